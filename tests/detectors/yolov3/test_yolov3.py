"""YOLOv3: places of anchors, the loss by hand, decoding, gradients, the folded network."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from detectors import boxes
from detectors.augment import AugmentSettings
from detectors.base import AnchorPredictions
from detectors.registry import load_detector, save_detector
from detectors.training import TrainingSettings, train
from detectors.types import Targets
from detectors.yolov3.cfg import DarknetCfg, MaxPoolLayer, parse, write
from detectors.yolov3.network import DarknetNetwork, FoldedNetwork, _max_pool
from detectors.yolov3.yolov3 import YoloAssignment, YoloV3, YoloV3Slim

HW = (32, 48)
COARSE = 2 * 6 * 4
"""Anchors of the first head, at stride 8; those of the second, at stride 4, follow."""


def targets(boxes_xyxy: Sequence[Sequence[float]], labels: Sequence[int], ignore: bool = False) -> Targets:
    count = len(labels)
    return Targets(
        torch.tensor(boxes_xyxy, dtype=torch.float32).reshape(count, 4),
        torch.tensor(labels, dtype=torch.int64),
        torch.full((count,), ignore),
    )


def box(centre_x: float, centre_y: float, width: float, height: float) -> list[float]:
    """A box around a point that is counted from the image's edge; pixel centres are at whole numbers."""
    x, y = centre_x - 0.5, centre_y - 0.5
    return [x - width / 2, y - height / 2, x + width / 2, y + height / 2]


def coarse(anchor: int, row: int, column: int) -> int:
    """Number of an anchor (2 or 3) of the first head."""
    return anchor - 2 + 2 * (row * 6 + column)


def fine(anchor: int, row: int, column: int) -> int:
    """Number of an anchor (0 or 1) of the second head."""
    return COARSE + anchor + 2 * (row * 12 + column)


def silent(detector: YoloV3, batch: int = 1) -> dict[str, Tensor]:
    """Parts of raw predictions: anchors in the middle of their cells, without any confidence."""
    places = detector.places(HW, torch.zeros(1))
    middle = places.cells_xy + places.strides[:, None] / 2 - 0.5
    anchors = torch.cat((middle - places.anchors_wh / 2, middle + places.anchors_wh / 2), 1)
    count = len(anchors)
    return {
        "boxes_xyxy": anchors.repeat(batch, 1, 1),
        "deltas": torch.zeros(batch, count, 4),
        "class_logits": torch.zeros(batch, count, 3),
        "confidence_logits": torch.full((batch, count), -60.0),
    }


def make_raw(parts: dict[str, Tensor]) -> AnchorPredictions:
    return AnchorPredictions(**parts, image_hw=HW)


def logit(p: float) -> float:
    return math.log(p / (1 - p))


def entropy(logits: Sequence[float], wanted: Sequence[float]) -> float:
    """Binary cross entropy, written out."""
    total = 0.0
    for z, t in zip(logits, wanted, strict=True):
        p = 1 / (1 + math.exp(-z))
        total -= t * math.log(p) + (1 - t) * math.log(1 - p)
    return total


LARGE = box(20, 12, 40, 24)
"""The shape of anchor 3, in the middle of the first head's cell of row 1, column 2."""


def test_boxes_of_an_untrained_network_are_its_anchors(mini: YoloV3) -> None:
    with torch.no_grad():
        for parameter in mini.parameters():
            parameter.zero_()
        raw = mini(torch.rand(1, 3, 27, 41))
    assert raw.boxes_xyxy.shape == (1, COARSE + 2 * 12 * 8, 4)
    assert raw.boxes_xyxy[0, coarse(3, 1, 2)].tolist() == LARGE
    assert raw.boxes_xyxy[0, coarse(2, 3, 5)].tolist() == box(44, 28, 20, 20)
    assert raw.boxes_xyxy[0, fine(1, 7, 0)].tolist() == box(2, 30, 12, 8)
    assert raw.image_hw == (27, 41)


