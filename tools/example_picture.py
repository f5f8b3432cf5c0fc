"""A picture for README or docs: one frame of a run before and after, with true and detected boxes. Its caption is
printed, and is the JPEG's comment: the page has the same text.

python tools/example_picture.py runs/demo-color-weather-translate-rotate-climb-seed0 demo-003 docs/example.jpg
python tools/example_picture.py runs/crossing 000000 docs/crossing.jpg --quality 80
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image

from drivesem.config.options import format_command_line
from drivesem.run.folder import PRESENTATION, load_attack_config
from drivesem.run.report import pictures
from drivesem.run.report.page import name_failure
from drivesem.run.results import Failure, FrameResult, load_frame
from scene_ir import files

GAP_PX = 6


def draw_example(run: Path, result: FrameResult) -> pictures.Image:
    """The benign frame above the counterexample, (2 H + gap, W, 3) RGB, each with its labels and detections."""
    folder = run / "frames" / result.identifier
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


def write_caption(command: str, result: FrameResult) -> str:
    """The caption: the command, the colours, and each failure with its grade and draws."""
    failures = "; ".join(map(_describe, result.failures)) or "none"
    return (
        f"A generated street, frame {result.identifier} of `{command}`. Green: true boxes. Yellow: detections. Orange: "
        f"missed objects. {failures}. Confirmed: in a second renderer's picture too; shared: by another detector too."
    )


def _describe(failure: Failure) -> str:
    text, count = f"{name_failure(failure)}: {failure.grade or 'not graded'}", failure.count
    if count is None or not count.before_draws:
        return text
    text += f" (right in {count.before} of {count.before_draws} random draws before the change"
    return f"{text}, wrong in {count.after} of {count.after_draws} after it)"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("frame")
    parser.add_argument("out", type=Path)
    parser.add_argument("--quality", type=int, default=88)
    arguments = parser.parse_args()
    result = load_frame(arguments.run / "frames" / arguments.frame / "result.json")
    attack = load_attack_config(arguments.run)
    command = format_command_line("attack", attack, set(PRESENTATION) - {"limit"})
    caption = write_caption(command, result)
    picture = Image.fromarray(draw_example(arguments.run, result))
    picture.save(arguments.out, "JPEG", quality=arguments.quality, comment=caption.encode())
    print(caption)


if __name__ == "__main__":
    main()
