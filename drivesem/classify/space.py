"""Parameters of an attack on an image classifier: vertices, pose and light of one object, as in the paper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from itertools import chain
from typing import Literal

import torch
from torch import Tensor

from drivesem.attacks.theta import ParameterSpec, ProjectedTheta, ThetaSpace, lattice_names, select_parameters
from scene_ir import ffd
from scene_ir.errors import RangeError
from scene_ir.geometry import weld_vertices
from scene_ir.types import LATTICE, LATTICE_POINTS

VertexMotion = Literal["each", "smooth"]
"""each: every vertex position by itself, as in the paper; smooth: through a 4x4x4 lattice around the object."""


class ClassifyParameter(StrEnum):
    """Attacked parameters, in the order of theta."""

    VERTEX = "vertex"
    POSE = "pose"
    LIGHTING = "lighting"


@dataclass(frozen=True, slots=True)
class ParameterAmounts:
    """One number per parameter: step sizes, or bounds in either direction (may be infinite)."""

    vertex: float
    """Along each axis, in object sizes (the longest side is 1)."""
    pose: float
    """Pitch, yaw and roll, rad."""
    lighting: float
    """Fraction of each light's strength; for the lamp's position, object sizes."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not value > 0:
                raise RangeError(entry.name, "a number above 0", value)


WIDEST_BOUNDS = ParameterAmounts(vertex=0.5, pose=math.pi, lighting=0.9)
"""Default bounds: half an object, half a turn, a tenth of the light."""

AXES = ("pose.pitch", "pose.yaw", "pose.roll")
_POSE = ParameterSpec(3, False, "rad", AXES)
_LIGHTING = ParameterSpec(
    5, False, "share", ("light.strength", "light.environment", "light.x", "light.y", "light.z")
)


def _vertex_parameter(motion: VertexMotion) -> ParameterSpec:
    if motion == "each":
        return ParameterSpec(3, True, "object sizes", ("x", "y", "z"), "vertices")
    return ParameterSpec(3 * LATTICE_POINTS, False, "object sizes", lattice_names("lattice", LATTICE))


def parse_parameters(text: str) -> tuple[ClassifyParameter, ...]:
    """Parse names such as "pose,vertex" into theta's order. Raises FormatError for unknown, repeated or no names."""
    return select_parameters(ClassifyParameter, (part for part in text.split(",") if part.strip()))


@dataclass(frozen=True, slots=True)
class ObjectChange:
    """A change of an object and its light; None for what is unchanged."""

    offsets: Tensor | None = None
    """Offsets of vertices (V, 3), in object sizes."""
    angles: Tensor | None = None
    """Added pitch, yaw, roll (3,), rad."""
    light: Tensor | None = None
    """Relative change of lamp and environment, and offset of the lamp's position, in object sizes (5,)."""


class ObjectSpace(ThetaSpace[ClassifyParameter]):
    """theta (D,) of one object; 0 is the unchanged object. Vertices at one position move together."""

    def __init__(
        self,
        vertices: Tensor,
        params: Sequence[ClassifyParameter],
        steps: ParameterAmounts,
        bounds: ParameterAmounts = WIDEST_BOUNDS,
        motion: VertexMotion = "each",
    ) -> None:
        """
        Args:
            vertices: Vertices (V, 3), y up.
            params: The attacked parameters.
            steps: Step sizes.
            bounds: Bounds in either direction.
            motion: Motion of vertices.
        """
        specs = {
            ClassifyParameter.VERTEX: _vertex_parameter(motion),
            ClassifyParameter.POSE: _POSE,
            ClassifyParameter.LIGHTING: _LIGHTING,
        }
        self._position = weld_vertices(vertices)
        super().__init__(params, specs, int(self._position.max()) + 1, vertices)
        self._weights = None
        if motion == "smooth":
            low, high = vertices.aminmax(dim=0)
            unit = (vertices - low) / (high - low).clamp_min(1e-6) - vertices.new_tensor([0.5, 1.0, 0.5])
            self._weights = ffd.lattice_weights(unit)
        for parameter, where in self.blocks.items():
            bound = min(getattr(bounds, parameter.value), getattr(WIDEST_BOUNDS, parameter.value))
            self.step[where] = getattr(steps, parameter.value)
            self.lower[where], self.upper[where] = -bound, bound

    def change(self, theta: Tensor) -> ObjectChange:
        """Convert theta (D,) to a change; differentiable. Raises as `check`."""
        self.check(theta)
        offsets = self.block(theta, ClassifyParameter.VERTEX)
        if offsets is not None and self._weights is not None:
            offsets = self._weights @ offsets.reshape(LATTICE_POINTS, 3)
        elif offsets is not None:
            offsets = offsets.index_select(0, self._position)
        return ObjectChange(
            offsets, self.block(theta, ClassifyParameter.POSE), self.block(theta, ClassifyParameter.LIGHTING)
        )

    def project(self, theta: Tensor) -> ProjectedTheta:
        """Clamp theta (D,) to its bounds."""
        inside = theta.clamp(self.lower, self.upper)
        names = (str(p) for p, where in self.blocks.items() if not torch.equal(inside[where], theta[where]))
        return ProjectedTheta(inside, tuple(f"{name}: bounds" for name in names))

    def physical(self, i: int, value: float) -> tuple[float, str] | None:
        parameter, _, k = self._locate(i)
        if parameter is ClassifyParameter.POSE:
            return math.degrees(value), "deg"
        return (100 * value, "%") if parameter is ClassifyParameter.LIGHTING and k < 2 else None

    def max_changes(self, theta: Tensor) -> dict[str, float]:
        """The largest change of each parameter in theta (D,), by name.

        For vertices it is the largest distance, in object sizes; for the others the largest coordinate.
        """
        largest = {p: theta[where].abs().amax() for p, where in self.blocks.items()}
        offsets = self.change(theta).offsets
        if offsets is not None:
            largest[ClassifyParameter.VERTEX] = offsets.norm(dim=1).amax()
        return {str(p): round(float(value), 6) for p, value in largest.items()}

    @property
    def scalar_coordinates(self) -> list[int]:
        """Indices of the coordinates of pose and light."""
        blocks = [range(self.dim)[where] for p, where in self.blocks.items() if p is not ClassifyParameter.VERTEX]
        return list(chain(*blocks))

    def format_scalars(self, theta: Tensor) -> dict[str, str]:
        """Format the coordinates of pose and light in theta (D,), by name."""
        return {self.name(i): self.display(i, float(theta[i])) for i in self.scalar_coordinates}
