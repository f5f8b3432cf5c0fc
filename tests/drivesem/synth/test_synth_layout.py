"""Where vehicles and people are put: on the road, apart from one another, as often as in KITTI."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from drivesem.synth.layout import (
    MARGIN_M,
    ROAD_KINDS,
    Actor,
    LayoutSettings,
    clearance,
    footprint,
    place_people,
    place_vehicles,
    plan_road,
    statistics,
)
from drivesem.synth.soup import Material
from scene_ir.geometry import ground_footprint


def _actors(seed: int, **changes: object) -> list[Actor]:
    rng = np.random.default_rng(seed)
    layout = LayoutSettings(**changes)
    return place_vehicles(rng, plan_road(rng, layout.kinds), layout)


def test_clearance_of_parallel_boxes_is_their_gap_and_negative_where_they_overlap():
    one = footprint((0.0, 10.0), 0.0, (4.0, 1.5, 2.0))
    assert clearance(one, footprint((0.0, 13.0), 0.0, (4.0, 1.5, 2.0))) == pytest.approx(1.0)
    assert clearance(one, footprint((3.0, 10.5), 0.3, (4.0, 1.5, 2.0))) < 0


def test_clearance_sees_a_corner_between_axis_aligned_bounds():
    one = footprint((0.0, 0.0), np.pi / 4, (4.0, 1.5, 1.0))
    two = footprint((2.0, 2.0), np.pi / 4, (4.0, 1.5, 1.0))
    assert clearance(one, two) > 1.0


def test_footprint_follows_the_projects_yaw():
    size, yaw = (4.2, 1.5, 1.8), 0.7
    found = footprint((1.0, 12.0), yaw, size)
    expected = ground_footprint(torch.tensor(size), torch.tensor(yaw), torch.tensor([1.0, 0.0, 12.0])).numpy()
    distance = np.linalg.norm(found[:, None] - expected[None], axis=-1).min(axis=1)
    assert distance.max() < 1e-5


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_no_two_vehicles_touch_and_none_stands_in_the_camera(seed):
    outlines = [footprint(a.position_xz, a.yaw, a.size_lhw) for a in _actors(seed)]
    outlines.append(footprint((0.0, 1.5), -np.pi / 2, (7.0, 2.0, 2.2)))
    for one, two in itertools.combinations(outlines, 2):
        assert clearance(one, two) >= MARGIN_M - 1e-9


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_vehicles_stand_on_asphalt_or_parking_strips(seed):
    rng = np.random.default_rng(seed)
    road = plan_road(rng)
    paved = [(s.d0, s.d1) for s in road.strips if s.material in (Material.ROAD, Material.PARKING)]
    for actor in place_vehicles(rng, road, LayoutSettings()):
        x, z = actor.position_xz
        if road.crossing and road.crossing[0] - 1 < z < road.crossing[1] + 1:
            continue
        station = z
        for _ in range(8):
            at = road.point(0.0, station)
            heading = road.curvature * station
            along = (x - at[0]) * np.sin(heading) + (z - at[1]) * np.cos(heading)
            station += float(along)
        d = (x - at[0]) * np.cos(heading) - (z - at[1]) * np.sin(heading)
        assert any(low - 0.4 <= d <= high + 0.4 for low, high in paved), (d, paved)


def test_people_keep_clear_of_vehicles():
    met = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        road = plan_road(rng)
        vehicles = place_vehicles(rng, road, LayoutSettings())
        people = place_people(rng, road, vehicles)
        met += len(people)
        for person, vehicle in itertools.product(people, vehicles):
            gap = clearance(*(footprint(a.position_xz, a.yaw, a.size_lhw) for a in (person, vehicle)))
            assert gap > 0.2
    assert met > 10


def test_depths_and_types_are_distributed_as_in_the_labels():
    actors = [a for seed in range(150) for a in _actors(seed)]
    depth = np.array([a.position_xz[1] for a in actors])
    fitted = statistics()
    middle = (fitted.depth_edges_m[1:] + fitted.depth_edges_m[:-1]) / 2
    expected = float(middle[np.searchsorted(np.cumsum(fitted.depth_share), 0.5)])
    assert abs(np.median(depth) - expected) < 10
    labels = [a.label for a in actors]
    assert 0.75 < labels.count("Car") / len(labels) < 0.95
    assert 0.01 < labels.count("Truck") / len(labels) < 0.15


def test_sizes_of_cars_are_near_the_labels_mean():
    sizes = np.array([a.size_lhw for seed in range(60) for a in _actors(seed) if a.label == "Car"])
    height, width, length = statistics().size_hwl_mean_m["Car"]
    assert np.abs(sizes.mean(axis=0) - [length, height, width]).max() < 0.5


@pytest.mark.parametrize("kind", ROAD_KINDS)
def test_every_kind_of_road_can_be_asked_for(kind):
    road = plan_road(np.random.default_rng(3), (kind,))
    assert road.kind == kind
    assert (road.crossing is not None) == (kind == "junction")


def test_strips_do_not_overlap():
    for seed in range(30):
        road = plan_road(np.random.default_rng(seed))
        spans = sorted((s.d0, s.d1) for s in road.strips)
        assert all(b[0] >= a[1] - 1e-6 for a, b in itertools.pairwise(spans)), (road.kind, spans)


def test_variants_stay_in_the_asked_range():
    actors = [a for seed in range(30) for a in _actors(seed, variants=(100, 60), vehicles=(5, 8))]
    assert actors
    assert all(100 <= a.variant < 160 for a in actors)
