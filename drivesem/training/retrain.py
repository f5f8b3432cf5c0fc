"""A detector trained on with counterexamples, before and after, and attacked again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from detectors.base import Detector
from detectors.registry import save_detector
from detectors.training import CHECKPOINT, LOG, Sample
from detectors.types import CLASSES, Detections
from drivesem.attack.judging import JudgedClasses
from drivesem.attack.labels import LabelMode
from drivesem.config.commands import Attack, Retrain
from drivesem.config.errors import UsageError
from drivesem.data.registry import open_dataset
from drivesem.evaluation.coco import SCORE_TITLES, ClassScores
from drivesem.report.tables import Sheet, csv_text, percent
from drivesem.report.terminal import Console
from drivesem.run.attack import Worker, attack_frames
from drivesem.run.folder import SHARING, claim, trusted_attack
from drivesem.run.frame import as_targets
from drivesem.training.attacked import AttackedFrame, AttackedSamples, Stage, figures, frames_of, look
from drivesem.training.curves import draw
from drivesem.training.frames import FrameStore
from drivesem.training.judging import judge
from drivesem.training.known import warn_of_overlaps
from drivesem.training.mixture import Mixture
from drivesem.training.retraining import WEIGHTS, broken, forget_other_weights, shares_of, startable, train_on
from scene_ir import files

FIGURES, CURVES = "retrain.json", "curves.png"
TABLES = ("retrain.csv", "retrain.md")
FRESH, CACHE = "fresh", "cache"
"""Folders: the new attack's run, decoded frames."""
_FRESH_OF = "fresh_of.txt"
"""Digest of the weights that the new attack was against."""
_WRITTEN = (WEIGHTS, FIGURES, CURVES, CHECKPOINT, LOG, _FRESH_OF, *TABLES, FRESH, CACHE)
_FREE = (*SHARING, "out", "resume", "json", "minutes", "checkpoint_every", "fresh", "trust")
"""Settings that a run may change on the way."""


@dataclass(frozen=True)
class RetrainRow:
    """A set of frames and what two detectors find in it. broken: share of frames in which an attack made one lose
    an object or see a phantom, None where nothing was attacked.
    """

    frames: str
    labels: str
    detector: str
    count: int
    scores: ClassScores
    broken: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Flat, figures by name."""
        told = {"set": self.frames, "labels": self.labels, "detector": self.detector, "frames": self.count}
        return told | asdict(self.scores) | {"broken": self.broken}


def retrain_run(config: Retrain, console: Console) -> tuple[dict[str, Any], list[RetrainRow]]:
    """Retrain, or go on with it: the JSON's form, and its rows. Raises UsageError or SceneError for bad input."""
    attack = trusted_attack(Path(config.run), config.trust)
    frames = frames_of(Path(config.run))
    kept_out, learned = _divided(frames, config)
    start = config.start or attack.detector
    before, after = startable(start, config.device), startable(start, config.device)
    if attack.dataset == "kitti":
        warn_of_overlaps([start], attack.root, console)
    out = Path(config.out or f"runs/retrain-{Path(config.run).name}-seed{config.seed}")
    claim(out, config, _WRITTEN, _FREE)
    mixture = _mixture(config, attack, learned, {frame.name for frame in kept_out}, out, after)
    train_on(config, after, mixture, out, console)
    found = look(after, kept_out, "benign", config.device)
    after.t_star = _t_star(after, kept_out, found)
    save_detector(after, out / WEIGHTS, {"retrained_from": Path(start).name, "steps": str(config.steps)})
    rows = _known(before, "before", kept_out, config.device) + _known(after, "after", kept_out, config.device)
    rows += _fresh(config, attack, kept_out, out)
    data = {
        "out": str(out),
        "weights": str(out / WEIGHTS),
        "run": config.run,
        "detector": start,
        "frames": len(mixture),
        "counterexamples": len(mixture.shown),
        "held_out": len(kept_out),
        "t_star": {"before": before.t_star, "after": after.t_star},
        "rows": [row.to_json() for row in rows],
    }
    files.write_json(out / FIGURES, data)
    _write(out, rows)
    draw(out / LOG, out / "evaluations.csv", out / CURVES, f"{before.name}, retrained")
    return data, rows


