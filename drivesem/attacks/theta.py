"""theta, the flat vector of parameters that an attack moves: its blocks, and each coordinate's name, unit and
bounds.

Subclasses define the parameters and their effect: `drivesem.attacks.space` for street scenes,
`drivesem.classify.space` for objects in front of a classifier.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import product
from typing import Generic, TypeVar

import numpy as np
from torch import Tensor

from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.types import check_finite

P = TypeVar("P", bound=StrEnum)


def select_parameters(kind: type[P], names: Iterable[str]) -> tuple[P, ...]:
    """Parameters by name, in theta's order. Raises FormatError on an unknown, a repeated or no parameter."""
    known = [str(p) for p in kind]
    selected = [name.strip() for name in names]
    for name in selected:
        if name not in known:
            raise FormatError("params", f"names among {', '.join(known)}", repr(name))
    if not selected:
        raise FormatError("params", f"at least one of {', '.join(known)}", "none")
    if len(set(selected)) != len(selected):
        raise FormatError("params", "each parameter once", ",".join(selected))
    return tuple(p for p in kind if p.value in selected)


def lattice_names(word: str, shape: Sequence[int]) -> tuple[str, ...]:
    """Names of the coordinates of a lattice's points, such as `ffd[0,3,1].x`."""
    points = product(*map(range, shape))
    return tuple(f"{word}[{i},{j},{k}].{axis}" for i, j, k in points for axis in "xyz")


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """Facts about one parameter."""

    size: int
    """Number of coordinates, per owner or per scene."""
    per_object: bool
    """Whether each owner has its own."""
    unit: str
    """Unit of theta, for people."""
    names: tuple[str, ...]
    """Names of the coordinates, after `objects[i].` if they belong to an owner."""
    owner: str = "objects"
    """Name of the owners."""


@dataclass(frozen=True, slots=True)
class ProjectedTheta:
    """theta projected onto the feasible set."""

    theta: Tensor
    """(D,)."""
    active: tuple[str, ...]
    """Active constraints, such as `objects[3]: collision`."""


class ThetaSpace(ABC, Generic[P]):
    """The layout of theta (D,): blocks in the order of `params`; a block of a parameter with owners is (N, size),
    row-major.

    Attributes:
        theta0: (D,), where attacks start.
        lower: (D,), lower bounds.
        upper: (D,), upper bounds.
        step: (D,), the step alpha of each coordinate.
        count: N, number of owners.
    """

    def __init__(self, params: Sequence[P], specs: Mapping[P, ParameterSpec], count: int, like: Tensor) -> None:
        """Lay out the blocks.

        Args:
            params: the parameters, in theta's order.
            specs: facts about each parameter.
            count: number of owners.
            like: its dtype and device are theta's.
        """
        self.params = tuple(params)
        self.specs = specs
        self.count = count
        self._slices: dict[P, slice] = {}
        start = 0
        for parameter in self.params:
            spec = specs[parameter]
            end = start + spec.size * (count if spec.per_object else 1)
            self._slices[parameter] = slice(start, end)
            start = end
        self.dim = start
        self.theta0, self.lower, self.upper, self.step = (like.new_zeros(self.dim) for _ in range(4))

    @property
    def blocks(self) -> Mapping[P, slice]:
        """The slice of theta of each parameter, in theta's order."""
        return self._slices

    def owner_count(self, parameter: P) -> int:
        """Number of owners of a parameter; 0 for one of the scene."""
        return self.count if self.specs[parameter].per_object else 0

    def name(self, i: int) -> str:
        """The name of coordinate `i`, such as `objects[3].yaw`."""
        parameter, owner, k = self._locate(i)
        spec = self.specs[parameter]
        return f"{spec.owner}[{owner}].{spec.names[k]}" if spec.per_object else spec.names[k]

    def describe(self, i: int) -> str:
        """Name, unit and bounds of coordinate `i`: `objects[3].yaw, rad, [-0.35, 0.35]`."""
        unit = self.specs[self._locate(i)[0]].unit
        return f"{self.name(i)}, {unit}, [{float(self.lower[i]):g}, {float(self.upper[i]):g}]"

    def block(self, theta: Tensor, parameter: P) -> Tensor | None:
        """The block of a parameter, a view of theta (D,): (N, size), or (size,) for one of the scene; None where
        it is fixed.
        """
        where, spec = self._slices.get(parameter), self.specs[parameter]
        if where is None:
            return None
        return theta[where].reshape((self.count, spec.size) if spec.per_object else (spec.size,))

    def check(self, theta: Tensor) -> None:
        """Raise ShapeError for another shape than (D,), RangeError naming a coordinate that is not finite."""
        if tuple(theta.shape) != (self.dim,):
            raise ShapeError("theta", f"shape ({self.dim},)", tuple(theta.shape))
        values = theta.detach().cpu().numpy()
        if not np.isfinite(values).all():
            i = int(np.flatnonzero(~np.isfinite(values))[0])
            raise RangeError(f"theta: {self.name(i)}", "a finite value", float(values[i]))

    def check_gradient(self, gradient: Tensor) -> None:
        """Raise RangeError naming a coordinate of a gradient (D,) that is not finite."""
        values = gradient.detach().cpu().numpy()
        if not np.isfinite(values).all():
            i = int(np.flatnonzero(~np.isfinite(values))[0])
            raise RangeError(f"gradient of {self.name(i)}", "a finite value", float(values[i]))

    @abstractmethod
    def physical(self, i: int, value: float) -> tuple[float, str] | None:
        """`value` of coordinate `i` in a common unit, such as "m" or "deg"; None for a bare number."""

    def display(self, i: int, value: float) -> str:
        """`value` of coordinate `i` for people: `0.21 m`, `5.7 deg`, `3 %`, `0.25`."""
        physical = self.physical(i, value)
        return f"{value:.3g}" if physical is None else f"{physical[0]:.3g} {physical[1]}"

    def theta_by_name(self, theta: Tensor) -> dict[str, dict[str, float | str]]:
        """theta (D,) for people: name -> value, unit, lower, upper, and display in metres, degrees or percent."""
        if tuple(theta.shape) != (self.dim,):
            raise ShapeError("theta", f"shape ({self.dim},)", tuple(theta.shape))
        check_finite("theta", theta)
        lower, upper = self.lower.tolist(), self.upper.tolist()
        return {
            self.name(i): {
                "value": value,
                "unit": self.specs[self._locate(i)[0]].unit,
                "lower": lower[i],
                "upper": upper[i],
                "display": self.display(i, value),
            }
            for i, value in enumerate(theta.detach().cpu().tolist())
        }

    def _locate(self, i: int) -> tuple[P, int, int]:
        """Parameter, owner (0 for one of the scene) and index within them of coordinate `i`."""
        if not 0 <= i < self.dim:
            raise RangeError("theta coordinate", f"an index in [0, {self.dim})", i)
        for parameter, where in self._slices.items():
            if i < where.stop:
                owner, k = divmod(i - where.start, self.specs[parameter].size)
                return parameter, owner, k
        raise AssertionError("the slices cover theta")
