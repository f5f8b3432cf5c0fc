"""Does a detector keep the contract of `detectors.base`? Each promise is tried on a picture made up for it.

The gradient is held against central differences along random directions, in float64 where the detector can. There
a difference of 1e-6 steps over few of a network's kinks; in float32 rounding asks for steps that cross many.
"""

from __future__ import annotations

import contextlib
import copy
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors import boxes
from detectors.base import Detector, DetectorError, Plantable, Predictor, Raw, outside, predict, raised
from detectors.types import Detections, Targets

Verdict = Literal["ok", "failed", "raised", "not tried"]
Plant = Callable[[Any, Tensor, int], Any]
"""Raw predictions, a box (4,) px and a label, to the same with this prediction alone."""

IMAGE_HW = (192, 320)
"""Size of the picture, px: no multiple is asked for, but small enough for float64."""
REQUIRED_TERMS = ("total", "objectness")
OUTSIDE_PX = 1e-3
"""How far a box may reach beyond the image."""
SAME_BOX_IOU = 0.98
"""Overlap of a planted box with what comes out."""
SAME_PX = 0.1
SAME_SCORE = 1e-3
"""What alone and what in a batch is computed in another order: boxes and scores differ by rounding."""
SAME_LOSS = 1e-3
MOST_APART = 0.02
"""Share of detections that may differ: of two boxes that tie but for rounding, suppression takes either."""

DIRECTIONS = 3
STEPS: dict[torch.dtype, tuple[float, ...]] = {
    torch.float64: (1e-3, 1e-4, 1e-5, 1e-6, 1e-7),
    torch.float32: (3e-2, 1e-2, 3e-3, 1e-3),
}
"""Of a difference, in units of a pixel's [0, 1]: root mean square over the picture. The best one counts: a network
that is sure of nothing has slopes that drown in rounding where steps are small."""
TOLERANCES: dict[torch.dtype, float] = {torch.float64: 0.05, torch.float32: 0.2}
"""Largest relative error of the slopes: the length of their difference over that of the differences. float64's is
that of `drivesem gradcheck`."""
_DESCENT_TRIALS = 40
_LARGEST_MOVE = 0.3
"""Of a step along a gradient: root mean square over pixels in [0, 1], or over weights."""
_LEAST_DROP = 100
"""Of a loss, in roundings: what counts as fallen."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One promise. said: what was measured, or why it was not tried."""

    name: str
    verdict: Verdict
    said: str


@dataclass(frozen=True, slots=True)
class Report:
    """What came of all of them. gradients: whether the detector promises any."""

    detector: str
    gradients: bool
    findings: tuple[Finding, ...]

    @property
    def failed(self) -> tuple[Finding, ...]:
        """What was broken, by what a method gives or by its raising."""
        return tuple(finding for finding in self.findings if finding.verdict in ("failed", "raised"))

    @property
    def raised(self) -> tuple[Finding, ...]:
        """What the detector's own code raised."""
        return tuple(finding for finding in self.findings if finding.verdict == "raised")

    def require(self) -> Report:
        """The same; raises DetectorError with all that was broken, where anything was."""
        if self.failed:
            said = "; ".join(f"{finding.name}: {finding.said}" for finding in self.failed)
            raise DetectorError(f"detector {self.detector!r} does not keep its contract: {said}")
        return self


class _Broken(Exception):  # noqa: N818  (no error of ours: it ends one trial)
    """A promise that is not kept; its text says how."""


class _NotTried(Exception):  # noqa: N818
    """A promise that this detector does not make."""


@dataclass(frozen=True, slots=True)
class Trial:
    """What all promises are tried on. images (2, 3, H, W) in [0, 1]; targets of each; plant: see `Plant`."""

    detector: Predictor
    images: Tensor
    targets: tuple[Targets, ...]
    plant: Plant | None
    seed: int

    @property
    def differentiable(self) -> Detector:
        """The detector, where it has gradients."""
        if not isinstance(self.detector, Detector):
            raise _NotTried("a detector without gradients")
        return self.detector


