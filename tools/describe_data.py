"""What folders of generated frames were made of: the vehicle shapes and surroundings that their frames show.

    python tools/describe_data.py build/plain build/pack --out detectors/weights/squeezedet_data.json

The result goes beside the weights that were trained on the folders, so that a test can show that no demo scene,
and no frame that they were judged by, shares anything with them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scene_ir import files

SHARED = ("split", "seed", "vehicles", "building", "tree", "bush", "surface")
"""What a frame's manifest says of its origin and of the shapes it shows."""


def describe(folders: Sequence[Path], frames: int | None = None) -> dict[str, Any]:
    """Splits, seeds and the union of shapes over folders of `drivesem synth`, the first `frames` of each."""
    manifests = [files.read_json(folder / "manifest.json")["frames"] for folder in folders]
    entries = [entry for manifest in manifests for entry in manifest[:frames]]
    union: dict[str, Any] = {"frames": len(entries)}
    for key in SHARED:
        values = [entry[key] for entry in entries]
        union[key] = sorted({v for value in values for v in (value if isinstance(value, list) else [value])})
    return union


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, help="only the first ones of each folder")
    arguments = parser.parse_args()
    files.write_text(arguments.out, json.dumps(describe(arguments.folders, arguments.frames)) + "\n")


if __name__ == "__main__":
    main()
