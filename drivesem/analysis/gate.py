"""Compares two detectors around certain failures of runs: does the new one fail more often?"""

from __future__ import annotations

import time
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from detectors.base import DetectorError, Predictor
from detectors.registry import load_predictor
from drivesem.attacks.space import parse_params
from drivesem.attacks.targets import EvaluatedClasses, resolve_t_star
from drivesem.config.commands import GateConfig
from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS, LEVEL, PairedDifference, holm, paired_differences, ratio_metric
from drivesem.failures.neighbourhood import NEAR_REACH, Neighbourhood
from drivesem.report.tables import AnalysisReport, ReportTable, format_count
from drivesem.run.driver import FrameAnalyser, analyse_runs
from drivesem.run.finished import AttackRun, RebuiltFrame, load_runs
from drivesem.run.folder import (
    FRAMES,
    PRESENTATION,
    claim_folder,
    load_attack_config,
    load_trusted_config,
    resolve_output_folder,
)
from drivesem.run.frame import certain_losses
from drivesem.run.results import Failure
from scene_ir import files

_WRITTEN = ("gate.json", "gate.md", "gate.csv", "gate.xml", "runs")
_FREE = (*PRESENTATION, "runs", "tolerance", "bootstrap")
HOLE, KIND, ALL, PHANTOMS = "hole", "kind", "all", "phantoms"
_MAX_PRINTED = 12
"""Holes in the table on a terminal; the files have all."""
_NOTE = (
    "Lost: share of samples around a certain failure in which a detector misses the object; both detectors get "
    "the same pictures. Phantoms: share of these samples with a detection on nothing, anywhere in the picture. In "
    "brackets: 95 % paired bootstrap interval, over samples for a hole, and over holes for kinds, all, and "
    "phantoms. p: exact sign test of the samples in which only one detector fails, with Holm's correction over "
    "all rows. A row grew if the difference exceeds the tolerance, its interval lies above 0, and p is below 0.05."
)
_NO_FAILURES = "These runs have no certain failure of an object: nothing to compare, so the gate is passed."
_NO_SAMPLES = "No sample counts around any certain failure: nothing was compared, so the gate is not passed."


@dataclass(frozen=True, slots=True)
class PairedSamples:
    """The same samples around one certain failure before two detectors."""

    index: int | None
    """Number of the object; None if the frame shows a single object."""
    label: str
    """Class of the object."""
    error: str
    """Kind of the failure."""
    before: tuple[bool, ...]
    """Whether the old detector misses the object, per sample."""
    after: tuple[bool, ...]
    """Whether the new detector misses it."""
    phantoms_before: tuple[bool, ...] = ()
    """Whether the old detector reports something where nothing is, per sample."""
    phantoms_after: tuple[bool, ...] = ()
    """Whether the new detector does."""


@dataclass(frozen=True, slots=True)
class FrameGateResult:
    """Samples of all certain failures of a frame."""

    identifier: str
    """The frame."""
    source: str
    """Digest of the run's result.json."""
    pairs: tuple[PairedSamples, ...]
    """Samples per failure."""
    seconds: float
    """Run time; the only field that may differ between two calls."""


