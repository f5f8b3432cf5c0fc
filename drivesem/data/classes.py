"""What the class names of data sets mean: one table of synonyms, the detectors' classes, and ignored types."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

from scene_ir.errors import RangeError

if TYPE_CHECKING:  # torch takes a second to load; readers of label files do not need it
    from scene_ir.types import Labels

CLASS_OF_TYPE: Mapping[str, str] = {
    "Car": "Car",
    "Van": "Car",
    "Truck": "Truck",
    "Pedestrian": "Pedestrian",
    "Cyclist": "Cyclist",
}
"""The detectors' class of each object type, by KITTI's names."""
IGNORED_TYPES: Mapping[str, str | None] = {
    "Person_sitting": "Pedestrian",
    "Bicycle": "Cyclist",
    "Motorcycle": "Cyclist",
    **dict.fromkeys(("Bus", "Tram", "Trailer", "Misc"), None),
}
"""Object types that are neither a miss nor a hit, and the class for which they are ignored; None: for every class.
A bicycle is ignored for cyclists, since a KITTI cyclist includes the rider."""
VEHICLES = ("Car", "Van", "Truck")
"""Types that are de-rendered into movable objects."""
PEOPLE = ("Pedestrian", "Cyclist")
"""Types that are de-rendered into movable objects with --people."""

_SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "Car": (
        *("car", "vehicle", "vehicle car", "taxi", "limousine", "automobile", "sedan", "suv"),
        "vehicle emergency police",
    ),
    "Van": ("van", "minivan", "vehicle emergency ambulance", "ambulance"),
    "Truck": ("truck", "vehicle truck", "lorry", "pickup", "pickup truck"),
    "Pedestrian": (
        *("pedestrian", "person", "people", "man", "woman", "boy", "girl", "child", "human pedestrian adult"),
        *("human pedestrian child", "human pedestrian construction worker", "human pedestrian police officer"),
    ),
    "Cyclist": ("cyclist", "rider", "bicyclist"),
    "Person_sitting": ("person sitting", "sitting person", "human pedestrian wheelchair", "wheelchair"),
    "Bicycle": ("bicycle", "bike", "vehicle bicycle"),
    "Motorcycle": ("motorcycle", "motorbike", "motor", "vehicle motorcycle", "tricycle", "awning tricycle"),
    "Bus": ("bus", "vehicle bus rigid", "vehicle bus bendy"),
    "Tram": ("tram", "train"),
    "Trailer": ("trailer", "vehicle trailer", "caravan"),
    "Misc": (
        *("misc", "other vehicle", "other person", "others", "land vehicle", "construction vehicle"),
        *("vehicle construction", "human pedestrian stroller", "human pedestrian personal mobility"),
    ),
}
"""Names of the object types in KITTI, COCO, Pascal VOC, BDD100K, nuScenes, Waymo, Cityscapes, VisDrone and Open
Images, in lower case with blanks between words."""
_TYPE_OF_NAME = {name: kind for kind, names in _SYNONYMS.items() for name in names}
_SEPARATORS = re.compile(r"[\s_.-]+")
ClassRole = Literal["used", "mapped", "ignored", "background"]
"""What becomes of a data set's class: its objects are used under their name or under another one, are neither a miss
nor a hit, or are background."""


@lru_cache(maxsize=4096)
def object_type(name: str) -> str | None:
    """Return the object type that a data set's class name means; None for background, such as a traffic light.

    The type is a key of CLASS_OF_TYPE or IGNORED_TYPES. Letter case, "_", "-", "." and a prefix "TYPE_" do not matter.
    """
    return _TYPE_OF_NAME.get(_SEPARATORS.sub(" ", name.strip().lower()).removeprefix("type "))


def class_role(name: str, mapping: Mapping[str, str | None]) -> tuple[ClassRole, str]:
    """Return what becomes of a data set's class, and the class of its objects ("" for none).

    Args:
        name: Name in the data set.
        mapping: New names, from `--map`; None makes a class background.
    """
    target = mapping.get(name, name)
    kind = None if target is None else object_type(target)
    if kind is None:
        return "background", ""
    if kind in IGNORED_TYPES:
        return "ignored", IGNORED_TYPES[kind] or ""
    found = CLASS_OF_TYPE[kind]
    return ("used" if name.strip().lower() == found.lower() else "mapped"), found


def check_class_map(mapping: Mapping[str, str | None]) -> None:
    """Raise RangeError for a new class name (`--map OLD=NEW`) that means no object type."""
    for name, target in mapping.items():
        if target is not None and object_type(target) is None:
            expected = f"one of {', '.join((*CLASS_OF_TYPE, *IGNORED_TYPES))}, or - for background"
            raise RangeError(f"--map {name}", expected, repr(target))


def rename_to_types(labels: Labels, mapping: Mapping[str, str | None]) -> Labels:
    """Rename objects to their types; objects of other classes keep their names.

    Args:
        labels: Labels with the data set's class names.
        mapping: New names, from `--map`; None makes a class background.

    Returns:
        The renamed labels, in the same order.
    """
    targets = [mapping.get(kind, kind) for kind in labels.kind]
    kinds = ["background" if target is None else object_type(target) or target for target in targets]
    return replace(labels, kind=tuple(kinds))


def rider_rows(labels: Labels, mapping: Mapping[str, str | None]) -> list[int]:
    """Return the rows of cyclists without their two-wheelers, by the data set's class names.

    Args:
        labels: Labels with the data set's class names.
        mapping: New names, from `--map`; `rider=Cyclist` takes riders for whole.
    """
    return [
        row for row, kind in enumerate(labels.kind) if (mapping.get(kind, kind) or "").strip().lower() == "rider"
    ]


def select_road_users(labels: Labels) -> Labels:
    """Rename objects to their types, and drop those without a type, which are background."""
    labels = rename_to_types(labels, {})
    rows = [row for row, kind in enumerate(labels.kind) if object_type(kind) is not None]
    return labels if len(rows) == len(labels.kind) else labels.select(rows)


def count_vehicles(labels: Labels | None, people: bool = False) -> int:
    """Count the movable objects of a frame, with or without people."""
    movable = VEHICLES + PEOPLE if people else VEHICLES
    return 0 if labels is None else sum(object_type(kind) in movable for kind in labels.kind)
