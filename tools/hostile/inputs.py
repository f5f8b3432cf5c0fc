"""Hostile inputs: files made to break a reader, derived from generated data."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from detectors.registry import SHIPPED, read_weights, write_weights
from detectors.yolov3 import darknet
from scene_ir import files
from tools.fuzz.formats import dataset, net
from tools.small_frames import small_frames

MARK = "mark"
"""File that foreign code creates when it runs."""
FRAME = "frames/n00000"
"""Folder of the frame of the run."""
GIGABYTE = 1 << 30

Make = Callable[["ValidInputs", Path], object]
"""Writes the input of a command into a folder."""


class ValidInputs:
    """Valid data from which inputs are made, created on first use in a temporary folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @cached_property
    def kitti(self) -> Path:
        """Two generated KITTI frames of 192x112 px with one car each."""
        with files.atomic_folder(self._folder / "kitti") as part:
            small_frames(part, 2, streets=3)
        return self._folder / "kitti"

    @cached_property
    def run(self) -> Path:
        """A run on the first frame, in which the car is missed."""
        words = f"attack --dataset kitti --root {self.kitti} --no-fit --params weather,translate,rotate"
        words += " --method random --queries 8 --limit 1 --workers 1 --out"
        out = self._folder / "run"
        command = [sys.executable, "-m", "drivesem.cli", *words.split(), str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"the valid run: exit code {done.returncode}: {done.stderr[-500:]}")
        return out


def nothing(ground: ValidInputs, place: Path) -> None:
    """No files."""


def text(name: str, content: str) -> Make:
    """A file with this text."""
    return lambda ground, place: files.write_text(place / name, content)


def both(*makers: Make) -> Make:
    """Call several makers in order."""

    def make(ground: ValidInputs, place: Path) -> None:
        for maker in makers:
            maker(ground, place)

    return make


# ---- runs and scenes ----


def run(ground: ValidInputs, place: Path) -> None:
    """The run in folder `run`."""
    shutil.copytree(ground.run, place / "run")


def scene(ground: ValidInputs, place: Path) -> None:
    """The scene of its frame in folder `scene`."""
    shutil.copytree(ground.run / FRAME / "scene", place / "scene")


def edited(path: str, *keys: Any, value: Any) -> Make:
    """Change the value of a JSON file at the path of keys."""

    def make(ground: ValidInputs, place: Path) -> None:
        data = json.loads((place / path).read_text())
        inner = data
        for key in keys[:-1]:
            inner = inner[key]
        if inner[keys[-1]] == value:
            raise RuntimeError(f"{path}: {keys}: already {value!r}")
        inner[keys[-1]] = value
        (place / path).write_text(json.dumps(data))

    return make


def setting(name: str, value: str) -> Make:
    """Change a setting of the run's config.yaml, as text."""

    def make(ground: ValidInputs, place: Path) -> None:
        path = place / "run" / "config.yaml"
        lines = path.read_text().splitlines()
        (at,) = (number for number, line in enumerate(lines) if line.startswith(f"{name}: "))
        lines[at] = f"{name}: {value}"
        path.write_text("\n".join(lines) + "\n")

    return make


def linked(path: str, target: str) -> Make:
    """Replace a file by a link."""

    def make(ground: ValidInputs, place: Path) -> None:
        (place / path).unlink(missing_ok=True)
        (place / path).symlink_to(target)

    return make


def brightened(ground: ValidInputs, place: Path) -> None:
    """Change one corner of the counterexample."""
    path = place / "run" / FRAME / "counterexample.png"
    image = files.read_image(path)
    image[:20, :20] ^= 64
    files.write_png(path, image)


def overlay(ground: ValidInputs, place: Path) -> None:
    """Replace the picture with boxes by the photograph."""
    frame = place / "run" / FRAME
    shutil.copy(frame / "benign.png", frame / "overlay.png")


def labels(ground: ValidInputs, place: Path) -> None:
    """Shift the moved label by 3 px."""
    path = place / "run" / FRAME / "labels_moved.txt"
    words = path.read_text().split()
    words[4] = f"{float(words[4]) - 3:.2f}"
    path.write_text(" ".join(words) + "\n")


# ---- code ----

EVIL = f"""
from pathlib import Path

Path({MARK!r}).touch()

class D:
    pass
"""


