"""Train the network for the light of a closed sky (`scene_ir.derender.delight`) on generated streets, each under the
sun and under clouds.

    python tools/train_delight.py --run build/delight

A run first generates its pairs into its folder, then trains from the segmenter's weights. It resumes where it was
stopped, to the same bytes as one that was never stopped (one thread, one machine).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from averaged import StreetRun, StreetSettings, load_frames, multiscale_error, parse_options
from torch import Tensor
from train_segmenter import (
    HORIZON_ERROR,
    STORE_HW,
    cast_shade,
    load_features,
    resample_crop,
    shrunk,
    surface_classes,
    vary_camera,
    vary_colours,
    window,
)

from drivesem.config.edits import FrameEdit
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import (
    VARIANTS,
    SynthFrame,
    SynthSettings,
    build_street,
    plan_frame,
    render_frame,
)
from drivesem.synth.layout import LayoutSettings
from scene_ir.derender import delight, unet
from scene_ir.derender.delight import DelightNet
from scene_ir.derender.segmentation import StreetClass
from scene_ir.render.environment import compute_closed_sky_gain
from scene_ir.render.model import CLOSED_SKY_LOG, CLOSED_SKY_OFFSET
from scene_ir.types import Weather

CLOSED = FrameEdit(weather=tuple(float(code is Weather.OVERCAST) for code in Weather))
"""The edit that closes the sky."""
CLOUDED_SHARE = 0.2
"""Share of training examples that are under clouds already, and must not change."""


def draw_pair(seed: int, index: int, split: str) -> tuple[SynthFrame, SynthFrame]:
    """Frame `index` of a stream, under the sun and under a closed sky."""
    layout = LayoutSettings(variants=VARIANTS[split], people=True)
    plan = plan_frame(seed, index, split, SynthSettings(layout=layout, bent=True, sunny=True))
    # without noise and streaks the ratio of both is light alone
    response = replace(plan.setting.response, noise=0.0, streaks=0.0)
    plan = replace(plan, setting=replace(plan.setting, response=response))
    surround = build_street(plan)
    frames = [render_frame(one, surround=surround) for one in (plan, apply_edit(plan, CLOSED))]
    sunny, clouded = frames
    assert sunny is not None
    assert clouded is not None
    return sunny, clouded


class PairStore:
    """Pairs of a stream at the size `STORE_HW`, made as far as they are not there yet.

    images (N, 2, h, w, 3) uint8: under the sun, under clouds; classes (N, h, w) uint8; elevation (N, h, w) float16.
    """

    def __init__(self, folder: Path, frames: int, seed: int, split: str) -> None:
        def arrays(index: int) -> dict[str, np.ndarray]:
            pair = draw_pair(seed, index, split)
            images = [cv2.resize(p.image, STORE_HW[::-1], interpolation=cv2.INTER_AREA) for p in pair]
            elevation = unet.compute_elevation(pair[0].environment.ground, pair[0].camera, STORE_HW)
            found = {"images": np.stack(images), "classes": shrunk(surface_classes(pair[0]))}
            return found | {"elevation": elevation.astype(np.float16)}

        parts = load_frames(folder, frames, seed, split, arrays)
        self.images, self.classes, self.elevation = (
            np.stack([p[name] for p in parts]) for name in ("images", "classes", "elevation")
        )

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True)
class DelightExample:
    """A part of a street under both lights."""

    image: np.ndarray
    """(h, w, 3) in [0, 1], the network's input."""
    clouded: np.ndarray
    """(h, w, 3) in [0, 1], the same under a closed sky."""
    elevation: np.ndarray
    """(h, w) with an error, as an estimated plane has it."""
    sky: np.ndarray
    """(h, w), 1 in the sky, else 0."""


