"""Two detectors beside each other: by hole, by kind of failure, and in all, with paired intervals and tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from drivesem.analysis.gate.results import Pair
from drivesem.evaluation.resampling import LEVEL, Difference, differences, holm, rate

HOLE, KIND, ALL, PHANTOMS = "hole", "kind", "all", "phantoms"


@dataclass(frozen=True, slots=True)
class GateRow:
    """level: HOLE, KIND, ALL or PHANTOMS; hole: its name. before, after: share of samples in which either detector
    does not find the object, of PHANTOMS in which it reports what is not there; difference: after less before;
    low, high: its 95 % interval by paired bootstrap, over samples of one hole and over holes else; p: of the sign
    test, one-sided, Holm's over all rows; samples, holes: how many. grew: by more than is tolerated, and by more
    than chance.
    """

    level: str
    hole: str
    before: float
    after: float
    difference: float
    low: float | None
    high: float | None
    p: float
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
    rows = [*holes, *others, *whole, *phantoms]
    # A kind of one hole, and all of one kind, are no further test: their p is that of the row that they repeat.
    tested = [
        row.p
        for row in rows
        if not (row.level == KIND and row.holes == 1) and not (row.level == ALL and len(kinds) == 1)
    ]
    adjusted = {p: least for p, least in zip(tested, holm(tested), strict=True) if least is not None}
    ps = [adjusted[row.p] for row in rows]
    return [replace(row, p=p, grew=row.grew and p < 1 - LEVEL) for row, p in zip(rows, ps, strict=True)]


def _row(level: str, name: str, pairs: Sequence[Pair], tolerance: float, draws: int, seed: int) -> GateRow:
    """p as if it were the only row, and grew before p is asked."""
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
        p=_sign_test(pairs),
        samples=sum(len(pair.before) for pair in pairs),
        holes=len(pairs),
        grew=one.difference > tolerance and (one.low is None or one.low > 0),
    )


def _difference(before: np.ndarray, after: np.ndarray, count: np.ndarray, draws: int, seed: int) -> Difference:
    first, second = rate("lost", before, count), rate("lost", after, count)
    (one,) = differences([first], [second], len(count), draws, np.random.default_rng(seed), test=False)
    return one


def _sign_test(pairs: Sequence[Pair]) -> float:
    """Exact, one-sided, of the samples in which one detector alone fails (McNemar 1947): were both alike in these
    holes, either would fail there with even odds.
    """
    from scipy.stats import binomtest  # on use: it takes a third of a second to load

    alone = [after for p in pairs for before, after in zip(p.before, p.after, strict=True) if before != after]
    return float(binomtest(sum(alone), len(alone), alternative="greater").pvalue) if alone else 1.0
