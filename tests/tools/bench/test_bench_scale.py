"""Frames shared by Ray beside frames shared by processes: what is reckoned of rounds, and real ones."""

import json
from collections.abc import Callable

import pytest

from tools.bench import scale
from tools.bench.__main__ import main
from tools.bench.settings import DetectorBenchConfig


def test_rounds_are_in_turn_and_their_figures_are_medians(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, range]] = []

    def one(
        work: Callable[[int], tuple[float, str]], config: DetectorBenchConfig, numbers: range
    ) -> scale._ScaleRound:
        asked.append((config.engine, numbers))
        n, slow = len(asked), config.engine == "ray"
        told = {number: "another" if slow and number == 4 else f"{number}" for number in numbers}
        return scale._ScaleRound(9.0 if n < 3 else 2.0, 120.0 + n if slow else 110.0, [100.0] * len(numbers), told)

    monkeypatch.setattr(scale, "_round", one)
    monkeypatch.setattr(scale, "_worker", lambda name: None)
    local, ray = scale.measure(DetectorBenchConfig(what="scale", limit=16, workers=2))
    assert [engine for engine, _ in asked] == ["local", "ray", *["local", "ray", "ray", "local"] * 2]
    assert [numbers for engine, numbers in asked if engine == "ray"][1:] == [
        range(k, k + 4) for k in (0, 4, 8, 12)
    ]
    assert (local.frames, local.processes, local.first_s, local.start_s) == (16, 2, 9.0, 2.0)
    assert (local.frame_ms, local.own_ms, local.over_ms) == (110.0, 100.0, 10.0)
    assert ray.frame_ms == pytest.approx(126.5)  # of 124, 125, 128, 129
    assert ray.over_ms == pytest.approx(26.5)
    assert local.same == ray.same == 15
    asked.clear()
    assert next(scale.measure(DetectorBenchConfig(what="scale", quick=True, workers=1))).frames == 40


@pytest.mark.slow
def test_frames_are_the_same_by_either(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert main(["scale", "--quick", "--limit", "4", "--workers", "1", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["engine"], row["frames"], row["same"]) for row in rows] == [("local", 4, 4), ("ray", 4, 4)]
    assert all(row["own_ms"] > 0 and row["start_s"] > 0 for row in rows)
