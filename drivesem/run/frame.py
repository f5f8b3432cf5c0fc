"""One frame: de-render -> perturb -> project -> re-render -> detect -> judge, and its folder on disk."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from detectors.base import Predictor
from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.aims import EVERYTHING, Aim
from drivesem.attack.feasibility_check import check_scene
from drivesem.attack.feasible import FeasibleSet
from drivesem.attack.labels import LabelMode, to_kitti_labels
from drivesem.attack.methods.base import Attack as AttackMethod
from drivesem.attack.methods.base import AttackResult
from drivesem.attack.objective import Objective, Rendered
from drivesem.attack.space import Budget, Parameter, ParameterSpace
from drivesem.data import kitti
from drivesem.report import pictures
from drivesem.run.results import BoxRecord, Coordinate, Failure, FrameResult, dump_frame
from scene_ir import files
from scene_ir.compositor import Compositor, RenderSettings
from scene_ir.io import load_scene, save_scene, to_uint8
from scene_ir.types import SceneIR

RESULT = "result.json"
"""The file that marks a frame as done."""


@dataclass(frozen=True, slots=True)
class FrameSettings:
    """What is done to every frame. attack: the algorithm; params: what it may move; term: of the detector's loss,
    to be raised; seed: of its randomness; t_star: score from which a detection counts, by default the detector's;
    budget: how far theta may go, by default as far as the paper's; aim: what the attack is after.
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


def attack_frame(
    identifier: str, scene: SceneIR, detector: Predictor, settings: FrameSettings, folder: Path
) -> FrameResult:
    """Attack one scene and write its folder, whole or not at all. Returns what `folder / RESULT` holds.

    Raises SceneError where the scene cannot be used, or a loss or gradient is not finite; DetectorError where the
    detector knows no cars.
    """
    start = time.perf_counter()
    space = ParameterSpace(scene, settings.params, settings.budget)
    compositor = Compositor(scene, settings.render)
    objective = Objective(
        compositor,
        space,
        detector,
        settings.label_mode,
        settings.term,
        t_star=settings.t_star,
        aim=settings.aim,
    )
    feasible = FeasibleSet(space)
    attacked = settings.attack(objective.problem(feasible), space.theta0, settings.seed)
    rendered = objective.evaluate(attacked.theta)
    benign = objective.detect(scene.photograph)
    with files.whole_folder(folder) as part:
        save_scene(rendered.scene, part / "scene")
        saved = load_scene(part / "scene")
        result = _result(
            identifier, objective, attacked, rendered, benign, tuple(check_scene(saved.as_photographed(), saved))
        )
        seconds = round(time.perf_counter() - start, 3)
        result = replace(result, seconds=seconds, violated_at_start=feasible.violated_at_start)
        _write(part, scene, objective, rendered, result)
    return result


def _result(
    identifier: str,
    objective: Objective,
    attacked: AttackResult,
    rendered: Rendered,
    benign: Detections,
    violations: tuple[str, ...],
) -> FrameResult:
    names = objective.judged.names
    scene = objective.space.scene
    moved = rendered.moved.targets
    return FrameResult(
        identifier=identifier,
        objects=len(scene.objects),
        queries=attacked.queries,
        loss_trace=attacked.loss_trace,
        theta=tuple(
            Coordinate(name=name, **facts)  # pyright: ignore[reportArgumentType]
            for name, facts in objective.space.theta_by_name(attacked.theta).items()
        ),
        active_constraints=attacked.active_constraints,
        violations=violations,
        targets_benign=target_records(objective.benign.paper.targets, CLASSES, len(scene.objects)),
        targets_moved=target_records(moved, CLASSES, len(scene.objects)),
        detections_benign=detection_records(benign, names),
        detections_rerendered=detection_records(objective.benign.detections, names),
        detections_attacked=detection_records(rendered.detections, names),
        failures=failure_records(objective, rendered),
        became_ignored=tuple(rendered.moved.became_ignored.nonzero()[:, 0].tolist()),
        success_paper=attacked.success_paper,
        success_moved=attacked.success_moved,
        identity_psnr_db=_psnr_in_boxes(scene, objective.benign.render.image),
        seconds=0.0,
    )


def _write(part: Path, scene: SceneIR, objective: Objective, rendered: Rendered, result: FrameResult) -> None:
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
        as_kitti = to_kitti_labels(labels, scene, rendered.scene)
        kitti.write_labels(part / f"labels_{labels.mode}.txt", as_kitti)
    files.write_json(
        part / "theta.json",
        {
            c.name: {"value": c.value, "unit": c.unit, "bounds": [c.lower, c.upper], "display": c.display}
            for c in result.theta
        },
    )
    files.write_text(part / RESULT, dump_frame(result))


def failure_records(objective: Objective, rendered: Rendered) -> tuple[Failure, ...]:
    """What the detector gets wrong in `rendered`, by moved labels, as records: lost objects, then phantoms."""
    names = objective.judged.names
    found = objective.failures(rendered, "moved")
    moved, detections = rendered.moved.targets, rendered.detections
    lost = [
        Failure("lost", CLASSES[int(moved.labels[i])], _xyxy(moved.boxes_xyxy[i]), index=i) for i in found.lost
    ]
    phantoms = [
        Failure(
            "phantom",
            names[int(detections.labels[i])],
            _xyxy(detections.boxes_xyxy[i]),
            score=float(detections.scores[i]),
        )
        for i in found.phantoms
    ]
    return (*lost, *phantoms)


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
        labels=torch.tensor([names.index(r.label) for r in records], dtype=torch.int64),
        ignore=torch.tensor([r.ignore for r in records], dtype=torch.bool),
    )


def as_detections(records: tuple[BoxRecord, ...], names: tuple[str, ...]) -> Detections:
    """The inverse of `detection_records`."""
    return Detections(
        boxes_xyxy=torch.tensor([r.xyxy for r in records], dtype=torch.float32).reshape(-1, 4),
        labels=torch.tensor([names.index(r.label) for r in records], dtype=torch.int64),
        scores=torch.tensor([r.score for r in records], dtype=torch.float32),
    )


def _xyxy(box: Tensor) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = box.detach().tolist()
    return x0, y0, x1, y1


def _psnr_in_boxes(scene: SceneIR, image: Tensor) -> float | None:
    """PSNR in dB of a re-render against the photograph, inside the vehicles' boxes; None where they are equal."""
    inside = torch.zeros(scene.camera.height, scene.camera.width, dtype=torch.bool)
    for x0, y0, x1, y1 in scene.objects.box2d.tolist():
        inside[max(math.floor(y0), 0) : math.ceil(y1) + 1, max(math.floor(x0), 0) : math.ceil(x1) + 1] = True
    if not bool(inside.any()):
        return None
    error = float(((image.detach().cpu() - scene.photograph.cpu())[:, inside] ** 2).mean())
    return None if error == 0 else -10 * math.log10(error)
