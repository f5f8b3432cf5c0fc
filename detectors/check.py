"""Tests whether a detector fulfils the contract of `detectors.base` on generated images.

The gradient is compared with central differences along random directions, in float64 if the detector supports it:
there, steps of 1e-6 cross few of a network's kinks. Rounding in float32 requires steps that cross many.
"""

from __future__ import annotations

import contextlib
import copy
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors import boxes
from detectors.adapters.formats import OutputDecoder
from detectors.base import (
    Detector,
    DetectorError,
    InjectablePredictions,
    Predictor,
    RawPredictions,
    describe_error,
    predict,
    user_code_frames,
)
from detectors.types import Detections, Targets

Verdict = Literal["ok", "failed", "raised", "not tried"]
"""Outcome of one check."""
Plant = Callable[[Any, Tensor, int], Any]
"""Maps raw predictions, a box (4,) px and a label to predictions with only this one."""

IMAGE_HW = (192, 320)
"""Default image size, px: deliberately no multiple of a stride, and small enough for float64."""
REQUIRED_TERMS = ("total", "objectness")
OUTSIDE_PX = 1e-3
"""Tolerance for boxes beyond the image, px."""
SAME_BOX_IOU = 0.98
"""Least IoU of an injected box with the decoded one."""
SAME_PX = 0.1
"""Tolerance for box sides, px: batches compute in another order than single images."""
SAME_SCORE = 1e-3
"""Tolerance for scores."""
SAME_LOSS = 1e-3
"""Relative tolerance for losses."""
MAX_SHARE_DIFFERING = 0.02
"""Share of detections that may differ: suppression may take either of two nearly tied boxes."""

DIRECTIONS = 3
STEPS: dict[torch.dtype, tuple[float, ...]] = {
    torch.float64: (1e-3, 1e-4, 1e-5, 1e-6, 1e-7),
    torch.float32: (3e-2, 1e-2, 3e-3, 1e-3),
}
"""Steps of the differences, root mean square over the image, in units of its [0, 1] range. The best one counts:
slopes of a network without confident predictions drown in rounding when steps are small.
"""
TOLERANCES: dict[torch.dtype, float] = {torch.float64: 0.05, torch.float32: 0.2}
"""Largest relative error of the slopes: norm of their difference over that of the differences. float64's is that
of `python -m tools.bench gradcheck`.
"""
_DESCENT_TRIALS = 40
_MAX_STEP = 0.3
"""Largest step along a gradient, root mean square over pixels in [0, 1] or over weights."""
_MIN_DROP = 100
"""Least decrease of a loss, in units of rounding."""


@dataclass(frozen=True, slots=True)
class ContractCheck:
    """Outcome of one check."""

    name: str
    """The part of the contract that was checked."""
    verdict: Verdict
    """"raised" means that the detector's own code raised an error."""
    detail: str
    """What was measured, or why the check was not made."""


@dataclass(frozen=True, slots=True)
class ContractReport:
    """Outcome of all checks."""

    detector: str
    """The detector's name."""
    gradients: bool
    """Whether the detector promises gradients."""
    findings: tuple[ContractCheck, ...]
    """One per check, in order."""

    @property
    def failed(self) -> tuple[ContractCheck, ...]:
        """Checks that failed or raised."""
        return tuple(finding for finding in self.findings if finding.verdict in ("failed", "raised"))

    @property
    def raised(self) -> tuple[ContractCheck, ...]:
        """Checks in which the detector's own code raised an error."""
        return tuple(finding for finding in self.findings if finding.verdict == "raised")

    def require(self) -> ContractReport:
        """Return the report.

        Raises:
            DetectorError: Some check failed; the message lists all that did.
        """
        if self.failed:
            details = "; ".join(f"{finding.name}: {finding.detail}" for finding in self.failed)
            raise DetectorError(f"detector {self.detector!r} violates the contract: {details}")
        return self


