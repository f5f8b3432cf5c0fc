"""Placed meshes, their silhouettes, and the fit of silhouettes to vehicle masks.

The fit changes pose, size and a few symmetric modes of the free-form deformation, by gradients through the
project's own rasteriser, until the mesh's outline runs along the mask's border. It stays near the label.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from scene_ir import ffd as lattice
from scene_ir.geometry import place_vertices, to_clip
from scene_ir.meshes.lod import level_of_detail
from scene_ir.meshes.templates import template
from scene_ir.raster import verbs
from scene_ir.types import LATTICE, LATTICE_POINTS, Camera, Mesh, Part

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
    clip, vertex_ranges = _join_vertices([placement.vertices() for placement in placements], camera.matrix)
    faces, face_ranges = _join_faces([placement.mesh for placement in placements])
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
    x0, y0, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return x0, y0, x0 + width, y0 + height


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
    coarse = _MeshBatch.from_placements(placements)
    pull = torch.from_numpy(np.concatenate([w.pull.reshape(-1) / w.length for w in windows]))
    matrices = torch.stack([w.place.zoom @ camera.matrix for w in windows])
    limits = _BoxLimits.from_windows(boxes, windows)
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
    edges: EdgeSamples | None = None
    for step in range(settings.steps + 1):
        clips = coarse.project(code * spread, modes, matrices)
        clip = clips[coarse.valid]
        fragments = verbs.rasterize(clip, coarse.faces, coarse.face_ranges, layout, backend)
        covered = verbs.antialias(fragments, clip, coarse.faces, backend) * pull
        energy = torch.stack([covered[span].sum() for span, _ in layout.spans()])
        box_loss = (limits.distances(clips, coarse.valid) * boxes.trust).sum(1)
        loss = energy + settings.prior * code.square().sum(1) + settings.box * box_loss
        if evidence.picture is not None and settings.edges > 0:
            if edges is None or step % _RETRACE_STEPS == 0:
                edges = _trace_edges(coarse.meshes, windows, clip, fragments)
                # Losses with other edges do not compare.
                best = torch.full_like(best, torch.inf)
            loss = loss + settings.edges * edges.distances(clip)
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
    fitted = zip(*coarse.pose.changed(best_code * spread, modes), strict=True)
    return [Placement(placement.mesh, *parts) for placement, parts in zip(placements, fitted, strict=True)]


class _Poses(NamedTuple):
    """Poses, sizes and shapes of N placed meshes."""

    translation: Tensor
    """(N, 3) m."""
    yaw: Tensor
    """(N,) rad."""
    size_lhw: Tensor
    """(N, 3) m."""
    ffd: Tensor
    """(N, 64, 3)."""

    def changed(self, change: Tensor, modes: Tensor) -> _Poses:
        """After changes (N, K) in the order of `_code_scales`; modes (K - 7, 64, 3)."""
        return _Poses(
            self.translation + change[:, [0, 2, 1]],
            self.yaw + change[:, 3],
            self.size_lhw * torch.exp(change[:, 4:7]),
            self.ffd + (change[:, 7:] @ modes.flatten(1)).unflatten(1, modes.shape[1:]),
        )


@dataclass(frozen=True, slots=True)
class _MeshBatch:
    """Placed meshes at the windows' level of detail, padded to one number of vertices."""

    meshes: tuple[Mesh, ...]
    """N meshes."""
    unit: Tensor
    """(N, V, 3), vertices in the unit box."""
    weights: Tensor
    """(N, V, 64), of the lattice points."""
    valid: Tensor
    """(N, V) bool, vertices that are no padding."""
    faces: Tensor
    """(F, 3) int64, of all meshes, in terms of their valid vertices."""
    face_ranges: Tensor
    """(N, 2)."""
    pose: _Poses
    """Where they are placed."""

    @classmethod
    def from_placements(cls, placements: Sequence[Placement]) -> _MeshBatch:
        meshes = tuple(level_of_detail(p.mesh, _DETAIL_PX) for p in placements)
        unit = pad_sequence([mesh.vertices for mesh in meshes], batch_first=True)
        weights = pad_sequence([lattice.lattice_weights(mesh.vertices) for mesh in meshes], batch_first=True)
        counts = torch.tensor([len(mesh.vertices) for mesh in meshes])
        valid = torch.arange(unit.shape[1]) < counts[:, None]
        faces, face_ranges = _join_faces(meshes)
        names = ("translation", "yaw", "size_lhw", "ffd")
        pose = _Poses(*(torch.stack([getattr(p, name).detach() for p in placements]) for name in names))
        return cls(meshes, unit, weights, valid, faces, face_ranges, pose)

    def project(self, change: Tensor, modes: Tensor, matrices: Tensor) -> Tensor:
        """Clip coordinates (N, V, 3) after changes (N, K), by matrices (N, 3, 4)."""
        pose = self.pose.changed(change, modes)
        deformed = lattice.deform(self.unit, self.weights, pose.ffd)
        points = place_vertices(deformed, pose.size_lhw, pose.yaw, pose.translation)
        return points @ matrices[:, :, :3].transpose(1, 2) + matrices[:, None, :, 3]


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
    placements = [replace(p, mesh=level_of_detail(p.mesh, _DETAIL_PX)) for p in placements]
    vertices = [placement.vertices() for placement in placements]
    clip, vertex_ranges = _join_vertices(vertices, camera.matrix)
    rects = verbs.bounding_rects(clip, vertex_ranges, camera.height, camera.width, margin=0)
    rects = rects[(rects[:, 2:] > rects[:, :2]).all(1)]
    if not len(rects):
        return [1.0] * len(placements)
    x0, y0, x1, y1 = (*rects[:, :2].amin(0).tolist(), *rects[:, 2:].amax(0).tolist())
    window = _Window.around((x0, y0, x1, y1), unknown.shape)
    known = window.nearest(~unknown)
    field = compute_edge_field(window.resize(picture), grow_mask(~known, 1))
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, *window.size_wh]] * len(placements)))
    faces, face_ranges = _join_faces([placement.mesh for placement in placements])
    clip, _ = _join_vertices(vertices, window.zoom @ camera.matrix)
    fragments = verbs.rasterize(clip, faces, face_ranges, layout, backend)
    meshes = [placement.mesh for placement in placements]
    contours = _trace_contours(meshes, [known] * len(meshes), clip, fragments)
    samples = EdgeSamples.from_contours([field] * len(meshes), contours, [len(mesh.vertices) for mesh in meshes])
    return torch.where(samples.count > 0, samples.distances(clip), 1.0).tolist()


