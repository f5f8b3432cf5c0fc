"""Arms of the study `retrain`, their frames and pictures."""

import io
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from detectors.registry import load_detector, read_weights
from drivesem.config.commands import RetrainConfig
from drivesem.config.errors import UsageError
from drivesem.config.parsing import parse
from drivesem.data import kitti
from drivesem.data.kitti import KittiWriter
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.run.results import dump_frame
from drivesem.training.frames import AttackedFrame, TrainingMixture
from scene_ir import files
from scene_ir.errors import SceneError
from scene_ir.io import SCHEMA, VERSION
from scene_ir.types import Labels
from tests.tools.experiments.detection.conftest import frame
from tools.experiments.detection import retraining_arms
from tools.experiments.detection.retraining import prepare_retraining
from tools.experiments.detection.retraining_arms import (
    OURS,
    RETRAINING_ARMS,
    FrameDivision,
    RetrainingArm,
    TrainingPictures,
    benign_samples,
    build_retraining_arms,
    divide_frames,
    placebo_attack,
    train_arm,
    training_attack,
    validation_frames,
    weights_path,
)
from tools.experiments.settings import StudyConfig

PRESETS = Path(__file__).parents[4] / "configs"
OUT = Path("out")
COLOURS = {"benign": 10, "rerender": 20, "counterexample": 30}
"""Grey value of a frame's pictures."""
QUIET = Console(file=io.StringIO())
WORKER: Any = None
"""Who attacked: nobody asks."""


def labelled(x: float, kind: str = "Car") -> Labels:
    return Labels(
        kind=(kind,),
        boxes_xyxy=torch.tensor([[x, 10.0, x + 40, 46.0]]),
        truncation=torch.zeros(1),
        occlusion=torch.zeros(1, dtype=torch.int64),
        translation=torch.tensor([[0.0, 1.6, 20.0]]),
        yaw=torch.zeros(1),
        size_lhw=torch.tensor([[4.0, 1.5, 1.7]]),
        ignore_xyxy=torch.zeros(0, 4),
    )


@pytest.fixture
def attacked(tmp_path: Path) -> list[AttackedFrame]:
    """Three frames: the first is not broken. Cars are at 10 by the benign labels, at 20 by moved ones."""
    found = []
    for i in range(3):
        one = AttackedFrame(tmp_path / "run", f"{i}")
        folder = one.folder
        for name, value in COLOURS.items():
            files.write_png(folder / f"{name}.png", np.full((60, 90, 3), value + i, np.uint8))
        kitti.write_labels(folder / "labels_paper.txt", labelled(10.0))
        kitti.write_labels(folder / "labels_moved.txt", labelled(20.0))
        files.write_json(folder / "scene" / "scene.json", {"schema": SCHEMA, "version": VERSION, "others": None})
        files.write_text(folder / "result.json", dump_frame(frame(f"{i}", success=i > 0)))
        found.append(one)
    return found


def kitti_folder(root: Path, count: int, kind: str = "Car") -> Path:
    writer = KittiWriter(root)
    projection = torch.tensor([[700.0, 0, 60, 0], [0, 700, 40, 0], [0, 0, 1, 0]])
    for i in range(count):
        writer.write_photograph(f"{i:06d}", np.full((60, 90, 3), i, np.uint8), labelled(10.0, kind), projection)
    return root


def test_ours_is_the_preset() -> None:
    assert parse(["retrain", "--run", "", "--config", str(PRESETS / "retrain-mixed.yaml")]) == replace(
        OURS, loss="quality"
    )
    paper = build_retraining_arms(StudyConfig(name="retrain"))[-1]
    assert parse(["retrain", "--run", "", "--config", str(PRESETS / "retrain-paper.yaml")]) == paper.config


def test_arms_differ_in_their_pictures_alone() -> None:
    study = StudyConfig(name="retrain", arms=",".join(RETRAINING_ARMS), seeds=2, consistency=0.5)
    lessons = build_retraining_arms(study)
    alike = {replace(one.config, seed=0) for one in lessons if one.arm != "paper"}
    assert len(alike) == 1
    assert {one.arm: one.weight for one in lessons if one.weight} == {"consistent": 0.5, "worst": 0.5}
    seeds = {arm: [one.config.seed for one in lessons if one.arm == arm] for arm in RETRAINING_ARMS}
    assert seeds == {
        arm: [0, 1] if arm in ("benign", "random", "certain", "consistent", "worst") else [0]
        for arm in RETRAINING_ARMS
    }
    assert len({one.folder for one in lessons}) == len({one.name for one in lessons}) == len(lessons)
    assert {one.arm: one.labels for one in lessons} == {
        **dict.fromkeys(("random", "generator", "ours", "certain", "consistent", "worst"), "moved"),
        **dict.fromkeys(("benign", "re-rendered", "paper"), "benign"),
    }
    assert [one.arm for one in build_retraining_arms(replace(study, arms="certain, benign", seeds=1))] == [
        "benign",
        "certain",
    ]
    with pytest.raises(UsageError, match=r"--arms: expected some of benign, re-rendered, .* found 'certian'"):
        build_retraining_arms(replace(study, arms="certian"))


