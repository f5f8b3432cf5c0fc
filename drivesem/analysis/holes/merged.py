"""From samples around single failures to holes: rules of the same features in about the same intervals are one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesem.analysis.holes.pooled import Key, Told
from drivesem.analysis.holes.results import Around, Samples
from drivesem.evaluation.resampling import newcombe, wilson
from drivesem.failures.rare import Share
from drivesem.failures.rules import Rule, Where, counted, in_words, overlap
from drivesem.synth.compare import QUANTITIES, reference

ONE = 0.5
"""Overlap from which two rules of the same features are one hole."""
_OF_KITTI = {
    "distance_m": ("depth_m", 1.0),
    "height_px": ("box_height_px", 1.0),
    "yaw_deg": ("yaw_rad", np.pi / 180),
}
"""Features of which KITTI's distribution is known: its name there, and how many of its units one of ours is."""

Again = Mapping[Key, Samples]
"""Of a recheck: samples inside of the rule around a failure, by frame and object."""


@dataclass(frozen=True, slots=True)
class Explained:
    """A failure and its rule. fresh: further samples inside of the rule, which it is held against."""

    around: Around
    told: Told
    fresh: Samples


@dataclass(frozen=True, slots=True)
class Recheck:
    """A hole's probability beside that of draws which had no part in it. stated, again: failures and samples."""

    stated: tuple[int, int]
    again: tuple[int, int]

    @property
    def probability(self) -> float:
        """Share of failures among the new draws."""
        return self.again[0] / self.again[1]

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's of it, 95 %."""
        return wilson(*self.again)

    @property
    def difference(self) -> tuple[float, float]:
        """The 95 % interval of how much more often new draws fail than is stated."""
        return newcombe(self.stated, self.again)

    @property
    def holds(self) -> bool:
        """Whether chance alone may explain the difference: 0 lies in its interval."""
        low, high = self.difference
        return low <= 0 <= high

    def to_json(self) -> dict[str, Any]:
        """A JSON object."""
        return {
            "draws": self.again[1],
            "failures": self.again[0],
            "probability": self.probability,
            "interval": list(self.interval),
            "difference": list(self.difference),
            "holds": self.holds,
        }


@dataclass(frozen=True, slots=True)
class Hole:
    """where: the rule, by feature; empty where failures are told by nothing, and the whole neighbourhood is meant.
    label: class of the objects; probability, low, high: of failing in fresh samples inside, with Wilson's 95 %
    interval, of `count` samples; outside: share of failures outside of it; lost: how large it is, the
    share of the neighbourhoods in which the object is lost; kitti: share of KITTI's vehicles inside, by feature;
    failures, frames: that led to it; pooled: whether the rule is of several failures' samples; recheck: None where
    none was asked for, or nothing is stated.
    """

    where: Where
    label: str
    probability: float | None
    low: float | None
    high: float | None
    count: int
    outside: float | None
    lost: Share
    kitti: dict[str, float]
    failures: tuple[str, ...]
    frames: tuple[str, ...]
    pooled: bool
    recheck: Recheck | None = None

    def to_json(self) -> dict[str, Any]:
        """A JSON object."""
        return {
            "parameters": list(self.where),
            "where": {name: list(bounds) for name, bounds in self.where.items()},
            "class": self.label,
            "pooled": self.pooled,
            "probability": self.probability,
            "interval": [self.low, self.high],
            "samples": self.count,
            "recheck": None if self.recheck is None else self.recheck.to_json(),
            "outside": self.outside,
            "size": {
                "probability": self.lost.probability,
                "interval": [self.lost.low, self.lost.high],
                "by": self.lost.by,
            },
            "kitti": self.kitti,
            "failures": list(self.failures),
            "frames": list(self.frames),
        }

    @property
    def words(self) -> str:
        """The rule for people."""
        return in_words(self.where)


