"""Tables of pooled rules for detectors with one fault, without a fault, and with random failures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from detectors.planted import PlantedFault
from drivesem.bench.session import Columns
from drivesem.evaluation.resampling import DRAWS, wilson
from drivesem.failures.rules import Flags, Floats, Intervals, fit_rule_list, format_rule
from tools.bench.planted.across import SharedFault, SharedFaultFrame, SharedFaultSearch
from tools.bench.planted.pool import FramePool, bands_by_label, hidden
from tools.bench.planted.yardstick import rule_names_fault

CONTRAST = 4
"""Halton states per frame in addition to samples around failures: they show where cars are detected."""
SAME_PASSES, ALL = "halton's states, as many passes", "halton's states, all"
CHANCE = "chance"
CHANCE_DETECTORS = 40
"""Detectors of each kind with random failures."""
SHARP = 0.3
"""Share of the cars in its bands by labels that a fault hides, from which it counts as sharp."""
_SHARE = 0.05
"""Of the cars in Halton's states, or of all cars in half of their states, that chance loses."""
METHOD = (
    "Each fault is one detector's, in all frames. By an attack: searches in some of the frames, samples "
    "around what they lose for certain, and a few of Halton's states of every frame. By Halton's states: "
    "those alone, as many passes, and all there are. Pooled rules of either (drivesem holes) name a fault "
    "where the first one has its features, each about where its band is (half of both bands' hull), in part "
    "where it has one of them; further rules are those after the first, or all where there is no fault. "
    "Sharp: the fault hides three in ten or more of the cars that lie in its bands by their labels. Passes: "
    "what one detector takes; here states and pictures serve all faults. No fault: the detector as it is, in "
    "the same frames. Chance: cars are lost by lot, state by state or car by car. Intervals: Wilson's, 95 %."
)
TITLE = "faults of a detector named by pooled rules"
COLUMNS: Columns = {
    "fault": ("fault", "fault"),
    "by": ("by", "by"),
    "hit": ("Halton's pictures that it hits", "hit"),
    "cars": ("cars in them", "cars"),
    "still": ("cars as photographed", "still"),
    "sharp": ("cars inside by labels", "sharp"),
    "failures": ("failures", "failures"),
    "objects": ("of objects", "objects"),
    "passes": ("passes", "passes"),
    "rule": ("first rule", "rule"),
    "named": ("named", "named"),
    "in_part": ("in part", "part"),
    "further": ("further rules", "further"),
}
SUMMARY_TITLE = "all faults"
SUMMARY_COLUMNS: Columns = {
    "by": ("by", "by"),
    "faults": ("detectors", "faults"),
    "named": ("named", "named"),
    "low": ("from", "from"),
    "high": ("to", "to"),
    "in_part": ("in part", "part"),
    "with_rule": ("with a rule", "rule"),
    "further": ("further rules", "further"),
    "passes": ("passes a detector", "passes"),
}


FOUND_TITLE = "cars lost by a fault"
FOUND_COLUMNS: Columns = {
    "method": ("method", "method"),
    "faults": ("faults searched for", "searched"),
    "faults_found": ("found", "found"),
    "certain": ("cars lost for certain", "certain"),
    "found": ("by a fault", "by fault"),
    "per_1000": ("for 1,000 passes", "/1,000 passes"),
    "low": ("from", "from"),
    "high": ("to", "to"),
    "difference": ("less the first method", "less first"),
    "difference_low": ("from", "from"),
    "difference_high": ("to", "to"),
}


@dataclass(frozen=True)
class PooledSamples:
    """Samples of many cars. columns: features (n,) by name; fails (n,); objects (n,): which car each is of;
    passes: what they took.
    """

    columns: Mapping[str, Floats]
    fails: Flags
    objects: np.ndarray
    passes: int

    def rules(self) -> list[Intervals]:
        """Pooled rules, the most informative first."""
        if not self.fails.any():
            return []
        return [rule.intervals for rule in fit_rule_list(self.columns, self.fails, self.objects)]


