"""Parameters of an attack on an image classifier: vertices, pose and light of one object, as in the paper."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from itertools import accumulate, chain
from typing import Literal

import torch
from torch import Tensor

from drivesem.attacks.methods.base import ParameterGroup
from drivesem.attacks.theta import ParameterSpec, ProjectedTheta, ThetaSpace, lattice_names, select_parameters
from scene_ir import ffd
from scene_ir.errors import RangeError
from scene_ir.geometry import weld_vertices
from scene_ir.types import LATTICE, LATTICE_POINTS

VertexMotion = Literal["each", "smooth"]
"""each: every vertex position by itself, as in the paper; smooth: through a 4x4x4 lattice around the object."""
Turns = Literal["add", "compose"]
"""add: moves add Euler angles, about the object's centre; compose: each move turns the object as it stands, about the
mean of its vertices, which move along the axes of the view. As in the paper's text, and in its code."""
Lamp = Literal["white", "coloured"]
"""white: a white lamp near the camera; its strength and position change, and the environment; coloured: the lamp of the
paper's code, far in front of the object; its R, G and B change by themselves."""
LAMP_RGB = (20_000.0, 30_000.0, 20_000.0)
"""Intensity of the coloured lamp."""


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
_COLOURED = ParameterSpec(3, False, "share", ("light.red", "light.green", "light.blue"))
_ONE_TURN = ParameterSpec(1, False, "rad", ("pose.turn",))


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
    """Offsets of vertices (V, 3), in object sizes; along the axes of the view if turns compose."""
    angles: Tensor | None = None
    """Pitch, yaw, roll (3,), rad: added to the view's, or of the turn from the view if turns compose."""
    light: Tensor | None = None
    """Relative change of lamp and environment, and offset of the lamp's position, in object sizes (5,); of the coloured
    lamp's R, G and B (3,)."""
    turns: Turns = "add"
    """Meaning of offsets and angles."""
    next_turn: Tensor | None = None
    """Pitch, yaw, roll (3,), rad, of a last turn about the mean of the vertices as they stand."""


def rotation_matrix(angles: Tensor) -> Tensor:
    """Compute the rotation (3, 3) by pitch, yaw and roll (3,), rad.

    Yaw acts first, then pitch, then roll, about the camera's axes; with positive pitch the top is visible.
    """
    (cp, cy, cr), (sp, sy, sr) = angles.cos(), angles.sin()
    zero, one = torch.zeros_like(cp), torch.ones_like(cp)
    pitch = torch.stack([one, zero, zero, zero, cp, -sp, zero, sp, cp]).reshape(3, 3)
    yaw = torch.stack([cy, zero, sy, zero, one, zero, -sy, zero, cy]).reshape(3, 3)
    roll = torch.stack([cr, -sr, zero, sr, cr, zero, zero, zero, one]).reshape(3, 3)
    return roll @ pitch @ yaw


