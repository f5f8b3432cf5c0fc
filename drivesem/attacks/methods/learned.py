"""A search that begins where a model of finished frames predicts failures.

A detector's weakness is a region of what it sees, the same in all frames. So margins of one frame's search predict
those of another frame: trees (extremely randomised, Geurts et al. 2006) are fitted to features of objects as drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.methods.margin_search import MARGIN_CEILING, Climb, MarginSearchState, sample_points

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
_POOL = 32
"""Rendered points of which proposals are combined."""
_LEARNED_SHARE = 0.5
"""Share of the points of a start that the model proposes; a wrong model costs no more."""


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
    """`Climb` that starts from what a model of finished frames predicts; without a model it is `Climb`."""

    model: MarginModel | None = None
    """The model."""

    def _start_points(self, search: MarginSearchState, count: int) -> tuple[Tensor, range]:
        learned = int(_LEARNED_SHARE * count)
        if self.model is None or not learned:
            return Climb._start_points(self, search, count)
        pool = sample_points(search, _POOL)
        predicted = self._predict(self.model, search, pool)
        proposals = [search.combine_objects(pool, *self._choose(search, predicted)) for _ in range(learned)]
        points = torch.cat([torch.stack(proposals), sample_points(search, count - learned)])
        return points, range(learned + 1, count, 2)

    def _predict(self, model: MarginModel, search: MarginSearchState, pool: Tensor) -> Tensor:
        """Margins (T, C, N) of the points (C, K) by each tree."""
        described = [search.oracle.describe(search.theta(point)[0], search.next_sample()) for point in pool]
        counts = [len(rows) for rows, _ in described]
        by_point = model.predict(torch.cat([features for _, features in described])).split(counts, 1)
        predicted = torch.full((len(by_point[0]), len(pool), len(search.oracle.counted_objects)), MARGIN_CEILING)
        for place, ((rows, _), margins) in enumerate(zip(described, by_point, strict=True)):
            predicted[:, place, rows.cpu()] = margins.to(predicted)
        return predicted.to(pool)

    def _choose(self, search: MarginSearchState, predicted: Tensor) -> tuple[Tensor, int]:
        """Margins (C, N) by a few trees, and the point with the lowest objective by them."""
        few = torch.randperm(len(predicted), generator=search.generator)[:_TREES_OF_PROPOSAL]
        margins = predicted[few.to(predicted.device)].mean(0)
        values = [search.objective(row) for row in margins]
        return margins, min(range(len(values)), key=values.__getitem__)
