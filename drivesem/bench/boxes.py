"""Times a whole attack step against the detector's whole pass, with vehicles placed as in KITTI's labels.

The user provides labels, but no photographs. Vehicles of the labelled 3D boxes are placed in a frame of noise,
rendered by the compositor and de-rendered exactly. So the steps, with their regions, are those of a KITTI frame;
the detections are not.
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
from drivesem.attack.space import combo_parameters
from drivesem.bench.scenes import HEIGHT, WIDTH
from drivesem.bench.session import Columns
from drivesem.bench.step import AttackSteps, time_pair
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


@dataclass(frozen=True, slots=True)
class BoxesRow:
    """Summary over frames; ratios are of a whole step to the detector's whole pass, times are medians in ms."""

    frames: int
    """Number of frames."""
    median_ratio: float
    """Median."""
    p90_ratio: float
    """90th percentile."""
    worst_ratio: float
    """Maximum."""
    median_cpu_ratio: float
    """Median for processor time."""
    p90_cpu_ratio: float
    """90th percentile for processor time."""
    worst_cpu_ratio: float
    """Maximum for processor time."""
    median_first_ratio: float
    """Median for each frame's first step."""
    median_vehicles: float
    """Vehicles per frame."""
    median_changed: float
    """Share of pixels covered by vehicles and shadows."""
    step_ms: float
    """Whole step."""
    detector_ms: float
    """Detector forward and backward."""
    step_cpu_ms: float
    """Processor time of the step."""
    detector_cpu_ms: float
    """Processor time of the detector."""

    @classmethod
    def from_frames(cls, frames: Sequence[FrameCost]) -> BoxesRow:
        """The summary of at least one frame."""

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
    """Measurements in one frame; times are medians in ms."""

    frame: str
    """Its name."""
    vehicles: int
    """Number of vehicles."""
    changed: float
    """Share of pixels covered by vehicles and shadows."""
    ratio: float
    """Step over detector."""
    cpu_ratio: float
    """The same for processor time."""
    first_ratio: float
    """First step over detector."""
    step_ms: float
    """Whole step."""
    detector_ms: float
    """Detector forward and backward."""
    step_cpu_ms: float
    """Processor time of the step."""
    detector_cpu_ms: float
    """Processor time of the detector."""


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
) -> Iterator[FrameCost]:
    """Measure one row per frame.

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
        detector_ms = Spread.from_values([alone.ms for _, alone in pairs]).median
        yield FrameCost(
            frame=frame.name,
            vehicles=len(frame.rows),
            changed=round(step.drawn_share(), 4),
            ratio=round(Spread.from_values([step.ms / alone.ms for step, alone in pairs]).median, 4),
            cpu_ratio=round(Spread.from_values([step.cpu_ms / alone.cpu_ms for step, alone in pairs]).median, 4),
            first_ratio=round(first / detector_ms, 4),
            step_ms=round(Spread.from_values([step.ms for step, _ in pairs]).median, 3),
            detector_ms=round(detector_ms, 3),
            step_cpu_ms=round(Spread.from_values([step.cpu_ms for step, _ in pairs]).median, 3),
            detector_cpu_ms=round(Spread.from_values([alone.cpu_ms for _, alone in pairs]).median, 3),
        )


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
