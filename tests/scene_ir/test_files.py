"""Files that take no room twice."""

import os
from pathlib import Path

import pytest

from scene_ir import files


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
    files.share_alike(second, first)
    assert (second / "scene" / "same.txt").samefile(first / "scene" / "same.txt")
    assert (second / "other.txt").read_text() == "number 2"
    assert not (second / "other.txt").samefile(first / "other.txt")
    assert sorted(p.name for p in second.rglob("*") if p.is_file()) == ["other.txt", "own.txt", "same.txt"]
    files.share_alike(second, first)  # again: nothing left to do


def test_replacing_one_leaves_the_other(folders: tuple[Path, Path]) -> None:
    first, second = folders
    files.share_alike(second, first)
    files.write_text(second / "scene" / "same.txt", "changed")
    assert (first / "scene" / "same.txt").read_text() == "the same"


def test_where_there_are_no_links_two_copies_stay(
    folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = folders

    def refuse(*_: object) -> None:
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", refuse)
    files.share_alike(second, first)
    assert (second / "scene" / "same.txt").read_text() == "the same"
    assert not (second / "scene" / "same.txt").samefile(first / "scene" / "same.txt")
    assert not [p for p in second.rglob("*") if p.name.endswith(".tmp")]
