"""KITTI's object folders, `training/{image_2,label_2,calib,velodyne}/000000.*`: reader and writer.

Two more folders, as in KITTI's other benchmarks, hold ground truth that the object benchmark lacks:
`depth_2` (uint16 PNG, 256 times the depth in metres, 0: none; Uhrig et al. 2017) and `instance_2` (uint16 PNG, 256
times the semantic id plus the instance's number, Cityscapes' ids; Abu Alhaija et al. 2018). The instance's number
is the object's line in `label_2`, from 1; objects without a line have higher numbers; 0 means no instance.

Labels follow the object development kit (Geiger et al. 2012): `type truncated occluded alpha left top right bottom
h w l x y z ry`, results have the score as a 16th field. A label table accepts any type and any finite number;
a scene requires more, see `read_labels`. Errors name the file, the line or key, and the field.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from drivesem.data.account import IMAGE_SUFFIXES, DataAccount, account_for_files
from drivesem.data.ground_truth import SKY_CM, Exposure, FrameLocation
from drivesem.data.kitti_labels import (
    SPLITS,
    TYPES,
    UNKNOWN_POSE,
    UNKNOWN_SIZE,
    WITHOUT_LABELS,
    KittiLabelLines,
    finite_number,
    iterate_label_lines,
    list_files,
    read_splits,
)
from drivesem.data.label_table import (
    REGION,
    UNKNOWN_OCCLUSION,
    LabelTable,
    WriteSummary,
    copy_images,
    format_number,
    format_shortest,
    is_known_pose,
    parse_camera_entry,
)
from drivesem.data.photographs import (
    FrameIndex,
    check_image_size,
    is_in_front,
    list_images,
    pinhole_camera,
    read_focal_length,
    read_upright,
)
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.io import to_tensor
from scene_ir.types import FOCAL_PX, Camera, Frame, Labels

DEPTH_SCALE = 256
"""Values per metre in `depth_2`."""
_MAX_LINES = 10_000
"""Limit of one frame; KITTI's have at most about 30."""
INSTANCES = 256
"""Values per semantic id in `instance_2`; the lower byte is the instance."""
SEMANTIC_NAMES = (
    *("Undefined", "EgoVehicle", "Border", "OutOfRoi", "Misc", "Dynamic", "Ground", "Road", "Sidewalk", "Parking"),
    *("RailTrack", "Building", "Wall", "Fence", "GuardRail", "Bridge", "Tunnel", "Pole", "PoleGroup"),
    *("TrafficLight", "TrafficSign", "Vegetation", "Terrain", "Sky", "Pedestrian", "Rider", "Car", "Truck", "Bus"),
    *("Caravan", "Trailer", "Train", "Motorcycle", "Bicycle"),
)
"""Cityscapes' classes in the order of their ids, as in KITTI's semantic benchmark, by Virtual KITTI's names where
it has them (github.com/mcordts/cityscapesScripts, helpers/labels.py; "Undefined" is "unlabeled", "Misc"
"static", "Vegetation" includes trees, "Pedestrian" is "person")."""
_ALIASES = {"tree": "vegetation", "van": "car", "cyclist": "rider", "tram": "train", "personsitting": "pedestrian"}
"""Cityscapes' names of classes without an id of their own."""


def read_labels(path: Path, scored: bool = False) -> Labels:
    """Read the labels of one frame, or a detector's results if `scored`. An empty file has no objects.

    A 3D box that is marked as unknown (sizes -1, position -1000) is NaN in translation, yaw and size_lhw; in results
    truncation and occlusion may be unknown too. Raises FormatError naming file, line and field: a wrong number of
    fields, a value that is not finite or out of range, a box that ends before it begins, a 3D box wholly behind the
    camera.
    """
    return _parse_labels(str(path), files.read_text(path), scored)


def _split_lines(name: str, text: str, scored: bool) -> KittiLabelLines:
    if text.count("\n") > _MAX_LINES:
        raise FormatError(name, f"at most {_MAX_LINES:,} lines", f"{text.count(chr(10)):,}")
    return KittiLabelLines([name], [text], scored)


