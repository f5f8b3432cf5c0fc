"""Experiment `fidelity`: its fit, its measure of error, and the streets that the shipped weights were fitted to."""

import csv
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivesem.failures.fidelity import BASE_ERROR, ERROR_SCALE, ERROR_WEIGHTS, MIN_FIDELITY
from scene_ir import files
from tools.experiments.fidelity import (
    BAD_ERROR,
    MIN_PRECISION,
    OwnCar,
    choose_threshold,
    fit_weights,
    measure_error,
    measure_street,
    rank_correlation,
)

STORED = Path(__file__).parents[3] / "docs" / "data" / "fidelity" / "objects.csv"
"""What `python -m tools.experiments fidelity` measured."""


def made_up_rows(streets: int = 10, seed: int = 0) -> list[dict[str, Any]]:
    """Rows with errors of 0.01, plus 0.2 times what is completed, plus 0.1 times what is mismatched."""
    rng = np.random.default_rng(seed)
    rows = []
    for street in range(streets):
        evidence = {name: round(float(rng.random()), 4) for name in ERROR_WEIGHTS}
        error = 0.01 + 0.2 * evidence["completed"] + 0.1 * evidence["mismatched"]
        rows.append({"street": street, "state": 0, "placed_by": "labels", "object": 0, "error": error} | evidence)
    return rows


def test_fit_finds_the_weights() -> None:
    rows = made_up_rows(60)
    found = dict(zip(("base", *ERROR_WEIGHTS), fit_weights(rows), strict=True))
    expected = dict.fromkeys(ERROR_WEIGHTS, 0.0) | {"base": 0.01, "completed": 0.2, "mismatched": 0.1}
    assert found == pytest.approx(expected, abs=1e-6)
    assert rank_correlation(rows, fit_weights(rows)) == pytest.approx(1.0)
    rejected = [row for row in rows if row["error"] > choose_threshold(rows, fit_weights(rows))]
    bad = sum(row["error"] > BAD_ERROR for row in rejected)
    assert MIN_PRECISION <= bad / len(rejected) < 1


def test_reads_what_it_measured_before(tmp_path: Path, output_json: Callable[..., dict[str, Any]]) -> None:
    rows = made_up_rows(20)
    for street in range(20):
        files.write_json(tmp_path / "streets" / f"0-{street:04d}.json", [r for r in rows if r["street"] == street])
    data = output_json("fidelity", "--out", tmp_path, "--streets", 20, "--bootstrap", 10)
    assert data["objects"] == {"fitted": 10, "held_out": 10}
    assert data["rank_correlation"]["held_out"] == pytest.approx(1.0)
    assert data["weights"]["completed"] == pytest.approx(0.2, abs=1e-3)
    assert (tmp_path / "fidelity.png").is_file()


@pytest.mark.parametrize(("shift_px", "low", "high"), [(0, 0.0, 1e-6), (2, 0.02, 0.4), (8, 0.1, 0.6)])
def test_error_grows_with_a_shift(shift_px: int, low: float, high: float) -> None:
    true = np.zeros((80, 120, 3), np.float32) + 0.3
    true[20:60, 30:90] = 0.8
    true[30:40, 40:60] = 0.1
    drawn = np.roll(true, shift_px, axis=1)
    region = np.zeros((80, 120), bool)
    region[15:65, 25:100] = True
    assert low <= measure_error(true, drawn, region, 40.0) <= high


def test_own_car_is_in_front_of_the_street() -> None:
    cars = [OwnCar.draw(np.random.default_rng(seed), (60, 100)) for seed in range(20)]
    there = [bool(car.mask.any()) for car in cars]
    assert any(there)
    assert not all(there)
    car = cars[there.index(True)]
    assert car.mask[-1, 50]
    assert not car.mask[:30].any()
    picture = car.over(np.full((60, 100, 3), 255, np.uint8))
    assert (picture[~car.mask] == 1).all()
    assert (picture[car.mask] == car.colour[car.mask]).all()


def test_shipped_weights_follow_from_the_stored_streets() -> None:
    with STORED.open(newline="") as stored:
        rows: list[dict[str, Any]] = [
            {name: value if name == "placed_by" else float(value) for name, value in row.items()}
            for row in csv.DictReader(stored)
        ]
    fitted, held_out = ([row for row in rows if row["street"] % 2 == half] for half in (0, 1))
    weights = fit_weights(fitted)
    assert [BASE_ERROR, *ERROR_WEIGHTS.values()] == pytest.approx(weights.tolist(), abs=1e-4)
    threshold = choose_threshold(fitted, weights)
    assert pytest.approx(math.exp(-threshold / ERROR_SCALE), abs=0.005) == MIN_FIDELITY
    assert rank_correlation(held_out, weights) >= 0.6


@pytest.mark.slow
def test_fidelity_predicts_the_errors_of_new_streets() -> None:
    rows = [row for index in (1004, 1012, 1015) for row in measure_street(0, index)]
    assert len(rows) >= 10
    assert {row["placed_by"] for row in rows} == {"labels", "boxes"}
    assert all(0 <= row["error"] <= 1 for row in rows)
    assert rank_correlation(rows, np.array([BASE_ERROR, *ERROR_WEIGHTS.values()])) > 0.4
