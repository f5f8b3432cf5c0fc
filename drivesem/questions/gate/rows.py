"""Two detectors beside each other: by hole, by kind of failure, and in all, with paired intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from drivesem.evaluation.resampling import Difference, differences, rate
from drivesem.questions.gate.results import Pair

HOLE, KIND, ALL, PHANTOMS = "hole", "kind", "all", "phantoms"


@dataclass(frozen=True, slots=True)
class GateRow:
    """level: HOLE, KIND, ALL or PHANTOMS; hole: its name. before, after: share of samples in which either detector
    does not find the object, of PHANTOMS in which it reports what is not there; difference: after less before;
    low, high: its 95 % interval by paired bootstrap, over samples of one hole and over holes else;
    samples, holes: how many. grew: by more than is tolerated, beyond chance.
    """

    level: str
    hole: str
    before: float
    after: float
    difference: float
    low: float | None
    high: float | None
    samples: int
    holes: int
    grew: bool

    def to_json(self) -> dict[str, Any]:
        """A JSON object."""
        data = asdict(self)
        data["interval"] = [data.pop("low"), data.pop("high")]
        return data


def rows_of(found: Mapping[str, Sequence[Pair]], tolerance: float, draws: int, seed: int) -> list[GateRow]:
    """Rows of pairs by frame: holes, those that grew most first; then kinds; then all of them; then phantoms in
    their samples. tolerance: by how much a share may grow. A pair without samples has no row.
    """
    named = [
        (frame if p.index is None else f"{frame}: objects[{p.index}]", p)
        for frame, pairs in found.items()
        for p in pairs
        if p.before
    ]
    holes = [_row(HOLE, name, [pair], tolerance, draws, seed) for name, pair in named]
    holes.sort(key=lambda row: (-row.difference, row.hole))
    kinds = dict.fromkeys(pair.error for _, pair in named)
    others = [
        _row(KIND, kind, [pair for _, pair in named if pair.error == kind], tolerance, draws, seed)
        for kind in sorted(kinds)
    ]
    pairs = [pair for _, pair in named]
    seen = [
        replace(pair, before=pair.phantoms_before, after=pair.phantoms_after)
        for pair in pairs
        if pair.phantoms_before
    ]
    whole = [_row(ALL, ALL, pairs, tolerance, draws, seed)] if named else []
    phantoms = [_row(PHANTOMS, PHANTOMS, seen, tolerance, draws, seed)] if seen else []
    return [*holes, *others, *whole, *phantoms]


def _row(level: str, name: str, pairs: Sequence[Pair], tolerance: float, draws: int, seed: int) -> GateRow:
    if len(pairs) == 1:  # of one hole the samples are what chance chose
        before, after = (np.array(side, np.float64) for side in (pairs[0].before, pairs[0].after))
        count = np.ones(len(before))
    else:
        before, after = (
            np.array([sum(getattr(p, side)) for p in pairs], np.float64) for side in ("before", "after")
        )
        count = np.array([len(p.before) for p in pairs], np.float64)
    one = _difference(before, after, count, draws, seed)
    assert one.first is not None
    assert one.second is not None
    assert one.difference is not None
    return GateRow(
        level=level,
        hole=name,
        before=one.first,
        after=one.second,
        difference=one.difference,
        low=one.low,
        high=one.high,
        samples=sum(len(pair.before) for pair in pairs),
        holes=len(pairs),
        grew=one.difference > tolerance and (one.low is None or one.low > 0),
    )


def _difference(before: np.ndarray, after: np.ndarray, count: np.ndarray, draws: int, seed: int) -> Difference:
    first, second = rate("lost", before, count), rate("lost", after, count)
    (one,) = differences([first], [second], len(count), draws, np.random.default_rng(seed))
    return one
