"""A counterexample as a notebook holds it: one scene attacked in memory, by the way that `drivesem attack` goes.

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
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from html import escape
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack, get_args, get_type_hints

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.base import Predictor, detector_device
from drivesem.config.commands import AttackConfig, SearchMethod
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.report.tables import format_count
from drivesem.run.attack import AttackWorker, load_named_detector, with_gradient_free_fallback
from drivesem.run.frame import AttackedScene, frame_result, write_frame
from drivesem.run.report import page as grading
from drivesem.run.report import pictures
from drivesem.run.results import Failure, FrameResult
from drivesem.run.summary import count_grades
from drivesem.scenes.scene import Scene, png
from scene_ir.io import to_uint8
from scene_ir.types import SceneIR


class AttackOptions(TypedDict, total=False):
    """The options of `drivesem attack` that make sense for one scene, with the same meaning and defaults."""

    combo: int
    params: str
    method: SearchMethod
    steps: int
    queries: int
    passes: int
    changes: str
    mesh: str
    step_form: Literal["raw", "l2"]
    rate: float
    momentum: float
    norm: Literal[1, 2]
    restarts: int
    scouts: int
    budget: str
    range: Literal["bounds", "steps"]
    early_stop: bool
    objective_labels: Literal["moved", "paper"]
    objective: Literal["objectness", "confidence", "total", "failure", "hide", "phantom", "localisation"]
    keep: Literal["best", "last"]
    project: Literal["feasible", "bounds"]
    target_objects: str
    target_classes: str
    backend: Literal["warp", "reference"]
    precision: Literal["float32", "bfloat16", "float16"]
    t_star: float
    tiles: Literal["auto", "off"]
    draws: int
    nuisances: str
    confirm: bool
    witness: str
    peer: str
    device: str
    seed: int


@dataclass(frozen=True, slots=True)
class Counterexample:
    """What an attack made of a scene. scene: the changed one; result: all that `drivesem attack` records of a
    frame. A notebook shows the pictures before and after, and what fails.
    """

    scene: Scene
    result: FrameResult
    attacked: AttackedScene

    @property
    def picture(self) -> NDArray[np.uint8]:
        """The picture that was judged, (H, W, 3) RGB."""
        return to_uint8(self.tensor)

    @property
    def tensor(self) -> Tensor:
        """The picture that was judged, (3, H, W) RGB in [0, 1], before rounding to 8 bits."""
        return self.attacked.rendered.render.image.detach().cpu()

    @property
    def photograph(self) -> NDArray[np.uint8]:
        """The photograph before the change, (H, W, 3) RGB."""
        return self.scene.photograph

    @property
    def theta(self) -> dict[str, float]:
        """What was changed, by name, such as objects[3].yaw; `rows` has units and bounds."""
        return {coordinate.name: coordinate.value for coordinate in self.result.theta}

    @property
    def failures(self) -> tuple[Failure, ...]:
        """What the detector got right before the change and gets wrong after it, by labels that moved along."""
        return self.result.failures

    @property
    def grades(self) -> dict[str, int]:
        """How many failures are of at least each grade: threshold, certain, confirmed, shared (docs/guide/ideas.md)."""
        return count_grades([self.result])["grades"]

    @property
    def success(self) -> bool:
        """Whether the attack broke the detector, by labels that moved along."""
        return self.result.success_moved

    @property
    def feasible(self) -> bool:
        """Whether the independent check found the change possible."""
        return self.result.feasible

    def rows(self) -> list[dict[str, Any]]:
        """Theta as flat dicts, for `pandas.DataFrame`: name, unit, value, lower, upper, display."""
        return [asdict(coordinate) for coordinate in self.result.theta]

    def failure_rows(self) -> list[dict[str, Any]]:
        """Failures as flat dicts, for `pandas.DataFrame`: kind, grade, draws, second opinions, box."""
        return [failure.to_row() for failure in self.failures]

    def save(self, folder: str | Path) -> None:
        """Write the folder that `drivesem attack` writes of a frame; in place of an earlier one."""
        path = Path(folder)
        if path.is_file() or (path.is_dir() and any(path.iterdir()) and not (path / "theta.json").is_file()):
            raise UsageError("folder", "a new folder, or one of a counterexample", folder)
        write_frame(self.attacked, path)

    def _repr_html_(self) -> str:
        result, t_star = self.result, self.attacked.objective.t_star
        marked = pictures.draw_overlay(
            self.picture, result.targets_moved, result.detections_attacked, result.failures, t_star
        )
        before = pictures.draw_overlay(
            self.photograph, result.targets_benign, result.detections_benign, (), t_star
        )
        shown = "".join(
            f'<figure style="margin:0;flex:1"><img alt="{name}" style="width:100%" src="data:image/png;base64,'
            f'{base64.b64encode(png(picture)).decode("ascii")}"/><figcaption>{name}</figcaption></figure>'
            for name, picture in (("before", before), ("after", marked))
        )
        lines = "".join(f"<li>{escape(_told(failure))}</li>" for failure in result.failures)
        lines = lines or "<li>nothing fails</li>"
        feasible = "feasible" if self.feasible else f"not feasible: {'; '.join(result.violations)}"
        grades = ", ".join(f"{count} {grade}" for grade, count in self.grades.items() if count) or "no failure"
        head = f"{self.scene.name}: {grades}; {feasible}, {format_count(result.queries, 'query', 'queries')}"
        return f'<div><p>{escape(head)}</p><div style="display:flex;gap:8px">{shown}</div><ul>{lines}</ul></div>'


def _told(failure: Failure) -> str:
    """Its grade in front, then what it is and where, and what says so."""
    place = ", ".join(f"{value:.0f}" for value in failure.xyxy)
    which = "" if failure.index is None else f", objects[{failure.index}]"
    score = "" if failure.score is None else f"score {failure.score:.2f}"
    opinions = (grading.format_second_opinion(failure, agreement) for agreement in (failure.second, failure.peer))
    said = [words for words in (score, grading.format_draws(failure), *opinions) if words]
    return f"{failure.grade}: {grading.what(failure)}{which} at {place} px" + "".join(
        f"; {words}" for words in said
    )


def run_attack(
    scene: Scene | SceneIR, detector: str | Predictor = "squeezedet", **options: Unpack[AttackOptions]
) -> Counterexample:
    """Change a scene, within what is feasible, until a detector gets it wrong.

        found = ds.attack(scene, "squeezedet", params="translate,rotate,mesh")
        found.picture, found.theta, found.failures

    detector: a name or file as of `drivesem attack --detector`, or a detector that is loaded (`ds.load_detector`),
    beside which there is no precision, no tiles, and no device but its own. One without gradient is attacked by
    climb, where no other method is asked for.
    options: those of `drivesem attack`, with underscores. The same scene, settings and number of torch threads
    give the command's theta and picture. Raises UsageError naming the argument, SceneError or DetectorError.
    """
    _check(options)
    named = detector if isinstance(detector, str) else detector.name
    held = scene if isinstance(scene, Scene) else Scene(scene)
    try:
        config = AttackConfig(detector=named, **options)
        config.check()
        check_device(config.device)
        if not isinstance(detector, str):
            _check_beside(detector, options)
        loaded = load_named_detector(config) if isinstance(detector, str) else detector
        worker = AttackWorker.from_config(with_gradient_free_fallback(config, loaded), loaded)
    except UsageError as error:
        raise UsageError(_argument(error.field), _argument(error.expected), error.actual) from error
    attacked = worker.search(held.name, held.ir)
    changed = attacked.rendered.scene
    return Counterexample(replace(held, ir=changed, notes=()), frame_result(attacked, changed), attacked)


def _check(options: Mapping[str, Any]) -> None:
    """Raise UsageError for an option that is none, or a value of another type."""
    kinds = get_type_hints(AttackOptions)
    for name, value in options.items():
        if name not in kinds:
            raise UsageError("attack", f"options among {', '.join(kinds)}", name)
        choices = get_args(kinds[name])
        if choices and value not in choices:
            raise UsageError(name, f"one of {', '.join(map(str, choices))}", repr(value))
        if not choices and not (isinstance(value, kinds[name]) or (kinds[name] is float and type(value) is int)):
            raise UsageError(name, f"a value of type {kinds[name].__name__}", repr(value))


def _check_beside(detector: Predictor, options: Mapping[str, Any]) -> None:
    """Raise UsageError for an option that says how to load the detector, which is loaded otherwise."""
    for name in ("precision", "tiles"):
        if name in options:
            raise UsageError(name, "none beside a detector that is loaded", repr(options[name]))
    own = detector_device(detector)
    asked = torch.device(options.get("device", own))
    if asked.type != own.type or asked.index not in (None, own.index):
        raise UsageError("device", f"that of the detector, which is loaded: {own}", repr(options["device"]))


def _argument(text: str) -> str:
    """`--t-star` as Python writes it: t_star."""
    return re.sub(r"--([a-z][a-z-]*)", lambda flag: flag[1].replace("-", "_"), text)
