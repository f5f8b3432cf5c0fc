"""Choose the likeliest template and heading of a labelled car by edges, before its mask is known.

Labels are off by degrees, and an outline hardly determines the heading: a car turned a little and a longer car
look alike. Edges inside the outline differ.
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
"""Turns from the label's heading that are tried: labels are off by some 5 degrees; the fit corrects 2."""
_LABEL_TURN_RAD = 0.08
"""Standard deviation of a label's heading, rad."""
_TURN_COST = 0.005
"""Cost, in edge distance, of a turn by that deviation, twice: half its square counts."""
MIN_VISIBLE_SHARE = 0.5
"""Share of a car that must be visible for its edges to outweigh its label."""
_RANK_COST = 0.004
"""Cost, in edge distance, of each rank of a template by its proportions."""
_PICKUP_COST = 0.04
"""Cost, in edge distance, of a pickup: seen from its ends it looks like other cars, and on Europe's roads one car
in fifty is one."""
_FIXED_HEADING = BoxAlignmentSettings(turn_rad=0.01)
"""A tried heading may be moved to fill the box, but not turned back."""
_FIXED_POSE = BoxAlignmentSettings(shift_m=0.05, lift_m=0.02, turn_rad=0.01, stretch=0.02)
"""For a car that a laser measured."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPhotograph:
    """A photograph as evidence about one object."""

    picture: NDArray[np.uint8]
    """(H, W, 3) RGB."""
    hidden: Mask
    """(H, W), pixels of nearer objects."""
    camera: Camera
    """The photograph's camera."""
    backend: verbs.Backend = "warp"
    """Of the rasteriser."""

    def visible_share(self, placement: Placement) -> float:
        """Share of a placed mesh's pixels that nothing nearer hides; 0 if it has none."""
        outline = render_silhouettes([placement], self.camera, self.backend)[0]
        total = np.count_nonzero(outline)
        return np.count_nonzero(outline & ~self.hidden) / total if total else 0.0

    def edge_distances(self, placements: Sequence[Placement]) -> NDArray[np.float64]:
        """Distances (N,) of each placed mesh's edges from the photograph's."""
        return np.array(measure_edge_distances(placements, self.hidden, self.picture, self.camera, self.backend))


def choose_pose(
    options: Sequence[Placement], box: LabelBoxes | None, photograph: ObjectPhotograph, measured: bool = False
) -> tuple[list[Placement], NDArray[np.float64]]:
    """Align each option with the label's 2D box and rate it; try other headings for the best one.

    Args:
        options: N meshes at the label, the likeliest by its proportions first.
        box: The label's 2D box (one row) if its sides can be trusted.
        photograph: The photograph, for its edges.
        measured: Whether a laser measured the pose. Then, and where little is visible, no other heading is tried.

    Returns:
        The N placements, and their edge distances (N,) plus penalties: the likeliest has the least.
    """

    def align(placements: list[Placement], settings: BoxAlignmentSettings | None) -> list[Placement]:
        if box is None:
            return placements
        count = len(placements)
        boxes = LabelBoxes(box.xyxy.expand(count, 4), box.trust.expand(count, 4))
        return align_to_boxes(placements, boxes, photograph.camera, settings)

    aligned = align(list(options), _FIXED_POSE if measured else None)
    penalties = [_RANK_COST * i + _PICKUP_COST * o.mesh.name.startswith("pickup-") for i, o in enumerate(options)]
    costs = photograph.edge_distances(aligned) + np.array(penalties)
    best = int(np.argmin(costs))
    if measured or photograph.visible_share(aligned[best]) < MIN_VISIBLE_SHARE:
        return aligned, costs
    start = options[best] if box is not None else aligned[best]
    yaw = aligned[best].yaw
    tried = [aligned[best], *align([replace(start, yaw=yaw + turn) for turn in _TRIED_TURNS_RAD], _FIXED_HEADING)]
    # in one call: distances compare only within one window
    distances = photograph.edge_distances(tried)
    label_yaw = float(options[best].yaw)
    turns = [math.remainder(float(p.yaw) - label_yaw, 2 * math.pi) / _LABEL_TURN_RAD for p in tried]
    chosen = int(np.argmin(distances + np.array([_TURN_COST * turn**2 / 2 for turn in turns])))
    aligned[best] = tried[chosen]
    costs[best] += min(distances[chosen] - distances[0], 0.0)
    return aligned, costs
