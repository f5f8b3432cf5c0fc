"""The shared loss and decoding of dense detectors, with values computed by hand."""

import pytest
import torch

from detectors.adapters.dense import CANDIDATES, DensePredictions, dense_loss
from detectors.types import Targets

CLASSES = ("person", "Car", "bus")
CAR = 1
PLACES = torch.tensor([[0.0, 0, 40, 20], [2, 0, 42, 20], [60, 0, 90, 20], [0, 40, 30, 60]])


def predictions(rows: list[list[float]]) -> DensePredictions:
    return DensePredictions(PLACES[None, :, None], torch.tensor(rows)[None], (64, 96))


def make_targets(*boxes: tuple[list[float], int, bool]) -> list[Targets]:
    return [
        Targets(
            torch.tensor([b for b, _, _ in boxes]).view(-1, 4),
            torch.tensor([label for _, label, _ in boxes], dtype=torch.int64),
            torch.tensor([ignore for _, _, ignore in boxes], dtype=torch.bool),
        )
    ]


ROWS = [[0.1, 0.3, 0.0], [0.0, 0.6, 0.9], [0.0, 0.5, 0.0], [0.2, 0.1, 0.0]]


def test_object_counts_by_its_most_probable_match() -> None:
    terms = dense_loss(predictions(ROWS), make_targets(([0.0, 0, 40, 20], CAR, False)), CLASSES)
    # 0.6 of the two that meet it; alarms: Car of the other two, out of four; persons and buses are not labelled
    assert float(terms["missed"]) == pytest.approx(75 * 0.4**2)
    assert float(terms["alarms"]) == pytest.approx(100 * (0.5**2 + 0.1**2) / 4)
    assert float(terms["objectness"]) == pytest.approx(float(terms["missed"] + terms["alarms"]))
    assert terms["total"] is terms["objectness"]


def test_other_classes_do_not_match() -> None:
    terms = dense_loss(
        predictions(ROWS), make_targets(([0.0, 0, 40, 20], 2, False), ([300.0, 0, 340, 20], CAR, False)), CLASSES
    )
    # a bus at 0.9, and a car that nothing meets
    assert float(terms["missed"]) == pytest.approx(75 * (0.1**2 + 1) / 2)


def test_ignored_regions_are_neither_objects_nor_alarms() -> None:
    region = ([55.0, -5, 95, 30], CAR, True)
    terms = dense_loss(predictions(ROWS), make_targets(([0.0, 0, 40, 20], CAR, False), region), CLASSES)
    assert float(terms["missed"]) == pytest.approx(75 * 0.4**2)
    assert float(terms["alarms"]) == pytest.approx(100 * 0.1**2 / 4)
    alone = dense_loss(predictions(ROWS), make_targets(region), CLASSES)
    assert float(alone["missed"]) == 0
    assert float(alone["alarms"]) == pytest.approx(100 * (0.3**2 + 0.6**2 + 0.1**2) / 4)


def test_no_objects_and_no_predictions() -> None:
    assert float(dense_loss(predictions(ROWS), make_targets(), CLASSES)["missed"]) == 0
    none = DensePredictions(torch.zeros(1, 0, 1, 4), torch.zeros(1, 0, 3), (64, 96))
    assert float(dense_loss(none, make_targets(([0.0, 0, 40, 20], CAR, False)), CLASSES)["objectness"]) == 75


def test_loss_does_not_depend_on_the_rest_of_the_batch() -> None:
    """Two predictions of a picture, four of the one beside it: two rows only fill up."""
    few, many = torch.tensor(ROWS[:2]), torch.tensor(ROWS)
    filled = torch.stack([torch.cat((few, torch.zeros(2, 3))), many])
    places = torch.stack([PLACES * torch.tensor([1.0, 1, 0, 0])[:, None], PLACES])[:, :, None]
    raw = DensePredictions(places, filled, (64, 96), counts=(2, 4))
    alone = [DensePredictions(PLACES[None, :2, None], few[None], (64, 96)), predictions(ROWS)]
    targets = make_targets(([60.0, 0, 90, 20], CAR, False))
    losses = [dense_loss(one, targets, CLASSES)["objectness"] for one in alone]
    for image, (one, loss) in enumerate(zip(alone, losses, strict=True)):
        own = raw.select(image)
        assert torch.equal(own.probabilities, one.probabilities)
        assert torch.equal(own.boxes_xyxy, one.boxes_xyxy)
        assert torch.equal(dense_loss(own, targets, CLASSES)["objectness"], loss)
    both = dense_loss(raw, targets * 2, CLASSES)["objectness"]
    assert float(both) == pytest.approx(float(torch.stack(losses).mean()))
    for counts in ((2,), (2, 3), (2, 5)):
        with pytest.raises(ValueError, match="counts: expected 2, the largest of them 4, found"):
            DensePredictions(places, filled, (64, 96), counts=counts)


