"""A frame of a finished run as the objective that it was attacked by, from its folder alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from detectors.base import Predictor, device_of
from drivesem.attack.aims import Aim
from drivesem.attack.budgets import budget_of
from drivesem.attack.labels import Difficulty
from drivesem.attack.objective import Objective
from drivesem.attack.space import Parameter, ParameterSpace
from drivesem.config.commands import Attack
from drivesem.run.frame import RESULT
from drivesem.run.results import FrameResult
from scene_ir.errors import FormatError
from scene_ir.io import load_scene
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import scene_to


def rebuilt(
    result: FrameResult,
    folder: Path,
    attack: Attack,
    params: Sequence[Parameter],
    detector: Predictor,
) -> tuple[Objective, Tensor]:
    """The objective of a frame of a run, and the theta (D,) that was found, from the scene that was saved.

    The saved scene carries the one it was made from, so that neither the data set nor its de-rendering is needed.
    Raises FormatError.
    """
    scene = scene_to(load_scene(folder / "scene").at_rest(), None, device_of(detector))
    space = ParameterSpace(scene, params, budget_of(attack.budget), parametrisation=attack.parametrisation)
    if [c.name for c in result.theta] != [space.name(i) for i in range(space.dim)]:
        raise FormatError(str(folder / RESULT), f"theta of {', '.join(space.params)}", "other coordinates")
    theta = torch.tensor([c.value for c in result.theta]).to(space.theta0)
    compositor = Compositor(scene, RenderSettings(backend=attack.backend))
    labels, term = attack.objective_labels, attack.objective
    aim = Aim.of(attack.target_objects, attack.target_classes)
    difficulty = Difficulty(min_contrast=result.min_contrast)
    return Objective(
        compositor, space, detector, labels, term, difficulty, attack.t_star, aim, attack.whole, attack.keep_mb
    ), theta
