"""`drivesem view` as a user types it, without a browser."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivesem.cli import main
from drivesem.commands import view
from drivesem.config.commands import ViewConfig
from drivesem.config.parsing import parse
from drivesem.run.finished import load_run
from drivesem.run.results import dump_frame, load_frame
from drivesem.training.frames import load_attacked_frames
from drivesem.viewer import server as frames
from scene_ir.errors import FormatError
from scene_ir.io import load_scene, save_scene

Refused = Callable[..., str]


@pytest.fixture
def two_scenes(small_run: Path, tmp_path: Path) -> Path:
    """A folder of derender: its settings, and two scenes."""
    folder = tmp_path / "scenes"
    scene = load_scene(small_run / "frames" / "demo-000" / "scene").unperturbed()
    for name in ("a", "b"):
        save_scene(scene, folder / name)
    (folder / "config.yaml").write_text("dataset: kitti\nlimit: 2\n")
    return folder


def test_defaults() -> None:
    assert parse(["view", "a"]) == ViewConfig(scene="a")
    config = parse(["view", "a", "--no-browser", "--port", "0", "--detector", "yolov3-slim", "--frame", "b"])
    assert config == ViewConfig(scene="a", browser=False, port=0, detector="yolov3-slim", frame="b")


def test_a_run_shows_its_frames_to_its_detector(small_run: Path) -> None:
    viewer_frames = frames.open_viewer_frames(ViewConfig(scene=str(small_run)))
    assert list(viewer_frames.frames) == ["demo-000"]
    assert viewer_frames.frames["demo-000"].words == "withstood"
    assert viewer_frames.frames["demo-000"].folder == small_run / "frames" / "demo-000" / "scene"
    assert viewer_frames.detector.name == "squeezedet"
    assert viewer_frames.title == "a"


def test_a_frame_that_was_not_attacked_did_not_withstand(small_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(small_run, run)
    path = run / "frames" / "demo-000" / "result.json"
    path.write_text(dump_frame(replace(load_frame(path), found_before=(), queries=0)))
    assert frames.open_viewer_frames(ViewConfig(scene=str(run))).frames["demo-000"].words == "not attacked"
    (row,) = load_run(run).rows()
    assert (row["attacked"], row["found_before"], row["success_moved"]) == (False, 0, None)
    with pytest.raises(FormatError, match="expected a run of drivesem attack with attacked frames"):
        load_attacked_frames(run)


def test_scenes_of_derender_are_no_run(two_scenes: Path) -> None:
    assert list(frames.open_viewer_frames(ViewConfig(scene=str(two_scenes))).frames) == ["a", "b"]
    assert list(frames.open_viewer_frames(ViewConfig(scene=str(two_scenes), frame="b")).frames) == ["b", "a"]
    assert list(frames.open_viewer_frames(ViewConfig(scene=str(two_scenes / "b"))).frames) == ["b"]


def test_it_begins_with_a_frame_that_has_vehicles(two_scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frames, "count_objects", lambda folder: 1 if folder.name == "b" else 0)
    assert list(frames.open_viewer_frames(ViewConfig(scene=str(two_scenes))).frames) == ["b", "a"]


def test_refuses_what_a_folder_lacks(two_scenes: Path, small_run: Path, refused: Refused) -> None:
    output = refused("view", str(two_scenes), "--frame", "c")
    assert output == f"drivesem: --frame: expected a frame of {two_scenes}, found c"


def test_refuses_a_detector_that_is_none(two_scenes: Path, refused: Refused) -> None:
    assert "--detector: expected a detector that knows cars" in refused("view", str(two_scenes), "--detector", "x")


def test_refuses_code_of_a_run(small_run: Path, tmp_path: Path, refused: Refused) -> None:
    folder = tmp_path / "theirs"
    shutil.copytree(small_run, folder)
    config = folder / "config.yaml"
    config.write_text(config.read_text().replace("detector: squeezedet", "detector: module:theirs.py:D"))
    assert "--trust, which lets this run the code in theirs.py" in refused("view", str(folder))


def test_refuses_a_port_that_is_taken(two_scenes: Path, refused: Refused) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        output = refused("view", str(two_scenes), "--port", str(port), "--no-browser")
    assert output == f"drivesem: --port: expected a free port of 127.0.0.1, found {port}, which is in use"


def test_the_next_port_that_is_free(two_scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        monkeypatch.setattr(view, "_PORT", port)
        server = view._create_server(frames.open_viewer_frames(ViewConfig(scene=str(two_scenes))), None)
        try:
            assert port < server.server_port < port + view._MAX_TRIES
        finally:
            server.server_close()
            server.viewer.close()


def test_it_serves_until_ctrl_c(small_run: Path) -> None:
    words = [sys.executable, "-m", "drivesem.cli", "view", str(small_run), "--port", "0", "--no-browser", "--json"]
    child = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ},
        # A shell's job in the background, as these tests may be, ignores Ctrl-C, and so would what it starts.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert child.stdout is not None
    try:
        content = json.loads(child.stdout.readline())
        assert (content["frames"], content["detector"]) == (1, "squeezedet")
        with urllib.request.urlopen(
            f"{content['url']}picture?frame=demo-000&weather.fog=0.5", timeout=60
        ) as answer:
            assert answer.read(2) == b"\xff\xd8", "a JPEG"
    finally:
        child.send_signal(signal.SIGINT)
        out, err = child.communicate(timeout=30)
    assert child.returncode == 0
    assert out + err.strip() == ""


def test_the_browser_is_opened_at_the_page(two_scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []

    def stop(self: Any, *_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(view.webbrowser, "open", opened.append)
    monkeypatch.setattr(view.Server, "serve_forever", stop)
    monkeypatch.setattr(view, "_PORT", 0)
    assert main(["view", str(two_scenes / "a")]) == 0
    (url,) = opened
    assert url.startswith("http://127.0.0.1:")
