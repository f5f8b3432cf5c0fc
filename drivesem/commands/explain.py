"""`drivesem explain`: why the counterexamples of a finished run fail, and how little is enough."""

from __future__ import annotations

from drivesem.analysis.explain.asking import explain_run
from drivesem.config.commands import ExplainConfig
from drivesem.config.devices import check_device
from drivesem.report.terminal import Console
from drivesem.run.driver import publish_report


def run(config: ExplainConfig) -> int:
    """Explain, report; exit code 0. Raises UsageError or SceneError for bad input."""
    check_device(config.device)
    publish_report(explain_run(config), config.json, end=None if config.json else Console())
    return 0
