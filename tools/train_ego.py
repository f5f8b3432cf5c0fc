"""Train the network that finds the ego vehicle in photographs (`scene_ir.derender.ego`) on generated streets, with
bonnets, dashboards, wipers and pillars drawn over half of them.

    python tools/train_ego.py --run build/ego

A run first generates its frames into its folder, then trains from the segmenter's weights. It resumes where it was
stopped, to the same bytes as one that was never stopped (one thread, one machine).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from averaged import StreetRun, StreetSettings, parse_options
from torch import Tensor
from train_segmenter import (
    STORE_HW,
    SegmentStore,
    load_features,
    paste_unknown_objects,
    plan_street,
    vary_camera,
    vary_colours,
    vary_light,
)

from drivesem.synth.frames import SynthFrame, render_frame
from scene_ir.derender import ego
from scene_ir.derender.ego import INPUT_HW, EgoNet
from scene_ir.types import Camera

STREAM = 0xE60
"""Keeps this tool's random numbers apart from the generator's."""
DASHCAM_SHARE, DASHCAM_HW = 0.6, (360, 640)
"""Of frames taken by a dashcam and not by one of KITTI's cameras, and the size of its pictures."""
EGO_SHARE = 0.5
"""Of pictures that show the ego vehicle."""
RARENESS = -2.5
"""Log odds of the class before training."""
TRAIN_SEED, HELD_SEED = 61, 62
"""Of the generator's streams."""

Draw = Callable[[float, float], float]


def street(seed: int, index: int, split: str) -> SynthFrame:
    """Frame `index` of a stream, by KITTI's camera or by a dashcam: wide, from several heights."""
    plan = plan_street(seed, index, split)
    rng = np.random.default_rng([STREAM, seed, index, split == "train"])
    if rng.random() < DASHCAM_SHARE:
        height, width = DASHCAM_HW
        focal = width * float(rng.uniform(0.55, 1.1))
        middle = height * float(rng.uniform(0.35, 0.6))
        intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, middle], [0, 0, 1]])
        view = replace(
            plan.setting.view,
            camera=Camera(intrinsics, height, width),
            height_m=float(rng.uniform(1.1, 1.7)),
        )
        plan = replace(plan, setting=replace(plan.setting, view=view))
    frame = render_frame(plan)
    assert frame is not None
    return frame


