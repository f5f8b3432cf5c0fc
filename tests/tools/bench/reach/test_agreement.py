"""Rows of the table: cosines, signs, what is kept, bands of distance."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tools.bench.reach.agreement import ALL, ReachRow, compare_slopes, reach_rows
from tools.bench.reach.report import build_reach_report
from tools.bench.reach.slopes import STEPS, ProbeSlopes

ONE = ProbeSlopes(
    0,
    10.0,
    "rotate",
    "yaw",
    point=((1.0, 3.0),) * 3,
    smoothed=((0.0, 1.0),) * 3,
    wide=((2.0, 2.0), (1.0, 1.0), (-1.0, -3.0)),
)
FAR = replace(
    ONE, object=1, distance_m=40.0, point=((-1.0, -1.0),) * 3, wide=((1.0, 1.0), (None, None), (-2.0, 2.0))
)


def rows() -> dict[tuple[str, int], ReachRow]:
    return {(row.distance, row.steps): row for row in reach_rows([[ONE, FAR]], 0)}


def test_what_one_list_tells_of_another() -> None:
    slopes, by, owner = np.array([1.0, 2.0, -1.0, 0.5]), np.array([2.0, 4.0, 1.0, 1.0]), np.array([0, 0, 1, 2])
    one = compare_slopes(slopes, by, owner, 0)
    assert one.cosine == pytest.approx(9.5 / np.sqrt(6.25 * 22))
    assert one.signs == 0.75
    assert one.realised == pytest.approx(9.5 / 22)
    assert one.low is not None
    assert one.high is not None
    assert one.low <= one.cosine <= one.high
    assert compare_slopes(slopes, by, np.array([0, 0, 1, 1]), 0).low is None, "two objects have no interval"


def test_noise_in_slopes_lowers_the_cosine_and_not_what_is_kept() -> None:
    generator = np.random.default_rng(0)
    by = generator.standard_normal(4000)
    noisy = compare_slopes(0.5 * by + 2 * generator.standard_normal(4000), by, np.arange(4000), 0)
    assert noisy.cosine < 0.3
    assert noisy.realised == pytest.approx(0.5, abs=0.1)


def test_objects_stand_in_their_band_and_in_all() -> None:
    found = rows()
    assert (found[ALL, 1].objects, found[ALL, 1].slopes) == (2, 2)
    assert found["under 15 m", 1].point.cosine == pytest.approx(1)
    assert found["over 30 m", 1].point.cosine == pytest.approx(-1)
    assert found["under 15 m", 16].point.cosine == pytest.approx(-1)
    assert found[ALL, 1].point.signs == 0.5
    assert ("15 to 30 m", 1) not in found


def test_an_answer_has_tables_and_a_picture(tmp_path: Path) -> None:
    answer = build_reach_report(tmp_path, list(rows().values()), {"settings": {}}, {})
    answer.write()
    assert len(json.loads((tmp_path / "reach.json").read_text())["rows"]) == len(rows())
    assert (tmp_path / "reach.png").stat().st_size > 5000
    heading, *lines = (tmp_path / "reach.csv").read_text().splitlines()
    assert len(lines) == len(rows())
    assert "point_cosine" in heading
    everywhere, by_distance = answer.tables
    assert [row[2] for row in everywhere.rows] == [str(steps) for steps in STEPS]
    assert [row[1] for row in by_distance.rows] == [str(steps) for steps in STEPS]
    assert by_distance.rows[1][-2:] == ("-", "-")
