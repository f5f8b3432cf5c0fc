"""Which mesh a labelled car is likeliest of, and which way it heads, before anything is known of its outline.

Labels are off by degrees, and an outline hardly tells: a car that is turned a little and longer looks alike. Edges
within the outline do not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scene_ir.derender.settle import SettleSettings, settle
from scene_ir.derender.silhouette import Boxes, Mask, Placement, edge_distances, silhouettes
from scene_ir.raster import verbs
from scene_ir.types import Camera

_TURNS = (-0.1, -0.05, 0.05, 0.1)
"""Headings that are tried beside a label's, rad: it is off by some five degrees; two the fit finds by itself."""
_TURN_RAD = 0.08
"""Standard deviation of a label's heading."""
_DOUBT = 0.005
"""What one such deviation, half squared, costs in distance of edges: all others are evidence, this is a habit."""
LEAST_SHOWN = 0.5
"""Share of a car that must show for its edges to be believed against its label."""
_LATER, _RARE = 0.004, 0.04
"""What it costs a mesh to be less likely by its proportions, each place, and to be a pickup, in distance of edges:
seen from its ends a car hardly differs from others, and on Europe's roads one in fifty is a pickup."""
_HELD = SettleSettings(turn_rad=0.01)
"""A box may move what is tried, not turn it back."""
_MEASURED = SettleSettings(shift_m=0.05, lift_m=0.02, turn_rad=0.01, stretch=0.02)
"""How far a box may move a car that a laser measured."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The photograph as one car's. picture (H, W, 3) RGB; hidden (H, W): pixels of nearer things."""

    picture: NDArray[np.uint8]
    hidden: Mask
    camera: Camera
    backend: verbs.Backend = "warp"


def shown(placement: Placement, view: View) -> float:
    """Share of a placed mesh's pixels that nothing nearer hides, 0 where it has none."""
    outline = silhouettes([placement], view.camera, view.backend)[0]
    whole = np.count_nonzero(outline)
    return np.count_nonzero(outline & ~view.hidden) / whole if whole else 0.0


def likely(
    options: Sequence[Placement], box: Boxes | None, view: View, measured: bool = False
) -> tuple[list[Placement], NDArray[np.float64]]:
    """The options where they stand best, and how far their edges are from the photograph's, (N,), a little more
    for what is rare: the likeliest has the least.

    options: meshes at the label, the likeliest by what the label says first; box: the label's (1 row), where its
    sides can be trusted; measured: by a laser. Then, and where little of it shows, no other headings are tried.
    """

    def filling(placements: list[Placement], settings: SettleSettings | None) -> list[Placement]:
        if box is None:
            return placements
        count = len(placements)
        boxes = Boxes(box.xyxy.expand(count, 4), box.trust.expand(count, 4))
        return settle(placements, boxes, view.camera, settings)[0]

    def distances(placements: Sequence[Placement]) -> NDArray[np.float64]:
        return np.array(edge_distances(placements, view.hidden, view.picture, view.camera, view.backend))

    standing = filling(list(options), _MEASURED if measured else None)
    habit = [_LATER * i + _RARE * option.mesh.name.startswith("pickup-") for i, option in enumerate(options)]
    apart = distances(standing) + np.array(habit)
    best = int(np.argmin(apart))
    if measured or shown(standing[best], view) < LEAST_SHOWN:
        return standing, apart
    start = options[best] if box is not None else standing[best]
    middle = standing[best].yaw
    others = filling([replace(start, yaw=middle + turn) for turn in _TURNS], _HELD)
    tried = [standing[best], *others]
    # all at once: one window, or their distances would not compare
    off = distances(tried)
    label = float(options[best].yaw)
    doubt = [_DOUBT * (math.remainder(float(p.yaw) - label, 2 * math.pi) / _TURN_RAD) ** 2 / 2 for p in tried]
    chosen = int(np.argmin(off + np.array(doubt)))
    standing[best] = tried[chosen]
    apart[best] += min(off[chosen] - off[0], 0.0)
    return standing, apart
