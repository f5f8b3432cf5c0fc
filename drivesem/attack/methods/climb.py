"""Climb: a search for failures that hold, which lowers the expected margin of each object over nuisance samples.

Between two frames a camera's nuisances change a margin by a good part of a logit, and a point gradient of a car's
position is mostly the phase of its edges in the pixels. So the search first samples all of the bounds and combines
the best point of each object; then it descends, by gradients where they predict wide steps, and by wide two-sided
differences elsewhere. Objects are nearly independent: one pass tests another change of each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from drivesem.attack.methods.margin_search import (
    FINAL_PASSES,
    MARGIN_CEILING,
    MARGIN_FLOOR,
    MarginSearch,
    MarginSearchState,
    balanced_corners,
)

_START_SHARE = 0.4
"""Share of the passes that choose the start."""
_DIFFERENCE_REACH = 0.2
"""Half the width of differences, as a share of the bounds."""
_STEP = 0.15
"""First step, as a share of the bounds; the last is a fifth of it."""
_SMOOTHING = 0.05
"""Standard deviation of theta in gradients, as a share of the bounds."""
_DECAY = 0.5
"""Weight of earlier estimates in a moving average."""


@dataclass(frozen=True, slots=True)
class Climb(MarginSearch):
    """Samples the bounds, then descends on margins."""

    gradient: bool = True
    """Whether to use gradients where the detector has one."""

    def _search(self, search: MarginSearchState) -> Tensor:
        start = _choose_start(search, max(int(_START_SHARE * self.passes), 1))
        return _Descent(search, self.gradient and search.oracle.differentiable).descend(start)


def _choose_start(search: MarginSearchState, count: int) -> Tensor:
    """The start u (K,): the best of the candidates that `count` points give."""
    starts = search.candidates(_sample_points(search, count))
    number = search.next_sample()
    values = [search.objective(search.margins(point, number)) for point in starts]
    return starts[min(range(len(starts)), key=values.__getitem__)]


def _sample_points(search: MarginSearchState, count: int) -> Tensor:
    """Points (count, K): balanced corners and a scrambled Halton sequence alternately."""
    from scipy.stats import qmc  # imported on use: it takes a third of a second to load

    box = search.box
    rng = np.random.default_rng(int(torch.randint(2**62, (), generator=search.generator)))
    points = torch.from_numpy(qmc.Halton(len(box.owner), scramble=True, rng=rng).random(count))
    points[::2] = balanced_corners(box.owner, (count + 1) // 2, search.generator)
    return points.to(box.start)


@dataclass(frozen=True, slots=True)
class _Descent:
    """The descent from a start, with or without gradients."""

    search: MarginSearchState
    gradient: bool

    def descend(self, point: Tensor) -> Tensor:
        """Descend from u (K,) until the passes are used up.

        Returns:
            Of the last point, the mean of the later ones, and the start: the best in held-out nuisance samples.
        """
        search, box = self.search, self.search.box
        start, rough = point, box.rough if self.gradient else torch.ones_like(box.rough)
        any_rough, any_smooth = bool(rough.any()), bool((~rough).any())
        cost = (3 if any_smooth else 0) + (2 if any_rough else 0)
        steps = max((search.passes_left - FINAL_PASSES) // cost, 0)
        slope = torch.zeros_like(point)
        track: list[Tensor] = []
        margins = torch.full((len(search.oracle.counted_objects),), MARGIN_CEILING, device=point.device)
        for step in range(steps):
            number, estimate = search.next_sample(), torch.zeros_like(point)
            if any_smooth:
                step_margins, gradient = self._estimate_gradient(point, number, _object_weights(margins))
                estimate = torch.where(rough, estimate, gradient)
                clamped = step_margins.clamp(-MARGIN_CEILING, MARGIN_CEILING)
                margins = _DECAY * margins + (1 - _DECAY) * clamped
            if any_rough:
                differences = self._estimate_differences(point, number, rough, margins)
                estimate = torch.where(rough, differences, estimate)
            slope = _DECAY * slope + (1 - _DECAY) * self._normalise_per_object(estimate)
            rate = _STEP * (1 - 0.8 * step / max(steps - 1, 1))
            point = (point - rate * slope.sign() * slope.abs().clamp_max(1)).clamp(0, 1)
            track.append(point)
        late = torch.stack(track[len(track) // 2 :]).mean(dim=0) if track else start
        return search.select_best([point, late, start])

    def _estimate_gradient(self, point: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Margins (N,) and the gradient (K,) of their weighted sum near u (K,)."""
        noise = torch.randn(len(point), generator=self.search.generator).to(point)
        theta, _ = self.search.theta((point + _SMOOTHING * noise).clamp(0, 1))
        margins, gradient = self.search.oracle.margins_and_grad(theta, number, weights)
        return margins, self.search.box.slope(gradient)

    def _estimate_differences(self, point: Tensor, number: int, rough: Tensor, margins: Tensor) -> Tensor:
        """Slopes (K,) of each object's margin in its own coordinates, and of all margins in the scene's.

        One random step either way changes all rough coordinates at once: other objects' steps hardly matter to an
        object, and average out.
        """
        owner = self.search.box.owner
        signs = torch.randint(0, 2, (len(point),), generator=self.search.generator) * 2.0 - 1
        direction = signs.to(point) * rough.to(point)
        ahead, behind = ((point + sign * _DIFFERENCE_REACH * direction).clamp(0, 1) for sign in (1, -1))
        margins_ahead, margins_behind = (
            self.search.margins(side, number).clamp(-MARGIN_CEILING, MARGIN_CEILING) for side in (ahead, behind)
        )
        differences = (margins_ahead - margins_behind).to(point)
        weighted_sum = (differences * _object_weights(margins).to(differences)).sum()
        change = torch.where(owner < 0, weighted_sum, differences[owner.clamp_min(0)])
        distance = ahead - behind
        return torch.where(distance != 0, change / distance, 0)

    def _normalise_per_object(self, slope: Tensor) -> Tensor:
        """A slope (K,) divided by its largest value for each object, in rough and in smooth coordinates separately:
        all objects move at one pace.
        """
        box, normalised = self.search.box, torch.zeros_like(slope)
        for owner in box.owner.unique():
            for rough in (False, True):
                where = (box.owner == owner) & (box.rough == rough)
                if bool(where.any()):
                    normalised[where] = slope[where] / slope[where].abs().max().clamp_min(1e-9)
        return normalised


def _object_weights(margins: Tensor) -> Tensor:
    """Weights (N,) of objects in shared coordinates: largest for nearly lost ones, near 0 for certainly lost ones."""
    finite = margins.nan_to_num(MARGIN_CEILING, MARGIN_CEILING, -MARGIN_CEILING)
    return torch.sigmoid(2 * (finite - MARGIN_FLOOR)) * torch.exp(-finite.clamp_min(0) / 2)
