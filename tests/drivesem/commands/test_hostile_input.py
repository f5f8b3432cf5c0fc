"""Folders that were made to break a command: exit code 2, and a last line that names file and field."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from detectors import registry
from detectors.registry import SHIPPED, read_weights, write_weights
from detectors.types import CLASSES, Detections
from drivesem import program
from drivesem.cli import main
from drivesem.run import attack as run_attack
from scene_ir import files
from tests.drivesem.invoke import invoke, refusal

CAR = "Car {truncated} 0 1.50 120 40 200 80 {height} 1.60 4.00 0.00 1.65 15.00 0.00\n"


@pytest.fixture
def folder(tmp_path: Path) -> Callable[..., Path]:
    """A KITTI folder of one frame."""

    def make(cars: int = 1, focal: str = "300", truncated: str = "0", height: str = "1.5") -> Path:
        part = tmp_path / "kitti" / "training"
        files.write_png(part / "image_2" / "000000.png", np.full((96, 320, 3), 90, np.uint8))
        text = CAR.format(truncated=truncated, height=height) * cars
        files.write_text(part / "label_2" / "000000.txt", text)
        files.write_text(part / "calib" / "000000.txt", f"P2: {focal} 0 160 0 0 {focal} 48 0 0 0 1 0\n")
        return tmp_path / "kitti"

    return make


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"focal": "1e30"}, "000000.txt: P2: expected positive focal lengths, 0.01 to 100000 px"),
        ({"focal": "1e-30"}, "000000.txt: P2: expected positive focal lengths, 0.01 to 100000 px"),
        ({"cars": 3000}, "frame 000000: labels: expected at most 500 labelled objects, found 3000"),
    ],
)
def test_frames(folder: Callable[..., Path], given: Any, message: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    line = refusal("derender", "--dataset", "kitti", "--root", folder(**given), "--workers", "1", "--out", out)
    assert message in line


def test_photographs(folder: Callable[..., Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    files.write_png(tmp_path / "one.png", np.zeros((1, 1, 3), np.uint8))
    assert "expected at least 16x16 px, found 1x1 px" in refusal("derender", tmp_path / "one.png", "--out", out)
    picture = folder() / "training" / "image_2" / "000000.png"
    picture.unlink()
    picture.symlink_to("/dev/zero")
    words = (
        "derender",
        "--dataset",
        "kitti",
        "--root",
        tmp_path / "kitti",
        "--workers",
        "1",
        "--out",
        tmp_path / "b",
    )
    assert "000000.png: expected a regular file" in refusal(*words)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"height": "-1.5"}, "000000.txt:1: height: expected metres, or -1, found -1.5"),
        ({"truncated": "-5"}, "frame 000000: truncation: expected [0, 1], or -1 where unknown, found -5"),
        (
            {"truncated": "1.5"},
            "frame 000000: truncation: expected [0, 1], or -1 where unknown, found 1.5",
        ),
    ],
)
def test_labels_that_are_converted(folder: Callable[..., Path], given: Any, message: str, tmp_path: Path) -> None:
    assert message in refusal("convert", folder(**given), "--to", "coco", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("table", "key", "value", "message"),
    [
        ("images", "id", [1], "images[0].id: expected a whole number"),
        ("categories", "id", [1], "categories[0].id: expected a whole number"),
        ("categories", "name", ["Car"], "categories[0].name: expected text"),
        ("annotations", "image_id", [1], "annotations[0].image_id: expected a whole number"),
        ("annotations", "truncation", -5, "truncation: expected [0, 1]"),
        ("images", "file_name", ["a"], "images[0].file_name: expected text"),
        ("images", "file_name", "a\0.png", "a NUL character"),
        ("images", "file_name", "\ud800.png", "half of one"),
        ("images", "id", 10**30, "an integer of 31 digits"),
    ],
)
def test_coco(tmp_path: Path, table: str, key: str, value: Any, message: str) -> None:
    content = {
        "images": [{"id": 1, "file_name": "a.png", "height": 96, "width": 320}],
        "categories": [{"id": 1, "name": "Car"}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [10, 10, 50, 40], "area": 2000}],
    }
    content[table][0][key] = value
    path = tmp_path / "labels.json"
    path.write_text(json.dumps(content))
    assert message in refusal("convert", path, "--to", "kitti", "--out", tmp_path / "out")


@pytest.mark.parametrize("name", ["../../secret.png", "/dev/zero"])
def test_coco_names_stay_in_their_folder(tmp_path: Path, name: str) -> None:
    content = {
        "images": [{"id": 1, "file_name": name, "height": 96, "width": 320}],
        "categories": [],
        "annotations": [],
    }
    path = tmp_path / "annotations" / "instances_all.json"
    path.parent.mkdir()
    path.write_text(json.dumps(content))
    words = ("derender", "--dataset", "coco", "--root", tmp_path, "--out", tmp_path / "out")
    assert "images[0].file_name: expected a file in" in refusal(*words)


def test_many_equal_detections(folder: Callable[..., Path], tmp_path: Path) -> None:
    line = CAR.format(truncated="0", height="1.5").strip() + " 0.5\n"
    files.write_text(tmp_path / "found" / "000000.txt", line * 80_000)
    words = ("eval", "--gt", folder(), "--pred", tmp_path / "found", "--protocol", "kitti")
    assert "at most 2,000 detections of a class in a frame" in refusal(*words)


def edit(path: Path, *keys: Any, value: Any) -> None:
    data = json.loads(path.read_text())
    place = data
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("file", "keys", "value", "message"),
    [
        ("result", ("targets_benign", 0, "xyxy"), [1, 2, 3], "targets_benign[0]: xyxy: expected 4 values"),
        (
            "result",
            ("detections_benign", 0, "score"),
            "high",
            "detections_benign[0]: score: expected a finite number",
        ),
        ("result", ("targets_benign", 0, "label"), "Dragon", "label: expected one of Car"),
        ("result", ("objects",), 1.5, "objects: expected an integer"),
        ("result", ("unknown",), 1, "unknown: expected a field of FrameResult"),
        ("metrics", ("t_star",), "half", "metrics.json: t_star: expected a finite number"),
        ("manifest", ("frames",), ["a"], "manifest.json: frames: expected hashes by frame and file"),
        ("manifest", ("frames",), {"/dev/zero": {}}, "frames: expected names of what is in there"),
        ("manifest", ("frames",), {"../..": {}}, "frames: expected names of what is in there"),
    ],
)
def test_runs(
    write_run: Callable[..., Path],
    tmp_path: Path,
    file: str,
    keys: tuple[Any, ...],
    value: Any,
    message: str,
) -> None:
    run = write_run(tmp_path / "run")
    places = {"result": run / "frames" / "a" / "result.json"}
    edit(places.get(file, run / f"{file}.json"), *keys, value=value)
    assert message in refusal("transfer", run, "--detectors", "squeezedet")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("detector: squeezedet", "detector: 5", "config.yaml: detector: expected text, found 5"),
        ("t_star: null", "t_star: .nan", "config.yaml: t_star: expected a finite number"),
        ("draws: 16", "draws: 0", "config.yaml: --draws: expected at least 16"),
        ("steps: 10", "steps: [[[[", "config.yaml: expected YAML"),
    ],
)
def test_settings_of_runs(
    write_run: Callable[..., Path], tmp_path: Path, old: str, new: str, message: str
) -> None:
    run = write_run(tmp_path / "run")
    text = (run / "config.yaml").read_text()
    assert old in text
    (run / "config.yaml").write_text(text.replace(old, new))
    assert message in refusal("verify", "--run", run)
    if "detector" in old:
        assert message in refusal("holes", run)


RAISING = """
import torch

