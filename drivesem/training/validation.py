"""Evaluates a detector while it trains, and saves the best weights with their model card."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from detectors import boxes
from detectors.base import Detector, Predictor, predict
from detectors.registry import save_detector
from detectors.training import LOG
from detectors.types import Detections, Targets
from drivesem.evaluation.coco import evaluate
from drivesem.training.card import CardFacts, ValidationScores, format_card, plot_curves, read_columns
from drivesem.training.frames import FrameStore
from scene_ir import files

EVALUATIONS, BEST, CURVES = "evaluations.csv", "best.json", "curves.png"
_COLUMNS: tuple[str, ...] = ("step", "mark", "car_ap50", "car_recall", "car_ap", "ap50", "recall", "f1", "t_star")


@dataclass(frozen=True)
class ValidationSet:
    """Frames that are not trained on."""

    frames: FrameStore
    """Frames that select weights and t*, and measure them unless there is a `test`."""
    thin: int = 1
    """Stride of the frames in evaluations during training; the card uses all."""
    also: FrameStore | None = None
    """Further frames that the card reports."""
    test: FrameStore | None = None
    """Frames that measure instead of `frames`, which then only select."""


class CheckpointSelector:
    """Evaluates the averaged detector, writes evaluations and curves, and saves the weights if they are the best so
    far, as float16 with t* and metrics, with their model card.

    Without held-out frames, the last weights are the best.
    """

    def __init__(
        self,
        run: Path,
        weights: Path,
        recipe: CardFacts,
        held_out: ValidationSet | None,
        device: str = "cpu",
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Prepare the evaluation.

        Args:
            run: Folder of the run.
            weights: File of the best weights.
            recipe: Facts for the model card.
            held_out: Frames to evaluate on; None for none.
            device: Where the detector runs.
            report: Receives lines of progress.
        """
        self.run, self.weights, self.recipe, self.held_out = run, weights, recipe, held_out
        self.device, self.report = device, report
        self.wanted = held_out.frames.evaluation_targets(recipe.judged) if held_out is not None else []
        best = files.read_json(run / BEST) if (run / BEST).is_file() else {}
        self.best = float(best.get("mark", 0.0))
        self._judged_step = -1

    def __call__(self, detector: Detector, step: int) -> None:
        if step == self._judged_step:
            return
        self._judged_step = step
        if self.held_out is None:
            self._export(detector, step, None)
        else:
            indices = range(0, len(self.wanted), self.held_out.thin)
            scores = self._evaluate(detector, self.held_out.frames, indices)
            self._record(step, scores)
            self.report(f"step {step}: {scores.summary()}")
            if scores.selection_score >= self.best:
                self.best = scores.selection_score
                whole = scores
                if len(indices) < len(self.wanted):
                    whole = self._evaluate(detector, self.held_out.frames, range(len(self.wanted)))
                self._export(detector, step, whole)
                files.write_json(
                    self.run / BEST, {"mark": scores.selection_score, "step": step} | _row(step, whole)
                )
        plot_curves(self.run / LOG, self.run / EVALUATIONS, self.run / CURVES, f"{detector.name}, {self.run.name}")

    def _evaluate(self, detector: Detector, frames: FrameStore, indices: range) -> ValidationScores:
        found = detect_in_store(detector, frames, indices, self.device)
        wanted = (
            self.wanted
            if self.held_out and frames is self.held_out.frames
            else frames.evaluation_targets(self.recipe.judged)
        )
        return score_detections(found, [wanted[i] for i in indices], detector.classes)

    def _export(self, detector: Detector, step: int, scores: ValidationScores | None) -> None:
        facts = {"step": str(step)}
        if scores is not None:
            detector.t_star = scores.t_star
            facts |= {"car": json.dumps(asdict(scores.scores.headline)), "f1": f"{scores.f1:.4f}"}
        save_detector(detector, self.weights, facts)
        also = None
        if self.held_out is not None and self.held_out.also is not None:
            frames = self.held_out.also
            also = len(frames), self._evaluate(detector, frames, range(len(frames))).scores.headline
        log = read_columns(self.run / LOG)
        seconds = float(log["seconds"][-1]) if log else 0.0
        measured, chosen_on = None if scores is None else (len(self.wanted), scores), None
        if scores is not None and self.held_out is not None and self.held_out.test is not None:
            test, chosen_on = self.held_out.test, len(self.wanted)
            found, wanted = (
                detect_in_store(detector, test, range(len(test)), self.device),
                test.evaluation_targets(self.recipe.judged),
            )
            coco_scores = evaluate(wanted, found, detector.classes, scores.t_star, "Car")
            measured = len(test), replace(scores, scores=coco_scores)
        files.write_text(
            self.weights.with_suffix(".md"),
            format_card(detector, self.recipe, self.weights, (step, seconds), measured, also, chosen_on),
        )
        self.report(f"step {step}: wrote {self.weights}")

    def _record(self, step: int, scores: ValidationScores) -> None:
        """Append a line; replace lines from this step on, which an interrupted run left behind."""
        path = self.run / EVALUATIONS
        earlier: list[dict[str, str]] = []
        if path.is_file():
            with path.open(newline="") as file:
                earlier = [row for row in csv.DictReader(file) if int(row["step"]) < step]
        table = io.StringIO(newline="")
        writer = csv.DictWriter(table, _COLUMNS)
        writer.writeheader()
        writer.writerows(earlier)
        row = {k: "" if v is None else f"{v:.6g}" for k, v in _row(step, scores).items()}
        writer.writerow(row | {"step": str(step)})
        files.write_text(path, table.getvalue())


