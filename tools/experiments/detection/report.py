"""The tables, notes and plot of a study that compares arms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

from drivesem.analysis.confirm import Confirmation
from drivesem.analysis.transfer import format_interval
from drivesem.attacks.targets import HEADLINE
from drivesem.evaluation.resampling import Interval, PairedDifference
from drivesem.failures.certificate import CertificateRule
from drivesem.failures.grades import Grade, Kind
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_count, format_percent
from drivesem.run.run_report import PAPER_BENIGN
from tools.experiments.detection.arms import PLACEBO, RANDOM, bootstrap_draws
from tools.experiments.detection.comparison import (
    METRIC_NAMES,
    MODES,
    ArmComparison,
    compare_arms,
    feasible_fraction,
)
from tools.experiments.detection.counts import StudyCounts
from tools.experiments.detection.labels import OVERLAPS, LabelComparison, compare_labels
from tools.experiments.detection.outcomes import (
    ArmGrades,
    SearchCost,
    SuccessCurve,
    WithstandingObjects,
    compare_success,
    count_grades,
    count_withstanding,
    search_costs,
    success_curve,
)
from tools.experiments.settings import StudyConfig
from tools.experiments.tables import study_command

OWN_PROTOCOL = (
    "Own protocol: not comparable with the paper's numbers, which stand only next to the paper's own protocol "
    "(--config paper)."
)
FEASIBLE = "Feasible by the independent check: {} % of all attacked frames."
_TEXT_COLUMNS = (_ARM, _METRIC, _CLASS) = ("arm", "metric", "class")
_CURVE_QUERIES = (1, 2, 5, 10, 20, 64)
"""Queries of a success curve that a table shows."""


@dataclass(frozen=True, slots=True)
class StudyResults:
    """All that a study of arms found."""

    study: StudyConfig
    """Settings of the study."""
    draws: int
    """Bootstrap draws of frames."""
    counts: StudyCounts
    """Counts of each arm."""
    rows: Sequence[ArmComparison]
    """Metrics of each arm that is no control."""
    curves: Sequence[SuccessCurve] = ()
    """Success curves, of `samples` and `steps`."""
    advantages: Mapping[str, PairedDifference] | None = None
    """Of `samples`, by arm: what the first arm breaks within its budget less what that arm breaks at its end."""
    label_sets: Sequence[LabelComparison] = ()
    """Both sets of labels by arm, of `labels`."""
    confirmed: Mapping[str, Confirmation] = field(default_factory=dict)
    """Survival under a second renderer by arm, with --confirm."""
    grades: Sequence[ArmGrades] = ()
    """Graded failures of all arms, controls included."""
    costs: Sequence[SearchCost] = ()
    """Cost of certain failures, of `searches`."""
    withstanding: Sequence[WithstandingObjects] = ()
    """Objects that withstand all arms, of `searches`."""

    def arm_rows(self) -> list[dict[str, Any]]:
        """Numbers of each arm by name, with survival under a second renderer where it was tested."""
        rows = [row.to_row() for row in self.rows]
        for row in rows:
            if row["name"] in self.confirmed:
                share = self.confirmed[row["name"]].shares[0]
                row |= {f"survive_{key}": getattr(share, key) for key in ("failures", "share", "low", "high")}
        return rows

    def csv_tables(self) -> dict[str, list[dict[str, Any]]]:
        """Rows of all tables by name; `study` holds the arms."""
        tables = {
            "study": self.arm_rows(),
            "curves": [point for curve in self.curves for point in curve.to_json()],
            "label_sets": [one.to_row() for one in self.label_sets],
            "grades": [one.to_row() for one in self.grades],
            "searches": [one.to_row() for one in self.costs],
            "standing": [one.to_row() for one in self.withstanding],
        }
        return {name: rows for name, rows in tables.items() if rows}

    def to_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        tables = self.csv_tables()
        return study_facts(self.study, self.draws, self.counts) | {"rows": tables.pop("study"), **tables}


def study_facts(study: StudyConfig, draws: int, counts: StudyCounts) -> dict[str, Any]:
    """The facts with which the JSON of a study of arms begins.

    Args:
        study: Settings of the study.
        draws: Bootstrap draws of frames.
        counts: Counts of its arms.
    """
    return {
        "study": study.name,
        "headline": HEADLINE,
        "frames": len(counts.arms[0].frames),
        "frames_without_vehicles": counts.without_vehicles,
        "frames_failed": {**counts.failed},
        "feasible_fraction": feasible_fraction(counts.frames),
        "bootstrap": draws,
    }


def build_results(
    study: StudyConfig, counts: StudyCounts, confirmed: Mapping[str, Confirmation] | None = None
) -> StudyResults:
    """Compute the metrics of a study from its counts.

    Args:
        study: Settings of the study.
        counts: Counts of its arms.
        confirmed: Survival under a second renderer by arm.
    """
    draws, arms, seed = bootstrap_draws(study), counts.arms, study.seed
    curves: Sequence[SuccessCurve] = ()
    advantages: Mapping[str, PairedDifference] | None = None
    if study.name in ("samples", "steps"):
        curves = [success_curve(arm, draws, seed) for arm in arms]
    if study.name == "samples":
        advantages = {arm.arm.name: compare_success(arms[0], study.steps, arm, draws, seed) for arm in arms}
    searches = study.name == "searches"
    return StudyResults(
        study,
        draws,
        counts,
        compare_arms(arms, draws, seed),
        curves=curves,
        advantages=advantages,
        label_sets=[compare_labels(name, frames) for name, frames in counts.labels.items()],
        confirmed=confirmed or {},
        grades=[count_grades(arm, draws, seed) for arm in arms if arm.graded],
        costs=search_costs(arms, counts.detected_objects, draws, seed) if searches else (),
        withstanding=count_withstanding(arms, counts.detected_objects) if searches else (),
    )


def build_study_report(
    study: StudyConfig,
    out: Path,
    data: Mapping[str, Any],
    csv_tables: Mapping[str, Sequence[Mapping[str, Any]]],
    tables: Sequence[ReportTable],
    printed: Sequence[ReportTable],
    **further: Any,
) -> AnalysisReport:
    """The report of any study on detectors.

    Args:
        study: Settings of the study.
        out: Its folder.
        data: What --json prints.
        csv_tables: Rows of CSV files by name.
        tables: Tables of the Markdown page.
        printed: Tables of the terminal.
        further: Other fields of `AnalysisReport`, such as notes, text_columns and picture.
    """
    return AnalysisReport(
        out=out,
        name="study",
        heading=f"Study: {study.name}",
        intro=[f"    {study_command(study)}", ""],
        data=data,
        csv_tables=csv_tables,
        tables=tables,
        printed_tables=printed,
        **further,
    )


def arms_report(results: StudyResults, out: Path) -> AnalysisReport:
    """The report of a study that compares arms."""
    tables = {name: report_tables(results, whole) for name, whole in (("page", True), ("terminal", False))}
    return build_study_report(
        results.study,
        out,
        results.to_json(),
        results.csv_tables(),
        tables["page"],
        [replace(table, rich_options={"unbroken": _TEXT_COLUMNS}) for table in tables["terminal"]],
        notes=build_notes(results),
        text_columns=_TEXT_COLUMNS,
    )


def report_tables(results: StudyResults, whole: bool = True) -> list[ReportTable]:
    """The study's own tables first; whole: also those that only some readers need."""
    tables: list[ReportTable] = []
    if results.curves:
        tables.append(_success_table(results))
    if results.label_sets:
        tables += [_label_table(results.label_sets), _counterexample_table(results.label_sets)]
    if results.grades and (whole or results.study.name in ("grades", "searches")):
        grades = _grade_table(results.grades) if whole else _short_grade_table(results.grades)
        tables += [grades, _kind_table(results.grades)]
    if results.costs:
        tables += [_cost_table(results.costs), _withstanding_table(results.withstanding)]
    tables.append(_precision_table(results.rows))
    if any(row.controls for row in results.rows):
        tables.append(_control_table(results.rows))
    if results.confirmed:
        tables.append(_confirmation_table(results.confirmed))
    return [*tables, *([_metric_table(results.rows)] if whole else []), _frame_table(results.rows)]


