"""Fine-tunes a detector on counterexamples, evaluates it before and after, and attacks it again."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from detectors.augment import AugmentSettings
from detectors.base import Detector, DetectorError
from detectors.registry import load_detector, save_detector
from detectors.squeezedet import SqueezeDet
from detectors.training import CHECKPOINT, LOG, AuxiliaryLoss, Sample, TrainingSettings, train
from detectors.types import CLASSES, Detections, Targets
from drivesem.attacks.labels import LabelMode
from drivesem.attacks.targets import HEADLINE, EvaluatedClasses
from drivesem.config.commands import AttackConfig, RetrainConfig
from drivesem.config.constraints import parse_interval, parse_size_hw
from drivesem.config.errors import UsageError
from drivesem.data.account import write_account
from drivesem.data.subsets import open_selection
from drivesem.evaluation.coco import SCORE_TITLES, ClassScores
from drivesem.evaluation.matched_class import MatchedClass
from drivesem.evaluation.resampling import (
    DRAWS,
    LEVEL,
    NamedMetric,
    PairedDifference,
    WeightedAveragePrecision,
    WeightedRecall,
    paired_differences,
)
from drivesem.reporting.tables import (
    Console,
    ReportTable,
    format_count,
    format_percent,
    rows_to_csv,
    training_progress_bar,
)
from drivesem.run.attack import AttackWorker, attack_frames
from drivesem.run.folder import SHARING, claim_folder, load_trusted_config
from drivesem.run.frame import detections_from_records, targets_from_records
from drivesem.training.card import plot_curves, warn_about_overlaps
from drivesem.training.frames import (
    AttackedFrame,
    AttackedSamples,
    FrameStore,
    MixtureShares,
    Stage,
    TrainingMixture,
    detect_in_frames,
    headline_scores,
    load_attacked_frames,
)
from drivesem.training.validation import score_detections
from scene_ir import files

WEIGHTS, RESULT, CURVES = "retrained.safetensors", "retrain.json", "curves.png"
TABLES = ("retrain.csv", "retrain.md")
FRESH, CACHE = "fresh", "cache"
"""Folders of the new attack's run and of decoded frames."""
_FRESH_OF = "fresh_of.txt"
"""File with the digest of the weights that the new attack targets."""
_WRITTEN = (WEIGHTS, RESULT, CURVES, CHECKPOINT, LOG, _FRESH_OF, *TABLES, FRESH, CACHE)
_FREE = (*SHARING, "out", "resume", "json", "minutes", "checkpoint_every", "fresh", "trust")
"""Settings that a run may change on the way."""


@dataclass(frozen=True)
class RetrainRow:
    """Metrics of one detector on one set of frames."""

    frames: str
    """Set of frames."""
    labels: str
    """Label mode."""
    detector: str
    """Before or after."""
    count: int
    """Number of frames."""
    scores: ClassScores
    """Metrics."""
    broken: float | None = None
    """Share of frames in which an attack succeeded; None where nothing was attacked."""

    @property
    def broken_text(self) -> str:
        """Such as `40 % of 5`; "" where nothing was attacked."""
        return "" if self.broken is None else f"{100 * self.broken:.0f} % of {self.count}"

    def to_json(self) -> dict[str, Any]:
        """Flatten the row to metrics by name."""
        row = {"set": self.frames, "labels": self.labels, "detector": self.detector, "frames": self.count}
        return row | asdict(self.scores) | {"broken": self.broken}


