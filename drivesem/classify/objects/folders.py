"""Sets of objects in folders: ShapeNetCore's layout, or meshes by class."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from drivesem.classify.objects.meshes import load_object
from drivesem.classify.objects.types import CLASSES, SPLITS, ObjectModel, Split
from scene_ir import files
from scene_ir.errors import FormatError, RangeError

SHAPENET = {
    "airplane": ("02691156", (775, 2713, 388)),
    "bench": ("02828884", (464, 1624, 232)),
    "trashcan": ("02747177", (119, 417, 60)),
    "bus": ("02924116", (127, 445, 64)),
    "car": ("02958343", (1549, 5421, 774)),
    "helmet": ("03513137", (60, 210, 30)),
    "mailbox": ("03710193", (15, 53, 8)),
    "motorcycle": ("03790512", (73, 258, 37)),
    "skateboard": ("04225987", (49, 171, 24)),
    "tower": ("04460130", (25, 87, 12)),
    "train": ("04468005", (99, 344, 49)),
    "boat": ("04530566", (315, 1100, 157)),
}
"""ShapeNetCore's folder of each class, and numbers of objects that the paper tests, trains and validates on."""
_SHARES = (0.7, 0.1)
"""Shares of training and validation if a class has fewer objects than in the paper: the paper's own."""
_MODELS = ("models/model_normalized.obj", "model.obj")
"""File of an object in ShapeNetCore's second and first version."""
_SUFFIXES = (".obj", ".glb", ".ply")


