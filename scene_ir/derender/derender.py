"""From one labelled photograph to a scene whose vehicles can be moved: `derender(frame) -> SceneIR`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender import background as fills
from scene_ir.derender import maps, shadow, silhouette, street
from scene_ir.derender.matte import matte
from scene_ir.derender.settle import settle
from scene_ir.derender.silhouette import Placement
from scene_ir.errors import RangeError, ShapeError
from scene_ir.geometry import project_boxes
from scene_ir.raster import verbs
from scene_ir.sources import SolveSettings, solve_sources
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

VEHICLES = {"Car": Category.CAR, "Van": Category.CAR, "Truck": Category.TRUCK}
"""Labels that become objects; all others stay in the background. Vans count as cars, as in the paper."""

_FADE = (0.08, 0.45)
"""Opacity up to which the photograph is taken for what is behind a car, and from which on that is all filled."""
_TRUSTED = 0.85
"""Agreement of mask and fitted outline from which on the outline may add to the mask."""
_EDGE = 0.03
"""How far the outline may add to the mask, as a fraction of the car's height: more is a mesh that is too large."""
_CLOSE = 0.015
"""How far the mask of a car that fills its 2D box may lie from its outline, as a fraction of its height."""
_SAME_PX, _SAME_SHARE = 1.0, 0.015
"""How near to the picture of its 3D box, px and share of the height, a label's 2D box is that picture."""
_LARGE_HOLE_PX = 60_000
"""Holes beyond are searched with one round less at full size: half the time, a little less grain."""
_UNDERBODY = 0.3
"""Lower part of a car, as a fraction of its height, in which what lies outside the mesh is ground."""


@dataclass(frozen=True, slots=True)
class DerenderSettings:
    """fit: move templates until their outlines meet the masks. min_height_px: smaller vehicles stay background.
    min_iou: below this agreement of mask and template the template's outline is the mask. max_inflation: of the
    halo that carries the matte, as a fraction of the car's height. min_reach_px: how far it reaches at least.
    seed: of the fill's random search. backend: of the renderer.
    """

    fit: bool = True
    min_height_px: float = 12.0
    min_iou: float = 0.6
    max_inflation: float = 0.12
    min_reach_px: float = 4.0
    seed: int = 0
    backend: verbs.Backend = "warp"
    fitting: silhouette.FitSettings = field(default_factory=silhouette.FitSettings)


@dataclass(frozen=True, slots=True)
class _Cut:
    """One car cut out: its label's row, the fitted placement, the mask, and how well they agree."""

    row: int
    placement: Placement
    mask: Mask
    unknown: Mask
    outline: Mask
    agreement: float


@dataclass(frozen=True, slots=True)
class _Surroundings:
    """horizon: its row, px; ground (4,): the plane; others (H, W): labelled things that are no vehicles."""

    horizon: float
    ground: torch.Tensor
    camera: Camera
    others: Mask


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
    rows = _vehicle_rows(frame.identifier, labels, camera, settings)
    image = np.ascontiguousarray(frame.photograph.detach().cpu().float().numpy().transpose(1, 2, 0))
    ground = maps.fit_ground(labels, _posed_rows(labels))
    cuts = _cut_out(image, frame, rows, settings)
    views = [shadow.ground_view(cut.placement, ground, camera) for cut in cuts]
    cuts = [_without_underbody(cut, view) for cut, view in zip(cuts, views, strict=True)]
    vehicles = np.zeros(image.shape[:2], bool)
    for cut in cuts:
        vehicles |= silhouette.grow(cut.mask, 2)
    horizon = maps.horizon_row(ground, camera)
    road = maps.road_map(image, horizon, vehicles)
    background, mattes, shadows, sun = _layers(
        image,
        cuts,
        views,
        vehicles,
        road,
        _Surroundings(horizon, ground, camera, _people(labels, camera)),
        settings.seed,
    )
    environment, depth = _environment(background, ground, sun, horizon, camera, vehicles)
    if frame.depth is not None:
        # What stands behind the vehicles was never measured: there the estimate stays.
        depth = torch.where(torch.from_numpy(vehicles), depth, frame.depth.float())
    objects, meshes = _objects(labels, cuts)
    provenance = dict(frame.provenance) | {"frame": frame.identifier, "derender": "template fit and patch fill"}
    for index, cut in enumerate(cuts):
        provenance[f"objects[{index}].label"] = str(cut.row)
        provenance[f"objects[{index}].mask_iou"] = f"{cut.agreement:.3f}"
    picture = torch.from_numpy(np.ascontiguousarray(background.transpose(2, 0, 1)))
    scene = SceneIR(
        camera,
        meshes,
        objects,
        environment,
        frame.photograph.float(),
        picture,
        depth,
        labels.ignore_xyxy,
        provenance,
    )
    if not cuts:
        return scene
    margins = [_reach_px(cut, opacity, settings) for cut, opacity in zip(cuts, mattes, strict=True)]
    return solve_sources(
        scene,
        [_crop(a[None]) for a in mattes],
        [_crop(1 - f.transpose(2, 0, 1), inverted=True) for f in shadows],
        SolveSettings(backend=settings.backend),
        margins,
    )


