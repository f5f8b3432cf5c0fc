"""Placed meshes, their silhouettes, and the fit of silhouettes to vehicle masks.

The fit changes pose, size and a few symmetric modes of the free-form deformation, by gradients through the
project's own rasteriser, until the mesh's outline runs along the mask's border. It stays near the label.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from scene_ir import ffd as lattice
from scene_ir.geometry import place_vertices, to_clip
from scene_ir.meshes.lod import level_of_detail
from scene_ir.meshes.templates import template
from scene_ir.raster import verbs
from scene_ir.types import LATTICE, LATTICE_POINTS, Camera, Mesh

Mask = NDArray[np.bool_]

_WORK_PX = 160
"""Larger side of the windows in which outlines are fitted: more changes nothing visible, less loses the wheels."""
_DETAIL_PX = 90.0
"""Height that selects a mesh's level of detail in those windows."""
_BAND = 0.12
"""Width of the band in which the mask attracts the outline, as a fraction of the window."""
_FREE_MODE_SCALE = 0.5
"""How far the free modes move single lattice points, against 1 for the shaped modes."""
_ANCHORED_SHARE = 0.25
"""Range of pose and size of an anchored placement, as a share of the usual range."""
_RETRACE_STEPS = 10
"""Steps between traces of the visible edges."""
_MISSED_WEIGHT = 2.0
"""Weight of a mask pixel that the mesh leaves out, against a pixel outside the mask that it covers."""
_ADAM = (0.9, 0.999)
"""Decay of the running means of gradients and of their squares, as its authors recommend."""
_BODIES_BY_LABEL = {
    "Car": ("sedan", "hatchback", "estate", "suv", "pickup"),
    "Van": ("van", "suv"),
    "Truck": ("truck", "bus"),
}
"""Template kinds by a label's type."""
_FALLBACK_KINDS = {"van": ("suv",)}
"""Kinds to choose from where a label's only kind is withheld."""
_MAX_USER_MESHES = 6
"""Number of the user's meshes tried for one label: each costs a render."""
_LOW_PART = 0.3
"""Lower part of a car, as a fraction of its height, next to its shadow."""


@dataclass(frozen=True, slots=True)
class Placement:
    """A mesh placed in camera space."""

    mesh: Mesh
    """Mesh in the unit box."""
    translation: Tensor
    """(3,) m, bottom-face centre."""
    yaw: Tensor
    """() rad."""
    size_lhw: Tensor
    """(3,) m, length, height, width."""
    ffd: Tensor
    """(64, 3) lattice offsets, fractions of the unit box."""

    def vertices(self) -> Tensor:
        """Vertices (V, 3) m in camera space."""
        deformed = unit = self.mesh.vertices
        if self.ffd.requires_grad or bool(self.ffd.any()):
            deformed = lattice.deform(unit, lattice.lattice_weights(unit), self.ffd)
        return place_vertices(deformed, self.size_lhw, self.yaw, self.translation)

    def adjusted(self, change: Tensor) -> Placement:
        """After a change (7,): x, y, z in m, yaw in rad, logarithms of length, height, width."""
        step = change.to(self.yaw)
        return replace(
            self,
            translation=self.translation + step[:3],
            yaw=self.yaw + step[3],
            size_lhw=self.size_lhw * torch.exp(step[4:]),
        )


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Steps, bounds and weights of the silhouette fit."""

    steps: int = 30
    """Steps of Adam; 0 fits nothing."""
    rate: float = 0.25
    """Learning rate, in standard deviations: half the bounds below."""
    max_shift_m: float = 0.3
    """Bound of the position on the ground, m; a third of it for the height."""
    max_turn_rad: float = 0.087
    """Bound of the yaw, rad."""
    max_stretch: float = 0.08
    """Bound of the logarithm of each size."""
    max_offset: float = 0.08
    """Bound of each deformation mode, in fractions of the unit box."""
    prior: float = 0.004
    """Weight of staying at the label."""
    box: float = 15.0
    """Weight of filling the label's 2D box."""
    edges: float = 1.5
    """Weight of the distance to the photograph's edges."""


@dataclass(frozen=True, slots=True, eq=False)
class FitEvidence:
    """What a fit may use besides masks and boxes."""

    picture: NDArray[np.uint8] | None = None
    """(H, W, 3) RGB, for its edges."""
    anchored: Sequence[bool] = ()
    """Whether each placement stays nearly where it is, since a laser measured it or little of it is visible; empty
    for none."""


