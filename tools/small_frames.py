"""Small labelled frames, a car in each, as many as are wanted, for long runs of commands.

python -m tools.small_frames 2000 small            # KITTI's layout, in small/training
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from scene_ir import files
from tools.same import copy_crop, sort_labels

STREETS = 20
"""Generated frames that the small ones are cut from, at different places."""
_WINDOW_WH = 192, 112
_SHIFT_PX = 5
_ACROSS = 15


def small_frames(folder: Path, count: int, streets: int = STREETS) -> None:
    """Make `folder`, KITTI's layout: a car a frame, cut from so many generated streets."""
    with tempfile.TemporaryDirectory(dir=folder.parent) as temporary:
        words = ["synth", "--frames", str(streets), "--seed", "11", "--workers", "2", "--out", temporary]
        subprocess.run([sys.executable, "-m", "drivesem.cli", *words], check=True, stdout=subprocess.DEVNULL)
        source = Path(temporary) / "training"
        cars = {path.stem: sort_labels(path) for path in sorted((source / "label_2").glob("*.txt"))}
        visible = [name for name, (car, *_) in cars.items() if car[0] == "Car" and _is_seen(car)]
        width, height = _WINDOW_WH
        for number in range(count):
            name, turn = visible[number % len(visible)], number // len(visible)
            left, top, right, bottom = map(float, cars[name][0][4:8])
            # Each time a little to the side: no two pictures are the same.
            down, across = divmod(turn, _ACROSS)
            x0 = round((left + right - width) / 2) + _SHIFT_PX * (across - _ACROSS // 2)
            y0 = round((top + bottom - height) / 2) + down
            copy_crop(source, folder / "training", name, 1.0, (x0, y0, x0 + width, y0 + height), slice(1))
            for path in sorted((folder / "training").glob(f"*/{name}.*")):
                path.rename(path.with_stem(f"n{number:05d}"))


def _is_seen(car: Sequence[str]) -> bool:
    """Whether a label is of a car that can be de-rendered, and is small enough for the window."""
    truncation, occlusion = float(car[1]), int(car[2])
    left, top, right, bottom = map(float, car[4:8])
    width, height = _WINDOW_WH
    fits = right - left < width - 50 and 30 <= bottom - top < height - 20
    return fits and truncation == 0 and occlusion == 0


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, help="how many")
    parser.add_argument("folder", type=Path, help="folder to make")
    given = parser.parse_args(argv)
    with files.atomic_folder(given.folder) as part:
        small_frames(part, given.count)


if __name__ == "__main__":
    main()
