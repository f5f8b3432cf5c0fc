"""Edits of a scene as text: one grammar for generated streets, scene folders and the command line.

An edit of one frame, as YAML or as nested mappings:

    weather: {fog: 0.5}             # codes in [0, 1]: fog, rain, time, overcast, night, snow; or a name, such as sunset
    foliage: {hue: 0.4}             # codes in [-1, 1]: hue, lightness, density
    sun: {azimuth: -0.5}            # codes in [-1, 1]: azimuth, elevation, strength
    drops: 0.5                      # drops on the windscreen, in [0, 1]
    objects:
      2: {translate: [0.5m, 0m], rotate: 10deg}
      4: {color: [0.3, 0, -0.5, 0, 0], mesh: [...]}   # as theta has them: 5 codes, 96 lattice offsets
      3: {size: 5%}                 # larger by so much, on its wheels; -5% is smaller
      1: {lamps: brake}             # off, auto (as the weather makes drivers do it), brake, or a code in [-1, 1]
      6: {mesh: 60%}                # drivesem edit --photographed: of the shape that the scene's vehicle has
      5: {remove: true}
      all: {rotate: 0.05}

translate is along the vehicle's length and across to its left (+z of its own axes), on the ground; rotate is about
its ground centre. Text needs a unit: m, deg, rad or %. A bare number of a YAML file is in theta's units: own
lengths, rad, shares. On the command line everything is text: `objects[2].translate=0.5m,0m`, `weather=fog`,
`weather=fog=0.6,night=1`, `weather.rain=0.4`, `drops=0.5`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.ffd import SYMMETRIC_DIM
from scene_ir.types import CLOTHES_DIM, TEXTURE_DIM, Weather

ALL = "all"
WEATHER_CODES = tuple(code.name.lower() for code in Weather)
FOLIAGE_CODES = ("hue", "lightness", "density")
SUN_CODES = ("azimuth", "elevation", "strength")
WEATHER_PRESETS: Mapping[str, Mapping[str, float]] = {
    "fog": {"fog": 0.6, "overcast": 0.8},
    "rain": {"rain": 0.8, "overcast": 1.0},
    "sunset": {"time": 0.5},
    "overcast": {"overcast": 1.0},
    "twilight": {"time": 1.0},
    "night": {"night": 1.0, "overcast": 0.3},
    "snow": {"snow": 0.6},
}
"""Weather codes by name; all others are 0."""
OBJECT_KEYS = ("translate", "rotate", "color", "mesh", "size", "lamps", "remove")
LAMPS: Mapping[str, float] = {"off": -1.0, "auto": 0.0, "brake": 1.0}
"""Codes of lamps by name."""
FRAME_KEYS = ("objects", "weather", "foliage", "sun", "drops")
LENGTH_UNITS = {"m": 1.0}
ANGLE_UNITS = {"deg": math.pi / 180, "rad": 1.0}
FRACTION_UNITS = {"%": 0.01}
MAX_SIZE_CHANGE = 0.5
"""Largest growth or shrinkage of a vehicle, as a fraction."""
_PLACE = re.compile(r"objects\[([^\]]*)\]\.(\w+)|(weather|drops)|(weather|foliage|sun)\.(\w+)")
_BOOLEANS = {"true": True, "false": False}


@dataclass(frozen=True, slots=True)
class ObjectEdit:
    """A change of one vehicle."""

    translate: tuple[float, float] = (0.0, 0.0)
    """Shift along the heading and to the left, in own lengths."""
    translate_m: tuple[float, float] = (0.0, 0.0)
    """The same in metres; both add up."""
    rotate: float = 0.0
    """Turn about the ground centre, rad."""
    color: tuple[float, ...] = (0.0,) * TEXTURE_DIM
    """The texture code (5,), or (8,) of a pedestrian, in [-1, 1]."""
    mesh: tuple[float, ...] = ()
    """Independent lattice offsets (96,), or none."""
    size: float = 0.0
    """Growth, as a fraction."""
    remove: bool = False
    """Whether the vehicle and its shadow are removed."""
    mesh_fraction: float = 0.0
    """Fraction, 0 to 1, of the deformation that the scene already has."""
    lamps: float = 0.0
    """Code of the lamps, in [-1, 1]."""

    def __post_init__(self) -> None:
        if len(self.color) not in (TEXTURE_DIM, CLOTHES_DIM) or not all(-1 <= c <= 1 for c in self.color):
            expected = f"{TEXTURE_DIM} codes in [-1, 1], or {CLOTHES_DIM} for a pedestrian"
            raise RangeError("edit color", expected, list(self.color))
        if len(self.mesh) not in (0, SYMMETRIC_DIM):
            raise RangeError("edit mesh", f"{SYMMETRIC_DIM} lattice offsets", len(self.mesh))
        if not -1 <= self.lamps <= 1:
            raise RangeError("edit lamps", f"{', '.join(LAMPS)}, or a code in [-1, 1]", self.lamps)
        if not abs(self.size) <= MAX_SIZE_CHANGE:
            raise RangeError("edit size", f"a change of at most {MAX_SIZE_CHANGE:.0%} either way", self.size)
        if not 0 <= self.mesh_fraction <= 1:
            raise RangeError("edit mesh", "a fraction from 0% to 100%", self.mesh_fraction)


@dataclass(frozen=True, slots=True)
class FrameEdit:
    """A change of one frame."""

    objects: Mapping[int | str, ObjectEdit] = field(default_factory=dict)
    """Changes of vehicles by track (generated streets) or row (scenes), or of "all"."""
    weather: tuple[float, ...] = (0.0,) * len(WEATHER_CODES)
    """Weather codes (6,), in [0, 1]."""
    foliage: tuple[float, ...] = (0.0,) * len(FOLIAGE_CODES)
    """Foliage codes (3,), in [-1, 1]."""
    sun: tuple[float, ...] = (0.0,) * len(SUN_CODES)
    """Sun codes (3,), in [-1, 1]."""
    drops: float = 0.0
    """Drops on the windscreen, in [0, 1]."""


Edits = Mapping[int | str, FrameEdit]
"""Edits by frame number, or "all"."""


def read_edits(path: Path) -> Edits:
    """The edits of a YAML file `frames: {all: ..., 3: ...}`, each in the form of this module.

    Raises FormatError with the file and the place in it.
    """
    frames = require_mapping(f"{path}", files.read_yaml(path), ("frames",)).get("frames", {})
    edits: dict[int | str, FrameEdit] = {}
    for key, value in require_mapping(f"{path}: frames", frames).items():
        number = _number_or_all(f"{path}: frames", key)
        edits[number] = parse_frame_edit(f"{path}: frame {number}", value)
    return edits


def read_frame_edit(path: Path) -> dict[str, Any]:
    """The checked mappings of a YAML file of one frame's edit. Raises FormatError."""
    loaded = files.read_yaml(path)
    content = {} if loaded is None else require_mapping(str(path), loaded, FRAME_KEYS)
    parse_frame_edit(str(path), content)
    return content


