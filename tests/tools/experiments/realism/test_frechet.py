"""The Fréchet distance against its closed form, and Inception against a second writing of it in float64."""

import numpy as np
import pytest
import scipy.linalg
import torch
import torch.nn.functional as F
from torch import Tensor

from scene_ir.errors import RangeError, ShapeError
from tools.experiments.realism.feature_networks import Inception
from tools.experiments.realism.metrics import Gaussian, frechet_distance


def closed_form(m1: np.ndarray, c1: np.ndarray, m2: np.ndarray, c2: np.ndarray) -> float:
    """As Heusel et al. write it, with a matrix root."""
    root = scipy.linalg.sqrtm(c1 @ c2)
    return float(((m1 - m2) ** 2).sum() + np.trace(c1 + c2 - 2 * np.real(root)))


def covariance(generator: np.random.Generator, size: int) -> np.ndarray:
    half = generator.normal(size=(size, size + 3))
    return half @ half.T


def test_equal_sets() -> None:
    features = np.random.default_rng(0).normal(size=(20, 50))
    one = Gaussian.from_features(features)
    assert frechet_distance(one, one) == pytest.approx(0, abs=1e-9)
    assert frechet_distance(one, Gaussian.from_features(features[::-1])) == pytest.approx(0, abs=1e-9)
    shifted = Gaussian.from_features(features + 2.0)
    assert frechet_distance(one, shifted) == pytest.approx(4.0 * 50)


def test_gaussians_of_known_moments() -> None:
    generator = np.random.default_rng(1)
    m1, m2 = generator.normal(size=(2, 6))
    c1, c2 = covariance(generator, 6), covariance(generator, 6)
    found = frechet_distance(Gaussian.from_moments(m1, c1), Gaussian.from_moments(m2, c2))
    assert found == pytest.approx(closed_form(m1, c1, m2, c2), rel=1e-9)
    # of one dimension: (m1 - m2)^2 + (s1 - s2)^2
    narrow = Gaussian.from_moments(np.array([1.0]), np.array([[4.0]]))
    wide = Gaussian.from_moments(np.array([3.0]), np.array([[25.0]]))
    assert frechet_distance(narrow, wide) == pytest.approx(4 + 9)


@pytest.mark.parametrize("count", [5, 40])
def test_sets_of_fewer_and_of_more_pictures_than_features(count: int) -> None:
    generator = np.random.default_rng(2)
    first, second = generator.normal(size=(count, 8)), generator.normal(1.0, 2.0, size=(count + 3, 8))
    moments = [(x.mean(axis=0), np.cov(x, rowvar=False)) for x in (first, second)]
    found = frechet_distance(Gaussian.from_features(first), Gaussian.from_features(second))
    # scipy's root of a singular product is good to single precision only
    assert found == pytest.approx(closed_form(*moments[0], *moments[1]), rel=1e-4)
    if count > 8:
        assert found == pytest.approx(frechet_distance(*(Gaussian.from_moments(*m) for m in moments)), rel=1e-9)


def test_bad_sets() -> None:
    with pytest.raises(ShapeError, match="at least two pictures"):
        Gaussian.from_features(np.zeros((1, 3)))
    with pytest.raises(RangeError, match="finite"):
        Gaussian.from_features(np.full((3, 3), np.nan))
    with pytest.raises(ShapeError):
        frechet_distance(Gaussian.from_features(np.eye(3)), Gaussian.from_features(np.eye(4)))
    with pytest.raises(RangeError, match="semi-definite"):
        Gaussian.from_moments(np.zeros(2), np.diag([1.0, -1.0]))


