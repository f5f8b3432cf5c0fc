"""From one labelled photograph to a scene whose vehicles can be moved: `derender(frame) -> SceneIR`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender import cutout as cutouts
from scene_ir.derender import depth as depths
from scene_ir.derender import ground_geometry as maps
from scene_ir.derender import icp, shadow, silhouette
from scene_ir.derender import mask_extension as wide
from scene_ir.derender import occluders as front
from scene_ir.derender import paint_mask as paint
from scene_ir.derender import segmentation as segment
from scene_ir.derender import template_choice as stand
from scene_ir.derender.background_fill import BackgroundFill, BackgroundInputs
from scene_ir.derender.cutout import Cutout
from scene_ir.derender.matte import cutout_opacity
from scene_ir.derender.silhouette import Placement
from scene_ir.errors import RangeError, ShapeError
from scene_ir.geometry import height_above_ground, project_boxes, to_clip
from scene_ir.image_filters import channel_max
from scene_ir.raster import verbs
from scene_ir.render.sources import SolveSettings, solve_sources
from scene_ir.types import (
    FOLIAGE_DIM,
    LATTICE_POINTS,
    TEXTURE_DIM,
    WEATHER_DIM,
    Camera,
    Category,
    Crop,
    Environment,
    Frame,
    Labels,
    Mesh,
    Objects,
    SceneIR,
)

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

VEHICLE_CATEGORIES = {"Car": Category.CAR, "Van": Category.CAR, "Truck": Category.TRUCK}
"""Labels that become objects; all others stay in the background. Vans count as cars, as in the paper."""

_FADE = (0.08, 0.45)
"""Opacity up to which the photograph is taken for what is behind a car, and from which on that is all filled."""
_FADE_FRONT = 0.98
"""Opacity of what stands in front from which on a pixel is all of it."""
_OUTLINE_TOLERANCE = 0.015
"""How far the mask of a car that fills its 2D box may lie from its outline, as a fraction of its height."""
_DERIVED_BOX_PX, _DERIVED_BOX_SHARE = 1.0, 0.015
"""How near to the picture of its 3D box, px and share of the height, a label's 2D box is that picture."""
_EDGE_WEIGHT = 0.3
"""Weight in the choice of a template of its edges' distance from the photograph's, against its mask's agreement:
among the templates of one car the former varies about three times as much."""
_UNDERBODY = 0.3
"""Lower part of a car, as a fraction of its height, in which what lies outside the mesh is ground."""


@dataclass(frozen=True, slots=True)
class DerenderSettings:
    """fit: move templates until their outlines meet the masks. min_height_px: smaller vehicles stay background.
    min_iou: below this agreement of mask and template the template's outline is the mask. max_inflation: of the
    halo that carries the matte, as a fraction of the car's height. min_reach_px: how far it reaches at least.
    seed: of the fill's random search. shrink: fill what vehicles hid at one over so much of the photograph's size.
    backend: of the renderer. meshes: a user's, to choose from beside the templates. segmenter: a user's, instead
    of the shipped network. withheld: for each label a kind of template that it may not be, "" for none; empty:
    none for all. known: for each label the vehicle as it stands there, None to find out, and nothing is fitted;
    empty: none is known.
    """

    fit: bool = True
    min_height_px: float = 12.0
    min_iou: float = 0.6
    max_inflation: float = 0.12
    min_reach_px: float = 4.0
    seed: int = 0
    shrink: int = 1
    backend: verbs.Backend = "warp"
    fitting: silhouette.FitSettings = field(default_factory=silhouette.FitSettings)
    meshes: tuple[silhouette.UserMesh, ...] = ()
    segmenter: segment.Segmenter | None = None
    withheld_kinds: tuple[str, ...] = ()
    known_placements: tuple[Placement | None, ...] = ()

    @classmethod
    def fast(cls) -> DerenderSettings:
        """No fit, and fills with half of the detail: what costs much and shows little."""
        return cls(fit=False, shrink=2)


@dataclass(frozen=True, slots=True)
class _VehicleCutout:
    """One car cut out: its label's row, the fitted placement, the mask, what hides it, the placement's outline,
    how well the two agree, and shares of pixels."""

    row: int
    placement: Placement
    mask: Mask
    hidden: Mask
    outline: Mask
    agreement: float
    cutout: Cutout


