"""Presets: YAML files of options, those of `configs` by name; a wheel installs them as data files."""

from __future__ import annotations

import difflib
import json
import math
import sys
from collections.abc import Mapping
from dataclasses import Field, fields
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, NoReturn, get_type_hints

from drivesem.config.commands import COMMANDS
from drivesem.config.errors import UsageError
from drivesem.config.options import CommandConfig, option_name
from scene_ir.errors import FormatError

Commands = Mapping[str, type[CommandConfig]]
_INSTALLED = "share/drivesem/configs/"
"""Where pyproject.toml has a wheel put them."""
_FOR = "for"
"""Key of a preset: its commands. Options that only some of them have are left out for the others."""
_LIST = "list"
"""Value of --config that prints the presets."""


@cache
def find_presets() -> dict[str, Path]:
    """The shipped presets by name: those of the clone that this code is in, else the installed ones."""
    clone = Path(__file__).resolve().parents[2]
    if (clone / "pyproject.toml").is_file() and (clone / "configs").is_dir():
        paths = sorted((clone / "configs").glob("*.yaml"))
    else:
        paths = _find_installed()
    return {path.stem: path for path in paths}


def _find_installed() -> list[Path]:
    try:
        files = metadata.files("drivesem") or []
    except metadata.PackageNotFoundError:
        return []
    presets = (file for file in files if _INSTALLED in file.as_posix() and file.suffix == ".yaml")
    return sorted(Path(str(file.locate())).resolve() for file in presets)


def resolve_preset(name: str) -> str:
    """The file of `--config NAME`: a file, or a shipped preset, also as configs/NAME.yaml; else `name`."""
    path = Path(name)
    if path.exists():
        return name
    plain = path.stem if path.suffix in (".yaml", ".yml") else path.name
    if path.parent.name in ("", "configs") and plain in find_presets():
        return str(find_presets()[plain])
    return name


def expand_presets(command: str, words: list[str], commands: Commands) -> list[str]:
    """The words of a command line with the options of its presets, in front, in place of `--config NAME`.

    Args:
        command: Name of the command.
        words: Its words.
        commands: Settings classes by command name.

    Raises:
        UsageError: For a preset that does not exist, or cannot be used.
        SystemExit: With code 0 after `--config list`.
    """
    options: list[str] = []
    others: list[str] = []
    remaining = list(words)
    while remaining:
        word, equals, name = remaining.pop(0).partition("=")
        if word != "--config":
            others.append(word + equals + name)
            continue
        name = name if equals or not remaining else remaining.pop(0)
        if name == _LIST:
            _print_presets(command, as_json="--json" in words)
        if not name:
            raise UsageError("--config", _expected(command), "nothing")
        options += preset_words(name, command, commands)
    return options + others


def preset_words(name: str, command: str, commands: Commands) -> list[str]:
    """The options of a preset as words of a command line, so that one parser checks both.

    Args:
        name: A file, or a shipped preset's name.
        command: Name of the command that takes the options.
        commands: Settings classes by command name.

    Raises:
        UsageError: Names the file, and the key where there is one.
    """
    path = resolve_preset(name)
    if not Path(path).is_file():
        near = difflib.get_close_matches(name, _names_for(command), n=1)
        raise UsageError("--config", _expected(command), f"{name}; did you mean {near[0]}?" if near else name)
    values = _read_mapping(path)
    wanted = values.pop(_FOR, [])
    targets = [str(target) for target in (wanted if isinstance(wanted, list) else [wanted])]
    unknown = [target for target in targets if target not in COMMANDS]
    if unknown:
        raise UsageError(f"{path}: {_FOR}", f"commands: {', '.join(COMMANDS)}", ", ".join(unknown))
    if (
        targets and command not in targets and commands is COMMANDS
    ):  # the commands of tools take those of all others
        raise UsageError(path, f"a preset for {command}", f"one for {', '.join(targets)}")
    own = {field.name: field for field in fields(commands[command])}
    known = dict.fromkeys([*own, *(field.name for target in targets for field in fields(COMMANDS[target]))])
    positional = _positional_fields(commands[command])
    words: list[str] = []
    for key, value in values.items():
        field = str(key).replace("-", "_")
        if field not in known:
            raise UsageError(f"{path}: {key}", f"one of {', '.join(known)}", "an unknown key")
        if field in positional and value not in (None, []):
            raise UsageError(f"{path}: {key}", "no value: the command line gives it, without an option", value)
        if field in own and field not in positional:
            words += _option_words(path, own[field], value)
    return words


def _print_presets(command: str, as_json: bool) -> NoReturn:
    rows = [(name, _describe(find_presets()[name]), str(find_presets()[name])) for name in _names_for(command)]
    if as_json:
        keys = ("name", "about", "file")
        text = json.dumps({"presets": [dict(zip(keys, row, strict=True)) for row in rows]}) + "\n"
    else:
        text = "".join(f"{name:<28} {about}\n" for name, about, _ in rows) or f"no presets for {command}\n"
    sys.stdout.write(text)
    raise SystemExit(0)


def _describe(path: Path) -> str:
    """The comment at the beginning of a preset."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = lines[: next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))]
    return " ".join(line.removeprefix("#").strip() for line in comment)


def _names_for(command: str) -> list[str]:
    return [name for name, path in find_presets().items() if command in preset_commands(str(path))]


def preset_commands(path: str) -> list[str]:
    """The commands that a preset is for; empty if it names none. Raises UsageError if it cannot be read."""
    wanted = _read_mapping(path).get(_FOR, [])
    return [str(name) for name in wanted] if isinstance(wanted, list) else [str(wanted)]


def _expected(command: str) -> str:
    names = _names_for(command)
    return "a YAML file" + (f", or a preset: {', '.join(names)}" if names else "")


def _read_mapping(path: str) -> dict[Any, Any]:
    from scene_ir import files  # which needs numpy, and --help does not

    try:
        values: Any = files.read_yaml(Path(path))
    except FormatError as error:
        raise UsageError(error.field, error.expected, error.actual) from error
    if values is not None and not isinstance(values, dict):
        raise UsageError(path, "a mapping of options", type(values).__name__)
    return values or {}


def _positional_fields(kind: type[CommandConfig]) -> set[str]:
    """Fields that the command line gives without an option."""
    hints = get_type_hints(kind, include_extras=True)
    return {name for name, hint in hints.items() if "Positional" in repr(getattr(hint, "__metadata__", ()))}


def _option_words(path: str, field: Field[Any], value: Any) -> list[str]:
    kind = str(field.type)
    if isinstance(field.default, bool):
        if not isinstance(value, bool):
            raise UsageError(f"{path}: {field.name}", "true or false", repr(value))
        if value:
            return [option_name(field.name)]
        return [option_name(f"no-{field.name}")] if kind == "bool" else []
    if kind == "Repeated" and isinstance(value, list):
        return [f"{option_name(field.name)}={item}" for item in value]
    if isinstance(value, list | tuple):
        value = ",".join(str(item) for item in value)
    if isinstance(value, dict) or (isinstance(value, float) and not math.isfinite(value)):
        raise UsageError(f"{path}: {field.name}", "one value", repr(value))
    # "=": a value that begins with a dash stays a value.
    return [f"{option_name(field.name)}={value}"]
