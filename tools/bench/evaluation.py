"""Time of `drivesem eval` for many frames, files included, against pycocotools alone."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivesem.bench.session import Columns
from drivesem.evaluation.coco import fastest_engine
from scene_ir import files
from scene_ir.errors import FormatError

TITLE = "Evaluation of many frames"
COLUMNS: Columns = {
    "protocol": ("protocol", "protocol"), "engine": ("counted by", "counted by"),
    "frames": ("frames", "frames"), "detections": ("detections", "detections"),
    "seconds": ("seconds", "seconds"), "processor_s": ("processor time, s", "processor, s"),
    "ratio": ("ratio", "ratio"),
}  # fmt: skip
METHOD = (
    "Random frames of 5 objects (Car, Pedestrian or Cyclist; a tenth DontCare) and 20 detections: three around "
    "each object and five elsewhere. pycocotools alone: its classes in this process, once they are loaded: "
    "COCO, loadRes, evaluate, accumulate, summarize. The other rows are whole commands, in processes of their "
    "own: start, reading the files, figures by class and part, and for COCO the twelve numbers by the engine "
    "that is named. --bootstrap 0. Medians of three rounds, in turn. ratio: of processor time, to that of "
    "pycocotools alone."
)
FULL_FRAMES, QUICK_FRAMES = 20_000, 1_000
_ROUNDS = 3
_OBJECTS, _AROUND, _ELSEWHERE = 5, 3, 5
_CLASSES = ("Car", "Pedestrian", "Cyclist")
_WIDTH, _HEIGHT = 1242, 375
_START = "import sys; from drivesem.cli import main; sys.exit(main())"
"""What the installed `drivesem` runs."""


@dataclass(frozen=True, slots=True)
class EvaluationRow:
    """One way from files to figures."""

    protocol: str
    engine: str
    frames: int
    detections: int
    seconds: float
    """Wall time."""
    processor_s: float
    """Of all threads."""
    ratio: float
    """The latter over pycocotools' own."""


def measure(frames: int, seed: int) -> Iterator[EvaluationRow]:
    """pycocotools alone, then `drivesem eval` by COCO's protocol and by KITTI's.

    Raises FormatError where the command fails.
    """
    with tempfile.TemporaryDirectory(prefix="drivesem-bench-") as name:
        folder = Path(name)
        detections = _write(folder, frames, seed)
        places = {"coco": ("truth.json", "found.json"), "kitti": ("label_2", "found")}
        truth, found = (folder / name for name in places["coco"])
        taken: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for _ in range(_ROUNDS):
            taken.setdefault(("coco", "pycocotools alone"), []).append(_pycocotools(truth, found))
            for protocol, engine in (("coco", fastest_engine()), ("kitti", "drivesem")):
                gt, pred = (str(folder / name) for name in places[protocol])
                spent = _command(["--gt", gt, "--pred", pred, "--protocol", protocol])
                taken.setdefault((protocol, engine), []).append(spent)
        alone = 0.0
        for (protocol, engine), rounds in taken.items():
            seconds, processor = (median(each) for each in zip(*rounds, strict=True))
            alone = alone or processor
            row = EvaluationRow(protocol, engine, frames, detections, round(seconds, 2), round(processor, 2), 0.0)
            yield replace(row, ratio=round(processor / alone, 3))