@dataclass(frozen=True, slots=True)
class _VehicleSegmenter:
    """How vehicles are told from what is around them: by the data set's masks where it has any, else by the
    network. image (H, W, 3); ground (4,): the plane."""

    image: NDArray[np.uint8]
    frame: Frame
    ground: torch.Tensor
    settings: DerenderSettings

    def first_mask(self, row: int, placement: Placement, hidden: Mask) -> tuple[Mask, Mask, Cutout | None]:
        """Pixels (H, W) of a label's vehicle, and of what else stands in front of it; and the first look, where
        one was needed. hidden (H, W): what is known to be in front."""
        if self.frame.masks is not None:
            return (self.frame.masks[row] > 0.5).numpy() & ~hidden, hidden, None
        found = self._coarse_cutouts([placement], hidden)[0]
        outline = silhouette.render_silhouettes([placement], self.frame.camera, self.settings.backend)[0]
        seen = self._clean(row, found, outline, hidden)
        return _visible_mask(seen, hidden), seen.full_map("front", hidden.shape) >= 0.5, found

    def cut_out(
        self, row: int, placement: Placement, outline: Mask, hidden: Mask, told: bool, first: Cutout | None = None
    ) -> _VehicleCutout:
        """A vehicle cut out about its placement. outline (H, W): of it; told: whether it fills its label's box;
        first: the first look with the template at this place, where there was one."""
        if self.frame.masks is not None:
            mask = (self.frame.masks[row] > 0.5).numpy() & ~hidden
            seen = cutouts.cutout_from_mask(self.image, mask, hidden)
        else:
            if first is None:
                # Without a fit the template is at its label already.
                widen = self.settings.fit and not told
                first = self._first_cutout(row, placement, outline, hidden, widen)
            seen = self._clean(row, cutouts.refine_cutouts(self.image, [first])[0], outline, hidden)
            if told:
                seen = _snap_to_outline(outline & ~hidden, seen)
            mask = _visible_mask(seen, hidden)
            front = hidden | (seen.full_map("front", hidden.shape) >= 0.5)
            if silhouette.mask_iou(mask, outline, front) >= self.settings.min_iou:
                hidden = front
            else:
                mask = outline & ~hidden
                seen = cutouts.cutout_from_mask(self.image, mask, hidden)
        return _VehicleCutout(
            row, placement, mask, hidden, outline, silhouette.mask_iou(mask, outline, hidden), seen
        )

    def _coarse_cutouts(self, places: list[Placement], hidden: Mask) -> list[Cutout]:
        """First looks with the template at each of the places."""
        camera, backend = self.frame.camera, self.settings.backend
        hides = [hidden] * len(places)
        return cutouts.cut_out(
            self.image, places, hides, self.ground, camera, backend=backend, refine_borders=False
        )

    def _first_cutout(self, row: int, placement: Placement, outline: Mask, hidden: Mask, widen: bool) -> Cutout:
        """The first look; of a large vehicle another with the template at its label, and what those two and the
        colours tell together."""
        if not (widen and outline.any() and _mask_height(outline) >= wide.MIN_HEIGHT_PX):
            return self._coarse_cutouts([placement], hidden)[0]
        labels, camera = self.frame.labels, self.frame.camera
        assert labels is not None
        pose = labels.translation[row], labels.yaw[row], labels.size_lhw[row]
        labelled = silhouette.place_mesh(placement.mesh, *pose)
        seen, other = self._coarse_cutouts([placement, labelled], hidden)
        if not (seen.visible.size and other.visible.size):
            return seen
        outlines = np.stack([outline, *silhouette.render_silhouettes([labelled], camera, self.settings.backend)])
        allowed = _label_box_mask(labels, row, hidden.shape) & ~hidden
        return wide.extend_mask(self.image, seen, other, outlines.mean(0, dtype=np.float32), allowed)

    def _clean(self, row: int, found: Cutout, outline: Mask, hidden: Mask) -> Cutout:
        """What is likely of a cut-out. outline (H, W): of its placement."""
        labels = self.frame.labels
        assert labels is not None
        seen = cutouts.remove_unlikely_occluders(cutouts.clean_cutout(found), outline, hidden)
        return replace(seen, visible=seen.visible * _label_box_mask(labels, row, hidden.shape)[seen.window])


