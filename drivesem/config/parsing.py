"""Parses the words of a command line into settings (presets, tyro, checks), and prints help texts.

tyro lays out the help; what it cannot do is written here: topics, and options that only `--help-all` shows.
"""

from __future__ import annotations

import ast
import contextlib
import difflib
import io
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, field, fields, make_dataclass, replace
from functools import cache
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, get_args, get_origin, get_type_hints

import tyro

from drivesem.config.commands import COMMANDS
from drivesem.config.errors import CommandLineError, UsageError
from drivesem.config.options import CommandConfig, Flag, Options, option_name
from drivesem.config.presets import expand_presets

ADVANCED = (
    *("resume", "keep_going", "engine", "address", "cache", "cache_gb", "focal", "finder", "whole", "incremental"),
    *("keep_mb", "tiles", "precision"),
)
"""Fields that `--help` leaves to `--help-all` in commands that do not list their basic ones."""
_MAX_WIDTH = 100


def format_overview(
    prog: str,
    commands: Mapping[str, type[CommandConfig]],
    summary: str = "",
    topics: Mapping[str, Sequence[str]] | None = None,
    examples: Mapping[str, str] | None = None,
) -> str:
    """The commands of a program, each with one line.

    Args:
        prog: The program's name.
        commands: Settings classes by command name.
        summary: What the program does, in one sentence.
        topics: Names of the commands by topic; all under "Commands" by default.
        examples: Command lines, each with its meaning.
    """
    width = min(shutil.get_terminal_size().columns, _MAX_WIDTH)
    lines = [summary, ""] if summary else []
    lines += [f"usage: {prog} COMMAND [options]; {prog} COMMAND --help lists the options", ""]
    for topic, names in (topics or {"Commands": tuple(commands)}).items():
        lines.append(topic)
        for name in names:
            text = (commands[name].__doc__ or "").partition(". ")[0].rstrip(".")
            lines += textwrap.wrap(text, width, initial_indent=f"  {name:<15} ", subsequent_indent=" " * 18)
        lines.append("")
    for words, meaning in (examples or {}).items():
        lines += [f"  {words}", *textwrap.wrap(meaning, width, initial_indent=" " * 6, subsequent_indent=" " * 6)]
    return "\n".join(lines).rstrip() + "\n"


def print_help(prog: str, kind: type[CommandConfig], every_option: bool) -> NoReturn:
    """Print the options of a command and raise SystemExit(0).

    Args:
        prog: Words before the options, such as `drivesem attack`.
        kind: The command's settings.
        every_option: Whether to print all options, or the basic ones.
    """
    hints, texts = get_type_hints(kind, include_extras=True), field_texts(kind)
    every = [item for item in fields(kind) if str(item.type) != "CommandName"]
    basic = kind.basic or tuple(item.name for item in every if item.name not in ADVANCED)
    order = {name: position for position, name in enumerate(basic)}
    listed = sorted(every, key=lambda item: order.get(item.name, len(order)))
    listed = listed if every_option else listed[: len(order)]
    options = [_help_field(item, hints[item.name], texts.get(item.name, "")) for item in listed]
    config = "Preset or YAML file of options; the command line wins over it; list prints the presets."
    options.append(("config", Annotated[str, _text(config)], field(default="")))
    if len(order) < len(every):
        options.append(("help_all", Annotated[Flag, _text("Show all options.")], field(default=False)))
    view = make_dataclass(kind.__name__, options, kw_only=True)
    view.__doc__ = kind.__doc__
    tyro.cli(view, prog=prog, args=["--help"])
    raise SystemExit(0)


def _help_field(item: Field[Any], hint: Any, text: str) -> tuple[str, Any, Any]:
    """A field of the dataclass that tyro prints the help of: name, type without None, default."""
    default = ""
    if item.default is MISSING:
        default = "(required)"
    elif item.default not in (None, False, (), "") and "(default" not in text:
        default = f"(default: {'on' if item.default is True else item.default})"
    plain = _without_none(hint)
    value = _example(plain) if item.default is None else item.default  # the help shows `default` in its place
    return item.name, Annotated[plain, _text(text, default)], field(default=value)


