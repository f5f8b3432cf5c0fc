"""A whole attack step beside the detector's whole pass, with vehicles where KITTI's labels have them.

The labels are the user's; there are no pictures. Vehicles of the labels' 3D boxes stand in a frame of noise, are
photographed by the compositor itself, and taken apart exactly. So the step, its regions among them, is that of a
frame of KITTI; what the detector finds is not.
"""

from __future__ import annotations

import tarfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import torch.nn.functional as F
from torch import Tensor

from detectors.base import Detector
from drivesem.attack.space import combo
from drivesem.bench.scenes import HEIGHT, WIDTH
from drivesem.bench.step import Stepping, pair
from drivesem.bench.tables import Columns
from drivesem.bench.timing import Clock, Spread
from drivesem.config.blocks import KEEP_MB
from drivesem.data.kitti import read_calib, read_labels
from scene_ir.derender.derender import VEHICLES, DerenderSettings
from scene_ir.errors import FormatError
from scene_ir.geometry import clip_boxes, project_boxes
from scene_ir.meshes.templates import template
from scene_ir.render.sources import from_own_picture
from scene_ir.types import (
    FOLIAGE_DIM,
    LATTICE_POINTS,
    TEXTURE_DIM,
    WEATHER_DIM,
    Camera,
    Environment,
    Labels,
    Objects,
    SceneIR,
)

TITLE = "One attack step with vehicles where KITTI has them"
COLUMNS: Columns = {
    "frames": ("frames", "frames"), "median_ratio": ("ratio, median", "median"),
    "p90_ratio": ("ratio, 90th percentile", "p90"), "worst_ratio": ("ratio, worst", "worst"),
    "median_cpu_ratio": ("of processor time, median", "cpu median"),
    "p90_cpu_ratio": ("90th percentile", "cpu p90"), "worst_cpu_ratio": ("worst", "cpu worst"),
    "median_first_ratio": ("first step, median", "first"), "median_vehicles": ("vehicles", "vehicles"),
    "median_changed": ("share of pixels drawn", "drawn"), "step_ms": ("step, ms", "step ms"),
    "detector_ms": ("detector, ms", "detector"), "step_cpu_ms": ("step, processor ms", None),
    "detector_cpu_ms": ("detector, processor ms", None),
}  # fmt: skip
METHOD = (
    "Frames with vehicles, evenly spread over the labels' names; cars, vans and trucks of at least 12 px, by "
    "their labelled 3D boxes and calibration, in a frame of 1242x375 px of noise. A step is "
    "Objective.loss_and_grad (scene at theta, render, labels, detector forward, loss, backward to theta) and "
    "FeasibleSet.project, steps following each other as an attack's do; translate, rotate, mesh. The detector is "
    "its whole forward and backward to the picture, with the same loss. Both are measured in turn, the order "
    "swapped every time; a frame's ratio is the median of its pairs, without the first step. First step: of each "
    "frame, with what it keeps of the benign picture and plans; not what is made once for all frames. Share of "
    "pixels drawn: the union of what vehicles and shadows are drawn into. Times are medians over frames. Of "
    "processor time: the same pairs by the processor's time, all threads together, which other work on the "
    "machine lengthens less than the clock's."
)
_PAIRS = 7
_KINDS = {"Car": "sedan", "Van": "van", "Truck": "truck"}
_EYE_M = 1.65
"""Height of KITTI's camera above the road."""
_HORIZON = 0.46
"""Share of the frame's height at which the ground ends."""


