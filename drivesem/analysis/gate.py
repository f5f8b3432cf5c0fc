"""Compares two detectors around certain failures of runs: does the new one fail more often?"""

from __future__ import annotations

import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from detectors import boxes
from detectors.base import DetectorError, Predictor, predict
from detectors.registry import load_predictor
from drivesem.attacks.space import parse_params
from drivesem.attacks.targets import EvaluatedClasses, resolve_t_star
from drivesem.config.commands import GateConfig
from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS, LEVEL, PairedDifference, holm, paired_differences, ratio_metric
from drivesem.failures.kinds import BACKGROUND_IOU, MATCH_IOU
from drivesem.failures.neighbourhood import NEAR_REACH, Neighbourhood
from drivesem.reporting.drawing import (
    DETECTED_COLOUR,
    TRUE_COLOUR,
    encode_jpeg_data_url,
    write_picture,
)
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_count
from drivesem.reporting.web import render_page
from drivesem.run.driver import FrameAnalyser, analyse_runs
from drivesem.run.export import PACKAGE, GateSource, open_gate_package, write_lossy_frame
from drivesem.run.finished import AttackRun, RebuiltFrame, load_runs, map_failing_frames, name_frames
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
from scene_ir.io import to_uint8

_WRITTEN = ("gate.json", "gate.md", "gate.csv", "gate.xml", "gate.html", "runs")
_FREE = (*PRESENTATION, "runs", "tolerance", "bootstrap", "allow_empty")
HOLE, CELL, KIND, ALL, PHANTOMS = "hole", "cell", "kind", "all", "phantoms"
_MAX_PRINTED = 12
"""Holes and cells in the table on a terminal; the files have all."""
_NOTE = (
    "Lost: share of samples around a certain failure in which a detector misses the object; both detectors get "
    "the same pictures, and samples in which the object is hidden, too small or faint do not count. Phantoms: share "
    "of these samples with a detection on nothing, anywhere in the picture. In brackets: 95 % paired bootstrap "
    "interval, over samples for a hole, and over holes for cells, kinds, all, and phantoms. A cell has the samples "
    "around the failures that lie in it on the run's map. p: exact sign test of the "
    "samples in which only one detector fails, with Holm's correction over all rows. A row grew if the difference "
    "exceeds the tolerance, its interval lies above 0, and p is below 0.05; it fell if the same holds the other way, "
    "and is the same if its interval is within the tolerance."
)
_NO_SAMPLES = "no sample counts around any certain failure"
_SIDES = ("unchanged", "changed")
"""Pictures of a certain failure."""
_NEW_COLOUR = (86, 180, 233)
_PICTURE_PX = 480
"""Width of such a picture."""
_MAX_PICTURED = 100
"""Failures with pictures on the page: each has two of some 30 KB."""


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
    scores: tuple[tuple[float | None, ...], ...] = ()
    """Best score on the object before and after the change, without nuisances, by the old and by the new detector;
    None if it is missed."""


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
    """HOLE, CELL, KIND, ALL or PHANTOMS."""
    hole: str
    """Name of the hole, of the cell, or of the kind."""
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
    change: Literal["grew", "fell", "same", "unclear"]
    """grew, fell: the rate changed by more than the tolerance and more than chance explains; same: the interval of
    the difference is within the tolerance; unclear: none of these.
    """

    @property
    def grew(self) -> bool:
        """Whether the rate grew, which fails the gate."""
        return self.change == "grew"

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object."""
        data = asdict(self)
        data["interval"] = [data.pop("low"), data.pop("high")]
        return {**data, "grew": self.grew}


def run_gate(config: GateConfig) -> AnalysisReport:
    """Compare two detectors, write the report, and return it; `data["passed"]` is the verdict.

    Raises UsageError or SceneError for bad input.
    """
    with ExitStack() as stack:
        return _run_gate(config, _open_sources(config, stack))


def _run_gate(config: GateConfig, sources: Sequence[GateSource]) -> AnalysisReport:
    runs = [source.run for source in sources]
    if config.before is None:
        config = replace(config, before=_attacked_detector(runs, config.trust))
    load_detector_pair(config)
    out = resolve_output_folder(config.out, Path(config.runs[0]) / "gate")
    claim_folder(out, config, _WRITTEN, _FREE, renews=True)
    frames = [(run, [f.result.identifier for f in run.frames if certain_losses(f.result)]) for run in runs]
    results, failed = analyse_runs(
        frames, partial(GateAnalyser, config), out / "runs", config, "comparing detectors in"
    )
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    pairs = {name: result.pairs for name, result in results.items()}
    failing = map_failing_frames(name_frames(runs))
    counts = {
        "frames": sum(source.frames for source in sources),
        "frames_attacked": sum(source.frames_attacked for source in sources),
        "frames_ungraded": sum(not frame.result.graded for run in runs for frame in run.frames),
        "frames_compared": len(pairs),
        "failures": sum(map(len, pairs.values())),
        "frames_without_record": failing.frames_without_record,
    }
    report = build_gate_report(
        out,
        compute_gate_rows(pairs, config.tolerance, draws, config.seed, failing.cells_by_failure()),
        GateFacts(
            about={
                "runs": list(config.runs),
                "before": config.before,
                "after": config.after,
                "tolerance": config.tolerance,
                **counts,
            },
            scope=_describe_scope(counts),
            failures=counts["failures"],
            failed=failed,
            allow_empty=config.allow_empty,
            close_ups=_find_close_ups(out, runs, pairs),
        ),
    )
    report.write()
    return report


def _open_sources(config: GateConfig, stack: ExitStack) -> list[GateSource]:
    """Load runs and unpack packages. Raises UsageError or FormatError if one cannot be used."""
    packages = [folder for folder in config.runs if (Path(folder) / PACKAGE).is_file()]
    folders = [folder for folder in config.runs if folder not in packages]
    if len({Path(folder).resolve() for folder in packages}) < len(packages):
        raise UsageError("RUN", "each package once", packages[0])
    sources = [GateSource.from_run(run) for run in load_runs(folders, config.limit, "RUN")]
    sources += [stack.enter_context(open_gate_package(Path(folder), config.limit)) for folder in packages]
    names = [source.run.name for source in sources]
    given = [*folders, *packages]
    return [
        source if names.count(name) == 1 else replace(source, run=replace(source.run, name=folder))
        for source, name, folder in zip(sources, names, given, strict=True)
    ]


def _describe_scope(counts: Mapping[str, int]) -> str:
    frames, attacked, ungraded = counts["frames"], counts["frames_attacked"], counts["frames_ungraded"]
    failures = format_count(counts["failures"], "certain failure") + " of objects" if counts["failures"] else ""
    text = f"{failures or 'no certain failure of an object'} in {format_count(attacked, 'attacked frame')}"
    text += f" ({frames - attacked} of {frames} had nothing to attack)" if attacked < frames else ""
    if ungraded:
        text += f"; the failures of {format_count(ungraded, 'frame')} have no grade: attack without --no-grade"
    if counts["frames_without_record"]:
        text += f"; {format_count(counts['frames_without_record'], 'frame')} without a record of the search: in no cell"
    return text


def _find_close_ups(
    out: Path, runs: Sequence[AttackRun], pairs: Mapping[str, Sequence[PairedSamples]]
) -> dict[str, HolePictures]:
    """Return the close-ups by hole of the analysed frames."""
    close_ups = {}
    for number, run in enumerate(runs):
        prefix = f"{run.name}/" if len(runs) > 1 else ""
        for frame in run.frames:
            name = frame.result.identifier
            folder = out / "runs" / str(number) / FRAMES / name
            for pair in pairs.get(prefix + name, ()):
                paths = tuple(folder / f"{pair.index}-{side}.jpg" for side in _SIDES)
                close_ups[_hole_name(prefix + name, pair)] = HolePictures(pair, paths)
    return close_ups


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

    file, kind, schema = "gate.json", FrameGateResult, 3

    def __init__(self, config: GateConfig, run: AttackRun, out: Path) -> None:
        super().__init__(run.folder, out)
        self.config = config
        self.attack, self.params = load_attack_config(run.folder, "RUN"), parse_params(run.params)
        self.detectors = load_detector_pair(config)

    def analyse(self, name: str, folder: Path) -> FrameGateResult:
        """See `FrameAnalyser`."""
        start = time.perf_counter()
        before, after = self.detectors
        with tempfile.TemporaryDirectory(prefix="drivesem-gate-") as temporary:
            # what a package holds, so that a run and its package give the same numbers
            packed = write_lossy_frame(self.run_folder / FRAMES / name, Path(temporary))
            frame = RebuiltFrame.load(packed, self.attack, self.params, before)
        pairs = []
        for failure, neighbourhood in frame.neighbourhoods(str(self.config.seed)):
            pair = _draw_paired_samples(failure, neighbourhood, after, self.config.samples)
            pairs.append(replace(pair, scores=_write_close_ups(folder, frame, neighbourhood.index, after)))
        return FrameGateResult(name, self.source_digest(name), tuple(pairs), round(time.perf_counter() - start, 3))


def _write_close_ups(
    folder: Path, frame: RebuiltFrame, index: int, after: Predictor
) -> tuple[tuple[float | None, ...], ...]:
    """Write the object before and after the change, with the detections of both detectors on it. Returns
    `PairedSamples.scores`.
    """
    objective, scores = frame.objective, []
    classes, changed = EvaluatedClasses.from_detector(after), objective.evaluate(frame.theta)
    states = ((objective.benign, objective.benign.paper), (changed, changed.moved))
    places = [labels.targets.boxes_xyxy[index] for _, labels in states]
    for side, (state, labels), place in zip(_SIDES, states, places, strict=True):
        new = classes.map_detections(predict(after, state.render.image[None])[0])
        label = objective.classes.map_targets(labels.targets).labels[index]
        found = []
        for detections, t_star in ((state.detections, objective.t_star), (new, resolve_t_star(after))):
            ious = boxes.iou_matrix(detections.boxes_xyxy, place[None].to(detections.boxes_xyxy))[:, 0]
            hits = (detections.scores >= t_star) & (detections.labels == label) & (ious >= MATCH_IOU)
            near = (detections.scores >= t_star) & (ious >= BACKGROUND_IOU)
            found.append(
                (float(detections.scores[hits].max()) if hits.any() else None, detections.boxes_xyxy[near])
            )
        scores.append([score for score, _ in found])
        coloured = [(place[None], TRUE_COLOUR), (found[0][1], DETECTED_COLOUR), (found[1][1], _NEW_COLOUR)]
        picture = _draw_close_up(to_uint8(state.render.image), torch.stack(places), coloured)
        write_picture(folder / f"{index}-{side}.jpg", picture)
    return tuple(zip(*scores, strict=True))


def _draw_close_up(
    image: np.ndarray, places_xyxy: Tensor, coloured: Sequence[tuple[Tensor, tuple[int, int, int]]]
) -> np.ndarray:
    """Draw a part of a picture, enlarged, with boxes.

    Args:
        image: (H, W, 3) uint8.
        places_xyxy: (P, 4) px, boxes that the part surrounds.
        coloured: Boxes (B, 4) px, with a colour; each colour a little farther out.

    Returns:
        (h, `_PICTURE_PX`, 3) uint8.
    """
    height, width = image.shape[:2]
    (x0, y0), (x1, y1) = places_xyxy[:, :2].amin(0).tolist(), places_xyxy[:, 2:].amax(0).tolist()
    half = min(max(0.9 * (x1 - x0), 1.2 * (y1 - y0), 40.0), width / 2, 2 * height / 3)
    x, y = np.clip((x0 + x1) / 2, half, width - half), np.clip((y0 + y1) / 2, 0.75 * half, height - 0.75 * half)
    left, top, right, bottom = (round(float(v)) for v in (x - half, y - 0.75 * half, x + half, y + 0.75 * half))
    zoom = _PICTURE_PX / (right - left)
    size = (_PICTURE_PX, round((bottom - top) * zoom))
    canvas = cv2.resize(image[top:bottom, left:right], size, interpolation=cv2.INTER_CUBIC)
    for outset, (rows, colour) in enumerate(coloured):
        for box in rows.tolist():
            a, b, c, d = (round(zoom * (v - start)) for v, start in zip(box, (left, top, left, top), strict=True))
            margin = 3 * outset
            corners = (a - margin, b - margin), (c + margin, d + margin)
            cv2.rectangle(canvas, *corners, (0, 0, 0), 5, cv2.LINE_AA)
            cv2.rectangle(canvas, *corners, colour, 3, cv2.LINE_AA)
    return canvas


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
    pairs_by_frame: Mapping[str, Sequence[PairedSamples]],
    tolerance: float,
    draws: int,
    seed: int,
    cells: Mapping[tuple[str, int], str] = MappingProxyType({}),
) -> list[GateRow]:
    """Compare failure rates by hole, by cell of the map, by kind of failure, in total, and of phantoms.

    Args:
        pairs_by_frame: Samples per failure, by frame; those without samples get no row.
        tolerance: Largest acceptable growth of a rate.
        draws: Bootstrap draws.
        seed: Seed of the bootstrap.
        cells: Cell of the map by frame and object; failures that lack one are in no row of a cell.

    Returns:
        Rows of holes, those that grew most first; of cells, in the same order; then of kinds, of all holes, and of
        phantoms.
    """
    named: _Group = []
    by_cell: dict[str, _Group] = {}
    by_kind: dict[str, _Group] = {}
    for frame, pairs in pairs_by_frame.items():
        for pair in pairs:
            if pair.before:
                named.append((_hole_name(frame, pair), pair))
                by_kind.setdefault(pair.error, []).append(named[-1])
                if pair.index is not None and (frame, pair.index) in cells:
                    by_cell.setdefault(cells[frame, pair.index], []).append(named[-1])
    groups = {(HOLE, name): [(name, pair)] for name, pair in named}
    groups |= {(CELL, cell): group for cell, group in by_cell.items()}
    groups |= {(KIND, kind): by_kind[kind] for kind in sorted(by_kind)}
    groups |= {(ALL, ALL): named} if named else {}
    phantoms = [
        (name, replace(pair, before=pair.phantoms_before, after=pair.phantoms_after))
        for name, pair in named
        if pair.phantoms_before
    ]
    groups |= {(PHANTOMS, PHANTOMS): phantoms} if phantoms else {}
    worse, better = (_correct_p_values(groups, alternative) for alternative in ("greater", "less"))
    rows = [
        _compute_row(key, [pair for _, pair in group], (worse[key], better[key]), tolerance, draws, seed)
        for key, group in groups.items()
    ]
    order = (HOLE, CELL)
    ranked = sorted(
        (r for r in rows if r.level in order), key=lambda r: (order.index(r.level), -r.difference, r.hole)
    )
    return ranked + [row for row in rows if row.level not in order]


_Group = list[tuple[str, PairedSamples]]
"""Samples by name of the hole."""


def _correct_p_values(
    groups: Mapping[tuple[str, str], _Group], alternative: Literal["greater", "less"]
) -> dict[tuple[str, str], float]:
    """Return the p-value of each row, with Holm's correction over all rows. Rows of the same holes, such as those of
    a cell with a single one, are one test.
    """
    tests = {key: (key[0] == PHANTOMS, frozenset(name for name, _ in group)) for key, group in groups.items()}
    pairs = {tests[key]: [pair for _, pair in group] for key, group in groups.items()}
    corrected = holm([_sign_test(group, alternative) for group in pairs.values()])
    by_test = {test: p for test, p in zip(pairs, corrected, strict=True) if p is not None}
    return {key: by_test[test] for key, test in tests.items()}


def _hole_name(frame: str, pair: PairedSamples) -> str:
    return frame if pair.index is None else f"{frame}: objects[{pair.index}]"


def _compute_row(
    key: tuple[str, str],
    pairs: Sequence[PairedSamples],
    p_values: tuple[float, float],
    tolerance: float,
    draws: int,
    seed: int,
) -> GateRow:
    """Compute the row of a level and name. p_values: corrected, that the new detector is worse, and better."""
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
    worse, better = (p < 1 - LEVEL for p in p_values)
    low, high = (-1.0, 1.0) if rates.low is None or rates.high is None else (rates.low, rates.high)
    change: Literal["grew", "fell", "same", "unclear"] = "unclear"
    if worse and rates.difference > tolerance and low > 0:
        change = "grew"
    elif better and -rates.difference > tolerance and high < 0:
        change = "fell"
    elif -tolerance <= low and high <= tolerance:
        change = "same"
    return GateRow(
        level=key[0],
        hole=key[1],
        before=rates.first,
        after=rates.second,
        difference=rates.difference,
        low=rates.low,
        high=rates.high,
        p=p_values[0],
        samples=sum(len(pair.before) for pair in pairs),
        holes=len(pairs),
        change=change,
    )


def _compare_rates(
    before: np.ndarray, after: np.ndarray, count: np.ndarray, draws: int, seed: int
) -> PairedDifference:
    first, second = ratio_metric("lost", before, count), ratio_metric("lost", after, count)
    rng = np.random.default_rng(seed)
    (difference,) = paired_differences([first], [second], len(count), draws, rng, test=False)
    return difference


def _sign_test(pairs: Sequence[PairedSamples], alternative: Literal["greater", "less"]) -> float:
    """Return the exact one-sided p-value over the samples in which only one detector fails (McNemar 1947): if both
    were equally good, either would fail with even odds. alternative: the new one fails more often, or less.
    """
    from scipy.stats import binomtest  # on use: it takes a third of a second to load

    discordant = [after for p in pairs for before, after in zip(p.before, p.after, strict=True) if before != after]
    if not discordant:
        return 1.0
    return float(binomtest(sum(discordant), len(discordant), alternative=alternative).pvalue)


@dataclass(frozen=True, slots=True)
class HolePictures:
    """Pictures of one certain failure."""

    pair: PairedSamples
    """Its samples."""
    paths: tuple[Path, ...]
    """JPEG files: before the change, and after it."""


@dataclass(frozen=True, slots=True)
class GateFacts:
    """What a gate's report states besides its rows."""

    about: Mapping[str, Any]
    """First entries of the JSON; has before and after."""
    scope: str
    """Number of certain failures, and of frames, in words."""
    failures: int
    """Number of certain failures, with samples or not."""
    failed: Mapping[str, str]
    """Reasons by frame that could not be compared; if there are any, the gate is not passed."""
    allow_empty: bool = False
    """Whether a gate without certain failures is passed."""
    close_ups: Mapping[str, HolePictures] = field(default_factory=dict)
    """Pictures by hole."""
    verb: str = "lost"
    """Past participle that names a failure."""
    note: str = _NOTE
    """Explanation of the columns."""

    def why_empty(self, rows: Sequence[GateRow]) -> str:
        """Why nothing was compared; empty if something was, or if all frames failed."""
        if rows or (self.failed and not self.failures):
            return ""
        return f"nothing was compared: {_NO_SAMPLES if self.failures else self.scope}"