def _snap_to_outline(outline: Mask, seen: Cutout) -> Cutout:
    """A cut-out whose border lies along the outline (H, W): one that fills its box is right to a pixel or two,
    whatever the colours say."""
    if not outline.any():
        return seen
    apart = _OUTLINE_TOLERANCE * _mask_height(outline)
    far = silhouette.grow_mask(outline, apart + 1)[seen.window]
    inner = silhouette.grow_mask(outline, -apart - 0.7)[seen.window]
    return replace(seen, visible=np.where(inner, 1 - seen.front, seen.visible * far).astype(np.float32))


def _visible_mask(seen: Cutout, hidden: Mask) -> Mask:
    """Pixels (H, W) that show a vehicle more than anything else."""
    return (seen.full_map("visible", hidden.shape) >= 0.5) & ~hidden


_LEAST_SIDE = 16
"""Of a photograph, px: maps are made at an eighth of its size."""
_MOST_LABELS = 500
"""Of a frame: each vehicle takes megabytes and a second."""


def derender(frame: Frame, settings: DerenderSettings | None = None) -> SceneIR:
    """Take a photograph apart into vehicles, their shadows, and what stood behind them.

    frame: with labels; Car, Van and Truck with a 3D pose become objects, in the labels' order. Masks and depth of
    the frame, where given, are used instead of estimates. Raises ShapeError without labels, RangeError for a
    labelled box behind the camera. The unperturbed render of the result is the photograph.
    """
    settings = settings or DerenderSettings()
    if frame.labels is None:
        raise ShapeError(f"frame {frame.identifier}: labels", "labels with 3D boxes", "none")
    labels, camera = frame.labels, frame.camera
    if min(camera.height, camera.width) < _LEAST_SIDE:
        found = f"{camera.width}x{camera.height} px"
        raise RangeError(f"frame {frame.identifier}", f"at least {_LEAST_SIDE}x{_LEAST_SIDE} px", found)
    if len(labels.kind) > _MOST_LABELS:
        expected = f"at most {_MOST_LABELS} labelled objects"
        raise RangeError(f"frame {frame.identifier}: labels", expected, len(labels.kind))
    rows = _vehicle_rows(frame.identifier, labels, camera, settings)
    image = np.ascontiguousarray(frame.photograph.detach().cpu().float().numpy().transpose(1, 2, 0))
    ground = maps.fit_ground(labels, _posed_rows(labels))
    others = [row for row in _posed_rows(labels) if labels.kind[row] not in VEHICLE_CATEGORIES]
    things = front.find_labelled_occluders(_to_uint8(image), frame, rows, others)
    cuts = _cut_out_vehicles(image, frame, rows, settings, things)
    things += _find_unlabelled_occluders(frame, cuts, things, ground)
    things.sort(key=lambda thing: thing.depth_m)
    cuts = _remove_occluders(cuts, things, camera)
    opacities = front.compute_opacities(image, things)
    views = [shadow.view_ground(cut.placement, ground, camera) for cut in cuts]
    cuts = [_without_underbody(cut, view) for cut, view in zip(cuts, views, strict=True)]
    vehicles = np.zeros(image.shape[:2], bool)
    for cut in cuts:
        vehicles |= silhouette.grow_mask(cut.mask, 2)
    horizon = maps.horizon_row(ground, camera)
    seen = segment.apply_frame_classes(
        frame, segment.segment_photograph(image, ground, camera, settings.segmenter)
    )
    road = np.where(vehicles, 0, seen.road).astype(np.float32)
    background, mattes, shadows, sun = _separate_layers(
        image,
        cuts,
        views,
        vehicles,
        road,
        BackgroundInputs(
            horizon,
            ground,
            camera,
            _non_vehicle_boxes(labels, camera),
            sum(opacities, np.zeros(image.shape[:2], np.float32)),
            seen,
        ),
        settings,
    )
    if cuts:
        # What stands behind the vehicles no classes tell.
        behind = segment.segment_photograph(background, ground, camera, settings.segmenter, shrink=settings.shrink)
        seen = segment.apply_frame_classes(frame, behind).merge_inside(
            (channel_max(np.abs(background - image)) > 0), behind
        )
    stood = maps.draw_footprints(labels, _posed_rows(labels), ground, camera)
    ties = depths.DepthConstraints(seen.sky, seen.ground, stood, _min_background_depth(cuts, camera))
    depth = torch.from_numpy(depths.estimate_depth(background, ground, camera, ties))
    if frame.depth is not None:
        # What stands behind the vehicles was never measured: there the estimate stays.
        depth = torch.where(torch.from_numpy(vehicles), depth, frame.depth.float())
    objects, meshes = _make_objects(labels, cuts)
    provenance = dict(frame.provenance) | {"frame": frame.identifier, "derender": "template fit and patch fill"}
    for index, cut in enumerate(cuts):
        provenance[f"objects[{index}].label"] = str(cut.row)
        provenance[f"objects[{index}].mesh"] = cut.placement.mesh.name
        provenance[f"objects[{index}].mask_iou"] = f"{cut.agreement:.3f}"
    picture = torch.from_numpy(np.ascontiguousarray(background.transpose(2, 0, 1)))
    # People, trams, vehicles that could not be taken apart: they stay as they are, and no detection counts there.
    taken = {cut.row for cut in cuts}
    kept = labels.select([row for row in range(len(labels.kind)) if row not in taken])
    scene = SceneIR(
        camera,
        meshes,
        objects,
        _make_environment(seen, ground, sun, vehicles),
        frame.photograph.float(),
        picture,
        depth,
        torch.cat([kept.ignore_xyxy, kept.boxes_xyxy]),
        provenance,
        tuple(
            front.make_occluder(a, thing.depth_m) for a, thing in zip(opacities, things, strict=True) if a.any()
        ),
        other_labels=kept,
    )
    if not cuts:
        return replace(scene, occluders=())  # it would hide nothing, and its colours are solved with vehicles'
    margins = [_reach_px(cut, opacity, settings) for cut, opacity in zip(cuts, mattes, strict=True)]
    solved = solve_sources(
        scene,
        [_crop_nonzero(a[None]) for a in mattes],
        [_crop_nonzero(1 - f.transpose(2, 0, 1), inverted=True) for f in shadows],
        SolveSettings(backend=settings.backend),
        margins,
    )
    return paint.add_paint_regions(solved, settings.backend)


