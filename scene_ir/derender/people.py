"""Cut people and cyclists out of a photograph by their labels, or leave them in the background with a reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender import cutout, upright
from scene_ir.derender.cutout import Cutout
from scene_ir.derender.silhouette import Placement, grow_mask, mask_bounds
from scene_ir.geometry import to_clip
from scene_ir.raster import verbs
from scene_ir.types import Category, Frame, Labels

Mask = NDArray[np.bool_]

PEOPLE_CATEGORIES = {"Pedestrian": Category.PEDESTRIAN, "Cyclist": Category.CYCLIST}
"""Label types that may become upright objects."""
PEOPLE_KINDS = (*PEOPLE_CATEGORIES, "Person_sitting")
"""Label types of people."""
_TWO_WHEELERS = ("Bicycle", "Motorcycle")
_MIN_RIDDEN = 0.3
"""Least share of the smaller box that a rider and the two-wheeler have in common."""
WEIGHTS = Path(__file__).parent / "weights" / "people.safetensors"
"""The shipped weights, made by `tools/train_cutout.py --people`."""

_MIN_HEIGHT_PX = 25.0
"""Lower people are not evaluated."""
_BORDER_PX = 2.0
"""A box nearer to the image's border is cut by it."""
_UNKNOWN_OCCLUSION = 3
_MAX_COVERED = 0.1
"""Share of a box that boxes of nearer labels may cover."""
_SOLID, _TRACE = 0.4, 0.15
"""Share from which a pixel is the object, and from which it may hold some of it: of bright clothes and bags the
network is less sure than of the rest."""
_BORDER = 1.5
"""Reach of soft pixels on either side of a mask's border, px."""
_MIN_REST = 0.1
"""Least share of a pixel that is no occluder."""
_PIECE, _HOLE = 0.1, 0.01
"""Least area of a separate piece, as a share of the largest; area up to which a hole is filled, as a share of all."""
_SIDE = 0.1
"""Largest distance of the mask's sides from the label's, as a share of its height; and 2 px."""
_FILLED = (0.2, 0.85)
"""Share of its box that a mask may fill."""
_UNSURE = (0.25, 0.75)
"""Shares between which the network is unsure of a pixel."""
_MAX_UNSURE, _MAX_UNSURE_INSIDE = 0.7, 0.22
"""Most pixels that it is unsure of, as a share of the mask's: in all, of which small masks have many along their
border, and more than 2 px away from it."""


@dataclass(frozen=True, slots=True)
class PersonCutout:
    """One person or cyclist cut out of the photograph."""

    row: int
    """Row of its label."""
    placement: Placement
    mask: Mask
    """(H, W), its pixels."""
    reach: Mask
    """(H, W), its pixels and those around that may hold some of it: they leave with it."""
    cutout: Cutout
    """Shares of pixels."""