def _parse_labels(name: str, text: str, scored: bool) -> Labels:
    lines = _split_lines(name, text, scored)
    check_scene(lines, scored)
    return lines.to_table([name], scored).to_labels()


def check_scene(lines: KittiLabelLines, scored: bool = False) -> None:
    """Raise FormatError for lines that a scene cannot use; see `read_labels`."""
    for row, (kind, values) in enumerate(zip(lines.kinds, lines.values.tolist(), strict=True)):

        def require(good: bool, field: str, expected: str, found: str, row: int = row) -> None:
            if not good:
                raise FormatError(lines.locate(row, field), expected, found)

        if kind == "DontCare":
            continue
        truncated, occluded, _, _, _, _, _, h, w, l, _, _, z, yaw = values[:14]  # noqa: E741
        unknown = (-1.0,) if scored else ()
        good = 0 <= truncated <= 1 or truncated in unknown
        require(good, "truncated", "[0, 1]", f"{truncated:g}")
        require(occluded in (0, 1, 2, 3, *unknown), "occluded", "0, 1, 2 or 3", f"{occluded:g}")
        if {h, w, l} <= {UNKNOWN_SIZE, 0.0} and len({h, w, l}) == 1:
            continue
        for name, size in zip(("height", "width", "length"), (h, w, l), strict=True):
            require(size > 0, name, "positive metres", f"{size:g}")
        require(abs(yaw) <= 2 * math.pi + 0.01, "rotation_y", "rad in [-2 pi, 2 pi]", f"{yaw:g}")
        behind = f"{z:g} m, wholly behind it"
        require(is_in_front(z, l, w, yaw), "z", "a 3D box in front of the camera", behind)


def _format_line(
    kind: str,
    truncation: float,
    occlusion: int,
    alpha: float,
    box: Sequence[float],
    pose: Sequence[float] | None,
    score: str | None,
) -> str:
    """Format a line of a label file. `pose` is length, height, width, x, y, z, yaw; unknown values are NaN or None."""
    fields = [kind, format_number(truncation) if truncation >= 0 else "-1", str(occlusion)]
    fields += ["-10" if math.isnan(alpha) else format_number(alpha), *map(format_number, box)]
    if pose is None:
        fields += UNKNOWN_POSE
    else:
        length, height, width, *rest = pose
        fields += map(format_number, (height, width, length, *rest))
    return " ".join(fields if score is None else [*fields, score])


def _round(values: Sequence[float]) -> list[float]:
    return [round(v, 3) for v in values]


def _wrap_angle(value: float) -> float:
    """Wrap an angle to [-pi, pi], rounded to 0.001."""
    turned = round(math.remainder(value, 2 * math.pi), 3)
    return math.copysign(min(abs(turned), 3.141), turned)


def format_labels(labels: Labels, scores: Tensor | None = None) -> str:
    """Format labels, or results if scores (M,) are given.

    Values are rounded to 0.001 (scores to 1e-6); alpha follows from yaw and translation. Unknown (NaN) 3D boxes
    become -1 and -1000, unknown truncation 0. Angles are wrapped to [-pi, pi]. Types of several words (`traffic light`)
    get underscores, as spaces separate fields. Raises FormatError if `read_labels` would refuse the text.
    """
    if scores is not None and tuple(scores.shape) != (len(labels.kind),):
        raise ShapeError("scores", f"shape {(len(labels.kind),)}", tuple(scores.shape))
    text: list[str] = []
    for i, name in enumerate(labels.kind):
        kind = "_".join(name.split())
        x, y, z = labels.translation[i].tolist()
        yaw = float(labels.yaw[i])
        pose, alpha = None, math.nan
        if is_known_pose((*labels.size_lhw[i].tolist(), x, y, z, yaw)):
            pose = [*_round([*labels.size_lhw[i].tolist(), x, y, z]), _wrap_angle(yaw)]
            alpha = _wrap_angle(yaw - math.atan2(x, z))
        cut = float(labels.truncation[i])
        truncation, box = 0.0 if math.isnan(cut) else round(cut, 3), _round(labels.boxes_xyxy[i].tolist())
        score = None if scores is None else f"{float(scores[i]):.6f}"
        text.append(_format_line(kind, truncation, int(labels.occlusion[i]), alpha, box, pose, score))
    if scores is None:
        regions = labels.ignore_xyxy.tolist()
        text += [_format_line("DontCare", -1, -1, math.nan, _round(box), None, None) for box in regions]
    whole = "".join(f"{line}\n" for line in text)
    _parse_labels("labels", whole, scores is not None)
    return whole


