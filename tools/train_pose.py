"""Train the network that places vehicles from 2D boxes (`scene_ir.derender.pose`) on generated streets.

    drivesem synth --layout kitti --split train --seed 31 --frames 2000 --out build/pose_train
    drivesem synth --layout kitti --split heldout --seed 32 --frames 150 --out build/pose_held
    python tools/train_pose.py --data build/pose_train --held-out build/pose_held

A run goes on from its last checkpoint, to the same bytes as one that was never stopped (one thread, one machine).
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from averaged import AveragedRun
from torch import Tensor

from detectors.boxes import iou_matrix
from detectors.registry import load_detector
from detectors.types import CLASSES
from drivesem.data.kitti import KittiDataset
from drivesem.reporting.tables import format_count
from drivesem.scenes.label_free import POSE_ROUNDS
from scene_ir import files
from scene_ir.derender import pose
from scene_ir.derender.derender import VEHICLE_CATEGORIES
from scene_ir.derender.pose import KINDS, PoseNet, PosePrediction
from scene_ir.types import Camera, Category, Frame, Labels

STORE_HW = (128, 192)
STORE_CONTEXT = 2.5
"""Crops are stored larger than the network's input, so that boxes can be jittered."""
LEAST_HEIGHT_PX, MOST_OCCLUSION = 16.0, 2
JITTER, JITTER_SHARE, JITTER_MOST = (0.02, 0.06, 0.12), (0.35, 0.3, 0.35), 0.28
"""Standard deviations of a box's sides, in its sides, how often each is used, and the most. The shipped detector's
sides are wrong by 0.12 on generated frames, by 0.09 on KITTI's, there 0.08 too far inwards; labels' are right."""
CLASS_OF = {Category.CAR: "Car", Category.TRUCK: "Truck"}


def vehicle_class(kind: str) -> str:
    """What a detector calls a vehicle of a data set's type."""
    return CLASS_OF[VEHICLE_CATEGORIES[kind]]


def usable(labels: Labels) -> list[int]:
    """Rows of vehicles that are large and visible enough, with a 3D box."""
    height = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
    good = (height >= LEAST_HEIGHT_PX) & (labels.occlusion <= MOST_OCCLUSION) & torch.isfinite(labels.yaw)
    good &= labels.truncation < 0.7
    return [i for i in range(len(labels.kind)) if labels.kind[i] in VEHICLE_CATEGORIES and bool(good[i])]


@dataclass(frozen=True)
class TruePoses:
    """What is known of K boxes. box (K, 4) px; centre (K, 2) px and depth (K,) m of the 3D centre; alpha (K,) rad;
    size (K, 3) m; kind (K,) index into KINDS, -1 where not known; truck (K,) bool.
    """

    box: Tensor
    centre: Tensor
    depth: Tensor
    alpha: Tensor
    size: Tensor
    kind: Tensor
    truck: Tensor
    camera: Tensor
    """Focal lengths, principal point, width, height, (K, 6)."""

    def rows(self, index: Tensor) -> TruePoses:
        """Those of an index."""
        return TruePoses(*(getattr(self, f.name)[index] for f in fields(self)))


def true_poses(labels: Labels, rows: Sequence[int], camera: Camera, kinds: Sequence[int]) -> TruePoses:
    """What is known of the labels `rows`."""
    index = torch.tensor(rows, dtype=torch.int64)
    size, foot = labels.size_lhw[index], labels.translation[index]
    middle = foot - size[:, 1:2] * torch.tensor([0.0, 0.5, 0.0])
    clip = middle @ camera.matrix[:, :3].T + camera.matrix[:, 3]
    return TruePoses(
        labels.boxes_xyxy[index],
        clip[:, :2] / clip[:, 2:],
        middle[:, 2],
        labels.yaw[index] - torch.atan2(foot[:, 0], foot[:, 2]),
        size,
        torch.tensor(kinds, dtype=torch.int64),
        pose.is_truck([labels.kind[i] for i in rows]),
        pose.camera_features(camera).expand(len(rows), 6),
    )