CAR = "Car"
TINY_PX = 4.0
"""Cars in photographs of streets are higher than this, px."""
_SAME_PLACE_PX = 1.0


@dataclass(frozen=True, slots=True)
class StreetDetections:
    """Cars, or objects of other classes, that a detector finds in pictures of streets with some."""

    pictures: int
    """Number of pictures."""
    boxes: int
    """Objects of the classes with a score of at least t*."""
    score_low: float | None
    """Lowest score of all detections, of any class; None if there is none."""
    score_high: float | None
    """Highest score."""
    height_low_px: float | None
    """Height of the lowest of the boxes, px."""
    height_high_px: float | None
    """Height of the highest, px."""
    problem: str | None
    """Why this is no detector of the classes, as far as the pictures show; None if nothing is wrong."""

    @property
    def as_check(self) -> ContractCheck:
        """As a check of the contract."""
        if self.problem is not None:
            return ContractCheck(STREET_CHECK, "failed", self.problem)
        heights = f"{self.height_low_px or 0:.0f} to {self.height_high_px or 0:.0f} px high"
        scores = f"scores {self.score_low or 0:.2f} to {self.score_high or 0:.2f}"
        return ContractCheck(
            STREET_CHECK, "ok", f"{self.boxes} cars in {self.pictures} streets, {heights}; {scores}"
        )


STREET_CHECK = "cars on streets"
"""Name of the check on pictures of streets."""


def survey_streets(
    detector: Predictor,
    pictures: Iterable[Tensor],
    t_star: float,
    until_found: bool = False,
    classes: Sequence[str] = (CAR,),
) -> tuple[StreetDetections, list[Detections]]:
    """Detect cars, or objects of other classes, in pictures of streets with some.

    Args:
        detector: The detector under test.
        pictures: Each (3, H, W) in [0, 1], on the detector's device.
        t_star: Lowest score of a detection that counts.
        until_found: End with the first picture in which one is found.
        classes: Classes to detect.

    Returns:
        What was found in them, and the detections in each.
    """
    found: list[Detections] = []
    labels = torch.tensor([i for i, name in enumerate(detector.classes) if name in classes])
    noun = " or ".join(classes)
    for picture in pictures:
        found.extend(predict(detector, picture[None]))
        survey = _summarise_streets(found, labels, t_star, noun)
        if until_found and survey.boxes and survey.problem is None:
            break
    survey = _summarise_streets(found, labels, t_star, noun)
    if not len(labels):
        survey = replace(survey, problem=f"no class {noun} among {', '.join(detector.classes[:6])}")
    reading = describe_reading(detector)
    if survey.problem is not None and reading:
        survey = replace(survey, problem=f"{survey.problem}; {reading}")
    return survey, found


def describe_reading(detector: Predictor) -> str:
    """How a network's outputs are read, and what else they could be; or what a MAITE model gets; empty for others."""
    decoder = getattr(detector, "decoder", None)
    return decoder.describe() if isinstance(decoder, OutputDecoder) else getattr(detector, "reading", "")


def _summarise_streets(found: Sequence[Detections], labels: Tensor, t_star: float, noun: str) -> StreetDetections:
    rows = [torch.isin(one.labels, labels.to(one.labels)) for one in found]
    boxes = [one.boxes_xyxy[mine & (one.scores >= t_star)] for one, mine in zip(found, rows, strict=True)]
    boxes_xyxy = torch.cat(boxes) if boxes else torch.zeros(0, 4)
    scores = torch.cat([one.scores for one in found]) if found else torch.zeros(0)
    sides = boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]
    low, high = (float(scores.min()), float(scores.max())) if len(scores) else (None, None)
    problem = None
    if low is not None and high is not None and not 0 <= low <= high <= 1:
        problem = f"scores outside [0, 1], from {low:.3g} to {high:.3g}"
    elif not len(boxes_xyxy):
        best = f"the best score is {high:.3g}" if high is not None else "no detection at all"
        of_them = [float(one.scores[mine].max()) for one, mine in zip(found, rows, strict=True) if mine.any()]
        if of_them:
            best = f"the best score of one is {max(of_them):.3g}"
        problem = f"no {noun.lower()} with a score of {t_star:.3g} or more in {len(found)} pictures ({best})"
    elif float(sides.amax(1).max()) < TINY_PX:
        problem = f"only boxes with sides below {TINY_PX:g} px"
    elif len(boxes_xyxy) > 1 and float((boxes_xyxy - boxes_xyxy[0]).abs().max()) < _SAME_PLACE_PX:
        problem = f"{len(boxes_xyxy)} times the same box, {_format_box(boxes_xyxy[0])}"
    heights = sides[:, 1]
    return StreetDetections(
        len(found),
        len(boxes_xyxy),
        low,
        high,
        float(heights.min()) if len(heights) else None,
        float(heights.max()) if len(heights) else None,
        problem,
    )