def _to_uint8(image: Array) -> NDArray[np.uint8]:
    """An image (H, W, 3) in [0, 1] with 8 bit."""
    return np.clip(np.rint(image * 255), 0, 255).astype(np.uint8)


def _find_unlabelled_occluders(
    frame: Frame, cuts: list[_VehicleCutout], things: list[front.OccluderMask], ground: torch.Tensor
) -> list[front.OccluderMask]:
    """Things in front of vehicles that no label tells of: by the frame's depth, where it has one."""
    if frame.depth is None or not cuts:
        return []
    known = _union([cut.mask for cut in cuts] + [thing.mask for thing in things], cuts[0].mask.shape)
    if frame.masks is not None:
        known = known | (frame.masks > 0.5).any(dim=0).numpy()
    nearest = [(cut.outline, front.nearest_corner_depth(cut.placement, frame.camera)) for cut in cuts]
    height = height_above_ground(frame.depth, ground, frame.camera.matrix).float().numpy()
    return front.find_measured_occluders(frame.depth.float().numpy(), height, known, nearest)


def _remove_occluders(
    cuts: list[_VehicleCutout], things: list[front.OccluderMask], camera: Camera
) -> list[_VehicleCutout]:
    """The cuts without what stands in front of them. One of which nothing is left stays as it was."""
    found = []
    for cut in cuts:
        depth = float(to_clip(cut.placement.translation.detach()[None], camera.matrix)[0, 2])
        hidden = front.mask_nearer_occluders(things, depth, cut.mask.shape)
        rest = cut.mask & ~hidden
        found.append(replace(cut, mask=rest, unknown=cut.hidden | hidden) if rest.any() else cut)
    return found


def place_vehicles(frame: Frame, settings: DerenderSettings | None = None) -> dict[int, Placement]:
    """Where the vehicles of a photograph are and of what shape, by row of their labels: of `derender` the
    geometric branch alone. Raises as `derender` does."""
    settings = settings or DerenderSettings()
    if frame.labels is None:
        raise ShapeError(f"frame {frame.identifier}: labels", "labels with 3D boxes", "none")
    labels = frame.labels
    rows = _vehicle_rows(frame.identifier, labels, frame.camera, settings)
    image = np.ascontiguousarray(frame.photograph.detach().cpu().float().numpy().transpose(1, 2, 0))
    others = [row for row in _posed_rows(labels) if labels.kind[row] not in VEHICLE_CATEGORIES]
    things = front.find_labelled_occluders(_to_uint8(image), frame, rows, others)
    return {cut.row: cut.placement for cut in _cut_out_vehicles(image, frame, rows, settings, things)}


