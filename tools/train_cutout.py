"""Train the network that cuts vehicles out (`scene_ir.derender.cutout`) on generated streets.

    python tools/fetch_assets.py build/assets
    python tools/train_cutout.py --assets build/assets
    python tools/train_cutout.py --people --out scene_ir/derender/weights/people.safetensors

Streets are generated first, in `--run`. A run resumes from its last checkpoint, to the same bytes as one that
was never stopped (one thread, one machine).
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
import torch
from averaged import AveragedRun, autocast
from numpy.typing import NDArray
from torch import Tensor

from drivesem.synth.assets import Assets, assets_from, of_split
from drivesem.synth.frames import (
    GENERATOR_VERSION,
    VARIANTS,
    SynthFrame,
    SynthSettings,
    Truth,
    plan_frame,
    render_frame,
)
from drivesem.synth.layout import LayoutSettings
from drivesem.synth.soup import Semantic
from drivesem.synth.view import blocks
from scene_ir import files
from scene_ir.derender import cutout, silhouette, upright
from scene_ir.derender.cutout import CROP_HW, HALO, TILE, CutoutNet
from scene_ir.derender.pose import crop_boxes
from scene_ir.derender.silhouette import Placement
from scene_ir.geometry import project_boxes
from scene_ir.meshes.outlines import KINDS
from scene_ir.types import Camera

Bytes = NDArray[np.uint8]

LEAST_PX, MOST_PX, LEAST_SEEN = 12.0, 330.0, 0.1
"""Heights and visible share of the vehicles that are learnt from."""
AROUND = 0.7
"""Margin of the stored crop on each side of a vehicle, in sides of its box; and 10 px."""
CLEAR_M = 0.3
"""What is that much nearer than all of a vehicle stands in front of it."""
DARK = 0.15
"""Ground that loses that share of its brightness through a vehicle is wholly shadow."""
LAYERS = ("red", "green", "blue", "visible", "front", "shadow", "nearer", "whole")
"""Channels of a stored crop, uint8: the photograph; share of each pixel that shows the vehicle, an occluder, its
or another's shadow on the ground; nearer vehicles; and the share that would show it if nothing hid it."""
_GROUND = (int(Semantic.ROAD), int(Semantic.TERRAIN))
VEHICLES = ("Car", "Van", "Truck")
PEOPLE = ("Pedestrian", "Cyclist")
CROWD = 8
"""Times as many people in the streets that people are learnt from."""


@dataclass(frozen=True)
class CutoutCases:
    """K vehicles."""

    rect: np.ndarray
    """x0, y0, x1, y1 of the stored crops, px, (K, 4)."""
    start: np.ndarray
    """Its first byte; matrix (K, 3, 4), (K,)."""
    matrix: np.ndarray
    ground: np.ndarray
    """Plane, (K, 4)."""
    size_wh: np.ndarray
    """The photograph's, (K, 2)."""
    translation: np.ndarray
    """The true pose, (K, 3)."""
    yaw: np.ndarray
    """The true pose, (K,)."""
    size_lhw: np.ndarray
    """The true pose, (K, 3)."""
    kind: np.ndarray
    """Index into `VEHICLES`, or into `PEOPLE`, (K,)."""
    visible: np.ndarray
    """Share of its silhouette in the image, (K,)."""


def street_settings(index: int, split: str, pack: Assets, people: bool = False) -> SynthSettings:
    """Every other street with the pack's vehicles and skies, all with more vehicles, or people, than KITTI has."""
    fleet = of_split(pack.vehicles, split) if index % 2 else ()
    crowd = CROWD if people else 1
    layout = LayoutSettings(VARIANTS[split], vehicles=(4, 12), fleet=fleet, crowd=crowd, varied_people=people)
    return SynthSettings(layout, bent=True, skies=pack.skies if index % 2 else ())


