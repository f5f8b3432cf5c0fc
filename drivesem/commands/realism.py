"""`drivesem realism`: how far the pictures of runs are from one another, by frame and by vehicle."""

from __future__ import annotations

from drivesem.config.commands import Realism
from drivesem.run.ask import say
from tools.experiments.realism.asking import realism_run


def run(config: Realism) -> int:
    """Measure, print; exit code 0. Raises UsageError or SceneError for bad input."""
    say(realism_run(config), config.json)
    return 0