@dataclass(frozen=True, slots=True)
class RetrainVerdict:
    """Whether the fine-tuned detector is better in one metric on one set of frames."""

    frames: str
    """Set of frames."""
    count: int
    """Number of frames, the same for both detectors."""
    objects: int
    """Number of objects of the headline's class."""
    compared: PairedDifference
    """The metric before and after, with a paired bootstrap over frames and a permutation test."""

    @property
    def verdict(self) -> str:
        """better or worse if the interval leaves out 0 and p is below 0.05, with `_LEAST_FRAMES` at least."""
        one = self.compared
        if self.count < _LEAST_FRAMES or one.difference is None or one.low is None or one.high is None:
            return "too few to tell"
        if one.p is None or one.p >= 1 - LEVEL or one.low <= 0 <= one.high:
            return "too few to tell"
        return "better" if one.difference > 0 else "worse"

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object."""
        one = self.compared
        values = {"before": one.first, "after": one.second, "difference": one.difference}
        row = {"set": self.frames, "metric": one.name, "verdict": self.verdict, "frames": self.count}
        return row | {"objects": self.objects, **values, "interval": [one.low, one.high], "p": one.p}

    def cells(self) -> tuple[str, ...]:
        """Texts of a table row, see `VERDICT_COLUMNS`."""
        one = self.compared
        change = "" if one.difference is None else f"{100 * one.difference:+.1f}"
        if one.low is not None and one.high is not None:
            change += f" [{100 * one.low:+.1f}, {100 * one.high:+.1f}]"
        counts = f"{format_count(self.count, 'frame')}, {format_count(self.objects, 'object')}"
        return (
            *(self.frames, one.name, format_percent(one.first), format_percent(one.second)),
            *(change, counts, self.verdict),
        )


_LEAST_FRAMES = 6
"""Fewest frames of which a permutation test can give p < 0.05."""
NOTE = (
    "better, worse: the 95 % interval of the change (paired bootstrap over frames) leaves out 0, and a permutation "
    f"test gives p < 0.05, for which {_LEAST_FRAMES} frames are the least; otherwise too few to tell."
)
VERDICT_COLUMNS = ("frames", "metric", "before", "after", "change, points", "of", "verdict")


@dataclass(frozen=True, slots=True)
class RetrainResult:
    """What `drivesem retrain` reports."""

    data: dict[str, Any]
    """The data of `--json`."""
    rows: list[RetrainRow]
    """Metrics of both detectors."""
    verdicts: list[RetrainVerdict]
    """Comparisons of both."""
    thresholds: str
    """Both detectors' t*, and how it was chosen."""


def retrain_detector(config: RetrainConfig, console: Console) -> RetrainResult:
    """Fine-tune or resume, evaluate and attack again. Raises UsageError or SceneError for bad input."""
    attack = load_trusted_config(Path(config.run), config.trust)
    frames = load_attacked_frames(Path(config.run))
    held_out, training = _split_frames(frames, config)
    start = config.start or attack.detector
    before, after = load_start(start, config.device), load_start(start, config.device)
    if attack.dataset == "kitti":
        warn_about_overlaps([start], attack.root, console)
    out = Path(config.out or f"runs/retrain-{Path(config.run).name}-seed{config.seed}")
    claim_folder(out, config, _WRITTEN, _FREE)
    mixture = _mixture(config, attack, training, {frame.name for frame in held_out}, out, after)
    fine_tune(config, after, mixture, out, console)
    own_t_star = before.t_star
    for detector in (before, after):
        detector.t_star = _t_star(
            detector, held_out, detect_in_frames(detector, held_out, "benign", config.device)
        )
    save_detector(after, out / WEIGHTS, {"retrained_from": Path(start).name, "steps": str(config.steps)})
    rows = _known(before, "before", held_out, config.device) + _known(after, "after", held_out, config.device)
    rows += _fresh(config, attack, held_out, out)
    verdicts = _verdicts(config, (before, after), held_out, out / FRESH)
    thresholds = (
        f"t*: {before.t_star:.3f} before, {after.t_star:.3f} after, each with the best F1 on the "
        f"{format_count(len(held_out), 'validation photograph')} (the detector's own: {own_t_star:.3f})"
    )
    data = {
        "out": str(out),
        "weights": str(out / WEIGHTS),
        "run": config.run,
        "detector": start,
        "frames": len(mixture),
        "counterexamples": len(mixture.drawn_counterexamples),
        "held_out": len(held_out),
        "t_star": {"before": before.t_star, "after": after.t_star, "own": own_t_star},
        "verdicts": [one.to_json() for one in verdicts],
        "rows": [row.to_json() for row in rows],
    }
    files.write_json(out / RESULT, data)
    _write(out, rows, verdicts, thresholds)
    plot_curves(out / LOG, out / "evaluations.csv", out / CURVES, f"{before.name}, retrained")
    return RetrainResult(data, rows, verdicts, thresholds)


