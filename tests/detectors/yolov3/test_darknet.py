"""Darknet's `.weights`: equal outputs after writing and reading; order by hand; files that do not fit."""

import resource
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from detectors.base import DetectorError
from detectors.registry import load_detector
from detectors.yolov3 import darknet
from detectors.yolov3 import darknet as weights
from detectors.yolov3.cfg import DarknetCfg, parse
from detectors.yolov3.network import DarknetNetwork
from detectors.yolov3.yolov3 import YoloV3

TWO = """[net]
[convolutional]
batch_normalize=1
filters=2
size=1
activation=leaky
[convolutional]
filters=6
size=1
activation=linear
[yolo]
mask=0
anchors=4,4
classes=1
"""
NUMBERS = 4 * 2 + 2 * 3 + 6 + 6 * 2


def test_round_trip_gives_the_same_outputs(mini: YoloV3, mini_cfg: DarknetCfg, tmp_path: Path) -> None:
    path = tmp_path / "mini.weights"
    weights.save_weights(mini.network, path, seen=2**33)
    other = DarknetNetwork(mini_cfg).eval()
    assert weights.load_weights(other, path) == 2**33
    x = torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        for ours, theirs in zip(mini.network(x), other(x), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-6)
    assert [p.name for p in tmp_path.iterdir()] == ["mini.weights"]


@pytest.mark.parametrize(("version", "seen"), [((0, 1, 0), "<i"), ((0, 2, 5), "<q"), ((1, 0, 0), "<q")])
def test_order_and_header_by_hand(version: tuple[int, int, int], seen: str, tmp_path: Path) -> None:
    path = tmp_path / "two.weights"
    numbers = np.arange(1, NUMBERS + 1, dtype="<f4")
    path.write_bytes(struct.pack("<3i", *version) + struct.pack(seen, 77) + numbers.tobytes())
    network = DarknetNetwork(parse(TWO))
    assert weights.load_weights(network, path) == 77
    first, second = network.blocks.values()
    assert first.norm is not None
    assert first.norm.bias.tolist() == [1, 2]
    assert first.norm.weight.tolist() == [3, 4]
    assert first.norm.running_mean.tolist() == [5, 6]
    assert first.norm.running_var.tolist() == [7, 8]
    assert first.conv.weight.flatten().tolist() == [9, 10, 11, 12, 13, 14]
    assert first.conv.bias is None
    assert second.conv.bias is not None
    assert second.conv.bias.tolist() == [15, 16, 17, 18, 19, 20]
    assert second.conv.weight.flatten().tolist() == list(range(21, 33))
    # The order in which they are written is the same.
    weights.save_weights(network, path, 77)
    written = path.read_bytes()
    assert struct.unpack("<3iq", written[:20]) == (0, 2, 0, 77)
    assert np.array_equal(np.frombuffer(written[20:], "<f4"), numbers)


@pytest.mark.parametrize(("extra", "found"), [(-1, "31"), (3, "35"), (-32, "0")])
def test_files_of_another_length(extra: int, found: str, tmp_path: Path) -> None:
    path = tmp_path / "two.weights"
    path.write_bytes(struct.pack("<3iq", 0, 2, 0, 0) + bytes(4 * (NUMBERS + extra)))
    with pytest.raises(
        DetectorError, match=rf"two\.weights: expected 32 numbers after the header, found {found}$"
    ):
        weights.load_weights(DarknetNetwork(parse(TWO)), path)


def test_files_that_are_none(tmp_path: Path) -> None:
    network = DarknetNetwork(parse(TWO))
    with pytest.raises(DetectorError, match=r"gone\.weights: expected Darknet weights, found No such file"):
        weights.load_weights(network, tmp_path / "gone.weights")
    short = tmp_path / "short.weights"
    short.write_bytes(b"dark")
    with pytest.raises(DetectorError, match=r"short\.weights: expected Darknet weights, found 4 bytes"):
        weights.load_weights(network, short)
    short.write_bytes(struct.pack("<3iq", 0, 2, 0, 0) + np.full(NUMBERS, np.nan, "<f4").tobytes())
    with pytest.raises(DetectorError, match=r"short\.weights: expected finite numbers"):
        weights.load_weights(network, short)


