"""The outcome of an attack on a scene, the frame's folder on disk, and the summary of all frames."""

from __future__ import annotations

import itertools
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from detectors.types import CLASSES, Detections, Targets
from drivesem.attacks.budgets import change_limits
from drivesem.attacks.feasibility_check import available_check_method, check_scene
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.labels import SceneLabels, to_kitti_labels, visible_boxes
from drivesem.attacks.methods.base import AttackResult
from drivesem.attacks.methods.gradient_free import Placebo
from drivesem.attacks.objective import Objective, RenderEvaluation
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.data import kitti
from drivesem.evaluation import coco
from drivesem.evaluation.failures import FrameFailures
from drivesem.evaluation.resampling import ClusteredShare, Proportion, clustered_interval
from drivesem.failures.certificate import CompositorRenderer, pad_visible_boxes
from drivesem.failures.feature_cells import CellVisit
from drivesem.failures.grades import Grade, Kind
from drivesem.failures.grading import FrameGrades, GradedFault, Grader, GradingInput
from drivesem.failures.kinds import OBJECT_KINDS, LabelledDetections
from drivesem.run.feature_map import FailureMap
from drivesem.run.labels import RESULT
from drivesem.run.report import pictures
from drivesem.run.results import (
    BoxRecord,
    ClassSummary,
    Coordinate,
    Failure,
    FrameResult,
    PhotographedRate,
    VehicleCounts,
    dump_frame,
)
from drivesem.run.search_memory import MARGINS, Experience
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_scene, save_scene, to_uint8
from scene_ir.types import Render, SceneIR


@dataclass(frozen=True, slots=True)
class AttackedScene:
    """The outcome of an attack on one scene, in memory."""

    identifier: str
    """Name of the frame."""
    objective: Objective
    """The objective of the scene."""
    search: AttackResult
    """The attack's result."""
    rendered: RenderEvaluation
    """The scene at its theta, evaluated."""
    benign: Detections
    """Detections on the photograph."""
    violated_at_start: tuple[str, ...]
    """Constraints that the photographed scene violates."""
    failures: tuple[Failure, ...]
    """Graded failures of `rendered`."""
    grade_notes: tuple[str, ...]
    """Why a grade could not be reached."""
    passes: int
    """Detector passes, a gradient counted as 3."""
    visits: tuple[CellVisit, ...]
    """Where in feature space the objects were evaluated."""
    learns: bool
    """Whether searches of other frames read `experience`."""
    seconds: float
    """Total time."""
    grading_seconds: float
    """Time after the search."""

    @property
    def experience(self) -> Experience:
        """What other frames learn from the search."""
        certain = [failure.index for failure in certain_losses(self)]
        return Experience.from_search(self.objective, self.search.theta, self.visits, certain)


def write_frame(attacked: AttackedScene, folder: Path) -> FrameResult:
    """Write a frame's folder, completely or not at all. Returns the content of `folder / RESULT`; the independent
    feasibility check reads the scene back from disk.
    """
    start = time.perf_counter()
    with files.atomic_folder(folder) as part:
        save_scene(attacked.rendered.scene, part / "scene")
        result = frame_result(attacked, load_scene(part / "scene"))
        result = replace(result, seconds=round(attacked.seconds + time.perf_counter() - start, 3))
        _write(part, attacked, result)
    return result


def frame_result(attacked: AttackedScene, perturbed: SceneIR) -> FrameResult:
    """The record of an attacked scene; `perturbed`: the scene that the independent feasibility check tests."""
    objective, search, rendered = attacked.objective, attacked.search, attacked.rendered
    names = objective.classes.names
    scene = objective.space.scene
    moved = rendered.moved.targets
    change = ""
    if scene.before is not None:
        from scene_ir.exchange import CHANGE_KEY

        change = scene.provenance.get(CHANGE_KEY, "")
    return FrameResult(
        identifier=attacked.identifier,
        objects=len(scene.objects),
        queries=search.queries,
        loss_trace=search.loss_trace,
        theta=tuple(
            Coordinate(name=name, **facts)  # pyright: ignore[reportArgumentType]
            for name, facts in objective.space.theta_by_name(search.theta).items()
        ),
        active_constraints=search.active_constraints,
        violations=tuple(
            check_scene(
                perturbed.unperturbed(),
                perturbed,
                limits=change_limits(objective.space.budget, objective.space.parametrisation),
            )
        ),
        targets_benign=target_records(objective.benign.paper.targets, CLASSES, len(scene.objects)),
        targets_moved=target_records(moved, CLASSES, len(scene.objects)),
        detections_benign=detection_records(attacked.benign, names),
        detections_rerendered=detection_records(objective.benign.detections, names),
        detections_attacked=detection_records(rendered.detections, names),
        failures=attacked.failures,
        became_ignored=tuple(rendered.moved.became_ignored.nonzero()[:, 0].tolist()),
        judged=objective.judged,
        found_before=objective.found_before,
        success_paper=search.success_paper,
        success_moved=search.success_moved,
        identity_psnr_db=psnr_in_boxes(objective.benign.scene, objective.benign.render.image),
        seconds=round(attacked.seconds, 3),
        violated_at_start=attacked.violated_at_start,
        checked_by=available_check_method(),
        passes=attacked.passes,
        grade_notes=attacked.grade_notes,
        min_contrast=objective.difficulty.min_contrast,
        joint_weather=True,
        change=change,
        visits=attacked.visits,
    )


