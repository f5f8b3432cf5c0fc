"""Times a whole attack step against the detector's whole pass, with vehicles placed as in KITTI's labels.

The user provides labels, but no photographs. Vehicles of the labelled 3D boxes are placed in a frame of noise,
rendered by the compositor and de-rendered exactly. So the steps, with their regions, are those of a KITTI frame;
the detections are not.
"""

from __future__ import annotations

import tarfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from detectors.base import Detector
from drivesem.attacks.space import combo_parameters
from drivesem.bench.scenes import HEIGHT, WIDTH
from drivesem.bench.session import Columns
from drivesem.bench.step import AttackSteps, pair_medians, time_pair
from drivesem.bench.timing import PairedTimer, Spread
from drivesem.config.options import DEFAULT_KEEP_MB
from drivesem.data.kitti import read_calibration, read_labels
from scene_ir.derender.derender import VEHICLE_CATEGORIES, DerenderSettings
from scene_ir.errors import FormatError
from scene_ir.geometry import clip_boxes, project_boxes
from scene_ir.meshes.templates import template
from scene_ir.render.sources import photograph_scene
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
"""Height of KITTI's camera above the road, m."""
_HORIZON = 0.46
"""Share of the frame's height at which the ground ends."""


_SUMMARY = {
    "median_ratio": ("ratio", 0.5), "p90_ratio": ("ratio", 0.9), "worst_ratio": ("ratio", 1.0),
    "median_cpu_ratio": ("cpu_ratio", 0.5), "p90_cpu_ratio": ("cpu_ratio", 0.9),
    "worst_cpu_ratio": ("cpu_ratio", 1.0), "median_first_ratio": ("first_ratio", 0.5),
    "median_vehicles": ("vehicles", 0.5), "median_changed": ("changed", 0.5),
    **{name: (name, 0.5) for name in ("step_ms", "detector_ms", "step_cpu_ms", "detector_cpu_ms")},
}  # fmt: skip
"""By field of the summary: the field of a frame, and the quantile over frames."""


def summarise(costs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Summary of the rows of `measure`, at least one."""

    def at(name: str, share: float) -> float:
        values = torch.tensor([float(cost[name]) for cost in costs], dtype=torch.float64)
        return round(float(values.quantile(share)), 4)

    return {"frames": len(costs)} | {name: at(*quantile) for name, quantile in _SUMMARY.items()}


@dataclass(frozen=True, slots=True)
class LabelledFrame:
    """Labels and camera of one frame."""

    name: str
    """Its name."""
    labels: Labels
    """All labels."""
    camera: Camera
    """The camera."""
    rows: tuple[int, ...]
    """Rows of the labels that are vehicles to place."""


def read_labelled_frames(path: Path, count: int) -> list[LabelledFrame]:
    """Read `count` frames with vehicles, evenly spread over their names, from a tar archive of KITTI's label_2 and
    calib.

    Raises:
        FormatError: The file is not such an archive; names it.
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

        def labelled(name: str) -> LabelledFrame:
            labels, calib = Path(folder) / f"{name}.txt", Path(folder) / f"{name}.calib.txt"
            labels.write_bytes(texts["label_2", name])
            calib.write_bytes(texts["calib", name])
            projection = read_calibration(calib).projection
            camera = Camera(projection[:, :3].clone(), HEIGHT, WIDTH, projection)
            frame_labels = read_labels(labels)
            return LabelledFrame(name, frame_labels, camera, _vehicle_rows(frame_labels, camera))

        chosen: dict[str, LabelledFrame] = {}
        for i in range(count if names else 0):
            # The next frame with vehicles, from an evenly spaced position on.
            for name in names[i * len(names) // count :]:
                if name not in chosen and (one := labelled(name)).rows:
                    chosen[name] = one
                    break
    if not chosen:
        raise FormatError(str(path), "label_2/NAME.txt and calib/NAME.txt of frames with vehicles", "none")
    return list(chosen.values())


def build_scene(frame: LabelledFrame, seed: int) -> SceneIR:
    """The frame's vehicles before noise, rendered and de-rendered."""
    return photograph_scene(_place_vehicles(frame, seed))


def measure(
    frames: Sequence[LabelledFrame],
    detector: Detector,
    seed: int,
    device: str,
    whole: bool = False,
    keep_mb: float = DEFAULT_KEEP_MB,
) -> Iterator[dict[str, Any]]:
    """Measure one row per frame; ratios are of a step to the detector, times are medians in ms.

    Args:
        frames: What to measure.
        detector: The detector.
        seed: Seed of noise and thetas.
        device: Device to measure.
        whole: As in `Objective`.
        keep_mb: As in `Objective`.
    """
    clock, params = PairedTimer(device), combo_parameters(2)
    layout: torch.memory_format | None = None
    for number, frame in enumerate(frames):
        step = AttackSteps(build_scene(frame, seed), params, detector, seed, device, whole=whole, keep_mb=keep_mb)
        layout = layout or step.faster_layout(clock)
        detect = step.detector_alone(layout)
        if number == 0:  # what is prepared once for all frames does not count
            step()
            step.objective.release_layers()
        detect()
        first = clock.milliseconds(step)
        pairs = [time_pair(clock, step, detect, swapped=bool(i % 2)) for i in range(_PAIRS)]
        detector_ms, medians = Spread.from_values([alone.ms for _, alone in pairs]).median, pair_medians(pairs)
        yield {
            "frame": frame.name,
            "vehicles": len(frame.rows),
            "changed": round(step.drawn_share(), 4),
            "ratio": round(Spread.from_values([step.ms / alone.ms for step, alone in pairs]).median, 4),
            "cpu_ratio": medians.pop("cpu_ratio"),
            "first_ratio": round(first / detector_ms, 4),
            **medians,
        }


def _vehicle_rows(labels: Labels, camera: Camera) -> tuple[int, ...]:
    """Rows of vehicles completely in front of the camera and large enough to de-render."""
    rows = [
        i
        for i in range(len(labels.kind))
        if labels.kind[i] in VEHICLE_CATEGORIES and bool(labels.size_lhw[i, 0] > 0)
    ]
    boxes = project_boxes(labels.size_lhw[rows], labels.yaw[rows], labels.translation[rows], camera.matrix)
    seen = clip_boxes(boxes, camera.height, camera.width)
    least = DerenderSettings().min_height_px
    is_large = (
        torch.isfinite(boxes).all(1) & (seen[:, 3] - seen[:, 1] >= least) & (seen[:, 2] - seen[:, 0] >= least / 2)
    )
    return tuple(row for row, keep in zip(rows, is_large.tolist(), strict=True) if keep)


def _place_vehicles(frame: LabelledFrame, seed: int) -> SceneIR:
    labels, rows, count = frame.labels, list(frame.rows), len(frame.rows)
    kinds = list(dict.fromkeys(labels.kind[row] for row in rows))
    objects = Objects(
        mesh_index=torch.tensor([kinds.index(labels.kind[row]) for row in rows]),
        translation=labels.translation[rows].float(),
        yaw=labels.yaw[rows].float(),
        size_lhw=labels.size_lhw[rows].float(),
        ffd=torch.zeros(count, LATTICE_POINTS, 3),
        texture_code=torch.zeros(count, TEXTURE_DIM),
        category=torch.tensor([int(VEHICLE_CATEGORIES[labels.kind[row]]) for row in rows]),
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
