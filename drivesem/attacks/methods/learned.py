"""A search in rounds, which a model of finished frames guides, and which ends where more passes promise little.

A detector's weakness is a region of what it sees, the same in all frames. So margins of one frame's search predict
those of another frame: trees (extremely randomised, Geurts et al. 2006) are fitted to features of objects as drawn.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.methods.margin_search import (
    FINAL_PASSES,
    MARGIN_CEILING,
    MarginSearch,
    MarginSearchState,
    sample_points,
)

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesRegressor

MIN_ROWS = 200
"""With fewer rows there is no model."""
_MAX_ROWS = 20_000
"""Rows of a fit, chosen at random: it takes a second."""
_LOWEST, _HIGHEST = -4.0, 6.0
"""Range of margins in the fit: how far a car is lost, or how safely it is found, is of no interest."""
_TREES, _TREES_OF_PROPOSAL = 48, 3
"""Trees; and of how many of them a proposal takes the mean. Others of the 48 differ where little is known, so
proposals spread there (Thompson sampling)."""
_POOL = 8
"""Points that are rendered for predictions before each round; proposals combine all so far."""
_START, _ROUND = 16, 8
"""Points of the first round and of each other one. The model proposes half of them; without a model these are drawn
anew. The rest are drawn anew in the first round, and changes of the best point later."""
_CHANGED = 0.3
"""Share of the best point's coordinates that such a change draws anew."""
_LOST, _LOST_SAMPLES = -1.0, 4
"""Mean margin at the best point below which an object is lost, in so many nuisance samples: it needs no more passes."""
_BEYOND_HOPE = 2.0
"""An object with no margin below, seen or predicted, gets no more passes."""


class MarginModel:
    """Predicts an object's margin from its features."""

    def __init__(self, rows: np.ndarray) -> None:
        """Fit.

        Args:
            rows: (R, F + 1), features and margin in logits.
        """
        from sklearn.ensemble import ExtraTreesRegressor  # imported on use: it takes a second, and is an extra

        if len(rows) > _MAX_ROWS:
            rows = rows[np.random.default_rng(0).choice(len(rows), _MAX_ROWS, replace=False)]
        trees = ExtraTreesRegressor(_TREES, min_samples_leaf=2, max_features=0.7, random_state=0)
        self._trees: ExtraTreesRegressor = trees.fit(rows[:, :-1], rows[:, -1].clip(_LOWEST, _HIGHEST))

    def predict(self, features: Tensor) -> Tensor:
        """Predict with each tree.

        Args:
            features: (K, F).

        Returns:
            (T, K) margins.
        """
        inputs = features.float().numpy()
        return torch.from_numpy(np.stack([tree.predict(inputs) for tree in self._trees.estimators_]))


@dataclass
class _Rounds:
    """Points so far, and the best combination of them."""

    search: MarginSearchState
    """The search."""
    points: list[Tensor] = field(default_factory=list[Tensor])
    """Evaluated points u (K,)."""
    margins: list[Tensor] = field(default_factory=list[Tensor])
    """Their margins (N,)."""
    finalists: list[Tensor] = field(default_factory=list[Tensor])
    """The best point, and the last ones that it was compared with."""
    _at_best: list[Tensor] = field(default_factory=list[Tensor])
    """Margins (N,) of the best point, a nuisance sample each."""

    @property
    def best(self) -> Tensor:
        """The best point u (K,)."""
        return self.finalists[0]

    def add(self, points: Tensor, random: Collection[int]) -> None:
        """Evaluate points (C, K) in a nuisance sample each, and compare the best point with new combinations."""
        search = self.search
        self._record(list(points), [search.next_sample() for _ in points], random)
        values = [search.objective(row) for row in self.margins]
        order = sorted(range(len(values)), key=values.__getitem__)
        known, margins = torch.stack(self.points), torch.stack(self.margins)
        contenders = self.finalists[:1]
        for row in order[:2]:
            combined = search.combine_objects(known, margins, row)
            if not any(torch.equal(combined, point) for point in contenders):
                contenders.append(combined)
        compared = self._record(contenders, [search.next_sample()] * len(contenders))
        values = [search.objective(row) for row in compared]
        order = sorted(range(len(values)), key=values.__getitem__)
        if not self.finalists or order[0]:
            self._at_best = []
        self._at_best.append(compared[order[0]])
        self.finalists = [contenders[place] for place in order]

    def _record(self, points: list[Tensor], numbers: list[int], random: Collection[int] = ()) -> list[Tensor]:
        margins = list(self.search.margins(points, numbers, random))
        self.points += points
        self.margins += margins
        return margins

    def undecided(self, proposer: _Proposer | None) -> bool:
        """Whether an object that counts is neither lost nor, by the model, beyond hope. What seems to be lost is
        evaluated in more nuisance samples.
        """
        remaining = self._count_remaining(proposer)
        more = _LOST_SAMPLES - len(self._at_best)
        if not remaining and more > 0:
            self._at_best += self._record([self.best] * more, [self.search.next_sample() for _ in range(more)])
            remaining = self._count_remaining(proposer)
        return remaining > 0

    def _count_remaining(self, proposer: _Proposer | None) -> int:
        remaining = self.search.oracle.counted_objects.clone()
        # The first sample chose the best point, so its margins are too low.
        at_best = torch.stack(self._at_best[1:] or self._at_best)
        remaining &= at_best.mean(0).to(remaining.device) > _LOST
        if proposer is not None:
            lowest = torch.minimum(torch.stack(self.margins).amin(0), proposer.lowest.to(self.margins[0]))
            remaining &= lowest.to(remaining.device) < _BEYOND_HOPE
        return int(remaining.sum())

    def change_best(self, count: int) -> Tensor:
        """Points (count, K): the best one with some coordinates drawn anew, half of them at an end of the bounds."""
        generator, size = self.search.generator, (count, len(self.best))
        drawn = torch.rand(size, generator=generator)
        drawn = torch.where(torch.rand(size, generator=generator) < 0.5, drawn.round(), drawn).to(self.best)
        return torch.where((torch.rand(size, generator=generator) < _CHANGED).to(drawn.device), drawn, self.best)


