"""Edits of generated scenes: vehicles moved, turned, bent, painted, removed; other weather and foliage.

The generator renders the edited world itself, so that what de-rendering and attacks make of an edit can be held
against the truth. A file of edits is YAML, each frame's entry as `drivesem.config.edits` has it:

    frames:
      all:                              # every frame, or a frame's number
        weather: {fog: 0.5}
      3:
        objects:
          2: {translate: [0.5m, 0m], rotate: 10deg}
          5: {remove: true}

Objects are numbered by their track (`manifest.json`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from drivesem.config.edits import ALL, Edits, FrameEdit, ObjectEdit, read_edits
from drivesem.synth.frames import Plan, stream
from drivesem.synth.lamps import darken, lamps_on, open_lens
from drivesem.synth.layout import Actor
from drivesem.synth.light import Light
from scene_ir.errors import RangeError
from scene_ir.ffd import from_symmetric
from scene_ir.render.environment import low_sun_share, move_sun, time_gain
from scene_ir.render.model import FOG_EXTINCTION_PER_M, RAIN_EXTINCTION_PER_M, SUN_STRENGTH, TWILIGHT_SKY
from scene_ir.render.texture import apply_texture_code
from scene_ir.types import TEXTURE_DIM, Weather

__all__ = ["ALL", "Edits", "FrameEdit", "ObjectEdit", "apply_edit", "apply_edits", "draw_night", "read_edits"]

_GAMMA = 2.2
"""Display values to linear light."""
_CLOSED_SKY = 1.15
"""Light of a closed sky, relative to the mean light at the horizon of a clear one."""
_SNOW_PER_M, _SNOW_COVER = 0.003, 0.95
"""Extinction and clouds of snow 1: moderate snow."""
_WET_NIGHTS, _BRAKING, _UNLIT = 0.3, 0.25, 0.03
"""Shares of nights in rain, and of drivers who brake or have no lamps on."""


def apply_edits(plan: Plan, edits: Edits, frame: int) -> Plan:
    """The plan as the edits for all frames, then those for this frame, leave it. RangeError for an unknown
    track."""
    for key in (ALL, frame):
        if key in edits:
            plan = apply_edit(plan, edits[key], f"frame {key}")
    return plan


def draw_night(plan: Plan, share: float) -> Plan:
    """The plan, by night in a share of streets: under other clouds, some in rain; of drivers who stand or drive, some
    brake and a few have forgotten their lamps.
    """
    seed, street, attempt = plan.origin
    rng = stream(seed, street, plan.split, 16 * attempt + 7)
    if rng.random() >= share:
        return plan
    rain = float(rng.uniform(0.3, 1.0)) if rng.random() < _WET_NIGHTS else 0.0
    weather = [0.0] * len(Weather)
    weather[Weather.NIGHT], weather[Weather.RAIN] = float(rng.uniform(0.75, 1.0)), rain
    weather[Weather.OVERCAST] = float(rng.uniform(0.5, 1.0)) if rain else float(rng.uniform(0.0, 1.0))
    lamps: dict[int | str, ObjectEdit] = {}
    for actor in plan.actors:
        chance, amount = float(rng.random()), float(rng.uniform(0.3, 1.0))
        if not actor.parked and chance < _BRAKING + _UNLIT:
            lamps[actor.track] = ObjectEdit(lamps=amount if chance < _BRAKING else -1.0)
    return apply_edit(plan, FrameEdit(objects=lamps, weather=tuple(weather)))


def apply_edit(plan: Plan, edit: FrameEdit, where: str = "edit") -> Plan:
    """The plan after one edit. Raises RangeError for drops, and for a track that the plan does not have."""
    if edit.drops:
        raise RangeError(f"{where}: drops", "0: generated streets have no windscreen", edit.drops)
    known = {actor.track for actor in plan.actors}
    for track in edit.objects:
        if track != ALL and track not in known:
            raise RangeError(f"{where}: object {track}", f"a track among {sorted(known)}", track)
    actors = []
    for actor in plan.actors:
        changed: Actor | None = actor
        for key in (ALL, actor.track):
            if key in edit.objects and changed is not None:
                changed = _edited(changed, edit.objects[key])
        if changed is not None:
            actors.append(changed)
    light = _weathered(_under_sun(plan.setting.light, edit.sun), edit.weather)
    response = open_lens(plan.setting.response, light.night)
    rain = edit.weather[Weather.RAIN]
    if rain > 0:
        response = replace(response, streaks=min(response.streaks + 0.8 * rain, 1.0))
    foliage = tuple(a + b for a, b in zip(plan.foliage, edit.foliage, strict=True))
    setting = replace(plan.setting, light=light, response=response)
    on = max(plan.drivers_lamps, lamps_on(edit.weather))
    return replace(plan, actors=tuple(actors), setting=setting, foliage=foliage, drivers_lamps=on)


def _edited(actor: Actor, edit: ObjectEdit) -> Actor | None:
    if edit.remove:
        return None
    if edit.mesh_fraction:
        expected = "lattice offsets; a generated vehicle has no other shape to take a share of"
        raise RangeError(f"object {actor.track}: mesh", expected, f"{edit.mesh_fraction:.0%}")
    if any(edit.color[TEXTURE_DIM:]):
        expected = f"{TEXTURE_DIM} codes; clothes of generated people are as generated"
        raise RangeError(f"object {actor.track}: color", expected, f"{len(edit.color)} codes")
    length = actor.size_lhw[0]
    along, across = (a * length + b for a, b in zip(edit.translate, edit.translate_m, strict=True))
    cos, sin = math.cos(actor.yaw), math.sin(actor.yaw)
    x, z = actor.position_xz
    long, high, wide = (side * (1 + edit.size) for side in actor.size_lhw)
    bent = actor.ffd
    if edit.mesh:
        added = from_symmetric(torch.tensor(edit.mesh, dtype=torch.float64)).reshape(-1)
        before = torch.tensor(actor.ffd or (0.0,), dtype=torch.float64)
        bent = tuple((before + added).tolist())
    return replace(
        actor,
        position_xz=(x + along * cos + across * sin, z - along * sin + across * cos),
        yaw=(actor.yaw + edit.rotate + math.pi) % (2 * math.pi) - math.pi,
        paint=_painted(actor.paint, edit.color[:TEXTURE_DIM]),
        ffd=bent,
        size_lhw=(long, high, wide),
        lamps=max(-1.0, min(actor.lamps + edit.lamps, 1.0)),
    )


def _painted(paint: tuple[float, float, float], code: tuple[float, ...]) -> tuple[float, float, float]:
    """Linear albedo of a paint under a texture code, as the compositor changes it in the picture."""
    if not any(code):
        return paint
    display_colour = torch.tensor([paint], dtype=torch.float64).clamp(0, 1) ** (1 / _GAMMA)
    one = torch.ones(1, dtype=torch.float64)
    row = torch.tensor([code], dtype=torch.float64)
    changed = apply_texture_code(display_colour, one, row, one, 0.5 * one, 50.0 * one)[0]
    red, green, blue = (changed.clamp(0.0, 1.0) ** _GAMMA).tolist()
    return red, green, blue


def _under_sun(light: Light, code: tuple[float, ...]) -> Light:
    """Light under a light code: the sun moved as the compositor moves it, its light as much stronger."""
    if not any(code):
        return light
    sun, up, change = (
        torch.tensor(np.asarray(value), dtype=torch.float64) for value in (light.sun, light.up, code)
    )
    strength = 1 + SUN_STRENGTH * code[2]
    return replace(light, sun=move_sun(sun, up, change).numpy(), sun_colour=light.sun_colour * strength)


def _weathered(light: Light, code: tuple[float, ...]) -> Light:
    """Light under a weather code: physical counterparts of what the compositor does to the picture."""
    if not any(code):
        return light
    fog, rain, time, overcast, snow = (
        code[w] for w in (Weather.FOG, Weather.RAIN, Weather.TIME, Weather.OVERCAST, Weather.SNOW)
    )
    overcast = 1 - (1 - overcast) * (1 - _SNOW_COVER * snow)
    cover = 1 - (1 - overcast) * (1 - 0.9 * rain) * (1 - 0.6 * fog)
    grey = float(np.mean(light.horizon)) * (1 - 0.3 * rain)
    low_sun = low_sun_share(*(torch.tensor(value, dtype=torch.float64) for value in (fog, rain, overcast)))
    gain = time_gain(torch.tensor(time, dtype=torch.float64), low_sun).numpy()
    daylight = (1 + gain) ** _GAMMA
    skylight = (1 + gain + np.array(TWILIGHT_SKY) * time * time) ** _GAMMA

    def toward(value: np.ndarray, target: np.ndarray | float, share: np.ndarray = skylight) -> np.ndarray:
        return (value + cover * (target - value)) * share

    sun_lost = light.sun_colour * max(float(light.sun @ light.up), 0.0)
    light = replace(
        light,
        sun_colour=light.sun_colour * (1 - cover) * daylight,
        zenith=toward(light.zenith, _CLOSED_SKY * grey),
        horizon=toward(light.horizon, _CLOSED_SKY * grey),
        ambient=toward(light.ambient, float(np.mean(light.ambient + 0.45 * sun_lost)), daylight),
        clouds=max(light.clouds, cover),
        haze_per_m=light.haze_per_m
        + FOG_EXTINCTION_PER_M * fog
        + RAIN_EXTINCTION_PER_M * rain
        + _SNOW_PER_M * snow,
        wet=max(light.wet, rain),
        snow=max(light.snow, snow),
    )
    return darken(light, code)
