"""`drivesem transfer`: counterexamples of finished runs before other detectors."""

from __future__ import annotations

from drivesem.analysis.transfer.asking import transfer_run
from drivesem.config.commands import Transfer
from drivesem.run.ask import say


def run(config: Transfer) -> int:
    """Look, count, report; exit code 0. Raises UsageError or SceneError for bad input."""
    say(transfer_run(config), config.json)
    return 0