def _trace_edges(
    meshes: Sequence[Mesh], windows: Sequence[_FitWindow], clip: Tensor, fragments: verbs.Fragments
) -> EdgeSamples:
    """The visible edges of the meshes, each in its window's field. clip (V, 3): of all vertices."""
    contours = _trace_contours(meshes, [window.known for window in windows], clip, fragments)
    return EdgeSamples.from_contours(
        [window.edges for window in windows], contours, [len(mesh.vertices) for mesh in meshes]
    )


def _trace_contours(
    meshes: Sequence[Mesh], known: Sequence[Mask], clip: Tensor, fragments: verbs.Fragments
) -> list[VisibleContour]:
    """The visible edges of each mesh in its window, with the pixels (h, w) that nothing nearer hides there."""
    contours, face_start, vertex_start = [], 0, 0
    for mesh, pixels, (span, shape) in zip(meshes, known, fragments.layout.spans(), strict=True):
        face = fragments.face[span].reshape(shape).long()
        face = torch.where(face >= 0, face - face_start, face)
        depth = fragments.depth[span].reshape(shape)
        own = clip[vertex_start : vertex_start + len(mesh.vertices)]
        contours.append(trace_contour(face, depth, own, mesh.faces, mesh.part, pixels))
        face_start, vertex_start = face_start + len(mesh.faces), vertex_start + len(mesh.vertices)
    return contours


@dataclass(frozen=True, slots=True)
class _BoxLimits:
    """Where the sides of N labels' 2D boxes lie in the windows."""

    sides: Tensor
    """(N, 4) px of the window, xyxy."""
    frame: Tensor
    """(N, 4) px, the image's border in the window, xyxy."""
    band: Tensor
    """(N, 1) px, unit of the distances."""

    @classmethod
    def from_windows(cls, boxes: LabelBoxes, windows: Sequence[_FitWindow]) -> _BoxLimits:
        zoom = torch.stack([window.place.zoom for window in windows])
        scale, offset = zoom.diagonal(dim1=1, dim2=2)[:, :2].repeat(1, 2), zoom[:, :2, 2].repeat(1, 2)
        band = torch.tensor([[_BAND * max(window.pull.shape)] for window in windows])
        return cls(boxes.xyxy * scale + offset, torch.stack([window.frame for window in windows]), band)

    def distances(self, clip: Tensor, valid: Tensor) -> Tensor:
        """Squared distances (N, 4) of the meshes' extents from the boxes on each side, in units of the band; 0 for a
        mesh out of sight. clip (N, V, 3); valid (N, V): vertices that are no padding.
        """
        # Points beyond the image's border are in no box; points nearer than half a metre project anywhere.
        pixels = clip[..., :2] / clip[..., 2:].clamp(min=0.5)
        inside = ((pixels >= self.frame[:, None, :2]) & (pixels <= self.frame[:, None, 2:])).all(2)
        visible = (inside & (clip[..., 2] > 0.5) & valid)[..., None]
        low, high = (torch.where(visible, pixels, sign * torch.inf) for sign in (1, -1))
        extremes = torch.cat([low.amin(1), high.amax(1)], 1)
        seen = visible.any(1)
        apart = (torch.where(seen, extremes, self.sides) - self.sides) / self.band
        return apart.clamp(-3, 3) ** 2