@dataclass(frozen=True, slots=True)
class LabelBoxes:
    """2D boxes of N labels and the trust in each of their sides."""

    xyxy: Tensor
    """(N, 4) px."""
    trust: Tensor
    """(N, 4) in [0, 1]; 0 where something cuts the side off."""

    def select(self, index: int) -> LabelBoxes:
        """One box, as one row."""
        return LabelBoxes(self.xyxy[index : index + 1], self.trust[index : index + 1])


@dataclass(frozen=True, slots=True, eq=False)
class UserMesh:
    """A user's mesh that a label may be fitted with."""

    mesh: Mesh
    """Mesh in the unit box."""
    kind: str
    """The template kind that its body is of."""
    size_lhw: tuple[float, float, float]
    """Its usual length, height, width, m."""


def rank_template_kinds(kind: str, size_lhw: Sequence[float], withheld: str = "") -> tuple[str, ...]:
    """Template kinds for a label, the likeliest by its proportions first.

    Args:
        kind: The label's type, "Car", "Van" or "Truck".
        size_lhw: The label's length, height, width, m.
        withheld: A kind to leave out.

    Returns:
        At least one kind.
    """
    length, height, _width = size_lhw
    if kind == "Truck":
        ranked = ("truck", "bus") if length < 10 else ("bus", "truck")
    elif kind == "Van":
        ranked = ("van", "suv") if height < 2.4 else ("van",)
    elif height > 1.75:
        ranked = ("suv", "van", "hatchback", "pickup", "estate", "sedan")
    elif height > 1.6:
        ranked = ("suv", "hatchback", "estate", "sedan", "pickup")
    elif length < 4.05:
        ranked = ("hatchback", "sedan", "suv", "estate")
    else:
        ranked = ("sedan", "estate", "hatchback", "suv", "pickup")
    return tuple(k for k in ranked if k != withheld) or _FALLBACK_KINDS.get(withheld, ranked)


def select_user_meshes(kind: str, size_lhw: Sequence[float], own: Sequence[UserMesh]) -> tuple[Mesh, ...]:
    """The user's meshes for a label, nearest in size first.

    Args:
        kind: The label's type, "Car", "Van" or "Truck".
        size_lhw: The label's length, height, width, m.
        own: The meshes to choose from.

    Returns:
        At most `_MAX_USER_MESHES` meshes of a suitable body.
    """

    def size_distance(choice: UserMesh) -> float:
        return float(np.square(np.log(np.divide(choice.size_lhw, size_lhw))).sum())

    suitable = [choice for choice in own if choice.kind in _BODIES_BY_LABEL[kind]]
    return tuple(choice.mesh for choice in sorted(suitable, key=size_distance)[:_MAX_USER_MESHES])


def render_silhouettes(
    placements: Sequence[Placement], camera: Camera, backend: verbs.Backend = "warp"
) -> list[Mask]:
    """Rasterise placed meshes.

    Args:
        placements: N placed meshes.
        camera: The camera.
        backend: Of the rasteriser.

    Returns:
        N masks (H, W) of the pixels with a covered centre.
    """
    if not placements:
        return []
    clip, faces, vertex_ranges, face_ranges = _pack_meshes(placements, camera.matrix)
    rects = verbs.bounding_rects(clip, vertex_ranges, camera.height, camera.width)
    layout = verbs.PixelLayout.from_rects(rects)
    hit = (verbs.rasterize(clip, faces, face_ranges, layout, backend).face >= 0).cpu().numpy()
    masks = []
    for (span, shape), (x0, y0, x1, y1) in zip(layout.spans(), rects.tolist(), strict=True):
        mask = np.zeros((camera.height, camera.width), bool)
        mask[y0:y1, x0:x1] = hit[span].reshape(shape)
        masks.append(mask)
    return masks


def mask_iou(first: Mask, second: Mask, unknown: Mask | None = None) -> float:
    """Intersection over union of two masks.

    Args:
        first: Mask (H, W).
        second: Mask (H, W).
        unknown: Pixels (H, W) that do not count.

    Returns:
        A number in [0, 1]; 0 if both masks are empty.
    """
    if unknown is not None:
        first, second = first & ~unknown, second & ~unknown
    union = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / union if union else 0.0


