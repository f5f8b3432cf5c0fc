"""theta, the flat vector of all that an attack moves: its blocks; the name, unit and bounds of each coordinate.

What the parameters are, and what they do to a scene, its subclasses say: of streets in `drivesem.attack.space`, of
objects before a classifier in `drivesem.classify.space`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import product
from typing import Generic, TypeVar

from torch import Tensor

from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.types import check_finite

P = TypeVar("P", bound=StrEnum)


def parameters_of(kind: type[P], names: Iterable[str]) -> tuple[P, ...]:
    """Parameters by name, in theta's order. Raises FormatError on an unknown, a repeated or no parameter."""
    known = [str(p) for p in kind]
    asked = [name.strip() for name in names]
    for name in asked:
        if name not in known:
            raise FormatError("params", f"names among {', '.join(known)}", repr(name))
    if not asked:
        raise FormatError("params", f"at least one of {', '.join(known)}", "none")
    if len(set(asked)) != len(asked):
        raise FormatError("params", "each parameter once", ",".join(asked))
    return tuple(p for p in kind if p.value in asked)


def lattice_names(word: str, shape: Sequence[int]) -> tuple[str, ...]:
    """Names of the coordinates of a lattice's points, such as `ffd[0,3,1].x`."""
    points = product(*map(range, shape))
    return tuple(f"{word}[{i},{j},{k}].{axis}" for i, j, k in points for axis in "xyz")


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """Facts of one parameter. size: coordinates an owner (`per_object`) or a scene; unit: of theta, for people;
    names: of the coordinates, after `objects[i].` where it belongs to an owner; owner: the word for these.
    """

    size: int
    per_object: bool
    unit: str
    names: tuple[str, ...]
    owner: str = "objects"


@dataclass(frozen=True, slots=True)
class Projected:
    """theta (D,) in the feasible set, and the constraints that held it back, such as `objects[3]: collision`."""

    theta: Tensor
    active: tuple[str, ...]


class ThetaSpace(ABC, Generic[P]):
    """The layout of theta (D,): blocks follow each other in the order of `params`; a block of a parameter with
    owners is (N, size), row-major. theta0, lower, upper, step (D,): where it starts, its bounds, the step alpha of
    each coordinate; they have `like`'s dtype and device. count: N, how many owners there are.
    """

    def __init__(self, params: Sequence[P], specs: Mapping[P, ParameterSpec], count: int, like: Tensor) -> None:
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
        """Where theta holds each of its parameters, in its order."""
        return self._slices

    def owners(self, parameter: P) -> int:
        """How many owners a parameter has: 0 where it is a scene's."""
        return self.count if self.specs[parameter].per_object else 0

    def slice_of(self, parameter: P) -> slice | None:
        """Where theta holds `parameter`, or None where it is held."""
        return self._slices.get(parameter)

    def name(self, i: int) -> str:
        """The name of coordinate `i`, for instance `objects[3].yaw`."""
        parameter, owner, k = self._locate(i)
        spec = self.specs[parameter]
        return f"{spec.owner}[{owner}].{spec.names[k]}" if spec.per_object else spec.names[k]

    def describe(self, i: int) -> str:
        """Name, unit and bounds of coordinate `i`: `objects[3].yaw, rad, [-0.35, 0.35]`."""
        unit = self.specs[self._locate(i)[0]].unit
        return f"{self.name(i)}, {unit}, [{float(self.lower[i]):g}, {float(self.upper[i]):g}]"

    def block(self, theta: Tensor, parameter: P) -> Tensor | None:
        """theta's (D,) block of a parameter, a view of it: (N, size), or (size,) of a scene; None where it is
        held.
        """
        where, spec = self._slices.get(parameter), self.specs[parameter]
        if where is None:
            return None
        return theta[where].reshape((self.count, spec.size) if spec.per_object else (spec.size,))

    def check(self, theta: Tensor) -> None:
        """ShapeError for another shape than (D,), RangeError naming a coordinate that is not finite."""
        if tuple(theta.shape) != (self.dim,):
            raise ShapeError("theta", f"shape ({self.dim},)", tuple(theta.shape))
        finite = theta.isfinite()
        if not bool(finite.all()):
            i = int((~finite).nonzero()[0])
            raise RangeError(f"theta: {self.name(i)}", "a finite value", float(theta[i]))

    def check_gradient(self, gradient: Tensor) -> None:
        """RangeError naming the coordinate of a gradient (D,) that is not finite."""
        bad = (~gradient.isfinite()).nonzero()
        if len(bad):
            i = int(bad[0])
            raise RangeError(f"gradient of {self.name(i)}", "a finite value", float(gradient[i]))

    @abstractmethod
    def physical(self, i: int, value: float) -> tuple[float, str] | None:
        """`value` of coordinate `i` in a unit that people use, such as "m" or "deg"; None for a bare number."""

    def display(self, i: int, value: float) -> str:
        """`value` of coordinate `i` as people write it: `0.21 m`, `5.7 deg`, `3 %`, `0.25`."""
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
        """Parameter, owner (0 for a scene's parameter) and place within them of coordinate `i`."""
        if not 0 <= i < self.dim:
            raise RangeError("theta coordinate", f"an index in [0, {self.dim})", i)
        for parameter, where in self._slices.items():
            if i < where.stop:
                owner, k = divmod(i - where.start, self.specs[parameter].size)
                return parameter, owner, k
        raise AssertionError("the slices cover theta")