@dataclass(frozen=True, slots=True)
class GateRow:
    """Failure rates of two detectors, compared."""

    level: str
    """HOLE, KIND, ALL or PHANTOMS."""
    hole: str
    """Name of the hole, or of the kind."""
    before: float
    """Share of samples in which the old detector fails."""
    after: float
    """Share of samples in which the new detector fails."""
    difference: float
    """`after` - `before`."""
    low: float | None
    """Lower end of its 95 % paired bootstrap interval, over samples of one hole or over holes."""
    high: float | None
    """Upper end."""
    p: float
    """P-value of the one-sided sign test, with Holm's correction over all rows."""
    samples: int
    """Number of samples."""
    holes: int
    """Number of holes."""
    grew: bool
    """Whether the rate grew by more than the tolerance and more than chance explains."""

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object."""
        data = asdict(self)
        data["interval"] = [data.pop("low"), data.pop("high")]
        return data


def run_gate(config: GateConfig) -> AnalysisReport:
    """Compare two detectors, write the report, and return it; `data["passed"]` is the verdict.

    Raises UsageError or SceneError for bad input.
    """
    runs = load_runs(config.runs, config.limit, "RUN")
    if config.before is None:
        config = replace(config, before=_attacked_detector(runs, config.trust))
    load_detector_pair(config)
    out = resolve_output_folder(config.out, runs[0].folder / "gate")
    claim_folder(out, config, _WRITTEN, _FREE, renews=True)
    frames = [(run, [f.result.identifier for f in run.frames if certain_losses(f.result)]) for run in runs]
    results, failed = analyse_runs(
        frames, partial(GateAnalyser, config), out / "runs", config, "comparing detectors in"
    )
    pairs = {name: result.pairs for name, result in results.items()}
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    facts = {
        "runs": [str(run.folder) for run in runs],
        "before": config.before,
        "after": config.after,
        "tolerance": config.tolerance,
    }
    rows = compute_gate_rows(pairs, config.tolerance, draws, config.seed)
    report = build_gate_report(out, rows, sum(map(len, pairs.values())), facts, failed)
    report.write()
    return report


def _attacked_detector(runs: Sequence[AttackRun], trust: bool) -> str:
    """Return the detector that the runs attacked. Raises UsageError if they have several, if it runs code that is
    not trusted, or if its file has changed since, as it may be the new detector.
    """
    names = list(dict.fromkeys(load_trusted_config(run.folder, trust, "RUN").detector for run in runs))
    if len(names) > 1:
        raise UsageError("--before", "the current detector, as these runs have several", ", ".join(names))
    return names[0]


def load_detector_pair(config: GateConfig) -> tuple[Predictor, Predictor]:
    """Load the old and the new detector. Raises UsageError if one is missing or their classes differ."""
    detectors: list[Predictor] = []
    for setting, name in (("--before", config.before or ""), ("--after", config.after or "")):
        try:
            detectors.append(load_predictor(name, config.device, config.tiles))
            EvaluatedClasses.from_detector(detectors[-1])
        except DetectorError as error:
            raise UsageError.from_detector_error(setting, "a detector", error) from error
    before, after = detectors
    missing = [name for name in before.classes if name not in after.classes]
    additional = [name for name in after.classes if name not in before.classes]
    if missing or additional:
        first = f"no {missing[0]}" if missing else f"{additional[0]}, which --before does not know"
        raise UsageError("--after", "the classes of --before", first)
    return before, after


class GateAnalyser(FrameAnalyser[FrameGateResult]):
    """Evaluates both detectors on samples around the certain failures of a run's frames."""

    file, kind, schema = "gate.json", FrameGateResult, 2

    def __init__(self, config: GateConfig, run: AttackRun, out: Path) -> None:
        super().__init__(run.folder, out)
        self.config = config
        self.attack, self.params = load_attack_config(run.folder, "RUN"), parse_params(run.params)
        self.detectors = load_detector_pair(config)

    def analyse(self, name: str, folder: Path) -> FrameGateResult:
        """See `FrameAnalyser`."""
        start = time.perf_counter()
        before, after = self.detectors
        frame = RebuiltFrame.load(self.run_folder / FRAMES / name, self.attack, self.params, before)
        pairs = tuple(
            _draw_paired_samples(failure, neighbourhood, after, self.config.samples)
            for failure, neighbourhood in frame.neighbourhoods(str(self.config.seed))
        )
        return FrameGateResult(name, self.source_digest(name), pairs, round(time.perf_counter() - start, 3))


def _draw_paired_samples(
    failure: Failure, neighbourhood: Neighbourhood, after: Predictor, samples: int
) -> PairedSamples:
    camera, index = neighbourhood.camera_for(after, resolve_t_star(after)), neighbourhood.index
    outcomes = []
    for number in range(samples):
        # half of the samples lie near the failure, as a hole may be small compared with its neighbourhood
        sample = neighbourhood.sample(number, 1.0 if number % 2 == 0 else NEAR_REACH)
        if sample is not None:
            outcomes.append(
                (neighbourhood.evaluate(sample).outcome, neighbourhood.evaluate(sample, camera).outcome)
            )
    return PairedSamples(
        index,
        failure.label,
        failure.error or "",
        before=tuple(not bool(old.detected[index]) for old, _ in outcomes),
        after=tuple(not bool(new.detected[index]) for _, new in outcomes),
        phantoms_before=tuple(bool(old.background) for old, _ in outcomes),
        phantoms_after=tuple(bool(new.background) for _, new in outcomes),
    )


