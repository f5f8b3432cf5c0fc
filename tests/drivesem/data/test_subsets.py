"""Subsets and joined folders: 3D-SDN's splits of Virtual KITTI, random shares, names in a file, several folders."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from drivesem.config.commands import TrainConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import SceneOptions
from drivesem.data.ground_truth import Exposure, FrameLocation
from drivesem.data.registry import open_dataset
from drivesem.data.subsets import PUBLISHED_SPLITS, FrameFilter, open_selection, select_split
from drivesem.data.vkitti1 import Vkitti1Writer
from drivesem.scenes.sources import open_source
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.types import Camera

VARIATIONS = ("clone", "fog")


class Named:
    """A data set of names alone."""

    def __init__(self, names: list[str]) -> None:
        self.identifiers = tuple(names)

    def splits(self) -> dict[str, tuple[str, ...]]:
        return {}


def virtual(layout: str) -> list[str]:
    """Every frame of the data set's five worlds, in two of its ten variations."""
    lengths = {1: 447, 2: 233, 6: 270, 18: 339, 20: 837}
    form = "{0:04d}/{1}/{2:05d}" if layout == "vkitti1" else "Scene{0:02d}/{1}/Camera_0/{2:05d}"
    return [form.format(w, v, i) for w, count in lengths.items() for v in VARIATIONS for i in range(count)]


@pytest.mark.parametrize("layout", ["vkitti1", "vkitti2"])
def test_3d_sdns_split_has_its_published_sizes_and_ends(layout: str) -> None:
    dataset = Named(virtual(layout))
    tested, trained = (select_split(dataset, split) for split in PUBLISHED_SPLITS)
    assert (len(tested), len(trained)) == (2 * 444, 2 * 1682)  # of 4,440 and 16,820 in ten variations
    assert set(tested) | set(trained) == set(dataset.identifiers)
    assert not set(tested) & set(trained)
    worlds = Counter(name.split("/")[0][-2:] for name in tested)
    assert worlds == {"01": 2 * 91, "02": 2 * 48, "06": 2 * 69, "18": 2 * 69, "20": 2 * 167}
    first = [name for name in tested if "clone" in name and name[:7] in ("0001/cl", "Scene01")]
    assert (first[0][-5:], first[-1][-5:]) == ("00356", "00446")


def test_generated_worlds_are_divided_and_read(tmp_path: Path, make_shot: Callable[..., Exposure]) -> None:
    """Two frames on both sides of where 3D-SDN divides world 6."""
    writer = Vkitti1Writer(tmp_path)
    camera = Camera(torch.tensor([[725.0, 0, 620.5], [0, 725, 187], [0, 0, 1]]), 375, 1242)
    places = [FrameLocation(i, "06", "clone", 68 + i, "train") for i in range(2)]
    writer.finish([writer.write(place, make_shot(375, 1242, camera, place.number)) for place in places])
    dataset = open_dataset("vkitti1", tmp_path)
    tested, trained = (select_split(dataset, split) for split in PUBLISHED_SPLITS)
    assert (tested, trained) == (["0006/clone/00068"], ["0006/clone/00069"])
    selected = open_selection("vkitti1", tmp_path, FrameFilter(split="3d-sdn"))
    labels = selected.labels("0006/clone/00068")
    assert labels is not None
    assert labels.kind == ("Car", "Car", "Van")
    assert selected.frame("0006/clone/00068").photograph.shape == (3, 375, 1242)
    source = open_source(SceneOptions(dataset="vkitti1", root=str(tmp_path), split="3d-sdn-train"))
    assert list(source.identifiers()) == ["0006/clone/00069"]


def test_a_share_at_random_and_all_others_are_the_whole_in_its_order() -> None:
    dataset = Named(virtual("vkitti1"))
    some, others = (select_split(dataset, f"random:0.75{rest}") for rest in ("", ":rest"))
    assert len(some) == round(0.75 * len(dataset.identifiers))
    assert sorted((*some, *others)) == sorted(dataset.identifiers)
    assert some == sorted(some, key=dataset.identifiers.index) == select_split(dataset, "random:.75")
    worlds = [{name[:10] for name in part} for part in (some, others)]
    assert worlds[0] == worlds[1]  # the same drives
    with pytest.raises(FormatError):
        select_split(dataset, "random:1.5")


def test_names_in_a_file_are_taken_in_the_data_sets_order(tmp_path: Path) -> None:
    dataset = Named(["0001/clone/00000", "0001/clone/00001", "a.b"])
    listed = tmp_path / "names.txt"
    listed.write_text("a.b\n\n0001/clone/00000.png\n")
    assert select_split(dataset, str(listed)) == ["0001/clone/00000", "a.b"]