def _text(text: str, default: str = "") -> Any:
    return tyro.conf.arg(help=text, help_behavior_hint=default)


def _without_none(hint: Any) -> Any:
    """A type hint without None, at any depth of its annotations."""
    if hasattr(hint, "__metadata__"):
        return Annotated[(_without_none(get_args(hint)[0]), *hint.__metadata__)]
    parts = [part for part in get_args(hint) if part is not type(None)]
    return parts[0] if get_origin(hint) not in (Literal, tuple) and len(parts) == 1 else hint


def _example(hint: Any) -> Any:
    """A value of a type, so that tyro does not require one."""
    while hasattr(hint, "__metadata__"):
        hint = get_args(hint)[0]
    return get_args(hint)[0] if get_origin(hint) is Literal else hint()


def field_texts(kind: type[Options]) -> dict[str, str]:
    """The docstring of each field of a settings class, its own before those of its bases."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if issubclass(base, Options):
            texts |= _read_docstrings(base.__module__).get(base.__name__, {})
    return texts


@cache
def _read_docstrings(module: str) -> dict[str, dict[str, str]]:
    """Field docstrings by class of a module, from its source."""
    path = Path(str(sys.modules[module].__file__))
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name: dict(_field_docstrings(node)) for node in tree.body if isinstance(node, ast.ClassDef)}


def _field_docstrings(node: ast.ClassDef) -> Iterator[tuple[str, str]]:
    for statement, text in zip(node.body, node.body[1:], strict=False):
        if not (isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name)):
            continue
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            yield statement.target.id, " ".join(str(text.value.value).split())


Commands = Mapping[str, type[CommandConfig]]
"""Settings classes by command name."""


def parse(argv: Sequence[str], commands: Commands = COMMANDS, prog: str = "drivesem") -> CommandConfig:
    """The settings that a command line gives.

    Args:
        argv: The name of a command, and its words.
        commands: Settings classes by command name.
        prog: The program's name, for help and errors.

    Raises:
        UsageError: For an unknown command or option, and for a bad value.
        CommandLineError: For words that the parser does not understand.
        SystemExit: With code 0 after `--help`, `--help-all` and `--config list`.
    """
    name, words = argv[0], list(argv[1:])
    if name not in commands:
        expected = f"one of {', '.join(commands)} ({prog} --help describes them)"
        raise UsageError("command", expected, suggest(name, commands))
    kind, prog = commands[name], f"{prog} {name}"
    if {"-h", "--help", "--help-all"} & set(words):
        print_help(prog, kind, "--help-all" in words)
    takes_run = any(field.name == "run" for field in fields(kind))
    if takes_run and words and not words[0].startswith("-"):  # the run may come first, without its option
        words = [f"{option_name('run')}={words[0]}", *words[1:]]
    config = _parse_options(expand_presets(name, words, commands), kind, prog)
    config = replace(config, **{field.name: name for field in fields(kind) if str(field.type) == "CommandName"})
    config.check()
    return config


def _parse_options(words: Sequence[str], kind: type[CommandConfig], prog: str) -> CommandConfig:
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            config, unknown = tyro.cli(kind, prog=prog, args=words, return_unknown_args=True)
    except SystemExit:
        raise CommandLineError(_first_paragraph(printed.getvalue())) from None
    if unknown:
        names = [option_name(field.name) for field in fields(kind)]
        expected = f"options of {prog} (--help-all lists them)"
        raise UsageError("command line", expected, suggest(unknown[0].partition("=")[0], names))
    return config


def _first_paragraph(text: str) -> str:
    """The message in a box that tyro prints, without its title, hints and border."""
    lines = [line.strip("│ ") for line in text.splitlines()[1:]]
    body = dropwhile(lambda line: not line.strip("─-╰╯"), lines)
    message = takewhile(lambda line: line.strip("─-╰╯"), body)
    return " ".join(message).partition(" Got errors:")[0]


def suggest(word: str, known: Iterable[str]) -> str:
    """A word, and the known one that it may stand for."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"{word}; did you mean {near[0]}?" if near else word