def example(store: PairStore, index: int, rng: np.random.Generator) -> DelightExample:
    """A part of a pair, zoomed, mirrored or not, in other colours, by another camera."""
    part = window(rng)
    sunny, clouded = (resample_crop(image, part).astype(np.float32) / 255 for image in store.images[index])
    classes = resample_crop(store.classes[index], part, cv2.INTER_NEAREST)
    elevation = resample_crop(store.elevation[index].astype(np.float32), part)
    if rng.random() < CLOUDED_SHARE:
        sunny = clouded.copy()
    elif rng.random() < 0.5:
        cast_shade(sunny, classes, rng)
    colours = int(rng.integers(2**31))
    for image in (sunny, clouded):  # the same change of colours
        vary_colours(image, classes, elevation, np.random.default_rng(colours))
    sunny, clouded = np.split(vary_camera(np.concatenate([sunny, clouded]), rng), 2)
    error = np.float32(rng.normal(0, HORIZON_ERROR))
    return DelightExample(sunny, clouded, elevation + error, (classes == StreetClass.SKY).astype(np.float32))


@dataclass(frozen=True)
class DelightSettings(StreetSettings):
    """Settings of the network for the light of a closed sky."""

    gradient: float = 0.5
    """Weight of the slopes' term."""


def build_batch(store: PairStore, step: int, settings: DelightSettings) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Images and clouded images (N, 3, h, w), elevations and skies (N, 1, h, w) of a step: a function of the seed
    and the step alone."""
    examples = []
    for place in range(settings.batch):
        rng = np.random.default_rng([settings.seed, step, place])
        examples.append(example(store, settings.frame_index(step, place, len(store)), rng))
    images, clouded = (
        torch.from_numpy(np.stack([getattr(e, name) for e in examples])).permute(0, 3, 1, 2)
        for name in ("image", "clouded")
    )
    elevation, sky = (
        torch.from_numpy(np.stack([getattr(e, name) for e in examples]))[:, None] for name in ("elevation", "sky")
    )
    return images, clouded, elevation, sky


def true_log_ratio(image: Tensor, clouded: Tensor) -> Tensor:
    """Bounded logarithm (N, 3, h/2, w/2) of the ratio of two pictures (N, 3, h, w)."""
    low, high = (F.avg_pool2d(picture, 2) + CLOSED_SKY_OFFSET for picture in (image, clouded))
    return (high / low).log().clamp(-CLOSED_SKY_LOG, CLOSED_SKY_LOG)


def compute_loss(found: Tensor, true: Tensor, sky: Tensor, gradient: float) -> Tensor:
    """Mean absolute error () of log ratios (N, 3, h/2, w/2) and of their slopes at three scales, without the sky: its
    colour is the weather's. sky: (N, 1, h, w). The absolute error's optimum is the median: unsure, it changes little.
    """
    weight = 1 - F.max_pool2d(sky, 2)
    apart = (found - true) * weight
    return multiscale_error(apart, gradient)


class DelightRun(StreetRun[DelightNet]):
    """The network in training."""

    settings: DelightSettings

    def __init__(self, settings: DelightSettings) -> None:
        torch.manual_seed(settings.seed)
        network = DelightNet().train()
        load_features(network)
        super().__init__(network, settings)

    def compute_loss(self, store: PairStore) -> Tensor:
        images, clouded, elevation, sky = build_batch(store, self.step_number, self.settings)
        found = CLOSED_SKY_LOG * torch.tanh(self.network(images, elevation) / 2)
        return compute_loss(found, true_log_ratio(images, clouded), sky, self.settings.gradient)


def psnr_db(picture: np.ndarray, true: np.ndarray, region: np.ndarray) -> float:
    """PSNR, dB, of two pictures (H, W, 3) in [0, 1] within a region (H, W)."""
    return float(-10 * np.log10(max(float(np.square(picture - true)[region].mean()), 1e-8)))


def judge(network: DelightNet, pairs: Sequence[tuple[SynthFrame, SynthFrame]]) -> dict[str, tuple[float, float]]:
    """Mean PSNR, dB, to the street under clouds, outside the sky, of the sunny picture and of the estimate; and of
    both for a street that is under clouds already.
    """
    found: dict[str, list[tuple[float, float]]] = {}
    for sunny, clouded in pairs:
        true = clouded.image.astype(np.float32) / 255
        region = sunny.environment.sky.numpy() < 0.5
        for name, frame in (("sun", sunny), ("clouds", clouded)):
            image, environment = frame.image.astype(np.float32) / 255, frame.environment
            closed_sky = delight.estimate_closed_sky(image, environment.ground, frame.camera, network)
            background, focal_px = torch.from_numpy(image).permute(2, 0, 1), float(frame.camera.intrinsics[0, 0])
            gain = compute_closed_sky_gain(closed_sky, background, environment.sky, focal_px)
            estimate = (background * (1 + gain)).clamp(0, 1).permute(1, 2, 0).numpy()
            found.setdefault(name, []).append((psnr_db(image, true, region), psnr_db(estimate, true, region)))
    return {name: (float(np.mean(rows, 0)[0]), float(np.mean(rows, 0)[1])) for name, rows in found.items()}


CARD = """# The light of a closed sky, trained on generated streets