class Init:
    def __init__(self):
        raise RuntimeError("no weights here")

class Net(torch.nn.Module):
    spec = {"format": "detr", "classes": ["Car"]}

    def forward(self, images):
        return images.nope

def broken(:
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Init", "RuntimeError: no weights here (mine.py:6, in __init__)"),
        ("Net", "(mine.py:12, in forward)"),
    ],
)
def test_a_detector_that_raises(tmp_path: Path, name: str, message: str) -> None:
    path = tmp_path / "mine.py"
    path.write_text(RAISING.replace("def broken(:", ""))
    assert message in refusal("check", "--detector", f"module:{path}:{name}")
    path.write_text(RAISING)
    line = refusal("check", "--detector", f"module:{path}:{name}")
    assert line.endswith("SyntaxError: invalid syntax (mine.py:14)")


LATE = """
from detectors.squeezedet import SqueezeDet

class Late(SqueezeDet):
    def decode(self, raw):
        raise KeyError("wheels")
"""


def test_a_detector_that_raises_when_it_is_attacked(small_kitti: Path, tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(LATE)
    words = ("attack", "--dataset", "kitti", "--root", small_kitti, "--no-fit", "--params", "translate")
    line = refusal(*words, "--workers", "1", "--out", tmp_path / "out", "--detector", f"module:{path}:Late")
    expected = "--detector: expected methods that raise nothing, found KeyError: 'wheels' (mine.py:6, in decode)"
    assert line == expected


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"t_star": "nan"}, "t_star: expected a score in (0, 1], found nan"),
        ({"t_star": "-1"}, "t_star: expected a score in (0, 1], found -1"),
        ({"anchors": json.dumps([[10, 10]] * 100_000)}, "anchors: expected at most 1000, found 100000"),
        ({"anchors": "[" * 100_000}, "recursion"),
    ],
)
def test_weights(tmp_path: Path, changed: dict[str, str], message: str) -> None:
    metadata, tensors = read_weights(SHIPPED["squeezedet"])
    path = tmp_path / "weights.safetensors"
    write_weights(path, metadata | changed, tensors)
    assert message in refusal("check", "--detector", path)


