"""Train the network that segments sky, foliage and road (`scene_ir.derender.segmentation`) on generated streets.

    python tools/train_segmenter.py --run build/segment

A run first generates its frames into its folder, then trains. It resumes where it was stopped, to the
same bytes as one that was never stopped (one thread, one machine).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from averaged import StreetRun, StreetSettings, autocast, load_frames, parse_options
from torch import Tensor, nn

from drivesem.synth.frames import (
    VARIANTS,
    Plan,
    SynthFrame,
    SynthSettings,
    apply_variation,
    plan_frame,
    render_frame,
)
from drivesem.synth.layout import LayoutSettings
from drivesem.synth.soup import Material, Semantic
from drivesem.synth.variations import MIXED, VARIATIONS
from scene_ir.derender import segmentation as segment
from scene_ir.derender import unet
from scene_ir.derender.segmentation import SegmentNet, StreetClass

STREAM = 0x5E6
"""Keeps this tool's random numbers apart from the generator's."""
MIXED_SHARE, LEAVES_SHARE = 0.5, 0.6
"""Of frames in weather of their own and not in one of Virtual KITTI's variations; of frames with foliage
changed by the generator's codes."""
LEAVES = ((-0.6, 0.6), (-0.8, 0.6), (-0.6, 0.7))
"""Ranges of those codes: hue, lightness, density."""
STORE_HW = (192, 624)
"""Size of stored frames: KITTI's, halved."""
STORE_FOCAL_PX = 361.0
CLASS_OF = {
    Material.SKY: StreetClass.SKY,
    Material.LEAF: StreetClass.LEAVES,
    Material.GRASS: StreetClass.GRASS,
    Material.ROAD: StreetClass.ROAD,
    Material.PARKING: StreetClass.ROAD,
    Material.PAVEMENT: StreetClass.GROUND,
    Material.KERB: StreetClass.GROUND,
    Material.GRAVEL: StreetClass.GROUND,
}
"""What a material is, where no vehicle and no person is seen; all others are `Class.OTHER`."""
ACTORS = {
    Semantic.CAR: StreetClass.VEHICLE,
    Semantic.VAN: StreetClass.VEHICLE,
    Semantic.TRUCK: StreetClass.VEHICLE,
    Semantic.PEDESTRIAN: StreetClass.PERSON,
    Semantic.CYCLIST: StreetClass.PERSON,
}


def surface_classes(frame: SynthFrame) -> np.ndarray:
    """The `Class` (H, W) uint8 of each pixel. The frame is one without a background of its own."""
    table = np.full(256, StreetClass.OTHER, np.uint8)
    for material, kind in CLASS_OF.items():
        table[material] = kind
    found = table[frame.ground_material]
    for semantic, kind in ACTORS.items():
        found[frame.semantic == semantic] = kind
    return found


def plan_street(seed: int, index: int, split: str) -> Plan:
    """What frame `index` of a stream shows: any weather, any season, from turned cameras too."""
    rng = np.random.default_rng([STREAM, seed, index, split == "train"])
    layout = LayoutSettings(variants=VARIANTS[split], people=True)
    plan = plan_frame(seed, index, split, SynthSettings(layout=layout, bent=True))
    name = MIXED if rng.random() < MIXED_SHARE else str(rng.choice(VARIATIONS))
    leaves = tuple(float(rng.uniform(*reach)) for reach in LEAVES)
    return replace(apply_variation(plan, name), foliage=leaves if rng.random() < LEAVES_SHARE else (0.0, 0.0, 0.0))


def street(seed: int, index: int, split: str) -> SynthFrame:
    """Frame `index` of a stream."""
    frame = render_frame(plan_street(seed, index, split))
    assert frame is not None
    return frame