def mask_bounds(mask: Mask) -> tuple[int, int, int, int]:
    """Bounding rectangle x0, y0, x1, y1, half-open, of a non-empty mask."""
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def grow_mask(mask: Mask, radius: float) -> Mask:
    """The mask grown by `radius` px, or shrunk by a negative one."""
    if not mask.any():
        return mask.copy()
    # Work only where the mask can change: a frame has many more pixels than a car.
    margin = int(max(radius, 0)) + 2
    x0, y0, x1, y1 = mask_bounds(mask)
    window = (slice(max(y0 - margin, 0), y1 + margin), slice(max(x0 - margin, 0), x1 + margin))
    part, grown = mask[window], mask.copy()
    if radius >= 0:
        outside = cv2.distanceTransform((~part).astype(np.uint8), cv2.DIST_L2, 5)
        grown[window] |= outside <= radius
    else:
        padded = np.pad(part, 1, mode="edge").astype(np.uint8)
        grown[window] = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1] > -radius
    return grown


def grabcut_mask(
    image: NDArray[np.uint8], outline: Mask, unknown: Mask, band_px: tuple[float, float, float], rounds: int = 3
) -> Mask:
    """Segment an object by GrabCut (Rother 2004) in a band around an outline.

    Args:
        image: (H, W, 3) RGB.
        outline: Rough mask (H, W) of the object.
        unknown: Pixels (H, W) of nearer objects, which belong to neither side.
        band_px: Width of the band inside the outline, outside it near the ground (where shadows look like
            objects), and outside it higher up, px.
        rounds: GrabCut iterations.

    Returns:
        Mask (H, W) without `unknown`.
    """
    visible = outline & ~unknown
    if not visible.any():
        return visible
    inside, outside_low, outside_high = band_px
    x0, y0, x1, y1 = mask_bounds(outline)
    height, width = outline.shape
    low = np.arange(height)[:, None] > y1 - _LOW_PART * (y1 - y0)
    reach = np.where(low, grow_mask(outline, outside_low), grow_mask(outline, outside_high))
    margin = int(2 * outside_high + 12)
    x0, y0, x1, y1 = max(x0 - margin, 0), max(y0 - margin, 0), min(x1 + margin, width), min(y1 + margin, height)
    window = (slice(y0, y1), slice(x0, x1))
    scale = float(np.clip(120 / max(mask_bounds(outline)[3] - mask_bounds(outline)[1], 1), 1, 4))
    size = (max(round((x1 - x0) * scale), 8), max(round((y1 - y0) * scale), 8))

    def enlarge(mask: Mask) -> Mask:
        return cv2.resize(mask[window].astype(np.float32), size, interpolation=cv2.INTER_LINEAR) >= 0.5

    crop = cv2.resize(image[window], size, interpolation=cv2.INTER_CUBIC)
    labels = np.full(size[::-1], cv2.GC_BGD, np.uint8)
    labels[enlarge(reach)] = cv2.GC_PR_BGD
    labels[enlarge(outline)] = cv2.GC_PR_FGD
    core = enlarge(grow_mask(outline, -inside))
    labels[core] = cv2.GC_FGD
    hidden = enlarge(unknown)
    labels[hidden] = cv2.GC_BGD
    if not ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).any():
        return visible
    models = np.zeros((1, 65)), np.zeros((1, 65))
    # OpenCV seeds its clusters from one process-wide generator.
    cv2.setRNGSeed(0)
    cv2.grabCut(crop, labels, (0, 0, 1, 1), *models, rounds, cv2.GC_INIT_WITH_MASK)
    mask = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)) & ~hidden
    mask = _clean_grabcut(mask, enlarge(outline), scale)
    result = np.zeros_like(outline)
    result[window] = cv2.resize(mask.astype(np.float32), (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA) >= 0.5
    return result & ~unknown


def _clean_grabcut(mask: Mask, outline: Mask, scale: float) -> Mask:
    """The mask without specks and hairs, holes closed, limited to components that lie mostly in the outline."""
    radius = max(1, round(1.2 * scale))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc)
    opened = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, disc)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    keep = np.zeros(count, bool)
    largest = stats[1:, cv2.CC_STAT_AREA].max(initial=0)
    for part in range(1, count):
        area = stats[part, cv2.CC_STAT_AREA]
        keep[part] = area >= 0.05 * largest and np.count_nonzero(outline & (parts == part)) >= 0.6 * area
    cleaned = keep[np.asarray(parts, np.int64)]
    # Holes are windows or reflections, never background: fill what the outside cannot reach.
    padded = np.pad(~cleaned, 1, constant_values=True).astype(np.uint8)
    _, regions = cv2.connectedComponents(padded, connectivity=4)
    enclosed = regions[1:-1, 1:-1] != regions[0, 0]
    return cleaned | (enclosed & outline)