def join_riders(labels: Labels) -> tuple[torch.Tensor, dict[int, int]]:
    """Find the two-wheelers of cyclists, in data sets that label rider and two-wheeler apart.

    Args:
        labels: Labels of N objects.

    Returns:
        Boxes (N, 4) px, a cyclist's around both; and the two-wheeler's row by the rider's.
    """
    boxes = labels.boxes_xyxy.tolist()
    areas = [(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in boxes]
    riders = [i for i, kind in enumerate(labels.kind) if kind == "Cyclist"]
    others = [i for i, kind in enumerate(labels.kind) if kind in _TWO_WHEELERS]
    pairs = [
        (_shared_area(boxes[rider], boxes[other]) / max(min(areas[rider], areas[other]), 1.0), rider, other)
        for rider in riders
        for other in others
    ]
    ridden: dict[int, int] = {}
    for share, rider, other in sorted(pairs, reverse=True):
        if share >= _MIN_RIDDEN and rider not in ridden and other not in ridden.values():
            ridden[rider] = other
    whole = labels.boxes_xyxy.clone()
    for rider, other in ridden.items():
        (x0, y0, x1, y1), (left, top, right, bottom) = boxes[rider], boxes[other]
        whole[rider] = whole.new_tensor([min(x0, left), min(y0, top), max(x1, right), max(y1, bottom)])
    return whole, ridden


def cut_out_people(
    picture: NDArray[np.uint8], frame: Frame, rows: Sequence[int], ground: torch.Tensor, backend: verbs.Backend
) -> tuple[list[PersonCutout], dict[int, str]]:
    """Cut out labelled people.

    Args:
        picture: The photograph (H, W, 3) RGB.
        frame: Its labels and, if there are any, masks.
        rows: Rows of the labels with a 3D box.
        ground: Plane (4,) n.x + d = 0.
        backend: Of the rasteriser.

    Returns:
        The people that are wholly visible and have a clean outline, nearest first, with disjoint masks; and for each
        other row of a person the reason why it stays in the background.
    """
    assert frame.labels is not None
    whole, ridden = join_riders(frame.labels)
    labels, camera = replace(frame.labels, boxes_xyxy=whole), frame.camera
    frame = replace(frame, labels=labels)
    posed = set(rows)
    reasons: dict[int, str] = {}
    for row, kind in enumerate(labels.kind):
        if kind in PEOPLE_KINDS:
            reason = _find_obstacle(labels, row, frame, ridden) if row in posed else "no 3D box"
            reasons[row] = reason
    chosen = [row for row, reason in reasons.items() if not reason]
    depths = to_clip(labels.translation, camera.matrix.to(labels.translation))[:, 2].tolist()
    chosen.sort(key=lambda row: depths[row])
    cuts: list[PersonCutout] = []
    taken = np.zeros(picture.shape[:2], bool)
    for row in chosen:
        parts = [ridden[row]] if row in ridden else []
        shares = _inside_box(_segment(picture, frame, row, parts, taken, ground, backend), labels, row)
        share = shares.full_map("visible", taken.shape)
        mask = _remove_specks((share >= _SOLID) & ~taken)
        reasons[row] = _find_flaw(mask, shares, labels.boxes_xyxy[row].tolist())
        if reasons[row]:
            continue
        reach = _remove_specks(grow_mask(mask, _BORDER + 1) | (share > _TRACE)) & ~taken
        shares = _firm_up(shares, mask)
        pose = labels.translation[row], labels.yaw[row], labels.size_lhw[row]
        placement = upright.make_placement(reach, labels.kind[row], pose, camera, body=mask)
        cuts.append(PersonCutout(row, placement, mask, reach, shares))
        taken = taken | mask
    return cuts, {row: reason for row, reason in reasons.items() if reason}


def _segment(
    picture: NDArray[np.uint8],
    frame: Frame,
    row: int,
    parts: list[int],
    taken: Mask,
    ground: torch.Tensor,
    backend: verbs.Backend,
) -> Cutout:
    """The cut-out of a label by the data set's masks, of its row and of its parts', if there are any, else by the
    network in its 2D box.
    """
    labels = frame.labels
    assert labels is not None
    network = cutout.load_network(WEIGHTS)
    if frame.masks is not None:
        mask = (frame.masks[[row, *parts]] > 0.5).any(0).numpy() & ~taken
        empty = Cutout(0, 0, *(np.zeros((0, 0), np.float32),) * 3)
        return cutout.cutout_from_mask(picture, mask, taken, network) if mask.any() else empty
    guide = upright.place_box(labels.boxes_xyxy[row], labels.translation[row], frame.camera)
    return cutout.cut_out(picture, [guide], [taken], ground, frame.camera, backend, network=network)[0]


def _find_obstacle(labels: Labels, row: int, frame: Frame, ridden: Mapping[int, int]) -> str:
    """Why a label cannot be cut out whole, by the labels alone; empty if nothing is against it."""
    x0, y0, x1, y1 = box = labels.boxes_xyxy[row].tolist()
    if labels.kind[row] == "Person_sitting":
        return "sitting"
    if frame.provenance.get(f"labels[{row}].name") == "rider" and row not in ridden:
        return "no two-wheeler"
    if y1 - y0 < _MIN_HEIGHT_PX:
        return f"lower than {_MIN_HEIGHT_PX:.0f} px"
    right, bottom = frame.camera.width - 1 - _BORDER_PX, frame.camera.height - 1 - _BORDER_PX
    if min(x0, y0) < _BORDER_PX or x1 > right or y1 > bottom or float(labels.truncation[row]) > 0:
        return "cut by the border"
    if 0 < int(labels.occlusion[row]) < _UNKNOWN_OCCLUSION:
        return "partly hidden"
    others = [other for i, other in enumerate(labels.boxes_xyxy.tolist()) if i not in (row, ridden.get(row))]
    covered = [_shared_area(box, other) for other in others if other[3] > y1 - 0.05 * (y1 - y0)]
    people = [_shared_area(box, region) for region in labels.ignore_xyxy.tolist()]
    if max([*covered, *people], default=0.0) > _MAX_COVERED * (x1 - x0) * (y1 - y0):
        return "overlaps others"
    return ""


def _firm_up(shares: Cutout, mask: Mask) -> Cutout:
    """A cut-out that is soft along the border of its mask alone: people are opaque."""
    low, high = _UNSURE
    soft = np.clip((shares.visible - low) / (high - low), 0, 1) * grow_mask(mask, _BORDER)[shares.window]
    return replace(shares, visible=np.maximum(soft, grow_mask(mask, -_BORDER)[shares.window]).astype(np.float32))


def _remove_specks(mask: Mask) -> Mask:
    """A mask without separate small pieces, and without holes too small for arms and legs to enclose."""
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    areas[0] = 0
    solid = (areas >= max(_PIECE * areas.max(), 1))[pieces]
    _, holes, stats, _ = cv2.connectedComponentsWithStats((~solid).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= _HOLE * areas.max()
    return solid | (small[holes] & ~solid)


def _find_flaw(mask: Mask, shares: Cutout, box_xyxy: list[float]) -> str:
    """Why a mask is not a clean outline of the object in a box; empty if it is."""
    if not mask.any():
        return "no outline"
    x0, y0, x1, y1 = box_xyxy
    apart = np.abs(np.subtract(mask_bounds(mask), (x0, y0, x1 + 1, y1 + 1))).max()
    area, count = (x1 - x0) * (y1 - y0), np.count_nonzero(mask)
    unsure = (shares.visible > _UNSURE[0]) & (shares.visible < _UNSURE[1])
    border = (grow_mask(mask, 2) & ~grow_mask(mask, -2))[shares.window]
    sure = np.count_nonzero(unsure) <= _MAX_UNSURE * count
    sure &= np.count_nonzero(unsure & ~border) <= _MAX_UNSURE_INSIDE * count
    filled = _FILLED[0] * area <= count <= _FILLED[1] * area
    return "" if sure and filled and apart <= _SIDE * (y1 - y0) + 2 else "no clean outline"


def _inside_box(shares: Cutout, labels: Labels, row: int) -> Cutout:
    """A cut-out limited to its label's 2D box with a small margin, and without occluders: the label is wholly visible,
    so what the network takes for one is shared among object and background.
    """
    x0, y0, x1, y1 = labels.boxes_xyxy[row].tolist()
    margin = 2.0 + 0.02 * (y1 - y0)
    rows, columns = shares.window
    down, across = np.arange(rows.start, rows.stop)[:, None], np.arange(columns.start, columns.stop)
    inside = (down >= y0 - margin) & (down <= y1 + margin) & (across >= x0 - margin) & (across <= x1 + margin)
    visible = inside * shares.visible / np.maximum(1 - shares.front, _MIN_REST)
    return replace(shares, visible=visible.clip(0, 1).astype(np.float32), front=np.zeros_like(shares.front))


def _shared_area(a: Sequence[float], b: Sequence[float]) -> float:
    """Area px2 shared by two boxes xyxy."""
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0.0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)