def parse_setting(text: str, setting: str = "--set") -> dict[str, Any]:
    """`objects[2].translate=0.5m,0m`, `weather=fog`, `foliage.hue=0.5` as checked nested mappings.

    Raises FormatError with `setting`, the option that gave the text.
    """
    place, equals, value = (part.strip() for part in text.partition("="))
    match = _PLACE.fullmatch(place)
    if not equals or not value or match is None:
        raise FormatError(
            f"{setting} {text}",
            f"objects[N].{'|'.join(OBJECT_KEYS)}=..., weather[.CODE]=..., foliage.CODE=..., sun.CODE=... or drops=...",
            "no value" if match is not None else "an unknown parameter",
        )
    row, parameter, whole, environment, code = match.groups()
    change: dict[str, Any]
    if whole is not None:
        change = {whole: value}
    elif environment is not None:
        change = {environment: {code: value}}
    else:
        number: int | str = int(row) if row.isascii() and row.isdigit() else row
        change = {"objects": {number: {parameter: _split_value(parameter, value)}}}
    parse_frame_edit(f"{setting} {text}", change)
    return change


def _split_value(parameter: str, value: str) -> Any:
    if parameter in ("translate", "color") or (parameter == "mesh" and "%" not in value):
        return [part.strip() for part in value.split(",")]
    return _BOOLEANS.get(value, value) if parameter == "remove" else value


