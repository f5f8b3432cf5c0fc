"""Counts failures of a run again in a second renderer's images, and reports which survive."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from detectors import boxes
from detectors.types import CLASSES, Detections, Targets
from drivesem.attacks.space import parse_params
from drivesem.attacks.targets import HEADLINE, EvaluatedClasses
from drivesem.config.commands import ConfirmConfig
from drivesem.config.constraints import is_url
from drivesem.config.errors import UsageError
from drivesem.config.options import DEMO
from drivesem.evaluation import coco, failures
from drivesem.evaluation.resampling import wilson
from drivesem.failures.grades import AGREEMENT_RULE, Grade, SecondOpinion
from drivesem.failures.second_renderer.base import SecondRender
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.reporting.drawing import MARGIN_PX, PAPER_COLOUR, TEXT_PX, measure_text, paste, write_text
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_count, format_percent
from drivesem.run.attack import build_grader
from drivesem.run.detection_cache import detect_objects, image_to_tensor
from drivesem.run.driver import FrameAnalyser, ProgressSettings, analyse_frames
from drivesem.run.finished import METRICS, AttackRun, RebuiltFrame, RunFrame, load_runs
from drivesem.run.folder import FRAMES, PRESENTATION, claim_folder, load_run_detector, load_trusted_config
from drivesem.run.frame import (
    detection_records,
    detections_from_records,
    has_grade,
    target_records,
    targets_from_records,
)
from drivesem.run.report.page import format_grade, format_second_opinion, name_failure
from drivesem.run.report.pictures import draw_overlay
from drivesem.run.results import BoxRecord, Failure, FrameResult
from scene_ir import files
from scene_ir.io import load_scene, to_uint8


@dataclass(frozen=True, slots=True)
class RendererFailure:
    """A failure in the second renderer's picture."""

    kind: str
    """"lost" or "phantom"."""
    label: str
    """Class."""
    xyxy: tuple[float, float, float, float]
    """True box of a lost object, detected box of a phantom, px."""
    index: int | None
    """Number of the lost object; None for a phantom."""
    score: float | None
    """Score of a phantom, in [0, 1]."""


@dataclass(frozen=True, slots=True)
class RetestedFailure:
    """A failure of the run, counted again in a second renderer's images."""

    failure: Failure
    """The failure, as the run graded it."""
    opinion: SecondOpinion | None
    """Draws of the second renderer, the same ones as the grade's; None for a failure of no kind."""

    @property
    def survives(self) -> bool:
        """Whether the second renderer agrees, by the rule of the grade *confirmed*."""
        return self.opinion is not None and self.opinion.agrees

    def to_json(self, frame: str) -> dict[str, Any]:
        """Return a JSON object. frame: its frame."""
        failure = self.failure
        return {
            "frame": frame,
            "object": failure.index,
            "kind": failure.error,
            "by_threshold": failure.kind,
            "grade": failure.grade,
            "fidelity": failure.fidelity and failure.fidelity.score,
            "survives": None if self.opinion is None else self.survives,
            "second": None if self.opinion is None else dataclasses.asdict(self.opinion),
            "second_in_run": None if failure.second is None else dataclasses.asdict(failure.second),
        }


@dataclass(frozen=True, slots=True)
class ObjectComparison:
    """One of the scene's objects in both pictures."""

    index: int
    """Number of the object."""
    judged: bool
    """Whether it counts in the second renderer's picture of the change."""
    iou_benign: float | None
    """IoU of its two labels before the change; None if it is not visible."""
    iou: float | None
    """IoU of its two labels after the change; None if it is not visible."""


