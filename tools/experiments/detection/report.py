"""A study for people: tables on the terminal and in Markdown, with what they mean."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

from drivesem.analysis.confirm.report import Confirmation
from drivesem.analysis.transfer.report import bounded
from drivesem.attack.targets import HEADLINE
from drivesem.evaluation.resampling import Difference, Interval
from drivesem.failures.certificate import CertificateRule
from drivesem.failures.grades import Grade, Kind
from drivesem.report.paper import PAPER_BENIGN
from drivesem.report.tables import AnalysisReport, ReportTable, format_count, format_percent
from tools.experiments.detection.arms import PLACEBO, RANDOM
from tools.experiments.detection.counts import StudyCounts
from tools.experiments.detection.grades import ArmGrades
from tools.experiments.detection.labels import OVERLAPS, LabelComparison
from tools.experiments.detection.rows import METRIC_NAMES, MODES, ArmComparison, feasible_fraction
from tools.experiments.detection.searches import SearchCost, WithstandingObjects
from tools.experiments.detection.success import SuccessCurve
from tools.experiments.settings import StudyConfig

OWN_PROTOCOL = (
    "Ours, own protocol: not comparable with the paper's figures, which stand beside its own protocol only "
    "(--config paper)."
)
_ARM, _MEASURE, _CLASS = "arm", "figure", "class"
_WORDS = (_ARM, _MEASURE, _CLASS)
_MARKS = (1, 2, 5, 10, 20, 64)
"""Queries at which a curve is told in a table."""


@dataclass(frozen=True, slots=True)
class StudyText:
    """A study as text. short: the tables of `sheets` that a terminal shows; tables: rows of CSV files by name;
    words: columns of words, the others hold numbers; unbroken: those that a terminal does not wrap.
    """

    study: str
    sheets: Sequence[ReportTable]
    short: Sequence[ReportTable]
    notes: Sequence[str]
    tables: Mapping[str, Sequence[Mapping[str, Any]]]
    words: Collection[str]
    unbroken: Collection[str] = ()


def heading(study: StudyConfig, draws: int, counts: StudyCounts) -> dict[str, Any]:
    """What the JSON object of a study of arms begins with."""
    return {
        "study": study.name,
        "headline": HEADLINE,
        "frames": len(counts.arms[0].frames),
        "frames_without_vehicles": counts.without_vehicles,
        "frames_failed": {**counts.failed},
        "feasible_fraction": feasible_fraction(counts.frames),
        "bootstrap": draws,
    }


@dataclass(frozen=True, slots=True)
class StudyResults:
    """All that a study found. curves, beside: of studies of success; beside: by arm, what the first arm breaks
    within `within` queries less what that arm does at its end. label_sets: of the study `labels`. confirmed: what
    second renderers' pictures say, by arm. grades: how sure failures are, of every arm, controls included. costs,
    standing: of the study `searches`.
    """

    study: StudyConfig
    draws: int
    counts: StudyCounts
    rows: Sequence[ArmComparison]
    curves: Sequence[SuccessCurve] = ()
    advantages: Mapping[str, Difference] | None = None
    within: int = 0
    label_sets: Sequence[LabelComparison] = ()
    confirmed: Mapping[str, Confirmation] = field(default_factory=dict)
    grades: Sequence[ArmGrades] = ()
    costs: Sequence[SearchCost] = ()
    withstanding: Sequence[WithstandingObjects] = ()

    def to_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        data = heading(self.study, self.draws, self.counts) | {"rows": self.arm_rows()}
        if self.curves:
            data["curves"] = [point for curve in self.curves for point in curve.to_json()]
        if self.label_sets:
            data["label_sets"] = [one.to_row() for one in self.label_sets]
        if self.grades:
            data["grades"] = [one.to_row() for one in self.grades]
        if self.costs:
            data["searches"] = [one.to_row() for one in self.costs]
            data["standing"] = [one.to_row() for one in self.withstanding]
        return data

    def arm_rows(self) -> list[dict[str, Any]]:
        """Numbers of each row by name, with those of the second renderer where it was asked."""
        rows = [row.to_row() for row in self.rows]
        for row in rows:
            if row["name"] in self.confirmed:
                share = self.confirmed[row["name"]].shares[0]
                told = {"failures": share.failures, "share": share.share, "low": share.low, "high": share.high}
                row |= {f"survive_{key}": value for key, value in told.items()}
        return rows


def sheets(found: StudyResults, whole: bool = True) -> list[ReportTable]:
    """The study's own question first. whole: with the figures that only some ask for."""
    tables: list[ReportTable] = []
    if found.curves:
        tables.append(_success(found))
    if found.label_sets:
        tables += [_label_sets(found.label_sets), _counterexamples(found.label_sets)]
    if found.grades and (whole or found.study.name in ("grades", "searches")):
        tables += [_grades(found.grades) if whole else _grades_short(found.grades), _kinds(found.grades)]
    if found.costs:
        tables += [_costs(found.costs), _standing(found.withstanding)]
    tables.append(_precision(found.rows))
    if any(row.controls for row in found.rows):
        tables.append(_controls(found.rows))
    if found.confirmed:
        tables.append(_confirmed(found.confirmed))
    return [*tables, *([_further(found.rows)] if whole else []), _frames(found.rows)]


