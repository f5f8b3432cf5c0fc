"""Settings as text: a YAML preset, the config.yaml of a run, a command line."""

from __future__ import annotations

import dataclasses
import math
import shlex
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml

from drivesem.settings.commands import Command
from drivesem.settings.errors import UsageError


def command_line(command: str, config: Command, presentation: Collection[str] = ()) -> str:
    """The command line that gives this configuration, without the settings named in `presentation`."""
    words = ["drivesem", command]
    for setting in dataclasses.fields(config):
        value = getattr(config, setting.name)
        if value == setting.default or setting.name in presentation:
            continue
        flag = setting.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            words += [f"--{flag}", str(value)]
    return shlex.join(words)


def yaml_arguments(path: str, command: type[Command]) -> list[str]:
    """The settings of a YAML preset as command-line words, so that both are checked by one parser.

    Raises UsageError naming the file, and the key where there is one.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(path, "a readable YAML file", error) from error
    try:
        loaded: Any = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise UsageError(path, "YAML", " ".join(str(error).split())) from error
    if loaded is None:
        return []
    if not isinstance(loaded, dict):
        raise UsageError(path, "a mapping of settings", type(loaded).__name__)
    fields = {f.name: f for f in dataclasses.fields(command)}
    words: list[str] = []
    for key, value in loaded.items():
        name = str(key).replace("-", "_")
        if name not in fields:
            raise UsageError(f"{path}: {key}", f"one of {', '.join(fields)}", "an unknown key")
        words += _words(path, fields[name], value)
    return words


def _words(path: str, field: dataclasses.Field[Any], value: Any) -> list[str]:
    flag = field.name.replace("_", "-")
    kind = str(field.type)
    if kind in ("Flag", "bool"):
        if not isinstance(value, bool):
            raise UsageError(f"{path}: {field.name}", "true or false", repr(value))
        if value:
            return [f"--{flag}"]
        return [f"--no-{flag}"] if kind == "bool" else []
    if kind == "Repeated" and isinstance(value, list):
        return [f"--{flag}={item}" for item in value]
    if isinstance(value, list | tuple):
        value = ",".join(str(item) for item in value)
    if isinstance(value, dict) or (isinstance(value, float) and not math.isfinite(value)):
        raise UsageError(f"{path}: {field.name}", "one value", repr(value))
    # "=": a value that begins with a dash stays a value.
    return [f"--{flag}={value}"]


def to_yaml(config: Command) -> str:
    """The resolved configuration, as it is written beside the results."""
    return yaml.safe_dump(dataclasses.asdict(config), sort_keys=False)
