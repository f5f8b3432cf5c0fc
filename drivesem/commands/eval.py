"""`drivesem eval`: metrics of detections, or of a detector on a data set."""

from __future__ import annotations

from drivesem.analysis.evaluate.files import evaluate_files
from drivesem.analysis.evaluate.report import print_evaluation
from drivesem.config.commands import EvalConfig
from drivesem.reporting.tables import Console, print_json


def eval_command(config: EvalConfig) -> int:
    """`drivesem eval`: evaluate and print."""
    console = Console(stderr=True)
    if config.detector is not None:
        from drivesem.analysis.evaluate.detector import evaluate_detector, print_detector_metrics
        from drivesem.config.devices import check_device

        check_device(config.device)
        metrics = evaluate_detector(config)
        if config.json:
            print_json(metrics.data)
        print_detector_metrics(metrics, console)
        return 0
    result = evaluate_files(config)
    if config.json:
        print_json(result.to_json())
    print_evaluation(result, console)
    return 0