def test_invalid_splits_are_refused(tmp_path: Path) -> None:
    listed = tmp_path / "names.txt"
    listed.write_text("000000\n000009\n")
    with pytest.raises(FormatError, match=r"names\.txt:2: expected a frame such as 000000, found '000009'"):
        select_split(Named(["000000"]), str(listed))
    for name in (".", "/"):
        listed.write_text(f"{name}\n")
        with pytest.raises(FormatError, match=r"names\.txt:1: expected a frame such as 000000, found '[./]'"):
            select_split(Named(["000000"]), str(listed))
    listed.write_text("\n")
    with pytest.raises(FormatError, match=r"--split .*: expected at least one frame of the data set"):
        select_split(Named(["000000"]), str(listed))
    with pytest.raises(FormatError, match=r"--split: expected frames of Virtual KITTI's worlds 1, 2, 6, 18, 20"):
        select_split(Named(["000000"]), "3d-sdn")
    with pytest.raises(FormatError, match="found '0003/clone/00000'"):
        select_split(Named(["0003/clone/00000"]), "3d-sdn")
    with pytest.raises(FormatError, match=r"absent\.txt"):
        select_split(Named(["000000"]), str(tmp_path / "absent.txt"))


def test_a_split_needs_a_labelled_data_set(refused: Callable[..., str]) -> None:
    assert "--split: expected --dataset kitti" in refused("attack", "--split", "3d-sdn")
    with pytest.raises(UsageError, match="--split, --held-out-split: expected none with --dataset synth"):
        TrainConfig(dataset="synth", held_out_split="3d-sdn").check()
    TrainConfig(dataset="vkitti1", root="x", held_out_split="3d-sdn").check()


CALIBRATION = "P2: 700 0 60 0 0 700 20 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"


def _kitti(root: Path, names: list[str], value: int) -> Path:
    for name in names:
        files.write_png(root / f"training/image_2/{name}.png", np.full((40, 120, 3), value, np.uint8))
        files.write_text(root / f"training/calib/{name}.txt", CALIBRATION)
        box = f"{value}.00 5.00 90.00 30.00"
        files.write_text(root / f"training/label_2/{name}.txt", f"Car 0 0 -10 {box} 1.5 1.7 4.2 0 1.6 20 0.1\n")
    return root


def test_frames_of_both_folders_in_order(tmp_path: Path) -> None:
    first = _kitti(tmp_path / "b", ["000000", "000001"], 10)
    second = _kitti(tmp_path / "a", ["000000"], 20)
    joined = open_selection("kitti", f"{first},{second}")
    assert joined.identifiers == ("0/000000", "0/000001", "1/000000")
    for name, value in zip(joined.identifiers, (10, 10, 20), strict=True):
        labels = joined.labels(name)
        assert labels is not None
        assert float(labels.boxes_xyxy[0, 0]) == value
        assert torch.equal(joined.frame(name).photograph, torch.full((3, 40, 120), value / 255))


def test_frames_with_attributes_are_selected(tmp_path: Path, make_shot: Callable[..., Exposure]) -> None:
    writer = Vkitti1Writer(tmp_path)
    camera = Camera(torch.tensor([[725.0, 0, 620.5], [0, 725, 187], [0, 0, 1]]), 375, 1242)
    weathers = ("clone", "fog", "rain", "15-deg-left")
    places = [FrameLocation(i, "01", weather, 0, "train") for i, weather in enumerate(weathers)]
    writer.finish([writer.write(place, make_shot(375, 1242, camera, place.number)) for place in places])
    chosen = open_selection("vkitti1", tmp_path, FrameFilter(where={"weather": ("fog", "rain")}))
    assert chosen.identifiers == ("0001/fog/00000", "0001/rain/00000")
    assert chosen.frame("0001/fog/00000").attributes == {"variation": "fog", "weather": "fog"}
    account = chosen.account()
    assert (account.frames, account.selection) == (4, "used: 2 images (weather fog or rain)")
    assert account.files + sum(account.skipped.values()) == sum(p.is_file() for p in tmp_path.rglob("*"))
    with pytest.raises(FormatError, match="--where weather: expected one of clone, fog, rain, found 'snow'"):
        open_selection("vkitti1", tmp_path, FrameFilter(where={"weather": ("snow",)}))
    with pytest.raises(FormatError, match="--where time: expected one of variation, weather, found 'time'"):
        open_selection("vkitti1", tmp_path, FrameFilter(where={"time": ("night",)}))


def test_own_splits_and_class_names(tmp_path: Path) -> None:
    root = _kitti(tmp_path, ["000000", "000001"], 10)
    files.write_text(root / "ImageSets/val.txt", "000001\n")
    chosen = open_selection("kitti", root, FrameFilter("val", mapping={"Car": "truck"}))
    assert chosen.identifiers == ("000001",)
    labels = chosen.labels("000001")
    assert labels is not None
    assert labels.kind == ("Truck",)
    assert chosen.account().by_role()["mapped"] == {"Car as Truck": 2}
    with pytest.raises(FormatError, match="--split: expected one of val, random:FRACTION, or a file of names"):
        open_selection("kitti", root, FrameFilter("train"))


def test_riders_labelled_apart_from_their_two_wheelers_are_marked(tmp_path: Path) -> None:
    root = _kitti(tmp_path, ["000000"], 10)
    for mapping, expected in (({"Car": "Rider"}, "rider"), ({"Car": "Cyclist"}, None)):
        frame = open_selection("kitti", root, FrameFilter(mapping=mapping)).frame("000000")
        assert frame.labels is not None
        assert frame.labels.kind == ("Cyclist",)
        assert frame.provenance.get("labels[0].name") == expected


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    first = _kitti(tmp_path / "a", ["000000"], 10)
    with pytest.raises(FormatError, match="missing"):
        open_selection("kitti", f"{first},{tmp_path / 'missing'}")
