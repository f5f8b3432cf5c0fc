"""`drivesem check`: test a detector against the contract of `detectors.base`."""

from __future__ import annotations

import re
from dataclasses import asdict

from rich import box
from rich.table import Table
from rich.text import Text

from detectors.adapters.network import RAISES_NOTHING
from detectors.base import DetectorError
from detectors.check import ContractReport, check_detector
from detectors.registry import load_predictor
from drivesem.config.commands import CheckConfig
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.reporting.tables import Console, print_json

MIN_SIDE_PX = 64
"""Smallest side of a test picture: its blocks must be larger than a network's stride."""
_STYLES = {"ok": "green", "failed": "bold red", "raised": "bold red", "not tried": "dim"}


def check_command(config: CheckConfig) -> int:
    """`drivesem check`: exit code 1 if a promise is broken. Raises UsageError if the detector's own code raises."""
    width, height = _size(config.size)
    check_device(config.device)
    try:
        detector = load_predictor(config.detector, config.device, config.tiles)
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    try:
        report = check_detector(detector, (height, width), seed=config.seed, device=config.device)
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    if config.json:
        print_json({"detector_setting": config.detector, **asdict(report)})
    else:
        _print(report, config, Console())
    if report.raised:
        raise UsageError("--detector", RAISES_NOTHING, report.raised[0].detail)
    return 1 if report.failed else 0


def _size(text: str) -> tuple[int, int]:
    """Width and height, px."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None or min(int(match[1]), int(match[2])) < MIN_SIDE_PX:
        raise UsageError("--size", f"WIDTHxHEIGHT, each at least {MIN_SIDE_PX} px", repr(text))
    return int(match[1]), int(match[2])


def _print(report: ContractReport, config: CheckConfig, console: Console) -> None:
    kind = "with gradients" if report.gradients else "predicts only"
    table = Table(title=f"{config.detector} ({kind})", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("promise", "", "found"):
        table.add_column(heading)
    for finding in report.findings:
        style = _STYLES[finding.verdict]
        table.add_row(finding.name, Text(finding.verdict, style), finding.detail)
    console.print(table)
    tried = sum(finding.verdict != "not tried" for finding in report.findings)
    console.print(f"{tried - len(report.failed)} of {tried} hold, {len(report.failed)} broken", soft_wrap=True)