def compute_gate_rows(
    pairs_by_frame: Mapping[str, Sequence[PairedSamples]], tolerance: float, draws: int, seed: int
) -> list[GateRow]:
    """Compare failure rates by hole, by kind of failure, in total, and of phantoms.

    Args:
        pairs_by_frame: Samples per failure, by frame; those without samples get no row.
        tolerance: Largest acceptable growth of a rate.
        draws: Bootstrap draws.
        seed: Seed of the bootstrap.

    Returns:
        Rows of holes, those that grew most first; then of kinds, of all holes, and of phantoms.
    """
    named = [
        (frame if p.index is None else f"{frame}: objects[{p.index}]", p)
        for frame, pairs in pairs_by_frame.items()
        for p in pairs
        if p.before
    ]
    hole_rows = [_compute_row(HOLE, name, [pair], tolerance, draws, seed) for name, pair in named]
    hole_rows.sort(key=lambda row: (-row.difference, row.hole))
    kinds = sorted({pair.error for _, pair in named})
    kind_rows = [
        _compute_row(KIND, kind, [pair for _, pair in named if pair.error == kind], tolerance, draws, seed)
        for kind in kinds
    ]
    pairs = [pair for _, pair in named]
    phantoms = [replace(p, before=p.phantoms_before, after=p.phantoms_after) for p in pairs if p.phantoms_before]
    rows = [*hole_rows, *kind_rows]
    rows += [_compute_row(ALL, ALL, pairs, tolerance, draws, seed)] if pairs else []
    rows += [_compute_row(PHANTOMS, PHANTOMS, phantoms, tolerance, draws, seed)] if phantoms else []
    # The row of a kind with one hole, and that of all holes of one kind, repeat another row: no further test.
    tested = [
        row.p
        for row in rows
        if not (row.level == KIND and row.holes == 1) and not (row.level == ALL and len(kinds) == 1)
    ]
    adjusted = {p: corrected for p, corrected in zip(tested, holm(tested), strict=True) if corrected is not None}
    return [replace(row, p=adjusted[row.p], grew=row.grew and adjusted[row.p] < 1 - LEVEL) for row in rows]


def _compute_row(
    level: str, name: str, pairs: Sequence[PairedSamples], tolerance: float, draws: int, seed: int
) -> GateRow:
    """Compute a row, with p uncorrected and `grew` without the test."""
    if len(pairs) == 1:  # of one hole, resample the samples
        before, after = (np.array(side, np.float64) for side in (pairs[0].before, pairs[0].after))
        count = np.ones(len(before))
    else:
        before, after = (
            np.array([sum(getattr(p, side)) for p in pairs], np.float64) for side in ("before", "after")
        )
        count = np.array([len(p.before) for p in pairs], np.float64)
    rates = _compare_rates(before, after, count, draws, seed)
    assert rates.first is not None
    assert rates.second is not None
    assert rates.difference is not None
    return GateRow(
        level=level,
        hole=name,
        before=rates.first,
        after=rates.second,
        difference=rates.difference,
        low=rates.low,
        high=rates.high,
        p=_sign_test(pairs),
        samples=sum(len(pair.before) for pair in pairs),
        holes=len(pairs),
        grew=rates.difference > tolerance and (rates.low is None or rates.low > 0),
    )


def _compare_rates(
    before: np.ndarray, after: np.ndarray, count: np.ndarray, draws: int, seed: int
) -> PairedDifference:
    first, second = ratio_metric("lost", before, count), ratio_metric("lost", after, count)
    rng = np.random.default_rng(seed)
    (difference,) = paired_differences([first], [second], len(count), draws, rng, test=False)
    return difference


def _sign_test(pairs: Sequence[PairedSamples]) -> float:
    """Return the exact one-sided p-value over the samples in which only one detector fails (McNemar 1947): if both
    were equally good, either would fail with even odds.
    """
    from scipy.stats import binomtest  # on use: it takes a third of a second to load

    discordant = [after for p in pairs for before, after in zip(p.before, p.after, strict=True) if before != after]
    if not discordant:
        return 1.0
    return float(binomtest(sum(discordant), len(discordant), alternative="greater").pvalue)


