"""How far an attack may go, as people write it: a preset, a YAML file, or `translate=0.5m,rotate=5deg`, by itself
or after a preset that it narrows (`street,translate=2m`).

A YAML file names parameters, as far as they are to be held more tightly than the paper's budget does:

    translate: 0.5m     # at most, along and across; a bare number is in own lengths
    rotate: 5deg        # a bare number is in rad
    mesh: 0.1           # unit boxes
    color: 0.5          # codes, like weather and foliage
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from drivesem.attack.feasibility_check import Reach
from drivesem.attack.space import Budget, Parameter, Parametrisation
from drivesem.config.edits import (
    ANGLE_UNITS,
    LENGTH_UNITS,
    SHARE_UNITS,
    finite_number,
    mapping_of,
    measure,
)
from drivesem.config.errors import UsageError
from scene_ir import files
from scene_ir.errors import FormatError

PAPER, PARKING, STREET = "paper", "parking", "street"
PRESETS: Mapping[str, Budget] = {
    PAPER: Budget(),
    # What a parked car's place may well differ by, and no driver would notice.
    PARKING: Budget(translate_m=0.5, rotate=math.radians(5)),
    # Where pictures of moved cars still hold: docs/attacks.md has the measurement.
    STREET: Budget(translate=1.5, translate_m=4.0, across_m=1.0, of_distance=0.3, partly=0.25, size=0.1, sun=1.0),
}
_UNITS: Mapping[Parameter, Mapping[str, float]] = {
    Parameter.TRANSLATE: LENGTH_UNITS,
    Parameter.ROTATE: ANGLE_UNITS,
    Parameter.SIZE: SHARE_UNITS,
}


def budget_of(text: str) -> Budget:
    """The budget that a preset's name, a YAML file or NAME=VALUE with commas says.

    Raises UsageError where it is none of them, FormatError naming file or setting, and the parameter.
    """
    if text in PRESETS:
        return PRESETS[text]
    if Path(text).suffix in (".yaml", ".yml") or Path(text).is_file():
        loaded = files.read_yaml(Path(text))
        return _budget(text, {} if loaded is None else loaded)
    first, _, rest = text.partition(",")
    preset, narrowed = (first, rest) if first in PRESETS else (PAPER, text)
    if "=" not in narrowed:
        expected = f"{', '.join(PRESETS)}, a YAML file, or NAME=VALUE with commas"
        raise UsageError("--budget", expected, repr(text))
    pairs = [part.partition("=") for part in narrowed.split(",")]
    names = [name.strip() for name, _, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise FormatError(f"--budget: {name}", "each parameter once", text)
    return _budget("--budget", {name.strip(): _value(value) for name, _, value in pairs}, PRESETS[preset])


def reach_of(budget: Budget, parametrisation: Parametrisation = "ground") -> Reach:
    """The same budget, as the second check of feasibility takes it."""
    return Reach(**asdict(budget), roi=parametrisation == "roi")


def written(budget: Budget) -> str:
    """The text that gives this budget without any file: a preset's name, or NAME=VALUE with commas."""
    for name, preset in PRESETS.items():
        if budget == preset:
            return name
    preset = PAPER
    if budget.across_m == PRESETS[STREET].across_m:
        preset = STREET  # which alone has a bound that no budget can be given
    elif budget.translate != PRESETS[PAPER].translate and budget.translate_m == PRESETS[PARKING].translate_m:
        preset = PARKING  # whose metres stay beside own lengths; a text has but one of the two
    widest = PRESETS[preset]
    changed = [p.value for p in Parameter if getattr(budget, p.value) != getattr(widest, p.value)]
    parts = {name: repr(getattr(budget, name)) for name in changed}
    if budget.translate_m != widest.translate_m:
        parts[Parameter.TRANSLATE.value] = f"{budget.translate_m!r}m"
    text = ",".join(f"{name}={value}" for name, value in parts.items())
    return text if preset == PAPER else f"{preset},{text}"


def _value(text: str) -> float | str:
    """A number, or text with a unit."""
    try:
        return float(text)
    except ValueError:
        return text.strip()


def _budget(where: str, content: Any, preset: Budget = PRESETS[PAPER]) -> Budget:
    """The preset, narrowed: the pictures hold no further than it goes."""
    entry = mapping_of(where, content, [p.value for p in Parameter])
    limits: dict[str, float] = {}
    for name, value in entry.items():
        parameter = Parameter(name)
        units = _UNITS.get(parameter)
        if units is not None and isinstance(value, str):
            limit = measure(f"{where}: {name}", value, units)
            key = "translate_m" if parameter is Parameter.TRANSLATE else name
        else:
            limit, key = finite_number(f"{where}: {name}", value), name
        widest = getattr(preset, key)
        if widest == 0:
            held = f"{STREET},{name}={value}, since only {STREET} lets it change"
            raise FormatError(f"{where}: {name}", held, value)
        if not 0 < limit <= widest:
            most = "" if widest == math.inf else f" of at most {widest:g}"
            raise FormatError(f"{where}: {name}", f"a positive number{most}", value)
        limits[key] = limit
    return replace(preset, **limits)
