"""Score threshold t* of a detector, from frames outside its training set.

    drivesem synth --layout kitti --split heldout --seed 5 --frames 120 --variations clone --out validation
    python -m tools.threshold validation squeezedet yolov3-slim

prints for each detector the score of best F1 over all classes, with 95 % of 200 draws of frames, and its own t*.
KITTI's layout.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from detectors.registry import load_detector
from drivesem.attacks.labels import Difficulty
from drivesem.data.registry import open_dataset
from drivesem.reporting.tables import format_count
from drivesem.training.frames import FrameStore
from drivesem.training.validation import detect_in_store, score_detections

DRAWS = 200


def measure_threshold(name: str, folder: Path) -> str:
    """One line."""
    detector, dataset = load_detector(name), open_dataset("kitti", folder)
    with tempfile.TemporaryDirectory() as cache:
        store = FrameStore(dataset, dataset.identifiers, Path(cache), detector.classes)
        found, wanted = detect_in_store(detector, store, range(len(store))), store.evaluation_targets(Difficulty())
    best, generator, drawn = score_detections(found, wanted, detector.classes), np.random.default_rng(0), []
    for _ in range(DRAWS):
        rows = generator.integers(len(store), size=len(store))
        drawn.append(
            score_detections([found[i] for i in rows], [wanted[i] for i in rows], detector.classes).t_star
        )
    low, high = np.quantile(drawn, [0.025, 0.975])
    objects = sum(int((~targets.ignore).sum()) for targets in wanted)
    return (
        f"{name}, {format_count(len(store), 'frame')}, {format_count(objects, 'object')}: best F1 "
        f"{best.f1:.3f} at {best.t_star:.3f} [{low:.3f}, {high:.3f}]; its own t* is {detector.t_star:.3f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("detectors", nargs="+")
    arguments = parser.parse_args()
    for name in arguments.detectors:
        print(measure_threshold(name, arguments.folder))


if __name__ == "__main__":
    main()
