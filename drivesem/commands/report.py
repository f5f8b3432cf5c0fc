"""`drivesem report`: the page of finished runs, beside each other where there are several."""

from __future__ import annotations

from drivesem.config.commands import ReportConfig
from drivesem.report.tables import format_count, print_json
from drivesem.report.terminal import Console
from drivesem.run.page import report_runs


def run(config: ReportConfig) -> int:
    """Write the page; exit code 0. Raises UsageError or SceneError for bad input."""
    data = report_runs(config)
    if config.json:
        print_json(data)
        return 0
    runs, frames = len(data["runs"]), len(data["frames"])
    said = f"{format_count(runs, 'run')}, {format_count(frames, 'frame')}, {data['bytes'] / 1e6:.1f} MB: {data['out']}"
    Console().print(said, soft_wrap=True)
    return 0
