"""Labels find places at their boxes where they do not hide each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivesem.reporting.drawing import (
    DETECTED_COLOUR,
    LOST_COLOUR,
    TEXT_PX,
    LabelLayout,
    PixelRect,
    TextLabel,
    measure_text,
)
from drivesem.run.report.pictures import draw_overlay
from drivesem.run.results import BoxRecord, Failure

SIZE_WH = (640, 300)
RED = (255, 0, 0)
TEXTS = ("Car 0.75", "Car missed: confirmed", "phantom Car where something is: threshold", "[7]")
FEW = 5
"""So many labels at any boxes that have their surroundings in the picture always find room."""

coordinates = st.tuples(st.integers(-40, 680), st.integers(-40, 340), st.integers(1, 400), st.integers(1, 200))
anywhere = coordinates.map(lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3]))
amid = st.tuples(st.integers(250, 380), st.integers(120, 150), st.integers(4, 60), st.integers(4, 30)).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)
texts = st.sampled_from(TEXTS)


def spots(boxes: list[tuple[tuple[float, ...], str]], size_wh: tuple[int, int] = SIZE_WH) -> list[PixelRect]:
    labels = LabelLayout(size_wh)
    for box, text in boxes:
        labels.add(box, TextLabel(text, RED))
    return [spot for spot, _ in labels.placed]


def apart(a: PixelRect, b: PixelRect) -> bool:
    return a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


def all_apart(found: list[PixelRect]) -> bool:
    return all(apart(a, b) for i, a in enumerate(found) for b in found[:i])


def inside(spot: PixelRect, size_wh: tuple[int, int] = SIZE_WH) -> bool:
    return 0 <= spot[0] < spot[2] <= size_wh[0] and 0 <= spot[1] < spot[3] <= size_wh[1]


def test_the_first_label_stands_above_and_the_second_below():
    box = (200.0, 100.0, 280.0, 150.0)
    first, second = spots([(box, "Car missed: certain"), (box, "Car 0.75")])
    assert first[3] <= 100
    assert second[1] > 150
    for spot in (first, second):
        assert abs(spot[0] - 200) <= 2
        assert inside(spot)


@pytest.mark.parametrize("box", [(0, 0, 80, 50), (600, 0, 700, 60), (-30, 250, 40, 400), (580, 260, 639, 299)])
def test_two_labels_of_a_box_at_the_edge_are_apart_and_inside(box: tuple[int, ...]):
    found = spots([(box, "Car missed: confirmed"), (box, "Car 0.75")])
    assert apart(*found)
    assert all(map(inside, found))


def test_a_number_stands_in_the_middle_unless_that_is_taken():
    labels = LabelLayout(SIZE_WH)
    for _ in range(2):
        labels.add((100, 100, 300, 200), TextLabel("[3]", RED, size_px=TEXT_PX), within=True)
    (middle, _), (other, _) = labels.placed
    assert abs(middle[0] + middle[2] - 400) <= 1
    assert abs(middle[1] + middle[3] - 300) <= 1
    assert apart(middle, other)


def test_a_small_box_is_not_hidden_by_its_neighbours_label():
    near, far = (100, 100, 200, 200), (110, 86, 140, 98)
    plain, careful = LabelLayout(SIZE_WH), LabelLayout(SIZE_WH, [far])
    for labels in (plain, careful):
        labels.add(near, TextLabel("Car 0.75", RED))
    assert not apart(plain.placed[0][0], far)
    assert apart(careful.placed[0][0], far)


def test_where_no_place_is_free_least_is_hidden():
    wide, high = measure_text("Car 0.75", TEXT_PX - 3)
    size_wh = (wide + 4, 2 * high)
    found = spots([((0, 0, wide, high), "Car 0.75")] * 3, size_wh)
    assert apart(*found[:2])
    assert all(inside(spot, size_wh) for spot in found)


@given(st.lists(st.tuples(anywhere, texts), max_size=20))
def test_labels_are_inside_and_near_their_boxes(boxes: list[tuple[tuple[float, ...], str]]):
    found = spots(boxes)
    assert found == spots(boxes)
    for (box, text), spot in zip(boxes, found, strict=True):
        assert inside(spot)
        wide, high = measure_text(text, TEXT_PX - 3)
        assert (spot[2] - spot[0], spot[3] - spot[1]) == (wide, high)
        # a box that lies outside has its label at the edge next to it
        (x0, x1), (y0, y1) = (np.clip(box[i::2], 0, SIZE_WH[i]) for i in (0, 1))
        assert x0 - 2 * wide <= spot[0] <= x1 + wide
        assert y0 - 6 * (high + 1) <= spot[1] <= y1 + 6 * (high + 1)


@given(st.lists(st.tuples(amid, texts), max_size=FEW))
def test_few_labels_are_apart_wherever_their_boxes_are(boxes: list[tuple[tuple[float, ...], str]]):
    assert all_apart(spots(boxes))


def test_an_overlay_shows_the_whole_label_of_each_box_at_one_place():
    image, box = np.full((200, 500, 3), 90, np.uint8), (200.0, 90.0, 240.0, 110.0)
    lost = Failure("lost", "Car", box, index=0, error="missed", grade="certain")
    found = BoxRecord(box, "Car", 0.75)
    alone, both = (
        draw_overlay(image, (BoxRecord(box, "Car", index=0),), found_there, failed, 0.5)
        for found_there, failed in (((), (lost,)), ((found,), (lost,)))
    )

    def plates(picture: np.ndarray) -> int:
        return int((picture == 0).all(axis=2).sum())

    only_found = draw_overlay(image, (), (found,), (), 0.5)
    assert plates(both) == plates(alone) + plates(only_found)
    for colour in (LOST_COLOUR, DETECTED_COLOUR):
        assert (both == colour).all(axis=2).any()
    assert not (image != 90).any()
