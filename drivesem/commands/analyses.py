"""Commands that compute one report and print it: confirm, drive, explain, gate, holes, transfer, verify.

Each imports its analysis when it runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from drivesem.config.commands import (
    ConfirmConfig,
    DriveConfig,
    ExplainConfig,
    GateConfig,
    HolesConfig,
    TransferConfig,
    VerifyConfig,
)
from drivesem.config.devices import check_device
from drivesem.reporting.tables import Console, ReportTable, format_count, print_json
from drivesem.run.driver import print_output_folder, publish_report


def confirm_command(config: ConfirmConfig) -> int:
    """`drivesem confirm`: re-test a run's counterexamples with a second renderer."""
    from drivesem.analysis.confirm import run_confirm

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
    from drivesem.analysis.transfer import run_transfer

    publish_report(run_transfer(config), config.json)
    return 0


_MAX_PRINTED, _MAX_PER_CHECK = 30, 5
"""Differences printed on a terminal, in total and per check and frame; verify.json has all."""


def verify_command(config: VerifyConfig) -> int:
    """`drivesem verify`: verify and report. Returns 1 if anything differs or a frame cannot be read, otherwise 0."""
    from drivesem.analysis.verify import run_verify

    check_device(config.device)
    data, out = run_verify(config)
    console = Console(stderr=True)
    if config.json:
        print_json(data)
    _print(data, console if config.json else Console())
    print_output_folder(out, console)
    return 0 if data["agree"] else 1


def _select_differences(differences: Sequence[dict[str, str]]) -> list[dict[str, str]]:
    """Select a few differences per frame and check, those of the whole run first, as they may explain the others."""
    from drivesem.analysis.verify import WHOLE_RUN

    by_check: dict[tuple[str, str], list[dict[str, str]]] = {}
    for one in sorted(differences, key=lambda one: one["frame"] != WHOLE_RUN):
        by_check.setdefault((one["frame"], one["check"]), []).append(one)
    return [one for group in by_check.values() for one in group[:_MAX_PER_CHECK]][:_MAX_PRINTED]


def _print(data: dict[str, Any], console: Console) -> None:
    rows = tuple(
        (row["name"], row["holds"], str(row["compared"]), str(row["differing"]), str(len(row["frames_differing"])))
        for row in data["checks"]
    )
    columns = ("check", "what holds if nothing differs", "compared", "differ", "in frames")
    title = f"{format_count(data['frames'], 'frame')} of {data['run']}"
    console.print(ReportTable(title, columns, rows).to_rich(columns[:2]))
    selected = _select_differences(data["differences"])
    for one in selected:
        line = f"{one['frame']}: {one['check']}: {one['field']}"
        line += f": expected {one['expected']}, found {one['found']}"
        console.print(line, soft_wrap=True, markup=False, highlight=False)
    if remaining := len(data["differences"]) - len(selected):
        console.print(f"and {remaining} more")
    for name, reason in data["frames_failed"].items():
        console.print(f"frame {name} could not be checked: {reason}", soft_wrap=True, markup=False)
    console.print("no differences" if data["agree"] else "the run differs from its files")
