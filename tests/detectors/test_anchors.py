"""Anchors by k-means: planted clusters, means and overlaps computed by hand."""

import numpy as np
import pytest
import torch

from detectors.anchors import fit_anchors, mean_best_iou, size_iou, target_sizes
from detectors.types import Targets

CENTRES = ((20.0, 30.0), (60.0, 40.0), (35.0, 120.0), (200.0, 100.0), (400.0, 180.0))


def planted(copies: int = 1) -> np.ndarray:
    """Around each centre, four sizes that lie symmetrically, so that their mean is the centre."""
    corners = np.array([(-2, -1), (2, 1), (-1, 2), (1, -2)], dtype=np.float64)
    return np.concatenate([np.add(centre, corners) for centre in CENTRES] * copies)


def test_overlap_of_sizes_by_hand() -> None:
    found = size_iou(np.array([[10.0, 20.0], [4.0, 4.0]]), np.array([[20.0, 10.0], [10.0, 20.0], [2.0, 2.0]]))
    np.testing.assert_allclose(found, [[100 / 300, 1.0, 4 / 200], [16 / 200, 16 / 200, 4 / 16]])


def test_mean_of_the_best_overlap_by_hand() -> None:
    sizes, anchors = np.array([[10.0, 20.0], [4.0, 4.0]]), np.array([[20.0, 10.0], [2.0, 2.0]])
    assert mean_best_iou(sizes, anchors) == pytest.approx((100 / 300 + 4 / 16) / 2)


@pytest.mark.parametrize("seed", range(5))
def test_planted_clusters_are_found(seed: int) -> None:
    found = fit_anchors(planted(), len(CENTRES), seed)
    by_area = sorted(CENTRES, key=lambda size: size[0] * size[1])
    np.testing.assert_allclose(found.sizes_wh, by_area, rtol=0, atol=1e-9)
    assert found.mean_iou == pytest.approx(mean_best_iou(planted(), np.array(by_area)), abs=1e-12)


def test_one_anchor_is_the_mean() -> None:
    found = fit_anchors(np.array([[10.0, 10.0], [10.0, 20.0]]), 1)
    assert found.sizes_wh == ((10.0, 15.0),)
    assert found.mean_iou == pytest.approx((100 / 150 + 150 / 200) / 2)


def test_as_many_anchors_as_sizes_are_the_sizes() -> None:
    sizes = np.array([[30.0, 10.0], [10.0, 10.0], [10.0, 80.0], [10.0, 10.0]])
    found = fit_anchors(sizes, 3)
    assert found.sizes_wh == ((10.0, 10.0), (30.0, 10.0), (10.0, 80.0))
    assert found.mean_iou == 1.0


def test_small_boxes_count_as_much_as_large_ones() -> None:
    # By Euclidean distance both anchors would go to the large boxes, which lie further apart in pixels.
    sizes = np.array([[10.0, 10.0], [20.0, 20.0]] * 3 + [[300.0, 300.0], [340.0, 340.0]])
    assert fit_anchors(sizes, 3).sizes_wh == ((10.0, 10.0), (20.0, 20.0), (320.0, 320.0))


def test_more_anchors_fit_better_and_a_seed_repeats() -> None:
    sizes = np.exp(np.random.default_rng(3).normal(4, 0.7, (400, 2)))
    fits = [fit_anchors(sizes, count, seed=1) for count in (1, 3, 6, 9)]
    assert [len(fit.sizes_wh) for fit in fits] == [1, 3, 6, 9]
    assert sorted(fit.mean_iou for fit in fits) == [fit.mean_iou for fit in fits]
    assert fit_anchors(sizes, 9, seed=1) == fits[-1]
    areas = [w * h for w, h in fits[-1].sizes_wh]
    assert areas == sorted(areas)
    # Each anchor is the mean of the sizes that are nearest to it: nothing is left to move.
    anchors = np.array(fits[-1].sizes_wh)
    nearest = size_iou(sizes, anchors).argmax(1)
    np.testing.assert_allclose(anchors, [sizes[nearest == k].mean(0) for k in range(9)])


def test_copies_of_a_size_weigh() -> None:
    found = fit_anchors(np.array([[10.0, 10.0]] * 3 + [[10.0, 14.0]]), 1)
    assert found.sizes_wh == ((10.0, 11.0),)


def test_a_cluster_that_loses_all_its_sizes_starts_anew() -> None:
    from detectors import anchors

    # Two first anchors are alike, so that the second of them has no size.
    sizes = np.array([[10.0, 10.0], [10.0, 12.0], [90.0, 90.0]])
    found = anchors._run_k_means(sizes, np.array([[10.0, 10.0], [10.0, 10.0]]))
    assert sorted(map(tuple, found.tolist())) == [(10.0, 11.0), (90.0, 90.0)]


def test_sizes_of_targets() -> None:
    targets = Targets(
        torch.tensor([[0.0, 0, 10, 20], [5, 5, 50, 50], [7, 7, 7, 9], [1, 2, 4, 4]]),
        torch.zeros(4, dtype=torch.int64),
        torch.tensor([False, True, False, False]),
    )
    np.testing.assert_array_equal(target_sizes(targets), [[10.0, 20.0], [3.0, 2.0]])


@pytest.mark.parametrize(
    ("sizes", "count", "message"),
    [
        (np.zeros((0, 2)), 1, r"sizes: expected shape \(N, 2\)"),
        (np.ones((4, 3)), 1, r"sizes: expected shape \(N, 2\)"),
        (np.array([[1.0, 0.0]]), 1, "sizes: expected positive"),
        (np.array([[1.0, np.nan]]), 1, "sizes: expected positive"),
        (np.array([[1.0, 2.0], [1.0, 2.0], [2.0, 2.0]]), 3, "count: expected 1 to 2"),
        (np.array([[1.0, 2.0]]), 0, "count: expected 1 to 1"),
    ],
)
def test_sizes_that_do_not_do(sizes: np.ndarray, count: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit_anchors(sizes, count)
