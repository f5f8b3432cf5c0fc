"""`drivesem bench` as a user types it: one JSON object, files, and errors on one line."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from drivesem.attacks.space import combo_parameters
from drivesem.bench import render, step
from drivesem.bench.scenes import build_bench_scene
from drivesem.bench.timing import CallTime
from drivesem.commands import bench
from tests.drivesem.invoke import invoke, refusal


@pytest.fixture(autouse=True)
def _one_thread_more_or_less_stays_here() -> Any:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def _no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fewest repetitions."""
    monkeypatch.setattr(bench, "_SECONDS", dict.fromkeys(("step", "render", "verbs"), (0.0, 0.0)))


def test_step(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _no_time(monkeypatch)
    words = ["bench", "step", "--quick", "--cars", "1", "--triangles", "600", "--threads", "1", "--json"]
    captured = invoke(*words, "--out", tmp_path, "--markdown", tmp_path / "all.md")
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
    assert result["extra"][0]["params"] == "weather,foliage"
    assert json.loads((tmp_path / "step.json").read_text()) == result
    assert "| ratio |" in (tmp_path / "step.md").read_text()
    assert (tmp_path / "step.md").read_text() in (tmp_path / "all.md").read_text()


def test_a_step_goes_on_from_a_theta_that_is_not_the_photograph() -> None:
    from detectors.registry import load_detector

    attack = step.AttackSteps(
        build_bench_scene(1, 600).scene, combo_parameters(2), load_detector("squeezedet"), 0, "cpu"
    )
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

        def time_call(self, call: Any) -> CallTime:
            slow = 10 if self.calls in (2, 3) else 1
            self.calls += 1
            ms = 3.0 if call is stepping else 2.0
            return CallTime(slow * ms, 2 * ms - 2.0)

    class Stepping:
        def __call__(self) -> None: ...

        def parts(self, clock: Any) -> tuple[float, ...]:
            return 1.0, 2.0, 3.0, 4.0

    stepping = Stepping()
    row = step._row(step.StepCase(1, 600), build_bench_scene(1, 600), stepping, lambda: None, Ticks(), 1e-9)  # type: ignore[arg-type]
    assert row["repetitions"] == 3
    assert (row["ratio"], row["ratio_iqr"]) == (1.5, 0.0)
    assert (row["step_ms"], row["detector_ms"]) == (3.0, 2.0)
    assert (row["cpu_ratio"], row["step_cpu_ms"], row["detector_cpu_ms"]) == (2.0, 4.0, 2.0)


def test_render_rows() -> None:
    rows = list(render.measure([render.SceneSize(1, 600)], 0.0, 0, "cpu"))
    assert [row["backend"] for row in rows] == ["warp", "reference"]
    for row in rows:
        assert row["forward_ms"] > 0
        assert row["backward_ms"] > 0
        assert row["forward_backward_ms"] > row["backward_ms"]
        assert row["both_cpu_ms"] > 0
    found = list(render.measure_verbs(render.SceneSize(1, 600), 0.0, 0, "cpu"))
    assert [(row["verb"], row["backward_ms"] is None) for row in found[:4]] == [
        ("rasterize", True), ("interpolate", False), ("texture", False), ("antialias", False),
    ]  # fmt: skip
    assert {row["backend"] for row in found} == {"warp", "reference"}


def test_out_must_be_a_folder_or_a_new_file(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    assert "--out" in refusal("bench", "step", "--out", tmp_path / "taken")


@pytest.mark.slow
def test_night() -> None:
    """Two embedded frames tell of a thousand."""
    words = ["bench", "night", "--limit", "2", "--count", "1000", "--workers", "1", "--json"]
    printed = invoke(*words, "--attack=--steps 2 --no-confirm")
    result = json.loads(printed.out)
    assert result["attack"] == "drivesem attack --steps 2 --no-confirm"
    assert "timing: drivesem attack --steps 2 --no-confirm" in printed.err
    assert len(result["measured"]) == 2
    assert [row["part"] for row in result["parts"]] == ["derender", "search", "certify", "write"]
    night = result["nights"][0]
    assert night["time"].endswith((" min", " h"))
    whole = sum(row["mean_s"] for row in result["parts"])
    assert night["hours"] == pytest.approx(whole * 1000 / 3600)
    assert 0 < whole < 300
