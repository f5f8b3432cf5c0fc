"""`drivesem retrain`: a detector trained on with counterexamples, before and after, and attacked again."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from drivesem.config.commands import RetrainConfig
from drivesem.config.devices import check_device
from drivesem.report.tables import format_percent, print_json
from drivesem.report.terminal import Console
from drivesem.training.retrain import RetrainRow, retrain_run


def run(config: RetrainConfig) -> int:
    """Retrain, or go on with it; exit code 0. Raises UsageError or SceneError for bad input."""
    console = Console(stderr=True)
    check_device(config.device)
    data, rows = retrain_run(config, console)
    if config.json:
        print_json(data)
    _print(rows, console)
    console.print(f"weights: {data['weights']}", soft_wrap=True)
    return 0


def _print(rows: Sequence[RetrainRow], console: Console) -> None:
    table = Table(title="Car, %, on frames that were not trained on", title_justify="left")
    table.add_column("frames, labels")
    table.add_column("detector")
    for title in ("AP50", "recall", "at t*", "broken"):
        table.add_column(title, justify="right")
    for row in rows:
        numbers = (row.scores.ap50, row.scores.recall, row.scores.recall_at_t_star, row.broken)
        table.add_row(f"{row.frames}, {row.labels}", row.detector, *(format_percent(number) for number in numbers))
    console.print(table)
