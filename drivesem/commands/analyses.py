"""Commands that compute one report and print it: confirm, drive, explain, gate, holes, transfer.

Each imports its analysis when it runs.
"""

from __future__ import annotations

from drivesem.config.commands import (
    ConfirmConfig,
    DriveConfig,
    ExplainConfig,
    GateConfig,
    HolesConfig,
    TransferConfig,
)
from drivesem.config.devices import check_device
from drivesem.report.terminal import Console
from drivesem.run.driver import publish_report


def confirm_command(config: ConfirmConfig) -> int:
    """`drivesem confirm`: re-test a run's counterexamples with a second renderer."""
    from drivesem.analysis.confirm.run import run_confirm

    check_device(config.device)
    _, report = run_confirm(config)
    publish_report(report, config.json)
    return 0


def drive_command(config: DriveConfig) -> int:
    """`drivesem drive`: attack a video clip, or resume."""
    from drivesem.video.run import attack_clip

    publish_report(attack_clip(config), config.json)
    return 0


def explain_command(config: ExplainConfig) -> int:
    """`drivesem explain`: find the causes of a run's failures."""
    from drivesem.analysis.explain.run import run_explain

    check_device(config.device)
    publish_report(run_explain(config), config.json, end=None if config.json else Console())
    return 0


def gate_command(config: GateConfig) -> int:
    """`drivesem gate`: compare two detectors; exit code 1 if the new one fails more often."""
    from drivesem.analysis.gate import run_gate

    check_device(config.device)
    report = run_gate(config)
    publish_report(report, config.json, end=None if config.json else Console())
    return 0 if report.data["passed"] else 1


def holes_command(config: HolesConfig) -> int:
    """`drivesem holes`: map the failure regions of runs."""
    from drivesem.analysis.holes.run import run_holes

    check_device(config.device)
    publish_report(run_holes(config), config.json, end=None if config.json else Console())
    return 0


def transfer_command(config: TransferConfig) -> int:
    """`drivesem transfer`: test a run's counterexamples on other detectors."""
    from drivesem.analysis.transfer.run import run_transfer

    publish_report(run_transfer(config), config.json)
    return 0