def build_gate_report(
    out: Path,
    rows: Sequence[GateRow],
    holes: int,
    facts: Mapping[str, Any],
    failed: Mapping[str, str],
    verb: str = "lost",
    note: str = _NOTE,
) -> AnalysisReport:
    """Decide whether the gate is passed, and write gate.xml.

    Args:
        out: Output folder.
        rows: The comparison.
        holes: Number of certain failures, with samples or not.
        facts: First entries of the JSON.
        failed: Reasons by frame that could not be compared; if there are any, the gate is not passed.
        verb: Past participle that names a failure.
        note: Explanation of the columns.
    """
    files.write_text(out / "gate.xml", format_junit(rows, failed, verb))
    no_samples = holes > 0 and not rows
    passed = not failed and not no_samples and not any(row.grew for row in rows)
    hole_rows = [row for row in rows if row.level == HOLE]
    other_rows = [row for row in rows if row.level != HOLE]
    title = f"Gate {'passed' if passed else 'not passed'}: {facts['after']} after {facts['before']}"
    notes = [note] if rows else [_NO_SAMPLES] if no_samples else [] if failed else [_NO_FAILURES]
    if failed:
        notes.append(f"{format_count(len(failed), 'frame')} could not be compared, so the gate is not passed.")
    data = {"passed": passed, **facts, "out": str(out), "rows": [row.to_json() for row in rows]}
    return AnalysisReport(
        out=out,
        name="gate",
        heading=title,
        data={**data, "frames_failed": {**failed}},
        csv_tables={"gate": [_csv_row(row) for row in rows]} if rows else {},
        tables=[_build_table(title, [*other_rows, *hole_rows], verb)],
        printed_tables=[_build_table(title, [*other_rows, *hole_rows[:_MAX_PRINTED]], verb)],
        notes=notes,
        failed=failed,
        failure_text="could not be compared",
    )


def format_junit(rows: Sequence[GateRow], failed: Mapping[str, str], verb: str = "lost") -> str:
    """Format rows as JUnit XML, which CI servers show.

    Args:
        rows: A test case each, which fails if the row grew.
        failed: Reasons by frame that could not be compared; a test case with an error each.
        verb: Past participle that names a failure.
    """
    counts = {"tests": len(rows) + len(failed), "failures": sum(r.grew for r in rows), "errors": len(failed)}
    suite = ET.Element("testsuite", {"name": "drivesem gate"} | {name: str(n) for name, n in counts.items()})
    for row in rows:
        case = ET.SubElement(suite, "testcase", classname=f"drivesem.gate.{row.level}", name=row.hole)
        if row.grew:
            row_verb = "phantoms in" if row.level == PHANTOMS else verb
            message = f"{row_verb} {100 * row.before:.1f} % before, {100 * row.after:.1f} % after"
            failure = ET.SubElement(case, "failure", message=message, type="grew")
            failure.text = f"{message}; difference {_format_difference(row)}; p {row.p:.3g}"
    for name, reason in failed.items():
        case = ET.SubElement(suite, "testcase", classname="drivesem.gate.frame", name=name)
        ET.SubElement(case, "error", message=reason, type="failed")
    ET.indent(suite)
    return ET.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def _build_table(title: str, rows: Sequence[GateRow], verb: str) -> ReportTable:
    lines = tuple(
        (
            "all holes" if row.level == ALL else row.hole,
            f"{100 * row.before:.0f}",
            f"{100 * row.after:.0f}",
            _format_difference(row),
            f"{row.p:.3f}",
            str(row.samples),
            "grew" if row.grew else "",
        )
        for row in rows
    )
    columns = ("hole", f"% {verb} before", "% after", "difference, points", "p", "samples", "")
    return ReportTable(title, columns, lines)


def _format_difference(row: GateRow) -> str:
    value = f"{100 * row.difference:+.1f}"
    if row.low is None or row.high is None:
        return value
    return f"{value} [{100 * row.low:+.1f}, {100 * row.high:+.1f}]"


def _csv_row(row: GateRow) -> dict[str, Any]:
    data = row.to_json()
    low, high = data.pop("interval")
    return {**data, "low": low, "high": high}
