"""One rule for failures of many frames: of the samples around all of them, and of cars that are not lost.

Samples around one car leave open what others would settle: it stands at one height and place. So rules are made of
the samples of all failures of a class (`truth.rules.cover`). A rule is used where it takes fewer words than the
rules of its failures do: its bounds are written once, theirs for each. What no such rule explains keeps its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from drivesem.analysis.holes.results import Around, FrameHoles, Samples, joined
from drivesem.failures.rules import Flags, Where, contains, cover, description, fit

COVERED = 0.5
"""Share of a failure's lost samples that lie inside of the rule that explains it."""

Key = tuple[str, int]
"""A frame's name, and the index of an object."""


@dataclass(frozen=True, slots=True)
class Told:
    """A failure's rule. pooled: whether it is one for several failures."""

    where: Where
    pooled: bool


def rules_of(found: Mapping[str, FrameHoles]) -> dict[Key, Told]:
    """The rule of each failure, of frames by name."""
    failures = {(frame, one.index): one for frame, holes in found.items() for one in holes.around}
    own = {key: Told(single(one), False) for key, one in failures.items()}
    for label in dict.fromkeys(one.label for one in failures.values()):
        own |= _pooled(label, {key: one for key, one in failures.items() if one.label == label}, own, found)
    return own


def single(around: Around) -> Where:
    """The rule of the samples around one failure."""
    samples = joined((around.asked, around.near))
    return fit(samples.columns(), samples.failing).where if samples.margins else {}


def _pooled(
    label: str, failures: Mapping[Key, Around], own: Mapping[Key, Told], found: Mapping[str, FrameHoles]
) -> dict[Key, Told]:
    """Rules for several of the failures of a class, by failure."""
    parts: list[tuple[Key, Samples]] = [(key, joined((one.asked, one.near))) for key, one in failures.items()]
    around = {key: samples for key, samples in parts if samples.margins}
    for frame, holes in found.items():
        for beside in holes.beside:
            if beside.label == label:
                parts += [((frame, index), samples) for index, samples in beside.by_object().items()]
    parts = [part for part in parts if part[1].margins]
    if len(around) < 2:
        return {}
    # Runs may differ in what they could change: what all of them tell is asked for.
    names = [name for name in parts[0][1].names if all(name in samples.names for _, samples in parts)]
    columns = {name: np.concatenate([samples.columns()[name] for _, samples in parts]) for name in names}
    fails = np.concatenate([samples.failing for _, samples in parts])
    numbers = {key: number for number, key in enumerate(dict.fromkeys(key for key, _ in parts))}
    objects = np.concatenate([np.full(len(samples.margins), numbers[key]) for key, samples in parts])
    told: dict[Key, Told] = {}
    for rule in cover(columns, fails, objects):
        members = [key for key, samples in around.items() if key not in told and _explains(rule.where, samples)]
        if len(members) > 1 and _is_shorter(rule.where, {key: around[key] for key in members}, own):
            told |= dict.fromkeys(members, Told(rule.where, True))
    return told


def _explains(where: Where, samples: Samples) -> bool:
    failing: Flags = samples.failing
    inside = contains(where, samples.columns(), len(failing))
    return bool(failing.any()) and float(inside[failing].mean()) >= COVERED


def _is_shorter(where: Where, around: Mapping[Key, Samples], own: Mapping[Key, Told]) -> bool:
    """Whether one rule and each failure's shares inside and outside of it take no more to write down than each
    failure's own rule and shares.
    """
    pooled = alone = 0.0
    count = sum(len(samples.margins) for samples in around.values())
    choice = math.log(len(next(iter(around.values())).names))  # among features
    for key, samples in around.items():
        columns, failing = samples.columns(), samples.failing
        single_where = own[key].where
        alone += description(single_where, columns, failing) + len(single_where) * choice
        pooled += description(where, columns, failing, bounds=0)
    return pooled + len(where) * (2 * math.log(count) + choice) <= alone