def shrunk(classes: np.ndarray) -> np.ndarray:
    """Majority class (h, w) of each pixel of a stored frame. classes: (H, W)."""
    height, width = STORE_HW
    shares = [
        cv2.resize((classes == kind).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        for kind in StreetClass
    ]
    return np.argmax(shares, axis=0).astype(np.uint8)


class SegmentStore:
    """Frames of a stream at the size `STORE_HW`, made as far as they are not there yet.

    images (N, h, w, 3) uint8, classes (N, h, w) uint8, elevation (N, h, w) float16: see `unet.elevation`.
    """

    def __init__(
        self,
        folder: Path,
        frames: int,
        seed: int,
        split: str,
        make: Callable[[int, int, str], SynthFrame] | None = None,
    ) -> None:
        """make: the frame of a seed, an index and a split; by default `street`."""

        def arrays(index: int) -> dict[str, np.ndarray]:
            frame = (make or street)(seed, index, split)
            image = cv2.resize(frame.image, STORE_HW[::-1], interpolation=cv2.INTER_AREA)
            elevation = unet.compute_elevation(frame.environment.ground, frame.camera, STORE_HW).astype(np.float16)
            return {"image": image, "classes": shrunk(surface_classes(frame)), "elevation": elevation}

        parts = load_frames(folder, frames, seed, split, arrays)
        self.images = np.stack([p["image"] for p in parts])
        self.classes = np.stack([p["classes"] for p in parts])
        self.elevation = np.stack([p["elevation"] for p in parts])

    def __len__(self) -> int:
        return len(self.images)


CROP_HW = (112, 224)
ZOOM = (0.75, 1.35)
"""Crops of this size are taken from frames zoomed by a factor in this range of the network's focal length."""


def _draw(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


def _smooth(rng: np.random.Generator, cells: int) -> np.ndarray:
    """Smooth noise (h, w) of about standard deviation 1, with so many cells along the crop's height."""
    grid = rng.normal(0, 1, (cells, cells * 2)).astype(np.float32)
    return cv2.resize(grid, CROP_HW[::-1], interpolation=cv2.INTER_CUBIC)


def window(rng: np.random.Generator) -> np.ndarray:
    """The map (2, 3) of a stored frame's pixels to those of a part of it, zoomed, mirrored or not."""
    height, width = CROP_HW
    whole_height, whole_width = STORE_HW
    down = _draw(rng, *ZOOM) * unet.INPUT_FOCAL_PX / STORE_FOCAL_PX
    across = down * _draw(rng, 0.9, 1.1)
    y0 = _draw(rng, 0, whole_height * down - height)
    x0 = _draw(rng, 0, whole_width * across - width)
    matrix = np.array([[across, 0, -x0], [0, down, -y0]])
    if rng.random() < 0.5:
        matrix[0] = -matrix[0] + np.array([0, 0, width - 1])
    return matrix


def resample_crop(values: np.ndarray, part: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
    """A part of a stored frame's arrays. part (2, 3): see `window`; how: OpenCV's interpolation."""
    return cv2.warpAffine(values, part, CROP_HW[::-1], flags=how, borderMode=cv2.BORDER_REPLICATE)


def random_crop(
    store: SegmentStore, index: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A part of a frame, zoomed, mirrored or not: image (h, w, 3) in [0, 1], classes (h, w), elevation (h, w)."""
    part = window(rng)
    image = resample_crop(store.images[index], part).astype(np.float32) / 255
    classes = resample_crop(store.classes[index], part, cv2.INTER_NEAREST)
    return image, classes, resample_crop(store.elevation[index].astype(np.float32), part)


def vary_surfaces(image: np.ndarray, classes: np.ndarray, elevation: np.ndarray, rng: np.random.Generator) -> None:
    """Vary colours and light of each class, replace skies, add unknown occluders; in place.

    What the generator draws always alike must not be what the network goes by.
    """
    vary_colours(image, classes, elevation, rng)
    paste_unknown_objects(image, classes, rng)
    vary_light(image, classes, rng)


def vary_colours(image: np.ndarray, classes: np.ndarray, elevation: np.ndarray, rng: np.random.Generator) -> None:
    """Vary colours of each class and replace skies; in place."""
    if rng.random() < 0.4:
        gains = np.exp(rng.normal(0, 0.25, (len(StreetClass), 1)) + rng.normal(0, 0.06, (len(StreetClass), 3)))
        image *= cv2.blur(gains.astype(np.float32)[classes], (5, 5))
    if rng.random() < 0.15:
        # walls in the sun, as white as the sky next to them
        image *= 1 + (classes == StreetClass.OTHER)[..., None] * _draw(rng, 0.5, 2.0)
    if rng.random() < 0.5:
        # leaves and grass in the sun: speckles
        green = ((classes == StreetClass.LEAVES) | (classes == StreetClass.GRASS))[..., None]
        speckles = np.exp(_draw(rng, 0.2, 0.7) * _smooth(rng, int(rng.integers(30, CROP_HW[0]))))[..., None]
        yellow = np.array([1.0, _draw(rng, 0.8, 1.0), _draw(rng, 0.3, 0.9)], np.float32) * _draw(rng, 0.8, 1.8)
        image *= 1 + green * (speckles * (yellow if rng.random() < 0.5 else 1.0) - 1)
    sky = (classes == StreetClass.SKY)[..., None]
    if sky.any() and rng.random() < 0.6:
        top = np.array([_draw(rng, 0.2, 1.0), 0.0, 1.0], np.float32)
        top[1] = _draw(rng, float(top[0]), 1.0)
        top *= _draw(rng, 0.55, 1.1)
        low = top + (_draw(rng, 0.8, 1.15) - top) * _draw(rng, 0, 1)
        share = np.clip(elevation / 0.25, 0, 1)[..., None]
        drawn = low + (top - low) * share
        if rng.random() < 0.4:
            clouds = np.clip(_smooth(rng, 4) + 0.6 * _smooth(rng, 12) - _draw(rng, -0.5, 1), 0, 1)[..., None]
            drawn = drawn + (_draw(rng, 0.75, 1.1) - drawn) * clouds
        opacity = cv2.blur(sky.astype(np.float32)[..., 0], (3, 3))[..., None]
        image += (drawn - image) * opacity


def paste_unknown_objects(image: np.ndarray, classes: np.ndarray, rng: np.random.Generator) -> None:
    """What no generated street has, in the way; in place."""
    height, width = classes.shape
    for _ in range(int(rng.integers(0, 4)) if rng.random() < 0.35 else 0):
        h, w = int(_draw(rng, 6, 70)), int(_draw(rng, 3, 70))
        y, x = int(rng.integers(0, height - h)), int(rng.integers(0, width - w))
        colour = rng.uniform(0, 1, 3) * rng.choice([0.25, 1.0]) if rng.random() < 0.6 else _draw(rng, 0, 1)
        grain = 1 + 0.25 * _smooth(rng, int(rng.integers(2, 24)))[y : y + h, x : x + w, None]
        image[y : y + h, x : x + w] = colour * grain
        classes[y : y + h, x : x + w] = StreetClass.OTHER


def vary_light(image: np.ndarray, classes: np.ndarray, rng: np.random.Generator) -> None:
    """Grain on the ground, shade from what is not in the picture; in place."""
    ground = np.isin(classes, (StreetClass.ROAD, StreetClass.GROUND, StreetClass.GRASS, StreetClass.OTHER))[
        ..., None
    ]
    if rng.random() < 0.4:
        image *= 1 + ground * _draw(rng, 0.05, 0.3) * _smooth(rng, int(rng.integers(8, 60)))[..., None]
    if rng.random() < 0.5:
        cast_shade(image, classes, rng)


def cast_shade(image: np.ndarray, classes: np.ndarray, rng: np.random.Generator) -> None:
    """Cast the shade of trees and houses that are not in the picture; in place."""
    noise = _smooth(rng, int(rng.integers(2, 6))) + _draw(rng, 0, 0.7) * _smooth(rng, int(rng.integers(8, 40)))
    shade = 1 / (1 + np.exp(-8 * (noise - _draw(rng, -0.5, 1))))[..., None]
    image *= 1 - shade * (classes != StreetClass.SKY)[..., None] * _draw(rng, 0.3, 0.85)


def vary_camera(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The picture (h, w, 3) in another exposure, other colours, less sharp, hazy, noisy, compressed."""
    if rng.random() < 0.15:
        air = _draw(rng, 0.5, 1.0)
        image = image + (air - image) * _draw(rng, 0.1, 0.5)
    level = _draw(rng, 0.2, 0.65)
    image = image * (level / max(float(image.mean()), 0.02) * rng.normal(1, 0.06, 3))
    image = np.clip(image, 0, 4).astype(np.float32)
    grey = image.mean(-1, keepdims=True)
    image = grey + (image - grey) * (_draw(rng, 0.5, 1.7) if rng.random() < 0.93 else 0.0)
    image = np.clip(image, 0, 1) ** np.exp(rng.normal(0, 0.3))
    if rng.random() < 0.5:
        # a steeper curve: black shade, white light, as photographs against the sun have
        middle = float(image.mean())
        image = np.clip(middle + (image - middle) * _draw(rng, 1.0, 2.0), 0, 1)
    if rng.random() < 0.35:
        image = cv2.GaussianBlur(image, (0, 0), _draw(rng, 0.4, 1.4))
    elif rng.random() < 0.4:
        image = image + (image - cv2.GaussianBlur(image, (0, 0), 1.0)) * _draw(rng, 0.3, 1.2)
    image = image + rng.standard_normal(image.shape, np.float32) * _draw(rng, 0, 0.05) * (rng.random() < 0.7)
    image = np.clip(image, 0, 1).astype(np.float32)
    if rng.random() < 0.2:
        levels = (image * 255).astype(np.uint8)
        _, packed = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(20, 80))])
        image = cv2.imdecode(packed, cv2.IMREAD_COLOR).astype(np.float32) / 255
    return image


@dataclass(frozen=True)
class SegmentSettings(StreetSettings):
    """Settings of the segmenter."""

    steps: int = 1800
    frames: int = 340
    rate: float = 3e-3
    average: float = 0.99


HORIZON_ERROR = 0.012
"""Standard deviation of the elevation given to the network: a plane estimated from a photograph is off."""


def build_batch(store: SegmentStore, step: int, settings: StreetSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Images (N, 3, h, w), elevations (N, 1, h, w) and classes (N, h, w) of a step: a function of the seed and the
    step alone."""
    images, heights, classes = [], [], []
    for place in range(settings.batch):
        rng = np.random.default_rng([settings.seed, step, place])
        image, found, height = random_crop(store, settings.frame_index(step, place, len(store)), rng)
        vary_surfaces(image, found, height, rng)
        images.append(vary_camera(image, rng))
        classes.append(found)
        heights.append(height + np.float32(rng.normal(0, HORIZON_ERROR)))
    return (
        torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2),
        torch.from_numpy(np.stack(heights))[:, None],
        torch.from_numpy(np.stack(classes)).long(),
    )


WEIGHTS_OF_CLASSES = (1.0, 1.0, 1.0, 0.9, 1.0, 1.0, 1.1, 2.0)
"""In the loss, in the order of `Class`: what is rare counts more."""


def compute_loss(logits: Tensor, classes: Tensor) -> Tensor:
    """Cross entropy () of logits (N, C, h/2, w/2) with the shares of the classes (N, h, w) in each 2x2 px."""
    shares = F.avg_pool2d(F.one_hot(classes, len(StreetClass)).permute(0, 3, 1, 2).float(), 2)
    weights = logits.new_tensor(WEIGHTS_OF_CLASSES)[:, None, None]
    return -(shares * logits.log_softmax(1) * weights).sum(1).mean()


class SegmentRun(StreetRun[SegmentNet]):
    """The network in training."""

    def __init__(self, settings: SegmentSettings) -> None:
        torch.manual_seed(settings.seed)
        super().__init__(SegmentNet().train(), settings)

    def compute_loss(self, store: SegmentStore) -> Tensor:
        images, heights, classes = build_batch(store, self.step_number, self.settings)
        with autocast():
            logits = self.network(images, heights)
        return compute_loss(logits.float(), classes)


def load_features(network: nn.Module) -> None:
    """Take all weights but the last layer's from the shipped segmenter."""
    known = segment.load_network().state_dict()
    network.load_state_dict({k: v for k, v in known.items() if not k.startswith("out.")}, strict=False)


JUDGED = ("sky", "foliage", "road", "vehicle")


def judge(network: SegmentNet, frames: Sequence[SynthFrame]) -> dict[str, tuple[float, float]]:
    """For each of `JUDGED`, intersection over union of map and truth, both cut at one half: over all frames'
    pixels, and the 10th percentile of the frames that show at least 500 px of it."""
    pixels: dict[str, list[tuple[int, int]]] = {name: [] for name in JUDGED}
    each: dict[str, list[float]] = {name: [] for name in JUDGED}
    for frame in frames:
        image = frame.image.astype(np.float32) / 255
        environment = frame.environment
        seen = segment.segment_photograph(image, environment.ground, frame.camera, network=network)
        vehicle = np.isin(frame.semantic, [kind for kind, found in ACTORS.items() if found == StreetClass.VEHICLE])
        truths = (environment.sky, environment.foliage_map, environment.road, torch.from_numpy(vehicle).float())
        for name, share in zip(JUDGED, truths, strict=True):
            found, truth = getattr(seen, name) > 0.5, share.numpy() > 0.5
            both, either = int((found & truth).sum()), int((found | truth).sum())
            pixels[name].append((both, either))
            if truth.sum() >= 500:
                each[name].append(both / either)
    whole = {name: np.sum(rows, axis=0) for name, rows in pixels.items()}
    return {
        name: (
            float(whole[name][0] / max(whole[name][1], 1)),
            float(np.percentile(each[name], 10)) if each[name] else float("nan"),
        )
        for name in JUDGED
    }


CARD = """# Sky, foliage and road in photographs, trained on generated streets

- Architecture: `scene_ir.derender.segmentation.SegmentNet`, {parameters:,} parameters: a U-Net of 3x3 convolutions with
  a depthwise middle, on the picture at 0.4 of KITTI's size (focal length {focal:.0f} px) and the elevation of
  each pixel's ray above the horizon; half of the first stages' channels are normalised over the picture itself.
  Eight classes: {classes}.
- Weights: `{file}`, float16, safetensors. Licence: Apache-2.0, as the whole project. Nothing pretrained.
- Data: {frames:,} frames of the project's own generator, version {version}, in all its weathers, seasons and
  camera angles; no photographs. Each class in other colours and light, other skies, shade, unknown objects in the
  way; other exposure, contrast and colours, blur, haze, noise, compression; zoomed, mirrored.
- Training: {steps:,} steps of {batch} crops, {minutes:.0f} minutes of one CPU core, seed {seed}.{note}

## Figures

Held out: {held_out} frames of the generator (shapes and streets that no training frame has). Intersection over
union of the maps as they are used (guided filter, rule of the horizon), cut at one half, with the truth: over all
pixels, and the 10th percentile of the frames that show at least 500 px of the class.

{table}

## Limits

It has seen generated pictures only. Foliage is leaves and grass; trunks are not. What it knows least is deep
shade, where leaves, walls and ground are all black, and what no generated street has: trams, tracks, bridges.
Paving and asphalt of one colour are often taken for one another. Not for use in a vehicle.

## Train it again

```
python tools/train_segmenter.py --frames {frames} --steps {steps} --seed {seed}
```
With the same generator, on the same machine, another run gives the same bytes.
"""


def format_table(metrics: dict[str, tuple[float, float]]) -> str:
    """A Markdown table, a row a map."""
    rows = [f"| {name} | {whole:.3f} | {tail:.3f} |" for name, (whole, tail) in metrics.items()]
    return "\n".join(["| map | IoU | 10th percentile |", "| --- | --- | --- |", *rows])


TRAIN_SEED, HELD_SEED = 41, 42
"""Of the generator's streams."""


def main() -> None:
    arguments, settings = parse_options(__doc__, Path("build/segment"), segment.WEIGHTS, 60, SegmentSettings)
    store = SegmentStore(arguments.run / "train", settings.frames, TRAIN_SEED, "train")
    run = SegmentRun(settings)
    if not run.train(store, arguments.run, arguments.pause_after):
        return
    frames = [street(HELD_SEED, index, "heldout") for index in range(arguments.held_out)]
    metrics = judge(run.averaged(), frames)
    table = format_table(metrics)
    print(table)
    classes = ", ".join(kind.name.lower() for kind in StreetClass)
    run.write_results(arguments, CARD, metrics, focal=unet.INPUT_FOCAL_PX, classes=classes, table=table)


if __name__ == "__main__":
    main()