class ObjectSpace(ThetaSpace[ClassifyParameter]):
    """theta (D,) of one object; 0 is the unchanged object. Vertices at one position move together."""

    def __init__(
        self,
        vertices: Tensor,
        params: Sequence[ClassifyParameter],
        steps: ParameterAmounts,
        bounds: ParameterAmounts = WIDEST_BOUNDS,
        motion: VertexMotion = "each",
        *,
        turns: Turns = "add",
        one_turn: bool = False,
        lamp: Lamp = "white",
        parts: Tensor | None = None,
    ) -> None:
        """
        Args:
            vertices: Vertices (V, 3), y up.
            params: The attacked parameters.
            steps: Step sizes.
            bounds: Bounds in either direction.
            motion: Motion of vertices.
            turns: How turns add up.
            one_turn: Whether pitch, yaw and roll are one number.
            lamp: The lamp that changes.
            parts: Mesh part of each vertex (V,) int64, if each part is a group of its own; a part without a finite
                gradient stays. None: all vertices are one group.
        """
        specs = {
            ClassifyParameter.VERTEX: _vertex_parameter(motion),
            ClassifyParameter.POSE: _ONE_TURN if one_turn else _POSE,
            ClassifyParameter.LIGHTING: _COLOURED if lamp == "coloured" else _LIGHTING,
        }
        self._turns: Turns = turns
        self._position = weld_vertices(vertices)
        count = int(self._position.max()) + 1
        sizes = [count]
        if parts is not None:  # number the positions part by part; one of several parts counts to the first
            of_position = parts.new_full((count,), int(parts.max())).scatter_reduce(
                0, self._position, parts, "amin"
            )
            self._position = of_position.argsort(stable=True).argsort()[self._position]
            sizes = torch.unique(of_position, return_counts=True)[1].tolist()
        super().__init__(params, specs, count, vertices)
        self._parts: list[slice] = []
        """Coordinates of each mesh part."""
        if parts is not None and ClassifyParameter.VERTEX in self.blocks:
            ends = list(accumulate(3 * size for size in sizes))
            self._parts = [slice(low, high) for low, high in zip([0, *ends], ends, strict=False)]
        self._weights = None
        if motion == "smooth":
            low, high = vertices.aminmax(dim=0)
            unit = (vertices - low) / (high - low).clamp_min(1e-6) - vertices.new_tensor([0.5, 1.0, 0.5])
            self._weights = ffd.lattice_weights(unit)
        for parameter, where in self.blocks.items():
            bound = min(getattr(bounds, parameter.value), getattr(WIDEST_BOUNDS, parameter.value))
            self.step[where] = getattr(steps, parameter.value)
            self.lower[where], self.upper[where] = -bound, bound
        if lamp == "coloured" and ClassifyParameter.LIGHTING in self.blocks:
            # A step is equally many units of each colour; the amounts are shares of red.
            self.step[self.blocks[ClassifyParameter.LIGHTING]] *= LAMP_RGB[0] / vertices.new_tensor(LAMP_RGB)

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        """Groups of coordinates: gradients are normalised within each."""
        whole = {parameter: [where] for parameter, where in self.blocks.items()}
        whole |= {ClassifyParameter.VERTEX: self._parts} if self._parts else {}
        owners = {parameter: self.owner_count(parameter) for parameter in self.blocks}
        return tuple(
            ParameterGroup(str(p), where, owners[p] and (where.stop - where.start) // self.specs[p].size)
            for p, slices in whole.items()
            for where in slices
        )

    def change(self, theta: Tensor, move: Tensor | None = None) -> ObjectChange:
        """Convert theta (D,), optionally after a move (D,), to a change; differentiable. Raises as `check`."""
        self.check(theta)
        pose, composed = self.block(theta, ClassifyParameter.POSE), self._turns == "compose"
        next_turn = self.block(move, ClassifyParameter.POSE) if composed and move is not None else None
        theta = theta if move is None else theta + move
        offsets = self.block(theta, ClassifyParameter.VERTEX)
        angles = pose if composed else self.block(theta, ClassifyParameter.POSE)
        return ObjectChange(
            None if offsets is None else self._spread(offsets),
            None if angles is None else angles.expand(3),
            self.block(theta, ClassifyParameter.LIGHTING),
            self._turns,
            None if next_turn is None else next_turn.expand(3),
        )

    def _spread(self, offsets: Tensor) -> Tensor:
        """Offsets of all vertices (V, 3), from the block of a parameter."""
        if self._weights is not None:
            return self._weights @ offsets.reshape(LATTICE_POINTS, 3)
        return offsets.index_select(0, self._position)

    def advance(self, theta: Tensor, move: Tensor) -> Tensor:
        """theta (D,) after a move (D,): their sum, or that of `change(theta, move)` if turns compose."""
        moved = theta + move
        turn = self.block(move, ClassifyParameter.POSE)
        if self._turns == "add" or turn is None:
            return moved
        from scipy.spatial.transform import Rotation  # imported on use: it takes a third of a second to load

        rotation = rotation_matrix(turn)
        standing = rotation_matrix(theta[self.blocks[ClassifyParameter.POSE]])
        composed = (rotation @ standing).double().cpu().numpy()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # at a pitch of 90 degrees it chooses a roll of 0
            roll, pitch, yaw = Rotation.from_matrix(composed).as_euler("ZXY")
        moved[self.blocks[ClassifyParameter.POSE]] = moved.new_tensor([pitch, yaw, roll])
        offsets = self.block(moved, ClassifyParameter.VERTEX)
        if offsets is not None:  # they turn too, about their mean
            mean, rows = self._spread(offsets).mean(dim=0), offsets.reshape(-1, 3)
            moved[self.blocks[ClassifyParameter.VERTEX]] = (mean + (rows - mean) @ rotation.T).reshape(-1)
        return moved

    def settle_gradient(self, gradient: Tensor) -> Tensor:
        """A gradient (D,) with 0 for mesh parts where it is not finite. Raises RangeError for other coordinates."""
        for where in self._parts:
            if not bool(gradient[where].isfinite().all()):
                gradient[where] = 0
        self.check_gradient(gradient)
        return gradient

    def project(self, theta: Tensor) -> ProjectedTheta:
        """Clamp theta (D,) to its bounds."""
        inside = theta.clamp(self.lower, self.upper)
        names = (str(p) for p, where in self.blocks.items() if not torch.equal(inside[where], theta[where]))
        return ProjectedTheta(inside, tuple(f"{name}: bounds" for name in names))

    def physical(self, i: int, value: float) -> tuple[float, str] | None:
        parameter = self._locate(i)[0]
        if parameter is ClassifyParameter.POSE:
            return math.degrees(value), "deg"
        offset = self.name(i) in _LIGHTING.names[2:]
        return (100 * value, "%") if parameter is ClassifyParameter.LIGHTING and not offset else None

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
