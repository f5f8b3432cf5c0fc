"""From a folder that the generator wrote back to its plans, frame by frame; and folders of other kinds."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivesem.config.errors import UsageError
from drivesem.data.kitti import read_labels
from drivesem.failures.second_renderer.generator import DemoPlans, FolderPlans
from drivesem.synth.frames import render_frame
from drivesem.synth.write import Order, synthesise
from scene_ir import files
from scene_ir.errors import FormatError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "streets"
    list(synthesise(Order(out, 1, seed=5, split="heldout", variations=("clone", "fog"))))
    return out


def scene_of(rows: list[int], **provenance: str) -> Any:
    """What a plan needs of a scene: how many objects it has, and from which labels they come."""
    provenance |= {f"objects[{i}].label": str(row) for i, row in enumerate(rows)}
    return SimpleNamespace(objects=range(len(rows)), provenance=provenance)


@pytest.mark.parametrize("inside", ["", "training"])
def test_plans_draw_the_files(folder: Path, inside: str) -> None:
    """Each variation of a street is a frame of its own."""
    plans = FolderPlans(folder / inside)
    labels = read_labels(folder / "training" / "label_2" / "000001.txt")
    rows = [i for i, kind in enumerate(labels.kind) if kind in ("Car", "Van", "Truck")]
    found = plans.find_plan("000001", scene_of([*rows[::-1], 99]))
    assert found.plan.variation == "fog"
    assert found.tracks[-1] is None
    actors = {actor.track: actor for actor in found.plan.actors}
    for row, track in zip(rows[::-1], found.tracks[:-1], strict=True):
        assert track is not None
        assert actors[track].label == labels.kind[row]
        assert actors[track].size_lhw == pytest.approx(labels.size_lhw[row].tolist(), abs=1e-3)
    if not inside:
        frame = render_frame(found.plan)
        assert frame is not None
        written = files.read_image(folder / "training" / "image_2" / "000001.png")
        np.testing.assert_array_equal(frame.image, written)


def test_unknown_frames(folder: Path) -> None:
    for name in ("000002", "night"):
        with pytest.raises(FormatError, match=f"frame {name}"):
            FolderPlans(folder).find_plan(name, scene_of([]))


@pytest.mark.parametrize(
    ("key", "value", "error", "told"),
    [
        ("generator", 1, FormatError, "which alone gives the same pictures, found 1"),
        ("layout", "coco", UsageError, "layout coco"),
        ("edits", "00ff", FormatError, "edits: expected none"),
        ("split", "tests", FormatError, "as drivesem synth writes it"),
        ("seed", None, FormatError, "as drivesem synth writes it"),
    ],
)
def test_manifests_that_cannot_be_used(
    folder: Path, tmp_path: Path, key: str, value: object, error: type[Exception], told: str
) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    if value is None:
        del manifest[key]
    else:
        manifest[key] = value
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(error, match=told):
        FolderPlans(tmp_path)


def test_photographs_are_no_generated_frames(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"which has no manifest\.json"):
        FolderPlans(tmp_path)
    (tmp_path / "manifest.json").write_text('{"name": "something else"}')
    with pytest.raises(UsageError, match="another program's"):
        FolderPlans(tmp_path)


def test_an_embedded_scene_names_its_street() -> None:
    with pytest.raises(FormatError, match="seed, index, attempt"):
        DemoPlans().find_plan("demo-000", scene_of([], seed="0", index="0"))
    with pytest.raises(FormatError, match="an embedded scene's"):
        DemoPlans().find_plan("demo-000", scene_of([], seed="0", index="0", attempt="0"))