def test_what_is_attacked_to_train_on() -> None:
    usual = training_attack(StudyConfig(name="retrain"))
    assert (usual.folder, usual.config.combo, usual.config.passes) == ("combo-2", 2, None)
    arm = training_attack(StudyConfig(name="retrain", params="weather,rotate", method="climb", passes=40, limit=3))
    assert (arm.config.params, arm.config.combo, arm.config.method, arm.config.passes) == (
        *("weather,rotate", None, "climb", 40),
    )
    placebo = placebo_attack(arm, Path("out"))
    assert (placebo.config.method, placebo.config.like) == ("placebo", "out/arms/attacked")
    assert (placebo.config.params, placebo.config.passes, placebo.config.limit) == ("weather,rotate", None, 3)


def test_held_out_frames_are_never_trained_on(tmp_path: Path) -> None:
    root = kitti_folder(tmp_path / "all", 8)
    study = StudyConfig(name="retrain", dataset="kitti", root=str(root))
    parts = divide_frames(study)
    assert parts.training is not None
    assert parts.test is not None
    assert (len(parts.training), len(parts.test)) == (6, 2)
    assert not set(parts.training) & set(parts.test)
    assert parts.benign_training is not None
    assert parts.benign_training[1] == parts.training
    assert parts.benign_test is not None
    assert parts.benign_test[1] == parts.test
    assert divide_frames(replace(study, seed=1)).test != parts.test

    further = kitti_folder(tmp_path / "further", 3)
    own = divide_frames(replace(study, held_out=str(further), benign_frames=2))
    assert (own.training, own.test) == (None, None)
    assert own.benign_test is not None
    assert own.benign_test[1] == ("000000", "000001")
    assert own.benign_training is not None
    assert len(own.benign_training[1]) == 8
    quick = divide_frames(replace(study, quick=True))
    assert quick.benign_training is None, "the attacked frames' own photographs"


def test_too_few_frames(tmp_path: Path) -> None:
    one = kitti_folder(tmp_path / "one", 1)
    study = StudyConfig(name="retrain", dataset="kitti", root=str(one))
    with pytest.raises(UsageError, match=r"--root: expected at least 2 frames, .* found 1"):
        divide_frames(study)
    none = tmp_path / "none"
    categories = '{"images": [], "annotations": [], "categories": [{"id": 1, "name": "car"}]}'
    files.write_text(none / "annotations" / "instances_none.json", categories)
    other = tmp_path / "other"
    shutil.copytree(none, other)
    coco = replace(study, dataset="coco", root=str(other), held_out=str(none))
    with pytest.raises(UsageError, match="--held-out: expected at least one frame, found none"):
        divide_frames(coco)


@pytest.mark.parametrize("setting", ["root", "benign_root"])
def test_what_is_trained_on_is_not_held_out(setting: str, tmp_path: Path) -> None:
    folders = {name: str(kitti_folder(tmp_path / name, 3)) for name in ("root", "benign_root", "held_out")}
    study = StudyConfig(name="retrain", dataset="kitti", **folders)  # pyright: ignore[reportArgumentType]
    assert divide_frames(study).benign_test is not None
    with pytest.raises(UsageError, match="--held-out: expected a folder that is not trained on"):
        divide_frames(replace(study, held_out=str(Path(folders[setting], "..", setting))))


def test_frames_without_vehicles_show_before_anything_is_done(tmp_path: Path) -> None:
    root, empty = kitti_folder(tmp_path / "root", 2), kitti_folder(tmp_path / "empty", 2, "Pedestrian")
    study = StudyConfig(name="retrain", dataset="kitti", root=str(root), held_out=str(empty))
    with pytest.raises(UsageError, match="--held-out: expected frames with vehicles, found none"):
        prepare_retraining(study, OUT)
    with pytest.raises(UsageError, match="--root: expected frames with vehicles, found none"):
        prepare_retraining(replace(study, root=str(empty), held_out=str(root)), OUT)
    ready = prepare_retraining(replace(study, held_out=str(kitti_folder(tmp_path / "held_out", 1))), OUT)
    assert [arm.folder for arm in ready.attacks] == ["combo-2"]
    assert list(ready.workers[0].source.identifiers()) == ["000000", "000001"]


@pytest.fixture
def given_frames(monkeypatch: pytest.MonkeyPatch) -> list[TrainingMixture]:
    """What each training was given, in the place of the training."""
    found: list[TrainingMixture] = []

    def train(config: RetrainConfig, detector: object, frames: TrainingMixture, *_: object) -> None:
        found.append(frames)

    monkeypatch.setattr(retraining_arms, "fine_tune", train)
    return found