def _posed_rows(labels: Labels) -> list[int]:
    """Rows whose 3D box is known: KITTI writes -1 for sizes and -1000 for places it does not know."""
    known = (labels.size_lhw > 0).all(1) & (labels.translation[:, 2] > -900)
    return [int(i) for i in known.nonzero()[:, 0]]


def _vehicle_rows(identifier: str, labels: Labels, camera: Camera, settings: DerenderSettings) -> list[int]:
    """Rows of the labels that become objects."""
    rows = [i for i in _posed_rows(labels) if labels.kind[i] in VEHICLE_CATEGORIES]
    boxes = project_boxes(labels.size_lhw[rows], labels.yaw[rows], labels.translation[rows], camera.matrix)
    kept = []
    for row, box in zip(rows, boxes, strict=True):
        if not bool(torch.isfinite(box).all()):
            place = f"frame {identifier}: label {row} ({labels.kind[row]})"
            raise RangeError(place, "a 3D box in front of the camera", labels.translation[row].tolist())
        shown_width = min(float(box[2]), camera.width - 1) - max(float(box[0]), 0)
        shown_height = min(float(box[3]), camera.height - 1) - max(float(box[1]), 0)
        if shown_height >= settings.min_height_px and shown_width >= settings.min_height_px / 2:
            kept.append(row)
    return kept


def _cut_out_vehicles(
    image: Array, frame: Frame, rows: list[int], settings: DerenderSettings, things: list[front.OccluderMask]
) -> list[_VehicleCutout]:
    """Masks and fitted placements, near to far, so that what a nearer car hides is known to be hidden."""
    labels, camera = frame.labels, frame.camera
    assert labels is not None
    bytes_image = _to_uint8(image)
    order = sorted(rows, key=lambda row: (float(labels.translation[row, [0, 2]].norm()), row))
    depth = to_clip(labels.translation, camera.matrix.to(labels.translation))[:, 2].tolist()
    unknown = {row: front.mask_nearer_occluders(things, depth[row], image.shape[:2]) for row in order}
    looks = _VehicleSegmenter(bytes_image, frame, maps.fit_ground(labels, _posed_rows(labels)), settings)
    chosen: list[Placement] = []
    masks: list[Mask] = []
    boxes = _trusted_boxes(labels, rows, camera)
    told = {row: int(np.count_nonzero(boxes.trust[i])) >= 2 for i, row in enumerate(rows)}
    hidden: list[Mask] = []
    kept: list[int] = []
    held: list[bool] = []
    firsts: list[Cutout | None] = []
    outlined: list[Mask] = []
    for row in order:
        options, by_laser = _candidate_placements(frame, labels, row, settings)
        mine = unknown[row] | _union(masks, image.shape[:2])
        box = boxes.select(rows.index(row)) if told[row] else None
        view = stand.ObjectPhotograph(bytes_image, mine, camera, settings.backend)
        if settings.known_placements and settings.known_placements[row] is not None:
            edges = np.zeros(1)
        else:
            options, edges = stand.choose_pose(options, box, view, by_laser)
        outlines = silhouette.render_silhouettes(options, camera, settings.backend)
        likeliest = int(np.argmin(edges))
        if not outlines[likeliest].any():
            continue
        mask, in_front, first = looks.first_mask(row, options[likeliest], mine)
        mine = mine | in_front
        scores = [silhouette.mask_iou(outline, mask, mine) for outline in outlines]
        best = int(np.argmax(np.subtract(scores, _EDGE_WEIGHT * edges)))
        if scores[best] < settings.min_iou:
            mask = outlines[best] & ~mine
        if not mask.any():
            continue
        kept.append(row)
        held.append(by_laser or stand.visible_share(options[best], view) < stand.MIN_VISIBLE_SHARE)
        chosen.append(options[best])
        # Without a fit the template stays where the first look had it.
        firsts.append(None if settings.fit or best != likeliest else first)
        masks.append(mask)
        hidden.append(mine)
        outlined.append(outlines[best])
    if settings.fit and not settings.known_placements:
        reliable, beside = _trusted_boxes(labels, kept, camera), silhouette.FitEvidence(bytes_image, held)
        fitting, backend = settings.fitting, settings.backend
        fitted = silhouette.fit_silhouettes(chosen, masks, hidden, reliable, camera, fitting, backend, beside)
        found = silhouette.render_silhouettes(fitted, camera, backend)
        # The fit may lead a car of which only a corner shows out of sight: that one stays where its label says.
        seen = [outline.any() for outline in found]
        chosen = [after if s else before for before, after, s in zip(chosen, fitted, seen, strict=True)]
        outlined = [after if s else before for before, after, s in zip(outlined, found, seen, strict=True)]
    cuts: list[_VehicleCutout] = []
    for index, row in enumerate(kept):
        mine = unknown[row] | _union([c.mask for c in cuts], image.shape[:2])
        whole = outlined[index] if frame.masks is None else (frame.masks[row] > 0.5).numpy()
        if not (whole & ~mine).any():
            continue
        cut = looks.cut_out(row, chosen[index], outlined[index], mine, told[row], firsts[index])
        if cut.mask.any():
            cuts.append(cut)
    return sorted(cuts, key=lambda cut: cut.row)


