"""`drivesem worth`: how much counterexamples could teach, and how much a second detector has learnt from them."""

from __future__ import annotations

from drivesem.config.commands import Worth
from drivesem.run.ask import say
from tools.experiments.worth.asking import worth_run


def run(config: Worth) -> int:
    """Measure, print; exit code 0. Raises UsageError or SceneError for bad input."""
    say(worth_run(config), config.json)
    return 0
