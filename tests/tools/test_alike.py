"""What tools/alike.py tells of two runs: the same, another grade, another success, other frames."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tools.alike import compare, main


def changed(run: Path, place: Path, **fields: Any) -> Path:
    """A copy of a run of one frame, whose result has these fields."""
    shutil.copytree(run, place)
    path = place / "frames" / "demo-000" / "result.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))
    return place


def failure(**fields: Any) -> dict[str, Any]:
    return {"kind": "lost", "label": "Car", "xyxy": [1.0, 2.0, 3.0, 4.0], "index": 0, **fields}


def test_a_run_is_like_itself(small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(small_run), str(changed(small_run, tmp_path / "b"))]) == 0
    said = capsys.readouterr().out
    assert "theta equal in 1" in said
    assert said.endswith("0 frames differ\n")


def test_another_grade_stands_in_a_row_with_its_margin(
    small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    count = {"before": 16, "before_draws": 16, "after": 12, "after_draws": 16, "margin_after": -0.25}
    sides = [
        changed(small_run, tmp_path / grade, failures=[failure(error="missed", grade=grade, count=count)])
        for grade in ("certain", "threshold")
    ]
    assert main([str(side) for side in sides]) == 1
    said = capsys.readouterr().out
    assert "first only: by_threshold lost, kind missed, grade certain, object 0" in said
    assert "second only: by_threshold lost, kind missed, grade threshold, object 0" in said
    assert "margin_after -0.25" in said


def test_success_counts_and_scores_do_not(small_run: Path, tmp_path: Path) -> None:
    still = [
        changed(small_run, tmp_path / str(score), failures=[failure(score=score)], success_moved=True)
        for score in (0.5, 0.6)
    ]
    other = changed(small_run, tmp_path / "c", failures=[failure(score=0.5)], success_moved=False)
    assert compare([str(side) for side in still])["differing"] == []
    (row,) = compare([str(still[0]), str(other)])["differing"]
    assert [side[0] for side in row["success"]] == [True, False]
    assert row["first"] == row["second"] == []


@pytest.mark.parametrize("other", ["nowhere", "frames"])
def test_bad_input_is_exit_code_2(small_run: Path, tmp_path: Path, other: str) -> None:
    place = tmp_path / other
    if other == "frames":
        changed(small_run, place)
        (place / "frames" / "demo-000").rename(place / "frames" / "demo-001")
        path = place / "frames" / "demo-001" / "result.json"
        path.write_text(path.read_text().replace('"demo-000"', '"demo-001"'))
        manifest = place / "manifest.json"
        manifest.write_text(manifest.read_text().replace('"demo-000"', '"demo-001"'))
    assert main([str(small_run), str(place)]) == 2
