"""Experiment `realism` on hand-made runs."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivesem.run.results import dump_frame, load_frame
from scene_ir import files
from scene_ir.errors import ShapeError
from tests.drivesem.commands.conftest import write_finished_run
from tools.experiments.__main__ import main
from tools.experiments.realism.comparison import crop_window, enclosing_rectangle, vehicle_boxes
from tools.experiments.realism.metrics import MIN_SIDE_PX


@pytest.fixture
def realism(output_json: Callable[..., Any]) -> Callable[..., Any]:
    return partial(output_json, "realism", "--bootstrap", "20")


def rows_of(data: dict[str, Any], **which: object) -> list[dict[str, Any]]:
    return [row for row in data["rows"] if all(row[key] == value for key, value in which.items())]


def test_identity(tmp_path: Path, realism: Callable[..., Any]) -> None:
    data = realism(write_finished_run(tmp_path / "same", same=True), "--metrics", "psnr,ssim,perceptual,frechet")
    for row in data["rows"]:
        expected = {"psnr": None, "ssim": pytest.approx(1), "perceptual": 0, "frechet": 0}[row["metric"]]
        assert row["value"] == expected
        # draws of frames hold repetitions, and would lie farther apart than the sets
        assert row["low"] == row["high"] == (None if row["metric"] == "frechet" else expected)
    assert len(data["rows"]) == 2 * 4 * 3
    assert {row["pictures"] for row in rows_of(data, region="boxes")} == {6}


def test_metrics(tmp_path: Path, realism: Callable[..., Any]) -> None:
    runs = [
        write_finished_run(tmp_path / name, params=params) for name, params in (("one", "rotate"), ("two", "mesh"))
    ]
    data = realism(*runs, "--metrics", "psnr,ssim,perceptual,frechet", "--out", tmp_path / "out")
    assert json.loads((tmp_path / "out" / "realism.json").read_text()) == data
    assert [(one["run"], one["params"], one["frames"], one["vehicles"]) for one in data["runs"]] == [
        ("one", "rotate", 3, 6),
        ("two", "mesh", 3, 6),
    ]
    (psnr,) = rows_of(data, run="one", region="frame", metric="psnr", first="benign", second="attacked")
    errors = []
    for name in "abc":
        before, after = (
            files.read_image(runs[0] / "frames" / name / f"{file}.png").astype(float)
            for file in ("benign", "counterexample")
        )
        errors.append(np.mean((before - after) ** 2))
    assert psnr["value"] == pytest.approx(10 * np.log10(255**2 / np.mean(errors)))
    assert psnr["median"] == pytest.approx(10 * np.log10(255**2 / np.median(errors)))
    assert psnr["low"] <= psnr["value"] <= psnr["high"]
    (boxes,) = rows_of(data, run="one", region="boxes", metric="psnr", first="benign", second="attacked")
    assert boxes["value"] < psnr["value"]
    for row in rows_of(data, metric="perceptual", second="attacked"):
        assert 0 < row["low"] <= row["value"] <= row["high"]
    lines = list(csv.DictReader((tmp_path / "out" / "realism.csv").read_text().splitlines()))
    assert len(lines) == 2 * 3 * 3 * 3
    equal = [line for line in lines if line["second"] == "rerendered"]
    assert {line["psnr"] for line in equal} == {""}
    assert {float(line["ssim"]) for line in equal} == {1.0}
    # the second car stands where nothing changed, but for what the first one's rectangle shares with it
    first, second = (
        [float(x["perceptual"]) for x in lines if x["object"] == i and x["second"] == "attacked"] for i in "01"
    )
    assert min(first) > max(second)
    assert "| one | rotate | frame | PSNR, dB | inf |" in (tmp_path / "out" / "realism.md").read_text()


def test_successes_alone(realism: Callable[..., Any], run: Path) -> None:
    assert realism(run, "--metrics", "psnr", "--successes")["runs"][0]["frames"] == 2
    assert realism(run, "--metrics", "psnr", "--limit", "1")["runs"][0]["frames"] == 1


def test_a_table_for_people(capsys: pytest.CaptureFixture[str], run: Path) -> None:
    assert main(["realism", str(run), "--metrics", "ssim", "--bootstrap", "0"]) == 0
    output = capsys.readouterr()
    assert "distances between pictures" in output.out
    assert str(run / "realism") in output.err.replace("\n", "")


def test_windows() -> None:
    rows, columns = crop_window([(10, 20, 30.5, 40)], 200, 300)
    assert (rows.stop - rows.start, columns.stop - columns.start) == (MIN_SIDE_PX, MIN_SIDE_PX)
    assert rows.start <= 20 < 40 <= rows.stop
    assert columns.start == 0
    both = crop_window([(10, 20, 90, 40), (100.2, 10, 190.4, 150.6)], 200, 300)
    assert both == (slice(10, 151), slice(10, 191))
    outside = crop_window([(290, 190, 400, 300)], 200, 300)
    assert outside == (slice(200 - MIN_SIDE_PX, 200), slice(300 - MIN_SIDE_PX, 300))
    with pytest.raises(ShapeError, match="at least 64 px"):
        crop_window([(0, 0, 1, 1)], 63, 300)


def test_the_window_of_a_vehicle_that_left_or_parked_is_where_it_is_seen(
    realism: Callable[..., Any], run: Path
) -> None:
    nowhere, box = (0.0, 0.0, 0.0, 0.0), (210.0, 120.0, 290.0, 190.0)
    assert (
        crop_window([box, nowhere], 200, 300)
        == crop_window([nowhere, box], 200, 300)
        == crop_window([box], 200, 300)
    )
    assert enclosing_rectangle([nowhere, box]) == box
    path = run / "frames" / "a" / "result.json"
    result = load_frame(path)
    benign, moved = result.targets_benign, result.targets_moved
    left = (replace(moved[0], xyxy=nowhere, ignore=True), moved[1])
    files.write_text(path, dump_frame(replace(result, targets_moved=left)))
    assert vehicle_boxes(load_frame(path)) == list(zip(benign, left, strict=True))
    assert realism(run, "--metrics", "ssim")["runs"][0]["vehicles"] == 6
    never = (replace(benign[0], xyxy=nowhere, ignore=True), benign[1])
    files.write_text(path, dump_frame(replace(result, targets_benign=never, targets_moved=left)))
    assert realism(run, "--metrics", "ssim")["runs"][0]["vehicles"] == 5
