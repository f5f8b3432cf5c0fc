"""Percentiles of places, headings and sizes: by hand on made-up distributions, and what KITTI's own say."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from drivesem.synth.compare import Quantity, histograms
from scene_ir.errors import RangeError
from scene_ir.types import Labels
from tools.experiments.plausibility.percentiles import (
    NAMES,
    PercentileScale,
    VehiclePlausibility,
    build_scales,
    kitti_scales,
    vehicle_plausibility,
)

EVEN = PercentileScale(Quantity("Even", "m", (0.0, 1.0, 2.0, 3.0, 4.0)), np.full(4, 0.25))


def labels(
    *cars: tuple[float, float, float], kind: str = "Car", size: tuple[float, ...] = (4.2, 1.5, 1.65)
) -> Labels:
    """Vehicles at (x, z) m with a yaw, rad."""
    count = len(cars)
    rows = torch.tensor(cars, dtype=torch.float32).reshape(-1, 3)
    return Labels(
        kind=(kind,) * count,
        boxes_xyxy=torch.tensor([[0.0, 0, 60, 40]]).repeat(count, 1),
        truncation=torch.zeros(count),
        occlusion=torch.zeros(count, dtype=torch.int64),
        translation=torch.stack([rows[:, 0], torch.full((count,), 1.65), rows[:, 1]], dim=1),
        yaw=rows[:, 2],
        size_lhw=torch.tensor(size).repeat(count, 1),
        ignore_xyxy=torch.zeros(0, 4),
    )


def test_an_even_distribution_by_hand() -> None:
    values = np.array([2.0, 1.0, 3.0, 0.5, 0.1, -7.0, 99.0, np.nan])
    # the end bins also hold what lies beyond: outside of their middles nothing is rarer
    expected = [100.0, 50.0, 50.0, 25.0, 25.0, 25.0, 25.0, np.nan]
    np.testing.assert_allclose(EVEN.percentiles(values), expected, atol=1e-9)


def test_angles_by_hand() -> None:
    """Three in four of the vehicles ahead, one in four behind; a quarter turn lies half-way."""
    half = math.pi / 2
    quantity = Quantity("Angle", "rad", tuple((i - 0.5) * half - math.pi for i in range(5)), angle=True)
    # bins about -pi, -pi / 2, 0, pi / 2
    scale = PercentileScale(quantity, np.array([0.25, 0.0, 0.75, 0.0]))
    ahead, behind, side, again = scale.percentiles(np.array([0.0, math.pi, half, 2 * math.pi]))
    assert ahead == again == pytest.approx(100)
    assert side == 0.0
    # densities fall evenly from 0.75 and from 0.25 to 0: as common as `behind` or rarer are all behind, and the
    # third of the way down from 0.75 that lies lowest, whose mass is a ninth of the rest
    assert behind == pytest.approx(100 * (0.25 + 0.75 / 9), abs=0.5)


@given(st.sampled_from([n for n in NAMES if n != "yaw_rad"]), st.floats(-100, 200), st.floats(0.01, 50))
def test_farther_from_the_median_is_never_more_common(name: str, value: float, step: float) -> None:
    scale = kitti_scales()[name]
    edges = np.asarray(scale.quantity.edges)
    middle = np.interp(0.5, np.concatenate([[0.0], np.cumsum(scale.shares)]), edges)
    away = value + step if value >= middle else value - step
    near, far = scale.percentiles(np.array([value, away]))
    assert 0.0 <= far <= near + 1e-9 <= 100.0 + 1e-9


def test_what_kitti_shows_often_and_what_it_does_not() -> None:
    scale = kitti_scales()
    along, across, slanted = scale["yaw_rad"].percentiles(np.array([-math.pi / 2, 0.0, 0.8]))
    assert along > 90 > across > slanted
    assert slanted < 5
    unseen, common = scale["height_m"].percentiles(np.array([1.02, 1.53]))
    assert unseen == 0.0
    assert common > 95
    assert scale["depth_m"].percentiles(np.array([26.0]))[0] > 85


def test_a_frame() -> None:
    found = vehicle_plausibility(labels((-2.0, 20.0, -1.57), (2.0, 20.0, 0.8)))
    assert found.table.shape == (2, len(NAMES))
    assert set(found.percentiles) == set(NAMES)
    assert found.percentiles["spacing_m"][0] == found.percentiles["spacing_m"][1]
    np.testing.assert_array_equal(found.lowest, found.table.min(axis=1))
    assert found.lowest[1] == found.percentiles["yaw_rad"][1] < 5 < found.lowest[0]


def test_one_alone_has_no_neighbour_and_people_are_left_out() -> None:
    alone = vehicle_plausibility(labels((-2.0, 20.0, -1.57)))
    assert np.isnan(alone.percentiles["spacing_m"]).all()
    assert np.isfinite(alone.lowest).all()
    people = vehicle_plausibility(labels((-2.0, 20.0, -1.57), kind="Pedestrian"))
    assert people.table.shape == (0, len(NAMES))
    assert people.lowest.shape == (0,)
    unknown = VehiclePlausibility({name: np.array([np.nan]) for name in NAMES})
    assert np.isnan(unknown.lowest).all()


def test_vehicles_without_poses_are_refused() -> None:
    with pytest.raises(RangeError, match="1 vehicles with poses, found 0"):
        vehicle_plausibility(labels((math.nan, 20.0, -1.57)))
    with pytest.raises(RangeError, match="histograms: depth_m"):
        build_scales(histograms([]))
