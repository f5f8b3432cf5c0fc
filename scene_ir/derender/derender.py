"""Turn one labelled photograph into an editable scene: `derender(frame) -> SceneIR`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender import alignment as icp
from scene_ir.derender import alignment as template_choice
from scene_ir.derender import (
    cutout,
    delight,
    depth,
    ego,
    occluders,
    paint_mask,
    people,
    segmentation,
    shadow,
    silhouette,
)
from scene_ir.derender import depth as ground_geometry
from scene_ir.derender import matte as mask_extension
from scene_ir.derender.background_fill import BackgroundFill, BackgroundInputs
from scene_ir.derender.cutout import Cutout
from scene_ir.derender.matte import cutout_opacity
from scene_ir.derender.occluders import OccluderMask
from scene_ir.derender.silhouette import LabelBoxes, Placement, grow_mask, mask_iou
from scene_ir.errors import RangeError, ShapeError
from scene_ir.geometry import height_above_ground, project_boxes, to_clip
from scene_ir.image_filters import channel_max
from scene_ir.raster import verbs
from scene_ir.render.sources import SolveSettings, solve_sources
from scene_ir.types import (
    CLOTHES_DIM,
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
"""Label types that become vehicles. Vans count as cars, as in the paper."""
_CATEGORIES = VEHICLE_CATEGORIES | people.PEOPLE_CATEGORIES
"""Label types that can become objects; all others stay in the background."""

_MIN_SIDE_PX = 16
"""Smallest side of a photograph: maps are computed at an eighth of its size."""
_MAX_BEHIND_EGO = 0.02
"""Share of a person that the ego vehicle may hide."""
_MAX_LABELS = 500
"""Labels of a frame: each vehicle takes megabytes and a second."""
_FADE = (0.08, 0.45)
"""Opacity of a vehicle up to which the background is the photograph, and from which it is the fill."""
_TRACE_OPACITY = 0.05
"""Least opacity of people where they may be: what of them is in the photograph there is solved for."""
_FADE_OCCLUDER = 0.98
"""Opacity of an occluder from which the background is the photograph."""
_OUTLINE_TOLERANCE = 0.015
"""Largest distance between mask and outline of a car that fills its 2D box, as a fraction of its height."""
_DERIVED_BOX_PX, _DERIVED_BOX_SHARE = 1.0, 0.015
"""A 2D box closer to its projected 3D box than this, px plus a share of its height, was derived from it."""
_EDGE_WEIGHT = 0.3
"""Weight of edge distances against mask agreement in the choice of a template: among the templates of one car they
vary about three times as much."""
_UNDERBODY = 0.3
"""Lower part of a car, as a fraction of its height, in which pixels outside the mesh are ground."""


@dataclass(frozen=True, slots=True)
class DerenderSettings:
    """Options of de-rendering."""

    fit: bool = True
    """Fit templates to the masks; otherwise they stay at their labels."""
    min_height_px: float = 12.0
    """Lower vehicles stay in the background, px."""
    min_fit_px: float = 25.0
    """Vehicles with a lower 2D box, px, are placed by it and not fitted: they are too low to be evaluated."""
    min_iou: float = 0.6
    """Agreement of mask and template below which the template's outline is the mask."""
    max_inflation: float = 0.12
    """Largest margin of the matte around the mesh, as a fraction of the vehicle's height."""
    min_reach_px: float = 4.0
    """Smallest margin of the matte around the mesh, px."""
    seed: int = 0
    """Seed of the background fill's random search."""
    shrink: int = 1
    """Fill the background at one over this size of the photograph."""
    backend: verbs.Backend = "warp"
    """Of the rasteriser."""
    fitting: silhouette.FitSettings = field(default_factory=silhouette.FitSettings)
    """Of the silhouette fit."""
    meshes: tuple[silhouette.UserMesh, ...] = ()
    """A user's meshes to choose from besides the templates."""
    segmenter: segmentation.Segmenter | None = None
    """A user's segmenter in place of the shipped network."""
    people: bool = False
    """Make objects of people and cyclists too, where they can be cut out whole."""
    withheld_kinds: tuple[str, ...] = ()
    """For each label a template kind that it may not be, "" for none; empty for no restrictions."""
    known_placements: tuple[Placement | None, ...] = ()
    """For each label its placement if known, else None; nothing is fitted then. Empty if none is known."""

    @classmethod
    def fast(cls) -> DerenderSettings:
        """Without the fit, and with a background fill at half size: three times as fast, with little
        visible loss.
        """
        return cls(fit=False, shrink=2)


@dataclass(frozen=True, slots=True)
class _VehicleCutout:
    """One vehicle or person cut out of the photograph."""

    row: int
    """Row of its label."""
    placement: Placement
    mask: Mask
    """(H, W), its visible pixels."""
    hidden: Mask
    """(H, W), pixels of nearer objects."""
    outline: Mask
    """(H, W), pixels of the placed mesh."""
    agreement: float
    """IoU of mask and outline."""
    cutout: Cutout
    """Shares of pixels."""
    reach: Mask | None = None
    """(H, W), of people: pixels that leave with them."""