def _posed_rows(labels: Labels) -> list[int]:
    """Rows whose 3D box is known: KITTI writes -1 for sizes and -1000 for places it does not know."""
    known = (labels.size_lhw > 0).all(1) & (labels.translation[:, 2] > -900)
    return [int(i) for i in known.nonzero()[:, 0]]


def _vehicle_rows(identifier: str, labels: Labels, camera: Camera, settings: DerenderSettings) -> list[int]:
    """Rows of the labels that become objects."""
    rows = [i for i in _posed_rows(labels) if labels.kind[i] in VEHICLES]
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


def _cut_out(image: Array, frame: Frame, rows: list[int], settings: DerenderSettings) -> list[_Cut]:
    """Masks and fitted placements, near to far, so that what a nearer car hides is known to be hidden."""
    labels, camera = frame.labels, frame.camera
    assert labels is not None
    bytes_image = np.clip(np.rint(image * 255), 0, 255).astype(np.uint8)
    order = sorted(rows, key=lambda row: (float(labels.translation[row, [0, 2]].norm()), row))
    unknown = _hidden_by_others(labels, order, camera)
    chosen: list[Placement] = []
    masks: list[Mask] = []
    boxes = _boxes(labels, rows, camera)
    told = {row: int(np.count_nonzero(boxes.trust[i])) >= 2 for i, row in enumerate(rows)}
    hidden: list[Mask] = []
    kept: list[int] = []
    for row in order:
        size = labels.size_lhw[row]
        kinds = silhouette.candidates(labels.kind[row], size.tolist())
        options = [silhouette.placed(k, labels.translation[row], labels.yaw[row], size) for k in kinds]
        if told[row]:
            options, _ = settle(options, _repeat(boxes, rows.index(row), len(options)), camera)
        outlines = silhouette.silhouettes(options, camera, settings.backend)
        if not outlines[0].any():
            continue
        mine = unknown[row] | _union(masks, image.shape[:2])
        height = _height(outlines[0])
        if frame.masks is not None:
            mask = (frame.masks[row] > 0.5).numpy() & ~mine
        else:
            band = (0.10 * height + 1.0, 0.05 * height + 1.5, 0.11 * height + 1.5)
            if told[row]:
                band = (0.05 * height + 1.0, 0.04 * height + 1.5, 0.05 * height + 1.5)
            mask = silhouette.instance_mask(bytes_image, outlines[0], mine, band)
            mask &= _label_box(labels, row, mask.shape)
        scores = [silhouette.iou(outline, mask, mine) for outline in outlines]
        best = int(np.argmax(scores))
        if scores[best] < settings.min_iou:
            mask = outlines[best] & ~mine
        if not mask.any():
            continue
        kept.append(row)
        chosen.append(options[best])
        masks.append(mask)
        hidden.append(mine)
    if settings.fit:
        chosen = silhouette.fit(
            chosen, masks, hidden, _boxes(labels, kept, camera), camera, settings.fitting, settings.backend
        )
    outlines = silhouette.silhouettes(chosen, camera, settings.backend)
    cuts: list[_Cut] = []
    for index, row in enumerate(kept):
        mine = unknown[row] | _union([c.mask for c in cuts], image.shape[:2])
        mask, outline = masks[index] & ~mine, outlines[index]
        if frame.masks is None and settings.fit:
            height = _height(outline)
            band = (0.03 * height + 1.5, 0.02 * height + 1.5, 0.03 * height + 1.5)
            around = outline | masks[index]
            if told[row]:
                around = outline
                band = (_CLOSE * height + 1.0, _CLOSE * height + 0.7, _CLOSE * height + 1.0)
            closer = silhouette.instance_mask(bytes_image, around, mine, band)
            closer &= _label_box(labels, row, mask.shape)
            if silhouette.iou(closer, outline, mine) >= settings.min_iou:
                mask = closer
            # Bright edges of roofs and pillars look like sky to GrabCut; the fitted mesh knows better, nearby.
            if silhouette.iou(mask, outline, mine) >= _TRUSTED:
                near = silhouette.grow(mask, _EDGE * height + 1)
                mask = mask | (silhouette.grow(outline, -1) & near & ~mine)
            # An outline that fills its box is right to a pixel or two, whatever the colours say.
            if told[row]:
                inner = silhouette.grow(outline, -_CLOSE * height - 0.7) & ~mine
                mask = (mask & silhouette.grow(outline, _CLOSE * height + 1)) | inner
        if mask.any():
            agreement = silhouette.iou(mask, outline, mine)
            cuts.append(_Cut(row, chosen[index], mask, mine, outline, agreement))
    return sorted(cuts, key=lambda cut: cut.row)