def _precision(rows: Sequence[ArmComparison]) -> ReportTable:
    told = any(row.run.arm.reference is not None for row in rows)
    columns = [_ARM, "benign", *(f"{mode} labels" for mode in MODES), *(f"falls, {mode}" for mode in MODES)]
    lines = []
    for row in rows:
        reference = row.run.arm.reference
        cells = [row.name, *(format_percent(scores.ap50) for scores in (row.benign, row.paper, row.moved))]
        cells += [bounded(row.drops[mode]["ap50"]) for mode in MODES]
        if told:
            cells += [
                format_percent(reference),
                "-" if reference is None else f"{100 * (PAPER_BENIGN - reference):.1f}",
            ]
        lines.append(tuple(cells))
    columns += ["mAP there", "falls there"] if told else []
    return ReportTable(f"{HEADLINE} AP50, %", tuple(columns), tuple(lines))


def _controls(rows: Sequence[ArmComparison]) -> ReportTable:
    kinds = [kind for kind in (RANDOM, PLACEBO) if any(kind in row.controls for row in rows)]
    tested = any(row.p is not None for row in rows)
    lines = []
    for row in rows:
        cells = [row.name]
        for kind in kinds:
            control = row.controls.get(kind)
            cells.append("-" if control is None else bounded(control.drops["moved"]["ap50"]))
            effect = "-" if control is None else bounded(row.effects[kind]["moved"].interval)
            cells.append(f"{effect} *" if kind == row.matching_control else effect)
        size = row.controls[PLACEBO].size if PLACEBO in row.controls else None
        cells.append("-" if size is None else f"{size:.2f}")
        lines.append((*cells, *([] if not tested else ["-" if row.p is None else f"{row.p:.3f}"])))
    columns = [column for kind in kinds for column in (f"{kind} falls", f"attack less {kind}")]
    columns += [f"size of {PLACEBO}", *(["p of *"] if tested else [])]
    return ReportTable("Controls: AP50, moved labels, points", (_ARM, *columns), tuple(lines))


def _confirmed(confirmed: Mapping[str, Confirmation]) -> ReportTable:
    lines = []
    for name, one in confirmed.items():
        cells = [name, str(one.frames)]
        for share in one.shares:
            value = bounded(Interval(share.name, share.share, share.low, share.high))
            cells.append(f"{value} of {share.failures}" if share.failures else "-")
        lines.append(tuple(cells))
    names = next(iter(confirmed.values())).shares
    return ReportTable(
        "Failures that survive a second renderer, %",
        (_ARM, "drawn", *(s.name for s in names)),
        tuple(lines),
    )


