"""Average precision and recall for parts of the objects: by distance, size, occlusion, and by the weather.

Objects outside a part are ignored: what finds them is no hit, and no false positive. A false positive belongs to
no object and counts in every part, so that precision in a small part is low; recall is what parts are compared by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from drivesem.evaluation.curves import Rule, average_precision
from drivesem.evaluation.instances import Booleans, Truths
from drivesem.evaluation.matching import Candidates, Match

DISTANCES_M = (0.0, 10.0, 20.0, 30.0, 50.0, np.inf)
HEIGHTS_PX = (0.0, 25.0, 40.0, 80.0, np.inf)
"""KITTI's minimum heights are among them."""
OCCLUSIONS = ("visible", "partly", "largely", "unknown")
"""KITTI's words for its codes 0 to 3."""


@dataclass(frozen=True, slots=True)
class PartRow:
    """One class in one part. by: distance, size, occlusion or weather; part: its name with its unit; ap, recall:
    fractions; objects: how many there are to find.
    """

    name: str
    by: str
    part: str
    ap: float | None
    recall: float | None
    objects: int


def parts_of(truths: Truths) -> dict[str, dict[str, Booleans]]:
    """The objects (M,) of each part; kinds of parts of which nothing is known are left out."""
    found: dict[str, dict[str, Booleans]] = {}
    if np.isfinite(truths.distance_m).any():
        found["distance"] = _ranges(truths.distance_m, DISTANCES_M, "m")
    found["size"] = _ranges(truths.boxes[:, 5], HEIGHTS_PX, "px high")
    if (truths.occlusion >= 0).any():
        found["occlusion"] = {name: truths.occlusion == code for code, name in enumerate(OCCLUSIONS)}
    return found


def _ranges(values: np.ndarray, bounds: Sequence[float], unit: str) -> dict[str, Booleans]:
    parts: dict[str, Booleans] = {}
    for low, high in pairwise(bounds):
        name = f"{low:g}+ {unit}" if np.isinf(high) else f"{low:g}-{high:g} {unit}"
        parts[name] = (values >= low) & (values < high)
    return parts


def rows(
    candidates: Candidates,
    matches: Sequence[Match],
    classes: Sequence[str],
    rule: Rule,
    weather: Sequence[str | None] | None = None,
) -> list[PartRow]:
    """Every class in every part that has objects. matches: one a class; weather (F,): of the frames."""
    found: list[PartRow] = []
    for by, parts in parts_of(candidates.truths).items():
        for part, chosen in parts.items():
            for label, name in enumerate(classes):
                tally = candidates.tally(matches[label], label, chosen)
                if objects := int(tally.count()):
                    found.append(PartRow(name, by, part, average_precision(tally, rule), tally.recall(), objects))
    known = sorted({word for word in weather or () if word is not None})
    for word in known:
        weights = np.array([one == word for one in weather or ()], np.float64)
        for label, name in enumerate(classes):
            tally = candidates.tally(matches[label], label)
            objects = tally.count(weights)
            if objects:
                recall = float((tally.hits * weights[tally.frame]).sum()) / objects
                ap = average_precision(tally, rule, weights)
                found.append(PartRow(name, "weather", word, ap, recall, int(objects)))
    return found
