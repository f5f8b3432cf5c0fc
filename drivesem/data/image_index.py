"""Files of a data set by folder and name, without torch."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivesem.data.account import IMAGE_SUFFIXES

SPLITS = ("train", "valid", "val", "test")
"""Names of splits as folders, in any letter case."""
_KIND_FOLDERS = ("annotations", "jpegimages", "images", "imgs", "labels")
"""Folders that are named after the kind of their files, in lower case."""


@dataclass(frozen=True, slots=True)
class IndexedFile:
    """A file of a data set."""

    path: Path
    """The file."""
    place: tuple[str, ...]
    """Folders below the data set, without those that are named after the kind of their files."""

    @property
    def split(self) -> str:
        """Innermost folder that is named as a split; "" if there is none."""
        return next((part for part in reversed(self.place) if part.lower() in SPLITS), "")

    @property
    def name_below_split(self) -> str:
        """The file's name, with the folders that are not named as a split."""
        return "/".join([*(part for part in self.place if part.lower() not in SPLITS), self.path.name])


def iterate_files(root: Path, suffix: str) -> Iterator[Path]:
    """Yield the files of a suffix, in lower case, below a folder; hidden ones are left out."""
    for folder, folders, names in os.walk(root):
        folders[:] = sorted(name for name in folders if name[0] != ".")
        yield from (Path(folder, name) for name in names if name[0] != "." and name.lower().endswith(suffix))


class FileIndex:
    """The images below a folder, by stem, and its files of another suffix. Hidden ones are left out.

    Args:
        root: The folder.
        suffix: The other suffix, in lower case.
        excluded: Beginnings, in lower case, of the names of folders without photographs, such as masks.
    """

    def __init__(self, root: Path, suffix: str, excluded: tuple[str, ...] = ()) -> None:
        self.images: dict[str, list[IndexedFile]] = {}
        """Images by stem, sorted by path."""
        self.others: list[IndexedFile] = []
        """Files of the other suffix, sorted by path."""
        for folder, folders, names in os.walk(root):
            folders[:] = sorted(name for name in folders if name[0] != ".")
            parts = Path(folder).relative_to(root).parts
            place = tuple(part for part in parts if part.lower() not in _KIND_FOLDERS)
            masks = bool(excluded) and any(part.lower().startswith(excluded) for part in parts)
            for name in sorted(name for name in names if name[0] != "."):
                stem, ending = os.path.splitext(name)
                if ending.lower() == suffix:
                    self.others.append(IndexedFile(Path(folder, name), place))
                elif ending.lower() in IMAGE_SUFFIXES and not masks:
                    self.images.setdefault(stem, []).append(IndexedFile(Path(folder, name), place))


def image_stem(name: str) -> str:
    """Return an image's file name, or path, without folders and without the suffix of an image."""
    name = name.replace("\\", "/").rpartition("/")[2]
    stem, ending = os.path.splitext(name)
    return stem if ending.lower() in IMAGE_SUFFIXES else name


def name_uniquely(stems: Sequence[str], places: Sequence[tuple[str, ...]]) -> list[str]:
    """Return identifiers of files: their stems if all differ, else with their places before them."""
    if len(set(stems)) == len(stems):
        return list(stems)
    return ["/".join([*place, stem]) for stem, place in zip(stems, places, strict=True)]
