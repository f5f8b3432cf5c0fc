"""A search that begins with what finished frames have shown.

A detector's weakness is a region of what it sees, the same in all frames. So margins of one frame's search predict
those of another frame: trees (extremely randomised, Geurts et al. 2006) are fitted to features of objects as drawn.
And a weather that loses the objects of one frame is a good guess in another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.methods.base import GRADIENT_PASSES, MAX_RESCORED, Proposals
from drivesem.attacks.methods.gradient_ascent import SiFGSM
from drivesem.attacks.methods.margin_search import (
    MARGIN_CEILING,
    MARGIN_FLOOR,
    START_SHARE,
    Climb,
    MarginSearchState,
    UnitBox,
    sample_points,
)

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesRegressor

MIN_ROWS = 200
"""With fewer rows there is no model."""
_MAX_ROWS = 20_000
"""Rows of a fit, chosen at random: it takes a second."""
LOWEST_MARGIN, HIGHEST_MARGIN = -4.0, 6.0
"""Range of margins in the fit: how far a car is lost, or how safely it is found, is of no interest."""
_TREES, _TREES_OF_PROPOSAL = 48, 3
"""Trees; and of how many of them a proposal takes the mean. Others of the 48 differ where little is known, so
proposals spread there (Thompson sampling)."""
_PLAIN = 2
"""Random points of each frame, for the run's rate of misses. More of them in frames in which the search goes on would
bias it."""
_RANDOM, _TRANSFERRED = 4, 4
"""Rendered points from which proposals come: random ones, and those transferred from finished frames."""
_ONLY_RANDOM = 32
"""Their number while there is nothing to transfer."""
_PROPOSALS = 4
"""Proposals that are tried before the search goes on."""
_LEARNED_SHARE = 0.5
"""Share of the points of a start that the model proposes where the scene does not change."""
_REST = 0.5
"""Share of the passes left that si-FGSM takes from a proposal: it is nearer to a failure than the photograph."""
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
        self._trees: ExtraTreesRegressor = trees.fit(rows[:, :-1], rows[:, -1].clip(LOWEST_MARGIN, HIGHEST_MARGIN))

    def predict(self, features: Tensor) -> Tensor:
        """Predict with each tree.

        Args:
            features: (K, F).

        Returns:
            (T, K) margins.
        """
        inputs = features.float().numpy()
        if not len(inputs):
            return torch.empty(_TREES, 0)
        return torch.from_numpy(np.stack([tree.predict(inputs) for tree in self._trees.estimators_]))


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What finished frames have shown."""

    model: MarginModel | None
    """Predicts margins; None while there are too few rows."""
    losses: Sequence[tuple[Tensor, Tensor]]
    """Of each object that is lost for certain: the scene's coordinates of theta (S,), and its own (P,)."""
    failing: frozenset[tuple[int, ...]]
    """Cells of the map in which objects are lost for certain."""

    def for_box(self, box: UnitBox) -> Knowledge | None:
        """What is of use in a box: where the scene changes, losses with as many coordinates. None if there is
        nothing.
        """
        sizes = [int((box.theta_owner == owner).sum()) for owner in (-1, 0)]
        losses = [loss for loss in self.losses if sizes[0] and [len(part) for part in loss] == sizes]
        return None if self.model is None and not losses else replace(self, losses=losses)


@dataclass(frozen=True, slots=True)
class Learn(Climb):
    """Where the scene changes, it tries what lost objects of finished frames, and ends if that loses all objects. If
    not, si-FGSM goes on from there, which finds the weather that objects are lost in; without a gradient, `Climb`.

    Where the scene does not change, it is `Climb` with a start that the model proposes half of: gradients do not
    predict what a new place does.
    """

    knowledge: Knowledge | None = None
    """What finished frames have shown."""

    def _propose_in(self, search: MarginSearchState, theta0: Tensor) -> Proposals:
        random = sample_points(search, 2 * _PLAIN)[1::2]
        search.margins(list(random), [search.next_sample() for _ in random], range(_PLAIN))
        if not (self.gradient and search.oracle.differentiable and bool((search.box.owner < 0).any())):
            return Climb._propose_in(self, search, theta0)
        start, active, steps = theta0, (), (search.passes_left - MAX_RESCORED) // GRADIENT_PASSES
        known = self._known(search)
        if known is not None and known.losses:
            best, lost_all = _try_proposals(known, search)
            start, active = search.theta(best)
            if lost_all:
                return Proposals((start,), (None,), search.passes, active)
            steps = int(_REST * (search.passes_left - MAX_RESCORED)) // GRADIENT_PASSES
        ascent = SiFGSM(max(steps, 1)).propose(search.problem, start, search.generator)
        constraints = tuple(dict.fromkeys((*active, *ascent.active_constraints)))
        return replace(ascent, queries=search.passes, active_constraints=constraints)

    def _search(self, search: MarginSearchState) -> Tensor:
        known, count = self._known(search), int(START_SHARE * self.passes)
        if known is None:
            return Climb._search(self, search)
        if known.losses:
            best, lost_all = _try_proposals(known, search)
            if lost_all:
                return best
            learned = best[None]
        else:
            learned, _ = _propose_points(known, search, int(_LEARNED_SHARE * count))
        points = torch.cat([learned, sample_points(search, max(count - search.passes - len(learned), 2))])
        return self._climb(search, points, ())

    def _known(self, search: MarginSearchState) -> Knowledge | None:
        return None if self.knowledge is None else self.knowledge.for_box(search.box)


