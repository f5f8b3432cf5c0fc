"""Drops on the windscreen."""

import pytest
import torch
from torch import Tensor

from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.render.windscreen import add_drops
from scene_ir.types import SceneIR


def _amount(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def test_none_at_0_and_more_with_the_amount_in_few_places() -> None:
    image = torch.rand(3, 180, 320, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.equal(add_drops(image, _amount(0.0)), image)
    shares = [float((add_drops(image, _amount(a)) != image).any(dim=0).double().mean()) for a in (0.2, 0.6, 1.0)]
    assert 0 < shares[0] < shares[1] < shares[2] < 0.06
    assert torch.equal(add_drops(image, _amount(0.6)), add_drops(image, _amount(0.6)))


def test_a_drop_shows_the_picture_upside_down_and_mirrored() -> None:
    rows, columns = torch.meshgrid(*(torch.linspace(0, 1, n).double() for n in (360, 640)), indexing="ij")
    for ramp, axis in ((rows, 0), (columns, 1)):
        image = ramp.expand(3, 360, 640)
        out = add_drops(image, _amount(1.0))[0]
        slopes, here = out.diff(dim=axis), (out != image[0]).narrow(axis, 1, out.shape[axis] - 1)
        plain = image[0].diff(dim=axis).mean()
        assert float(slopes[here].min()) < -5 * float(plain)


def test_gradients_are_those_of_differences() -> None:
    image = torch.rand(3, 60, 90, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    leaf, amount = image.requires_grad_(), _amount(0.55).requires_grad_()
    assert torch.autograd.gradcheck(lambda *inputs: add_drops(*inputs).sum(dim=0), (leaf, amount), fast_mode=True)


@pytest.mark.parametrize("backend", ["reference", "warp"])
def test_a_scene_keeps_its_objects_and_its_gradients_behind_drops(backend: str, photographed: SceneIR) -> None:
    compositor = Compositor(photographed, RenderSettings(backend=backend))  # type: ignore[arg-type]
    weather = torch.tensor([0.2, 0.3, 0.1, 0.4, 0.0, 0.0], dtype=torch.float64)
    plain = photographed.with_environment(weather=weather)
    wet = plain.with_environment(drops=torch.ones(1, dtype=torch.float64))
    before, after = compositor.render(plain), compositor.render(wet)
    assert torch.equal(before.object_id, after.object_id)
    expected = add_drops(before.image, before.image.new_tensor(1.0))
    torch.testing.assert_close(after.image, expected)
    assert not torch.equal(before.image, after.image)
    assert torch.equal(compositor.render(wet.unperturbed()).image, compositor.render(photographed).image)
    if backend == "reference":
        weights = torch.randn(after.image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

        def total(fog: Tensor) -> Tensor:
            code = torch.cat([fog, weather[1:]])
            return (compositor.render(wet.with_environment(weather=code)).image * weights).sum()

        assert torch.autograd.gradcheck(total, weather[:1].clone().requires_grad_())
