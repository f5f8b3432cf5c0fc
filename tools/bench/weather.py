"""The compositor's weather and sun against the generator's: brightness, contrast and a detector's scores.

A failure that only the compositor's weather causes does not survive the second renderer. This measures where the two
part: for each effect, at half and at full strength, in the boxes of the labelled vehicles; and how far the sun can
be moved, while the shadows of all but vehicles stay those of the photograph.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.base import Predictor, predict
from detectors.registry import load_predictor
from drivesem.attacks.losses import candidates_from_detections
from drivesem.attacks.targets import resolve_t_star
from drivesem.bench.session import Columns
from drivesem.config.edits import WEATHER_CODES, FrameEdit
from drivesem.failures.margins import object_margins
from drivesem.reporting.drawing import write_picture
from drivesem.synth import frames as generated
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import SPLITS, Plan, SynthFrame, SynthSettings, Truth
from scene_ir.derender.derender import VEHICLE_CATEGORIES, derender
from scene_ir.io import to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.render.model import LUMA, SUN_RISE_RAD, SUN_STRENGTH, SUN_TURN_RAD
from scene_ir.types import Frame, SceneIR, Weather
from tools.bench.pictures import SheetStrip, psnr, sheet
from tools.bench.settings import BenchTool

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]

TITLE = "Weather and sun, ours against the generator's"
COLUMNS: Columns = {
    "pool": ("pool", "pool"), "weather": ("weather", "weather"), "frames": ("frames", "frames"),
    "cars": ("vehicles", "cars"), "psnr_db": ("PSNR in the boxes, dB", "PSNR"),
    "tail_db": ("tail", "tail"), "unchanged_db": ("unchanged", "unchanged"),
    "mean": ("brightness in the boxes, ours", "mean"), "mean_true": ("the generator's", "true"),
    "contrast": ("contrast in the boxes, ours", "contrast"), "contrast_true": ("the generator's ", "true"),
    "margin": ("margin, ours, logits", "margin"), "margin_true": ("the generator's  ", "true"),
}  # fmt: skip
METHOD = (
    "Clear generated frames of both pools, de-rendered from their labels alone; a code of weather or another sun "
    "is drawn by the compositor on the photograph and by the generator in its world. In the boxes of labelled "
    "vehicles, at least 25 px high and half in view, grown by 15 % of their size each way: mean luma and its "
    "standard deviation (contrast), display values of [0, 1], and PSNR of one picture to the other; tail: "
    "the 10th percentile; unchanged: the photograph as the answer. Margin: the "
    "logit of the best detection of the vehicle less that of the detector's t*, from -8; means over vehicles."
)
QUICK_FRAMES, FULL_FRAMES = 4, 24
_SUN_CORNERS = ((1, 1, 1), (1, -1, 1), (-1, 1, -1), (-1, -1, -1))
CODES: dict[str, FrameEdit] = {
    "none": FrameEdit(),
    **{
        f"{WEATHER_CODES[code]} {amount:g}": FrameEdit(
            weather=tuple(amount * (other == code) for other in Weather)
        )
        for code in Weather
        for amount in (0.5, 1.0)
    },
    "fog and rain 0.5": FrameEdit(weather=tuple(0.5 * (code in (Weather.FOG, Weather.RAIN)) for code in Weather)),
    **{
        f"sun {degrees} degrees to the {side}": FrameEdit(sun=(sign * math.radians(degrees) / SUN_TURN_RAD, 0, 0))
        for degrees in (20, 40, 60)
        for side, sign in (("right", 1), ("left", -1))
    },
    **{
        f"sun {degrees} degrees {way}": FrameEdit(sun=(0, sign * math.radians(degrees) / SUN_RISE_RAD, 0))
        for degrees in (10, 20)
        for way, sign in (("higher", 1), ("lower", -1))
    },
    **{
        f"sun {share:.0%} {way}": FrameEdit(sun=(0, 0, sign * share / SUN_STRENGTH))
        for share in (0.3, 0.6)
        for way, sign in (("stronger", 1), ("weaker", -1))
    },
    **{f"corner {n} of the codes of suns": FrameEdit(sun=corner) for n, corner in enumerate(_SUN_CORNERS)},
}
"""What is tried: codes of weather, and suns, some beyond their codes' ends."""
_SEED = 59
"""Of the frames: of no training and no other test."""
_LEAST_PX, _LEAST_SEEN, _GROWN = 25.0, 0.5, 0.15


@dataclass(frozen=True, slots=True)
class WeatherRow:
    """One weather of one frame; figures are means over its vehicles, but for what begins with `each`."""

    pool: str
    frame: str
    weather: str
    cars: int
    psnr_db: float
    mean: float
    mean_true: float
    contrast: float
    contrast_true: float
    margin: float
    margin_true: float
    unchanged_db: float
    each_db: tuple[float, ...]


