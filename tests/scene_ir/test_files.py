"""Files that take no room twice, and files for which there is none."""

import errno
import gzip
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NoReturn

import pytest

from scene_ir import files
from scene_ir.errors import FormatError, WriteError


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Two folders with a file that both have, one that differs, and one that only the second has."""
    first, second = tmp_path / "first", tmp_path / "second"
    for folder, number in ((first, 1), (second, 2)):
        files.write_text(folder / "scene" / "same.txt", "the same")
        files.write_text(folder / "other.txt", f"number {number}")
    files.write_text(second / "own.txt", "mine")
    return first, second


def test_equal_files_are_one_file(folders: tuple[Path, Path]) -> None:
    first, second = folders
    files.hardlink_duplicates(second, first)
    assert (second / "scene" / "same.txt").samefile(first / "scene" / "same.txt")
    assert (second / "other.txt").read_text() == "number 2"
    assert not (second / "other.txt").samefile(first / "other.txt")
    assert sorted(p.name for p in second.rglob("*") if p.is_file()) == ["other.txt", "own.txt", "same.txt"]
    files.hardlink_duplicates(second, first)  # again: nothing left to do


def test_replacing_one_leaves_the_other(folders: tuple[Path, Path]) -> None:
    first, second = folders
    files.hardlink_duplicates(second, first)
    files.write_text(second / "scene" / "same.txt", "changed")
    assert (first / "scene" / "same.txt").read_text() == "the same"


def test_where_there_are_no_links_two_copies_stay(
    folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = folders

    def refuse(*_: object) -> None:
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", refuse)
    files.hardlink_duplicates(second, first)
    assert (second / "scene" / "same.txt").read_text() == "the same"
    assert not (second / "scene" / "same.txt").samefile(first / "scene" / "same.txt")
    assert not [p for p in second.rglob("*") if p.name.endswith(".tmp")]


def test_where_there_is_no_room_the_old_file_stays(
    tmp_path: Path, full_disk: Callable[[int], AbstractContextManager[None]]
) -> None:
    path = tmp_path / "a.txt"
    files.write_text(path, "old")
    too_large = r"a\.txt: expected a place that can be written, found file too large"
    with full_disk(1000), pytest.raises(WriteError, match=too_large):
        files.write_text(path, 2000 * "x")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path], "no half of the new one"


def test_a_folder_for_which_there_is_no_room_is_not_there(
    tmp_path: Path, full_disk: Callable[[int], AbstractContextManager[None]]
) -> None:
    def write() -> None:
        with files.atomic_folder(tmp_path / "frame") as part:
            files.write_text(part / "small.txt", "x")
            files.write_text(part / "large.txt", 2000 * "x")

    with full_disk(1000), pytest.raises(WriteError, match=f"^{tmp_path}/frame/large.txt: expected"):
        write()
    assert not list(tmp_path.iterdir())


def _reads_only(*_: object, **__: object) -> NoReturn:
    raise OSError(errno.EROFS, os.strerror(errno.EROFS))


@pytest.mark.parametrize("call", ["mkdir", "open"])
def test_what_may_only_be_read_is_named(tmp_path: Path, call: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, call, _reads_only)
    with pytest.raises(WriteError, match=r"a\.txt: expected a place that can be written, found read-only file"):
        files.write_text(tmp_path / "new/a.txt" if call == "mkdir" else tmp_path / "a.txt", "x")


def test_a_file_in_parts_is_whole_or_absent(tmp_path: Path) -> None:
    files.write_parts(tmp_path / "new/a.txt", (f"{i}\n".encode() for i in range(3)))
    assert (tmp_path / "new/a.txt").read_text() == "0\n1\n2\n"

    def fail() -> Iterator[bytes]:
        yield b"3\n"
        raise FormatError("a", "b", "c")

    with pytest.raises(FormatError):
        files.write_parts(tmp_path / "new/a.txt", fail())
    assert [path.read_text() for path in (tmp_path / "new").iterdir()] == ["0\n1\n2\n"]


def test_a_folder_in_what_may_only_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "mkdir", _reads_only)
    with pytest.raises(WriteError, match="frame: expected"), files.atomic_folder(tmp_path / "frame"):
        raise AssertionError


def _written(folder: Path, text: str) -> None:
    with files.atomic_folder(folder) as part:
        files.write_text(part / "a.txt", text)


def test_a_link_to_a_folder_gives_way_and_what_it_leads_to_stays(tmp_path: Path) -> None:
    _written(tmp_path / "real", "old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    _written(tmp_path / "link", "new")
    assert (tmp_path / "link" / "a.txt").read_text() == "new"
    assert (tmp_path / "real" / "a.txt").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "real"]


def test_the_old_folder_is_there_again_where_the_new_one_cannot_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _written(tmp_path / "frame", "old")
    replace = os.replace

    def fails_for_the_new(source: Path, target: Path) -> None:
        if target == tmp_path / "frame" and (source / "a.txt").read_text() == "new":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        replace(source, target)

    monkeypatch.setattr(os, "replace", fails_for_the_new)
    with pytest.raises(WriteError, match="frame: expected"):
        _written(tmp_path / "frame", "new")
    assert (tmp_path / "frame" / "a.txt").read_text() == "old"
    assert list(tmp_path.iterdir()) == [tmp_path / "frame"]


def test_of_two_that_write_a_folder_at_once_each_is_whole(tmp_path: Path) -> None:
    def write(text: str) -> None:
        for _ in range(200):
            _written(tmp_path / "frame", text)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(write, ("first", "second")))
    assert (tmp_path / "frame" / "a.txt").read_text() in ("first", "second")
    assert list(tmp_path.iterdir()) == [tmp_path / "frame"]


def test_errors_of_reading_inside_stay_what_they_are(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), files.atomic_folder(tmp_path / "frame"):
        (tmp_path / "gone").read_bytes()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", [(1 << 63) - 1, -(1 << 63) + 1, 10**18, 12])
def test_the_largest_integers_are_read(number: int, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(f'{{"n": [{number}, 0.{"1" * 30}]}}')
    assert files.read_json(tmp_path / "a.json") == {"n": [number, 1 / 9]}


def test_a_file_longer_than_its_reported_size_is_read_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").write_bytes(b"0123456789")
    monkeypatch.setattr(files, "_CHUNK_BYTES", 3)
    monkeypatch.setattr(files, "check_regular_file", lambda path, most: 4)
    assert files.read_bytes(tmp_path / "a") == b"0123456789"


def test_a_gzip_file_gives_no_more_than_it_may(tmp_path: Path) -> None:
    (tmp_path / "a.gz").write_bytes(gzip.compress(bytes(1000)))
    assert files.read_gzip(tmp_path / "a.gz") == files.read_gzip(tmp_path / "a.gz", 1000) == bytes(1000)
    with pytest.raises(FormatError, match=r"a\.gz: expected at most 999 bytes, unpacked, found more"):
        files.read_gzip(tmp_path / "a.gz", 999)


def test_leftovers_bear_folders_that_end_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (".left.0123abcd.tmp/.half.89abcdef.tmp", "frame/.part.4567abcd.tmp", "gone", ".other.tmp"):
        (tmp_path / name).mkdir(parents=True)
    scan = os.scandir

    def scandir(path: str | Path) -> object:
        if Path(path).name in ("gone", ".left.0123abcd.tmp"):
            os.rename(path, tmp_path / "elsewhere")
        return scan(path)

    monkeypatch.setattr(os, "scandir", scandir)
    assert files.find_leftovers(tmp_path) == [
        tmp_path / ".left.0123abcd.tmp",
        tmp_path / "frame" / ".part.4567abcd.tmp",
    ]
