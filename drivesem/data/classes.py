"""Which of a data set's types are which of the detectors' classes, and what nothing is judged on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch

from detectors.types import CLASSES, Targets
from scene_ir.errors import FormatError, RangeError
from scene_ir.types import Category, Labels


@dataclass(frozen=True, slots=True)
class ClassMap:
    """How a data set's types are read.

    classes: type -> one of `detectors.types.CLASSES`. ignored: type -> the class it is ignored for, or None for
    every class: such objects are neither missed nor a hit.
    """

    classes: Mapping[str, str]
    ignored: Mapping[str, str | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for kind, name in (*self.classes.items(), *self.ignored.items()):
            if name is not None and name not in CLASSES:
                raise RangeError(f"class map: {kind}", f"one of {', '.join(CLASSES)}", name)
        both = sorted(set(self.classes) & set(self.ignored))
        if both:
            raise RangeError(f"class map: {both[0]}", "a class or to be ignored", "both")

    def category(self, kind: str) -> Category | None:
        """The class that a type counts as; None where it is ignored. FormatError for a type in neither table."""
        if kind in self.classes:
            return Category(CLASSES.index(self.classes[kind]))
        if kind in self.ignored:
            return None
        raise FormatError("type", f"one of {', '.join((*self.classes, *self.ignored))}", kind)

    def known(self, labels: Labels) -> Labels:
        """The labels without objects of types in neither table: they are background."""
        rows = [i for i, kind in enumerate(labels.kind) if kind in self.classes or kind in self.ignored]
        if len(rows) == len(labels.kind):
            return labels
        return labels.rows(rows)

    def targets(self, labels: Labels) -> Targets:
        """What a detector is trained on and judged by.

        Objects in file order, then the DontCare regions. What is ignored for every class carries the label 0: an
        ignored target's label says nothing. An object whose box has no area is ignored: nothing can meet it.
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
"""KITTI's types. Vans count as cars and sitting people are ignored; trams and the miscellaneous look like nothing
the detectors know."""

COCO_ROAD_USERS = ClassMap(
    classes={"car": "Car", "truck": "Truck", "person": "Pedestrian"},
    ignored={"bus": None, "train": None, "bicycle": "Cyclist", "motorcycle": "Cyclist"},
)
"""The classes of COCO 2017 that are on the road. A KITTI cyclist includes the bicycle, so that a bicycle alone is
neither; buses and trains look like nothing the detectors know."""
ROAD_USERS = ClassMap(
    classes={**KITTI.classes, **COCO_ROAD_USERS.classes}, ignored={**KITTI.ignored, **COCO_ROAD_USERS.ignored}
)
"""KITTI's types and COCO's classes: they differ in letter case at least."""

VEHICLES: Mapping[str, Category] = {"Car": Category.CAR, "Van": Category.CAR, "Truck": Category.TRUCK}
"""Types that are de-rendered into objects that can be moved."""


def as_kitti(labels: Labels) -> Labels:
    """The labels with COCO's classes by the names of KITTI's types; those that are ignored keep their own."""
    names = COCO_ROAD_USERS.classes
    return replace(labels, kind=tuple(names.get(kind, kind) for kind in labels.kind))


def vehicle_count(labels: Labels | None) -> int:
    """How many objects of a frame can be moved."""
    return 0 if labels is None else sum(kind in VEHICLES for kind in as_kitti(labels).kind)
