"""A user's segmentation network: ONNX files written here byte by byte, since the package `onnx` is not needed
otherwise."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from detectors.types import Detections
from drivesem.cli import main
from drivesem.scenes import label_free
from drivesem.scenes.segmenter import CITYSCAPES, OnnxSegmenter
from scene_ir import files
from scene_ir.derender import segmentation as segment
from scene_ir.errors import FormatError
from scene_ir.types import Camera

NAMES = ("sky", "vegetation", "road", "building")
FLOAT, INT64 = 1, 7
Value = int | str | bytes


def varint(value: int) -> bytes:
    """A number as protocol buffers write it."""
    out = b""
    while value > 0x7F:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def message(*pairs: tuple[int, Value]) -> bytes:
    """Fields (number, value) as protocol buffers write them."""
    out = b""
    for number, value in pairs:
        if isinstance(value, int):
            out += varint(number << 3) + varint(value)
        else:
            data = value.encode() if isinstance(value, str) else value
            out += varint(number << 3 | 2) + varint(len(data)) + data
    return out


def value_info(name: str, kind: int, sides: tuple[int | str, ...]) -> bytes:
    shape = b"".join(message((1, message((1 if isinstance(side, int) else 2, side)))) for side in sides)
    return message((1, name), (2, message((1, message((1, kind), (2, shape))))))


def floats(name: str, values: np.ndarray) -> bytes:
    dims = tuple((1, side) for side in values.shape)
    return message(*dims, (2, FLOAT), (8, name), (9, values.astype("<f4").tobytes()))


def network(
    path: Path,
    weights: np.ndarray,
    last: str = "",
    sides: tuple[int | str, int | str] = ("h", "w"),
    kind: int = FLOAT,
    metadata: dict[str, str] | None = None,
) -> Path:
    """Write a network whose logits are weights (C, 3) times RGB; last: "", "Softmax" or "ArgMax"."""
    count = len(weights)
    nodes = [message((1, "image"), (1, "w"), (2, "logits"), (4, "Conv"))]
    out, out_kind = ("logits", FLOAT) if not last else ("out", INT64 if last == "ArgMax" else FLOAT)
    if last:
        axis = message((1, "axis"), (3, 1), (20, 2))
        keep = message((1, "keepdims"), (3, 0), (20, 2))
        attributes = [(5, axis), (5, keep)] if last == "ArgMax" else [(5, axis)]
        nodes.append(message((1, "logits"), (2, "out"), (4, last), *attributes))
    shape = (1, "h", "w") if last == "ArgMax" else (1, count, "h", "w")
    graph = message(
        *((1, node) for node in nodes),
        (2, "tiny"),
        (5, floats("w", weights.reshape(count, -1, 1, 1))),
        (11, value_info("image", kind, (1, weights.shape[1], *sides))),
        (12, value_info(out, out_kind, shape)),
    )
    metadata_entries = [(14, message((1, k), (2, v))) for k, v in (metadata or {}).items()]
    files.write_bytes(path, message((1, 8), (7, graph), (8, message((2, 13))), *metadata_entries))
    return path


COLOURS = np.array([[-9, -9, 18], [-9, 18, -9], [6, 6, 6], [18, -9, -9]], np.float32)
"""Blue is sky, green is foliage, red is a building, grey is road."""
METADATA = {"classes": json.dumps(NAMES)}


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    """Sky above, foliage, road, and a red wall on the right of it."""
    image = np.zeros((128, 192, 3), np.float32)
    image[:48] = (0, 0, 1)
    image[48:64] = (0, 1, 0)
    image[64:] = 0.6
    image[64:, 160:] = (1, 0, 0)
    return image


@pytest.mark.parametrize("last", ["", "Softmax", "ArgMax"])
def test_logits_probabilities_and_numbers_are_equivalent(tmp_path, picture, last):
    own = OnnxSegmenter(network(tmp_path / "own.onnx", COLOURS, last, metadata=METADATA))
    shares, names = own(picture)
    assert names == NAMES
    assert shares.shape == (4, 128, 192)
    assert shares.sum(0) == pytest.approx(1, abs=1e-5)
    assert shares[0, :48].min() > 0.99
    assert shares[1, 48:64].min() > 0.99
    assert shares[2, 64:, :160].min() > 0.99
    assert shares[3, 64:, 160:].min() > 0.99


def test_it_fills_the_maps(tmp_path, picture):
    own = OnnxSegmenter(network(tmp_path / "own.onnx", COLOURS, metadata=METADATA))
    camera = Camera(torch.tensor([[150.0, 0, 96], [0, 150.0, 62], [0, 0, 1]]), 128, 192)
    found = segment.segment_photograph(picture, torch.tensor([0.0, -1.0, 0.0, 1.65]), camera, own)
    assert found.sky[:40].min() > 0.99
    assert found.foliage[54:58].min() > 0.99
    assert found.road[80:, :150].min() > 0.99
    assert found.road[80:, 170:].max() < 0.01


def test_a_fixed_size_and_its_own_normalisation(tmp_path, picture):
    metadata_entries = METADATA | {"mean": "[0.5, 0.5, 0.5]", "std": "[0.5, 0.25, 0.5]"}
    own = OnnxSegmenter(network(tmp_path / "own.onnx", COLOURS, "", (32, 64), metadata=metadata_entries))
    shares, _ = own(picture)
    assert shares.shape == (4, 32, 64)
    logits = COLOURS @ ((np.array([0, 0, 1.0]) - 0.5) / [0.5, 0.25, 0.5])
    grown = np.exp(logits - logits.max())
    assert shares[:, 4, 10] == pytest.approx(grown / grown.sum(), abs=1e-5)


def test_without_names_they_are_cityscapes(tmp_path, picture):
    weights = np.zeros((19, 3), np.float32)
    weights[CITYSCAPES.index("sky"), 2] = 20
    own = OnnxSegmenter(network(tmp_path / "own.onnx", weights))
    shares, names = own(picture)
    assert names == CITYSCAPES
    assert shares[names.index("sky"), :48].min() > 0.99


def test_names_by_number(tmp_path):
    metadata_entries = {"names": str(dict(reversed(list(enumerate(NAMES)))))}
    assert OnnxSegmenter(network(tmp_path / "own.onnx", COLOURS, metadata=metadata_entries)).names == NAMES


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"metadata": {"classes": "sky; road"}}, "metadata classes: expected a list of names, found sky; road"),
        ({"metadata": METADATA | {"mean": "[1, 2]"}}, r"metadata mean: expected three numbers, found \[1, 2\]"),
        ({"metadata": METADATA | {"std": "[1, 0, 1]"}}, "metadata std: expected positive numbers"),
        ({"weights": np.zeros((4, 5), np.float32)}, r"inputs: expected one of shape \(1, 3, H, W\), found image"),
    ],
)
def test_a_network_that_cannot_be_used_is_an_error_that_names_it(tmp_path, change, text):
    settings = {"weights": COLOURS, "metadata": METADATA} | change
    path = network(tmp_path / "own.onnx", settings.pop("weights"), **settings)
    with pytest.raises(FormatError, match=rf"own\.onnx: {text}"):
        OnnxSegmenter(path)


def test_another_number_of_classes_than_names_is_an_error(tmp_path, picture):
    own = OnnxSegmenter(network(tmp_path / "own.onnx", COLOURS))
    with pytest.raises(FormatError, match=r"output: expected \(1, 19, h, w\) for 19 classes, or \(1, h, w\)"):
        own(picture)


def test_no_network_and_no_file_are_errors(tmp_path):
    files.write_bytes(tmp_path / "text.onnx", b"no network")
    with pytest.raises(FormatError, match=r"text\.onnx: expected an ONNX network, found "):
        OnnxSegmenter(tmp_path / "text.onnx")
    with pytest.raises(FormatError, match=r"none\.onnx"):
        OnnxSegmenter(tmp_path / "none.onnx")


def test_missing_onnxruntime_is_named(tmp_path, monkeypatch):
    path = network(tmp_path / "own.onnx", COLOURS, metadata=METADATA)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(FormatError, match=r"own\.onnx: expected onnxruntime \(pip"):
        OnnxSegmenter(path)


def test_the_command_takes_it(tmp_path, capsys, monkeypatch, picture):
    nothing = Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))
    monkeypatch.setattr(label_free, "detect", lambda *_: nothing)
    photo, out = tmp_path / "plain.png", tmp_path / "scenes"
    files.write_png(photo, np.rint(picture * 255).astype(np.uint8))
    path = network(tmp_path / "own.onnx", COLOURS, metadata=METADATA)
    assert main(["derender", str(photo), "--segmenter", str(path), "--out", str(out)]) == 0
    arrays = files.read_npz(out / "plain" / "arrays.npz")
    assert arrays["sky"][:40].min() > 0.9
    assert arrays["road"][100:, :150].min() > 0.9
    assert arrays["road"][100:, 170:].max() < 0.1
    assert main(["derender", "--segmenter", str(path)]) == 2
    assert "--segmenter: expected a PHOTO or a --dataset of photographs" in capsys.readouterr().err
