"""`drivesem drive`: an attack on a whole clip, and how long each car is missed."""

from __future__ import annotations

from drivesem.config.commands import DriveConfig
from drivesem.report.terminal import Console
from drivesem.run.driver import publish_report
from drivesem.video.running import drive_run


def run(config: DriveConfig) -> int:
    """Attack a clip or go on with it; exit code 0. Raises UsageError or SceneError for bad input."""
    answer = drive_run(config)
    publish_report(answer, config.json, Console(stderr=True))
    return 0
