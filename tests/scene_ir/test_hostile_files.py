"""Files that were made to break a reader: one line that names the file, soon, and without much memory."""

import hashlib
import io
import os
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scene_ir import files, weights
from scene_ir.errors import FormatError, make_printable


def png(width: int, height: int) -> bytes:
    """A PNG that has a header, and next to nothing behind it."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def npy(shape: str, dtype: str = "<f4") -> bytes:
    """An NPY file that says it has a shape, without the numbers."""
    head = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    head = head.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode()


def npz(member: bytes, declared: int | None = None) -> bytes:
    """An archive of one array. declared: the size of it that the archive's directory tells."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", member)
    data = bytearray(buffer.getvalue())
    if declared is not None:
        at = data.index(b"PK\x01\x02")
        data[at + 24 : at + 28] = struct.pack("<I", declared)
    return bytes(data)


@pytest.mark.parametrize(
    ("content", "declared"),
    [
        ("[" * 200_000, "nested too deep"),
        ('{"a":' * 200_000, "nested too deep"),
        (f'{{"a": {"9" * 5000}}}', "an integer of 5000 digits"),
        (f"[{1 << 63}]", "too large for 64 bits"),
        (f"[-{1 << 63}]", "too large for 64 bits"),
        ('{"file_name": "a\\u0000b"}', "a NUL character"),
        ('{"file_name": "\\ud800"}', "half of one"),
        ('{"\\udfff": 1}', "half of one"),
    ],
)
def test_json(tmp_path: Path, content: str, declared: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(content)
    with pytest.raises(FormatError, match=rf"a\.json: expected .*{declared}"):
        files.read_json(path)


def test_json_that_is_odd_and_right(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(f'["\\ud83d\\ude97", "\\u00fc", {(1 << 63) - 1}, {1 - (1 << 63)}, 1e300, -0.0]')
    assert files.read_json(path) == ["🚗", "ü", (1 << 63) - 1, 1 - (1 << 63), 1e300, -0.0]


BOMB = "a: &a [x, x]\n" + "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True))


@pytest.mark.parametrize(
    ("content", "declared"),
    [
        ("[" * 20_000, "nested too deep"),
        ("a: " + "9" * 5000, "an integer of 5000 digits, too large for 64 bits"),
        (f"a: {1 << 64}", "too large for 64 bits"),
        (BOMB, r"an alias \(\*a\)"),
        ("a: &a [*a]", r"an alias \(\*a\)"),
        ("2026-99-99", "month must be in"),
        ("a: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
        ("x" * (1 << 19), "524,288"),
    ],
)
def test_yaml(tmp_path: Path, content: str, declared: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(content)
    with pytest.raises(FormatError, match=rf"a\.yaml: expected .*{declared}"):
        files.read_yaml(path)


def test_yaml_that_is_right(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: 0x10\nb: [1, 2.5, true, null, text]\nc: -3\n")
    assert files.read_yaml(path) == {"a": 16, "b": [1, 2.5, True, None, "text"], "c": -3}


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_what_a_phone_writes_behind_a_picture_is_passed_over(tmp_path: Path, suffix: str) -> None:
    colours = np.linspace(0, 255, 40 * 60 * 3).reshape(40, 60, 3).astype(np.uint8)
    scans = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1] if suffix == ".jpg" else []
    whole = cv2.imencode(suffix, colours, scans)[1].tobytes()
    path = tmp_path / f"a{suffix}"
    path.write_bytes(whole)
    plain = files.read_image(path)
    for behind in (b"\0" * 100, b"ftypmp42" * 500, b"\xff\xd8\xff\xda" + b"\0" * 100):
        path.write_bytes(whole + behind)
        assert np.array_equal(files.read_image(path), plain)
    for cut in (len(whole) // 2, len(whole) - 20):
        path.write_bytes(whole[:cut])
        with pytest.raises(
            FormatError, match=rf"a\{suffix}: expected an image, found {cut} bytes that do not decode"
        ):
            files.read_image(path)


@pytest.mark.parametrize("size", [(100_000, 100_000), (30_000, 30_000), (8_193, 8_192)])
def test_a_picture_that_declares_a_huge_size(tmp_path: Path, size: tuple[int, int], recwarn: Any) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(png(*size))
    with pytest.raises(FormatError, match=r"a\.png: expected an image of at most 67,108,864 px"):
        files.read_image(path)
    assert not recwarn


@pytest.mark.parametrize(
    ("data", "declared"),
    [
        (npz(npy("(1000000000000,)")), r"an array of shape \(1000000000000,\) and float32 in 0 bytes"),
        (npz(npy("(-1,)")), r"shape \(-1,\)"),
        (npz(npy("(-2, -3)")), r"shape \(-2, -3\)"),
        (npz(npy("(0, 1000000000000)", "|O")), "allow_pickle"),
        (npz(npy("(0,)") + b"rest"), "in 4 bytes"),
        (npz(b""), "EOF"),
        (npz(npy("(1,)"), declared=(1 << 32) - 2), "4,294,967,294"),
        (npy("(1,)"), "a single array"),
    ],
)
def test_arrays(tmp_path: Path, data: bytes, declared: str) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(data)
    with pytest.raises(FormatError, match=rf"a\.npz: expected .*{declared}"):
        files.read_npz(path)


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_come_back_and_can_be_written_to(tmp_path: Path, order: Any) -> None:
    arrays = {
        "a": np.arange(6, dtype=np.int64).reshape(2, 3, order=order),
        "b": np.float32(3.5),
        "c": np.zeros((0, 2)),
    }
    path = tmp_path / "a.npz"
    np.savez(path, **arrays)
    for name, array in files.read_npz(path).items():
        assert np.array_equal(array, arrays[name])
        assert array.dtype == arrays[name].dtype
        assert array.flags.writeable


@pytest.mark.parametrize(
    "read", [files.read_bytes, files.read_json, files.read_yaml, files.read_image, files.sha256_digest]
)
def test_only_regular_files(tmp_path: Path, read: Callable[[Path], Any]) -> None:
    (tmp_path / "zero").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    for name in ("zero", "pipe"):
        with pytest.raises(
            FormatError, match=f"{name}: expected a regular file, found a device, a pipe or a socket"
        ):
            read(tmp_path / name)
    with pytest.raises(FormatError, match="expected a readable file"):
        read(tmp_path / "a\0b")


def test_a_file_that_is_too_large(tmp_path: Path) -> None:
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate((1 << 30) + 1)
    with pytest.raises(FormatError, match="sparse: expected at most 1,073,741,824 bytes, found 1,073,741,825"):
        files.read_bytes(tmp_path / "sparse")


def test_names_stay_in_their_folder(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    (folder / "a").mkdir(parents=True)
    (folder / "out").symlink_to(tmp_path)
    (folder / "in").symlink_to(folder / "a")
    for name in ("/etc/passwd", "..", "../x", "a/../../x", "", "out/x", "a\0"):
        with pytest.raises(FormatError, match="run"):
            files.resolve_inside(folder, name)
    for name in ("a", "a/b.json", "in/b.json", "not there"):
        assert files.resolve_inside(folder, name) == folder / name


@pytest.mark.parametrize(("place", "value", "declared"), [(6, 1, "password"), (8, 97, "compression")])
def test_an_archive_that_cannot_be_unpacked(tmp_path: Path, place: int, value: int, declared: str) -> None:
    """A member that is encrypted, or packed in a way that nobody knows, by its headers."""
    path = tmp_path / "a.npz"
    np.savez(path, a=np.zeros(3))
    data = bytearray(path.read_bytes())
    data[place] = value  # of the member's own header
    data[data.index(b"PK\x01\x02") + 2 + place] = value  # of the archive's list
    path.write_bytes(data)
    with pytest.raises(FormatError, match=rf"a\.npz: expected .*{declared}"):
        files.read_npz(path)


def test_a_header_that_python_cannot_take_apart(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(npz(npy("(1,), (")))
    with pytest.raises(FormatError, match=r"a\.npz: expected an NPZ archive of arrays"):
        files.read_npz(path)


def test_no_more_is_unpacked_than_the_archive_lists(tmp_path: Path) -> None:
    """A directory that tells of 1,000 bytes, before 200 MB of zeros."""
    path = tmp_path / "a.npz"
    path.write_bytes(npz(bytes(200 << 20), declared=1000))
    tracemalloc.start()
    try:
        with pytest.raises(FormatError, match=r"a\.npz: expected an NPZ archive of arrays"):
            files.read_npz(path)
        assert tracemalloc.get_traced_memory()[1] < 10 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "data",
    [
        png(4, 4)[:30],
        png(4, 4)[:33] + b"\0\0\0\4\xfa(\xc9|abcd" + b"\0\0\0\0",
        b"\xff\xd8\xff\xe1\0\x10Exif\0\0MM\0*\xff\xff",
        b"GIF89a",
        b"",
    ],
)
def test_headers_of_pictures_that_pillow_stumbles_over(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(data)
    for read in (lambda: files.read_image_size(path, data), lambda: files.read_image(path)):
        with pytest.raises(FormatError, match=r"a\.png: expected an image"):
            read()
    with pytest.raises(FormatError, match=r"a\.png: expected an image"):
        load(path)


def load(path: Path) -> None:
    """EXIF and pixels, as Pillow reads them."""
    with files.open_image(path) as image:
        image.getexif()
        image.load()


def test_a_folder_of_links(tmp_path: Path) -> None:
    folder = tmp_path / "frame"
    (folder / "scene").mkdir(parents=True)
    (folder / "a").write_text("")
    (folder / "scene" / "same").symlink_to(folder / "a")
    files.check_links(folder)
    (folder / "scene" / "out").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FormatError, match=r"scene/out: expected a file in .*frame, found a link to .*elsewhere"):
        files.check_links(folder)


def test_weights_are_held_to_their_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in sorted(weights.SHIPPED_WEIGHTS.glob("*.safetensors")):
        weights.read_weights(path)
    data = next(weights.SHIPPED_WEIGHTS.glob("depth.safetensors")).read_bytes()
    path, card = tmp_path / "a.safetensors", tmp_path / "a.md"
    path.write_bytes(data)
    monkeypatch.setattr(weights, "SHIPPED_WEIGHTS", tmp_path)
    card.write_text("# nothing\n")
    with pytest.raises(FormatError, match=r"a\.safetensors: expected the SHA-256 of a\.md, which has none, found"):
        weights.read_weights(path)
    card.write_text(f"SHA-256: `{hashlib.sha256(data).hexdigest()}`\n")
    weights.read_weights(path)
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(FormatError, match="expected the SHA-256 of"):
        weights.read_weights(path)


def test_what_a_terminal_would_obey_is_written_out() -> None:
    assert make_printable("\x1b]0;title\x07 \u202e ü \ud800") == "\\x1b]0;title\\x07 \\u202e ü \\ud800"
    assert make_printable("x" * 500) == "x" * 500
    assert len(make_printable("x" * 10**6)) < 600
    assert "(1,000,000 characters)" in make_printable("x" * 10**6)
    error = FormatError("f" * 9000, "e" * 9000, "\x1b" * 9000)
    assert len(str(error)) < 4000
    assert str(error).isprintable()
    assert error.actual == "\x1b" * 9000
