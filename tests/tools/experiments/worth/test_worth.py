"""Information worth: cases worked out by hand, bounds, and detection's points."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import t

from detectors.types import CLASSES, Detections, Targets
from scene_ir.errors import RangeError, ShapeError
from tools.experiments.worth.measures import (
    ANSWERS,
    MembershipPoints,
    WorthSettings,
    information_gain,
    information_worth,
    jackknife,
    join_points,
    one_hot,
    points_from_detections,
    points_from_probabilities,
    worth_interval,
)

CAR, NOTHING = CLASSES.index("Car"), len(CLASSES)


def entropy(*shares: float) -> float:
    return -sum(p * math.log(p) for p in shares if p)


def test_binary_by_hand() -> None:
    """Six points: answer 0 for labels 0, 0, 1; answer 1 for 1, 1, 1."""
    answers, label = np.array([0, 0, 0, 1, 1, 1]), np.array([0, 0, 1, 1, 1, 1])
    found = information_worth(one_hot(answers, 2), label)
    assert found.value == pytest.approx(0.5 * entropy(2 / 3, 1 / 3))
    np.testing.assert_allclose(found.shares, [0.5, 0.5])
    np.testing.assert_allclose(found.entropies, [entropy(2 / 3, 1 / 3), 0])
    assert information_worth(one_hot(answers, 2), label, base=2).value == pytest.approx(found.value / math.log(2))


def test_fractional_by_hand() -> None:
    """Two points, labels 0 and 1. Subset 0: 0.9 of one and 0.4 of the other."""
    mu = np.array([[0.9, 0.1], [0.4, 0.6]])
    expected = 1.3 / 2 * entropy(0.9 / 1.3, 0.4 / 1.3) + 0.7 / 2 * entropy(0.1 / 0.7, 0.6 / 0.7)
    assert information_worth(mu, np.array([0, 1])).value == pytest.approx(expected)
    # realism 0.5 of the second
    expected = 1.1 / 1.5 * entropy(0.9 / 1.1, 0.2 / 1.1) + 0.4 / 1.5 * entropy(0.1 / 0.4, 0.3 / 0.4)
    weighted = information_worth(mu, np.array([0, 1]), np.array([1.0, 0.5]))
    assert weighted.value == pytest.approx(expected)


def test_a_wrong_but_tidy_classifier_is_worth_nothing() -> None:
    """The appendix: accuracy gives a low worth, the converse is not so."""
    label = np.array([0, 1, 2, 0, 1, 2])
    assert information_worth(one_hot((label + 1) % 3, 3), label).value == 0
    assert information_worth(one_hot(label, 3), label).value == 0


memberships = st.integers(1, 12).flatmap(
    lambda count: st.tuples(
        st.lists(st.lists(st.floats(0.001, 1), min_size=3, max_size=3), min_size=count, max_size=count),
        st.lists(st.integers(0, 2), min_size=count, max_size=count),
        st.lists(st.floats(0.01, 1), min_size=count, max_size=count),
    )
)


@given(memberships)
def test_bounds_and_what_makes_no_difference(drawn: tuple[list[list[float]], list[int], list[float]]) -> None:
    rows, labels, rho = (np.array(part) for part in drawn)
    mu = rows / rows.sum(axis=1, keepdims=True)
    found = information_worth(mu, labels, rho)
    weights = np.bincount(labels, weights=rho, minlength=3) / rho.sum()
    # never more than what is unknown before any answer
    assert -1e-12 <= found.value <= entropy(*weights) + 1e-9 <= math.log(3) + 2e-9
    assert found.shares.sum() == pytest.approx(1)
    order = np.random.default_rng(0).permutation(len(labels))
    assert information_worth(mu[order], labels[order], rho[order]).value == pytest.approx(found.value, abs=1e-9)
    assert information_worth(mu[:, ::-1], labels, rho * 0.5).value == pytest.approx(found.value, abs=1e-9)
    twice = information_worth(np.tile(mu, (2, 1)), np.tile(labels, 2), np.tile(rho, 2))
    assert twice.value == pytest.approx(found.value, abs=1e-9)


def test_bad_input() -> None:
    mu, label = np.full((2, 2), 0.5), np.array([0, 1])
    for base in (1.0, 0.5, math.nan):
        with pytest.raises(RangeError, match="base"):
            information_worth(mu, label, base=base)
    with pytest.raises(ShapeError):
        information_worth(mu, label[:1])
    with pytest.raises(RangeError, match="memberships"):
        information_worth(mu - 0.6, label)
    with pytest.raises(RangeError, match="weights: expected finite"):
        information_worth(mu, label, np.array([1, math.nan]))
    with pytest.raises(RangeError, match="a point that counts"):
        information_worth(mu, label, np.zeros(2))


def test_gain() -> None:
    label = np.array([0, 0, 1, 1])
    worse = points_from_probabilities(np.array([[0.9, 0.1], [0.2, 0.8], [0.3, 0.7], [0.6, 0.4]]), label)
    right = points_from_probabilities(one_hot(label, 2), label)
    for kind in ("binary", "fractional"):
        setting = WorthSettings(kind, weighted=False)
        same = information_gain(worse, worse, setting)
        assert (same.value, same.low, same.high) == (0, 0, 0)
        gain, worth = information_gain(worse, right, setting), worth_interval(worse, setting)
        assert gain.value == pytest.approx(worth.value)
        assert worth.value is not None
        assert worth.value > 0
        back = information_gain(right, worse, setting)
        assert back.value == pytest.approx(-worth.value)
    one = points_from_probabilities(np.array([[0.9, 0.1]]), label[:1])
    assert worth_interval(one, WorthSettings("binary", weighted=False)).low is None
    with pytest.raises(ShapeError, match="the same 4 labels"):
        information_gain(
            worse,
            points_from_probabilities(one_hot(label, 2), label[::-1].copy()),
            WorthSettings("binary", weighted=False),
        )


def test_intervals_hold_what_all_pictures_are_worth() -> None:
    """Of few pictures less is unknown than of all; of the bootstrap's intervals few would hold that."""
    classes, units, views, rng = 6, 36, 3, np.random.default_rng(0)
    answers = 0.6 * np.eye(classes) + 0.4 * rng.dirichlet(np.full(classes, 0.5), classes)
    setting = WorthSettings("binary", weighted=False)
    true = information_worth(answers, np.arange(classes)).value
    label, unit = np.repeat(np.arange(units) % classes, views), np.repeat(np.arange(units), views)
    held, below, drawn = 0, 0, 0
    for _ in range(100):
        answer = np.array([rng.choice(classes, p=answers[one]) for one in label])
        given_frames = points_from_probabilities(one_hot(answer, classes), label)
        found = worth_interval(replace(given_frames, unit=unit), setting)
        assert found.value is not None
        assert found.low is not None
        assert found.high is not None
        held += found.low <= true <= found.high
        resampled = [
            information_worth(
                given_frames.binary,
                label,
                np.bincount(rng.integers(0, units, units), minlength=units)[unit].astype(np.float64),
            ).value
            for _ in range(60)
        ]
        low, high = np.quantile(resampled, [0.025, 0.975])
        drawn += low <= true <= high
        below += found.value < true
    assert below >= 80
    assert drawn < held - 30
    assert held >= 85


