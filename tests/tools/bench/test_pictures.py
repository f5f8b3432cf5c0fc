"""How near a picture is to the truth: known values, bounds, and sheets of the right size."""

import numpy as np
import pytest

from scene_ir.errors import ShapeError
from tools.bench.pictures import EXACT_DB, SheetStrip, psnr, sheet


def _noise(seed: int = 0, height: int = 60, width: int = 90) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def test_psnr_of_a_constant_difference() -> None:
    first = np.full((4, 5, 3), 100, np.uint8)
    region = np.ones((4, 5), bool)
    assert psnr(first, first + np.uint8(10), region) == pytest.approx(20 * np.log10(25.5))
    assert psnr(first + np.uint8(10), first, region) == pytest.approx(20 * np.log10(25.5))
    assert psnr(first, first, region) == EXACT_DB


def test_an_empty_region_is_an_error() -> None:
    with pytest.raises(ShapeError, match="region"):
        psnr(_noise(), _noise(), np.zeros((60, 90), bool))


def test_a_sheet_shows_four_panels_a_strip() -> None:
    photograph, ours, truth = _noise(0), _noise(1), _noise(1)
    region = np.zeros((60, 90), bool)
    region[20:40, 20:60] = True
    drawn = sheet(
        [SheetStrip(photograph, ours, truth, region, "one"), SheetStrip(photograph, ours, truth, region, "two")],
        400,
    )
    assert drawn.dtype == np.uint8
    assert drawn.shape[1:] == (400, 3)
    one = drawn.shape[0] // 2
    # Equal pictures leave the panel of their difference black, under the bar of names.
    assert not drawn[18:one, 300:].any()
    assert drawn[18:one, :300].any()
