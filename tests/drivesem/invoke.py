"""Commands as a user types them, run in this process."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass
from typing import Any

from drivesem.cli import main


@dataclass(frozen=True, slots=True)
class CommandOutput:
    """What a command printed."""

    out: str
    """Standard output."""
    err: str
    """Standard error."""


def invoke(*words: object, code: int = 0) -> CommandOutput:
    """Run a command that must end with this exit code."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        ended = main([*map(str, words)])
    assert ended == code, err.getvalue()
    return CommandOutput(out.getvalue(), err.getvalue())


def run_json(*words: object, code: int = 0) -> Any:
    """The JSON that a command prints with --json on standard output, and nothing else."""
    return json.loads(invoke(*words, "--json", code=code).out)


def refusal(*words: object) -> str:
    """The last line of a command that refuses its input, without the program's name; progress may precede it."""
    err = invoke(*words, code=2).err
    assert "Traceback" not in err
    return err.splitlines()[-1].removeprefix("drivesem: ")
