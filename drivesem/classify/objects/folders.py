"""Objects in folders: ShapeNetCore's layout, and meshes by class."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from drivesem.classify.objects.meshes import read_object
from drivesem.classify.objects.types import CLASSES, SPLITS, ObjectModel, Split
from drivesem.classify.paper import figures
from scene_ir import files
from scene_ir.errors import FormatError, RangeError

_SYNSETS = {
    "02691156": "airplane",
    "02828884": "bench",
    "02747177": "trashcan",
    "02924116": "bus",
    "02958343": "car",
    "03513137": "helmet",
    "03710193": "mailbox",
    "03790512": "motorcycle",
    "04225987": "skateboard",
    "04460130": "tower",
    "04468005": "train",
    "04530566": "boat",
}
"""ShapeNetCore's folders of the paper's classes: WordNet's numbers."""
_SHARES = (0.7, 0.1)
"""Of training and validation where a class has fewer objects than in the paper: the paper's own shares."""
_MODELS = ("models/model_normalized.obj", "model.obj")
"""Of an object in ShapeNetCore's second and first version."""
_SUFFIXES = (".obj", ".glb", ".ply")


class FolderObjects:
    """Objects read from a folder: `ObjectSet`.

    Either ShapeNetCore's `SYNSET/HASH/models/model_normalized.obj`, of which the paper's classes are taken, or
    `CLASS/NAME.obj` (or .glb, .ply) with any classes. Splits come from `splits.json` in the folder ({"train":
    ["bus/NAME", ...], "val": [...], "test": [...]}) or from `train.txt`, `val.txt` and `test.txt`, a name a line;
    else they are drawn by `seed`, class by class: of the paper's sizes where a class has so many objects, else 70,
    10 and 20 %. most_triangles: finer meshes are simplified to so many.
    Raises FormatError for a folder without objects, and for lists that name what is not there.
    """

    def __init__(self, folder: str | Path, *, seed: int = 0, most_triangles: int | None = None) -> None:
        if most_triangles is not None and most_triangles < 4:
            raise RangeError("most_triangles", "at least 4", most_triangles)
        self._root, self._seed, self._most = Path(folder), seed, most_triangles
        if not self._root.is_dir():
            raise FormatError(str(folder), "a folder of objects", "no such folder")
        self._synsets = {name: self._root / s for s, name in _SYNSETS.items() if (self._root / s).is_dir()}
        self._paths = self._shapenet() if self._synsets else self._by_class()
        if not self._paths:
            expected = f"ShapeNetCore's folders, or folders of {', '.join(_SUFFIXES)} by class"
            raise FormatError(str(folder), expected, "no object")
        known = {name.partition("/")[0] for name in self._paths}
        self.classes: tuple[str, ...] = CLASSES if known <= set(CLASSES) else tuple(sorted(known))
        if len(self.classes) < 2:
            raise FormatError(str(folder), "objects of two classes at least", f"of {min(known)} alone")
        folders = Counter(name.replace("/", "-") for name in self._paths)
        twice = next((name for name, count in folders.items() if count > 1), None)
        if twice is not None:
            raise FormatError(str(folder), "names that differ with - for /", f"{twice} twice")
        self._splits = self._listed() or self._drawn()

    def names(self, split: Split) -> tuple[str, ...]:
        """Names of a split's objects, in the order of classes."""
        return self._splits[split]

    def load(self, name: str) -> ObjectModel:
        """The object of that name. Raises FormatError where it cannot be read, RangeError where there is none."""
        if name not in self._paths:
            raise RangeError("object", f"one of the {len(self._paths):,} in {self._root}", name)
        path, label = self._paths[name], self.classes.index(name.partition("/")[0])
        if self._synsets:
            path, folder = next((path / m for m in _MODELS if (path / m).is_file()), path / _MODELS[0]), path
        else:
            folder = path.parent
        return read_object(path, name, label, folder, self._most)

    def _shapenet(self) -> dict[str, Path]:
        """Folders of objects by name."""
        found = {kind: _inside(synset) for kind, synset in self._synsets.items()}
        return {f"{kind}/{path.name}": path for kind, paths in found.items() for path in paths if path.is_dir()}

    def _by_class(self) -> dict[str, Path]:
        """Mesh files by name."""
        paths: dict[str, Path] = {}
        for folder in (path for path in _inside(self._root) if path.is_dir()):
            for path in _inside(folder):
                name = f"{folder.name}/{path.stem}"
                if path.suffix.lower() not in _SUFFIXES:
                    continue
                if name in paths:
                    raise FormatError(str(path), "one mesh of a name", f"{paths[name].name} too")
                paths[name] = path
        return paths

    @cached_property
    def _aliases(self) -> dict[str, str]:
        """Names by what lists call objects: by class, by synset, and by hash alone."""
        aliases = {name: name for name in self._paths}
        for name in self._paths if self._synsets else ():
            kind, _, code = name.partition("/")
            aliases[f"{self._synsets[kind].name}/{code}"] = name
            aliases[code] = name
        return aliases

    def _listed(self) -> dict[Split, tuple[str, ...]] | None:
        """The splits as lists beside the objects say; None where there are none."""
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
            for listed in lists[split]:
                name = self._aliases.get(listed)
                if name is None:
                    raise FormatError(f"{where}: {split}", f"objects of {self._root}", repr(listed[:200]))
                if owner.setdefault(name, split) != split:
                    raise FormatError(f"{where}: {split}", "objects of no other split", repr(listed[:200]))
        return {split: self._ordered([name for name, own in owner.items() if own == split]) for split in SPLITS}

    def _drawn(self) -> dict[Split, tuple[str, ...]]:
        """Splits drawn by seed."""
        splits: dict[Split, list[str]] = {split: [] for split in SPLITS}
        sizes = figures()["sizes"] if self._synsets else {}
        for kind in self.classes:
            own = sorted(name for name in self._paths if name.partition("/")[0] == kind)
            order = np.random.default_rng([self._seed, crc32(kind.encode())]).permutation(len(own))
            test, train, val = sizes.get(kind, (1, len(own), 0))
            if train + val + test > len(own):
                train, val = (round(share * len(own)) for share in _SHARES)
                test = len(own) - train - val
            ends = np.cumsum([0, train, val, test])
            for split, start, end in zip(SPLITS, ends[:-1], ends[1:], strict=True):
                splits[split] += [own[i] for i in order[start:end]]
        return {split: self._ordered(names) for split, names in splits.items()}

    def _ordered(self, names: Sequence[str]) -> tuple[str, ...]:
        return tuple(sorted(names, key=lambda name: (self.classes.index(name.partition("/")[0]), name)))


def _inside(folder: Path) -> list[Path]:
    """What a folder holds, in order, hidden things left out. Raises FormatError where it cannot be read."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise FormatError(str(folder), "a readable folder", (error.strerror or str(error)).lower()) from error


def _check_lists(path: Path, value: Any) -> dict[Split, list[str]]:
    """Lists of names by split, as a file of JSON has them."""
    if not isinstance(value, dict) or not set(value) <= set(SPLITS):
        raise FormatError(str(path), f"lists by {', '.join(SPLITS)}", "another value")
    lists: dict[Split, list[str]] = {}
    for split in SPLITS:
        names = value.get(split, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise FormatError(f"{path}: {split}", "a list of names", type(names).__name__)
        lists[split] = names
    return lists
