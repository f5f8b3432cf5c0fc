"""One synthetic frame: a street from a seed, its photograph and its exact ground truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike

from drivesem.data.ground_truth import occlusion_from_visible
from drivesem.synth import kernels, lamps
from drivesem.synth.assets import Sky, with_sky
from drivesem.synth.layout import (
    Actor,
    FittedCamera,
    LayoutSettings,
    Road,
    place_people,
    place_vehicles,
    plan_road,
    statistics,
)
from drivesem.synth.light import Light, draw_light, draw_response
from drivesem.synth.render import pixel_sums, rasterise, render, render_without_actors, see
from drivesem.synth.seasons import leaved
from drivesem.synth.soup import Material, Soup, box, join, placed, transformed
from drivesem.synth.variations import MIXED, VARIATIONS, fix_light_in_world, turned, vary
from drivesem.synth.vehicles import instance_ffd
from drivesem.synth.view import SUPERSAMPLING, Setting, Shadow, Sight, View, blocks, fine_matrix, noise_set
from drivesem.synth.world import POOLS, actor_soup, surroundings
from scene_ir.errors import RangeError
from scene_ir.geometry import project_boxes, yaw_matrix
from scene_ir.types import WEATHER_DIM, Camera, Crop, Environment, Labels

SPLITS = ("train", "heldout")
VARIANTS = {"train": (0, 100), "heldout": (100, 60)}
"""First vehicle shape and their number: held-out scenes share no shape with training scenes."""
_PHOTOGRAPHED_SHARE = 0.7
"""Of frames under a photographed sky, where there are some."""
_LEAST_VISIBLE = 0.05
_LEAST_HEIGHT_PX = 10.0
_LEAST_WIDTH_PX = 3.0


GENERATOR_VERSION = 2
"""Changes whenever the same seed gives another picture or other labels."""
FRAME_PERIOD_S = 0.1
"""Between frames of a drive: KITTI and Virtual KITTI have ten a second."""
BASELINE_M = 0.532725
"""Between Virtual KITTI 2's cameras."""
_VIRTUAL_CAMERAS = {
    "vkitti1": FittedCamera(725.0, (620.5, 187.0), (0.0, 0.0, 0.0), (1242, 375)),
    "vkitti2": FittedCamera(725.0087, (620.5, 187.0), (0.0, 0.0, 0.0), (1242, 375)),
}
"""Of Virtual KITTI 1.3.1 and 2."""


@dataclass(frozen=True, slots=True)
class SynthSettings:
    """What varies between uses of the generator. layout: vehicles and roads. sunny: clear weather only.
    tilt_rad: standard deviation of the camera's pitch and roll. camera: index into KITTI's four cameras, None:
    any, by name: Virtual KITTI's. sequence: frames of one drive, that follow each other by a tenth of a second.
    bent: each vehicle's shape is bent in a way of its own, so that no two are alike. skies: photographed ones,
    that stand in for the drawn sky in some frames.
    """

    layout: LayoutSettings | None = None
    sunny: bool = False
    tilt_rad: float = 0.008
    camera: int | Literal["vkitti1", "vkitti2"] | None = None
    sequence: int = 1
    bent: bool = False
    skies: tuple[Sky, ...] = ()


@dataclass(frozen=True, slots=True)
class Truth:
    """Exact ground truth of one actor. translation (3,) m, yaw rad: camera axes, KITTI's convention. index: of
    the actor in its plan. box_xyxy (4,) px; visible: share of its own silhouette in the image that nothing hides;
    screened: share that the surroundings hide; truncation in [0, 1]; opacity: its own silhouette (1, h, w), in [0,
    1].
    """

    actor: Actor
    translation: np.ndarray
    yaw: float
    index: int
    box_xyxy: np.ndarray
    visible: float
    screened: float
    occlusion: int
    truncation: float
    opacity: Crop

    @property
    def labelled(self) -> bool:
        """Whether it is large and visible enough to be an object, not a region to ignore."""
        width, height = self.box_xyxy[2:] - self.box_xyxy[:2]
        return bool(self.visible >= _LEAST_VISIBLE and width >= _LEAST_WIDTH_PX and height >= _LEAST_HEIGHT_PX)


