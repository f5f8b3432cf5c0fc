"""Frames perturbed by the project's own renderer, as training sees them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from detectors.types import CLASSES
from drivesem.attacks.labels import Labeller, append_other_labels, to_kitti_labels
from drivesem.attacks.space import PAPER_PARAMETERS, ParameterSpace
from drivesem.data import kitti
from drivesem.data.kitti import KittiDataset
from drivesem.training.frames import (
    TRAINING_LIMITS,
    VARIANTS,
    AttackedSamples,
    FrameStore,
    PerturbedFrames,
    Stage,
    load_attacked_frames,
    render_state,
    training_targets,
)
from scene_ir.io import load_scene, save_scene
from scene_ir.render.compositor import Compositor


def store(root: Path, cache: Path) -> FrameStore:
    dataset = KittiDataset(root)
    return FrameStore(dataset, dataset.identifiers, cache, CLASSES)


def test_frames_without_vehicles_stay_as_they_are(tmp_path: Path, kitti_folder: Callable[..., Path]) -> None:
    frames = store(kitti_folder(tmp_path / "data", 1, kind="Pedestrian"), tmp_path / "cache")
    semantic = PerturbedFrames(frames, tmp_path / "semantic", 1.0, 0)
    assert len(semantic) == 1
    image, targets = semantic.draw(0, 0, np.random.default_rng(0))
    assert np.array_equal(image, frames[0][0])
    assert targets.labels[~targets.ignore].tolist() == [CLASSES.index("Pedestrian")]
    assert not list((tmp_path / "semantic" / "000000").iterdir())


@pytest.mark.slow
def test_vehicles_move_and_their_labels_too(tmp_path: Path) -> None:
    from drivesem.synth.write import Order, synthesise

    list(synthesise(Order(tmp_path / "data", 3, seed=1)))
    frames = store(tmp_path / "data", tmp_path / "cache")
    index = max(range(3), key=lambda i: sum(kind in ("Car", "Van") for kind in frames.labels[i].kind))
    semantic = PerturbedFrames(frames, tmp_path / "semantic", 1.0, 0)
    drawn = [semantic.draw(index, 0, np.random.default_rng(seed)) for seed in range(8)]
    assert len(list((tmp_path / "semantic").glob("*/*.png"))) == VARIANTS
    benign_image, benign = frames[index]
    for image, targets in drawn:
        assert image.shape == benign_image.shape
        assert (image != benign_image).mean() > 0.01
        assert int((~targets.ignore).sum()) > 0
    boxes = {tuple(targets.boxes_xyxy[~targets.ignore].flatten().tolist()) for _, targets in drawn}
    assert 2 <= len(boxes) <= VARIANTS
    assert tuple(benign.boxes_xyxy[~benign.ignore].flatten().tolist()) not in boxes
    plain = PerturbedFrames(frames, tmp_path / "semantic", 0.0, 0).draw(index, 0, np.random.default_rng(0))
    assert np.array_equal(plain[0], benign_image)
    again = PerturbedFrames(frames, tmp_path / "again", 1.0, 0).draw(index, 5, np.random.default_rng(0))
    assert np.array_equal(again[0], drawn[0][0])


PEOPLE = ("Pedestrian", "Tram")


def test_what_stays_keeps_its_labels(tmp_path: Path, small_run: Path) -> None:
    """A person and a tram beside the cars: objects among the labels of a state, not regions."""
    scene = load_scene(small_run / "frames" / "demo-000" / "scene")
    boxes = torch.tensor([[20.0, 150.0, 50.0, 230.0], [1000.0, 100.0, 1100.0, 200.0]])
    row = to_kitti_labels(Labeller(scene).paper(), scene, scene).select([0, 0])
    region = torch.tensor([[300.0, 10.0, 320.0, 20.0]])
    others = replace(row, kind=PEOPLE, boxes_xyxy=boxes, ignore_xyxy=region)
    scene = replace(scene, other_labels=others, ignore=torch.cat([region, boxes]))
    space, compositor = ParameterSpace(scene, PAPER_PARAMETERS), Compositor(scene)
    labeller = Labeller(scene, compositor.render(scene))
    _, labels, judged = render_state(torch.zeros(space.dim), space, compositor, labeller, scene)
    assert labels.kind[-2:] == PEOPLE
    assert torch.equal(labels.boxes_xyxy[-2:], boxes)
    assert torch.equal(labels.ignore_xyxy, region)
    assert int(judged.ignore[len(scene.objects) :].sum()) == 3 * len(CLASSES), "they are not judged"
    written = tmp_path / "labels.txt"
    assert append_other_labels(labels, None) is labels
    kitti.write_labels(written, labels)
    targets = training_targets(kitti.read_labels(written), TRAINING_LIMITS, CLASSES)
    person = targets.labels == CLASSES.index("Pedestrian")
    assert targets.ignore[person].tolist() == [False]


@pytest.mark.parametrize("stage", ["benign", "rerender", "counterexample"])
def test_a_runs_pictures_have_people(stage: Stage, small_run: Path, tmp_path: Path) -> None:
    """To a detector that knows people, pictures without any would say that there are none."""
    shutil.copytree(small_run, tmp_path / "run")
    (frame,) = load_attacked_frames(tmp_path / "run")
    before = AttackedSamples([frame], stage, "moved", CLASSES)[0][1]
    scene = load_scene(frame.folder / "scene")
    region = torch.tensor([[20.0, 150.0, 50.0, 230.0]])
    for name in ("labels_moved.txt", "labels_paper.txt"):
        labels = kitti.read_labels(frame.folder / name)
        kitti.write_labels(frame.folder / name, replace(labels, ignore_xyxy=region))
    others = replace(labels.select([0]), kind=("Cyclist",), boxes_xyxy=region, ignore_xyxy=region[:0])
    save_scene(replace(scene, other_labels=others, ignore=region), frame.folder / "scene")
    after = AttackedSamples([frame], stage, "moved", CLASSES)[0][1]
    cyclist = after.labels == CLASSES.index("Cyclist")
    assert after.boxes_xyxy[cyclist & ~after.ignore].tolist() == region.tolist()
    assert len(after) == len(before) + 1
    for_cars = AttackedSamples([frame], stage, "moved", ("Car",))[0][1]
    assert region[0].tolist() not in for_cars.boxes_xyxy.tolist(), "to others they are background"
