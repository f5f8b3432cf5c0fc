"""A counterexample in Python: one scene attacked in memory, as `drivesem attack` does.

```pycon
>>> import drivesem as ds
>>> found = ds.attack(ds.demo_scene(0), "squeezedet", params="translate,rotate", steps=2)
>>> found.picture.shape, found.feasible
((376, 1241, 3), True)
>>> sorted(found.theta)[0]
'objects[0].translate.across'

```
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from html import escape
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.base import Predictor, detector_device
from detectors.registry import AnyDetector, load_predictor
from drivesem.attacks.budgets import resolve_parameters
from drivesem.attacks.objective import CustomLoss
from drivesem.config.commands import AttackConfig
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.config.options import DEMO, SCENES
from drivesem.reporting.tables import format_count
from drivesem.run.attack import (
    WRITTEN,
    AttackWorker,
    load_named_detector,
    report_fallback,
    summarise_run,
    with_gradient_free_fallback,
    write_run_summary,
)
from drivesem.run.folder import FRAMES, claim_folder
from drivesem.run.frame import AttackedScene, count_grades, frame_result, write_frame
from drivesem.run.report import page, pictures
from drivesem.run.results import Failure, FrameResult
from drivesem.scenes.scene import Scene, encode_png
from scene_ir.io import to_uint8
from scene_ir.types import SceneIR


@dataclass(frozen=True, slots=True)
class Counterexample:
    """The outcome of an attack on a scene. A notebook displays the pictures before and after, and the failures."""

    scene: Scene
    """The changed scene."""
    result: FrameResult
    """All that `drivesem attack` records of a frame."""
    attacked: AttackedScene
    """The attack's state in memory."""
    config: AttackConfig
    """The settings."""

    @property
    def picture(self) -> NDArray[np.uint8]:
        """The evaluated picture, (H, W, 3) RGB."""
        return to_uint8(self.tensor)

    @property
    def tensor(self) -> Tensor:
        """The evaluated picture, (3, H, W) RGB in [0, 1], before rounding to 8 bits."""
        return self.attacked.rendered.render.image.detach().cpu()

    @property
    def photograph(self) -> NDArray[np.uint8]:
        """The photograph before the change, (H, W, 3) RGB."""
        return self.scene.photograph

    @property
    def theta(self) -> dict[str, float]:
        """The change by name, such as objects[3].yaw; `rows` adds units and bounds."""
        return {coordinate.name: coordinate.value for coordinate in self.result.theta}

    @property
    def failures(self) -> tuple[Failure, ...]:
        """What the detector got right before the change and gets wrong after it, by moved labels."""
        return self.result.failures

    @property
    def grades(self) -> dict[str, int]:
        """How many failures are of at least each grade: threshold, certain, confirmed, shared
        (docs/guide/ideas.md).
        """
        return count_grades([self.result])["grades"]

    @property
    def success(self) -> bool:
        """Whether the attack made the detector fail, by moved labels."""
        return self.result.success_moved

    @property
    def feasible(self) -> bool:
        """Whether the independent check found the change feasible."""
        return self.result.feasible

    def rows(self) -> list[dict[str, Any]]:
        """Theta as flat dicts, for `pandas.DataFrame`: name, unit, value, lower, upper, display."""
        return [asdict(coordinate) for coordinate in self.result.theta]

    def failure_rows(self) -> list[dict[str, Any]]:
        """Failures as flat dicts, for `pandas.DataFrame`: kind, grade, draws, second opinions, box."""
        return [failure.to_row() for failure in self.failures]

    def save(self, folder: str | Path) -> None:
        """Write a run of `drivesem attack` with this one frame, replacing an earlier one of the frame. All commands and
        `ds.load_run` read it.

        Raises UsageError for a folder that holds anything else, or an objective that has no name.
        """
        if callable(self.config.objective):
            expected = "an objective by name, as commands need it (result.scene.save writes the scene)"
            raise UsageError("objective", expected, "a function")
        out, name = Path(folder), self.result.identifier
        frames = out / FRAMES
        if frames.is_dir() and {path.name for path in frames.iterdir()} - {name}:
            raise UsageError("folder", f"a new folder, or one of the frame {name} alone", folder)
        embedded = self.scene.ir.provenance.get("dataset") == DEMO
        source = {"dataset": DEMO} if embedded else {"dataset": SCENES, "root": str(frames)}
        config = replace(self.config, **source, out=str(out), resume=False)
        claim_folder(out, config, WRITTEN)
        result = write_frame(self.attacked, frames / name)
        detector = self.attacked.objective.detector
        summary = summarise_run(config, resolve_parameters(config), detector, [result])
        write_run_summary(out, config, replace(summary, seconds=result.seconds), [result], ())

    def _repr_html_(self) -> str:
        result, t_star = self.result, self.attacked.objective.t_star
        marked = pictures.draw_overlay(
            self.picture, result.targets_moved, result.detections_attacked, result.failures, t_star
        )
        before = pictures.draw_overlay(
            self.photograph, result.targets_benign, result.detections_benign, (), t_star
        )
        figure_html = "".join(
            f'<figure style="margin:0;flex:1"><img alt="{name}" style="width:100%" src="data:image/png;base64,'
            f'{base64.b64encode(encode_png(picture)).decode("ascii")}"/><figcaption>{name}</figcaption></figure>'
            for name, picture in (("before", before), ("after", marked))
        )
        lines = "".join(f"<li>{escape(_describe_failure(failure))}</li>" for failure in result.failures)
        lines = lines or (
            "<li>no failure</li>" if result.attacked else f"<li>{escape(result.reason_not_attacked)}</li>"
        )
        feasible = "feasible" if self.feasible else f"not feasible: {'; '.join(result.violations)}"
        grades = ", ".join(f"{count} {grade}" for grade, count in self.grades.items() if count)
        grades = grades or ("no failure" if result.attacked else "not attacked")
        head = f"{self.scene.name}: {grades}; {feasible}, {format_count(result.queries, 'query', 'queries')}"
        return f'<div><p>{escape(head)}</p><div style="display:flex;gap:8px">{figure_html}</div><ul>{lines}</ul></div>'