def _without_underbody(cut: _Cut, view: shadow.GroundView) -> _Cut:
    """The mask without the dark ground between and beside the wheels: that is shadow, and lies on the ground."""
    _, top, _, bottom = silhouette.extent(cut.outline)
    low = np.arange(cut.outline.shape[0])[:, None] > bottom - _UNDERBODY * (bottom - top)
    beneath = low & (view.distance < 0.4) & ~silhouette.grow(cut.outline, 1.5)
    return replace(cut, mask=cut.mask & ~beneath) if (cut.mask & ~beneath).any() else cut


def _hidden_by_others(labels: Labels, rows: list[int], camera: Camera) -> dict[int, Mask]:
    """For each vehicle the pixels of nearer people and the like, ellipses in their boxes: the car cannot own
    them."""
    shape = (camera.height, camera.width)
    people = [i for i in _posed_rows(labels) if labels.kind[i] not in VEHICLES]
    hidden = {}
    for row in rows:
        mask = np.zeros(shape, bool)
        for other in people:
            if float(labels.translation[other, 2]) < float(labels.translation[row, 2]):
                x0, y0, x1, y1 = labels.boxes_xyxy[other].tolist()
                v, u = np.mgrid[0 : camera.height, 0 : camera.width]
                across, down = (2 * u - x0 - x1) / max(x1 - x0, 1), (2 * v - y0 - y1) / max(y1 - y0, 1)
                mask |= across**2 + down**2 <= 1
        hidden[row] = mask
    return hidden


def _people(labels: Labels, camera: Camera) -> Mask:
    """Pixels (H, W) in the boxes of labelled things that are no vehicles: nothing is copied from there."""
    inside = np.zeros((camera.height, camera.width), bool)
    for kind, box in zip(labels.kind, labels.boxes_xyxy.tolist(), strict=True):
        if kind not in VEHICLES:
            x0, y0, x1, y1 = (max(int(side), 0) for side in box)
            inside[y0 : y1 + 2, x0 : x1 + 2] = True
    return inside


def _label_box(labels: Labels, row: int, shape: tuple[int, int]) -> Mask:
    """Pixels inside the label's 2D box and a little around: hand-drawn, it is tight to a few px."""
    x0, y0, x1, y1 = labels.boxes_xyxy[row].tolist()
    slack = 2.0 + 0.02 * (y1 - y0)
    inside = np.zeros(shape, bool)
    inside[max(int(y0 - slack), 0) : int(y1 + slack) + 2, max(int(x0 - slack), 0) : int(x1 + slack) + 2] = True
    return inside


