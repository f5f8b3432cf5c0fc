"""Cells of features, and the visits of a search to them."""

from __future__ import annotations

import pytest
import torch

from detectors.planted import compute_features
from drivesem.failures.search_log import OBJECT_FEATURES, ObjectPatches, SearchLog

BOXES = torch.tensor([[10.0, 20, 90, 50], [300, 30, 400, 130]])
SMALL_LEFT, LARGE_RIGHT = (0, 1, 0, 1), (2, 1, 2, 1)
DARK = (0, 1, 0, 0)


def picture(light: float = 0.5) -> torch.Tensor:
    """Grey noise (3, 200, 420), with a contrast of 0.15."""
    noise = torch.randn(1, 200, 420, generator=torch.Generator().manual_seed(0))
    return (light + 0.15 * noise).expand(3, -1, -1)


def test_cells_of_two_boxes() -> None:
    assert ObjectPatches.from_image(picture(), BOXES).cells() == [SMALL_LEFT, LARGE_RIGHT]
    assert [cell[3] for cell in ObjectPatches.from_image(picture(0.1), BOXES).cells()] == [0, 0]
    assert ObjectPatches.from_image(picture(), BOXES[:0]).cells() == []


def test_a_box_beyond_the_picture_is_cut_off() -> None:
    beyond = torch.tensor([[-50.0, 20, 90, 50]])
    inside = torch.tensor([[0.0, 20, 90, 50]])
    found, expected = (ObjectPatches.from_image(picture(), box) for box in (beyond, inside))
    assert torch.equal(found.box_features, expected.box_features)
    assert torch.equal(found.pixels, expected.pixels)


def test_the_grid_has_the_contrast_of_the_whole_box() -> None:
    whole = compute_features(picture()[None], BOXES[None], ("contrast",))[0, 0]
    patches = ObjectPatches.from_image(picture(), BOXES)
    sides = torch.tensor([0.0, 0, 15, 15]).expand(2, 1, 4)
    grid = compute_features(patches.pixels, sides, ("contrast",))[0, :, 0]
    assert grid.tolist() == pytest.approx(whole.tolist(), rel=0.1)


def test_visits_count_passes_and_misses_by_object_and_cell() -> None:
    log = SearchLog()
    both = torch.tensor([0, 4])
    log.record(picture(), both, BOXES, torch.tensor([False, True]), passes=1)
    log.record(picture(), both[1:], BOXES[1:], torch.tensor([True]), passes=3)
    log.record(picture(0.1), both[:1], BOXES[:1], torch.tensor([True]), passes=1)
    log.record(picture(), both[:0], BOXES[:0], torch.zeros(0, dtype=torch.bool), passes=1)
    found = [
        (visit.index, visit.cell, visit.passes, visit.misses, visit.photographed, visit.final)
        for visit in log.visits([DARK, SMALL_LEFT], [SMALL_LEFT, SMALL_LEFT])
    ]
    dark, left, right = (0, DARK, 1, 1), (0, SMALL_LEFT, 1, 0), (4, LARGE_RIGHT, 4, 2)
    assert found == [(*dark, True, False), (*left, False, True), (*right, False, False)]
    assert SearchLog().visits([], []) == ()


def test_visits_count_random_states_apart() -> None:
    log = SearchLog()
    for misses, random in ((True, False), (True, True), (False, True)):
        log.record(picture(), torch.tensor([0]), BOXES[:1], torch.tensor([misses]), passes=1, random=random)
    (visit,) = log.visits([], [])
    assert (visit.passes, visit.misses, visit.random, visit.random_misses) == (3, 2, 2, 1)


def test_rows_of_margins_are_features_of_the_states_that_have_them() -> None:
    log = SearchLog()
    both, missed = torch.tensor([0, 4]), torch.tensor([False, True])
    log.record(picture(), both, BOXES, missed, passes=1)
    assert log.margin_rows().shape == (0, len(OBJECT_FEATURES) + 1)
    log.record(picture(), both, BOXES, missed, passes=1, margins=torch.tensor([2.0, -1.0]))
    rows = dict(zip((*OBJECT_FEATURES, "margin"), log.margin_rows().T.tolist(), strict=True))
    assert rows["margin"] == [2, -1]
    assert rows["height_px"] == [30, 100]
    assert rows["aspect"] == pytest.approx([80 / 30, 1])
    assert rows["across"] == pytest.approx([50 / 420, 350 / 420])
    expected = compute_features(picture()[None], BOXES[None], ("lightness",))[0, 0]
    assert rows["lightness"] == pytest.approx(expected.tolist(), abs=0.05)
    assert rows["light"] == pytest.approx([0.5, 0.5], abs=0.02)
