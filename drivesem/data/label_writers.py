"""A `LabelTable` written in any layout, and what that layout cannot hold, counted by field.

Numbers are written so that they read back as they were; sums of decimals are rounded to 1e-9 px.
"""

from __future__ import annotations

import json
import math
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from drivesem.data import vkitti1, vkitti2
from drivesem.data.coco import CATEGORIES
from drivesem.data.kitti import IMAGE_SUFFIXES, TYPES, UNKNOWN_OCCLUSION, format_calib
from drivesem.data.label_table import REGION, LabelTable
from drivesem.data.tables import decimal, text_of
from drivesem.data.truth import TrackedObject
from scene_ir import files
from scene_ir.errors import FormatError

YOLO_DECIMALS = 15
"""Of shares, all that float64 has: in 4000 px that is 4e-12 px, far below the decimals of other files."""
SHOWN_BY_OCCLUSION = (1.0, 0.7, 0.3, 0.05)
"""Visible shares that Virtual KITTI 2's reader takes for KITTI's codes 0 to 3."""
_COLUMNS = {"truncation": "truncation", "occlusion": "occlusion", "alpha": "alpha", "pose": "3D box"}


@dataclass(frozen=True, slots=True)
class Written:
    """What became of a table. files: how many were written; lost: boxes (or frames) by field that the layout has
    no place for; assumed: those for which a value had to be made up, by field.
    """

    files: int
    lost: Mapping[str, int]
    assumed: Mapping[str, int]


def write(table: LabelTable, out: Path, layout: str, images: Mapping[str, Path]) -> Written:
    """Write labels, or detections where they have scores. images: identifier -> file to copy; empty: none.

    out: a folder, or a .json file for COCO. FormatError for what the layout cannot do without.
    """
    writers: Mapping[str, Callable[[LabelTable, Path, Mapping[str, Path]], Written]] = {
        "kitti": _kitti,
        "coco": _coco,
        "yolo": _yolo,
        "vkitti1": _virtual_1,
        "vkitti2": _virtual_2,
    }
    return writers[layout](table, out, images)


def known(table: LabelTable) -> dict[str, np.ndarray]:
    """Which boxes (N,) have a value, by field."""
    found = {
        "truncation": table.truncation >= 0,
        "occlusion": table.occlusion >= 0,
        "alpha": np.isfinite(table.alpha),
        "3D box": np.isfinite(table.pose).all(axis=1),
        "score": np.isfinite(table.score),
        "region": table.kind == REGION,
        "crowd": table.ignore & (table.kind != REGION),
    }
    for name, values in table.extra.items():
        if name != "dontcare":
            found[name] = np.array([value is not None for value in values], np.bool_)
    return found


def _lost(table: LabelTable, kept: Sequence[str], more: Mapping[str, int] | None = None) -> dict[str, int]:
    """Boxes by field that is not among `kept`, and cameras."""
    counts = {name: int(rows.sum()) for name, rows in known(table).items() if name not in kept}
    if "camera" not in kept:
        counts["camera"] = len(table.cameras)
    counts |= more or {}
    return {name: count for name, count in counts.items() if count}


def _number(value: float) -> str:
    """Two decimals as KITTI writes where they are enough, else all that are needed."""
    value += 0.0  # no "-0.00"
    text = f"{value:.2f}"
    if float(text) == value:
        return text
    return np.format_float_positional(value, trim="-")


def _scores(table: LabelTable) -> bool:
    return len(table) > 0 and bool(np.isfinite(table.score[table.kind != REGION]).all())


def _file_names(table: LabelTable) -> tuple[list[str], int]:
    """Identifiers as file names, and how many had to change."""
    names = ["_".join(name.split("/")) for name in table.frames]
    if len(set(names)) != len(names):
        raise FormatError("frames", "names that differ when / becomes _", "two alike")
    return names, sum(a != b for a, b in zip(names, table.frames, strict=True))


def _copy(names: Sequence[str], table: LabelTable, images: Mapping[str, Path], folder: Path) -> int:
    for name, identifier in zip(names, table.frames, strict=True):
        if identifier in images:
            source = images[identifier]
            folder.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, folder / f"{name}{source.suffix.lower()}")
    return len(images)


