"""Regions against masks."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from detectors.incremental.regions import ColumnRegion, ReceptiveField, Rect

HW = (24, 200)


@st.composite
def rects(draw: st.DrawFn, hw: tuple[int, int] = HW) -> list[Rect]:
    found = []
    for _ in range(draw(st.integers(0, 4))):
        top, left = draw(st.integers(-3, hw[0] - 1)), draw(st.integers(-3, hw[1] - 1))
        found.append(Rect(top, top + draw(st.integers(1, 12)), left, left + draw(st.integers(1, 60))))
    return found


def mask(region: ColumnRegion) -> NDArray[np.bool_]:
    rows = np.arange(region.height)[:, None]
    return (rows >= region.top) & (rows < region.bottom)


def painted(several: list[Rect], hw: tuple[int, int] = HW) -> NDArray[np.int64]:
    """How often each place is covered."""
    count = np.zeros(hw, np.int64)
    for rect in several:
        count[max(rect.top, 0) : max(rect.bottom, 0), max(rect.left, 0) : max(rect.right, 0)] += 1
    return count


@given(rects())
def test_a_region_covers_its_rectangles_and_what_lies_between(several: list[Rect]) -> None:
    found, count = mask(ColumnRegion.from_rects(several, HW)), painted(several)
    assert bool((found | (count == 0)).all())
    for column in np.flatnonzero(found.any(0)):
        rows = np.flatnonzero(count[:, column])
        assert list(np.flatnonzero(found[:, column])) == list(range(rows[0], rows[-1] + 1))


@given(rects())
def test_rectangles_cover_a_region_once_each_place(several: list[Rect]) -> None:
    region = ColumnRegion.from_rects(several, HW)
    count = painted(list(region.rects()))
    assert int(count.max(initial=0)) <= 1
    assert bool((count[mask(region)] == 1).all())
    assert bool(region.rects()) == bool(mask(region).any())


def test_near_rectangles_are_joined_and_far_ones_are_not() -> None:
    near = ColumnRegion.from_rects([Rect(4, 10, 0, 40), Rect(4, 10, 42, 80)], HW)
    far = ColumnRegion.from_rects([Rect(4, 10, 0, 40), Rect(4, 10, 120, 160)], HW)
    assert len(near.rects()) == 1
    assert len(far.rects()) == 2


def test_small_rectangle_next_to_a_tall_one_stays_small() -> None:
    tall, low = Rect(0, 24, 100, 200), Rect(10, 12, 0, 100)
    assert sum(rect.area for rect in ColumnRegion.from_rects([tall, low], HW).rects()) <= tall.area + 2 * low.area


@settings(max_examples=60)
@given(
    rects((20, 40)),
    st.integers(1, 5),
    st.integers(1, 3),
    st.integers(0, 3),
    st.integers(1, 5),
    st.integers(1, 3),
    st.integers(0, 3),
)
def test_places_that_see_a_region_are_those_of_a_convolution(
    several: list[Rect], high: int, down: int, above: int, wide: int, across: int, before: int
) -> None:
    """Window by window: the output's size as a layer with that padding on both sides has it."""
    region = ColumnRegion.from_rects(several, (20, 40))
    padded = np.pad(mask(region), ((above, above), (before, before)))
    hw = (20 + 2 * above - high) // down + 1, (40 + 2 * before - wide) // across + 1
    expected = np.array(
        [
            [padded[i * down : i * down + high, j * across : j * across + wide].any() for j in range(hw[1])]
            for i in range(hw[0])
        ]
    )
    found = region.propagate(ReceptiveField((high, wide), (down, across), (above, before)), hw)
    hull = np.maximum.accumulate(expected, 0) & np.maximum.accumulate(expected[::-1], 0)[::-1]
    assert np.array_equal(mask(found), hull)


@given(rects(), st.integers(1, 9))
def test_blocks_give_the_region_that_they_cover(several: list[Rect], side: int) -> None:
    count = painted(several) > 0
    rows, columns = -HW[0] % side, -HW[1] % side
    whole = np.pad(count, ((0, rows), (0, columns)))
    blocks = whole.reshape(whole.shape[0] // side, side, -1, side).any((1, 3))
    region = ColumnRegion.from_blocks(blocks, side, HW)
    assert region.contains(ColumnRegion.from_rects(several, HW))
    top, left = np.nonzero(blocks)
    squares = [Rect(y * side, (y + 1) * side, x * side, (x + 1) * side) for y, x in zip(top, left, strict=True)]
    assert np.array_equal(mask(region), mask(ColumnRegion.from_rects(squares, HW)))


def test_placing_and_enlarging_move_every_place() -> None:
    region = ColumnRegion.from_rects([Rect(2, 5, 3, 7)], (10, 12))
    assert np.array_equal(
        mask(region.embed((1, 4), (15, 20))), mask(ColumnRegion.from_rects([Rect(3, 6, 7, 11)], (15, 20)))
    )
    assert np.array_equal(mask(region.upsample(3)), mask(ColumnRegion.from_rects([Rect(6, 15, 9, 21)], (30, 36))))


def test_growing_adds_rows_and_columns_inside_of_the_tensor() -> None:
    grown = ColumnRegion.from_rects([Rect(2, 5, 3, 7)], (10, 12)).dilate(3)
    assert np.array_equal(mask(grown), mask(ColumnRegion.from_rects([Rect(0, 8, 0, 10)], (10, 12))))


@pytest.mark.parametrize(
    ("inner", "expected"), [(Rect(2, 5, 3, 7), True), (Rect(1, 5, 3, 7), False), (Rect(2, 5, 3, 8), False)]
)
def test_a_region_contains_what_lies_in_it(inner: Rect, expected: bool) -> None:
    outer = ColumnRegion.from_rects([Rect(2, 5, 3, 7)], (10, 12))
    assert outer.contains(ColumnRegion.from_rects([inner], (10, 12))) is expected
    assert outer.contains(ColumnRegion.from_rects([], (10, 12)))