def build_gate_report(out: Path, rows: Sequence[GateRow], facts: GateFacts) -> AnalysisReport:
    """Decide whether the gate is passed, and write gate.xml and gate.html.

    Args:
        out: Output folder.
        rows: The comparison.
        facts: The rest.
    """
    why_empty, failed, verb = facts.why_empty(rows), facts.failed, facts.verb
    allowed = bool(why_empty) and facts.allow_empty and not facts.failures
    passed = not failed and (allowed or not why_empty) and not any(row.grew for row in rows)
    verdict = "passed" if passed else "not passed"
    title = f"Gate {verdict}: {facts.about['after']} after {facts.about['before']}"
    notes = [f"Compared: {facts.scope}.", facts.note] if rows else []
    if why_empty:
        option = "" if facts.failures else " (--allow-empty)" if allowed else "; --allow-empty passes such a gate"
        notes.append(f"Gate {verdict}: {why_empty}{option}.")
    if failed:
        notes.append(f"{format_count(len(failed), 'frame')} could not be compared, so the gate is not passed.")
    hole_rows = [row for row in rows if row.level == HOLE]
    cell_rows = [row for row in rows if row.level == CELL]
    other_rows = [row for row in rows if row.level not in (HOLE, CELL)]
    ordered = [*other_rows, *cell_rows, *hole_rows]
    printed = [*other_rows, *cell_rows[:_MAX_PRINTED], *hole_rows[:_MAX_PRINTED]]
    files.write_text(out / "gate.xml", format_junit(rows, failed, verb, "" if allowed else why_empty, why_empty))
    kinds = sum(row.level == KIND for row in rows)
    distinct = [
        r for r in ordered if not (r.level == KIND and kinds == 1) and not (r.level == ALL and r.holes == 1)
    ]
    cases = [_describe_case(row, verb, facts.close_ups.get(row.hole)) for row in distinct[:_MAX_PICTURED]]
    page = render_page(
        "drivesem.analysis:gate.html",
        title=title,
        passed=passed,
        facts=facts,
        cases=cases,
        notes=notes,
        left_out=len(distinct) - len(cases),
    )
    files.write_text(out / "gate.html", page)
    data = {"passed": passed, **facts.about, "out": str(out), "rows": [row.to_json() for row in rows]}
    return AnalysisReport(
        out=out,
        name="gate",
        heading=title,
        data={**data, "frames_failed": {**failed}},
        csv_tables={"gate": [_csv_row(row) for row in rows]} if rows else {},
        tables=[_build_table(title, ordered, verb)],
        printed_tables=[_build_table(title, printed, verb)] if rows else [],
        notes=notes,
        failed=failed,
        failure_text="could not be compared",
    )


