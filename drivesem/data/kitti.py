"""KITTI's object folders: `training/{image_2,label_2,calib,velodyne}/000000.*`, read and written.

Two folders more, in the words of KITTI's other benchmarks, hold ground truth that the object benchmark has not:
`depth_2` (uint16 PNG, 256 times the depth in metres, 0: none; Uhrig et al. 2017) and `instance_2` (uint16 PNG, 256
times the semantic id plus the instance's number, Cityscapes' ids; Abu Alhaija et al. 2018). The instance's number
is here the object's line in `label_2`, from 1; objects without a line have higher numbers; 0 is no instance.

Labels follow the object development kit (Geiger et al. 2012): `type truncated occluded alpha left top right bottom
h w l x y z ry`, results have the score as a 16th field. Errors name the file, the line or key, and the field.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from drivesem.data.truth import SKY_CM, Exposure, Place
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.types import Camera, Frame, Labels

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
"""What KITTI labels."""
FIELDS = (
    *("type", "truncated", "occluded", "alpha", "left", "top", "right", "bottom"),
    *("height", "width", "length", "x", "y", "z", "rotation_y", "score"),
)
UNKNOWN_SIZE, UNKNOWN_POSITION, UNKNOWN_ANGLE = -1.0, -1000.0, -10.0
"""What the development kit writes where a value is not known."""
UNKNOWN_OCCLUSION = 3
"""KITTI's own code for an occlusion that is not known."""
BOX_MARGIN_PX = 2.0
"""How far a label's box may lie outside the image: KITTI's never do (checked on all 7,481), rounding may."""
CENTRE_RANGE = (0.25, 0.75)
"""Where the principal point may lie, as a fraction of the image: KITTI's lie at 0.46 to 0.50. Elsewhere, image and
calibration do not belong together."""
NEAR_M = 0.1
"""The near plane of projected boxes: what lies wholly before it has no image."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
DEPTH_SCALE = 256
"""Values a metre in `depth_2`."""
INSTANCES = 256
"""Values a semantic id in `instance_2`: the lower byte is the instance."""
PNG_COMPRESSION = 1
"""zlib's level for images: several times as fast as its best."""
SEMANTIC_NAMES = (
    *("Undefined", "EgoVehicle", "Border", "OutOfRoi", "Misc", "Dynamic", "Ground", "Road", "Sidewalk", "Parking"),
    *("RailTrack", "Building", "Wall", "Fence", "GuardRail", "Bridge", "Tunnel", "Pole", "PoleGroup"),
    *("TrafficLight", "TrafficSign", "Vegetation", "Terrain", "Sky", "Pedestrian", "Rider", "Car", "Truck", "Bus"),
    *("Caravan", "Trailer", "Train", "Motorcycle", "Bicycle"),
)
"""Cityscapes' classes in the order of their ids, which KITTI's semantic benchmark uses, in Virtual KITTI's words
where it has them (github.com/mcordts/cityscapesScripts, helpers/labels.py; "Undefined" is "unlabeled", "Misc"
"static", "Vegetation" includes trees, "Pedestrian" is "person")."""
_MERGED = {"tree": "vegetation", "van": "car", "cyclist": "rider", "tram": "train", "personsitting": "pedestrian"}
"""What Cityscapes has no id for, and what it is there."""