class FolderObjects:
    """`ObjectSet` of a folder.

    The folder has ShapeNetCore's layout `SYNSET/HASH/models/model_normalized.obj`, of which the paper's classes are
    used, or `CLASS/NAME.obj` (.glb, .ply) with any classes. `splits.json` ({"train": ["bus/NAME", ...], "val": [...],
    "test": [...]}) or `train.txt`, `val.txt` and `test.txt`, with one name per line, define the splits. Otherwise they
    are drawn at random within each class: of the paper's sizes if the class has that many objects, else 70, 10 and
    20 %.
    """

    def __init__(self, folder: str | Path, *, seed: int = 0, max_triangles: int | None = None) -> None:
        """
        Args:
            folder: The folder.
            seed: Seed of random splits.
            max_triangles: Simplify meshes with more triangles to this number.

        Raises:
            FormatError: A folder without objects, or lists that name missing objects.
        """
        if max_triangles is not None and max_triangles < 4:
            raise RangeError("max_triangles", "at least 4", max_triangles)
        self._root, self._seed, self._max_triangles = Path(folder), seed, max_triangles
        if not self._root.is_dir():
            raise FormatError(str(folder), "a folder of objects", "no such folder")
        synsets = {name: self._root / synset for name, (synset, _) in SHAPENET.items()}
        self._synsets = {name: path for name, path in synsets.items() if path.is_dir()}
        self._paths = self._find_shapenet_objects() if self._synsets else self._find_meshes_by_class()
        if not self._paths:
            expected = f"ShapeNetCore's folders, or folders of {', '.join(_SUFFIXES)} by class"
            raise FormatError(str(folder), expected, "no object")
        known = {name.partition("/")[0] for name in self._paths}
        self.classes: tuple[str, ...] = CLASSES if known <= set(CLASSES) else tuple(sorted(known))
        if len(self.classes) < 2:
            raise FormatError(str(folder), "objects of at least two classes", f"only {min(known)}")
        folders = Counter(name.replace("/", "-") for name in self._paths)
        duplicate = next((name for name, count in folders.items() if count > 1), None)
        if duplicate is not None:
            raise FormatError(str(folder), "names that differ with - for /", f"{duplicate} twice")
        self._splits = self._read_splits() or self._draw_splits()

    def names(self, split: Split) -> tuple[str, ...]:
        """List the names of a split's objects, in the order of classes."""
        return self._splits[split]

    def load(self, name: str) -> ObjectModel:
        """Load an object by name. Raises FormatError if it cannot be read, RangeError for an unknown name."""
        if name not in self._paths:
            raise RangeError("object", f"one of the {len(self._paths):,} in {self._root}", name)
        path, label = self._paths[name], self.classes.index(name.partition("/")[0])
        if self._synsets:
            path, folder = next((path / m for m in _MODELS if (path / m).is_file()), path / _MODELS[0]), path
        else:
            folder = path.parent
        return load_object(path, name, label, folder, self._max_triangles)

    def _find_shapenet_objects(self) -> dict[str, Path]:
        """Find folders of objects by name."""
        folders = {kind: _list_folder(synset) for kind, synset in self._synsets.items()}
        return {f"{kind}/{path.name}": path for kind, paths in folders.items() for path in paths if path.is_dir()}

    def _find_meshes_by_class(self) -> dict[str, Path]:
        """Find mesh files by name."""
        paths: dict[str, Path] = {}
        for folder in (path for path in _list_folder(self._root) if path.is_dir()):
            for path in _list_folder(folder):
                name = f"{folder.name}/{path.stem}"
                if path.suffix.lower() not in _SUFFIXES:
                    continue
                if name in paths:
                    raise FormatError(str(path), "one mesh per name", f"also {paths[name].name}")
                paths[name] = path
        return paths

    @cached_property
    def _aliases(self) -> dict[str, str]:
        """Names of objects by their names in lists: with the class, with the synset, or the hash alone."""
        aliases = {name: name for name in self._paths}
        for name in self._paths if self._synsets else ():
            kind, _, code = name.partition("/")
            aliases[f"{self._synsets[kind].name}/{code}"] = name
            aliases[code] = name
        return aliases

    def _read_splits(self) -> dict[Split, tuple[str, ...]] | None:
        """Read the splits from lists in the folder; None without lists."""
        path = self._root / "splits.json"
        if path.exists():
            lists = _check_lists(path, files.read_json(path))
        else:
            texts = {split: self._root / f"{split}.txt" for split in SPLITS}
            if not any(text.exists() for text in texts.values()):
                return None
            lines = {s: files.read_text(t).splitlines() if t.exists() else [] for s, t in texts.items()}
            lists = {split: [line.strip() for line in every if line.strip()] for split, every in lines.items()}
        owner: dict[str, Split] = {}
        for split in SPLITS:
            where = str(path) if path.exists() else str(self._root / f"{split}.txt")
            for entry in lists[split]:
                name = self._aliases.get(entry)
                if name is None:
                    raise FormatError(f"{where}: {split}", f"objects of {self._root}", repr(entry[:200]))
                if owner.setdefault(name, split) != split:
                    raise FormatError(f"{where}: {split}", "objects of no other split", repr(entry[:200]))
        return {
            split: self._sort_by_class([name for name, own in owner.items() if own == split]) for split in SPLITS
        }

    def _draw_splits(self) -> dict[Split, tuple[str, ...]]:
        """Draw splits at random."""
        splits: dict[Split, list[str]] = {split: [] for split in SPLITS}
        for kind in self.classes:
            own = sorted(name for name in self._paths if name.partition("/")[0] == kind)
            order = np.random.default_rng([self._seed, crc32(kind.encode())]).permutation(len(own))
            test, train, val = SHAPENET[kind][1] if self._synsets else (1, len(own), 0)
            if train + val + test > len(own):
                train, val = (round(share * len(own)) for share in _SHARES)
                test = len(own) - train - val
            ends = np.cumsum([0, train, val, test])
            for split, start, end in zip(SPLITS, ends[:-1], ends[1:], strict=True):
                splits[split] += [own[i] for i in order[start:end]]
        return {split: self._sort_by_class(names) for split, names in splits.items()}

    def _sort_by_class(self, names: Sequence[str]) -> tuple[str, ...]:
        return tuple(sorted(names, key=lambda name: (self.classes.index(name.partition("/")[0]), name)))


def _list_folder(folder: Path) -> list[Path]:
    """List a folder in order, without hidden files. Raises FormatError if it cannot be read."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise FormatError(str(folder), "a readable folder", (error.strerror or str(error)).lower()) from error


def _check_lists(path: Path, value: Any) -> dict[Split, list[str]]:
    """Check the contents of splits.json."""
    if not isinstance(value, dict) or not set(value) <= set(SPLITS):
        raise FormatError(str(path), f"lists by {', '.join(SPLITS)}", "another value")
    lists: dict[Split, list[str]] = {}
    for split in SPLITS:
        names = value.get(split, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise FormatError(f"{path}: {split}", "a list of names", type(names).__name__)
        lists[split] = names
    return lists