def _write(part: Path, attacked: AttackedScene, result: FrameResult) -> None:
    objective, rendered = attacked.objective, attacked.rendered
    scene = objective.space.scene
    before, after = to_uint8(scene.photograph), to_uint8(rendered.render.image)
    files.write_png(part / "benign.png", before)
    files.write_png(part / "rerender.png", to_uint8(objective.benign.render.image))
    files.write_png(part / "counterexample.png", after)
    marked = pictures.draw_overlay(
        after, result.targets_moved, result.detections_attacked, result.failures, objective.t_star
    )
    files.write_png(part / "overlay.png", marked)
    files.write_png(part / "difference.png", pictures.draw_difference(before, after))
    for labels in (rendered.paper, rendered.moved):
        as_kitti = to_kitti_labels(labels, objective.benign.scene, rendered.scene)
        kitti.write_labels(part / f"labels_{labels.mode}.txt", as_kitti)
    files.write_json(
        part / "theta.json",
        {
            c.name: {"value": c.value, "unit": c.unit, "bounds": [c.lower, c.upper], "display": c.display}
            for c in result.theta
        },
    )
    if attacked.learns:
        attacked.experience.write(part / MARGINS)
    files.write_text(part / RESULT, dump_frame(result))


def grade_failures(
    identifier: str,
    objective: Objective,
    feasible: FeasibleSet,
    search: AttackResult,
    grader: Grader | None,
    seed: int,
) -> tuple[tuple[Failure, ...], tuple[str, ...]]:
    """Failures at the theta that an attack found, as graded records.

    Args:
        identifier: name of the frame.
        objective: the objective of the scene.
        feasible: its feasible set, for the placebo.
        search: the attack's result.
        grader: grades the failures; None leaves them ungraded.
        seed: seed of the placebo.

    Returns:
        The records, and the reasons why a grade could not be reached.
    """
    evaluation = objective.evaluate(search.theta)
    failures, moved = objective.failures(evaluation, "moved"), evaluation.moved.targets
    if grader is None or not failures.success:
        return build_failure_records(objective.classes, moved, evaluation.detections, failures), ()

    def placebo() -> SceneIR:
        edit = Placebo(tuple(search.theta.tolist()))(objective.problem(feasible), objective.space.theta0, seed)
        return objective.space.apply(objective.space.scene, edit.theta)

    grades = grader.grade(objective_grading_input(identifier, objective, evaluation, placebo), failures)
    records = build_failure_records(objective.classes, moved, evaluation.detections, failures, grades)
    return records, grades.notes


@dataclass(frozen=True, slots=True)
class EvaluatedScene:
    """A state of a scene, rendered, labelled and detected."""

    scene: SceneIR
    """The scene."""
    render: Render
    """Its render."""
    labels: SceneLabels
    """Its labels."""
    detections: Detections
    """Detections; labels are indices into the evaluated classes."""


def build_grading_input(
    identifier: str,
    renderer: CompositorRenderer,
    classes: EvaluatedClasses,
    benign: EvaluatedScene,
    attacked: EvaluatedScene,
    placebo: Callable[[], SceneIR] | None = None,
) -> GradingInput:
    """The input of a grader.

    Args:
        identifier: name of the frame.
        renderer: renders states of the scene.
        classes: the evaluated classes.
        benign: the scene before the change.
        attacked: the scene after the change.
        placebo: makes a random change of the same size; see `GradingInput`.
    """

    def label_detections(state: EvaluatedScene) -> LabelledDetections:
        targets = classes.map_targets(state.labels.targets)
        boxes = pad_visible_boxes(visible_boxes(state.render), targets)
        return LabelledDetections(targets, boxes, state.detections)

    before, after = label_detections(benign), label_detections(attacked)
    return GradingInput(
        identifier, benign.scene, attacked.scene, renderer, before, after, renderer.compositor, placebo
    )