def write_labels(path: Path, labels: Labels, scores: Tensor | None = None) -> None:
    """Write labels or results atomically; see `format_labels`.

    Args:
        path: Label file.
        labels: Labels of one frame.
        scores: Scores (M,) of results.

    Raises:
        FormatError: `read_labels` would refuse the text.
    """
    files.write_text(path, format_labels(labels, scores))


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> WriteSummary:
    """Write a table as label files; numbers read back unchanged.

    Args:
        table: Labels or detections.
        out: Folder of the label files; with images, cameras or subfolders, it gets a `training` folder with all of
            them, and `ImageSets` with the splits.
        images: Images to copy, by frame identifier.

    Returns:
        Counts of files, lost and assumed values.

    Raises:
        FormatError: A class is not one of KITTI's types.
    """
    table = table.with_box_format("xyxy")
    kinds = [_kitti_type(kind, int((table.kind == i).sum())) for i, kind in enumerate(table.kinds)]
    names, renamed = table.file_names()
    scored = table.scored
    root = out / "training" if images or table.cameras or any("/" in name for name in names) else out
    folder = root / "label_2" if root != out else out
    for name, rows in zip(names, table.rows_by_frame(), strict=True):
        files.write_text(folder / f"{name}.txt", "".join(_format_rows(table, rows, kinds, scored)))
    for i, camera in table.cameras.items():
        calibration = format_calibration(torch.from_numpy(parse_camera_entry(camera)))
        files.write_text(root / "calib" / f"{names[i]}.txt", calibration)
    targets = {identifier: root / "image_2" / name for identifier, name in zip(table.frames, names, strict=True)}
    count = len(names) + copy_images(targets, images)
    known, objects = table.known_fields(), table.kind != REGION
    supported = ("truncation", "occlusion", "alpha", "3D box", "score", "region", "camera")
    more = renamed | ({"region": int((~objects).sum())} if scored else {})
    if root != out:
        lists, more["split"] = _write_splits(table, names, out)
        count += lists
    lost = table.count_lost(supported, more)
    assumed = {
        "occlusion (3, unknown)": int((objects & ~known["occlusion"]).sum()),
        "truncation (0)": int((objects & ~known["truncation"]).sum()),
    }
    return WriteSummary.from_counts(count, lost, {} if scored else assumed)


def _kitti_type(kind: str, boxes: int) -> str:
    by_name = {name.lower(): name for name in TYPES}
    if kind.lower() in by_name:
        return by_name[kind.lower()]
    if boxes:
        expected = f"one of {', '.join(TYPES[:-1])}, or --map {kind}=TYPE"
        raise FormatError(f"class {kind!r}", expected, f"{boxes} boxes")
    return kind


def _format_rows(table: LabelTable, rows: range, kinds: Sequence[str], scored: bool) -> Iterator[str]:
    """Yield the lines of a frame's boxes.

    Args:
        table: Labels or detections.
        rows: Rows of the frame.
        kinds: KITTI's types of the table's classes.
        scored: Write detections; regions are left out.
    """
    part = slice(rows.start, rows.stop)
    columns = (table.kind, table.ignore, table.truncation, table.occlusion, table.alpha, table.boxes, table.pose)
    values = zip(*(column[part].tolist() for column in columns), table.score[part].tolist(), strict=True)
    for kind, ignore, truncation, occlusion, alpha, box, pose, score in values:
        if scored and kind == REGION:
            continue
        region = kind == REGION or ignore
        known = is_known_pose(pose) and not region
        if known and not math.isfinite(alpha):
            alpha = math.remainder(pose[6] - math.atan2(pose[3], pose[5]), 2 * math.pi)
        if not region and not scored:
            # KITTI has a code for unknown occlusion, but none for unknown truncation
            occlusion = UNKNOWN_OCCLUSION if occlusion < 0 else occlusion
            truncation = max(truncation, 0.0)
        line = _format_line(
            "DontCare" if region else kinds[kind],
            truncation,
            occlusion,
            alpha,
            box,
            pose if known else None,
            format_shortest(score) if scored else None,
        )
        yield f"{line}\n"


