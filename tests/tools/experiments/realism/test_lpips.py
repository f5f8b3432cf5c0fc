"""LPIPS and the networks behind it, against its formula written out in float64 with the weights' own names."""

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from tools.experiments.realism.perceptual import TRUNKS, FeatureTrunk, Lpips, load_published_heads

Weights = dict[str, Tensor]


def convolved(x: Tensor, w: Weights, place: int | str, **how: int) -> Tensor:
    return F.relu(F.conv2d(x, w[f"features.{place}.weight"], w[f"features.{place}.bias"], **how))


def alex(x: Tensor, w: Weights) -> list[Tensor]:
    one = convolved(x, w, 0, stride=4, padding=2)
    two = convolved(F.max_pool2d(one, 3, 2), w, 3, padding=2)
    three = convolved(F.max_pool2d(two, 3, 2), w, 6, padding=1)
    four = convolved(three, w, 8, padding=1)
    return [one, two, three, four, convolved(four, w, 10, padding=1)]


def vgg(x: Tensor, w: Weights) -> list[Tensor]:
    found = []
    for stage in ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28)):
        if found:
            x = F.max_pool2d(x, 2, 2)
        for place in stage:
            x = convolved(x, w, place, padding=1)
        found.append(x)
    return found


def squeeze(x: Tensor, w: Weights) -> list[Tensor]:
    def fire(x: Tensor, place: int) -> Tensor:
        low = convolved(x, w, f"{place}.squeeze")
        wide = convolved(low, w, f"{place}.expand1x1"), convolved(low, w, f"{place}.expand3x3", padding=1)
        return torch.cat(wide, 1)

    def pooled(x: Tensor) -> Tensor:
        return F.max_pool2d(x, 3, 2, ceil_mode=True)

    found = [convolved(x, w, 0, stride=2)]
    found.append(fire(fire(pooled(found[0]), 3), 4))
    found.append(fire(fire(pooled(found[1]), 6), 7))
    x = pooled(found[2])
    for place in (9, 10, 11, 12):
        x = fire(x, place)
        found.append(x)
    return found


REFERENCES: dict[str, Callable[[Tensor, Weights], list[Tensor]]] = {"alex": alex, "vgg": vgg, "squeeze": squeeze}


def random_trunk(name: str) -> FeatureTrunk:
    trunk = TRUNKS[name]()
    generator = torch.Generator().manual_seed(3)
    for weights in trunk.parameters():
        torch.nn.init.normal_(weights, std=0.1, generator=generator)
    return trunk.double().requires_grad_(False)


def by_hand(net: str, first: Tensor, second: Tensor, w: Weights, heads: list[Tensor]) -> Tensor:
    """Equation 1 of the paper, pixel by pixel of each layer, as its published code scales pictures."""
    shift = torch.tensor([-0.030, -0.088, -0.188], dtype=torch.float64)
    scale = torch.tensor([0.458, 0.448, 0.450], dtype=torch.float64)
    scaled = [((2 * x - 1).movedim(1, -1) - shift) / scale for x in (first, second)]
    layers = zip(*(REFERENCES[net](x.movedim(-1, 1), w) for x in scaled), heads, strict=True)
    total = torch.zeros((), dtype=torch.float64)
    for a, b, head in layers:
        unit = [f / (torch.linalg.vector_norm(f, dim=1, keepdim=True) + 1e-10) for f in (a, b)]
        height, width = a.shape[2:]
        per_pixel = torch.einsum("bchw,c->bhw", (unit[0] - unit[1]) ** 2, head.double())
        total = total + per_pixel.sum() / (height * width)
    return total


@pytest.mark.parametrize("net", TRUNKS)
def test_equals_the_formula(net: str) -> None:
    generator = torch.Generator().manual_seed(1)
    first, second = (torch.rand(1, 3, 70, 91, generator=generator, dtype=torch.float64) for _ in range(2))
    trunk = random_trunk(net)
    heads = [head.double() for head in load_published_heads(net)]
    lpips = Lpips(trunk, heads).double()
    expected = by_hand(net, first, second, dict(trunk.state_dict()), heads)
    # the published constants are single-precision buffers
    assert float(lpips(first, second)[0]) == pytest.approx(float(expected), rel=1e-5)
    assert float(expected) > 1e-3
    assert float(lpips(first, first)[0]) == 0.0
    assert float(lpips(second, first)[0]) == pytest.approx(float(lpips(first, second)[0]), rel=1e-12)


@pytest.mark.parametrize("net", TRUNKS)
def test_published_heads_fit_and_are_not_negative(net: str) -> None:
    heads = load_published_heads(net)
    assert tuple(len(head) for head in heads) == TRUNKS[net]().widths
    assert all(float(head.min()) >= 0 and float(head.max()) > 0 for head in heads)


@pytest.mark.parametrize(("net", "name"), [("alex", "alexnet"), ("vgg", "vgg16"), ("squeeze", "squeezenet1_1")])
def test_networks_equal_torchvisions(net: str, name: str) -> None:
    try:
        import torchvision
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"needs a torchvision that fits torch: {error}")
    theirs = getattr(torchvision.models, name)(weights=None).features.double().eval()
    ours = random_trunk(net)
    theirs.load_state_dict({k.removeprefix("features."): v for k, v in ours.state_dict().items()}, strict=False)
    x = torch.rand(1, 3, 70, 91, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = theirs[: ours.taps[-1] + 1](x)
    torch.testing.assert_close(ours(x)[-1], expected, rtol=1e-10, atol=1e-12)
