"""`drivesem COMMAND [options]`: parses, hands over to the command, turns errors into one line and exit code 2."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import sys
from collections.abc import Callable, Sequence

import tyro

from drivesem.run.lock import let_go
from drivesem.settings.checks import validate
from drivesem.settings.commands import COMMANDS, Command
from drivesem.settings.errors import UsageError
from drivesem.settings.text import yaml_arguments

_DESCRIPTION = "Find out where a driving detector breaks: semantic counterexamples by gradient."
_MODULES = "drivesem.commands.{}"
_EXIT_BAD_INPUT = 2
_EXIT_INTERRUPTED = 130


def parse(argv: Sequence[str]) -> Command:
    """The configuration that `argv` asks for. Raises UsageError; SystemExit(0) after `--help`."""
    words = list(argv)
    if words and words[0] in COMMANDS:
        words = [words[0], *_with_presets(words[0], words[1:])]
    captured = io.StringIO()
    try:
        with contextlib.redirect_stderr(captured):
            config: Command = tyro.extras.subcommand_cli_from_dict(  # pyright: ignore[reportAssignmentType]
                COMMANDS, prog="drivesem", description=_DESCRIPTION, args=words
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UsageError(
            "command line", "known options (see drivesem --help)", _unboxed(captured.getvalue())
        ) from None
    validate(config)
    return config


def _with_presets(command: str, words: list[str]) -> list[str]:
    """Replace `--config FILE` by the file's settings, in front, so that the command line wins."""
    presets: list[str] = []
    rest: list[str] = []
    position = 0
    while position < len(words):
        word = words[position]
        if word == "--config" and position + 1 < len(words):
            presets += yaml_arguments(words[position + 1], COMMANDS[command])
            position += 2
        elif word.startswith("--config="):
            presets += yaml_arguments(word.removeprefix("--config="), COMMANDS[command])
            position += 1
        else:
            rest.append(word)
            position += 1
    return presets + rest


def _unboxed(text: str) -> str:
    """The parser's message without its frame, on one line."""
    lines = [line.strip("│╭╮╰╯─ \t") for line in text.splitlines()]
    message = " ".join(line for line in lines if line)
    message = re.split(r"For full helptext|Perhaps you meant", message)[0]
    return " ".join(message.split()) or "an unknown command"


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns the exit code: 0 done, 1 a check failed, 2 bad input, 130 interrupted."""
    try:
        config = parse(sys.argv[1:] if argv is None else argv)
        with let_go():
            return _run(config)
    except KeyboardInterrupt:
        sys.stderr.write("drivesem: interrupted; the same command goes on where it stopped\n")
        return _EXIT_INTERRUPTED
    except (ValueError, OSError) as error:
        if not _is_bad_input(error):
            raise
        sys.stderr.write(f"drivesem: {' '.join(str(error).split())}\n")
        return _EXIT_BAD_INPUT


def _is_bad_input(error: Exception) -> bool:
    """Whether an error speaks of what the user gave, not of a fault of ours."""
    if isinstance(error, UsageError | OSError):
        return True
    # Only classes of modules that are loaded can have been raised: nothing heavy is imported to find out.
    kinds = [
        kind
        for module, name in (("scene_ir.errors", "SceneError"), ("detectors.base", "DetectorError"))
        if (kind := getattr(sys.modules.get(module), name, None)) is not None
    ]
    return isinstance(error, tuple(kinds)) if kinds else False


def _run(config: Command) -> int:
    name = next(name for name, kind in COMMANDS.items() if type(config) is kind)
    run: Callable[[Command], int] = importlib.import_module(_MODULES.format(name.replace("-", "_"))).run
    return run(config)


if __name__ == "__main__":
    sys.exit(main())