def _try_proposals(known: Knowledge, search: MarginSearchState) -> tuple[Tensor, bool]:
    """The best one (K,) of a few proposals, and whether it loses all objects."""
    points, weights = _propose_points(known, search, _PROPOSALS)
    margins = search.margins(list(points), [search.next_sample() for _ in points])
    best = points[int(_gain(margins, weights.to(margins)).argmax())]
    return best, search.loses_all(best)


def _transfer(known: Knowledge, search: MarginSearchState, point: Tensor) -> Tensor:
    """The point u (K,) with the scene of a random counterexample, and each object's coordinates from one, too."""
    box = search.box
    theta, owner = box.theta(point), box.theta_owner
    count = int(owner.max()) + 1
    scene, *donors = torch.randint(len(known.losses), (1 + count,), generator=search.generator).tolist()
    theta[owner < 0] = known.losses[scene][0].to(theta)
    for index, donor in enumerate(donors):
        theta[owner == index] = known.losses[donor][1].to(theta)
    return box.point(theta)


def _propose_points(known: Knowledge, search: MarginSearchState, count: int) -> tuple[Tensor, Tensor]:
    """The points (C, K) that promise most, of random and transferred ones; and what the loss of an object counts
    there (C, N).
    """
    model = known.model
    if model is None:
        points = torch.stack([_transfer(known, search, point) for point in sample_points(search, count)])
        return points, points.new_ones(count, 1)
    transferred = _TRANSFERRED if known.losses else 0
    points = sample_points(search, transferred + _RANDOM if transferred else _ONLY_RANDOM)
    for place in range(transferred):
        points[place] = _transfer(known, search, points[place])
    described = [search.oracle.describe(search.theta(point)[0], search.next_sample()) for point in points]
    by_tree = model.predict(torch.cat([features for _, features, _ in described]))
    weights = points.new_ones(len(points), len(search.oracle.counted_objects))
    predicted = weights.new_full((len(by_tree), *weights.shape), MARGIN_CEILING)
    by_point = by_tree.split([len(rows) for rows, _, _ in described], 1)
    for place, ((rows, _, cells), own) in enumerate(zip(described, by_point, strict=True)):
        predicted[:, place, rows.to(predicted.device)] = own.to(predicted)
        counts = [_KNOWN_CELL if cell in known.failing else 1.0 for cell in cells]
        weights[place, rows.to(weights.device)] = weights.new_tensor(counts)
    proposals: list[Tensor] = []
    chosen: list[int] = []
    for number in range(count):
        trees = torch.randperm(len(predicted), generator=search.generator)[:_TREES_OF_PROPOSAL]
        margins = predicted[trees.to(predicted.device)].mean(0)
        gains = _gain(margins, weights)
        gains[chosen] = -1
        whole = transferred and number % 2 == 0  # what failed together is tried together
        chosen.append(int(gains[: transferred if whole else None].argmax()))
        proposals.append(points[chosen[-1]] if whole else search.combine_objects(points, margins, chosen[-1]))
    return torch.stack(proposals), weights[chosen]


def _gain(margins: Tensor, weights: Tensor) -> Tensor:
    """What points (C,) are worth, by margins (C, N) of objects and what their losses count: about one for each lost
    object, and a small share for low margins.
    """
    clamped = margins.clamp(MARGIN_FLOOR, MARGIN_CEILING)
    return (weights * (torch.sigmoid(-4 * clamped) + 0.05 * (MARGIN_CEILING - clamped))).sum(1)