@dataclass(frozen=True, slots=True)
class BoxesRow:
    """Over frames: ratios of a whole step to the detector's whole pass; `FrameCost` has them one by one."""

    frames: int
    median_ratio: float
    p90_ratio: float
    worst_ratio: float
    median_cpu_ratio: float
    p90_cpu_ratio: float
    worst_cpu_ratio: float
    median_first_ratio: float
    median_vehicles: float
    median_changed: float
    step_ms: float
    detector_ms: float
    step_cpu_ms: float
    detector_cpu_ms: float

    @classmethod
    def of(cls, frames: Sequence[FrameCost]) -> BoxesRow:
        """Of at least one frame."""

        def at(name: str, share: float = 0.5) -> float:
            values = torch.tensor([float(getattr(frame, name)) for frame in frames], dtype=torch.float64)
            return round(float(values.quantile(share)), 4)

        return cls(
            len(frames), at("ratio"), at("ratio", 0.9), at("ratio", 1.0), at("cpu_ratio"), at("cpu_ratio", 0.9),
            at("cpu_ratio", 1.0), at("first_ratio"), at("vehicles"), at("changed"), at("step_ms"),
            at("detector_ms"), at("step_cpu_ms"), at("detector_cpu_ms"),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class FrameCost:
    """What was measured in one frame. changed: share of the pixels that vehicles and shadows are drawn into."""

    frame: str
    vehicles: int
    changed: float
    ratio: float
    cpu_ratio: float
    first_ratio: float
    step_ms: float
    detector_ms: float
    step_cpu_ms: float
    detector_cpu_ms: float


@dataclass(frozen=True, slots=True)
class Labelled:
    """One frame's labels and camera."""

    name: str
    labels: Labels
    camera: Camera
    rows: tuple[int, ...]


def frames_of(path: Path, count: int) -> list[Labelled]:
    """`count` frames with vehicles of a tar archive of KITTI's label_2 and calib, evenly spread over their names.

    Raises FormatError naming the file.
    """
    try:
        with tarfile.open(path) as archive:
            texts = {
                (Path(member.name).parent.name, Path(member.name).stem): extracted.read()
                for member in archive
                if member.name.endswith(".txt") and (extracted := archive.extractfile(member)) is not None
            }
    except (OSError, tarfile.TarError, EOFError) as error:
        raise FormatError(str(path), "a tar archive of KITTI's label_2 and calib", error) from error
    names = sorted(name for folder, name in texts if folder == "label_2" and ("calib", name) in texts)
    with TemporaryDirectory() as folder:

        def labelled(name: str) -> Labelled:
            labels, calib = Path(folder) / f"{name}.txt", Path(folder) / f"{name}.calib.txt"
            labels.write_bytes(texts["label_2", name])
            calib.write_bytes(texts["calib", name])
            projection = read_calib(calib).projection
            camera = Camera(projection[:, :3].clone(), HEIGHT, WIDTH, projection)
            found = read_labels(labels)
            return Labelled(name, found, camera, _vehicles(found, camera))

        chosen: dict[str, Labelled] = {}
        for i in range(count if names else 0):
            # The next one with vehicles from an evenly spaced place on.
            for name in names[i * len(names) // count :]:
                if name not in chosen and (one := labelled(name)).rows:
                    chosen[name] = one
                    break
    if not chosen:
        raise FormatError(str(path), "label_2/NAME.txt and calib/NAME.txt of frames with vehicles", "none")
    return list(chosen.values())


def scene_of(frame: Labelled, seed: int) -> SceneIR:
    """The frame's vehicles before noise, photographed and taken apart."""
    return from_own_picture(_bare(frame, seed))


def measure(
    frames: Sequence[Labelled],
    detector: Detector,
    seed: int,
    device: str,
    whole: bool = False,
    keep_mb: float = KEEP_MB,
) -> Iterator[FrameCost]:
    """One row a frame. whole, keep_mb: as of `Objective`."""
    clock, params = Clock(device), combo(2)
    layout: torch.memory_format | None = None
    for number, frame in enumerate(frames):
        stepping = Stepping(scene_of(frame, seed), params, detector, seed, device, whole=whole, keep_mb=keep_mb)
        layout = layout or stepping.faster_layout(clock)
        detect = stepping.detector_alone(layout)
        if number == 0:  # what is made once for all frames is nobody's
            stepping()
            stepping.objective.forget()
        detect()
        first = clock.ms(stepping)
        pairs = [pair(clock, stepping, detect, swapped=bool(i % 2)) for i in range(_PAIRS)]
        detector_ms = Spread.of([alone.ms for _, alone in pairs]).median
        yield FrameCost(
            frame=frame.name,
            vehicles=len(frame.rows),
            changed=round(stepping.drawn_share(), 4),
            ratio=round(Spread.of([step.ms / alone.ms for step, alone in pairs]).median, 4),
            cpu_ratio=round(Spread.of([step.cpu_ms / alone.cpu_ms for step, alone in pairs]).median, 4),
            first_ratio=round(first / detector_ms, 4),
            step_ms=round(Spread.of([step.ms for step, _ in pairs]).median, 3),
            detector_ms=round(detector_ms, 3),
            step_cpu_ms=round(Spread.of([step.cpu_ms for step, _ in pairs]).median, 3),
            detector_cpu_ms=round(Spread.of([alone.cpu_ms for _, alone in pairs]).median, 3),
        )


def _vehicles(labels: Labels, camera: Camera) -> tuple[int, ...]:
    """Rows that are vehicles, wholly before the camera and as large as a de-rendered one must be."""
    rows = [i for i in range(len(labels.kind)) if labels.kind[i] in VEHICLES and bool(labels.size_lhw[i, 0] > 0)]
    boxes = project_boxes(labels.size_lhw[rows], labels.yaw[rows], labels.translation[rows], camera.matrix)
    seen = clip_boxes(boxes, camera.height, camera.width)
    least = DerenderSettings().min_height_px
    kept = (
        torch.isfinite(boxes).all(1) & (seen[:, 3] - seen[:, 1] >= least) & (seen[:, 2] - seen[:, 0] >= least / 2)
    )
    return tuple(row for row, keep in zip(rows, kept.tolist(), strict=True) if keep)


def _bare(frame: Labelled, seed: int) -> SceneIR:
    labels, rows, count = frame.labels, list(frame.rows), len(frame.rows)
    kinds = list(dict.fromkeys(labels.kind[row] for row in rows))
    objects = Objects(
        mesh_index=torch.tensor([kinds.index(labels.kind[row]) for row in rows]),
        translation=labels.translation[rows].float(),
        yaw=labels.yaw[rows].float(),
        size_lhw=labels.size_lhw[rows].float(),
        ffd=torch.zeros(count, LATTICE_POINTS, 3),
        texture_code=torch.zeros(count, TEXTURE_DIM),
        category=torch.tensor([int(VEHICLES[labels.kind[row]]) for row in rows]),
        box2d=labels.boxes_xyxy[rows].float(),
        truncation=labels.truncation[rows].float(),
        occlusion=labels.occlusion[rows],
    )
    picture = _noise(seed)
    below = torch.arange(HEIGHT, dtype=torch.float32)[:, None].expand(HEIGHT, WIDTH) - HEIGHT * _HORIZON
    focal = float(frame.camera.intrinsics[1, 1])
    environment = Environment(
        weather=torch.zeros(WEATHER_DIM),
        foliage=torch.zeros(FOLIAGE_DIM),
        sun=F.normalize(torch.tensor([0.4, -0.75, -0.4]), dim=0),
        ground=torch.tensor([0.0, -1.0, 0.0, _EYE_M]),
        sky=(below < -HEIGHT / 4).float(),
        foliage_map=torch.zeros(HEIGHT, WIDTH),
        road=(below > 0).float(),
    )
    return SceneIR(
        camera=frame.camera,
        meshes=tuple(template(_KINDS[kind]) for kind in kinds),
        objects=objects,
        environment=environment,
        photograph=picture,
        background=picture,
        depth=torch.where(below > 1, _EYE_M * focal / below.clamp_min(1), torch.inf),
        ignore=torch.zeros(0, 4),
    )


def _noise(seed: int) -> Tensor:
    """(3, H, W): blobs of several sizes, 8 bit."""
    generator = torch.Generator().manual_seed(seed)
    picture = torch.zeros(1, 3, HEIGHT, WIDTH)
    for cells in (4, 16, 64):
        coarse = torch.rand(1, 3, cells, 3 * cells, generator=generator)
        picture += F.interpolate(coarse, (HEIGHT, WIDTH), mode="bicubic") / 3
    return (picture[0].clamp(0.1, 0.9) * 255).round() / 255