class CropStore:
    """Crops and truths of a generated folder, cached in `cache`."""

    def __init__(self, root: Path, cache: Path) -> None:
        manifest = files.read_json(root / "manifest.json")
        dataset = KittiDataset(root)
        crops_path, truth_path = cache / "crops.npy", cache / "truth.npz"
        stamp = cache / "frames.json"
        facts = {"seed": manifest["seed"], "frames": len(manifest["frames"]), "context": STORE_CONTEXT}
        self.frames = len(manifest["frames"])
        if not (stamp.is_file() and json.loads(stamp.read_text()) == facts):
            cache.mkdir(parents=True, exist_ok=True)
            crops, truths = [], []
            for entry in manifest["frames"]:
                frame = dataset.frame(f"{entry['number']:06d}")
                assert frame.labels is not None
                rows = usable(frame.labels)
                if not rows:
                    continue
                models = [o["model"] for o in entry["objects"] if o["labelled"]]
                kinds = [KINDS.index(models[i].rsplit("-", 1)[0]) for i in rows]
                truths.append(true_poses(frame.labels, rows, frame.camera, kinds))
                image = (frame.photograph.numpy().transpose(1, 2, 0) * 255).round().astype(np.uint8)
                crops.append(pose.crop_boxes(image, truths[-1].box.numpy(), STORE_HW, STORE_CONTEXT))
            np.save(crops_path, np.concatenate(crops))
            joined = {f.name: np.concatenate([getattr(t, f.name) for t in truths]) for f in fields(TruePoses)}
            files.write_npz(truth_path, joined)
            files.write_json(stamp, facts)
        self.crops = np.load(crops_path, mmap_mode="r")
        arrays = files.read_npz(truth_path)
        self.truth = TruePoses(*(torch.from_numpy(arrays[f.name]) for f in fields(TruePoses)))

    def __len__(self) -> int:
        return len(self.crops)


@dataclass(frozen=True)
class PoseTargets:
    """Targets of the network for N boxes, see `PosePrediction`; kind (N,) int64."""

    alpha: Tensor
    offset: Tensor
    size: Tensor
    depth: Tensor
    kind: Tensor


