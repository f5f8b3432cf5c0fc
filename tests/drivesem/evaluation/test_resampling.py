"""Bootstrap and paired test: what they must give where the answer is known."""

import numpy as np
import pytest
from scipy.stats import binomtest

from drivesem.evaluation.curves import ClassMatches
from drivesem.evaluation.kitti import evaluate
from drivesem.evaluation.resampling import (
    ClusteredShare,
    NamedMetric,
    Proportion,
    WeightedAveragePrecision,
    WeightedKittiPrecision,
    WeightedRecall,
    bootstrap_intervals,
    holm,
    newcombe,
    paired_differences,
    wilson,
)

KINDS = ("Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Truck")


def _tally(found: np.ndarray, frames: int, per_frame: int = 5) -> ClassMatches:
    """Objects of which found[i] of `per_frame` are found in frame i, at falling scores, with no misfire."""
    frame = np.repeat(np.arange(frames), found)
    return ClassMatches(
        score=np.linspace(1, 0, len(frame)),
        frame=frame,
        true_positives=np.ones(len(frame)),
        false_positives=np.zeros(len(frame)),
        objects=np.full(frames, float(per_frame)),
    )


def _figure(found: np.ndarray) -> NamedMetric:
    return NamedMetric("AP", (WeightedAveragePrecision(_tally(found, len(found)), "voc"),))


def test_an_interval_is_that_of_the_mean_where_ap_is_recall():
    draw = np.random.default_rng(0)
    found = draw.binomial(5, 0.6, 200)
    (one,) = bootstrap_intervals([_figure(found)], 200, 400, draw)
    mean, error = found.mean() / 5, found.std() / 5 / np.sqrt(200)
    assert one.value == pytest.approx(mean)
    assert one.low == pytest.approx(mean - 1.96 * error, abs=0.3 * error)
    assert one.high == pytest.approx(mean + 1.96 * error, abs=0.3 * error)


def test_the_same_seed_gives_the_same_interval():
    figure = _figure(np.random.default_rng(1).binomial(5, 0.5, 30))
    first = bootstrap_intervals([figure], 30, 50, np.random.default_rng(3))
    assert first == bootstrap_intervals([figure], 30, 50, np.random.default_rng(3))
    assert first != bootstrap_intervals([figure], 30, 50, np.random.default_rng(4))


def test_equal_detectors_do_not_differ_and_unequal_ones_do():
    draw = np.random.default_rng(2)
    worse = draw.binomial(5, 0.5, 60)
    better = np.minimum(worse + draw.integers(0, 2, 60), 5)
    (same,) = paired_differences([_figure(worse)], [_figure(worse)], 60, 100, draw)
    assert (same.difference, same.low, same.high, same.p) == (0, 0, 0, 1)
    (other,) = paired_differences([_figure(worse)], [_figure(better)], 60, 300, draw)
    assert other.difference == pytest.approx((better.mean() - worse.mean()) / 5)
    assert other.low is not None
    assert other.low > 0
    assert other.p is not None
    assert other.p == pytest.approx(1 / 301)


def test_p_is_uniform_where_nothing_differs():
    draw = np.random.default_rng(5)
    values = []
    for _ in range(60):
        a, b = draw.binomial(5, 0.5, 40), draw.binomial(5, 0.5, 40)
        (one,) = paired_differences([_figure(a)], [_figure(b)], 40, 40, draw)
        assert one.p is not None
        values.append(one.p)
    assert 0.35 < np.mean(values) < 0.65
    assert np.mean(np.array(values) < 0.1) < 0.25


def test_kitti_curves_side_by_side_weigh_as_each_alone(make_truths, make_found, draw_rows):
    truth, found = draw_rows(7, 8, True)
    other = draw_rows(7, 8, True)[1][::2]
    first = evaluate(make_truths(truth, 8), make_found(found), KINDS)
    second = evaluate(make_truths(truth, 8), make_found(other), KINDS)
    ones, none = np.ones(8), np.zeros(8)
    for a, b in zip(first, second, strict=True):
        both = NamedMetric("R40", (WeightedKittiPrecision(a),)).concatenate(
            NamedMetric("R40", (WeightedKittiPrecision(b),))
        )
        assert both.value(np.concatenate([ones, none])) == a.r40()
        assert both.value(np.concatenate([none, ones])) == b.r40()


def test_recall_weighs_frames_and_counts_on():
    first, second = WeightedRecall(_tally(np.array([5, 0, 2]), 3)), WeightedRecall(_tally(np.array([1, 1, 1]), 3))
    assert first.value(None) == pytest.approx(7 / 15)
    assert first.value(np.array([2.0, 0.0, 1.0])) == pytest.approx(12 / 15)
    assert first.value(np.zeros(3)) is None
    both = first.concatenate(second)
    assert both.value(np.array([0, 0, 0, 1.0, 1.0, 1.0])) == pytest.approx(3 / 15)
    assert WeightedRecall(_tally(np.zeros(2, int), 2)).value(None) == 0