def _grades(grades: Sequence[ArmGrades]) -> ReportTable:
    lines = []
    for one in grades:
        survive = f"{bounded(one.survive)} of {one.second_rendered}" if one.second_rendered else "-"
        cells = [one.name, str(one.frames), str(one.objects), str(one.passes)]
        cells += [str(one.counts[grade]) for grade in Grade]
        lines.append((*cells, bounded(one.rates[Grade.CERTAIN]), survive))
    columns = (
        _ARM,
        "frames",
        "objects",
        "passes",
        *map(str, Grade),
        "certain, % of objects",
        "confirmed, % of certain",
    )
    return ReportTable("Failures by grade, each with those above it", columns, tuple(lines))


def _grades_short(grades: Sequence[ArmGrades]) -> ReportTable:
    """The same for a terminal: counts in one column."""
    lines = []
    for one in grades:
        survive = f"{bounded(one.survive)} of {one.second_rendered}" if one.second_rendered else "-"
        counts = _by_grade([one.counts[grade] for grade in Grade])
        lines.append((one.name, counts, str(one.objects), bounded(one.rates[Grade.CERTAIN]), survive))
    columns = (_ARM, "failures", "objects", "certain, % of objects", "confirmed, % of certain")
    return ReportTable(f"Failures by grade: {' / '.join(Grade)}", columns, tuple(lines))


def _kinds(grades: Sequence[ArmGrades]) -> ReportTable:
    told = (Grade.THRESHOLD, Grade.CERTAIN, Grade.CONFIRMED)
    lines = [
        (one.name, *(_by_grade([one.kinds[kind][grade] for grade in told]) for kind in Kind)) for one in grades
    ]
    return ReportTable(f"Kinds of failure: {' / '.join(told)}", (_ARM, *map(str, Kind)), tuple(lines))


def _by_grade(counts: Sequence[int]) -> str:
    """`7 / 3 / 2`, or a dash where there is none."""
    return " / ".join(map(str, counts)) if any(counts) else "-"


def _costs(costs: Sequence[SearchCost]) -> ReportTable:
    lines = []
    for one in costs:
        ahead = "-" if one.ahead is None else bounded(one.ahead.interval)
        lines.append((one.name, f"{one.seconds:.1f}", *map(_number, (one.per_100_passes, one.per_minute)), ahead))
    columns = (
        _ARM,
        "s a frame",
        "certain for 100 passes",
        "certain a minute",
        f"{costs[0].name} less this, % of objects",
    )
    return ReportTable("What certain failures cost", columns, tuple(lines))


def _number(one: Interval) -> str:
    """`0.52 [0.31, 0.70]`."""
    if one.value is None or one.low is None or one.high is None:
        return "-" if one.value is None else f"{one.value:.2f}"
    return f"{one.value:.2f} [{one.low:.2f}, {one.high:.2f}]"


def _standing(classes: Sequence[WithstandingObjects]) -> ReportTable:
    lines = [(one.name, str(one.objects), str(one.lost), bounded(one.share)) for one in classes]
    return ReportTable(
        "Objects that no method brings to fall for certain",
        (_CLASS, "found", "lost to any", "standing, %"),
        tuple(lines),
    )


def _further(rows: Sequence[ArmComparison]) -> ReportTable:
    lines = []
    for row in rows:
        for key, name in METRIC_NAMES.items():
            if key == "ap50":
                continue
            scores = (getattr(one, key) for one in (row.benign, row.paper, row.moved))
            falls = (bounded(row.drops[mode][key]) for mode in MODES)
            lines.append((row.name, name, *map(format_percent, scores), *falls))
    columns = (_ARM, _MEASURE, "benign", *MODES, *(f"falls, {mode}" for mode in MODES))
    return ReportTable(f"{HEADLINE}, further figures, %", columns, tuple(lines))