def _describe_case(row: GateRow, verb: str, close_up: HolePictures | None) -> dict[str, Any]:
    """Values of a case on the page."""
    case = {"row": row, "name": _row_name(row), "text": _describe_row(row, verb), "images": []}
    if close_up is None or not all(path.is_file() for path in close_up.paths):
        return case
    urls = [encode_jpeg_data_url(files.read_image(path)) for path in close_up.paths]
    scores = [
        ["missed" if score is None else f"{score:.2f}" for score in by_detector]
        for by_detector in zip(*close_up.pair.scores, strict=True)
    ]
    name = f"{case['name']} ({close_up.pair.label}, {close_up.pair.error})"
    return {**case, "name": name, "images": list(zip(("before", "after"), urls, scores, strict=True))}


def _row_name(row: GateRow) -> str:
    names = {ALL: "all failures", PHANTOMS: "phantoms", KIND: f"all {row.hole}", CELL: f"cell {row.hole}"}
    return names.get(row.level, row.hole)


def _describe_row(row: GateRow, verb: str) -> str:
    """The result of a row in one line: counts of samples, difference with its interval, p."""
    verb = "phantoms" if row.level == PHANTOMS else verb
    before, after = round(row.before * row.samples), round(row.after * row.samples)
    text = f"{verb} in {before} of {row.samples} samples by the current detector, in {after} by the new one"
    text += f"; difference {_format_difference(row)} points; p {row.p:.2g}"
    return text if row.holes == 1 else f"{text}; {row.holes} holes"