def fit_silhouettes(
    placements: Sequence[Placement],
    masks: Sequence[Mask],
    unknown: Sequence[Mask],
    boxes: LabelBoxes,
    camera: Camera,
    settings: FitSettings,
    backend: verbs.Backend = "warp",
    evidence: FitEvidence | None = None,
) -> list[Placement]:
    """Fit placements, all at once, so that their outlines run along masks.

    Minimises the signed distance to the mask, clamped to the band, summed over the pixels that the mesh covers:
    its gradient moves each piece of outline towards the mask's border from anywhere in the band (Chan and Vese
    2001).

    Args:
        placements: N meshes at their labels.
        masks: N masks (H, W) of the vehicles' visible pixels.
        unknown: N masks (H, W) of pixels that attract nothing.
        boxes: The labels' 2D boxes, which bound the outlines' extent and which no reflection can mislead.
        camera: The photograph's camera.
        settings: Steps, bounds and weights.
        backend: Of the rasteriser.
        evidence: With a picture, outlines and edges between mesh parts are attracted by its edges.

    Returns:
        N fitted placements.
    """
    if not placements or settings.steps == 0:
        return list(placements)
    evidence = evidence or FitEvidence()
    outlines = render_silhouettes(placements, camera, backend)
    windows = [_make_window(*pixels, evidence.picture) for pixels in zip(masks, unknown, outlines, strict=True)]
    rects = torch.tensor([[0, 0, w.pull.shape[1], w.pull.shape[0]] for w in windows])
    layout = verbs.PixelLayout.from_rects(rects)
    whole, placements = placements, _with_coarse_meshes(placements)
    pull = torch.from_numpy(np.concatenate([w.pull.reshape(-1) / w.length for w in windows]))
    faces, _, face_ranges = _pack_meshes(placements, camera.matrix)[1:]
    matrices = [w.zoom @ camera.matrix for w in windows]
    weights = [lattice.lattice_weights(p.mesh.vertices) for p in placements]
    modes = _deformation_modes()
    spread, bound = _code_scales(settings, len(modes))
    spread, bound = spread.repeat(len(placements), 1), bound.repeat(len(placements), 1)
    for row, anchored in enumerate(evidence.anchored):
        if anchored:
            spread[row, :7], bound[row, :7] = _ANCHORED_SHARE * spread[row, :7], _ANCHORED_SHARE * bound[row, :7]
    code = torch.zeros_like(spread, requires_grad=True)
    mean, square = torch.zeros_like(code), torch.zeros_like(code)
    best = torch.full((len(placements),), torch.inf)
    best_code = code.detach().clone()
    contours: list[VisibleContour] = []
    for step in range(settings.steps + 1):
        clips = []
        for i, (placement, weight, matrix) in enumerate(zip(placements, weights, matrices, strict=True)):
            moved = _apply_change(placement, code[i] * spread[i], modes)
            unit = lattice.deform(placement.mesh.vertices, weight, moved.ffd)
            clips.append(to_clip(place_vertices(unit, moved.size_lhw, moved.yaw, moved.translation), matrix))
        clip = torch.cat(clips)
        fragments = verbs.rasterize(clip, faces, face_ranges, layout, backend)
        covered = verbs.antialias(fragments, clip, faces, backend) * pull
        energy = torch.stack([covered[span].sum() for span, _ in layout.spans()])
        sides = [_box_distances(c, box, w) for c, box, w in zip(clips, boxes.xyxy, windows, strict=True)]
        box_loss = (torch.stack(sides) * boxes.trust).sum(1)
        loss = energy + settings.prior * code.square().sum(1) + settings.box * box_loss
        if evidence.picture is not None and settings.edges > 0:
            if step % _RETRACE_STEPS == 0:
                contours = _trace_contours(placements, windows, clips, fragments)
                # Losses with other edges do not compare.
                best = torch.full_like(best, torch.inf)
            inner = [
                contour_distance(window.edges, contour, c)
                for window, contour, c in zip(windows, contours, clips, strict=True)
            ]
            loss = loss + settings.edges * torch.stack(inner)
        better = loss.detach() < best
        best = torch.where(better, loss.detach(), best)
        best_code = torch.where(better[:, None], code.detach(), best_code)
        if step == settings.steps:
            break
        gradient = torch.autograd.grad(loss.sum(), code)[0]
        with torch.no_grad():
            # Vertices at the near plane can have infinite gradients; one car's must not spoil the others'.
            torch.nan_to_num_(gradient, nan=0.0, posinf=0.0, neginf=0.0)
            # Adam (Kingma and Ba 2015) by hand: importing torch's optimisers takes longer than this whole fit.
            mean.lerp_(gradient, 1 - _ADAM[0])
            square.lerp_(gradient.square(), 1 - _ADAM[1])
            scale = (square / (1 - _ADAM[1] ** (step + 1))).sqrt() + 1e-8
            code -= settings.rate * mean / (1 - _ADAM[0] ** (step + 1)) / scale
            code.clamp_(-bound / spread, bound / spread)
    return [_apply_change(p, c, modes) for p, c in zip(whole, best_code * spread, strict=True)]


