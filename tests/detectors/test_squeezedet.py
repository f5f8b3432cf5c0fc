"""SqueezeDet: its layers, its anchors, each term of its loss on planted targets, its decoding."""

import math

import pytest
import torch
from torch import Tensor

from detectors import boxes
from detectors.base import AnchorPredictions
from detectors.squeezedet import ANCHOR_SIZES_WH, AnchorAssignment, SqueezeDet, SqueezeDetPlus
from detectors.types import Targets


def fresh(seed: int = 0, classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist")) -> SqueezeDet:
    detector = SqueezeDet(classes=classes)
    detector.initialise(torch.Generator().manual_seed(seed))
    return detector.eval()


def targets(boxes_xyxy: list, labels: list[int], ignore: list[bool] | None = None) -> Targets:
    flags = [False] * len(labels) if ignore is None else ignore
    return Targets(
        torch.tensor(boxes_xyxy, dtype=torch.float32).reshape(-1, 4),
        torch.tensor(labels, dtype=torch.int64),
        torch.tensor(flags, dtype=torch.bool),
    )


def silent(batch: int, height: int, width: int, classes: int = 3) -> dict[str, Tensor]:
    """Predictions of a network that sees nothing: boxes are the anchors, confidence 1e-9 (logit)."""
    rows, columns = -(-height // 16), -(-width // 16)
    count = rows * columns * 9
    index = torch.arange(count)
    size = torch.tensor(ANCHOR_SIZES_WH)[index % 9]
    centre = torch.stack((index // 9 % columns, index // 9 // columns), 1) * 16.0 + 7.5
    return {
        "boxes_xyxy": torch.cat((centre - size / 2, centre + size / 2), 1).repeat(batch, 1, 1),
        "deltas": torch.zeros(batch, count, 4),
        "class_logits": torch.zeros(batch, count, classes),
        "confidence_logits": torch.full((batch, count), -40.0),
    }


def anchor_at(row: int, column: int, shape: int, columns: int) -> int:
    return (row * columns + column) * 9 + shape


def make_raw(parts: dict[str, Tensor], height: int, width: int) -> AnchorPredictions:
    return AnchorPredictions(**parts, image_hw=(height, width))


@pytest.mark.parametrize(
    ("kind", "kernel", "channels", "fires", "published"),
    [  # 7.9 and 26.8 MiB of float32, as in the paper
        (SqueezeDet, 3, 64, ((16, 64), (32, 128), (48, 192), (64, 256), (96, 384)), 2_082_120),
        (SqueezeDetPlus, 7, 96, ((96, 64), (192, 128), (288, 192), (384, 256), (384, 256)), 7_021_640),
    ],
)
def test_parameter_count_is_the_published_one(
    kind: type[SqueezeDet], kernel: int, channels: int, fires: tuple[tuple[int, int], ...], published: int
) -> None:
    # A layer has (in * k * k + 1) * out parameters; a Fire is a squeeze, expand 1x1 and expand 3x3.
    count = (3 * kernel**2 + 1) * channels
    for squeeze, expand in (fire for fire in fires for _ in range(2)):
        count += (channels + 1) * squeeze + (squeeze + 1) * expand + (squeeze * 9 + 1) * expand
        channels = 2 * expand
    count += (channels * 9 + 1) * 9 * (3 + 1 + 4)
    detector = kind(classes=("Car", "Pedestrian", "Cyclist"))
    assert count == published == sum(p.numel() for p in detector.parameters())


def test_anchors_are_the_published_ones() -> None:
    # The comparison is with the numbers of config/kitti_squeezeDet_config.py, in their order.
    published = "36 37 366 174 115 59 162 87 38 90 258 173 224 108 78 170 72 43"
    assert " ".join(f"{number:g}" for size in fresh().anchors for number in size) == published
    assert SqueezeDetPlus().anchors == fresh().anchors


def test_squeezedet_plus_sees_images_of_any_size() -> None:
    plus = SqueezeDetPlus(classes=("Car",))
    plus.initialise(torch.Generator().manual_seed(0))
    for height, width, cells in ((64, 65, 20), (16, 16, 1), (50, 70, 20)):
        with torch.no_grad():
            assert plus.eval()(torch.zeros(1, 3, height, width)).confidence_logits.shape == (1, 9 * cells)


def test_any_number_of_anchors() -> None:
    detector = SqueezeDet(classes=("Car", "Truck"), anchors=[(40, 30), (90.5, 61.0)])
    detector.initialise(torch.Generator().manual_seed(0))
    assert detector.convdet.out_channels == 2 * (2 + 1 + 4)
    torch.nn.init.zeros_(detector.convdet.weight)
    # The channels of the two confidences follow those of 2 x 2 class scores.
    assert detector.convdet.bias.tolist() == [0, 0, 0, 0, -2, -2, 0, 0, 0, 0, 0, 0, 0, 0]
    detector.eval()
    raw = detector(torch.rand(1, 3, 33, 48))
    # second cell of the third row, second anchor
    centre, index = (16 + 7.5, 32 + 7.5), (2 * 3 + 1) * 2 + 1
    assert raw.boxes_xyxy.shape == (1, 3 * 3 * 2, 4)
    expected = [centre[0] - 45.25, centre[1] - 30.5, centre[0] + 45.25, centre[1] + 30.5]
    assert raw.boxes_xyxy[0, index].tolist() == expected
    assigned = detector.assign(raw, [targets([expected], [1])])
    assert assigned.anchor.tolist() == [index]
    assert assigned.deltas.tolist() == [[0.0, 0.0, 0.0, 0.0]]


@pytest.mark.parametrize("anchors", [[], [(10.0,)], [(10.0, 0.0)], [(10.0, math.inf)], [(1.0, 2.0, 3.0)]])
def test_anchors_that_are_no_sizes_are_refused(anchors: list) -> None:
    with pytest.raises(ValueError, match="anchors: expected pairs of positive px"):
        SqueezeDet(anchors=anchors)


@pytest.mark.parametrize(
    ("height", "width", "rows", "columns"),
    [(384, 1248, 24, 78), (375, 1242, 24, 78), (64, 65, 4, 5), (16, 16, 1, 1)],
)
def test_grid(height: int, width: int, rows: int, columns: int) -> None:
    with torch.no_grad():
        raw = fresh()(torch.zeros(1, 3, height, width))
    assert raw.boxes_xyxy.shape == (1, 9 * rows * columns, 4)
    assert raw.class_logits.shape == (1, 9 * rows * columns, 3)
    assert raw.image_hw == (height, width)


def test_zero_deltas_are_the_anchors() -> None:
    detector = fresh()
    torch.nn.init.zeros_(detector.convdet.weight)
    torch.nn.init.zeros_(detector.convdet.bias)
    with torch.no_grad():
        raw = detector(torch.rand(2, 3, 50, 70))
    torch.testing.assert_close(raw.boxes_xyxy, silent(2, 50, 70)["boxes_xyxy"])
    # second cell of the second row, fourth shape: 162 x 87 around (23.5, 23.5)
    box = raw.boxes_xyxy[0, anchor_at(1, 1, 3, 5)]
    assert box.tolist() == [23.5 - 81, 23.5 - 43.5, 23.5 + 81, 23.5 + 43.5]


def test_box_regression_and_safe_exponential() -> None:
    detector = fresh()
    torch.nn.init.zeros_(detector.convdet.weight)
    bias = torch.zeros(72)
    bias[36:40] = torch.tensor([0.25, -0.5, math.log(2.0), 2.0])  # first shape, 36 x 37
    with torch.no_grad():
        detector.convdet.bias.copy_(bias)
        box = detector(torch.zeros(1, 3, 16, 16)).boxes_xyxy[0, 0]
    width, height = 72.0, 37 * math.e * 2.0  # the tangent of exp at 1 is e * x
    expected = [7.5 + 9 - width / 2, 7.5 - 18.5 - height / 2, 7.5 + 9 + width / 2, 7.5 - 18.5 + height / 2]
    torch.testing.assert_close(box, torch.tensor(expected))


def test_channel_order_is_classes_confidence_boxes() -> None:
    detector = fresh()
    torch.nn.init.zeros_(detector.convdet.weight)
    with torch.no_grad():
        detector.convdet.bias.copy_(torch.arange(72.0) / 100)
        raw = detector(torch.zeros(1, 3, 16, 16))
    torch.testing.assert_close(raw.class_logits[0], (torch.arange(27.0) / 100).reshape(9, 3))
    torch.testing.assert_close(raw.confidence_logits[0], torch.arange(27.0, 36.0) / 100)
    torch.testing.assert_close(raw.deltas[0], (torch.arange(36.0, 72.0) / 100).reshape(9, 4))


def test_padding_adds_mean_colour_only() -> None:
    detector = fresh()
    image = torch.rand(1, 3, 41, 55, generator=torch.Generator().manual_seed(2))
    mean_rgb = torch.tensor([123.68, 116.779, 103.939]).view(1, 3, 1, 1) / 255
    padded = mean_rgb.expand(1, 3, 48, 64).clone()
    padded[..., :41, :55] = image
    with torch.no_grad():
        small, large = detector(image), detector(padded)
    torch.testing.assert_close(small.confidence_logits, large.confidence_logits, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(small.boxes_xyxy, large.boxes_xyxy, rtol=1e-4, atol=1e-3)


def test_channels_are_read_as_rgb() -> None:
    detector = fresh()
    with torch.no_grad():
        detector.conv1.weight.zero_()
        detector.conv1.weight[0, 2] = 1.0  # third channel of the network is red
        first = detector.conv1(torch.zeros(1, 3, 3, 3))
    seen: list[Tensor] = []
    handle = detector.conv1.register_forward_hook(lambda _m, inputs, _o: seen.append(inputs[0]))
    red = torch.zeros(1, 3, 16, 16)
    red[:, 0] = 1.0
    with torch.no_grad():
        detector(red)
    handle.remove()
    assert first.shape[1] == 64
    expected = torch.tensor([-103.939, -116.779, 255 - 123.68])
    torch.testing.assert_close(seen[0][0, :, 0, 0], expected)


def test_confidence_term_by_hand() -> None:
    parts = silent(1, 64, 160)
    at = anchor_at(2, 5, 8, 10)  # 72 x 43 around (87.5, 39.5)
    truth = parts["boxes_xyxy"][0, at].clone()
    # The predicted box is 18 px further right than the true one: IoU = 54 / 90 = 0.6.
    parts["boxes_xyxy"][0, at] += torch.tensor([18.0, 0, 18.0, 0])
    parts["confidence_logits"][0, at] = 0.0  # 0.5
    other = anchor_at(0, 0, 0, 10)
    parts["confidence_logits"][0, other] = math.log(0.2 / 0.8)
    raw = make_raw(parts, 64, 160)
    terms = fresh().loss(raw, [targets([truth.tolist()], [0])])
    silent_anchors = 9 * 4 * 10 - 1
    expected = 75 * (0.5 - 0.6) ** 2 / 1 + 100 * 0.2**2 / silent_anchors
    assert terms["confidence"].item() == pytest.approx(expected, rel=1e-4)


def test_confidence_term_of_a_batch_by_hand() -> None:
    parts = silent(4, 64, 160)
    at, other = anchor_at(2, 5, 8, 10), anchor_at(0, 0, 0, 10)
    truth = parts["boxes_xyxy"][0, at].tolist()  # met exactly: IoU 1
    parts["confidence_logits"][0, at] = 0.0  # 0.5
    parts["confidence_logits"][1, at] = 40.0  # 1.0
    parts["confidence_logits"][3, other] = math.log(0.2 / 0.8)
    wanted = [targets([truth], [0]), targets([truth], [0]), targets([], []), targets([], [])]
    terms = fresh().loss(make_raw(parts, 64, 160), wanted)
    # Two objects in the batch, 360 anchors an image, four images.
    expected = (75 * (0.5 - 1.0) ** 2 / 2 + 100 * 0.2**2 / (360 - 2)) / 4
    assert terms["confidence"].item() == pytest.approx(expected, rel=1e-4)


def test_objectness_by_hand() -> None:
    # One object, whose responsible box is 18 px off (IoU 0.6), at confidence 0.4; another anchor's box meets it at
    # confidence 0.7: as published it should be silent, but it is no false alarm; one of these elsewhere, at 0.2.
    parts = silent(1, 64, 160)
    at, other = anchor_at(2, 5, 8, 10), anchor_at(0, 0, 0, 10)
    truth = parts["boxes_xyxy"][0, at].tolist()
    parts["boxes_xyxy"][0, at] += torch.tensor([18.0, 0, 18.0, 0])
    parts["confidence_logits"][0, at] = math.log(0.4 / 0.6)
    parts["confidence_logits"][0, other] = math.log(0.2 / 0.8)
    second = anchor_at(2, 5, 0, 10)
    parts["boxes_xyxy"][0, second] = torch.tensor(truth)
    parts["confidence_logits"][0, second] = math.log(0.7 / 0.3)
    terms = fresh().loss(make_raw(parts, 64, 160), [targets([truth], [0])])
    unseen, missed = 75 * (1 - 0.7) ** 2, 75 * (0.6 - 0.4) ** 2
    assert terms["objectness"].item() == pytest.approx(unseen + 100 * 0.2**2 / (360 - 1), rel=1e-4)
    assert terms["confidence"].item() == pytest.approx(missed + 100 * (0.2**2 + 0.7**2) / (360 - 1), rel=1e-4)


def test_objectness_of_a_batch_by_hand() -> None:
    parts = silent(2, 64, 160)
    at, other = anchor_at(2, 5, 8, 10), anchor_at(0, 0, 0, 10)
    truth = parts["boxes_xyxy"][0, at].tolist()
    parts["confidence_logits"][0, at] = math.log(0.4 / 0.6)
    parts["confidence_logits"][1, other] = math.log(0.2 / 0.8)
    wanted = [targets([truth], [0]), targets([truth], [0])]  # the second is not seen at all
    terms = fresh().loss(make_raw(parts, 64, 160), wanted)
    expected = (75 * ((1 - 0.4) ** 2 + 1) / 2 + 100 * 0.2**2 / (360 - 2)) / 2
    assert terms["objectness"].item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("shift", "meets"), [(22.0, True), (25.0, False)])
def test_a_box_meets_an_object_from_half_an_overlap_on(shift: float, meets: bool) -> None:
    # Of 72 px wide boxes that lie 22 and 25 px apart: IoU 50 / 94 and 47 / 97.
    parts = silent(1, 64, 160)
    at = anchor_at(2, 5, 8, 10)
    truth = parts["boxes_xyxy"][0, at].tolist()
    parts["boxes_xyxy"][0, at] += torch.tensor([shift, 0, shift, 0])
    parts["confidence_logits"][0, at] = math.log(0.4 / 0.6)
    terms = fresh().loss(make_raw(parts, 64, 160), [targets([truth], [0])])
    assert terms["objectness"].item() == pytest.approx(75 * (0.6**2 if meets else 1.0), rel=1e-4)


@pytest.mark.parametrize(("covered", "excused"), [(0.55, True), (0.45, False)])
def test_an_ignored_region_excuses_what_it_covers_by_half(covered: float, excused: bool) -> None:
    parts = silent(1, 64, 160)
    at = anchor_at(2, 5, 0, 10)  # 36 x 37
    left, top, _, bottom = parts["boxes_xyxy"][0, at].tolist()
    region = [left, top, left + 36 * covered, bottom]
    assigned = fresh().assign(make_raw(parts, 64, 160), [targets([region], [0], [True])])
    assert bool(assigned.negative[0, at]) is not excused


def test_box_and_class_terms_by_hand() -> None:
    parts = silent(1, 64, 160)
    at = anchor_at(2, 5, 8, 10)
    # 144 wide (log-size ln 2), 43 high, centre moved by (7.2, -4.3) = (0.1, -0.1) anchor sizes
    truth = [87.5 + 7.2 - 72, 39.5 - 4.3 - 21.5, 87.5 + 7.2 + 72, 39.5 - 4.3 + 21.5]
    iou = boxes.iou_matrix(torch.tensor([truth]), parts["boxes_xyxy"][0])
    at = int(iou.argmax())
    anchor = parts["boxes_xyxy"][0, at]
    size = anchor[2:] - anchor[:2]
    shift = (torch.tensor(truth[:2]) + torch.tensor(truth[2:]) - anchor[:2] - anchor[2:]) / 2 / size
    scale = torch.log(torch.tensor([144.0, 43.0]) / size)
    parts["deltas"][0, at] = torch.tensor([0.3, 0.0, -0.2, 0.1])
    parts["class_logits"][0, at] = torch.tensor([1.0, 2.0, 3.0])
    terms = fresh().loss(make_raw(parts, 64, 160), [targets([truth], [2])])
    wanted = torch.cat((shift, scale))
    box = 5 * float((torch.tensor([0.3, 0.0, -0.2, 0.1]) - wanted).square().sum())
    cross_entropy = math.log(math.exp(1) + math.exp(2) + math.exp(3)) - 3
    assert terms["box"].item() == pytest.approx(box, rel=1e-4)
    assert terms["class"].item() == pytest.approx(cross_entropy, rel=1e-5)
    assert terms["total"].item() == pytest.approx(sum(terms[k].item() for k in ("confidence", "box", "class")))


def test_terms_are_means_over_all_objects_of_the_batch() -> None:
    parts = silent(2, 64, 160)
    first, second = anchor_at(2, 5, 8, 10), anchor_at(2, 2, 8, 10)
    boxes_xyxy = parts["boxes_xyxy"][0]
    parts["deltas"][0, first, 0] = 0.5
    terms = fresh().loss(
        make_raw(parts, 64, 160),
        [targets([boxes_xyxy[first].tolist(), boxes_xyxy[second].tolist()], [0, 0]), targets([], [])],
    )
    assert terms["box"].item() == pytest.approx(5 * 0.5**2 / 2)
    assert terms["class"].item() == pytest.approx(math.log(3))


def test_target_of_the_box_is_what_decoding_hits() -> None:
    parts = silent(1, 64, 160)
    truth = torch.tensor([10.0, 5.0, 150.0, 60.0])
    raw = make_raw(parts, 64, 160)
    detector = fresh()
    wanted = detector.assign(raw, [targets([truth.tolist()], [1])])
    torch.nn.init.zeros_(detector.convdet.weight)
    bias = torch.zeros(9 * 8)
    shape = int(wanted.anchor[0]) % 9
    bias[36 + 4 * shape : 40 + 4 * shape] = wanted.deltas[0]
    with torch.no_grad():
        detector.convdet.bias.copy_(bias)
        box = detector(torch.zeros(1, 3, 64, 160)).boxes_xyxy[0, wanted.anchor[0]]
    torch.testing.assert_close(box, truth, rtol=1e-5, atol=1e-3)


def test_each_object_has_an_anchor_of_its_own() -> None:
    parts = silent(1, 64, 160)
    box = parts["boxes_xyxy"][0, anchor_at(2, 5, 8, 10)].tolist()
    outside = [4000.0, 4000.0, 4010.0, 4010.0]  # overlaps nothing: the nearest anchor
    assigned = fresh().assign(make_raw(parts, 64, 160), [targets([box, box, outside, outside], [0, 0, 0, 0])])
    assert len(set(assigned.anchor.tolist())) == 4
    overlap = boxes.iou_matrix(torch.tensor([box]), parts["boxes_xyxy"][0])[0]
    assert overlap[assigned.anchor[:2]].tolist() == pytest.approx(overlap.topk(2).values.tolist())
    assert int(assigned.anchor[2]) // 9 == 39  # last cell
    assert not assigned.negative[0, assigned.anchor].any()


def test_ignored_objects_have_no_positive_and_silence_no_anchor() -> None:
    parts = silent(1, 64, 160)
    at = anchor_at(2, 5, 8, 10)
    box = parts["boxes_xyxy"][0, at].tolist()
    parts["confidence_logits"][0, at] = 3.0
    raw = make_raw(parts, 64, 160)
    detector = fresh()
    punished = detector.loss(raw, [targets([], [])])["confidence"].item()
    excused = detector.loss(raw, [targets([box], [0], [True])])
    assert punished == pytest.approx(100 / 360 * torch.sigmoid(torch.tensor(3.0)).item() ** 2, rel=1e-4)
    assert excused["confidence"].item() == pytest.approx(0, abs=1e-12)
    assert excused["box"].item() == 0
    assert excused["class"].item() == 0
    # A wide region excuses small anchors inside it, by the share of the anchor that it covers.
    region = detector.assign(raw, [targets([[0.0, 0.0, 80.0, 64.0]], [0], [True])])
    inside, beyond = anchor_at(2, 2, 0, 10), anchor_at(2, 8, 0, 10)
    assert not bool(region.negative[0, inside])
    assert bool(region.negative[0, beyond])


def test_ignored_object_excuses_the_box_predicted_over_it() -> None:
    parts = silent(1, 64, 160)
    at = anchor_at(2, 5, 0, 10)  # 36 x 37: too large for the small box below
    small = torch.tensor([80.0, 34.0, 92.0, 44.0])
    parts["boxes_xyxy"][0, at] = small
    assigned = fresh().assign(make_raw(parts, 64, 160), [targets([small.tolist()], [0], [True])])
    assert not bool(assigned.negative[0, at])


def test_targets_that_do_not_fit_are_refused() -> None:
    detector, raw = fresh(), make_raw(silent(2, 32, 32), 32, 32)
    with pytest.raises(ValueError, match=r"targets: expected 2, one for each image, found 1"):
        detector.loss(raw, [targets([], [])])
    with pytest.raises(ValueError, match=r"targets\.labels: expected 0\.\.2, found \[3\]"):
        detector.loss(raw, [targets([[0, 0, 9, 9]], [3]), targets([], [])])
    with pytest.raises(ValueError, match=r"images: expected shape \(B, 3, H, W\)"):
        detector(torch.zeros(3, 32, 32))


def test_decode_planted_predictions() -> None:
    parts = silent(2, 64, 160)
    left, right, near = anchor_at(2, 1, 8, 10), anchor_at(2, 8, 8, 10), anchor_at(2, 7, 8, 10)
    for at, confidence, logits in [
        (left, 0.9, [4.0, 0.0, 0.0]),
        (right, 0.8, [0.0, 4.0, 0.0]),
        (near, 0.7, [0.0, 4.0, 0.0]),  # IoU 56/88 with `right`, same class: suppressed
    ]:
        parts["confidence_logits"][1, at] = math.log(confidence / (1 - confidence))
        parts["class_logits"][1, at] = torch.tensor(logits)
    # Another class at the place of `left`, and one below the lowest score.
    weak, other = anchor_at(0, 4, 1, 10), anchor_at(2, 1, 2, 10)
    parts["boxes_xyxy"][1, other] = parts["boxes_xyxy"][1, left]
    parts["confidence_logits"][1, other], parts["class_logits"][1, other] = 0.0, torch.tensor([0.0, 0.0, 9.0])
    parts["confidence_logits"][1, weak] = math.log(0.014 / 0.986)  # times 1/3
    nothing, found = fresh().decode(make_raw(parts, 64, 160))
    assert len(nothing) == 0
    share = math.exp(4) / (math.exp(4) + 2)
    assert found.labels.tolist() == [0, 1, 2]
    assert found.scores.tolist() == pytest.approx(
        [0.9 * share, 0.8 * share, 0.5 * math.exp(9) / (math.exp(9) + 2)]
    )
    assert found.boxes_xyxy[0].tolist() == [0.0, 39.5 - 21.5, 23.5 + 36, 39.5 + 21.5]
    assert found.boxes_xyxy[1, 2] == 159


@pytest.mark.parametrize(("shift", "count"), [(33.4, 1), (36.4, 2)])
def test_decode_suppresses_from_an_overlap_of_a_third_on(shift: float, count: int) -> None:
    # 72 px wide boxes: IoU 38.6 / 105.4 = 0.37 and 35.6 / 108.4 = 0.33
    parts = silent(1, 64, 160)
    for at, left, confidence in ((40, 10.0, 0.9), (80, 10.0 + shift, 0.8)):
        parts["boxes_xyxy"][0, at] = torch.tensor([left, 10.0, left + 72, 50.0])
        parts["confidence_logits"][0, at] = math.log(confidence / (1 - confidence))
    (found,) = fresh().decode(make_raw(parts, 64, 160))
    assert len(found) == count


def test_decode_keeps_scores_from_a_two_hundredth_on() -> None:
    parts = silent(1, 64, 160)
    for at, confidence in ((40, 0.0052), (2000 // 9, 0.0048)):
        parts["confidence_logits"][0, at] = math.log(confidence / (1 - confidence))
        parts["class_logits"][0, at, 1] = 20.0
    (found,) = fresh().decode(make_raw(parts, 64, 160))
    assert found.scores.tolist() == pytest.approx([0.0052], rel=1e-3)


def test_decode_returns_at_most_1024() -> None:
    parts = silent(1, 256, 256)
    parts["confidence_logits"][:] = 2.0
    count = torch.arange(len(parts["boxes_xyxy"][0]))
    corner = torch.stack((count % 50 * 5.0, count // 50 * 5.0), 1)  # none touches another
    parts["boxes_xyxy"][0] = torch.cat((corner, corner + 4.0), 1)
    assert len(fresh().decode(make_raw(parts, 256, 256))[0]) == 1024


def test_gradient_to_the_image_agrees_with_differences() -> None:
    detector = fresh(3).double().requires_grad_(False)
    generator = torch.Generator().manual_seed(4)
    image = torch.rand(1, 3, 40, 52, dtype=torch.float64, generator=generator)
    wanted = [targets([[5.0, 5.0, 35.0, 30.0], [20.0, 10.0, 50.0, 38.0]], [0, 2], [False, False])]
    assignment: AnchorAssignment = detector.assign(detector(image), wanted)

    def total(x: Tensor) -> Tensor:
        return detector.loss_terms(detector(x), assignment)["total"]

    x = image.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(total(x), x)
    directions = torch.randn(12, *image.shape, dtype=torch.float64, generator=generator)
    step = 1e-7
    numeric = torch.stack([(total(image + step * d) - total(image - step * d)) / (2 * step) for d in directions])
    analytic = (directions * gradient).sum((1, 2, 3, 4))
    torch.testing.assert_close(analytic, numeric, rtol=1e-4, atol=1e-4 * float(numeric.abs().max()))


def test_frozen_detector_gives_a_gradient_to_the_image_only() -> None:
    detector = fresh().requires_grad_(False)
    image = torch.rand(1, 3, 48, 64).requires_grad_()
    detector.loss(detector(image), [targets([[5.0, 5.0, 40.0, 30.0]], [0])])["confidence"].backward()
    assert image.grad is not None
    assert float(image.grad.abs().sum()) > 0
    assert all(p.grad is None for p in detector.parameters())


def test_only_dropout_depends_on_the_mode() -> None:
    detector, image = fresh(), torch.rand(1, 3, 48, 64)
    detector.dropout.probability = 0.0
    with torch.no_grad():
        evaluated = detector.eval()(image).confidence_logits
        assert torch.equal(detector.train()(image).confidence_logits, evaluated)
        detector.dropout.probability = 0.5
        detector.dropout.generator = torch.Generator().manual_seed(0)
        first = detector(image).confidence_logits
        detector.dropout.generator.manual_seed(0)
        assert torch.equal(detector(image).confidence_logits, first)
        assert not torch.equal(first, evaluated)


def test_dropout_keeps_the_mean() -> None:
    dropout = SqueezeDet().dropout.train()
    dropout.probability, dropout.generator = 0.25, torch.Generator().manual_seed(0)
    dropped = dropout(torch.ones(3, 5, 7, 101))
    assert sorted(dropped.unique().tolist()) == pytest.approx([0.0, 1 / 0.75])
    assert dropped.mean().item() == pytest.approx(1.0, abs=0.03)


def test_bfloat16_autocast_still_gives_float32_boxes() -> None:
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        raw = fresh()(torch.rand(1, 3, 32, 48))
    assert raw.boxes_xyxy.dtype == torch.float32


def test_backbone_of_another_shape_is_refused() -> None:
    detector = SqueezeDet()
    tensors = dict(detector.state_dict())
    detector.load_backbone({k: v for k, v in tensors.items() if "fire10" not in k})
    with pytest.raises(ValueError, match=r"backbone: conv1\.weight: expected shape .* found none"):
        detector.load_backbone({k: v for k, v in tensors.items() if k != "conv1.weight"})
