"""The Python API: its results equal the command line's, and bad arguments raise errors in one line."""

from __future__ import annotations

import base64
import doctest
import importlib
import inspect
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
import torch

import drivesem as ds
from detectors.base import Candidates
from detectors.boxes import iou_matrix
from detectors.types import Targets
from drivesem.cli import main
from drivesem.config.commands import AttackConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import FrameCommandConfig, SceneOptions
from drivesem.failures.grades import Certificate, SecondOpinion
from drivesem.run import attack as attack_run
from drivesem.run.attack import AttackWorker
from drivesem.run.results import Failure, load_frame
from drivesem.scenes.scene import to_image_tensor
from scene_ir.errors import FormatError, RangeError, SceneError
from scene_ir.files import read_image
from scene_ir.types import Frame
from tests.drivesem.commands.test_attack_command import Blinking

OPTIONS = {"params": "translate,rotate", "steps": 2}


@pytest.fixture(scope="module", autouse=True)
def command_threads() -> Iterator[None]:
    """As many threads as a command with one process takes: sums are then added up alike."""
    before = torch.get_num_threads()
    torch.set_num_threads(min(os.cpu_count() or 1, before))  # as the command: no more than OMP_NUM_THREADS says
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def scene() -> ds.Scene:
    return ds.demo_scene(0)


@pytest.fixture(scope="module")
def counterexample(scene: ds.Scene) -> ds.Counterexample:
    return ds.attack(scene, "squeezedet", **OPTIONS)