@dataclass(frozen=True, slots=True)
class SynthFrame:
    """A synthetic frame. image, background (H, W, 3) uint8 (the background on request); labels:
    KITTI's classes; truths: actors that appear in the image; depth_m (H, W), inf in the sky, semantic (H, W)
    uint8, a `Semantic`, and instance (H, W) uint16, 0 or track + 1 of one of `truths`: of each pixel's nearest
    sample; owner (2H, 2W): what each sample shows, -1 sky, 0 surroundings, i + 1 actor i; ground_material (H, W):
    of the background where there is one, of each pixel's first sample; environment: codes 0 and exact maps,
    likewise; manifest: seed and shapes used.
    """

    image: np.ndarray
    background: np.ndarray | None
    background_depth_m: np.ndarray | None
    labels: Labels
    truths: tuple[Truth, ...]
    depth_m: np.ndarray
    semantic: np.ndarray
    instance: np.ndarray
    owner: np.ndarray
    ground_material: np.ndarray
    setting: Setting
    environment: Environment
    manifest: dict[str, object] = field(default_factory=dict)

    @property
    def camera(self) -> Camera:
        """The camera that took it."""
        return self.setting.view.camera


def _camera(rng: np.random.Generator, settings: SynthSettings) -> View:
    fitted = statistics()
    drawn = int(rng.integers(len(fitted.cameras)))
    if isinstance(settings.camera, str):
        fit = _VIRTUAL_CAMERAS[settings.camera]
    else:
        fit = fitted.cameras[drawn if settings.camera is None else settings.camera]
    f, (cx, cy) = fit.focal_px, fit.centre_px
    k = torch.tensor([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])
    projection = torch.cat([k, torch.tensor(fit.offset_px_m)[:, None]], dim=1)
    width, height = fit.size_wh_px
    pitch, roll = rng.normal(0, settings.tilt_rad), rng.normal(0, settings.tilt_rad * 0.5)
    tilt = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    lean = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    return View(
        Camera(k, height, width, projection), lean @ tilt, fitted.camera_height_m + float(rng.normal(0, 0.03))
    )


def _into_camera(soup: Soup, view: View) -> Soup:
    """The surroundings in camera axes about the centre of projection."""
    return transformed(soup, view.rotation, view.to_camera(np.zeros(3)) - view.centre)


def _stand(actor: Actor, view: View) -> np.ndarray:
    """Where the bottom-face centre (3,) of an actor lies in camera axes: on the ground plane."""
    return view.to_camera(np.array([actor.position_xz[0], 0.0, actor.position_xz[1]]))


def yaw_in_camera(actor: Actor, view: View) -> float:
    """KITTI's rotation_y of an actor, rad in [-pi, pi)."""
    return float((actor.yaw - view.heading + np.pi) % (2 * np.pi) - np.pi)


def _place_actor(actor: Actor, owner: int, view: View) -> Soup:
    """An actor in camera axes about the centre of projection, upright as labels know it."""
    spot = _stand(actor, view)
    soup = actor_soup(actor, owner, float(np.linalg.norm(spot)))
    turn = yaw_matrix(torch.tensor(yaw_in_camera(actor, view), dtype=torch.float64)).numpy()
    return transformed(soup, turn, spot - view.centre)


def full_boxes(actors: Sequence[Actor], view: View) -> np.ndarray:
    """Boxes (N, 4) px of the actors' 3D boxes, not cut at the image border; NaN behind the camera."""
    if not actors:
        return np.zeros((0, 4))
    size = torch.tensor([a.size_lhw for a in actors], dtype=torch.float64)
    yaw = torch.tensor([yaw_in_camera(a, view) for a in actors], dtype=torch.float64)
    spot = torch.from_numpy(np.stack([_stand(a, view) for a in actors]))
    return project_boxes(size, yaw, spot, view.camera.matrix.double()).numpy()


