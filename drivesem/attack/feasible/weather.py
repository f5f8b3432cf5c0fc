"""Feasible weather: which codes of fog, rain, time of day and overcast occur together, and keep vehicles visible.

Each code alone covers its whole range: dense fog (visibility 130 m), strong rain, the end of civil twilight, a
closed cloud cover. All of them at their maximum at once is weather that does not occur.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import nnls

from drivesem.attack.feasible.vehicles import TOLERANCE, Array, Flags, Values, to_float64_array
from drivesem.attack.space import ParameterSpace

FindInvisible = Callable[[Array], Flags]
"""Which objects (N,) are no longer visible under weather codes (4,)."""

_DUSK = math.log10(15_000 / 3.4)
"""Decades of illuminance (lx) from daylight (10,000 to 20,000 without direct sun) to the end of civil twilight,
until which one sees without lamps: vehicles here have none lit. Illuminances, here and below, are from the RCA
Electro-Optics Handbook (1974) and Schlyter's Radiometry and photometry in astronomy."""
_COVER = math.log10(400 / 40)
"""Decades that a closed cloud cover absorbs. Fog is a cloud cover on the ground."""
_STORM = math.log10(2_000 / 200)
"""Decades by which the clouds of strong rain are darker than other clouds."""
_BRIGHT_RAIN = 0.5
"""Maximum rain from a sky no more covered than in the photograph: showers in sunshine are light to moderate,
strong rain needs deep, wide clouds (WMO, International Cloud Atlas: nimbostratus, cumulonimbus)."""
CODE_SUMS = np.array(
    [
        # Drops of rain wash those of fog out of the air, the faster the stronger it rains; fog in rain forms where
        # weak rain evaporates into cold air (AMS Glossary of Meteorology: washout, precipitation fog).
        [1.0, 1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, -1.0],
        [_COVER / _DUSK, _STORM / _DUSK, 1.0, _COVER / _DUSK],
    ]
)
"""Sums (3, 4) of the codes of fog, rain, time of day and overcast."""
CODE_SUM_LIMITS = np.array([1.0, _BRIGHT_RAIN, 1.0])
"""Upper limits (3,) of CODE_SUMS."""
RULE_NAMES = ("fog in rain", "rain without cover", "dark")
_HALVINGS = 5
"""Bisection steps of the visibility limit, to 1/32 of a change."""


class WeatherSet:
    """The feasible weather of one scene: a convex set of codes, restricted to those that keep vehicles visible."""

    def __init__(
        self, space: ParameterSpace, where: slice, joint: bool, find_invisible: FindInvisible | None
    ) -> None:
        """Prepare the set.

        Args:
            space: the scene's parameter space.
            where: the weather block of theta.
            joint: whether the codes are bounded together.
            find_invisible: which objects are no longer visible under which codes; None: all stay visible.
        """
        self._where, self._find_invisible = where, find_invisible
        self._start = to_float64_array(space.scene.environment.weather)
        self._lower, self._upper = to_float64_array(space.lower)[where], to_float64_array(space.upper)[where]
        # Sums that the photographed scene already exceeds may only not grow.
        self._room = (
            np.maximum(CODE_SUM_LIMITS - CODE_SUMS @ self._start, 0.0)
            if joint
            else np.full(len(CODE_SUM_LIMITS), np.inf)
        )

    def violations(self, values: Values) -> list[str]:
        """Violations of theta (D,), which is inside its bounds, such as `weather: fog in rain`."""
        change = values[self._where].astype(np.float64)
        return [f"weather: {RULE_NAMES[k]}" for k in np.flatnonzero(self._exceeded(change))] + self._invisible(
            change
        )

    def project(self, values: Values, unclipped: Values) -> list[str]:
        """Move theta into the set, in place: first to the nearest codes that occur together, then towards the
        photograph until all vehicles are visible.

        Args:
            values: theta (D,), inside its bounds.
            unclipped: theta (D,) before it was clipped to its bounds; the nearest codes are nearest to it.

        Returns:
            The active constraints.
        """
        change = values[self._where]
        active = [f"weather: {RULE_NAMES[k]}" for k in np.flatnonzero(self._exceeded(change.astype(np.float64)))]
        if active:
            change[:] = np.clip(
                self._find_nearest(unclipped[self._where].astype(np.float64)), self._lower, self._upper
            )
        invisible = self._invisible(change.astype(np.float64))
        if invisible:
            goal, low, high = change.copy(), 0.0, 1.0
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                # Test what is returned: codes rounded as theta is.
                change[:] = goal * middle
                low, high = (low, middle) if self._invisible(change.astype(np.float64)) else (middle, high)
            change[:] = goal * low
        return active + invisible

    def _exceeded(self, change: Array) -> Flags:
        """(3,), which of CODE_SUMS exceed their limits."""
        return CODE_SUMS @ change > self._room + TOLERANCE

    def _invisible(self, change: Array) -> list[str]:
        if self._find_invisible is None or not change.any():
            return []
        return [f"objects[{i}]: contrast" for i in np.flatnonzero(self._find_invisible(self._start + change))]

    def _find_nearest(self, codes: Array) -> Array:
        """The point (4,) of the set nearest to codes (4,), exactly: the distance to a polyhedron by non-negative
        least squares (Lawson and Hanson 1974, chapter 23).
        """
        axes = np.eye(len(codes))
        rows = np.concatenate([-CODE_SUMS, axes, -axes])
        offsets = np.concatenate([-self._room, self._lower, -self._upper]) - rows @ codes
        system, target = np.vstack([rows.T, offsets]), np.append(np.zeros(len(codes)), 1.0)
        residual = system @ nnls(system, target)[0] - target
        return codes - residual[:-1] / residual[-1]
