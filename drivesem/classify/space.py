"""What an attack may move of an object before a classifier: its vertices, its pose, its light, as in the paper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from itertools import chain
from typing import Literal

import torch
from torch import Tensor

from drivesem.attack.theta import ParameterSpec, ProjectedTheta, ThetaSpace, lattice_names, select_parameters
from scene_ir import ffd
from scene_ir.errors import RangeError
from scene_ir.geometry import weld_vertices
from scene_ir.types import LATTICE, LATTICE_POINTS

Shape = Literal["each", "smooth"]
"""each: every place at which vertices are by itself, as in the paper; smooth: by a 4x4x4 lattice around all."""


class Moved(StrEnum):
    """What can be moved, in the order in which theta holds it."""

    VERTEX = "vertex"
    POSE = "pose"
    LIGHTING = "lighting"


@dataclass(frozen=True, slots=True)
class Amounts:
    """A number for each parameter: the step alpha, or how far it may go either way (inf: as far as it likes).
    vertex: object sizes (its longest side is 1); pose: rad; lighting: shares of the lights, and object sizes of
    where the lamp is.
    """

    vertex: float
    pose: float
    lighting: float

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not value > 0:
                raise RangeError(entry.name, "a number above 0", value)


FARTHEST = Amounts(vertex=0.5, pose=math.pi, lighting=0.9)
"""Where no bound is asked for: half an object, all the way round, hardly any light."""

AXES = ("pose.pitch", "pose.yaw", "pose.roll")
_POSE = ParameterSpec(3, False, "rad", AXES)
_LIGHTING = ParameterSpec(
    5, False, "share", ("light.strength", "light.environment", "light.x", "light.y", "light.z")
)


def _vertex_spec(shape: Shape) -> ParameterSpec:
    if shape == "each":
        return ParameterSpec(3, True, "object sizes", ("x", "y", "z"), "vertices")
    return ParameterSpec(3 * LATTICE_POINTS, False, "object sizes", lattice_names("lattice", LATTICE))


def moved_of(text: str) -> tuple[Moved, ...]:
    """Parameters of "pose,vertex", in theta's order. Raises FormatError on an unknown, a repeated or no name."""
    return select_parameters(Moved, (part for part in text.split(",") if part.strip()))


@dataclass(frozen=True, slots=True)
class Change:
    """theta as it acts. offsets (V, 3): of vertices; angles (3,): pitch, yaw, roll, rad; light (5,): strength and
    environment, shares, and the lamp's place; None where held.
    """

    offsets: Tensor | None = None
    angles: Tensor | None = None
    light: Tensor | None = None


class ObjectSpace(ThetaSpace[Moved]):
    """theta (D,) of one object with vertices (V, 3); 0 is the object as it is. reach: bounds either way. Vertices
    at one place move as one, so that surfaces which meet there do not come apart.
    """

    def __init__(
        self,
        vertices: Tensor,
        params: Sequence[Moved],
        steps: Amounts,
        reach: Amounts = FARTHEST,
        shape: Shape = "each",
    ) -> None:
        specs = {Moved.VERTEX: _vertex_spec(shape), Moved.POSE: _POSE, Moved.LIGHTING: _LIGHTING}
        self._place = weld_vertices(vertices)
        super().__init__(params, specs, int(self._place.max()) + 1, vertices)
        self._weights = None
        if shape == "smooth":
            low, high = vertices.aminmax(dim=0)
            unit = (vertices - low) / (high - low).clamp_min(1e-6) - vertices.new_tensor([0.5, 1.0, 0.5])
            self._weights = ffd.lattice_weights(unit)
        for parameter, where in self.blocks.items():
            bound = min(getattr(reach, parameter.value), getattr(FARTHEST, parameter.value))
            self.step[where] = getattr(steps, parameter.value)
            self.lower[where], self.upper[where] = -bound, bound

    def change(self, theta: Tensor) -> Change:
        """What theta (D,) does; differentiable. Raises as `check`."""
        self.check(theta)
        offsets = self.block(theta, Moved.VERTEX)
        if offsets is not None and self._weights is not None:
            offsets = self._weights @ offsets.reshape(LATTICE_POINTS, 3)
        elif offsets is not None:
            offsets = offsets.index_select(0, self._place)
        return Change(offsets, self.block(theta, Moved.POSE), self.block(theta, Moved.LIGHTING))

    def project(self, theta: Tensor) -> ProjectedTheta:
        """theta (D,) within its bounds."""
        inside = theta.clamp(self.lower, self.upper)
        names = (str(p) for p, where in self.blocks.items() if not torch.equal(inside[where], theta[where]))
        return ProjectedTheta(inside, tuple(f"{name}: bounds" for name in names))

    def physical(self, i: int, value: float) -> tuple[float, str] | None:
        parameter, _, k = self._locate(i)
        if parameter is Moved.POSE:
            return math.degrees(value), "deg"
        return (100 * value, "%") if parameter is Moved.LIGHTING and k < 2 else None

    def sizes(self, theta: Tensor) -> dict[str, float]:
        """The largest change of each parameter in theta (D,), by name: how far the farthest vertex goes, in object
        sizes; of the others the largest coordinate, in theta's units.
        """
        most = {p: theta[where].abs().amax() for p, where in self.blocks.items()}
        offsets = self.change(theta).offsets
        if offsets is not None:
            most[Moved.VERTEX] = offsets.norm(dim=1).amax()
        return {str(p): round(float(value), 6) for p, value in most.items()}

    @property
    def singles(self) -> list[int]:
        """The coordinates of pose and light."""
        blocks = [range(self.dim)[where] for p, where in self.blocks.items() if p is not Moved.VERTEX]
        return list(chain(*blocks))

    def few(self, theta: Tensor) -> dict[str, str]:
        """theta (D,) for people: each coordinate that is not one of many, by name."""
        return {self.name(i): self.display(i, float(theta[i])) for i in self.singles}
