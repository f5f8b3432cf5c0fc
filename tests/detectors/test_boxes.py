"""Overlaps, clipping and suppression of boxes, against plain loops."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from detectors import boxes


def random_boxes(generator: torch.Generator, count: int) -> Tensor:
    corner = torch.rand(count, 2, generator=generator) * 80
    return torch.cat((corner, corner + torch.rand(count, 2, generator=generator) * 40), 1)


def plain_iou(a: list[float], b: list[float]) -> float:
    width = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
    height = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - width * height
    return width * height / union if union > 0 else 0.0


@pytest.mark.parametrize(
    ("first", "second", "iou", "ioa"),
    [
        ((0, 0, 10, 10), (0, 0, 10, 10), 1.0, 1.0),
        ((0, 0, 10, 10), (5, 0, 15, 10), 1 / 3, 0.5),
        ((0, 0, 10, 10), (10, 0, 20, 10), 0.0, 0.0),
        ((2, 2, 4, 4), (0, 0, 10, 10), 0.04, 1.0),
        ((0, 0, 10, 10), (2, 2, 4, 4), 0.04, 0.04),
        ((3, 3, 3, 9), (0, 0, 10, 10), 0.0, 0.0),
        ((3, 3, 3, 3), (3, 3, 3, 3), 0.0, 0.0),
    ],
)
def test_overlap_by_hand(first: tuple, second: tuple, iou: float, ioa: float) -> None:
    a, b = torch.tensor([first], dtype=torch.float32), torch.tensor([second], dtype=torch.float32)
    assert boxes.iou_matrix(a, b).item() == pytest.approx(iou)
    assert boxes.ioa_matrix(a, b).item() == pytest.approx(ioa)
    assert boxes.paired_iou(a, b).item() == pytest.approx(iou)


def test_iou_matrix_equals_plain_loop() -> None:
    generator = torch.Generator().manual_seed(1)
    a, b = random_boxes(generator, 7), random_boxes(generator, 11)
    plain = torch.tensor([[plain_iou(x, y) for y in b.tolist()] for x in a.tolist()])
    torch.testing.assert_close(boxes.iou_matrix(a, b), plain)
    torch.testing.assert_close(boxes.paired_iou(a, b[:7]), plain[:, :7].diagonal())


def test_empty_sets_keep_their_shape() -> None:
    none = torch.zeros(0, 4)
    some = torch.rand(3, 4)
    assert boxes.iou_matrix(none, some).shape == (0, 3)
    assert boxes.ioa_matrix(some, none).shape == (3, 0)
    assert boxes.nms(none, torch.zeros(0), 0.5).tolist() == []


def test_clip_keeps_boxes_on_pixels() -> None:
    clipped = boxes.clip(torch.tensor([[-5.0, 3.0, 50.0, 400.0]]), height=100, width=40)
    assert clipped.tolist() == [[0.0, 3.0, 39.0, 99.0]]


def plain_nms(all_boxes: list, scores: list, threshold: float, labels: list) -> list[int]:
    selected: list[int] = []
    for i in sorted(range(len(scores)), key=lambda i: -scores[i]):
        rivals = [k for k in selected if labels[k] == labels[i]]
        if all(plain_iou(all_boxes[i], all_boxes[k]) <= threshold for k in rivals):
            selected.append(i)
    return selected


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(0, 40), threshold=st.sampled_from([0.1, 0.4, 0.7]))
def test_nms_equals_brute_force(seed: int, count: int, threshold: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    all_boxes = random_boxes(generator, count).double()
    scores = torch.randint(0, 12, (count,), generator=generator).double() / 12  # ties on purpose
    labels = torch.randint(0, 3, (count,), generator=generator)
    expected = plain_nms(all_boxes.tolist(), scores.tolist(), threshold, labels.tolist())
    assert boxes.nms(all_boxes, scores, threshold, labels).tolist() == expected
    unlabelled = plain_nms(all_boxes.tolist(), scores.tolist(), threshold, [0] * count)
    assert boxes.nms(all_boxes, scores, threshold).tolist() == unlabelled


def test_generalised_iou_by_hand() -> None:
    first = torch.tensor([[0.0, 0.0, 10.0, 10.0], [0.0, 0.0, 10.0, 10.0], [0.0, 0.0, 2.0, 2.0]])
    second = torch.tensor([[0.0, 0.0, 10.0, 10.0], [5.0, 0.0, 15.0, 10.0], [6.0, 0.0, 8.0, 2.0]])
    # the same; half and half: 50 of 150, nothing left open; apart: 8 of a hull of 16
    assert boxes.paired_giou(first, second).tolist() == pytest.approx([1.0, 1 / 3, -0.5])


def test_generalised_iou_draws_boxes_together_that_do_not_meet() -> None:
    box = torch.tensor([[0.0, 0.0, 2.0, 2.0]], requires_grad=True)
    boxes.paired_giou(box, torch.tensor([[6.0, 0.0, 8.0, 2.0]])).sum().backward()
    assert box.grad is not None
    assert float(box.grad[0, 2]) > 0
