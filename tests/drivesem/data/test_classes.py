"""Class names of data sets: synonyms, roles, and the types that they mean."""

from __future__ import annotations

import pytest

from drivesem.data.classes import (
    CLASS_OF_TYPE,
    IGNORED_TYPES,
    check_class_map,
    class_role,
    object_type,
    rename_to_types,
    select_road_users,
)
from drivesem.training.frames import make_targets
from scene_ir.errors import RangeError
from scene_ir.types import Category
from tests.drivesem.data.shots import plain_labels


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        (("Car", "CAR", "vehicle", "VEHICLE", "TYPE_VEHICLE", "vehicle.car", "Taxi"), "Car"),
        (("van", "Van", "minivan"), "Van"),
        (("truck", "vehicle.truck", "lorry"), "Truck"),
        (("person", "pedestrian", "TYPE_PEDESTRIAN", "human.pedestrian.adult", "people", "Woman"), "Pedestrian"),
        (("Cyclist", "rider", "TYPE_CYCLIST"), "Cyclist"),
        (("Person_sitting", "person sitting"), "Person_sitting"),
        (("bicycle", "bike", "vehicle.bicycle"), "Bicycle"),
        (("motor", "motorbike", "Motorcycle", "awning-tricycle"), "Motorcycle"),
        (("bus", "vehicle.bus.bendy"), "Bus"),
        (("Tram", "train"), "Tram"),
        (("traffic light", "dog", "", "cart"), None),
    ],
)
def test_one_table_of_synonyms(names: tuple[str, ...], kind: str | None) -> None:
    assert {object_type(name) for name in names} == {kind}


def test_types_mean_themselves() -> None:
    for kind in (*CLASS_OF_TYPE, *IGNORED_TYPES):
        assert object_type(kind) == kind


def test_roles_of_classes() -> None:
    mapping = {"cart": "Van", "car": None}
    assert class_role("pedestrian", {}) == ("used", "Pedestrian")
    assert class_role("rider", {}) == ("mapped", "Cyclist")
    assert class_role("bus", {}) == ("ignored", "")
    assert class_role("traffic light", {}) == ("background", "")
    assert class_role("cart", mapping) == ("mapped", "Car")
    assert class_role("car", mapping) == ("background", "")


def test_a_map_to_an_unknown_class_is_refused() -> None:
    check_class_map({"cart": "Van", "dog": None})
    with pytest.raises(RangeError, match=r"--map cart: expected one of Car, .* found 'Cart'"):
        check_class_map({"cart": "Cart"})


def test_types_become_targets() -> None:
    kinds = ("Car", "van", "truck", "person", "Person_sitting", "rider", "Tram", "Misc", "dog")
    labels = select_road_users(plain_labels(kinds, regions=1))
    targets = make_targets(labels)
    assert targets.ignore.tolist() == [False, False, False, False, True, False, True, True, True]
    assert targets.labels[~targets.ignore].tolist() == [0, 0, 1, 2, 3]
    assert int(targets.labels[4]) == Category.PEDESTRIAN


def test_renaming_preserves_rows() -> None:
    labels = plain_labels(("rider", "dog", "car"))
    assert rename_to_types(labels, {"car": None}).kind == ("Cyclist", "dog", "background")