def _of_frames(table: LabelTable) -> list[range]:
    """The rows of each frame."""
    ends = np.cumsum(np.bincount(table.frame, minlength=len(table.frames))).tolist()
    return [range(a, b) for a, b in zip([0, *ends], ends, strict=False)]


# ---- KITTI ----


def _kitti(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    table = table.in_edges("xyxy")
    kinds = [_kitti_type(kind, int((table.kind == i).sum())) for i, kind in enumerate(table.kinds)]
    names, renamed = _file_names(table)
    scores = _scores(table)
    whole = out / "training" if images or table.cameras else out
    folder = whole / "label_2" if whole != out else out
    count = 0
    for i, rows in enumerate(_of_frames(table)):
        lines = [
            _kitti_line(table, row, kinds, scores) for row in rows if not (scores and table.kind[row] == REGION)
        ]
        files.write_text(folder / f"{names[i]}.txt", "".join(f"{line}\n" for line in lines))
        count += 1
        if i in table.cameras:
            projection = _projection(table.cameras[i])
            files.write_text(whole / "calib" / f"{names[i]}.txt", format_calib(torch.from_numpy(projection)))
    count += _copy(names, table, images, whole / "image_2")
    present = table.kind != REGION
    had = known(table)
    lost = _lost(
        table,
        ("truncation", "occlusion", "alpha", "3D box", "score", "region", "camera"),
        {"/ in frame names": renamed, "region": int((~present).sum()) if scores else 0},
    )
    unknown = {
        "occlusion (3, unknown)": present & ~had["occlusion"],
        "truncation (0)": present & ~had["truncation"],
    }
    assumed = {} if scores else {name: int(rows.sum()) for name, rows in unknown.items() if rows.any()}
    return Written(count, lost, assumed)


def _kitti_type(kind: str, boxes: int) -> str:
    by_name = {name.lower(): name for name in TYPES}
    if kind.lower() in by_name:
        return by_name[kind.lower()]
    if boxes:
        raise FormatError(
            f"class {kind!r}", f"one of {', '.join(TYPES[:-1])}, or --map {kind}=TYPE", f"{boxes} boxes"
        )
    return kind


def _kitti_line(table: LabelTable, row: int, kinds: Sequence[str], scores: bool) -> str:
    kind = int(table.kind[row])
    region = kind == REGION or bool(table.ignore[row])
    truncation, occlusion, alpha = float(table.truncation[row]), int(table.occlusion[row]), float(table.alpha[row])
    pose = table.pose[row].tolist()
    have_pose = all(map(math.isfinite, pose)) and not region
    if not region and not math.isfinite(alpha) and have_pose:
        alpha = math.remainder(pose[6] - math.atan2(pose[3], pose[5]), 2 * math.pi)
    if not region and not scores:
        # labels have a code for an unknown occlusion, and none for truncation
        occlusion = UNKNOWN_OCCLUSION if occlusion < 0 else occlusion
        truncation = max(truncation, 0.0)
    fields = ["DontCare" if region else kinds[kind]]
    fields += ["-1" if truncation < 0 else _number(truncation), str(occlusion)]
    fields.append(_number(alpha) if math.isfinite(alpha) else "-10")
    fields += [_number(v) for v in table.boxes[row].tolist()]
    if have_pose:
        length, height, width, *rest = pose
        fields += [_number(v) for v in (height, width, length, *rest)]
    else:
        fields += ["-1", "-1", "-1", "-1000", "-1000", "-1000", "-10"]
    if scores:
        fields.append(np.format_float_positional(table.score[row], trim="-"))
    return " ".join(fields)


def _projection(camera: Any) -> np.ndarray:
    """P2 (3, 4) of a COCO "camera" entry of this project."""
    if "projection" in camera:
        return np.array(camera["projection"], np.float64).reshape(3, 4)
    fx, fy, cx, cy = (float(camera[k]) for k in ("fx", "fy", "cx", "cy"))
    return np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0]], np.float64)


# ---- COCO ----