def _verdicts(
    config: RetrainConfig, detectors: tuple[Detector, Detector], held_out: Sequence[AttackedFrame], fresh: Path
) -> list[RetrainVerdict]:
    """Compare both detectors on photographs, on the run's counterexamples, and on those against either."""

    def judge(name: str, frames: Sequence[AttackedFrame], stage: Stage) -> list[RetrainVerdict]:
        truths = [_true_targets(detector, frames, stage) for detector in detectors]
        found = [detect_in_frames(detector, frames, stage, config.device) for detector in detectors]
        return compare_retrained(name, detectors, truths, found, config.seed)

    attacked = [frame for frame in held_out if frame.result.attacked]
    verdicts = judge("benign", held_out, "benign")
    if attacked:
        verdicts += judge("counterexamples of the run", attacked, "counterexample")
    if not fresh.is_dir():
        return verdicts
    again = {frame.name: frame for frame in load_attacked_frames(fresh) if frame.result.attacked}
    pairs = [(frame, again[frame.name]) for frame in attacked if frame.name in again]
    if pairs and config.attack_steps is None:  # the same attack on either
        sides = list(zip(*pairs, strict=True))
        truths, found = [], []
        for detector, frames in zip(detectors, sides, strict=True):
            names = EvaluatedClasses.from_detector(detector).names
            truths.append(_true_targets(detector, frames, "counterexample"))
            found.append([detections_from_records(f.result.detections_attacked, names) for f in frames])
        verdicts += compare_retrained("counterexamples against each", detectors, truths, found, config.seed)
    return verdicts


def _true_targets(detector: Detector, frames: Sequence[AttackedFrame], stage: Stage) -> list[Targets]:
    """True boxes of a stage's pictures; those of counterexamples have moved with the vehicles."""
    judged = EvaluatedClasses.from_detector(detector)
    results = [frame.result for frame in frames]
    records = [r.targets_benign if stage == "benign" else r.targets_moved for r in results]
    return [judged.map_targets(targets_from_records(record, CLASSES)) for record in records]


def compare_retrained(
    name: str,
    detectors: Sequence[Detector],
    truths: Sequence[Sequence[Targets]],
    found: Sequence[Sequence[Detections]],
    seed: int,
) -> list[RetrainVerdict]:
    """Compare AP50 and recall at t* of the headline's class before and after.

    Args:
        name: Set of frames.
        detectors: Before and after, each with its t*.
        truths: Labels of each frame, by detector.
        found: Detections in each frame, by detector.
        seed: Seed of the bootstrap.
    """
    metrics, objects, frames = [], 0, len(truths[0])
    for detector, targets, detections in zip(detectors, truths, found, strict=True):
        label = EvaluatedClasses.from_detector(detector).names.index(HEADLINE)
        keep = [one.scores >= detector.t_star for one in detections]
        sure = [
            Detections(one.boxes_xyxy[k], one.labels[k], one.scores[k])
            for one, k in zip(detections, keep, strict=True)
        ]
        at_any_score, at_t_star = (
            matched.candidates.class_matches(matched.match, 0)
            for matched in (MatchedClass.from_frames(targets, some, label) for some in (detections, sure))
        )
        objects = int(at_any_score.objects.sum())
        ap50 = NamedMetric("AP50", (WeightedAveragePrecision(at_any_score, "coco"),))
        metrics.append((ap50, NamedMetric("recall at t*", (WeightedRecall(at_t_star),))))
    first, second = metrics
    compared = paired_differences(first, second, frames, DRAWS, np.random.default_rng(seed))
    return [RetrainVerdict(name, frames, objects, one) for one in compared]


def _split_frames(
    frames: Sequence[AttackedFrame], config: RetrainConfig
) -> tuple[list[AttackedFrame], list[AttackedFrame]]:
    """Split frames at random into held-out ones and training ones."""
    order = np.random.default_rng([config.seed, 6]).permutation(len(frames))
    count = max(round(config.validation * len(frames)), 1)
    if count >= len(frames):
        raise UsageError("--run", "at least 2 frames, some to train on and some to judge by", len(frames))
    held_out = {int(i) for i in order[:count]}
    chosen = [[f for i, f in enumerate(frames) if (i in held_out) == wanted] for wanted in (True, False)]
    return chosen[0], chosen[1]