def _with_coarse_meshes(placements: Sequence[Placement]) -> list[Placement]:
    """The placements with the meshes' level of detail for windows."""
    return [replace(p, mesh=level_of_detail(p.mesh, _DETAIL_PX)) for p in placements]


def measure_edge_distances(
    placements: Sequence[Placement],
    unknown: Mask,
    picture: NDArray[np.uint8],
    camera: Camera,
    backend: verbs.Backend = "warp",
) -> list[float]:
    """Distance of each mesh's visible edges from the photograph's, to compare meshes at one place.

    Args:
        placements: N placed meshes.
        unknown: Pixels (H, W) of nearer objects.
        picture: The photograph (H, W, 3) RGB.
        camera: Its camera.
        backend: Of the rasteriser.

    Returns:
        N distances in [0, 1]; 1 for a mesh that is not visible.
    """
    covered = np.logical_or.reduce(render_silhouettes(placements, camera, backend))
    if not covered.any():
        return [1.0] * len(placements)
    windows = [_make_window(covered, unknown, covered, picture)] * len(placements)
    placements = _with_coarse_meshes(placements)
    height, width = windows[0].known.shape
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, width, height]] * len(placements)))
    clip, faces, vertex_ranges, face_ranges = _pack_meshes(placements, windows[0].zoom @ camera.matrix)
    fragments = verbs.rasterize(clip, faces, face_ranges, layout, backend)
    clips = [clip[start:end] for start, end in vertex_ranges.tolist()]
    contours = _trace_contours(placements, windows, clips, fragments)
    return [
        float(contour_distance(window.edges, contour, clip)) if len(contour.channel) else 1.0
        for window, contour, clip in zip(windows, contours, clips, strict=True)
    ]


def _trace_contours(
    placements: Sequence[Placement],
    windows: Sequence[_FitWindow],
    clips: Sequence[Tensor],
    fragments: verbs.Fragments,
) -> list[VisibleContour]:
    """The visible edges of each placed mesh in its window."""
    contours = []
    spans = fragments.layout.spans()
    start = 0
    for placement, window, clip, (span, shape) in zip(placements, windows, clips, spans, strict=True):
        mesh = placement.mesh
        face = fragments.face[span].reshape(shape).long()
        face = torch.where(face >= 0, face - start, face)
        depth = fragments.depth[span].reshape(shape)
        contours.append(trace_contour(face, depth, clip, mesh.faces, mesh.part, window.known))
        start += len(mesh.faces)
    return contours


def _box_distances(clip: Tensor, box_xyxy: Tensor, window: _FitWindow) -> Tensor:
    """Squared distances (4,) of a mesh's extent from a label's box on each side, in units of the band."""
    # Points beyond the image's border are in no box; points nearer than half a metre project anywhere.
    pixels = clip[:, :2] / clip[:, 2:].clamp(min=0.5)
    visible = ((pixels >= window.frame[:2]) & (pixels <= window.frame[2:])).all(1) & (clip[:, 2] > 0.5)
    if not bool(visible.any()):
        return box_xyxy.new_zeros(4)
    extremes = torch.cat([pixels[visible].amin(0), pixels[visible].amax(0)])
    scale = window.zoom.diagonal()[:2].repeat(2)
    offset = window.zoom[:2, 2].repeat(2)
    band = _BAND * max(window.pull.shape)
    return (((extremes - (box_xyxy * scale + offset)) / band).clamp(-3, 3)) ** 2


@dataclass(frozen=True, slots=True)
class _FitWindow:
    """The part of the photograph in which one outline is fitted, resized."""

    pull: NDArray[np.float32]
    """(h, w) in [-2, 1], signed distance to the mask over the band, 0 where unknown."""
    length: float
    """Perimeter of the window, px."""
    zoom: Tensor
    """(3, 3), image pixels to window pixels."""
    frame: Tensor
    """(4,) px, the image's border xyxy in the window."""
    edges: Tensor
    """(C, h, w), distance to the photograph's edges."""
    known: Mask
    """(h, w), pixels that nothing nearer hides."""


