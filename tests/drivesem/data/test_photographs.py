"""Photographs without metadata: pixels of any channels, orientation, focal length."""

from __future__ import annotations

import contextlib
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from drivesem.data.photographs import DEFAULT_FOCAL, read_focal_length, read_photograph, read_pixels
from scene_ir import files
from scene_ir.errors import FormatError, RangeError


def save(
    path: Path, tags: dict[int, object], exif_tags: dict[int, object], size_wh: tuple[int, int] = (400, 300)
) -> Path:
    """Write a JPEG with these tags and those of EXIF's sub-directory; its upper left quarter is red."""
    pixels = np.full((size_wh[1], size_wh[0], 3), 128, np.uint8)
    pixels[: size_wh[1] // 2, : size_wh[0] // 2] = (200, 20, 20)
    image = Image.fromarray(pixels)
    exif = Image.Exif()
    for tag, value in tags.items():
        exif[tag] = value
    exif.get_ifd(0x8769).update(exif_tags)
    image.save(path, exif=exif, quality=95)
    return path


@pytest.mark.parametrize(
    ("exif_tags", "expected"),
    [
        ({0xA405: 26}, (400 * 26 / 36, "EXIF")),
        ({0x920A: 4.0, 0xA20E: 1000.0, 0xA210: 3}, (400.0, "EXIF")),
        ({0x920A: 4.0, 0xA20E: 2540.0}, (400.0, "EXIF")),
        ({0x920A: 4.0}, (DEFAULT_FOCAL * 400, "default")),
        ({0xA405: 0}, (DEFAULT_FOCAL * 400, "default")),
        ({}, (DEFAULT_FOCAL * 400, "default")),
    ],
)
def test_focal_length_of_a_file(exif_tags: dict[int, object], expected: tuple[float, str], tmp_path: Path) -> None:
    path = save(tmp_path / "a.jpg", {}, exif_tags)
    focal = read_focal_length(path)
    assert (focal.length_px, focal.source) == (pytest.approx(expected[0], rel=1e-4), expected[1])
    assert read_focal_length(path, 333.0).length_px == 333.0
    camera = read_photograph(path).camera
    assert (camera.width, camera.height) == (400, 300)
    assert camera.intrinsics[:2, 2].tolist() == [199.5, 149.5]
    assert float(camera.intrinsics[0, 0]) == pytest.approx(expected[0], rel=1e-4)


@pytest.mark.parametrize(("kind", "count"), [(3, 3), (2, 1), (7, 1), (12, 1)])
def test_a_damaged_orientation_is_ignored_or_refused(kind: int, count: int, tmp_path: Path) -> None:
    """Tags of another type or with several values; Pillow must not warn."""
    path = save(tmp_path / "a.jpg", {0x0112: 6}, {})
    data, tag = path.read_bytes(), b"\x01\x12\x00\x03\x00\x00\x00\x01"
    little = tag not in data
    tag = struct.pack("<HHI" if little else ">HHI", 0x0112, 3, 1)
    assert data.count(tag) == 1
    path.write_bytes(data.replace(tag, struct.pack("<HHI" if little else ">HHI", 0x0112, kind, count)))
    with contextlib.suppress(FormatError):
        assert read_photograph(path).photograph.shape[1:] in ((300, 400), (400, 300))


@pytest.mark.parametrize(("orientation", "red"), [(1, (0, 0)), (3, (-1, -1)), (6, (0, -1)), (8, (-1, 0))])
def test_photographs_are_turned_upright(orientation: int, red: tuple[int, int], tmp_path: Path) -> None:
    path = save(tmp_path / "a.jpg", {0x0112: orientation}, {0xA405: 36})
    frame = read_photograph(path)
    assert frame.photograph.shape[1:] == ((400, 300) if orientation in (6, 8) else (300, 400))
    assert (frame.camera.height, frame.camera.width) == frame.photograph.shape[1:]
    y, x = (5 if r == 0 else -5 for r in red)
    assert float(frame.photograph[0, y, x]) > 0.7
    assert float(frame.photograph[0, -y, -x]) < 0.6
    assert float(frame.camera.intrinsics[0, 0]) == pytest.approx(400)  # of the longer side
    assert frame.identifier == "a"
    assert frame.provenance["focal"] == "400.0 px, EXIF"


def test_invalid_files_and_focal_lengths_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no image")
    for path in (tmp_path / "a.png", tmp_path / "none.png"):
        for call in (read_focal_length, read_photograph):
            with pytest.raises(FormatError, match=path.name):
                call(path)
    path = save(tmp_path / "b.jpg", {}, {})
    for focal in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(RangeError, match="focal"):
            read_photograph(path, focal)


PIXELS = np.random.default_rng(0).integers(0, 256, (6, 9, 3)).astype(np.uint8)


@pytest.mark.parametrize("mode", ["L", "LA", "RGBA", "P", "1"])
def test_any_channels_become_rgb(mode: str, tmp_path: Path) -> None:
    image = Image.fromarray(PIXELS).convert(mode)
    if mode == "RGBA":
        image.putalpha(7)  # opacity is dropped
    image.save(tmp_path / "a.png")
    pixels = read_pixels(tmp_path / "a.png", (6, 9))
    assert pixels.shape == (6, 9, 3)
    assert pixels.dtype == np.uint8
    if mode == "RGBA":
        assert np.array_equal(pixels, PIXELS)
    elif mode in ("L", "LA"):
        grey = np.asarray(Image.fromarray(PIXELS).convert("L"))
        assert all(np.array_equal(pixels[..., c], grey) for c in range(3))


def test_colour_pixels_are_as_stored(tmp_path: Path) -> None:
    Image.fromarray(PIXELS).save(tmp_path / "a.png")
    assert np.array_equal(read_pixels(tmp_path / "a.png"), PIXELS)
    assert np.array_equal(read_pixels(tmp_path / "a.png"), files.read_image(tmp_path / "a.png"))


def test_pixels_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    Image.fromarray(np.full((6, 9), 40_000, np.uint16)).save(tmp_path / "deep.png")
    with pytest.raises(FormatError, match=r"deep\.png: expected 8 bits"):
        read_pixels(tmp_path / "deep.png")
    for mode in ("L", "RGB"):
        Image.fromarray(PIXELS).convert(mode).save(tmp_path / "a.png")
        with pytest.raises(FormatError, match=r"a\.png: expected 8x6 px, found 9x6 px"):
            read_pixels(tmp_path / "a.png", (6, 8))
    noise = np.random.default_rng(1).integers(0, 256, (60, 90)).astype(np.uint8)
    Image.fromarray(noise).save(tmp_path / "cut.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "cut.png").read_bytes()[:3000])
    with pytest.raises(FormatError, match=r"cut\.png: expected an image"):
        read_pixels(tmp_path / "cut.png")
