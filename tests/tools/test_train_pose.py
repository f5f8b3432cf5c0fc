"""The maintainers' script behind the shipped pose network: crops, targets, steps that can be stopped, figures."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from drivesem.synth.write import Order, synthesise
from scene_ir.derender import pose
from scene_ir.derender.pose import BINS, KINDS, PosePrediction
from tests.tools.loading import tool

training = tool("train_pose")
SETTINGS = training.PoseSettings(steps=6, batch=4)


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three generated frames, KITTI layout."""
    root = tmp_path_factory.mktemp("pose") / "streets"
    assert list(synthesise(Order(root, 3, seed=5))) == [0, 1, 2]
    return root


@pytest.fixture(scope="module")
def store(streets: Path) -> Any:
    return training.CropStore(streets, streets.parent / "cache")


def test_crops_are_kept(streets: Path, store: Any) -> None:
    again = training.CropStore(streets, streets.parent / "cache")
    assert len(again) == len(store) > 4
    assert again.crops.shape[1:] == (*training.STORE_HW, 3)
    assert torch.equal(again.truth.box, store.truth.box)
    assert bool((again.truth.kind >= 0).all())
    assert bool((again.truth.box[:, 3] - again.truth.box[:, 1] >= training.LEAST_HEIGHT_PX).all())


def test_targets_are_what_the_estimate_undoes(store: Any) -> None:
    """Angle, offset and depth of jittered, mirrored boxes lead back to the truth."""
    crops, numbers, targets = training.build_batch(store, 0, SETTINGS)
    assert crops.shape == (4, 3, *pose.CROP_HW)
    assert float(crops.min()) >= 0
    assert float(crops.max()) <= 1
    assert numbers.shape == (4, pose.BOX_FEATURES)
    # the box's height and the mean size tell a depth; the target is what is missing from it
    heights = torch.exp(numbers[:, 3] + pose.LEVEL_SIZE[1])
    kinds = ["Truck" if t else "Car" for t in numbers[:, 8] > 0]
    depth = pose.mean_sizes(kinds)[:, 1] / heights * targets.depth.exp()
    gaps = (depth[:, None] / store.truth.depth - 1).abs().min(1)
    assert float(gaps.values.max()) < 1e-3
    true = store.truth.rows(gaps.indices)

    def apart(alpha: torch.Tensor) -> torch.Tensor:
        return torch.remainder(alpha - true.alpha + math.pi, 2 * math.pi) - math.pi

    same = apart(targets.alpha).abs() < 1e-4
    assert bool((same | (apart(math.pi - targets.alpha).abs() < 1e-4)).all())
    ray = (true.centre - true.camera[:, 2:4]) / true.camera[:, :2]
    middle = numbers[:, :2] + targets.offset * torch.exp(numbers[:, 2:4] + torch.tensor(pose.LEVEL_SIZE))
    sign = torch.where(same, 1.0, -1.0)
    torch.testing.assert_close(middle[:, 0] * sign, ray[:, 0], atol=1e-4, rtol=0)
    torch.testing.assert_close(middle[:, 1], ray[:, 1], atol=1e-4, rtol=0)


def said_of(targets: Any, confidence: float) -> PosePrediction:
    n = len(targets.alpha)
    apart = targets.alpha[:, None] - torch.arange(BINS) * (2 * math.pi / BINS)
    kind = torch.nn.functional.one_hot(targets.kind, len(KINDS)) * 20.0
    return PosePrediction(
        confidence * apart.cos(),
        torch.stack([apart.cos(), apart.sin()], -1),
        targets.offset,
        targets.size,
        targets.depth,
        torch.full((n,), -3.0),
        kind,
    )


def test_the_truth_costs_least(store: Any) -> None:
    _, _, targets = training.build_batch(store, 0, SETTINGS)
    right = training.loss_terms(said_of(targets, 40.0), targets)
    for name in ("turn", "offset", "size", "depth_error", "kind"):
        assert float(right[name]) < 0.02, name
    for change in (
        {"alpha": targets.alpha + 0.2},
        {"offset": targets.offset + 0.05},
        {"size": targets.size - 0.1},
        {"depth": targets.depth + 0.1},
        {"kind": (targets.kind + 1) % len(KINDS)},
    ):
        wrong = training.loss_terms(said_of(replace(targets, **change), 40.0), targets)
        assert float(wrong["total"]) > float(right["total"]) + 0.05, change.keys()


def test_judged_by_errors(streets: Path) -> None:
    frames = training.labelled_frames(streets)
    errors = training.judge(frames, training.PoseRun(SETTINGS).averaged())
    assert len(errors.yaw) == sum(len(training.usable(frame.labels)) for frame, _ in frames)
    table = training.format_table({"all": errors.summary(), "none": errors.chosen(errors.depth < 0).summary()})
    assert table.count("\n") == 3
    blind = [training.PoseDetections(torch.zeros(0, 4), ())] * len(frames)
    assert len(training.judge(frames, training.PoseRun(SETTINGS).averaged(), blind).yaw) == 0
