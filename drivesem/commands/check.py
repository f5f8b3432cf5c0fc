"""`drivesem check`: test a detector against the contract of `detectors.base`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text
from torch import Tensor

from detectors.adapters.network import RAISES_NOTHING
from detectors.base import DetectorError, Predictor
from detectors.check import (
    ContractReport,
    StreetDetections,
    check_detector,
    describe_reading,
    survey_streets,
)
from detectors.registry import load_predictor
from detectors.types import Detections
from drivesem.attacks.targets import resolve_t_star
from drivesem.config.commands import CheckConfig
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.config.options import DataSourceOptions, SceneOptions, shared_options
from drivesem.reporting.drawing import MARGIN_PX, write_picture
from drivesem.reporting.tables import Console, print_json
from drivesem.run.frame import detection_records
from drivesem.run.report.pictures import draw_overlay
from drivesem.scenes.sources import open_source
from scene_ir.io import to_uint8

MIN_SIDE_PX = 64
"""Smallest side of a test picture: its blocks must be larger than a network's stride."""
STREETS = 3
"""Number of streets by default."""
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
    streets = None
    if not report.raised:
        streets = _survey(detector, config)
        report = replace(report, findings=(*report.findings, streets.as_check))
    if config.json:
        seen = None if streets is None else asdict(streets)
        facts = {
            "detector": config.detector,
            "name": report.detector,
            "gradient": report.gradients,
            "reading": describe_reading(detector),
            "promises": [asdict(promise) for promise in report.findings],
        }
        print_json({**facts, "seen": seen})
    else:
        _print(report, config, Console())
    if report.raised:
        raise UsageError("--detector", RAISES_NOTHING, report.raised[0].detail)
    return 1 if report.failed else 0


def _survey(detector: Predictor, config: CheckConfig) -> StreetDetections:
    """Detect cars in streets that have some, and draw the boxes to --out."""
    options = SceneOptions(**shared_options(config, DataSourceOptions))
    source = open_source(replace(options, limit=config.limit or STREETS))
    names = islice(filter(source.has_vehicles, source.identifiers()), config.limit or STREETS)
    pictures = [source.photograph(name).to(config.device) for name in names]
    if not pictures:
        raise UsageError("--root", "photographs with vehicles", "none")
    t_star = resolve_t_star(detector)
    survey, found = survey_streets(detector, pictures, t_star)
    if config.out is not None:
        panels = [
            _draw(picture, one, detector.classes, t_star) for picture, one in zip(pictures, found, strict=True)
        ]
        width = max(panel.shape[1] for panel in panels)
        padded = [np.pad(panel, ((0, MARGIN_PX), (0, width - panel.shape[1]), (0, 0))) for panel in panels]
        write_picture(Path(config.out), np.concatenate(padded))
    return survey


def _draw(picture: Tensor, found: Detections, classes: Sequence[str], t_star: float) -> np.ndarray:
    """Draw the detections with a score of at least t* into a picture (3, H, W): (H, W, 3) uint8."""
    return draw_overlay(to_uint8(picture.cpu()), (), detection_records(found, tuple(classes)), (), t_star)


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
