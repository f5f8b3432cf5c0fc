"""`drivesem anchors`: anchor shapes for a data set, and how well they fit beside the published ones."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from drivesem.config.commands import AnchorsConfig
from drivesem.report.tables import format_count, print_json
from drivesem.report.terminal import Console
from drivesem.training.anchors import fitted_anchors


def run(config: AnchorsConfig) -> int:
    """Read the labels, fit, print; exit code 0. Raises UsageError or SceneError for bad input."""
    data = fitted_anchors(config)
    if config.json:
        print_json(data)
    _print(data, Console(stderr=True))
    return 0


def _print(data: dict[str, Any], console: Console) -> None:
    title = (
        f"Anchors for {format_count(data['boxes'], 'box', 'boxes')} of {format_count(data['frames'], 'frame')}, px"
    )
    table = Table(title=title, title_justify="left", min_width=min(len(title) + 4, console.width))
    for heading in ("", "mean best IoU", "width x height"):
        table.add_column(heading, justify="left")
    for name, key in (("fitted", ""), ("published", "published_")):
        sizes = ", ".join(f"{w:.0f} x {h:.0f}" for w, h in data[f"{key}anchors"])
        table.add_row(name, f"{data[f'{key}mean_iou']:.3f}", sizes)
    console.print(table)
