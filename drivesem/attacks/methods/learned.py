"""A search that begins with what finished frames tell.

A detector's weakness is a region of what it sees, the same in all frames. So margins of one frame's search predict
those of another frame: trees (extremely randomised, Geurts et al. 2006) are fitted to features of objects as drawn.
And a weather that loses the objects of one frame is a good guess in another one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.methods.margin_search import (
    MARGIN_CEILING,
    MARGIN_FLOOR,
    START_SHARE,
    Climb,
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
_POOL = 32
"""Rendered points of which proposals are combined; half of them have scenes of finished frames."""
_FIRST = 4
"""Proposals that are tried before the search goes on."""
_LEARNED_SHARE = 0.5
"""Share of the points of a start that are proposals; wrong knowledge costs no more."""
_KNOWN_CELL = 0.25
"""What a loss counts in a cell that fails already; elsewhere it counts 1."""


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
class Knowledge:
    """What finished frames tell."""

    model: MarginModel | None
    """Predicts margins; None while there are too few rows."""
    scenes: Tensor
    """(M, S), the scene's coordinates of theta in counterexamples."""
    lost: Tensor
    """(M,), objects that are lost for certain in each, at least one."""
    failing: frozenset[tuple[int, ...]]
    """Cells of the map in which objects are lost for certain."""


@dataclass(frozen=True, slots=True)
class _Pool:
    """Points of which proposals are combined."""

    points: Tensor
    """(C, K)."""
    predicted: Tensor
    """(T, C, N), margins of the objects by each tree; `MARGIN_CEILING` without a model."""
    weights: Tensor
    """(C, N), what the loss of an object counts there."""


@dataclass(frozen=True, slots=True)
class Learn(Climb):
    """Tries what finished frames propose, and ends if that loses all objects; if not, it climbs from there."""

    knowledge: Knowledge | None = None
    """What finished frames tell; without, it is `Climb`."""

    def _search(self, search: MarginSearchState) -> Tensor:
        known = self.knowledge
        if known is None or (known.model is None and not known.scenes.numel()):
            return Climb._search(self, search)
        pool = self._build_pool(known, search)
        count = int(START_SHARE * self.passes)
        proposals, weights = self._propose_points(search, pool, max(int(_LEARNED_SHARE * count), _FIRST))
        margins = search.margins(list(proposals[:_FIRST]), [search.next_sample() for _ in range(_FIRST)])
        best = proposals[int(_gain(margins, weights[:_FIRST].to(margins)).argmax())]
        if search.loses_all(best):
            return best
        learned = torch.cat([best[None], proposals[_FIRST:]])
        points = torch.cat([learned, sample_points(search, max(count - search.passes - len(learned), 2))])
        return self._climb(search, points, range(len(learned) + 1, len(points), 2))

    def _build_pool(self, known: Knowledge, search: MarginSearchState) -> _Pool:
        points = sample_points(search, _POOL)
        if known.scenes.numel():
            count = _POOL // 2
            chosen = known.lost.multinomial(count, count > len(known.lost), generator=search.generator)
            for place, scene in enumerate(known.scenes[chosen]):
                points[place] = search.box.with_scene(points[place], scene)
        weights = points.new_ones(len(points), len(search.oracle.counted_objects))
        if known.model is None:  # only points with scenes of finished frames
            return _Pool(points[: _POOL // 2], MARGIN_CEILING * weights[None, : _POOL // 2], weights[: _POOL // 2])
        described = [search.oracle.describe(search.theta(point)[0], search.next_sample()) for point in points]
        margins = known.model.predict(torch.cat([features for _, features, _ in described]))
        predicted = weights.new_full((len(margins), *weights.shape), MARGIN_CEILING)
        by_point = margins.split([len(rows) for rows, _, _ in described], 1)
        for place, ((rows, _, cells), own) in enumerate(zip(described, by_point, strict=True)):
            predicted[:, place, rows.to(predicted.device)] = own.to(predicted)
            counts = [_KNOWN_CELL if cell in known.failing else 1.0 for cell in cells]
            weights[place, rows.to(weights.device)] = weights.new_tensor(counts)
        return _Pool(points, predicted, weights)

    def _propose_points(self, search: MarginSearchState, pool: _Pool, count: int) -> tuple[Tensor, Tensor]:
        """Points (count, K), and what the loss of an object counts there (count, N)."""
        points: list[Tensor] = []
        weights: list[Tensor] = []
        left = torch.ones(len(pool.points), dtype=torch.bool, device=pool.points.device)
        for _ in range(count):
            trees = torch.randperm(len(pool.predicted), generator=search.generator)[:_TREES_OF_PROPOSAL]
            margins = pool.predicted[trees.to(pool.predicted.device)].mean(0)
            row = int(torch.where(left, _gain(margins, pool.weights), -1).argmax())
            left[row] = False
            points.append(search.combine_objects(pool.points, margins, row))
            weights.append(pool.weights[row])
        return torch.stack(points), torch.stack(weights)


def _gain(margins: Tensor, weights: Tensor) -> Tensor:
    """What points (C,) are worth, by margins (C, N) of objects and what their losses count: about one for each lost
    object, and a small share for low margins.
    """
    clamped = margins.clamp(MARGIN_FLOOR, MARGIN_CEILING)
    return (weights * (torch.sigmoid(-4 * clamped) + 0.05 * (MARGIN_CEILING - clamped))).sum(1)
