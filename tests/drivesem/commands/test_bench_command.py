"""`drivesem bench` as a user types it: one JSON object, files, and errors on one line."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from drivesem.bench import memory, render, rivals, step
from drivesem.bench.scenes import Placed, bench_scene
from drivesem.cli import main
from drivesem.commands import bench
from scene_ir.raster import verbs
from scene_ir.types import scene_to


@pytest.fixture(autouse=True)
def _one_thread_more_or_less_stays_here() -> Any:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def _no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fewest repetitions."""
    monkeypatch.setattr(bench, "_SECONDS", dict.fromkeys(("step", "render", "verbs"), (0.0, 0.0)))


def test_step(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    _no_time(monkeypatch)
    words = ["bench", "step", "--quick", "--cars", "1", "--triangles", "600", "--threads", "1", "--json"]
    assert main([*words, "--out", str(tmp_path), "--markdown", str(tmp_path / "all.md")]) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert captured.out.count("\n") == 1
    assert result["what"] == "step"
    assert result["machine"]["threads"] == 1
    (row,) = result["rows"]
    assert (row["cars"], row["triangles"], row["triangles_actual"]) == (1, 600, 600)
    assert row["params"] == "translate,rotate,mesh"
    # Which of the two is larger is for a quiet machine to say, not for one pair of timings.
    assert min(row["step_ms"], row["detector_ms"]) > 0
    # The median of paired ratios lies near the ratio of the medians, however noisy the machine.
    assert 0.3 < row["ratio"] / (row["step_ms"] / row["detector_ms"]) < 3
    assert row["ratio_iqr"] >= 0
    parts = ("render_forward_ms", "render_backward_ms", "labels_ms", "project_ms")
    assert all(row[part] > 0 for part in parts)
    assert 0 < row["pixels"] < row["crop_pixels"]
    assert result["beside"][0]["params"] == "weather,foliage"
    assert json.loads((tmp_path / "step.json").read_text()) == result
    assert "| ratio |" in (tmp_path / "step.md").read_text()
    assert (tmp_path / "step.md").read_text() in (tmp_path / "all.md").read_text()


def test_a_step_goes_on_from_a_theta_that_is_not_the_photograph() -> None:
    from detectors.registry import load_detector

    case = step.Case(1, 600)
    attack = step._Step(case, bench_scene(1, 600), load_detector("squeezedet"), 0, "cpu")
    before = attack.theta
    attack()
    assert bool(before.any())
    assert not torch.equal(attack.theta, before)
    assert attack.feasible.violations(attack.theta) == ()


def test_the_ratio_is_of_what_was_measured_in_one_round() -> None:
    class Ticks:
        """2 ms a detector, 3 ms a step; in the second round the machine is ten times as slow."""

        def __init__(self) -> None:
            self.calls = 0

        def ms(self, call: Any) -> float:
            slow = 10 if self.calls in (2, 3) else 1
            self.calls += 1
            return slow * (3.0 if call is stepping else 2.0)

    class Stepping:
        def __call__(self) -> None: ...

        def parts(self, clock: Any) -> tuple[float, ...]:
            return 1.0, 2.0, 3.0, 4.0

    stepping = Stepping()
    row = step._row(step.Case(1, 600), bench_scene(1, 600), stepping, lambda: None, Ticks(), 1e-9)  # type: ignore[arg-type]
    assert row.repetitions == 3
    assert (row.ratio, row.ratio_iqr) == (1.5, 0.0)
    assert (row.step_ms, row.detector_ms) == (3.0, 2.0)


def test_render_rows_of_the_project(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rivals, "RIVALS", {})
    rows = list(render.measure([render.Size(1, 600)], 0.0, 0, "cpu"))
    assert [row.backend for row in rows] == ["warp", "reference", "warp-verbs"]
    for row in rows:
        assert row.forward_ms is not None
        assert row.forward_ms > 0
        assert row.backward_ms is not None
        assert row.backward_ms > 0
        assert row.forward_backward_ms is not None
        assert row.forward_backward_ms > row.backward_ms
    found = list(render.measure_verbs(render.Size(1, 600), 0.0, 0, "cpu"))
    assert [(row.verb, row.backward_ms is None) for row in found[:4]] == [
        ("rasterize", True), ("interpolate", False), ("texture", False), ("antialias", False),
    ]  # fmt: skip
    assert {row.backend for row in found} == {"warp", "reference"}


def _task(cars: int) -> rivals.Task:
    scene = scene_to(bench_scene(cars, 600).scene, torch.float32)
    placed = Placed.of(scene)
    weight = torch.ones(scene.camera.height, scene.camera.width, 3)
    return rivals.Task(placed, scene.camera, torch.rand(placed.points.shape), weight)


@pytest.mark.parametrize("name", ["pyrender", "open3d"])
@pytest.mark.filterwarnings("ignore")
def test_other_renderers_draw_the_same_cars(name: str) -> None:
    task = _task(4)
    try:
        renderer = rivals.RIVALS[name](task)
    except rivals.UnavailableError as error:
        pytest.skip(f"{name}: {error}")
    placed, camera = task.placed, task.camera
    everything = torch.tensor([[0, placed.faces.shape[0]]])
    frame = verbs.Layout.of(torch.tensor([[0, 0, camera.width, camera.height]]))
    own = int((verbs.rasterize(placed.clip, placed.faces, everything, frame).face >= 0).sum())
    assert renderer.hits(renderer.forward()) == pytest.approx(own, rel=0.02)


@pytest.mark.parametrize("name", ["pytorch3d", "nvdiffrast", "mitsuba"])
def test_a_renderer_that_is_not_there_says_why(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(module: str) -> None:
        raise ModuleNotFoundError(f"No module named {module!r}")

    monkeypatch.setattr(rivals.importlib, "import_module", missing)
    row = render._measure_rival(name, (render.Size(1, 600), 5, _task(1)), 0.0, "cpu")
    assert row.forward_ms is None
    assert row.unavailable is not None
    assert "No module named" in row.unavailable


@pytest.mark.slow
def test_memory(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "QUICK_STEPS", 20)
    monkeypatch.setattr(memory, "HAS_BATCHES", False)
    words = ["bench", "memory", "--quick", "--cars", "1", "--triangles", "600", "--threads", "1", "--json"]
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)
    assert [row["sweep"] for row in result["rows"]] == ["cars", "steps"]
    for row in result["rows"]:
        assert row["above_mb"] == pytest.approx(row["peak_mb"] - row["detector_mb"], abs=0.2)
        assert row["peak_mb"] >= row["rss_10"] > 0
    assert abs(result["rows"][1]["slope_kb"]) < 4096


def test_a_leak_shows_as_a_slope() -> None:
    assert memory._slope([100_000 + 64 * i for i in range(100)]) == pytest.approx(64, abs=0.01)
    assert memory._slope([100_000] * 100) == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["step", "--cars", "0"], "--cars: expected numbers of at least 1"),
        (["step", "--cars", "1,two"], "--cars"),
        (["step", "--cars", "99"], "--cars: expected at most 16, found 99"),
        (["render", "--triangles", "1"], "--triangles: expected numbers of at least 4"),
        (["step", "--threads", "0"], "--threads"),
        (["step", "--detector", "nowhere.safetensors"], "nowhere.safetensors"),
        (["step", "--device", "quantum"], "quantum"),
        (["memory", "--device", "quantum"], "quantum"),
        (["frobnicate"], "frobnicate"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert message in captured.err


def test_out_must_be_a_folder_or_a_new_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").write_text("")
    assert main(["bench", "step", "--out", str(tmp_path / "taken")]) == 2
    assert "--out" in capsys.readouterr().err


@pytest.mark.slow
def test_synth(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["bench", "synth", "--frames", "10", "--workers", "2", "--json"]
    assert main([*words, "--out", str(tmp_path), "--markdown", str(tmp_path / "all.md")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [(row["layout"], row["workers"]) for row in result["rows"]] == [
        ("vkitti2", 2),
        ("vkitti2", 1),
        ("kitti", 2),
    ]
    assert result["frames_per_second"] == result["rows"][0]["frames_per_second"] > 0
    assert result["peak_rss_mb"] > 200
    assert result["command"] == "drivesem bench synth --frames 10 --workers 2"
    assert "frames a second" in (tmp_path / "all.md").read_text()


def test_synth_needs_some_frames(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "synth", "--frames", "3"]) == 2
    assert "--frames: expected at least 10, found 3" in capsys.readouterr().err
