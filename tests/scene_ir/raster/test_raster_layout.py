"""PixelLayout: packing of rectangles."""

import pytest
import torch

from scene_ir.errors import RangeError, ShapeError
from scene_ir.raster.layout import PixelLayout


def test_pixels_are_packed_row_major_per_draw():
    layout = PixelLayout.from_rects(torch.tensor([[3, 5, 5, 7], [0, 0, 0, 9], [7, 1, 8, 3]]))
    assert layout.offsets.tolist() == [0, 4, 4, 6]
    assert layout.size == 6
    assert layout.draw_index().tolist() == [0, 0, 0, 0, 2, 2]
    assert layout.pixel_xy().tolist() == [[3, 5], [4, 5], [3, 6], [4, 6], [7, 1], [7, 2]]
    assert layout.spans() == [(slice(0, 4), (2, 2)), (slice(4, 4), (9, 0)), (slice(4, 6), (2, 1))]


def test_draws_of_one_pixel():
    pixels = torch.tensor([[3.0, 5.0], [-2.0, 9.0], [3.0, 5.0]], dtype=torch.float64)
    layout, places = PixelLayout.from_pixels(pixels), pixels.to(torch.int64)
    expected = PixelLayout.from_rects(torch.cat([places, places + 1], dim=1))
    assert torch.equal(layout.rects, expected.rects)
    assert torch.equal(layout.offsets, expected.offsets)
    assert PixelLayout.from_pixels(torch.zeros(0, 2)).size == 0


def test_no_draws():
    layout = PixelLayout.from_rects(torch.zeros(0, 4, dtype=torch.int64))
    assert (layout.size, layout.spans()) == (0, [])
    assert layout.pixel_xy().shape == (0, 2)


def test_inverted_rectangle_is_empty():
    assert PixelLayout.from_rects(torch.tensor([[5, 5, 2, 2]])).size == 0


def test_errors():
    rects = torch.tensor([[0, 0, 2, 2]])
    with pytest.raises(RangeError, match=r"layout\.offsets"):
        PixelLayout(rects, torch.tensor([0, 3]))
    with pytest.raises(ShapeError, match=r"layout\.offsets"):
        PixelLayout(rects, torch.tensor([0, 4, 4]))
    with pytest.raises(ShapeError, match=r"layout\.rects"):
        PixelLayout.from_rects(torch.zeros(2, 3, dtype=torch.int64))
    with pytest.raises(ShapeError, match="int64"):
        PixelLayout(rects.to(torch.int32), torch.tensor([0, 4]))