def check_detector(
    detector: Predictor,
    image_hw: tuple[int, int] = IMAGE_HW,
    plant: Plant | None = None,
    seed: int = 0,
    device: str | torch.device = "cpu",
) -> Report:
    """Try every promise of the contract. The detector is frozen, and otherwise left as it was.

    image_hw: size of the pictures, px. plant: how a prediction is put into its raw ones, where they have no
    `planted` of their own; without either, decoding is tried only on what is found. seed: of the pictures and of
    the directions. Raises DetectorError for one without names of classes, and for nothing else that a detector
    does wrong: `Report.require` does.
    """
    if isinstance(detector, nn.Module):
        detector.requires_grad_(False)
        detector.eval()
    try:
        trial = Trial(detector, *pictures(image_hw, detector.classes, seed, device), plant, seed)
    except (AttributeError, TypeError) as error:
        raise DetectorError(f"detector: classes: expected names, found {raised(error)}") from error
    # Each on pictures of its own: a detector may have drawn on those of the one before.
    findings = [_try(name, promise, replace(trial, images=trial.images.clone())) for name, promise in _PROMISES]
    return Report(str(getattr(detector, "name", "?")), isinstance(detector, Detector), tuple(findings))


def pictures(
    image_hw: tuple[int, int], classes: Sequence[str], seed: int, device: str | torch.device
) -> tuple[Tensor, tuple[Targets, ...]]:
    """Two pictures (2, 3, H, W) in [0, 1] of smooth noise with darker blocks, and a Targets for each: those
    blocks, as cars where the detector knows cars, and an ignored region.
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


def _try(name: str, promise: Callable[[Trial], str], trial: Trial) -> Finding:
    try:
        return Finding(name, "ok", promise(trial))
    except _NotTried as reason:
        return Finding(name, "not tried", str(reason))
    except _Broken as reason:
        return Finding(name, "failed", str(reason))
    except Exception as error:  # whatever a detector of anybody's raises is a finding
        return Finding(name, "raised" if outside(error) else "failed", raised(error))


def _facts(trial: Trial) -> str:
    detector = trial.detector
    if not (isinstance(detector.name, str) and detector.name):
        raise _Broken(f"name: expected a text, found {detector.name!r}")
    classes = detector.classes
    if not (isinstance(classes, tuple) and classes and all(isinstance(c, str) and c for c in classes)):
        raise _Broken(f"classes: expected a tuple of names, found {classes!r}")
    if len(set(classes)) != len(classes):
        raise _Broken(f"classes: expected each once, found {', '.join(classes)}")
    said = f"{len(classes)} classes, Car " + (f"is {classes.index('Car')}" if "Car" in classes else "is none")
    if isinstance(detector, Detector):
        if not 0 <= detector.t_star <= 1:
            raise _Broken(f"t_star: expected a number in [0, 1], found {detector.t_star!r}")
        said += f", t* {detector.t_star:.3f}"
    return said


def _raw(trial: Trial) -> str:
    detector = trial.differentiable
    raw = detector(trial.images)
    if not isinstance(raw, Raw):
        raise _Broken(f"forward: expected what has a length and `one`, found {type(raw).__name__}")
    if len(raw) != len(trial.images):
        raise _Broken(f"len(raw): expected {len(trial.images)}, found {len(raw)}")
    if len(raw.one(1)) != 1:
        raise _Broken(f"len(raw.one(1)): expected 1, found {len(raw.one(1))}")
    return type(raw).__name__


def _detections(trial: Trial) -> str:
    counts = []
    height, width = trial.images.shape[2:]
    odd = trial.images[:, :, : height - 7, : width - 13]
    for images in (trial.images, odd):
        found = predict(trial.detector, images)
        if not isinstance(found, list) or len(found) != len(images):
            raise _Broken(f"decode: expected a list of {len(images)}, found {found!r}"[:200])
        for one in found:
            _well_formed(one, (int(images.shape[2]), int(images.shape[3])), len(trial.detector.classes))
            counts.append(len(one))
    return (
        f"{', '.join(map(str, counts))} boxes in images of {width} x {height} and {width - 13} x {height - 7} px"
    )


def _well_formed(found: Detections, image_hw: tuple[int, int], classes: int) -> None:
    if not isinstance(found, Detections):
        raise _Broken(f"decode: expected Detections, found {type(found).__name__}")
    placed, scores, labels = found.boxes_xyxy, found.scores, found.labels
    if placed.requires_grad or scores.requires_grad:
        raise _Broken("decode: expected no gradient, found one")
    if labels.dtype != torch.int64:
        raise _Broken(f"labels: expected int64, found {labels.dtype}")
    if not bool(torch.isfinite(placed).all() & torch.isfinite(scores).all()):
        raise _Broken("boxes and scores: expected finite numbers, found others")
    if not len(found):
        return
    height, width = image_hw
    limit = placed.new_tensor([width, height, width, height]) - 1 + OUTSIDE_PX
    if bool((placed < -OUTSIDE_PX).any() | (placed > limit).any()):
        worst = placed[((placed < -OUTSIDE_PX) | (placed > limit)).any(1)][0]
        raise _Broken(f"boxes: expected inside 0..{width - 1} x 0..{height - 1}, found {_numbers(worst)}")
    if bool((placed[:, 2:] < placed[:, :2]).any()):
        raise _Broken(f"boxes: expected left <= right, top <= bottom, found {_numbers(placed[0])}")
    if bool((scores < 0).any() | (scores > 1).any()):
        raise _Broken(f"scores: expected in [0, 1], found {float(scores.min()):g} to {float(scores.max()):g}")
    if bool((scores[1:] > scores[:-1]).any()):
        raise _Broken("scores: expected best first, found another order")
    if bool((labels < 0).any() | (labels >= classes).any()):
        raise _Broken(f"labels: expected 0..{classes - 1}, found {int(labels.min())} to {int(labels.max())}")


def _planted(trial: Trial) -> str:
    detector = trial.differentiable
    with torch.no_grad():
        raw = detector(trial.images)
    box, label, raw = _with_plant(trial, raw)
    for found in detector.decode(raw):
        sure = found.scores > 0.5
        if int(sure.sum()) != 1:
            raise _Broken(f"expected the planted box alone, found {int(sure.sum())} with a score above 0.5")
        overlap = float(boxes.paired_iou(found.boxes_xyxy[sure], box[None].to(found.boxes_xyxy))[0])
        if int(found.labels[sure][0]) != label or overlap < SAME_BOX_IOU:
            raise _Broken(
                f"expected class {label} at {_numbers(box)}, found {int(found.labels[sure][0])} at "
                f"{_numbers(found.boxes_xyxy[sure][0])}"
            )
    return "found where it was put"


def _with_plant(trial: Trial, raw: Any) -> tuple[Tensor, int, Any]:
    """A box (4,) px, its label, and raw predictions with it alone."""
    height, width = trial.images.shape[2:]
    box = torch.tensor([0.25 * width, 0.3 * height, 0.6 * width, 0.75 * height], device=trial.images.device)
    label = len(trial.detector.classes) - 1
    if trial.plant is not None:
        return box, label, trial.plant(raw, box, label)
    if isinstance(raw, Plantable):
        return box, label, raw.planted(box, label)
    raise _NotTried(f"{type(raw).__name__} has no `planted`, and no `plant` was given")


def _untouched(trial: Trial) -> str:
    before = trial.images.clone()
    predict(trial.detector, trial.images)
    if not torch.equal(before, trial.images):
        raise _Broken("forward: expected the images as they were, found them changed")
    return "images as they were"


def _deterministic(trial: Trial) -> str:
    first, second = (predict(trial.detector, trial.images) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        same = len(one) == len(other) and all(
            torch.equal(getattr(one, part), getattr(other, part)) for part in ("boxes_xyxy", "labels", "scores")
        )
        if not same:
            raise _Broken("two calls with the same images: expected the same to the bit, found another")
    return "the same to the bit"


def _batch(trial: Trial) -> str:
    together = predict(trial.detector, trial.images)
    alone = [predict(trial.detector, image[None])[0] for image in trial.images]
    apart = max(_apart(one, other) for one, other in zip(together, alone, strict=True))
    if apart > MOST_APART:
        raise _Broken(f"a batch of two and two alone: {apart:.0%} of the detections differ")
    said = f"{1 - apart:.0%} of the detections the same as alone"
    if not isinstance(trial.detector, Detector):
        return said
    with torch.no_grad():
        raw = trial.detector(trial.images)
        pairs = [
            (_objectness(trial, raw.one(i), i), _objectness(trial, trial.detector(trial.images[i : i + 1]), i))
            for i in range(len(trial.images))
        ]
    worst = max(abs(one - other) / max(abs(other), 1e-12) for one, other in pairs)
    if worst > SAME_LOSS:
        raise _Broken(f"objectness of raw.one(i): {worst:.1e} (relative) off that of the image alone")
    return f"{said}, objectness to {worst:.0e}"


def _objectness(trial: Trial, raw: Any, image: int) -> float:
    return float(trial.differentiable.loss(raw, [trial.targets[image]])["objectness"])


def _apart(first: Detections, second: Detections) -> float:
    """Share of detections that the other does not have: same class, same place, same score."""
    most = max(len(first), len(second))
    if not most:
        return 0.0
    # Not by overlap: a box that is cut off at the border may have no area.
    same = (first.boxes_xyxy[:, None] - second.boxes_xyxy[None]).abs().amax(-1) <= SAME_PX
    same &= first.labels[:, None] == second.labels[None]
    same &= (first.scores[:, None] - second.scores[None]).abs() <= SAME_SCORE
    return 1 - min(int(same.any(1).sum()), int(same.any(0).sum())) / most


def _frozen(trial: Trial) -> str:
    if not isinstance(trial.detector, nn.Module):
        raise _NotTried("no torch.nn.Module")
    before = predict(trial.detector, trial.images)
    state = {name: tensor.clone() for name, tensor in trial.detector.state_dict().items()}
    trial.detector.train()
    after = predict(trial.detector, trial.images)
    trial.detector.eval()
    if max(_apart(one, other) for one, other in zip(before, after, strict=True)) > 0:
        raise _Broken("with all weights frozen, detections differ after train()")
    changed = [n for n, t in trial.detector.state_dict().items() if not torch.equal(t, state[n])]
    if changed:
        raise _Broken(f"with all weights frozen, train() let {changed[0]} change")
    return "frozen, train() changes nothing"


def _loss(trial: Trial) -> str:
    detector = trial.differentiable
    with torch.no_grad():
        raw = detector(trial.images)
        no_boxes = [Targets(t.boxes_xyxy[:0], t.labels[:0], t.ignore[:0]) for t in trial.targets]
        ignored = [Targets(t.boxes_xyxy, t.labels, torch.ones_like(t.ignore)) for t in trial.targets]
        terms: dict[str, Tensor] = {}
        for case, targets in (("no objects", no_boxes), ("ignored alone", ignored), ("objects", trial.targets)):
            terms = detector.loss(raw, targets)
            _check_terms(terms, case)
    try:
        detector.loss(raw, trial.targets[:1])
    except ValueError:
        return ", ".join(f"{name} {float(term):.4g}" for name, term in terms.items())
    raise _Broken("loss of two images and one Targets: expected a ValueError, found none")


def _candidates(trial: Trial) -> str:
    """Every detection is one of the candidates, with its score."""
    detector = trial.differentiable
    if type(detector).candidates is Detector.candidates:
        raise _NotTried("a detector that tells none")
    height, width = trial.images.shape[-2:]
    limit = trial.images.new_tensor([width - 1.0, height - 1.0] * 2)
    found = 0
    with torch.no_grad():
        raw = detector(trial.images)
        raws = [raw.one(i) for i in range(len(raw))]
        if trial.plant is not None or isinstance(raw, Plantable):
            raws.append(_with_plant(trial, raws[0])[2])
        for one in raws:
            told, (detections,) = detector.candidates(one), detector.decode(one)
            rows = zip(detections.boxes_xyxy, detections.labels.tolist(), detections.scores, strict=True)
            for box, label, score in rows:
                scored = (told.log_scores[:, label].exp() - score).abs() <= SAME_SCORE
                placed = torch.minimum(told.boxes_of(label)[scored].clamp_min(0), limit.to(box))
                if not bool(((placed - box).abs() <= SAME_PX).all(1).any()):
                    raise _Broken(f"candidates: expected every detection among them, found none at {box.tolist()}")
            found += len(detections)
    return f"{found} detections among them"


def _check_terms(terms: Any, case: str) -> None:
    missing = [name for name in REQUIRED_TERMS if name not in terms]
    if missing:
        raise _Broken(f"loss: expected {' and '.join(REQUIRED_TERMS)}, found {', '.join(terms)}")
    for name, term in terms.items():
        if not isinstance(term, Tensor) or term.ndim:
            raise _Broken(f"loss: {name}: expected a scalar tensor, found {tuple(getattr(term, 'shape', ()))}")
        if not bool(torch.isfinite(term)):
            raise _Broken(f"loss: {name}: expected a finite number, found {float(term)} ({case})")


def _gradient(trial: Trial) -> str:
    detector, dtype = _precise(trial.differentiable, trial.images)
    image, target = trial.images[:1].to(dtype), [_to(trial.targets[0], dtype)]
    live = image.clone().requires_grad_()
    raw = detector(live)
    (gradient,) = torch.autograd.grad(detector.loss(raw, target)["objectness"], live)
    if not bool(torch.isfinite(gradient).all()):
        raise _Broken("gradient of objectness to the image: expected finite numbers, found others")
    if not bool((gradient != 0).any()):
        raise _Broken("gradient of objectness to the image: expected one, found zero everywhere")

    def value(picture: Tensor) -> float:
        return float(detector.loss(detector(picture), target)["objectness"])

    generator = torch.Generator().manual_seed(trial.seed + 1)
    noise = [torch.randn(image.shape, generator=generator, dtype=dtype) for _ in range(DIRECTIONS - 1)]
    # Along the gradient itself it is longest; random directions see what it leaves out.
    directions = [d.to(image) / d.square().mean().sqrt().to(image) for d in (gradient, *noise)]
    claimed = torch.tensor([float((gradient * d).sum()) for d in directions], dtype=torch.float64)
    best, best_step = math.inf, math.nan
    with torch.no_grad(), detector.holding(raw):
        for step in STEPS[dtype]:
            slopes = [(value(image + step * d) - value(image - step * d)) / (2 * step) for d in directions]
            measured = torch.tensor(slopes, dtype=torch.float64)
            error = float((claimed - measured).norm() / measured.norm().clamp_min(1e-300))
            if error < best:
                best, best_step = error, step
    name = str(dtype).removeprefix("torch.")
    said = f"{best:.1e} off differences in {name} (step {best_step:g}; at most {TOLERANCES[dtype]:g})"
    if not best <= TOLERANCES[dtype]:
        raise _Broken(f"gradient of objectness to the image: {said}")
    return said


def _image_descent(trial: Trial) -> str:
    detector, dtype = _precise(trial.differentiable, trial.images)
    target = [_to(trial.targets[0], dtype)]
    live = trial.images[:1].to(dtype).requires_grad_()
    raw = detector(live)
    objectness = detector.loss(raw, target)["objectness"]
    (gradient,) = torch.autograd.grad(objectness, live)

    def value(step: float) -> float:
        return float(detector.loss(detector(live.detach() - step * gradient), target)["objectness"])

    with torch.no_grad(), detector.holding(raw):
        return _falls("objectness", float(objectness.detach()), gradient, value)


def _weight_descent(trial: Trial) -> str:
    try:
        detector = _copied(trial.differentiable)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise _NotTried(f"a detector that cannot be copied: {error}"[:120]) from None
    detector.requires_grad_(True)
    learned = [parameter for parameter in detector.parameters() if parameter.requires_grad]
    if not learned:
        raise _NotTried("no weights that could be trained")
    raw = detector(trial.images)
    total = detector.loss(raw, trial.targets)["total"]
    if not total.requires_grad:
        raise _NotTried("no gradient to the weights")
    gradients = torch.autograd.grad(total, learned, allow_unused=True)
    start = [parameter.detach().clone() for parameter in learned]
    flat = torch.cat([g.flatten() for g in gradients if g is not None])

    def value(step: float) -> float:
        for parameter, origin, gradient in zip(learned, start, gradients, strict=True):
            if gradient is not None:
                parameter.copy_(origin - step * gradient)
        return float(detector.loss(detector(trial.images), trial.targets)["total"])

    with torch.no_grad(), detector.holding(raw):
        return _falls("total", float(total.detach()), flat, value)


def _falls(name: str, before: float, gradient: Tensor, value: Callable[[float], float]) -> str:
    """Whether some step along the gradient lowers a loss; from large ones to small."""
    length = float(gradient.double().norm())
    if not length:
        raise _Broken(f"{name}: expected a gradient, found zero")
    least = _LEAST_DROP * torch.finfo(gradient.dtype).eps
    # The step that would take a linear loss to zero, where that is not too far, halved again and again.
    step = min(abs(before) / length**2, _LARGEST_MOVE * math.sqrt(gradient.numel()) / length)
    for _ in range(_DESCENT_TRIALS):
        after = value(step)
        if before - after > least * abs(before):
            return f"{name} falls from {before:.6g} to {after:.6g} along its gradient"
        step /= 2
    raise _Broken(f"{name}: no step along its gradient lowers it from {before:.6g}")


def _precise(detector: Detector, images: Tensor) -> tuple[Detector, torch.dtype]:
    """The detector in float64 where it can be, and what it computes in."""
    # float64 is no promise, and a detector of anybody's may raise anything.
    with contextlib.suppress(Exception), torch.no_grad():
        precise = _copied(detector).double()
        # Told by what comes of it: some networks compute in float32 whatever they are given.
        values = list(_floats(precise(images[:1].double())))
        if values and all(value.dtype == torch.float64 for value in values):
            return precise, torch.float64
    return detector, torch.float32


def _copied(detector: Detector) -> Detector:
    with warnings.catch_warnings():
        # torch warns of its own ways where it copies exported graphs
        warnings.simplefilter("ignore", FutureWarning)
        return copy.deepcopy(detector)


def _floats(raw: Any) -> Iterator[Tensor]:
    """The tensors of numbers that raw predictions hold."""
    names = getattr(type(raw), "__slots__", None) or vars(raw)
    for name in names:
        value = getattr(raw, name, None)
        if isinstance(value, Tensor) and value.is_floating_point():
            yield value


def _to(targets: Targets, dtype: torch.dtype) -> Targets:
    return Targets(targets.boxes_xyxy.to(dtype), targets.labels, targets.ignore)


def _numbers(box: Tensor) -> str:
    return "[" + ", ".join(f"{float(side):.1f}" for side in box) + "]"


_PROMISES: tuple[tuple[str, Callable[[Trial], str]], ...] = (
    ("name, classes, t*", _facts),
    ("raw predictions", _raw),
    ("detections", _detections),
    ("planted prediction", _planted),
    ("image untouched", _untouched),
    ("deterministic", _deterministic),
    ("batch as singles", _batch),
    ("frozen", _frozen),
    ("loss terms", _loss),
    ("candidates", _candidates),
    ("gradient to the image", _gradient),
    ("image along the gradient", _image_descent),
    ("weights along the gradient", _weight_descent),
)
