"""Failing cells of runs on the same frames."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivesem.failures.feature_cells import Cell, CellVisit
from tools import failing_cells
from tools.failing_cells import compare, find_failing_cells, main

DARK, BRIGHT = (0, 0, 0, 0), (0, 0, 0, 1)


def frame(name: str, *lost: Cell, passes: int = 50) -> Any:
    """A frame whose objects are lost for certain in these cells."""
    visits = [CellVisit(index, cell, passes, 1, final=True) for index, cell in enumerate(lost)]
    failures = [SimpleNamespace(index=index, error="missed", grade="certain") for index in range(len(lost))]
    return SimpleNamespace(
        identifier=name,
        visits=visits,
        failures=failures,
        judged=(0,),
        found_before=(0, 1),
        passes=passes,
        seconds=30.0,
    )


def test_cells_count_once_however_many_objects_are_lost_in_them() -> None:
    count, metrics = find_failing_cells([frame("a", DARK, DARK), frame("b", DARK, BRIGHT), frame("c")])
    assert count == 2
    per_pass, certain, per_minute = (metric.value() for metric in metrics)
    assert per_pass == pytest.approx(2 / 0.150)
    assert certain == pytest.approx(4 / 0.150)
    assert per_minute == pytest.approx(2 / 1.5)
    only_first = metrics[0].value(np.array([3.0, 0.0, 0.0]))
    assert only_first == pytest.approx(3 * 2 / 3 / 0.150), "a third of the dark cell for each object"


def test_runs_are_compared_on_the_frames_that_all_have(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = {
        "one": [frame("a", DARK, passes=10), frame("b", BRIGHT, passes=10), frame("d", DARK)],
        "two": [frame("a", DARK), frame("b"), frame("c", BRIGHT)],
    }
    loaded = [
        SimpleNamespace(name=name, frames=[SimpleNamespace(result=result) for result in results])
        for name, results in runs.items()
    ]
    monkeypatch.setattr(failing_cells, "load_runs", lambda folders, setting: loaded)
    first, second = compare(["one", "two"])
    assert first[:6] == ("one", "2", "4", "2", "2", "20")
    assert second[:6] == ("two", "2", "4", "1", "1", "100")
    assert first[6].startswith("100.0 [")
    assert first[-1] == ""
    assert second[-1].startswith("90.0 [")


def test_a_folder_that_is_no_run_ends_with_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([str(tmp_path)])
    assert end.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