def merge_edits(first: Mapping[Any, Any], second: Mapping[Any, Any]) -> dict[Any, Any]:
    """Two edits as one mapping; the second overrides the first."""
    edit = dict(first)
    for key, value in second.items():
        before = edit.get(key)
        if key == "weather":
            before, value = _weather(before), _weather(value)
        both = isinstance(before, Mapping) and isinstance(value, Mapping)
        edit[key] = merge_edits(before, value) if both and before is not None else value
    return edit


def _weather(value: Any) -> Any:
    """A weather's name, or amounts such as "fog=0.6,night=1", as all codes, so that they replace earlier ones."""
    if not isinstance(value, str):
        return value
    named = WEATHER_PRESETS.get(value)
    if named is None:
        pairs = [part.partition("=") for part in value.split(",")]
        if not all(equals for _, equals, _ in pairs):
            return value
        named = {name.strip(): amount.strip() for name, _, amount in pairs}
    return {**dict.fromkeys(WEATHER_CODES, 0.0), **named}


def parse_frame_edit(where: str, value: Any) -> FrameEdit:
    """The edit that nested mappings describe. Raises FormatError with `where` and the place in them."""
    entry = require_mapping(where, value, FRAME_KEYS)
    objects = require_mapping(f"{where}: objects", entry.get("objects") or {})
    weather = _weather(entry.get("weather"))
    if isinstance(weather, str):
        expected = f"codes such as fog=0.6,night=1, or one of {', '.join(WEATHER_PRESETS)}"
        raise FormatError(f"{where}: weather", expected, repr(weather))
    return FrameEdit(
        objects={
            _number_or_all(f"{where}: objects", key): _object_edit(f"{where}: object {key}", edit)
            for key, edit in objects.items()
        },
        weather=_codes(f"{where}: weather", weather, WEATHER_CODES, 0.0),
        foliage=_codes(f"{where}: foliage", entry.get("foliage"), FOLIAGE_CODES, -1.0),
        sun=_codes(f"{where}: sun", entry.get("sun"), SUN_CODES, -1.0),
        drops=_code(f"{where}: drops", entry.get("drops", 0.0), 0.0),
    )


def _object_edit(where: str, value: Any) -> ObjectEdit:
    entry = require_mapping(where, value, OBJECT_KEYS)
    own, metres = [0.0, 0.0], [0.0, 0.0]
    for i, item in enumerate(_list(f"{where}: translate", entry.get("translate", [0, 0]), 2)):
        if isinstance(item, str):
            metres[i] = parse_measure(f"{where}: translate", item, LENGTH_UNITS)
        else:
            own[i] = parse_finite_number(f"{where}: translate", item)
    mesh = entry.get("mesh")
    share = 0.0
    if isinstance(mesh, str):
        mesh, share = None, parse_measure(f"{where}: mesh", mesh, FRACTION_UNITS)
    remove = entry.get("remove", False)
    if not isinstance(remove, bool):
        raise FormatError(f"{where}: remove", "true or false", repr(remove))
    try:
        return ObjectEdit(
            translate=(own[0], own[1]),
            translate_m=(metres[0], metres[1]),
            rotate=_angle(f"{where}: rotate", entry.get("rotate", 0)),
            color=_floats(f"{where}: color", entry.get("color", [0] * TEXTURE_DIM), TEXTURE_DIM, CLOTHES_DIM),
            mesh=() if mesh in (None, []) else _floats(f"{where}: mesh", mesh, SYMMETRIC_DIM),
            size=_fraction(f"{where}: size", entry.get("size", 0)),
            remove=remove,
            mesh_fraction=share,
            lamps=_lamps(f"{where}: lamps", entry.get("lamps", 0.0)),
        )
    except RangeError as error:
        raise FormatError(where, error.expected, error.actual) from error


