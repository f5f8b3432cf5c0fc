"""`drivesem confirm`: counterexamples of a run, drawn again by a second renderer."""

from __future__ import annotations

from drivesem.analysis.confirm.asking import confirm_run
from drivesem.config.commands import Confirm
from drivesem.config.devices import check_device
from drivesem.run.ask import say


def run(config: Confirm) -> int:
    """Draw, ask, report; exit code 0. Raises UsageError or SceneError for bad input."""
    check_device(config.device)
    _, answer = confirm_run(config)
    say(answer, config.json)
    return 0