def test_channels_are_box_objectness_classes_anchor_by_anchor(mini: YoloV3) -> None:
    with torch.no_grad():
        for parameter in mini.parameters():
            parameter.zero_()
        bias = mini.network.blocks[7].conv.bias
        assert bias is not None
        bias.copy_(torch.arange(16.0) / 10)
        raw = mini(torch.zeros(1, 3, *HW))
    at = coarse(3, 1, 2)
    assert raw.deltas[0, at].tolist() == pytest.approx([0.8, 0.9, 1.0, 1.1])
    assert raw.confidence_logits[0, at].item() == pytest.approx(1.2)
    assert raw.class_logits[0, at].tolist() == pytest.approx([1.3, 1.4, 1.5])
    x, y = 16 + 8 / (1 + math.exp(-0.8)), 8 + 8 / (1 + math.exp(-0.9))
    wanted = box(x, y, 40 * math.exp(1.0), 24 * math.exp(1.1))
    assert raw.boxes_xyxy[0, at].tolist() == pytest.approx(wanted, rel=1e-5)


def test_padding_adds_grey_only(mini: YoloV3) -> None:
    image = torch.rand(1, 3, 27, 41, generator=torch.Generator().manual_seed(2))
    padded = torch.full((1, 3, 32, 48), 0.5)
    padded[..., :27, :41] = image
    with torch.no_grad():
        small, large = mini(image), mini(padded)
    assert torch.equal(small.confidence_logits, large.confidence_logits)
    assert torch.equal(small.boxes_xyxy, large.boxes_xyxy)


def test_confidence_term_by_hand(mini: YoloV3) -> None:
    parts = silent(mini)
    at = coarse(3, 1, 2)
    parts["confidence_logits"][0, at] = logit(0.4)
    parts["confidence_logits"][0, fine(0, 0, 11)] = logit(0.2)
    # Its box overlaps the object by more than ignore_thresh: it may say what it likes.
    near = coarse(2, 1, 2)
    parts["boxes_xyxy"][0, near] = torch.tensor(LARGE) + torch.tensor([2.0, 0, 2.0, 0])
    parts["confidence_logits"][0, near] = 3.0
    terms = mini.loss(make_raw(parts), [targets([LARGE], [0])])
    assert terms["confidence"].item() == pytest.approx(-math.log(0.4) - math.log(0.8), rel=1e-4)
    # Where it overlaps less, it must be silent.
    parts["boxes_xyxy"][0, near] += torch.tensor([8.0, 0, 8.0, 0])  # IoU 30 / 50
    terms = mini.loss(make_raw(parts), [targets([LARGE], [0])])
    silenced = math.log(1 + math.exp(3.0))
    assert terms["confidence"].item() == pytest.approx(-math.log(0.4) - math.log(0.8) + silenced, rel=1e-4)


def test_box_term_by_hand(mini: YoloV3) -> None:
    parts = silent(mini)
    truth = box(16 + 8 * 0.25, 8 + 8 * 0.75, 30, 24)  # in the cell of row 1, column 2; nearest shape: anchor 3
    at = coarse(3, 1, 2)
    parts["deltas"][0, at] = torch.tensor([0.3, -0.2, 0.1, 0.4])
    terms = mini.loss(make_raw(parts), [targets([truth], [0])])
    shape = ((0.1 - math.log(30 / 40)) ** 2 + (0.4 - 0) ** 2) / 2
    scale = 2 - 30 * 24 / (32 * 48)
    least = entropy([logit(0.25), logit(0.75)], [0.25, 0.75])
    expected = scale * (entropy([0.3, -0.2], [0.25, 0.75]) - least + shape)
    assert terms["box"].item() == pytest.approx(expected, rel=1e-5)
    parts["deltas"][0, at] = torch.tensor([logit(0.25), logit(0.75), math.log(30 / 40), 0.0])
    assert mini.loss(make_raw(parts), [targets([truth], [0])])["box"].item() == pytest.approx(0, abs=1e-6)


def test_class_term_by_hand(mini: YoloV3) -> None:
    parts = silent(mini)
    parts["class_logits"][0, coarse(3, 1, 2)] = torch.tensor([1.0, 2.0, -1.0])
    terms = mini.loss(make_raw(parts), [targets([LARGE], [2])])
    assert terms["class"].item() == pytest.approx(entropy([1.0, 2.0, -1.0], [0, 0, 1]), rel=1e-5)
    assert terms["total"].item() == pytest.approx(sum(terms[k].item() for k in ("confidence", "box", "class")))