def cutout_cases(
    frame: SynthFrame, labels: tuple[str, ...] = VEHICLES
) -> Iterator[tuple[Bytes, dict[str, object]]]:
    """Yield crop (h, w, 8) and row of `CutoutCases`, without start, of each usable object of a frame."""
    assert frame.background is not None
    samples = blocks(frame.owner)
    lit = frame.background.max(-1).astype(np.float32)
    lost = (lit - frame.image.max(-1)) / np.maximum(lit, 8.0)
    ground = np.isin(frame.semantic, _GROUND)
    dark = np.clip(lost / DARK, 0, 1) * ground
    for truth in frame.truths:
        height = truth.box_xyxy[3] - truth.box_xyxy[1]
        if (
            truth.actor.label not in labels
            or not LEAST_PX <= height <= MOST_PX
            or truth.visible < LEAST_SEEN
            or not np.isfinite(nearest_m(truth, frame))
        ):
            continue
        x0, y0, x1, y1 = crop_rect(truth, frame)
        window = (slice(y0, y1), slice(x0, x1))
        shares = {t.index: share_in(samples, window, t.index + 1) for t in frame.truths}
        visible = shares[truth.index]
        whole = np.zeros(frame.depth_m.shape, np.float32)
        h, w = truth.opacity.values.shape[1:]
        whole[truth.opacity.y0 : truth.opacity.y0 + h, truth.opacity.x0 : truth.opacity.x0 + w] = (
            truth.opacity.values[0].numpy()
        )
        whole = whole[window]
        hiding, nearer = np.zeros_like(whole), np.zeros_like(whole)
        for other in frame.truths:
            if other is not truth and np.count_nonzero((whole > 0.5) & (shares[other.index] > 0.5)) >= 2:
                hiding += shares[other.index]
            if other.actor.label in {*VEHICLES, *labels} and far_m(other) < far_m(truth):
                nearer += shares[other.index]
        near = (frame.depth_m[window] < nearest_m(truth, frame) - CLEAR_M) & ~ground[window]
        # Beyond its own border a pixel's share is unknown: what hides part of it, may hide all.
        hidden = np.where(whole > 0.99, 1 - visible, np.clip(whole - visible, 0, 1))
        front = np.maximum(np.maximum(hiding, near), hidden).clip(0, 1 - visible)
        layers = np.stack([visible, front, dark[window] * (1 - visible - front), nearer, whole], axis=-1)
        stored = np.concatenate([frame.image[window], np.rint(255 * layers.clip(0, 1)).astype(np.uint8)], axis=-1)
        yield (
            stored,
            {
                "rect": [x0, y0, x1, y1],
                "matrix": frame.camera.matrix.numpy(),
                "ground": frame.environment.ground.numpy(),
                "size_wh": [frame.camera.width, frame.camera.height],
                "translation": truth.translation,
                "yaw": truth.yaw,
                "size_lhw": truth.actor.size_lhw,
                "kind": labels.index(truth.actor.label),
                "visible": truth.visible,
            },
        )


def nearest_m(truth: Truth, frame: SynthFrame) -> float:
    """Depth of the vehicle's nearest corner, m; NaN where it reaches behind the camera."""
    size = torch.tensor([truth.actor.size_lhw], dtype=torch.float64)
    yaw = torch.tensor([truth.yaw], dtype=torch.float64)
    place = torch.from_numpy(truth.translation)[None]
    if not bool(torch.isfinite(project_boxes(size, yaw, place, frame.camera.matrix.double())).all()):
        return math.nan
    length, _, width = truth.actor.size_lhw
    reach = abs(math.sin(truth.yaw)) * length / 2 + abs(math.cos(truth.yaw)) * width / 2
    return float(truth.translation[2] - reach)


def share_in(samples: list[np.ndarray], window: tuple[slice, slice], owner: int) -> NDArray[np.float32]:
    """How much (h, w) of each pixel of a window shows the owner, in [0, 1]."""
    return np.mean([part[window] == owner for part in samples], axis=0, dtype=np.float32)


def far_m(truth: Truth) -> float:
    """How far a vehicle's middle is, m on the ground."""
    return float(np.hypot(truth.translation[0], truth.translation[2]))


def crop_rect(truth: Truth, frame: SynthFrame) -> tuple[int, int, int, int]:
    """The stored part of the photograph around a vehicle, px, half-open."""
    x0, y0, x1, y1 = truth.box_xyxy
    wide, high = AROUND * (x1 - x0) + 10, AROUND * (y1 - y0) + 10
    return (
        max(int(x0 - wide), 0),
        max(int(y0 - high), 0),
        min(int(x1 + wide) + 1, frame.camera.width),
        min(int(y1 + high) + 1, frame.camera.height),
    )


CHUNK = 40
"""Streets that are made, or not, together."""


def make(
    folder: Path, split: str, seed: int, frames: int, assets: Path | None, people: bool = False
) -> list[Path]:
    """Folders of `CHUNK` streets each, made where they are not there yet: all of `frames` streets' vehicles, or
    people.
    """
    labels = PEOPLE if people else VEHICLES
    pack = assets_from(assets) if assets is not None else Assets((), ())
    made = []
    for first in range(0, frames, CHUNK):
        part = folder / f"{first:05d}"
        facts = {"seed": seed, "split": split, "assets": assets is not None, "generator": GENERATOR_VERSION}
        facts |= {"people": "varied, with prams"} if people else {}
        facts["frames"] = min(CHUNK, frames - first)
        made.append(part)
        if (part / "made.json").is_file() and files.read_json(part / "made.json") == facts:
            continue
        part.mkdir(parents=True, exist_ok=True)
        rows: list[dict[str, object]] = []
        place = 0
        with (part / "layers.bin").open("wb") as out:
            for index in range(first, first + facts["frames"]):
                settings = street_settings(index, split, pack, people)
                frame = render_frame(plan_frame(seed, index, split, settings), True)
                assert frame is not None
                for crop, row in cutout_cases(frame, labels):
                    out.write(crop.tobytes())
                    rows.append(row | {"start": place})
                    place += crop.size
        files.write_npz(
            part / "cases.npz", {f.name: np.array([row[f.name] for row in rows]) for f in fields(CutoutCases)}
        )
        files.write_json(part / "made.json", facts)
        print(f"{split}: {first + facts['frames']} streets, {len(rows)} objects in the last {CHUNK}", flush=True)
    return made


