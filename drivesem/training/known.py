"""Which generated streets weights have seen: those they were trained on, and those that chose step and t*."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from detectors.registry import SHIPPED
from drivesem.report.terminal import Console
from scene_ir import files

SHARED = ("split", "seed", "vehicles", "building", "tree", "bush", "surface")
"""What a frame's manifest says of its origin and of the shapes it shows."""
MANIFEST = "manifest.json"
_NAMED = re.compile(r"`([\w.-]+_data\.json)`")
"""Files beside a model card that say what frames were made of."""


def describe(folders: Iterable[Path], frames: int | None = None) -> dict[str, Any]:
    """Splits, seeds and the union of shapes over folders of `drivesem synth`, the first `frames` of each."""
    manifests = [files.read_json(folder / MANIFEST)["frames"] for folder in folders]
    entries = [entry for manifest in manifests for entry in manifest[:frames]]
    union: dict[str, Any] = {"frames": len(entries)}
    for key in SHARED:
        values = [entry[key] for entry in entries]
        union[key] = sorted({v for value in values for v in (value if isinstance(value, list) else [value])})
    return union


def generated(folders: str | None) -> list[Path]:
    """The folders, with commas between, where `drivesem synth` made all of them; else none."""
    found = [Path(part) for part in (folders or "").split(",") if part]
    return found if found and all((folder / MANIFEST).is_file() for folder in found) else []


def streets(described: dict[str, Any]) -> set[tuple[str, int]]:
    """Split and seed of streets that `describe` tells of: where two sets share one, they share streets."""
    return {(split, seed) for split in described["split"] for seed in described["seed"]}


def overlaps(detector: str, folders: str | None) -> list[str]:
    """Lines that say which frames of generated folders a detector's model card names as its own, to train on or to
    choose by; none where the card or the folders do not tell.
    """
    here = generated(folders)
    card = SHIPPED.get(detector, Path(detector)).with_suffix(".md")
    if not here or not card.is_file():
        return []
    own, lines = streets(describe(here)), []
    for name in dict.fromkeys(_NAMED.findall(files.read_text(card))):
        path = card.with_name(name)
        for split, seed in sorted(own & streets(files.read_json(path)) if path.is_file() else ()):
            lines.append(
                f"{folders}: streets of split {split}, seed {seed}, are among those of {name}, which the card of "
                f"{detector} names: figures on them are not of held-out frames"
            )
    return lines


def warn_of_overlaps(detectors: Sequence[str], folders: str | None, console: Console) -> None:
    """Say it, a line each."""
    for line in dict.fromkeys(line for one in detectors for line in overlaps(one, folders)):
        console.print(line, soft_wrap=True, markup=False, highlight=False)
