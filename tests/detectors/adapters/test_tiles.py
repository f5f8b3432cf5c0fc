"""Windows of a wide picture, and boxes of several windows as boxes of the picture."""

from itertools import pairwise

import pytest
import torch

from detectors.adapters.onnx import MAX_ENLARGEMENT, OVERLAP, Tile, is_cut_by_tile, make_tiles, merge_tiles


@pytest.mark.parametrize(
    ("height", "width", "input_hw"),
    [
        (375, 1242, (416, 416)),
        (1080, 1920, (416, 416)),
        (1200, 400, (320, 416)),
        (416, 416, (416, 416)),
        (9, 7, (32, 32)),
    ],
)
def test_windows_cover_the_picture_at_every_scale(height: int, width: int, input_hw: tuple[int, int]) -> None:
    found = make_tiles(height, width, input_hw)
    assert found[0] == Tile(0, 0, width, height)
    sizes: dict[tuple[int, int], torch.Tensor] = {}
    for w in found:
        assert 0 <= w.x0 < w.x1 <= width
        assert 0 <= w.y0 < w.y1 <= height
        covered = sizes.setdefault((w.y1 - w.y0, w.x1 - w.x0), torch.zeros(height, width, dtype=torch.bool))
        covered[w.y0 : w.y1, w.x0 : w.x1] = True
    assert all(bool(covered.all()) for covered in sizes.values())
    for high, wide in list(sizes)[1:]:
        assert min(input_hw[0] / high, input_hw[1] / wide) <= MAX_ENLARGEMENT + 1e-9


def test_neighbours_overlap() -> None:
    fine = make_tiles(375, 1242, (416, 416))[1:]
    assert [(w.x0, w.x1) for w in fine] == [(0, 621), (310, 931), (621, 1242)]
    for first, second in pairwise(fine):
        assert first.x1 - second.x0 >= OVERLAP * (first.x1 - first.x0) - 1


def test_a_picture_of_the_networks_size_is_one_window() -> None:
    assert make_tiles(416, 416, (416, 416)) == [Tile(0, 0, 416, 416)]


def test_only_borders_inside_the_picture_cut() -> None:
    boxes = torch.tensor([[0.0, 20, 50, 60], [100.0, 20, 200, 60], [340.0, 20, 399, 60], [110.0, 80, 200, 199]])
    window = Tile(100, 0, 400, 200)
    assert is_cut_by_tile(boxes, window, (200, 400)).tolist() == [True, True, False, False]
    assert is_cut_by_tile(boxes, Tile(0, 0, 400, 200), (200, 400)).tolist() == [False] * 4
    assert is_cut_by_tile(boxes[3:], Tile(100, 0, 400, 200), (300, 400)).tolist() == [True]


def test_a_car_seen_by_two_windows_is_one_box() -> None:
    boxes = torch.tensor([[100.0, 50, 200, 100], [102.0, 51, 201, 101]])
    selected = merge_tiles(boxes, torch.tensor([0.6, 0.8]), torch.tensor([2, 2]), torch.tensor([False, False]))
    assert selected.tolist() == [1]


def test_part_of_a_complete_box_is_dropped_at_any_score() -> None:
    boxes = torch.tensor([[100.0, 50, 200, 100], [100.0, 50, 140, 100]])
    scores, labels = torch.tensor([0.4, 0.9]), torch.tensor([2, 2])
    assert merge_tiles(boxes, scores, labels, torch.tensor([False, True])).tolist() == [0]
    # another class, or no cut: both stay, best first
    assert merge_tiles(boxes, scores, torch.tensor([2, 7]), torch.tensor([False, True])).tolist() == [1, 0]
    assert merge_tiles(boxes, scores, labels, torch.tensor([False, False])).tolist() == [1, 0]


def test_a_part_stays_where_no_window_saw_the_whole() -> None:
    boxes = torch.tensor([[100.0, 50, 140, 100], [101.0, 50, 141, 100]])
    selected = merge_tiles(boxes, torch.tensor([0.5, 0.7]), torch.tensor([2, 2]), torch.tensor([True, True]))
    assert selected.tolist() == [1]


def test_nothing_seen_is_nothing() -> None:
    none = torch.zeros(0)
    assert merge_tiles(none.view(0, 4), none, none.long(), none.bool()).tolist() == []