@dataclass(frozen=True, slots=True)
class Learn(MarginSearch):
    """Rounds of points, of which a model of finished frames proposes a part. It ends early once each object is lost,
    or has no chance by the model, so that other frames can have the passes.
    """

    model: MarginModel | None = None
    """The model."""

    def _search(self, search: MarginSearchState) -> Tensor:
        rounds, proposer = _Rounds(search), None if self.model is None else _Proposer(self.model, search)
        start = min(_START, search.passes_left - FINAL_PASSES - 2)  # with fewer passes no other round follows
        learned = 0 if proposer is None else start // 2
        first = sample_points(search, start - learned)
        points = first if proposer is None else torch.cat([first, proposer.propose(learned)])
        rounds.add(points, range(1, len(first), 2))
        while search.passes_left >= _ROUND + _LOST_SAMPLES + 2 + FINAL_PASSES and rounds.undecided(proposer):
            learned = _ROUND // 2
            guided = sample_points(search, learned) if proposer is None else proposer.propose(learned)
            rounds.add(torch.cat([rounds.change_best(_ROUND - learned), guided]), ())
        return search.select_best(rounds.finalists)


class _Proposer:
    """Points of which the model expects failures."""

    def __init__(self, model: MarginModel, search: MarginSearchState) -> None:
        self._model, self._search = model, search
        self._points: list[Tensor] = []
        self._predicted: list[Tensor] = []

    @property
    def lowest(self) -> Tensor:
        """(N,), the lowest margin of each object by any few trees."""
        groups = torch.stack(self._predicted, 1).unflatten(0, (-1, _TREES_OF_PROPOSAL))
        return groups.mean(1).amin((0, 1))

    def propose(self, count: int) -> Tensor:
        """Render more points, and combine `count` points (count, K) of all that were rendered."""
        self._render()
        points, predicted = torch.stack(self._points), torch.stack(self._predicted, 1)
        return torch.stack([self._search.combine_objects(points, *self._choose(predicted)) for _ in range(count)])

    def _render(self) -> None:
        """Add points, and the margins (T, N) that each tree predicts at each of them."""
        search, new = self._search, list(sample_points(self._search, _POOL))
        described = [search.oracle.describe(search.theta(point)[0], search.next_sample()) for point in new]
        counts = [len(rows) for rows, _ in described]
        by_point = self._model.predict(torch.cat([features for _, features in described])).split(counts, 1)
        for point, (rows, _), margins in zip(new, described, by_point, strict=True):
            predicted = torch.full((len(margins), len(search.oracle.counted_objects)), MARGIN_CEILING)
            predicted[:, rows.cpu()] = margins.to(predicted)
            self._points.append(point)
            self._predicted.append(predicted.to(point))

    def _choose(self, predicted: Tensor) -> tuple[Tensor, int]:
        """Margins (C, N) by a few of the trees (T, C, N), and the point with the lowest objective by them."""
        few = torch.randperm(len(predicted), generator=self._search.generator)[:_TREES_OF_PROPOSAL]
        margins = predicted[few.to(predicted.device)].mean(0)
        values = [self._search.objective(row) for row in margins]
        return margins, min(range(len(values)), key=values.__getitem__)