def derender(frame: Frame, settings: DerenderSettings | None = None) -> SceneIR:
    """Separate a photograph into vehicles, their shadows and the background behind them.

    Cars, vans and trucks with a 3D box become objects, in the labels' order; with `settings.people` also pedestrians
    and cyclists that can be cut out whole. Masks and depth of the frame replace
    estimates. The unperturbed render of the scene is the photograph. Raises ShapeError without labels, RangeError
    for a labelled box behind the camera, a tiny photograph or too many labels.
    """
    settings = settings or DerenderSettings()
    labels, rows = _check_frame(frame, settings)
    camera, image = frame.camera, _frame_image(frame)
    ground = ground_geometry.fit_ground(labels, _posed_rows(labels))

    # Vehicles and people, and what stands in front of them.
    ego_mask = _find_ego_vehicle(frame, image)
    rows = [rows[i] for i in ego.boxes_outside(ego_mask, labels.boxes_xyxy[rows])]
    persons, left_out = _cut_out_people(frame, image, ground, settings, ego_mask)
    occluder_masks = _find_labelled_occluders(frame, image, rows, ego_mask, persons)
    in_front = occluder_masks + [OccluderMask(p.mask, _depth_m(p.placement, camera)) for p in persons]
    cuts = _cut_out_vehicles(image, frame, rows, settings, in_front)
    cuts = sorted([*cuts, *_place_people(persons, cuts, settings, camera)], key=lambda cut: cut.row)
    occluder_masks += _find_unlabelled_occluders(frame, cuts, occluder_masks, ground)
    occluder_masks.sort(key=lambda occluder: occluder.depth_m)
    cuts = _remove_occluders(cuts, occluder_masks, camera)
    opacities = occluders.compute_opacities(image, occluder_masks)
    ego_opacity = opacities[0] if ego_mask is not None else np.zeros(image.shape[:2], np.float32)
    views = [shadow.view_ground(cut.placement, ground, camera) for cut in cuts]
    cuts = [_remove_underbody(cut, view) for cut, view in zip(cuts, views, strict=True)]
    vehicles = _union([grow_mask(cut.mask, 2) for cut in cuts], image.shape[:2])

    # Background, mattes and shadows.
    maps = segmentation.segment_photograph(image, ground, camera, settings.segmenter)
    maps = segmentation.apply_frame_classes(frame, maps).outside(ego_opacity)
    staying = sorted(set(range(len(labels.kind))) - {cut.row for cut in cuts})
    inputs = BackgroundInputs(
        ground_geometry.horizon_row(ground, camera),
        ground,
        camera,
        _boxes_of(labels, camera, [row for row in staying if labels.kind[row] not in VEHICLE_CATEGORIES])
        | (ego_opacity > 0),
        _boxes_of(labels, camera, [row for row in staying if labels.kind[row] in people.PEOPLE_KINDS]),
        sum(opacities, np.zeros(image.shape[:2], np.float32)),
        maps,
    )
    background, mattes, shadows, sun = _separate_layers(image, cuts, views, vehicles, inputs, settings)

    # Maps and depth of the background.
    if cuts:
        # The frame's classes do not cover what stands behind the vehicles.
        shrink = 2 * settings.shrink  # what stands behind is a guess
        behind = segmentation.segment_photograph(background, ground, camera, settings.segmenter, shrink)
        filled = channel_max(np.abs(background - image)) > 0
        maps = segmentation.apply_frame_classes(frame, behind).merge_inside(filled, behind).outside(ego_opacity)
    footprints = ground_geometry.draw_footprints(labels, _posed_rows(labels), ground, camera)
    constraints = depth.DepthConstraints(maps.sky, maps.ground, footprints, _min_background_depth(cuts, camera))
    depth_m = torch.from_numpy(depth.estimate_depth(background, ground, camera, constraints))
    if frame.depth is not None:
        # The frame's depth was not measured behind the vehicles: the estimate stays there.
        depth_m = torch.where(torch.from_numpy(vehicles), depth_m, frame.depth.float())

    # The scene.
    objects, meshes = _make_objects(labels, cuts, CLOTHES_DIM if settings.people else TEXTURE_DIM)
    provenance = dict(frame.provenance) | {"frame": frame.identifier, "derender": "template fit and patch fill"}
    for index, cut in enumerate(cuts):
        provenance[f"objects[{index}].label"] = str(cut.row)
        provenance[f"objects[{index}].mesh"] = cut.placement.mesh.name
        provenance[f"objects[{index}].mask_iou"] = f"{cut.agreement:.3f}"
    provenance |= {f"labels[{row}].background": reason for row, reason in left_out.items()}
    # People, trams and vehicles that were not cut out stay in the background, and no detection counts there.
    _, ridden = people.join_riders(labels)
    object_rows = {cut.row for cut in cuts}
    object_rows |= {ridden[row] for row in object_rows & ridden.keys()}
    other_labels = labels.select([row for row in range(len(labels.kind)) if row not in object_rows])
    if ego_mask is not None:
        regions = torch.cat([other_labels.ignore_xyxy, ego.ignored_regions(ego_mask).to(other_labels.ignore_xyxy)])
        other_labels = replace(other_labels, ignore_xyxy=regions)
    pictures = (background, frame.photograph.float().permute(1, 2, 0).numpy())
    closed_sky = torch.stack([delight.estimate_closed_sky(picture, ground, camera) for picture in pictures])
    scene = SceneIR(
        camera,
        meshes,
        objects,
        _make_environment(maps, ground, sun, vehicles, closed_sky, ego_opacity),
        frame.photograph.float(),
        torch.from_numpy(np.ascontiguousarray(background.transpose(2, 0, 1))),
        depth_m,
        torch.cat([other_labels.ignore_xyxy, other_labels.boxes_xyxy]),
        provenance,
        tuple(
            occluders.make_occluder(opacity, occluder.depth_m)
            for opacity, occluder in zip(opacities, occluder_masks, strict=True)
            if opacity.any()
        ),
        other_labels=other_labels,
    )
    if not cuts:
        return replace(scene, occluders=())  # they would hide nothing, and their colours are solved with vehicles'
    solved = solve_sources(
        scene,
        [_crop_nonzero(matte[None]) for matte in mattes],
        shadows,
        SolveSettings(backend=settings.backend),
        [_matte_reach_px(cut, opacity, settings) for cut, opacity in zip(cuts, mattes, strict=True)],
    )
    return paint_mask.add_paint_regions(solved, settings.backend)


