"""The training loop: it learns, it resumes to the bit, it refuses what it cannot use."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from detectors import training
from detectors.augment import AugmentSettings
from detectors.base import AnchorPredictions, DetectorError
from detectors.boxes import iou_matrix
from detectors.registry import read_weights, write_weights
from detectors.squeezedet import SeededDropout, SqueezeDet
from detectors.training import CHECKPOINT, LOG, Sample, TrainingSettings, learning_rate, make_batch, train
from detectors.types import Targets

CHECKPOINTED = ("total", "objectness")
SMALL = TrainingSettings(
    steps=6,
    batch=2,
    rate=1e-4,
    warmup_steps=2,
    checkpoint_every=2,
    augment=AugmentSettings(window_hw=(48, 64)),
)


def painted(count: int) -> list[Sample]:
    """Frames with one bright block each."""
    generator = np.random.default_rng(0)
    frames = []
    for _ in range(count):
        image = generator.integers(90, 130, (64, 96, 3), dtype=np.uint8)
        x, y = int(generator.integers(2, 50)), int(generator.integers(2, 25))
        image[y : y + 36, x : x + 40] = (250, 240, 30)
        box = torch.tensor([[x, y, x + 39, y + 35]]).float()
        frames.append((image, Targets(box, torch.tensor([0]), torch.tensor([False]))))
    return frames


def fresh() -> SqueezeDet:
    detector = SqueezeDet(classes=("Car", "Truck"))
    detector.initialise(torch.Generator().manual_seed(0))
    with torch.no_grad():
        detector.conv1.weight *= 0.01  # inputs are in 0..255; pretrained weights know that, drawn ones do not
    return detector


def with_batch_norm() -> SqueezeDet:
    """A detector that counts and measures as it is trained."""
    detector = fresh()
    detector.dropout = nn.Sequential(SeededDropout(0.5), nn.BatchNorm2d(768))  # pyright: ignore[reportAttributeAccessIssue]
    return detector


@pytest.mark.parametrize(
    ("optimiser", "precision"), [("adamw", "float32"), ("sgd", "float32"), ("sgd", "bfloat16")]
)
def test_resumed_equals_uninterrupted(tmp_path: Path, optimiser: str, precision: str) -> None:
    settings = replace(SMALL, optimiser=optimiser, precision=precision)
    whole = train(fresh(), painted(3), settings, tmp_path / "whole")
    train(fresh(), painted(3), settings, tmp_path / "parts", stop_after=5)  # killed after the checkpoint of step 4
    parts = train(fresh(), painted(3), settings, tmp_path / "parts")
    for name, value in whole.state_dict().items():
        assert torch.equal(parts.state_dict()[name], value), name
    log = [list(csv.DictReader((tmp_path / run / LOG).read_text().splitlines())) for run in ("whole", "parts")]
    assert [row["step"] for row in log[0]] == ["1", "2", "3", "4", "5", "6"]
    for first, second in zip(*log, strict=True):
        assert {**first, "seconds": ""} == {**second, "seconds": ""}


class KilledError(Exception):
    """SIGKILL, at a place of choice."""


def die(*_: object) -> None:
    raise KilledError


def test_an_evaluation_at_which_a_run_is_killed_is_made_again(tmp_path: Path) -> None:
    settings = replace(SMALL, evaluate_every=2)
    with pytest.raises(KilledError):
        train(fresh(), painted(3), settings, tmp_path, evaluate=die)
    judged: list[int] = []
    train(fresh(), painted(3), settings, tmp_path, evaluate=lambda _, step: judged.append(step))
    assert judged[0] == 2, "its checkpoint comes after it"


def test_no_checkpoint_has_steps_that_the_log_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = training.write_weights

    def and_die(path: Path, *content: Any) -> None:
        write(path, *content)
        log = (tmp_path / LOG).read_text().splitlines()  # as it lies there now
        assert [row["step"] for row in csv.DictReader(log)] == ["1", "2"]
        die()

    monkeypatch.setattr(training, "write_weights", and_die)
    with pytest.raises(KilledError):
        train(fresh(), painted(3), SMALL, tmp_path)


class SmallMemorySqueezeDet(SqueezeDet):
    """On a device that holds no more than so many views at once. Its loss is a mean over views."""

    most = 2

    def forward(self, images: torch.Tensor) -> AnchorPredictions:
        if len(images) > self.most:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return super().forward(images)

    def loss(self, raw: AnchorPredictions, targets: Sequence[Targets]) -> dict[str, torch.Tensor]:
        alone = [
            super(SmallMemorySqueezeDet, self).loss(raw.select(i), [target]) for i, target in enumerate(targets)
        ]
        return {name: torch.stack([terms[name] for terms in alone]).mean() for name in alone[0]}


def test_batch_is_split_when_memory_runs_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = fresh().state_dict()

    def moved(most: int) -> torch.Tensor:
        detector = SmallMemorySqueezeDet(classes=("Car", "Truck"), dropout=0)
        detector.load_state_dict(start)
        detector.most = most
        settings = replace(SMALL, steps=2, batch=4, optimiser="sgd", warmup_steps=0)
        end = train(detector, painted(4), settings, tmp_path / str(most)).state_dict()
        return torch.cat([(end[name] - start[name]).flatten() for name in start])

    whole, halves, singles = (moved(most) for most in (4, 2, 1))
    lines = capsys.readouterr().err.splitlines()
    line = "drivesem: a batch of 4 exceeds the device's memory: {} at once from now on"
    assert lines == [line.format(2), line.format(2), line.format(1)], "once, not at every step"
    assert (halves - whole).norm() < 1e-3 * whole.norm()
    assert (singles - whole).norm() < 1e-3 * whole.norm()
    with pytest.raises(torch.OutOfMemoryError):
        moved(0)


class PooledSqueezeDet(SqueezeDet):
    """ConvDet on mean colours: small enough for float16, which CPUs compute very slowly."""

    def forward(self, images: torch.Tensor) -> AnchorPredictions:
        cells = functional.avg_pool2d(images, 16).repeat(1, 256, 1, 1)
        return self._interpret(self.convdet(self.dropout(cells)), (int(images.shape[2]), int(images.shape[3])))


def test_float16_scales_its_loss_and_resumes(tmp_path: Path) -> None:
    def pooled() -> SqueezeDet:
        detector = PooledSqueezeDet(classes=("Car", "Truck"))
        detector.initialise(torch.Generator().manual_seed(0))
        return detector

    settings = replace(SMALL, precision="float16", rate=1e-3)
    whole = train(pooled(), painted(3), settings, tmp_path / "whole").state_dict()
    train(pooled(), painted(3), settings, tmp_path / "parts", stop_after=5)
    parts = train(pooled(), painted(3), settings, tmp_path / "parts").state_dict()
    assert all(torch.equal(parts[name], value) for name, value in whole.items())
    scaler = json.loads(read_weights(tmp_path / "whole" / CHECKPOINT)[0]["scaler"])
    assert 1 < scaler["scale"] <= 2**16
    # the first steps overflow until the scale fits, and change nothing
    assert not torch.equal(whole["convdet.weight"], pooled().convdet.weight)


def test_buffers_are_averaged_and_resumed(tmp_path: Path) -> None:
    whole = train(with_batch_norm(), painted(3), SMALL, tmp_path / "whole").state_dict()
    train(with_batch_norm(), painted(3), SMALL, tmp_path / "parts", stop_after=5)
    parts = train(with_batch_norm(), painted(3), SMALL, tmp_path / "parts").state_dict()
    assert all(torch.equal(parts[name], value) for name, value in whole.items())
    assert int(whole["dropout.1.num_batches_tracked"]) == SMALL.steps
    _, tensors = read_weights(tmp_path / "whole" / CHECKPOINT)
    last, average = (tensors[f"{part}.dropout.1.running_mean"] for part in ("weights", "average"))
    assert torch.equal(whole["dropout.1.running_mean"], average)
    assert not torch.equal(last, average)


def test_a_checkpoint_that_lacks_a_setting_is_refused(tmp_path: Path) -> None:
    train(fresh(), painted(3), SMALL, tmp_path, stop_after=5)
    facts, tensors = read_weights(tmp_path / CHECKPOINT)
    settings = json.loads(facts["settings"])
    del settings["precision"]
    write_weights(tmp_path / CHECKPOINT, facts | {"settings": json.dumps(settings)}, tensors)
    with pytest.raises(DetectorError, match="precision: expected float32 as set, found None"):
        train(fresh(), painted(3), SMALL, tmp_path)


def test_loader_threads_change_nothing(tmp_path: Path) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        plain = train(fresh(), painted(3), SMALL, tmp_path / "plain").state_dict()
        ahead = train(fresh(), painted(3), SMALL, tmp_path / "ahead", loaders=2).state_dict()
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(ahead[name], value) for name, value in plain.items())


def test_data_set_may_draw_its_frames() -> None:
    class Choosing(list[Sample]):
        def draw(self, index: int, step: int, generator: np.random.Generator) -> Sample:
            image, targets = self[index]
            return np.full_like(image, 10 * step + int(generator.integers(2))), targets

    plain = replace(
        SMALL, augment=replace(SMALL.augment, brightness=0.0, contrast=0.0, gamma=0.0, channel_gain=0.0)
    )
    plain = replace(plain, augment=replace(plain.augment, noise_probability=0, jpeg_probability=0, hue_rad=0.0))
    drawn = [float(make_batch(Choosing(painted(2)), step, plain)[0].min()) * 255 for step in (3, 3, 8)]
    assert drawn[0] == drawn[1]
    assert round(drawn[0]) in (30, 31)
    assert round(drawn[2]) in (80, 81)


def test_the_log_has_the_detectors_own_terms(tmp_path: Path) -> None:
    class Named(SqueezeDet):
        def loss(self, raw: AnchorPredictions, targets: Sequence[Targets]) -> dict[str, torch.Tensor]:
            terms = super().loss(raw, targets)
            return {
                "boxes": terms["box"],
                "rest": terms["total"] - terms["box"],
                **{k: terms[k] for k in CHECKPOINTED},
            }

    train(Named(classes=("Car", "Truck")), painted(2), replace(SMALL, steps=1), tmp_path)
    (row,) = csv.DictReader((tmp_path / LOG).read_text().splitlines())
    assert list(row) == ["step", "seconds", "rate", "boxes", "rest", "total", "norm"]


class ConstantAuxiliaryLoss:
    """A term on a picture of its own, which pulls its confidences to a value."""

    name = "pull"

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def images(self, step: int) -> torch.Tensor:
        return torch.rand(1, 3, 48, 64, generator=torch.Generator().manual_seed(step))

    def term(self, detector: Any, raw: Any, step: int) -> torch.Tensor:
        return self.weight * (raw.confidence_logits - 1).square().mean()


def test_a_further_term_is_added_to_the_loss(tmp_path: Path) -> None:
    """It has a column of its own, moves the weights by its gradient, and resumes to the bit."""
    runs = {
        name: train(fresh(), painted(3), SMALL, tmp_path / name, auxiliary_loss=auxiliary)
        for name, auxiliary in (
            ("alone", None),
            ("nothing", ConstantAuxiliaryLoss(0.0)),
            ("whole", ConstantAuxiliaryLoss(5.0)),
        )
    }
    weights = {name: run.state_dict()["conv1.weight"] for name, run in runs.items()}
    assert torch.equal(weights["alone"], weights["nothing"])
    assert not torch.equal(weights["alone"], weights["whole"])
    rows = list(csv.DictReader((tmp_path / "whole" / LOG).read_text().splitlines()))
    terms = [float(rows[0][name]) for name in ("confidence", "box", "class", "pull")]
    assert float(rows[0]["total"]) == pytest.approx(sum(terms), rel=1e-4)
    assert terms[-1] > 0
    train(fresh(), painted(3), SMALL, tmp_path / "parts", stop_after=5, auxiliary_loss=ConstantAuxiliaryLoss(5.0))
    parts = train(fresh(), painted(3), SMALL, tmp_path / "parts", auxiliary_loss=ConstantAuxiliaryLoss(5.0))
    assert torch.equal(parts.state_dict()["conv1.weight"], weights["whole"])


def test_training_changes_weights_and_returns_eval_mode(tmp_path: Path) -> None:
    detector = fresh()
    before = detector.convdet.weight.clone()
    trained = train(detector, painted(2), replace(SMALL, steps=2), tmp_path)
    assert not trained.training
    assert not torch.equal(trained.convdet.weight, before)


def test_progress_is_reported_after_each_step(tmp_path: Path) -> None:
    lines: list[tuple[int, int, float]] = []

    def progress(done: int, steps: int, row: Mapping[str, float]) -> None:
        lines.append((done, steps, row["total"]))

    train(fresh(), painted(2), replace(SMALL, steps=4), tmp_path, stop_after=3, progress=progress)
    assert [reported[:2] for reported in lines] == [(1, 4), (2, 4), (3, 4)]
    log = list(csv.DictReader((tmp_path / LOG).read_text().splitlines()))
    assert [loss for *_, loss in lines] == pytest.approx([float(row["total"]) for row in log], rel=1e-5)


@pytest.mark.slow
def test_learns_a_few_frames_by_heart(tmp_path: Path) -> None:
    augment = AugmentSettings(
        window_hw=(64, 96), scale_probability=0, flip_probability=0, noise_probability=0, blur_probability=0
    )
    settings = replace(
        SMALL, steps=150, batch=2, rate=1e-3, warmup_steps=10, augment=augment, checkpoint_every=150
    )
    frames = painted(2)
    detector = SqueezeDet(classes=("Car", "Truck"), dropout=0.0)
    detector.load_state_dict(fresh().state_dict())
    detector = train(detector, frames, settings, tmp_path)
    for image, targets in frames:
        found = detector.decode(detector(torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255))[0]
        assert float(iou_matrix(found.boxes_xyxy[:1], targets.boxes_xyxy)) > 0.75
        assert float(found.scores[0]) > 0.5


def test_evaluate_sees_the_averaged_detector(tmp_path: Path) -> None:
    seen: list[tuple[int, bool, torch.Tensor]] = []

    def evaluate(detector: torch.nn.Module, step: int) -> None:
        seen.append((step, detector.training, detector.get_parameter("convdet.weight").clone()))

    plain = train(fresh(), painted(2), replace(SMALL, steps=4), tmp_path / "plain")
    trained = train(fresh(), painted(2), replace(SMALL, steps=4, evaluate_every=2), tmp_path / "judged", evaluate)
    assert [(step, mode) for step, mode, _ in seen] == [(2, False), (4, False), (4, False)]
    assert torch.equal(seen[-1][2], trained.get_parameter("convdet.weight"))
    assert torch.equal(plain.get_parameter("convdet.weight"), trained.get_parameter("convdet.weight"))


def test_batches_cover_every_frame_once_an_epoch() -> None:
    frames = painted(6)

    class Counting(list[Sample]):
        drawn_frames: tuple[int, ...] = ()

        def __getitem__(self, index: int) -> Sample:  # type: ignore[override]
            self.drawn_frames = (*self.drawn_frames, index)
            return frames[index]

    counting = Counting(frames)
    for step in range(6):
        make_batch(counting, step, SMALL)
    assert sorted(counting.drawn_frames[:6]) == list(range(6))
    assert sorted(counting.drawn_frames[6:]) == list(range(6))
    assert counting.drawn_frames[:6] != counting.drawn_frames[6:]


def test_schedule_warms_up_and_falls() -> None:
    settings = replace(SMALL, steps=100, rate=1.0, warmup_steps=10)
    rates = [learning_rate(step / 100, step, settings) for step in range(100)]
    assert rates[0] == pytest.approx(0.1)
    assert max(rates) == pytest.approx(rates[9], abs=0.01)
    assert rates[9:] == sorted(rates[9:], reverse=True)
    assert rates[-1] < 0.02


def test_published_schedules() -> None:
    squeezedet = replace(SMALL, rate=0.01, warmup_steps=0, drops=(10, 20, 30), drop_factor=0.5)
    assert [learning_rate(0.9, step, squeezedet) for step in (0, 9, 10, 29, 30)] == pytest.approx(
        [0.01, 0.01, 0.005, 0.0025, 0.00125]
    )
    darknet = replace(SMALL, rate=0.001, warmup_steps=1000, warmup_power=4, drops=(4000, 4500))
    assert learning_rate(0.0, 499, darknet) == pytest.approx(0.001 * 0.5**4)
    assert [learning_rate(0.0, step, darknet) for step in (999, 3999, 4000, 4500)] == pytest.approx(
        [1e-3, 1e-3, 1e-4, 1e-5]
    )


def test_invalid_input_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="dataset: expected at least one frame, found 0"):
        train(fresh(), [], SMALL, tmp_path)
    with pytest.raises(ValueError, match="optimiser: expected adamw or sgd, found 'lion'"):
        replace(SMALL, optimiser="lion")
    with pytest.raises(ValueError, match="precision: expected one of float32, bfloat16, float16, found 'int8'"):
        replace(SMALL, precision="int8")
    with pytest.raises(ValueError, match="batch: expected a number above 0"):
        replace(SMALL, batch=0)
    train(fresh(), painted(2), replace(SMALL, steps=2), tmp_path)
    with pytest.raises(ValueError, match=rf"{CHECKPOINT}: steps: expected 3 as set, found 2"):
        train(fresh(), painted(2), replace(SMALL, steps=3), tmp_path)
    with pytest.raises(DetectorError, match="expected the tensors of squeezedet, found others"):
        train(with_batch_norm(), painted(2), replace(SMALL, steps=2), tmp_path)


def test_a_loss_that_is_not_finite_names_the_step(tmp_path: Path) -> None:
    detector = fresh()
    with torch.no_grad():
        detector.convdet.bias.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="step 0: expected a finite loss"):
        train(detector, painted(2), SMALL, tmp_path)