def test_objectness_by_hand(mini: YoloV3) -> None:
    parts = silent(mini)
    parts["confidence_logits"][0, coarse(3, 1, 2)] = logit(0.4)
    # Another anchor's box meets the object, with more confidence: this one counts, and is no false alarm.
    other = coarse(2, 1, 3)
    parts["boxes_xyxy"][0, other] = torch.tensor(LARGE) + torch.tensor([10.0, 0, 10.0, 0])  # IoU 30 / 50
    parts["confidence_logits"][0, other] = logit(0.7)
    parts["confidence_logits"][0, fine(0, 0, 11)] = logit(0.2)
    small = box(46, 2, 12, 8)  # nothing meets it
    parts["boxes_xyxy"][0, fine(1, 0, 11)] = torch.tensor([0.0, 30.0, 1.0, 31.0])
    parts["boxes_xyxy"][0, fine(0, 0, 11)] = torch.tensor([0.0, 30.0, 1.0, 31.0])
    parts["boxes_xyxy"][0, fine(1, 0, 10)] = torch.tensor([0.0, 30.0, 1.0, 31.0])
    terms = mini.loss(make_raw(parts), [targets([LARGE, small], [0, 1])])
    expected = ((1 - 0.7) ** 2 + 1 + 0.2**2) / 2
    assert terms["objectness"].item() == pytest.approx(expected, rel=1e-4)


def test_sums_are_divided_by_all_objects_of_the_batch(mini: YoloV3) -> None:
    parts = silent(mini, 3)
    parts["confidence_logits"][2, 5] = logit(0.2)
    wanted = [targets([LARGE, box(2, 2, 6, 6)], [0, 0]), targets([], []), targets([], [])]
    terms = mini.loss(make_raw(parts), wanted)
    assert terms["confidence"].item() == pytest.approx((2 * 60 - math.log(0.8)) / 2, rel=1e-5)
    assert terms["class"].item() == pytest.approx(3 * math.log(2))
    nothing = mini.loss(make_raw(parts), [targets([], [])] * 3)
    assert nothing["confidence"].item() == pytest.approx(-math.log(0.8), rel=1e-4)
    assert nothing["box"].item() == 0
    assert nothing["class"].item() == 0


def test_each_object_has_the_best_anchor_that_is_free(mini: YoloV3) -> None:
    raw = make_raw(silent(mini))
    outside = box(400, -30, 40, 24)  # the nearest cell
    assigned = mini.assign(raw, [targets([LARGE, LARGE, box(2, 30, 6, 6), outside], [0, 1, 2, 0])])
    # The second has the shape that fits next best, of the same head or another.
    assert assigned.anchor.tolist() == [coarse(3, 1, 2), coarse(2, 1, 2), fine(0, 7, 0), coarse(3, 0, 5)]
    assert assigned.labels.tolist() == [0, 1, 2, 0]
    assert not assigned.negative[0, assigned.anchor].any()
    assert assigned.deltas[3, :2].tolist() == [1, 0]  # as far as the cell reaches


def test_further_anchors_answer_beyond_the_match_threshold(mini_text: str) -> None:
    text = mini_text.replace("ignore_thresh = .7\n", "ignore_thresh = .7\niou_thresh = 0.3\n")
    detector = YoloV3(("Car", "Truck", "Cyclist"), cfg=parse(text))
    truth = box(21, 13, 14, 10)  # shapes' IoU: 36/140, 96/140, 140/400, 140/960
    assigned = detector.assign(make_raw(silent(detector)), [targets([truth], [1])])
    assert assigned.anchor.tolist() == [fine(1, 3, 5), coarse(2, 1, 2)]
    assert assigned.labels.tolist() == [1, 1]
    assert assigned.deltas[1].tolist() == pytest.approx([5 / 8, 5 / 8, math.log(14 / 20), math.log(10 / 20)])
    assert len(assigned.found) == 1