def format_junit(
    rows: Sequence[GateRow],
    failed: Mapping[str, str],
    verb: str = "lost",
    empty: str = "",
    skipped: str = "",
) -> str:
    """Format rows as JUnit XML, which CI servers show. Each case has its numbers, passed or not.

    Args:
        rows: A test case each, which fails if the row grew.
        failed: Reasons by frame that could not be compared; a test case with an error each.
        verb: Past participle that names a failure.
        empty: Why nothing was compared; a test case that fails.
        skipped: Why nothing was compared; without `empty`, a test case that is skipped.
    """
    suite = ET.Element("testsuite", {"name": "drivesem gate"})
    for row in rows:
        case = ET.SubElement(suite, "testcase", classname=f"drivesem.gate.{row.level}", name=row.hole)
        if row.grew:
            row_verb = "phantoms in" if row.level == PHANTOMS else verb
            message = f"{row_verb} {100 * row.before:.1f} % before, {100 * row.after:.1f} % after"
            ET.SubElement(case, "failure", message=message, type="grew").text = _describe_row(row, verb)
        ET.SubElement(case, "system-out").text = _describe_row(row, verb)
    for name, reason in failed.items():
        case = ET.SubElement(suite, "testcase", classname="drivesem.gate.frame", name=name)
        ET.SubElement(case, "error", message=reason, type="failed")
    if empty or skipped:
        case = ET.SubElement(suite, "testcase", classname="drivesem.gate", name="certain failures")
        if empty:
            ET.SubElement(case, "failure", message=empty, type="empty")
        else:
            ET.SubElement(case, "skipped", message=skipped)
    counts = {"tests": len(suite)}
    counts |= {f"{tag}s": len(suite.findall(f"testcase/{tag}")) for tag in ("failure", "error")}
    counts["skipped"] = len(suite.findall("testcase/skipped"))
    suite.attrib |= {name: str(number) for name, number in counts.items()}
    ET.indent(suite)
    return ET.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def _build_table(title: str, rows: Sequence[GateRow], verb: str) -> ReportTable:
    lines = tuple(
        (
            _row_name(row),
            f"{100 * row.before:.0f}",
            f"{100 * row.after:.0f}",
            _format_difference(row),
            "<0.001" if row.p < 0.0005 else f"{row.p:.3f}",
            str(row.samples),
            row.change,
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