class CutoutStore:
    """Vehicles of folders that `make` wrote."""

    def __init__(self, parts: Sequence[Path], people: bool = False) -> None:
        self.people = people
        loaded = [files.read_npz(part / "cases.npz") for part in parts]
        self.cases = CutoutCases(*(np.concatenate([one[f.name] for one in loaded]) for f in fields(CutoutCases)))
        self.part = np.repeat(np.arange(len(parts)), [len(one["start"]) for one in loaded])
        self.bytes = [np.memmap(part / "layers.bin", np.uint8, "r") for part in parts]

    def __len__(self) -> int:
        return len(self.part)

    def layers(self, index: int) -> Bytes:
        """The stored crop of a vehicle (h, w, 8), see `LAYERS`."""
        x0, y0, x1, y1 = self.cases.rect[index].tolist()
        shape = (y1 - y0, x1 - x0, len(LAYERS))
        start = int(self.cases.start[index])
        return self.bytes[int(self.part[index])][start : start + math.prod(shape)].reshape(shape)

    def camera(self, index: int) -> Camera:
        """That took the photograph."""
        matrix = torch.from_numpy(self.cases.matrix[index]).float()
        width, height = self.cases.size_wh[index].tolist()
        return Camera(matrix[:, :3].contiguous(), height, width, matrix)

    def disturbed(self, index: int, amount: float, rng: np.random.Generator) -> Placement:
        """A template at the vehicle's label, or a person's box, off by `amount` times what hand-drawn labels are."""
        cases = self.cases
        if self.people:
            x0, y0, _, _ = cases.rect[index].tolist()
            whole = self.layers(index)[..., 7] > 127
            rows, columns = np.flatnonzero(whole.any(1)), np.flatnonzero(whole.any(0))
            box = np.array([x0 + columns[0], y0 + rows[0], x0 + columns[-1], y0 + rows[-1]], np.float64)
            side = np.tile(box[2:] - box[:2], 2)
            box += amount * (BOX_SHARE * side + 0.5) * np.clip(rng.normal(0, 0.8, 4), -1.5, 1.5)
            place = torch.from_numpy(cases.translation[index]).float()
            return upright.place_box(torch.from_numpy(box), place, self.camera(index))
        angle, far = rng.uniform(0, 2 * math.pi), amount * SHIFT_M * min(abs(rng.normal(0, 0.8)), 1.5)
        place = cases.translation[index].copy()
        normal = cases.ground[index]
        place[0] += far * math.cos(angle)
        place[2] += far * math.sin(angle)
        place[1] -= far * (math.cos(angle) * normal[0] + math.sin(angle) * normal[2]) / normal[1]
        yaw = float(cases.yaw[index]) + amount * TURN_RAD * float(np.clip(rng.normal(0, 0.8), -1.5, 1.5))
        size = cases.size_lhw[index] * (1 + amount * STRETCH * np.clip(rng.normal(0, 0.8, 3), -1.5, 1.5))
        kinds = silhouette.rank_template_kinds(VEHICLES[int(cases.kind[index])], size.tolist())
        if rng.random() < WRONG_SHARE:
            kinds = KINDS
        kind = kinds[0 if rng.random() < LIKELIEST_SHARE else int(rng.integers(len(kinds)))]
        return silhouette.place_mesh(
            kind, torch.from_numpy(place).float(), torch.tensor(yaw), torch.from_numpy(size).float()
        )


SHIFT_M, TURN_RAD, STRETCH, BOX_SHARE = 0.2, math.radians(5.0), 0.05, 0.04
"""How far labels are off: as hand-drawn 3D boxes are, and the sides of people's 2D boxes, in its sides."""
AMOUNTS, AMOUNT_SHARE = (0.2, 1.0, 2.0), (0.45, 0.35, 0.2)
"""Of that: as after the fit, as labels, and worse."""
WRONG_SHARE, LIKELIEST_SHARE = 0.08, 0.6
"""Vehicles that get a template of any kind; of the others, those that get the likeliest."""
CAMOUFLAGE_SHARE, JPEG_SHARE, POLE_SHARE, GIVEN_SHARE = 0.3, 0.3, 0.15, 0.3
"""Vehicles painted as bright as what is around them; photographs that were compressed; vehicles with a pole in
front; refinements start from a mask instead of a first pass."""
CLOTHES_SHARE = 0.7
"""People whose clothes get folds and patterns."""
TILES = 2
"""Refinement tiles per vehicle."""


@dataclass(frozen=True)
class CutoutSample:
    """One vehicle to learn from. crop (96, 160, 3) uint8; truth (96, 160, 3): visible, front, shadow, uint8; given
    (2, 96, 160): nearer vehicles, and what lies inside; photograph (h, w, 3), shares (h, w, 3) uint8: what lies
    inside in its own pixels, its first pixel at offset (x, y) of the crop's rect."""

    placement: Placement
    camera: Camera
    ground: Tensor
    rect: tuple[int, int, int, int]
    crop: Bytes
    truth: Bytes
    given: NDArray[np.float32]
    photograph: Bytes
    shares: Bytes
    offset: tuple[int, int]


