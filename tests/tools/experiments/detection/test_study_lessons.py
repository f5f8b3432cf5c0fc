"""What `drivesem study retrain` trains, on which frames, and when it does not."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from detectors.registry import load_detector, read_weights
from drivesem.config.commands import Retrain, Study
from drivesem.config.errors import UsageError
from drivesem.config.parsing import parse
from drivesem.data import kitti
from drivesem.data.kitti import KittiWriter
from drivesem.failures.second_renderer.choose import SecondRenderers
from drivesem.run.results import dump_frame
from drivesem.training.attacked import AttackedFrame
from drivesem.training.mixture import Mixture
from scene_ir import files
from scene_ir.errors import SceneError
from scene_ir.io import SCHEMA, VERSION
from scene_ir.types import Labels
from tools.experiments.detection import lessons, retrain
from tools.experiments.detection.lessons import (
    OURS,
    REPEATED,
    TAUGHT,
    Among,
    Lesson,
    Taken,
    learn,
    learning_arm,
    lessons_of,
    parts_of,
    placebo_arm,
    weights_of,
)

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
def attacked(frame: Callable[..., object], tmp_path: Path) -> list[AttackedFrame]:
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
    paper = lessons_of(Study(name="retrain"))[-1]
    assert parse(["retrain", "--run", "", "--config", str(PRESETS / "retrain-paper.yaml")]) == paper.config


def test_the_ablation_differs_in_its_pictures_alone() -> None:
    for study in (Study(name="retrain", quick=True), Study(name="retrain", train_steps=7, mix="replace")):
        ablation, ours, *further = lessons_of(study)
        assert (ablation.pictures, ours.pictures) == ("rerender", "counterexample")
        assert ablation.config == ours.config
        assert len(further) == (not study.quick)
        if study.train_steps is not None:
            assert {lesson.config.steps for lesson in (ours, *further)} == {7}
            assert (ours.config.mix, further[0].config.mix) == ("replace", "replace")
    assert lessons_of(Study(name="retrain"))[1].config.mix == "add"


def test_arms_differ_in_their_pictures_alone() -> None:
    study = Study(name="retrain", arms=",".join(TAUGHT), seeds=2, consistency=0.5)
    lessons = lessons_of(study)
    alike = {replace(one.config, seed=0) for one in lessons if one.arm != "paper"}
    assert len(alike) == 1
    assert {one.arm: one.weight for one in lessons if one.weight} == {"consistent": 0.5, "worst": 0.5}
    seeds = {arm: [one.config.seed for one in lessons if one.arm == arm] for arm in TAUGHT}
    assert seeds == {arm: [0, 1] if arm in REPEATED else [0] for arm in TAUGHT}
    assert len({one.folder for one in lessons}) == len({one.name for one in lessons}) == len(lessons)
    assert {one.arm: one.labels for one in lessons} == {
        **dict.fromkeys(("random", "generator", "ours", "certain", "consistent", "worst"), "moved"),
        **dict.fromkeys(("benign", "re-rendered", "paper"), "benign"),
    }
    assert [one.arm for one in lessons_of(replace(study, arms="certain, benign", seeds=1))] == [
        "benign",
        "certain",
    ]
    with pytest.raises(UsageError, match=r"--arms: expected some of benign, re-rendered, .* found 'certian'"):
        lessons_of(replace(study, arms="certian"))


def test_what_is_attacked_to_train_on() -> None:
    usual = learning_arm(Study(name="retrain"))
    assert (usual.folder, usual.config.combo, usual.config.passes) == ("combo-2", 2, None)
    arm = learning_arm(Study(name="retrain", params="weather,rotate", method="climb", passes=40, limit=3))
    assert (arm.config.params, arm.config.combo, arm.config.method, arm.config.passes) == (
        *("weather,rotate", None, "climb", 40),
    )
    placebo = placebo_arm(arm, Path("out"))
    assert (placebo.config.method, placebo.config.like) == ("placebo", "out/arms/attacked")
    assert (placebo.config.params, placebo.config.passes, placebo.config.limit) == ("weather,rotate", None, 3)


def test_weights_from_elsewhere_keep_their_loss() -> None:
    losses = {
        d: lessons_of(Study(name="retrain", detector=d))[1].config.loss for d in ("squeezedet", "own.safetensors")
    }
    assert losses == {"squeezedet": "quality", "own.safetensors": "published"}


def test_held_out_frames_are_never_trained_on(tmp_path: Path) -> None:
    root = kitti_folder(tmp_path / "all", 8)
    study = Study(name="retrain", dataset="kitti", root=str(root))
    parts = parts_of(study)
    assert parts.learned is not None
    assert parts.judged is not None
    assert (len(parts.learned), len(parts.judged)) == (6, 2)
    assert not set(parts.learned) & set(parts.judged)
    assert parts.benign is not None
    assert parts.benign[1] == parts.learned
    assert parts.held_out is not None
    assert parts.held_out[1] == parts.judged
    assert parts_of(replace(study, seed=1)).judged != parts.judged

    further = kitti_folder(tmp_path / "further", 3)
    own = parts_of(replace(study, held_out=str(further), benign_frames=2))
    assert (own.learned, own.judged) == (None, None)
    assert own.held_out is not None
    assert own.held_out[1] == ("000000", "000001")
    assert own.benign is not None
    assert len(own.benign[1]) == 8
    quick = parts_of(replace(study, quick=True))
    assert quick.benign is None, "the attacked frames' own photographs"


def test_too_few_frames(tmp_path: Path) -> None:
    one = kitti_folder(tmp_path / "one", 1)
    study = Study(name="retrain", dataset="kitti", root=str(one))
    with pytest.raises(UsageError, match=r"--root: expected at least 2 frames, .* found 1"):
        parts_of(study)
    none = tmp_path / "none"
    categories = '{"images": [], "annotations": [], "categories": [{"id": 1, "name": "car"}]}'
    files.write_text(none / "annotations" / "instances_none.json", categories)
    other = tmp_path / "other"
    shutil.copytree(none, other)
    coco = replace(study, dataset="coco", root=str(other), held_out=str(none))
    with pytest.raises(UsageError, match="--held-out: expected at least one frame, found none"):
        parts_of(coco)


@pytest.mark.parametrize("setting", ["root", "benign_root"])
def test_what_is_trained_on_is_not_held_out(setting: str, tmp_path: Path) -> None:
    folders = {name: str(kitti_folder(tmp_path / name, 3)) for name in ("root", "benign_root", "held_out")}
    study = Study(name="retrain", dataset="kitti", **folders)  # pyright: ignore[reportArgumentType]
    assert parts_of(study).held_out is not None
    with pytest.raises(UsageError, match="--held-out: expected a folder of which nothing is trained on"):
        parts_of(replace(study, held_out=str(Path(folders[setting], "..", setting))))


def test_frames_without_vehicles_show_before_anything_is_done(tmp_path: Path) -> None:
    root, empty = kitti_folder(tmp_path / "root", 2), kitti_folder(tmp_path / "empty", 2, "Pedestrian")
    study = Study(name="retrain", dataset="kitti", root=str(root), held_out=str(empty))
    with pytest.raises(UsageError, match="--held-out: expected frames with vehicles, found none"):
        retrain.prepare(study, OUT)
    with pytest.raises(UsageError, match="--root: expected frames with vehicles, found none"):
        retrain.prepare(replace(study, root=str(empty), held_out=str(root)), OUT)
    ready = retrain.prepare(replace(study, held_out=str(kitti_folder(tmp_path / "held_out", 1))), OUT)
    assert [arm.folder for arm in ready.arms] == ["combo-2"]
    assert list(ready.workers[0].source.identifiers()) == ["000000", "000001"]


def test_a_source_among_names() -> None:
    class Source:
        def identifiers(self) -> Sequence[str]:
            return "c", "a", "b"

    assert list(Among(Source(), frozenset(("a", "c"))).identifiers()) == ["c", "a"]  # pyright: ignore[reportArgumentType]


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[Mixture]:
    """What each training was given, in the place of the training."""
    found: list[Mixture] = []

    def train(config: Retrain, detector: object, frames: Mixture, *_: object) -> None:
        found.append(frames)

    monkeypatch.setattr(lessons, "train_on", train)
    return found


def lesson(kind: int | str, **settings: object) -> Lesson:
    arms, place = (kind, 0) if isinstance(kind, str) else (None, kind)
    one = lessons_of(Study(name="retrain", train_steps=2, arms=arms))[place]
    return replace(one, config=replace(one.config, **settings))


def taught(one: Lesson, attacked: list[AttackedFrame], folder: Path) -> Path:
    study = Study(name="retrain")

    def benign(classes: Sequence[str]) -> Sequence[object]:
        return lessons.benign_samples(lessons.Parts(None, None, None, None), attacked, classes, folder)

    taken = Taken(attacked, attacked[1:], WORKER, SecondRenderers("demo", None), folder / "pool", 0, 0.5)
    learn(study, one, taken, benign, weights_of(folder, one), QUIET)  # pyright: ignore[reportArgumentType]
    return weights_of(folder, one)


def pictures(mixture: Mixture) -> set[tuple[int, float]]:
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
def test_what_is_shown(
    kind: int | str,
    settings: dict[str, object],
    expected: set[tuple[int, float]],
    attacked: list[AttackedFrame],
    shown: list[Mixture],
    tmp_path: Path,
) -> None:
    """Benign photographs of all frames, and of those that broke the detector what the lesson is about."""
    taught(lesson(kind, fraction=0.5, **settings), attacked, tmp_path / "out")
    assert pictures(shown[0]) == {(10, 10.0), (11, 10.0), (12, 10.0)} | expected


def test_what_is_learned_is_not_learned_twice(
    attacked: list[AttackedFrame], shown: list[Mixture], tmp_path: Path
) -> None:
    weights = taught(lesson(1), attacked, tmp_path)
    facts, _ = read_weights(weights)
    assert (facts["retrained_from"], facts["steps"]) == ("squeezedet", "2")
    assert load_detector(weights).name == "squeezedet"
    before = weights.stat().st_mtime_ns
    assert taught(lesson(1), attacked, tmp_path) == weights
    assert (len(shown), weights.stat().st_mtime_ns) == (1, before)


def test_lessons_that_cannot_be_held_say_why(attacked: list[AttackedFrame], tmp_path: Path) -> None:
    """No failure of these frames is certain, and no generator made them."""
    taken = Taken(attacked, attacked, WORKER, SecondRenderers("kitti", str(tmp_path)), tmp_path, 0, 0.5)
    reasons = {one.arm: taken.missing(one) for one in lessons_of(Study(name="retrain", arms=",".join(TAUGHT)))}
    none = "no attacked frame has a certain failure of an object"
    assert reasons == {
        **dict.fromkeys(TAUGHT),
        **dict.fromkeys(("certain", "consistent", "worst"), none),
        "generator": "no generator made these frames",
    }


def test_validation_is_neither_trained_on_nor_judged_by(tmp_path: Path) -> None:
    folders = {name: str(kitti_folder(tmp_path / name, 3)) for name in ("root", "held_out", "validation")}
    study = Study(name="retrain", dataset="kitti", **folders)  # pyright: ignore[reportArgumentType]
    assert parts_of(study).held_out is not None
    store = lessons.validation_frames(study, ("Car",), tmp_path)
    assert store is not None
    assert len(store) == 3
    assert lessons.validation_frames(replace(study, validation=None), ("Car",), tmp_path) is None
    for name in ("root", "held_out"):
        with pytest.raises(UsageError, match="--validation: expected a folder that is neither"):
            parts_of(replace(study, validation=folders[name]))
    with pytest.raises(SceneError, match="nowhere"):
        parts_of(replace(study, validation=str(tmp_path / "nowhere")))


def test_without_counterexamples_there_is_nothing_to_learn(attacked: list[AttackedFrame], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--limit: expected counterexamples .* by moved labels, found none"):
        taught(lesson(1), attacked[:1], tmp_path)