def _candidate_placements(
    frame: Frame, labels: Labels, row: int, settings: DerenderSettings
) -> tuple[list[Placement], bool]:
    """The meshes that may stand for a label, where it says or, with enough of a laser's points, where those are;
    and whether it was those."""
    known = settings.known_placements[row] if settings.known_placements else None
    if known is not None:
        return [known], False
    size = labels.size_lhw[row]
    withheld = settings.withheld_kinds[row] if settings.withheld_kinds else ""
    kinds = silhouette.rank_template_kinds(labels.kind[row], size.tolist(), withheld)
    own = silhouette.select_user_meshes(labels.kind[row], size.tolist(), settings.meshes)
    options = [silhouette.place_mesh(m, labels.translation[row], labels.yaw[row], size) for m in (*kinds, *own)]
    if frame.points is None:
        return options, False
    met = [icp.align_to_points(option, frame.points, frame.camera) for option in options]
    found = [placement for placement in met if placement is not None]
    return (found, True) if len(found) == len(options) else (options, False)


def _without_underbody(cut: _VehicleCutout, view: shadow.GroundView) -> _VehicleCutout:
    """The mask without the dark ground between and beside the wheels: that is shadow, and lies on the ground."""
    _, top, _, bottom = silhouette.mask_bounds(cut.outline)
    low = np.arange(cut.outline.shape[0])[:, None] > bottom - _UNDERBODY * (bottom - top)
    beneath = low & (view.distance < 0.4) & ~silhouette.grow_mask(cut.outline, 1.5)
    return replace(cut, mask=cut.mask & ~beneath) if (cut.mask & ~beneath).any() else cut


def _non_vehicle_boxes(labels: Labels, camera: Camera) -> Mask:
    """Pixels (H, W) in the boxes of labelled things that are no vehicles: nothing is copied from there."""
    inside = np.zeros((camera.height, camera.width), bool)
    for kind, box in zip(labels.kind, labels.boxes_xyxy.tolist(), strict=True):
        if kind not in VEHICLE_CATEGORIES:
            x0, y0, x1, y1 = (max(int(side), 0) for side in box)
            inside[y0 : y1 + 2, x0 : x1 + 2] = True
    return inside


def _label_box_mask(labels: Labels, row: int, shape: tuple[int, int]) -> Mask:
    """Pixels inside the label's 2D box and a little around: hand-drawn, it is tight to a few px."""
    x0, y0, x1, y1 = labels.boxes_xyxy[row].tolist()
    slack = 2.0 + 0.02 * (y1 - y0)
    inside = np.zeros(shape, bool)
    inside[max(int(y0 - slack), 0) : int(y1 + slack) + 2, max(int(x0 - slack), 0) : int(x1 + slack) + 2] = True
    return inside