def finite_number(where: str, text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        raise FormatError(where, "a number", repr(text)) from None
    if not math.isfinite(value):
        raise FormatError(where, "a finite number", text)
    return value


@dataclass(frozen=True, slots=True)
class _Line:
    """One line of a label file, checked. `values` are the fields 1 to 15 (a score of 1 where there is none)."""

    where: str
    kind: str
    values: tuple[float, ...]

    @property
    def box_xyxy(self) -> tuple[float, ...]:
        return self.values[3:7]

    @property
    def pose(self) -> tuple[float, ...]:
        """Length, height, width, x, y, z, yaw; NaN where the file says that it does not know."""
        h, w, l, *rest = self.values[7:14]  # noqa: E741
        return (l, h, w, *rest) if l > 0 else (math.nan,) * 7


def _require(condition: bool, where: str, field: str, expected: str, actual: object) -> None:
    if not condition:
        raise FormatError(f"{where}: {field}", expected, actual)


def _parse_line(where: str, text: str, with_score: bool) -> _Line:
    """One label line. FormatError naming the line and the field."""
    parts = text.split()
    counts = (16,) if with_score else (15, 16)
    expected = "16 fields (with a score)" if with_score else "15 or 16 fields"
    if len(parts) not in counts:
        raise FormatError(where, expected, len(parts))
    kind = parts[0]
    _require(kind in TYPES, where, "type", f"one of {', '.join(TYPES)}", repr(kind))
    values = [finite_number(f"{where}: {FIELDS[i + 1]}", part) for i, part in enumerate(parts[1:])]
    truncated, occluded, _, left, top, right, bottom, h, w, l, x, y, z, yaw = values[:14]  # noqa: E741
    _require(left < right, where, "right", f"more than left ({left:g})", f"{right:g}")
    _require(top < bottom, where, "bottom", f"more than top ({top:g})", f"{bottom:g}")
    if kind != "DontCare":
        may_be_unknown = (-1.0,) if with_score else ()
        _require(
            0 <= truncated <= 1 or truncated in may_be_unknown, where, "truncated", "[0, 1]", f"{truncated:g}"
        )
        _require(occluded in (0, 1, 2, 3, *may_be_unknown), where, "occluded", "0, 1, 2 or 3", f"{occluded:g}")
        unknown = [v == UNKNOWN_SIZE for v in (h, w, l)] + [v == UNKNOWN_POSITION for v in (x, y, z)]
        if not all(unknown):
            for name, size in zip(("height", "width", "length"), (h, w, l), strict=True):
                _require(size > 0, where, name, "positive metres", f"{size:g}")
            _require(abs(yaw) <= 2 * math.pi + 0.01, where, "rotation_y", "rad in [-2 pi, 2 pi]", f"{yaw:g}")
            farthest = z + 0.5 * (l * abs(math.sin(yaw)) + w * abs(math.cos(yaw)))
            _require(
                farthest > NEAR_M, where, "z", "a 3D box in front of the camera", f"{z:g} m, wholly behind it"
            )
    return _Line(where, kind, tuple(values) if len(values) == 15 else (*values, 1.0))


def _to_labels(lines: Sequence[_Line]) -> Labels:
    objects = [line for line in lines if line.kind != "DontCare"]
    regions = [line for line in lines if line.kind == "DontCare"]

    def table(rows: list[tuple[float, ...]], width: int) -> Tensor:
        return torch.tensor(rows, dtype=torch.float32).reshape(-1, width)

    poses = table([line.pose for line in objects], 7)
    truncation = table([(line.values[0] if line.values[0] >= 0 else math.nan,) for line in objects], 1)
    occlusion = [int(line.values[1]) if line.values[1] >= 0 else UNKNOWN_OCCLUSION for line in objects]
    return Labels(
        kind=tuple(line.kind for line in objects),
        boxes_xyxy=table([line.box_xyxy for line in objects], 4),
        truncation=truncation[:, 0],
        occlusion=torch.tensor(occlusion, dtype=torch.int64),
        translation=poses[:, 3:6].clone(),
        yaw=poses[:, 6].clone(),
        size_lhw=poses[:, :3].clone(),
        ignore_xyxy=table([line.box_xyxy for line in regions], 4),
    )


def _parse(name: str, text: str, with_score: bool) -> list[_Line]:
    lines = enumerate(text.splitlines(), start=1)
    return [_parse_line(f"{name}:{i}", line, with_score) for i, line in lines if line.strip()]


def read_labels(path: Path) -> Labels:
    """The labels of one frame. An empty file is a frame without objects.

    A 3D box that the file marks as unknown (sizes -1, position -1000) is NaN in translation, yaw and size_lhw.
    Raises FormatError naming file, line and field: wrong field count, a value that is no finite number or out of
    its range, an unknown type, a box without area, a 3D box wholly behind the camera.
    """
    return _to_labels(_parse(str(path), files.read_text(path), with_score=False))


def read_results(path: Path) -> tuple[Labels, Tensor]:
    """A detector's results for one frame: labels, and scores (M,), a row each.

    Unknown truncation is NaN, unknown occlusion is 3 (KITTI's code for it). Raises as `read_labels` does.
    """
    lines = [line for line in _parse(str(path), files.read_text(path), with_score=True) if line.kind != "DontCare"]
    scores = torch.tensor([line.values[14] for line in lines], dtype=torch.float32)
    return _to_labels(lines), scores


def _decimal(value: float) -> str:
    """Two decimals as KITTI writes, or three where two are not enough."""
    text = f"{value:.3f}"
    text = "0.000" if text == "-0.000" else text
    return text.removesuffix("0")


def _angle(value: float) -> str:
    """An angle in [-pi, pi] as KITTI's angles are, also after rounding."""
    text = _decimal(math.remainder(value, 2 * math.pi))
    return text if abs(float(text)) <= math.pi else text.replace("3.142", "3.141")


def format_labels(labels: Labels, scores: Tensor | None = None) -> str:
    """KITTI's lines for labels, or for results where scores (M,) are given.

    Values are written to 0.001 (scores to 1e-6); alpha follows from yaw and translation. Unknown (NaN) 3D boxes
    become -1 and -1000. Angles are wrapped to [-pi, pi]. Raises FormatError for what `read_labels` would not read
    back.
    """
    if scores is not None and tuple(scores.shape) != (len(labels.kind),):
        raise ShapeError("scores", f"shape {(len(labels.kind),)}", tuple(scores.shape))
    unknown = ["-1", "-1", "-1", "-1000", "-1000", "-1000", "-10"]
    text = []
    for i, kind in enumerate(labels.kind):
        l, h, w = labels.size_lhw[i].tolist()  # noqa: E741
        x, y, z = labels.translation[i].tolist()
        yaw = float(labels.yaw[i])
        known = all(map(math.isfinite, (l, h, w, x, y, z, yaw)))
        alpha = yaw - math.atan2(x, z) if known else UNKNOWN_ANGLE
        truncation = float(labels.truncation[i])
        fields = [kind, "-1" if math.isnan(truncation) else _decimal(truncation), str(int(labels.occlusion[i]))]
        fields += [_angle(alpha) if known else "-10"]
        fields += [_decimal(v) for v in labels.boxes_xyxy[i].tolist()]
        fields += [*map(_decimal, (h, w, l, x, y, z)), _angle(yaw)] if known else unknown
        fields += [] if scores is None else [f"{float(scores[i]):.6f}"]
        text.append(" ".join(fields))
    if scores is None:
        for box in labels.ignore_xyxy.tolist():
            text.append(" ".join(["DontCare", "-1", "-1", "-10", *map(_decimal, box), *unknown]))
    for number, line in enumerate(text, start=1):
        _parse_line(f"label {number}", line, with_score=scores is not None)
    return "".join(f"{line}\n" for line in text)


def write_labels(path: Path, labels: Labels, scores: Tensor | None = None) -> None:
    """Write labels, or results where scores (M,) are given, atomically: see `format_labels`."""
    files.write_text(path, format_labels(labels, scores))


@dataclass(frozen=True, slots=True)
class Calibration:
    """One frame's calibration. projection: (3, 4) px, P2, of rectified camera points to the left colour image.
    rectification (3, 3) and velodyne_to_camera (3, 4), R0_rect and Tr_velo_to_cam, where the file has them.
    """

    projection: Tensor
    rectification: Tensor | None = None
    velodyne_to_camera: Tensor | None = None


_CALIBRATION_COUNTS = {
    **dict.fromkeys(("P0", "P1", "P2", "P3", "Tr_velo_to_cam", "Tr_imu_to_velo"), 12),
    "R0_rect": 9,
}


def read_calib(path: Path) -> Calibration:
    """A calibration file. FormatError naming file and key: P2 missing, wrong count, not finite, said twice."""
    found: dict[str, Tensor] = {}
    for number, line in enumerate(files.read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        key, colon, rest = line.partition(":")
        _require(bool(colon), f"{path}:{number}", "line", "'KEY: numbers'", repr(line[:40]))
        key = key.strip()
        if key not in _CALIBRATION_COUNTS:
            continue
        where = f"{path}:{number}: {key}"
        if key in found:
            raise FormatError(where, "the key once", "it twice")
        values = [finite_number(where, part) for part in rest.split()]
        if len(values) != _CALIBRATION_COUNTS[key]:
            raise FormatError(where, f"{_CALIBRATION_COUNTS[key]} numbers", len(values))
        found[key] = torch.tensor(values, dtype=torch.float32).reshape(3, -1)
    if "P2" not in found:
        raise FormatError(f"{path}: P2", "12 numbers", f"no such key (only {', '.join(found) or 'none'})")
    projection = found["P2"]
    if not (projection[0, 0] > 0 and projection[1, 1] > 0 and projection[2, 2] > 0):
        raise FormatError(f"{path}: P2", "positive focal lengths", projection.diagonal().tolist())
    return Calibration(projection, found.get("R0_rect"), found.get("Tr_velo_to_cam"))


def format_calib(projection: Tensor) -> str:
    """KITTI's calibration lines for one camera: P0 to P3 are `projection` (3, 4), the rest is identity."""
    identity = torch.eye(3, 4)
    rows = [(f"P{i}", projection) for i in range(4)]
    rows += [("R0_rect", identity[:, :3]), ("Tr_velo_to_cam", identity), ("Tr_imu_to_velo", identity)]
    return "".join(f"{key}: {' '.join(f'{v:.12e}' for v in m.flatten().tolist())}\n" for key, m in rows)


def read_points(path: Path, calibration: Calibration) -> Tensor:
    """Laser points (P, 3) m in rectified camera axes, as the labels are, from float32 x y z reflectance."""
    if calibration.rectification is None or calibration.velodyne_to_camera is None:
        raise FormatError(f"calibration for {path}", "R0_rect and Tr_velo_to_cam", "not both")
    data = files.read_bytes(path)
    if len(data) % 16:
        raise FormatError(str(path), "float32 x y z reflectance: a multiple of 16 bytes", f"{len(data)} bytes")
    points = torch.from_numpy(np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float32))
    if not bool(torch.isfinite(points).all()):
        raise FormatError(str(path), "finite coordinates", "NaN or infinity")
    transform = calibration.velodyne_to_camera
    return (points @ transform[:, :3].T + transform[:, 3]) @ calibration.rectification.T


class KittiDataset:
    """The frames of a KITTI object folder.

    root: the folder that holds `split`, or `split` itself. with_points: read the laser's points where a frame has
    them. Raises FormatError naming the folder where there is no image_2 or it is empty, or no velodyne for points;
    a frame's own faults are raised by `labels` and `frame`, so that the other frames can be used.
    """

    def __init__(self, root: Path, split: str = "training", with_points: bool = False) -> None:
        root = Path(root)
        self.folder = root if (root / "image_2").is_dir() and not (root / split).is_dir() else root / split
        if not root.is_dir():
            raise FormatError(str(root), "a KITTI folder", "no such folder")
        if not (self.folder / "image_2").is_dir():
            raise FormatError(str(self.folder / "image_2"), "a folder of images", "no such folder")
        if with_points and not (self.folder / "velodyne").is_dir():
            raise FormatError(str(self.folder / "velodyne"), "a folder of a laser's points", "no such folder")
        self.with_points = with_points
        self._images = {
            path.stem: path
            for path in sorted((self.folder / "image_2").iterdir())
            if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")
        }
        if not self._images:
            raise FormatError(str(self.folder / "image_2"), "at least one .png or .jpg", "none")
        self._has_labels = (self.folder / "label_2").is_dir()
        labelled = (path.stem for path in (self.folder / "label_2").glob("[!.]*.txt")) if self._has_labels else ()
        self._identifiers = tuple(sorted({*self._images, *labelled}))

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, sorted: every image and every label file."""
        return self._identifiers

    def __len__(self) -> int:
        return len(self._identifiers)

    def _check_identifier(self, identifier: str) -> None:
        if identifier not in self._identifiers:
            raise RangeError(f"frame of {self.folder}", f"one of {len(self)} identifiers", repr(identifier))

    def labels(self, identifier: str) -> Labels | None:
        """The labels of one frame; None where the folder has no label_2 (test split)."""
        self._check_identifier(identifier)
        return read_labels(self.folder / "label_2" / f"{identifier}.txt") if self._has_labels else None

    def frame(self, identifier: str) -> Frame:
        """One frame: photograph (3, H, W) float32, 8-bit values over 255, camera with P2, labels, points.

        Also depth m, inf where there is none, and classes and masks, where the folder has depth_2 and instance_2.
        Raises FormatError naming the file and what is wrong: an image, label or calibration that is missing or
        does not read; an image whose size does not go with its labels or its calibration.
        """
        self._check_identifier(identifier)
        if identifier not in self._images:
            raise FormatError(str(self.folder / "image_2" / f"{identifier}.png"), "an image", "no such file")
        image_path = self._images[identifier]
        calib_path = self.folder / "calib" / f"{identifier}.txt"
        labels = self.labels(identifier)
        calibration = read_calib(calib_path)
        image = files.read_image(image_path)
        height, width = image.shape[:2]
        camera = Camera(calibration.projection[:, :3].clone(), height, width, calibration.projection)
        check_size(image_path, camera, labels)
        points_path = self.folder / "velodyne" / f"{identifier}.bin"
        points = read_points(points_path, calibration) if self.with_points and points_path.exists() else None
        size_hw = (height, width)
        classes, masks = _read_instances(self.folder / "instance_2" / f"{identifier}.png", size_hw, labels)
        return Frame(
            identifier=identifier,
            photograph=torch.from_numpy(image).permute(2, 0, 1).contiguous().to(torch.float32) / 255,
            camera=camera,
            labels=labels,
            masks=masks,
            depth=_read_depth(self.folder / "depth_2" / f"{identifier}.png", size_hw),
            classes=classes,
            class_names=() if classes is None else SEMANTIC_NAMES,
            points=points,
            provenance={"dataset": "kitti", "image": image_path.name, "folder": self.folder.name},
        )


def _read_depth(path: Path, size_hw: tuple[int, int]) -> Tensor | None:
    """Depth (H, W) float32 m, inf where there is none."""
    if not path.exists():
        return None
    depth = torch.from_numpy(files.read_uint16(path, size_hw).astype(np.float32)) / DEPTH_SCALE
    return depth.masked_fill(depth == 0, math.inf)


def _read_instances(
    path: Path, size_hw: tuple[int, int], labels: Labels | None
) -> tuple[Tensor | None, Tensor | None]:
    """Classes (H, W) int64 into SEMANTIC_NAMES, and the labels' masks (M, H, W) float32."""
    if not path.exists():
        return None, None
    values = files.read_uint16(path, size_hw).astype(np.int64)
    classes, number = values // INSTANCES, torch.from_numpy(values % INSTANCES)
    if classes.max(initial=0) >= len(SEMANTIC_NAMES):
        raise FormatError(f"{path}: semantic id", f"0 to {len(SEMANTIC_NAMES) - 1}", int(classes.max()))
    masks = None
    if labels is not None:
        masks = (number == torch.arange(1, len(labels.kind) + 1)[:, None, None]).float()
    return torch.from_numpy(classes), masks


def check_size(image_path: Path, camera: Camera, labels: Labels | None) -> None:
    """Refuse an image whose size contradicts its calibration or its labels."""
    found = f"{camera.width}x{camera.height} px"
    low, high = CENTRE_RANGE
    for axis, size in ((0, camera.width), (1, camera.height)):
        centre = float(camera.intrinsics[axis, 2])
        if not low * size <= centre <= high * size:
            name = ("wide", "high")[axis]
            expected = f"{centre / high:.0f} to {centre / low:.0f} px {name} (principal point of the calibration)"
            raise FormatError(str(image_path), expected, found)
    if labels is None:
        return
    boxes = torch.cat([labels.boxes_xyxy, labels.ignore_xyxy])
    limit = torch.tensor([camera.width, camera.height], dtype=boxes.dtype) - 1 + BOX_MARGIN_PX
    outside = ((boxes[:, 2:] > limit) | (boxes[:, :2] < -BOX_MARGIN_PX)).any(dim=1)
    if bool(outside.any()):
        box = [round(v, 2) for v in boxes[outside][0].tolist()]
        raise FormatError(str(image_path), f"an image that holds the label's box {box}", found)


def _plain(name: str) -> str:
    return name.replace("_", "").lower()


def semantic_ids(class_names: Sequence[str]) -> np.ndarray:
    """Cityscapes' ids (C,) uint16 of classes named as Virtual KITTI does. FormatError for an unknown name."""
    known = {_plain(name): i for i, name in enumerate(SEMANTIC_NAMES)}
    plain = [_MERGED.get(_plain(name), _plain(name)) for name in class_names]
    for name, key in zip(class_names, plain, strict=True):
        if key not in known:
            raise FormatError("class", f"one of {', '.join(SEMANTIC_NAMES)}", repr(name))
    return np.array([known[key] for key in plain], np.uint16)


def _instance_map(exposure: Exposure) -> np.ndarray:
    """`instance_2` (H, W) uint16 of an exposure: lines of the label file first, then objects without a line."""
    ordered = sorted(exposure.objects, key=lambda o: not o.labelled)  # stable: file order within both
    if len(exposure.labels.kind) >= INSTANCES:
        raise RangeError("labels of one frame", f"at most {INSTANCES - 1}", len(exposure.labels.kind))
    highest = max([int(exposure.instances.max(initial=0)), *(o.track + 1 for o in ordered)])
    number = np.zeros(highest + 1, np.uint16)
    for i, thing in enumerate(ordered[: INSTANCES - 1]):
        number[thing.track + 1] = i + 1
    return semantic_ids(exposure.class_names)[exposure.classes] * np.uint16(INSTANCES) + number[exposure.instances]


def _depth_map(depth_cm: np.ndarray) -> np.ndarray:
    """`depth_2` (H, W) uint16 of centimetres. 0, none: the sky and what lies beyond 255.99 m."""
    values = (depth_cm.astype(np.uint32) * DEPTH_SCALE + 50) // 100
    return np.where((depth_cm == SKY_CM) | (values > np.iinfo(np.uint16).max), 0, values).astype(np.uint16)


class KittiWriter:
    """Writes frames in KITTI's layout under `root / split`, each file atomically, and `root/ImageSets`.

    extras: also `depth_2` and `instance_2`. What KITTI cannot hold: tracks, extrinsics, the visible share beyond
    its four levels; poses and boxes are rounded to 0.001 m, rad and px. In `instance_2`, trees and vegetation are
    one class, and so are cars and vans.
    """

    def __init__(self, root: Path, split: str = "training", extras: bool = True) -> None:
        self.root = Path(root)
        self.folder = self.root / split
        self.extras = extras

    def _image(self, identifier: str) -> Path:
        return self.folder / "image_2" / f"{identifier}.png"

    def exists(self, place: Place) -> bool:
        """Whether the frame is there: its image is written last."""
        return self._image(f"{place.number:06d}").exists()

    def write(self, place: Place, exposure: Exposure) -> dict[str, object]:
        """Write one frame; the image comes last. The entry says which of the lists in ImageSets it belongs to."""
        identifier = f"{place.number:06d}"
        if self.extras:
            for name, values in (
                ("depth_2", _depth_map(exposure.depth_cm)),
                ("instance_2", _instance_map(exposure)),
            ):
                files.write_png(self.folder / name / f"{identifier}.png", values, PNG_COMPRESSION)
        self.write_photograph(identifier, exposure.image, exposure.labels, exposure.camera.matrix)
        return {"number": place.number, "part": place.part}

    def write_photograph(self, identifier: str, image_rgb: np.ndarray, labels: Labels, projection: Tensor) -> None:
        """Calibration, labels, and last the image. image_rgb: (H, W, 3) uint8; projection: (3, 4) px, as P2."""
        files.write_text(self.folder / "calib" / f"{identifier}.txt", format_calib(projection))
        write_labels(self.folder / "label_2" / f"{identifier}.txt", labels)
        files.write_png(self._image(identifier), image_rgb, PNG_COMPRESSION)

    def finish(self, entries: Sequence[Mapping[str, object]]) -> None:
        """Write `ImageSets/{train,val,trainval}.txt`, one identifier a line, as KITTI's loaders read them."""
        for name, parts in (("train", ("train",)), ("val", ("val",)), ("trainval", ("train", "val"))):
            lines = [f"{entry['number']:06d}\n" for entry in entries if entry["part"] in parts]
            files.write_text(self.root / "ImageSets" / f"{name}.txt", "".join(lines))