@dataclass(frozen=True, slots=True)
class _Window:
    """A part of the photograph, resized."""

    part: tuple[slice, slice]
    """Rows and columns of the photograph."""
    size_wh: tuple[int, int]
    """Its size, px."""
    scale: float
    """Pixels of the window per pixel of the photograph."""
    zoom: Tensor
    """(3, 3), image pixels to window pixels."""

    @classmethod
    def around(cls, bounds: tuple[int, int, int, int], shape: tuple[int, ...]) -> _Window:
        """The window around a rectangle x0, y0, x1, y1 of a photograph of a shape (H, W)."""
        x0, y0, x1, y1 = bounds
        margin = int(0.15 * max(x1 - x0, y1 - y0)) + 3
        x0, y0 = max(x0 - margin, 0), max(y0 - margin, 0)
        x1, y1 = min(x1 + margin, shape[1]), min(y1 + margin, shape[0])
        scale = min(_WORK_PX / max(x1 - x0, y1 - y0), 4.0)
        size = (max(round((x1 - x0) * scale), 1), max(round((y1 - y0) * scale), 1))
        across, down = size[0] / (x1 - x0), size[1] / (y1 - y0)
        zoom = [[across, 0.0, (0.5 - x0) * across - 0.5], [0.0, down, (0.5 - y0) * down - 0.5], [0.0, 0.0, 1.0]]
        return cls((slice(y0, y1), slice(x0, x1)), size, scale, torch.tensor(zoom))

    def resize(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The window (h, w, 3) of a photograph (H, W, 3)."""
        method = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_CUBIC
        crop = cv2.resize(picture[self.part], self.size_wh, interpolation=method)
        return np.asarray(crop, np.uint8).reshape(*self.size_wh[::-1], 3)

    def nearest(self, mask: Mask) -> Mask:
        """The window (h, w) of a mask (H, W)."""
        part = mask[self.part].astype(np.uint8)
        return cv2.resize(part, self.size_wh, interpolation=cv2.INTER_NEAREST).reshape(self.size_wh[::-1]) > 0


@dataclass(frozen=True, slots=True)
class _FitWindow:
    """The part of the photograph in which one outline is fitted, resized."""

    pull: NDArray[np.float32]
    """(h, w) in [-2, 1], signed distance to the mask over the band, 0 where unknown."""
    length: float
    """Perimeter of the window, px."""
    place: _Window
    """Where it lies."""
    frame: Tensor
    """(4,) px, the image's border xyxy in the window."""
    edges: Tensor
    """(C, h, w), distance to the photograph's edges."""
    known: Mask
    """(h, w), pixels that nothing nearer hides."""


def _make_window(mask: Mask, unknown: Mask, outline: Mask, picture: NDArray[np.uint8] | None) -> _FitWindow:
    height, width = mask.shape
    both = mask | outline
    window = _Window.around(mask_bounds(both) if both.any() else (0, 0, 1, 1), mask.shape)
    scale, size = window.scale, window.size_wh
    inner, visible = mask[window.part], ~unknown[window.part]
    # Hidden pixels next to the mask belong to neither side: distances are to pixels that are certainly not the
    # car.
    to_car = cv2.distanceTransform((~inner).astype(np.uint8), cv2.DIST_L2, 5)
    to_rest = cv2.distanceTransform((inner | ~visible).astype(np.uint8), cv2.DIST_L2, 5)
    to_car = np.where(inner.any(), to_car, max(size))
    to_rest = np.where((~inner & visible).any(), to_rest, max(size))
    signed = np.where(inner, 0.5 - to_rest, to_car - 0.5) * scale
    band = _BAND * max(size)
    pull = np.clip(signed / band, -1, 1) * visible
    # A piece of car outside the mesh tears off when the car turns; a piece of road inside it only moves along.
    pull = np.where(pull < 0, _MISSED_WEIGHT * pull, pull)
    resized = cv2.resize(
        pull.astype(np.float32), size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    )
    corners = torch.tensor([[0.0, 0.0, 1.0], [width - 1.0, height - 1.0, 1.0]]) @ window.zoom.T
    known, edges = window.nearest(~unknown), torch.zeros(0)
    if picture is not None:
        edges = compute_edge_field(window.resize(picture), grow_mask(~known, 1))
    return _FitWindow(
        np.asarray(resized, np.float32).reshape(size[::-1]),
        2.0 * (size[0] + size[1]),
        window,
        corners[:, :2].reshape(4),
        edges,
        known,
    )


def _join_vertices(vertices: Sequence[Tensor], matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Clip coordinates of all meshes' vertices (V, 3), and each mesh's range of them (N, 2)."""
    ends = torch.tensor([len(part) for part in vertices]).cumsum(0)
    starts = torch.cat([ends.new_zeros(1), ends[:-1]])
    return to_clip(torch.cat(list(vertices)), matrix), torch.stack([starts, ends], 1)


def _join_faces(meshes: Sequence[Mesh]) -> tuple[Tensor, Tensor]:
    """Faces (F, 3) of all meshes in one draw, and each mesh's range of them (N, 2)."""
    faces, ranges, vertex, face = [], [], 0, 0
    for mesh in meshes:
        faces.append(mesh.faces + vertex)
        ranges.append([face, face + len(mesh.faces)])
        vertex, face = vertex + len(mesh.vertices), face + len(mesh.faces)
    return torch.cat(faces), torch.tensor(ranges)


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
    blurred = cv2.GaussianBlur((kind[..., None] == np.arange(len(Part))).astype(np.float32), (0, 0), 1.5)
    dx, dy = (cv2.Sobel(blurred, cv2.CV_32F, *order)[y, x, kind[y, x]] for order in ((1, 0), (0, 1)))
    angle = np.arctan2(dy, dx)
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


@dataclass(frozen=True, slots=True)
class EdgeSamples:
    """Visible edges of N meshes as P points, each in the edge field of its mesh's window."""

    vertex: Tensor
    """(P, 3) int64, vertices of the face that each point lies on."""
    weight: Tensor
    """(P, 3, 1), barycentric coordinates."""
    offset: Tensor
    """(P, 2) px, from the point to the edge."""
    limit: Tensor
    """(P, 2) px, the last column and row of its field."""
    start: Tensor
    """(P,) int64, first value of its field and direction in `values`."""
    mesh: Tensor
    """(P,) int64."""
    count: Tensor
    """(N,), points of each mesh."""
    values: Tensor
    """All fields, flat."""

    @classmethod
    def from_contours(
        cls, fields: Sequence[Tensor], contours: Sequence[VisibleContour], vertices: Sequence[int]
    ) -> EdgeSamples:
        """Join contours.

        Args:
            fields: N distances (4, h, w) from `compute_edge_field`.
            contours: N meshes' visible edges.
            vertices: N numbers of vertices, which follow each other in the clip coordinates.
        """
        counts = torch.tensor([len(contour.channel) for contour in contours])
        first_vertex = torch.tensor([0, *vertices[:-1]]).cumsum(0)
        first_value = torch.tensor([0, *(field.numel() for field in fields[:-1])]).cumsum(0)
        size = torch.tensor([[field.shape[2], field.shape[1]] for field in fields])
        mesh = torch.arange(len(contours)).repeat_interleave(counts)
        channel = torch.cat([contour.channel for contour in contours])
        return cls(
            torch.cat([contour.vertex for contour in contours]) + first_vertex[mesh, None],
            torch.cat([contour.weight for contour in contours])[..., None],
            torch.cat([contour.offset for contour in contours]),
            (size[mesh] - 1).float(),
            first_value[mesh] + channel * size[mesh].prod(1),
            mesh,
            counts.float(),
            torch.cat([field.reshape(-1) for field in fields]),
        )

    def distances(self, clip: Tensor) -> Tensor:
        """Mean distance (N,) in [0, 1] of each mesh from the photograph's edges, differentiable by clip (V, 3); 0
        without visible edges.
        """
        point = (clip[self.vertex] * self.weight).sum(1)
        pixel = point[:, :2] / point[:, 2:].clamp(min=0.05) + self.offset
        pixel = torch.minimum(pixel.clamp(min=0), self.limit)
        corner = pixel.detach().floor()
        x, y = (pixel - corner).unbind(1)
        (left, top), (right, bottom) = (
            at.long().unbind(1) for at in (corner, torch.minimum(corner + 1, self.limit))
        )
        stride = self.limit[:, 0].long() + 1

        def row(line: Tensor) -> Tensor:
            first, second = (self.values[self.start + line * stride + column] for column in (left, right))
            return first + x * (second - first)

        above, below = row(top), row(bottom)
        sampled = above + y * (below - above)
        return clip.new_zeros(len(self.count)).index_add(0, self.mesh, sampled) / self.count.clamp(min=1)
