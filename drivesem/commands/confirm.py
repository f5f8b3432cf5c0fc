"""`drivesem confirm`: counterexamples of a run, drawn again by a second renderer."""

from __future__ import annotations

from drivesem.analysis.confirm.asking import confirm_run
from drivesem.config.commands import ConfirmConfig
from drivesem.config.devices import check_device
from drivesem.run.driver import publish_report


def run(config: ConfirmConfig) -> int:
    """Draw, ask, report; exit code 0. Raises UsageError or SceneError for bad input."""
    check_device(config.device)
    _, answer = confirm_run(config)
    publish_report(answer, config.json)
    return 0