def test_darknet_files(tmp_path: Path) -> None:
    path = tmp_path / "net.cfg"
    path.write_text("[net]\nchannels=3\n" + "[shortcut]\nfrom=-1\n" * 20_000)
    words = ("check", "--detector", f"darknet:{path}")
    assert "net.cfg: expected at most 1000 sections, found 20001" in refusal(*words)
    path.unlink()
    path.symlink_to("/dev/zero")
    assert "net.cfg: expected a Darknet .cfg, found no regular file" in refusal(*words)
    path.unlink()
    head = "[convolutional]\nfilters=18\nsize=1\nstride=1\nactivation=linear\n[yolo]\nclasses=1\nmask=0,1,2\n"
    path.write_text(f"[net]\nchannels=3\n{head}anchors=1,1,2,2,3,3\nnum=3\n")
    (tmp_path / "net.names").write_bytes(b"\xff\xfe\n")
    assert "net.names: expected class names, found bytes that are no text" in refusal(*words)


class Blind:
    """A detector without gradient that finds nothing."""

    name, classes, t_star = "blind", CLASSES, 0.5

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images

    def decode(self, raw: torch.Tensor) -> list[Detections]:
        nothing = Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))
        return [nothing] * len(raw)


def test_a_detector_without_detections_is_not_attacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_attack, "load_predictor", lambda *_: Blind())
    words = ("attack", "--method", "random", "--queries", "1", "--workers", "1", "--params", "weather")
    line = refusal(*words, "--limit", "2", "--out", tmp_path / "run")
    assert line.startswith("--detector: expected one that finds cars, found no car")
    assert "no car with a score of 0.5 or more in 2 pictures (no detection at all)" in line
    assert not (tmp_path / "run" / "metrics.json").exists()
    line = refusal(*words, "--limit", "2", "--people", "--out", tmp_path / "people")
    assert "one that finds cars or trucks or pedestrians or cyclists, found no car or" in line
    # One photograph in which nothing is found says nothing of the detector.
    assert main([*words, "--limit", "1", "--out", str(tmp_path / "one")]) == 0


NAMES = ("[/red]", "[bold]", "\x1b]0;title\x07", "\x1b[31m", "<b>")