def lesson(kind: int | str, **settings: object) -> RetrainingArm:
    arms, place = (kind, 0) if isinstance(kind, str) else (None, kind)
    one = build_retraining_arms(StudyConfig(name="retrain", train_steps=2, arms=arms))[place]
    return replace(one, config=replace(one.config, **settings))


def taught(one: RetrainingArm, attacked: list[AttackedFrame], folder: Path) -> Path:
    study = StudyConfig(name="retrain")

    def benign(classes: Sequence[str]) -> Sequence[object]:
        return benign_samples(FrameDivision(None, None, None, None), attacked, classes, folder)

    taken = TrainingPictures(
        attacked, attacked[1:], WORKER, SecondRenderers("demo", None), folder / "pool", 0, 0.5
    )
    train_arm(study, one, taken, benign, weights_path(folder, one), QUIET)  # pyright: ignore[reportArgumentType]
    return weights_path(folder, one)


def pictures(mixture: TrainingMixture) -> set[tuple[int, float]]:
    """Grey value and left border of the first object, of each entry."""
    return {(int(image[0, 0, 0]), float(targets.boxes_xyxy[0, 0])) for image, targets in mixture}


@pytest.mark.parametrize(
    ("kind", "settings", "expected"),
    [
        (0, {}, {(21, 10.0), (22, 10.0)}),
        (1, {}, {(31, 20.0), (32, 20.0)}),
        (1, {"label_mode": "paper"}, {(31, 10.0), (32, 10.0)}),
        (0, {"label_mode": "paper"}, {(21, 10.0), (22, 10.0)}),
        ("benign", {}, {(11, 10.0), (12, 10.0)}),
        ("random", {}, {(31, 20.0), (32, 20.0)}),
    ],
    ids=["re-rendered", "moved", "paper", "re-rendered, paper", "benign", "random"],
)
def test_what_is_given(
    kind: int | str,
    settings: dict[str, object],
    expected: set[tuple[int, float]],
    attacked: list[AttackedFrame],
    given_frames: list[TrainingMixture],
    tmp_path: Path,
) -> None:
    """Benign photographs of all frames, and of those that broke the detector what the lesson is about."""
    taught(lesson(kind, fraction=0.5, **settings), attacked, tmp_path / "out")
    assert pictures(given_frames[0]) == {(10, 10.0), (11, 10.0), (12, 10.0)} | expected


def test_what_is_learned_is_not_learned_twice(
    attacked: list[AttackedFrame], given_frames: list[TrainingMixture], tmp_path: Path
) -> None:
    weights = taught(lesson(1), attacked, tmp_path)
    facts, _ = read_weights(weights)
    assert (facts["retrained_from"], facts["steps"]) == ("squeezedet", "2")
    assert load_detector(weights).name == "squeezedet"
    before = weights.stat().st_mtime_ns
    assert taught(lesson(1), attacked, tmp_path) == weights
    assert (len(given_frames), weights.stat().st_mtime_ns) == (1, before)


def test_lessons_that_cannot_be_held_state_why(attacked: list[AttackedFrame], tmp_path: Path) -> None:
    """No failure of these frames is certain, and no generator made them."""
    taken = TrainingPictures(attacked, attacked, WORKER, SecondRenderers("kitti", str(tmp_path)), tmp_path, 0, 0.5)
    reasons = {
        one.arm: taken.missing(one)
        for one in build_retraining_arms(StudyConfig(name="retrain", arms=",".join(RETRAINING_ARMS)))
    }
    none = "no attacked frame has a certain failure of an object"
    assert reasons == {
        **dict.fromkeys(RETRAINING_ARMS),
        **dict.fromkeys(("certain", "consistent", "worst"), none),
        "generator": "no generator made these frames",
    }


def test_validation_is_neither_trained_on_nor_judged_by(tmp_path: Path) -> None:
    folders = {name: str(kitti_folder(tmp_path / name, 3)) for name in ("root", "held_out", "validation")}
    study = StudyConfig(name="retrain", dataset="kitti", **folders)  # pyright: ignore[reportArgumentType]
    assert divide_frames(study).benign_test is not None
    store = validation_frames(study, ("Car",), tmp_path)
    assert store is not None
    assert len(store) == 3
    assert validation_frames(replace(study, validation=None), ("Car",), tmp_path) is None
    for name in ("root", "held_out"):
        with pytest.raises(UsageError, match="--validation: expected a folder that is neither"):
            divide_frames(replace(study, validation=folders[name]))
    with pytest.raises(SceneError, match="nowhere"):
        divide_frames(replace(study, validation=str(tmp_path / "nowhere")))


def test_without_counterexamples_there_is_nothing_to_learn(attacked: list[AttackedFrame], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--limit: expected counterexamples .* by moved labels, found none"):
        taught(lesson(1), attacked[:1], tmp_path)
