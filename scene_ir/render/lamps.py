"""Lamps of vehicles: tail lamps and headlamps at their places on the mesh, with glare, and mirrored by a wet road.

A lamp is a sum of Gaussians that are separable along rows and columns: its image, the glare of the lens and of drops
in the air around it, a streak across. So all lamps of a picture are one matrix product, differentiable to poses,
shapes and codes. Which lamps something hides comes from the z-buffer, without a slope.

Shapes: N objects with 4 lamps each: front left, front right, rear left, rear right. Of riders only the left ones are
there, on the centre line; people on foot have none.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from scene_ir import ffd
from scene_ir.geometry import to_clip
from scene_ir.render import model
from scene_ir.render.reflections import mirror_share
from scene_ir.render.surfaces import rotate_y
from scene_ir.render.texture import smoothstep
from scene_ir.types import Crop, Environment, Mesh, Objects, Part, SceneIR, Weather

_QUADRANTS = tuple(product((1.0, -1.0), (1.0, -1.0)))
"""Signs of x (front) and z (left) of the four lamps."""
_SEEN_PX = 2
"""Reach of the window in which a lamp's own vehicle must be visible."""
_LEAST_SEARCH_PX = 3


@dataclass(frozen=True, slots=True)
class VehicleLamps:
    """Lamps of a scene's vehicles."""

    unit: Tensor
    """(N, 4, 3) places in the unit box."""
    weights: Tensor
    """(N, 4, P) of the lattice at these places."""
    shift_m: Tensor
    """(N, 4, 2) from there to the photograph's own lamps, right and down."""
    driven: Tensor
    """(N,) in [0, 1]: 0 is parked, with all lamps off."""
    front: Tensor
    """(N, 4) bool, which are headlamps."""
    radius_m: Tensor
    """(N, 4), 0 where there is no lamp."""


def lamps_on(weather: Tensor) -> Tensor:
    """How far () drivers have their lamps on in a weather (6,): 0 at code 0, near 1 by night and in dense fog."""
    return -torch.expm1(-(weather.new_tensor(model.LAMPS_ON) * weather).sum().square())


@torch.no_grad()
def find_lamps(scene: SceneIR, base: Objects, centre: Tensor) -> VehicleLamps:
    """The lamps of a scene's vehicles.

    Args:
        scene: The scene.
        base: Its N objects as photographed.
        centre: (3,) m, centre of the camera.
    """
    like = centre
    meshes = [scene.meshes[int(i)] for i in base.mesh_index]
    unit = torch.stack([find_lamp_places(mesh) for mesh in meshes]).to(like)
    riders = scene.riders
    unit[riders] = _rider_lamp_places(base.size_lhw[riders].to(like))
    weights = ffd.lattice_weights(unit.reshape(-1, 3)).reshape(*unit.shape[:2], -1)
    driven = torch.stack([is_driven(scene, base, i) for i in range(len(base))]).to(like)
    driven = torch.where(base.upright, riders.to(driven), driven)
    front = torch.tensor([x > 0 for x, _ in _QUADRANTS]).repeat(len(base), 1)
    left = torch.tensor([z > 0 for _, z in _QUADRANTS], device=like.device)
    own = model.RIDER_LAMP_RADIUS_M * (riders[:, None] & left).to(like)
    radius_m = torch.where(base.upright[:, None], own, model.LAMP_RADIUS_M)
    still = VehicleLamps(unit, weights, torch.zeros_like(unit[..., :2]), driven, front, radius_m)
    xy, depth, facing = project_lamps(still, scene, base, centre)
    focal = scene.camera.matrix[0, 0].to(like)
    reach_px = model.LAMP_SEARCH * focal * base.size_lhw[:, 2:].to(like) / depth
    shift_px = torch.zeros_like(xy)
    seen = (facing > 0.2) & (depth > 0.5)
    for i in (~base.upright).nonzero()[:, 0].tolist() if base.source else ():
        foreground = base.source[i].foreground
        reach = reach_px[i].clamp(min=_LEAST_SEARCH_PX).tolist()
        ahead = [k for k in (0, 1) if seen[i, k]]
        if ahead and _are_red(foreground, xy[i, ahead], reach[ahead[0]]):
            front[i] = ~front[i]  # the estimated heading is turned by 180 degrees
        for k in seen[i].nonzero()[:, 0].tolist():
            shift_px[i, k] = _snap(foreground, xy[i, k], reach[k], bool(front[i, k]))
    return VehicleLamps(
        unit, weights, shift_px * (depth / focal)[..., None], driven, front.to(like.device), radius_m
    )