def _trusted_boxes(labels: Labels, rows: list[int], camera: Camera) -> silhouette.LabelBoxes:
    """The labels' boxes; only sides that neither the image's border nor, as far as labelled, anything else
    cuts."""
    xyxy = labels.boxes_xyxy[rows].float()
    limit = xyxy.new_tensor([camera.width - 1, camera.height - 1]).repeat(2)
    inside = (xyxy > 2) & (xyxy < limit - 2)
    whole = project_boxes(labels.size_lhw[rows], labels.yaw[rows], labels.translation[rows], camera.matrix)
    whole = torch.minimum(whole.clamp(min=0), limit)
    slack = _DERIVED_BOX_PX + _DERIVED_BOX_SHARE * (xyxy[:, 3:] - xyxy[:, 1:2])
    same = ((xyxy - whole).abs() < slack).all(1)
    # Drawn from the 3D boxes, as KITTI's are, 2D boxes tell nothing of the outlines but their top: cars are
    # rounder than boxes. That is a habit of a whole data set, so the frame's vehicles vote on it.
    derived = 2 * int(same.sum()) >= len(rows)
    sure = xyxy.new_tensor([0.0, 1.0, 0.0, 0.0] if derived else [1.0, 1.0, 1.0, 1.0])
    return silhouette.LabelBoxes(xyxy, sure * (labels.occlusion[rows] <= 1)[:, None] * inside)


def _union(masks: Sequence[Mask], shape: tuple[int, ...]) -> Mask:
    """Pixels of any of the masks."""
    return np.logical_or.reduce(masks) if masks else np.zeros(shape, bool)


def _mask_height(mask: Mask) -> int:
    """Height, px, of what is not empty."""
    _, top, _, bottom = silhouette.mask_bounds(mask)
    return bottom - top


def _separate_layers(
    image: Array,
    cuts: list[_VehicleCutout],
    views: list[shadow.GroundView],
    vehicles: Mask,
    road: Array,
    surroundings: BackgroundInputs,
    settings: DerenderSettings,
) -> tuple[Array, list[Array], list[Array], torch.Tensor]:
    """Background (H, W, 3) on the photograph's 8-bit grid, mattes (H, W), shadow factors (H, W, 3), sun."""
    if not cuts:
        return image, [], [], maps.default_sun()
    near = np.stack([view.distance for view in views]).min(0)
    in_front = surroundings.occluder_opacity > 0
    behind = lit = BackgroundFill(image, near, surroundings, settings.shrink)
    if settings.shrink > 1:  # light is smooth
        lit = BackgroundFill(image, near, surroundings, 2 * settings.shrink)
    lighting = shadow.estimate_ground_light(image, road, vehicles, views, behind=lit.continue_street)
    sun, shaded = _find_shadows(lighting, cuts, views, vehicles, in_front)
    hole = vehicles.copy()
    for cut, region, view in zip(cuts, shaded, views, strict=True):
        hole |= silhouette.grow_mask(region, 2.5) | silhouette.grow_mask(cut.mask, 4) | (view.distance < 0.2)
    filled = behind.fill_hole(hole, settings.seed)
    mattes = [cutout_opacity(cut.cutout, cut.mask, cut.hidden) for cut in cuts]
    opaque = np.max(mattes, axis=0)
    shadow_share = np.zeros(image.shape[:2], np.float32)
    for region in shaded:
        beyond = cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, 5)
        shadow_share = np.maximum(shadow_share, np.clip(1.25 - beyond / 2.5, 0, 1))
    # Where a matte is thin, most of the pixel is background already: the fill fades into it.
    replaced = np.clip(np.maximum(shadow_share, (opaque - _FADE[0]) / (_FADE[1] - _FADE[0])), 0, 1)[..., None]
    mixed = image + (filled - image) * replaced
    # A shadow only darkens: where the fill is darker than the photograph, the photograph is the background.
    only_shadow = (opaque == 0)[..., None]
    mixed = np.where(only_shadow, np.maximum(mixed, image), mixed)
    # What stands in front is in the background too; only its border lets through what is behind.
    mixed = np.where(surroundings.occluder_opacity[..., None] >= _FADE_FRONT, image, mixed)
    background = np.where(replaced > 0, np.rint(mixed * 255) / 255, image).astype(np.float32)
    owner = np.stack([view.distance for view in views]).argmin(0)
    factors = [
        shadow.shadow_factors(image, background, (shadow_share > 0) & (owner == i) & (opaque < 0.5) & ~in_front)
        for i in range(len(cuts))
    ]
    return background, mattes, factors, sun