@dataclass(frozen=True, slots=True)
class ConfirmedFrame:
    """One frame, re-rendered with a second renderer."""

    identifier: str
    """The frame."""
    source: str
    """Digest of the run's result.json."""
    renderer: str
    """Name of the second renderer."""
    failures: tuple[RetestedFailure, ...]
    """The run's failures, in the compositor's picture."""
    second: tuple[RendererFailure, ...]
    """Failures in the second renderer's picture, without nuisances."""
    objects: tuple[ObjectComparison, ...]
    """The scene's objects in both pictures."""
    targets_benign: tuple[BoxRecord, ...]
    """True boxes in the second renderer's picture before the change."""
    targets_changed: tuple[BoxRecord, ...]
    """True boxes in its picture after the change."""
    detections_benign: tuple[BoxRecord, ...]
    """Detections in its picture before the change."""
    detections_changed: tuple[BoxRecord, ...]
    """Detections in its picture after the change."""
    not_carried: tuple[str, ...]
    """Parts of the change that the second renderer cannot render."""
    seconds: float
    """Run time; the only field that may differ between two calls."""


@dataclass(frozen=True, slots=True)
class RendererTargets:
    """A second renderer's labels before and after the change, row by row: objects, then regions of both pictures.
    What is ignored in one picture is ignored in both.
    """

    benign: Targets
    """Before the change."""
    changed: Targets
    """After the change."""


def pair_targets(before: SecondRender, after: SecondRender, count: int) -> RendererTargets:
    """Align the labels of two renders of a scene.

    Args:
        before: Render before the change.
        after: Render after it.
        count: Number of objects.
    """
    first, second = before.targets, after.targets
    ignore = first.ignore[:count] | second.ignore[:count]
    regions = [targets.boxes_xyxy[count:] for targets in (first, second)]
    labels = [targets.labels[count:] for targets in (first, second)]

    def append_regions(own: Targets) -> Targets:
        all_regions = torch.cat(regions)
        return Targets(
            torch.cat([own.boxes_xyxy[:count], all_regions]),
            torch.cat([own.labels[:count], *labels]),
            torch.cat([ignore, torch.ones(len(all_regions), dtype=torch.bool)]),
        )

    return RendererTargets(append_regions(first), append_regions(second))


def find_second_failures(
    targets: RendererTargets, detections: Sequence[Detections], classes: EvaluatedClasses, t_star: float
) -> tuple[RendererFailure, ...]:
    """Find the failures in the second renderer's picture.

    Args:
        targets: Its labels.
        detections: Detections in its pictures, before and after the change.
        classes: The detector's evaluated classes.
        t_star: Score from which a detection counts.
    """
    benign, changed = classes.map_targets(targets.benign), classes.map_targets(targets.changed)
    before, after = detections
    found = failures.find_failures(benign, before, changed, after, t_star)
    lost = [
        RendererFailure("lost", CLASSES[int(targets.changed.labels[i])], _xyxy(changed.boxes_xyxy[i]), i, None)
        for i in found.lost
    ]
    phantoms = [
        RendererFailure(
            "phantom",
            classes.names[int(after.labels[i])],
            _xyxy(after.boxes_xyxy[i]),
            None,
            float(after.scores[i]),
        )
        for i in found.phantoms
    ]
    return (*lost, *phantoms)


def compare_objects(result: FrameResult, targets: RendererTargets, count: int) -> tuple[ObjectComparison, ...]:
    """Compare the objects' boxes in both renderers' pictures.

    Args:
        result: The run's result.
        targets: Labels of the second renderer.
        count: Number of objects.
    """
    benign = {t.index: t.xyxy for t in result.targets_benign if t.index is not None}
    moved = {t.index: t.xyxy for t in result.targets_moved if t.index is not None}

    def label_iou(box: Sequence[float], others: Targets, i: int) -> float | None:
        other = others.boxes_xyxy[i]
        return _iou(box, _xyxy(other)) if float(boxes.area(other[None])) > 0 else None

    return tuple(
        ObjectComparison(
            i,
            not bool(targets.changed.ignore[i]),
            label_iou(benign[i], targets.benign, i),
            label_iou(moved[i], targets.changed, i),
        )
        for i in range(count)
    )


def _iou(one: Sequence[float], two: Sequence[float]) -> float:
    return float(boxes.iou_matrix(torch.tensor([one]), torch.tensor([two]))[0, 0])


def _xyxy(box: Tensor) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = box.tolist()
    return x0, y0, x1, y1


