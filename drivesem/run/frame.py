"""One frame: de-render -> perturb -> project -> re-render -> detect -> judge, and its folder on disk."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from detectors.base import Predictor, device_of
from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.aims import EVERYTHING, Aim
from drivesem.attack.budgets import reach_of
from drivesem.attack.changes import DRAWS, Changes, affordable, passes_of, proposals
from drivesem.attack.feasibility_check import Reach, check_scene, judge_at_hand
from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.judging import JudgedClasses
from drivesem.attack.labels import LabelMode, MovedLabels, shown_boxes, to_kitti_labels
from drivesem.attack.methods.base import Attack as AttackMethod
from drivesem.attack.methods.base import AttackResult, Problem
from drivesem.attack.methods.given import Given
from drivesem.attack.methods.margin_search import FRESH, OfMargins, value_of
from drivesem.attack.methods.placebo import Placebo
from drivesem.attack.objective import Objective, Rendered
from drivesem.attack.space import Budget, Parameter, ParameterSpace, Parametrisation
from drivesem.config.blocks import KEEP_MB
from drivesem.data import kitti
from drivesem.evaluation.failures import Failures
from drivesem.failures.certificate import with_regions
from drivesem.failures.grades import Grade
from drivesem.failures.grading import Case, Graded, Grader, Grades
from drivesem.failures.kinds import View
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.second_renderer.compositor import CompositorDraw
from drivesem.failures.views import DrawnViews
from drivesem.run.report import pictures
from drivesem.run.results import BoxRecord, Coordinate, Failure, FrameResult, dump_frame
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.exchange import CHANGE
from scene_ir.io import load_scene, save_scene, to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Render, SceneIR, scene_to

RESULT = "result.json"
"""The file that marks a frame as done."""


@dataclass(frozen=True, slots=True)
class FrameSettings:
    """What is done to every frame. attack: the algorithm; params: what it may move; term: of the detector's loss,
    to be raised; seed: of its randomness; t_star: score from which a detection counts, by default the detector's;
    budget: how far theta may go, by default as far as the paper's; aim: what the attack is after; grader: says
    how sure its failures are, None to leave them ungraded. keep_last, only_bounds: as the paper's protocol has it,
    see `Problem` and `FeasibleSet`. parametrisation: of translate. whole, keep_mb: see `Objective`. changes: what
    is proposed after a search on margins, None for nothing.
    """

    attack: AttackMethod
    params: tuple[Parameter, ...]
    label_mode: LabelMode
    term: str
    render: RenderSettings
    seed: int
    t_star: float | None = None
    budget: Budget | None = None
    aim: Aim = EVERYTHING
    grader: Grader | None = None
    keep_last: bool = False
    only_bounds: bool = False
    parametrisation: Parametrisation = "ground"
    whole: bool = False
    keep_mb: float = KEEP_MB
    changes: Changes | None = None


@dataclass(frozen=True, slots=True)
class AttackedScene:
    """What an attack on one scene found, in memory. search: what the attack handed back; rendered: the scene at
    its theta, judged; benign: detections on the photograph; failures: of `rendered`, graded; seconds: it all took,
    grading_seconds: and of these, what came after the search.
    """

    identifier: str
    objective: Objective
    search: AttackResult
    rendered: Rendered
    benign: Detections
    violated_at_start: tuple[str, ...]
    failures: tuple[Failure, ...]
    grade_notes: tuple[str, ...]
    passes: int
    seconds: float
    grading_seconds: float


def attack_scene(identifier: str, scene: SceneIR, detector: Predictor, settings: FrameSettings) -> AttackedScene:
    """Attack one scene, where the detector is. Nothing is written.

    Raises SceneError where the scene cannot be used, or a loss or gradient is not finite; DetectorError where the
    detector knows no cars.
    """
    start = time.perf_counter()
    scene = scene_to(scene, None, device_of(detector))
    posed, attack = _Posed.of(identifier, scene, detector, settings), settings.attack
    aside = 0
    if settings.changes is not None and isinstance(attack, OfMargins):
        count = affordable(attack.passes)
        attack = replace(attack, passes=attack.passes - passes_of(count))
        search = posed.searched(attack)
        offered = proposals(scene, settings.changes, count, settings.seed, settings.render)
        others = (_Posed.of(identifier, changed, detector, settings) for changed in offered)
        posed, search, aside = _best_change(posed, search, others)
    else:
        search = posed.searched(attack)
    posed.views.forget()
    objective, feasible = posed.views.objective, posed.feasible
    rendered = objective.evaluate(search.theta)
    benign = objective.detect(scene.photograph)
    passes = objective.passes + 1 + aside
    searched = time.perf_counter()
    failures, notes = _graded(identifier, objective, feasible, search, rendered, settings)
    objective.forget()
    end = time.perf_counter()
    return AttackedScene(
        identifier=identifier,
        objective=objective,
        search=search,
        rendered=rendered,
        benign=benign,
        violated_at_start=feasible.violated_at_start,
        failures=failures,
        grade_notes=notes,
        passes=passes,
        seconds=end - start,
        grading_seconds=end - searched,
    )


@dataclass(frozen=True, slots=True)
class _Posed:
    """A scene and what is asked of it, in draws of its frame's name."""

    views: DrawnViews
    feasible: FeasibleSet
    problem: Problem
    seed: int

    @classmethod
    def of(cls, identifier: str, scene: SceneIR, detector: Predictor, settings: FrameSettings) -> _Posed:
        objective = Objective(
            Compositor(scene, settings.render),
            ParameterSpace(scene, settings.params, settings.budget, parametrisation=settings.parametrisation),
            detector,
            settings.label_mode,
            settings.term,
            t_star=settings.t_star,
            aim=settings.aim,
            whole=settings.whole,
            keep_mb=settings.keep_mb,
        )
        nuisances = Nuisances() if settings.grader is None else settings.grader.nuisances
        views = DrawnViews.of(objective, nuisances, f"search:{identifier}:{settings.seed}")
        feasible = objective.feasible_set(only_bounds=settings.only_bounds)
        return cls(views, feasible, objective.problem(feasible, settings.keep_last, views), settings.seed)

    @property
    def space(self) -> ParameterSpace:
        """Of theta."""
        return self.views.objective.space

    def searched(self, attack: AttackMethod) -> AttackResult:
        """What an attack finds."""
        return attack(self.problem, self.space.theta0, self.seed)

    def value(self, theta: Tensor) -> float:
        """What a search on margins lowers, at theta (D,), in draws that no search looks at."""
        seen = (self.views.margins(theta, FRESH + number) for number in range(DRAWS))
        return sum(value_of(margins, self.views.judged) for margins in seen)