def _precision_table(rows: Sequence[ArmComparison]) -> ReportTable:
    with_paper = any(row.run.arm.reference is not None for row in rows)
    columns = [_ARM, "benign", *(f"{mode} labels" for mode in MODES), *(f"drop, {mode}" for mode in MODES)]
    lines = []
    for row in rows:
        reference = row.run.arm.reference
        cells = [row.name, *(format_percent(scores.ap50) for scores in (row.benign, row.paper, row.moved))]
        cells += [format_interval(row.drops[mode]["ap50"]) for mode in MODES]
        if with_paper:
            drop = "-" if reference is None else f"{100 * (PAPER_BENIGN - reference):.1f}"
            cells += [format_percent(reference), drop]
        lines.append(tuple(cells))
    columns += ["paper's mAP", "paper's drop"] if with_paper else []
    return ReportTable(f"{HEADLINE} AP50, %", tuple(columns), tuple(lines))


def _control_table(rows: Sequence[ArmComparison]) -> ReportTable:
    kinds = [kind for kind in (RANDOM, PLACEBO) if any(kind in row.controls for row in rows)]
    tested = any(row.p is not None for row in rows)
    lines = []
    for row in rows:
        cells = [row.name]
        for kind in kinds:
            control = row.controls.get(kind)
            cells.append("-" if control is None else format_interval(control.drops["moved"]["ap50"]))
            effect = "-" if control is None else format_interval(row.effects[kind]["moved"].interval)
            cells.append(f"{effect} *" if kind == row.matching_control else effect)
        size = row.controls[PLACEBO].size if PLACEBO in row.controls else None
        cells.append("-" if size is None else f"{size:.2f}")
        if tested:
            cells.append("-" if row.p is None else f"{row.p:.3f}")
        lines.append(tuple(cells))
    columns = [column for kind in kinds for column in (f"{kind} drop", f"attack less {kind}")]
    columns += [f"size of {PLACEBO}", *(["p of *"] if tested else [])]
    return ReportTable("Controls: AP50, moved labels, points", (_ARM, *columns), tuple(lines))


