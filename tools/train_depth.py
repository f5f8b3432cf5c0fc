"""Train the depth network for a photograph's surroundings (`scene_ir.derender.depth`) on generated streets with exact
depth.

    python tools/train_depth.py --run build/depth

A run first generates its frames into its folder, then trains from the segmenter's weights. It resumes
where it was stopped, to the same bytes as one that was never stopped (one thread, one machine).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from averaged import StreetRun, StreetSettings, autocast, load_frames, multiscale_error, parse_options
from torch import Tensor
from train_segmenter import (
    CLASS_OF,
    HORIZON_ERROR,
    STORE_HW,
    load_features,
    plan_street,
    resample_crop,
    shrunk,
    surface_classes,
    vary_camera,
    vary_colours,
    vary_light,
    window,
)

from drivesem.synth.frames import SynthFrame, render_frame
from scene_ir.derender import depth, unet
from scene_ir.derender import depth as maps
from scene_ir.derender import segmentation as segment
from scene_ir.derender.depth import DepthNet
from scene_ir.derender.segmentation import StreetClass

STREAM = 0xDE9
"""Keeps this tool's random numbers apart from the generator's."""
HIGHER_FROM, HIGHER = 350, (0.6, 1.7)
"""Index of a stream's first frame that is taken from another height than KITTI's, and how many times as high those
may be: depth must follow not only from objects' sizes, but also from where they stand on the ground."""
LEAST_NEARNESS = 0.01
"""Added before logarithms are taken: beyond 165 m distances cannot be distinguished, and no fog shows them."""


def street(seed: int, index: int, split: str) -> SynthFrame:
    """Frame `index` of a stream, with a background: as the segmenter sees it, from other heights too."""
    plan = plan_street(seed, index, split)
    if index >= HIGHER_FROM:
        rng = np.random.default_rng([STREAM, seed, index, split == "train"])
        view = plan.setting.view
        higher = replace(view, height_m=view.height_m * float(np.exp(rng.uniform(*np.log(HIGHER)))))
        plan = replace(plan, setting=replace(plan.setting, view=higher))
    frame = render_frame(plan, with_background=True)
    assert frame is not None
    return frame


def depth_to_nearness(depth_m: np.ndarray, height_m: float) -> np.ndarray:
    """Nearness (h, w) float16 at the size of stored frames. depth_m (H, W): each pixel takes one of its."""
    nearness = (height_m / depth_m).astype(np.float32)
    return cv2.resize(nearness, STORE_HW[::-1], interpolation=cv2.INTER_NEAREST).astype(np.float16)


def training_pictures(frame: SynthFrame) -> dict[str, np.ndarray]:
    """Stored arrays of a frame with a background: twice, with its actors and without, image (2, h, w, 3) uint8,
    classes (2, h, w) uint8 and nearness (2, h, w) float16; elevation and the ground's nearness (h, w) float16;
    focal () px.
    """
    assert frame.background is not None
    assert frame.background_depth_m is not None
    ground, camera = frame.environment.ground, frame.camera
    table = np.full(256, StreetClass.OTHER, np.uint8)
    for material, kind in CLASS_OF.items():
        table[material] = kind
    height_m = float(ground[3])
    size = STORE_HW[::-1]
    images = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (frame.image, frame.background))
    return {
        "images": np.stack(list(images)),
        "classes": np.stack([shrunk(surface_classes(frame)), shrunk(table[frame.ground_material])]),
        "nearness": np.stack([depth_to_nearness(d, height_m) for d in (frame.depth_m, frame.background_depth_m)]),
        "elevation": unet.compute_elevation(ground, camera, STORE_HW).astype(np.float16),
        "ground": depth_to_nearness(maps.compute_plane_depth(ground, camera), height_m),
        "focal": np.array(float(camera.intrinsics[0, 0]) * STORE_HW[0] / camera.height, np.float32),
    }


class DepthStore:
    """Frames of a stream, made as far as they are not there yet: see `training_pictures`. A picture is half a frame: 2i
    the one with actors, 2i + 1 the one without."""

    def __init__(self, folder: Path, frames: int, seed: int, split: str) -> None:
        parts = load_frames(
            folder, frames, seed, split, lambda index: training_pictures(street(seed, index, split))
        )
        self.images, self.classes, self.nearness = (
            np.concatenate([p[name] for p in parts]) for name in ("images", "classes", "nearness")
        )
        self.elevation, self.ground, self.focal = (
            np.stack([p[name] for p in parts]) for name in ("elevation", "ground", "focal")
        )

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True)
class DepthExample:
    """A part of a picture. image (h, w, 3) in [0, 1]; elevation, ground, nearness (h, w): as a camera of the
    network's focal length would have them."""

    image: np.ndarray
    elevation: np.ndarray
    ground: np.ndarray
    nearness: np.ndarray