class Tags(HTMLParser):
    """Reads HTML; notes images' sources and whether each tag that opens is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name == "src"]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def tags_of(html: str) -> Tags:
    tags = Tags()
    tags.feed(html)
    assert not tags.open
    return tags


def picture_of(data: bytes) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert picture is not None
    return picture


def test_importing_is_quick_and_every_name_is_there() -> None:
    code = (
        "import sys, time; start = time.perf_counter(); import drivesem as ds\n"
        "heavy = {'torch', 'cv2', 'numpy', 'warp', 'tyro'} & set(sys.modules)\n"
        "print(time.perf_counter() - start, sorted(heavy), dir(ds) == ds.__all__)"
    )
    command = [sys.executable, "-c", code]
    captured = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    seconds, rest = captured.split(maxsplit=1)
    assert rest.strip() == "[] True"
    assert float(seconds) < 0.2
    assert all(callable(getattr(ds, name)) for name in ds.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ds.nothing  # pyright: ignore[reportAttributeAccessIssue]


def test_the_signature_is_the_commands() -> None:
    parameters = dict(inspect.signature(ds.attack).parameters)
    assert list(parameters)[:2] == ["scene", "detector"]
    of_a_data_set = {field.name for field in fields(FrameCommandConfig) + fields(SceneOptions)} - {
        "device",
        "seed",
    }
    others = {"detector", "like", "part", "grade", "whole", "incremental", "keep_mb", "parametrisation"}
    settings = {field.name: field.default for field in fields(AttackConfig)}
    wanted = {name: value for name, value in settings.items() if name not in of_a_data_set | others}
    options = {
        name: parameter.default for name, parameter in parameters.items() if name not in ("scene", "detector")
    }
    assert options == wanted
    assert set(parameters) <= set(re.findall(r"^    (\w+): ", inspect.getdoc(ds.attack) or "", re.MULTILINE))


def test_examples_in_docstrings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("scenes.scene", "run.counterexample", "run.probes", "analyses"):
        module = importlib.import_module(f"drivesem.{name}")
        assert doctest.testmod(module, raise_on_error=True).attempted > 0
        assert "```pycon\n>>> import" in (module.__doc__ or "")  # else the site shows quotations


def test_a_scene_has_a_picture_and_a_description(scene: ds.Scene, tmp_path: Path) -> None:
    picture = scene.render()
    assert (picture.dtype, picture.shape) == (np.uint8, scene.photograph.shape)
    assert scene.tensor().shape == (3, *picture.shape[:2])
    assert np.array_equal(picture, scene.photograph)
    assert np.array_equal(picture_of(scene._repr_png_()), picture)
    rows = scene.rows()
    assert [row["row"] for row in rows] == list(range(len(scene)))
    assert json.loads(json.dumps(rows)) == rows
    scene.save(tmp_path / "scene")
    again = ds.load_scene(tmp_path / "scene")
    assert np.array_equal(again.render(), picture)
    (tmp_path / "else").mkdir()
    (tmp_path / "else" / "file").touch()
    with pytest.raises(UsageError, match="folder: expected a new folder, or one of a scene"):
        scene.save(tmp_path / "else")


def test_a_scene_says_what_is_changed(scene: ds.Scene) -> None:
    assert repr(scene) == "Scene('demo-000', 1241x376 px, 6 objects)"
    assert scene.theta == {}
    assert np.allclose(scene.boxes(), scene.ir.objects.box2d.numpy(), atol=0.51)
    changed = scene.edit("objects[1].translate=0m,0.5m", "objects[0].rotate=10deg", weather="fog")
    assert repr(changed).endswith("6 objects, 4 changes)")
    assert changed.theta == pytest.approx(
        {
            "weather.fog": 0.6,
            "weather.overcast": 0.8,
            "objects[1].translate.across": 0.5 / scene.rows()[1]["length_m"],
            "objects[0].yaw": math.radians(10),
        },
        abs=1e-5,
    )
    assert changed.weather == pytest.approx(
        {"fog": 0.6, "rain": 0, "time": 0, "overcast": 0.8, "night": 0, "snow": 0}
    )
    by_night = scene.edit("objects[1].lamps=off", weather="fog=0.6,night=1")
    assert by_night.theta == pytest.approx({"weather.fog": 0.6, "weather.night": 1.0, "objects[1].lamps": -1.0})
    assert scene.edit(weather="night").render().mean() < 0.5 * scene.render().mean()
    moved = np.abs(changed.boxes() - scene.boxes()).max(axis=1) > 0.01
    assert moved.tolist() == [True, True, False, False, False, False]


def test_detections_margins_and_gradients(scene: ds.Scene) -> None:
    detector = ds.load_detector("squeezedet")
    of_scene, of_picture = ds.detect(detector, scene), ds.detect("squeezedet", scene.photograph)
    assert torch.equal(of_scene.boxes_xyxy, of_picture.boxes_xyxy)
    assert torch.equal(of_scene.scores, of_picture.scores)
    best = {
        row: float(of_scene.scores[iou_matrix(box[None], of_scene.boxes_xyxy)[0] >= 0.7].amax())
        for row, box in enumerate(torch.from_numpy(scene.boxes()))
        if row in (0, 3)
    }
    for row, score in best.items():
        logit = math.log(score / (1 - score)) - math.log(detector.t_star / (1 - detector.t_star))
        assert ds.margin(scene, detector, row) == pytest.approx(logit, abs=1e-3)
    assert ds.margin(scene, detector, 0, t_star=0.999) < 0
    with pytest.raises(UsageError, match="object: expected a row from 0 to 5, found 6"):
        ds.margin(scene, detector, 6)


@pytest.mark.parametrize(
    ("objective", "error"),
    [
        ("objectness", 0.25),  # the IoU that its targets depend on counts as constant
        (lambda candidates, *_: -candidates.log_scores[:, 0].mean(), 0.01),  # of all anchors: none is saturated
    ],
)
def test_gradients_are_central_differences(scene: ds.Scene, objective: Any, error: float) -> None:
    state, step = scene.edit(weather={"fog": 0.6}), 2e-4
    found = ds.gradient(state, "squeezedet", objective, params="weather,translate")
    assert found.pixels.shape == (3, 376, 1241)
    low, high = (
        ds.gradient(scene.edit(weather={"fog": fog}), "squeezedet", objective, params="weather").loss
        for fog in (0.6 - step, 0.6 + step)
    )
    assert found.theta["weather.fog"] == pytest.approx((high - low) / (2 * step), rel=error)


def test_an_objective_of_ones_own(scene: ds.Scene, tmp_path: Path) -> None:
    calls = []

    def hide_the_first(candidates: Candidates, targets: Targets, t_star: float) -> torch.Tensor:
        calls.append(t_star)
        overlap = iou_matrix(targets.boxes_xyxy[:1], candidates.boxes_xyxy[:, 0])[0] > 0.5
        return -candidates.log_scores[overlap, 0].amax()

    options = {"params": "color,weather", "steps": 3, "confirm": False}
    found = ds.attack(scene, "squeezedet", objective=hide_the_first, **options)
    assert len(calls) > 3
    assert max(found.result.loss_trace) > found.result.loss_trace[0]
    with pytest.raises(UsageError, match="objective: expected an objective by name"):
        found.save(tmp_path / "run")
    with pytest.raises(SceneError, match="objective: expected a function that returns a tensor"):
        ds.attack(scene, "squeezedet", objective=lambda *_: 1.0, **options)  # pyright: ignore[reportArgumentType]


def test_functions_and_modules_are_detectors(scene: ds.Scene) -> None:
    def one_box(images: torch.Tensor) -> dict[str, Any]:
        assert images.shape == (1, 3, 376, 1241)
        return {"boxes": [[-5.0, 10.0, 90.0, 60.0], [1.0, 2.0, 3.0, 4.0]], "scores": [0.5, 0.75], "labels": [0, 1]}

    detector = ds.load_detector(one_box, classes=["Car", "Pedestrian"])
    found = ds.detect(detector, scene)
    assert found.boxes_xyxy.tolist() == [[1.0, 2.0, 3.0, 4.0], [0.0, 10.0, 90.0, 60.0]]
    assert found.labels.tolist() == [1, 0]
    assert ds.attack(scene, detector, params="weather", passes=24, confirm=False).result.objects == 6
    assert ds.load_detector(Blobs()).classes == ("Car", "Pedestrian")
    with pytest.raises(ValueError, match=r"detector Flat\w+: expected .*, found"):
        ds.load_detector(torch.nn.Flatten())
    with pytest.raises(ValueError, match="expected class names for a function"):
        ds.attack(scene, one_box)
    with pytest.raises(ValueError, match=r"detector one_box: expected boxes \(M, 4\) px"):
        ds.detect(ds.load_detector(one_box, classes=["Car"]), scene)
    for wrong in (scene.photograph, 3.5, None):
        with pytest.raises(ValueError, match="detector: expected a name, a file, a detector"):
            ds.load_detector(wrong)
        with pytest.raises(ValueError, match="scene: expected a scene"):
            ds.attack(wrong)


class Blobs(torch.nn.Module):
    """Boxes and probabilities of dark blobs."""

    spec: ClassVar[dict[str, Any]] = {"classes": ["Car", "Pedestrian"], "multiple": 16}

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        dark = 0.5 - torch.nn.functional.avg_pool2d(images.mean(1), 16).flatten(1)
        boxes = torch.tensor([0.0, 0.0, 32.0, 32.0]).expand(1, dark.shape[1], 4)
        return boxes, torch.stack((dark, -dark), -1).sigmoid()


class OwnNetwork(torch.nn.Module):
    """The bundled network as somebody else's: boxes (1, A, 4) px and probabilities (1, A, C)."""

    def __init__(self, through_numpy: bool) -> None:
        super().__init__()
        self.inner = ds.load_detector("squeezedet")
        self.spec = {"classes": list(self.inner.classes)}
        self.through_numpy = through_numpy

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        if self.through_numpy:
            images = torch.from_numpy(images.numpy())
        found = self.inner.candidates(self.inner(images))
        best = found.log_scores.amax(1).topk(200).indices
        return found.boxes_xyxy[None, best, 0], found.log_scores[None, best].exp()


