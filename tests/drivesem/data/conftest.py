"""A small exposure made by hand: three labelled objects, one too hidden to be, a region where nothing stands."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch

from drivesem.data.ground_truth import SKY_CM, Exposure, TrackedObject
from scene_ir.types import Camera
from tests.drivesem.data.shots import make_labels, shot
from tests.drivesem.data.shots import make_object as build_object

HEIGHT, WIDTH = 40, 80
CLASS_NAMES = (
    *("Undefined", "Terrain", "Sky", "Tree", "Vegetation", "Building", "Road", "GuardRail", "TrafficSign"),
    *("TrafficLight", "Pole", "Misc", "Truck", "Car", "Van", "Pedestrian", "Cyclist"),
)
# track, kind, rows, columns, labelled; the van stands before the car, the truck shows a corner
OBJECTS = (
    (7, "Car", (12, 24), (5, 25), True),
    (2, "Truck", (10, 13), (40, 46), False),
    (3, "Van", (14, 30), (20, 40), True),
    (255, "Pedestrian", (15, 35), (60, 66), True),
)


def _exposure(seed: int = 0, specification: Sequence[tuple] = OBJECTS, empty_box: bool = True) -> Exposure:
    generator = np.random.default_rng(seed)
    instances = np.zeros((HEIGHT, WIDTH), np.uint16)
    classes = generator.integers(0, 11, (HEIGHT, WIDTH)).astype(np.uint8)
    depth_cm = generator.integers(1, 25_599, (HEIGHT, WIDTH)).astype(np.uint16)
    for track, kind, (top, bottom), (left, right), _ in specification:
        instances[top:bottom, left:right] = track + 1
        classes[top:bottom, left:right] = CLASS_NAMES.index(kind)
    depth_cm[classes == 2] = SKY_CM
    objects = []
    for track, kind, (top, bottom), (left, right), labelled in specification:
        pixels = int((instances == track + 1).sum())
        visible = pixels / ((bottom - top) * (right - left))
        x, z = generator.uniform(-5, 5), generator.uniform(8, 40)
        objects.append(
            build_object(
                track,
                kind,
                box_ltrb=(left, top, right - 1, bottom - 1),
                pixels=pixels,
                truncation=0.25 if labelled else 0.0,
                visible=visible,
                translation=(x, 1.65, z),
                yaw=float(generator.uniform(-np.pi, np.pi)),
                size_lhw=(4.25, 1.5, 1.75),
                world=(x, 0.0, z),
                world_yxz=(0.0, 0.0, 0.0),
                labelled=labelled,
            )
        )
    labelled_objects = [o for o in objects if o.labelled]

    def edges(tracked: TrackedObject) -> list[float]:
        left, top, right, bottom = tracked.box_ltrb
        return [max(left - 0.5, 0), max(top - 0.5, 0), min(right + 0.5, WIDTH - 1), min(bottom + 0.5, HEIGHT - 1)]

    return Exposure(
        image=generator.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8),
        depth_cm=depth_cm,
        classes=classes,
        class_names=CLASS_NAMES,
        instances=instances,
        camera=Camera(
            torch.tensor([[72.0, 0, 39.25], [0, 72, 18.25], [0, 0, 1]]),
            HEIGHT,
            WIDTH,
            torch.tensor([[72.0, 0, 39.25, 4.57], [0, 72, 18.25, 0.2], [0, 0, 1, 0.003]]),
        ),
        extrinsic=np.eye(4),
        objects=tuple(objects),
        labels=make_labels(
            labelled_objects,
            [edges(o) for o in labelled_objects],
            [edges(o) for o in objects if not o.labelled] + [[70.0, 2.0, 76.0, 8.5]] * empty_box,
        ),
    )


@pytest.fixture
def make_exposure() -> Callable[..., Exposure]:
    """An exposure of 80x40 px by seed. things: (track, kind, rows, columns, labelled) a rectangle; empty_box: a
    region to ignore where no object stands."""
    return _exposure


@pytest.fixture(scope="session")
def make_object() -> Callable[..., TrackedObject]:
    """The factory of objects, by track, kind and whatever else is to differ."""
    return build_object


@pytest.fixture(scope="session")
def make_shot() -> Callable[..., Exposure]:
    """The factory of exposures, by height, width, camera and seed."""
    return shot
