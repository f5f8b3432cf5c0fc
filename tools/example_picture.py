"""The README's picture: one frame of a run before and after, with true and detected boxes.

python tools/example_picture.py runs/demo-color-weather-translate-rotate-climb-seed0 demo-003 docs/example.jpg
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from drivesem.run.report import pictures
from drivesem.run.results import load_frame
from scene_ir import files

JPEG_QUALITY = 88
GAP_PX = 6


def example(run: Path, name: str) -> pictures.Image:
    """The benign frame above the counterexample, (2 H + gap, W, 3) RGB, each with its labels and detections."""
    folder = run / "frames" / name
    result = load_frame(folder / "result.json")
    threshold = float(json.loads(files.read_text(run / "metrics.json"))["t_star"])
    before = pictures.draw_overlay(
        files.read_image(folder / "benign.png"), result.targets_benign, result.detections_benign, (), threshold
    )
    after = pictures.draw_overlay(
        files.read_image(folder / "counterexample.png"),
        result.targets_moved,
        result.detections_attacked,
        result.failures,
        threshold,
    )
    gap = np.full((GAP_PX, before.shape[1], 3), 255, np.uint8)
    return np.concatenate([before, gap, after])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("frame")
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    picture = example(arguments.run, arguments.frame)
    encoded = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    files.write_bytes(arguments.out, encoded.tobytes())


if __name__ == "__main__":
    main()