def test_a_module_is_attacked_by_its_gradient(scene: ds.Scene, capsys: pytest.CaptureFixture[str]) -> None:
    found = ds.attack(
        scene, OwnNetwork(through_numpy=False), params="color", steps=1, confirm=False, nuisances="off"
    )
    assert found.config.method == "si-fgsm"
    assert len(found.result.found_before) > 2
    assert found.result.loss_trace[-1] > found.result.loss_trace[0]
    assert "gradient" not in capsys.readouterr().err


def test_a_module_without_gradient_is_attacked_without_one(
    scene: ds.Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    found = ds.attack(
        scene, OwnNetwork(through_numpy=True), params="color", passes=24, confirm=False, nuisances="off"
    )
    assert found.config.method == "climb"
    assert any(found.theta.values())
    reason = "its outputs do not depend on the image by torch's operations"
    line = f"OwnNetwork has no gradient ({reason}): method climb takes the place of si-fgsm"
    assert line in capsys.readouterr().err.splitlines()


def test_edits_are_the_commands(scene: ds.Scene, tmp_path: Path) -> None:
    scene.save(tmp_path / "scene")
    loaded = ds.load_scene(tmp_path / "scene")  # tensors' layout in memory decides how fog's last bits are rounded
    changed = loaded.edit("objects[1].translate=0.5m,0m", weather="fog", remove=[3])
    assert len(changed) == len(scene) - 1
    same = loaded.edit(objects={1: {"translate": ("0.5m", "0m")}}, weather="fog", remove=[3])
    assert np.array_equal(changed.render(), same.render())
    words = ["--set", "objects[1].translate=0.5m,0m", "--set", "weather=fog", "--remove", "3"]
    assert main(["edit", str(tmp_path / "scene"), *words, "-o", str(tmp_path / "moved.png")]) == 0
    assert np.array_equal(read_image(tmp_path / "moved.png"), changed.render())
    assert len(scene.edit(remove="all")) == 0


@pytest.mark.parametrize(
    ("settings", "named", "error", "line"),
    [
        ((), {}, UsageError, "edit: expected a change"),
        (("objects[1].fly=1",), {}, FormatError, "edit objects\\[1\\].fly=1"),
        ((), {"weather": "hail"}, FormatError, "edit: weather: expected codes such as fog"),
        ((), {"remove": [99]}, RangeError, "objects\\[99\\]"),
        ((), {"remove": "some"}, UsageError, "remove: expected rows from 0, or 'all'"),
    ],
)
def test_bad_edits(
    scene: ds.Scene, settings: tuple[str, ...], named: dict[str, object], error: type[Exception], line: str
) -> None:
    with pytest.raises(error, match=line):
        scene.edit(*settings, **named)  # pyright: ignore[reportArgumentType]


def test_an_attack_is_the_commands(counterexample: ds.Counterexample, small_run: Path, tmp_path: Path) -> None:
    written = small_run / "frames" / "demo-000"
    theta = json.loads((written / "theta.json").read_text())
    assert counterexample.theta == {name: coordinate["value"] for name, coordinate in theta.items()}
    assert np.array_equal(counterexample.picture, read_image(written / "counterexample.png"))
    assert counterexample.result.failures == load_frame(written / "result.json").failures
    counterexample.save(tmp_path / "run")
    saved = tmp_path / "run" / "frames" / "demo-000"
    names, of_frame = (
        sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
        for folder in (written, saved)
    )
    assert names == of_frame
    for name in names:
        if name.name != "result.json":  # which holds the seconds
            assert (saved / name).read_bytes() == (written / name).read_bytes(), name


def test_a_saved_counterexample_is_a_run(counterexample: ds.Counterexample, tmp_path: Path) -> None:
    for _ in range(2):  # the second replaces the first
        counterexample.save(tmp_path / "run")
        run = ds.load_run(tmp_path / "run")
        assert [frame.result.identifier for frame in run.frames] == ["demo-000"]
    assert ds.verify(run).data["agree"] is True
    assert ds.report(tmp_path / "run", out=tmp_path / "page.html") == tmp_path / "page.html"
    assert "demo-000" in (tmp_path / "page.html").read_text()
    (tmp_path / "run" / "frames" / "another").mkdir()
    with pytest.raises(UsageError, match="folder: expected a new folder, or one of the frame demo-000 alone"):
        counterexample.save(tmp_path / "run")


def test_analyses_take_runs_and_folders(small_run: Path, tmp_path: Path) -> None:
    confirmed = ds.confirm(ds.load_run(small_run), out=str(tmp_path / "confirm"), workers=1)
    assert (tmp_path / "confirm" / "confirm.json").is_file()
    assert confirmed.out == tmp_path / "confirm"
    with pytest.raises(UsageError, match=r"run: expected a run .*, found int"):
        ds.explain(7)  # pyright: ignore[reportArgumentType]
    with pytest.raises(UsageError, match=r"speed: expected one of .*points"):
        ds.explain(small_run, speed=1)
    with pytest.raises(UsageError, match="points: expected at least 1, found 0"):
        ds.explain(small_run, points=0)


def test_a_counterexample_has_a_picture_and_a_description(
    counterexample: ds.Counterexample, scene: ds.Scene
) -> None:
    assert counterexample.feasible
    assert counterexample.tensor.shape == (3, *counterexample.picture.shape[:2])
    assert np.array_equal(counterexample.photograph, scene.photograph)
    assert counterexample.rows()[0].keys() == {"name", "unit", "value", "lower", "upper", "display"}
    tags = tags_of(counterexample._repr_html_())
    assert len(tags.sources) == 2
    for source in tags.sources:
        head, data = source.split(",")
        assert head == "data:image/png;base64"
        assert picture_of(base64.b64decode(data)).shape == counterexample.picture.shape
    further = counterexample.scene.edit(weather="rain")  # what was found is a scene like any other
    assert further.render().shape == counterexample.picture.shape


def test_failures_have_kind_grade_and_draws(counterexample: ds.Counterexample, small_run: Path) -> None:
    box, count = (1.0, 2.0, 30.0, 40.0), Certificate(16, 16, 13, 16, 1.5, -0.5)
    failures = (
        Failure("lost", "Car", box, 0, None, "placed", "confirmed", count, SecondOpinion("generator", 4, 3, 4)),
        Failure("phantom", "Car", box, score=0.7, grade="threshold"),
    )
    result = replace(counterexample.result, failures=failures)
    found = replace(counterexample, result=result)
    assert found.grades == {"threshold": 2, "certain": 1, "confirmed": 1, "shared": 0}
    lost, phantom = found.failure_rows()
    assert (lost["kind"], lost["grade"], lost["object"]) == ("placed", "confirmed", 0)
    assert (lost["right_before"], lost["wrong_after"], lost["draws_after"]) == (16, 13, 16)
    assert (lost["second"], lost["second_agrees"], lost["peer"]) == ("generator", True, None)
    assert (phantom["kind"], phantom["grade"], phantom["score"]) == (None, "threshold", 0.7)
    assert json.loads(json.dumps(found.failure_rows())) == [lost, phantom]
    description = tags_of(found._repr_html_()).text
    assert "2 threshold, 1 certain, 1 confirmed; feasible" in description
    assert "confirmed: Car badly placed, objects[0] at 1, 2, 30, 40 px; found in 16/16 draws before" in description
    run = ds.load_run(small_run)
    (frame,) = run.frames
    run = replace(run, frames=(replace(frame, result=result),))
    assert run.failure_rows() == [{"frame": "demo-000", **row} for row in (lost, phantom)]
    (row,) = run.rows()
    assert (row["certain"], row["confirmed"], row["shared"]) == (1, 1, 0)
    assert (row["placed"], row["missed"], row["passes"]) == (1, 0, result.passes)


def test_failures_of_earlier_runs_are_of_unknown_grade(small_run: Path) -> None:
    run = ds.load_run(small_run)
    (frame,) = run.frames
    lost = Failure("lost", "Car", (1.0, 2.0, 3.0, 4.0), index=0)
    (row,) = replace(run, frames=(replace(frame, result=replace(frame.result, failures=(lost,))),)).rows()
    assert (row["lost"], row["certain"], row["missed"]) == (1, None, None)
    assert lost.to_row()["grade"] is None


def test_a_scene_that_was_not_attacked_says_so(counterexample: ds.Counterexample) -> None:
    result = replace(counterexample.result, failures=(), objects=3, judged=(), found_before=(), queries=0)
    description = tags_of(replace(counterexample, result=result)._repr_html_()).text
    assert "not attacked; feasible" in description
    assert "none of 3 objects is judged" in description


def test_names_are_escaped(counterexample: ds.Counterexample) -> None:
    named = replace(counterexample, scene=replace(counterexample.scene, name="<script>"))
    assert "<script>" not in named._repr_html_()
    assert "<script>" in tags_of(named._repr_html_()).text


def test_a_detector_that_is_loaded(scene: ds.Scene, counterexample: ds.Counterexample) -> None:
    detector = ds.load_detector("squeezedet")
    assert ds.attack(scene.ir, detector, **OPTIONS).theta == counterexample.theta


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"steps": 0}, "steps: expected at least 1, found 0"),
        ({"steps": "many"}, "steps: expected a whole number, found 'many'"),
        ({"t_star": 2.0}, "t_star: expected a score in"),
        ({"method": "magic"}, "method: expected one of si-fgsm"),
        ({"combo": 1, "params": "rotate"}, "params: expected no combo"),
        ({"detector": "nobody"}, "detector: expected a detector"),
        ({"target_objects": "77"}, "expected objects up to the 77th"),
    ],
)
def test_bad_options_name_the_argument(scene: ds.Scene, options: dict[str, object], line: str) -> None:
    with pytest.raises((UsageError, SceneError), match=line) as caught:
        ds.attack(scene, **options)  # pyright: ignore[reportArgumentType]
    assert "\n" not in str(caught.value)
    assert "--" not in str(caught.value).partition("expected")[0]


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"precision": "bfloat16"}, "precision: expected none with a loaded detector, found 'bfloat16'"),
        ({"tiles": "off"}, "tiles: expected none with a loaded detector, found 'off'"),
        ({"device": "meta"}, "device: expected that of the loaded detector: cpu, found 'meta'"),
    ],
)
def test_a_loaded_detector_excludes_loading_options(scene: ds.Scene, options: dict[str, str], line: str) -> None:
    with pytest.raises(UsageError, match=line):
        ds.attack(scene, ds.load_detector("squeezedet"), **options)  # pyright: ignore[reportArgumentType]


