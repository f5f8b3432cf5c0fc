"""The words of a command line as a command's settings: presets are expanded, tyro parses, values are checked."""

from __future__ import annotations

import contextlib
import difflib
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from itertools import dropwhile, takewhile

import tyro

from drivesem.config.commands import COMMANDS
from drivesem.config.errors import CommandLineError, UsageError
from drivesem.config.help import print_help
from drivesem.config.options import CommandConfig, option_name
from drivesem.config.presets import expand_presets

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