def _confirmation_table(confirmed: Mapping[str, Confirmation]) -> ReportTable:
    lines = []
    for name, one in confirmed.items():
        shares = (
            f"{format_interval(Interval(s.name, s.share, s.low, s.high))} of {s.failures}" if s.failures else "-"
            for s in one.shares
        )
        lines.append((name, str(one.frames), *shares))
    columns = (_ARM, "rendered", *(share.name for share in next(iter(confirmed.values())).shares))
    return ReportTable("Failures that survive a second renderer, %", columns, tuple(lines))


def _grade_table(grades: Sequence[ArmGrades]) -> ReportTable:
    lines = []
    for one in grades:
        cells = [one.name, str(one.frames), str(one.objects), str(one.passes)]
        cells += [str(one.counts[grade]) for grade in Grade]
        lines.append((*cells, format_interval(one.rates[Grade.CERTAIN]), _format_survival(one)))
    columns = (_ARM, "frames", "objects", "passes", *map(str, Grade), *_GRADE_SHARES)
    return ReportTable("Failures of at least each grade", columns, tuple(lines))


_GRADE_SHARES = ("certain, % of objects", "confirmed, % of certain")


def _short_grade_table(grades: Sequence[ArmGrades]) -> ReportTable:
    """The same for a terminal, with the counts in one column."""
    lines = []
    for one in grades:
        counts = _join_counts([one.counts[grade] for grade in Grade])
        lines.append(
            (one.name, counts, str(one.objects), format_interval(one.rates[Grade.CERTAIN]), _format_survival(one))
        )
    columns = (_ARM, "failures", "objects", *_GRADE_SHARES)
    return ReportTable(f"Failures by grade: {' / '.join(Grade)}", columns, tuple(lines))


def _format_survival(grades: ArmGrades) -> str:
    return f"{format_interval(grades.survive)} of {grades.second_rendered}" if grades.second_rendered else "-"


def _kind_table(grades: Sequence[ArmGrades]) -> ReportTable:
    levels = (Grade.THRESHOLD, Grade.CERTAIN, Grade.CONFIRMED)
    lines = [
        (one.name, *(_join_counts([one.kinds[kind][grade] for grade in levels]) for kind in Kind))
        for one in grades
    ]
    return ReportTable(f"Kinds of failure: {' / '.join(levels)}", (_ARM, *map(str, Kind)), tuple(lines))


def _join_counts(counts: Sequence[int]) -> str:
    """`7 / 3 / 2`, or a dash without any."""
    return " / ".join(map(str, counts)) if any(counts) else "-"


