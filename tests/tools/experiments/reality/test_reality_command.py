"""The command `reality`: tables and plots of stored results, the order of its parts, and tables read back."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detectors.registry import load_detector
from drivesem.evaluation.curves import ClassMatches
from scene_ir import files
from tests.tools.experiments.reality.test_losses import observe
from tools.bench.conditions import DAY, UNDRAWN
from tools.experiments.__main__ import main
from tools.experiments.reality.features import ObjectFeatures
from tools.experiments.reality.observations import (
    ADVERSE,
    DRAWN,
    PLACEBO,
    PLAIN,
    REAL,
    TABLE,
    Observation,
    ObservedObject,
    read_observations,
)
from tools.experiments.reality.report import RecallAtPrecision
from tools.experiments.reality.retraining import (
    ARMS,
    DETECTIONS,
    OBJECTS,
    START,
    ArmDetection,
    RetrainTestFrame,
    find_worst,
    read_matches,
)
from tools.experiments.tables import METADATA, write_table


def write_results(folder: Path) -> None:
    """Stored tables of a detector that misses what has little contrast, and of four arms."""
    rng = np.random.default_rng(0)
    rows: list[Observation] = observe(REAL, DAY, 1, (40.0, 60.0)) + observe(PLAIN, UNDRAWN, 1, (40.0, 60.0))
    for misses, condition in enumerate(ADVERSE):
        rows += observe(REAL, condition, misses + 1, (40.0, 60.0), frames=6)
        rows += observe(DRAWN, condition, misses + 2, (40.0, 60.0)) + observe(PLACEBO, condition, 1, (40.0, 60.0))
    rows = [
        (one, replace(features, contrast=float(rng.uniform(0, 0.1) if one.missed_by else rng.uniform(0.05, 0.3))))
        for one, features in rows
    ]
    write_table(folder / TABLE.format("B"), (ObservedObject, ObjectFeatures), rows)
    rule = {"detector": "a", "objects": 3, "where": {"contrast": [0.0, 0.08]}, "placebo": {"across": [0.0, 0.4]}}
    files.write_json(folder / "rules.json", [rule, rule | {"where": {"across": [0.4, 0.6]}}])
    frames = [RetrainTestFrame(condition, f"{condition}{i}", 2) for condition in (DAY, *ADVERSE) for i in range(4)]
    write_table(folder / OBJECTS.format("a"), (RetrainTestFrame,), [(frame,) for frame in frames])
    found = [
        ArmDetection(arm, seed, frame.frame, round(0.9 - 0.01 * k, 2), k <= number)
        for number, arm in enumerate((*ARMS, START))
        for seed in range(1 if arm == START else 2)
        for frame in frames
        for k in range(2)
    ]
    write_table(folder / DETECTIONS.format("a"), (ArmDetection,), [(one,) for one in found])
    files.write_json(folder / METADATA, {"settings": {"name": "reality"}, "seconds": {}})


def test_report_of_stored_tables(tmp_path: Path, output_json: Callable[..., dict[str, Any]]) -> None:
    write_results(tmp_path / "stored")
    data = output_json("reality", "--from", tmp_path / "stored", "--out", tmp_path / "out", "--bootstrap", 50)
    value, low, high = data["agreement"]["drawn weather"]["rank_correlation"]
    assert low <= value <= high
    assert value > 0.8
    assert data["agreement"]["placebo"]["same_sign"][0] < 1
    first, second = data["lifts"]["rules"]
    assert first["low"] > 1
    assert second["low"] is None or second["low"] <= 1
    text = (tmp_path / "out" / "study.md").read_text(encoding="utf-8")
    for title in ("Losses of recall", "Rules found on dry days", "How many rules hold", "AP50 of cars"):
        assert title in text
    days, start = (data["retrained"][0]["arms"][arm]["fog"] for arm in ("days", START))
    assert (days[0], start[0]) == (
        pytest.approx(0.5, abs=0.01),
        pytest.approx(1.0),
    )  # of two cars a frame, one or both
    assert data["retrained"][0]["differences"][START]["fog"] == [0, 0, 0]
    recall = data["retrained"][1]
    assert recall["metric"] == "recall at a precision of 80%"
    assert recall["arms"]["usual"]["night"][0] == 1
    for name in ("losses", "lifts", "retraining"):
        assert (tmp_path / "out" / f"{name}.png").stat().st_size > 10_000


def test_tables_are_read_back(tmp_path: Path) -> None:
    write_results(tmp_path)
    rows = read_observations(tmp_path / TABLE.format("B"))
    assert {one.condition for one, _ in rows} == {DAY, UNDRAWN, *ADVERSE}
    matches, frames = read_matches(tmp_path, "a")
    assert len(frames) == 24
    assert {arm for arm, _ in matches} == {*ARMS, START}
    assert [int(matches[arm, 0].true_positives.sum()) for arm in ARMS] == [24, 48, 48, 48]
    assert matches["days", 0].objects.sum() == 48


def test_recall_at_a_precision_is_the_largest_where_enough_detections_are_right() -> None:
    hits = np.array([1.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0])  # precision 1, 1, 0.67, 0.75, 0.8, 0.67, 0.57, 0.63
    matches = ClassMatches(np.linspace(0.9, 0.1, 8), np.zeros(8, np.int64), hits, 1 - hits, np.array([10.0]))
    assert RecallAtPrecision(matches, "coco").value(None) == pytest.approx(0.4)


def test_the_worst_state_has_the_largest_loss(tmp_path: Path) -> None:
    files.write_json(tmp_path / "losses.json", {"a": [1.0, 3.0, 2.0], "b": [5.0, 4.0], "empty": []})
    days = [tmp_path / name for name in ("a", "b", "empty")]
    assert find_worst(days, load_detector("squeezedet"), tmp_path / "losses.json") == [1, 0, 0]


def test_half_b_stays_closed_until_rules_are_fixed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reality", "observe", "--root", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "--half: expected A, until the part rules has fixed the rules" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["report"], "--from: expected a folder, or --out"),
        (["observe", "--out", "x"], "--root: expected a folder"),
        (["retrain", "--out", "x", "--root", "y"], "--train-root: expected a folder"),
        (["attack", "--root", "x"], "--out: expected a folder"),
        (["rules", "--out", "x", "--from", "."], "--from: expected none but with report"),
    ],
)
def test_missing_settings_are_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reality", *arguments]) == 2
    assert message in capsys.readouterr().err
