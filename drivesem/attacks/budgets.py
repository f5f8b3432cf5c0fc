"""Budgets as text: a preset, a YAML file, or `translate=0.5m,rotate=5deg`, alone or after a preset that it narrows
(`street,translate=2m`).

A YAML file names the parameters with tighter limits than the paper's budget:

    translate: 0.5m     # maximum along and across; a bare number is in own lengths
    rotate: 5deg        # a bare number is in rad
    mesh: 0.1           # unit boxes
    color: 0.5          # codes, like weather and foliage
    night: 0.5          # the code of night alone, with street; 0 leaves night out; snow likewise
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from drivesem.attacks.feasibility_check import ChangeLimits
from drivesem.attacks.space import Budget, Parameter, Parametrisation, combo_parameters, parse_params
from drivesem.config.commands import DEFAULT_COMBO, AttackConfig
from drivesem.config.edits import (
    ANGLE_UNITS,
    FRACTION_UNITS,
    LENGTH_UNITS,
    parse_finite_number,
    parse_measure,
    require_mapping,
)
from drivesem.config.errors import UsageError
from scene_ir import files
from scene_ir.errors import FormatError

PAPER, PARKING, STREET = "paper", "parking", "street"
PRESETS: Mapping[str, Budget] = {
    PAPER: Budget(),
    # Differences in how a car is parked that no driver would notice.
    PARKING: Budget(translate_m=0.5, rotate=math.radians(5)),
    # As far as renders of moved cars are realistic: docs/guide/attack.md has the measurement.
    STREET: Budget(
        translate=1.5,
        translate_m=4.0,
        across_m=1.0,
        distance_share=0.3,
        partly_visible=0.25,
        walk_m=2.0,
        size=0.1,
        sun=1.0,
        night=1.0,
        snow=1.0,
        lamps=1.0,
    ),
}
_RARE = ("night", "snow")
"""Codes of weather with limits of their own."""
_LIMITS = (*(p.value for p in Parameter), *_RARE)
"""Limits that a text can set."""
_UNITS: Mapping[str, Mapping[str, float]] = {
    Parameter.TRANSLATE: LENGTH_UNITS,
    Parameter.ROTATE: ANGLE_UNITS,
    Parameter.SIZE: FRACTION_UNITS,
}


def parse_budget(text: str) -> Budget:
    """The budget of a preset's name, a YAML file, or NAME=VALUE with commas. Raises UsageError for anything else,
    and FormatError naming file or setting and the parameter.
    """
    if text in PRESETS:
        return PRESETS[text]
    if Path(text).suffix in (".yaml", ".yml") or Path(text).is_file():
        loaded = files.read_yaml(Path(text))
        return _narrow_budget(text, {} if loaded is None else loaded)
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
    return _narrow_budget(
        "--budget", {name.strip(): _parse_value(value) for name, _, value in pairs}, PRESETS[preset]
    )


def resolve_parameters(config: AttackConfig) -> tuple[Parameter, ...]:
    """The parameters that an attack moves. Raises FormatError where its budget fixes one of them."""
    params = (
        combo_parameters(config.combo or DEFAULT_COMBO) if config.params is None else parse_params(config.params)
    )
    parse_budget(config.budget).check(params, config.parametrisation)
    return params


def budget_for_coordinates(budget: Budget, names: Sequence[str]) -> Budget:
    """The budget of a recorded theta with these coordinates: runs made before there was night or snow have none."""
    missing = [code for code in _RARE if not any(name.endswith(f".{code}") for name in names)]
    return replace(budget, **dict.fromkeys(missing, 0.0))


def change_limits(budget: Budget, parametrisation: Parametrisation = "ground") -> ChangeLimits:
    """A budget as the independent feasibility check takes it."""
    return ChangeLimits(**asdict(budget), roi=parametrisation == "roi")


def format_budget(budget: Budget) -> str:
    """The text of a budget, independent of files: a preset's name, or NAME=VALUE with commas."""
    for name, preset in PRESETS.items():
        if budget == preset:
            return name
    preset = PAPER
    if budget.across_m == PRESETS[STREET].across_m:
        preset = STREET  # only this preset has a limit that no text can set
    elif budget.translate != PRESETS[PAPER].translate and budget.translate_m == PRESETS[PARKING].translate_m:
        preset = PARKING  # its limit in metres stays besides own lengths; a text has only one of the two
    widest = PRESETS[preset]
    changed = [name for name in _LIMITS if getattr(budget, name) != getattr(widest, name)]
    parts = {name: repr(getattr(budget, name)) for name in changed}
    if budget.translate_m != widest.translate_m:
        parts[Parameter.TRANSLATE.value] = f"{budget.translate_m!r}m"
    text = ",".join(f"{name}={value}" for name, value in parts.items())
    return text if preset == PAPER else f"{preset},{text}"


def _parse_value(text: str) -> float | str:
    """A number, or text with a unit."""
    try:
        return float(text)
    except ValueError:
        return text.strip()


def _narrow_budget(where: str, content: Any, preset: Budget = PRESETS[PAPER]) -> Budget:
    """The preset, narrowed by the entries of `content`; no limit may exceed the preset's."""
    entry = require_mapping(where, content, _LIMITS)
    limits: dict[str, float] = {}
    for name, value in entry.items():
        units = _UNITS.get(name)
        if units is not None and isinstance(value, str):
            limit = parse_measure(f"{where}: {name}", value, units)
            key = "translate_m" if name == Parameter.TRANSLATE else name
        else:
            limit, key = parse_finite_number(f"{where}: {name}", value), name
        widest = getattr(preset, key)
        if widest == 0:
            expected = f"{STREET},{name}={value}, since only {STREET} lets it change"
            raise FormatError(f"{where}: {name}", expected, value)
        if not (0 < limit <= widest or (name in _RARE and limit == 0)):
            maximum = "" if widest == math.inf else f" of at most {widest:g}"
            raise FormatError(f"{where}: {name}", f"a positive number{maximum}", value)
        limits[key] = limit
        if key == Parameter.TRANSLATE:
            limits["walk_m"] = 0.0  # own lengths limit people too
    return replace(preset, **limits)