def _describe_failure(failure: Failure) -> str:
    """Its grade, kind and place, then the evidence."""
    place = ", ".join(f"{value:.0f}" for value in failure.xyxy)
    which = "" if failure.index is None else f", objects[{failure.index}]"
    score = "" if failure.score is None else f"score {failure.score:.2f}"
    opinions = (page.format_second_opinion(failure, agreement) for agreement in (failure.second, failure.peer))
    evidence = [text for text in (score, page.format_evidence(failure), *opinions) if text]
    return "; ".join((f"{failure.grade}: {page.describe_failure(failure)}{which} at {place} px", *evidence))


def attack(
    scene: Scene | SceneIR,
    detector: AnyDetector = "squeezedet",
    *,
    params: str | None = None,
    combo: int | None = None,
    budget: str = "paper",
    method: str = "si-fgsm",
    steps: int = 10,
    passes: int | None = None,
    queries: int | None = None,
    rate: float = 1.0,
    momentum: float = 0.0,
    step_form: Literal["raw", "l2"] = "l2",
    norm: Literal[1, 2] = 2,
    range: Literal["bounds", "steps"] = "bounds",
    early_stop: bool = False,
    changes: str | None = None,
    mesh: str | None = None,
    target_objects: str | None = None,
    target_classes: str | None = None,
    objective: str | CustomLoss = "objectness",
    objective_labels: Literal["moved", "paper"] = "moved",
    keep: Literal["best", "last"] = "best",
    project: Literal["feasible", "bounds"] = "feasible",
    t_star: float | None = None,
    draws: int = 16,
    nuisances: str = "default",
    confirm: bool = True,
    second_detector: str = "auto",
    reference_detector: str | None = None,
    backend: Literal["warp", "reference"] = "warp",
    precision: Literal["float32", "bfloat16", "float16"] = "float32",
    tiles: Literal["auto", "off"] = "auto",
    device: str = "cpu",
    seed: int = 0,
) -> Counterexample:
    """Change a scene, within what is feasible, until a detector fails.

        counterexample = ds.attack(scene, "squeezedet", params="translate,rotate,mesh")
        counterexample.picture, counterexample.theta, counterexample.failures

    The options are those of `drivesem attack`. The same scene, settings and number of torch threads give the theta and
    picture of the command.

    Args:
        scene: The scene to attack.
        detector: A name or file as for `drivesem attack --detector`, a loaded detector, a torch module, or a function
            of images (`ds.load_detector`). An object excludes the options `precision` and `tiles`, and any device but
            its own. A detector without gradient is attacked by climb unless another method is given; a line on standard
            error names the reason.
        params: Parameters of theta with commas: color, weather, foliage, translate, rotate, mesh, size, sun, lamps.
        combo: Combination of the paper instead of `params`: 1 translate+rotate, 2 translate+rotate+mesh (the
            default), 3 translate+mesh, 4 rotate+mesh.
        budget: Limits of the change: paper, parking, street, or limits such as "translate=0.1".
        method: si-fgsm, apgd, fgsm, sgd, scw, random, halton, cma-es, corners, climb or learn (on one
            scene the same as climb).
        steps: Gradient steps.
        passes: Detector passes, a gradient counted as 3, instead of `steps` or `queries`.
        queries: Gradients of scw; evaluated renders of gradient-free methods.
        rate: Length of a step of si-fgsm, apgd, sgd and scw, in units of each parameter's own step.
        momentum: Weight of earlier gradients in si-fgsm and sgd, in [0, 1].
        step_form: Step of sgd: the gradient itself (raw), or its direction (l2).
        norm: Norm of the change that scw keeps small.
        range: Region in which gradient-free methods sample: the bounds, or what `steps` steps can reach.
        early_stop: Stop at the first failure.
        changes: Changes of objects with the budget street, with commas: leave, park, swap, load, emerge.
        mesh: File of the mesh that a vehicle changes to.
        target_objects: Rows that count as failures when lost, such as "0,2".
        target_classes: Classes in which failures count, such as "Car,Pedestrian".
        objective: The loss to raise: objectness, confidence, total, failure, hide, phantom, localisation; or a
            function from the detector's `Candidates`, its `Targets` and t* to a differentiable loss ().
        objective_labels: Labels of the loss: those that move with the vehicles, or the paper's.
        keep: The best state, or the last one.
        project: Project onto the feasible set, or onto the bounds alone.
        t_star: Score from which a detection counts; None uses the detector's own.
        draws: Draws of a certificate.
        nuisances: Nuisances of the draws.
        confirm: Test failures with a second renderer and a second detector.
        second_detector: auto, off, or a detector.
        reference_detector: Detector that judges how well vehicles are rendered.
        backend: The fast kernels, or the plain torch reference.
        precision: Of gradients.
        tiles: Whether ONNX detectors see enlarged tiles of wide pictures.
        device: torch device.
        seed: Seed of all random numbers.

    Raises:
        UsageError: A wrong option, or something that is no scene.
        SceneError: The scene cannot be used.
        DetectorError: The detector cannot be used.
    """
    options = {name: value for name, value in locals().items() if name not in ("scene", "detector", "objective")}
    if not isinstance(scene, Scene | SceneIR):
        found = f"{type(scene).__module__}.{type(scene).__name__}"
        raise UsageError("scene", "a scene (ds.derender(photo) makes one of a photograph)", found)
    source = scene if isinstance(scene, Scene) else Scene(scene)
    named = isinstance(detector, str | Path)
    own = None if named else load_predictor(detector)
    if not callable(objective):
        options["objective"] = objective
    try:
        config = AttackConfig(detector=str(detector) if own is None else own.name, **options)
        config.check()
        check_device(config.device)
        if own is not None:
            _check_loaded_detector(own, options)
        loaded = load_named_detector(config) if own is None else own
        usable = with_gradient_free_fallback(config, loaded)
        if callable(objective):
            usable = replace(usable, objective=cast("Any", objective))
        worker = AttackWorker.from_config(usable, loaded)
        report_fallback(config, usable, loaded)
    except UsageError as error:
        raise error.with_arguments() from error
    attacked = worker.attack_scene(source.name, source.ir)
    changed = attacked.rendered.scene
    return Counterexample(
        replace(source, ir=changed, notes=()), frame_result(attacked, changed), attacked, worker.config
    )


def _check_loaded_detector(detector: Predictor, options: Mapping[str, Any]) -> None:
    """Raise UsageError for an option that controls how a detector is loaded."""
    defaults = AttackConfig()
    for name in ("precision", "tiles"):
        if options[name] != getattr(defaults, name):
            raise UsageError(name, "none with a loaded detector", repr(options[name]))
    own, device = detector_device(detector), torch.device(options["device"])
    given = options["device"] != defaults.device
    if given and (device.type != own.type or device.index not in (None, own.index)):
        raise UsageError("device", f"that of the loaded detector: {own}", repr(options["device"]))
