"""A search that starts where a model of finished frames predicts failures, and ends where more passes promise little.

A detector's weakness is a region of what it sees, the same in all frames. So margins of one frame's search predict
those of another frame: trees (extremely randomised, Geurts et al. 2006) are fitted to features of objects as drawn.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.methods.margin_search import (
    FINAL_PASSES,
    MARGIN_CEILING,
    START_SHARE,
    Climb,
    Descent,
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
_POOL = 24
"""Points that are rendered for predictions; proposals combine them."""
_FIRST = 16
"""Points after which a search may end; the model proposes half of all points at the start."""
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


@dataclass(frozen=True, slots=True)
class Learn(Climb):
    """`Climb` from a start that a model of finished frames proposes in part. It ends early where each object is lost
    at the start, or has no chance by the model.
    """

    model: MarginModel | None = None
    """The model."""

    def _search(self, search: MarginSearchState) -> Tensor:
        most = search.passes_left - FINAL_PASSES - 2 * _LOST_SAMPLES
        total = max(min(int(START_SHARE * self.passes), most), 1)
        points: list[Tensor] = []
        margins: list[Tensor] = []
        for end in sorted({min(_FIRST, total), total}):
            new, random, predicted = self._draw_points(search, end - len(points))
            # Whether there is a second part depends on scores, so it has no states that do not.
            random = () if points else random
            margins += search.margins(new, [search.next_sample() for _ in new], random)
            points += new
            values = [search.objective(row) for row in margins]
            scene_row = min(range(end), key=values.__getitem__)
            best = search.combine_objects(torch.stack(points), torch.stack(margins), scene_row)
            at_best = search.margins([best] * _LOST_SAMPLES, [search.next_sample() for _ in range(_LOST_SAMPLES)])
            remaining = search.oracle.counted_objects.to(at_best.device) & (at_best.mean(0) > _LOST)
            if predicted is not None:
                lowest = torch.stack([*margins, *at_best, predicted.to(at_best)]).amin(0)
                remaining &= lowest < _BEYOND_HOPE
            if not bool(remaining.any()):
                return best
        return Descent(search, self._uses_gradient(search)).descend(best)

    def _draw_points(
        self, search: MarginSearchState, count: int
    ) -> tuple[list[Tensor], Collection[int], Tensor | None]:
        """Points u (K,), the places of those that are uniform in the box, and the lowest margin (N,) of each object
        that any few trees predict.
        """
        if self.model is None:
            return list(sample_points(search, count)), range(1, count, 2), None
        own, pool = sample_points(search, count - count // 2), sample_points(search, _POOL)
        predicted = _predict(self.model, search, pool)
        proposals = [search.combine_objects(pool, *_choose(search, predicted)) for _ in range(count // 2)]
        lowest = predicted.unflatten(0, (-1, _TREES_OF_PROPOSAL)).mean(1).amin((0, 1))
        return [*own, *proposals], range(1, len(own), 2), lowest


def _predict(model: MarginModel, search: MarginSearchState, pool: Tensor) -> Tensor:
    """Margins (T, C, N) of the points (C, K) by each tree."""
    described = [search.oracle.describe(search.theta(point)[0], search.next_sample()) for point in pool]
    counts = [len(rows) for rows, _ in described]
    by_point = model.predict(torch.cat([features for _, features in described])).split(counts, 1)
    predicted = torch.full((len(by_point[0]), len(pool), len(search.oracle.counted_objects)), MARGIN_CEILING)
    for place, ((rows, _), margins) in enumerate(zip(described, by_point, strict=True)):
        predicted[:, place, rows.cpu()] = margins.to(predicted)
    return predicted.to(pool)


def _choose(search: MarginSearchState, predicted: Tensor) -> tuple[Tensor, int]:
    """Margins (C, N) by a few of the trees (T, C, N), and the point with the lowest objective by them."""
    few = torch.randperm(len(predicted), generator=search.generator)[:_TREES_OF_PROPOSAL]
    margins = predicted[few.to(predicted.device)].mean(0)
    values = [search.objective(row) for row in margins]
    return margins, min(range(len(values)), key=values.__getitem__)
