"""`drivesem train` and `drivesem retrain`: train a detector, or fine-tune it on counterexamples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from drivesem.config.commands import RetrainConfig, TrainConfig
from drivesem.config.devices import check_device
from drivesem.reporting.tables import Console, format_count, format_percent, print_json
from drivesem.training.retrain import NOTE, RetrainRow, build_verdict_table, retrain_detector
from drivesem.training.train import fit_dataset_anchors, run_training


def train_command(config: TrainConfig) -> int:
    """`drivesem train`: train or resume; with `--anchors N`, fit and print anchors instead."""
    console = Console(stderr=True)
    if isinstance(config.anchors, int):
        data = fit_dataset_anchors(config, config.anchors)
        if config.json:
            print_json(data)
        _print_anchors(data, console)
        return 0
    result = run_training(config)
    if result is None:
        return 0
    if config.json:
        print_json(result.data)
    time = result.time
    console.print(
        f"{format_count(result.data['steps'], 'step')}, {time.steps} of them now: {time.images_a_second:.1f} "
        f"images per second, {time.processor_seconds_an_image:.3f} CPU seconds each; weights: {result.data['weights']}",
        soft_wrap=True,
    )
    return 0


def _print_anchors(data: dict[str, Any], console: Console) -> None:
    boxes = format_count(data["boxes"], "box", "boxes")
    title = f"Anchors for {boxes} of {format_count(data['frames'], 'frame')}, px"
    table = Table(title=title, title_justify="left", min_width=min(len(title) + 4, console.width))
    for heading in ("", "mean best IoU", "width x height"):
        table.add_column(heading, justify="left")
    for name, key in (("fitted", ""), ("published", "published_")):
        sizes = ", ".join(f"{w:.0f} x {h:.0f}" for w, h in data[f"{key}anchors"])
        table.add_row(name, f"{data[f'{key}mean_iou']:.3f}", sizes)
    console.print(table)


def retrain_command(config: RetrainConfig) -> int:
    """`drivesem retrain`: fine-tune or resume, then attack again."""
    console = Console(stderr=True)
    check_device(config.device)
    result = retrain_detector(config, console)
    if config.json:
        print_json(result.data)
    _print_retraining(result.rows, console)
    table = build_verdict_table(result.verdicts)
    console.print(*table.fit_to_console(console, ("frames", "metric", "of", "verdict")), sep="\n")
    for line in (result.thresholds, NOTE, f"weights: {result.data['weights']}"):
        console.print(line, soft_wrap=True)
    return 0


def _print_retraining(rows: Sequence[RetrainRow], console: Console) -> None:
    table = Table(title="Car, %, on frames that were not trained on", title_justify="left")
    table.add_column("frames, labels")
    table.add_column("detector")
    for title in ("AP50", "recall", "at t*", "frames broken"):
        table.add_column(title, justify="right")
    for row in rows:
        numbers = (row.scores.ap50, row.scores.recall, row.scores.recall_at_t_star)
        cells = (*map(format_percent, numbers), row.broken_text)
        table.add_row(f"{row.frames}, {row.labels}", row.detector, *cells)
    console.print(table)
