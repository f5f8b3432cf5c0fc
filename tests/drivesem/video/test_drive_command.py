"""`drivesem drive` as a user types it: what it prints and writes, going on, bad input; and real folders."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

from detectors.registry import load_predictor
from drivesem.attacks.space import Budget, Parameter
from drivesem.cli import main
from drivesem.config.commands import DriveConfig
from drivesem.config.errors import UsageError
from drivesem.run.records import from_json
from drivesem.synth.write import Order, synthesise
from drivesem.video import clips as taking
from drivesem.video import run as running
from drivesem.video.clips import DerenderedClip
from drivesem.video.objective import ClipObjective
from drivesem.video.report import DriveResult, write_page
from scene_ir import files
from scene_ir.io import load_scene
from scene_ir.types import Category, SceneIR
from tests.drivesem.invoke import invoke, refusal, run_json
from tests.drivesem.video.clips import clip_of

WORDS = ["drive", "--params", "color,translate", "--steps", "1", "--keys", "2", "--keep", "last", "--json"]


@pytest.fixture(scope="module")
def taken(street: Callable[..., SceneIR]) -> DerenderedClip:
    return clip_of(street, 3, drawn=True, without=1)


@pytest.fixture(scope="module")
def finished(taken: DerenderedClip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A command on a clip that is taken apart already."""
    out = tmp_path_factory.mktemp("drive") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(running, "ClipDerenderer", lambda *_: None)
        patch.setattr(running, "derender_clip", lambda *_: taken)
        assert main([*WORDS, "--limit", "3", "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize("words", ["export --to kitti --out out", "retrain --out out", "verify", "explain"])
def test_a_clip_is_not_taken_for_an_interrupted_attack(
    words: str, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command, *rest = words.split()
    error = refusal(command, finished, *rest)
    assert "--run: expected a" in error
    assert "of drivesem attack, found" in error
    assert "stopped early" not in error


def test_what_is_written(finished: Path, taken: DerenderedClip) -> None:
    data = json.loads((finished / "drive.json").read_text())
    assert data["frames"] == 3
    assert data["names"] == list(taken.names)
    assert data["params"] == ["color", "translate"]
    assert data["feasible"] == 3
    assert data["queries"] == 1
    assert sorted(car["track"] for car in data["tracks"]) == [4, 7, 9]
    for car in data["tracks"]:
        assert set(car["states"]) == {"before", "after", "control"}
        for state, letters in car["states"].items():
            assert len(letters) == 3
            assert car[f"lost_{state}"] == letters.count("l")
        assert car["frames"] == sum(letter in "fl" for letter in car["states"]["after"])
    (last,) = (car for car in data["tracks"] if car["track"] == 9)
    assert [way is None for way in last["path_m"]] == [False, True, False]
    assert last["states"]["after"][1] == " "
    assert any(name.startswith("tracks[4].paint") for name in data["theta"])
    for name in taken.names:
        for side in ("before", "after"):
            assert files.read_image(finished / "frames" / name / f"{side}.jpg").shape == (188, 621, 3)
    assert (finished / "config.yaml").is_file()
    assert len((finished / "drive.csv").read_text().splitlines()) == 4
    assert not files.find_leftovers(finished)


def test_the_video_has_all_frames(finished: Path) -> None:
    video = cv2.VideoCapture(str(finished / "clip.webm"))
    count = 0
    while video.read()[0]:
        count += 1
    assert count == 3
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    assert (finished / "clip.webm").read_bytes()[:4] == b"\x1aE\xdf\xa3"  # EBML, of which WebM is made


def test_resume_prints_the_finished_result(finished: Path) -> None:
    assert json.loads(invoke(*WORDS, "--limit", "3", "--out", finished).out) == json.loads(
        (finished / "drive.json").read_text()
    )
    assert "other values of limit" in refusal(*WORDS, "--out", finished, "--limit", "2")


def test_a_clip_that_memory_cannot_hold_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(taking, "memory_gb", lambda: 0.5)
    output = invoke("drive", "--limit", "30", "--out", tmp_path / "out", code=2).err.strip()
    assert output.endswith(
        "CLIP: frames: expected at most 6 frames, which fit into 0.5 GB of memory (--limit takes the first), found 30"
    )
    assert not (tmp_path / "out" / "scenes").exists()


def test_people_need_a_clip(tmp_path: Path) -> None:
    words = ("drive", "--target-classes", "Pedestrian", "--out", tmp_path / "out")
    assert refusal(*words) == "--people: expected a CLIP with people, found none"


def test_only_targeted_classes_count(street: Callable[..., SceneIR]) -> None:
    """The second object is a pedestrian; the cars change, and are not judged."""
    clip = clip_of(street, 1, drawn=True)
    category = torch.tensor([int(Category.CAR), int(Category.PEDESTRIAN), int(Category.CAR)])
    clip = replace(clip, scenes=tuple(scene.with_objects(category=category) for scene in clip.scenes))
    config = DriveConfig(clip="clip", target_classes="Pedestrian")
    objective = ClipObjective(clip, load_predictor("squeezedet"), (Parameter.COLOR,), Budget(), config)
    detection = objective.match_frame(0, objective.frames[0].benign)
    assert detection.counted == (False, True, False)
    assert objective.space.count == 3
    with pytest.raises(
        UsageError, match="objects of Truck that are large and visible enough to count, found none in 1 frame"
    ):
        ClipObjective(
            clip,
            load_predictor("squeezedet"),
            (Parameter.COLOR,),
            Budget(),
            replace(config, target_classes="Truck"),
        )


def test_the_table_names_cars(finished: Path) -> None:
    output = invoke(*(word for word in WORDS if word != "--json"), "--limit", "3", "--out", finished).out
    assert "4 Car" in output
    assert "by a random change" in output


def test_the_page_escapes_and_runs_one_script(finished: Path, tmp_path: Path) -> None:
    data = json.loads((finished / "drive.json").read_text())
    data["clip"] = "<b>clip</b>"
    data["names"][0] = "</script><i>"
    write_page(tmp_path / "page.html", from_json(DriveResult, data, "drive.json"))
    page = (tmp_path / "page.html").read_text()
    assert "<b>clip" not in page
    assert "<i>" not in page
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert len(scripts) == 1
    assert f"'sha256-{base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()}'" in page
    assert "default-src 'none'" in page


def test_a_slider_shows_frames_in_a_browser(chromium: Any, finished: Path) -> None:
    complaints: list[str] = []
    page = chromium.new_page(viewport={"width": 1280, "height": 900})
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto((finished / "report.html").as_uri())
    page.wait_for_load_state("networkidle")
    assert page.locator("#after").evaluate("image => image.naturalWidth") == 621
    page.locator("#frame").focus()
    page.keyboard.press("End")
    assert page.locator("#name").inner_text() == "002"
    assert page.locator("#after").get_attribute("src") == "frames/002/after.jpg"
    page.wait_for_function("document.querySelector('video').readyState >= 1")
    assert page.locator("video").evaluate("video => video.videoWidth") == 622
    assert page.locator("video").evaluate("video => video.error") is None
    width, wide = page.evaluate("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert width <= wide
    page.close()
    assert not complaints


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["vkitti2", "kitti"])
def test_what_the_generator_wrote(layout: str, tmp_path: Path) -> None:
    people = layout == "kitti"
    variations = ("mixed",) if people else ("clone",)
    order = Order(tmp_path / "data", 3, 1, layout, "heldout", sequence=3, people=people, variations=variations)
    assert len(list(synthesise(order))) == 3
    out = tmp_path / "out"
    words = ["drive", str(tmp_path / "data"), "--params", "color", "--steps", "1", "--certify", "0", "--no-fit"]
    words += ["--people"] if people else []
    words += ["--workers", "1", "--out", str(out), "--json"]
    data = json.loads(invoke(*words).out)
    assert data["frames"] == 3
    kinds = {one["kind"] for one in data["tracks"]}
    assert {"Car", *(["Pedestrian"] if people else [])} <= kinds
    assert data["feasible"] == 3
    meshes: dict[str, set[str]] = {}
    for name in data["names"]:
        scene = load_scene(out / "scenes" / name)
        tracks = scene.provenance["tracks"].split(",")
        for i in range(len(scene.objects)):
            mesh = scene.meshes[int(scene.objects.mesh_index[i])].name
            meshes.setdefault(tracks[int(scene.provenance[f"objects[{i}].label"])], set()).add(mesh)
    assert meshes
    assert all(len(names) == 1 for names in meshes.values())


@pytest.mark.slow
def test_a_killed_command_goes_on(tmp_path: Path) -> None:
    """What was taken apart stays, and the end is the same."""
    words = ["drive", "--limit", "2", "--params", "color", "--steps", "1", "--certify", "0", "--workers", "1"]
    found = []
    for name in ("whole", "killed"):
        out = tmp_path / name
        if name == "killed":
            shutil.copytree(tmp_path / "whole", out)
            shutil.rmtree(out / "scenes" / "drive-001")
            for path in (out / "drive.json", out / "frames"):
                path.unlink() if path.is_file() else shutil.rmtree(path)
        data = run_json(*words, "--out", out)
        found.append({key: value for key, value in data.items() if key not in ("out", "seconds")})
    assert found[0] == found[1]
    assert len(found[0]["tracks"]) >= 3