def _write(folder: Path, frames: int, seed: int) -> int:
    """The same random frames as COCO's files and as KITTI's; how many detections they hold."""
    draw = np.random.default_rng(seed)
    images, truth, found = [], [], []
    for kind in ("label_2", "found"):
        (folder / kind).mkdir()
    for frame in range(1, frames + 1):
        name = f"{frame:06d}"
        images.append({"id": frame, "file_name": f"{name}.png", "width": _WIDTH, "height": _HEIGHT})
        objects = _boxes(draw, _OBJECTS)
        labels = draw.integers(0, len(_CLASSES), _OBJECTS)
        regions = draw.random(_OBJECTS) < 0.1
        near = np.repeat(objects, _AROUND, 0) + draw.normal(0, 3, (_OBJECTS * _AROUND, 4))
        boxes = np.round(_inside(np.concatenate([near, _boxes(draw, _ELSEWHERE)])), 2)
        detected_labels = np.concatenate([np.repeat(labels, _AROUND), draw.integers(0, len(_CLASSES), _ELSEWHERE)])
        scores = np.round(draw.random(len(boxes)), 4)
        for box, label, region in zip(objects.tolist(), labels.tolist(), regions.tolist(), strict=True):
            truth.append(_annotation(box, frame, label) | {"id": len(truth) + 1, "iscrowd": int(region)})
        for box, label, score in zip(boxes.tolist(), detected_labels.tolist(), scores.tolist(), strict=True):
            found.append(_annotation(box, frame, label) | {"score": score})
        lines = [
            _kitti("DontCare" if r else _CLASSES[k], b) for b, k, r in zip(objects, labels, regions, strict=True)
        ]
        (folder / "label_2" / f"{name}.txt").write_text("\n".join(lines) + "\n")
        lines = [f"{_kitti(_CLASSES[k], b)} {s}" for b, k, s in zip(boxes, detected_labels, scores, strict=True)]
        (folder / "found" / f"{name}.txt").write_text("\n".join(lines) + "\n")
    categories = [{"id": k + 1, "name": name} for k, name in enumerate(_CLASSES)]
    files.write_json(folder / "truth.json", {"images": images, "categories": categories, "annotations": truth})
    files.write_json(folder / "found.json", found)
    return len(found)


def _boxes(draw: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Boxes (count, 4) px, xyxy, as large as KITTI's cars."""
    corner = draw.uniform((0, 100), (_WIDTH - 60, _HEIGHT - 60), (count, 2))
    return np.round(_inside(np.concatenate([corner, corner + draw.uniform(26, 180, (count, 2))], 1)), 2)


def _inside(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    held = np.clip(boxes, 0, (_WIDTH - 2, _HEIGHT - 2, _WIDTH - 1, _HEIGHT - 1))
    held[:, 2:] = np.maximum(held[:, 2:], held[:, :2] + 1)
    return held


def _annotation(box: list[float], frame: int, label: int) -> dict[str, Any]:
    """KITTI's box counts pixels by their centres, COCO's by their edges."""
    x0, y0, x1, y1 = box
    width, height = round(x1 - x0, 2), round(y1 - y0, 2)
    bbox = [round(x0 + 0.5, 2), round(y0 + 0.5, 2), width, height]
    return {"image_id": frame, "category_id": label + 1, "bbox": bbox, "area": width * height}


def _kitti(kind: str, box: NDArray[np.float64]) -> str:
    edges = " ".join(f"{edge:.2f}" for edge in box)
    return f"{kind} 0.00 0 -10 {edges} -1 -1 -1 -1000 -1000 -1000 -10"


def _pycocotools(truth: Path, found: Path) -> tuple[float, float]:
    """Seconds, and those of the processor, that pycocotools takes to read two files and count."""
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    with contextlib.redirect_stdout(io.StringIO()):
        start, before = time.perf_counter(), time.process_time()
        dataset = COCO(str(truth))
        evaluator = COCOeval(dataset, dataset.loadRes(str(found)), iouType="bbox")
        evaluator.evaluate()
        evaluator.accumulate()
        evaluator.summarize()
        return time.perf_counter() - start, time.process_time() - before


def _command(words: list[str]) -> tuple[float, float]:
    """Seconds, and those of the processor, that `drivesem eval` takes, from its start to its end."""
    start, before = time.perf_counter(), _of_children()
    whole = [sys.executable, "-c", _START, "eval", *words, "--bootstrap", "0", "--json"]
    done = subprocess.run(whole, capture_output=True, text=True, check=False)
    seconds, processor = time.perf_counter() - start, _of_children() - before
    if done.returncode != 0 or not json.loads(done.stdout):
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise FormatError("bench eval: command", "a result", f"exit code {done.returncode}: {last}")
    return seconds, processor


def _of_children() -> float:
    """Processor seconds of all processes that this one started and that ended."""
    times = os.times()
    return times.children_user + times.children_system