def _need_sizes(table: LabelTable, layout: str) -> None:
    missing = int((table.sizes_wh <= 0).any(axis=1).sum())
    if missing:
        raise FormatError(
            f"{layout}: image sizes", "--images FOLDER or --image-size WIDTHxHEIGHT", f"none for {missing} frames"
        )


def _coco(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    _need_sizes(table, "coco")
    table = table.in_edges("xywh")
    names, renamed = _file_names(table)
    kinds = list(CATEGORIES) if set(table.kinds) <= set(CATEGORIES) else list(table.kinds)
    numbers = list(range(1, len(kinds) + 1))
    if table.kind_ids is not None:
        kinds, numbers = list(table.kinds), table.kind_ids.tolist()
    image_ids = (np.arange(1, len(names) + 1) if table.image_ids is None else table.image_ids).tolist()
    records: list[dict[str, Any]] = []
    for i, (name, identifier) in enumerate(zip(names, table.frames, strict=True)):
        suffix = images[identifier].suffix.lower() if identifier in images else ".png"
        width, height = table.sizes_wh[i].tolist()
        record = {"id": image_ids[i], "file_name": f"{name}{suffix}", "width": width, "height": height}
        records.append(record | ({"camera": table.cameras[i]} if i in table.cameras else {}))
    annotations: list[dict[str, Any]] = []
    taken = set() if table.box_ids is None else set(table.box_ids.tolist())
    free = max(taken, default=0) + 1
    for row in range(len(table)):
        kind = int(table.kind[row])
        labels = numbers if kind == REGION else [numbers[kinds.index(table.kinds[kind])]]
        entry = _coco_entry(table, row)
        for k, label in enumerate(labels):
            number = free
            if table.box_ids is not None and k == 0 and kind != REGION:
                number = int(table.box_ids[row])
            else:
                free += 1
            whole = {"id": number, "image_id": image_ids[int(table.frame[row])], "category_id": label, **entry}
            annotations.append(whole | ({"dontcare": True} if kind == REGION else {}))
    categories = [
        {"id": number, "name": kind, "supercategory": CATEGORIES.get(kind, "object")}
        for number, kind in zip(numbers, kinds, strict=True)
    ]
    text = ["{"]
    for name, rows in (("images", records), ("annotations", annotations), ("categories", categories)):
        lines = ",\n".join(json.dumps(row, allow_nan=False) for row in rows)
        text.append(f'"{name}": [\n{lines}\n]' + ("," if name != "categories" else "\n}"))
    path = out if out.suffix.lower() == ".json" else out / "annotations" / "instances_all.json"
    files.write_text(path, "\n".join(text) + "\n")
    copied = 0
    if images:
        copied = _copy(names, table, images, (path.parent if path == out else out) / "images")
    renamed_only = {"/ in frame names": renamed} if renamed else {}
    return Written(1 + copied, renamed_only, {})


def _coco_entry(table: LabelTable, row: int) -> dict[str, Any]:
    box = table.boxes[row].tolist()
    area = float(table.area[row])
    area = area if math.isfinite(area) else box[2] * box[3]
    entry: dict[str, Any] = {"bbox": box, "area": int(area) if area.is_integer() else area}
    entry["iscrowd"] = int(table.ignore[row])
    if math.isfinite(table.score[row]):
        entry["score"] = float(table.score[row])
    if table.truncation[row] >= 0:
        entry["truncation"] = float(table.truncation[row])
    if table.occlusion[row] >= 0:
        entry["occlusion"] = int(table.occlusion[row])
    if math.isfinite(table.alpha[row]):
        entry["alpha"] = float(table.alpha[row])
    pose = table.pose[row].tolist()
    if all(map(math.isfinite, pose)):
        entry["pose"] = {"translation": pose[3:6], "yaw": pose[6], "size_lhw": pose[:3]}
    for name, values in table.extra.items():
        if name != "dontcare" and values[row] is not None:
            entry[name] = values[row]
    return entry


# ---- YOLO ----


def _yolo(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    _need_sizes(table, "yolo")
    table = table.in_edges("xywh")
    names, renamed = _file_names(table)
    scores = _scores(table)
    written = ~table.ignore & (table.kind != REGION) & (table.boxes[:, 2:] > 0).all(axis=1)
    count = 0
    for i, rows in enumerate(_of_frames(table)):
        width, height = table.sizes_wh[i].tolist()
        lines: list[str] = []
        for row in rows:
            if not written[row]:
                continue
            x, y, w, h = table.boxes[row].tolist()
            shares = ((x + w / 2) / width, (y + h / 2) / height, w / width, h / height)
            fields = [str(int(table.kind[row])), *(f"{v:.{YOLO_DECIMALS}f}" for v in shares)]
            fields += [np.format_float_positional(table.score[row], trim="-")] if scores else []
            lines.append(" ".join(fields))
        files.write_text(out / "labels" / "train" / f"{names[i]}.txt", "".join(f"{line}\n" for line in lines))
        count += 1
        if i in table.cameras:
            projection = torch.from_numpy(_projection(table.cameras[i]))
            files.write_text(out / "calib" / "train" / f"{names[i]}.txt", format_calib(projection))
    content = {"train": "images/train", "val": "images/train", "nc": len(table.kinds)}
    text = yaml.safe_dump(content | {"names": dict(enumerate(table.kinds))}, sort_keys=False)
    files.write_text(out / "data.yaml", text)
    count += 1 + _copy(names, table, images, out / "images" / "train")
    boxes = table.boxes[:, 2] * table.boxes[:, 3]
    drawn = np.isfinite(table.area) & ~np.isclose(table.area, boxes, rtol=1e-9) & written
    lost = _lost(
        table,
        ("score", "camera"),
        {
            "/ in frame names": renamed,
            "box without area": int((~table.ignore & (table.boxes[:, 2:] <= 0).any(axis=1)).sum()),
            "area of the mask": int(drawn.sum()),
        },
    )
    return Written(count, lost, {})


# ---- Virtual KITTI ----


def _places(table: LabelTable, world: str) -> tuple[list[tuple[str, str, int]], int]:
    """Scene, variation and frame number of each frame, and how many names had to change."""
    found: list[tuple[str, str, int]] = []
    changed = 0
    for i, name in enumerate(table.frames):
        parts = name.replace("_", "/").split("/")
        scene = parts[0].removeprefix("Scene")
        if len(parts) >= 3 and scene.isdecimal() and parts[-1].isdecimal():
            found.append((f"{int(scene):0{len(world)}d}", parts[1], int(parts[-1])))
        elif name.isdecimal():
            found.append((world, "clone", int(name)))
        else:
            found.append((world, "clone", i))
            changed += 1
    if len(set(found)) != len(found):
        raise FormatError("frames", "a number of its own for each frame", "two alike")
    return found, changed


def _things(table: LabelTable) -> tuple[list[list[TrackedObject]], dict[str, int], dict[str, int]]:
    """The objects of each frame, what is lost and what is assumed. FormatError for objects without a 3D box."""
    table = table.in_edges("xyxy")
    lost: Counter[str] = Counter()
    assumed: Counter[str] = Counter()
    flat = np.asarray(~np.isfinite(table.pose).all(axis=1))
    without = int((flat & (table.kind != REGION) & ~table.ignore).sum())
    if without:
        raise FormatError("Virtual KITTI: 3D box", "one of every object", f"none of {without} objects")
    bad = sorted({table.kinds[k] for k in np.unique(table.kind[table.kind >= 0]).tolist()} - set(vkitti2.KINDS))
    if bad:
        raise FormatError(
            f"class {bad[0]!r}", f"one of {', '.join(vkitti2.KINDS)}, or --map {bad[0]}=TYPE", bad[0]
        )
    frames: list[list[TrackedObject]] = []
    for rows in _of_frames(table):
        things: list[TrackedObject] = []
        used = {int(t) for r in rows if (t := _extra(table, "track", r)) is not None}
        spare = (n for n in range(len(rows) + len(used) + 1) if n not in used)
        for row in rows:
            if flat[row] or (table.ignore[row] and _extra(table, "kind", row) is None):
                lost["region"] += 1
                continue
            things.append(_thing(table, row, spare, lost, assumed))
        frames.append(things)
    return frames, dict(lost), dict(assumed)


def _extra(table: LabelTable, name: str, row: int) -> Any:
    return table.extra[name][row] if name in table.extra else None


def _thing(table: LabelTable, row: int, spare: Any, lost: Counter[str], assumed: Counter[str]) -> TrackedObject:
    def or_assumed(name: str, value: Any) -> Any:
        found = _extra(table, name, row)
        assumed[name] += found is None
        return value if found is None else found

    edges = table.boxes[row]
    whole = np.round(edges)
    lost["fraction of a pixel"] += bool((whole != edges).any())
    lost["score"] += math.isfinite(table.score[row])
    occlusion, truncation = int(table.occlusion[row]), float(table.truncation[row])
    assumed["truncation"] += truncation < 0
    assumed["occlusion"] += occlusion < 0
    code = max(occlusion, 0)
    length, height, width, x, y, z, yaw = table.pose[row].tolist()
    world = _extra(table, "world", row) or (x, y, z)
    turn: Any = _extra(table, "world_yxz", row) or (yaw, 0.0, 0.0)
    left, top, right, bottom = (int(v) for v in whole)
    region = int(table.kind[row]) == REGION
    track = _extra(table, "track", row)
    assumed["track"] += track is None
    return TrackedObject(
        track=next(spare) if track is None else int(track),
        kind=str(_extra(table, "kind", row)) if region else table.kinds[int(table.kind[row])],
        model=str(or_assumed("model", "unknown")),
        paint=str(or_assumed("paint", "unknown")),
        moving=bool(or_assumed("moving", False)),
        box_ltrb=(left, top, right, bottom),
        pixels=int(_extra(table, "pixels", row) or 0),
        truncation=max(truncation, 0.0),
        visible=float(or_assumed("visible", SHOWN_BY_OCCLUSION[min(code, 3)])),
        occlusion=code,
        translation=(x, y, z),
        yaw=yaw,
        size_lhw=(length, height, width),
        world=(world[0], world[1], world[2]),
        world_yxz=(turn[0], turn[1], turn[2]),
        labelled=not region,
    )


_VIRTUAL = (
    *("truncation", "occlusion", "alpha", "3D box", "track", "visible", "model", "paint", "moving", "kind"),
    *("score", "region", "crowd"),  # counted row by row
)
"""What both versions of Virtual KITTI hold."""
_EYE = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


def _virtual_1(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    places, changed = _places(table, "0001")
    frames, lost, assumed = _things(table)
    count = 0
    for world, variation in sorted({(w, v) for w, v, _ in places}):
        chosen = sorted((n, i) for i, (w, v, n) in enumerate(places) if (w, v) == (world, variation))
        rows = [vkitti1.format_row(n, thing) for n, i in chosen for thing in frames[i]]
        name = f"{world}_{variation}.txt"
        files.write_text(out / "vkitti_1.3.1_motgt" / name, text_of(vkitti1.MOTGT, rows))
        poses = [f"{n} {_EYE}" for n, _ in chosen]
        files.write_text(out / "vkitti_1.3.1_extrinsicsgt" / name, text_of(vkitti1.EXTRINSICS, poses))
        count += 2
    for (world, variation, number), identifier in zip(places, table.frames, strict=True):
        if identifier in images:
            _copy_one(images[identifier], out / "vkitti_1.3.1_rgb" / world / variation / f"{number:05d}.png")
    deep = sum(thing.occlusion > 2 for things in frames for thing in things)
    lost |= {"occlusion 3 (2 is the most)": deep, "frame names": changed}
    lost |= _lost(table, _VIRTUAL)
    return Written(count + len(images), _positive(lost), _positive(assumed))


def _virtual_2(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    places, changed = _places(table, "01")
    frames, lost, assumed = _things(table)
    count = 0
    for scene, variation in sorted({(s, v) for s, v, _ in places}):
        chosen = sorted((n, i) for i, (s, v, n) in enumerate(places) if (s, v) == (scene, variation))
        clip = out / f"Scene{scene}" / variation
        info: dict[int, str] = {}
        offset = 0
        boxes: list[str] = []
        poses: list[str] = []
        for n, i in chosen:
            things = frames[i]
            if "track" not in table.extra:  # numbers that say nothing must not be one object in two frames
                things = [replace(thing, track=thing.track + offset) for thing in things]
                offset += len(things)
            for thing in things:
                text = f"{thing.kind} {thing.model} {thing.paint}"
                if info.setdefault(thing.track, text) != text:
                    raise FormatError(f"track {thing.track}", f"{info[thing.track]}, as before", text)
                boxes.append(vkitti2.format_bbox(n, 0, thing))
                poses.append(vkitti2.format_pose(n, 0, thing))
        intrinsics = [f"{n} 0 {_intrinsic(table.cameras.get(i))}" for n, i in chosen]
        tables = {
            "info": (vkitti2.INFO, [f"{track} {text}" for track, text in sorted(info.items())]),
            "bbox": (vkitti2.BBOX, boxes),
            "pose": (vkitti2.POSE, poses),
            "intrinsic": (vkitti2.INTRINSIC, intrinsics),
            "extrinsic": (vkitti2.EXTRINSIC, [f"{n} 0 {_EYE}" for n, _ in chosen]),
        }
        for name, (header, rows) in tables.items():
            files.write_text(clip / f"{name}.txt", text_of(header, rows))
            count += 1
    for (scene, variation, number), identifier in zip(places, table.frames, strict=True):
        if identifier in images:
            source = images[identifier]
            folder = out / f"Scene{scene}" / variation / "frames" / "rgb" / "Camera_0"
            _copy_one(source, folder / f"rgb_{number:05d}{source.suffix.lower()}")
    assumed["camera"] = len(table.frames) - len(table.cameras)
    shifted = sum(bool(_projection(c)[:, 3].any()) for c in table.cameras.values())
    lost |= {"frame names": changed, "camera's offset": shifted}
    lost |= _lost(table, (*_VIRTUAL, "pixels", "world", "world_yxz", "camera"))
    return Written(count + len(images), _positive(lost), _positive(assumed))


def _positive(counts: Mapping[str, int]) -> dict[str, int]:
    return {name: int(count) for name, count in counts.items() if count}


def _intrinsic(camera: Any) -> str:
    """fx fy cx cy; Virtual KITTI 2's own where none is known."""
    if camera is None:
        return "725.0087 725.0087 620.5 187"
    matrix = _projection(camera)
    return " ".join(decimal(float(v)) for v in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))


def _copy_one(source: Path, target: Path) -> None:
    if target.suffix != source.suffix.lower():
        raise FormatError(str(source), f"a {target.suffix} image", source.suffix or "none")
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def images_beside(path: Path, layout: str, frames: Sequence[str]) -> dict[str, Path]:
    """The images of a source, where they are in its layout's own place."""
    if layout == "yolo":
        from drivesem.data.yolo import YoloDataset

        dataset = YoloDataset(path)
        return {name: dataset.image_path(name) for name in frames}
    if layout.startswith("vkitti"):
        opened = vkitti1.Vkitti1Dataset(path) if layout == "vkitti1" else vkitti2.Vkitti2Dataset(path)
        return {name: opened.image_path(name) for name in frames}
    places = {
        "kitti": (path / "training" / "image_2", path / "image_2", path.parent / "image_2"),
        "coco": (path.parent / "images", path.parent.parent / "images", path / "images"),
        "run": (),
    }[layout]
    folders = [folder for place in places if place.is_dir() for folder in (place, *_below(place))]
    return images_in(folders, frames)


def _below(folder: Path) -> list[Path]:
    return sorted(child for child in folder.iterdir() if child.is_dir())


def images_in(folders: Sequence[Path], frames: Sequence[str]) -> dict[str, Path]:
    """The image of each frame that has one in one of the folders."""
    there = {
        path.stem: path
        for folder in reversed(folders)
        for path in folder.iterdir()
        if path.suffix.lower() in IMAGE_SUFFIXES
    }
    return {name: there[name] for name in frames if name in there}
