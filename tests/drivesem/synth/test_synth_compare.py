"""Distributions are counted as KITTI's figures were, and their distances are those of planted shifts."""

import json
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch

from drivesem.synth.compare import QUANTITIES, VEHICLES, Comparison, Histograms, compare, histograms, reference
from drivesem.synth.layout import statistics
from scene_ir.types import Labels


def _labels(depths: list[float], kind: str = "Car", yaw: float = -np.pi / 2, height_px: float = 52.0) -> Labels:
    """Vehicles one behind the other, 1 m to the right."""
    m = len(depths)
    return Labels(
        kind=(kind,) * m,
        boxes_xyxy=torch.tensor([[100.0, 150.0, 160.0, 150.0 + height_px]]).repeat(m, 1),
        truncation=torch.zeros(m),
        occlusion=torch.zeros(m, dtype=torch.int64),
        translation=torch.tensor([[1.0, 1.6, z] for z in depths]).reshape(-1, 3),
        yaw=torch.full((m,), yaw),
        size_lhw=torch.tensor([[3.9, 1.5, 1.6]]).repeat(m, 1),
        ignore_xyxy=torch.zeros(0, 4),
    )


@dataclass(frozen=True)
class _Frames:
    """A data set of given labels."""

    found: dict[str, Labels | None]

    @property
    def identifiers(self) -> tuple[str, ...]:
        return tuple(self.found)

    def labels(self, identifier: str) -> Labels | None:
        return self.found[identifier]


def test_equal_sets_have_no_distance():
    own = histograms([_labels([12.0, 22.0]), _labels([7.0])])
    for distance in Comparison(own, own).distances.values():
        assert distance.wasserstein == 0
        assert distance.total_variation == 0


def test_a_shift_in_depth_is_its_own_distance():
    one, two = histograms([_labels([12.0, 22.0, 33.0])]), histograms([_labels([27.0, 37.0, 48.0])])
    distances = Comparison(one, two).distances
    assert distances["depth_m"].wasserstein == pytest.approx(15.0)
    assert distances["depth_m"].total_variation == pytest.approx(1.0)
    assert distances["depth_m"].mean == pytest.approx(67 / 3)
    assert distances["box_height_px"].wasserstein == 0
    half = histograms([_labels([12.0, 27.0])])
    assert Comparison(half, histograms([_labels([12.0, 12.5])])).distances["depth_m"].total_variation == 0.5


def test_a_vehicle_more_in_every_frame_is_a_distance_of_one():
    one, two = histograms([_labels([9.0]), _labels([])]), histograms([_labels([9.0, 19.0]), _labels([9.0])])
    distance = Comparison(one, two).distances["vehicles_per_frame"]
    assert (distance.mean, distance.kitti_mean, distance.wasserstein) == (0.5, 1.5, 1.0)


@pytest.mark.parametrize(("yaw", "other", "apart"), [(3.1, -3.1, 0.0), (2.9, -2.9, 0.5236), (-0.3, 0.3, 0.5236)])
def test_angles_go_round(yaw, other, apart):
    found = Comparison(histograms([_labels([9.0], yaw=yaw)]), histograms([_labels([9.0], yaw=other)]))
    assert found.distances["yaw_rad"].wasserstein == pytest.approx(apart, abs=1e-3)


def test_what_lies_beyond_the_bins_counts_in_the_last_one():
    own = histograms([_labels([300.0], height_px=900.0)])
    assert own.shares["depth_m"][-1] == 1
    assert own.shares["box_height_px"][-1] == 1


def test_only_vehicles_count_and_unknown_poses_only_where_none_is_needed():
    assert histograms([_labels([9.0], kind="Pedestrian")]).vehicles == 0
    known, unknown = _labels([9.0]), _labels([float("nan")])
    own = histograms([known, unknown])
    assert (own.frames, own.vehicles) == (2, 2)
    assert own.means["depth_m"] == pytest.approx(9.0)
    assert own.shares["box_height_px"].sum() == pytest.approx(1.0)


def test_spacing_is_to_the_nearest_of_the_same_frame():
    own = histograms([_labels([10.0, 13.5, 30.5]), _labels([13.0])])
    assert own.means["spacing_m"] == pytest.approx((3.5 + 3.5 + 17.0) / 3)


def test_no_frame_at_all_is_no_error():
    empty = histograms([])
    assert (empty.frames, empty.vehicles) == (0, 0)
    assert all(share.sum() == 0 for share in empty.shares.values())
    assert Comparison(empty, reference()).distances["depth_m"].total_variation is None
    assert "| depth | m | - | 29.24 | - | - |" in Comparison(empty, reference()).table()


def test_kitti_statistics_agree_with_the_layout():
    kitti, fitted = reference(), statistics()
    assert (kitti.frames, kitti.vehicles) == (7481, 32750)
    for name, quantity in QUANTITIES.items():
        assert kitti.shares[name].sum() == pytest.approx(1.0, abs=2e-4), name
        assert len(kitti.shares[name]) == len(quantity.edges) - 1
    # The first and last bins of the comparison also take what lies beyond.
    assert np.abs(kitti.shares["depth_m"] - fitted.depth_share).max() < 0.003
    assert np.abs(kitti.shares["lateral_m"] - fitted.lateral_share).max() < 0.003
    assert np.abs(kitti.shares["vehicles_per_frame"] - fitted.vehicles_per_frame).max() < 1e-5


def test_a_data_set_is_compared_and_frames_without_labels_are_left_out():
    found = compare(_Frames({"a": _labels([9.0]), "b": None, "c": _labels([])}))
    assert (found.own.frames, found.own.vehicles) == (2, 1)
    table = found.table()
    assert table.count("\n|") == 2 + len(QUANTITIES) + 1
    assert "| truncated vehicles | % | 0.0 | 14.1 |" in table
    assert json.loads(json.dumps(found.summary()))["distances"]["depth_m"]["kitti_mean"] == pytest.approx(
        29.24, 0.01
    )


def test_the_plot_shows_both_sides_in_six_panels(tmp_path):
    rng = np.random.default_rng(3)
    own = histograms([_labels(rng.uniform(4, 70, 4).tolist()) for _ in range(30)])
    Comparison(own, reference()).plot(tmp_path / "distributions.png")
    picture = cv2.imread(str(tmp_path / "distributions.png"))
    assert picture.shape[0] > 600
    assert picture.shape[1] > 1000
    height, width = picture.shape[:2]
    line = np.array([0x00, 0x5E, 0xD5])
    for row in range(2):
        for column in range(3):
            part = picture[
                row * height // 2 : (row + 1) * height // 2, column * width // 3 : (column + 1) * width // 3
            ]
            assert (np.abs(part.astype(int) - line).max(axis=2) < 30).sum() > 100
    Comparison(own, reference()).plot(tmp_path / "again.png")
    assert (tmp_path / "again.png").read_bytes() == (tmp_path / "distributions.png").read_bytes()


def test_vehicles_are_what_the_generator_labels():
    assert set(statistics().type_share) == set(VEHICLES)
    assert isinstance(reference(), Histograms)