def place_vehicles(frame: Frame, settings: DerenderSettings | None = None) -> dict[int, Placement]:
    """Fitted placements of a photograph's vehicles, by row of their labels: the geometric part of `derender`."""
    settings = settings or DerenderSettings()
    labels, rows = _check_frame(frame, settings)
    image = _frame_image(frame)
    ego_mask = _find_ego_vehicle(frame, image)
    rows = [rows[i] for i in ego.boxes_outside(ego_mask, labels.boxes_xyxy[rows])]
    occluder_masks = _find_labelled_occluders(frame, image, rows, ego_mask)
    return {cut.row: cut.placement for cut in _cut_out_vehicles(image, frame, rows, settings, occluder_masks)}


def _check_frame(frame: Frame, settings: DerenderSettings) -> tuple[Labels, list[int]]:
    """The frame's labels, and the rows that become objects."""
    where, camera = f"frame {frame.identifier}", frame.camera
    if frame.labels is None:
        raise ShapeError(f"{where}: labels", "labels with 3D boxes", "none")
    if min(camera.height, camera.width) < _MIN_SIDE_PX:
        found = f"{camera.width}x{camera.height} px"
        raise RangeError(where, f"at least {_MIN_SIDE_PX}x{_MIN_SIDE_PX} px", found)
    if len(frame.labels.kind) > _MAX_LABELS:
        raise RangeError(f"{where}: labels", f"at most {_MAX_LABELS} labelled objects", len(frame.labels.kind))
    return frame.labels, _vehicle_rows(where, frame.labels, camera, settings)


def _vehicle_rows(where: str, labels: Labels, camera: Camera, settings: DerenderSettings) -> list[int]:
    """Rows of the labels that become objects: vehicles that are large enough."""
    rows = [i for i in _posed_rows(labels) if labels.kind[i] in VEHICLE_CATEGORIES]
    boxes = project_boxes(labels.size_lhw[rows], labels.yaw[rows], labels.translation[rows], camera.matrix)
    large = []
    for row, box in zip(rows, boxes, strict=True):
        if not bool(torch.isfinite(box).all()):
            label = f"{where}: label {row} ({labels.kind[row]})"
            raise RangeError(label, "a 3D box in front of the camera", labels.translation[row].tolist())
        width = min(float(box[2]), camera.width - 1) - max(float(box[0]), 0)
        height = min(float(box[3]), camera.height - 1) - max(float(box[1]), 0)
        if height >= settings.min_height_px and width >= settings.min_height_px / 2:
            large.append(row)
    return large


def _posed_rows(labels: Labels) -> list[int]:
    """Rows with a known 3D box: KITTI writes -1 for unknown sizes and -1000 for unknown positions."""
    known = (labels.size_lhw > 0).all(1) & (labels.translation[:, 2] > -900)
    return [int(i) for i in known.nonzero()[:, 0]]


def _frame_image(frame: Frame) -> Array:
    """The photograph (H, W, 3)."""
    return np.ascontiguousarray(frame.photograph.detach().cpu().float().numpy().transpose(1, 2, 0))


def _to_uint8(image: Array) -> NDArray[np.uint8]:
    """An image (H, W, 3) in [0, 1] with 8 bits."""
    return np.clip(np.rint(image * 255), 0, 255).astype(np.uint8)


def _find_ego_vehicle(frame: Frame, image: Array) -> Mask | None:
    """Pixels (H, W) of the ego vehicle, by the frame's classes or the network; None if there are none."""
    if frame.classes is None:
        return ego.find_ego_vehicle(image)
    numbers = [i for i, name in enumerate(frame.class_names) if name.strip().lower() == ego.CLASS_NAME]
    mask = np.isin(frame.classes.numpy(), numbers)
    return mask if mask.any() else None


def _find_labelled_occluders(
    frame: Frame,
    image: Array,
    rows: list[int],
    ego_mask: Mask | None,
    persons: Sequence[people.PersonCutout] = (),
) -> list[OccluderMask]:
    """The ego vehicle, if it is visible, then people and the like in front of objects, by their labels; without
    `persons`, which are objects, and without the pixels of those who stand nearer.
    """
    labels = frame.labels
    assert labels is not None
    cut_out = [person.row for person in persons]
    unmoved = set(_posed_rows(labels)).difference(cut_out)
    others = [row for row in sorted(unmoved) if labels.kind[row] not in VEHICLE_CATEGORIES]
    labelled = occluders.find_labelled_occluders(_to_uint8(image), frame, [*rows, *cut_out], others)
    nearer = [(person.mask, _depth_m(person.placement, frame.camera)) for person in persons]
    found = [] if ego_mask is None else [OccluderMask(ego_mask, ego.DEPTH_M)]
    for occluder in labelled:
        taken = [other.mask for other in found[:1] if ego_mask is not None]
        taken += [mask for mask, depth_m in nearer if depth_m < occluder.depth_m]
        rest = occluder.mask & ~_union(taken, occluder.mask.shape)
        if rest.any():
            found.append(replace(occluder, mask=rest))
    return found