def _make_window(mask: Mask, unknown: Mask, outline: Mask, picture: NDArray[np.uint8] | None) -> _FitWindow:
    height, width = mask.shape
    both = mask | outline
    x0, y0, x1, y1 = mask_bounds(both) if both.any() else (0, 0, 1, 1)
    margin = int(0.15 * max(x1 - x0, y1 - y0)) + 3
    x0, y0, x1, y1 = max(x0 - margin, 0), max(y0 - margin, 0), min(x1 + margin, width), min(y1 + margin, height)
    scale = min(_WORK_PX / max(x1 - x0, y1 - y0), 4.0)
    size = (max(round((x1 - x0) * scale), 1), max(round((y1 - y0) * scale), 1))
    inner = mask[y0:y1, x0:x1]
    # Hidden pixels next to the mask belong to neither side: distances are to pixels that are certainly not the
    # car.
    visible = ~unknown[y0:y1, x0:x1]
    to_car = cv2.distanceTransform((~inner).astype(np.uint8), cv2.DIST_L2, 5)
    to_rest = cv2.distanceTransform((inner | ~visible).astype(np.uint8), cv2.DIST_L2, 5)
    to_car = np.where(inner.any(), to_car, max(size))
    to_rest = np.where((~inner & visible).any(), to_rest, max(size))
    signed = np.where(inner, 0.5 - to_rest, to_car - 0.5) * scale
    band = _BAND * max(size)
    pull = np.clip(signed / band, -1, 1) * visible
    # A piece of car outside the mesh tears off when the car turns; a piece of road inside it only moves along.
    pull = np.where(pull < 0, _MISSED_WEIGHT * pull, pull)
    zoom = torch.tensor(
        [
            [size[0] / (x1 - x0), 0.0, (0.5 - x0) * size[0] / (x1 - x0) - 0.5],
            [0.0, size[1] / (y1 - y0), (0.5 - y0) * size[1] / (y1 - y0) - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    resized = cv2.resize(
        pull.astype(np.float32), size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    )
    corners = torch.tensor([[0.0, 0.0, 1.0], [width - 1.0, height - 1.0, 1.0]]) @ zoom.T
    known = cv2.resize(visible.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).reshape(size[::-1]) > 0
    edges = torch.zeros(0)
    if picture is not None:
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        crop = cv2.resize(picture[y0:y1, x0:x1], size, interpolation=method)
        edges = compute_edge_field(np.asarray(crop, np.uint8).reshape(*size[::-1], 3), grow_mask(~known, 1))
    return _FitWindow(
        np.asarray(resized, np.float32).reshape(size[::-1]),
        2.0 * (size[0] + size[1]),
        zoom,
        corners[:, :2].reshape(4),
        edges,
        known,
    )


def _pack_meshes(placements: Sequence[Placement], matrix: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Clip coordinates, faces, vertex ranges (N, 2) and face ranges (N, 2) of all placements in one draw."""
    clips, faces, vertex_ranges, face_ranges = [], [], [], []
    vertex = face = 0
    for placement in placements:
        mesh = placement.mesh
        clips.append(to_clip(placement.vertices(), matrix))
        faces.append(mesh.faces + vertex)
        vertex_ranges.append([vertex, vertex + len(mesh.vertices)])
        face_ranges.append([face, face + len(mesh.faces)])
        vertex, face = vertex_ranges[-1][1], face_ranges[-1][1]
    return torch.cat(clips), torch.cat(faces), torch.tensor(vertex_ranges), torch.tensor(face_ranges)


def _deformation_modes() -> Tensor:
    """Symmetric deformations (K, 64, 3) that turn one car's outline into another's; the lowest layer stays
    level.
    """
    modes = []

    def grid() -> Tensor:
        modes.append(torch.zeros(*LATTICE, 3))
        return modes[-1]

    across = torch.linspace(-1.0, 1.0, LATTICE[2])
    for station in range(LATTICE[0]):
        grid()[station, 0, :, 1] = 1.0  # roof up and down along the length
    for station in (1, 2):
        grid()[station, :2, :, 0] = 1.0  # cabin forward and back, longer and shorter
    grid()[:, 0, :, 2] = across  # roof broader
    grid()[:, 1:3, :, 2] = across  # waist broader
    for station in (0, 3):
        grid()[station, :, :, 2] = across  # rear and front broader
        grid()[station, 2, :, 0] = 1.0  # bumpers out
    shaped = torch.stack(modes).reshape(-1, LATTICE_POINTS, 3)
    free = lattice.from_symmetric(torch.eye(lattice.SYMMETRIC_DIM)).reshape(-1, *LATTICE, 3)
    lifts = free[:, :, -1, :, 1].abs().sum((1, 2)) > 0
    return torch.cat([shaped, _FREE_MODE_SCALE * free[~lifts].reshape(-1, LATTICE_POINTS, 3)])


def _code_scales(settings: FitSettings, modes: int) -> tuple[Tensor, Tensor]:
    """Standard deviations and bounds of x, z, y (m), yaw (rad), log length, height, width, and the modes."""
    shift, turn, stretch = settings.max_shift_m, settings.max_turn_rad, settings.max_stretch
    bound = [shift, shift, shift / 3, turn, stretch, stretch, stretch, *[settings.max_offset] * modes]
    spread = torch.tensor(bound) / 2
    spread[7:] = settings.max_offset / 3
    return spread, torch.tensor(bound)


def _apply_change(placement: Placement, change: Tensor, modes: Tensor) -> Placement:
    """The placement after a change of pose, size and shape, in the order of `_units`."""
    return replace(
        placement,
        translation=placement.translation + torch.stack([change[0], change[2], change[1]]),
        yaw=placement.yaw + change[3],
        size_lhw=placement.size_lhw * torch.exp(change[4:7]),
        ffd=placement.ffd + torch.einsum("k,kpc->pc", change[7:], modes),
    )


def place_mesh(mesh: str | Mesh, translation: Tensor, yaw: Tensor, size_lhw: Tensor) -> Placement:
    """Place a mesh by a label.

    Args:
        mesh: A mesh, or a template kind for its canonical template.
        translation: Bottom-face centre (3,) m.
        yaw: () rad.
        size_lhw: Length, height, width (3,) m.

    Returns:
        The placement, undeformed.
    """
    shape = template(mesh) if isinstance(mesh, str) else mesh
    return Placement(shape, translation, yaw, size_lhw, torch.zeros(LATTICE_POINTS, 3))


_CHANNELS = 4
"""Number of edge directions; an edge counts for those within `_SAME_DIRECTION_RAD` of its own."""
_SAME_DIRECTION_RAD = 0.6
REACH_PX = 7.0
"""Distance from which an image edge attracts, px of the window."""
_STRONG, _WEAK = 60.0, 25.0
"""Canny's thresholds on the channel that changes most: 8-bit levels per pixel, times 8 by Sobel's weights."""
_BLUR_PX = 1.2
_MOST_POINTS = 600
"""Number of edge points of a car: more change nothing."""


@dataclass(frozen=True, slots=True)
class VisibleContour:
    """P points of a mesh on its visible edges."""

    vertex: Tensor
    """(P, 3) int64, vertices of the face that each point lies on."""
    weight: Tensor
    """(P, 3), barycentric coordinates."""
    offset: Tensor
    """(P, 2) px, from the point to the edge: half a pixel."""
    channel: Tensor
    """(P,) int64, index of the edge's direction."""


def compute_edge_field(picture: NDArray[np.uint8], unknown: NDArray[np.bool_]) -> Tensor:
    """Distance (4, h, w) to the nearest edge of each direction, in units of `REACH_PX` and at most 1.

    `picture` is (h, w, 3) RGB; edges at `unknown` pixels (h, w) do not count.
    """
    blurred = cv2.GaussianBlur(picture, (0, 0), _BLUR_PX)
    dx, dy = (cv2.Sobel(blurred, cv2.CV_16S, *order) for order in ((1, 0), (0, 1)))
    strongest = (np.abs(dx.astype(np.int32)) + np.abs(dy)).argmax(2)[..., None]
    dx, dy = (np.take_along_axis(d, strongest, 2)[..., 0] for d in (dx, dy))
    edges = (cv2.Canny(dx, dy, _WEAK, _STRONG, L2gradient=True) > 0) & ~unknown
    angle = np.arctan2(dy, dx)
    field = []
    for channel in range(_CHANNELS):
        off = np.abs((angle - channel * np.pi / _CHANNELS + np.pi / 2) % np.pi - np.pi / 2)
        empty = ~(edges & (off < _SAME_DIRECTION_RAD))
        far = cv2.distanceTransform(empty.astype(np.uint8), cv2.DIST_L2, 5) if not empty.all() else REACH_PX
        field.append(np.minimum(np.broadcast_to(far, edges.shape) / REACH_PX, 1))
    return torch.from_numpy(np.stack(field).astype(np.float32))


def trace_contour(
    face: Tensor, depth: Tensor, clip: Tensor, faces: Tensor, part: Tensor, known: NDArray[np.bool_]
) -> VisibleContour:
    """Find a mesh's visible edges in a window that it is rasterised into.

    Args:
        face: Triangle (h, w) at each pixel, -1 for none.
        depth: (h, w) m.
        clip: Clip coordinates (V, 3).
        faces: (F, 3) int64.
        part: (F,) int64, a `Part`.
        known: Pixels (h, w) in which edges count.
    """
    hit = (face >= 0).numpy()
    kind = np.where(hit, part[face.clamp(min=0)].numpy(), -1)
    near = np.where(hit, depth.numpy(), np.inf)
    rows, columns, offsets = [], [], []
    for dy, dx in ((0, 1), (1, 0)):
        first = (slice(0, kind.shape[0] - dy), slice(0, kind.shape[1] - dx))
        second = (slice(dy, None), slice(dx, None))
        differ = (kind[first] != kind[second]) & known[first] & known[second]
        for mine, other, sign in ((first, second, 0.5), (second, first, -0.5)):
            # an edge belongs to the nearer surface; between two parts of one surface, to either
            y, x = np.nonzero(differ & (near[mine] < near[other]))
            rows.append(y + (dy if sign < 0 else 0))
            columns.append(x + (dx if sign < 0 else 0))
            offsets.append(np.tile([sign * dx, sign * dy], (len(y), 1)))
    y, x, offset = np.concatenate(rows), np.concatenate(columns), np.concatenate(offsets)
    chosen = np.linspace(0, len(y) - 1, min(len(y), _MOST_POINTS)).astype(int)
    y, x, offset = y[chosen], x[chosen], offset[chosen]
    smooth, point_kind = np.zeros((2, len(y)), np.float32), kind[y, x]
    for value in np.unique(point_kind):
        blurred = cv2.GaussianBlur((kind == value).astype(np.float32), (0, 0), 1.5)
        mine = point_kind == value
        for axis, order in enumerate(((1, 0), (0, 1))):
            smooth[axis, mine] = cv2.Sobel(blurred, cv2.CV_32F, *order)[y[mine], x[mine]]
    angle = np.arctan2(smooth[1], smooth[0])
    channel = np.rint(angle / np.pi * _CHANNELS).astype(np.int64) % _CHANNELS
    vertex = faces[face[torch.from_numpy(y), torch.from_numpy(x)]]
    corners = clip.detach()[vertex].double().transpose(1, 2)
    pixel = torch.from_numpy(np.stack([x, y, np.ones(len(x))], 1)).double()
    # Cramer's rule: the common determinant drops out of the ratio.
    a, b, c = corners.unbind(2)
    share = torch.stack([(pixel * torch.linalg.cross(*two)).sum(1) for two in ((b, c), (c, a), (a, b))], 1)
    share = share / share.sum(1, keepdim=True)
    usable = torch.isfinite(share).all(1) & (share.abs() < 2).all(1)
    return VisibleContour(
        vertex[usable],
        share[usable].float(),
        torch.from_numpy(offset).float()[usable],
        torch.from_numpy(channel)[usable],
    )


def contour_distance(field: Tensor, contour: VisibleContour, clip: Tensor) -> Tensor:
    """Mean distance of a contour from the photograph's edges, differentiable by `clip`.

    Args:
        field: Distances (4, h, w) from `compute_edge_field`.
        contour: The mesh's visible edges.
        clip: Clip coordinates (V, 3) of the mesh's vertices.

    Returns:
        () in [0, 1]; 0 without visible edges.
    """
    if not len(contour.channel):
        return clip.new_zeros(())
    point = (clip[contour.vertex] * contour.weight[..., None]).sum(1)
    pixel = point[:, :2] / point[:, 2:].clamp(min=0.05) + contour.offset
    size = pixel.new_tensor([field.shape[2], field.shape[1]])
    grid = ((2 * pixel + 1) / size - 1)[None, None]
    sampled = F.grid_sample(field[None], grid, padding_mode="border", align_corners=False)[0, :, 0]
    return sampled.gather(0, contour.channel[None]).mean()
