"""`drivesem holes`: how large the holes are that a run's certain failures lie in, as rules a person can read."""

from __future__ import annotations

from drivesem.analysis.holes.asking import holes_run
from drivesem.config.commands import HolesConfig
from drivesem.config.devices import check_device
from drivesem.report.terminal import Console
from drivesem.run.driver import publish_report


def run(config: HolesConfig) -> int:
    """Look around, report; exit code 0. Raises UsageError or SceneError for bad input."""
    check_device(config.device)
    publish_report(holes_run(config), config.json, end=None if config.json else Console())
    return 0
