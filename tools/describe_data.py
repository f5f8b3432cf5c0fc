"""What folders of generated frames were made of: the vehicle shapes and surroundings that their frames show.

    python tools/describe_data.py build/plain build/pack --out detectors/weights/squeezedet_data.json

The result goes beside the weights that were trained on the folders, so that a test can show that no demo scene,
and no frame that they were judged by, shares anything with them.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from drivesem.training.known import describe
from scene_ir import files


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, help="only the first ones of each folder")
    arguments = parser.parse_args()
    files.write_text(arguments.out, json.dumps(describe(arguments.folders, arguments.frames)) + "\n")


if __name__ == "__main__":
    main()