@dataclass(frozen=True, slots=True)
class FaultRuleRow:
    """Rules found for one detector. failures, objects: lost samples, and of how many cars; passes: of the detector;
    rules: as text; named, in_part: whether the first rule is the fault, or has one of its features; further: rules
    after it, or all rules without a fault."""

    fault: str
    by: str
    hit: float | None
    cars: float | None
    still: float | None
    sharp: float | None
    failures: int
    objects: int
    passes: int
    rules: tuple[str, ...]
    named: bool
    in_part: bool
    further: int

    def to_json(self) -> dict[str, Any]:
        """A JSON object."""
        return asdict(self) | {"rule": self.rules[0] if self.rules else "none"}


def rule_rows(
    planted: Sequence[SharedFault],
    pools: Sequence[FramePool],
    judged: Sequence[SharedFaultFrame],
    methods: Sequence[str],
) -> list[FaultRuleRow]:
    """Of each fault and of none, by each method, and by Halton's states alone: as many passes, and all of them."""
    rows = []
    for one in (*planted, None):
        fault = None if one is None else one.fault
        most = 0
        for method in methods:
            searched = searched_evidence(fault, method, pools, judged)
            most = max(most, searched.passes)
            rows.append(_row(one, method, searched, pools))
        states = max(len(pool.states) for pool in pools)
        counts = {ALL: states} if not methods else {SAME_PASSES: min(-(-most // len(pools)), states), ALL: states}
        rows += [_row(one, by, drawn_evidence(fault, pools, count), pools) for by, count in counts.items()]
    return rows


def searched_evidence(
    fault: PlantedFault | None, method: str, pools: Sequence[FramePool], judged: Sequence[SharedFaultFrame]
) -> PooledSamples:
    """Samples around what a method lost for certain, and `CONTRAST` states of every frame."""
    text = "" if fault is None else fault.text
    own = [a for frame in judged for a in frame.attempts if (a.fault, a.method) == (text, method)]
    contrast = drawn_evidence(fault, pools, CONTRAST)
    numbers = {pool.frame: number for number, pool in enumerate(pools)}
    parts = [
        (_car(numbers[a.frame], one.index), one.around)
        for a in own
        for one in a.neighbourhoods
        if one.around.margins
    ]
    columns = {
        name: np.concatenate([contrast.columns[name], *(part.columns()[name] for _, part in parts)])
        for name in contrast.columns
    }
    fails = np.concatenate([contrast.fails, *(part.failing for _, part in parts)])
    objects = np.concatenate([contrast.objects, *(np.full(len(part.margins), car) for car, part in parts)])
    spent = sum(a.passes for a in own) + sum(len(part.margins) for _, part in parts)
    return PooledSamples(columns, fails, objects, contrast.passes + spent)


def drawn_evidence(fault: PlantedFault | None, pools: Sequence[FramePool], states: int) -> PooledSamples:
    """So many of Halton's states of each frame, with all cars in them that the fault leaves as photographed."""
    names = next((pool.names for pool in pools if pool.names), ())
    rows: list[tuple[float, ...]] = []
    fails: list[bool] = []
    objects: list[int] = []
    for number, pool in enumerate(pools):
        before = set() if fault is None else pool.hidden_as_photographed(fault)
        cars = [car for state in pool.states[:states] for car in state if car.index not in before]
        gone = [False] * len(cars) if fault is None else hidden(cars, fault, pool.t_star)
        rows += [car.described for car in cars]
        fails += [car.margin < 0 or one for car, one in zip(cars, gone, strict=True)]
        objects += [_car(number, car.index) for car in cars]
    table = np.array(rows, np.float64).reshape(len(rows), len(names))
    columns = {name: table[:, i] for i, name in enumerate(names)}
    passes = sum(len(pool.states[:states]) for pool in pools)
    return PooledSamples(columns, np.array(fails, np.bool_), np.array(objects, np.int64), passes)


def chance_rows(pools: Sequence[FramePool], seed: int, shams: int) -> list[dict[str, Any]]:
    """How often random failures get a rule."""
    plain = drawn_evidence(None, pools, max(len(pool.states) for pool in pools))
    rows = []
    for kind in ("state by state", "car by car"):
        with_rule = 0
        for number in range(shams):
            rng = np.random.default_rng([seed, number])
            fails = rng.random(len(plain.fails)) < _SHARE
            if kind == "car by car":
                known = np.unique(plain.objects)
                chosen = rng.choice(known, max(round(2 * _SHARE * len(known)), 1), replace=False)
                fails = np.isin(plain.objects, chosen) & (rng.random(len(plain.fails)) < 0.5)
            with_rule += bool(PooledSamples(plain.columns, fails, plain.objects, plain.passes).rules())
        low, high = wilson(with_rule, shams)
        rows.append({"by": f"{CHANCE}, {kind}", "faults": shams, "with_rule": with_rule, "low": low, "high": high})
    return rows


def summary_rows(rows: Sequence[FaultRuleRow]) -> list[dict[str, Any]]:
    """Of faults, of the sharp ones, and of none, by what named them."""
    found = []
    for by in dict.fromkeys(row.by for row in rows):
        of_by = [row for row in rows if row.by == by]
        sharp = [row for row in of_by if row.sharp is not None and row.sharp >= SHARP]
        parts = {"": [row for row in of_by if row.fault], ", sharp faults": sharp}
        parts[", no fault"] = [row for row in of_by if not row.fault]
        for which, own in parts.items():
            if not own:
                continue
            planted = which != ", no fault"
            named = sum(row.named for row in own)
            low, high = wilson(named, len(own)) if planted else (None, None)
            found.append(
                {
                    "by": by + which,
                    "faults": len(own),
                    "named": named if planted else None,
                    "low": low,
                    "high": high,
                    "in_part": sum(row.in_part for row in own) if planted else None,
                    "with_rule": sum(bool(row.rules) for row in own),
                    "further": sum(row.further for row in own),
                    "passes": float(np.mean([row.passes for row in own])),
                }
            )
    return found


def found_rows(judged: Sequence[SharedFaultFrame], methods: Sequence[str], seed: int) -> list[dict[str, Any]]:
    """Cars that each method loses by a fault, for 1,000 passes, and how many more than the first method; intervals
    by bootstrap over frames.
    """

    def attempts(method: str) -> list[list[SharedFaultSearch]]:
        return [[a for a in frame.attempts if a.fault and a.method == method] for frame in judged]

    def sums(method: str, name: str) -> np.ndarray:
        return np.array([sum(getattr(a, name) for a in own) for own in attempts(method)], np.float64)

    rows = []
    for method in methods:
        own = [attempt for frame in attempts(method) for attempt in frame]
        found, passes = sums(method, "found"), sums(method, "passes") / 1000
        first_found, first_passes = sums(methods[0], "found"), sums(methods[0], "passes") / 1000
        drawn = np.random.default_rng(seed).integers(len(judged), size=(DRAWS, len(judged)))
        rates = found[drawn].sum(1) / passes[drawn].sum(1)
        more = rates - first_found[drawn].sum(1) / first_passes[drawn].sum(1)
        low, high = np.quantile(rates, (0.025, 0.975)).tolist()
        more_low, more_high = np.quantile(more, (0.025, 0.975)).tolist()
        rows.append(
            {
                "method": method,
                "faults": len({a.fault for a in own}),
                "faults_found": len({a.fault for a in own if a.found}),
                "certain": sum(a.certain for a in own),
                "found": int(found.sum()),
                "per_1000": float(found.sum() / passes.sum()),
                "low": low,
                "high": high,
                "difference": float(found.sum() / passes.sum() - first_found.sum() / first_passes.sum()),
                "difference_low": more_low,
                "difference_high": more_high,
            }
        )
    return rows


def _row(one: SharedFault | None, by: str, evidence: PooledSamples, pools: Sequence[FramePool]) -> FaultRuleRow:
    rules = evidence.rules()
    whole = in_part = False
    if one is not None and rules:
        whole, in_part = rule_names_fault(rules[0], one.fault, bands_by_label(pools, one.fault))
    return FaultRuleRow(
        fault="" if one is None else one.fault.text,
        by=by,
        hit=None if one is None else one.hit,
        cars=None if one is None else one.cars,
        still=None if one is None else one.still,
        sharp=None if one is None else one.sharp,
        failures=int(evidence.fails.sum()),
        objects=len(np.unique(evidence.objects[evidence.fails])),
        passes=evidence.passes,
        rules=tuple(map(format_rule, rules)),
        named=whole,
        in_part=in_part,
        further=len(rules) - (one is not None and bool(rules)),
    )


def _car(frame: int, index: int) -> int:
    return 1000 * frame + index