def _write_splits(table: LabelTable, names: Sequence[str], out: Path) -> tuple[int, int]:
    """Write the lists `ImageSets/{train,val,test}.txt`.

    Args:
        table: All frames and splits.
        names: Names of the frames' files.
        out: Folder above `ImageSets`.

    Returns:
        Number of lists, and of frames of splits with another name, or joined with another split.
    """
    lists: dict[str, list[int]] = {}
    lost = 0
    for name, rows in table.splits.items():
        known = next((split for split in SPLITS if name.lower().startswith(split)), None)
        lost += len(rows) if known is None or known in lists else 0
        if known is not None:
            lists.setdefault(known, []).extend(rows)
    for name, rows in lists.items():
        files.write_text(out / "ImageSets" / f"{name}.txt", "".join(f"{names[i]}\n" for i in sorted(set(rows))))
    return len(lists), lost


@dataclass(frozen=True, slots=True)
class KittiCalibration:
    """One frame's calibration."""

    projection: Tensor
    """P2 (3, 4) px: from rectified camera points to the left colour image."""
    rectification: Tensor | None = None
    """R0_rect (3, 3)."""
    velodyne_to_camera: Tensor | None = None
    """Tr_velo_to_cam (3, 4) m."""


_CALIBRATION_COUNTS = {
    **dict.fromkeys(("P0", "P1", "P2", "P3", "Tr_velo_to_cam", "Tr_imu_to_velo"), 12),
    "R0_rect": 9,
}

_KEYS_WITHOUT_COLON = ("R_rect", "Tr_velo_cam", "Tr_imu_velo")
"""Keys of the tracking benchmark's files that are not used."""