def test_metrics_without_objects():
    empty = NamedMetric("AP", (WeightedAveragePrecision(_tally(np.zeros(3, int), 3, per_frame=0), "coco"),))
    (one,) = bootstrap_intervals([empty], 3, 10, np.random.default_rng(0))
    assert (one.value, one.low, one.high) == (None, None, None)
    (pair,) = paired_differences([empty], [empty], 3, 10, np.random.default_rng(0))
    assert pair.p is None


@pytest.mark.parametrize(("hits", "count", "low", "high"), [(5, 10, 0.2366, 0.7634), (0, 30, 0.0, 0.1135)])
def test_wilson_by_hand(hits: int, count: int, low: float, high: float) -> None:
    assert wilson(hits, count) == (pytest.approx(low, abs=5e-5), pytest.approx(high, abs=5e-5))


@pytest.mark.parametrize(("hits", "count"), [(0, 1), (1, 1), (3, 7), (29, 30), (400, 1000)])
def test_wilson_is_scipys(hits: int, count: int) -> None:
    expected = binomtest(hits, count).proportion_ci(method="wilson")
    assert wilson(hits, count) == pytest.approx((expected.low, expected.high), abs=1e-6)


@pytest.mark.parametrize(("hits", "count"), [(0, 0), (-1, 3), (4, 3)])
def test_wilson_of_what_is_no_share(hits: int, count: int) -> None:
    with pytest.raises(ValueError, match="share"):
        wilson(hits, count)


@pytest.mark.parametrize(
    ("first", "second", "low", "high"),
    [
        ((48, 80), (56, 70), 0.0524, 0.3339),
        ((3, 10), (9, 10), 0.1705, 0.8090),
        ((2, 7), (6, 7), 0.0582, 0.8062),
        ((0, 20), (10, 10), 0.6791, 1.0),
        ((0, 29), (5, 56), -0.0381, 0.1926),
    ],
)
def test_newcombes_own_examples(first: tuple[int, int], second: tuple[int, int], low: float, high: float) -> None:
    """Newcombe (1998), table II, method 10."""
    assert newcombe(first, second) == (pytest.approx(low, abs=5e-5), pytest.approx(high, abs=5e-5))
    assert newcombe(second, first) == (pytest.approx(-high, abs=5e-5), pytest.approx(-low, abs=5e-5))


def test_holm_steps_down_keeps_the_order_and_leaves_out_what_was_not_tested() -> None:
    """By hand: 0.01 * 4, then 0.02 * 3, then no less than that."""
    assert holm([0.03, 0.01, None, 0.02, 0.9]) == pytest.approx([0.06, 0.04, None, 0.06, 0.9], nan_ok=True)
    assert holm([0.6, 0.5]) == [1.0, 1.0]
    assert holm([]) == []


def test_a_difference_without_its_test_is_the_same() -> None:
    rng = np.random.default_rng(0)
    sides = [[NamedMetric("r", (WeightedRecall(_tally(rng.integers(0, 6, 12), 12)),))] for _ in range(2)]
    (with_p,), (without,) = (
        paired_differences(*sides, 12, 30, np.random.default_rng(1), test=test) for test in (True, False)
    )
    assert without.interval == with_p.interval
    assert (without.p, with_p.p is None) == (None, False)


@pytest.mark.parametrize(
    ("count", "of", "text"),
    [(3, 8, "3 of 8 cars (38 % [14, 69])"), (0, 13, "0 of 13 cars (0 % [0, 23])"), (0, 0, "0 of 0 cars")],
)
def test_a_proportion_has_its_interval(count: int, of: int, text: str) -> None:
    assert Proportion.from_counts(count, of).format("cars") == text


@pytest.mark.parametrize("rate", [0.05, 0.2])
def test_a_clustered_share_s_interval_holds_the_rate_as_often_as_documented(rate: float) -> None:
    rng, held = np.random.default_rng(0), 0
    for _ in range(400):
        chances, draws = rng.beta(4 * rate, 4 * (1 - rate), 60), 16 * rng.integers(1, 6, 60)
        failing = rng.binomial(draws, chances)
        share = ClusteredShare.from_frames(list(zip(failing.tolist(), draws.tolist(), strict=True)))
        assert share is not None
        assert share.low < share.value < share.high
        held += share.low <= rate <= share.high
    assert 0.91 <= held / 400 <= 0.98


def test_clustered_shares_at_the_ends() -> None:
    none = ClusteredShare.from_frames([(0, 16)] * 30 + [(0, 0)])
    assert none is not None
    assert (none.failing, none.draws, none.frames, none.value, none.low) == (0, 480, 30, 0, 0)
    assert none.high == pytest.approx(1 - 0.025 ** (1 / 30))  # no frame of 30
    all_fail = ClusteredShare.from_frames([(16, 16)] * 30)
    assert all_fail is not None
    assert (all_fail.high, all_fail.low) == (1, pytest.approx(0.025 ** (1 / 30)))
    assert ClusteredShare.from_frames([(3, 16), (0, 0)]) is None


def test_frames_that_fail_together_make_a_clustered_share_less_certain() -> None:
    alike, together = (ClusteredShare.from_frames(c) for c in ([(4, 16)] * 20, [(16, 16)] * 5 + [(0, 16)] * 15))
    assert alike is not None
    assert together is not None
    assert alike.value == together.value == 0.25
    assert together.high - together.low > 3 * (alike.high - alike.low)
