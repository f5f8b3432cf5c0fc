"""The benchmark of conditions: split, chosen frames, size weighting, sheets, and a run on a small data set."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from detectors.registry import load_predictor
from drivesem.config.edits import WEATHER_PRESETS
from drivesem.evaluation.conditions import ConditionRow
from drivesem.reporting.drawing import write_picture
from scene_ir import files
from tools.bench import conditions
from tools.bench.__main__ import main
from tools.bench.conditions import (
    DAY,
    UNDRAWN,
    ConditionFrame,
    ConditionSets,
    DetectedFrame,
    RecallDetector,
    detect_frames,
    half_of,
    picture_sheet,
    recall_rows,
    subtract_recalls,
)
from tools.bench.settings import ConditionsConfig

FRAMES = 6
"""Frames of each condition in half B."""


def names_of(half: str, prefix: str, count: int) -> list[str]:
    names = (f"{prefix}{number:03d}" for number in range(1000))
    return [name for name in names if half_of(name) == half][:count]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Bright frames by day and dark ones at dusk in half B, and one of each in half A."""
    generator = np.random.default_rng(3)
    images, annotations = [], []
    for time, level in (("daytime", 150), ("dawn/dusk", 60)):
        for name in names_of("B", time[:3], FRAMES) + names_of("A", time[:3], 1):
            picture = generator.integers(level - 40, level + 40, (180, 320, 3)).astype(np.uint8)
            write_picture(tmp_path / "data" / "images" / f"{name}.jpg", picture)
            number = len(images) + 1
            attributes = {"weather": "clear", "timeofday": time}
            images.append(
                {
                    "id": number,
                    "file_name": f"{name}.jpg",
                    "width": 320,
                    "height": 180,
                    "attributes": attributes,
                }
            )
            for box in ([100, 80, 40, 30], [10, 90, 8, 6]):
                annotations.append(
                    {
                        "id": len(annotations) + 1,
                        "image_id": number,
                        "category_id": 1,
                        "bbox": box,
                        "area": 1,
                        "iscrowd": 0,
                    }
                )
    data = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "car"}]}
    files.write_json(tmp_path / "data" / "annotations.json", data)
    return tmp_path / "data"


def config(root: Path, **settings: object) -> ConditionsConfig:
    return ConditionsConfig(what="conditions", root=str(root), out=str(root.parent / "out"), **settings)  # pyright: ignore[reportArgumentType]


def test_halves_depend_on_the_name_alone_and_are_about_equal() -> None:
    halves = [half_of(f"frame-{number}") for number in range(400)]
    assert halves == [half_of(f"some/folder/frame-{number}") for number in range(400)]
    assert 160 < halves.count("A") < 240
    # fixed for ever: figures of half B would no longer be held out
    assert [half_of(name) for name in ("b1e1a7b8-0aec80e8", "b1e8ad72-c3c79240", "foggy-002")] == ["A", "A", "B"]


def test_drawn_frames_are_sunny_days_with_vehicles_of_the_half(root: Path) -> None:
    dusk = conditions.CONDITIONS[1]
    sets = ConditionSets(config(root))
    assert {half_of(name) for name in sets.base()} == {"B"}
    assert len(sets.base()) == FRAMES
    assert len(list(sets.real(dusk))) == FRAMES
    assert len(list(ConditionSets(config(root, half="all")).real(dusk))) == FRAMES + 1
    assert len(ConditionSets(config(root, frames=2)).base()) == 2
    assert len(list(ConditionSets(config(root, real=3)).real(dusk))) == 3
    frame = next(sets.drawn("dusk", {}))
    np.testing.assert_allclose(frame.boxes_xyxy[0], [100, 80, 139, 109], atol=1)


def test_weather_of_a_condition() -> None:
    fog = next(condition for condition in conditions.CONDITIONS if condition.name == "fog")
    assert fog.settings(full=False) == WEATHER_PRESETS["fog"]
    assert fog.settings(full=True) == {"fog": 1.0}
    assert conditions.CONDITIONS[0].settings(full=False) is None
    assert replace(fog, preset="sandstorm", code="sand").settings(full=False) is None
    assert replace(fog, preset="sandstorm", code="sand").settings(full=True) is None


def hits(condition: str, drawn: bool, heights: list[float], found: list[bool]) -> DetectedFrame:
    return DetectedFrame("net", condition, drawn, np.array(heights), np.array(found, bool))


def test_recalls_are_weighted_to_the_heights_of_dry_days() -> None:
    """Low boxes are three in four by day; of fog's boxes all low ones are missed, and all high ones found."""
    day = hits(DAY, False, [40, 40, 40, 100], [True, True, True, True])
    undrawn = hits(UNDRAWN, True, [40, 40, 100, 100], [True, True, True, True])
    fog = hits("fog", False, [40, 100, 100, 100], [False, True, True, True])
    drawn = hits("fog", True, [40, 100], [True, False])
    rows = recall_rows([day, undrawn, fog, drawn], 20, 0)
    assert [row["condition"] for row in rows] == [DAY, "fog"]
    assert (rows[0]["real"], rows[0]["drawn"]) == (100, 100)
    row = rows[1]
    assert (row["real"], row["drawn"], row["difference"]) == (25, 75, 50)
    assert (row["real_change"], row["drawn_change"], row["same_sign"]) == (-75, -25, "yes")
    assert (row["real_objects"], row["drawn_objects"]) == (4, 2)


