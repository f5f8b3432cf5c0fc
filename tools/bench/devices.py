"""A GPU against the CPU: differences of pictures, gradients and detections, and the time of a step on each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from detectors import boxes
from detectors.base import Detector
from detectors.registry import load_detector
from detectors.types import Detections
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import ParameterSpace, parse_params
from drivesem.bench.session import Columns
from drivesem.bench.timing import PairedTimer, Spread
from drivesem.synth import frames as generated
from drivesem.synth.frames import SPLITS, SynthSettings
from scene_ir.derender.derender import derender
from scene_ir.render.compositor import Compositor
from scene_ir.types import Frame, SceneIR, convert_scene
from tools.bench.weather import rendered, to_tensor

TITLE = "A GPU against the CPU"
COLUMNS: Columns = {
    "state": ("state", "state"), "frames": ("frames", "frames"),
    "least_psnr_db": ("PSNR, the least, dB", "PSNR"), "furthest": ("furthest pixel, of 255", "furthest"),
    "moved_share": ("pixels off by over 1 of 255, %", "off, %"),
    "loss_off": ("loss, off by, %", "loss, %"),
    "cosine": ("cosine of gradients, the least", "cosine"), "worst": ("of the parameter", "of"),
    "again": ("device against itself", "itself"),
    "found_off": ("detections more or fewer", "found"),
    "score_off": ("score, the furthest", "score"), "box_off_px": ("box, the furthest, px", "box, px"),
    "step_ms": ("step, ms", "step ms"), "step_cpu_ms": ("step on the processor, ms", "processor ms"),
}  # fmt: skip
METHOD = (
    "Generated frames of both pools, de-rendered with their labels; the photograph, and feasible states of "
    "combination 2 and of all six parameters, random within ten steps of an attack. The same theta is drawn, seen "
    "by the detector and differentiated on --device and on the processor. PSNR of one picture to the other, the "
    "least of the frames; pixels off by more than 1 of 255; loss (objectness) and its gradient by parameter, the "
    "least cosine; device against itself: the least cosine of two gradients at the same theta, with sums in "
    "another order; detections over t*, each against its best match. Milliseconds of loss and "
    "gradient: medians of 10 after 2, the two in turn."
)
QUICK_FRAMES, FULL_FRAMES = 2, 12
STATES = {
    "photograph": "color",
    "combination 2": "translate,rotate,mesh",
    "all six": "color,weather,foliage,translate,rotate,mesh",
}
_SEED = 97
"""Of the frames: of no training and no other test."""
_STEPS, _WARM_UP, _TIMES = 10, 2, 10


@dataclass(frozen=True, slots=True)
class DeviceRow:
    """One state of one frame: how far apart the two devices are, and milliseconds of a gradient on each."""

    state: str
    frame: str
    psnr_db: float
    furthest: float
    moved_share: float
    loss_off: float
    cosines: dict[str, float]
    again: float
    found_off: int
    score_off: float
    box_off_px: float
    step_ms: float
    step_cpu_ms: float


def measure(frames: int, detector: str, device: str) -> Iterator[list[DeviceRow]]:
    """Rows of a frame at a time, pools in turn. DetectorError where there is no such detector."""
    there, here = load_detector(detector, device), load_detector(detector, "cpu")
    for number in range(frames):
        plan = generated.plan_frame(
            _SEED, number, SPLITS[number % len(SPLITS)], SynthSettings(bent=True, sunny=True)
        )
        made = rendered(plan, generated.build_street(plan))
        scene = derender(Frame(f"{number:03d}", to_tensor(made.image), made.camera, made.labels))
        yield [_row(state, scene, number, there, here, device) for state in STATES]


def _row(state: str, scene: SceneIR, number: int, there: Detector, here: Detector, device: str) -> DeviceRow:
    ours, other = _objective(scene, state, here, "cpu"), _objective(scene, state, there, device)
    theta = ours.space.theta0 if state == "photograph" else _random(ours.space, number)
    moved = theta.to(other.space.theta0)
    picture, found = _render_and_detect(ours, theta)
    picture_there, found_there = _render_and_detect(other, moved)
    off = 255 * (picture - picture_there).abs()
    loss, gradient = ours.loss_and_grad(theta)
    (loss_there, gradient_there), (_, again) = other.loss_and_grad(moved), other.loss_and_grad(moved)
    gradient_there, again = gradient_there.cpu(), again.cpu()
    score, box = _apart(found, found_there)
    clock, times = PairedTimer(device), ([], [])
    for _ in range(_WARM_UP + _TIMES):
        for ms, objective, at in zip(times, (other, ours), (moved, theta), strict=True):
            ms.append(clock.milliseconds(partial(objective.loss_and_grad, at)))
    step_ms, step_cpu_ms = (Spread.from_values(ms[_WARM_UP:]).median for ms in times)
    return DeviceRow(
        state=state,
        frame=f"{number:03d}",
        psnr_db=round(-10 * math.log10(max(float(((off / 255) ** 2).mean()), 1e-12)), 2),
        furthest=round(float(off.max()), 3),
        moved_share=round(100 * float((off.amax(0) > 1).double().mean()), 5),
        loss_off=round(100 * abs(loss - loss_there) / abs(loss), 5),
        cosines={
            str(parameter): round(_cosine(gradient[where], gradient_there[where]), 6)
            for parameter, where in ours.space.blocks.items()
        },
        again=round(_cosine(gradient_there, again), 6),
        found_off=abs(len(found) - len(found_there)),
        score_off=round(score, 6),
        box_off_px=round(box, 4),
        step_ms=round(step_ms, 3),
        step_cpu_ms=round(step_cpu_ms, 3),
    )


def _objective(scene: SceneIR, state: str, detector: Detector, device: str) -> Objective:
    scene = convert_scene(scene, torch.float32, device)
    return Objective(Compositor(scene), ParameterSpace(scene, parse_params(STATES[state])), detector)


def _random(space: ParameterSpace, seed: int) -> Tensor:
    """A feasible theta other than 0, as an attack passes through."""
    noise = torch.rand(space.dim, generator=torch.Generator().manual_seed(seed)).to(space.step)
    return FeasibleSet(space).project(_STEPS * space.step * (2 * noise - 1)).theta


@torch.no_grad()
def _render_and_detect(objective: Objective, theta: Tensor) -> tuple[Tensor, Detections]:
    """The picture (3, H, W) at theta, on the processor, and what is found in it, from t* on."""
    scene = objective.space.apply(objective.space.scene, theta)
    render = objective.compositor.render(scene)
    found = objective.evaluate_render(scene, render).detections
    counts = found.scores >= objective.t_star
    return render.image.cpu(), Detections(found.boxes_xyxy[counts], found.labels[counts], found.scores[counts])


def _cosine(first: Tensor, second: Tensor) -> float:
    """Of two gradients; 1 where both are zero."""
    if not bool(first.any()) and not bool(second.any()):
        return 1.0
    return float(torch.cosine_similarity(first.double(), second.double(), dim=0))


def _apart(first: Detections, second: Detections) -> tuple[float, float]:
    """How far scores and boxes, px, of detections are apart from those that they meet best."""
    if not len(first) or not len(second):
        return 0.0, 0.0
    best = boxes.iou_matrix(first.boxes_xyxy, second.boxes_xyxy.cpu()).argmax(dim=1)
    scores = first.scores - second.scores.cpu()[best]
    corners = first.boxes_xyxy - second.boxes_xyxy.cpu()[best]
    return float(scores.abs().max()), float(corners.abs().max())


def summary(rows: Sequence[DeviceRow]) -> list[dict[str, Any]]:
    """The worst of all frames, by state; of times the median."""
    out: list[dict[str, Any]] = []
    for state in STATES:
        chosen = [row for row in rows if row.state == state]
        if not chosen:
            continue
        cosine, worst = min((value, name) for row in chosen for name, value in row.cosines.items())
        out.append(
            {
                "state": state,
                "frames": len(chosen),
                "least_psnr_db": min(row.psnr_db for row in chosen),
                "furthest": max(row.furthest for row in chosen),
                "moved_share": max(row.moved_share for row in chosen),
                "loss_off": max(row.loss_off for row in chosen),
                "cosine": cosine,
                "worst": worst,
                "again": min(row.again for row in chosen),
                "found_off": max(row.found_off for row in chosen),
                "score_off": max(row.score_off for row in chosen),
                "box_off_px": max(row.box_off_px for row in chosen),
                "step_ms": round(Spread.from_values([row.step_ms for row in chosen]).median, 2),
                "step_cpu_ms": round(Spread.from_values([row.step_cpu_ms for row in chosen]).median, 2),
            }
        )
    return out