def measure(config: BenchTool, frames: int, sheets: Path | None) -> Iterator[list[WeatherRow]]:
    """Rows of a frame at a time, pools in turn; frames without a judged vehicle have none."""
    detector = load_predictor(config.detector)
    for number in range(frames):
        pool = SPLITS[number % len(SPLITS)]
        plan = generated.plan_frame(_SEED, number // len(SPLITS), pool, SynthSettings(bent=True, sunny=True))
        yield weather_rows(pool, number, plan, detector, sheets)


def weather_rows(
    pool: str, number: int, plan: Plan, detector: Predictor, sheets: Path | None = None
) -> list[WeatherRow]:
    """The figures of one frame. sheets: folder for its pictures."""
    street = generated.build_street(plan)
    made = rendered(plan, street)
    scene = derender(Frame(f"{number:03d}", to_tensor(made.image), made.camera, made.labels))
    judged = [truth for truth in made.truths if _is_judged(truth)]
    if not judged:
        return []
    compositor = Compositor(scene)
    rows, strips = [], []
    for name, edit in CODES.items():
        ours = to_uint8(compositor.render(_under(scene, edit)).image)
        truth = rendered(apply_edit(plan, edit), street).image
        rows.append(_row((pool, f"{number:03d}", name), made.image, ours, truth, judged, detector))
        region = np.ones(ours.shape[:2], bool)
        strips.append(SheetStrip(made.image, ours, truth, region, f"{name}: {rows[-1].psnr_db:.1f} dB"))
    if sheets is not None:
        write_picture(sheets / f"{number:03d}_{pool}.png", sheet(strips, 3200))
    return rows


def summary(rows: Sequence[WeatherRow]) -> list[dict[str, Any]]:
    """Means over vehicles, by pool and weather."""
    out: list[dict[str, Any]] = []
    averaged = (
        "psnr_db",
        "mean",
        "mean_true",
        "contrast",
        "contrast_true",
        "margin",
        "margin_true",
        "unchanged_db",
    )
    for pool in SPLITS:
        for name in CODES:
            chosen = [row for row in rows if (row.pool, row.weather) == (pool, name)]
            if not chosen:
                continue
            cars = [row.cars for row in chosen]
            table = np.array([[getattr(row, figure) for figure in averaged] for row in chosen])
            means = np.average(table, axis=0, weights=cars).round(3).tolist()
            row: dict[str, Any] = {"pool": pool, "weather": name, "frames": len(chosen), "cars": sum(cars)}
            row["tail_db"] = round(float(np.percentile([db for one in chosen for db in one.each_db], 10)), 3)
            out.append({**row, **dict(zip(averaged, means, strict=True))})
    return out


def _row(
    name: tuple[str, str, str],
    before: Picture,
    ours: Picture,
    truth: Picture,
    cars: Sequence[Truth],
    detector: Predictor,
) -> WeatherRow:
    per_car = []
    margins = [_margins(picture, cars, detector) for picture in (ours, truth)]
    for i, car in enumerate(cars):
        region = _region(car, ours.shape[:2])
        lights = [(picture[region] @ np.array(LUMA)) / 255 for picture in (ours, truth)]
        spread = [value for light in lights for value in (light.mean(), light.std())]
        per_car.append([psnr(ours, truth, region), spread[0], spread[2], spread[1], spread[3]])
        per_car[-1] += [float(margin[i]) for margin in margins] + [psnr(before, truth, region)]
    means = np.mean(per_car, axis=0).round(4).tolist()
    return WeatherRow(*name, len(cars), *means, each_db=tuple(round(float(f[0]), 4) for f in per_car))


def _margins(picture: Picture, cars: Sequence[Truth], detector: Predictor) -> Tensor:
    boxes = torch.tensor(np.stack([car.box_xyxy for car in cars]), dtype=torch.float32)
    labels = torch.tensor([int(VEHICLE_CATEGORIES[car.actor.label]) for car in cars])
    found = candidates_from_detections(predict(detector, to_tensor(picture)[None])[0], len(detector.classes))
    return object_margins(found, boxes, labels, boxes, resolve_t_star(detector))


def _region(car: Truth, size: tuple[int, int]) -> Mask:
    x0, y0, x1, y1 = car.box_xyxy
    wide, high = _GROWN * (x1 - x0), _GROWN * (y1 - y0)
    region = np.zeros(size, bool)
    rows = slice(max(round(y0 - high), 0), round(y1 + high) + 1)
    region[rows, max(round(x0 - wide), 0) : round(x1 + wide) + 1] = True
    return region


def _is_judged(truth: Truth) -> bool:
    tall = truth.box_xyxy[3] - truth.box_xyxy[1] >= _LEAST_PX
    return (
        truth.labelled and truth.actor.label in VEHICLE_CATEGORIES and bool(tall) and truth.visible >= _LEAST_SEEN
    )


def _under(scene: SceneIR, edit: FrameEdit) -> SceneIR:
    like = scene.environment.weather
    return scene.with_environment(weather=like.new_tensor(edit.weather), light=like.new_tensor(edit.sun))


def rendered(plan: Plan, street: generated.Street) -> SynthFrame:
    frame = generated.render_frame(plan, surround=street)
    assert frame is not None
    return frame


def to_tensor(image: Picture) -> Tensor:
    return torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32) / np.float32(255))