def make_sample(
    store: CutoutStore, index: int, amount: float, rng: np.random.Generator | None
) -> CutoutSample | None:
    """A vehicle with its template off by `amount`; rng: also in other looks. None where the template shows nowhere
    in the stored crop."""
    camera = store.camera(index)
    placement = store.disturbed(index, amount, rng or np.random.default_rng(index))
    rect = cutout.crop_rectangle(placement, camera)
    if rect is None:
        return None
    if rng is not None:
        rect = jittered(rect, rng)
    x0, y0, x1, y1 = store.cases.rect[index].tolist()
    left, top, right, bottom = max(rect[0], x0), max(rect[1], y0), min(rect[2], x1), min(rect[3], y1)
    if right - left < 8 or bottom - top < 8:
        return None
    layers = store.layers(index)[top - y0 : bottom - y0, left - x0 : right - x0]
    photograph = np.ascontiguousarray(layers[..., :3])
    shares, nearer = np.ascontiguousarray(layers[..., 3:6]), np.ascontiguousarray(layers[..., 6])
    if rng is not None:
        if store.people and rng.random() < CLOTHES_SHARE:
            photograph = vary_clothes(photograph, shares[..., 0], rng)
        photograph, shares = vary_appearance(photograph, shares, rng)
    box = np.array([[rect[0] - left, rect[1] - top, rect[2] - left, rect[3] - top]], np.float32) - 0.5
    inside = cutout.inside_mask(rect, (left, top, right, bottom))
    crop = crop_boxes(photograph, box, CROP_HW, 1.0)[0]
    truth = crop_boxes(shares, box, CROP_HW, 1.0)[0] * (inside > 0)[..., None].astype(np.uint8)
    others = crop_boxes(np.repeat(nearer[..., None], 3, 2), box, CROP_HW, 1.0)[0, ..., 0] * inside / 255
    if rng is not None:
        others = misjudged(others, rng)
    given = np.stack([others, inside]).astype(np.float32)
    ground = torch.from_numpy(store.cases.ground[index]).float()
    offset = (left - rect[0], top - rect[1])
    return CutoutSample(placement, camera, ground, rect, crop, truth, given, photograph, shares, offset)


def jittered(rect: tuple[int, int, int, int], rng: np.random.Generator) -> tuple[int, int, int, int]:
    """A rectangle somewhat larger or smaller, and elsewhere."""
    wide, high = rect[2] - rect[0], rect[3] - rect[1]
    zoom = math.exp(rng.normal(0, 0.08))
    new_wide, new_high = max(round(wide * zoom), 12), max(round(high * zoom), 8)
    x0 = rect[0] + round((wide - new_wide) / 2 + rng.normal(0, 0.03) * wide)
    y0 = rect[1] + round((high - new_high) / 2 + rng.normal(0, 0.03) * high)
    return x0, y0, x0 + new_wide, y0 + new_high


def misjudged(nearer: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Nearer vehicles' pixels (h, w) as they are known: a little off, or not at all."""
    if rng.random() < 0.15:
        return np.zeros_like(nearer)
    mask = np.roll((nearer > 0.5).astype(np.float32), tuple(rng.integers(-2, 3, 2)), (0, 1))
    size = int(rng.integers(1, 3)) * 2 + 1
    change = rng.random()
    if change < 0.3:
        return cv2.dilate(mask, np.ones((size, size)))
    return cv2.erode(mask, np.ones((size, size))) if change < 0.6 else mask


_NOISE = np.random.default_rng(5).normal(0, 1, (512, 2048, 3)).astype(np.float32)


def vary_appearance(photograph: Bytes, shares: Bytes, rng: np.random.Generator) -> tuple[Bytes, Bytes]:
    """The photograph in other light, other colours, less sharp, noisier, compressed; the vehicle painted as its
    surroundings are, or behind a pole; and the shares that belong to it."""
    visible = shares[..., 0]
    if rng.random() < CAMOUFLAGE_SHARE:
        photograph = camouflage(photograph, visible, rng)
    if rng.random() < POLE_SHARE:
        photograph, shares = add_pole(photograph, shares, rng)
    levels = np.arange(256, dtype=np.float32)[:, None] / 255
    level = float(photograph.mean()) / 255
    curve = levels ** np.exp(rng.uniform(-0.5, 0.5))
    curve = (level + (curve - level) * rng.uniform(0.5, 1.4)) * rng.normal(1, 0.06, 3) * rng.uniform(0.65, 1.35)
    table = np.rint(255 * curve.clip(0, 1)).astype(np.uint8)[None]
    photograph = np.asarray(cv2.LUT(photograph, table))
    amount = 0.0 if rng.random() < 0.1 else rng.uniform(0.5, 1.6)
    photograph = cv2.transform(photograph, amount * np.eye(3) + (1 - amount) * np.full((3, 3), 1 / 3))
    if rng.random() < 0.45:
        photograph = cv2.GaussianBlur(photograph, (0, 0), rng.uniform(0.3, 1.3))
    if rng.random() < 0.7:
        h, w = photograph.shape[:2]
        y, x = int(rng.integers(0, 512 - h)), int(rng.integers(0, 2048 - w))
        noise = _NOISE[y : y + h, x : x + w] * (255 * rng.uniform(0, 0.035))
        photograph = np.clip(photograph + noise, 0, 255).astype(np.uint8)
    if rng.random() < JPEG_SHARE:
        _, data = cv2.imencode(".jpg", photograph, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 95))])
        photograph = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))
    return photograph, shares


