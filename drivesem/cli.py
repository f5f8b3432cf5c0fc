"""`drivesem COMMAND [options]`: parses, hands over to the command, turns errors into one line and exit code 2."""

from __future__ import annotations

import gc
import importlib
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from types import FrameType
from typing import Any

from drivesem.config.blocks import CommandConfig, option
from drivesem.config.commands import COMMANDS
from drivesem.config.errors import UsageError
from drivesem.config.parsing import Commands, parse
from drivesem.run.jobs import keep_freed
from drivesem.run.lock import release_folder_locks
from scene_ir.errors import make_printable

_MODULES = "drivesem.commands.{}"
_EXIT_BAD_INPUT = 2
_EXIT_INTERRUPTED = 130
_EXIT_PIPE = 141
_EXIT_ENDED = 143
_CODE = re.compile(r"(?:^|[,@])(?:module|torchscript|export|ultralytics):([^,]+)")
"""Detectors whose files are code (`detectors.adapters.choose.RUNS_CODE`, which a test holds this against)."""
_ENDING_SECONDS = 5.0
"""In which a command that is interrupted ends; after that Ctrl-C counts again."""
_LONGEST_LINE = 2000
"""Characters: what is wrong with a file may be what it holds."""


RunCommand = Callable[[Any], int]
"""Runs a command with its settings and returns the exit code."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `drivesem`. Returns the exit code, see `run_program`."""
    return run_program(argv, COMMANDS, "drivesem", _load_command)


def run_program(
    argv: Sequence[str] | None, commands: Commands, prog: str, load_command: Callable[[str], RunCommand]
) -> int:
    """Run one command of a program.

    Args:
        argv: Words of the command line without the program's name; None for this process' own.
        commands: Settings classes by command name.
        prog: The program's name, for help and errors.
        load_command: Imports the function that runs the command of a name.

    Returns:
        The exit code: 0 done, 1 a check failed, 2 bad input, 130 interrupted, 141 the reader closed the pipe, 143
        ended by SIGTERM.
    """
    with _interrupted_once(last=argv is None):
        return _run_program(sys.argv[1:] if argv is None else argv, commands, prog, load_command)


def _run_program(
    words: Sequence[str], commands: Commands, prog: str, load_command: Callable[[str], RunCommand]
) -> int:
    try:
        config = parse(words, commands, prog)
        from drivesem.store import stored  # which needs numpy, and --help does not

        _tell_of_code(config)
        with release_folder_locks(), stored(config) as config:
            return _run(config, partial(load_command, words[0]))
    except KeyboardInterrupt as error:
        sys.stderr.write(f"{prog}: interrupted; the same command goes on where it stopped\n")
        return _EXIT_ENDED if isinstance(error, _EndedError) else _EXIT_INTERRUPTED
    except BrokenPipeError:  # whoever reads what is printed has enough, as `head` has
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # where the interpreter's last words go
        return _EXIT_PIPE
    except Exception as unknown:
        error = _of_detector(unknown) or unknown
        if not _is_bad_input(error):
            raise
        sys.stderr.write(f"drivesem: {' '.join(make_printable(error, _LONGEST_LINE).split())}\n")
        return _EXIT_BAD_INPUT


class _EndedError(KeyboardInterrupt):
    """SIGTERM: to be cleaned up after as after Ctrl-C."""


@contextmanager
def _interrupted_once(last: bool) -> Iterator[None]:
    """Let SIGTERM, which systems that share machines send before they kill, end a command as Ctrl-C does. While a
    command ends, neither counts again for some seconds, so that it can clean up. last: the process does nothing
    else, and they do not count again at all once the command is done.
    """
    if threading.current_thread() is not threading.main_thread():  # a signal's handler can't be set elsewhere
        yield
        return
    interrupted_s = -math.inf

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted_s
        if time.monotonic() - interrupted_s > _ENDING_SECONDS:
            interrupted_s = time.monotonic()
            raise KeyboardInterrupt if number == signal.SIGINT else _EndedError

    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, end)}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # neither ignored nor somebody else's
        before[signal.SIGINT] = signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if last and interrupted_s > -math.inf else handler)


def _tell_of_code(config: CommandConfig) -> None:
    """Say which files' code will be run, by a setting that names such a detector."""
    for setting in fields(config):
        value = getattr(config, setting.name)
        for text in value if isinstance(value, tuple) else (value,):
            for word in _CODE.findall(text) if isinstance(text, str) else ():
                sys.stderr.write(f"drivesem: {option(setting.name)}: runs the code in {make_printable(word)}\n")


def _of_detector(error: Exception) -> UsageError | None:
    """An error that a detector of the user's own raised, as one of the setting that names it."""
    module = sys.modules.get("detectors.adapters.module")  # nothing heavy is imported to find out
    if module is None or _is_bad_input(error):
        return None
    told = module.blamed(error)
    return None if told is None else UsageError("--detector", module.RAISES_NOTHING, told)


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


def _load_command(name: str) -> RunCommand:
    return importlib.import_module(_MODULES.format(name.replace("-", "_"))).run


def _run(config: CommandConfig, load: Callable[[], RunCommand]) -> int:
    gc.disable()  # libraries make half a million objects as they load, and none of them is garbage
    try:
        run = load()
    finally:
        gc.enable()
    gc.freeze()
    keep_freed()
    return run(config)


if __name__ == "__main__":
    sys.exit(main())