def _cost_table(costs: Sequence[SearchCost]) -> ReportTable:
    lines = []
    for one in costs:
        ahead = "-" if one.ahead is None else format_interval(one.ahead.interval)
        rates = map(_format_rate, (one.per_100_passes, one.per_minute))
        lines.append((one.name, f"{one.seconds:.1f}", *rates, ahead))
    columns = (
        _ARM,
        "s per frame",
        "certain per 100 passes",
        "certain per minute",
        f"{costs[0].name} less this, % of objects",
    )
    return ReportTable("Cost of certain failures", columns, tuple(lines))


def _format_rate(rate: Interval) -> str:
    """`0.52 [0.31, 0.70]`."""
    if rate.value is None or rate.low is None or rate.high is None:
        return "-" if rate.value is None else f"{rate.value:.2f}"
    return f"{rate.value:.2f} [{rate.low:.2f}, {rate.high:.2f}]"


def _withstanding_table(classes: Sequence[WithstandingObjects]) -> ReportTable:
    lines = [(one.name, str(one.objects), str(one.lost), format_interval(one.share)) for one in classes]
    columns = (_CLASS, "found", "lost to any", "withstand, %")
    return ReportTable("Objects that no method makes the detector lose with certainty", columns, tuple(lines))


def _metric_table(rows: Sequence[ArmComparison]) -> ReportTable:
    lines = []
    for row in rows:
        for key, name in METRIC_NAMES.items():
            if key == "ap50":
                continue
            scores = (getattr(one, key) for one in (row.benign, row.paper, row.moved))
            drops = (format_interval(row.drops[mode][key]) for mode in MODES)
            lines.append((row.name, name, *map(format_percent, scores), *drops))
    columns = (_ARM, _METRIC, "benign", *MODES, *(f"drop, {mode}" for mode in MODES))
    return ReportTable(f"{HEADLINE}, further metrics, %", columns, tuple(lines))


def _frame_table(rows: Sequence[ArmComparison]) -> ReportTable:
    controls = [name for name in (RANDOM, PLACEBO) if any(name in row.controls for row in rows)]
    lines = []
    for row in rows:
        flat = row.to_row()
        keys = [f"successes_{mode}" for mode in MODES] + [f"{name}_successes_moved" for name in controls]
        counts = [flat.get(key) for key in ("frames", *keys, "queries")]
        # an arm may lack a control that another has; over several seeds there is a mean
        cells = ["-" if count is None else f"{round(count, 1):.15g}" for count in counts]
        lines.append((row.name, *cells[:3], format_interval(row.broken_share("moved")), *cells[3:]))
    columns = (_ARM, "frames", *MODES, "moved, %", *controls, "queries")
    return ReportTable("Frames with a lost object or a phantom (Wilson's 95 %)", columns, tuple(lines))


def _success_table(results: StudyResults) -> ReportTable:
    most = max(curve.max_queries for curve in results.curves)
    marks = [mark for mark in _CURVE_QUERIES if mark <= most]
    lines = []
    for curve in results.curves:
        shares = [format_interval(curve.at(mark)) if mark <= curve.max_queries else "-" for mark in marks]
        last = format_interval(curve.at(curve.max_queries))
        mean = "-" if curve.mean_queries is None else f"{curve.mean_queries:.1f}"
        cells = [curve.name, *shares, f"{last} of {curve.max_queries}", mean]
        if results.advantages is not None:
            cells.append(format_interval(results.advantages[curve.name].interval))
        lines.append(tuple(cells))
    columns = [_ARM, *(f"{mark}" for mark in marks), "at the end", "mean queries"]
    if results.advantages is not None:
        columns.append(f"{results.curves[0].name} in {results.study.steps}, less this at the end")
    return ReportTable("Frames broken within so many queries, %", tuple(columns), tuple(lines))


def _label_table(sets: Sequence[LabelComparison]) -> ReportTable:
    lines = []
    for one in sets:
        ious = ("-" if value is None else f"{value:.3f}" for value in one.iou.values())
        lines.append((one.name, str(one.objects), *ious, *(format_percent(one.below[o]) for o in OVERLAPS)))
    columns = (_ARM, "objects", *sets[0].iou, *(f"below {o:g}, %" for o in OVERLAPS))
    return ReportTable("IoU of benign and moved labels", columns, tuple(lines))


