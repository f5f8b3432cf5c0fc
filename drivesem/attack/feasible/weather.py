"""Weather: which codes of fog, rain, time of day and overcast go together, and through which one still sees.

Each code by itself goes to the end of what is drawn: dense fog (visibility 130 m), strong rain, the end of civil
twilight, a closed cover. All of them at their ends at once is a weather that nobody has met.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import nnls

from drivesem.attack.feasible.cars import TOLERANCE, Array, Flags, Values, array
from drivesem.attack.space import ParameterSpace

Fading = Callable[[Array], Flags]
"""Which objects (N,) would no longer be seen under weather codes (4,)."""

_DUSK = math.log10(15_000 / 3.4)
"""Decades of light, lx, from a day's (10,000 to 20,000 without direct sun) to that at the end of civil twilight,
until which one sees without lamps: vehicles here have none lit. Levels of light, here and below, are those of the
RCA Electro-Optics Handbook (1974) and of Schlyter's Radiometry and photometry in astronomy."""
_COVER = math.log10(400 / 40)
"""Decades that a closed cover takes, of 400 lx at sunset as of a day's. Fog is a cover that lies on the ground."""
_STORM = math.log10(2_000 / 200)
"""Decades by which the clouds of strong rain are darker than other covers."""
_BRIGHT_RAIN = 0.5
"""Rain that falls out of a sky which is no more covered than in the photograph: showers beside sunshine are light
to moderate, strong rain takes deep, wide clouds (WMO, International Cloud Atlas: nimbostratus, cumulonimbus)."""
TOGETHER = np.array(
    [
        # Drops of rain wash those of fog out of the air, the faster the stronger it rains; fog in rain forms where
        # weak rain evaporates into cold air (AMS Glossary of Meteorology: washout, precipitation fog).
        [1.0, 1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, -1.0],
        [_COVER / _DUSK, _STORM / _DUSK, 1.0, _COVER / _DUSK],
    ]
)
"""Sums (3, 4) of the codes of fog, rain, time of day and overcast."""
MOST = np.array([1.0, _BRIGHT_RAIN, 1.0])
"""What each of TOGETHER (3,) may come to."""
RULES = ("fog in rain", "rain without cover", "dark")
_HALVINGS = 5
"""Bisection steps: how far one sees is found to 1/32 of a change."""


class WeatherSet:
    """The weather of one scene's `ParameterSpace`: a convex set of codes, and of those, as one sees through.

    together: whether codes are bounded together; fades: who is lost from sight under which codes.
    """

    def __init__(self, space: ParameterSpace, where: slice, together: bool, fades: Fading | None) -> None:
        self._where, self._fades = where, fades
        self._start = array(space.scene.environment.weather)
        self._lower, self._upper = array(space.lower)[where], array(space.upper)[where]
        # What the scene comes to from the start is kept, and may only not grow.
        self._room = np.maximum(MOST - TOGETHER @ self._start, 0.0) if together else np.full(len(MOST), np.inf)

    def violations(self, values: Values) -> list[str]:
        """What theta (D,), inside its bounds, violates, such as `weather: fog in rain`."""
        change = values[self._where].astype(np.float64)
        return [f"weather: {RULES[k]}" for k in np.flatnonzero(self._beyond(change))] + self._faded(change)

    def bound(self, values: Values, asked: Values) -> list[str]:
        """Move theta (D,), which is inside its bounds, into the set, in place; what held it back.

        asked (D,): theta before it was brought inside. The nearest to it is taken of codes that go together, and
        from there the way to the photograph until all is seen.
        """
        change = values[self._where]
        active = [f"weather: {RULES[k]}" for k in np.flatnonzero(self._beyond(change.astype(np.float64)))]
        if active:
            change[:] = np.clip(self._nearest(asked[self._where].astype(np.float64)), self._lower, self._upper)
        faded = self._faded(change.astype(np.float64))
        if faded:
            goal, low, high = change.copy(), 0.0, 1.0
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                # What is looked at is what is handed back, rounded as theta is.
                change[:] = goal * middle
                low, high = (low, middle) if self._faded(change.astype(np.float64)) else (middle, high)
            change[:] = goal * low
        return active + faded

    def _beyond(self, change: Array) -> Flags:
        """Of TOGETHER (3,), which are too much."""
        return TOGETHER @ change > self._room + TOLERANCE

    def _faded(self, change: Array) -> list[str]:
        if self._fades is None or not change.any():
            return []
        return [f"objects[{i}]: contrast" for i in np.flatnonzero(self._fades(self._start + change))]

    def _nearest(self, asked: Array) -> Array:
        """The nearest point (4,) of the set, exactly: the least distance to a polyhedron is a problem of
        non-negative least squares (Lawson and Hanson 1974, chapter 23).
        """
        axes = np.eye(len(asked))
        rows = np.concatenate([-TOGETHER, axes, -axes])
        least = np.concatenate([-self._room, self._lower, -self._upper]) - rows @ asked
        system, target = np.vstack([rows.T, least]), np.append(np.zeros(len(asked)), 1.0)
        residual = system @ nnls(system, target)[0] - target
        return asked - residual[:-1] / residual[-1]