class ByHand:
    """Inception v3 from a table of its convolutions, weights by name."""

    def __init__(self, weights: dict[str, Tensor], original: bool) -> None:
        self.w, self.original = weights, original

    def conv(self, x: Tensor, name: str, stride: int = 1) -> Tensor:
        kernel = self.w[f"{name}.conv.weight"]
        same = stride == 1 and not name.startswith(("Conv2d_1a", "Conv2d_2a", "Conv2d_4a"))
        padding = [side // 2 if same else 0 for side in kernel.shape[2:]]
        x = F.conv2d(x, kernel, stride=stride, padding=padding)
        shape = (1, -1, 1, 1)
        mean, variance, gain, offset = (
            self.w[f"{name}.bn.{key}"].view(shape) for key in ("running_mean", "running_var", "weight", "bias")
        )
        return ((x - mean) / (variance + 0.001).sqrt() * gain + offset).clamp_min(0)

    def chain(self, x: Tensor, block: str, *names: str, last: int = 1) -> Tensor:
        for i, name in enumerate(names):
            x = self.conv(x, f"{block}.{name}", last if i == len(names) - 1 else 1)
        return x

    def pooled(self, x: Tensor, block: str) -> Tensor:
        if self.original and block == "Mixed_7c":
            around = F.max_pool2d(F.pad(x, (1, 1, 1, 1), value=-torch.inf), 3, 1)
        else:
            kernel = x.new_ones(x.shape[1], 1, 3, 3)
            total = F.conv2d(x, kernel, padding=1, groups=x.shape[1])
            count = F.conv2d(torch.ones_like(x), kernel, padding=1, groups=x.shape[1]) if self.original else 9.0
            around = total / count
        return self.chain(around, block, "branch_pool")

    def features(self, x: Tensor) -> Tensor:
        x = 2 * F.interpolate(x, (299, 299), mode="bilinear") - 1
        x = self.conv(self.conv(self.conv(x, "Conv2d_1a_3x3", 2), "Conv2d_2a_3x3"), "Conv2d_2b_3x3")
        x = self.conv(F.max_pool2d(x, 3, 2), "Conv2d_3b_1x1")
        x = F.max_pool2d(self.conv(x, "Conv2d_4a_3x3"), 3, 2)
        for block in ("Mixed_5b", "Mixed_5c", "Mixed_5d"):
            five = self.chain(x, block, "branch5x5_1", "branch5x5_2")
            three = self.chain(x, block, *(f"branch3x3dbl_{i}" for i in (1, 2, 3)))
            x = torch.cat([self.chain(x, block, "branch1x1"), five, three, self.pooled(x, block)], 1)
        three = self.chain(x, "Mixed_6a", *(f"branch3x3dbl_{i}" for i in (1, 2, 3)), last=2)
        x = torch.cat([self.chain(x, "Mixed_6a", "branch3x3", last=2), three, F.max_pool2d(x, 3, 2)], 1)
        for block in ("Mixed_6b", "Mixed_6c", "Mixed_6d", "Mixed_6e"):
            seven = self.chain(x, block, *(f"branch7x7_{i}" for i in (1, 2, 3)))
            twice = self.chain(x, block, *(f"branch7x7dbl_{i}" for i in (1, 2, 3, 4, 5)))
            x = torch.cat([self.chain(x, block, "branch1x1"), seven, twice, self.pooled(x, block)], 1)
        three = self.chain(x, "Mixed_7a", "branch3x3_1", "branch3x3_2", last=2)
        seven = self.chain(x, "Mixed_7a", *(f"branch7x7x3_{i}" for i in (1, 2, 3, 4)), last=2)
        x = torch.cat([three, seven, F.max_pool2d(x, 3, 2)], 1)
        for block in ("Mixed_7b", "Mixed_7c"):
            three = self.chain(x, block, "branch3x3_1")
            twice = self.chain(x, block, "branch3x3dbl_1", "branch3x3dbl_2")
            both = [self.chain(three, block, f"branch3x3_2{side}") for side in "ab"]
            both += [self.chain(twice, block, f"branch3x3dbl_3{side}") for side in "ab"]
            x = torch.cat([self.chain(x, block, "branch1x1"), *both, self.pooled(x, block)], 1)
        return x.mean((2, 3))


def random_inception(original: bool) -> Inception:
    net = Inception(original)
    generator = torch.Generator().manual_seed(5)
    for name, tensor in net.state_dict().items():
        if name.endswith("conv.weight"):
            torch.nn.init.kaiming_normal_(tensor, generator=generator)
        elif name.endswith(("running_var", "bn.weight")):
            tensor.uniform_(0.5, 1.5, generator=generator)
        elif tensor.is_floating_point():
            tensor.normal_(0, 0.1, generator=generator)
    return net.double().eval().requires_grad_(False)


@pytest.mark.parametrize("original", [True, False], ids=["FID's", "torchvision's"])
def test_inception_equals_its_second_writing(original: bool) -> None:
    net = random_inception(original)
    image = torch.rand(1, 3, 60, 90, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = net(image)
    assert found.shape == (1, 2048)
    expected = ByHand(dict(net.state_dict()), original).features(image)
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)
    other = ByHand(dict(net.state_dict()), not original).features(image)
    assert float((found - other).abs().max()) > 1e-6


def test_inception_equals_torchvisions() -> None:
    try:
        from torchvision.models import inception_v3
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"needs a torchvision that fits torch: {error}")
    theirs = (
        inception_v3(weights=None, aux_logits=False, init_weights=False, transform_input=False).double().eval()
    )
    ours = random_inception(original=False)
    theirs.load_state_dict(ours.state_dict(), strict=False)
    theirs.fc = torch.nn.Identity()
    x = torch.rand(1, 3, 299, 299, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(ours(x), theirs(2 * x - 1), rtol=1e-8, atol=1e-10)