def _find_unlabelled_occluders(
    frame: Frame, cuts: list[_VehicleCutout], occluder_masks: list[OccluderMask], ground: torch.Tensor
) -> list[OccluderMask]:
    """Unlabelled objects in front of vehicles, if the frame has depth."""
    if frame.depth is None or not cuts:
        return []
    known = _union([cut.mask for cut in cuts] + [occluder.mask for occluder in occluder_masks], cuts[0].mask.shape)
    if frame.masks is not None:
        known = known | (frame.masks > 0.5).any(dim=0).numpy()
    nearest = [(cut.outline, occluders.nearest_corner_depth(cut.placement, frame.camera)) for cut in cuts]
    height = height_above_ground(frame.depth, ground, frame.camera.matrix).float().numpy()
    return occluders.find_measured_occluders(frame.depth.float().numpy(), height, known, nearest)


def _cut_out_people(
    frame: Frame, image: Array, ground: torch.Tensor, settings: DerenderSettings, ego_mask: Mask | None
) -> tuple[list[people.PersonCutout], dict[int, str]]:
    """The people that become objects, if any may, and by row why others stay in the background."""
    if not settings.people or frame.labels is None:
        return [], {}
    rows = _posed_rows(frame.labels)
    persons, reasons = people.cut_out_people(_to_uint8(image), frame, rows, ground, settings.backend)
    if ego_mask is not None:
        behind = [p.row for p in persons if np.mean(ego_mask[p.mask]) > _MAX_BEHIND_EGO]
        reasons |= dict.fromkeys(behind, "behind the ego vehicle")
    return [person for person in persons if person.row not in reasons], reasons


def _place_people(
    persons: list[people.PersonCutout], vehicles: list[_VehicleCutout], settings: DerenderSettings, camera: Camera
) -> list[_VehicleCutout]:
    """People without the pixels of nearer vehicles."""
    outlines = silhouette.render_silhouettes([p.placement for p in persons], camera, settings.backend)
    placed = []
    for person, outline in zip(persons, outlines, strict=True):
        own = _depth_m(person.placement, camera)
        hidden = _union([c.mask for c in vehicles if _depth_m(c.placement, camera) < own], outline.shape)
        mask = person.mask & ~hidden
        if mask.any():
            agreement = mask_iou(mask, outline, hidden)
            parts = (mask, hidden, outline, agreement, person.cutout, person.reach & ~hidden)
            placed.append(_VehicleCutout(person.row, person.placement, *parts))
    return placed


def _depth_m(placement: Placement, camera: Camera) -> float:
    """Depth of an object along the optical axis, m."""
    place = placement.translation.detach()[None]
    return float(to_clip(place, camera.matrix.to(place))[0, 2])


def _cut_out_vehicles(
    image: Array, frame: Frame, rows: list[int], settings: DerenderSettings, occluder_masks: list[OccluderMask]
) -> list[_VehicleCutout]:
    """Masks and fitted placements, from near to far, so that pixels hidden by nearer vehicles are known."""
    labels, camera, shape = frame.labels, frame.camera, image.shape[:2]
    assert labels is not None
    picture = _to_uint8(image)
    order = sorted(rows, key=lambda row: (float(labels.translation[row, [0, 2]].norm()), row))
    depths = to_clip(labels.translation, camera.matrix.to(labels.translation))[:, 2].tolist()
    occluded = {row: occluders.mask_nearer_occluders(occluder_masks, depths[row], shape) for row in order}
    ground = ground_geometry.fit_ground(labels, _posed_rows(labels))
    segmenter = _VehicleSegmenter(picture, frame, ground, settings)
    boxes = _trusted_boxes(labels, rows, camera)
    fills_box = {row: int(np.count_nonzero(boxes.trust[i])) >= 2 for i, row in enumerate(rows)}
    heights = (labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]).tolist()
    fitted_rows = {row for row in order if settings.fit and heights[row] >= settings.min_fit_px}
    drafts: list[_DraftCutout] = []
    for row in order:
        hidden = occluded[row] | _union([draft.mask for draft in drafts], shape)
        box = boxes.select(rows.index(row)) if fills_box[row] else None
        photograph = template_choice.ObjectPhotograph(picture, hidden, camera, settings.backend)
        draft = _draft_cutout(row, frame, box, photograph, segmenter, row in fitted_rows)
        if draft is not None:
            drafts.append(draft)
    tall = [draft for draft in drafts if draft.row in fitted_rows]
    if tall and not settings.known_placements:
        tall = _fit_drafts(tall, picture, _trusted_boxes(labels, [d.row for d in tall], camera), segmenter)
        drafts = [*tall, *(draft for draft in drafts if draft.row not in fitted_rows)]
        drafts.sort(key=lambda draft: order.index(draft.row))
    cuts: list[_VehicleCutout] = []
    for draft in drafts:
        hidden = occluded[draft.row] | _union([cut.mask for cut in cuts], shape)
        whole = draft.outline if frame.masks is None else (frame.masks[draft.row] > 0.5).numpy()
        if not (whole & ~hidden).any():
            continue
        cut = segmenter.cut_out(draft, hidden, fills_box[draft.row])
        if cut.mask.any():
            cuts.append(cut)
    return sorted(cuts, key=lambda cut: cut.row)


@dataclass(frozen=True, slots=True)
class _DraftCutout:
    """One vehicle before the fit."""

    row: int
    placement: Placement
    mask: Mask
    hidden: Mask
    outline: Mask
    anchored: bool
    """Whether the fit must leave it nearly in place."""
    first: Cutout | None
    """The first cut-out, if it was made with the template at this placement."""


