"""What bench people counts, with detectors that answer in turn, and its pictures against the generator's."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from detectors.boxes import iou_matrix
from drivesem.attacks.budgets import PRESETS
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.space import ParameterSpace
from drivesem.cli import main as drivesem
from scene_ir.types import SceneIR
from tests.drivesem.generated_people import derender_generated_people
from tests.tools.bench.test_bench_found import Rows, Told
from tools.bench import people
from tools.bench.__main__ import main
from tools.bench.found import LOOSE_IOU
from tools.bench.settings import BenchTool

CLASSES = ("Car", "Pedestrian")


@pytest.fixture(scope="module")
def scene() -> SceneIR:
    return derender_generated_people()


def answers_of(boxes: torch.Tensor) -> Rows:
    return [(box, 1, 0.9) for box in boxes.tolist()]


def test_what_is_counted(scene: SceneIR, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    rows = scene.objects.upright.nonzero()[:, 0].tolist()
    boxes = scene.objects.box2d[rows]
    moves, rng = people.PeopleMoves(scene), np.random.default_rng(7)
    answers: list[Rows] = [answers_of(boxes)]
    answers.append(answers_of(boxes[:1]))  # the first one leaves a person behind
    steps: dict[tuple[int, float], people.PeopleMove] = {}
    away = 0
    for row in rows:
        for metres in people.MOVES_M:
            step = moves.first_feasible(row, metres, rng)
            if step is not None:
                steps[row, metres] = step
                missed = (row, metres) == (rows[0], 0.5)
                place = rows.index(row)
                apart = float(iou_matrix(step.boxes_xyxy[row][None], boxes[place][None])) < LOOSE_IOU
                away += apart
                leaves = boxes[place : place + 1] if apart and place == 0 else boxes[:0]
                answers.append([] if missed else answers_of(torch.cat([step.boxes_xyxy[rows], leaves])))
    detector = Told(answers)
    detector.classes = CLASSES  # type: ignore[assignment]
    monkeypatch.setattr(people, "load_predictor", lambda *_: detector)
    judge = people.PeopleJudge(BenchTool(dataset="kitti", root=str(tmp_path)), tmp_path)
    found = judge.judge("a", scene, np.random.default_rng(7))
    assert detector.answers == []
    assert {(row.row, move.metres): move.shift_m for row in found for move in row.moves} == {
        key: step.shift_m for key, step in steps.items()
    }
    lines = {line["measure"]: (line["found"], line["people"]) for line in people.summary(found)}
    assert lines["frames, exact without a change"] == (1, 1)
    assert lines["in the photograph"] == (len(rows), len(rows))
    left = sum(move.left is not None for move in found[0].moves)
    assert left > 0
    assert lines["moved away, found where they were"] == (left, away)
    assert lines["removed"] == (1, len(rows))
    for metres in people.MOVES_M:
        moved = sum(key[1] == metres for key in steps)
        assert lines[f"moved {metres:g} m"] == (moved - (metres == 0.5), moved)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names[left:] == ["moved-0.5-a-0.png", "removed-a-0.png"]
    assert all(name.startswith("left-") for name in names[:left])


def test_moves_are_feasible_and_of_their_length(scene: SceneIR) -> None:
    moves, space = people.PeopleMoves(scene), ParameterSpace(scene, ("translate",), PRESETS["street"])
    row = int(scene.objects.upright.nonzero()[0, 0])
    directions: set[tuple[float, float]] = set()
    for seed in range(6):
        step = moves.first_feasible(row, 0.5, np.random.default_rng(seed))
        assert step is not None
        directions.add(step.shift_m)
        apart = (step.scene.objects.translation - scene.objects.translation).norm(dim=1)
        assert apart[row].item() == pytest.approx(0.5, abs=1e-4)
        assert float(apart.sum()) == pytest.approx(0.5, abs=1e-4)
        theta = space.theta0.clone()
        theta[2 * row : 2 * row + 2] = torch.tensor(step.shift_m) / scene.objects.size_lhw[row, 0]
        assert FeasibleSet(space).violations(theta) == ()
    assert len(directions) > 1
    assert moves.first_feasible(row, 2.5, np.random.default_rng(0)) is None


def test_a_pasted_box_stands_where_the_new_one_does() -> None:
    picture = np.zeros((20, 30, 3), np.uint8)
    picture[5:11, 4:8] = 200
    pasted = people.paste(picture, np.array([4, 5, 7, 10]), np.array([24, 8, 29, 14]))
    assert pasted[9:15, 25:29].min() == 200
    assert int((pasted[..., 0] > 0).sum()) == 2 * 24
    cut = people.paste(picture, np.array([4, 5, 7, 10]), np.array([28, 8, 31, 14]))
    assert cut[9:15, 28:].min() == 200


@pytest.mark.slow
def test_the_command_compares_with_the_generator(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    streets = tmp_path / "streets"
    words = [
        "synth",
        "--layout",
        "kitti",
        "--frames",
        "1",
        "--split",
        "heldout",
        "--variations",
        "clone",
        "--seed",
        "5",
    ]
    assert drivesem([*words, "--out", str(streets), "--workers", "1"]) == 0
    capsys.readouterr()
    detector = Told([[]] * 50)
    detector.classes = CLASSES  # type: ignore[assignment]
    monkeypatch.setattr(people, "load_predictor", lambda *_: detector)
    assert main(["people", "--dataset", "kitti", "--root", str(streets), "--json"]) == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert {row["frame"] for row in result["rows"]} == {"000000"}
    assert all(row["exact"] for row in result["rows"])
    *moved, removed = result["generator"]
    assert [line["move"] for line in moved] == ["0.5 m", "1 m", "2 m"]
    assert removed["move"] == "removed"
    assert 0 < removed["ours"] < max(line["pasted"] for line in moved)
    for line in moved:
        assert line["ours"] < line["pasted"]
        assert line["nearer"] > line["people"] / 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["people"], "--dataset: expected a data set with people, found demo"),
        (["found", "--where", "weather=rainy"], "--where: expected the benchmark people"),
        (["people", "--dataset", "kitti", "--root", "none"], "none"),
    ],
)
def test_wrong_options_are_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.strip().count("\n") == 0
