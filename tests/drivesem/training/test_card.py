"""Which generated streets weights have seen, and where they are shown again."""

from __future__ import annotations

import io
import itertools
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from drivesem.training.card import (
    describe_data,
    generated_folders,
    list_overlaps,
    street_seeds,
    warn_about_overlaps,
)

WEIGHTS = Path(__file__).parents[3] / "detectors" / "weights"
SETS = ("squeezedet_data", "validation_data", "heldout_data")
"""Of the shipped detectors: trained on, chosen by, judged by."""


def folder(root: Path, split: str, seed: int, frames: int = 2) -> Path:
    shapes = {"vehicles": ["sedan-1"], "building": [1], "tree": [1], "bush": [1], "surface": [1]}
    root.mkdir(parents=True)
    entries = [{"split": split, "seed": seed, "index": i, **shapes} for i in range(frames)]
    (root / "manifest.json").write_text(json.dumps({"seed": seed, "frames": entries}))
    return root


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Weights whose card names what they were trained on and chosen by."""
    for name, split, seed in (("own_data", "train", 3), ("own_chosen_data", "heldout", 5)):
        described = describe_data([folder(tmp_path / name, split, seed)])
        (tmp_path / f"{name}.json").write_text(json.dumps(described))
    (tmp_path / "own.md").write_text("`own_data.json` lists these, `own_chosen_data.json` those that chose.")
    return tmp_path / "own.safetensors"


def read(name: str) -> dict[str, Any]:
    return json.loads((WEIGHTS / f"{name}.json").read_text())


def apart(described: dict[str, dict[str, Any]]) -> None:
    for one, other in itertools.combinations(described, 2):
        shared = street_seeds(described[one]) & street_seeds(described[other])
        assert not shared, f"{one} and {other} share {sorted(shared)}"


def test_the_shipped_sets_share_no_street() -> None:
    apart({name: read(name) for name in SETS})
    assert not set(read("squeezedet_data")["vehicles"]) & set(read("validation_data")["vehicles"])
    with pytest.raises(
        AssertionError, match=r"squeezedet_data and again share \[\('train', 1\), \('train', 3\)\]"
    ):
        apart({name: read(name) for name in SETS} | {"again": read("squeezedet_data")})


def test_lists_streets_that_a_card_names(weights: Path, tmp_path: Path) -> None:
    fresh = folder(tmp_path / "fresh", "heldout", 6)
    chosen = folder(tmp_path / "chosen", "heldout", 5, 7)
    assert list_overlaps(str(weights), str(fresh)) == []
    (line,) = list_overlaps(str(weights), str(chosen))
    assert line.startswith(f"{chosen}: streets of split heldout, seed 5, are among those of own_chosen_data.json")
    both = f"{fresh},{folder(tmp_path / 'trained', 'train', 3)}"
    assert "own_data.json" in list_overlaps(str(weights), both)[0]
    # Photographs, data sets from elsewhere and detectors without a card do not tell.
    assert list_overlaps(str(weights), str(tmp_path)) == list_overlaps("onnx:x.onnx", str(chosen)) == []
    assert list_overlaps(str(weights), None) == []
    stream = io.StringIO()
    warn_about_overlaps([str(weights), str(weights)], str(chosen), Console(file=stream, width=60))
    assert stream.getvalue() == line + "\n"


def test_the_shipped_cards_name_their_sets(tmp_path: Path) -> None:
    for detector in ("squeezedet", "yolov3-slim"):
        for name in SETS:
            (split, seed), *_ = sorted(street_seeds(read(name)))
            visible = folder(tmp_path / f"{detector}-{name}", split, seed)
            assert f"{name}.json" in "".join(list_overlaps(detector, str(visible))), (detector, name)


def test_folders_are_described_only_where_all_were_generated(tmp_path: Path) -> None:
    made = folder(tmp_path / "made", "train", 4, 3)
    (tmp_path / "other").mkdir()
    assert generated_folders(f"{made}") == [made]
    assert generated_folders(f"{made},{tmp_path / 'other'}") == generated_folders(None) == []
    described = describe_data([made], 2)
    assert (described["frames"], described["split"], described["seed"]) == (2, ["train"], [4])