_WRITTEN = ("confirm.json", "confirm.md", "confirm.csv", FRAMES)
_FREE = (*PRESENTATION, "run", "root", "seed")


def run_confirm(config: ConfirmConfig) -> tuple[Confirmation, AnalysisReport]:
    """Re-test a run's frames, or resume, and write the report.

    Raises UsageError or SceneError for bad input, NoSecondRendererError before anything is written.
    """
    (run,) = load_runs([config.run or ""], config.limit)
    out = Path(config.out) if config.out else run.folder / "confirm"
    make_analyser = partial(ConfirmAnalyser, config, run, out)
    analyser = make_analyser()
    claim_folder(out, config, _WRITTEN, _FREE)
    names = [frame.result.identifier for frame in run.frames]
    progress_settings = ProgressSettings("re-rendering frames", keep=False)
    confirmed, failed = analyse_frames(names, analyser, make_analyser, config, progress_settings)
    if not confirmed:
        raise UsageError("--run", "a run with frames that can be used", run.folder)
    results = [frame.result for frame in run.frames if frame.result.identifier not in failed]
    classes = EvaluatedClasses.from_detector(analyser.detector).names
    confirmation = summarise_confirmation(confirmed, results, classes, analyser.t_star)
    facts = {
        "run": str(run.folder),
        "detector": run.detector,
        "params": run.params,
        "t_star": analyser.t_star,
    }
    report = build_confirm_report(out, confirmation, confirmed, facts, failed)
    report.write()
    return confirmation, report


class ConfirmAnalyser(FrameAnalyser[ConfirmedFrame]):
    """Re-renders frames of a run and compares the detector's failures."""

    file, kind, schema = "confirmed.json", ConfirmedFrame, 3

    def __init__(self, config: ConfirmConfig, run: AttackRun, out: Path) -> None:
        super().__init__(run.folder, out)
        attack = load_trusted_config(run.folder, config.trust)
        self.frames = {frame.result.identifier: frame for frame in run.frames}
        if attack.dataset == DEMO and config.root is not None:
            raise UsageError("--root", "none for the embedded scenes", config.root)
        if config.root is None and is_url(attack.root or ""):  # the local copy may be anywhere
            raise UsageError("--root", "the run's data set, as the run read it from a URL", attack.root)
        self.second = SecondRenderers(attack.dataset, config.root or attack.root)
        self.second.check()
        self.detector = load_run_detector(attack, config.device)
        self.device, self.t_star = config.device, float(files.read_json(run.folder / METRICS)["t_star"])
        self.attack, self.params = attack, parse_params(run.params)
        grader = build_grader(dataclasses.replace(attack, confirm=False), self.detector)
        self.grader = dataclasses.replace(grader, make_second_renderer=self.second.renderer_for)

    def analyse(self, name: str, folder: Path) -> ConfirmedFrame:
        """See `FrameAnalyser`. Raises SceneError if no second renderer reproduces the frame's photograph."""
        start = time.perf_counter()
        changed = load_scene(self.run_folder / FRAMES / name / "scene")
        renderer = self.second.renderer_for(name, changed)
        renders = [renderer.render(scene) for scene in (changed.as_photographed(), changed)]
        count = len(changed.objects)
        targets = pair_targets(renders[0], renders[1], count)
        classes = EvaluatedClasses.from_detector(self.detector)
        pictures = [to_uint8(render.image) for render in renders]
        detections = [detect_objects(self.detector, image_to_tensor(p, self.device)) for p in pictures]
        result = self.frames[name].result
        confirmed = ConfirmedFrame(
            identifier=name,
            source=self.source_digest(name),
            renderer=renderer.name,
            failures=self._count_again(name),
            second=find_second_failures(targets, detections, classes, self.t_star),
            objects=compare_objects(result, targets, count),
            targets_benign=target_records(targets.benign, CLASSES, count),
            targets_changed=target_records(targets.changed, CLASSES, count),
            detections_benign=detection_records(detections[0], classes.names),
            detections_changed=detection_records(detections[1], classes.names),
            not_carried=renderer.unsupported_changes(changed),
            seconds=round(time.perf_counter() - start, 3),
        )
        files.write_png(folder / f"{renderer.name}.png", pictures[1])
        sheet = draw_confirm_sheet(self.frames[name], confirmed, pictures[1], self.t_star)
        files.write_png(folder / "sheet.png", sheet)
        return confirmed

    def _count_again(self, name: str) -> tuple[RetestedFailure, ...]:
        """Count the draws of the second renderer in which a frame's failures occur, as its grades do."""
        frame = RebuiltFrame.load(self.run_folder / FRAMES / name, self.attack, self.params, self.detector)
        state = frame.evaluate_state(self.grader, frame.theta)
        faults = {failure: state.find_recorded_fault(failure) for failure in frame.result.failures}
        opinions = self.grader.second_opinions(
            state.case, [fault for fault in faults.values() if fault is not None]
        )
        return tuple(
            RetestedFailure(failure, None if fault is None else opinions[fault])
            for failure, fault in faults.items()
        )


