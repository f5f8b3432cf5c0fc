"""A program of several commands: parse, run one, turn errors into one line and an exit code."""

from __future__ import annotations

import gc
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from types import FrameType
from typing import Any

import tyro

from drivesem.config.errors import CommandLineError, UsageError
from drivesem.config.options import CommandConfig, option_name
from drivesem.config.parsing import format_overview, parse
from scene_ir.errors import make_printable

_EXIT_BAD_INPUT = 2
_EXIT_INTERRUPTED = 130
_EXIT_PIPE = 141
_EXIT_TERMINATED = 143
RUNS_CODE = re.compile(r"(?:^|[,@])(?:module|maite|torchscript|export|ultralytics):([^,]+)")
"""Detectors that run code from their files (as `detectors.registry.RUNS_CODE`; a test compares the two)."""
_CLEANUP_SECONDS = 5.0
"""Seconds that an interrupted command has to clean up before Ctrl-C counts again."""
_MAX_ERROR_LENGTH = 2000
"""Characters: an error may quote the content of a file."""

RunCommand = Callable[[Any], int]
"""Runs a command with its settings and returns the exit code."""


@dataclass(frozen=True)
class Program:
    """A program of several commands."""

    name: str
    """The words that start it, such as `drivesem`."""
    version: str
    """What `--version` prints."""
    summary: str
    """What it does, in one sentence."""
    commands: Mapping[str, type[CommandConfig]]
    """Settings classes by command name."""
    load: Callable[[str], RunCommand]
    """Imports the function that runs the command of a name."""
    topics: Mapping[str, Sequence[str]] | None = None
    """Names of the commands by topic, for the overview."""
    examples: Mapping[str, str] = field(default_factory=dict)
    """Command lines, each with its meaning, for the overview."""

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run one command.

        Args:
            argv: Words of the command line without the program's name; None for this process' own.

        Returns:
            The exit code: 0 done, 1 a check failed, 2 bad input, 130 interrupted, 141 the reader closed the pipe,
            143 ended by SIGTERM.
        """
        with _one_interrupt(last=argv is None):
            try:
                return self._run(list(sys.argv[1:] if argv is None else argv))
            except KeyboardInterrupt as error:
                sys.stderr.write(f"{self.name}: interrupted; the same command resumes\n")
                return _EXIT_TERMINATED if isinstance(error, _TerminatedError) else _EXIT_INTERRUPTED
            except BrokenPipeError:  # the reader has enough, as `head` has
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the interpreter's last flush
                return _EXIT_PIPE
            except Exception as raised:
                error = _user_detector_error(raised) or raised
                if not _is_bad_input(error):
                    raise
                sys.stderr.write(f"{self.name}: {' '.join(make_printable(error, _MAX_ERROR_LENGTH).split())}\n")
                return _EXIT_BAD_INPUT

    def _run(self, words: list[str]) -> int:
        if not words or words[0] in ("-h", "--help"):
            sys.stdout.write(format_overview(self.name, self.commands, self.summary, self.topics, self.examples))
            return 0
        if words[0] == "--version":
            sys.stdout.write(f"{self.name} {self.version}\n")
            return 0
        if words[0].startswith("--tyro-"):  # shell completion, which exits
            tyro.extras.subcommand_cli_from_dict(dict(self.commands), prog=self.name, args=words)
        config = parse(words, self.commands, self.name)
        _report_code(config)

        from drivesem.run.lock import release_folder_locks
        from drivesem.store import remote_output

        with release_folder_locks(), remote_output(config) as config:
            return self._load(words[0])(config)

    def _load(self, command: str) -> RunCommand:
        gc.disable()  # libraries make half a million objects as they load, and none of them is garbage
        try:
            run = self.load(command)
        finally:
            gc.enable()
        gc.freeze()

        from drivesem.run.allocation import keep_freed_memory

        keep_freed_memory()
        return run


class _TerminatedError(KeyboardInterrupt):
    """SIGTERM, which is cleaned up after as Ctrl-C is."""


@contextmanager
def _one_interrupt(last: bool) -> Iterator[None]:
    """Let SIGTERM end a command as Ctrl-C does, and ignore further signals while it cleans up.

    Args:
        last: Whether the process ends with the command: signals are then ignored until its end.
    """
    if threading.current_thread() is not threading.main_thread():  # handlers can't be set elsewhere
        yield
        return
    interrupted_s = -math.inf

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted_s
        if time.monotonic() - interrupted_s > _CLEANUP_SECONDS:
            interrupted_s = time.monotonic()
            raise KeyboardInterrupt if number == signal.SIGINT else _TerminatedError

    previous = {signal.SIGTERM: signal.signal(signal.SIGTERM, interrupt)}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # neither ignored nor another's
        previous[signal.SIGINT] = signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_IGN if last and interrupted_s > -math.inf else handler)


def _report_code(config: CommandConfig) -> None:
    """Print which files' code will run, for options that name such a detector."""
    for option in fields(config):
        value = getattr(config, option.name)
        for text in value if isinstance(value, tuple) else (value,):
            for path in RUNS_CODE.findall(text) if isinstance(text, str) else ():
                sys.stderr.write(
                    f"drivesem: {option_name(option.name)}: runs the code in {make_printable(path)}\n"
                )


def _user_detector_error(error: Exception) -> UsageError | None:
    """An error that a user's own detector raised, as a UsageError of the option that names it."""
    module = sys.modules.get("detectors.adapters.network")  # imports nothing heavy
    if module is None or _is_bad_input(error):
        return None
    found = module.describe_user_error(error)
    return None if found is None else UsageError("--detector", module.RAISES_NOTHING, found)


def _is_bad_input(error: Exception) -> bool:
    """Whether an error is about the user's input, and not a fault of the program."""
    if isinstance(error, UsageError | CommandLineError | OSError):
        return True
    # Only classes of loaded modules can have been raised: nothing heavy is imported to find out.
    kinds = [
        kind
        for module, name in (("scene_ir.errors", "SceneError"), ("detectors.base", "DetectorError"))
        if (kind := getattr(sys.modules.get(module), name, None)) is not None
    ]
    return isinstance(error, tuple(kinds))
