"""Decomposition gives the same bits for any number of torch threads."""

from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from scene_ir.render.sources import _extend_shadow
from scene_ir.render.surfaces import _thread_invariant_sigmoid, pixels_to_ground

RANDOM = torch.Generator()


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def by_threads(work: Callable[[], Tensor]) -> list[Tensor]:
    found = []
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        found.append(work())
    return found


@pytest.mark.parametrize("shape", [(94451,), (3, 41001), (0, 5), (2, 3, 4)])
def test_sigmoid_does_not_depend_on_threads(shape: tuple[int, ...]) -> None:
    values = 4 * torch.randn(shape, generator=RANDOM.manual_seed(0))
    one, *others = by_threads(lambda: _thread_invariant_sigmoid(values))
    assert all(torch.equal(one, other) for other in others)
    torch.testing.assert_close(one, torch.sigmoid(values), rtol=1e-6, atol=0)


def test_extended_shadow_does_not_depend_on_threads() -> None:
    dark = torch.rand(3, 171, 498, generator=RANDOM.manual_seed(0))
    expected = torch.rand(171, 498, generator=RANDOM)
    covered = torch.rand(171, 498, generator=RANDOM) > 0.6
    one, *others = by_threads(lambda: _extend_shadow(dark, expected, covered))
    assert all(torch.equal(one, other) for other in others)


def test_ground_points_do_not_depend_on_threads() -> None:
    down, across = torch.rand(2, 39988, generator=RANDOM.manual_seed(0)) * 300
    pixels = torch.stack([down * 3, across + 400], dim=1)
    camera = torch.tensor([[721.5, 0.0, 609.6], [0.0, 721.5, 172.9], [0.0, 0.0, 1.0]])
    ground = torch.tensor([0.01, -0.9998, 0.02, 1.65])
    placed = (torch.zeros(3), torch.tensor([1.0, 1.65, 9.0]), torch.tensor(0.3), ground)
    one, *others = by_threads(lambda: pixels_to_ground(pixels, camera.inverse(), *placed) + 0.0)  # type: ignore[operator]
    assert all(torch.equal(one, other) for other in others)


@pytest.mark.slow
def test_a_demo_scene_does_not_depend_on_threads() -> None:
    from drivesem.synth.demo import demo_scene

    for index in (0, 1):
        one, *others = by_threads(
            lambda index=index: torch.cat(
                [
                    part.values.flatten()
                    for source in demo_scene(0, index).objects.source or ()
                    for part in (source.foreground, source.shadow)
                    if part is not None
                ]
            )
        )
        assert all(torch.equal(one, other) for other in others)