def _boxes(labels: Labels, rows: list[int], camera: Camera) -> silhouette.Boxes:
    """The labels' boxes; only sides that neither the image's border nor, as far as labelled, anything else
    cuts."""
    xyxy = labels.boxes_xyxy[rows].float()
    limit = xyxy.new_tensor([camera.width - 1, camera.height - 1]).repeat(2)
    inside = (xyxy > 2) & (xyxy < limit - 2)
    whole = project_boxes(labels.size_lhw[rows], labels.yaw[rows], labels.translation[rows], camera.matrix)
    whole = torch.minimum(whole.clamp(min=0), limit)
    slack = _SAME_PX + _SAME_SHARE * (xyxy[:, 3:] - xyxy[:, 1:2])
    same = ((xyxy - whole).abs() < slack).all(1)
    # Drawn from the 3D boxes, as KITTI's are, 2D boxes tell nothing of the outlines but their top: cars are
    # rounder than boxes. That is a habit of a whole data set, so the frame's vehicles vote on it.
    derived = 2 * int(same.sum()) >= len(rows)
    sure = xyxy.new_tensor([0.0, 1.0, 0.0, 0.0] if derived else [1.0, 1.0, 1.0, 1.0])
    return silhouette.Boxes(xyxy, sure * (labels.occlusion[rows] <= 1)[:, None] * inside)


def _repeat(boxes: silhouette.Boxes, index: int, count: int) -> silhouette.Boxes:
    """One of the boxes, `count` times."""
    return silhouette.Boxes(boxes.xyxy[index].expand(count, 4), boxes.trust[index].expand(count, 4))


def _union(masks: Sequence[Mask], shape: tuple[int, ...]) -> Mask:
    """Pixels of any of the masks."""
    return np.logical_or.reduce(masks) if masks else np.zeros(shape, bool)


def _height(mask: Mask) -> int:
    """Height, px, of what is not empty."""
    _, top, _, bottom = silhouette.extent(mask)
    return bottom - top


def _layers(
    image: Array,
    cuts: list[_Cut],
    views: list[shadow.GroundView],
    vehicles: Mask,
    road: Array,
    surroundings: _Surroundings,
    seed: int,
) -> tuple[Array, list[Array], list[Array], torch.Tensor]:
    """Background (H, W, 3) on the photograph's 8-bit grid, mattes (H, W), shadow factors (H, W, 3), sun."""
    if not cuts:
        return image, [], [], maps.sun_direction()
    placements = [cut.placement for cut in cuts]
    tight = _union([cut.mask for cut in cuts], vehicles.shape)
    lighting = shadow.light(
        image, road, vehicles, views, behind=lambda zone: _continued(image, zone, road, surroundings)[0].image
    )
    sun = shadow.estimate_sun(lighting, vehicles, placements, views, maps.sun_direction())
    allowed = [shadow.reachable(placement, view, sun) for placement, view in zip(placements, views, strict=True)]
    shaded = shadow.find(lighting, tight, views, allowed)
    hole = vehicles.copy()
    for cut, region, view in zip(cuts, shaded, views, strict=True):
        hole |= silhouette.grow(region, 2.5) | silhouette.grow(cut.mask, 4) | (view.distance < 0.2)
    near = np.stack([view.distance for view in views])
    filled = _filled(image, hole, near.min(0), road, surroundings, seed)
    mattes = [matte(image, cut.mask, cut.unknown, near.min(0) < 0.6) for cut in cuts]
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
    background = np.where(replaced > 0, np.rint(mixed * 255) / 255, image).astype(np.float32)
    owner = near.argmin(0)
    factors = [
        shadow.factors(image, background, (shadow_share > 0) & (owner == i) & (opaque < 0.5))
        for i in range(len(cuts))
    ]
    return background, mattes, factors, sun