class EgoPainter:
    """Draws the ego vehicle over a picture (h, w, 3) in [0, 1], in place. coverage: (h, w) in [0, 1], its share."""

    def __init__(self, image: np.ndarray, rng: np.random.Generator) -> None:
        self.image, self.rng = image, rng
        self.height, self.width = image.shape[:2]
        self.coverage = np.zeros((self.height, self.width), np.float32)
        self.v = np.arange(self.height, dtype=np.float32)[:, None]
        """(h, 1), rows."""
        self.u = np.linspace(-1, 1, self.width, dtype=np.float32)[None]
        """(1, w), columns, from -1 to 1."""

    def draw(self) -> np.ndarray:
        """Draw some of its parts; the coverage (h, w)."""
        street = self.image.copy()
        kind = self.rng.random()
        if kind < 0.9:
            self.draw_bottom(street)
        if kind >= 0.9 or self.chance(0.25):
            self.draw_pillar() if self.chance(0.6) else self.draw_mirror()
        return self.coverage

    def draw_bottom(self, street: np.ndarray) -> None:
        """Bonnet, cowl and dashboard: bands along the lower border, one below the other; what lies on them."""
        rise = self.height * (0.04 + 0.34 * self.rng.random() ** 1.6)
        curve, tilt, corner = self.uniform(-0.05, 0.35), self.rng.normal(0, 0.08), self.uniform(0, 1)
        whole = rise
        for band in range(int(self.rng.integers(1, 5))):
            sides = np.abs(self.u) ** (2 if corner < 0.75 else 8)
            wave = self.uniform(0, 0.06) * np.cos(self.uniform(4, 14) * self.u + self.uniform(0, 6))
            top = self.height - rise * (1 - curve * sides - tilt * self.u + wave * (self.rng.random() < 0.4))
            lacquered = self.chance(0.6 if band == 0 else 0.15)
            colour = self.bonnet(street, top) if lacquered else self.plastic(top)
            self.blend(colour, np.clip(self.v - top + 0.5, 0, 1))
            if self.chance(0.35):  # a gap or a lit edge
                line = np.clip(1.2 - np.abs(self.v - top - self.uniform(0, 3)), 0, 1)
                self.blend(np.float32(self.uniform(0, 1) ** 2), line * self.uniform(0.3, 1), covers=False)
            rise *= self.uniform(0.35, 0.95)
            curve, tilt = curve * self.uniform(0.3, 1.2), tilt * self.uniform(0.5, 1.2)
        for _ in range(int(self.rng.integers(1, 3)) if self.chance(0.35) else 0):
            self.draw_wiper(whole)
        if self.chance(0.2):
            self.draw_object(whole)

    def bonnet(self, street: np.ndarray, top: np.ndarray) -> np.ndarray:
        """Colours (h, w, 3) of lacquer below an edge (1, w): paint, the mirrored street and sky, ridges."""
        grey = self.uniform(0, 1) ** 2
        paint = np.clip(grey + self.rng.normal(0, 0.15, 3) * self.chance(0.4), 0.01, 1).astype(np.float32)
        below = np.clip((self.v - top) / max(float(self.height - top.min()), 1), 0, 1)
        paint = paint * (1 + self.rng.normal(0, 0.4) * (below - 0.5))[..., None]
        rows = np.clip(top - (self.v - top) * self.uniform(0.8, 5), 0, self.height - 1).astype(np.float32)
        columns = np.broadcast_to(np.arange(self.width, dtype=np.float32), rows.shape)
        mirrored = cv2.remap(street, columns, rows, cv2.INTER_LINEAR)
        mirrored = cv2.GaussianBlur(mirrored, (0, 0), self.uniform(0.5, 6), sigmaY=self.uniform(0.5, 3))
        # towards its far edge the lacquer mirrors more (Fresnel)
        gloss = (self.uniform(0, 0.5) + (1 - below) ** 2 * self.uniform(0, 0.5))[..., None]
        colour = paint + (mirrored - paint) * gloss
        for _ in range(int(self.rng.integers(0, 4))):
            across = self.u - self.uniform(-1, 1) - self.uniform(-0.8, 0.8) * below
            ridge = np.exp(-((across / self.uniform(0.01, 0.15)) ** 2)) * self.uniform(-0.3, 0.6)
            colour = colour * (1 + ridge[..., None])
        return colour

    def plastic(self, top: np.ndarray) -> np.ndarray:
        """Colours (h, w, 3) of a dashboard or cowl below an edge (1, w): mostly dark, grained, with reflections."""
        level = self.uniform(0.0, 0.55) ** 1.6
        tint = 1 + self.rng.normal(0, 0.12, 3) * self.chance(0.5)
        depth = np.clip((self.v - top) / max(float(self.height - top.min()), 1), 0, 1)
        light = 1 + self.rng.normal(0, 0.5) * (depth - 0.5) + self.rng.normal(0, 0.25) * self.u
        cells = int(self.rng.integers(2, 14))
        patches = cv2.resize(
            self.rng.normal(0, 1, (cells, 2 * cells)).astype(np.float32),
            (self.width, self.height),
            interpolation=cv2.INTER_CUBIC,
        )
        light = np.maximum(light + self.uniform(0, 0.3) * patches, 0.1)
        light = light * (1 + self.uniform(0, 0.12) * self.rng.standard_normal(light.shape))
        sheen = np.exp(-((depth * self.uniform(3, 20)) ** 2)) * self.uniform(0, 0.25) * self.chance(0.5)
        return ((level * light + sheen)[..., None] * tint).astype(np.float32)

    def draw_wiper(self, rise: float) -> None:
        """A thin dark bar above the lower border, at a flat angle."""
        x = self.uniform(0, self.width)
        y = self.height - rise * self.uniform(0.6, 1.0)
        length, angle = self.uniform(0.2, 0.6) * self.width, self.rng.normal(0, 0.12)
        end = (x + math.copysign(length, self.width / 2 - x) * math.cos(angle), y + length * math.sin(angle))
        self.draw_bar((x, y), end, self.uniform(0.7, 2.2), self.uniform(0, 0.15))

    def draw_bar(self, start: tuple[float, float], end: tuple[float, float], half_px: float, level: float) -> None:
        """A bar of a grey level between two points (x, y), half_px thick to either side."""
        x, y = np.arange(self.width, dtype=np.float32)[None] - start[0], self.v - start[1]
        dx, dy = end[0] - start[0], end[1] - start[1]
        along = np.clip((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-6), 0, 1)
        distance = np.hypot(x - along * dx, y - along * dy)
        self.blend(np.float32(level), np.clip(half_px + 0.5 - distance, 0, 1))

    def draw_object(self, rise: float) -> None:
        """A camera's mount, a box or paper on the dashboard."""
        x, half = self.uniform(0.05, 0.95) * self.width, self.uniform(0.02, 0.12) * self.width
        top = self.height - rise * self.uniform(0.4, 1.0) - self.chance(0.4) * self.uniform(0, 0.15) * self.height
        column = np.arange(self.width, dtype=np.float32)[None]
        inside = np.clip(half - np.abs(column - x - self.uniform(-0.5, 0.5) * (self.v - top)) + 0.5, 0, 1)
        level = self.uniform(0, 0.15) if self.chance(0.6) else self.uniform(0.5, 1)
        self.blend(np.float32(level), inside * np.clip(self.v - top + 0.5, 0, 1))

    def draw_pillar(self) -> None:
        """A pillar along the left or right border, upright or slanted, or only in the upper corner."""
        across = 0.5 * (1 + (self.u if self.chance(0.5) else -self.u)) * self.width
        low, high = self.uniform(-0.15, 0.08), self.uniform(0.03, 0.3)
        reach = self.width * (high + (low - high) * (self.v / self.height) ** self.uniform(0.5, 2))
        self.blend(self.plastic(np.zeros((1, self.width), np.float32)), np.clip(reach - across + 0.5, 0, 1))

    def draw_mirror(self) -> None:
        """A mirror or a dark strip at the upper border."""
        half, drop = self.uniform(0.1, 1.2), self.uniform(0.03, 0.2) * self.height
        away = np.abs((self.u - self.uniform(-1, 1)) / half)
        lower = drop * (1 - np.minimum(away, 1) ** self.uniform(2, 8)) - (away >= 1)
        self.blend(self.plastic(np.zeros((1, self.width), np.float32)), np.clip(lower - self.v + 0.5, 0, 1))

    def blend(self, colour: np.ndarray | np.float32, share: np.ndarray, covers: bool = True) -> None:
        """Blend colours into the picture by a share (h, w). covers: whether it belongs to the coverage."""
        self.image += (colour - self.image) * share[..., None]
        if covers:
            self.coverage = np.maximum(self.coverage, share.astype(np.float32))

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)


