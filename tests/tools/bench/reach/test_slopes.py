"""Gradients and slopes of margins that are known in full."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.space import Parameter, ParameterSpace
from scene_ir import ffd
from scene_ir.errors import RangeError
from scene_ir.types import SceneIR
from tools.bench.reach.slopes import LATTICE_DIRECTIONS, STEPS, ProbeSlopes, SlopeProbe, measure, probes

PARAMS = ("color", "weather", "translate", "rotate", "mesh")


@dataclass
class Margins:
    """Margins of objects as a function of theta (D,); `draw` shifts them, and changes no slope."""

    of: Callable[[Tensor], Tensor]
    counted_objects: Tensor
    differentiable: bool = True
    passes: int = 0

    def margins(self, thetas: Sequence[Tensor], numbers: Sequence[int]) -> Tensor:
        return torch.stack([self.of(theta) + number for theta, number in zip(thetas, numbers, strict=True)])

    def margins_and_grad(self, theta: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        leaf = theta.clone().requires_grad_(True)
        margins = self.of(leaf)
        return margins.detach(), torch.autograd.grad((weights * margins).sum(), leaf)[0]


@pytest.fixture
def space(street: Callable[..., SceneIR]) -> ParameterSpace:
    return ParameterSpace(street(((-4.0, 12.0), (4.0, 30.0))), PARAMS)


def tried(space: ParameterSpace) -> tuple[SlopeProbe, ...]:
    return probes(space, torch.Generator().manual_seed(0))


def measured(
    space: ParameterSpace, of: Callable[[Tensor], Tensor], judged: tuple[bool, ...] = (True, True)
) -> dict[tuple[int, str], ProbeSlopes]:
    views = Margins(of, torch.tensor(judged))
    found = measure(views, FeasibleSet(space), tried(space), 3, torch.Generator().manual_seed(1))
    return {(one.object, one.name): one for one in found}


def test_a_probe_is_one_step_of_each_object_in_a_coordinate_of_its_own(space: ParameterSpace) -> None:
    names = [probe.name for probe in tried(space)]
    assert len(names) == len(set(names)) == 5 + 4 + 2 + 1 + LATTICE_DIRECTIONS + len(ffd.low_order_modes())
    for probe in tried(space):
        assert len(probe.directions) == (1 if probe.row == "weather" else 2)
        steps = probe.directions.abs() / space.step
        assert float(steps.max(dim=1).values.min()) == pytest.approx(1)
        assert not bool((steps[:-1] * steps[1:]).any())  # no coordinate of two objects
        owners = [{space.name(int(i)).split(".")[0] for i in way.nonzero()} for way in probe.directions]
        assert all(len(owner) == 1 for owner in owners)
    (yaw,) = [probe for probe in tried(space) if probe.name == "yaw"]
    assert space.name(int(yaw.directions[1].nonzero()[0])) == "objects[1].yaw"


def test_of_a_linear_margin_gradient_and_slopes_are_the_same(space: ParameterSpace) -> None:
    """Each object's own, whichever way the others go; also where a bound allows one side only (weather)."""
    generator = torch.Generator().manual_seed(2)
    slopes = torch.randn(2, space.dim, generator=generator)
    translate = space.blocks[Parameter.TRANSLATE]
    for i in range(2):  # of its own coordinates and of the scene's
        for parameter, where in space.blocks.items():
            if parameter is not Parameter.WEATHER:
                slopes[i, where].view(2, -1)[1 - i] = 0
    found = measured(space, lambda theta: slopes @ theta)
    one = found[1, "translate.across"]
    expected = float(slopes[1, translate.start + 3]) * 0.01
    for drawn in (*one.point, *one.smoothed):
        assert drawn == pytest.approx([expected] * 3, rel=1e-3)
    assert one.distance_m == pytest.approx(30.27, abs=0.1)
    for key, own in found.items():
        assert len(own.wide) == len(STEPS)
        for wide, point, smoothed in zip(own.wide, own.point, own.smoothed, strict=True):
            for slope, *said in zip(wide, point, smoothed, strict=True):
                assert (slope is None) == (said[0] is None), key
                assert slope is None or said == pytest.approx([slope] * 2, rel=1e-2, abs=1e-4), key


def test_what_does_not_count_has_no_slope(space: ParameterSpace) -> None:
    """Neither objects that are not judged, nor those that are hidden on a side; nor where one cannot go."""
    where = space.blocks[Parameter.ROTATE]

    def margins(theta: Tensor) -> Tensor:
        hidden = theta[where].abs() > 0.1
        return torch.where(hidden, torch.inf, theta[where])

    found = measured(space, margins, (False, True))
    assert {key[0] for key in found} == {1}
    yaw = found[1, "yaw"]
    assert None not in yaw.wide[0]
    assert set(yaw.wide[STEPS.index(16)]) == {None}
    # Offsets of 16 steps either way would tear any mesh: the bound on strain holds them back.
    assert set(found[1, "random 0"].wide[STEPS.index(16)]) == {None}


def test_a_gradient_that_is_no_number_is_named(space: ParameterSpace) -> None:
    where = space.blocks[Parameter.ROTATE]
    with pytest.raises(RangeError, match=r"gradient of objects\[0\].yaw: expected a finite value"):
        measured(space, lambda theta: (theta[where] * 0).sqrt())
