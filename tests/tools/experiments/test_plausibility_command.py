"""Experiment `plausibility` on the folder of a run."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from drivesem.config.commands import AttackConfig
from drivesem.config.options import to_yaml
from drivesem.data.kitti import write_labels
from drivesem.run.results import SCHEMA, Coordinate, FrameResult, dump_frame
from scene_ir import files
from scene_ir.types import Labels
from tools.experiments.__main__ import main

YAW, TURNED = -1.57, 0.8


def labels(yaw: float, *depths_m: float) -> Labels:
    count = len(depths_m)
    return Labels(
        kind=("Car",) * count,
        boxes_xyxy=torch.tensor([[10.0, 10, 60, 40]]).repeat(count, 1),
        truncation=torch.zeros(count),
        occlusion=torch.zeros(count, dtype=torch.int64),
        translation=torch.tensor([[-2.0, 1.65, depth] for depth in depths_m]).reshape(-1, 3),
        yaw=torch.full((count,), yaw),
        size_lhw=torch.tensor([[4.2, 1.5, 1.65]]).repeat(count, 1),
        ignore_xyxy=torch.zeros(0, 4),
    )


def result(name: str) -> FrameResult:
    nothing = dict.fromkeys(FrameResult.__dataclass_fields__, ())
    facts = {
        "identifier": name,
        "objects": 1,
        "queries": 1,
        "success_paper": False,
        "success_moved": False,
        "identity_psnr_db": None,
        "seconds": 0.0,
        "checked_by": "outlines",
        "min_contrast": 0.0,
        "joint_weather": False,
        "passes": None,
        "change": "",
    }
    return FrameResult(**nothing | facts)  # pyright: ignore[reportArgumentType]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Two frames: in the first, two cars that turn; in the second, one alone that stays."""
    folder = tmp_path / "run"
    frames = {"a": (labels(YAW, 20, 30), labels(TURNED, 20, 30)), "b": (labels(YAW, 25), labels(YAW, 25))}
    files.write_text(folder / "config.yaml", to_yaml(AttackConfig(out=str(folder))))
    files.write_json(folder / "metrics.json", {"schema": SCHEMA, "params": ["rotate"], "t_star": 0.5})
    files.write_json(folder / "manifest.json", {"frames": {name: {} for name in frames}})
    for name, (before, after) in frames.items():
        part = folder / "frames" / name
        write_labels(part / "labels_paper.txt", before)
        write_labels(part / "labels_moved.txt", after)
        files.write_text(part / "result.json", dump_frame(result(name)))
        for picture in ("benign.png", "rerender.png", "counterexample.png"):
            files.write_png(part / picture, np.zeros((4, 4, 3), np.uint8))
    return folder


def test_before_and_after(run: Path, output_json: Callable[..., Any]) -> None:
    data = output_json("plausibility", "--run", run)
    out = run / "plausibility"
    assert json.loads((out / "plausibility.json").read_text()) == data
    rows = {row["name"]: row for row in data["rows"]}
    assert rows["yaw_rad"]["vehicles"] == rows["depth_m"]["vehicles"] == 3
    assert rows["spacing_m"]["vehicles"] == 2
    assert rows["depth_m"]["largest_fall"] == 0.0
    assert rows["yaw_rad"]["median_before"] > 90 > 5 > rows["yaw_rad"]["median_after"]
    assert (rows["yaw_rad"]["unusual_before"], rows["yaw_rad"]["unusual_after"]) == (0.0, pytest.approx(2 / 3))
    one, two = data["by_frame"]
    assert one["before"] > 5 > one["after"]
    assert two["before"] == two["after"]
    assert (one["weather"], data["weather_beyond"]) == (None, [])
    cars = list(csv.DictReader((out / "plausibility.csv").read_text().splitlines()))
    assert [(car["frame"], car["object"]) for car in cars] == [("a", "0"), ("a", "1"), ("b", "0")]
    assert cars[2]["spacing_m_before"] == ""
    assert float(cars[0]["lowest_after"]) == float(cars[0]["yaw_rad_after"])
    assert "| yaw_rad | 3 |" in (out / "plausibility.md").read_text()


def test_a_table_for_people(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plausibility", "--run", str(run), "--limit", "1", "--out", str(tmp_path / "p")]) == 0
    assert "1 frame: percentiles by KITTI's labels" in capsys.readouterr().out
    assert len((tmp_path / "p" / "plausibility.csv").read_text().splitlines()) == 3


def test_weather_and_what_of_it_comes_together(run: Path, output_json: Callable[..., Any]) -> None:
    codes = {"weather.fog": 0.75, "weather.rain": 0.75, "weather.time_of_day": 0.0, "weather.overcast": 0.5}
    theta = tuple(Coordinate(name, "code", value, 0.0, 1.0, "") for name, value in codes.items())
    files.write_text(run / "frames" / "a" / "result.json", dump_frame(replace(result("a"), theta=theta)))
    data = output_json("plausibility", "--run", run)
    assert [frame["weather"] for frame in data["by_frame"]] == [1.5, None]
    assert data["weather_beyond"] == ["a"]
    written = (run / "plausibility" / "plausibility.md").read_text()
    assert "| a | 0.75 | 0.75 | 0.00 | 0.50 | 0.00 | 0.00 | 150.0 | fog in rain or snow |" in written


def test_a_bad_folder_or_labels_that_do_not_fit_are_refused(
    run: Path, refused: Callable[..., str], tmp_path: Path
) -> None:
    out = ["--out", str(run / "metrics.json")]
    assert "--out: expected a folder" in refused("plausibility", "--run", str(run), *out)
    (tmp_path / "empty").rmdir()
    write_labels(run / "frames" / "a" / "labels_moved.txt", labels(YAW, 20))
    assert "expected the 2 vehicles of labels_paper.txt, found 1" in refused("plausibility", "--run", str(run))
    (tmp_path / "empty").rmdir()
    for name, side in product("ab", ("paper", "moved")):
        write_labels(run / "frames" / name / f"labels_{side}.txt", labels(YAW))
    assert "a run with vehicles" in refused("plausibility", "--run", str(run))