@pytest.mark.parametrize("name", NAMES)
def test_names_that_a_terminal_or_a_table_would_obey(name: str, tmp_path: Path) -> None:
    content = {
        "images": [{"id": 1, "file_name": "a.png", "height": 96, "width": 320}],
        "categories": [{"id": 1, "name": name}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [10, 10, 50, 40], "area": 2000}],
    }
    (tmp_path / "true.json").write_text(json.dumps(content))
    found = [{"image_id": 1, "category_id": 1, "bbox": [10, 10, 50, 40], "score": 0.9}]
    (tmp_path / "found.json").write_text(json.dumps(found))
    words = ["--gt", str(tmp_path / "true.json"), "--pred", str(tmp_path / "found.json"), "--classes", name]
    output = invoke("eval", *words)
    printed = output.out + output.err
    assert printed.replace("\n", "").isprintable()
    assert name.encode("unicode_escape").decode() in printed
    assert refusal("convert", tmp_path / "true.json", "--to", "kitti", "--out", tmp_path / "out").isprintable()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "Car 0 1e30 1.5 120 40 200 80 1.5 1.6 4 0 1.6 15 0 0.5",
            "occluded: expected a flag, such as 0 to 3, found 1e+30",
        ),
        (f"Car 0 {'9' * 5000} 1.5 1 1 2 2 1 1 1 1 1 1 1 0.5", "occluded: expected a finite number"),
    ],
)
def test_numbers_that_no_column_holds(
    folder: Callable[..., Path], tmp_path: Path, line: str, message: str
) -> None:
    files.write_text(tmp_path / "found" / "000000.txt", line + "\n")
    output = refusal("eval", "--gt", folder(), "--pred", tmp_path / "found")
    assert message in output
    assert len(output) < 2000


def test_a_frame_of_a_million_lines(folder: Callable[..., Path], tmp_path: Path) -> None:
    words = ("derender", "--dataset", "kitti", "--workers", "1", "--out", tmp_path / "out", "--root")
    assert "000000.txt: expected at most 10,000 lines, found 1,000,000" in refusal(*words, folder(cars=10**6))


def test_coco_s_cameras_of_other_projects(tmp_path: Path) -> None:
    content: dict[str, Any] = {
        "images": [
            {"id": 1, "file_name": "a.png", "height": 96, "width": 320, "camera": {"projection": [[1], 2]}}
        ],
        "categories": [{"id": 1, "name": "Car"}],
        "annotations": [],
    }
    path = tmp_path / "labels.json"
    path.write_text(json.dumps(content))
    message = "camera: expected projection (12 numbers), or fx, fy, cx, cy"
    assert message in refusal("convert", path, "--to", "kitti", "--out", tmp_path / "out")


def test_coco_keys_with_values_beyond_json(tmp_path: Path) -> None:
    row = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [1, 1, 5, 4], "area": 20, "mood": float("nan")}
    image = {"id": 1, "file_name": "a.png", "height": 96, "width": 320}
    content = {"images": [image], "categories": [{"id": 1, "name": "Car"}], "annotations": [row]}
    path = tmp_path / "labels.json"
    path.write_text(json.dumps(content))
    message = "annotations[0]: expected finite numbers, found NaN or infinity"
    assert message in refusal("convert", path, "--to", "coco", "--out", tmp_path / "out")


@pytest.mark.parametrize("name", ["result.json", "scene/depth.bin", "counterexample.png"])
def test_links_of_a_run_stay_in_it(write_run: Callable[..., Path], tmp_path: Path, name: str) -> None:
    run = write_run(tmp_path / "run")
    path = run / "frames" / "b" / name
    path.parent.mkdir(exist_ok=True)
    path.unlink(missing_ok=True)
    (tmp_path / "secret").write_text("secret")
    path.symlink_to(tmp_path / "secret")
    line = refusal("holes", run)
    assert f"{path}: expected a file in {run / 'frames' / 'b'}, found a link to" in line
    (run / "metrics.json").unlink()
    (run / "metrics.json").symlink_to("/etc/passwd")
    assert "metrics.json: expected a file in" in refusal("holes", run)
    (run / "config.yaml").unlink()
    (run / "config.yaml").symlink_to("/dev/zero")
    assert "config.yaml: expected a file in" in refusal("holes", run)


def test_a_command_names_the_code_that_it_runs(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text("class A:\n    pass\n")
    first, _ = invoke("check", "--detector", f"planted:height_px=30:38@module:{path}:A", code=2).err.splitlines()
    assert first == f"drivesem: --detector: runs the code in {path}:A"
    for kind in registry.KINDS:
        named = program.RUNS_CODE.findall(f"squeezedet,{kind}:a.b")
        assert named == (["a.b"] if kind in registry.RUNS_CODE else [])
