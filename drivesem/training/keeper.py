"""Judges a detector as it is trained, and keeps the best weights with their model card."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from detectors.base import Detector
from detectors.registry import save_detector
from detectors.training import LOG
from drivesem.evaluation.coco import evaluate
from drivesem.training.card import Recipe, card
from drivesem.training.curves import draw, read_columns
from drivesem.training.frames import FrameStore
from drivesem.training.judging import Marks, detect, judge
from scene_ir import files

EVALUATIONS, BEST, CURVES = "evaluations.csv", "best.json", "curves.png"
_COLUMNS: tuple[str, ...] = ("step", "mark", "car_ap50", "car_recall", "car_ap", "ap50", "recall", "f1", "t_star")


@dataclass(frozen=True)
class HeldOut:
    """frames: to choose and to judge by; thin: every so-and-so-many-th of them while training goes on, all for the
    card; also: further frames whose figures go into the card; test: what is judged by in the place of `frames`,
    which then only choose.
    """

    frames: FrameStore
    thin: int = 1
    also: FrameStore | None = None
    test: FrameStore | None = None


class Keeper:
    """Called with the averaged detector now and then: writes evaluations, curves, and the weights if they are the
    best so far, as float16 with t* and figures, and the card beside them.

    Without held-out frames the last weights are the best.
    """

    def __init__(
        self,
        run: Path,
        weights: Path,
        recipe: Recipe,
        held_out: HeldOut | None,
        device: str = "cpu",
        tell: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.run, self.weights, self.recipe, self.held_out = run, weights, recipe, held_out
        self.device, self.tell = device, tell
        self.wanted = held_out.frames.judged(recipe.judged) if held_out is not None else []
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
            marks = self._judge(detector, self.held_out.frames, indices)
            self._record(step, marks)
            self.tell(f"step {step}: {marks.summary()}")
            if marks.mark >= self.best:
                self.best = marks.mark
                whole = marks
                if len(indices) < len(self.wanted):
                    whole = self._judge(detector, self.held_out.frames, range(len(self.wanted)))
                self._export(detector, step, whole)
                files.write_json(self.run / BEST, {"mark": marks.mark, "step": step} | _row(step, whole))
        draw(self.run / LOG, self.run / EVALUATIONS, self.run / CURVES, f"{detector.name}, {self.run.name}")

    def _judge(self, detector: Detector, frames: FrameStore, indices: range) -> Marks:
        found = detect(detector, frames, indices, self.device)
        wanted = (
            self.wanted if self.held_out and frames is self.held_out.frames else frames.judged(self.recipe.judged)
        )
        return judge(found, [wanted[i] for i in indices], detector.classes)

    def _export(self, detector: Detector, step: int, marks: Marks | None) -> None:
        facts = {"step": str(step)}
        if marks is not None:
            detector.t_star = marks.t_star
            facts |= {"car": json.dumps(asdict(marks.scores.headline)), "f1": f"{marks.f1:.4f}"}
        save_detector(detector, self.weights, facts)
        also = None
        if self.held_out is not None and self.held_out.also is not None:
            frames = self.held_out.also
            also = len(frames), self._judge(detector, frames, range(len(frames))).scores.headline
        log = read_columns(self.run / LOG)
        seconds = float(log["seconds"][-1]) if log else 0.0
        told, chosen_on = None if marks is None else (len(self.wanted), marks), None
        if marks is not None and self.held_out is not None and self.held_out.test is not None:
            test, chosen_on = self.held_out.test, len(self.wanted)
            found, wanted = detect(detector, test, range(len(test)), self.device), test.judged(self.recipe.judged)
            scores = evaluate(wanted, found, detector.classes, marks.t_star, "Car")
            told = len(test), replace(marks, scores=scores)
        files.write_text(
            self.weights.with_suffix(".md"),
            card(detector, self.recipe, self.weights, (step, seconds), told, also, chosen_on),
        )
        self.tell(f"step {step}: wrote {self.weights}")

    def _record(self, step: int, marks: Marks) -> None:
        """Add a line; lines from this step on are of a run that was killed and went on from before."""
        path = self.run / EVALUATIONS
        kept: list[dict[str, str]] = []
        if path.is_file():
            with path.open(newline="") as file:
                kept = [row for row in csv.DictReader(file) if int(row["step"]) < step]
        table = io.StringIO(newline="")
        writer = csv.DictWriter(table, _COLUMNS)
        writer.writeheader()
        writer.writerows(kept)
        row = {k: "" if v is None else f"{v:.6g}" for k, v in _row(step, marks).items()}
        writer.writerow(row | {"step": str(step)})
        files.write_text(path, table.getvalue())


def _row(step: int, marks: Marks) -> dict[str, float | None]:
    car, every = marks.scores.headline, marks.scores.overall
    return {
        "step": step,
        "mark": marks.mark,
        "car_ap50": car.ap50,
        "car_recall": car.recall,
        "car_ap": car.ap,
        "ap50": every.ap50,
        "recall": every.recall,
        "f1": marks.f1,
        "t_star": marks.t_star,
    }
