"""`drivesem drive`: an attack on a whole clip, and how long each car is missed."""

from __future__ import annotations

from drivesem.drive.running import drive_run
from drivesem.report.terminal import Console
from drivesem.run.ask import say
from drivesem.settings.commands import Drive


def run(config: Drive) -> int:
    """Attack a clip or go on with it; exit code 0. Raises UsageError or SceneError for bad input."""
    answer = drive_run(config)
    say(answer, config.json, Console(stderr=True))
    return 0