def _best_change(
    still: _Posed, search: AttackResult, changed: Iterable[_Posed]
) -> tuple[_Posed, AttackResult, int]:
    """Of a scene at the theta that was found, and what changes made of it at the same theta, that with the lowest
    margins; and the passes that the others took.
    """
    best, least, theta = still, still.value(search.theta), search.theta
    all_passes = kept_passes = still.views.passes
    for posed in changed:
        here = posed.problem.project(posed.space.carried(still.space, search.theta)).theta
        value = posed.value(here)
        posed.views.forget()
        all_passes += posed.views.passes
        if value < least:
            best, least, theta, kept_passes = posed, value, here, posed.views.passes
    if best is not still:
        found = best.searched(Given(theta))
        if torch.equal(found.theta, theta):  # else its render showed that it cannot be
            trace = (*search.loss_trace, *found.loss_trace)
            return best, replace(found, queries=search.queries, loss_trace=trace), all_passes - kept_passes
    return still, search, all_passes - still.views.passes


def write_frame(attacked: AttackedScene, folder: Path) -> FrameResult:
    """Write a frame's folder, whole or not at all. Returns what `folder / RESULT` holds: the independent check
    reads the scene back from disk.
    """
    start = time.perf_counter()
    with files.whole_folder(folder) as part:
        save_scene(attacked.rendered.scene, part / "scene")
        result = frame_result(attacked, load_scene(part / "scene"))
        result = replace(result, seconds=round(attacked.seconds + time.perf_counter() - start, 3))
        _write(part, attacked, result)
    return result


def frame_result(attacked: AttackedScene, perturbed: SceneIR) -> FrameResult:
    """The record of an attacked scene. perturbed: the counterexample as the independent check is to see it."""
    objective, search, rendered = attacked.objective, attacked.search, attacked.rendered
    names = objective.judged.names
    scene = objective.space.scene
    moved = rendered.moved.targets
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
        violations=tuple(check_scene(perturbed.at_rest(), perturbed, reach=_reach(objective.space))),
        targets_benign=target_records(objective.benign.paper.targets, CLASSES, len(scene.objects)),
        targets_moved=target_records(moved, CLASSES, len(scene.objects)),
        detections_benign=detection_records(attacked.benign, names),
        detections_rerendered=detection_records(objective.benign.detections, names),
        detections_attacked=detection_records(rendered.detections, names),
        failures=attacked.failures,
        became_ignored=tuple(rendered.moved.became_ignored.nonzero()[:, 0].tolist()),
        success_paper=search.success_paper,
        success_moved=search.success_moved,
        identity_psnr_db=psnr_in_boxes(objective.benign.scene, objective.benign.render.image),
        seconds=round(attacked.seconds, 3),
        violated_at_start=attacked.violated_at_start,
        checked_by=judge_at_hand(),
        passes=attacked.passes,
        grade_notes=attacked.grade_notes,
        min_contrast=objective.difficulty.min_contrast,
        joint_weather=True,
        change=scene.provenance.get(CHANGE, "") if scene.before is not None else "",
    )


def _reach(space: ParameterSpace) -> Reach:
    return reach_of(space.budget, space.parametrisation)


def _write(part: Path, attacked: AttackedScene, result: FrameResult) -> None:
    objective, rendered = attacked.objective, attacked.rendered
    scene = objective.space.scene
    before, after = to_uint8(scene.photograph), to_uint8(rendered.render.image)
    files.write_png(part / "benign.png", before)
    files.write_png(part / "rerender.png", to_uint8(objective.benign.render.image))
    files.write_png(part / "counterexample.png", after)
    marked = pictures.overlay(
        after, result.targets_moved, result.detections_attacked, result.failures, objective.t_star
    )
    files.write_png(part / "overlay.png", marked)
    files.write_png(part / "difference.png", pictures.difference(before, after))
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
    files.write_text(part / RESULT, dump_frame(result))


