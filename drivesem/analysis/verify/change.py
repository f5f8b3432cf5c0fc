"""The change of one frame: theta in its three places, the budget, and what the second check says of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from drivesem.analysis.verify.differences import CheckLog
from drivesem.attack.feasibility_check import Reach, check_reach, check_scene
from drivesem.attack.space import Budget, Parameter, ParameterSpace, Parametrisation
from drivesem.run.results import FrameResult
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.types import SceneIR

THETA = "theta.json"
BOUND = 1e-6
"""Slack of theta's bounds, in its units: far above float32's rounding at their size, far below a sign step."""
SCENE = 1e-5
"""By how much the scene that theta gives may differ from the saved one (m, rad, unit boxes, codes)."""
_MOVED = ("translation", "yaw", "ffd", "size_lhw", "texture_code")
_CODES = ("weather", "foliage", "light")


def check_change(
    log: CheckLog,
    folder: Path,
    result: FrameResult,
    base: SceneIR,
    perturbed: SceneIR,
    params: Sequence[Parameter],
    budget: Budget,
    parametrisation: Parametrisation,
) -> None:
    """theta of result.json against theta.json, the run's bounds, and the saved scene. Raises FormatError where
    theta.json is damaged.
    """
    written = files.read_json(folder / THETA)
    if not isinstance(written, dict):
        raise FormatError(str(folder / THETA), "coordinates by name", type(written).__name__)
    log.same("theta", f"{THETA}, names", [c.name for c in result.theta], list(written))
    for c in result.theta:
        if c.name in written:
            expected = {"value": c.value, "unit": c.unit, "bounds": [c.lower, c.upper], "display": c.display}
            log.same("theta", f"{THETA}: {c.name}", expected, written[c.name])
    space = ParameterSpace(base, params, budget, parametrisation=parametrisation)
    names = [space.name(i) for i in range(space.dim)]
    log.same("theta", "coordinates", [c.name for c in result.theta], names)
    if len(result.theta) != space.dim:
        return
    for c, lower, upper in zip(result.theta, space.lower.tolist(), space.upper.tolist(), strict=True):
        bounds, own = f"[{c.lower:g}, {c.upper:g}]", f"[{lower:g}, {upper:g}]"
        same = abs(c.lower - lower) <= BOUND and abs(c.upper - upper) <= BOUND
        log.told("theta", f"{c.name}, bounds", bounds, own, agrees=same)
        log.told(
            "feasibility",
            f"{c.name}, budget",
            f"a value in {own}",
            c.value,
            agrees=lower - BOUND <= c.value <= upper + BOUND,
        )
    theta = torch.tensor([c.value for c in result.theta]).to(space.theta0)
    _compare_scenes(log, space.apply(base, theta), perturbed)


def _compare_scenes(log: CheckLog, expected: SceneIR, found: SceneIR) -> None:
    """The scene that theta gives against the saved one."""
    for name in _MOVED:
        rows = zip(getattr(expected.objects, name), getattr(found.objects, name), strict=True)
        for i, (one, other) in enumerate(rows):
            _compare_tensors(log, f"scene: objects[{i}].{name}", one, other)
    for name in _CODES:
        one, other = (getattr(scene.environment, name) for scene in (expected, found))
        _compare_tensors(log, f"scene: {name}", one, other)


def _compare_tensors(log: CheckLog, name: str, expected: Tensor, found: Tensor) -> None:
    apart = (expected - found).abs().reshape(-1)
    worst = int(apart.argmax())
    pair = [f"{float(side.reshape(-1)[worst]):.6g}" for side in (expected, found)]
    log.told("theta", name, *pair, agrees=float(apart[worst]) <= SCENE)


def check_feasibility(log: CheckLog, result: FrameResult, base: SceneIR, perturbed: SceneIR, reach: Reach) -> None:
    """What the second check finds in the saved scene, and whether the poses in it lie within the run's budget."""
    found = check_scene(base, perturbed, result.checked_by, result.joint_weather, reach)
    log.same("feasibility", "violations", list(result.violations), found)
    log.same("feasibility", "budget", [], check_reach(base, perturbed, reach))