def merged(found: Mapping[Key, Explained], again: Again | None = None) -> list[Hole]:
    """Holes of all failures, by frame and object, largest first; what is told by the same features as a larger one
    comes after those that are not. again: samples of a recheck.
    """
    groups: list[list[tuple[Key, Explained]]] = []
    # Rules of many failures first: others that are much like one join it.
    for key, one in sorted(found.items(), key=lambda item: not item[1].told.pooled):
        like = next((group for group in groups if _alike(group[0][1], one)), None)
        if like is None:
            groups.append([(key, one)])
        else:
            like.append((key, one))
    holes = sorted((_hole(group, again or {}) for group in groups), key=lambda hole: -hole.lost.probability)
    seen: set[tuple[str, ...]] = set()
    first: list[Hole] = []
    copies: list[Hole] = []
    for hole in holes:
        key = (hole.label, *sorted(hole.where))
        (copies if key in seen else first).append(hole)
        seen.add(key)
    return first + copies


def _alike(one: Explained, other: Explained) -> bool:
    same = one.around.label == other.around.label and set(one.told.where) == set(other.told.where)
    return same and overlap(one.told.where, other.told.where) >= ONE


def _hole(group: Sequence[tuple[Key, Explained]], again: Again) -> Hole:
    members, first = [one for _, one in group], group[0][1].told
    # Of bounds that differ a little from failure to failure, the ones in the middle.
    where: Where = {
        name: (
            float(np.median([one.told.where[name][0] for one in members])),
            float(np.median([one.told.where[name][1] for one in members])),
        )
        for name in first.where
    }
    if first.pooled:
        where = first.where
    around = [one.around for one in members if one.around.asked.margins]
    asked = [counted(where, one.asked.columns(), one.asked.failing) for one in around]
    fails, count = _inside(where, [one.fresh for one in members])
    checked = _inside(where, [again[key] for key, _ in group if key in again])
    low, high = wilson(fails, count) if count else (None, None)
    return Hole(
        where=where,
        label=members[0].around.label,
        probability=fails / count if count else None,
        low=low,
        high=high,
        count=count,
        outside=_share(asked),
        lost=_mean([one.around.lost for one in members]),
        kitti=of_kitti(where),
        failures=tuple(f"{frame}: objects[{index}]" for (frame, index), _ in group),
        frames=tuple(dict.fromkeys(frame for (frame, _), _ in group)),
        pooled=first.pooled,
        recheck=Recheck((fails, count), checked) if count and checked[1] else None,
    )


def _inside(where: Where, samples: Sequence[Samples]) -> tuple[int, int]:
    """Failures among samples inside of a rule, and how many these are."""
    rules = [counted(where, some.columns(), some.failing) for some in samples if some.margins]
    return sum(rule.fails for rule in rules), sum(rule.count for rule in rules)


def _mean(shares: Sequence[Share]) -> Share:
    """Of several neighbourhoods. The ends are means as well, which is wider than need be."""
    ends = [(share.probability, share.low, share.high) for share in shares]
    by = " and ".join(sorted({share.by for share in shares}))
    probability, low, high = np.mean(ends, axis=0).tolist()
    return Share(probability, low, high, by, sum(share.asked for share in shares))


def _share(rules: Sequence[Rule]) -> float | None:
    count = sum(rule.count_outside for rule in rules)
    return sum(rule.fails_outside for rule in rules) / count if count else None


def of_kitti(where: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Share of KITTI's labelled vehicles inside of each interval, of features whose distribution is known."""
    found: dict[str, float] = {}
    for name, (low, high) in where.items():
        if name not in _OF_KITTI:
            continue
        theirs, unit = _OF_KITTI[name]
        found[name] = round(_below(theirs, high * unit) - _below(theirs, low * unit), 4)
    return found


def _below(name: str, value: float) -> float:
    """Share of KITTI's vehicles below a value; an angle adds one for each turn."""
    quantity = QUANTITIES[name]
    edges = np.asarray(quantity.edges, float)
    below = np.concatenate([[0.0], np.cumsum(reference().shares[name])])
    turns, rest = divmod(value - edges[0], 2 * np.pi) if quantity.angle else (0.0, value - edges[0])
    return float(turns + np.interp(edges[0] + rest, edges, below / below[-1]))
