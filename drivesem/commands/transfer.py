"""`drivesem transfer`: counterexamples of finished runs before other detectors."""

from __future__ import annotations

from drivesem.analysis.transfer.asking import transfer_run
from drivesem.config.commands import TransferConfig
from drivesem.run.driver import publish_report


def run(config: TransferConfig) -> int:
    """Look, count, report; exit code 0. Raises UsageError or SceneError for bad input."""
    publish_report(transfer_run(config), config.json)
    return 0