def _row(step: int, scores: ValidationScores) -> dict[str, float | None]:
    car, every = scores.scores.headline, scores.scores.overall
    return {
        "step": step,
        "mark": scores.selection_score,
        "car_ap50": car.ap50,
        "car_recall": car.recall,
        "car_ap": car.ap,
        "ap50": every.ap50,
        "recall": every.recall,
        "f1": scores.f1,
        "t_star": scores.t_star,
    }


EXCUSED = 0.5
"""IoU with an ignored box, or share inside it, above which a detection does not count."""
HIT_IOU = 0.5


def score_detections(
    found: Sequence[Detections], wanted: Sequence[Targets], classes: Sequence[str], headline: str = "Car"
) -> ValidationScores:
    """Compute COCO's metrics, and the score of the best F1 over all classes.

    Args:
        found: Detections in each image.
        wanted: Labels of each image.
        classes: Names of the classes.
        headline: Class that the paper reports.
    """
    outcomes = [_outcomes(d, t, k) for d, t in zip(found, wanted, strict=True) for k in range(len(classes))]
    rows = np.concatenate(outcomes)
    rows = rows[np.argsort(-rows[:, 0], kind="stable")]
    hits = np.cumsum(rows[:, 1])
    f1 = 2 * hits / (np.arange(1, len(rows) + 1) + sum(int((~t.ignore).sum()) for t in wanted))
    best = int(np.argmax(f1)) if len(f1) else -1
    f1, t_star = (float(f1[best]), float(rows[best, 0])) if len(f1) else (0.0, 0.5)
    return ValidationScores(evaluate(wanted, found, classes, t_star, headline), f1, t_star)


def _outcomes(found: Detections, wanted: Targets, label: int) -> np.ndarray:
    """(K, 2) score and hit of each detection of a class that counts."""
    mine = found.labels == label
    boxes_xyxy, confidences = found.boxes_xyxy[mine], found.scores[mine]
    counted = (wanted.labels == label) & ~wanted.ignore
    overlap = boxes.iou_matrix(boxes_xyxy, wanted.boxes_xyxy[counted]).numpy()
    ignored = wanted.boxes_xyxy[wanted.ignore & (wanted.labels == label)]
    excused = (boxes.iou_matrix(boxes_xyxy, ignored) > EXCUSED) | (boxes.ioa_matrix(boxes_xyxy, ignored) > EXCUSED)
    excused = excused.any(1).numpy() if len(ignored) else np.zeros(len(confidences), bool)
    free = np.ones(overlap.shape[1], bool)
    rows = []
    for i, score in enumerate(confidences.tolist()):
        candidates = np.where(free, overlap[i], 0.0)
        if candidates.size and candidates.max() >= HIT_IOU:
            free[candidates.argmax()] = False
            rows.append((score, 1.0))
        elif not excused[i]:
            rows.append((score, 0.0))
    return np.array(rows, np.float64).reshape(-1, 2)


def detect_in_store(
    detector: Predictor, frames: FrameStore, indices: Sequence[int], device: str = "cpu"
) -> list[Detections]:
    """Detect objects in whole frames.

    Args:
        detector: The detector.
        frames: Frames.
        indices: Which of them.
        device: Where the detector runs.

    Returns:
        Detections of each frame, on the CPU.
    """
    found = []
    for index in indices:
        image = torch.from_numpy(np.array(frames.image(index))).permute(2, 0, 1)[None].float() / 255
        for one in predict(detector, image.to(device)):
            found.append(Detections(one.boxes_xyxy.cpu(), one.labels.cpu(), one.scores.cpu()))
    return found
