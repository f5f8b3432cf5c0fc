"""Whether samples around a failure name the fault that was planted: its features, and about its bands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from detectors.planted import Band, PlantedFault
from drivesem.analysis.holes.rules import FeatureSamples
from drivesem.analysis.holes.run import draw_samples_around
from drivesem.failures.neighbourhood import Neighbourhood
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.rules import fit_rule, overlap
from drivesem.run.frame import AttackedScene

ENOUGH = 0.5
"""Overlap of bands, their intersection by their hull, from which a band is the right one."""

Where = Mapping[str, tuple[float, float]]


def told_of(attacked: AttackedScene, index: int, samples: int, seed: int) -> tuple[Where, int]:
    """A rule from so many samples around the failure of one object, and the passes that they took."""
    around = looked_around(attacked, index, samples, seed)
    return fit_rule(around.columns(), around.failing).intervals if around.margins else {}, len(around.margins)


def looked_around(attacked: AttackedScene, index: int, samples: int, seed: int) -> FeatureSamples:
    """So many samples around the failure of one object, half of them close to it. Each costs a pass."""
    objective, nuisances = attacked.objective, Nuisances()
    name = f"{attacked.identifier}:{index}:{seed}"
    near = Neighbourhood(objective, objective.feasible_set(), attacked.search.theta, index, nuisances, name)
    return draw_samples_around(near, samples)


def agrees(where: Where, fault: PlantedFault, bands: Sequence[Band]) -> tuple[bool, bool]:
    """Whether a rule names a fault: wholly, in part. bands: where it hides cars, by features of their labels;
    without any nothing is right.
    """
    true = {band.feature: (band.low, band.high) for band in bands}
    right = [name for name in where if name in true and overlap({name: where[name]}, {name: true[name]}) >= ENOUGH]
    return bool(right) and set(right) == set(where) == set(fault.feature_names), bool(right)
