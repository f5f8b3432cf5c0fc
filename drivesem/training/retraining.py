"""A detector trained on with counterexamples: what `drivesem retrain` and `drivesem study retrain` share."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from detectors.augment import AugmentSettings
from detectors.base import Detector, DetectorError
from detectors.registry import load_detector
from detectors.squeezedet import SqueezeDet
from detectors.training import Beside, Sample, TrainingSettings, train
from drivesem.attack.judging import JudgedClasses
from drivesem.attack.labels import LabelMode
from drivesem.config.commands import Retrain
from drivesem.config.errors import UsageError
from drivesem.config.values import interval, size_hw
from drivesem.report.progress import training_bar
from drivesem.report.terminal import Console
from drivesem.training.attacked import AttackedFrame
from drivesem.training.mixture import Shares
from scene_ir import files

WEIGHTS = "retrained.safetensors"


def startable(name: str, device: str, setting: str = "--start") -> Detector:
    """A detector that can be trained on. Raises UsageError, naming the setting, where it is none."""
    try:
        detector = load_detector(name, device)
        JudgedClasses.of(detector)
    except DetectorError as error:
        raise UsageError.of(setting, "a detector that can be trained", error) from error
    return detector


def broken(frames: Sequence[AttackedFrame], mode: LabelMode, setting: str = "--run") -> list[AttackedFrame]:
    """The frames whose counterexamples break the detector by labels of a mode. Raises UsageError where none do."""
    failed = [f for f in frames if (f.result.success_moved if mode == "moved" else f.result.success_paper)]
    if not failed:
        raise UsageError(setting, f"counterexamples that break the detector, by {mode} labels", "none")
    return failed


def shares_of(config: Retrain) -> Shares:
    """How many counterexamples there are among the benign frames, and when."""
    return Shares(config.fraction, config.mix, round(config.ramp * config.steps), config.seed)


def train_on(
    config: Retrain,
    detector: Detector,
    frames: Sequence[Sample],
    out: Path,
    console: Console,
    beside: Beside | None = None,
) -> None:
    """Train in place, or go on with it, with checkpoints in `out`; frozen again at the end. beside: a further term
    of the loss. Raises UsageError.
    """
    settings = TrainingSettings(
        steps=config.steps,
        minutes=config.minutes,
        batch=config.batch,
        rate=config.rate,
        backbone_rate=1.0,  # nothing starts anew
        warmup_steps=config.warmup,
        precision=config.precision,
        seed=config.seed,
        checkpoint_every=config.checkpoint_every,
        augment=AugmentSettings(
            window_hw=size_hw("--window", config.window), scale=interval("--scale", config.scale)
        ),
    )
    if isinstance(detector, SqueezeDet):
        detector.trained_by = config.loss
    detector.requires_grad_(True)
    with training_bar(console) as bar:
        task = bar.add_task("retraining", total=config.steps)

        def progress(done: int, steps: int, row: Mapping[str, float]) -> None:
            bar.update(task, completed=done, description=f"loss {row['total']:.3f}")

        try:
            train(detector, frames, settings, out, progress=progress, beside=beside)
        except FloatingPointError as error:
            raise UsageError("--rate", "one at which the loss stays finite", error) from error
    detector.requires_grad_(False)


def forget_other_weights(run: Path, weights: Path, stamp: Path) -> None:
    """Remove a run that was against other weights than those that are there now. stamp: a file that says which."""
    digest = files.digest(weights)
    if run.is_dir() and (not stamp.is_file() or files.read_text(stamp) != digest):
        shutil.rmtree(run)
    files.write_text(stamp, digest)