def find_lamp_places(mesh: Mesh) -> Tensor:
    """Centres (4, 3) of a mesh's lamps in the unit box; usual places where it has none."""
    corners = mesh.vertices[mesh.faces[mesh.part == Part.LIGHT]].double()
    centres = corners.mean(dim=1)
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1)
    places = []
    for front, left in _QUADRANTS:
        weight = area * (centres[:, 0] * front > 0.3) * (centres[:, 2] * left > 0.15)
        usual = centres.new_tensor([0.48 * front, -0.52, 0.40 * left])
        found = float(weight.sum()) > 0
        places.append((centres * weight[:, None]).sum(dim=0) / weight.sum() if found else usual)
    return torch.stack(places)


def _rider_lamp_places(size_lhw: Tensor) -> Tensor:
    """Places (K, 4, 3) in the unit box of riders' lamps: on the centre line, where the upright surface stands."""
    height_m = size_lhw.new_tensor([model.RIDER_LAMPS_M[x < 0] for x, _ in _QUADRANTS])
    up = height_m / size_lhw[:, 1:2]
    return torch.stack([torch.zeros_like(up), -up, torch.zeros_like(up)], dim=-1)


def is_driven(scene: SceneIR, base: Objects, i: int) -> Tensor:
    """Whether () a vehicle stands where one drives, in [0, 1]: along the camera's path, and in it, or coming towards
    it in the next lane, or with road beyond its side that faces away from that path.
    """
    x, y, z = base.translation[i].double().tolist()
    half, towards = 0.5 * float(base.size_lhw[i, 2]), base.yaw[i].double().sin()
    if z < 1.0:
        return torch.tensor(1.0)
    along = smoothstep(towards.abs(), *model.DRIVEN_ALONG)
    if abs(x) < half + 0.5 or (towards > 0 and abs(x) < model.NEXT_LANE_M):
        return along
    outward = 1.0 if x > 0 else -1.0
    places = [
        [x + outward * (half + aside), y, z + along] for aside in (0.8, 1.4, 2.0) for along in (-1.5, 0.0, 1.5)
    ]
    clip = to_clip(torch.tensor(places, dtype=torch.float64), scene.camera.matrix.double().cpu())
    columns, rows = (clip[:, :2] / clip[:, 2:].clamp(min=0.1)).round().long().unbind(1)
    height, width = scene.environment.road.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    if not bool(inside.any()):
        return along
    road = scene.environment.road.cpu()[rows[inside], columns[inside]].double().mean()
    return along * smoothstep(road, *model.DRIVEN_ROAD)


def _are_red(foreground: Crop, places: Tensor, reach_px: float) -> bool:
    """Whether the photograph is red around the places (K, 2) px of lamps, and much less so elsewhere on the vehicle."""
    red, green, blue, opacity = foreground.values.to(places)
    redness = smoothstep(red - torch.maximum(green, blue), *model.TAIL_LAMP_RED) * opacity
    height, width = redness.shape
    shares = []
    for x, y in (places - places.new_tensor([foreground.x0, foreground.y0])).tolist():
        rows = slice(min(max(round(y - reach_px), 0), height - 1), max(round(y + reach_px) + 1, 1))
        columns = slice(min(max(round(x - reach_px), 0), width - 1), max(round(x + reach_px) + 1, 1))
        shares.append(float(redness[rows, columns].mean()))
    there = max(shares)
    return there > model.RED_LAMPS[0] and there > model.RED_LAMPS[1] * float(redness.mean())