def _mixture(
    config: RetrainConfig,
    attack: AttackConfig,
    training: Sequence[AttackedFrame],
    held_out: set[str],
    out: Path,
    after: Detector,
) -> TrainingMixture:
    mode, classes = config.label_mode, after.classes
    counterexamples = AttackedSamples(select_counterexamples(training, mode), "counterexample", mode, classes)
    benign: Sequence[Sample]
    if config.dataset is None:
        benign = AttackedSamples(training, "benign", "paper", classes)
    else:
        dataset = open_selection(config.dataset, config.root or "")
        write_account(dataset.account())
        names = list(dataset.identifiers[: config.limit])
        if config.dataset == attack.dataset:  # never train on held-out frames, in any folder
            names = [name for name in names if name not in held_out]
        if not names:
            raise UsageError("--root", "frames that are not held out", "none")
        benign = FrameStore(dataset, names, out / CACHE, classes)
    return TrainingMixture(benign, counterexamples, mixture_shares(config))


def _t_star(detector: Detector, frames: Sequence[AttackedFrame], found: Sequence[Detections]) -> float:
    """The score of the best F1 on the held-out benign frames."""
    judged = EvaluatedClasses.from_detector(detector)
    wanted = [judged.map_targets(targets_from_records(frame.result.targets_benign, CLASSES)) for frame in frames]
    return score_detections(found, wanted, judged.names).t_star


def _known(detector: Detector, name: str, frames: Sequence[AttackedFrame], device: str) -> list[RetrainRow]:
    """Metrics on benign frames, and on the run's counterexamples against the original detector."""
    rows = []
    stages: tuple[tuple[Stage, tuple[LabelMode, ...]], ...] = (
        ("benign", ("paper",)),
        ("counterexample", ("moved", "paper")),
    )
    for stage, modes in stages:
        if stage == "counterexample":
            frames = [frame for frame in frames if frame.result.attacked]
            if not frames:
                continue
        found = detect_in_frames(detector, frames, stage, device)
        for mode in modes:
            scores = headline_scores(detector, detector.t_star, frames, found, mode)
            share = None
            if stage == "counterexample" and name == "before":
                won = [f.result.success_moved if mode == "moved" else f.result.success_paper for f in frames]
                share = sum(won) / len(won)
            label = "benign" if stage == "benign" else "counterexamples of the run"
            rows.append(RetrainRow(label, mode, name, len(frames), scores, share))
    return rows


def _fresh(
    config: RetrainConfig, attack: AttackConfig, held_out: Sequence[AttackedFrame], out: Path
) -> list[RetrainRow]:
    """Repeat the attack on the held-out frames against the fine-tuned detector."""
    names = [frame.name for frame in held_out][: config.fresh]
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
    discard_stale_run(out / FRESH, out / WEIGHTS, out / _FRESH_OF)
    summary = attack_frames(AttackWorker.from_config(again), names, out / FRESH)
    rows = []
    for mode, scores, won in (
        ("moved", summary.attacked_moved, summary.successes_moved),
        ("paper", summary.attacked_paper, summary.successes_paper),
    ):
        frames = summary.frames_attacked
        share = won / frames if frames else None
        rows.append(RetrainRow("fresh counterexamples", mode, "after", frames, scores.headline, share))
    return rows


def _write(out: Path, rows: Sequence[RetrainRow], verdicts: Sequence[RetrainVerdict], thresholds: str) -> None:
    """Write the metrics as CSV, and all as Markdown."""
    words = ("frames", "labels", "detector")
    sheet = ReportTable("", (*words, *SCORE_TITLES, "objects", "frames broken"), tuple(map(_cells, rows)))
    csv_name, markdown_name = TABLES
    files.write_text(out / csv_name, rows_to_csv([row.to_json() for row in rows], line_end="\r\n"))
    lines = [
        *build_verdict_table(verdicts).to_markdown(("frames", "metric", "verdict")),
        "",
        thresholds,
        "",
        NOTE,
        "",
    ]
    files.write_text(out / markdown_name, "\n".join([*lines, *sheet.to_markdown(words)[2:]]) + "\n")