def draw_ego(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw an ego vehicle over a picture (h, w, 3) in [0, 1], in place; its share (h, w) of each pixel."""
    return EgoPainter(image, rng).draw()


def draw_glass_reflection(image: np.ndarray, rng: np.random.Generator) -> None:
    """Add faint reflections of a dashboard on the windscreen, through which the street is seen; in place."""
    height, width = image.shape[:2]
    cells = int(rng.integers(3, 24))
    pattern = cv2.resize(rng.random((cells, 2 * cells)).astype(np.float32), (width, height))
    fade = np.clip(np.linspace(-rng.uniform(0, 1), 1, height), 0, 1)[:, None]
    image += (pattern * fade * rng.uniform(0.02, 0.2))[..., None].astype(np.float32)


def draw_shade(image: np.ndarray, rng: np.random.Generator) -> None:
    """Darken the road along the lower border, as shadows of houses and of the ego vehicle do; in place."""
    height, width = image.shape[:2]
    u = np.linspace(-1, 1, width)[None]
    edge = height * (1 - rng.uniform(0.03, 0.4)) + height * (rng.normal(0, 0.1) * u + rng.normal(0, 0.1) * u * u)
    share = np.clip((np.arange(height)[:, None] - edge) / rng.uniform(0.5, 4) + 0.5, 0, 1)
    image *= (1 - share * rng.uniform(0.3, 0.9))[..., None].astype(np.float32)


def random_part(store: SegmentStore, index: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """A part of a frame in the network's size, of any aspect ratio, mirrored or not: image (h, w, 3) in [0, 1],
    classes (h, w), elevation (h, w). It often cuts vehicles at its lower border.
    """
    (height, width), (rows, columns) = INPUT_HW, STORE_HW
    h, w = (rng.uniform(0.4, 1.0) if rng.random() < 0.7 else 1.0) * rows, rng.uniform(0.4, 1.0) * columns
    y0, x0 = rng.uniform(0, rows - h), rng.uniform(0, columns - w)
    sx, sy = width / w, height / h
    part = np.array([[sx, 0, -x0 * sx], [0, sy, -y0 * sy]])
    if rng.random() < 0.5:
        part[0] = -part[0] + np.array([0, 0, width - 1])

    def resample(values: np.ndarray, how: int) -> np.ndarray:
        return cv2.warpAffine(values, part, (width, height), flags=how, borderMode=cv2.BORDER_REPLICATE)

    image = resample(store.images[index], cv2.INTER_LINEAR).astype(np.float32) / 255
    elevation = resample(store.elevation[index].astype(np.float32), cv2.INTER_LINEAR)
    return image, resample(store.classes[index], cv2.INTER_NEAREST), elevation


def make_picture(
    parts: tuple[np.ndarray, ...], rng: np.random.Generator, has_ego: bool
) -> tuple[np.ndarray, np.ndarray]:
    """A training picture (h, w, 3) in [0, 1] and the ego vehicle's share (h, w). parts: see `random_part`;
    has_ego: whether to draw an ego vehicle.
    """
    image, classes, elevation = parts
    vary_colours(image, classes, elevation, rng)
    paste_unknown_objects(image, classes, rng)
    vary_light(image, classes, rng)
    if rng.random() < 0.25:
        draw_shade(image, rng)
    coverage = draw_ego(image, rng) if has_ego else np.zeros(image.shape[:2], np.float32)
    if rng.random() < 0.3:
        draw_glass_reflection(image, rng)
    image = vary_camera(image, rng)
    if rng.random() < 0.12:  # at night
        image = image ** rng.uniform(1, 1.6) * np.float32(rng.uniform(0.25, 0.8))
    return image.astype(np.float32), coverage


@dataclass(frozen=True)
class EgoSettings(StreetSettings):
    """Settings of the network for the ego vehicle."""

    steps: int = 1100
    frames: int = 300
    rate: float = 3e-3
    average: float = 0.99


def build_batch(store: SegmentStore, step: int, settings: StreetSettings) -> tuple[Tensor, Tensor]:
    """Images (N, 3, h, w) and shares (N, h, w) of a step: a function of the seed and the step alone."""
    images, shares = [], []
    for place in range(settings.batch):
        rng = np.random.default_rng([settings.seed, step, place])
        parts = random_part(store, int(rng.integers(len(store))), rng)
        image, coverage = make_picture(parts, rng, bool(rng.random() < EGO_SHARE))
        images.append(image)
        shares.append(coverage)
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2), torch.from_numpy(np.stack(shares))


def compute_loss(logits: Tensor, shares: Tensor) -> Tensor:
    """Cross entropy () of logits (N, 1, h/2, w/2) with the shares (N, h, w)."""
    return F.binary_cross_entropy_with_logits(logits, F.avg_pool2d(shares[:, None], 2))


class EgoRun(StreetRun[EgoNet]):
    """The network in training."""

    def __init__(self, settings: EgoSettings) -> None:
        torch.manual_seed(settings.seed)
        network = EgoNet().train()
        load_features(network)
        super().__init__(network, settings)
        # Without a bias for the class's rareness all features learn to lower it, and none to raise it.
        torch.nn.init.constant_(self.network.out.bias, RARENESS)  # pyright: ignore[reportArgumentType]

    def compute_loss(self, store: SegmentStore) -> Tensor:
        images, shares = build_batch(store, self.step_number, self.settings)
        return compute_loss(self.network(images, ego.row_map(len(images))), shares)


def judge(network: EgoNet, store: SegmentStore, pictures: int) -> dict[str, float]:
    """Results on held-out pictures, half of them with an ego vehicle.

    Returns:
        iou: intersection over union over all pixels of pictures with one; median_iou: over these pictures;
        missed: share of them in which less than half is found; false: share of the others with any mask.
    """
    rows, wrong = [], []
    for index in range(pictures):
        rng = np.random.default_rng([STREAM, HELD_SEED, index])
        has_ego = index % 2 == 0
        image, coverage = make_picture(random_part(store, index % len(store), rng), rng, has_ego)
        mask, truth = ego.find_ego_vehicle(image, network), coverage > 0.5
        if not has_ego:
            wrong.append(mask is not None)
            continue
        mask = np.zeros(INPUT_HW, bool) if mask is None else mask
        rows.append((int((mask & truth).sum()), int((mask | truth).sum()), int(truth.sum())))
    both, either, truth = np.array(rows, float).T
    return {
        "iou": float(both.sum() / either.sum()),
        "median_iou": float(np.median(both / np.maximum(either, 1))),
        "missed": float(np.mean(both < 0.5 * truth)),
        "false": float(np.mean(wrong)),
    }


CARD = """# The ego vehicle in photographs, trained on generated streets

- Architecture: `scene_ir.derender.ego.EgoNet`, {parameters:,} parameters: the segmenter's U-Net on the whole picture at
  {height} x {width} px and each pixel's row. One class: the ego vehicle.
- Weights: `{file}`, float16, safetensors. Licence: Apache-2.0, as the whole project.
  SHA-256: `{sha256}`
- Data: {frames:,} frames of the project's own generator, version {version}, by KITTI's cameras and by dashcams,
  in all its weathers and seasons; no photographs. Over half of the pictures the ego vehicle is drawn: bands of bonnet,
  cowl and dashboard of many shapes, wipers, objects on the dashboard, pillars, mirrors. All pictures: other colours,
  light, shade on the road, unknown objects, faint reflections on the glass, noise, compression, darkness.
- Training: {steps:,} steps of {batch} pictures, {minutes:.0f} minutes of one CPU core, from the segmenter's
  weights, seed {seed}; nothing else is pretrained.{note}

## Figures

{held_out:,} held-out pictures (streets that no training frame has), as the masks are used; the darkest, which count as
taken by night, have none:

| quantity | value |
| --- | --- |
| IoU, all pixels of pictures with an ego vehicle | {iou:.3f} |
| IoU, median of these pictures | {median_iou:.3f} |
| pictures with one in which less than half is found | {missed:.3f} |
| pictures without one in which a mask is found | {false:.3f} |

## Limits

It has seen drawn ego vehicles only. It is not used on photographs taken by night, where a dashboard is as black as the
road. Thin strips, wipers and the glossy front of a bonnet are often missed; dark or wet road next to a dashboard is
sometimes taken for it. Strong reflections on the glass are not part of the class. Only what reaches the picture's
border counts. Not for use in a vehicle.

## Train it again

```
python tools/train_ego.py --frames {frames} --steps {steps} --seed {seed}
```
With the same generator, on the same machine, another run gives the same bytes.
"""


def main() -> None:
    arguments, settings = parse_options(__doc__, Path("build/ego"), ego.WEIGHTS, 400, EgoSettings)
    store = SegmentStore(arguments.run / "train", settings.frames, TRAIN_SEED, "train", street)
    run = EgoRun(settings)
    if not run.train(store, arguments.run, arguments.pause_after):
        return
    held_out = SegmentStore(arguments.run / "heldout", 40, HELD_SEED, "heldout", street)
    metrics = judge(run.averaged(), held_out, arguments.held_out)
    print(metrics)
    height, width = INPUT_HW
    run.write_results(arguments, CARD, metrics, height=height, width=width, **metrics)


if __name__ == "__main__":
    main()