def _draft_cutout(
    row: int,
    frame: Frame,
    box: LabelBoxes | None,
    photograph: template_choice.ObjectPhotograph,
    segmenter: _VehicleSegmenter,
    is_fitted: bool,
) -> _DraftCutout | None:
    """Choose a label's template and cut it out; None if nothing of it is visible. One that is not fitted later has
    the likeliest template by its label's proportions.
    """
    settings, hidden = segmenter.settings, photograph.hidden
    options, measured = _candidate_placements(frame, row, settings)
    if settings.known_placements and settings.known_placements[row] is not None:
        costs = np.zeros(1)
    elif settings.fit and not is_fitted:
        options, costs = template_choice.align_to_boxes(options[:1], box, frame.camera), np.zeros(1)
    else:
        options, costs = template_choice.choose_pose(options, box, photograph, measured)
    outlines = silhouette.render_silhouettes(options, frame.camera, settings.backend)
    likeliest = int(np.argmin(costs))
    if not outlines[likeliest].any():
        return None
    mask, in_front, first = segmenter.first_mask(row, options[likeliest], hidden)
    hidden = hidden | in_front
    scores = [mask_iou(outline, mask, hidden) for outline in outlines]
    best = int(np.argmax(np.subtract(scores, _EDGE_WEIGHT * costs)))
    if scores[best] < settings.min_iou:
        mask = outlines[best] & ~hidden
    if not mask.any():
        return None
    anchored = measured or photograph.visible_share(options[best]) < template_choice.MIN_VISIBLE_SHARE
    # Without a fit the template stays where the first cut-out had it.
    reused = None if is_fitted or best != likeliest else first
    return _DraftCutout(row, options[best], mask, hidden, outlines[best], anchored, reused)


def _candidate_placements(frame: Frame, row: int, settings: DerenderSettings) -> tuple[list[Placement], bool]:
    """Candidate meshes for a label, at the label or fitted to laser points, and whether they were fitted."""
    labels = frame.labels
    assert labels is not None
    known = settings.known_placements[row] if settings.known_placements else None
    if known is not None:
        return [known], False
    size = labels.size_lhw[row]
    withheld = settings.withheld_kinds[row] if settings.withheld_kinds else ""
    kinds = silhouette.rank_template_kinds(labels.kind[row], size.tolist(), withheld)
    own = silhouette.select_user_meshes(labels.kind[row], size.tolist(), settings.meshes)
    pose = labels.translation[row], labels.yaw[row], size
    options = [silhouette.place_mesh(mesh, *pose) for mesh in (*kinds, *own)]
    if frame.points is None:
        return options, False
    fitted = [icp.align_to_points(option, frame.points, frame.camera) for option in options]
    found = [placement for placement in fitted if placement is not None]
    return (found, True) if len(found) == len(options) else (options, False)