def read_calibration(path: Path) -> KittiCalibration:
    """Read a calibration file. Raises FormatError naming file and key: missing P2, wrong, not finite, or repeated."""
    matrices: dict[str, Tensor] = {}
    for number, line in enumerate(files.read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        key, colon, rest = line.partition(":")
        if not colon and line.split()[0] in _KEYS_WITHOUT_COLON:
            continue
        if not colon:
            raise FormatError(f"{path}:{number}: line", "'KEY: numbers'", repr(line[:40]))
        key = key.strip()
        if key not in _CALIBRATION_COUNTS:
            continue
        where = f"{path}:{number}: {key}"
        if key in matrices:
            raise FormatError(where, "the key once", "twice")
        values = [finite_number(where, part) for part in rest.split()]
        if len(values) != _CALIBRATION_COUNTS[key]:
            raise FormatError(where, f"{_CALIBRATION_COUNTS[key]} numbers", len(values))
        matrices[key] = torch.tensor(values, dtype=torch.float32).reshape(3, -1)
    if "P2" not in matrices:
        raise FormatError(f"{path}: P2", "12 numbers", f"no such key (only {', '.join(matrices) or 'none'})")
    projection = matrices["P2"]
    least, most = FOCAL_PX
    if not (least <= projection[0, 0] <= most and least <= projection[1, 1] <= most and projection[2, 2] > 0):
        expected = f"positive focal lengths, {least:g} to {most:g} px"
        raise FormatError(f"{path}: P2", expected, projection.diagonal().tolist())
    return KittiCalibration(projection, matrices.get("R0_rect"), matrices.get("Tr_velo_to_cam"))


def format_calibration(projection: Tensor) -> str:
    """Format a calibration of one camera: P0 to P3 are `projection` (3, 4), the others are identity."""
    identity = torch.eye(3, 4)
    rows = [(f"P{i}", projection) for i in range(4)]
    rows += [("R0_rect", identity[:, :3]), ("Tr_velo_to_cam", identity), ("Tr_imu_to_velo", identity)]
    return "".join(f"{key}: {' '.join(f'{v:.12e}' for v in m.flatten().tolist())}\n" for key, m in rows)


def read_points(path: Path, calibration: KittiCalibration) -> Tensor:
    """Read laser points (P, 3) m in rectified camera axes, as the labels', from float32 x y z reflectance."""
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


class KittiDataset(FrameIndex[Path]):
    """The frames of a KITTI object folder: every image, in subfolders too, with a label file, if there are labels.

    An identifier is the path of an image below image_2, without suffix. Values of a 3D box, truncations and
    occlusions that a scene cannot use are unknown; so are the 3D boxes of frames without a calibration. Their camera is
    a pinhole. `account` counts all of them. Images are turned upright by EXIF.

    Args:
        root: Folder that contains `split`, or that folder itself.
        split: Name of the folder of frames.
        with_points: Read laser points of frames that have them.

    Raises:
        FormatError: No or an empty image_2, no image with labels, or no velodyne for points. A frame's own faults are
            raised by `labels` and `frame` only.
    """

    def __init__(self, root: Path, split: str = "training", with_points: bool = False) -> None:
        root = Path(root)
        self._root = root
        self.folder = root if (root / "image_2").is_dir() and not (root / split).is_dir() else root / split
        if not root.is_dir():
            raise FormatError(str(root), "a KITTI folder", "no such folder")
        folder = self.folder / "image_2"
        images = {p.relative_to(folder).with_suffix("").as_posix(): p for p in list_images(folder, recursive=True)}
        if with_points and not (self.folder / "velodyne").is_dir():
            raise FormatError(str(self.folder / "velodyne"), "a folder of a laser's points", "no such folder")
        self.with_points = with_points
        if not images:
            raise FormatError(str(folder), f"at least one image ({', '.join(IMAGE_SUFFIXES)})", "none")
        self._has_labels = (self.folder / "label_2").is_dir()
        self._unpaired: dict[str, str] = {}
        if self._has_labels:
            folder = self.folder / "label_2"
            self._labels = {os.path.splitext(name)[0]: f"{folder}{os.sep}{name}" for name in list_files(folder)}
            self._unpaired = {f"{images[name]}": WITHOUT_LABELS for name in images.keys() - self._labels.keys()}
            paths = (self._labels[name] for name in self._labels.keys() - images.keys())
            self._unpaired |= {f"{path}": _WITHOUT_IMAGE for path in paths}
            images = {name: path for name, path in images.items() if name in self._labels}
            if not images:
                raise FormatError(str(self.folder / "label_2"), "label files named after the images", "none")
        super().__init__(self.folder, dict(sorted(images.items())))

    def _calibration_path(self, identifier: str) -> Path:
        return self.folder / "calib" / f"{identifier}.txt"

    def splits(self) -> dict[str, tuple[str, ...]]:
        """Identifiers by split, of the lists `ImageSets/{train,val,test}.txt`."""
        return read_splits(self._root, self.identifiers)

    def account(self) -> DataAccount:
        """Account for all files and label rows; reads all labels."""
        names, splits = self.identifiers, self.splits()
        read = [f"{self._entry(name)}" for name in names]
        read += [f"{self._calibration_path(name)}" for name in names]
        read += [f"{self._root / 'ImageSets' / name}.txt" for name in splits]
        for folder, suffix in (("depth_2", "png"), ("instance_2", "png"), ("velodyne", "bin")):
            if folder != "velodyne" or self.with_points:
                read += [f"{self.folder / folder / name}.{suffix}" for name in names]
        classes, regions, repairs = Counter[str](), 0, Counter[str]()
        if self._has_labels:
            paths = [self._labels[name] for name in names]
            read += paths
            for lines in iterate_label_lines(paths):
                repairs.update(lines.drop_unusable())
                of_chunk, regions_of_chunk = lines.count_rows()
                classes.update(of_chunk)
                regions += regions_of_chunk
        uncalibrated = sum(not self._calibration_path(name).exists() for name in names)
        if uncalibrated:
            repairs["frames without calibration (3D boxes not used)"] = uncalibrated
        count, skipped = account_for_files(self._root, read, self._unpaired)
        return DataAccount(
            "kitti",
            len(names),
            count,
            skipped,
            dict(classes),
            regions,
            without_image=sum(reason == _WITHOUT_IMAGE for reason in self._unpaired.values()),
            splits={name: len(chosen) for name, chosen in splits.items()},
            repairs=dict(repairs),
        )

    def labels(self, identifier: str) -> Labels | None:
        """Read the labels of one frame; None if the folder has no label_2 (test split)."""
        self._entry(identifier)
        if not self._has_labels:
            return None
        path = self._labels[identifier]
        lines = _split_lines(path, files.read_text(path), scored=False)
        lines.drop_unusable()
        labels = lines.to_table([identifier], scored=False).to_labels()
        return labels if self._calibration_path(identifier).exists() else _drop_poses(labels)

    def frame(self, identifier: str) -> Frame:
        """Read one frame: photograph, camera with P2, labels, points.

        Reads depth (inf where unknown) from depth_2, and classes and masks from instance_2, if they exist. Raises
        FormatError naming the file and the fault: a damaged image, label file or calibration; an image of a size that
        does not fit its labels or its calibration.
        """
        image_path = self._entry(identifier)
        labels = self.labels(identifier)
        provenance = {"dataset": "kitti", "image": image_path.name, "folder": self.folder.name}
        image = read_upright(image_path)
        size_hw = height, width = image.shape[:2]
        points = None
        calib_path = self._calibration_path(identifier)
        if calib_path.exists() or self.with_points:  # points have no place without a calibration
            calibration = read_calibration(calib_path)
            camera = Camera(calibration.projection[:, :3].clone(), height, width, calibration.projection)
            points_path = self.folder / "velodyne" / f"{identifier}.bin"
            if self.with_points and points_path.exists():
                points = read_points(points_path, calibration)
        else:
            focal = read_focal_length(image_path)
            camera = pinhole_camera(height, width, focal.length_px)
            provenance["focal"] = str(focal)
        check_image_size(image_path, camera, labels)
        classes, masks = _read_instances(self.folder / "instance_2" / f"{identifier}.png", size_hw, labels)
        return Frame(
            identifier=identifier,
            photograph=to_tensor(image),
            camera=camera,
            labels=labels,
            masks=masks,
            depth=_read_depth(self.folder / "depth_2" / f"{identifier}.png", size_hw),
            classes=classes,
            class_names=() if classes is None else SEMANTIC_NAMES,
            points=points,
            provenance=provenance,
        )


_WITHOUT_IMAGE = "label file without an image"


def _drop_poses(labels: Labels) -> Labels:
    """Return labels with unknown 3D boxes."""
    names = ("translation", "yaw", "size_lhw")
    return replace(labels, **{name: torch.full_like(getattr(labels, name), math.nan) for name in names})


def _read_depth(path: Path, size_hw: tuple[int, int]) -> Tensor | None:
    """Read depth (H, W) float32 m, inf where unknown."""
    if not path.exists():
        return None
    depth = torch.from_numpy(files.read_uint16(path, size_hw).astype(np.float32)) / DEPTH_SCALE
    return depth.masked_fill(depth == 0, math.inf)


def _read_instances(
    path: Path, size_hw: tuple[int, int], labels: Labels | None
) -> tuple[Tensor | None, Tensor | None]:
    """Read classes (H, W) int64, indices into SEMANTIC_NAMES, and the labels' masks (M, H, W) float32."""
    if not path.exists():
        return None, None
    values = files.read_uint16(path, size_hw).astype(np.int64)
    classes, instances = values // INSTANCES, torch.from_numpy(values % INSTANCES)
    if classes.max(initial=0) >= len(SEMANTIC_NAMES):
        raise FormatError(f"{path}: semantic id", f"0 to {len(SEMANTIC_NAMES) - 1}", int(classes.max()))
    masks = None
    if labels is not None:
        masks = (instances == torch.arange(1, len(labels.kind) + 1)[:, None, None]).float()
    return torch.from_numpy(classes), masks


def _normalise_name(name: str) -> str:
    return name.replace("_", "").lower()


def semantic_ids(class_names: Sequence[str]) -> np.ndarray:
    """Convert Virtual KITTI's class names to Cityscapes' ids (C,) uint16. Raises FormatError for an unknown name."""
    known = {_normalise_name(name): i for i, name in enumerate(SEMANTIC_NAMES)}
    keys = [_ALIASES.get(_normalise_name(name), _normalise_name(name)) for name in class_names]
    for name, key in zip(class_names, keys, strict=True):
        if key not in known:
            raise FormatError("class", f"one of {', '.join(SEMANTIC_NAMES)}", repr(name))
    return np.array([known[key] for key in keys], np.uint16)


def _instance_map(exposure: Exposure) -> np.ndarray:
    """Make `instance_2` (H, W) uint16: lines of the label file first, then objects without a line."""
    ordered = sorted(exposure.objects, key=lambda o: not o.labelled)  # stable: file order within both
    if len(exposure.labels.kind) >= INSTANCES:
        raise RangeError("labels of one frame", f"at most {INSTANCES - 1}", len(exposure.labels.kind))
    highest = max([int(exposure.instances.max(initial=0)), *(o.track + 1 for o in ordered)])
    number = np.zeros(highest + 1, np.uint16)
    for i, tracked in enumerate(ordered[: INSTANCES - 1]):
        number[tracked.track + 1] = i + 1
    return semantic_ids(exposure.class_names)[exposure.classes] * np.uint16(INSTANCES) + number[exposure.instances]


def _depth_map(depth_cm: np.ndarray) -> np.ndarray:
    """Convert centimetres to `depth_2` (H, W) uint16; 0 (unknown) for the sky and beyond 255.99 m."""
    values = (depth_cm.astype(np.uint32) * DEPTH_SCALE + 50) // 100
    return np.where((depth_cm == SKY_CM) | (values > np.iinfo(np.uint16).max), 0, values).astype(np.uint16)


class KittiWriter:
    """Writes frames in KITTI's layout under `root / split`, each file atomically, and `root/ImageSets`.

    With `extras`, also `depth_2` and `instance_2`. KITTI cannot hold tracks, extrinsics, and visible shares beyond
    four levels; poses and boxes are rounded to 0.001 m, rad and px. In `instance_2`, trees and vegetation are one
    class, and so are cars and vans.
    """

    def __init__(self, root: Path, split: str = "training", extras: bool = True) -> None:
        self.root = Path(root)
        self.folder = self.root / split
        self.extras = extras

    def _image(self, identifier: str) -> Path:
        return self.folder / "image_2" / f"{identifier}.png"

    def exists(self, location: FrameLocation) -> bool:
        """Whether the frame exists; its image is written last."""
        return self._image(f"{location.number:06d}").exists()

    def write(self, location: FrameLocation, exposure: Exposure) -> dict[str, object]:
        """Write one frame, its image last. Returns its number and part for the lists in ImageSets."""
        identifier = f"{location.number:06d}"
        if self.extras:
            for name, values in (
                ("depth_2", _depth_map(exposure.depth_cm)),
                ("instance_2", _instance_map(exposure)),
            ):
                files.write_png(self.folder / name / f"{identifier}.png", values)
        self.write_photograph(identifier, exposure.image, exposure.labels, exposure.camera.matrix)
        return {"number": location.number, "part": location.part}

    def write_photograph(self, identifier: str, image_rgb: np.ndarray, labels: Labels, projection: Tensor) -> None:
        """Write calibration, labels, and the image last.

        Args:
            identifier: Name of the files.
            image_rgb: Image (H, W, 3) uint8.
            labels: Labels.
            projection: P2 (3, 4) px.
        """
        files.write_text(self.folder / "calib" / f"{identifier}.txt", format_calibration(projection))
        write_labels(self.folder / "label_2" / f"{identifier}.txt", labels)
        files.write_png(self._image(identifier), image_rgb)

    def finish(self, entries: Sequence[Mapping[str, object]]) -> None:
        """Write `ImageSets/{train,val,trainval}.txt`, one identifier per line, as KITTI's loaders read them."""
        for name, parts in (("train", ("train",)), ("val", ("val",)), ("trainval", ("train", "val"))):
            lines = [f"{entry['number']:06d}\n" for entry in entries if entry["part"] in parts]
            files.write_text(self.root / "ImageSets" / f"{name}.txt", "".join(lines))
