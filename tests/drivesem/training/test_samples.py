"""Benign frames and counterexamples in one training set."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from detectors.training import Sample
from detectors.types import Targets
from drivesem.training.frames import Mix, MixtureShares, TrainingMixture

NOTHING = Targets(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.bool))


def frames(first: int, count: int) -> list[Sample]:
    return [(np.full((2, 2, 3), first + i, np.uint8), NOTHING) for i in range(count)]


def numbers(mixture: TrainingMixture) -> list[int]:
    return [int(mixture[i][0][0, 0, 0]) for i in range(len(mixture))]


@pytest.mark.parametrize(("mix", "benign", "total"), [("replace", 30, 40), ("add", 40, 53)])
def test_shares(mix: Mix, benign: int, total: int) -> None:
    mixture = TrainingMixture(frames(0, 40), frames(100, 4), MixtureShares(0.25, mix, 0, 7))
    visible = numbers(mixture)
    assert len(visible) == total
    assert len({n for n in visible if n < 100}) == sum(n < 100 for n in visible) == benign
    counts = [visible.count(n) for n in range(100, 104)]
    assert sum(counts) == total - benign
    assert max(counts) - min(counts) <= 1
    assert numbers(TrainingMixture(frames(0, 40), frames(100, 4), MixtureShares(0.25, mix, 0, 7))) == visible
    other = TrainingMixture(frames(0, 40), frames(100, 4), MixtureShares(0.25, mix, 0, 8))
    assert numbers(other) != visible


def test_counterexamples_come_in_little_by_little() -> None:
    mixture = TrainingMixture(frames(0, 4), frames(100, 4), MixtureShares(0.5, "add", 1000, 0))
    last = len(mixture) - 1

    def share(step: int) -> float:
        drawn = [mixture.draw(last, step, np.random.default_rng(i))[0][0, 0, 0] >= 100 for i in range(400)]
        return float(np.mean(drawn))

    assert share(0) == 0
    assert share(300) == pytest.approx(0.3, abs=0.08)
    assert share(1000) == 1
    assert mixture.draw(0, 0, np.random.default_rng(0))[0][0, 0, 0] < 100


class Anew(list[Sample]):
    """Frames that look otherwise in each step."""

    def draw(self, index: int, step: int, generator: np.random.Generator) -> Sample:
        return np.full((2, 2, 3), 200 + 10 * index + step, np.uint8), NOTHING


def test_counterexamples_may_be_drawn_anew() -> None:
    mixture = TrainingMixture(frames(0, 2), Anew(frames(100, 2)), MixtureShares(0.5, "add", 0, 0))
    drawn = [[int(mixture.draw(i, s, np.random.default_rng(0))[0][0, 0, 0]) for i in range(4)] for s in (1, 2)]
    assert [sorted(one) for one in drawn] == [[0, 1, 201, 211], [0, 1, 202, 212]]


@pytest.mark.parametrize(("benign", "counterexamples"), [(0, 1), (1, 0)])
def test_either_without_frames_is_refused(benign: int, counterexamples: int) -> None:
    with pytest.raises(ValueError, match="expected at least one frame, found 0"):
        TrainingMixture(frames(0, benign), frames(100, counterexamples), MixtureShares(0.25, "replace", 0, 0))
