"""`drivesem gate`: does a new detector fail more often than an old one around failures that are known?"""

from __future__ import annotations

from drivesem.analysis.gate.asking import gate_run
from drivesem.config.commands import GateConfig
from drivesem.config.devices import check_device
from drivesem.report.terminal import Console
from drivesem.run.driver import publish_report


def run(config: GateConfig) -> int:
    """Compare, report; exit code 0 where the gate is passed, 1 where it is not. Raises UsageError or SceneError
    for bad input.
    """
    check_device(config.device)
    passed, answer = gate_run(config)
    publish_report(answer, config.json, end=None if config.json else Console())
    return 0 if passed else 1