def test_targets_of_the_box_are_what_decoding_hits(mini: YoloV3) -> None:
    truth = box(19.3, 12.9, 31, 17)
    assigned = mini.assign(make_raw(silent(mini)), [targets([truth], [1])])
    place, shape = assigned.deltas[0, :2], assigned.deltas[0, 2:]
    with torch.no_grad():
        for parameter in mini.parameters():
            parameter.zero_()
        bias = mini.network.blocks[7].conv.bias
        assert bias is not None
        k = 8 * (int(assigned.anchor[0]) % 2)
        bias[k : k + 4] = torch.cat((torch.logit(place), shape))
        found = mini(torch.zeros(1, 3, *HW)).boxes_xyxy[0, assigned.anchor[0]]
    assert found.tolist() == pytest.approx(truth, abs=1e-3)


def test_ignored_regions_have_no_positive_and_excuse_what_lies_in_them(mini: YoloV3) -> None:
    parts = silent(mini)
    at, beyond = coarse(3, 1, 2), fine(0, 0, 11)
    parts["confidence_logits"][0, at] = 3.0
    parts["confidence_logits"][0, beyond] = logit(0.2)
    punished = mini.loss(make_raw(parts), [targets([], [])])
    assert punished["confidence"].item() == pytest.approx(math.log(1 + math.exp(3)) - math.log(0.8), rel=1e-4)
    excused = mini.loss(make_raw(parts), [targets([LARGE], [0], ignore=True)])
    assert excused["confidence"].item() == pytest.approx(-math.log(0.8), rel=1e-4)
    assert excused["box"].item() == 0
    assert excused["objectness"].item() == pytest.approx(0.2**2, rel=1e-4)
    # So does one whose box, not whose anchor, lies in the region.
    parts["boxes_xyxy"][0, beyond] = torch.tensor([4.0, 4.0, 9.0, 9.0])
    excused = mini.loss(make_raw(parts), [targets([LARGE], [0], ignore=True)])
    assert excused["confidence"].item() == pytest.approx(0, abs=1e-6)


def test_targets_that_do_not_fit_are_refused(mini: YoloV3, mini_cfg: DarknetCfg) -> None:
    raw = make_raw(silent(mini, 2))
    with pytest.raises(ValueError, match=r"targets: expected 2, one for each image, found 1"):
        mini.loss(raw, [targets([], [])])
    with pytest.raises(ValueError, match=r"targets\.labels: expected 0\.\.2, found \[3\]"):
        mini.loss(raw, [targets([LARGE], [3]), targets([], [])])
    with pytest.raises(ValueError, match=r"images: expected shape \(B, 3, H, W\)"):
        mini(torch.zeros(3, 32, 32))
    with pytest.raises(ValueError, match=r"classes: expected 3 as in the cfg, found 2"):
        YoloV3(("Car", "Truck"), cfg=mini_cfg)


def test_decode_planted_predictions(mini: YoloV3) -> None:
    parts = silent(mini, 2)
    parts["class_logits"][:] = -60.0
    first, second, near, other = coarse(3, 1, 2), fine(1, 7, 3), fine(1, 7, 4), fine(0, 0, 11)
    for at, confidence, label, probability in [
        (first, 0.9, 0, 0.8),
        (second, 0.8, 1, 0.8),
        (near, 0.7, 1, 0.9),  # 4 px beside it, both 12 px wide: IoU 8 / 16, suppressed
        (other, 0.04, 2, 0.1),  # 0.004: too little
    ]:
        parts["confidence_logits"][1, at] = logit(confidence)
        parts["class_logits"][1, at, label] = logit(probability)
    parts["class_logits"][1, first, 2] = logit(0.3)  # the same box, as another class
    nothing, found = mini.decode(make_raw(parts))
    assert len(nothing) == 0
    assert found.labels.tolist() == [0, 1, 2]
    assert found.scores.tolist() == pytest.approx([0.72, 0.64, 0.27])
    assert found.boxes_xyxy[0].tolist() == boxes.clip(torch.tensor(LARGE), *HW).tolist()
    assert found.boxes_xyxy[1].tolist() == [7.5, 25.5, 19.5, 31.0]