def _frames(rows: Sequence[ArmComparison]) -> ReportTable:
    controls = [name for name in (RANDOM, PLACEBO) if any(name in row.controls for row in rows)]
    lines = []
    for row in rows:
        flat = row.to_row()
        keys = [f"successes_{mode}" for mode in MODES] + [f"{name}_successes_moved" for name in controls]
        counts = [flat.get(key) for key in ("frames", *keys, "queries")]
        # An arm may have none of the controls that another has; of several seeds there is a mean.
        told = ["-" if count is None else f"{round(count, 1):.15g}" for count in counts]
        lines.append((row.name, *told[:3], bounded(row.broken_share("moved")), *told[3:]))
    columns = (_ARM, "frames", *MODES, "moved, %", *controls, "queries")
    return ReportTable(
        "Frames in which something was lost or made up (in brackets Wilson's 95 %)", columns, tuple(lines)
    )


def _success(found: StudyResults) -> ReportTable:
    most = max(curve.max_queries for curve in found.curves)
    marks = [mark for mark in _MARKS if mark <= most]
    lines = []
    for curve in found.curves:
        shares = [bounded(curve.at(mark)) if mark <= curve.max_queries else "-" for mark in marks]
        last = bounded(curve.at(curve.max_queries))
        mean = "-" if curve.mean_queries is None else f"{curve.mean_queries:.1f}"
        cells = [curve.name, *shares, f"{last} of {curve.max_queries}", mean]
        if found.advantages is not None:
            one = found.advantages[curve.name]
            cells.append(bounded(one.interval))
        lines.append(tuple(cells))
    columns = [_ARM, *(f"{mark}" for mark in marks), "at the end", "mean queries"]
    if found.advantages is not None:
        columns.append(f"{found.curves[0].name} in {found.within}, less this at the end")
    return ReportTable("Frames broken after so many queries, %", tuple(columns), tuple(lines))


def _label_sets(sets: Sequence[LabelComparison]) -> ReportTable:
    lines = []
    for one in sets:
        iou = ("-" if value is None else f"{value:.3f}" for value in one.iou.values())
        lines.append((one.name, str(one.objects), *iou, *(format_percent(one.below[o]) for o in OVERLAPS)))
    columns = (_ARM, "objects", *sets[0].iou, *(f"below {o:g}, %" for o in OVERLAPS))
    return ReportTable("IoU of benign and moved labels", columns, tuple(lines))


def _counterexamples(sets: Sequence[LabelComparison]) -> ReportTable:
    lines = [
        (one.name, f"{overlap:g}", *(str(count) for count in (one.frames, *astuple(at))))
        for one in sets
        for overlap, at in one.counts.items()
    ]
    columns = (_ARM, "IoU", "frames", "paper", "moved", "paper only", "lost, paper", "lost, paper only")
    return ReportTable("Counterexamples by benign (paper) and by moved labels", columns, tuple(lines))


