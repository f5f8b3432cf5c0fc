"""Gradient of each object's margin, and its slope over one attack step and over many.

Both are seen in the same draws of a camera's small changes, both sides of a difference in the same one. All
objects move at once, each to a side of its own that chance decides in each draw: what others do averages out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.methods.base import MarginOracle
from drivesem.attacks.space import Parameter, ParameterSpace
from scene_ir import ffd
from scene_ir.errors import RangeError

STEPS = (1, 4, 16)
"""Half the width of differences, in steps of an attack."""
SMOOTHING = 4.0
"""Standard deviation of theta for the gradient that is averaged over places, in steps of an attack."""
LATTICE_DIRECTIONS = 4
"""Random directions in which all of a mesh's lattice offsets go a step up or down, as in a sign step."""
_LEAST_MOVE = 0.5
"""Share of the way to the bounds, or of the steps, that must be left of a difference after its projection."""


@dataclass(frozen=True, slots=True)
class SlopeProbe:
    """Directions of theta that are tried at once."""

    row: str
    """Of the table that they belong to."""
    name: str
    """Of the direction."""
    directions: Tensor
    """One a step long for each object (N, D), or one for the scene (1, D)."""


@dataclass(frozen=True, slots=True)
class ProbeSlopes:
    """What is known of one object and one direction, in logits of the margin a step: for each of STEPS, a value
    for each draw; None where an object does not count on one of the sides, or cannot go there.
    """

    object: int
    distance_m: float
    """From the camera, on the ground."""
    row: str
    name: str
    point: tuple[tuple[float | None, ...], ...]
    """Slopes predicted by gradients between the same two sides: at theta0 and at points nearby."""
    smoothed: tuple[tuple[float | None, ...], ...]
    """Slopes predicted by gradients between the same two sides: at theta0 and at points nearby."""
    wide: tuple[tuple[float | None, ...], ...]
    """By differences."""


def probes(space: ParameterSpace, generator: torch.Generator) -> tuple[SlopeProbe, ...]:
    """All directions of a space: its coordinates one by one; of meshes some random ones and the low bends."""
    return tuple(probe for parameter in space.params for probe in _of(space, parameter, generator))


def measure(
    views: MarginOracle,
    feasible: FeasibleSet,
    tried: tuple[SlopeProbe, ...],
    draws: int,
    generator: torch.Generator,
) -> tuple[ProbeSlopes, ...]:
    """Of all objects that are found as photographed, around theta0. Costs for each draw 6 passes a probe, and two
    gradients an object. Raises RangeError for a gradient that is not finite.
    """
    space = feasible.space
    noise = [probe for probe in tried if probe.row != "mesh"]
    gradients = []
    for draw in range(draws):
        apart = sum(
            SMOOTHING
            * torch.randn(len(probe.directions), generator=generator).to(probe.directions)
            @ probe.directions
            for probe in noise
        )
        places = (space.theta0, feasible.project(space.theta0 + apart).theta)
        gradients.append(torch.stack([_gradients(views, space, place, draw) for place in places]))
    where = space.scene.objects.translation[:, [0, 2]].norm(dim=1).tolist()
    found: list[ProbeSlopes] = []
    for probe in tried:
        seen = torch.stack([_slopes(views, feasible, probe, steps, gradients, generator) for steps in STEPS])
        for i in views.counted_objects.nonzero()[:, 0].tolist():
            wide, point, smoothed = (
                tuple(tuple(None if math.isnan(one) else one for one in drawn) for drawn in kind.tolist())
                for kind in seen[..., i].permute(2, 0, 1)
            )
            found.append(ProbeSlopes(i, where[i], probe.row, probe.name, point, smoothed, wide))
    return tuple(found)


def _of(space: ParameterSpace, parameter: Parameter, generator: torch.Generator) -> Iterator[SlopeProbe]:
    spec, where = space.specs[parameter], space.blocks[parameter]
    size, step = spec.size, getattr(space.steps, parameter.value)
    row = parameter.value
    if parameter is Parameter.MESH:
        signs = 2.0 * torch.randint(2, (LATTICE_DIRECTIONS, size), generator=generator) - 1
        for k, direction in enumerate(signs):
            yield _probe(space, row, f"random {k}", where, step * direction)
        for k, direction in enumerate(ffd.low_order_modes()):
            yield _probe(space, "mesh, low bends", f"bend {k}", where, step * direction)
        return
    if parameter is Parameter.WEATHER:
        size = where.stop - where.start  # a budget may leave night out
    for k, direction in enumerate(torch.eye(size)):
        name = spec.names[k]
        yield _probe(space, name if parameter is Parameter.TRANSLATE else row, name, where, step * direction)


def _probe(space: ParameterSpace, row: str, name: str, where: slice, direction: Tensor) -> SlopeProbe:
    """One direction (size,) of a block, for each object that the block holds."""
    count = (where.stop - where.start) // len(direction)
    directions = space.theta0.new_zeros(count, space.dim)
    directions[:, where] = torch.block_diag(*[direction[None].to(directions)] * count)
    return SlopeProbe(row, name, directions)


def _gradients(views: MarginOracle, space: ParameterSpace, theta: Tensor, draw: int) -> Tensor:
    """Of each object's margin in a draw, at theta (D,): (N, D), 0 where one does not count."""
    found = theta.new_zeros(len(views.counted_objects), len(theta))
    for i in views.counted_objects.nonzero()[:, 0].tolist():
        weights = torch.zeros(len(views.counted_objects))
        weights[i] = 1.0
        _, found[i] = views.margins_and_grad(theta, draw, weights)
        bad = (~torch.isfinite(found[i])).nonzero()
        if len(bad):
            k = int(bad[0])
            raise RangeError(f"gradient of {space.name(k)}", "a finite value", float(found[i, k]))
    return found


def _slopes(
    views: MarginOracle,
    feasible: FeasibleSet,
    probe: SlopeProbe,
    steps: int,
    gradients: list[Tensor],
    generator: torch.Generator,
) -> Tensor:
    """Slopes (draws, 3, N) along a probe: by two-sided differences, and by both gradients (2, N, D) of each draw;
    nan where there is none.
    """
    space, directions = feasible.space, probe.directions
    found = []
    for draw, gradient in enumerate(gradients):
        signs = 2.0 * torch.randint(2, (len(directions),), generator=generator).to(directions) - 1
        far = steps * (signs[:, None] * directions).sum(dim=0)
        wanted_ends = [torch.minimum(torch.maximum(side * far, space.lower), space.upper) for side in (1, -1)]
        sides = [feasible.project(theta).theta for theta in wanted_ends]
        one, two = views.margins(sides, [draw, draw])
        # How far either went along each way, in steps: bounds and what is feasible may hold it back.
        length = (directions * directions).sum(dim=1)
        wanted, moved = (directions @ (ends[0] - ends[1]) / length for ends in (wanted_ends, sides))
        # Rain brings clouds along, a kerb turns a way aside: gradients are evaluated along the actual way.
        predicted = gradient @ (sides[0] - sides[1])
        slopes = torch.cat([(one - two).to(predicted)[None], predicted]) / moved
        there = (moved.abs() >= _LEAST_MOVE * wanted.abs()) & torch.isfinite(slopes[0])
        found.append(torch.where(there, slopes, torch.nan))
    return torch.stack(found)