def objective_grading_input(
    identifier: str,
    objective: Objective,
    evaluation: RenderEvaluation,
    placebo: Callable[[], SceneIR] | None = None,
) -> GradingInput:
    """The input of a grader for a state of an objective's scene.

    Args:
        identifier: name of the frame.
        objective: the objective of the scene.
        evaluation: the state after the change.
        placebo: makes a random change of the same size; see `GradingInput`.
    """
    benign = objective.benign
    return build_grading_input(
        identifier,
        CompositorRenderer(objective.compositor, objective.labeller),
        objective.classes,
        EvaluatedScene(benign.scene, benign.render, benign.paper, benign.detections),
        EvaluatedScene(evaluation.scene, evaluation.render, evaluation.moved, evaluation.detections),
        placebo,
    )


def build_failure_records(
    classes: EvaluatedClasses,
    moved: Targets,
    detections: Detections,
    failures: FrameFailures,
    grades: FrameGrades | None = None,
) -> tuple[Failure, ...]:
    """Failures as records: lost objects, then phantoms.

    Args:
        classes: the evaluated classes, which the detections' labels index.
        moved: targets with labels among CLASSES.
        detections: detections after the change.
        failures: the failures.
        grades: of these failures; None leaves them ungraded.
    """
    lost = [
        Failure(
            "lost",
            CLASSES[int(moved.labels[i])],
            _xyxy(moved.boxes_xyxy[i]),
            index=i,
            **_grade_fields(grades, "lost", i),
        )
        for i in failures.lost
    ]
    phantoms = [
        Failure(
            "phantom",
            classes.names[int(detections.labels[i])],
            _xyxy(detections.boxes_xyxy[i]),
            score=float(detections.scores[i]),
            **_grade_fields(grades, "phantoms", i),
        )
        for i in failures.phantoms
    ]
    return (*lost, *phantoms)


def _grade_fields(grades: FrameGrades | None, which: Literal["lost", "phantoms"], index: int) -> dict[str, Any]:
    """The fields of a failure's record that hold its kind and grade."""
    if grades is None:
        return {}
    graded: GradedFault | None = getattr(grades, which).get(index)
    if graded is None:
        return {"grade": str(Grade.THRESHOLD)}
    fields: dict[str, Any] = {"error": str(graded.fault.kind), "grade": str(graded.grade), "count": graded.count}
    if graded.fault.kind is Kind.TWICE:
        fields["index"] = graded.fault.target
    return fields | {"second": graded.second, "peer": graded.peer, "fidelity": graded.fidelity}


def target_records(targets: Targets, names: tuple[str, ...], objects: int) -> tuple[BoxRecord, ...]:
    """Targets as records.

    Args:
        targets: labels among `names`.
        names: the classes.
        objects: number of the scene's objects, which are the first targets.
    """
    rows = zip(targets.boxes_xyxy, targets.labels.tolist(), targets.ignore.tolist(), strict=True)
    return tuple(
        BoxRecord(_xyxy(box), names[label], ignore=ignore, index=i if i < objects else None)
        for i, (box, label, ignore) in enumerate(rows)
    )


def detection_records(detections: Detections, names: tuple[str, ...]) -> tuple[BoxRecord, ...]:
    """Detections as records, best first."""
    rows = zip(detections.boxes_xyxy, detections.labels.tolist(), detections.scores.tolist(), strict=True)
    return tuple(BoxRecord(_xyxy(box), names[label], score=score) for box, label, score in rows)


def targets_from_records(records: tuple[BoxRecord, ...], names: tuple[str, ...]) -> Targets:
    """The inverse of `target_records`."""
    return Targets(
        boxes_xyxy=torch.tensor([r.xyxy for r in records], dtype=torch.float32).reshape(-1, 4),
        labels=_labels(records, names),
        ignore=torch.tensor([r.ignore for r in records], dtype=torch.bool),
    )


def detections_from_records(records: tuple[BoxRecord, ...], names: tuple[str, ...]) -> Detections:
    """The inverse of `detection_records`."""
    return Detections(
        boxes_xyxy=torch.tensor([r.xyxy for r in records], dtype=torch.float32).reshape(-1, 4),
        labels=_labels(records, names),
        scores=torch.tensor([r.score for r in records], dtype=torch.float32),
    )


def _labels(records: tuple[BoxRecord, ...], names: tuple[str, ...]) -> Tensor:
    """The labels (N,) of records. Raises FormatError for a class that is not among `names`."""
    for record in records:
        if record.label not in names:
            raise FormatError(f"{RESULT}: label", f"one of {', '.join(names)}", repr(record.label))
    return torch.tensor([names.index(record.label) for record in records], dtype=torch.int64)