def test_darknet_files_by_name(mini: YoloV3, mini_text: str, tmp_path: Path) -> None:
    path = tmp_path / "own.cfg"
    darknet.save(mini, path)
    assert (tmp_path / "own.names").read_text() == "Car\nTruck\nCyclist\n"
    path.write_text(mini_text)
    image = torch.rand(1, 3, 30, 40, generator=torch.Generator().manual_seed(1))
    mini.requires_grad_(False)
    for name in (f"darknet:{path}", f"darknet:{path},{tmp_path / 'own.weights'}"):
        detector = load_detector(name)
        assert detector.classes == ("Car", "Truck", "Cyclist")
        assert not any(p.requires_grad for p in detector.parameters())
        torch.testing.assert_close(detector(image).boxes_xyxy, mini(image).boxes_xyxy, rtol=0, atol=1e-6)
    with pytest.raises(DetectorError, match=r"other\.weights: expected Darknet weights, found No such file"):
        load_detector(f"darknet:{path},{tmp_path / 'other.weights'}")
    with pytest.raises(DetectorError, match=r"gone\.cfg: expected a Darknet \.cfg, found No such file"):
        load_detector(f"darknet:{tmp_path / 'gone.cfg'}")
    (tmp_path / "own.names").write_text("car\nbus\n")
    with pytest.raises(DetectorError, match=r"own\.names: expected 3 classes as in the \.cfg, found 2"):
        load_detector(f"darknet:{path}")
    (tmp_path / "own.names").unlink()
    with pytest.raises(DetectorError, match=r"own\.names: expected the 3 classes of the \.cfg, a line each"):
        load_detector(f"darknet:{path}")


def test_darknet_files_with_commas_in_their_names(mini: YoloV3, tmp_path: Path) -> None:
    folder = tmp_path / "a,b"
    folder.mkdir()
    darknet.save(mini, folder / "own,1.cfg")
    (folder / "own,1.weights").rename(folder / "best,2.weights")
    assert load_detector(f"darknet:{folder}/own,1.cfg,{folder}/best,2.weights").classes == mini.classes
    with pytest.raises(DetectorError, match=r"own,1\.weights: expected Darknet weights, found No such file"):
        load_detector(f"darknet:{folder}/own,1.cfg")
    with pytest.raises(DetectorError, match=r"none: expected a Darknet \.cfg, found No such file"):
        load_detector(f"darknet:{tmp_path}/none,1.cfg")


def test_coco_names_where_there_are_eighty(tmp_path: Path) -> None:
    path = tmp_path / "coco.cfg"
    path.write_text(TWO.replace("classes=1", "classes=80").replace("filters=6", "filters=85"))
    weights.save_weights(DarknetNetwork(parse(path.read_text())), tmp_path / "coco.weights")
    detector = load_detector(f"darknet:{path}")
    assert detector.classes[:3] == ("person", "bicycle", "Car")
    (tmp_path / "coco.names").write_text("\n".join(["car", *map(str, range(79))]))
    assert load_detector(f"darknet:{path}").classes[:2] == ("Car", "0")


def test_no_memory_before_the_file_is_known_to_fill_it(tmp_path: Path) -> None:
    path = tmp_path / "a.cfg"
    wide = "[convolutional]\nfilters=256\nsize=63\npad=1\nactivation=linear\n"
    path.write_text(TWO.replace("[net]\n", f"[net]\n{wide * 3}"))  # 2 GB
    path.with_suffix(".names").write_text("Car\n")
    path.with_suffix(".weights").write_bytes(bytes(200))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(
        DetectorError, match=r"a\.weights: expected 523,\d+,\d+ numbers after the header, found 45"
    ):
        darknet.load(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000
    path.with_suffix(".weights").unlink()
    path.with_suffix(".weights").symlink_to("/dev/zero")
    with pytest.raises(DetectorError, match=r"a\.weights: expected Darknet weights, found no regular file"):
        darknet.load(path)
