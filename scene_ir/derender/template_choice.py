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

from scene_ir.derender.box_alignment import BoxAlignmentSettings, align_to_boxes
from scene_ir.derender.silhouette import LabelBoxes, Mask, Placement, measure_edge_distances, render_silhouettes
from scene_ir.raster import verbs
from scene_ir.types import Camera

_TRIED_TURNS_RAD = (-0.1, -0.05, 0.05, 0.1)
"""Headings that are tried beside a label's, rad: it is off by some five degrees; two the fit finds by itself."""
_LABEL_TURN_RAD = 0.08
"""Standard deviation of a label's heading."""
_TURN_COST = 0.005
"""What one such deviation, half squared, costs in distance of edges: all others are evidence, this is a habit."""
MIN_VISIBLE_SHARE = 0.5
"""Share of a car that must show for its edges to be believed against its label."""
_RANK_COST, _PICKUP_COST = 0.004, 0.04
"""What it costs a mesh to be less likely by its proportions, each place, and to be a pickup, in distance of edges:
seen from its ends a car hardly differs from others, and on Europe's roads one in fifty is a pickup."""
_FIXED_HEADING = BoxAlignmentSettings(turn_rad=0.01)
"""A box may move what is tried, not turn it back."""
_FIXED_POSE = BoxAlignmentSettings(shift_m=0.05, lift_m=0.02, turn_rad=0.01, stretch=0.02)
"""How far a box may move a car that a laser measured."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPhotograph:
    """The photograph as one car's. picture (H, W, 3) RGB; hidden (H, W): pixels of nearer things."""

    picture: NDArray[np.uint8]
    hidden: Mask
    camera: Camera
    backend: verbs.Backend = "warp"


def visible_share(placement: Placement, view: ObjectPhotograph) -> float:
    """Share of a placed mesh's pixels that nothing nearer hides, 0 where it has none."""
    outline = render_silhouettes([placement], view.camera, view.backend)[0]
    whole = np.count_nonzero(outline)
    return np.count_nonzero(outline & ~view.hidden) / whole if whole else 0.0


def choose_pose(
    options: Sequence[Placement], box: LabelBoxes | None, view: ObjectPhotograph, measured: bool = False
) -> tuple[list[Placement], NDArray[np.float64]]:
    """The options where they stand best, and how far their edges are from the photograph's, (N,), a little more
    for what is rare: the likeliest has the least.

    options: meshes at the label, the likeliest by what the label says first; box: the label's (1 row), where its
    sides can be trusted; measured: by a laser. Then, and where little of it shows, no other headings are tried.
    """

    def filling(placements: list[Placement], settings: BoxAlignmentSettings | None) -> list[Placement]:
        if box is None:
            return placements
        count = len(placements)
        boxes = LabelBoxes(box.xyxy.expand(count, 4), box.trust.expand(count, 4))
        return align_to_boxes(placements, boxes, view.camera, settings)[0]

    def distances(placements: Sequence[Placement]) -> NDArray[np.float64]:
        return np.array(measure_edge_distances(placements, view.hidden, view.picture, view.camera, view.backend))

    standing = filling(list(options), _FIXED_POSE if measured else None)
    habit = [
        _RANK_COST * i + _PICKUP_COST * option.mesh.name.startswith("pickup-") for i, option in enumerate(options)
    ]
    apart = distances(standing) + np.array(habit)
    best = int(np.argmin(apart))
    if measured or visible_share(standing[best], view) < MIN_VISIBLE_SHARE:
        return standing, apart
    start = options[best] if box is not None else standing[best]
    middle = standing[best].yaw
    others = filling([replace(start, yaw=middle + turn) for turn in _TRIED_TURNS_RAD], _FIXED_HEADING)
    tried = [standing[best], *others]
    # all at once: one window, or their distances would not compare
    off = distances(tried)
    label = float(options[best].yaw)
    doubt = [
        _TURN_COST * (math.remainder(float(p.yaw) - label, 2 * math.pi) / _LABEL_TURN_RAD) ** 2 / 2 for p in tried
    ]
    chosen = int(np.argmin(off + np.array(doubt)))
    standing[best] = tried[chosen]
    apart[best] += min(off[chosen] - off[0], 0.0)
    return standing, apart