class _Touching:
    """Creates MARK when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (MARK, "w")


def pickled_arrays(ground: ValidInputs, place: Path) -> None:
    """Put a pickled object into the arrays of a scene."""
    with (place / "scene" / "arrays.npz").open("wb") as file:
        np.savez(file, depth=np.array([_Touching()], dtype=object))


def pickled_weights(name: str) -> Make:
    """A state_dict with a pickled object."""

    def make(ground: ValidInputs, place: Path) -> None:
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        torch.save({"layer.weight": torch.ones(2), "more": _Touching()}, place / name)

    return make


# ---- pictures and arrays ----


def png(name: str, width: int, height: int) -> Make:
    """Write a PNG with a header that declares another size than its data have.

    Args:
        name: File to write.
        width: Declared width, px.
        height: Declared height, px.
    """

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    data = b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    return lambda ground, place: files.write_bytes(place / name, data)


def one_pixel(name: str) -> Make:
    """A photograph of 1x1 px."""
    return lambda ground, place: files.write_png(place / name, np.zeros((1, 1, 3), np.uint8))


def oversized_arrays(ground: ValidInputs, place: Path) -> None:
    """An array that declares 10^12 numbers and has none."""
    head = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117) + "\n"
    member = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode()
    with zipfile.ZipFile(place / "scene" / "arrays.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", member)


def bomb(declared: int | None = None) -> Make:
    """An archive of 4 MB that expands to 4 GB of zeros; its directory may declare another size, bytes."""

    def make(ground: ValidInputs, place: Path) -> None:
        path = place / "scene" / "arrays.npz"
        zeros = bytes(1 << 24)
        with (
            zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
            archive.open("depth.npy", "w", force_zip64=True) as member,
        ):
            for _ in range(4 * GIGABYTE // len(zeros) - 1):
                member.write(zeros)
        if declared is not None:
            data = bytearray(path.read_bytes())
            at = data.rindex(b"PK\x01\x02")
            data[at + 24 : at + 28] = struct.pack("<I", declared)
            path.write_bytes(data)

    return make


def ply(name: str, faces: int) -> Make:
    """A mesh that declares a number of faces and has none."""
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    return lambda ground, place: files.write_bytes(place / name, head.encode() + bytes(36))


# ---- data sets ----


def kitti(cars: int = 1, lines: Mapping[int, str] | None = None, focal: str | None = None) -> Make:
    """The generated frames in folder `kitti`.

    Args:
        cars: Repetitions of the first frame's label.
        lines: Words of this label to replace, by position.
        focal: Focal length of its camera, px.
    """

    def make(ground: ValidInputs, place: Path) -> None:
        shutil.copytree(ground.kitti, place / "kitti")
        part = place / "kitti" / "training"
        label, calib = part / "label_2" / "n00000.txt", part / "calib" / "n00000.txt"
        words = label.read_text().split()
        for at, word in (lines or {}).items():
            words[at] = word
        label.write_text((" ".join(words) + "\n") * cars)
        if focal is not None:
            calib.write_text(f"P2: {focal} 0 96 0 0 {focal} 56 0 0 0 1 0\n")

    return make


def equal_detections(ground: ValidInputs, place: Path) -> None:
    """80,000 equal detections in each frame, in folder `found`."""
    for path in (ground.kitti / "training" / "label_2").iterdir():
        files.write_text(place / "found" / path.name, f"{path.read_text().strip()} 0.5\n" * 80_000)


def coco(table: str, key: str, value: Any) -> Make:
    """A COCO data set in folder `coco` with one changed value."""

    def make(ground: ValidInputs, place: Path) -> None:
        dataset("coco", place / "coco")
        edited(COCO, table, 0, key, value=value)(ground, place)

    return make


COCO = "coco/annotations/instances_train.json"


def layout(name: str) -> Make:
    """A data set in a layout, in a folder of that name."""
    return lambda ground, place: dataset(name, place / name)


# ---- networks ----


def weights(**changed: str) -> Make:
    """The weights of SqueezeDet with other metadata, in `weights.safetensors`."""

    def make(ground: ValidInputs, place: Path) -> None:
        metadata, tensors = read_weights(SHIPPED["squeezedet"])
        write_weights(place / "weights.safetensors", metadata | changed, tensors)

    return make


def oversized_weights(ground: ValidInputs, place: Path) -> None:
    """A header of 1 KB that declares 2 GB."""
    tensors = {"weight": {"dtype": "F32", "shape": [1 << 29], "data_offsets": [0, 1 << 31]}}
    header = json.dumps(tensors).encode().ljust(1024)
    files.write_bytes(place / "weights.safetensors", struct.pack("<Q", len(header)) + header)


def layers(ground: ValidInputs, place: Path) -> None:
    """A Darknet network of 20,000 layers, in `net.cfg`."""
    files.write_text(place / "net.cfg", "[net]\nchannels=3\n" + "[shortcut]\nfrom=-1\n" * 20_000)


def anchors(ground: ValidInputs, place: Path) -> None:
    """A Darknet network of 100,000 anchors, in `net.cfg`."""
    _darknet(place)
    path = place / "net.cfg"
    lines = path.read_text().splitlines()
    path.write_text("\n".join("anchors=" + "10,13," * 100_000 if "anchors" in line else line for line in lines))


def names(ground: ValidInputs, place: Path) -> None:
    """A Darknet network with class names that are not UTF-8."""
    _darknet(place)
    (place / "net.names").write_bytes(b"\xff\xfe\n")


def _darknet(place: Path) -> None:
    darknet.save(net(), place / "net.cfg")


# ---- malformed texts ----

DEEP = "[" * 200_000
DIGITS = "9" * 5000


# ---- user detectors ----


def detector(method: str = "", body: str = "pass", module_code: str = "") -> Make:
    """SqueezeDet with another method, as `mine.py:Mine`.

    Args:
        method: Head of the method.
        body: Its first line, line 7 of the file.
        module_code: A line at the top of the module.
    """
    members = f"    {method}\n        {body}\n" if method else "    pass\n"
    return text(
        "mine.py",
        f"from detectors.squeezedet import SqueezeDet\n{module_code}\n\n\nclass Mine(SqueezeDet):\n{members}",
    )


BLIND = """
import torch

from detectors.squeezedet import SqueezeDet
from detectors.types import Detections


class Mine(SqueezeDet):
    def decode(self, raw):
        none = Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))
        return [none] * len(raw)
"""
"""A detector that detects nothing, for `mine.py`."""

MODULE = """
import torch


class Mine(torch.nn.Module):
    pass
"""

SCRIPT = """
from drivesem.cli import main

code = main("derender --dataset kitti --root kitti --no-fit --workers 2 --out scenes".split())
raise SystemExit(code)
"""
"""A script with two workers and no main guard."""