def _divided(frames: Sequence[AttackedFrame], config: Retrain) -> tuple[list[AttackedFrame], list[AttackedFrame]]:
    """Frames that are never trained on, drawn at random, and the others."""
    order = np.random.default_rng([config.seed, 6]).permutation(len(frames))
    count = max(round(config.validation * len(frames)), 1)
    if count >= len(frames):
        raise UsageError("--run", "at least 2 frames, some to train on and some to judge by", len(frames))
    kept_out = {int(i) for i in order[:count]}
    chosen = [[f for i, f in enumerate(frames) if (i in kept_out) == wanted] for wanted in (True, False)]
    return chosen[0], chosen[1]


def _mixture(
    config: Retrain,
    attack: Attack,
    learned: Sequence[AttackedFrame],
    kept_out: set[str],
    out: Path,
    after: Detector,
) -> Mixture:
    mode, classes = config.label_mode, after.classes
    counterexamples = AttackedSamples(broken(learned, mode), "counterexample", mode, classes)
    benign: Sequence[Sample]
    if config.dataset is None:
        benign = AttackedSamples(learned, "benign", "paper", classes)
    else:
        dataset = open_dataset(config.dataset, Path(config.root or ""))
        names = list(dataset.identifiers[: config.limit])
        if config.dataset == attack.dataset:  # what is judged by is not trained on, wherever it lies
            names = [name for name in names if name not in kept_out]
        if not names:
            raise UsageError("--root", "frames that are not held out", "none")
        benign = FrameStore(dataset, names, out / CACHE, classes)
    return Mixture(benign, counterexamples, shares_of(config))


def _t_star(detector: Detector, frames: Sequence[AttackedFrame], found: Sequence[Detections]) -> float:
    """The score of best F1 on the benign frames that were held out."""
    judged = JudgedClasses.of(detector)
    wanted = [judged.targets(as_targets(frame.result.targets_benign, CLASSES)) for frame in frames]
    return judge(found, wanted, judged.names).t_star


def _known(detector: Detector, name: str, frames: Sequence[AttackedFrame], device: str) -> list[RetrainRow]:
    """Benign frames, and the counterexamples that the run found against the detector as it was."""
    rows = []
    stages: tuple[tuple[Stage, tuple[LabelMode, ...]], ...] = (
        ("benign", ("paper",)),
        ("counterexample", ("moved", "paper")),
    )
    for stage, modes in stages:
        found = look(detector, frames, stage, device)
        for mode in modes:
            scores = figures(detector, detector.t_star, frames, found, mode)
            share = None
            if stage == "counterexample" and name == "before":
                won = [f.result.success_moved if mode == "moved" else f.result.success_paper for f in frames]
                share = sum(won) / len(won)
            label = "benign" if stage == "benign" else "counterexamples of the run"
            rows.append(RetrainRow(label, mode, name, len(frames), scores, share))
    return rows


def _fresh(config: Retrain, attack: Attack, kept_out: Sequence[AttackedFrame], out: Path) -> list[RetrainRow]:
    """The same attack on the same frames, against the retrained detector."""
    names = [frame.name for frame in kept_out][: config.fresh]
    if not names:
        return []
    again = replace(
        attack,
        detector=str(out / WEIGHTS),
        steps=config.attack_steps or attack.steps,
        out=None,
        json=False,
        resume=config.resume,
        workers=config.workers,
        device=config.device,
        t_star=None,
    )
    forget_other_weights(out / FRESH, out / WEIGHTS, out / _FRESH_OF)
    summary = attack_frames(Worker.of(again), names, out / FRESH)
    rows = []
    for mode, scores, won in (
        ("moved", summary.attacked_moved, summary.successes_moved),
        ("paper", summary.attacked_paper, summary.successes_paper),
    ):
        share = won / summary.frames if summary.frames else None
        rows.append(RetrainRow("fresh counterexamples", mode, "after", summary.frames, scores.headline, share))
    return rows


def _write(out: Path, rows: Sequence[RetrainRow]) -> None:
    """The table as CSV and as Markdown."""
    words = ("frames", "labels", "detector")
    sheet = Sheet("", (*words, *SCORE_TITLES, "objects", "frames broken"), tuple(map(_cells, rows)))
    csv_name, markdown_name = TABLES
    files.write_text(out / csv_name, csv_text([row.to_json() for row in rows], line_end="\r\n"))
    files.write_text(out / markdown_name, "\n".join(sheet.markdown(words)[2:]) + "\n")  # without a heading


def _cells(row: RetrainRow) -> tuple[str, ...]:
    share = "" if row.broken is None else f"{100 * row.broken:.0f} % of {row.count}"
    figures = map(percent, row.scores.shown)
    return row.frames, row.labels, row.detector, *figures, str(row.scores.objects), share