def test_injection_into_empty_predictions() -> None:
    box = torch.tensor([10.0, 10, 50, 30])
    empty = DensePredictions(torch.zeros(1, 0, 1, 4), torch.zeros(1, 0, 3), (64, 96)).inject(box, CAR)
    padded = DensePredictions(
        PLACES[None, :, None].repeat(2, 1, 1, 1), torch.tensor([ROWS, ROWS]), (64, 96), counts=(0, 4)
    ).inject(box, CAR)
    for raw in (empty, padded.select(0), padded.select(1)):
        assert torch.equal(raw.boxes_xyxy[0, 0, 0], box)
        assert raw.probabilities.nonzero().tolist() == [[0, 0, CAR]]


def test_each_class_may_have_its_own_box() -> None:
    own = PLACES[None, :, None].repeat(1, 1, 3, 1)
    own[:, :, CAR] += 200
    raw = DensePredictions(own, torch.tensor(ROWS)[None], (300, 300))
    assert float(dense_loss(raw, make_targets(([0.0, 0, 40, 20], CAR, False)), CLASSES)["missed"]) == 75
    moved = dense_loss(raw, make_targets(([200.0, 200, 240, 220], CAR, False)), CLASSES)
    assert float(moved["missed"]) == pytest.approx(12)


def test_raising_the_loss_hides_the_object() -> None:
    probabilities = torch.tensor(ROWS)[None].requires_grad_()
    raw = DensePredictions(PLACES[None, :, None], probabilities, (64, 96))
    dense_loss(raw, make_targets(([0.0, 0, 40, 20], CAR, False)), CLASSES)["objectness"].backward()
    assert probabilities.grad is not None
    expected = torch.zeros(4, 3)
    expected[1, CAR] = -2 * 75 * 0.4
    expected[2, CAR], expected[3, CAR] = 2 * 100 * 0.5 / 4, 2 * 100 * 0.1 / 4
    torch.testing.assert_close(probabilities.grad[0], expected)


def test_targets_that_do_not_fit() -> None:
    with pytest.raises(ValueError, match="targets: expected 1, one for each image, found 2"):
        dense_loss(predictions(ROWS), make_targets() * 2, CLASSES)
    with pytest.raises(ValueError, match=r"targets.labels: expected 0..2, found \[3\]"):
        dense_loss(predictions(ROWS), make_targets(([0.0, 0, 40, 20], 3, False)), CLASSES)
    with pytest.raises(ValueError, match="boxes_xyxy: expected shape"):
        DensePredictions(torch.zeros(1, 4, 2, 4), torch.zeros(1, 4, 3), (64, 96))


def test_decoding_suppresses_in_each_class_and_stays_fast() -> None:
    from detectors.adapters.dense import decode_one

    found = decode_one(predictions(ROWS), 0, 0.05, 0.5)
    assert [(int(k), round(float(s), 2)) for k, s in zip(found.labels, found.scores, strict=True)] == [
        (2, 0.9),
        (1, 0.6),
        (1, 0.5),
        (0, 0.2),
        (0, 0.1),
        (1, 0.1),
    ]
    many = torch.rand(1, 20 * CANDIDATES, 1, 4, generator=torch.Generator().manual_seed(0)) * 20
    many[..., 2:] += many[..., :2]
    crowd = DensePredictions(many, torch.full((1, 20 * CANDIDATES, 1), 0.5), (64, 96))
    assert 0 < len(decode_one(crowd, 0, 0.05, 0.5)) <= 100