def test_a_detector_without_gradient_gets_the_commands_method(
    scene: ds.Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    methods: list[str] = []
    monkeypatch.setattr(
        AttackWorker, "attack_scene", lambda worker, *_: methods.append(worker.config.method) or 1 / 0
    )
    monkeypatch.setattr(attack_run, "load_predictor", lambda *_: Blinking())
    for detector in (Blinking(), "any"):
        with pytest.raises(ZeroDivisionError):
            ds.attack(scene, detector, params="color", confirm=False)
        every = "method: expected one of random, halton, cma-es, corners, climb, learn for"
        with pytest.raises(UsageError, match=every):
            ds.attack(scene, detector, params="color", confirm=False, method="apgd")
    assert methods == ["climb", "climb"]


def test_runs_are_rows(small_run: Path) -> None:
    run = ds.load_run(small_run)
    (row,) = run.rows()
    assert row["frame"] == "demo-000"
    assert all(isinstance(value, str | int | float | bool | None) for value in row.values())
    assert "squeezedet" in tags_of(run._repr_html_()).text
    with pytest.raises(UsageError, match="folder: expected a folder of drivesem attack"):
        ds.load_run(small_run / "frames")
    for limit in (0, -1):
        with pytest.raises(UsageError, match=f"limit: expected at least 1, found {limit}"):
            ds.load_run(small_run, limit=limit)


def test_frames_of_a_data_set(small_kitti: Path) -> None:
    frames = ds.open_dataset("kitti", small_kitti)
    assert len(frames) == len(frames.names)
    first = next(iter(frames))
    assert isinstance(first, Frame)
    assert frames[frames.names[0]].identifier == first.identifier
    with pytest.raises(RangeError, match="frame of"):
        _ = frames["nobody"]
    with pytest.raises(RangeError, match="dataset: expected one of bdd100k, coco"):
        ds.open_dataset("lego", small_kitti)


def test_photographs_as_files_arrays_tensors_and_frames(small_kitti: Path, tmp_path: Path) -> None:
    name = "000008"
    photo = small_kitti / "training" / "image_2" / f"{name}.png"
    labels, calib = (small_kitti / "training" / part / f"{name}.txt" for part in ("label_2", "calib"))
    frame = ds.open_dataset("kitti", small_kitti)[name]
    assert torch.equal(to_image_tensor(read_image(photo)), frame.photograph)
    assert torch.equal(to_image_tensor(frame.photograph), frame.photograph)
    scenes = [
        ds.derender(photo, labels, calib, fit=False),
        ds.derender(read_image(photo), frame.labels, frame.camera.matrix.numpy(), fit=False),
        ds.derender(replace(frame, depth=None, classes=None, masks=None), fit=False),
    ]
    words = ["--root", str(small_kitti), "--fast", "--workers", "1", "--out", str(tmp_path)]
    assert main(["derender", "--dataset", "kitti", *words]) == 0
    by_command, whole = ds.load_scene(tmp_path / name), ds.derender(frame, fit=False)
    for same in ((scenes[0], scenes[1]), (scenes[1], scenes[2]), (by_command, whole)):
        assert same[0].rows() == same[1].rows()
        assert np.array_equal(same[0].ir.background, same[1].ir.background)


def test_bad_photographs(small_kitti: Path) -> None:
    folder = small_kitti / "training"
    photo, labels = folder / "image_2" / "000008.png", folder / "label_2" / "000008.txt"
    pixels = read_image(photo)
    with pytest.raises(UsageError, match="calib: expected a calibration for labels, found none"):
        ds.derender(photo, labels)
    with pytest.raises(UsageError, match="photo: expected an array"):
        ds.derender(pixels.astype(np.float32))  # pyright: ignore[reportArgumentType]
    with pytest.raises(UsageError, match="photo: expected values in"):
        ds.derender(torch.full((3, 8, 8), 255.0))
    with pytest.raises(UsageError, match="photo: expected a file, an array"):
        ds.derender(7)  # pyright: ignore[reportArgumentType]
    with pytest.raises(UsageError, match="calib: expected intrinsics"):
        ds.derender(pixels, labels, np.eye(4))
    with pytest.raises(UsageError, match="meshes: expected a folder"):
        ds.derender(pixels, meshes="nowhere")
    with pytest.raises(FormatError, match=r"nowhere\.png"):
        ds.derender("nowhere.png")
    with pytest.raises(RangeError, match="focal"):
        ds.derender(pixels, focal=-1.0)


def test_the_collector_runs_again_once_a_command_is_loaded() -> None:
    code = (
        "import gc\n"
        "from drivesem.cli import main\n"
        "assert main(['attack', '--dataset', 'kitti', '--root', '/nowhere']) == 2\n"
        "assert gc.isenabled() and gc.get_freeze_count() > 0\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
