"""Records comparisons of a run with its files, and checks theta, the budget and feasibility of a frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from drivesem.attack.feasibility_check import ChangeLimits, check_limits, check_scene
from drivesem.attack.space import Budget, Parameter, ParameterSpace, Parametrisation
from drivesem.run.results import FrameResult
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.types import SceneIR

CHECKS: Mapping[str, str] = {
    "files": "all files of the frames, and metrics.json, have the hashes in manifest.json",
    "settings": "config.yaml has the settings in manifest.json",
    "pictures": "re-rendering the saved scene reproduces the three pictures",
    "detections": "the detector's detections in the three pictures are the recorded ones",
    "labels": "both label files and the recorded targets follow from the saved scene",
    "success": "lost objects, phantoms, and success in both label modes follow from labels and detections",
    "grades": "new draws reproduce each certificate; grades follow from their evidence",
    "feasibility": "the independent check agrees on the saved scene, and the change is within the budget",
    "theta": "theta.json, result.json and the saved scene hold the same change",
    "totals": "metrics.json follows from the frames and config.yaml",
}
"""Checks in the order of the report, and what holds if nothing differs."""


@dataclass(frozen=True, slots=True)
class Mismatch:
    """A difference between a run's result and its files."""

    check: str
    """Name of the check."""
    field: str
    """Such as `success_moved` or `objects[3].yaw`."""
    expected: str
    """Value in the run's result."""
    found: str
    """Value that follows from its files."""


@dataclass(slots=True)
class CheckLog:
    """Counts comparisons, and collects the differences."""

    compared: dict[str, int] = field(default_factory=dict)
    """Number of comparisons by check."""
    differences: list[Mismatch] = field(default_factory=list)
    """Values that differ."""

    def compare(self, check: str, name: str, expected: object, found: object) -> None:
        """Compare two values exactly.

        Args:
            check: Name of the check.
            name: Name of the value.
            expected: Value in the run's result.
            found: Value that follows from its files.
        """
        self.record(check, name, expected, found, agrees=expected == found)

    def compare_values(self, check: str, file: str, expected: Mapping[str, str], found: Mapping[str, str]) -> None:
        """Compare several values of a file exactly.

        Args:
            check: Name of the check.
            file: The file.
            expected: Values in the run's result, by name.
            found: Values that follow from its files.
        """
        for name, value in expected.items():
            self.compare(check, f"{file}: {name}", value, found.get(name))

    def record(self, check: str, name: str, expected: object, found: object, agrees: bool) -> None:
        """Record a comparison.

        Args:
            check: Name of the check.
            name: Name of the value.
            expected: Value in the run's result.
            found: Value that follows from its files.
            agrees: Whether they agree.
        """
        self.compared[check] = self.compared.get(check, 0) + 1
        if not agrees:
            self.differences.append(Mismatch(check, name, _format_value(expected), _format_value(found)))


def _format_value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "; ".join(_format_value(part) for part in value) or "none"
    return str(value)


THETA = "theta.json"
BOUND = 1e-6
"""Tolerance of theta's bounds, in its units: above float32 rounding, below a sign step."""
SCENE = 1e-5
"""Tolerance between the scene that theta gives and the saved one (m, rad, unit boxes, codes)."""
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
    """Compare theta of result.json with theta.json, the run's bounds, and the saved scene.

    Args:
        log: Records the comparisons.
        folder: The frame's folder.
        result: The frame's result.
        base: The scene before the change.
        perturbed: The saved scene.
        params: The run's parameters.
        budget: The run's budget.
        parametrisation: The run's parametrisation.

    Raises:
        FormatError: theta.json is damaged.
    """
    written = files.read_json(folder / THETA)
    if not isinstance(written, dict):
        raise FormatError(str(folder / THETA), "coordinates by name", type(written).__name__)
    log.compare("theta", f"{THETA}, names", [c.name for c in result.theta], list(written))
    for c in result.theta:
        if c.name in written:
            expected = {"value": c.value, "unit": c.unit, "bounds": [c.lower, c.upper], "display": c.display}
            log.compare("theta", f"{THETA}: {c.name}", expected, written[c.name])
    space = ParameterSpace(base, params, budget, parametrisation=parametrisation)
    names = [space.name(i) for i in range(space.dim)]
    log.compare("theta", "coordinates", [c.name for c in result.theta], names)
    if len(result.theta) != space.dim:
        return
    for c, lower, upper in zip(result.theta, space.lower.tolist(), space.upper.tolist(), strict=True):
        bounds, own = f"[{c.lower:g}, {c.upper:g}]", f"[{lower:g}, {upper:g}]"
        same = abs(c.lower - lower) <= BOUND and abs(c.upper - upper) <= BOUND
        log.record("theta", f"{c.name}, bounds", bounds, own, agrees=same)
        log.record(
            "feasibility",
            f"{c.name}, budget",
            f"a value in {own}",
            c.value,
            agrees=lower - BOUND <= c.value <= upper + BOUND,
        )
    theta = torch.tensor([c.value for c in result.theta]).to(space.theta0)
    _compare_scenes(log, space.apply(base, theta), perturbed)


def _compare_scenes(log: CheckLog, expected: SceneIR, found: SceneIR) -> None:
    """Compare the scene that theta gives with the saved one."""
    for name in _MOVED:
        rows = zip(getattr(expected.objects, name), getattr(found.objects, name), strict=True)
        for i, (one, other) in enumerate(rows):
            _compare_tensors(log, f"scene: objects[{i}].{name}", one, other)
    for name in _CODES:
        one, other = (getattr(scene.environment, name) for scene in (expected, found))
        _compare_tensors(log, f"scene: {name}", one, other)


def _compare_tensors(log: CheckLog, name: str, expected: Tensor, found: Tensor) -> None:
    differences = (expected - found).abs().reshape(-1)
    worst = int(differences.argmax())
    pair = [f"{float(side.reshape(-1)[worst]):.6g}" for side in (expected, found)]
    log.record("theta", name, *pair, agrees=float(differences[worst]) <= SCENE)


def check_feasibility(
    log: CheckLog, result: FrameResult, base: SceneIR, perturbed: SceneIR, reach: ChangeLimits
) -> None:
    """Repeat the independent feasibility check, and check the saved poses against the run's budget.

    Args:
        log: Records the comparisons.
        result: The frame's result.
        base: The scene before the change.
        perturbed: The saved scene.
        reach: Limits of the change.
    """
    found = check_scene(base, perturbed, result.checked_by, result.joint_weather, reach)
    log.compare("feasibility", "violations", list(result.violations), found)
    log.compare("feasibility", "budget", [], check_limits(base, perturbed, reach))
