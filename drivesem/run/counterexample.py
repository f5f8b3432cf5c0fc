"""A counterexample in Python: one scene attacked in memory, as `drivesem attack` does.

```pycon
>>> import drivesem as ds
>>> found = ds.run_attack(ds.demo_scene(0), "squeezedet", params="translate,rotate", steps=2)
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
from dataclasses import asdict, dataclass, fields, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.base import Predictor, detector_device
from drivesem.config.commands import AttackConfig
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.config.options import FrameCommandConfig, SceneOptions
from drivesem.report.tables import format_count
from drivesem.run.attack import AttackWorker, load_named_detector, with_gradient_free_fallback
from drivesem.run.frame import AttackedScene, count_grades, frame_result, write_frame
from drivesem.run.report import page, pictures
from drivesem.run.results import Failure, FrameResult
from drivesem.scenes.scene import Scene, encode_png
from scene_ir.io import to_uint8
from scene_ir.types import SceneIR

_DATASET_OPTIONS = {field.name for field in fields(FrameCommandConfig) + fields(SceneOptions)} - {"device", "seed"}
OPTIONS = tuple(
    field.name
    for field in fields(AttackConfig)
    if field.name
    not in _DATASET_OPTIONS
    | {"detector", "like", "part", "grade", "whole", "incremental", "keep_mb", "parametrisation"}
)
"""Options of `drivesem attack` that apply to one scene, with the same meaning and defaults."""


@dataclass(frozen=True, slots=True)
class Counterexample:
    """The outcome of an attack on a scene. A notebook displays the pictures before and after, and the failures."""

    scene: Scene
    """The changed scene."""
    result: FrameResult
    """All that `drivesem attack` records of a frame."""
    attacked: AttackedScene
    """The attack's state in memory."""

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
        """Write the folder that `drivesem attack` writes for a frame, replacing an earlier one."""
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
        figure_html = "".join(
            f'<figure style="margin:0;flex:1"><img alt="{name}" style="width:100%" src="data:image/png;base64,'
            f'{base64.b64encode(encode_png(picture)).decode("ascii")}"/><figcaption>{name}</figcaption></figure>'
            for name, picture in (("before", before), ("after", marked))
        )
        lines = "".join(f"<li>{escape(_describe_failure(failure))}</li>" for failure in result.failures)
        lines = lines or "<li>nothing fails</li>"
        feasible = "feasible" if self.feasible else f"not feasible: {'; '.join(result.violations)}"
        grades = ", ".join(f"{count} {grade}" for grade, count in self.grades.items() if count) or "no failure"
        head = f"{self.scene.name}: {grades}; {feasible}, {format_count(result.queries, 'query', 'queries')}"
        return f'<div><p>{escape(head)}</p><div style="display:flex;gap:8px">{figure_html}</div><ul>{lines}</ul></div>'


def _describe_failure(failure: Failure) -> str:
    """Its grade, kind and place, then the evidence."""
    place = ", ".join(f"{value:.0f}" for value in failure.xyxy)
    which = "" if failure.index is None else f", objects[{failure.index}]"
    score = "" if failure.score is None else f"score {failure.score:.2f}"
    opinions = (page.format_second_opinion(failure, agreement) for agreement in (failure.second, failure.peer))
    evidence = [text for text in (score, page.format_draws(failure), *opinions) if text]
    return "; ".join((f"{failure.grade}: {page.describe_failure(failure)}{which} at {place} px", *evidence))


def run_attack(scene: Scene | SceneIR, detector: str | Predictor = "squeezedet", **options: Any) -> Counterexample:
    """Change a scene, within what is feasible, until a detector fails.

        counterexample = ds.run_attack(scene, "squeezedet", params="translate,rotate,mesh")
        counterexample.picture, counterexample.theta, counterexample.failures

    The same scene, settings and number of torch threads give the theta and picture of the command.

    Args:
        scene: the scene to attack.
        detector: a name or file as for `drivesem attack --detector`, or a loaded detector (`ds.load_detector`),
            which excludes the options `precision` and `tiles`, and any device but its own. A detector without
            gradient is attacked by climb unless another method is given.
        options: options of `drivesem attack`, with underscores (`OPTIONS`).

    Raises:
        UsageError: a wrong option or detector.
        SceneError: the scene cannot be used.
        DetectorError: the detector fails.
    """
    for name in options:
        if name not in OPTIONS:
            raise UsageError("attack", f"options among {', '.join(OPTIONS)}", name)
    source = scene if isinstance(scene, Scene) else Scene(scene)
    try:
        config = AttackConfig(detector=detector if isinstance(detector, str) else detector.name, **options)
        config.check()
        check_device(config.device)
        if not isinstance(detector, str):
            _check_loaded_detector(detector, options)
        loaded = load_named_detector(config) if isinstance(detector, str) else detector
        worker = AttackWorker.from_config(with_gradient_free_fallback(config, loaded), loaded)
    except UsageError as error:
        raise UsageError(_argument(error.field), _argument(error.expected), error.actual) from error
    attacked = worker.attack_scene(source.name, source.ir)
    changed = attacked.rendered.scene
    return Counterexample(replace(source, ir=changed, notes=()), frame_result(attacked, changed), attacked)


def _check_loaded_detector(detector: Predictor, options: Mapping[str, Any]) -> None:
    """Raise UsageError for an option that controls how a detector is loaded."""
    for name in ("precision", "tiles"):
        if name in options:
            raise UsageError(name, "none with a loaded detector", repr(options[name]))
    own = detector_device(detector)
    device = torch.device(options.get("device", own))
    if device.type != own.type or device.index not in (None, own.index):
        raise UsageError("device", f"that of the loaded detector: {own}", repr(options["device"]))


def _argument(text: str) -> str:
    """Option names as Python arguments: `--t-star` becomes t_star."""
    return re.sub(r"--([a-z][a-z-]*)", lambda flag: flag[1].replace("-", "_"), text)
