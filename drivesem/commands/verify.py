"""`drivesem verify`: whether a finished run is what it says it is, computed again from its files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from drivesem.analysis.verify.run import WHOLE_RUN, run_verify
from drivesem.config.commands import VerifyConfig
from drivesem.config.devices import check_device
from drivesem.report.tables import ReportTable, format_count, print_json
from drivesem.report.terminal import Console
from drivesem.run.driver import print_output_folder
from drivesem.run.report.page import UNKNOWN

_MOST_SHOWN, _MOST_ALIKE = 30, 5
"""Differences that are told on a terminal, and of them those of one check of a frame; verify.json has them all."""

_UNSEALED = (
    "manifest.json is of an earlier version, with hashes of pictures, labels and theta.json alone: settings, loss "
    "traces, active constraints, overlays and second opinions were not checked"
)


def verify_command(config: VerifyConfig) -> int:
    """Check, report; exit code 0, or 1 where something differs or a frame could not be read. Raises UsageError or
    SceneError for bad input.
    """
    check_device(config.device)
    data, out = run_verify(config)
    console = Console(stderr=True)
    if config.json:
        print_json(data)
    _print(data, console if config.json else Console())
    print_output_folder(out, console)
    return 0 if data["agree"] else 1


def _told_first(differences: Sequence[dict[str, str]]) -> list[dict[str, str]]:
    """A few of each frame and check: a changed picture has hundreds, and must not hide a setting. The whole run's,
    which may explain the others, come first.
    """
    kept: dict[tuple[str, str], list[dict[str, str]]] = {}
    for one in sorted(differences, key=lambda one: one["frame"] != WHOLE_RUN):
        kept.setdefault((one["frame"], one["check"]), []).append(one)
    return [one for ours in kept.values() for one in ours[:_MOST_ALIKE]]


def _print(data: dict[str, Any], console: Console) -> None:
    rows = tuple(
        (row["name"], row["holds"], str(row["compared"]), str(row["differing"]), str(len(row["frames_differing"])))
        for row in data["checks"]
    )
    columns = ("check", "what holds where nothing differs", "compared", "differ", "in frames")
    console.print(
        ReportTable(f"{format_count(data['frames'], 'frame')} of {data['run']}", columns, rows).to_rich(
            columns[:2]
        )
    )
    told = _told_first(data["differences"])[:_MOST_SHOWN]
    for wrong in told:
        line = f"{wrong['frame']}: {wrong['check']}: {wrong['field']}"
        line += f": expected {wrong['expected']}, found {wrong['found']}"
        console.print(line, soft_wrap=True, markup=False, highlight=False)
    if left := len(data["differences"]) - len(told):
        console.print(f"and {left} more")
    if ungraded := data["frames_ungraded"]:
        console.print(f"{format_count(ungraded, 'frame')}: {UNKNOWN}")
    for name, reason in data["frames_failed"].items():
        console.print(f"frame {name} could not be checked: {reason}", soft_wrap=True, markup=False)
    if not data["sealed"]:
        console.print(_UNSEALED, soft_wrap=True)
    console.print("all agree" if data["agree"] else "the run is not what it says it is")
