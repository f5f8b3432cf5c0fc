"""Where objects come from, and the embedded ones: a hundred of each class, made by code."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from zlib import crc32

import numpy as np

from drivesem.classify.objects.made.airplanes import AIRPLANES
from drivesem.classify.objects.made.boats import BOATS
from drivesem.classify.objects.made.cycles import MOTORCYCLES, SKATEBOARDS
from drivesem.classify.objects.made.helmets import HELMETS
from drivesem.classify.objects.made.street import BENCHES, MAILBOXES, TRASHCANS
from drivesem.classify.objects.made.towers import TOWERS
from drivesem.classify.objects.made.vehicles import BUSES, CARS, TRAINS
from drivesem.classify.objects.surfaces import Kit
from drivesem.classify.objects.types import CLASSES, ObjectModel, ObjectSet, Split
from scene_ir.errors import RangeError

KINDS: Mapping[str, tuple[Callable[[Kit], None], ...]] = {
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
"""What makes each class's objects; object n is of kind n modulo their number."""

_NUMBERS = tuple(f"{number:04d}" for number in range(100))
_SPLITS: Mapping[Split, tuple[str, ...]] = {"train": _NUMBERS[:70], "val": _NUMBERS[70:80], "test": _NUMBERS[80:]}
"""Numbers of each split's objects, in every class: 70, 10 and 20 %, as in the paper."""


class EmbeddedObjects:
    """A hundred different objects of each of the paper's classes: `ObjectSet`.

    Each has a generator of its own, seeded by its name: the same proportions, parts and colours wherever and
    whenever it is made.
    """

    classes: tuple[str, ...] = CLASSES

    def names(self, split: Split) -> tuple[str, ...]:
        """Names of a split's objects, in the order of classes."""
        return tuple(f"{name}/{number}" for name in self.classes for number in _SPLITS[split])

    def load(self, name: str) -> ObjectModel:
        """The object "class/0000" to "class/0099". Raises RangeError for any other name."""
        kind, _, number = name.partition("/")
        if kind not in KINDS or number not in _NUMBERS:
            raise RangeError("object", f"a class of {', '.join(self.classes)}, and 0000 to {_NUMBERS[-1]}", name)
        make = KINDS[kind][int(number) % len(KINDS[kind])]
        kit = Kit(np.random.default_rng([crc32(kind.encode()), int(number)]))
        make(kit)
        return kit.model(name, self.classes.index(kind))


def open_objects(source: str | None, *, seed: int = 0, most_triangles: int | None = 20_000) -> ObjectSet:
    """The embedded objects (None), or those of a folder: see `FolderObjects`, which seed and most_triangles are
    for. Raises FormatError for a folder without objects.
    """
    if source is None:
        return EmbeddedObjects()
    from drivesem.classify.objects.folders import FolderObjects

    return FolderObjects(source, seed=seed, most_triangles=most_triangles)
