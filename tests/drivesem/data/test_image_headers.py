"""Upright copies of images in all formats and orientations."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from drivesem.data.coco_labels import read_turn
from drivesem.data.image_headers import (
    copy_upright,
    read_header,
    read_orientation,
    read_stored_header,
    read_upright_size,
)
from drivesem.data.photographs import read_upright, turn_pixels
from scene_ir.errors import FormatError

PIXELS = np.kron(np.random.default_rng(0).integers(0, 255, (3, 5, 3)), np.ones((16, 16, 1))).astype(np.uint8)
OPTIONS = {".webp": {"lossless": True}, ".jpg": {"quality": 100, "subsampling": 0}}
ORIENTATION = 0x0112


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_copies_are_upright(tmp_path: Path, suffix: str, orientation: int) -> None:
    source, target = tmp_path / f"a{suffix}", tmp_path / f"new/b{suffix}"
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    Image.fromarray(PIXELS).save(source, exif=exif, **(OPTIONS.get(suffix, {})))
    copy_upright(source, target)
    size_wh = (80, 48) if orientation < 5 else (48, 80)
    assert read_orientation(target) == 1
    assert read_upright_size(source) == size_wh
    assert read_stored_header(target)[1:] == size_wh
    expected = turn_pixels(PIXELS, orientation).astype(int)
    for path in (source, target):
        assert np.abs(read_upright(path) - expected).max() <= (12 if suffix == ".jpg" else 0)
    if orientation == 1:
        assert target.read_bytes() == source.read_bytes()


@pytest.mark.parametrize("mode", ["L", "P", "RGBA", "I;16"])
def test_copies_have_the_mode_of_their_source(tmp_path: Path, mode: str) -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    image = Image.fromarray(PIXELS).convert("L" if mode == "I;16" else mode)
    image = Image.fromarray(np.asarray(image).astype(np.uint16) * 257) if mode == "I;16" else image
    image.save(tmp_path / "a.png", exif=exif)
    copy_upright(tmp_path / "a.png", tmp_path / "b.png")
    with Image.open(tmp_path / "b.png") as copy:
        assert copy.mode == mode
        assert np.array_equal(np.asarray(copy), np.rot90(np.asarray(image), -1))


@pytest.mark.parametrize("suffix", ["jpg", "png", "bmp", "webp", "tif"])
@pytest.mark.parametrize("options", [{}, {"progressive": True, "quality": 30}, {"exif": Image.Exif()}])
def test_sizes_agree_with_pillow(suffix: str, options: dict[str, object], tmp_path: Path) -> None:
    path = tmp_path / f"a.{suffix}"
    Image.new("RGB", (321, 123), (10, 200, 30)).save(path, **options)
    assert read_header(path) == read_stored_header(path) == (1, 321, 123)


def test_a_size_that_the_image_does_not_have_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.new("RGB", (100, 60)).save(path)
    assert read_turn(path, (100, 60)) == read_turn(path, (0, 0)) == read_turn(tmp_path / "b.jpg", (9, 9)) == 1
    with pytest.raises(
        FormatError, match=r"a\.jpg: expected 640x480 px, as its annotation states, found 100x60 px"
    ):
        read_turn(path, (640, 480))
