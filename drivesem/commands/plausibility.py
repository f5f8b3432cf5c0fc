"""`drivesem plausibility`: how common a run's vehicles are, before and after the attack."""

from __future__ import annotations

from drivesem.config.commands import Plausibility
from drivesem.run.ask import say
from tools.experiments.plausibility.asking import plausibility_run


def run(config: Plausibility) -> int:
    """Measure, print; exit code 0. Raises UsageError or SceneError for bad input."""
    say(plausibility_run(config), config.json)
    return 0
