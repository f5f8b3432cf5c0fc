"""How near a frame's weather comes to what hardly ever comes together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivesem.attack.feasible.weather import CODE_SUM_LIMITS, RULE_NAMES, CODE_SUMS
from drivesem.run.results import FrameResult

CODES = ("fog", "rain", "time_of_day", "overcast")
_SLACK = 1e-5
"""Of a share: float32's rounding of codes that lie on a bound."""


@dataclass(frozen=True, slots=True)
class Weather:
    """codes: of CODES, changes from the photograph; share: what comes together, of what there may be of it
    (`feasible.weather`), where that is most; 0 as photographed; rule: which that is.
    """

    codes: tuple[float, ...]
    share: float
    rule: str

    @property
    def beyond(self) -> bool:
        """Whether this is a weather that hardly ever is."""
        return self.share > 1 + _SLACK


def weather_of(result: FrameResult) -> Weather | None:
    """The weather of an attacked frame; None where the run moved none."""
    values = {c.name: c.value for c in result.theta}
    codes = [values[f"weather.{name}"] for name in CODES if f"weather.{name}" in values]
    if len(codes) < len(CODES):
        return None
    shares = CODE_SUMS @ np.array(codes) / CODE_SUM_LIMITS
    worst = int(shares.argmax())
    return Weather(tuple(codes), max(float(shares[worst]), 0.0), RULE_NAMES[worst])