def vary_clothes(photograph: Bytes, visible: Bytes, rng: np.random.Generator) -> Bytes:
    """A person in clothes with folds and patterns: smooth factors of all sizes on what is visible (h, w)."""
    h, w = visible.shape
    folds = np.zeros((h, w, 3), np.float32)
    for cells in (2, 5, 12):
        coarse = rng.normal(0, rng.uniform(0, 0.4), (cells * 2, cells, 1)) + rng.normal(
            0, 0.1, (cells * 2, cells, 3)
        )
        folds += cv2.resize(coarse.astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
    alpha = visible.astype(np.float32)[..., None] / 255
    return np.clip(photograph * (1 + alpha * (np.exp(folds) - 1)), 0, 255).astype(np.uint8)


def camouflage(photograph: Bytes, visible: Bytes, rng: np.random.Generator) -> Bytes:
    """The vehicle's colours brought near to those around it, all or some of the way."""
    alpha = visible.astype(np.float32)[..., None] / 255
    around = cv2.dilate(visible, np.ones((9, 9))) > 0
    ring = around & (visible == 0)
    if not ring.any() or not (visible > 128).any():
        return photograph
    own = photograph[visible > 128].astype(np.float32).mean(0)
    goal = photograph[ring].astype(np.float32)[rng.integers(0, np.count_nonzero(ring), 40)].mean(0)
    gain = (goal + 8) / (own + 8)
    gain = np.exp(np.log(gain) * rng.uniform(0.5, 1.1)).astype(np.float32)
    repainted = photograph.astype(np.float32) * (1 + alpha * (gain - 1))
    return np.clip(repainted, 0, 255).astype(np.uint8)


def add_pole(photograph: Bytes, shares: Bytes, rng: np.random.Generator) -> tuple[Bytes, Bytes]:
    """With an upright bar of one colour, lighter towards one side, in front."""
    h, w = photograph.shape[:2]
    wide = max(rng.uniform(0.02, 0.1) * w, 1.0)
    middle, lean = rng.uniform(0.1, 0.9) * w, rng.normal(0, 0.03)
    top, bottom = (0, h) if rng.random() < 0.6 else (int(rng.uniform(0, 0.6) * h), int(rng.uniform(0.7, 1) * h))
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    across = (x - middle - lean * y) / (wide / 2)
    alpha = np.clip((1 - np.abs(across)) * wide / 2 + 0.5, 0, 1)
    alpha[:top], alpha[bottom:] = 0, 0
    colour = rng.uniform(15, 230) * rng.normal(1, 0.1, 3)
    bar = colour * (1 + rng.uniform(-0.5, 0.5) * across.clip(-1, 1))[..., None]
    photograph = np.clip(photograph + (bar - photograph) * alpha[..., None], 0, 255).astype(np.uint8)
    composed = shares.astype(np.float32) * (1 - alpha[..., None])
    composed[..., 1] += 255 * alpha
    return photograph, np.rint(composed).clip(0, 255).astype(np.uint8)


def build_batch(
    store: CutoutStore, step: int, settings: CutoutSettings
) -> tuple[list[CutoutSample], np.random.Generator]:
    """The vehicles of a step, and the generator for what is left to draw: both a function of the seed and the
    step alone."""
    rng = np.random.default_rng([settings.seed, step])
    per_epoch = max(len(store) // settings.batch, 1)
    epoch, place = divmod(step, per_epoch)
    order = np.random.default_rng([settings.seed, 1_000_000 + epoch]).permutation(len(store))
    chosen = order[place * settings.batch : (place + 1) * settings.batch]
    found = [make_sample(store, int(i), float(rng.choice(AMOUNTS, p=AMOUNT_SHARE)), rng) for i in chosen]
    return [sample for sample in found if sample is not None], rng


def first_inputs(samples: Sequence[CutoutSample]) -> tuple[Tensor, Tensor]:
    """Crops (N, 3, 96, 160) and guides (N, 7, 96, 160)."""
    crops = torch.from_numpy(np.stack([s.crop for s in samples])).permute(0, 3, 1, 2).float() / 255
    given = np.stack([s.given for s in samples])
    cameras = [cutout.crop_camera(s.camera, s.rect) for s in samples]
    return crops, cutout.render_guides([s.placement for s in samples], cameras, [s.ground for s in samples], given)


def pixel_weights(sample: CutoutSample) -> NDArray[np.float32]:
    """How much each pixel (96, 160) of a crop counts: those along the vehicle's border five times as much."""
    visible = np.ascontiguousarray(sample.truth[..., 0])
    edge = cv2.dilate(visible, np.ones((5, 5))) - cv2.erode(visible, np.ones((5, 5)))
    return (0.5 + 2 * edge.astype(np.float32) / 255) * sample.given[1]


def mirror(
    crops: Tensor, first: Tensor, truth: Tensor, weight: Tensor, flip: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Some of the batch mirrored: what is left of a vehicle is right of it then."""
    sign = torch.ones(cutout.GUIDE_CHANNELS)
    sign[3] = -1
    chosen = flip[:, None, None, None]
    return (
        torch.where(chosen, crops.flip(3), crops),
        torch.where(chosen, first.flip(3) * sign[:, None, None], first),
        torch.where(chosen, truth.flip(3), truth),
        torch.where(chosen, weight.flip(3), weight),
    )


def initial_loss(logits: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Cross entropy with the true shares (N, 3, 96, 160), by weight."""
    rest = (1 - truth.sum(1, keepdim=True)).clamp(min=0)
    wanted = torch.cat([truth, rest], 1)
    return -((wanted * logits.float().log_softmax(1)).sum(1, keepdim=True) * weight).sum() / weight.sum()


def split_tiles(
    sample: CutoutSample, first: NDArray[np.float32], rng: np.random.Generator
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Refinement tiles at a vehicle's borders: inputs (6, 48, 48), and true shares (2, 48, 48) of visible and front.
    first (3, 96, 160): shares of the first pass."""
    h, w = sample.photograph.shape[:2]
    rect, (left, top) = sample.rect, sample.offset
    size = (rect[2] - rect[0], rect[3] - rect[1])
    if rng.random() < GIVEN_SHARE:
        hard = (np.roll(sample.shares, tuple(rng.integers(-1, 2, 2)), (0, 1)) > 127).astype(np.float32)
        hard[..., 1] *= rng.random() < 0.5
        hard[..., 2] = 0
        before = hard.transpose(2, 0, 1)
    else:
        before = cutout.resize_shares(first, size)[:, top : top + h, left : left + w]
    side = TILE + 2 * HALO
    both = np.concatenate([sample.photograph.transpose(2, 0, 1) / np.float32(255), before])
    truth = sample.shares[..., :2].transpose(2, 0, 1) / np.float32(255)
    pad = ((0, 0), (HALO, max(HALO, side - h)), (HALO, max(HALO, side - w)))
    both, truth = (np.pad(a, pad, mode="edge").astype(np.float32) for a in (both, truth))
    visible = sample.shares[..., 0]
    edge = cv2.dilate(visible, np.ones((3, 3))) - cv2.erode(visible, np.ones((3, 3))) > 100
    rows, columns = np.nonzero(edge)
    for _ in range(TILES if len(rows) else 0):
        k = int(rng.integers(len(rows)))
        y = int(np.clip(rows[k] + HALO - side // 2, 0, both.shape[1] - side))
        x = int(np.clip(columns[k] + HALO - side // 2, 0, both.shape[2] - side))
        yield both[:, y : y + side, x : x + side], truth[:, y : y + side, x : x + side]


def second_loss(log_shares: Tensor, truth: Tensor) -> Tensor:
    """Cross entropy with the true shares (N, 2, 48, 48) of visible and front, and difference of the visible."""
    wanted = torch.cat([truth, (1 - truth.sum(1, keepdim=True)).clamp(min=0)], 1)
    inner = (..., slice(HALO, -HALO), slice(HALO, -HALO))
    apart = (log_shares.exp()[:, 0] - truth[:, 0]).abs()
    return -(wanted * log_shares).sum(1)[inner].mean() + apart[inner].mean()


@dataclass(frozen=True)
class CutoutSettings:
    """What decides on the result of a run."""

    cycles: tuple[tuple[int, float], ...] = ((1000, 3e-3), (900, 2e-3))
    """Steps, and the rate from which each falls to nothing."""
    batch: int = 16
    weight_decay: float = 0.02
    average: float = 0.995
    seed: int = 0

    @property
    def steps(self) -> int:
        """Of all cycles."""
        return sum(steps for steps, _ in self.cycles)

    def rate(self, step: int) -> float:
        """The rate of a step."""
        warm, first = min(1.0, (step + 1) / 50), 0
        for steps, rate in self.cycles:
            if step < first + steps:
                return rate * warm * 0.5 * (1 + math.cos(math.pi * (step - first) / steps))
            first += steps
        return 0.0


class CutoutRun(AveragedRun[CutoutNet]):
    """The network in training."""

    settings: CutoutSettings

    def __init__(self, settings: CutoutSettings) -> None:
        torch.manual_seed(settings.seed)
        super().__init__(CutoutNet().to(memory_format=torch.channels_last).train(), settings)

    def step(self, store: CutoutStore) -> dict[str, float]:
        """One step of the optimiser; the terms of the loss."""
        step, settings = self.step_number, self.settings
        with self.timed():
            samples, rng = build_batch(store, step, settings)
            crops, first = first_inputs(samples)
            truth = torch.from_numpy(np.stack([s.truth for s in samples])).permute(0, 3, 1, 2).float() / 255
            flip = torch.from_numpy(rng.random(len(samples)) < 0.5)
            weight = torch.from_numpy(np.stack([pixel_weights(s) for s in samples])[:, None])
            crops, first, truth, weight = mirror(crops, first, truth, weight, flip)
            with autocast():
                logits = self.network(crops, first)
            terms = {"first": initial_loss(logits, truth, weight)}
            seen = logits.detach().float().softmax(1)[:, :3]
            seen = torch.where(flip[:, None, None, None], seen.flip(3), seen).numpy()
            tiles = [
                tile
                for sample, share in zip(samples, seen, strict=True)
                for tile in split_tiles(sample, share, rng)
            ]
            both, wanted = (torch.from_numpy(np.stack(part)) for part in zip(*tiles, strict=True))
            both = both.contiguous(memory_format=torch.channels_last)
            with autocast():
                change = self.network.refine(both[:, :3], both[:, 3:])
            terms["second"] = second_loss(change.float(), wanted)
            terms["total"] = terms["first"] + terms["second"]
            self.descend(terms["total"], settings.rate(step))
        return {k: float(v.detach()) for k, v in terms.items()}


@torch.no_grad()
def judge(store: CutoutStore, network: CutoutNet, amount: float, most: int = 200) -> dict[str, float]:
    """Figures over the first `most` vehicles at least 40 px high of which 70% show, and over smaller or hidden
    ones: IoU of what is visible (median and tenth percentile); of occluders (median over vehicles with some);
    mean difference of the shares along the true border, in px of border."""
    large, small, front, border = [], [], [], []
    for index in range(min(len(store), most)):
        sample = make_sample(store, index, amount, None)
        if sample is None:
            continue
        shares = network(*first_inputs([sample])).softmax(1)[0, :3].numpy()
        (left, top), (h, w) = sample.offset, sample.photograph.shape[:2]
        size = (sample.rect[2] - sample.rect[0], sample.rect[3] - sample.rect[1])
        parts = cutout.resize_shares(shares, size)[:, top : top + h, left : left + w]
        first = cutout.Cutout(0, 0, *(np.ascontiguousarray(p) for p in parts))
        found = cutout.refine_cutouts(sample.photograph, [first], network)[0]
        truth = sample.shares.astype(np.float32) / 255
        value = silhouette.mask_iou(found.visible >= 0.5, truth[..., 0] >= 0.5)
        rows = np.flatnonzero((truth[..., 0] >= 0.5).any(1))
        if not len(rows):
            continue
        good = rows[-1] - rows[0] >= 40 and store.cases.visible[index] >= 0.7
        (large if good else small).append(value)
        if (truth[..., 1] >= 0.5).sum() > 30:
            front.append(silhouette.mask_iou(found.front >= 0.5, truth[..., 1] >= 0.5))
        edge = cv2.dilate(truth[..., 0], np.ones((5, 5))) - cv2.erode(truth[..., 0], np.ones((5, 5))) > 0.5
        border.append(float(np.abs(found.visible - truth[..., 0])[edge].mean()) * 5)
    return {
        "vehicles": len(large),
        "iou": float(np.median(large)),
        "iou_p10": float(np.percentile(large, 10)),
        "others": len(small),
        "others_iou": float(np.median(small)),
        "others_iou_p10": float(np.percentile(small, 10)),
        "front_iou": float(np.median(front)),
        "border_px": float(np.median(border)),
    }


CARD = """# {title} cut out of photographs, trained on generated streets

- Architecture: `scene_ir.derender.cutout.CutoutNet`, {parameters:,} parameters: an encoder to a sixteenth and back
  on a 96x160 crop around {guide} (colours, its coverage and surface, nearness to its
  footprint, nearer objects), and {second:,} for a refinement at the photograph's own pixels along the borders.
- Weights: `{file}`, float16, safetensors. Licence: Apache-2.0, as the whole project. {start}
  SHA-256: `{sha256}`
- Data: {frames:,} streets of the project's own generator (version {version}, split train, seed {data_seed}),
  {vehicles:,} objects at least {least:.0f} px high of which 10% show; no photographs. {variety}
  Other light and colours, blur, noise, compression; objects as bright as what is around them; poles in front.
- Training: {steps:,} steps of {batch}, in {count} cycle(s) of the rate, {minutes:.0f} minutes of one CPU core,
  seed {seed}.{note}

## Figures

Held out: {held} objects of the generator's split heldout (shapes and streets that no training street has), seed
{held_seed}. Labels are off by `amount` times {off}. "large": at least 40 px high, of which 70%
show; "others": smaller or more hidden. IoU of the pixels at least half covered; border: mean error of the shares
across the true border, in px.

{table}

## Limits

It has seen generated pictures only. Without {guide} it finds nothing: it is no detector.
{limits} Not for use in a vehicle.

## Train it again

```
python tools/fetch_assets.py build/assets
python tools/train_cutout.py {option} --frames {frames} --steps {cycles} --seed {seed}
```
With the same, on the same machine, another run gives the same bytes.
"""
VEHICLE_CARD = {
    "title": "Vehicles",
    "guide": "the placed template",
    "start": "Nothing pretrained.",
    "variety": """Every other street has
  vehicles and skies of the pack that `tools/fetch_assets.py` fetches. Templates at labels that are off as after
  the fit, as drawn by hand, and by twice that; some of a wrong kind.""",
    "off": "0.2 m, 5 degrees and 5%",
    "limits": """On
photographs it takes dark parts of vehicles for occluders now and then, and misses thin poles and trunks;
`remove_unlikely_occluders` keeps of the former only what is shaped like a pole or known from elsewhere.""",
    "option": "--assets build/assets",
}
PEOPLE_CARD = {
    "title": "People and cyclists",
    "guide": "a thin upright box that fills the label's 2D box",
    "start": "Trained on from `cutout.safetensors`.",
    "variety": """Varied people
  (coats, skirts, hats, bags, prams, children, people side by side, riders of motorcycles) in boxes with sides off as
  drawn by hand, more, and less. Clothes with folds and patterns.""",
    "off": "4% of the box's sides",
    "limits": """On photographs it is unsure of very bright clothes and of people under 40 px high, and its prams
are simple ones; `scene_ir.derender.people` uses no unsure outline, and nothing outside the label's box.""",
    "option": "--people --out scene_ir/derender/weights/people.safetensors",
}
COLUMNS = (
    *(("vehicles", "large", "{:.0f}"), ("iou", "IoU", "{:.3f}"), ("iou_p10", "IoU, 10%", "{:.3f}")),
    *(("others", "others", "{:.0f}"), ("others_iou", "IoU", "{:.3f}"), ("others_iou_p10", "IoU, 10%", "{:.3f}")),
    *(("front_iou", "in front, IoU", "{:.3f}"), ("border_px", "border", "{:.2f} px")),
)


def format_table(metrics: dict[float, dict[str, float]]) -> str:
    """A Markdown table, a row an amount."""
    lines = ["| amount | " + " | ".join(c[1] for c in COLUMNS) + " |", "| --- |" + " --- |" * len(COLUMNS)]
    for amount, row in metrics.items():
        lines.append(f"| {amount:g} | " + " | ".join(text.format(row[key]) for key, _, text in COLUMNS) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--assets", type=Path, help="pack of vehicles and skies; without it only the templates'")
    parser.add_argument(
        "--people", action="store_true", help="learn people and cyclists, from the vehicles' weights"
    )
    parser.add_argument("--run", type=Path, default=Path("build/cutout"), help="streets, checkpoint, log")
    parser.add_argument("--out", type=Path, default=cutout.WEIGHTS)
    parser.add_argument("--frames", type=int, default=240, help="streets to train on")
    parser.add_argument("--held-out", type=int, default=24, help="streets to judge by")
    parser.add_argument("--data-seed", type=int, default=41, help="of the streets; one more for those to judge by")
    parser.add_argument(
        "--steps", type=int, nargs="+", default=[steps for steps, _ in CutoutSettings.cycles], help="of each cycle"
    )
    parser.add_argument("--batch", type=int, default=CutoutSettings.batch)
    parser.add_argument("--seed", type=int, default=CutoutSettings.seed)
    parser.add_argument("--remark", default="", help="a remark on this run for the model card")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rates = [rate for _, rate in CutoutSettings.cycles]
    cycles = tuple((steps, rates[min(i, len(rates) - 1)]) for i, steps in enumerate(arguments.steps))
    settings = CutoutSettings(cycles, arguments.batch, seed=arguments.seed)
    seeds, people = (arguments.data_seed, arguments.data_seed + 1), arguments.people
    store, held = (
        CutoutStore(make(arguments.run / split, split, seed, frames, arguments.assets, people), people)
        for split, seed, frames in zip(
            ("train", "heldout"), seeds, (arguments.frames, arguments.held_out), strict=True
        )
    )
    run = CutoutRun(settings)
    if people:
        run.network.load_state_dict(cutout.load_network().state_dict())
    checkpoint = arguments.run / "checkpoint.safetensors"
    if checkpoint.is_file():
        run.load(checkpoint)
        print(f"going on from step {run.step_number}", flush=True)
    with (arguments.run / "log.csv").open("a", newline="") as file:
        log = csv.writer(file)
        while run.step_number < settings.steps:
            terms = run.step(store)
            if run.step_number % 25 == 0:
                log.writerow([run.step_number, f"{run.seconds:.1f}", *(f"{v:.4f}" for v in terms.values())])
                file.flush()
            if run.step_number % 100 == 0 or run.step_number == settings.steps:
                run.save(checkpoint)
                print(f"step {run.step_number}, {run.seconds:.0f} s: {terms}", flush=True)
    network = run.averaged()
    metrics = {amount: judge(held, network, amount) for amount in AMOUNTS}
    print(format_table(metrics))
    facts = {"steps": str(settings.steps), "seed": str(settings.seed), "metrics": json.dumps(metrics)}
    run.ship(arguments.out, facts)
    card = CARD.format(
        parameters=sum(p.numel() for p in network.parameters()),
        second=sum(p.numel() for p in network.second.parameters()),
        file=arguments.out.name,
        frames=arguments.frames,
        version=GENERATOR_VERSION,
        data_seed=seeds[0],
        held_seed=seeds[1],
        vehicles=len(store),
        least=LEAST_PX,
        steps=settings.steps,
        count=len(settings.cycles),
        cycles=" ".join(str(steps) for steps in arguments.steps),
        batch=settings.batch,
        minutes=run.seconds / 60,
        seed=settings.seed,
        note=f"\n  {arguments.remark}" if arguments.remark else "",
        held=len(held),
        table=format_table(metrics),
        sha256=files.sha256_digest(arguments.out),
        **(PEOPLE_CARD if people else VEHICLE_CARD),
    )
    files.write_text(arguments.out.with_suffix(".md"), card)


if __name__ == "__main__":
    main()
