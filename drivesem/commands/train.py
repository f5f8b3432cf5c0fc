"""`drivesem train`: a detector from frames, with its curves, its best weights and their model card."""

from __future__ import annotations

from drivesem.config.commands import TrainConfig
from drivesem.report.tables import format_count, print_json
from drivesem.report.terminal import Console
from drivesem.training.train import train_run


def run(config: TrainConfig) -> int:
    """Train or go on training; exit code 0. Raises UsageError or SceneError for bad input."""
    trained = train_run(config)
    if trained is None:
        return 0
    data, pace = trained.data, trained.pace
    if config.json:
        print_json(data)
    speed = (
        f"{pace.images_a_second:.1f} images a second, {pace.processor_seconds_an_image:.3f} processor seconds each"
    )
    told = f"{format_count(data['steps'], 'step')}, {pace.steps} of them now: {speed}; weights: {data['weights']}"
    Console(stderr=True).print(told, soft_wrap=True)
    return 0