def _graded(
    identifier: str,
    objective: Objective,
    feasible: FeasibleSet,
    search: AttackResult,
    rendered: Rendered,
    settings: FrameSettings,
) -> tuple[tuple[Failure, ...], tuple[str, ...]]:
    """What the detector gets wrong in `rendered`, as graded records; and why a grade could not be reached."""
    failures = objective.failures(rendered, "moved")
    if settings.grader is None or not failures.success:
        return failure_records(objective.judged, rendered.moved.targets, rendered.detections, failures), ()

    def placebo() -> SceneIR:
        edit = Placebo(tuple(search.theta.tolist()))(
            objective.problem(feasible), objective.space.theta0, settings.seed
        )
        return objective.space.apply(objective.space.scene, edit.theta)

    case = case_of(
        identifier,
        CompositorDraw(objective.compositor, objective.labeller),
        objective.judged,
        State(
            objective.benign.scene, objective.benign.render, objective.benign.paper, objective.benign.detections
        ),
        State(rendered.scene, rendered.render, rendered.moved, rendered.detections),
        placebo,
    )
    grades = settings.grader.grade(case, failures)
    records = failure_records(objective.judged, rendered.moved.targets, rendered.detections, failures, grades)
    return records, grades.notes


@dataclass(frozen=True, slots=True)
class State:
    """A scene as it was judged: rendered, labelled, looked at. detections: labels among the judged classes."""

    scene: SceneIR
    render: Render
    labels: MovedLabels
    detections: Detections


def case_of(
    identifier: str,
    renderer: CompositorDraw,
    judged: JudgedClasses,
    benign: State,
    now: State,
    placebo: Callable[[], SceneIR] | None = None,
) -> Case:
    """What a grader is to look at. placebo: as of `Case`."""

    def view(state: State) -> View:
        targets = judged.targets(state.labels.targets)
        return View(targets, with_regions(shown_boxes(state.render), targets), state.detections)

    return Case(identifier, benign.scene, now.scene, renderer, view(benign), view(now), placebo)


def failure_records(
    judged: JudgedClasses,
    moved: Targets,
    detections: Detections,
    failures: Failures,
    grades: Grades | None = None,
) -> tuple[Failure, ...]:
    """Failures as records: lost objects, then phantoms. moved: labels among CLASSES; detections: among the judged
    classes; grades: of these failures, None where nobody asked.
    """
    lost = [
        Failure(
            "lost", CLASSES[int(moved.labels[i])], _xyxy(moved.boxes_xyxy[i]), index=i, **_of(grades, "lost", i)
        )
        for i in failures.lost
    ]
    phantoms = [
        Failure(
            "phantom",
            judged.names[int(detections.labels[i])],
            _xyxy(detections.boxes_xyxy[i]),
            score=float(detections.scores[i]),
            **_of(grades, "phantoms", i),
        )
        for i in failures.phantoms
    ]
    return (*lost, *phantoms)


def _of(grades: Grades | None, which: Literal["lost", "phantoms"], index: int) -> dict[str, Any]:
    """The fields of a failure's record that say what it is and how sure."""
    if grades is None:
        return {}
    graded: Graded | None = getattr(grades, which).get(index)
    if graded is None:
        return {"grade": str(Grade.THRESHOLD)}
    fields = {"error": str(graded.fault.kind), "grade": str(graded.grade), "count": graded.count}
    return fields | {"second": graded.second, "peer": graded.peer}


def target_records(targets: Targets, names: tuple[str, ...], objects: int) -> tuple[BoxRecord, ...]:
    """Targets as records; the first `objects` of them are the scene's objects."""
    rows = zip(targets.boxes_xyxy, targets.labels.tolist(), targets.ignore.tolist(), strict=True)
    return tuple(
        BoxRecord(_xyxy(box), names[label], ignore=ignore, index=i if i < objects else None)
        for i, (box, label, ignore) in enumerate(rows)
    )


def detection_records(detections: Detections, names: tuple[str, ...]) -> tuple[BoxRecord, ...]:
    """Detections as records, best first."""
    rows = zip(detections.boxes_xyxy, detections.labels.tolist(), detections.scores.tolist(), strict=True)
    return tuple(BoxRecord(_xyxy(box), names[label], score=score) for box, label, score in rows)


def as_targets(records: tuple[BoxRecord, ...], names: tuple[str, ...]) -> Targets:
    """The inverse of `target_records`."""
    return Targets(
        boxes_xyxy=torch.tensor([r.xyxy for r in records], dtype=torch.float32).reshape(-1, 4),
        labels=_labels(records, names),
        ignore=torch.tensor([r.ignore for r in records], dtype=torch.bool),
    )


def as_detections(records: tuple[BoxRecord, ...], names: tuple[str, ...]) -> Detections:
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