def build_verdict_table(verdicts: Sequence[RetrainVerdict]) -> ReportTable:
    """The verdicts as a table."""
    title = f"{HEADLINE}, %: is the retrained detector better?"
    return ReportTable(title, VERDICT_COLUMNS, tuple(one.cells() for one in verdicts))


def _cells(row: RetrainRow) -> tuple[str, ...]:
    metrics = map(format_percent, row.scores.columns)
    return row.frames, row.labels, row.detector, *metrics, str(row.scores.objects), row.broken_text


def load_start(name: str, device: str, setting: str = "--start") -> Detector:
    """Load a detector that can be fine-tuned.

    Args:
        name: Detector.
        device: Where it runs.
        setting: Option that errors name.

    Raises:
        UsageError: The detector cannot be trained.
    """
    try:
        detector = load_detector(name, device)
        EvaluatedClasses.from_detector(detector)
    except DetectorError as error:
        raise UsageError.from_detector_error(setting, "a detector that can be trained", error) from error
    return detector


def select_counterexamples(
    frames: Sequence[AttackedFrame], mode: LabelMode, setting: str = "--run"
) -> list[AttackedFrame]:
    """Select the frames in which the attack succeeds.

    Args:
        frames: Frames of a run.
        mode: Labels that decide.
        setting: Option that errors name.

    Raises:
        UsageError: There is no such frame.
    """
    failed = [f for f in frames if (f.result.success_moved if mode == "moved" else f.result.success_paper)]
    if not failed:
        raise UsageError(setting, f"counterexamples that break the detector, by {mode} labels", "none")
    return failed


def mixture_shares(config: RetrainConfig) -> MixtureShares:
    """Read the settings of the mixture."""
    return MixtureShares(config.fraction, config.mix, round(config.ramp * config.steps), config.seed)


def fine_tune(
    config: RetrainConfig,
    detector: Detector,
    frames: Sequence[Sample],
    out: Path,
    console: Console,
    auxiliary_loss: AuxiliaryLoss | None = None,
    augment: AugmentSettings | None = None,
) -> None:
    """Fine-tune a detector in place, or resume, and freeze it again.

    Args:
        config: Settings.
        detector: The detector.
        frames: Training samples.
        out: Folder of the checkpoints.
        console: Where progress appears.
        auxiliary_loss: Further term of the loss.
        augment: Augmentation, of which window and scale are those of the settings (default: the usual one).

    Raises:
        UsageError: The loss becomes infinite.
    """
    settings = TrainingSettings(
        steps=config.steps,
        minutes=config.minutes,
        batch=config.batch,
        rate=config.rate,
        backbone_rate=1.0,  # all layers are pretrained
        warmup_steps=config.warmup,
        precision=config.precision,
        seed=config.seed,
        checkpoint_every=config.checkpoint_every,
        augment=replace(
            augment or AugmentSettings(),
            window_hw=parse_size_hw("--window", config.window),
            scale=parse_interval("--scale", config.scale),
        ),
    )
    if isinstance(detector, SqueezeDet):
        detector.trained_by = config.loss
    detector.requires_grad_(True)
    with training_progress_bar(console) as bar:
        task = bar.add_task("retraining", total=config.steps)

        def progress(done: int, steps: int, row: Mapping[str, float]) -> None:
            bar.update(task, completed=done, description=f"loss {row['total']:.3f}")

        try:
            train(detector, frames, settings, out, progress=progress, auxiliary_loss=auxiliary_loss)
        except FloatingPointError as error:
            raise UsageError("--rate", "one at which the loss stays finite", error) from error
    detector.requires_grad_(False)


def discard_stale_run(run: Path, weights: Path, stamp: Path) -> None:
    """Remove a run against other weights than the current ones.

    Args:
        run: Folder of the run.
        weights: The current weights.
        stamp: File with the digest of the run's weights.
    """
    digest = files.sha256_digest(weights)
    if run.is_dir() and (not stamp.is_file() or files.read_text(stamp) != digest):
        shutil.rmtree(run)
    files.write_text(stamp, digest)
