"""Edits of generated scenes: vehicles moved, turned, bent, painted, removed; other weather and foliage.

The generator renders the edited world itself, so that what de-rendering and attacks make of an edit can be held
against the truth. A file of edits is YAML:

    frames:
      all:                              # every frame, or a frame's number
        weather: {fog: 0.5}             # codes in [0, 1]: fog, rain, time, overcast
        foliage: {hue: 0.4}             # codes in [-1, 1]: hue, lightness, density
      3:
        objects:
          2: {translate: [0.5m, 0m], rotate: 10deg}
          4: {color: [0.3, 0, -0.5, 0, 0], mesh: [...]}   # as theta has them: 5 codes, 96 lattice offsets
          5: {remove: true}
          all: {rotate: 0.05}

Objects are numbered by their track (`manifest.json`). translate is along the vehicle's length and across to its
left, in metres or in own lengths (a bare number); rotate in degrees or rad; both on the ground.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from drivesem.synth.frames import Plan
from drivesem.synth.layout import Actor
from drivesem.synth.light import Light
from scene_ir import files
from scene_ir.environment import FOG_EXTINCTION_PER_M, RAIN_EXTINCTION_PER_M
from scene_ir.errors import FormatError, RangeError
from scene_ir.ffd import SYMMETRIC_DIM, from_symmetric
from scene_ir.texture import apply_texture_code
from scene_ir.types import TEXTURE_DIM

ALL = "all"
WEATHER_NAMES = ("fog", "rain", "time", "overcast")
FOLIAGE_NAMES = ("hue", "lightness", "density")
_ANGLE_UNITS = {"deg": math.pi / 180, "rad": 1.0}


@dataclass(frozen=True, slots=True)
class ObjectEdit:
    """What happens to one vehicle. translate: (along, across), own lengths; translate_m: the same in metres; both
    add up. rotate: rad; color: the texture code (5,); mesh: independent lattice offsets (96,), or none.
    """

    translate: tuple[float, float] = (0.0, 0.0)
    translate_m: tuple[float, float] = (0.0, 0.0)
    rotate: float = 0.0
    color: tuple[float, ...] = (0.0,) * TEXTURE_DIM
    mesh: tuple[float, ...] = ()
    remove: bool = False

    def __post_init__(self) -> None:
        if len(self.color) != TEXTURE_DIM or not all(-1 <= c <= 1 for c in self.color):
            raise RangeError("edit color", f"{TEXTURE_DIM} codes in [-1, 1]", list(self.color))
        if len(self.mesh) not in (0, SYMMETRIC_DIM):
            raise RangeError("edit mesh", f"{SYMMETRIC_DIM} lattice offsets", len(self.mesh))


@dataclass(frozen=True, slots=True)
class FrameEdit:
    """What happens to one frame. objects: by track, or "all"; weather (4,) in [0, 1]; foliage (3,) in [-1, 1]."""

    objects: Mapping[int | str, ObjectEdit] = field(default_factory=dict)
    weather: tuple[float, ...] = (0.0,) * len(WEATHER_NAMES)
    foliage: tuple[float, ...] = (0.0,) * len(FOLIAGE_NAMES)


Edits = Mapping[int | str, FrameEdit]
"""Edits by frame number, or "all"."""


def apply_edits(plan: Plan, edits: Edits, frame: int) -> Plan:
    """The plan as the edits for all frames, then those for this frame, leave it. RangeError for an unknown
    track."""
    for key in (ALL, frame):
        if key in edits:
            plan = apply_edit(plan, edits[key], f"frame {key}")
    return plan


def apply_edit(plan: Plan, edit: FrameEdit, where: str = "edit") -> Plan:
    """The plan after one edit. Raises RangeError where it names a track that the plan does not have."""
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
    light = _weathered(plan.setting.light, edit.weather)
    response = plan.setting.response
    rain = edit.weather[1]
    if rain > 0:
        response = replace(response, streaks=min(response.streaks + 0.8 * rain, 1.0))
    foliage = tuple(a + b for a, b in zip(plan.foliage, edit.foliage, strict=True))
    setting = replace(plan.setting, light=light, response=response)
    return replace(plan, actors=tuple(actors), setting=setting, foliage=foliage)


def _edited(actor: Actor, edit: ObjectEdit) -> Actor | None:
    if edit.remove:
        return None
    length = actor.size_lhw[0]
    along, across = (a * length + b for a, b in zip(edit.translate, edit.translate_m, strict=True))
    cos, sin = math.cos(actor.yaw), math.sin(actor.yaw)
    x, z = actor.position_xz
    bent = actor.ffd
    if edit.mesh:
        added = from_symmetric(torch.tensor(edit.mesh, dtype=torch.float64)).reshape(-1)
        before = torch.tensor(actor.ffd or (0.0,), dtype=torch.float64)
        bent = tuple((before + added).tolist())
    return replace(
        actor,
        position_xz=(x + along * cos + across * sin, z - along * sin + across * cos),
        yaw=(actor.yaw + edit.rotate + math.pi) % (2 * math.pi) - math.pi,
        paint=_painted(actor.paint, edit.color),
        ffd=bent,
    )


def _painted(paint: tuple[float, float, float], code: tuple[float, ...]) -> tuple[float, float, float]:
    """Linear albedo of a paint under a texture code, as the compositor changes it in the picture."""
    if not any(code):
        return paint
    shown = torch.tensor([paint], dtype=torch.float64).clamp(0, 1) ** (1 / 2.2)
    one = torch.ones(1, dtype=torch.float64)
    row = torch.tensor([code], dtype=torch.float64)
    changed = apply_texture_code(shown, one, row, one, 0.5 * one, 50.0 * one)[0]
    red, green, blue = (changed.clamp(0.0, 1.0) ** 2.2).tolist()
    return red, green, blue


def _weathered(light: Light, code: tuple[float, ...]) -> Light:
    """Light under a weather code: physical counterparts of what the compositor does to the picture."""
    fog, rain, time, overcast = code
    if not any(code):
        return light
    cover = 1 - (1 - overcast) * (1 - 0.9 * rain) * (1 - 0.6 * fog)
    grey = float(np.mean(light.horizon)) * (1 - 0.3 * rain)
    night = np.exp(-np.array([2.0, 1.75, 1.25]) * time * time)
    warm = 1 + np.array([0.7, 0.12, -0.42]) * time * np.exp(-3.5 * time * time)

    def toward(value: np.ndarray, target: np.ndarray | float) -> np.ndarray:
        return (value + cover * (target - value)) * night * warm

    sun_lost = light.sun_colour * max(float(light.sun @ light.up), 0.0)
    return replace(
        light,
        sun_colour=light.sun_colour * (1 - cover) * night * warm,
        zenith=toward(light.zenith, 0.8 * grey),
        horizon=toward(light.horizon, grey),
        ambient=toward(light.ambient, float(np.mean(light.ambient + 0.45 * sun_lost))),
        clouds=max(light.clouds, cover),
        haze_per_m=light.haze_per_m + FOG_EXTINCTION_PER_M * fog + RAIN_EXTINCTION_PER_M * rain,
        wet=max(light.wet, rain),
    )


def read_edits(path: Path) -> Edits:
    """The edits in a YAML file. FormatError naming the file and the place in it."""
    try:
        loaded: Any = yaml.safe_load(files.read_text(path))
    except yaml.YAMLError as error:
        raise FormatError(str(path), "YAML", " ".join(str(error).split())) from error
    frames = _mapping(f"{path}", loaded, ("frames",)).get("frames", {})
    found: dict[int | str, FrameEdit] = {}
    for key, value in _mapping(f"{path}: frames", frames).items():
        number = _number_or_all(f"{path}: frames", key)
        where = f"{path}: frame {number}"
        entry = _mapping(where, value, ("objects", "weather", "foliage"))
        objects = _mapping(f"{where}: objects", entry.get("objects") or {})
        found[number] = FrameEdit(
            objects={
                _number_or_all(f"{where}: objects", track): _object_edit(f"{where}: object {track}", edit)
                for track, edit in objects.items()
            },
            weather=_codes(f"{where}: weather", entry.get("weather"), WEATHER_NAMES, 0.0),
            foliage=_codes(f"{where}: foliage", entry.get("foliage"), FOLIAGE_NAMES, -1.0),
        )
    return found


def _object_edit(where: str, value: Any) -> ObjectEdit:
    entry = _mapping(where, value, ("translate", "rotate", "color", "mesh", "remove"))
    own, metres = [0.0, 0.0], [0.0, 0.0]
    translate = _list(f"{where}: translate", entry.get("translate", [0, 0]), 2)
    for i, item in enumerate(translate):
        if isinstance(item, str) and item.strip().endswith("m"):
            metres[i] = _float(f"{where}: translate", item.strip().removesuffix("m"))
        else:
            own[i] = _float(f"{where}: translate", item)
    remove = entry.get("remove", False)
    if not isinstance(remove, bool):
        raise FormatError(f"{where}: remove", "true or false", repr(remove))
    try:
        return ObjectEdit(
            translate=(own[0], own[1]),
            translate_m=(metres[0], metres[1]),
            rotate=_angle(f"{where}: rotate", entry.get("rotate", 0)),
            color=tuple(
                _float(f"{where}: color", v) for v in _list(f"{where}: color", entry.get("color", [0] * 5), 5)
            ),
            mesh=tuple(
                _float(f"{where}: mesh", v)
                for v in _list(f"{where}: mesh", entry.get("mesh", []), SYMMETRIC_DIM, empty=True)
            ),
            remove=remove,
        )
    except RangeError as error:
        raise FormatError(where, error.expected, error.actual) from error


def _mapping(where: str, value: Any, known: tuple[str, ...] | None = None) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise FormatError(where, "a mapping", type(value).__name__)
    for key in value:
        if known is not None and key not in known:
            raise FormatError(f"{where}: {key}", f"one of {', '.join(known)}", "an unknown key")
    return value


def _list(where: str, value: Any, length: int, empty: bool = False) -> list[Any]:
    if not isinstance(value, list) or (len(value) != length and not (empty and not value)):
        raise FormatError(where, f"a list of {length}", repr(value))
    return value


def _float(where: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not math.isfinite(number):
        raise FormatError(where, "a finite number", repr(value))
    return number


def _angle(where: str, value: Any) -> float:
    if isinstance(value, str):
        for unit, factor in _ANGLE_UNITS.items():
            if value.strip().endswith(unit):
                return _float(where, value.strip().removesuffix(unit)) * factor
    return _float(where, value)


def _number_or_all(where: str, key: Any) -> int | str:
    if key == ALL or (isinstance(key, int) and not isinstance(key, bool) and key >= 0):
        return key
    raise FormatError(where, "a number from 0, or all", repr(key))


def _codes(where: str, value: Any, names: tuple[str, ...], low: float) -> tuple[float, ...]:
    entry = _mapping(where, value or {}, names)
    codes = tuple(_float(f"{where}.{name}", entry.get(name, 0.0)) for name in names)
    for name, code in zip(names, codes, strict=True):
        if not low <= code <= 1:
            raise FormatError(f"{where}.{name}", f"a code in [{low:g}, 1]", code)
    return codes
