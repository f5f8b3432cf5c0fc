"""Help texts: a program's overview, and a command's options with the docstrings of its settings.

tyro lays out the options; what it cannot do is written here: topics, and options that only `--help-all` shows.
"""

from __future__ import annotations

import ast
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, field, fields, make_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, get_args, get_origin, get_type_hints

import tyro

from drivesem.config.options import CommandConfig, Flag, Options

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