def test_the_jackknife_of_a_mean_is_students_interval() -> None:
    values = np.array([3.0, 1, 4, 1, 5, 9])
    without = [float(np.delete(values, i).mean()) for i in range(6)]
    found = jackknife("mean", float(values.mean()), without)
    expected = t.interval(0.95, 5, values.mean(), values.std(ddof=1) / np.sqrt(6))
    assert (found.value, found.low, found.high) == pytest.approx((values.mean(), *expected))


def test_the_jackknife_takes_off_what_goes_with_one_over_the_number() -> None:
    """The variance over n has a bias of just that kind: without it is that over n - 1."""
    values = np.array([3.0, 1, 4, 1, 5, 9])
    without = [float(np.delete(values, i).var()) for i in range(6)]
    found = jackknife("variance", float(values.var()), without)
    assert found.value == pytest.approx(values.var())
    assert found.low is not None
    assert found.high is not None
    assert (found.low + found.high) / 2 == pytest.approx(values.var(ddof=1))


def test_the_jackknife_needs_two_units_that_count() -> None:
    for value, without in ((1.0, []), (1.0, [None]), (1.0, [1.0, None]), (None, [1.0, 1.0])):
        found = jackknife("a", value, without)
        assert (found.value, found.low, found.high) == (value, None, None)