def _find_shadows(
    lighting: shadow.GroundLight,
    cuts: list[_VehicleCutout],
    views: list[shadow.GroundView],
    vehicles: Mask,
    in_front: Mask,
) -> tuple[torch.Tensor, list[Mask]]:
    """The direction towards the sun (3,), and the ground (H, W) that each car shades. in_front (H, W): pixels of
    what stands in front of cars."""
    placements = [cut.placement for cut in cuts]
    tight = _union([cut.mask for cut in cuts], vehicles.shape) | in_front
    sun = shadow.estimate_sun(lighting, vehicles | in_front, placements, views, maps.default_sun())
    best: tuple[int, torch.Tensor, list[Mask]] | None = None
    for factor in shadow.STRETCHES:
        lower = shadow.lengthen_shadows(sun, factor)
        allowed = [shadow.reachable_ground(p, view, lower) for p, view in zip(placements, views, strict=True)]
        casts = [shadow.cast_box_shadow(p, view, lower) for p, view in zip(placements, views, strict=True)]
        found, beyond = shadow.find_shadows(lighting, tight, views, allowed, casts)
        if best is None or beyond < shadow.MAX_SPILL_RATIO * best[0]:
            best = beyond, lower, found
        if not best[0]:
            break
    assert best is not None
    return best[1], best[2]


def _make_environment(
    seen: segment.Segmentation, ground: torch.Tensor, sun: torch.Tensor, vehicles: Mask
) -> Environment:
    """Maps of the background; codes 0."""
    # Weather changes the finished picture: a vehicle before the sky is none. Leaves change before it is drawn.
    sky = np.where(vehicles, 0, seen.sky)
    return Environment(
        torch.zeros(WEATHER_DIM),
        torch.zeros(FOLIAGE_DIM),
        sun,
        ground,
        *(torch.from_numpy(np.ascontiguousarray(m, dtype=np.float32)) for m in (sky, seen.foliage, seen.road)),
    )


def _min_background_depth(cuts: list[_VehicleCutout], camera: Camera) -> Array:
    """Depth (H, W) m that what stands behind the vehicles has at least, that of their middle; 0 where none
    stands."""
    middle = np.zeros((camera.height, camera.width), np.float32)
    for cut in cuts:
        place = cut.placement.translation.detach()[None]
        depth = float(to_clip(place, camera.matrix.to(place))[0, 2])
        middle = np.where(cut.outline, np.maximum(middle, np.float32(depth)), middle)
    return middle


def _make_objects(labels: Labels, cuts: list[_VehicleCutout]) -> tuple[Objects, tuple[Mesh, ...]]:
    """The vehicles as placed by the fit, without sources, and the templates they use."""
    meshes: list[Mesh] = []
    index = []
    for cut in cuts:
        known = [m is cut.placement.mesh for m in meshes]
        if not any(known):
            meshes.append(cut.placement.mesh)
            known.append(True)
        index.append(known.index(True))
    rows = [cut.row for cut in cuts]
    count = len(cuts)

    def stacked(name: str, *shape: int) -> torch.Tensor:
        parts = [getattr(cut.placement, name).detach().float() for cut in cuts]
        return torch.stack(parts) if parts else torch.zeros(0, *shape)

    objects = Objects(
        torch.tensor(index, dtype=torch.int64),
        stacked("translation", 3),
        stacked("yaw"),
        stacked("size_lhw", 3),
        stacked("ffd", LATTICE_POINTS, 3),
        torch.zeros(count, TEXTURE_DIM),
        torch.tensor([int(VEHICLE_CATEGORIES[labels.kind[row]]) for row in rows], dtype=torch.int64),
        labels.boxes_xyxy[rows].float(),
        labels.truncation[rows].float(),
        labels.occlusion[rows],
    )
    return objects, tuple(meshes)


def _reach_px(cut: _VehicleCutout, opacity: Array, settings: DerenderSettings) -> float:
    """How far the matte reaches beyond the mesh's outline, px, and a little more; bounded by the car's height."""
    beyond = cv2.distanceTransform((~cut.outline).astype(np.uint8), cv2.DIST_L2, 5)
    limit = settings.max_inflation * _mask_height(cut.outline)
    return float(
        np.clip(beyond[opacity > 0].max(initial=0) + 1.5, settings.min_reach_px, max(limit, settings.min_reach_px))
    )


def _crop_nonzero(values: Array, inverted: bool = False) -> Crop:
    """The part (C, h, w) of a frame (C, H, W) that is not zero; of `inverted` values, one minus it."""
    used = np.asarray((values > 0).any(0))
    x0, y0, x1, y1 = silhouette.mask_bounds(used) if used.any() else (0, 0, 0, 0)
    part = np.ascontiguousarray(values[:, y0:y1, x0:x1], dtype=np.float32)
    return Crop(torch.from_numpy(1 - part if inverted else part), x0, y0)
