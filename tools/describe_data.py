"""What a folder of generated frames was made of: the vehicle shapes and surroundings that its frames show.

    python tools/describe_data.py data/synth-train-seed1 detectors/weights/squeezedet_data.json

The result goes beside the weights that were trained on the folder, so that a test can show that no demo scene
shares anything with them.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from scene_ir import files

SHARED = ("split", "seed", "vehicles", "building", "tree", "bush", "surface")
"""What a frame's manifest says of its origin and of the shapes it shows."""


def describe(folder: Path, frames: int | None = None) -> dict[str, Any]:
    """Splits, seeds and the union of shapes over the first `frames` frames of a folder of `drivesem synth`."""
    entries = files.read_json(folder / "manifest.json")["frames"][:frames]
    union: dict[str, Any] = {"frames": len(entries)}
    for key in SHARED:
        values = [entry[key] for entry in entries]
        union[key] = sorted({v for value in values for v in (value if isinstance(value, list) else [value])})
    return union


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, help="only the first ones")
    arguments = parser.parse_args()
    files.write_text(arguments.out, json.dumps(describe(arguments.folder, arguments.frames)) + "\n")


if __name__ == "__main__":
    main()