SURVIVE, CERTAIN, LOST, PHANTOMS, NEW = ("frames", "certain", "lost", "phantoms", "frames, second only")
"""Names of the survival rates. Of frames with failures of a kind: those in which one survives; of the failures that are
graded at least certain, of lost vehicles, and of phantoms: those that survive; of frames that do not fail in the
compositor's picture, those that fail in the second renderer's."""

_OVERLAP = ("mean", "least", "boxes")
_MAX_ENLARGED = 3
"""Vehicles that are shown enlarged, lost ones first."""
_CONTEXT = 0.35
"""Context around an enlarged vehicle, as a share of the longer side of its box."""
_LINE_PX = TEXT_PX + 8


@dataclass(frozen=True, slots=True)
class SurvivalRate:
    """Share of failures that survive, with its 95 % Wilson interval."""

    name: str
    """What is counted: SURVIVE, SAME, LOST, PHANTOMS or NEW."""
    failures: int
    """Number of failures."""
    survive: int
    """Number of those that survive."""
    share: float | None
    """`survive` / `failures`; None without a failure."""
    low: float | None
    """Lower end of the interval."""
    high: float | None
    """Upper end."""

    @classmethod
    def from_outcomes(cls, name: str, outcomes: Sequence[bool]) -> SurvivalRate:
        """Count outcomes, one per failure: whether it survives."""
        count, hits = len(outcomes), sum(outcomes)
        low, high = wilson(hits, count) if count else (None, None)
        return cls(name, count, hits, hits / count if count else None, low, high)