def build_batch(store: CropStore, step: int, settings: PoseSettings) -> tuple[Tensor, Tensor, PoseTargets]:
    """Crops (N, 3, 64, 96), numbers (N, 9) and targets of a step: a function of the seed and the step alone."""
    rng = np.random.default_rng([settings.seed, step])
    per_epoch = max(len(store) // settings.batch, 1)
    epoch, place = divmod(step, per_epoch)
    order = np.random.default_rng([settings.seed, 1_000_000 + epoch]).permutation(len(store))
    chosen = np.sort(order[place * settings.batch : (place + 1) * settings.batch])
    n = len(chosen)
    truth = store.truth.rows(torch.from_numpy(chosen))
    crops = torch.from_numpy(store.crops[chosen]).permute(0, 3, 1, 2).float() / 255
    sides = (truth.box[:, 2:] - truth.box[:, :2]).repeat(1, 2)
    limit = truth.camera[:, 4:6] - 1
    cut = torch.cat([truth.box[:, :2] <= pose.BORDER_PX, truth.box[:, 2:] >= limit - pose.BORDER_PX], 1)
    amount = rng.choice(JITTER, (n, 1), p=JITTER_SHARE)
    noise = torch.from_numpy(np.clip(rng.normal(0, 1, (n, 4)) * amount, -JITTER_MOST, JITTER_MOST)).float()
    box = truth.box + noise * sides * ~cut
    size, middle = box[:, 2:] - box[:, :2], (box[:, :2] + box[:, 2:]) / 2
    shift = (middle - (truth.box[:, :2] + truth.box[:, 2:]) / 2) * 2 / sides[:, :2] / STORE_CONTEXT
    stretch = size / sides[:, :2] * pose.CONTEXT / STORE_CONTEXT
    theta = torch.zeros(n, 2, 3)
    theta[:, 0, 0], theta[:, 1, 1], theta[:, :, 2] = stretch[:, 0], stretch[:, 1], shift
    grid = F.affine_grid(theta, [n, 3, *pose.CROP_HW], align_corners=False)
    crops = F.grid_sample(crops, grid, padding_mode="border", align_corners=False)
    kinds = ["Truck" if t else "Car" for t in truth.truck]
    numbers = pose.box_features(box, truth.truck, truth.camera)
    offset = (truth.centre - middle) / size
    mean = truth.camera[:, 1] * pose.mean_sizes(kinds)[:, 1] / size[:, 1]
    alpha = truth.alpha
    flip = torch.from_numpy(rng.random(n) < 0.5)
    crops = torch.where(flip[:, None, None, None], crops.flip(3), crops)
    numbers = torch.where(flip[:, None], pose.mirror_features(numbers), numbers)
    alpha = torch.where(flip, math.pi - alpha, alpha)
    offset = torch.where(flip[:, None], offset * torch.tensor([-1.0, 1.0]), offset)
    targets = PoseTargets(
        alpha, offset, torch.log(truth.size / pose.mean_sizes(kinds)), torch.log(truth.depth / mean), truth.kind
    )
    return vary_appearance(crops, rng), numbers, targets


def vary_appearance(crops: Tensor, rng: np.random.Generator) -> Tensor:
    """The crops in other light, other colours, less sharp, noisier, partly hidden."""
    n = len(crops)

    def draw(low: float, high: float) -> Tensor:
        return torch.from_numpy(rng.uniform(low, high, (n, 1, 1, 1))).float()

    crops = crops.clamp(1e-4, 1) ** torch.exp(draw(-0.5, 0.5))
    grey = crops.mean(1, keepdim=True)
    crops = grey + (crops - grey) * torch.where(draw(0, 1) < 0.1, torch.zeros(1), draw(0.5, 1.6))
    tint = torch.from_numpy(rng.normal(1, 0.06, (n, 3, 1, 1))).float()
    level = crops.mean((1, 2, 3), keepdim=True)
    crops = (level + (crops - level) * draw(0.6, 1.4)) * tint * draw(0.7, 1.3)
    # some as small as far cars are, some blurred
    less = int(rng.integers(0, n // 2 + 1))
    if less:
        factor = float(rng.uniform(0.25, 0.8))
        small = F.interpolate(crops[:less], scale_factor=factor, mode="area")
        crops = torch.cat([F.interpolate(small, crops.shape[2:], mode="bilinear"), crops[less:]])
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    crops = crops + torch.randn(crops.shape, generator=generator) * draw(0, 0.04)
    height, width = crops.shape[2:]
    for i in np.nonzero(rng.random(n) < 0.25)[0]:
        h, w = int(rng.uniform(0.1, 0.5) * height), int(rng.uniform(0.1, 0.4) * width)
        y, x = int(rng.integers(0, height - h)), int(rng.integers(0, width - w))
        crops[i, :, y : y + h, x : x + w] = torch.from_numpy(rng.uniform(0, 1, (3, 1, 1))).float()
    return crops.clamp(0, 1)


def loss_terms(predicted: PosePrediction, wanted: PoseTargets) -> dict[str, Tensor]:
    """Terms of the loss, means over boxes, and their weighted sum "total"."""
    centre = torch.arange(pose.BINS) * (2 * math.pi / pose.BINS)
    apart = wanted.alpha[:, None] - centre
    near = (apart.cos() > math.cos(1.5 * math.pi / pose.BINS)).float()
    # the truth belongs to the two nearest bins by its distance to each
    share = (1 - (torch.atan2(apart.sin(), apart.cos()).abs() / (2 * math.pi / pose.BINS))).clamp(min=0)
    bins = -(share * predicted.bins.log_softmax(1)).sum(1)
    direction = F.normalize(predicted.turn, dim=-1, eps=1e-6)
    apart_vector = (direction - torch.stack([apart.cos(), apart.sin()], -1)).square().sum(-1)
    turn = (torch.sqrt(apart_vector + 1e-4) * near).sum(1) / near.sum(1)
    depth = (predicted.depth - wanted.depth).abs() * torch.exp(-predicted.log_sigma) + predicted.log_sigma
    terms = {
        "bins": bins.mean(),
        "turn": turn.mean(),
        "offset": F.smooth_l1_loss(predicted.offset, wanted.offset, beta=0.02),
        "size": F.smooth_l1_loss(predicted.size, wanted.size, beta=0.02),
        "depth": depth.mean(),
        "depth_error": (predicted.depth - wanted.depth).abs().mean(),
        "kind": F.cross_entropy(predicted.kind, wanted.kind),
    }
    weights = {"bins": 1.0, "turn": 4.0, "offset": 4.0, "size": 3.0, "depth": 0.3, "depth_error": 4.0, "kind": 0.3}
    return terms | {"total": sum((weights[k] * v for k, v in terms.items()), torch.zeros(()))}


@dataclass(frozen=True)
class PoseSettings:
    """What decides on the result of a run."""

    steps: int = 4000
    batch: int = 64
    rate: float = 2e-3
    weight_decay: float = 0.02
    average: float = 0.998
    seed: int = 0


class PoseRun(AveragedRun[PoseNet]):
    """The network in training."""

    settings: PoseSettings

    def __init__(self, settings: PoseSettings) -> None:
        torch.manual_seed(settings.seed)
        super().__init__(PoseNet().train(), settings)

    def step(self, store: CropStore) -> dict[str, float]:
        """One step of the optimiser; the terms of the loss."""
        step, settings = self.step_number, self.settings
        with self.timed():
            crops, numbers, targets = build_batch(store, step, settings)
            warm = min(1.0, (step + 1) / 100)
            terms = loss_terms(self.network(crops, numbers), targets)
            rate = settings.rate * warm * 0.5 * (1 + math.cos(math.pi * step / settings.steps))
            self.descend(terms["total"], rate)
        return {k: float(v.detach()) for k, v in terms.items()}


@dataclass(frozen=True)
class PoseErrors:
    """Of K vehicles: yaw (K,) rad, depth (K,) relative, size (K, 3) relative, right template (K,)."""

    yaw: np.ndarray
    depth: np.ndarray
    size: np.ndarray
    kind: np.ndarray
    moderate: np.ndarray
    """Whether KITTI's moderate level has it, (K,)."""
    place_m: np.ndarray

    def summary(self) -> dict[str, float]:
        """The figures of the model card over all these vehicles."""
        yaw = np.degrees(self.yaw)
        if not len(yaw):
            return {"vehicles": 0}
        flipped = yaw > 90
        metrics = {
            "vehicles": len(yaw),
            "yaw_deg": float(np.median(yaw)),
            "yaw_deg_p90": float(np.percentile(yaw, 90)),
            "flipped": float(flipped.mean()),
            "axis_deg": float(np.median(np.minimum(yaw, 180 - yaw))),
            "depth_pc": 100 * float(np.median(self.depth)),
            "depth_pc_p90": 100 * float(np.percentile(self.depth, 90)),
            "place_m": float(np.median(self.place_m)),
        }
        metrics |= {f"{n}_pc": 100 * float(np.median(s)) for n, s in zip("lhw", self.size.T, strict=True)}
        return metrics | {"kind": float(self.kind.mean())}

    def chosen(self, mask: np.ndarray) -> PoseErrors:
        """Those of a mask."""
        return PoseErrors(*(getattr(self, f.name)[mask] for f in fields(self)))


def judge(
    frames: Sequence[tuple[Frame, list[int]]], network: PoseNet, found: Sequence[PoseDetections] | None = None
) -> PoseErrors:
    """Errors of the estimate on frames with given vehicle templates (-1: unknown). Boxes are the
    labels', or what was `found`, of which those count that meet a label (IoU of at least 0.5).
    """
    rows: list[tuple[float, ...]] = []
    for number, (frame, kinds) in enumerate(frames):
        labels = frame.labels
        assert labels is not None
        index = usable(labels)
        classes = [vehicle_class(labels.kind[i]) for i in index]
        boxes, answers = labels.boxes_xyxy[index], list(range(len(index)))
        if found is not None:
            overlap = iou_matrix(boxes, found[number].boxes_xyxy)
            boxes, classes = found[number].boxes_xyxy, list(found[number].kinds)
            best = overlap.max(1) if overlap.numel() else None
            answers = [
                int(best.indices[i]) if best is not None and float(best.values[i]) >= 0.5 else -1
                for i in range(len(index))
            ]
        vary_appearance = 1 if found is None else POSE_ROUNDS
        poses = pose.estimate_poses(
            frame.photograph, boxes, classes, frame.camera, network=network, rounds=vary_appearance
        )
        for row, answer in zip(index, answers, strict=True):
            if answer < 0:
                continue
            turn = float(poses.yaw[answer] - labels.yaw[row])
            z = float(labels.translation[row, 2])
            size = torch.log(poses.size_lhw[answer] / labels.size_lhw[row]).abs().tolist()
            height = float(labels.boxes_xyxy[row, 3] - labels.boxes_xyxy[row, 1])
            moderate = height >= 25 and int(labels.occlusion[row]) <= 1 and float(labels.truncation[row]) <= 0.3
            rows.append(
                (
                    abs(math.remainder(turn, 2 * math.pi)),
                    abs(float(poses.translation[answer, 2]) / z - 1),
                    *size,
                    float(KINDS.index(poses.kind[answer]) == kinds[row]),
                    float(moderate),
                    float((poses.translation[answer] - labels.translation[row]).norm()),
                )
            )
    table = np.array(rows, np.float64).reshape(-1, 8)
    return PoseErrors(table[:, 0], table[:, 1], table[:, 2:5], table[:, 5], table[:, 6] > 0, table[:, 7])


@dataclass(frozen=True)
class PoseDetections:
    """A detector's vehicles in one frame: boxes_xyxy (N, 4) px, kinds."""

    boxes_xyxy: Tensor
    kinds: tuple[str, ...]


def detected(frames: Sequence[tuple[Frame, list[int]]]) -> list[PoseDetections]:
    """What the shipped detector finds, from its score of best F1 on."""
    detector = load_detector("squeezedet")
    out = []
    for frame, _ in frames:
        with torch.no_grad():
            seen = detector.decode(detector(frame.photograph[None]))[0]
        rows = [
            i
            for i in range(len(seen))
            if float(seen.scores[i]) >= detector.t_star and CLASSES[int(seen.labels[i])] in ("Car", "Truck")
        ]
        out.append(PoseDetections(seen.boxes_xyxy[rows], tuple(CLASSES[int(seen.labels[i])] for i in rows)))
    return out


def labelled_frames(root: Path, limit: int | None = None) -> list[tuple[Frame, list[int]]]:
    """Labelled frames of a KITTI folder, and each label's template, -1 where no manifest has it."""
    dataset = KittiDataset(root)
    manifest = root / "manifest.json"
    models = {}
    if manifest.is_file():
        for entry in files.read_json(manifest)["frames"]:
            models[f"{entry['number']:06d}"] = [o["model"] for o in entry["objects"] if o["labelled"]]
    out = []
    for identifier in dataset.identifiers[:limit]:
        frame = replace(dataset.frame(identifier), masks=None, depth=None, classes=None)
        assert frame.labels is not None
        names = [m.rsplit("-", 1)[0] for m in models.get(identifier, [""] * len(frame.labels.kind))]
        out.append((frame, [KINDS.index(n) if n in KINDS else -1 for n in names]))
    return out


CARD = """# Poses of vehicles from 2D boxes, trained on generated streets

- Architecture: `scene_ir.derender.pose.PoseNet`, {parameters:,} parameters: seven 3x3 convolutions on a 64x96 crop
  around the box, the box's coordinates, the head of 3D-SDN (viewing angle in twelve bins with cosine and
  sine, offset of the centre, log sizes, log depth with its uncertainty, template; no deformation code).
- Weights: `{file}`, float16, safetensors. Licence: Apache-2.0, as the whole project. Nothing pretrained.
- Data: {frames:,} frames of the project's own generator (`{data}`), {boxes:,} vehicles at least 16 px high; no
  photographs. Boxes jittered by 2 to 12% of their sides, as a detector's are; mirrored, other light and colours,
  blur, noise, parts hidden.
- Training: {steps:,} steps of {batch}, {minutes:.0f} minutes on one CPU core, seed {seed}.{note}

## Figures

Held out: {held_out} frames of the generator (shapes and streets that no training frame has). "moderate": at least
25 px high, occlusion at most 1, truncation at most 0.3; "all": at least 16 px, occlusion at most 2, truncation
below 0.7. KITTI: {real} labelled frames, labels hidden from the estimate but for the boxes where so stated. The
detector is `squeezedet` at its t*; a vehicle counts where its box meets the label's (IoU of at least 0.5). Yaw
errors are medians over all, turned ones (front taken for back) included; the axis is yaw but for half turns.

{table}

## Limits

It has seen generated pictures only, taken 1.65 m above the road (3 cm up or down): from other heights its depths
are biased, and so are those of vehicles much larger or smaller than others of their class. Not for use in a
vehicle.

## Train it again

```
drivesem synth --layout kitti --split train --seed {train_seed} --frames {frames} --out {data}
drivesem synth --layout kitti --split heldout --seed {held_seed} --frames {held_out} --out {held_name}
python tools/train_pose.py --data {data} --held-out {held_name} --steps {steps} --seed {seed}
```
The generator was version {version}. With the same, on the same machine, another run gives the same bytes.
"""
COLUMNS = (
    *(("vehicles", "vehicles", "{:.0f}"), ("yaw_deg", "yaw", "{:.2f}°"), ("yaw_deg_p90", "yaw, 90%", "{:.1f}°")),
    *(("flipped", "turned", "{:.1%}"), ("axis_deg", "axis", "{:.2f}°"), ("depth_pc", "depth", "{:.1f}%")),
    *(("depth_pc_p90", "depth, 90%", "{:.1f}%"), ("place_m", "place", "{:.2f} m"), ("l_pc", "length", "{:.1f}%")),
    *(("h_pc", "height", "{:.1f}%"), ("w_pc", "width", "{:.1f}%"), ("kind", "template", "{:.0%}")),
)


def format_table(metrics: dict[str, dict[str, float]]) -> str:
    """A Markdown table, a row a set of vehicles."""
    lines = ["| boxes | " + " | ".join(c[1] for c in COLUMNS) + " |", "| --- |" + " --- |" * len(COLUMNS)]
    for name, row in metrics.items():
        cells = [
            text.format(row[key]) if key in row and not math.isnan(row[key]) else "" for key, _, text in COLUMNS
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def all_metrics(network: PoseNet, held: Path, real: Path | None) -> dict[str, dict[str, float]]:
    """Figures of the model card by the name of their row."""
    metrics = {}
    for name, root in (("generated", held), ("KITTI", real)):
        if root is None:
            continue
        frames = labelled_frames(root)
        found = detected(frames)
        for boxes, errors in (("labels", judge(frames, network)), ("detector", judge(frames, network, found))):
            for level, part in (("moderate", errors.chosen(errors.moderate)), ("all", errors)):
                row = part.summary()
                if name == "KITTI":
                    row.pop("kind", None)
                metrics[f"{name}, {boxes}, {level}"] = row
    return metrics


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="generated frames to train on, KITTI layout")
    parser.add_argument("--held-out", type=Path, required=True, help="generated frames to judge by, KITTI layout")
    parser.add_argument("--also", type=Path, help="labelled photographs to evaluate for the model card")
    parser.add_argument("--run", type=Path, default=Path("build/pose"), help="checkpoint, log, crops")
    parser.add_argument("--out", type=Path, default=pose.WEIGHTS)
    parser.add_argument("--steps", type=int, default=PoseSettings.steps)
    parser.add_argument("--batch", type=int, default=PoseSettings.batch)
    parser.add_argument("--rate", type=float, default=PoseSettings.rate)
    parser.add_argument("--seed", type=int, default=PoseSettings.seed)
    parser.add_argument(
        "--pause-after", type=int, help="stop after so many steps of this call; call again to go on"
    )
    parser.add_argument("--remark", default="", help="a remark on this run for the model card")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = PoseSettings(arguments.steps, arguments.batch, arguments.rate, seed=arguments.seed)
    store = CropStore(arguments.data, arguments.run / "train")
    print(f"{format_count(len(store), 'vehicle')} in {format_count(store.frames, 'frame')}", flush=True)
    run = PoseRun(settings)
    checkpoint = arguments.run / "checkpoint.safetensors"
    if checkpoint.is_file():
        run.load(checkpoint)
        print(f"going on from step {run.step_number}", flush=True)
    end = min(settings.steps, run.step_number + (arguments.pause_after or settings.steps))
    held = labelled_frames(arguments.held_out)
    log_path = arguments.run / "log.csv"
    with log_path.open("a", newline="") as file:
        log = csv.writer(file)
        while run.step_number < end:
            terms = run.step(store)
            if run.step_number % 50 == 0:
                log.writerow([run.step_number, f"{run.seconds:.1f}", *(f"{v:.4f}" for v in terms.values())])
                file.flush()
            if run.step_number % 250 == 0 or run.step_number == end:
                run.save(checkpoint)
            if run.step_number % 500 == 0:
                errors = judge(held[:40], run.averaged())
                metrics = {k: round(v, 3) for k, v in errors.chosen(errors.moderate).summary().items()}
                print(f"step {run.step_number}, {run.seconds:.0f} s: {metrics}", flush=True)
    if run.step_number < settings.steps:
        return
    network = run.averaged()
    metrics = all_metrics(network, arguments.held_out, arguments.also)
    print(format_table(metrics))
    facts = {"steps": str(settings.steps), "seed": str(settings.seed), "metrics": json.dumps(metrics)}
    run.ship(arguments.out, facts)
    card = CARD.format(
        parameters=sum(p.numel() for p in network.parameters()),
        file=arguments.out.name,
        frames=store.frames,
        data=f"build/{arguments.data.name}",
        boxes=len(store),
        steps=settings.steps,
        batch=settings.batch,
        minutes=run.seconds / 60,
        seed=settings.seed,
        held_out=len(held),
        held_name=f"build/{arguments.held_out.name}",
        train_seed=files.read_json(arguments.data / "manifest.json")["seed"],
        held_seed=files.read_json(arguments.held_out / "manifest.json")["seed"],
        real=len(KittiDataset(arguments.also)) if arguments.also else 0,
        table=format_table(metrics),
        version=files.read_json(arguments.data / "manifest.json")["generator"],
        note=f"\n  {arguments.remark}" if arguments.remark else "",
    )
    files.write_text(arguments.out.with_suffix(".md"), card)


if __name__ == "__main__":
    main()
