"""Opens sets of objects; the embedded set has a hundred generated objects of each class."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from zlib import crc32

import numpy as np

from drivesem.classify.objects.generated.shapes import ObjectBuilder
from drivesem.classify.objects.generated.structures import BENCHES, HELMETS, MAILBOXES, TOWERS, TRASHCANS
from drivesem.classify.objects.generated.vehicles import (
    AIRPLANES,
    BOATS,
    BUSES,
    CARS,
    MOTORCYCLES,
    SKATEBOARDS,
    TRAINS,
)
from drivesem.classify.objects.types import CLASSES, ObjectModel, ObjectSet, Split
from scene_ir.errors import RangeError

KINDS: Mapping[str, tuple[Callable[[ObjectBuilder], None], ...]] = {
    "airplane": AIRPLANES,
    "bench": BENCHES,
    "trashcan": TRASHCANS,
    "bus": BUSES,
    "car": CARS,
    "helmet": HELMETS,
    "mailbox": MAILBOXES,
    "motorcycle": MOTORCYCLES,
    "skateboard": SKATEBOARDS,
    "tower": TOWERS,
    "train": TRAINS,
    "boat": BOATS,
}
"""Generators of each class; object n uses generator n modulo their number."""

_NUMBERS = tuple(f"{number:04d}" for number in range(100))
_SPLITS: Mapping[Split, tuple[str, ...]] = {"train": _NUMBERS[:70], "val": _NUMBERS[70:80], "test": _NUMBERS[80:]}
"""Numbers of the objects of each split, in every class: 70, 10 and 20 %, as in the paper."""


class EmbeddedObjects:
    """`ObjectSet` of a hundred generated objects of each of the paper's classes, each seeded by its name."""

    classes: tuple[str, ...] = CLASSES

    def names(self, split: Split) -> tuple[str, ...]:
        """List the names of a split's objects, in the order of classes."""
        return tuple(f"{name}/{number}" for name in self.classes for number in _SPLITS[split])

    def load(self, name: str) -> ObjectModel:
        """Generate object "class/0000" to "class/0099". Raises RangeError for any other name."""
        kind, _, number = name.partition("/")
        if kind not in KINDS or number not in _NUMBERS:
            raise RangeError("object", f"a class of {', '.join(self.classes)}, and 0000 to {_NUMBERS[-1]}", name)
        generate = KINDS[kind][int(number) % len(KINDS[kind])]
        builder = ObjectBuilder(np.random.default_rng([crc32(kind.encode()), int(number)]))
        generate(builder)
        return builder.build(name, self.classes.index(kind))


def open_objects(source: str | None, *, seed: int = 0, max_triangles: int | None = 20_000) -> ObjectSet:
    """Open the embedded objects, or those of a folder.

    Args:
        source: The folder; None for the embedded objects.
        seed: See `FolderObjects`.
        max_triangles: See `FolderObjects`.

    Raises:
        FormatError: A folder without objects.
    """
    if source is None:
        return EmbeddedObjects()
    from drivesem.classify.objects.folders import FolderObjects

    return FolderObjects(source, seed=seed, max_triangles=max_triangles)
