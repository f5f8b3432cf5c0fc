"""`drivesem COMMAND [options]`: the table of commands."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from drivesem import __version__
from drivesem.config.commands import COMMANDS
from drivesem.program import Program, RunCommand

TOPICS = {
    "Find failures": ("attack", "drive", "classify"),
    "Validate and explain": ("verify", "confirm", "explain", "holes", "transfer"),
    "Improve": ("gate", "retrain", "train", "eval", "export"),
    "Data and scenes": ("inspect", "convert", "derender", "edit", "render", "view", "synth"),
    "Setup": ("check", "doctor", "bench", "report", "runs"),
}
"""Every command, by purpose."""
EXAMPLES = {
    "drivesem attack --combo 2": "attack the shipped detector on ten generated streets; needs no data",
    "drivesem attack --dataset kitti --root KITTI --limit 20 --out runs/a": "attack it on your photographs",
    "drivesem inspect KITTI": "see what is read of your data, and what is not",
    "drivesem attack --config quick": "use a preset; --config list prints them",
    "drivesem explain runs/a": "find out why it fails",
    "drivesem export runs/a --to coco --out for-training": "turn the counterexamples into training data",
}
_MODULES = {
    "analyses": ("confirm", "drive", "explain", "gate", "holes", "transfer", "verify"),
    "attack": ("attack", "report"),
    "data": ("convert", "export", "inspect"),
    "scenes": ("derender", "edit", "render"),
    "training": ("train", "retrain"),
}
"""Modules of `drivesem.commands` with several commands; the others hold the command of their name."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `drivesem`; see `Program.main`."""
    summary = "Find out where a driving detector breaks: semantic counterexamples by gradient."
    return Program("drivesem", __version__, summary, COMMANDS, _load, TOPICS, EXAMPLES).main(argv)


def _load(command: str) -> RunCommand:
    module = next((module for module, names in _MODULES.items() if command in names), command)
    return getattr(importlib.import_module(f"drivesem.commands.{module}"), f"{command}_command")


if __name__ == "__main__":
    sys.exit(main())