class _Violation(Exception):  # noqa: N818  (ends one check)
    """A failed check; the text explains it."""


class _NotApplicable(Exception):  # noqa: N818
    """A check that does not apply to this detector."""


@dataclass(frozen=True, slots=True)
class ContractInputs:
    """Inputs of every check."""

    detector: Predictor
    """The detector under test."""
    images: Tensor
    """(2, 3, H, W) in [0, 1]."""
    targets: tuple[Targets, ...]
    """Targets of each image."""
    plant: Plant | None
    """Injects a prediction; see `Plant`."""
    seed: int
    """Seed of the images and the directions."""

    @property
    def differentiable(self) -> Detector:
        """The detector, if it has gradients; otherwise raises `_NotApplicable`."""
        if not isinstance(self.detector, Detector):
            raise _NotApplicable("a detector without gradients")
        return self.detector


def check_detector(
    detector: Predictor,
    image_hw: tuple[int, int] = IMAGE_HW,
    plant: Plant | None = None,
    seed: int = 0,
    device: str | torch.device = "cpu",
) -> ContractReport:
    """Check every part of the contract. The detector is frozen and otherwise left unchanged.

    Args:
        detector: The detector under test.
        image_hw: Size of the images, px.
        plant: Injects a prediction into raw predictions that have no `inject`; without either, decoding is tested
            only on what the detector finds.
        seed: Seed of the images and the directions.
        device: Device of the images.

    Raises:
        DetectorError: The detector has no class names. All other faults are in the report.
    """
    if isinstance(detector, nn.Module):
        detector.requires_grad_(False)
        detector.eval()
    try:
        inputs = ContractInputs(detector, *make_images(image_hw, detector.classes, seed, device), plant, seed)
    except (AttributeError, TypeError) as error:
        raise DetectorError(f"detector: classes: expected names, found {describe_error(error)}") from error
    # A copy for each check: a detector may write into its input.
    findings = [_run_check(name, check, replace(inputs, images=inputs.images.clone())) for name, check in _CHECKS]
    return ContractReport(str(getattr(detector, "name", "?")), isinstance(detector, Detector), tuple(findings))