def test_detections_of_any_vehicle_class_above_the_threshold_count_once(root: Path) -> None:
    """One good box, one of a person, one too unsure, and two on the same vehicle."""
    boxes = torch.tensor(
        [[0, 0, 49, 39], [100, 0, 149, 39], [200, 0, 249, 39], [2, 0, 49, 39]], dtype=torch.float32
    )

    def detect(image: torch.Tensor) -> dict[str, torch.Tensor]:
        scores, labels = torch.tensor([0.9, 0.9, 0.3, 0.8]), torch.tensor([1, 2, 0, 0])
        return {"boxes": boxes, "scores": scores, "labels": labels}

    predictor = load_predictor(detect, classes=("Car", "bus", "person"))
    truth = np.array([[0, 0, 49, 39], [100, 0, 149, 39], [200, 0, 249, 39], [3, 2, 52, 41], [0, 0, 9, 20]], float)
    frame = ConditionFrame("fog", False, "a", truth, lambda: np.zeros((360, 640, 3), np.uint8))
    (result,) = detect_frames(config(root), [RecallDetector("mine", predictor, 0.5, "")], [frame])
    assert result.heights.tolist() == [78, 78, 78, 78, 40]
    assert result.hits.tolist() == [True, False, False, True, False]


def test_the_interval_of_a_difference_joins_both_intervals() -> None:
    row = ConditionRow("", 9, 9, 50.0, None, None, None, 0.6, 0.5, 0.7, 1.0)
    other = replace(row, equal_recall=0.4, equal_low=0.3, equal_high=0.5)
    assert subtract_recalls(row, other) == pytest.approx((20, 20 - 14.14, 20 + 14.14), abs=0.01)
    assert subtract_recalls(replace(row, equal_low=None), other) == (20, None, None)
    assert subtract_recalls(replace(row, equal_recall=None), other) == (None, None, None)


def test_sheets_fill_rows_of_six_and_cut_other_shapes() -> None:
    wide = np.full((100, 400, 3), 90, np.uint8)
    high = np.full((400, 300, 3), 30, np.uint8)
    sheet = picture_sheet([wide, high] + [wide] * 5)
    assert sheet.shape == (2 * 270, 6 * 480, 3)
    assert [int(sheet[100, x, 0]) for x in (200, 700)] == [90, 30]
    assert sheet[300, 200, 0] == 90
    assert sheet[300, 700, 0] == 0


@pytest.mark.slow
def test_a_run_measures_draws_and_resumes(
    root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures that were drawn before are used again; other conditions have no real frames."""
    monkeypatch.setattr(ConditionSets, "scene", None)  # de-rendering would fail
    out = root.parent / "out"
    for name in names_of("B", "day", FRAMES):
        photograph = cv2.imread(str(root / "images" / f"{name}.jpg"))
        assert photograph is not None
        path = out / "drawn" / "time=1" / f"{name}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), photograph // 2)
    command = f"conditions --root {root} --out {out} --bootstrap 20 --threads 1 --json"
    assert main(command.split()) == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert result["half"] == "B"
    assert "real ones of half B" in printed.err
    assert "night: skipped, 0 real frames" in printed.err
    rows = {row["measure"]: row for row in result["rows"] if row["condition"] == "dusk"}
    brightness = rows["frame: brightness"]
    assert (brightness["real_frames"], brightness["drawn_frames"]) == (FRAMES, FRAMES)
    assert brightness["drawn_median"] == pytest.approx(75 / 255, abs=0.01)
    assert brightness["undrawn_median"] == pytest.approx(150 / 255, abs=0.01)
    assert brightness["inside"] == "no"
    assert brightness["undrawn_distance"] > brightness["distance"] > 0
    aucs = {row["pair"]: row["auc"] for row in result["probe"]}
    assert aucs["undrawn and real"] == 1
    assert {path.name for path in (out / "sheets").iterdir()} == {
        "as-photographed-drawn.jpg",
        "dusk-drawn.jpg",
        "dusk-real.jpg",
    }
    assert "(half B)" in (out / "conditions.md").read_text()
    monkeypatch.setattr(conditions, "measure_picture", None)  # measuring again would fail
    assert main(command.split()) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == result["rows"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "--root: expected the folder of BDD100K's frames, found nothing"),
        ("--root data", "--out: expected a folder for scenes, pictures and sheets, found nothing"),
        ("--root data --out a.json", "--out: expected a folder, found a.json"),
        ("--root data --out out --half C", "--half: expected"),
        ("--root data --out out --frames 0", "--frames: expected"),
        ("--root nowhere --out out", "nowhere: expected the folder of a data set"),
        ("--root data --out out --recall --detectors none", "--detectors: expected detectors (squeezedet"),
        ("--root data --out out --recall --detectors squeezedet@2", "--detectors: expected NAME@SCORE"),
        ("--root data --out out --recall --detectors squeezedet@high", "--detectors: expected NAME@SCORE"),
    ],
)
def test_refusal(
    words: str, message: str, root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(root.parent)
    assert main(["conditions", *words.split()]) == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.startswith("python -m tools.bench: ")
    assert message in line