@dataclass(frozen=True, slots=True)
class Confirmation:
    """Survival of a run's failures before a second renderer, over the frames that it can render completely."""

    frames: int
    """Number of these frames."""
    not_carried: dict[str, list[str]]
    """Parts of the change that the second renderer lacks, by frame that is left out."""
    shares: tuple[SurvivalRate, ...]
    """Survival rates."""
    scores: dict[str, coco.CocoScores]
    """Scores by picture, each by its own labels."""
    overlap: tuple[float, float, int] | None
    """Mean and least IoU of vehicles' boxes in both pictures, and their number; None without any."""
    failures: tuple[tuple[str, RetestedFailure], ...] = ()
    """Failures that were counted again, each with its frame."""
    not_tested: int = 0
    """Number of failures of no kind, which are not tested."""

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object; rates are fractions."""
        return {
            "frames": self.frames,
            "not_carried": self.not_carried,
            "survive": self.shares[0].share,
            "failures": [one.to_json(frame) for frame, one in self.failures],
            "not_tested": self.not_tested,
            "rows": [
                {name: getattr(share, name) for name in ("name", "failures", "survive", "share", "low", "high")}
                for share in self.shares
            ],
            "scores": {name: scores.to_json() for name, scores in self.scores.items()},
            "box_iou": None if self.overlap is None else dict(zip(_OVERLAP, self.overlap, strict=True)),
        }


def summarise_confirmation(
    confirmed: Sequence[ConfirmedFrame], results: Sequence[FrameResult], classes: tuple[str, ...], t_star: float
) -> Confirmation:
    """Compute survival rates and scores.

    Args:
        confirmed: Re-rendered frames.
        results: The run's results of the same frames.
        classes: Evaluated classes.
        t_star: Score from which a detection counts.
    """
    pairs = [(one, result) for one, result in zip(confirmed, results, strict=True) if not one.not_carried]
    whole = [one for one, _ in pairs]
    every = [(one.identifier, failure) for one in whole for failure in one.failures]
    tested = [(frame, failure) for frame, failure in every if failure.opinion is not None]
    by_frame = {frame: [one for name, one in tested if name == frame] for frame, _ in tested}

    def rate(name: str, chosen: Callable[[Failure], bool]) -> SurvivalRate:
        return SurvivalRate.from_outcomes(name, [one.survives for _, one in tested if chosen(one.failure)])

    shares = (
        SurvivalRate.from_outcomes(SURVIVE, [any(f.survives for f in ones) for ones in by_frame.values()]),
        rate(CERTAIN, has_grade(Grade.CERTAIN)),
        rate(LOST, lambda failure: failure.kind == "lost"),
        rate(PHANTOMS, lambda failure: failure.kind == "phantom"),
        SurvivalRate.from_outcomes(NEW, [bool(one.second) for one in whole if not one.failures]),
    )
    ious = [s.iou for one in whole for s in one.objects if s.judged and s.iou is not None]
    return Confirmation(
        frames=len(whole),
        failures=tuple(tested),
        not_tested=len(every) - len(tested),
        not_carried={one.identifier: list(one.not_carried) for one in confirmed if one.not_carried},
        shares=shares,
        scores=_compute_scores(pairs, classes, t_star),
        overlap=(sum(ious) / len(ious), min(ious), len(ious)) if ious else None,
    )


def _compute_scores(
    pairs: Sequence[tuple[ConfirmedFrame, FrameResult]], names: tuple[str, ...], t_star: float
) -> dict[str, coco.CocoScores]:
    columns = {
        "photograph": [(r.targets_benign, r.detections_benign) for _, r in pairs],
        "second renderer, unchanged": [(c.targets_benign, c.detections_benign) for c, _ in pairs],
        "compositor": [(r.targets_moved, r.detections_attacked) for _, r in pairs],
        "second renderer": [(c.targets_changed, c.detections_changed) for c, _ in pairs],
    }
    if not pairs:
        return {}
    judged = EvaluatedClasses(names, names)
    return {
        name: coco.evaluate(
            [judged.map_targets(targets_from_records(targets, CLASSES)) for targets, _ in column],
            [detections_from_records(detections, names) for _, detections in column],
            names,
            t_star,
            HEADLINE,
        )
        for name, column in columns.items()
    }


def build_confirm_tables(report: Confirmation) -> list[ReportTable]:
    """Build the tables of survival rates, and of precision and recall by picture."""
    by_failure = tuple(
        (
            frame,
            name_failure(one.failure),
            format_grade(one.failure),
            format_second_opinion(one.failure, one.opinion),
            "yes" if one.survives else "no",
        )
        for frame, one in report.failures
    )
    shares = tuple(
        (
            s.name,
            f"{s.survive} of {s.failures}",
            format_percent(s.share),
            f"{format_percent(s.low)} to {format_percent(s.high)}" if s.failures else "-",
        )
        for s in report.shares
    )
    scores = [(name, *map(format_percent, scores.headline.columns)) for name, scores in report.scores.items()]
    return [
        ReportTable("failures", ("frame", "failure", "grade", "second renderer, draws", "survives"), by_failure),
        ReportTable("failures that survive", ("of", "survive", "share, %", "95 %"), shares),
        ReportTable(f"{HEADLINE}, %", ("picture", *coco.SCORE_TITLES), tuple(scores)),
    ]


def build_confirm_notes(report: Confirmation) -> list[str]:
    """Explain the rates, and list what they leave out."""
    needed, of = AGREEMENT_RULE
    notes = [
        f"Survives: the second renderer agrees, by the rule and in the draws of the grade confirmed: right in {needed} "
        f"of {of} draws before the change, wrong in {needed} of {of} after it. A failure that is certain and survives "
        "is confirmed. Frames: those in which a failure survives. Second only: of the frames without a failure, "
        "those that fail in the second renderer's one picture without nuisances. Intervals: Wilson, 95 %.",
    ]
    if report.not_tested:
        count = format_count(report.not_tested, "failure")
        notes.append(f"{count} by threshold, none of a kind: not tested.")
    for frame, one in report.failures:
        earlier = one.failure.second
        if earlier is not None and earlier != one.opinion:
            before = format_second_opinion(one.failure, earlier)
            notes.append(f"Frame {frame}, {name_failure(one.failure)}: the run counted otherwise: {before}.")
    if report.overlap is not None:
        mean, least, count = report.overlap
        notes.append(f"IoU of the boxes of {count} objects in both pictures: mean {mean:.3f}, least {least:.3f}.")
    notes += [f"Frame {name} is not counted: {'; '.join(why)}." for name, why in report.not_carried.items()]
    return notes


def build_confirm_report(
    out: Path,
    report: Confirmation,
    confirmed: Sequence[ConfirmedFrame],
    facts: Mapping[str, Any],
    failed: Mapping[str, str],
) -> AnalysisReport:
    """Build the report.

    Args:
        out: Output folder.
        report: Survival rates and scores.
        confirmed: Re-rendered frames.
        facts: First entries of the JSON.
        failed: Reasons by frame that could not be re-rendered.
    """
    return AnalysisReport(
        out=out,
        name="confirm",
        heading="The second renderer",
        data={**facts, **report.to_json(), "frames_failed": failed},
        csv_tables={"confirm": [_csv_row(frame) for frame in confirmed]},
        tables=build_confirm_tables(report),
        notes=build_confirm_notes(report),
        text_columns=("frame", "failure", "grade", "second renderer, draws", "survives", "of", "picture"),
        failed={f"frame {name}": reason for name, reason in failed.items()},
    )


def _csv_row(one: ConfirmedFrame) -> dict[str, Any]:
    tested = [failure for failure in one.failures if failure.opinion is not None]
    row: dict[str, Any] = {
        "frame": one.identifier,
        "second": one.renderer,
        "failures": len(tested),
        "survive": sum(failure.survives for failure in tested),
        "not_tested": len(one.failures) - len(tested),
        "lost_second": sum(f.kind == "lost" for f in one.second),
        "phantoms_second": sum(f.kind == "phantom" for f in one.second),
    }
    ious = [s.iou for s in one.objects if s.judged and s.iou is not None]
    return row | {
        "vehicles": len(one.objects),
        "judged": len(ious),
        "box_iou": round(sum(ious) / len(ious), 4) if ious else None,
        "box_iou_least": round(min(ious), 4) if ious else None,
        "not_carried": "; ".join(one.not_carried),
    }


def draw_confirm_sheet(frame: RunFrame, confirmed: ConfirmedFrame, image: np.ndarray, t_star: float) -> np.ndarray:
    """Draw both renderers' pictures of a frame on one sheet, with failures enlarged.

    Args:
        frame: The run's frame.
        confirmed: Its failures before both renderers.
        image: The second renderer's picture of the change (H, W, 3) uint8.
        t_star: Score from which a detection counts.

    Returns:
        The sheet (h, w, 3) uint8.
    """
    composed = files.read_image(frame.pictures["attacked"])
    result = frame.result
    composed_overlay = _draw_failures(
        composed, result.targets_moved, result.detections_attacked, [f.failure for f in confirmed.failures], t_star
    )
    second_overlay = _draw_failures(
        image, confirmed.targets_changed, confirmed.detections_changed, confirmed.second, t_star
    )
    survive = sum(failure.survives for failure in confirmed.failures)
    titles = (
        f"{confirmed.identifier}, compositor: {_describe_failures(result.failures)}; {survive} survive in draws",
        f"{confirmed.identifier}, {confirmed.renderer}, without nuisances: {_describe_failures(confirmed.second)}",
    )
    names = ("compositor", confirmed.renderer)
    strip = _draw_enlarged(
        names, (composed, image), _choose_boxes(confirmed, result.targets_moved), composed.shape[1]
    )
    height, width = composed.shape[:2]
    canvas = np.empty(
        (2 * (height + _LINE_PX) + strip.shape[0] + 4 * MARGIN_PX, width + 2 * MARGIN_PX, 3), np.uint8
    )
    canvas[:] = PAPER_COLOUR
    y = MARGIN_PX
    for title, picture in zip(titles, (composed_overlay, second_overlay), strict=True):
        write_text(canvas, (MARGIN_PX, y), title)
        paste(canvas, (MARGIN_PX, y + _LINE_PX), picture)
        y += _LINE_PX + height + MARGIN_PX
    paste(canvas, (MARGIN_PX, y), strip)
    return canvas


def _draw_failures(
    image: np.ndarray,
    targets: Sequence[BoxRecord],
    detections: Sequence[BoxRecord],
    failures: Sequence[RendererFailure | Failure],
    t_star: float,
) -> np.ndarray:
    # ignored regions, which the targets hold once per class, are left out
    objects = tuple(t for t in targets if t.index is not None)
    failed = tuple(Failure(f.kind, f.label, f.xyxy, score=f.score) for f in failures)
    return draw_overlay(image, objects, tuple(detections), failed, t_star)


def _describe_failures(failures: Sequence[RendererFailure | Failure]) -> str:
    if not failures:
        return "no failure"
    lost = sum(f.kind == "lost" for f in failures)
    return f"{lost} lost, {format_count(len(failures) - lost, 'phantom')}"


def _choose_boxes(confirmed: ConfirmedFrame, moved: Sequence[BoxRecord]) -> list[tuple[float, ...]]:
    """Choose the boxes to enlarge: failures, then the largest vehicles that count."""
    boxes: list[tuple[float, ...]] = [f.failure.xyxy for f in confirmed.failures]
    boxes += [f.xyxy for f in confirmed.second]
    cars = sorted((t for t in moved if t.index is not None and not t.ignore), key=lambda t: t.xyxy[1] - t.xyxy[3])
    for box in (t.xyxy for t in cars):
        if all(abs(box[0] - p[0]) + abs(box[1] - p[1]) > 8 for p in boxes):
            boxes.append(box)
    return boxes[:_MAX_ENLARGED]


def _draw_enlarged(
    names: tuple[str, str],
    pictures: tuple[np.ndarray, np.ndarray],
    boxes: Sequence[tuple[float, ...]],
    width: int,
) -> np.ndarray:
    """Draw pairs of enlarged crops side by side in `width` px, the compositor's on the left."""
    cell = (width - (2 * _MAX_ENLARGED - 1) * MARGIN_PX) // (2 * _MAX_ENLARGED)
    strip = np.empty((cell + _LINE_PX if boxes else 0, width, 3), np.uint8)
    strip[:] = PAPER_COLOUR
    for column, box in enumerate(boxes):
        for side, picture in enumerate(pictures):
            x = (2 * column + side) * (cell + MARGIN_PX)
            paste(
                strip,
                (x, _LINE_PX),
                cv2.resize(_crop_square(picture, box), (cell, cell), interpolation=cv2.INTER_CUBIC),
            )
            title = names[side]
            if measure_text(title, TEXT_PX)[0] <= cell:
                write_text(strip, (x, 0), title)
    return strip


def _crop_square(picture: np.ndarray, box: Sequence[float]) -> np.ndarray:
    """Crop a square around a box, shifted into the picture."""
    x0, y0, x1, y1 = box
    side = round(max(x1 - x0, y1 - y0, 16.0) * (1 + 2 * _CONTEXT))
    side = min(side, *picture.shape[:2])
    left = int(np.clip(round((x0 + x1 - side) / 2), 0, picture.shape[1] - side))
    top = int(np.clip(round((y0 + y1 - side) / 2), 0, picture.shape[0] - side))
    return picture[top : top + side, left : left + side]
