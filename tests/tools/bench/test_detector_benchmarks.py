"""`python -m tools.bench memory`, `climb` and `planted`: one JSON object, files, and errors in one line."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from drivesem.bench.scenes import build_bench_scene
from tools.bench import climb, memory
from tools.bench.__main__ import main
from tools.bench.planted import across, yardstick
from tools.bench.planted import across_report as across_names
from tools.bench.planted.pool import CarObservation, FramePool


@pytest.fixture(autouse=True)
def _one_thread_more_or_less_stays_here() -> Any:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
def test_memory(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "QUICK_STEPS", 20)
    words = ["memory", "--quick", "--cars", "1", "--triangles", "600", "--threads", "1", "--json"]
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


def test_planted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """What is done is kept, and the figures are of it."""
    row = yardstick.FaultSearch(
        "demo-000", "aspect easy", "easy", "aspect=1:2", 0.2, 0.1, "halton", 1, 1, 1, 50, 4.0
    )
    asked = []

    def judged(self: yardstick.PlantedFaultBench, name: str) -> yardstick.FrameSearches:
        asked.append(name)
        return yardstick.FrameSearches(name, (replace(row, frame=name),), ("contrast rare",))

    monkeypatch.setattr(yardstick.PlantedFaultBench, "_judge", judged)
    words = ["planted", "--methods", "halton", "--limit", "2", "--workers", "1", "--json"]
    for _ in range(2):
        assert main([*words, "--out", str(tmp_path)]) == 0
        result = json.loads(capsys.readouterr().out)
    assert asked == ["demo-000", "demo-001"]
    (summed,) = result["rows"]
    assert (summed["found"], summed["faults"], summed["found_per_100"]) == (2, 2, 2.0)
    assert result["kinds"][1]["planted"] == 0
    capsys.readouterr()
    assert main([*words, "--out", str(tmp_path), "--faults", "1", "--naming", "halton"]) == 0
    assert len(asked) == 4, "other settings, other frames"
    assert "4 attacks of 90 passes" in capsys.readouterr().err


@pytest.mark.slow
def test_planted_across(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Faults of a detector in made-up frames: what is done is kept, and frames search for faults in turn."""
    made: list[str] = []
    searched: list[tuple[str, str]] = []
    names = ("height_px", "lightness")

    def pool(objective: Any, name: str, seed: int, states: int) -> FramePool:
        made.append(name)
        rng = np.random.default_rng(len(made))

        def car(index: int) -> CarObservation:
            height, shade = 20.0 + 8 * index + rng.uniform(-3, 3), rng.random()
            return CarObservation(index, (height, shade), 2.0, ((0.9, height, 1.5, 0.5, shade, 0.2),))

        rows = [tuple(car(index) for index in range(8)) for _ in range(4 + states)]
        return FramePool(name, 0.545, names, tuple(rows[:4]), tuple(rows[4:]))

    def attempt(
        self: across.SharedFaultBench, name: str, scene: Any, fault: str, method: str, *_: Any
    ) -> across.SharedFaultSearch:
        searched.append((name, fault))
        return across.SharedFaultSearch(name, fault, method, 0, 0, 24, ())

    monkeypatch.setattr(FramePool, "make", pool)
    monkeypatch.setattr(across.SharedFaultBench, "_attempt", attempt)
    monkeypatch.setattr(across, "KINDS", (("height_px",), ("aspect",), ("lightness",)))
    monkeypatch.setattr(across, "FRAMES", {"common": 2})
    monkeypatch.setattr(across, "CARS", {"common": 3})
    scene = build_bench_scene(1, 600).scene
    monkeypatch.setattr(across.SharedFaultBench, "_scene", lambda *_: scene)
    monkeypatch.setattr(across_names, "CHANCE_DETECTORS", 2)
    words = [
        "planted",
        "--methods",
        "climb",
        "--limit",
        "3",
        "--workers",
        "1",
        "--json",
        "--across",
        "24",
    ]
    for _ in range(2):
        assert main([*words, "--faults", "2", "--out", str(tmp_path)]) == 0
        result = json.loads(capsys.readouterr().out)
    assert (len(made), len(searched)) == (3, 6)
    assert result["unplanted"] == ["aspect"], "all of one aspect"
    planted = list(dict.fromkeys(row["fault"] for row in result["rows"] if row["fault"]))
    assert [text.split("=")[0] for text in planted] == ["height_px", "lightness"]
    in_turn = [*planted, ""]
    assert [fault for _, fault in searched] == [in_turn[i % 3] for i in range(6)]
    named = [row for row in result["rows"] if row["by"] == "halton's states, all" and row["fault"]]
    assert all(row["named"] for row in named)
    assert {row["by"]: row["faults"] for row in result["summary"]}["climb"] == 2
    assert "faults of a detector" in (tmp_path / "planted.md").read_text()


@pytest.mark.slow
def test_climb(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(climb, "PRECISIONS", {"float32": None})
    words = ["climb", "--quick", "--cars", "1", "--params", "color,weather", "--passes", "24", "--json"]
    assert main([*words, "--threads", "1"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert (row["cars"], row["params"], row["passes"], row["precision"]) == (1, "color,weather", 24, "float32")
    parts = row["render_ms"] + row["picture_ms"] + row["detector_ms"]
    assert parts > 0
    assert row["gradient_ms"] > row["detector_ms"]
    # At least as long as its passes' detector, a gradient being one that is counted as three.
    assert row["search_s"] * 1e3 > 24 / 3 * 0.5 * row["detector_ms"]