def notes(found: StudyResults) -> list[str]:
    """What the columns mean."""
    spread = f" In brackets: 95 % of {found.draws} draws of frames, paired." if found.draws else ""
    told = [
        f"Paper: by the benign labels, as in the paper; moved: by labels that moved with the cars.{spread}",
    ]
    if any(row.run.arm.reference is not None for row in found.rows):
        told.append(
            "There: in the paper, with its own detector on Virtual KITTI, mAP "
            f"{100 * PAPER_BENIGN:.1f} before; beside rows under the paper's protocol, and no others."
        )
    elif found.study.name in ("single", "multi"):
        told.append(OWN_PROTOCOL)
    if any(RANDOM in row.controls for row in found.rows):
        told.append(
            "Random: the best of as many uniform samples as the attack takes steps, where those steps may lead."
        )
    if any(row.controls for row in found.rows):
        seeds = max(len(control.runs) for row in found.rows for control in row.controls.values())
        several = f" Controls are means of {seeds} seeds." if seeds > 1 else ""
        told.append(
            "Placebo: one random edit as large as the attack's, through the same pipeline; its size beside the "
            "attack's, which projection onto what is feasible may lessen. *: the attack's effect, which is how "
            "much further AP50 falls than with a control of as many chances: random where it keeps the best of "
            "its iterates, the placebo where it keeps the last. p: permutation of frames, Holm's over the "
            f"rows.{several}"
        )
    if found.curves:
        told.append(
            "Each frame ends at its first success by moved labels. A query is one gradient, or one judged render; "
            "methods without gradient look where si-FGSM's steps may lead, or in all of the bounds."
        )
    if found.label_sets:
        told.append(
            "Attacks aim at the benign labels where the arm says nothing else. Paper only: counterexamples by the "
            "benign labels which are none by moved ones, where a detection meets a label from that IoU on. Of an "
            "attack's iterates the one that fails most by moved labels at IoU 0.5 is kept: chosen by the benign "
            "labels there would be more."
        )
    if found.confirmed:
        told.append(
            "Survive: the same change, drawn by a second renderer and with its labels, fails the detector too; in "
            "brackets Wilson's 95 %. Second only: of frames that did not fail before."
        )
    if found.grades:
        rule = CertificateRule(found.study.draws)
        told.append(
            f"Certain: right in {rule.before} of {rule.draws} draws of a camera's small changes before, wrong in "
            f"{rule.after} of {rule.draws} after. "
            "Confirmed: a second renderer's pictures fail too, in 3 of 4. Shared: so does another architecture. "
            "Kinds leave out what a person would not call a failure: found as far as it shows, on a real object, "
            "suspect before."
        )
    if found.costs:
        told.append(
            "Passes: of the detector, a gradient counted as 3; certificates are not counted. Seconds: all that a "
            "frame takes on this machine, certificates included. Found: objects that the detector finds in the "
            "photograph; in brackets Wilson's 95 %."
        )
    unknown = [one.arm.name for one in found.counts.arms if not one.graded]
    if unknown:
        told.append(f"Grades unknown, of an older version or without them: {', '.join(unknown)}.")
    share = feasible_fraction(found.counts.frames)
    told.append(f"Feasible by the independent check: {format_percent(share)} % of all attacked frames.")
    if found.counts.without_vehicles:
        told.append(f"{format_count(found.counts.without_vehicles, 'frame')} without vehicles passed over.")
    told += [f"Frame {name} could not be used: {reason}" for name, reason in found.counts.failed.items()]
    return told


def study_text(found: StudyResults) -> StudyText:
    """The tables of all arms."""
    tables = {"study": found.arm_rows()}
    if found.curves:
        tables["curves"] = [point for curve in found.curves for point in curve.to_json()]
    if found.label_sets:
        tables["label_sets"] = [one.to_row() for one in found.label_sets]
    if found.grades:
        tables["grades"] = [one.to_row() for one in found.grades]
    if found.costs:
        tables["searches"] = [one.to_row() for one in found.costs]
        tables["standing"] = [one.to_row() for one in found.withstanding]
    return StudyText(
        found.study.name, sheets(found), sheets(found, whole=False), notes(found), tables, _WORDS, _WORDS
    )


def build_report(
    told: StudyText, out: Path, data: Mapping[str, Any], command: str, picture: Callable[[Path], object] | None
) -> AnalysisReport:
    """A study in its folder. data: its JSON; command: what repeats it; picture: draws it."""
    return AnalysisReport(
        out=out,
        name="study",
        heading=f"Study: {told.study}",
        intro=[f"    {command}", ""],
        data=data,
        csv_tables=told.tables,
        tables=told.sheets,
        printed_tables=[replace(sheet, looks={"unbroken": told.unbroken}) for sheet in told.short],
        notes=told.notes,
        text_columns=told.words,
        picture=picture,
    )