def _filled(image: Array, hole: Mask, near: Array, road: Array, surroundings: _Surroundings, seed: int) -> Array:
    """The image (H, W, 3) without what is in the hole. near (H, W) m: distance from the cars' footprints."""
    forbidden = silhouette.grow(hole, 2)
    guide, like = _continued(image, forbidden, road, surroundings)
    ground = fills.Ground((near < 0.3) | guide.ground, like)
    forbidden = forbidden | surroundings.others
    quick = fills.FillSettings(iterations=(8, 1))
    settings = quick if np.count_nonzero(hole) > _LARGE_HOLE_PX else fills.FillSettings()
    return fills.fill(image, hole, forbidden, surroundings.horizon, ground, seed, settings, guide.image)


def _continued(
    image: Array, unknown: Mask, road: Array, surroundings: _Surroundings
) -> tuple[street.Continued, Array]:
    """The street behind unknown pixels, and how much (H, W) each known pixel looks like ground."""
    unknown = unknown | surroundings.others
    like = np.where(unknown, 0, road).astype(np.float32)
    plane = street.plane_view(surroundings.ground, surroundings.camera)
    return street.continued(image, unknown, like, plane, surroundings.horizon), like


def _environment(
    background: Array, ground: torch.Tensor, sun: torch.Tensor, horizon: float, camera: Camera, vehicles: Mask
) -> tuple[Environment, torch.Tensor]:
    """Maps and depth of the background."""
    nothing = np.zeros(vehicles.shape, bool)
    sky = maps.sky_map(background, horizon, nothing)
    road = maps.road_map(background, horizon, nothing)
    foliage = maps.foliage_map(background, sky, road, nothing)
    depth = maps.depth_map(maps.plane_depth(ground, camera), road, sky, horizon)
    # Vehicles cover both: their pixels must not change with season or weather of what is behind them.
    sky, foliage = np.where(vehicles, 0, sky), np.where(vehicles, 0, foliage)
    environment = Environment(
        torch.zeros(WEATHER_DIM),
        torch.zeros(FOLIAGE_DIM),
        sun,
        ground,
        *(torch.from_numpy(np.ascontiguousarray(m, dtype=np.float32)) for m in (sky, foliage, road)),
    )
    return environment, torch.from_numpy(depth)


def _objects(labels: Labels, cuts: list[_Cut]) -> tuple[Objects, tuple[Mesh, ...]]:
    """The vehicles as placed by the fit, without sources, and the templates they use."""
    meshes: list[Mesh] = []
    index = []
    for cut in cuts:
        names = [m.name for m in meshes]
        if cut.placement.mesh.name not in names:
            meshes.append(cut.placement.mesh)
            names.append(cut.placement.mesh.name)
        index.append(names.index(cut.placement.mesh.name))
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
        torch.tensor([int(VEHICLES[labels.kind[row]]) for row in rows], dtype=torch.int64),
        labels.boxes_xyxy[rows].float(),
        labels.truncation[rows].float(),
        labels.occlusion[rows],
    )
    return objects, tuple(meshes)


def _reach_px(cut: _Cut, opacity: Array, settings: DerenderSettings) -> float:
    """How far the matte reaches beyond the mesh's outline, px, and a little more; bounded by the car's height."""
    beyond = cv2.distanceTransform((~cut.outline).astype(np.uint8), cv2.DIST_L2, 5)
    limit = settings.max_inflation * _height(cut.outline)
    return float(
        np.clip(beyond[opacity > 0].max(initial=0) + 1.5, settings.min_reach_px, max(limit, settings.min_reach_px))
    )


def _crop(values: Array, inverted: bool = False) -> Crop:
    """The part (C, h, w) of a frame (C, H, W) that is not zero; of `inverted` values, one minus it."""
    used = np.asarray((values > 0).any(0))
    x0, y0, x1, y1 = silhouette.extent(used) if used.any() else (0, 0, 0, 0)
    part = np.ascontiguousarray(values[:, y0:y1, x0:x1], dtype=np.float32)
    return Crop(torch.from_numpy(1 - part if inverted else part), x0, y0)