- Architecture: `scene_ir.derender.delight.DelightNet`, {parameters:,} parameters: the segmenter's network
  (`scene_ir.derender.unet`), on the picture at 0.4 of KITTI's size (focal length {focal:.0f} px) and the elevation of
  each pixel's ray above the horizon. Three numbers a pixel: the logarithms of the ratios of red, green and blue
  under clouds to those in the photograph, within {bound} of 0. A guided filter moves their steps to the
  photograph's edges.
- Weights: `{file}`, float16, safetensors. Licence: Apache-2.0, as the whole project.
  SHA-256: `{sha256}`
  Training starts from the
  segmenter's weights; nothing else is pretrained.
- Data: {frames:,} streets of the project's own generator, version {version}, each under the sun and under a closed
  sky. No photographs. Other colours, other skies, shade of objects out of view; other exposure and contrast, blur,
  haze, noise, compression; zoomed, mirrored. {clouded:.0%} of the examples are under clouds already.
- Training: {steps:,} steps of {batch} crops, {minutes:.0f} minutes of one CPU core, seed {seed}. Loss: absolute
  error of the logarithms and of their slopes at three scales, outside the sky.{note}

## Figures

Held out: {held_out} streets of the generator (shapes and streets that no training frame has). Mean PSNR to the
street under clouds, outside the sky.

{table}

## Limits

It has seen generated pictures only. A shadow with an edge that the photograph does not show, black shade and
burnt-out light stay: the ratio is bounded, and clipped pixels have lost their colours. A dark surface and a shaded
one can look alike; where the network is unsure it changes little. Not for use in a vehicle.

## Train it again

```
python tools/train_delight.py --frames {frames} --steps {steps} --seed {seed}
```
With the same generator, on the same machine, another run gives the same bytes.
"""


def format_table(metrics: dict[str, tuple[float, float]]) -> str:
    """Markdown table, one row per light of the photograph."""
    rows = [f"| {name} | {before:.1f} | {after:.1f} |" for name, (before, after) in metrics.items()]
    head = ["| photograph under | unchanged, dB | estimate, dB |", "| --- | --- | --- |"]
    return "\n".join([*head, *rows])


TRAIN_SEED, HELD_SEED = 61, 62
"""Of the generator's streams."""


def main() -> None:
    arguments, settings = parse_options(__doc__, Path("build/delight"), delight.WEIGHTS, 40, DelightSettings)
    store = PairStore(arguments.run / "train", settings.frames, TRAIN_SEED, "train")
    run = DelightRun(settings)
    if not run.train(store, arguments.run, arguments.pause_after):
        return
    pairs = [draw_pair(HELD_SEED, index, "heldout") for index in range(arguments.held_out)]
    metrics = judge(run.averaged(), pairs)
    table = format_table(metrics)
    print(table)
    limits = {"bound": CLOSED_SKY_LOG, "clouded": CLOUDED_SHARE}
    run.write_results(arguments, CARD, metrics, focal=unet.INPUT_FOCAL_PX, table=table, **limits)


if __name__ == "__main__":
    main()