def measure(actors: Sequence[Actor], soups: list[Soup], owner: np.ndarray, view: View) -> list[Truth]:
    """Ground truth of the actors that reach into the image. owner (2H, 2W): what each sample shows."""
    n = SUPERSAMPLING
    height, width = view.camera.height, view.camera.width
    full = full_boxes(actors, view)
    rects = np.zeros((len(actors), 4), np.int64)
    for i, extent in enumerate(full):
        if np.isfinite(extent).all():
            low = np.floor(np.clip(extent[:2] - 2, 0, [width, height]))
            high = np.ceil(np.clip(extent[2:] + 3, 0, [width, height]))
            rects[i] = n * np.concatenate([low, np.maximum(high, low)])
    ends = np.cumsum([len(s) for s in soups])
    ranges = np.stack([np.concatenate([[0], ends[:-1]]), ends], axis=1) if soups else np.zeros((0, 2))
    found = []
    if not soups:
        return found
    face, _ = rasterise(np.concatenate([s.corners for s in soups]), fine_matrix(view), rects, ranges)
    start = 0
    for i, (actor, (x0, y0, x1, y1)) in enumerate(zip(actors, rects, strict=True)):
        count = int((x1 - x0) * (y1 - y0))
        own = face[start : start + count].reshape(y1 - y0, x1 - x0) >= 0
        start += count
        if own.sum() < 4:
            continue
        seen = owner[y0:y1, x0:x1]
        own_visible = (seen == i + 1) & own
        rows, columns = np.flatnonzero(own.any(axis=1)), np.flatnonzero(own.any(axis=0))
        # Sample k of an axis covers [k / n - 1/2, (k + 1) / n - 1/2] px, as pixel j covers [j - 1/2, j + 1/2].
        outline = np.array([x0 + columns[0], y0 + rows[0], x0 + columns[-1] + 1, y0 + rows[-1] + 1]) / n - 0.5
        outline = np.clip(outline, 0, [width - 1, height - 1, width - 1, height - 1])
        visible = float(own_visible.sum() / own.sum())
        screened = float(((seen == 0) & own).sum() / own.sum())
        cut = np.clip(full[i], 0, [width - 1, height - 1, width - 1, height - 1])
        whole = np.prod(full[i][2:] - full[i][:2])
        truncation = float(np.clip(1 - np.prod(cut[2:] - cut[:2]) / max(whole, 1e-6), 0, 1))
        opacity = pixel_sums(own.view(np.uint8)).astype(np.float32) / np.float32(n * n)
        found.append(
            Truth(
                actor=actor,
                translation=_stand(actor, view),
                yaw=yaw_in_camera(actor, view),
                box_xyxy=outline,
                index=i,
                visible=visible,
                screened=screened,
                occlusion=occlusion_from_visible(visible),
                truncation=truncation if truncation > 0.005 else 0.0,
                opacity=Crop(torch.from_numpy(opacity)[None], int(x0) // n, int(y0) // n),
            )
        )
    return found


def labels_from_truths(truths: Sequence[Truth]) -> Labels:
    """Make KITTI labels; hardly visible or tiny objects become ignored regions."""
    labelled = [t for t in truths if t.labelled]
    ignored = [
        t.box_xyxy
        for t in truths
        if not t.labelled and t.visible > 0 and (t.box_xyxy[2:] > t.box_xyxy[:2] + 0.5).all()
    ]
    return Labels(
        kind=tuple(t.actor.label for t in labelled),
        boxes_xyxy=table([t.box_xyxy for t in labelled], 4),
        truncation=torch.tensor([t.truncation for t in labelled], dtype=torch.float32),
        occlusion=torch.tensor([t.occlusion for t in labelled], dtype=torch.int64),
        translation=table([t.translation for t in labelled], 3),
        yaw=torch.tensor([t.yaw for t in labelled], dtype=torch.float32),
        size_lhw=table([t.actor.size_lhw for t in labelled], 3),
        ignore_xyxy=table(ignored, 4),
    )


def table(rows: Sequence[ArrayLike], width: int) -> torch.Tensor:
    """Rows of `width` numbers, also none at all, as a tensor (N, width) float32."""
    return torch.tensor(np.array(rows), dtype=torch.float32).reshape(-1, width)


_SHARES = ((Material.SKY,), (Material.LEAF, Material.GRASS), (Material.ROAD, Material.PARKING))
"""Materials of the maps of an `Environment`: sky, foliage, road."""


def _shares(material: np.ndarray) -> list[torch.Tensor]:
    """Shares (H, W) of each pixel's samples made of the materials of `_SHARES`. material (2H, 2W)."""
    # three counts of up to four in one number: three bits each
    table = np.zeros(256, np.uint16)
    for i, chosen in enumerate(_SHARES):
        table[list(chosen)] = 1 << (3 * i)
    counts = pixel_sums(cv2.LUT(material, table))
    quarter = np.float32(1 / SUPERSAMPLING**2)
    return [torch.from_numpy(((counts >> (3 * i)) & 7) * quarter) for i in range(len(_SHARES))]


def _environment(sight: Sight, setting: Setting) -> Environment:
    view = setting.view
    up = view.up
    sky, foliage, road = _shares(sight.material)
    return Environment(
        weather=torch.zeros(WEATHER_DIM),
        foliage=torch.zeros(3),
        sun=torch.tensor(setting.light.sun, dtype=torch.float32),
        ground=torch.tensor([*up, view.height_m], dtype=torch.float32),
        sky=sky,
        foliage_map=foliage,
        road=road,
    )


def stream(seed: int, index: int, split: str, name: int) -> np.random.Generator:
    """The generator for one purpose of one frame: independent of all others, of order and of workers."""
    if split not in SPLITS:
        raise RangeError("synth split", " or ".join(SPLITS), split)
    return np.random.default_rng([0xD51F, SPLITS.index(split), seed, index, name])


@dataclass(frozen=True, slots=True)
class Plan:
    """A frame before it is rendered. actors stand on road; setting: camera, light and the rest. origin: seed,
    index of the street, attempt. variation: its name; time_s: since the drive began. foliage:
    codes (3,) of hue, lightness, density. drivers_lamps: how far in [0, 1] drivers have their lamps on.
    """

    actors: tuple[Actor, ...]
    setting: Setting
    split: str
    origin: tuple[int, int, int]
    variation: str = MIXED
    time_s: float = 0.0
    foliage: tuple[float, ...] = (0.0, 0.0, 0.0)
    drivers_lamps: float = 0.0


def plan_frame(
    seed: int, index: int, split: str = "train", settings: SynthSettings | None = None, attempt: int = 0
) -> Plan:
    """What frame `index` of the stream `seed` will show; see `generate_frame`."""
    settings = settings or SynthSettings()
    street = index - index % settings.sequence
    rng = [stream(seed, street, split, 16 * attempt + i) for i in (0, 1, 2, 4)]
    layout = settings.layout or LayoutSettings(variants=VARIANTS[split])
    view = _camera(rng[0], settings)
    road = plan_road(rng[1], layout.kinds)
    actors = place_vehicles(rng[1], road, layout)
    for _ in range(layout.crowd if layout.people else 0):
        actors += place_people(rng[2], road, actors, layout.varied_people)
    light = draw_light(rng[3], view.up, settings.sunny)
    if settings.skies:
        light = _photographed_sky(light, settings, stream(seed, street, split, 16 * attempt + 6))
    setting = Setting(
        view=view,
        road=road,
        light=light,
        response=draw_response(rng[3], light.weather),
        noise=noise_set(SPLITS.index(split)),
        grain_seed=(seed, index, SPLITS.index(split), attempt),
    )
    tracked = tuple(replace(_own_shape(a, settings.bent), track=i) for i, a in enumerate(actors))
    plan = Plan(tracked, setting, split, (seed, street, attempt))
    return drive(plan, (index - street) * FRAME_PERIOD_S)


def _photographed_sky(light: Light, settings: SynthSettings, rng: np.random.Generator) -> Light:
    skies = [s for s in settings.skies if s.sunny or not settings.sunny]
    if not skies or rng.random() >= _PHOTOGRAPHED_SHARE:
        return light
    return with_sky(light, skies[int(rng.integers(len(skies)))], rng)


def _own_shape(actor: Actor, bent: bool) -> Actor:
    if not bent or actor.label not in ("Car", "Van", "Truck"):
        return actor
    return replace(actor, ffd=tuple(instance_ffd(actor).reshape(-1).tolist()))


def apply_variation(plan: Plan, name: str) -> Plan:
    """The plan in another of Virtual KITTI's variations. RangeError for an unknown name."""
    seed, street, attempt = plan.origin
    kind = (MIXED, *VARIATIONS).index(name) if name in (MIXED, *VARIATIONS) else 0
    setting = vary(plan.setting, name, stream(seed, street, plan.split, 16 * attempt + 5))
    return replace(plan, setting=replace(setting, grain_seed=(*setting.grain_seed[:4], kind)), variation=name)


def drive(plan: Plan, time_s: float) -> Plan:
    """The plan `time_s` later: the camera's car and all that moves go on along the road."""
    if time_s == 0:
        return plan
    road, view = plan.setting.road, plan.setting.view
    way = road.ego_speed_mps * time_s
    x, z = road.point(0.0, way)
    moved = replace(turned(view, road.curvature * way), position_xz=(float(x), float(z)))
    actors = tuple(_after(a, road, time_s) for a in plan.actors)
    setting = replace(plan.setting, view=moved, light=fix_light_in_world(plan.setting.light, view, moved))
    return replace(plan, actors=actors, setting=setting, time_s=plan.time_s + time_s)


def _after(actor: Actor, road: Road, time_s: float) -> Actor:
    if actor.lane_ds is None or actor.speed_mps == 0:
        return actor
    d, s = actor.lane_ds
    way = actor.speed_mps * time_s
    x, z = road.point(d, s + way)
    return replace(
        actor, position_xz=(float(x), float(z)), yaw=actor.yaw + road.curvature * way, lane_ds=(d, s + way)
    )


def second_camera(plan: Plan) -> Plan:
    """The plan as Virtual KITTI 2's right camera sees it."""
    view = plan.setting.view
    x, y, z = view.origin + view.rotation.T @ np.array([BASELINE_M, 0.0, 0.0])
    moved = replace(view, position_xz=(float(x), float(z)), height_m=float(-y))
    seed = (*plan.setting.grain_seed, 1)
    return replace(plan, setting=replace(plan.setting, view=moved, grain_seed=seed))


def actor_soups(plan: Plan) -> list[Soup]:
    """The actors' triangles in camera axes about the centre of projection, actor i owned by i + 1."""
    return [_place_actor(a, i + 1, plan.setting.view) for i, a in enumerate(plan.actors)]


def boxes_alone(plan: Plan) -> list[Truth]:
    """Roughly what the actors hide of one another: ground truth as if only their boxes stood in the world."""
    view = plan.setting.view
    if not plan.actors:
        return []
    soups = []
    for i, actor in enumerate(plan.actors):
        soup = placed(
            box(actor.size_lhw, Material.FLAT, (0.5, 0.5, 0.5)), (0, 0, 0), yaw_in_camera(actor, view), (1, 1, 1)
        )
        corners = (soup.corners + (_stand(actor, view) - view.centre)).astype(np.float32)
        soups.append(replace(soup, corners=corners, owner=np.full(len(soup), i + 1, np.int32)))
    return measure(plan.actors, soups, see(join(soups), view).owner, view)


@dataclass(frozen=True, slots=True)
class Street:
    """What stands in a plan's street besides its actors. soup: in camera axes about the centre of projection;
    used: what it was made of, by name.
    """

    soup: Soup
    used: dict[str, list[int]]


def build_street(plan: Plan) -> Street:
    """The surroundings of a plan: a matter of its origin, road, view and foliage, and not of its actors."""
    seed, street, attempt = plan.origin
    rng = stream(seed, street, plan.split, 16 * attempt + 3)
    static, used = surroundings(plan.setting.road, POOLS[plan.split], rng)
    return Street(_into_camera(leaved(static, plan.foliage), plan.setting.view), used)


def _lit(plan: Plan, street: Soup, soups: list[Soup]) -> tuple[Soup, list[Soup], Setting, Setting]:
    """Street and actors with their lamps as they are on, and the settings with all lamps and with those but actors'."""
    setting = plan.setting
    view, light = setting.view, setting.light
    states = lamps.LampStates(light.night, plan.drivers_lamps)
    street, rows = lamps.street_lamps(street, light, sum(plan.origin))
    rows = np.concatenate([rows, lamps.own_lamps(view, light, states)])
    found, lit = [rows], []
    for actor, soup in zip(plan.actors, soups, strict=True):
        yaw = yaw_in_camera(actor, view)
        soup, own = lamps.vehicle_lamps(actor, soup, np.array([np.cos(yaw), 0.0, -np.sin(yaw)]), light.up, states)
        lit.append(soup)
        found.append(own)
    return street, lit, replace(setting, lamps=np.concatenate(found)), replace(setting, lamps=rows)


def render_frame(
    plan: Plan,
    with_background: bool = False,
    accept: Callable[[Sequence[Truth]], bool] | None = None,
    surround: Street | None = None,
) -> SynthFrame | None:
    """Render a plan; with_background: also the street without its actors and their shadows. None where
    `accept` is given and turns the truths down, which is known before anything is shaded. surround: the plan's,
    if available.
    """
    setting, view = plan.setting, plan.setting.view
    seed, _, attempt = plan.origin
    surround = surround or build_street(plan)
    street, soups, setting, empty_setting = _lit(plan, surround.soup, actor_soups(plan))
    shadows = [Shadow(a.position_xz, a.yaw, a.size_lhw) for a in plan.actors]
    world = join([street, *soups])
    sight = see(world, view)
    truths = measure(plan.actors, soups, sight.owner, view)
    if accept is not None and not accept(truths):
        return None
    picture = render(sight, world, shadows, setting)
    plain = see(street, view) if with_background else None
    empty = None if plain is None else render_without_actors(plain, picture, empty_setting)
    behind = plain or sight
    closest = kernels.nearest(sight.depth)
    # Of an actor with no more than a few samples there is no truth, and so no instance. Owner -1, the sky, reads
    # the last.
    tracked = {truth.actor.track for truth in truths}
    tracks = np.array([0, *(a.track + 1 if a.track in tracked else 0 for a in plan.actors), 0], np.uint16)
    vehicles = {t.actor.model for t in truths if t.actor.label in ("Car", "Van", "Truck")}
    return SynthFrame(
        image=picture.image,
        background=None if empty is None else empty.image,
        background_depth_m=None if plain is None else plain.depth_m,
        labels=labels_from_truths(truths),
        truths=tuple(truths),
        depth_m=sight.depth.reshape(-1)[closest],
        semantic=sight.semantic.reshape(-1)[closest],
        instance=tracks[sight.owner.reshape(-1)[closest]],
        owner=sight.owner,
        ground_material=blocks(behind.material)[0],
        setting=setting,
        environment=_environment(behind, setting),
        manifest={
            "seed": seed,
            "index": setting.grain_seed[1],
            "split": plan.split,
            "attempt": attempt,
            "road": setting.road.kind,
            "weather": setting.light.weather,
            "variation": plan.variation,
            "time_s": round(plan.time_s, 6),
            **({"night": round(setting.light.night, 6)} if setting.light.night else {}),
            "vehicles": sorted(vehicles),
            **surround.used,
        },
    )


def generate_frame(
    seed: int,
    index: int,
    split: str = "train",
    settings: SynthSettings | None = None,
    with_background: bool = False,
) -> SynthFrame:
    """Frame `index` of the stream `seed` of a split ("train" or "heldout"): same arguments, same bytes.

    with_background: also render the street without its actors and their shadows. Raises RangeError for an unknown
    split.
    """
    frame = render_frame(plan_frame(seed, index, split, settings), with_background)
    assert frame is not None
    return frame