def _xyxy(box: Tensor) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = box.detach().tolist()
    return x0, y0, x1, y1


def psnr_in_boxes(scene: SceneIR, image: Tensor) -> float | None:
    """PSNR in dB of a re-render against the photograph, inside the vehicles' boxes; None where they are equal."""
    inside = torch.zeros(scene.camera.height, scene.camera.width, dtype=torch.bool)
    for x0, y0, x1, y1 in scene.objects.box2d.tolist():
        inside[max(math.floor(y0), 0) : math.ceil(y1) + 1, max(math.floor(x0), 0) : math.ceil(x1) + 1] = True
    if not bool(inside.any()):
        return None
    error = float(((image.detach().cpu() - scene.photograph.cpu())[:, inside] ** 2).mean())
    return None if error == 0 else -10 * math.log10(error)


class GradedFailure(Protocol):
    """A failure with a kind and a grade, such as `results.Failure`."""

    @property
    def index(self) -> int | None: ...
    @property
    def error(self) -> str | None: ...
    @property
    def grade(self) -> str | None: ...


F = TypeVar("F", bound=GradedFailure)
F_co = TypeVar("F_co", bound=GradedFailure, covariant=True)


class FrameWithFailures(Protocol[F_co]):
    """A frame with failures, such as `results.FrameResult`."""

    @property
    def failures(self) -> Sequence[F_co]: ...


def targets_and_detections(
    results: Sequence[FrameResult], classes: EvaluatedClasses, labels: str, picture: str
) -> tuple[list[Targets], list[Detections]]:
    """Return targets and detections of each frame.

    Args:
        results: The frames.
        classes: Evaluated classes.
        labels: benign or moved.
        picture: benign, rerendered or attacked.
    """
    targets = [
        classes.map_targets(targets_from_records(getattr(r, f"targets_{labels}"), CLASSES)) for r in results
    ]
    return targets, [detections_from_records(getattr(r, f"detections_{picture}"), classes.names) for r in results]


def has_grade(grade: Grade) -> Callable[[GradedFailure], bool]:
    """Return a predicate: whether a failure has at least this grade. Every failure has that of the threshold."""
    higher = list(Grade)[list(Grade).index(grade) :]
    return lambda failure: failure.grade in higher or grade is Grade.THRESHOLD


def certain_losses(result: FrameWithFailures[F]) -> list[F]:
    """Return the certain failures of objects, without phantoms."""
    certain = has_grade(Grade.CERTAIN)
    return [f for f in result.failures if f.index is not None and f.error in OBJECT_KINDS and certain(f)]


def count_grades(results: Sequence[FrameResult]) -> dict[str, Any]:
    """Count failures by grade and kind, and detector passes."""
    failures = [failure for r in results for failure in r.failures]
    return {
        "passes": sum(r.passes or 0 for r in results),
        **_count_failures(failures),
        "fidelity": {
            "trusted": sum(failure.count is not None and failure.is_trusted for failure in failures),
            "not_trusted": sum(not failure.is_trusted for failure in failures),
        },
        "frames_ungraded": sum(not r.graded for r in results),
        "grade_notes": dict(Counter(note for r in results for note in r.grade_notes)),
    }


def _count_failures(failures: Sequence[GradedFailure]) -> dict[str, dict[str, int]]:
    """Count failures of at least each grade, and by kind."""
    return {
        "grades": {str(grade): sum(map(has_grade(grade), failures)) for grade in Grade},
        "kinds": {str(kind): sum(f.error == kind for f in failures) for kind in Kind},
    }


def count_by_class(results: Sequence[FrameResult]) -> dict[str, ClassSummary]:
    """Count judged objects and failures of each class that has any."""
    judged = [(r.targets_benign[row].label, row in r.found_before) for r in results for row in r.judged]
    failures = [failure for r in results for failure in r.failures]
    present = {name for name, _ in judged} | {failure.label for failure in failures}
    return {
        name: ClassSummary(
            sum(label == name for label, _ in judged),
            sum(label == name and found for label, found in judged),
            **_count_failures([failure for failure in failures if failure.label == name]),
        )
        for name in CLASSES
        if name in present
    }


def build_map(results: Sequence[FrameResult]) -> FailureMap:
    """Build the map of frames with judged vehicles."""
    return FailureMap.from_frames(
        [(r.identifier, r.visits, {failure.index for failure in certain_losses(r)}) for r in results if r.judged]
    )