_LEVEL = (StreetClass.ROAD, StreetClass.GROUND, StreetClass.GRASS)


def example(store: DepthStore, index: int, rng: np.random.Generator) -> DepthExample:
    """A part of a picture, zoomed, mirrored or not, in other light and colours.

    Zoomed, all is as near as it seems. The horizon given to the network is disturbed, as an estimated plane would be;
    the ground is off with it.
    """
    part = window(rng)
    image = resample_crop(store.images[index], part).astype(np.float32) / 255
    classes = resample_crop(store.classes[index], part, cv2.INTER_NEAREST)
    zoom = np.float32(store.focal[index // 2] * part[1, 1] / unet.INPUT_FOCAL_PX)
    elevation = resample_crop(store.elevation[index // 2].astype(np.float32), part) * zoom
    ground = resample_crop(store.ground[index // 2].astype(np.float32), part) * zoom
    near = resample_crop(store.nearness[index].astype(np.float32), part, cv2.INTER_NEAREST) * zoom
    vary_colours(image, classes, elevation, rng)
    vary_light(image, classes, rng)
    image = vary_camera(image, rng)
    error = np.float32(rng.normal(0, HORIZON_ERROR))
    known = np.where(ground > 0, np.maximum(ground - error, 0), 0)
    near = np.maximum(np.where(np.isin(classes, _LEVEL), near + known - ground, near), known)
    return DepthExample(image, elevation + error, known, near)


@dataclass(frozen=True)
class DepthSettings(StreetSettings):
    """Settings of the depth network."""

    steps: int = 2600
    frames: int = 500
    gradient: float = 0.5
    """Weight of the slopes' term."""


Batch = tuple[Tensor, Tensor, Tensor, Tensor]


def build_batch(store: DepthStore, step: int, settings: DepthSettings) -> Batch:
    """Images (N, 3, h, w), elevations, the ground's nearness and the truth (N, 1, h, w) of a step: a function of
    the seed and the step alone."""
    examples = []
    for place in range(settings.batch):
        rng = np.random.default_rng([settings.seed, step, place])
        examples.append(example(store, settings.frame_index(step, place, len(store)), rng))
    maps_of = (np.stack([getattr(e, name) for e in examples]) for name in ("elevation", "ground", "nearness"))
    elevation, ground, near = (torch.from_numpy(m.astype(np.float32))[:, None] for m in maps_of)
    images = torch.from_numpy(np.stack([e.image for e in examples])).permute(0, 3, 1, 2)
    return images, elevation, ground, near


def compute_loss(numbers: Tensor, ground: Tensor, near: Tensor, gradient: float) -> Tensor:
    """Mean difference () of the logarithms of nearness, and of their slopes at three scales. numbers (N, 1, h/2,
    w/2): the network's; ground, near (N, 1, h, w)."""
    found = F.avg_pool2d(ground, 2) + depth.nearness_excess(numbers)
    apart = (found + LEAST_NEARNESS).log() - (F.avg_pool2d(near, 2) + LEAST_NEARNESS).log()
    return multiscale_error(apart, gradient)


class DepthRun(StreetRun[DepthNet]):
    """The network in training."""

    settings: DepthSettings

    def __init__(self, settings: DepthSettings) -> None:
        torch.manual_seed(settings.seed)
        network = DepthNet().train()
        load_features(network)
        super().__init__(network, settings)

    def compute_loss(self, store: DepthStore) -> Tensor:
        images, elevation, ground, near = build_batch(store, self.step_number, self.settings)
        with autocast():
            numbers = self.network(images, elevation)
        return compute_loss(numbers.float(), ground, near, self.settings.gradient)


FAR_M = 120.0
"""Farther truths are not judged: fog hides what is there."""


def judge(network: DepthNet, frames: Sequence[SynthFrame]) -> dict[str, tuple[float, float]]:
    """Relative error and share of pixels within a quarter of the truth, means over frames with a background, by
    each source of depth: walls by rule, the network, and both combined as in use."""
    found: dict[str, list[tuple[float, float]]] = {}
    for frame in frames:
        assert frame.background is not None
        assert frame.background_depth_m is not None
        ground, camera = frame.environment.ground, frame.camera
        image = np.asarray(frame.background / 255, np.float32)
        seen = segment.segment_photograph(image, ground, camera)
        nothing = np.zeros_like(seen.sky)
        ties = depth.DepthConstraints(seen.sky, seen.ground, nothing, nothing)
        outlook = depth.GroundFrame.from_image(image, ground, camera)
        alone = depth.nearness_by_network(outlook, seen.ground, network)
        horizon = maps.horizon_row(ground, camera)
        guesses = {
            "walls by rule": maps.compute_wall_depth(outlook.plane_m, seen.ground, nothing, seen.sky, horizon),
            "network": outlook.depth_m(alone * (1 - seen.sky)),
            "both": depth.estimate_depth(image, ground, camera, ties, network),
        }
        known = frame.background_depth_m < FAR_M
        true = frame.background_depth_m[known]
        for name, guess in guesses.items():
            estimate = np.minimum(guess[known], 300.0)
            near = np.maximum(estimate / true, true / estimate) < 1.25
            found.setdefault(name, []).append((float((np.abs(estimate - true) / true).mean()), float(near.mean())))
    means = {name: np.mean(rows, axis=0) for name, rows in found.items()}
    return {name: (float(error), float(near)) for name, (error, near) in means.items()}


CARD = """# Depth of photographs' surroundings, trained on generated streets

- Architecture: `scene_ir.derender.depth.DepthNet`, {parameters:,} parameters: the segmenter's network
  (`scene_ir.derender.unet`), on the picture at 0.4 of KITTI's size (focal length {focal:.0f} px) and the
  elevation of each pixel's ray above the horizon. One number a pixel: by how much it is nearer than the ground
  that its ray meets.
- Weights: `{file}`, float16, safetensors. Licence: Apache-2.0, as the whole project. Training starts from
  the segmenter's weights; nothing else is pretrained.
- Data: {frames:,} frames of the project's own generator, version {version}, in all its weathers, seasons and
  camera angles, each with its vehicles and people and without; those from number {higher} on from {low} to {high}
  times KITTI's height. No photographs. Other colours and light, other skies; other exposure and contrast, blur,
  haze, noise, compression; zoomed, mirrored.
- Training: {steps:,} steps of {batch} crops, {minutes:.0f} minutes of one CPU core, seed {seed}. Loss:
  difference of the logarithms of nearness, and of their slopes at three scales.{note}

## Figures

Held out: {held_out} frames of the generator without vehicles (shapes and streets that no training frame has), up
to {far:.0f} m. Relative error is the mean of |d - d*| / d*; within 1.25 is the share of pixels with a ratio to
the truth is smaller. What a scene keeps is the mean of both, in logarithms.

{table}

Against a laser, and in fog, on photographs: `python -m tools.bench depth`, docs/research/benchmarks.md.

## Limits

It has seen generated pictures only. On photographs it errs to the far side. Objects that stand on no ground that
is seen, fences that one sees through, trams and bridges it does not know. Not for use in a vehicle, and no
measurement.

## Train it again

```
python tools/train_depth.py --frames {frames} --steps {steps} --seed {seed}
```
With the same generator, on the same machine, another run gives the same bytes.
"""


def format_table(metrics: dict[str, tuple[float, float]]) -> str:
    """Markdown table, one row per source of depth."""
    rows = [f"| {name} | {error:.3f} | {near:.3f} |" for name, (error, near) in metrics.items()]
    return "\n".join(["| depth by | relative error | within 1.25 |", "| --- | --- | --- |", *rows])


TRAIN_SEED, HELD_SEED = 51, 52
"""Of the generator's streams."""


def main() -> None:
    arguments, settings = parse_options(__doc__, Path("build/depth"), depth.WEIGHTS, 40, DepthSettings)
    store = DepthStore(arguments.run / "train", settings.frames, TRAIN_SEED, "train")
    run = DepthRun(settings)
    if not run.train(store, arguments.run, arguments.pause_after):
        return
    frames = [street(HELD_SEED, index, "heldout") for index in range(arguments.held_out)]
    metrics = judge(run.averaged(), frames)
    table = format_table(metrics)
    print(table)
    reach = {"higher": HIGHER_FROM, "low": HIGHER[0], "high": HIGHER[1], "far": FAR_M}
    run.write_results(arguments, CARD, metrics, focal=unet.INPUT_FOCAL_PX, table=table, **reach)


if __name__ == "__main__":
    main()