def _snap(foreground: Crop, xy: Tensor, reach_px: float, front: bool) -> Tensor:
    """Shift (2,) px from a lamp's projection to the photograph's lamp: red pixels behind, bright ones in front; 0
    where there are none. foreground: of the vehicle's `Source`.
    """
    xy = xy - xy.new_tensor([foreground.x0, foreground.y0])
    height, width = foreground.values.shape[1:]
    (x0, y0), (x1, y1) = (xy - reach_px).floor().long().tolist(), (xy + reach_px).ceil().long().tolist()
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1 + 1, width), min(y1 + 1, height)
    if x1 <= x0 or y1 <= y0:
        return torch.zeros_like(xy)
    red, green, blue, _ = foreground.values[:, y0:y1, x0:x1].to(xy)
    strength = torch.minimum(torch.minimum(red, green), blue) if front else red - torch.maximum(green, blue)
    strength = smoothstep(strength, *(model.HEADLAMP_WHITE if front else model.TAIL_LAMP_RED))
    rows, columns = torch.meshgrid(torch.arange(y0, y1).to(xy), torch.arange(x0, x1).to(xy), indexing="ij")
    near = torch.exp(-((columns - xy[0]).square() + (rows - xy[1]).square()) / (2 * (0.6 * reach_px) ** 2))
    weight = strength * near
    total = weight.sum()
    if float(total) < max(1.5, 0.01 * reach_px**2):
        return torch.zeros_like(xy)
    return torch.stack([(columns * weight).sum(), (rows * weight).sum()]) / total - xy