CARS = [[0.0, 0, 40, 40], [100.0, 0, 140, 40], [200.0, 0, 240, 40]]


def targets(ignore: tuple[bool, ...] = (False, False, False)) -> Targets:
    return Targets(torch.tensor(CARS), torch.full((3,), CAR), torch.tensor(ignore))


def found(*rows: tuple[float, str, float]) -> Detections:
    """Rows: x of a box of 40 px, class, score."""
    return Detections(
        torch.tensor([[x, 0.0, x + 40, 40.0] for x, _, _ in rows]).reshape(-1, 4),
        torch.tensor([CLASSES.index(kind) for _, kind, _ in rows], dtype=torch.int64),
        torch.tensor([score for *_, score in rows]),
    )


def test_points_of_detection() -> None:
    other = next(name for name in CLASSES if name != "Car")
    seen = found((2, "Car", 0.9), (0, other, 0.2), (101, "Car", 0.3), (60, "Car", 0.75), (300, other, 0.6))
    points = points_from_detections(targets(), seen, t_star=0.5)
    assert points.label.tolist() == [CAR] * 3 + [NOTHING] * 3
    np.testing.assert_allclose(points.fractional.sum(axis=1), 1)
    first = dict(zip(ANSWERS, points.fractional[0], strict=True))
    # more than 1 together: scaled
    assert (first["Car"], first[other], first["nothing"]) == pytest.approx((0.9 / 1.1, 0.2 / 1.1, 0))
    second = dict(zip(ANSWERS, points.fractional[1], strict=True))
    assert (second["Car"], second["nothing"]) == pytest.approx((0.3, 0.7))
    assert points.fractional[2, NOTHING] == 1
    # false detections, best first
    assert points.fractional[3, CAR] == pytest.approx(0.75)
    assert points.fractional[4, CLASSES.index(other)] == pytest.approx(0.6)
    assert points.fractional[5, NOTHING] == 1
    assert points.binary.argmax(axis=1).tolist() == [
        *(CAR, NOTHING, NOTHING),
        *(CAR, CLASSES.index(other), NOTHING),
    ]


def test_what_detection_is_worth() -> None:
    perfect = points_from_detections(targets(), found(*((x, "Car", 1.0) for x in (0, 100, 200))), 0.5)
    blind = points_from_detections(targets(), found(), 0.5)
    half = points_from_detections(targets(), found((0, "Car", 1.0)), 0.5)
    for kind in ("binary", "fractional"):
        setting = WorthSettings(kind, weighted=True)
        assert worth_interval(perfect, setting).value == 0
        assert worth_interval(blind, setting).value == pytest.approx(math.log(2))
        # one subset of 1 car, one of 2 cars and 3 empty places
        assert worth_interval(half, setting).value == pytest.approx(5 / 6 * entropy(2 / 5, 3 / 5))
        assert information_gain(blind, perfect, setting).value == pytest.approx(math.log(2))


def test_ignored_objects_are_no_points_and_excuse_detections() -> None:
    points = points_from_detections(targets((False, True, False)), found((100, "Car", 0.9), (0, "Car", 0.8)), 0.5)
    assert points.label.tolist() == [CAR, CAR, NOTHING, NOTHING]
    np.testing.assert_allclose(points.fractional[:, CAR], [0.8, 0, 0, 0])


def test_frames_without_objects_and_realism_of_empty_places() -> None:
    none = points_from_detections(
        Targets(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.bool)),
        found(),
        0.5,
    )
    assert len(none.label) == 0
    three = points_from_detections(targets(), found(), 0.5, np.array([1.0, 0.5, 0.0]))
    np.testing.assert_allclose(three.realism, [1, 0.5, 0, 0.5, 0.5, 0.5])
    both = join_points([none, three])
    assert both.unit.tolist() == [1] * 6
    assert isinstance(both, MembershipPoints)
    assert worth_interval(join_points([none]), WorthSettings("binary", weighted=False)).value is None
