"""Figures of the yardstick: what each method found, by how rare faults are and by kind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from drivesem.bench.session import Columns
from drivesem.evaluation.resampling import DRAWS, bootstrap_intervals, ratio_metric
from drivesem.failures.rules import format_rule
from tools.bench.planted.yardstick import NO_FAULT, FrameSearches

METHOD = (
    "Each fault is planted into the detector for one frame: as photographed no car is inside of it, and theta "
    "can bring one in. Every method attacks each frame with each fault. Found: cars lost for certain that the "
    "detector without the fault sees in the same picture. Passes: of the detector, a gradient counted as 3; "
    "certificates are not counted. Intervals: 95 %, by bootstrap over frames. With a rule: a rule of features "
    "separates the failing states around the first car found from the others; named: its features are the fault's, "
    "each about where its band is (half of both bands' hull); in part: at least one. Faults none: the "
    "detector as it is, with certain losses and rules that nobody planted."
)
TITLE = "planted faults found, by method"
COLUMNS: Columns = {
    "method": ("method", "method"),
    "rarity": ("faults", "faults"),
    "frames": ("frames", "frames"),
    "faults": ("planted", "planted"),
    "reached": ("with a car found", "reached"),
    "found": ("cars found", "cars"),
    "found_per_100": ("for 100 passes", "/100 passes"),
    "low": ("from", "from"),
    "high": ("to", "to"),
    "inside_share": ("inside of the region", "inside"),
    "certain": ("all certain losses", "certain"),
    "with_rule": ("with a rule", "rule"),
    "named": ("which is the fault", "named"),
    "in_part": ("in part", "in part"),
    "passes": ("passes a fault", "passes"),
    "seconds": ("s a fault", "s"),
}
KINDS_TITLE = "planted faults, by kind"


def method_rows(judged: Sequence[FrameSearches], methods: Sequence[str], seed: int) -> list[dict[str, Any]]:
    """One row per rarity and method; rarity None where nothing was planted."""
    attempts = [attempt for frame in judged for attempt in frame.attempts]
    measured = {(attempt.rarity, attempt.method) for attempt in attempts}
    rarities = dict.fromkeys(attempt.rarity for attempt in attempts)
    pairs = [(method, rarity) for rarity in rarities for method in methods if (rarity, method) in measured]
    return [_row(judged, method, rarity, seed) for method, rarity in pairs]


def kind_rows(judged: Sequence[FrameSearches], methods: Sequence[str]) -> list[dict[str, Any]]:
    """A row for each kind: in how many frames it could be planted, how often chance hits it, and how many of the
    planted ones each method found.
    """
    attempts = [attempt for frame in judged for attempt in frame.attempts]
    kinds = dict.fromkeys(attempt.kind for attempt in attempts if attempt.rarity != NO_FAULT)
    kinds |= dict.fromkeys(kind for frame in judged for kind in frame.unplanted)
    rows = []
    for kind in kinds:
        own = [attempt for attempt in attempts if attempt.kind == kind]
        first = [attempt for attempt in own if attempt.method == methods[0]]
        rows.append(
            {
                "kind": kind,
                "frames": len(judged),
                "planted": len(first),
                "hit": _mean([attempt.hit for attempt in first]),
                "sure": _mean([attempt.sure for attempt in first]),
                **{f"reached_{name}": sum(a.found > 0 for a in own if a.method == name) for name in methods},
            }
        )
    return rows


def kind_columns(methods: Sequence[str]) -> Columns:
    """Those of `kind_rows`."""
    return {
        "kind": ("kind", "kind"),
        "frames": ("frames", None),
        "planted": ("planted in", "planted"),
        "hit": ("hit by so many of Halton's draws", "hit"),
        "sure": ("so that it holds", "sure"),
        **{f"reached_{name}": (f"found by {name}", name) for name in methods},
    }


def _row(judged: Sequence[FrameSearches], method: str, rarity: str, seed: int) -> dict[str, Any]:
    by_frame = [[a for a in frame.attempts if (a.method, a.rarity) == (method, rarity)] for frame in judged]
    own = [attempt for frame in by_frame for attempt in frame]

    def counted(name: str) -> np.ndarray:
        return np.array([sum(getattr(attempt, name) for attempt in frame) for frame in by_frame], np.float64)

    figure = ratio_metric("found", counted("found"), counted("passes") / 100)
    (interval,) = bootstrap_intervals([figure], len(by_frame), DRAWS, np.random.default_rng(seed))
    found = sum(attempt.found for attempt in own)
    return {
        "method": method,
        "rarity": rarity,
        "frames": sum(map(bool, by_frame)),
        "faults": len(own),
        "reached": sum(attempt.found > 0 for attempt in own),
        "found": found,
        "found_per_100": interval.value,
        "low": interval.low,
        "high": interval.high,
        "inside_share": sum(attempt.inside for attempt in own) / found if found else None,
        "certain": sum(attempt.certain for attempt in own),
        "explained": sum(attempt.rule is not None for attempt in own),
        "with_rule": sum(attempt.rule not in (None, format_rule({})) for attempt in own),
        "named": sum(attempt.named for attempt in own),
        "in_part": sum(attempt.in_part for attempt in own),
        "naming": sum(attempt.naming for attempt in own),
        "passes": _mean([attempt.passes for attempt in own]),
        "seconds": _mean([attempt.seconds for attempt in own]),
    }


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None