def project_lamps(
    lamps: VehicleLamps, scene: SceneIR, objects: Objects, centre: Tensor, mirrored: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Position (N, 4, 2) px, depth (N, 4) m, and cosine (N, 4) between a lamp's axis and the direction to the camera;
    of their mirror images below the ground if `mirrored`.
    """
    count = len(objects)
    local = (lamps.unit + lamps.weights @ objects.ffd) * objects.size_lhw[:, None]
    yaw = objects.yaw[:, None].expand(count, 4).reshape(-1)
    points = rotate_y(local.reshape(-1, 3), yaw).reshape(count, 4, 3) + objects.translation[:, None]
    axis = points.new_tensor([[front, 0.0, 0.0] for front, _ in _QUADRANTS]).repeat(count, 1)
    to_camera = torch.nn.functional.normalize(centre - points, dim=-1)
    facing = (rotate_y(axis, yaw).reshape(count, 4, 3) * to_camera).sum(dim=-1)
    if mirrored:
        ground = scene.environment.ground.to(points)
        points = points - 2.0 * ((points @ ground[:3]) + ground[3])[..., None] * ground[:3]
    clip = to_clip(points.reshape(-1, 3), scene.camera.matrix.to(points)).reshape(count, 4, 3)
    depth = clip[..., 2].clamp(min=0.1)
    focal = scene.camera.matrix[0, 0].to(points)
    return clip[..., :2] / depth[..., None] + focal * lamps.shift_m / depth[..., None], depth, facing


def draw_lamps(
    lamps: VehicleLamps, scene: SceneIR, objects: Objects, number: Tensor, environment: Environment, centre: Tensor
) -> Tensor:
    """Light (3, H, W) of the vehicles' lamps, as squares of display values; exactly 0 at weather 0 and `lamps` 0.

    Args:
        lamps: Of `find_lamps`.
        scene: The scene.
        objects: Its objects, perturbed.
        number: (H, W) int64, 0 for background, i + 1 for object i.
        environment: Weather, and map of the road where it shows.
        centre: (3,) m, centre of the camera.
    """
    height, width = number.shape
    weather = environment.weather.to(centre)
    xy, depth, facing = project_lamps(lamps, scene, objects, centre)
    mirror_xy, *_ = project_lamps(lamps, scene, objects, centre, mirrored=True)
    seen = _visible_share(number, xy.detach(), depth.detach()) * (lamps.radius_m > 0)
    coded = objects.lamps.requires_grad or bool((objects.lamps != 0).any())
    may_shine = (lamps.driven > 0) | coded
    index = ((seen > 0) & (facing.detach() > 0) & may_shine[:, None]).reshape(-1).nonzero()[:, 0]
    if not len(index):
        return centre.new_zeros(3, height, width)
    xy, mirror_xy = (places.reshape(-1, 2)[index] for places in (xy, mirror_xy))
    depth, facing, seen = (values.reshape(-1)[index] for values in (depth, facing, seen))
    front = lamps.front.reshape(-1)[index]
    longer = -torch.expm1(-(weather.new_tensor(model.LAMP_EXPOSURE) * weather).sum())
    exposure = model.LAMP_BY_DAY + (1.0 - model.LAMP_BY_DAY) * longer
    extinction = (
        model.FOG_EXTINCTION_PER_M * weather[Weather.FOG] + model.RAIN_EXTINCTION_PER_M * weather[Weather.RAIN]
    )
    beam = torch.where(front, model.HEADLAMP_WIDE + (1 - model.HEADLAMP_WIDE) * facing.clamp(min=0.0) ** 8, 1.0)
    code = objects.lamps.to(centre)[index // 4]
    braking = code * torch.sigmoid(model.LAMP_BEND * code)
    off = -code * torch.sigmoid(-model.LAMP_BEND * code)
    level = lamps_on(weather) * lamps.driven[index // 4] * (1.0 - off) + model.BRAKE_LAMP * braking * ~front
    strength = exposure * level.clamp(min=0.0) * seen * smoothstep(facing, *model.LAMP_FACES)
    strength = strength * beam * torch.exp(-extinction * depth)
    colours = centre.new_tensor([model.TAIL_LAMP_RGB, model.HEADLAMP_RGB])[front.long()] * strength[:, None]
    radius = lamps.radius_m.reshape(-1)[index] * scene.camera.matrix[0, 0].to(depth) / depth
    # An image below a pixel spreads over it.
    core = (radius.square() + model.LAMP_LEAST_PX**2).sqrt()
    area = radius.square()
    growth = 1.0 + model.GLARE_FOG * weather[Weather.FOG] + model.GLARE_RAIN * weather[Weather.RAIN]
    stretch_x, stretch_y = model.LAMP_STRETCH
    spots = [(xy, area / core.square(), stretch_x * core, stretch_y * core)]
    for k, (sigma, share) in enumerate(model.GLARE):
        # Drops scatter wider than the lens.
        spread = (core.square() + (sigma * height) ** 2).sqrt()
        spots.append((xy, (growth if k else 1.0) * share * area / spread.square(), spread, spread))
    across, along = model.STREAK
    streak = model.STREAK_SHARE * area / (across * along * height**2)
    spots.append((xy, streak, torch.full_like(core, across * height), torch.full_like(core, along * height)))
    # The middle of a tail lamp overflows into white.
    overflow = model.TAIL_CORE * colours[:, :1] * (~front)[:, None]
    light = _splat(spots, colours, height, width)
    light = light + _splat(spots[:1], overflow.expand_as(colours), height, width)
    wet = model.WET_MIRROR * mirror_share(depth, environment.ground[3].to(depth))
    wet = model.DRY_MIRROR + (wet - model.DRY_MIRROR) * weather[Weather.RAIN]
    drop = (mirror_xy[:, 1] - xy[:, 1]).clamp(min=1.0)
    mirrored = [(mirror_xy, area / core.square(), model.MIRROR_WIDTH * core, model.MIRROR_LENGTH * drop + core)]
    road = environment.road.to(centre)
    return light + road * _splat(mirrored, wet[:, None] * colours, height, width)


def _splat(spots: list[tuple[Tensor, Tensor, Tensor, Tensor]], colours: Tensor, height: int, width: int) -> Tensor:
    """Sum (3, H, W) of Gaussians: for each spot centres (J, 2), peaks (J,), widths across and down (J,) px; colours
    (J, 3).
    """
    xy, peak, across, down = (torch.cat(parts) for parts in zip(*spots, strict=True))
    colours = colours.repeat(len(spots), 1) * peak[:, None]
    columns, rows = (torch.arange(n, device=xy.device, dtype=xy.dtype) for n in (width, height))
    by_column = torch.exp(-0.5 * ((columns - xy[:, :1]) / across[:, None]).square())
    by_row = torch.exp(-0.5 * ((rows - xy[:, 1:]) / down[:, None]).square())
    return (colours.T[:, :, None] * by_row).transpose(1, 2) @ by_column


def _visible_share(number: Tensor, xy: Tensor, depth: Tensor) -> Tensor:
    """Share (N, 4) in [0, 1] of each lamp's surroundings that show its own vehicle; half of them is all of it."""
    height, width = number.shape
    steps = torch.arange(-_SEEN_PX, _SEEN_PX + 1, device=number.device)
    columns = (xy[..., 0].round().long()[..., None] + steps)[..., None, :]
    rows = (xy[..., 1].round().long()[..., None] + steps)[..., :, None]
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    at = number[rows.clamp(0, height - 1), columns.clamp(0, width - 1)]
    own = torch.arange(1, len(xy) + 1, device=number.device)[:, None, None, None]
    share = ((at == own) & inside).to(xy).mean(dim=(2, 3))
    return (2.0 * share).clamp(max=1.0) * (depth > 0.5)
