"""Passes on changed regions against whole passes: values, gradients, memory, and when they give way."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import pytest
import torch
import torch.nn.functional as F
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from detectors.base import AnchorPredictions, Detector, DetectorStages
from detectors.incremental.graph import LayerGraph, UntraceableError
from detectors.incremental.passes import ChangedOutputs, ImageInput, forward
from detectors.incremental.plan import SizedGraph
from detectors.incremental.reference import LIMIT_MB, MAX_LOGIT_DIFFERENCE, ReferencePass
from detectors.incremental.regions import ColumnRegion, Rect
from detectors.registry import load_detector
from detectors.squeezedet import SqueezeDet, SqueezeDetPlus
from detectors.types import Detections, Targets
from detectors.yolov3.yolov3 import YoloV3

FIELDS = ("boxes_xyxy", "deltas", "class_logits", "confidence_logits")
KITTI_HW = (375, 1242)


class Residual(nn.Module):
    """A residual block as torchvision's."""

    def __init__(self, inputs: int, channels: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, channels, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.relu = nn.ReLU(inplace=True)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.side = nn.Sequential(nn.Conv2d(inputs, channels, 1, stride), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        identity = self.side(x)
        x = self.bn2(self.conv2(self.relu(self.bn1(self.conv1(x)))))
        x += identity
        return self.relu(x)


class Backbone(nn.Module):
    """A pyramid: residuals, nearest and bilinear enlargements, concatenation, pools, an activation that is not a
    rectifier, a normalisation without a convolution before it, a depthwise and a dilated convolution.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(nn.Conv2d(3, 8, 7, 2, 3), nn.BatchNorm2d(8), nn.ReLU(), nn.MaxPool2d(3, 2, 1))
        self.first = Residual(8, 8)
        self.second = Residual(8, 12, stride=2)
        self.norm = nn.BatchNorm2d(12)
        self.deep = nn.Sequential(nn.Conv2d(12, 12, 3, 1, 1, groups=12), nn.SiLU(), nn.AvgPool2d(2), nn.Identity())
        self.wide = nn.Conv2d(12, 8, 3, padding=2, dilation=2)
        self.head = nn.Conv2d(28, 5, (3, 1), padding=(1, 0))
        self.far = nn.Conv2d(8, 5, 1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        near = self.first(self.stem(x))
        middle = self.norm(self.second(near))
        far = self.wide(self.deep(middle))
        up = F.interpolate(far, scale_factor=2, mode="bilinear", align_corners=False)
        joined = torch.cat((up, F.leaky_relu(middle, 0.1), up * 0.5 + 1), 1)
        large = F.interpolate(joined, scale_factor=2.0)
        pooled = F.max_pool2d(F.pad(near, (0, 1, 1, 0), value=-torch.inf), 2, 1)
        return self.head(large) + self.far(pooled), far


@lru_cache
def backbone() -> Backbone:
    torch.manual_seed(3)
    network = Backbone().double()
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.running_mean.normal_()
                module.running_var.uniform_(0.5, 2)
                module.weight.uniform_(-1.5, 1.5)
                module.bias.normal_()
    return network.requires_grad_(False).eval()


@lru_cache
def detector(name: str) -> Detector:
    if name == "squeezedet-plus":
        made = SqueezeDetPlus()
        made.initialise(torch.Generator().manual_seed(0))
        return made.double().requires_grad_(False)
    if name == "yolov3":
        full = YoloV3()
        full.initialise(torch.Generator().manual_seed(0))
        return full.double().requires_grad_(False)
    loaded = load_detector(name)
    assert isinstance(loaded, Detector)
    return loaded.double()


def smooth(height: int, width: int, seed: int, dtype: torch.dtype) -> Tensor:
    """An image with blobs of many sizes, nowhere flat: equal numbers have no one maximum."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.zeros(1, 3, height, width, dtype=dtype)
    for cells in (3, 8, 20):
        coarse = torch.rand(1, 3, cells, 2 * cells, generator=generator, dtype=dtype)
        image += F.interpolate(coarse, (height, width), mode="bicubic")
    image -= image.min()
    return image / image.max()


@dataclass(frozen=True)
class Pictures:
    """Of two pictures of a size, and the rectangles in which the second is shown instead of the first."""

    hw: tuple[int, int]
    seed: int
    rects: tuple[Rect, ...]

    def images(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        image, other = (smooth(*self.hw, seed, dtype) for seed in (self.seed, self.seed + 1))
        changed = image.clone()
        for rect in self.rects:
            changed[inside(rect)] = other[inside(rect)]
        return image, changed


@st.composite
def pictures(draw: st.DrawFn) -> Pictures:
    """Rectangles anywhere, overlapping, none."""
    height, width = draw(st.integers(70, 150)), draw(st.integers(70, 200))
    rects: list[Rect] = []
    for _ in range(draw(st.integers(0, 3))):
        high, wide = draw(st.integers(1, 40)), draw(st.integers(1, 40))
        top, left = draw(st.integers(0, height - high)), draw(st.integers(0, width - wide))
        rects.append(Rect(top, top + high, left, left + wide))
    return Pictures((height, width), draw(st.integers(0, 99)), tuple(rects))


BORDERS = Pictures(
    (97, 131),
    5,
    (
        *(Rect(0, 13, 0, 21), Rect(0, 7, 110, 131), Rect(90, 97, 0, 9), Rect(84, 97, 118, 131)),
        *(Rect(30, 61, 0, 1), Rect(40, 41, 130, 131), Rect(0, 1, 60, 75), Rect(96, 97, 50, 51)),
    ),
)
"""Odd sides, and a rectangle at each corner and each border, one pixel wide too."""
OVERLAPPING = Pictures((71, 99), 8, (Rect(10, 50, 20, 60), Rect(30, 71, 40, 99), Rect(10, 50, 20, 60)))
NOTHING = Pictures((75, 103), 9, ())


def inside(rect: Rect) -> tuple[slice, slice, slice, slice]:
    return slice(None), slice(None), slice(rect.top, rect.bottom), slice(rect.left, rect.right)


def functional(outputs: Sequence[Tensor]) -> Tensor:
    total = outputs[0].new_zeros(())
    for output in outputs:
        weight = torch.linspace(-1, 1, output.numel(), dtype=output.dtype).view_as(output)
        total = total + (output * weight).sum() + output.sigmoid().square().sum()
    return total


def raw_tensors(raw: AnchorPredictions) -> list[Tensor]:
    return [getattr(raw, field) for field in ("deltas", "class_logits", "confidence_logits")]


def outputs_and_gradient(call: Callable[[Tensor], Sequence[Tensor]], image: Tensor) -> tuple[list[Tensor], Tensor]:
    """What comes out, and the gradient of a function of all of it."""
    leaf = image.clone().requires_grad_(True)
    outputs = call(leaf)
    (slope,) = torch.autograd.grad(functional(outputs), leaf)
    return [output.detach() for output in outputs], slope


def relative(found: Tensor, expected: Tensor) -> float:
    return float((found - expected).norm() / expected.norm().clamp_min(1e-30))


def assert_agreement(name: str, scene: Pictures) -> None:
    """All outputs, and the gradient inside each rectangle, are those of a whole pass. In double precision: in
    single, a number near 0 may be on the other side of a rectifier.
    """
    model, tolerance = detector(name), 1e-9
    image, changed = scene.images(torch.float64)
    reference = ReferencePass.run(model, image)
    assert reference is not None
    reference = replace(reference, max_cost_share=float("inf"))
    found, slope = outputs_and_gradient(lambda x: raw_tensors(reference(x, scene.rects)), changed)
    expected, expected_slope = outputs_and_gradient(lambda x: raw_tensors(model(x)), changed)
    assert max(relative(a, b) for a, b in zip(found, expected, strict=True)) < tolerance
    for rect in scene.rects:
        assert relative(slope[inside(rect)], expected_slope[inside(rect)]) < tolerance
    assert not reference.incremental.disagrees


@settings(max_examples=25)
@example(BORDERS)
@example(OVERLAPPING)
@example(NOTHING)
@given(pictures())
def test_squeezedet_equals_a_whole_pass(scene: Pictures) -> None:
    assert_agreement("squeezedet", scene)


@settings(max_examples=5)
@example(BORDERS)
@example(OVERLAPPING)
@example(NOTHING)
@given(pictures())
def test_squeezedet_plus_equals_a_whole_pass(scene: Pictures) -> None:
    assert_agreement("squeezedet-plus", scene)


@settings(max_examples=20)
@example(BORDERS)
@example(OVERLAPPING)
@example(NOTHING)
@given(pictures())
def test_slim_yolov3_equals_a_whole_pass(scene: Pictures) -> None:
    assert_agreement("yolov3-slim", scene)


@pytest.mark.slow
@settings(max_examples=5)
@example(OVERLAPPING)
@example(NOTHING)
@given(pictures())
def test_full_yolov3_equals_a_whole_pass(scene: Pictures) -> None:
    assert_agreement("yolov3", scene)


@pytest.mark.slow
def test_full_yolov3_equals_a_whole_pass_at_all_borders() -> None:
    """With random weights: of the full size none ship."""
    assert_agreement("yolov3", BORDERS)


@settings(max_examples=40)
@example(BORDERS, 0.05)
@example(OVERLAPPING, 0.0)
@example(NOTHING, 100.0)
@given(pictures(), st.sampled_from([0.0, 0.05, 100.0]))
def test_traceable_network_equals_a_whole_pass(scene: Pictures, limit_mb: float) -> None:
    """Whatever is kept: nothing but picture and outputs, some layers, all that are wanted."""
    network = backbone()
    graph = LayerGraph.trace(network)
    bottom, right = (-side % 16 for side in scene.hw)
    image, changed = (F.pad(x, (0, right, 0, bottom), value=0.5) for x in scene.images(torch.float64))
    hw = int(image.shape[2]), int(image.shape[3])
    everywhere = Rect(0, *hw[:1], 0, *hw[1:])
    shapes = SizedGraph.for_size(graph, hw, limit_mb * 1e6)
    first = shapes.plan(ColumnRegion.from_rects([everywhere], hw), everywhere)
    parts, _ = forward(graph, first, ImageInput(image), {}, shapes.stored)
    activations = {layer: several[0] for layer, several in parts.items()}
    plan = shapes.plan(ColumnRegion.from_rects(scene.rects, hw), everywhere)

    def call(x: Tensor) -> list[Tensor]:
        return list(ChangedOutputs.apply(x, ImageInput(x.detach()), graph, plan, activations))

    found, slope = outputs_and_gradient(call, changed)
    expected, expected_slope = outputs_and_gradient(network, changed)
    assert max(relative(a, b) for a, b in zip(found, expected, strict=True)) < 1e-9
    for rect in scene.rects:
        assert relative(slope[inside(rect)], expected_slope[inside(rect)]) < 1e-9


@pytest.mark.parametrize("name", ["squeezedet", "yolov3-slim"])
def test_single_precision_stays_within_rounding(name: str) -> None:
    """At KITTI's size, as attacks run it: oneDNN's own weights, and only some of the work."""
    model = load_detector(name)
    image, other = (smooth(*KITTI_HW, seed, torch.float32) for seed in (0, 1))
    rects = [Rect(180, 260, 300, 420), Rect(170, 190, 640, 662), Rect(150, 375, 1100, 1242)]
    changed = image.clone()
    for rect in rects:
        changed[inside(rect)] = other[inside(rect)]
    reference = ReferencePass.run(model, image)
    assert reference is not None
    found, slope = outputs_and_gradient(lambda x: raw_tensors(reference(x, rects)), changed)
    expected, expected_slope = outputs_and_gradient(lambda x: raw_tensors(model(x)), changed)
    assert max(relative(a, b) for a, b in zip(found, expected, strict=True)) < 1e-4
    for rect in rects:
        assert relative(slope[inside(rect)], expected_slope[inside(rect)]) < 1e-4
    assert float(slope[..., :100, :].abs().max()) == 0  # nothing changes there, nobody asks


def test_unnamed_changes_are_found() -> None:
    image = smooth(*KITTI_HW, 0, torch.float32)
    model = load_detector("squeezedet")
    reference = ReferencePass.run(model, image)
    assert reference is not None
    changed = image.clone()
    changed[..., 200:260, 500:560] = 0
    torch.testing.assert_close(
        reference(changed, []).confidence_logits, model(changed).confidence_logits, atol=1e-4, rtol=1e-4
    )


@pytest.mark.parametrize("name", ["squeezedet", "yolov3-slim", "yolov3"])
def test_stored_activations_respect_the_limit(name: str) -> None:
    model = detector(name)
    trunk = model.stages(KITTI_HW)
    assert trunk is not None
    top, bottom, left, right = trunk.padding
    shapes = SizedGraph.for_size(
        LayerGraph.trace(trunk.network), (top + KITTI_HW[0] + bottom, left + KITTI_HW[1] + right), LIMIT_MB * 1e6
    )
    total = sum(4 * layer.channels * shapes.hw[layer][0] * shapes.hw[layer][1] for layer in shapes.stored)
    assert total < LIMIT_MB * 1e6


def test_size_of_stored_activations() -> None:
    reference = ReferencePass.run(load_detector("squeezedet"), smooth(*KITTI_HW, 0, torch.float32))
    assert reference is not None
    assert reference.bytes == sum(4 * t.numel() for t in reference.activations.values()) < 30e6


def test_a_small_change_costs_a_small_share_and_a_large_one_is_a_whole_pass() -> None:
    image = smooth(*KITTI_HW, 0, torch.float32)
    reference = ReferencePass.run(load_detector("squeezedet"), image)
    assert reference is not None
    shapes, frame = reference.sized_graph, Rect(0, *KITTI_HW[:1], 0, *KITTI_HW[1:])
    hw = shapes.hw[reference.incremental.graph.layers[0]]
    shares = [
        shapes.plan(ColumnRegion.from_rects([Rect(0, side, 0, side)], hw), frame).cost_share
        for side in (16, 64, 128, 256)
    ]
    assert shares == sorted(shares)
    assert shares[0] < 0.08
    assert shapes.plan(ColumnRegion.from_rects([frame], hw), frame).cost_share > 0.99


class CountingDetector(Detector):
    """SqueezeDet, whose whole passes are counted."""

    def __init__(self, inner: SqueezeDet) -> None:
        super().__init__()
        self.inner, self.name, self.classes, self.t_star = inner, "counting", inner.classes, inner.t_star
        self.passes = 0

    def forward(self, images: Tensor) -> AnchorPredictions:
        self.passes += 1
        return self.inner(images)

    def stages(self, image_hw: tuple[int, int]) -> DetectorStages | None:
        return self.inner.stages(image_hw)

    def loss(self, raw: AnchorPredictions, targets: Sequence[Targets]) -> dict[str, Tensor]:
        return self.inner.loss(raw, targets)

    def decode(self, raw: AnchorPredictions) -> list[Detections]:
        return self.inner.decode(raw)


def counting_detector() -> CountingDetector:
    inner = load_detector("squeezedet")
    assert isinstance(inner, SqueezeDet)
    return CountingDetector(inner).requires_grad_(False)


def test_the_first_pass_is_compared_and_only_that() -> None:
    model, image = counting_detector(), smooth(*KITTI_HW, 0, torch.float32)
    reference = ReferencePass.run(model, image)
    assert reference is not None
    for _ in range(3):
        reference(image, [Rect(180, 220, 300, 340)])
    assert model.passes == 1
    assert ReferencePass.run(model, image) is not None


def test_disagreement_is_reported_once_and_ends_incremental_passes(capsys: pytest.CaptureFixture[str]) -> None:
    model, image = counting_detector(), smooth(*KITTI_HW, 0, torch.float32)
    reference = ReferencePass.run(model, image)
    assert reference is not None
    for layer in reference.incremental.graph.outputs:
        reference.activations[layer] += 10 * MAX_LOGIT_DIFFERENCE
    rects = [Rect(180, 220, 300, 340)]
    first = reference(image, rects)
    second = reference(image, rects)
    message = capsys.readouterr().err
    assert message.startswith("drivesem: detector counting: incremental passes differ")
    assert message.count("\n") == 1
    expected = model(image)
    for field in FIELDS:
        assert torch.equal(getattr(first, field), getattr(expected, field))
        assert torch.equal(getattr(second, field), getattr(expected, field))
    assert model.passes == 3
    assert ReferencePass.run(model, image) is None


def test_a_change_of_unknown_place_is_a_whole_pass() -> None:
    model, image = counting_detector(), smooth(*KITTI_HW, 0, torch.float32)
    reference = ReferencePass.run(model, image)
    assert reference is not None
    reference(image, None)
    reference(1 - image, [])
    assert model.passes == 2


def test_changed_weights_are_traced_again() -> None:
    model, image = counting_detector(), smooth(*KITTI_HW, 0, torch.float32)
    first = ReferencePass.run(model, image)
    with torch.no_grad():
        model.inner.convdet.weight *= 2
    second = ReferencePass.run(model, image)
    assert first is not None
    assert second is not None
    assert second.incremental is not first.incremental
    torch.testing.assert_close(second(image, []).deltas, model(image).deltas, atol=1e-4, rtol=1e-4)


class ShuffleNetwork(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return x.flip(3)


class GlobalMeanNetwork(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return x - F.adaptive_avg_pool2d(x, 1)


class InPlaceNetwork(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 3, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv(x)
        return F.relu(x, inplace=True) + x


class BranchingNetwork(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return x * 2 if bool(x.sum() > 0) else x


@pytest.mark.parametrize(
    "network",
    [
        ShuffleNetwork(), GlobalMeanNetwork(), InPlaceNetwork(), BranchingNetwork(),
        nn.Conv2d(3, 4, 3, padding_mode="reflect", padding=1),
        nn.Sequential(nn.Conv2d(3, 4, 1), nn.InstanceNorm2d(4)), nn.ConstantPad2d(1, 2.0),
        nn.Sequential(nn.ZeroPad2d(1), nn.ReLU()), nn.Upsample(scale_factor=1.5),
        nn.Sequential(nn.Conv2d(3, 4, 1), nn.LeakyReLU(-0.1)),
    ],
    ids=lambda network: type(network).__name__,
)  # fmt: skip
def test_untraceable_networks_are_refused(network: nn.Module) -> None:
    with pytest.raises(UntraceableError):
        LayerGraph.trace(network.eval())


def test_trainable_or_untraceable_detectors_have_no_reference() -> None:
    image = smooth(64, 64, 0, torch.float32)
    trained = load_detector("squeezedet").requires_grad_(True)
    assert ReferencePass.run(trained, image) is None
    coarse = load_detector("squeezedet")
    coarse.gradient_precision = torch.bfloat16
    assert ReferencePass.run(coarse, image) is None


def test_a_plan_serves_the_next_small_moves() -> None:
    reference = ReferencePass.run(load_detector("squeezedet"), smooth(*KITTI_HW, 0, torch.float32))
    assert reference is not None

    def plan(left: int) -> object:
        return reference._plan(reference.image, [Rect(200, 260, left, left + 80)])

    first = plan(400)
    joined = plan(399)
    assert joined is not first  # another block of pixels
    assert plan(400) is joined  # it lies in the latest, which is hardly larger
    assert plan(407) is joined  # from the second on they reach a little further
    assert plan(392) is joined
    assert plan(600) is not joined
