"""The words of a command line, and the YAML presets that they name, as a command's settings."""

from __future__ import annotations

import contextlib
import difflib
import io
import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import Field, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

import tyro

from drivesem.config.blocks import CommandConfig, option
from drivesem.config.commands import COMMANDS
from drivesem.config.errors import UsageError
from drivesem.config.help import command_help, overview
from drivesem.config.presets import preset_path, presets
from drivesem.version import __version__
from scene_ir.errors import FormatError

_HELP = ("--help", "-h")
_FOR = "for"
"""Key of a preset: the commands that it is for. A setting that only some of them have is left out for others."""


Commands = Mapping[str, type[CommandConfig]]


def parse(argv: Sequence[str], commands: Commands = COMMANDS, prog: str = "drivesem") -> CommandConfig:
    """The settings that `argv` gives.

    Args:
        argv: Words of the command line, without the program's name.
        commands: Settings classes by command name.
        prog: The program's name, for help and errors.

    Raises:
        UsageError: For an unknown command or option, or a bad value.
        SystemExit: With code 0 after `--help` and `--version`.
    """
    words = list(argv)
    if not words or words[0] in _HELP:
        sys.stdout.write(overview(commands, prog))
        raise SystemExit(0)
    if words[0] == "--version":
        sys.stdout.write(f"{prog} {__version__}\n")
        raise SystemExit(0)
    if words[0] in commands and any(word in _HELP for word in words[1:]):
        sys.stdout.write(command_help(words[0], commands, prog))
        raise SystemExit(0)
    if words[0] in commands:
        words = [words[0], *_with_presets(words[0], _with_run(words[0], words[1:], commands), commands)]
    elif not words[0].startswith("-"):
        raise UsageError(
            "command", f"one of {', '.join(commands)} ({prog} --help describes them)", _meant(words[0], commands)
        )
    captured = io.StringIO()
    try:
        with contextlib.redirect_stderr(captured):
            config: CommandConfig = tyro.extras.subcommand_cli_from_dict(  # pyright: ignore[reportAssignmentType]
                dict(commands), prog=prog, args=words
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        _refuse_unknown(words, commands, prog)
        raise _refused(f"{prog} {words[0]}", _unboxed(captured.getvalue())) from None
    named = {field.name: words[0] for field in fields(config) if str(field.type) == "CommandName"}
    config = replace(config, **named)
    config.check()
    return config


def _refuse_unknown(words: Sequence[str], commands: Commands, prog: str) -> None:
    """Raises UsageError for the first option that the command does not have."""
    if words[0] not in commands:
        return
    settings = fields(commands[words[0]])
    known = {"--help", *(option(field.name) for field in settings)}
    known |= {option(f"no-{field.name}") for field in settings if str(field.type) == "bool"}
    known |= _aliases(commands[words[0]])
    for word in words[1:]:
        name = word.partition("=")[0]
        if name.startswith("--") and name.replace("_", "-") not in known:
            expected = f"an option of {prog} {words[0]} (its --help lists them)"
            raise UsageError("command line", expected, _meant(name, known))


def _aliases(command: type[CommandConfig]) -> set[str]:
    """Other names of a command's options."""
    kinds = get_type_hints(command, include_extras=True).values()
    markers = (marker for kind in kinds for marker in getattr(kind, "__metadata__", ()))
    return {name for marker in markers for name in getattr(marker, "aliases", None) or ()}


def _positional(command: type[CommandConfig]) -> set[str]:
    """Settings of a command that are words without an option."""
    kinds = get_type_hints(command, include_extras=True)
    return {name for name, kind in kinds.items() if "Positional" in repr(getattr(kind, "__metadata__", ()))}


def _refused(command: str, text: str) -> UsageError:
    """The parser's own sentence, as field, expected and found where it is one of the usual ones."""
    choice = re.search(r"invalid choice '(.*?)' for argument '(.*?)'\. Expected one of \((.*?),?\)", text)
    if choice is not None:
        known = [name.strip(" '") for name in choice[3].split(",")]
        return UsageError(choice[2], f"one of {', '.join(known)}", _meant(choice[1], known))
    stray = re.search(r"Unrecognized options: (.*)", text)
    if stray is not None:
        return UsageError("command line", f"options of {command} (its --help lists them)", stray[1])
    missing = re.search(r"Required options.*? Missing from .*?: (\{[^}]*\}|[^\s,]+)", text)
    if missing is not None:
        return UsageError(missing[1], f"a value ({command} --help says which)", "none")
    return UsageError("command line", "known options (its --help lists them)", text)


def _meant(word: str, known: Iterable[str]) -> str:
    """A word, and what it may have been meant to be."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"{word}; did you mean {near[0]}?" if near else word


def _with_run(command: str, words: list[str], commands: Commands) -> list[str]:
    """The run that a question is asked of may stand first, without its option's name."""
    takes_runs = any(field.name == "run" for field in fields(commands[command]))
    if takes_runs and words and not words[0].startswith("-"):
        return [f"{option('run')}={words[0]}", *words[1:]]
    return words


def _with_presets(command: str, words: list[str], commands: Commands) -> list[str]:
    """Replace `--config FILE` by the file's settings, in front, so that the command line wins."""
    named: list[str] = []
    rest: list[str] = []
    left = list(words)
    while left:
        word, equals, path = left.pop(0).partition("=")
        if word == "--config":
            path = path if equals or not left else left.pop(0)
            if not path:
                raise UsageError("--config", _presets_for(command), "nothing")
            named += preset_words(path, command, commands)
        else:
            rest.append(f"{word}{equals}{path}")
    return named + rest


def _unboxed(text: str) -> str:
    """The parser's message without its frame, on one line."""
    lines = [line.strip("│╭╮╰╯─ \t") for line in text.splitlines()]
    message = " ".join(line for line in lines if line)
    message = re.split(r"For full helptext|Perhaps you meant", message)[0]
    return " ".join(message.split()) or "an unknown command"


def preset_words(path: str, command: str, commands: Commands = COMMANDS) -> list[str]:
    """The settings of a YAML preset as command-line words, so that both are checked by one parser.

    Raises UsageError naming the file, and the key where there is one.
    """
    given, path = path, preset_path(path)
    if not Path(path).is_file():
        raise UsageError("--config", _presets_for(command), _meant(given, _names_for(command)))
    loaded = _mapping(path)
    wanted = loaded.pop(_FOR, command)
    wanted_by = wanted if isinstance(wanted, list) else [wanted]
    if not all(name in {*COMMANDS, *commands} for name in wanted_by):
        raise UsageError(f"{path}: {_FOR}", f"commands: {', '.join(COMMANDS)}", repr(wanted))
    if command not in wanted_by:
        raise UsageError(path, f"a preset for drivesem {command}", f"one for {', '.join(wanted_by)}")
    own = {field.name: field for field in fields(commands[command])}
    known = dict.fromkeys(
        [*own, *(field.name for name in wanted_by for field in fields((dict(COMMANDS) | dict(commands))[name]))]
    )
    words: list[str] = []
    for key, value in loaded.items():
        name = str(key).replace("-", "_")
        if name not in known:
            raise UsageError(f"{path}: {key}", f"one of {', '.join(known)}", "an unknown key")
        if name in own and name not in _positional(commands[command]):
            words += _words(path, own[name], value)
        elif name in own and value not in (None, []):
            raise UsageError(f"{path}: {key}", "nothing: it stands on the command line, without an option", value)
    return words


def commands_of(path: str) -> list[str]:
    """The commands that a preset is for; none where it does not say. Raises UsageError where it cannot be read."""
    wanted = _mapping(path).get(_FOR, [])
    return [str(name) for name in wanted] if isinstance(wanted, list) else [str(wanted)]


def _names_for(command: str) -> list[str]:
    """The presets for a command."""
    return [name for name, path in presets().items() if command in commands_of(str(path))]


def _presets_for(command: str) -> str:
    """What --config takes."""
    names = _names_for(command)
    return "a YAML file" + (f", or a preset: {', '.join(names)}" if names else "")


def _mapping(path: str) -> dict[Any, Any]:
    """What a YAML file holds. Raises UsageError where it cannot be read."""
    from scene_ir import files  # which needs numpy, and --help does not

    try:
        loaded: Any = files.read_yaml(Path(path))
    except FormatError as error:
        raise UsageError(error.field, error.expected, error.actual) from error
    if loaded is not None and not isinstance(loaded, dict):
        raise UsageError(path, "a mapping of settings", type(loaded).__name__)
    return loaded or {}


def _words(path: str, field: Field[Any], value: Any) -> list[str]:
    kind = str(field.type)
    if kind in ("Flag", "bool"):
        if not isinstance(value, bool):
            raise UsageError(f"{path}: {field.name}", "true or false", repr(value))
        if value:
            return [option(field.name)]
        return [option(f"no-{field.name}")] if kind == "bool" else []
    if kind == "Repeated" and isinstance(value, list):
        return [f"{option(field.name)}={item}" for item in value]
    if isinstance(value, list | tuple):
        value = ",".join(str(item) for item in value)
    if isinstance(value, dict) or (isinstance(value, float) and not math.isfinite(value)):
        raise UsageError(f"{path}: {field.name}", "one value", repr(value))
    # "=": a value that begins with a dash stays a value.
    return [f"{option(field.name)}={value}"]