def _fit_drafts(
    drafts: list[_DraftCutout], picture: NDArray[np.uint8], boxes: LabelBoxes, segmenter: _VehicleSegmenter
) -> list[_DraftCutout]:
    """Fit the placements to the masks. A car of which only a corner is visible may leave the image: it stays."""
    settings, camera = segmenter.settings, segmenter.frame.camera
    fitted = silhouette.fit_silhouettes(
        [draft.placement for draft in drafts],
        [draft.mask for draft in drafts],
        [draft.hidden for draft in drafts],
        boxes,
        camera,
        settings.fitting,
        settings.backend,
        silhouette.FitEvidence(picture, [draft.anchored for draft in drafts]),
    )
    outlines = silhouette.render_silhouettes(fitted, camera, settings.backend)
    return [
        replace(draft, placement=placement, outline=outline) if outline.any() else draft
        for draft, placement, outline in zip(drafts, fitted, outlines, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class _VehicleSegmenter:
    """Cuts vehicles out of the photograph: by the data set's masks if there are any, else by the network."""

    picture: NDArray[np.uint8]
    """(H, W, 3) RGB."""
    frame: Frame
    ground: torch.Tensor
    """(4,), plane n.x + d = 0."""
    settings: DerenderSettings

    def first_mask(self, row: int, placement: Placement, hidden: Mask) -> tuple[Mask, Mask, Cutout | None]:
        """Pixels (H, W) of a label's vehicle and of occluders, and the network's cut-out if it was used.

        `hidden` (H, W) are known pixels of nearer objects.
        """
        if self.frame.masks is not None:
            return (self.frame.masks[row] > 0.5).numpy() & ~hidden, hidden, None
        first = self._coarse_cutouts([placement], hidden)[0]
        outline = silhouette.render_silhouettes([placement], self.frame.camera, self.settings.backend)[0]
        cleaned = self._clean(row, first, outline, hidden)
        return _visible_mask(cleaned, hidden), cleaned.full_map("front", hidden.shape) >= 0.5, first

    def cut_out(self, draft: _DraftCutout, hidden: Mask, fills_box: bool) -> _VehicleCutout:
        """Cut out a placed vehicle.

        Args:
            draft: The vehicle with its final placement.
            hidden: Pixels (H, W) of nearer objects.
            fills_box: Whether the placed mesh fills its label's 2D box.

        Returns:
            The vehicle's cut-out.
        """
        row, outline = draft.row, draft.outline
        if self.frame.masks is not None:
            mask = (self.frame.masks[row] > 0.5).numpy() & ~hidden
            shares = cutout.cutout_from_mask(self.picture, mask, hidden)
        else:
            first = draft.first
            if first is None:
                # Without a fit the template is at its label already.
                extend = self.settings.fit and not fills_box
                first = self._first_cutout(draft, hidden, extend)
            shares = self._clean(row, cutout.refine_cutouts(self.picture, [first])[0], outline, hidden)
            if fills_box:
                shares = _snap_to_outline(outline & ~hidden, shares)
            mask = _visible_mask(shares, hidden)
            front = hidden | (shares.full_map("front", hidden.shape) >= 0.5)
            if mask_iou(mask, outline, front) >= self.settings.min_iou:
                hidden = front
            else:
                mask = outline & ~hidden
                shares = cutout.cutout_from_mask(self.picture, mask, hidden)
        return _VehicleCutout(row, draft.placement, mask, hidden, outline, mask_iou(mask, outline, hidden), shares)

    def _coarse_cutouts(self, places: list[Placement], hidden: Mask) -> list[Cutout]:
        """Unrefined cut-outs with the template at each of the places."""
        camera, backend = self.frame.camera, self.settings.backend
        nearer = [hidden] * len(places)
        return cutout.cut_out(self.picture, places, nearer, self.ground, camera, backend, refine_borders=False)

    def _first_cutout(self, draft: _DraftCutout, hidden: Mask, extend: bool) -> Cutout:
        """The network's cut-out; a large vehicle's is extended by colours and by the cut-out at its label."""
        placement, outline = draft.placement, draft.outline
        if not (extend and outline.any() and _mask_height(outline) >= mask_extension.MIN_HEIGHT_PX):
            return self._coarse_cutouts([placement], hidden)[0]
        labels, camera, row = self.frame.labels, self.frame.camera, draft.row
        assert labels is not None
        pose = labels.translation[row], labels.yaw[row], labels.size_lhw[row]
        labelled = silhouette.place_mesh(placement.mesh, *pose)
        first, other = self._coarse_cutouts([placement, labelled], hidden)
        if not (first.visible.size and other.visible.size):
            return first
        outlines = [outline, *silhouette.render_silhouettes([labelled], camera, self.settings.backend)]
        allowed = _label_box_mask(labels, row, hidden.shape) & ~hidden
        covered = np.stack(outlines).mean(0, dtype=np.float32)
        return mask_extension.extend_mask(self.picture, first, other, covered, allowed)

    def _clean(self, row: int, shares: Cutout, outline: Mask, hidden: Mask) -> Cutout:
        """A cut-out without unlikely parts, limited to its label's 2D box. outline (H, W): of its placement."""
        labels = self.frame.labels
        assert labels is not None
        cleaned = cutout.remove_unlikely_occluders(cutout.clean_cutout(shares), outline, hidden)
        inside = _label_box_mask(labels, row, hidden.shape)[cleaned.window]
        return replace(cleaned, visible=cleaned.visible * inside)


def _snap_to_outline(outline: Mask, shares: Cutout) -> Cutout:
    """A cut-out with its border along the outline (H, W) of a mesh that fills its box, and so is right to
    a pixel.
    """
    if not outline.any():
        return shares
    tolerance = _OUTLINE_TOLERANCE * _mask_height(outline)
    outer = grow_mask(outline, tolerance + 1)[shares.window]
    inner = grow_mask(outline, -tolerance - 0.7)[shares.window]
    return replace(shares, visible=np.where(inner, 1 - shares.front, shares.visible * outer).astype(np.float32))


def _visible_mask(shares: Cutout, hidden: Mask) -> Mask:
    """Pixels (H, W) of which at least half is the vehicle."""
    return (shares.full_map("visible", hidden.shape) >= 0.5) & ~hidden


def _label_box_mask(labels: Labels, row: int, shape: tuple[int, int]) -> Mask:
    """Pixels in a label's 2D box with a margin: hand-drawn boxes are tight to a few px."""
    x0, y0, x1, y1 = labels.boxes_xyxy[row].tolist()
    margin = 2.0 + 0.02 * (y1 - y0)
    inside = np.zeros(shape, bool)
    rows = slice(max(int(y0 - margin), 0), int(y1 + margin) + 2)
    inside[rows, max(int(x0 - margin), 0) : int(x1 + margin) + 2] = True
    return inside


def _boxes_of(labels: Labels, camera: Camera, rows: list[int]) -> Mask:
    """Pixels (H, W) in the boxes of labels."""
    inside = np.zeros((camera.height, camera.width), bool)
    for box in labels.boxes_xyxy[rows].tolist():
        x0, y0, x1, y1 = (max(int(side), 0) for side in box)
        inside[y0 : y1 + 2, x0 : x1 + 2] = True
    return inside


def _trusted_boxes(labels: Labels, rows: list[int], camera: Camera) -> LabelBoxes:
    """The labels' 2D boxes, trusted on sides that neither the image's border nor, as labelled, anything
    else cuts.
    """
    xyxy = labels.boxes_xyxy[rows].float()
    limit = xyxy.new_tensor([camera.width - 1, camera.height - 1]).repeat(2)
    inside = (xyxy > 2) & (xyxy < limit - 2)
    projected = project_boxes(labels.size_lhw[rows], labels.yaw[rows], labels.translation[rows], camera.matrix)
    projected = torch.minimum(projected.clamp(min=0), limit)
    tolerance = _DERIVED_BOX_PX + _DERIVED_BOX_SHARE * (xyxy[:, 3:] - xyxy[:, 1:2])
    derived = ((xyxy - projected).abs() < tolerance).all(1)
    # 2D boxes derived from 3D boxes, as KITTI's are, fit only the outlines' top: cars are rounder than boxes. That
    # is a convention of a whole data set, so the frame's vehicles vote on it.
    only_top = 2 * int(derived.sum()) >= len(rows)
    sides = xyxy.new_tensor([0.0, 1.0, 0.0, 0.0] if only_top else [1.0, 1.0, 1.0, 1.0])
    return LabelBoxes(xyxy, sides * (labels.occlusion[rows] <= 1)[:, None] * inside)


def _remove_occluders(
    cuts: list[_VehicleCutout], occluder_masks: list[OccluderMask], camera: Camera
) -> list[_VehicleCutout]:
    """The vehicles without their occluders' pixels. A vehicle that would vanish stays as it was."""
    visible = []
    for cut in cuts:
        depth_m = _depth_m(cut.placement, camera)
        hidden = occluders.mask_nearer_occluders(occluder_masks, depth_m, cut.mask.shape)
        rest = cut.mask & ~hidden
        visible.append(replace(cut, mask=rest, hidden=cut.hidden | hidden) if rest.any() else cut)
    return visible


def _remove_underbody(cut: _VehicleCutout, view: shadow.GroundView) -> _VehicleCutout:
    """The mask without the dark ground between and next to the wheels, which is shadow on the ground."""
    _, top, _, bottom = silhouette.mask_bounds(cut.outline)
    low = np.arange(cut.outline.shape[0])[view.window[0], None] > bottom - _UNDERBODY * (bottom - top)
    beneath = low & (view.distance < 0.4) & ~grow_mask(cut.outline, 1.5)[view.window]
    mask = cut.mask & ~view.in_frame(beneath, cut.mask.shape)
    return replace(cut, mask=mask) if mask.any() else cut


def _separate_layers(
    image: Array,
    cuts: list[_VehicleCutout],
    views: list[shadow.GroundView],
    vehicles: Mask,
    inputs: BackgroundInputs,
    settings: DerenderSettings,
) -> tuple[Array, list[Array], list[Crop], torch.Tensor]:
    """Background (H, W, 3) on the photograph's 8-bit grid, mattes (H, W), shadow factors (3, h, w), sun (3,)."""
    if not cuts:
        return image, [], [], ground_geometry.default_sun()
    owner, near = shadow.nearest_views(views, image.shape)
    in_front = inputs.occluder_opacity > 0
    fill = BackgroundFill(image, near, inputs, settings.shrink)
    lighting = shadow.estimate_ground_light(image, vehicles, views, fill.continue_street)
    sun, shaded = _find_shadows(lighting, cuts, views, vehicles, in_front)
    hole = vehicles.copy()
    for cut, region, view in zip(cuts, shaded, views, strict=True):
        hole |= grow_mask(view.in_frame(region, hole.shape), 2.5) | grow_mask(cut.mask, 4)
        hole[view.window] |= view.distance < 0.2
    reaches = [(i, cut.reach) for i, cut in enumerate(cuts) if cut.reach is not None]
    people = [grow_mask(reach, 2) for _, reach in reaches]
    filled = fill.fill_hole(hole | _union(people, hole.shape), settings.seed)
    for place, person in enumerate(people):
        filled = fill.fill_thin(filled, person, _union(people[place + 1 :], hole.shape))
    mattes = [cutout_opacity(cut.cutout, cut.mask, cut.hidden) for cut in cuts]
    for i, reach in reaches:
        mattes[i] = np.maximum(mattes[i], _TRACE_OPACITY * reach).astype(np.float32)
    opaque = np.max(mattes, axis=0)
    shadow_share = np.zeros(image.shape[:2], np.float32)
    for region, view in zip(shaded, views, strict=True):
        if region.any():
            wide = tuple(slice(max(part.start - 4, 0), part.stop + 4) for part in view.window)
            outside = ~view.in_frame(region, shadow_share.shape)[wide]
            beyond = cv2.distanceTransform(outside.astype(np.uint8), cv2.DIST_L2, 5)
            shadow_share[wide] = np.maximum(shadow_share[wide], np.clip(1.25 - beyond / 2.5, 0, 1))
    # Where a matte is thin, most of the pixel is background already: the fill fades into it.
    replaced = np.clip(np.maximum(shadow_share, (opaque - _FADE[0]) / (_FADE[1] - _FADE[0])), 0, 1)
    replaced = np.maximum(replaced, _union([reach for _, reach in reaches], replaced.shape))[..., None]
    mixed = image + (filled - image) * replaced
    # A shadow only darkens: where the fill is darker than the photograph, the photograph is the background.
    only_shadow = (opaque == 0)[..., None]
    mixed = np.where(only_shadow, np.maximum(mixed, image), mixed)
    # Occluders are in the background too; only their border lets through what is behind.
    mixed = np.where(inputs.occluder_opacity[..., None] >= _FADE_OCCLUDER, image, mixed)
    background = np.where(replaced > 0, np.rint(mixed * 255) / 255, image).astype(np.float32)
    seen = (shadow_share > 0) & (opaque < 0.5) & ~in_front
    factors = []
    for i, view in enumerate(views):
        part = view.window
        factor = shadow.shadow_factors(image[part], background[part], seen[part] & (owner[part] == i))
        crop = _crop_nonzero(1 - factor.transpose(2, 0, 1), inverted=True)
        factors.append(replace(crop, x0=crop.x0 + part[1].start, y0=crop.y0 + part[0].start))
    return background, mattes, factors, sun


def _find_shadows(
    lighting: shadow.GroundLight,
    cuts: list[_VehicleCutout],
    views: list[shadow.GroundView],
    vehicles: Mask,
    in_front: Mask,
) -> tuple[torch.Tensor, list[Mask]]:
    """The direction towards the sun (3,), and the ground (h, w) of its view's window that each vehicle shades.
    in_front (H, W): occluders.
    """
    placements = [cut.placement for cut in cuts]
    tight = _union([cut.mask for cut in cuts], vehicles.shape) | in_front
    sun = shadow.estimate_sun(lighting, vehicles | in_front, placements, views, ground_geometry.default_sun())
    best: tuple[int, torch.Tensor, list[Mask]] | None = None
    for factor in shadow.STRETCHES:
        lower = shadow.lengthen_shadows(sun, factor)
        allowed = [shadow.reachable_ground(p, view, lower) for p, view in zip(placements, views, strict=True)]
        casts = [shadow.cast_box_shadow(p, view, lower) for p, view in zip(placements, views, strict=True)]
        shadows, beyond = shadow.find_shadows(lighting, tight, views, allowed, casts)
        if best is None or beyond < shadow.MAX_SPILL_RATIO * best[0]:
            best = beyond, lower, shadows
        if not best[0]:
            break
    assert best is not None
    return best[1], best[2]


def _min_background_depth(cuts: list[_VehicleCutout], camera: Camera) -> Array:
    """Least depth (H, W) m of the background behind vehicles: that of their middle; 0 where there is none."""
    middle = np.zeros((camera.height, camera.width), np.float32)
    for cut in cuts:
        depth_m = _depth_m(cut.placement, camera)
        middle = np.where(cut.outline, np.maximum(middle, np.float32(depth_m)), middle)
    return middle


def _make_environment(
    maps: segmentation.Segmentation,
    ground: torch.Tensor,
    sun: torch.Tensor,
    vehicles: Mask,
    closed_sky: torch.Tensor,
    ego_opacity: Array,
) -> Environment:
    """The background's maps, with codes 0."""
    # Weather changes the finished picture, so a vehicle in front of the sky is not sky. Foliage changes before the
    # vehicles are drawn.
    sky = np.where(vehicles, 0, maps.sky)
    return Environment(
        torch.zeros(WEATHER_DIM),
        torch.zeros(FOLIAGE_DIM),
        sun,
        ground,
        *(torch.from_numpy(np.ascontiguousarray(m, dtype=np.float32)) for m in (sky, maps.foliage, maps.road)),
        closed_sky=closed_sky,
        ego=torch.from_numpy(ego_opacity) if ego_opacity.any() else None,
    )


def _make_objects(labels: Labels, cuts: list[_VehicleCutout], codes: int) -> tuple[Objects, tuple[Mesh, ...]]:
    """The vehicles at their placements, without sources, with texture codes (N, codes) of 0, and their meshes."""
    meshes: dict[int, Mesh] = {}
    for cut in cuts:
        meshes.setdefault(id(cut.placement.mesh), cut.placement.mesh)
    order = list(meshes)
    rows = [cut.row for cut in cuts]

    def stack(name: str, *shape: int) -> torch.Tensor:
        parts = [getattr(cut.placement, name).detach().float() for cut in cuts]
        return torch.stack(parts) if parts else torch.zeros(0, *shape)

    objects = Objects(
        torch.tensor([order.index(id(cut.placement.mesh)) for cut in cuts], dtype=torch.int64),
        stack("translation", 3),
        stack("yaw"),
        stack("size_lhw", 3),
        stack("ffd", LATTICE_POINTS, 3),
        torch.zeros(len(cuts), codes),
        torch.tensor([int(_CATEGORIES[labels.kind[row]]) for row in rows], dtype=torch.int64),
        labels.boxes_xyxy[rows].float(),
        labels.truncation[rows].float(),
        labels.occlusion[rows],
    )
    return objects, tuple(meshes.values())


def _matte_reach_px(cut: _VehicleCutout, opacity: Array, settings: DerenderSettings) -> float:
    """How far the matte reaches beyond the mesh's outline, with a margin, px; bounded by the vehicle's height."""
    x0, y0, x1, y1 = silhouette.mask_bounds(cut.outline | (opacity > 0))
    outline, opaque = cut.outline[y0:y1, x0:x1], opacity[y0:y1, x0:x1] > 0
    beyond = cv2.distanceTransform((~outline).astype(np.uint8), cv2.DIST_L2, 5)
    limit = max(settings.max_inflation * _mask_height(cut.outline), settings.min_reach_px)
    return float(np.clip(beyond[opaque].max(initial=0) + 1.5, settings.min_reach_px, limit))


def _crop_nonzero(values: Array, inverted: bool = False) -> Crop:
    """The non-zero part (C, h, w) of a frame (C, H, W); one minus it if `inverted`."""
    used = np.asarray((values > 0).any(0))
    x0, y0, x1, y1 = silhouette.mask_bounds(used) if used.any() else (0, 0, 0, 0)
    part = np.ascontiguousarray(values[:, y0:y1, x0:x1], dtype=np.float32)
    return Crop(torch.from_numpy(1 - part if inverted else part), x0, y0)


def _union(masks: Sequence[Mask], shape: tuple[int, ...]) -> Mask:
    """Pixels of any of the masks."""
    return np.logical_or.reduce(masks) if masks else np.zeros(shape, bool)


def _mask_height(mask: Mask) -> int:
    """Height, px, of a non-empty mask."""
    _, top, _, bottom = silhouette.mask_bounds(mask)
    return bottom - top