def _lamps(where: str, value: Any) -> float:
    # YAML reads off as false
    if value is False or (isinstance(value, str) and value in LAMPS):
        return LAMPS["off" if value is False else value]
    try:
        return parse_finite_number(where, value)
    except FormatError as error:
        raise FormatError(where, f"{', '.join(LAMPS)}, or a code in [-1, 1]", error.actual) from error


def require_mapping(where: str, value: Any, known: Sequence[str] | None = None) -> dict[Any, Any]:
    """Return a value that is a mapping.

    Args:
        where: File and place, for errors.
        value: The value.
        known: Its allowed keys; all if None.

    Raises:
        FormatError: For another type, or an unknown key.
    """
    if not isinstance(value, dict):
        raise FormatError(where, "a mapping", type(value).__name__)
    for key in value:
        if known is not None and key not in known:
            raise FormatError(f"{where}: {key}", f"one of {', '.join(known)}", "an unknown key")
    return value


def _list(where: str, value: Any, *lengths: int) -> Sequence[Any]:
    if not isinstance(value, list | tuple) or len(value) not in lengths:
        raise FormatError(where, f"a list of {' or '.join(map(str, lengths))}", repr(value))
    return value


def _floats(where: str, value: Any, *lengths: int) -> tuple[float, ...]:
    return tuple(parse_finite_number(where, item) for item in _list(where, value, *lengths))


def parse_finite_number(where: str, value: Any) -> float:
    """`value` as a finite number. Raises FormatError."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not math.isfinite(number):
        raise FormatError(where, "a finite number", repr(value))
    return number


def _angle(where: str, value: Any) -> float:
    return (
        parse_measure(where, value, ANGLE_UNITS) if isinstance(value, str) else parse_finite_number(where, value)
    )


def _fraction(where: str, value: Any) -> float:
    return (
        parse_measure(where, value, FRACTION_UNITS)
        if isinstance(value, str)
        else parse_finite_number(where, value)
    )


def parse_measure(where: str, text: str, units: Mapping[str, float]) -> float:
    """The value of a text with a unit, such as 10deg; 0 needs none.

    Args:
        where: File and place, for errors.
        text: Number and unit.
        units: Factor of each unit.

    Raises:
        FormatError: For another unit, or no number.
    """
    for unit, factor in units.items():
        if text.strip().endswith(unit):
            return parse_finite_number(where, text.strip().removesuffix(unit)) * factor
    if parse_finite_number(where, text) != 0:
        raise FormatError(where, f"a unit: {' or '.join(text.strip() + unit for unit in units)}", repr(text))
    return 0.0


def _number_or_all(where: str, key: Any) -> int | str:
    if key == ALL or (isinstance(key, int) and not isinstance(key, bool) and key >= 0):
        return key
    raise FormatError(where, "a number from 0, or all", repr(key))


def _codes(where: str, value: Any, names: tuple[str, ...], low: float) -> tuple[float, ...]:
    entry = require_mapping(where, {} if value is None else value, names)
    return tuple(_code(f"{where}.{name}", entry.get(name, 0.0), low) for name in names)


def _code(where: str, value: Any, low: float) -> float:
    code = parse_finite_number(where, value)
    if not low <= code <= 1:
        raise FormatError(where, f"a code in [{low:g}, 1]", code)
    return code
