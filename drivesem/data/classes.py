"""Mapping from the object types of data sets to the detectors' classes, and which types are ignored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch

from detectors.types import CLASSES, Targets
from scene_ir.errors import FormatError, RangeError
from scene_ir.types import Category, Labels


@dataclass(frozen=True, slots=True)
class ClassMap:
    """How the object types of a data set map to the detectors' classes."""

    classes: Mapping[str, str]
    """Maps a type to one of `detectors.types.CLASSES`."""
    ignored: Mapping[str, str | None] = field(default_factory=dict)
    """Maps a type to the class for which it is ignored, neither a miss nor a hit; None: for every class."""

    def __post_init__(self) -> None:
        for kind, name in (*self.classes.items(), *self.ignored.items()):
            if name is not None and name not in CLASSES:
                raise RangeError(f"class map: {kind}", f"one of {', '.join(CLASSES)}", name)
        both = sorted(set(self.classes) & set(self.ignored))
        if both:
            raise RangeError(f"class map: {both[0]}", "a class or to be ignored", "both")

    def category(self, kind: str) -> Category | None:
        """Return the class of a type; None if it is ignored. Raises FormatError for a type in neither table."""
        if kind in self.classes:
            return Category(CLASSES.index(self.classes[kind]))
        if kind in self.ignored:
            return None
        raise FormatError("type", f"one of {', '.join((*self.classes, *self.ignored))}", kind)

    def drop_unknown(self, labels: Labels) -> Labels:
        """Return the labels without objects of types in neither table, which are background."""
        rows = [i for i, kind in enumerate(labels.kind) if kind in self.classes or kind in self.ignored]
        if len(rows) == len(labels.kind):
            return labels
        return labels.select(rows)

    def targets(self, labels: Labels) -> Targets:
        """Return the targets for training and evaluation: objects in file order, then DontCare regions.

        Targets that are ignored for every class have the label 0. Objects with boxes without area are ignored, since
        no detection can match them.
        """
        categories = [self.category(kind) for kind in labels.kind]
        named = [self.ignored.get(kind) for kind in labels.kind]
        index = [
            int(c) if c is not None else CLASSES.index(n) if n is not None else 0
            for c, n in zip(categories, named, strict=True)
        ]
        regions = labels.ignore_xyxy.shape[0]
        flat = (labels.boxes_xyxy[:, 2:] <= labels.boxes_xyxy[:, :2]).any(dim=1).tolist()
        ignored = [c is None or thin for c, thin in zip(categories, flat, strict=True)]
        return Targets(
            boxes_xyxy=torch.cat([labels.boxes_xyxy, labels.ignore_xyxy]),
            labels=torch.tensor([*index, *[0] * regions], dtype=torch.int64),
            ignore=torch.tensor([*ignored, *[True] * regions], dtype=torch.bool),
        )


KITTI = ClassMap(
    classes={"Car": "Car", "Van": "Car", "Truck": "Truck", "Pedestrian": "Pedestrian", "Cyclist": "Cyclist"},
    ignored={"Person_sitting": "Pedestrian", "Tram": None, "Misc": None},
)
"""KITTI's types. Vans count as cars; sitting people, trams and miscellaneous objects are ignored."""

COCO_ROAD_USERS = ClassMap(
    classes={"car": "Car", "truck": "Truck", "person": "Pedestrian"},
    ignored={"bus": None, "train": None, "bicycle": "Cyclist", "motorcycle": "Cyclist"},
)
"""Road users among the classes of COCO 2017. Buses and trains are ignored, and so are bicycles: a KITTI cyclist
includes the rider."""
ROAD_USERS = ClassMap(
    classes={**KITTI.classes, **COCO_ROAD_USERS.classes}, ignored={**KITTI.ignored, **COCO_ROAD_USERS.ignored}
)
"""KITTI's types and COCO's classes, which differ at least in letter case."""

VEHICLES: Mapping[str, Category] = {"Car": Category.CAR, "Van": Category.CAR, "Truck": Category.TRUCK}
"""Types that are de-rendered into movable objects."""


def to_kitti_kinds(labels: Labels) -> Labels:
    """Rename COCO's classes to KITTI's types; ignored classes keep their names."""
    names = COCO_ROAD_USERS.classes
    return replace(labels, kind=tuple(names.get(kind, kind) for kind in labels.kind))


def count_vehicles(labels: Labels | None) -> int:
    """Count the movable objects of a frame."""
    return 0 if labels is None else sum(kind in VEHICLES for kind in to_kitti_kinds(labels).kind)