def test_gradient_to_the_image_agrees_with_differences(mini: YoloV3) -> None:
    detector = mini.double().requires_grad_(False)
    generator = torch.Generator().manual_seed(4)
    image = torch.rand(1, 3, 30, 44, dtype=torch.float64, generator=generator)
    wanted = [targets([[5.0, 5.0, 35.0, 28.0], [20.0, 10.0, 40.0, 25.0]], [0, 2])]
    assignment: YoloAssignment = detector.assign(detector(image), wanted)
    directions = torch.randn(12, *image.shape, dtype=torch.float64, generator=generator)
    for term in ("total", "objectness"):

        def value(x: Tensor, term: str = term) -> Tensor:
            return detector.loss_terms(detector(x), assignment)[term]

        x = image.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(value(x), x)
        step = 1e-7
        numeric = torch.stack(
            [(value(image + step * d) - value(image - step * d)) / (2 * step) for d in directions]
        )
        analytic = (directions * gradient).sum((1, 2, 3, 4))
        torch.testing.assert_close(analytic, numeric, rtol=1e-4, atol=1e-4 * float(numeric.abs().max()))


def test_frozen_network_is_folded_with_the_same_output(mini: YoloV3) -> None:
    image = torch.rand(2, 3, 30, 44, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        plain = mini(image)
    mini.requires_grad_(False)
    assert isinstance(mini._folded_network(torch.float32), FoldedNetwork)
    for raw in (mini(image), mini.train()(image)):  # nothing to train: statistics stay as they are
        torch.testing.assert_close(raw.boxes_xyxy, plain.boxes_xyxy, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(raw.confidence_logits, plain.confidence_logits, rtol=1e-4, atol=1e-4)
    # Statistics or weights that change afterwards are seen.
    with torch.no_grad():
        for block in mini.network.blocks.values():
            if block.norm is not None:
                block.norm.running_mean += 0.3
    again = mini(image)
    assert not torch.allclose(again.confidence_logits, plain.confidence_logits, atol=1e-2)


@pytest.mark.parametrize("precision", [torch.bfloat16, torch.float16])
def test_gradient_precision(mini: YoloV3, precision: torch.dtype) -> None:
    mini.requires_grad_(False)
    image = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(3)).requires_grad_()
    wanted = [targets([LARGE], [0])]

    def gradient(weight: float) -> Tensor:
        return torch.autograd.grad(mini.loss(mini(image), wanted)["confidence"] * weight, image)[0] / weight

    exact = gradient(1.0)
    mini.gradient_precision = precision
    for weight in (1.0, 1e-9):  # less than float16 can hold
        found = gradient(weight)
        assert found.dtype == torch.float32
        assert float(torch.cosine_similarity(found.flatten(), exact.flatten(), 0)) > 0.98
    with torch.no_grad():  # what is judged is as precise as ever
        judged, glance = mini(image).boxes_xyxy, mini.forward_for_search(image)
        mini.gradient_precision = None
        assert torch.equal(mini(image).boxes_xyxy, judged)
        assert torch.equal(mini.forward_for_search(image).boxes_xyxy, judged)
    with torch.enable_grad():
        mini.gradient_precision = precision
        assert torch.equal(mini(image).confidence_logits, glance.confidence_logits)
    assert not glance.confidence_logits.requires_grad


def test_training_mode_uses_the_batch(mini: YoloV3) -> None:
    image = torch.rand(4, 3, 32, 48, generator=torch.Generator().manual_seed(3))
    norm = mini.network.blocks[0].norm
    assert norm is not None
    assert norm.running_mean is not None
    before = norm.running_mean.clone()
    with torch.no_grad():
        evaluated = mini(image).confidence_logits
        assert torch.equal(norm.running_mean, before)
        trained = mini.train()(image).confidence_logits
    assert not torch.allclose(trained, evaluated, atol=1e-3)
    assert not torch.equal(norm.running_mean, before)


def test_poolings_and_routes_by_hand() -> None:
    cfg = parse(
        "[net]\n[maxpool]\nsize=2\nstride=1\n[route]\nlayers=-1,0\n[upsample]\nstride=1\n[convolutional]\n"
        "filters=6\nactivation=linear\n[yolo]\nmask=0\nanchors=2,2\nclasses=1\n"
    )
    network = DarknetNetwork(cfg)
    block = network.blocks[3]
    assert block.conv.bias is not None
    with torch.no_grad():
        block.conv.weight.zero_()
        block.conv.bias.zero_()
        block.conv.weight[0, 3] = 1.0  # the second copy of the first channel
        x = torch.zeros(1, 3, 2, 3)
        x[0, 0] = torch.tensor([[1.0, 5.0, -2.0], [0.0, -3.0, -4.0]])
        (found,) = network(x)
    # A window reaches one px right and below; beyond the edge there is nothing.
    assert found[0, 0].tolist() == [[5.0, 5.0, -2.0], [0.0, -3.0, -4.0]]


@pytest.mark.parametrize(
    ("size", "stride"), [(1, 2), (2, 1), (2, 2), (2, 4), (3, 1), (3, 2), (3, 3), (3, 4), (4, 2), (4, 4), (5, 5)]
)
def test_poolings_begin_where_darknet_s_do(size: int, stride: int) -> None:
    """forward_maxpool_layer of its src/maxpool_layer.c, place by place."""
    side = 3 * stride
    picture = torch.rand(side, side, generator=torch.Generator().manual_seed(0))
    padding = size - 1
    places = (side + padding - size) // stride + 1
    expected = torch.full((places, places), -torch.inf)
    for row in range(places):
        for column in range(places):
            top, left = row * stride - padding // 2, column * stride - padding // 2
            window = picture[max(top, 0) : top + size, max(left, 0) : left + size]
            expected[row, column] = window.max()
    assert torch.equal(_max_pool(picture[None, None], MaxPoolLayer(size, stride))[0, 0], expected)


def test_weights_file_holds_the_cfg(mini: YoloV3, tmp_path: Path) -> None:
    path = tmp_path / "own.safetensors"
    mini.t_star = 0.25
    save_detector(mini, path, {"note": "made for a test"})
    detector = load_detector(path)
    assert isinstance(detector, YoloV3)
    assert write(detector.cfg) == write(mini.cfg)
    assert (detector.classes, detector.t_star) == (mini.classes, 0.25)
    variance, wanted = detector.network.blocks[0].norm, mini.network.blocks[0].norm
    assert variance is not None
    assert wanted is not None
    assert variance.running_var is not None
    assert wanted.running_var is not None
    assert torch.equal(variance.running_var, wanted.running_var)  # not rounded


def test_slim_network_takes_any_size() -> None:
    detector = YoloV3Slim()
    detector.initialise(torch.Generator().manual_seed(0))
    raw = detector(torch.rand(2, 3, 70, 100))
    assert raw.confidence_logits.shape == (2, 3 * (3 * 4 + 6 * 8 + 12 * 16))
    assert float(torch.sigmoid(raw.confidence_logits.detach()).max()) < 0.05  # anchors begin silent, at 0.01
    weights = 2 * sum(p.numel() for p in detector.parameters())
    assert weights < 18e6


def test_training_under_autocast_lowers_the_loss(mini: YoloV3, tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    frames = []
    for _ in range(4):
        image = generator.integers(0, 60, (96, 160, 3), dtype=np.uint8)
        left, top = (int(n) for n in generator.integers(20, 60, 2))
        image[top : top + 24, left : left + 40] = 230
        frames.append((image, targets([[left, top, left + 40, top + 24]], [0])))
    mini.initialise(torch.Generator().manual_seed(0))
    augment = AugmentSettings(window_hw=(64, 96))
    settings = TrainingSettings(
        steps=30, batch=2, warmup_steps=5, rate=1e-2, precision="bfloat16", augment=augment
    )
    losses: list[float] = []
    trained = train(mini, frames, settings, tmp_path, progress=lambda _k, _n, row: losses.append(row["total"]))
    assert not trained.training
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:3])
    mini.requires_grad_(False)
    with torch.autocast("cpu", torch.bfloat16):
        assert mini(torch.rand(1, 3, 32, 48)).boxes_xyxy.dtype == torch.float32