def make_images(
    image_hw: tuple[int, int], classes: Sequence[str], seed: int, device: str | torch.device
) -> tuple[Tensor, tuple[Targets, ...]]:
    """Two images of smooth noise with darker blocks.

    Args:
        image_hw: Size, px.
        classes: The detector's classes.
        seed: Seed of the noise.
        device: Device of the result.

    Returns:
        Images (2, 3, H, W) in [0, 1], and a Targets each: the blocks, labelled as cars if the detector knows cars,
        and an ignored region.
    """
    generator = torch.Generator().manual_seed(seed)
    height, width = image_hw
    coarse = torch.rand(2, 3, max(height // 8, 2), max(width // 8, 2), generator=generator)
    images = F.interpolate(coarse, image_hw, mode="bicubic", align_corners=False)
    images = images + 0.05 * torch.randn(images.shape, generator=generator)
    unit = torch.tensor([width, height, width, height], dtype=torch.float32)
    blocks = torch.tensor([[0.1, 0.4, 0.4, 0.8], [0.55, 0.35, 0.8, 0.7], [0.8, 0.1, 0.98, 0.3]]) * unit
    for left, top, right, bottom in blocks.round().int().tolist():
        images[:, :, top:bottom, left:right] *= 0.4
    label = classes.index("Car") if "Car" in classes else 0
    labels, ignore = torch.full((3,), label), torch.tensor([False, False, True])
    second = Targets(blocks[1:].to(device), labels[1:].to(device), ignore[1:].to(device))
    first = Targets(blocks.to(device), labels.to(device), ignore.to(device))
    return images.clamp(0, 1).to(device), (first, second)


def _run_check(name: str, check: Callable[[ContractInputs], str], inputs: ContractInputs) -> ContractCheck:
    try:
        return ContractCheck(name, "ok", check(inputs))
    except _NotApplicable as reason:
        return ContractCheck(name, "not tried", str(reason))
    except _Violation as reason:
        return ContractCheck(name, "failed", str(reason))
    except Exception as error:  # user code may raise anything
        return ContractCheck(name, "raised" if user_code_frames(error) else "failed", describe_error(error))


def _check_attributes(inputs: ContractInputs) -> str:
    detector = inputs.detector
    if not (isinstance(detector.name, str) and detector.name):
        raise _Violation(f"name: expected a non-empty string, found {detector.name!r}")
    classes = detector.classes
    if not (isinstance(classes, tuple) and classes and all(isinstance(c, str) and c for c in classes)):
        raise _Violation(f"classes: expected a tuple of names, found {classes!r}")
    if len(set(classes)) != len(classes):
        raise _Violation(f"classes: expected each once, found {', '.join(classes)}")
    detail = f"{len(classes)} classes, " + (
        f"Car is {classes.index('Car')}" if "Car" in classes else "without Car"
    )
    if isinstance(detector, Detector):
        if not 0 <= detector.t_star <= 1:
            raise _Violation(f"t_star: expected a number in [0, 1], found {detector.t_star!r}")
        detail += f", t* {detector.t_star:.3f}"
    return detail


def _check_raw_predictions(inputs: ContractInputs) -> str:
    detector = inputs.differentiable
    raw = detector(inputs.images)
    if not isinstance(raw, RawPredictions):
        raise _Violation(f"forward: expected a length and `select`, found {type(raw).__name__}")
    if len(raw) != len(inputs.images):
        raise _Violation(f"len(raw): expected {len(inputs.images)}, found {len(raw)}")
    if len(raw.select(1)) != 1:
        raise _Violation(f"len(raw.select(1)): expected 1, found {len(raw.select(1))}")
    return type(raw).__name__


def _check_detections(inputs: ContractInputs) -> str:
    counts = []
    height, width = inputs.images.shape[2:]
    odd = inputs.images[:, :, : height - 7, : width - 13]
    for images in (inputs.images, odd):
        found = predict(inputs.detector, images)
        if not isinstance(found, list) or len(found) != len(images):
            raise _Violation(f"decode: expected a list of {len(images)}, found {found!r}"[:200])
        for detections in found:
            _check_well_formed(detections, images.shape[2:], len(inputs.detector.classes))
            counts.append(len(detections))
    return (
        f"{', '.join(map(str, counts))} boxes in images of {width} x {height} and {width - 13} x {height - 7} px"
    )


def _check_well_formed(found: Detections, image_hw: Sequence[int], classes: int) -> None:
    if not isinstance(found, Detections):
        raise _Violation(f"decode: expected Detections, found {type(found).__name__}")
    placed, scores, labels = found.boxes_xyxy, found.scores, found.labels
    if placed.requires_grad or scores.requires_grad:
        raise _Violation("decode: expected no gradient, found one")
    if labels.dtype != torch.int64:
        raise _Violation(f"labels: expected int64, found {labels.dtype}")
    if not bool(torch.isfinite(placed).all() & torch.isfinite(scores).all()):
        raise _Violation("boxes and scores: expected finite numbers, found others")
    if not len(found):
        return
    height, width = image_hw
    limit = placed.new_tensor([width, height, width, height]) - 1 + OUTSIDE_PX
    if bool((placed < -OUTSIDE_PX).any() | (placed > limit).any()):
        worst = placed[((placed < -OUTSIDE_PX) | (placed > limit)).any(1)][0]
        raise _Violation(f"boxes: expected inside 0..{width - 1} x 0..{height - 1}, found {_format_box(worst)}")
    if bool((placed[:, 2:] < placed[:, :2]).any()):
        raise _Violation(f"boxes: expected left <= right, top <= bottom, found {_format_box(placed[0])}")
    if bool((scores < 0).any() | (scores > 1).any()):
        raise _Violation(f"scores: expected in [0, 1], found {float(scores.min()):g} to {float(scores.max()):g}")
    if bool((scores[1:] > scores[:-1]).any()):
        raise _Violation("scores: expected best first, found another order")
    if bool((labels < 0).any() | (labels >= classes).any()):
        raise _Violation(f"labels: expected 0..{classes - 1}, found {int(labels.min())} to {int(labels.max())}")


def _check_injection(inputs: ContractInputs) -> str:
    detector = inputs.differentiable
    with torch.no_grad():
        raw = detector(inputs.images)
    box, label, raw = _inject(inputs, raw)
    for found in detector.decode(raw):
        sure = found.scores > 0.5
        if int(sure.sum()) != 1:
            raise _Violation(f"expected only the injected box, found {int(sure.sum())} with a score above 0.5")
        overlap = float(boxes.paired_iou(found.boxes_xyxy[sure], box[None].to(found.boxes_xyxy))[0])
        if int(found.labels[sure][0]) != label or overlap < SAME_BOX_IOU:
            raise _Violation(
                f"expected class {label} at {_format_box(box)}, found {int(found.labels[sure][0])} at "
                f"{_format_box(found.boxes_xyxy[sure][0])}"
            )
    return "decoded at the injected box"


def _inject(inputs: ContractInputs, raw: Any) -> tuple[Tensor, int, Any]:
    """A box (4,) px, its label, and raw predictions with only this one."""
    height, width = inputs.images.shape[2:]
    box = torch.tensor([0.25 * width, 0.3 * height, 0.6 * width, 0.75 * height], device=inputs.images.device)
    label = len(inputs.detector.classes) - 1
    if inputs.plant is not None:
        return box, label, inputs.plant(raw, box, label)
    if isinstance(raw, InjectablePredictions):
        return box, label, raw.inject(box, label)
    raise _NotApplicable(f"{type(raw).__name__} has no `inject`, and no `plant` was given")


def _check_images_untouched(inputs: ContractInputs) -> str:
    before = inputs.images.clone()
    predict(inputs.detector, inputs.images)
    if not torch.equal(before, inputs.images):
        raise _Violation("forward: expected unchanged images, found changed ones")
    return "images unchanged"


def _check_deterministic(inputs: ContractInputs) -> str:
    first, second = (predict(inputs.detector, inputs.images) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        same = len(one) == len(other) and all(
            torch.equal(getattr(one, part), getattr(other, part)) for part in ("boxes_xyxy", "labels", "scores")
        )
        if not same:
            raise _Violation("two calls with the same images: expected identical detections")
    return "identical"


def _check_batch(inputs: ContractInputs) -> str:
    together = predict(inputs.detector, inputs.images)
    alone = [predict(inputs.detector, image[None])[0] for image in inputs.images]
    differing = max(_share_differing(one, other) for one, other in zip(together, alone, strict=True))
    if differing > MAX_SHARE_DIFFERING:
        raise _Violation(f"a batch of two and single images: {differing:.0%} of the detections differ")
    detail = f"{1 - differing:.0%} of the detections as with single images"
    if not isinstance(inputs.detector, Detector):
        return detail
    with torch.no_grad():
        raw = inputs.detector(inputs.images)
        pairs = [
            (
                _objectness(inputs, raw.select(i), i),
                _objectness(inputs, inputs.detector(inputs.images[i : i + 1]), i),
            )
            for i in range(len(inputs.images))
        ]
    worst = max(abs(one - other) / max(abs(other), 1e-12) for one, other in pairs)
    if worst > SAME_LOSS:
        raise _Violation(f"objectness of raw.select(i): off by {worst:.1e} (relative)")
    return f"{detail}, objectness within {worst:.0e}"


def _objectness(inputs: ContractInputs, raw: Any, image: int) -> float:
    return float(inputs.differentiable.loss(raw, [inputs.targets[image]])["objectness"])


def _share_differing(first: Detections, second: Detections) -> float:
    """Share of detections without a counterpart of the same class, box and score."""
    most = max(len(first), len(second))
    if not most:
        return 0.0
    # Not by IoU: a box clipped at the border may have no area.
    same = (first.boxes_xyxy[:, None] - second.boxes_xyxy[None]).abs().amax(-1) <= SAME_PX
    same &= first.labels[:, None] == second.labels[None]
    same &= (first.scores[:, None] - second.scores[None]).abs() <= SAME_SCORE
    return 1 - min(int(same.any(1).sum()), int(same.any(0).sum())) / most


def _check_frozen(inputs: ContractInputs) -> str:
    if not isinstance(inputs.detector, nn.Module):
        raise _NotApplicable("not a torch.nn.Module")
    before = predict(inputs.detector, inputs.images)
    state = {name: tensor.clone() for name, tensor in inputs.detector.state_dict().items()}
    inputs.detector.train()
    after = predict(inputs.detector, inputs.images)
    inputs.detector.eval()
    if max(_share_differing(one, other) for one, other in zip(before, after, strict=True)) > 0:
        raise _Violation("with all weights frozen, detections differ after train()")
    changed = [n for n, t in inputs.detector.state_dict().items() if not torch.equal(t, state[n])]
    if changed:
        raise _Violation(f"with all weights frozen, train() changed {changed[0]}")
    return "frozen, train() changes nothing"


def _check_loss(inputs: ContractInputs) -> str:
    detector = inputs.differentiable
    with torch.no_grad():
        raw = detector(inputs.images)
        no_boxes = [Targets(t.boxes_xyxy[:0], t.labels[:0], t.ignore[:0]) for t in inputs.targets]
        ignored = [Targets(t.boxes_xyxy, t.labels, torch.ones_like(t.ignore)) for t in inputs.targets]
        terms: dict[str, Tensor] = {}
        for case, targets in (
            ("no objects", no_boxes),
            ("only ignored objects", ignored),
            ("objects", inputs.targets),
        ):
            terms = detector.loss(raw, targets)
            _check_terms(terms, case)
    try:
        detector.loss(raw, inputs.targets[:1])
    except ValueError:
        return ", ".join(f"{name} {float(term):.4g}" for name, term in terms.items())
    raise _Violation("loss of two images and one Targets: expected a ValueError")


def _check_candidates(inputs: ContractInputs) -> str:
    """Every detection is among the candidates, with its score."""
    detector = inputs.differentiable
    if type(detector).candidates is Detector.candidates:
        raise _NotApplicable("the detector provides none")
    height, width = inputs.images.shape[-2:]
    limit = inputs.images.new_tensor([width - 1.0, height - 1.0] * 2)
    count = 0
    with torch.no_grad():
        raw = detector(inputs.images)
        raws = [raw.select(i) for i in range(len(raw))]
        if inputs.plant is not None or isinstance(raw, InjectablePredictions):
            raws.append(_inject(inputs, raws[0])[2])
        for one in raws:
            candidates, (detections,) = detector.candidates(one), detector.decode(one)
            rows = zip(detections.boxes_xyxy, detections.labels.tolist(), detections.scores, strict=True)
            for box, label, score in rows:
                scored = (candidates.log_scores[:, label].exp() - score).abs() <= SAME_SCORE
                placed = torch.minimum(candidates.boxes_for_class(label)[scored].clamp_min(0), limit.to(box))
                if not bool(((placed - box).abs() <= SAME_PX).all(1).any()):
                    raise _Violation(
                        f"candidates: expected every detection among them, found none at {box.tolist()}"
                    )
            count += len(detections)
    return f"all {count} detections are among them"


def _check_terms(terms: Any, case: str) -> None:
    missing = [name for name in REQUIRED_TERMS if name not in terms]
    if missing:
        raise _Violation(f"loss: expected {' and '.join(REQUIRED_TERMS)}, found {', '.join(terms)}")
    for name, term in terms.items():
        if not isinstance(term, Tensor) or term.ndim:
            raise _Violation(f"loss: {name}: expected a scalar tensor, found {tuple(getattr(term, 'shape', ()))}")
        if not bool(torch.isfinite(term)):
            raise _Violation(f"loss: {name}: expected a finite number, found {float(term)} ({case})")


def _check_gradient(inputs: ContractInputs) -> str:
    detector, dtype = _in_float64(inputs.differentiable, inputs.images)
    image, target = inputs.images[:1].to(dtype), [_targets_to(inputs.targets[0], dtype)]
    live = image.clone().requires_grad_()
    raw = detector(live)
    (gradient,) = torch.autograd.grad(detector.loss(raw, target)["objectness"], live)
    if not bool(torch.isfinite(gradient).all()):
        raise _Violation("gradient of objectness to the image: expected finite numbers, found others")
    if not bool((gradient != 0).any()):
        raise _Violation("gradient of objectness to the image: expected one, found zero everywhere")

    def value(picture: Tensor) -> float:
        return float(detector.loss(detector(picture), target)["objectness"])

    generator = torch.Generator().manual_seed(inputs.seed + 1)
    noise = [torch.randn(image.shape, generator=generator, dtype=dtype) for _ in range(DIRECTIONS - 1)]
    # The gradient's own direction, and random ones for what it misses.
    directions = [d.to(image) / d.square().mean().sqrt().to(image) for d in (gradient, *noise)]
    claimed = torch.tensor([float((gradient * d).sum()) for d in directions], dtype=torch.float64)
    best, best_step = math.inf, math.nan
    with torch.no_grad(), detector.freeze_choices(raw):
        for step in STEPS[dtype]:
            slopes = [(value(image + step * d) - value(image - step * d)) / (2 * step) for d in directions]
            measured = torch.tensor(slopes, dtype=torch.float64)
            error = float((claimed - measured).norm() / measured.norm().clamp_min(1e-300))
            if error < best:
                best, best_step = error, step
    name = str(dtype).removeprefix("torch.")
    detail = f"error {best:.1e} against differences in {name} (step {best_step:g}, limit {TOLERANCES[dtype]:g})"
    if not best <= TOLERANCES[dtype]:
        raise _Violation(f"gradient of objectness to the image: {detail}")
    return detail


def _check_image_descent(inputs: ContractInputs) -> str:
    detector, dtype = _in_float64(inputs.differentiable, inputs.images)
    target = [_targets_to(inputs.targets[0], dtype)]
    live = inputs.images[:1].to(dtype).requires_grad_()
    raw = detector(live)
    objectness = detector.loss(raw, target)["objectness"]
    (gradient,) = torch.autograd.grad(objectness, live)

    def value(step: float) -> float:
        return float(detector.loss(detector(live.detach() - step * gradient), target)["objectness"])

    with torch.no_grad(), detector.freeze_choices(raw):
        return _find_descent("objectness", float(objectness.detach()), gradient, value)


def _check_weight_descent(inputs: ContractInputs) -> str:
    try:
        detector = _copy(inputs.differentiable)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise _NotApplicable(f"the detector cannot be copied: {error}"[:120]) from None
    detector.requires_grad_(True)
    learned = [parameter for parameter in detector.parameters() if parameter.requires_grad]
    if not learned:
        raise _NotApplicable("no trainable weights")
    raw = detector(inputs.images)
    total = detector.loss(raw, inputs.targets)["total"]
    if not total.requires_grad:
        raise _NotApplicable("no gradient to the weights")
    gradients = torch.autograd.grad(total, learned, allow_unused=True)
    start = [parameter.detach().clone() for parameter in learned]
    flat = torch.cat([g.flatten() for g in gradients if g is not None])

    def value(step: float) -> float:
        for parameter, origin, gradient in zip(learned, start, gradients, strict=True):
            if gradient is not None:
                parameter.copy_(origin - step * gradient)
        return float(detector.loss(detector(inputs.images), inputs.targets)["total"])

    with torch.no_grad(), detector.freeze_choices(raw):
        return _find_descent("total", float(total.detach()), flat, value)


def _find_descent(name: str, before: float, gradient: Tensor, value: Callable[[float], float]) -> str:
    """Test that some step against the gradient lowers a loss, from large steps to small."""
    length = float(gradient.double().norm())
    if not length:
        raise _Violation(f"{name}: expected a gradient, found zero")
    least = _MIN_DROP * torch.finfo(gradient.dtype).eps
    # Start with the step that would take a linear loss to zero, limited in size, then halve.
    step = min(abs(before) / length**2, _MAX_STEP * math.sqrt(gradient.numel()) / length)
    for _ in range(_DESCENT_TRIALS):
        after = value(step)
        if before - after > least * abs(before):
            return f"{name} falls from {before:.6g} to {after:.6g} along its gradient"
        step /= 2
    raise _Violation(f"{name}: no step along its gradient lowers it from {before:.6g}")


def _in_float64(detector: Detector, images: Tensor) -> tuple[Detector, torch.dtype]:
    """The detector in float64 if it supports that, and the type it computes in."""
    # float64 is not part of the contract, and user code may raise anything.
    with contextlib.suppress(Exception), torch.no_grad():
        precise = _copy(detector).double()
        # Judged by the output: some networks compute in float32 for any input.
        values = list(_float_tensors(precise(images[:1].double())))
        if values and all(value.dtype == torch.float64 for value in values):
            return precise, torch.float64
    return detector, torch.float32


def _copy(detector: Detector) -> Detector:
    with warnings.catch_warnings():
        # torch warns when it copies exported graphs
        warnings.simplefilter("ignore", FutureWarning)
        return copy.deepcopy(detector)


def _float_tensors(raw: Any) -> Iterator[Tensor]:
    """The floating-point tensors of raw predictions."""
    names = getattr(type(raw), "__slots__", None) or vars(raw)
    for name in names:
        value = getattr(raw, name, None)
        if isinstance(value, Tensor) and value.is_floating_point():
            yield value


def _targets_to(targets: Targets, dtype: torch.dtype) -> Targets:
    return Targets(targets.boxes_xyxy.to(dtype), targets.labels, targets.ignore)


def _format_box(box: Tensor) -> str:
    return "[" + ", ".join(f"{float(side):.1f}" for side in box) + "]"


_CHECKS: tuple[tuple[str, Callable[[ContractInputs], str]], ...] = (
    ("name, classes, t*", _check_attributes),
    ("raw predictions", _check_raw_predictions),
    ("detections", _check_detections),
    ("planted prediction", _check_injection),
    ("image untouched", _check_images_untouched),
    ("deterministic", _check_deterministic),
    ("batch as singles", _check_batch),
    ("frozen", _check_frozen),
    ("loss terms", _check_loss),
    ("candidates", _check_candidates),
    ("gradient to the image", _check_gradient),
    ("image along the gradient", _check_image_descent),
    ("weights along the gradient", _check_weight_descent),
)
