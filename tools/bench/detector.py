"""What the detectors cost: forward, forward and backward to the image, decoding, and peak memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from detectors.base import AnchorPredictions, Detector
from detectors.registry import load_detector
from drivesem.bench.scenes import build_bench_scene
from drivesem.bench.session import Columns
from drivesem.bench.timing import CallTime, PairedTimer, Spread, TimeBudget, repetitions
from tools.bench import memory
from tools.bench.probe import ProbeOrder, image_gradient, probe

TITLE = "The detectors"
COLUMNS: Columns = {
    "detector": ("detector", "detector"), "size": ("size", "size"), "threads": ("threads", "threads"),
    "forward_ms": ("forward, ms", "forward ms"), "forward_min_ms": ("fastest", "fastest"),
    "both_ms": ("forward and backward, ms", "both"), "both_min_ms": ("fastest", "fastest"),
    "forward_cpu_ms": ("forward, processor ms", "cpu"), "forward_each_cpu_ms": ("of four at once, each", "of 4"),
    "both_cpu_ms": ("forward and backward, processor ms", "cpu"),
    "both_each_cpu_ms": ("of four at once, each", "of 4"),
    "decode_ms": ("decode, ms", "decode"), "decode_worst_ms": ("at worst", "at worst"),
    "peak_mb": ("peak, MB", "peak MB"), "rounds": ("rounds", None),
}  # fmt: skip
METHOD = (
    "A generated street of 8 cars, resized to each size. forward: without gradient, up to the raw predictions; "
    "forward and backward: raw predictions, the loss that attacks raise for one object, and its gradient to the "
    "image; decode: scores, the best of them and non-maximum suppression, of what was predicted and, at worst, "
    "with every anchor confident. All are measured in turn in one process after a warm-up; the median of the "
    "rounds stands next to the fastest, which is what an idle machine does. Processor ms: by the processor's time, "
    "all threads together, of a picture by itself, and of each of four in one batch. Peak memory is that of a "
    "process of its own, forward and backward, above what it holds once the detector is loaded."
)
SIZES_HW = ((384, 1248), (192, 624))
_CARS, _TRIANGLES = 8, 600
_BATCH = 4
_FEWEST, _MOST = 3, 400
_SURE = 30.0
"""Added to the logits of all confidences: every anchor is a candidate."""
_STEPS = 6
"""Steps of the process for memory; its peak is reached in the first ones."""
_KB = 1024.0


@dataclass(frozen=True, slots=True)
class DetectorRow:
    """One detector at one size, width x height. Times in ms, medians, and the fastest."""

    detector: str
    size: str
    threads: int
    forward_ms: float
    forward_min_ms: float
    both_ms: float
    both_min_ms: float
    forward_cpu_ms: float
    forward_each_cpu_ms: float
    both_cpu_ms: float
    both_each_cpu_ms: float
    decode_ms: float
    decode_min_ms: float
    decode_worst_ms: float
    peak_mb: float | None
    """MB above the loaded detector, None where it is not measured."""
    rounds: int
    """Repetitions. each: of `_BATCH` at once."""


def measure(names: Sequence[str], seconds: float, seed: int, device: str) -> Iterator[DetectorRow]:
    """Yield one row per detector and size, within about `seconds` in total.

    DetectorError for a missing detector or one without gradients, FormatError if the process that measures
    memory ends without a result.
    """
    photograph = build_bench_scene(_CARS, _TRIANGLES, seed).scene.photograph[None].float()
    budget = TimeBudget(seconds, len(names) * len(SIZES_HW))
    for name in names:
        detector = load_detector(name, device)
        for size in SIZES_HW:
            image = F.interpolate(photograph, size, mode="bilinear").clamp(0, 1).to(device)
            image = image.contiguous(memory_format=torch.channels_last)
            yield _row(name, detector, image, PairedTimer(device), budget.share())


def _row(name: str, detector: Detector, image: Tensor, clock: PairedTimer, seconds: float) -> DetectorRow:
    height, width = image.shape[2:]
    with torch.no_grad():
        raw = detector(image)
    sure = replace(raw, confidence_logits=raw.confidence_logits + _SURE)
    several = image.repeat(_BATCH, 1, 1, 1).contiguous(memory_format=torch.channels_last)
    calls: dict[str, Callable[[], object]] = {
        "forward": lambda: _judge(detector, image),
        "both": lambda: image_gradient(detector, image),
        "decode": lambda: detector.decode(raw),
        "worst": lambda: detector.decode(sure),
        "forward_each": lambda: _judge(detector, several),
        "both_each": lambda: image_gradient(detector, several),
    }
    for call in calls.values():
        call()
    times: dict[str, list[CallTime]] = {key: [] for key in calls}
    for _ in repetitions(seconds, _FEWEST, _MOST):
        for key, call in calls.items():
            times[key].append(clock.time_call(call))
    median = {key: round(Spread.from_values([one.ms for one in found]).median, 3) for key, found in times.items()}
    fastest = {key: round(min(one.ms for one in found), 3) for key, found in times.items()}
    spent = {key: Spread.from_values([one.cpu_ms for one in found]).median for key, found in times.items()}
    return DetectorRow(
        detector=name,
        size=f"{width}x{height}",
        threads=torch.get_num_threads(),
        forward_ms=median["forward"],
        forward_min_ms=fastest["forward"],
        both_ms=median["both"],
        both_min_ms=fastest["both"],
        forward_cpu_ms=round(spent["forward"], 3),
        forward_each_cpu_ms=round(spent["forward_each"] / _BATCH, 3),
        both_cpu_ms=round(spent["both"], 3),
        both_each_cpu_ms=round(spent["both_each"] / _BATCH, 3),
        decode_ms=median["decode"],
        decode_min_ms=fastest["decode"],
        decode_worst_ms=median["worst"],
        peak_mb=_peak_mb(name, height, width) if image.device.type == "cpu" and memory.supported() else None,
        rounds=len(times["both"]),
    )


@torch.no_grad()
def _judge(detector: Detector, image: Tensor) -> AnchorPredictions:
    return detector(image)


def _peak_mb(name: str, height: int, width: int) -> float:
    """Peak of a fresh process above what it holds with the detector loaded, MB."""
    resident = probe(
        "detector", ProbeOrder(name, torch.get_num_threads(), (height, width), steps=_STEPS), "bench detector"
    )
    return round((resident.peak_kb - resident.loaded_kb) / _KB, 1)
