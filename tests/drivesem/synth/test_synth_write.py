"""Frames on disk: a KITTI folder that can be gone on with."""

import numpy as np
import pytest

from drivesem.data.kitti import KittiDataset
from drivesem.synth import write
from drivesem.synth.frames import generate_frame
from drivesem.synth.write import synthesise
from scene_ir import files
from scene_ir.errors import FormatError, RangeError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("synth")
    assert list(synthesise(out, 2, seed=4)) == [0, 1]
    return out


def test_the_folder_reads_back_as_kitti(folder):
    data = KittiDataset(folder)
    assert list(data.identifiers) == ["000000", "000001"]
    frame, made = data.frame("000001"), generate_frame(4, 1)
    assert np.array_equal((frame.photograph.numpy() * 255).round().astype(np.uint8), made.image.transpose(2, 0, 1))
    assert frame.labels is not None
    assert frame.labels.kind == made.labels.kind
    assert (frame.labels.boxes_xyxy - made.labels.boxes_xyxy).abs().max() < 0.01
    assert (frame.camera.matrix - made.camera.matrix).abs().max() < 1e-3


def test_the_manifest_lists_every_frame(folder):
    manifest = files.read_json(folder / "manifest.json")
    assert [entry["index"] for entry in manifest["frames"]] == [0, 1]
    assert manifest["seed"] == 4
    assert manifest["split"] == "train"


def test_frames_that_exist_are_kept_and_missing_ones_made_again(folder, monkeypatch):
    images = sorted((folder / "training" / "image_2").glob("*.png"))
    before = [p.read_bytes() for p in images]
    images[1].unlink()
    made = []
    original = write.generate_frame

    def counted(seed, index, *rest):
        made.append(index)
        return original(seed, index, *rest)

    monkeypatch.setattr(write, "generate_frame", counted)
    assert list(synthesise(folder, 2, seed=4)) == [0, 1]
    assert made == [1]
    assert [p.read_bytes() for p in images] == before


def test_another_seed_in_the_same_folder_is_an_error(folder):
    with pytest.raises(FormatError, match=r"origin\.json: expected seed 5"):
        list(synthesise(folder, 2, seed=5))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 0}, "synth frames: expected at least 1, found 0"),
        ({"frames": 1, "workers": 0}, "synth workers: expected at least 1, found 0"),
        ({"frames": 1, "split": "test"}, "synth split: expected train or heldout, found test"),
    ],
)
def test_bad_requests_are_errors(tmp_path, changes, message):
    with pytest.raises(RangeError, match=message):
        list(synthesise(tmp_path / "out", **changes))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_workers_change_nothing(tmp_path, folder):
    list(synthesise(tmp_path, 2, seed=4, workers=2))
    for path in sorted((folder / "training").rglob("*.*")):
        assert (tmp_path / "training" / path.relative_to(folder / "training")).read_bytes() == path.read_bytes()