def estimate_rates(results: Sequence[FrameResult]) -> dict[str, Any]:
    """Compute the rates of `RunSummary`."""
    return {"rate": estimate_rate(results), "rate_as_photographed": estimate_photographed_rate(results)}


def estimate_rate(results: Sequence[FrameResult]) -> ClusteredShare | None:
    """Estimate how often a random state loses a vehicle that is found before, from the states that no score of the
    search influenced; for runs without changes of vehicles, which are chosen by scores. None for fewer than two frames
    with such states.
    """
    counts = []
    for result in results:
        visits = [visit for visit in result.visits if visit.index in result.found_before]
        counts.append((sum(v.random_misses for v in visits), sum(v.random for v in visits)))
    return ClusteredShare.from_frames(counts)


def estimate_photographed_rate(results: Sequence[FrameResult]) -> PhotographedRate | None:
    """Weight the states of `estimate_rate` so that objects are distributed over cells as in the photographs. None
    where fewer than two frames have such states, or no photographed object is in a cell with any, which holds for
    frames of earlier versions.
    """
    frames = [[visit for visit in r.visits if visit.index in r.found_before] for r in results]
    visits = list(itertools.chain.from_iterable(frames))
    cells = {cell: place for place, cell in enumerate(sorted({v.cell for v in visits if v.random}))}
    counts = np.zeros((len(frames), 3, len(cells)))  # photographed, random states, misses in these
    for row, visited in zip(counts, frames, strict=True):
        for visit in visited:
            if visit.cell in cells:
                row[:, cells[visit.cell]] += visit.photographed, visit.random, visit.random_misses
    photographed, draws, misses = counts.sum(0)
    if not photographed.sum() or np.count_nonzero(counts[:, 1].sum(1)) < 2:
        return None
    weights, rates = photographed / photographed.sum(), misses / draws
    value = float(weights @ rates)
    # A frame influences the rate of each cell, and how many photographed objects the cell has.
    by_rate = (counts[:, 2] - rates * counts[:, 1]) @ (weights / draws)
    by_weight = counts[:, 0] @ (rates - value) / photographed.sum()
    low, high = clustered_interval(value, by_rate + by_weight, float(draws.sum()))
    covered = photographed.sum() / sum(visit.photographed for visit in visits)
    return PhotographedRate(value, low, high, float(covered))


def count_objects(results: Sequence[FrameResult]) -> dict[str, Any]:
    """Count vehicles: those that are judged, found before, missed before, and lost."""
    judged, found = sum(len(r.judged) for r in results), sum(len(r.found_before) for r in results)

    def lost(grade: Grade) -> int:
        reaches = has_grade(grade)
        lost_rows = ({f.index for f in r.failures if f.kind == "lost" and reaches(f)} for r in results)
        return sum(len(rows & set(r.found_before)) for rows, r in zip(lost_rows, results, strict=True))

    return {
        "objects": VehicleCounts(sum(r.objects for r in results), judged, found),
        "by_class": count_by_class(results),
        "missed_before": Proportion.from_counts(judged - found, judged),
        "lost_by_grade": {str(grade): Proportion.from_counts(lost(grade), found) for grade in Grade},
    }


def summarise_frames(
    results: Sequence[FrameResult], classes: EvaluatedClasses, t_star: float, headline: str
) -> dict[str, Any]:
    """Compute the fields of `RunSummary` that follow from its frames.

    Args:
        results: The frames.
        classes: Evaluated classes.
        t_star: Score from which detections count.
        headline: Class of the headline.
    """

    attacked = [r for r in results if r.attacked]

    def scores(labels: str, picture: str) -> coco.CocoScores:
        return coco.evaluate(
            *targets_and_detections(attacked, classes, labels, picture), classes.names, t_star, headline
        )

    def count(kind: str) -> dict[str, int]:
        labels = [failure.label for r in results for failure in r.failures if failure.kind == kind]
        return {name: labels.count(name) for name in classes.names}

    return {
        "frames": len(results),
        "frames_not_attacked": {r.identifier: r.reason_not_attacked for r in results if not r.attacked},
        **count_objects(results),
        "benign": scores("benign", "benign"),
        "rerendered": scores("benign", "rerendered"),
        "attacked_paper": scores("benign", "attacked"),
        "attacked_moved": scores("moved", "attacked"),
        "lost_objects": count("lost"),
        "phantoms": count("phantom"),
        "successes_paper": sum(r.success_paper for r in results),
        "successes_moved": sum(r.success_moved for r in results),
        "feasible_fraction": sum(r.feasible for r in attacked) / len(attacked) if attacked else None,
        "queries": sum(r.queries for r in results),
        "map": build_map(results),
        **count_grades(results),
    }
