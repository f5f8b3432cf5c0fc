"""Parts of a change theta that are weighed against each other: parameters, cars, and one parameter of one car."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from drivesem.attack.space import Parameter, ParameterSpace

Kind = Literal["parameter", "object"]
SURROUNDINGS = "surroundings"
"""The player beside the cars that holds what belongs to none: weather and foliage."""


@dataclass(frozen=True, slots=True)
class Player:
    """A part of theta. mask (D,) bool; name such as `rotate` or `objects[2]`."""

    kind: Kind
    name: str
    mask: Tensor


@dataclass(frozen=True, slots=True)
class Cell:
    """One parameter of one car, or of the scene (object None), with its coordinates in theta."""

    parameter: Parameter
    object: int | None
    where: slice

    @property
    def name(self) -> str:
        """Such as `objects[2].rotate` or `weather`."""
        return str(self.parameter) if self.object is None else f"{object_name(self.object)}.{self.parameter}"


@dataclass(frozen=True, slots=True)
class Size:
    """How far one cell goes. value in `unit`: translate, metres on the ground; rotate, degrees; mesh, metres of
    the lattice point that goes farthest; codes, the largest. steps: the longest way of a coordinate, in alpha.
    """

    parameter: str
    object: int | None
    value: float
    unit: str
    steps: float

    @property
    def owner(self) -> str:
        """The player of the second team that has this cell."""
        return SURROUNDINGS if self.object is None else object_name(self.object)


def object_name(index: int) -> str:
    """As theta's coordinates are called."""
    return f"objects[{index}]"


def cells(space: ParameterSpace) -> Iterator[Cell]:
    """All of theta, in its order."""
    for parameter in space.params:
        where = space.slice_of(parameter)
        assert where is not None
        spec = space.specs[parameter]
        if not spec.per_object:
            yield Cell(parameter, None, where)
            continue
        for i in range(space.count):
            start = where.start + i * spec.size
            yield Cell(parameter, i, slice(start, start + spec.size))


def parameters(space: ParameterSpace, theta: Tensor) -> list[Player]:
    """The parameters that theta (D,) moves."""
    masks: dict[str, Tensor] = {}
    for cell in _moved(space, theta):
        _mask(masks, str(cell.parameter), theta)[cell.where] = True
    return [Player("parameter", name, mask) for name, mask in masks.items()]


def objects(space: ParameterSpace, theta: Tensor) -> list[Player]:
    """The cars that theta (D,) moves, in their order, and the surroundings where they change."""
    masks: dict[str, Tensor] = {}
    for cell in sorted(_moved(space, theta), key=lambda cell: math.inf if cell.object is None else cell.object):
        name = SURROUNDINGS if cell.object is None else object_name(cell.object)
        _mask(masks, name, theta)[cell.where] = True
    return [Player("object", name, mask) for name, mask in masks.items()]


def sizes(space: ParameterSpace, theta: Tensor) -> list[Size]:
    """Of each cell that theta (D,) moves."""
    return [_size(space, theta, cell) for cell in _moved(space, theta)]


def _moved(space: ParameterSpace, theta: Tensor) -> list[Cell]:
    return [cell for cell in cells(space) if bool(theta[cell.where].any())]


def _mask(masks: dict[str, Tensor], name: str, theta: Tensor) -> Tensor:
    return masks.setdefault(name, torch.zeros_like(theta, dtype=torch.bool))


def _size(space: ParameterSpace, theta: Tensor, cell: Cell) -> Size:
    indices = range(cell.where.start, cell.where.stop)
    values, units = [], set()
    for i, value in zip(indices, theta[cell.where].tolist(), strict=True):
        physical = space.physical(i, value)
        values.append(value if physical is None else physical[0])
        units.add("code" if physical is None else physical[1])
    (unit,) = units
    if cell.parameter is Parameter.TRANSLATE and space.parametrisation == "ground":
        value = math.hypot(*values)
    elif cell.parameter is Parameter.MESH:
        value = max(math.hypot(*values[k : k + 3]) for k in range(0, len(values), 3))
    else:
        value = max(map(abs, values))
    # A coordinate that is held has no step, and stays at 0.
    alpha = space.step[cell.where].clamp_min(torch.finfo(space.step.dtype).tiny)
    steps = float((theta[cell.where] / alpha).abs().max())
    return Size(str(cell.parameter), cell.object, value, unit, steps)