def _counterexample_table(sets: Sequence[LabelComparison]) -> ReportTable:
    lines = [
        (one.name, f"{overlap:g}", *(str(count) for count in (one.frames, *astuple(counts))))
        for one in sets
        for overlap, counts in one.counts.items()
    ]
    columns = (_ARM, "IoU", "frames", "paper", "moved", "paper only", "lost, paper", "lost, paper only")
    return ReportTable("Counterexamples by benign (paper) and by moved labels", columns, tuple(lines))


def describe_intervals(draws: int) -> str:
    """The sentence on the intervals of a table; empty without draws."""
    return f" In brackets: 95 % interval over {draws} bootstrap draws of frames, paired." if draws else ""


LABEL_MODES = "Paper: by the benign labels, as in the paper. Moved: by labels that move with the cars."


def describe_skipped(without_vehicles: int, failed: Mapping[str, str]) -> list[str]:
    """Notes on frames that were skipped or failed."""
    notes = [f"Skipped: {format_count(without_vehicles, 'frame')} without vehicles."] if without_vehicles else []
    return notes + [f"Frame {name} could not be used: {reason}" for name, reason in failed.items()]


def build_notes(results: StudyResults) -> list[str]:
    """What the columns mean."""
    notes = [f"{LABEL_MODES}{describe_intervals(results.draws)}"]
    if any(row.run.arm.reference is not None for row in results.rows):
        notes.append(
            f"Paper's mAP: of its own detector on Virtual KITTI, {100 * PAPER_BENIGN:.1f} before the attack; "
            "shown only for the paper's protocol."
        )
    elif results.study.name in ("single", "multi"):
        notes.append(OWN_PROTOCOL)
    controls = [control for row in results.rows for control in row.controls.values()]
    if any(RANDOM in row.controls for row in results.rows):
        notes.append(
            "Random: the best of as many uniform samples as the attack takes steps, within the reach of its steps."
        )
    if controls:
        seeds = max(len(control.runs) for control in controls)
        means = f" Controls are means over {seeds} seeds." if seeds > 1 else ""
        notes.append(
            "Placebo: one random edit as large as the attack's, through the same pipeline; its size in units of "
            "the attack's, which projection onto the feasible set may reduce. *: the attack's effect, which is the "
            "drop of AP50 beyond that of the control with as many chances: random if the attack keeps its best "
            f"iterate, the placebo if it keeps the last. p: permutation of frames, Holm-adjusted over rows.{means}"
        )
    if results.curves:
        notes.append(
            "Each frame ends at its first success by moved labels. A query is one gradient or one evaluated render. "
            "Gradient-free methods search the reach of si-FGSM's steps, or all of the bounds."
        )
    if results.label_sets:
        notes.append(
            "Attacks use the benign labels unless the arm's name differs. Paper only: counterexamples by the "
            "benign labels and not by the moved ones, if a detection meets a label from that IoU on. The chosen "
            "iterate fails most by moved labels at IoU 0.5; chosen by the benign labels there would be more."
        )
    if results.confirmed:
        notes.append(
            "Survive: the detector also fails on the same change, rendered by a second renderer with that "
            "renderer's labels; in brackets Wilson's 95 %. Second only: of frames that did not fail before."
        )
    if results.grades:
        rule = CertificateRule(results.study.draws)
        notes.append(
            f"Certain: right in {rule.before} of {rule.draws} nuisance samples before, wrong in {rule.after} of "
            f"{rule.draws} after. Confirmed: a second renderer's pictures fail too, in 3 of 4. Shared: so does "
            "another architecture. Kinds leave out what a person would not call a failure: an object found as far "
            "as it is visible, a detection on a real object, an object that was doubtful before."
        )
    if results.costs:
        notes.append(
            "Passes: of the detector, with a gradient counted as 3 and certificates left out. Seconds: all that a "
            "frame takes on this machine, certificates included. Found: objects that the detector finds in the "
            "photograph; in brackets Wilson's 95 %."
        )
    unknown = [one.arm.name for one in results.counts.arms if not one.graded]
    if unknown:
        notes.append(f"Not graded: {', '.join(unknown)}.")
    notes.append(FEASIBLE.format(format_percent(feasible_fraction(results.counts.frames))))
    return notes + describe_skipped(results.counts.without_vehicles, results.counts.failed)
