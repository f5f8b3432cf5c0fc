"""Labels and detections from files of any layout into a `LabelTable`, without decoding images.

KITTI: folders of label files, `label_2`, `training`, results' `data`. COCO: a JSON file of a data set, or of
results. YOLO: `data.yaml`, or a folder of text files. Virtual KITTI 1.3.1 and 2. Runs of `drivesem attack`.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.data.kitti import FIELDS, IMAGE_SUFFIXES, UNKNOWN_ANGLE, UNKNOWN_POSITION, finite_number
from drivesem.data.label_table import REGION, LabelTable
from drivesem.data.truth import TrackedObject
from drivesem.data.vkitti1 import SIZE_HW, Vkitti1Dataset
from drivesem.data.vkitti2 import Vkitti2Dataset
from drivesem.data.yolo import YoloDataset, parse_line, size_of_image
from drivesem.run.results import BoxRecord, load_frame
from scene_ir import files
from scene_ir.errors import FormatError, RangeError

LAYOUTS = ("kitti", "coco", "yolo", "vkitti1", "vkitti2", "run")
DONT_CARE = "dontcare"
STAGES = ("attacked", "attacked-paper", "rerendered", "benign")
"""What of a run is looked at: detections after the attack with labels that moved or the benign ones, detections in
the re-rendered photograph, and in the photograph."""
RESULT = "result.json"
_SHOWN = 3


def layout_of(path: Path) -> str:
    """One of LAYOUTS by what lies there. FormatError where it is none."""
    if path.is_file():
        if path.suffix.lower() == ".json":
            return "coco"
        if path.suffix.lower() in (".yaml", ".yml"):
            return "yolo"
        raise FormatError(str(path), "a .json or .yaml file, or a folder of labels", f"a {path.suffix or 'file'}")
    if not path.is_dir():
        raise FormatError(str(path), "a file or folder of labels", "nothing there")
    if (path / "frames").is_dir() and any((path / "frames").glob(f"*/{RESULT}")):
        return "run"
    if (path / "data.yaml").is_file():
        return "yolo"
    if any((path / "annotations").glob("instances_*.json")):
        return "coco"
    if (path / "vkitti_1.3.1_rgb").is_dir():
        return "vkitti1"
    if any(p.is_dir() for pattern in ("Scene[0-9]*", "vkitti_2*") for p in path.glob(pattern)):
        return "vkitti2"
    folder = kitti_folder(path)
    if folder is not None:
        return "yolo" if _is_yolo_text(folder) else "kitti"
    raise FormatError(str(path), f"labels as one of {', '.join(LAYOUTS)}", "no label file (an empty folder?)")


def kitti_folder(path: Path) -> Path | None:
    """The folder of label files that a path means: itself, or `label_2`, `training/label_2`, `data` below it."""
    for folder in (path / "training" / "label_2", path / "label_2", path / "data", path):
        if folder.is_dir() and any(folder.glob("[!.]*.txt")):
            return folder
    return None


def _text_files(folder: Path) -> list[Path]:
    """The text files of a folder, sorted by name: of tens of thousands, paths would take seconds to sort."""
    return [folder / name for name in sorted(os.listdir(folder)) if name.endswith(".txt") and name[0] != "."]


def _is_yolo_text(folder: Path) -> bool:
    """Whether text files begin with a class number, as YOLO's do; KITTI's begin with a name."""
    for path in _text_files(folder):
        words = files.read_text(path).split(None, 1)
        if words:
            return words[0].isdecimal()
    return False


@dataclass(frozen=True, slots=True)
class Reading:
    """How a path is read. layout: one of LAYOUTS, None to look; scores: detections, not labels; stage: of a run;
    truth: the labels beside which detections are read, for COCO's ids, YOLO's classes and image sizes.
    """

    layout: str | None = None
    scores: bool = False
    stage: str = STAGES[0]
    truth: LabelTable | None = None


def read(path: Path, how: Reading) -> LabelTable:
    """The table of a path. FormatError naming file, line or entry, and field."""
    layout = how.layout or layout_of(path)
    if not path.exists():
        raise FormatError(str(path), "a file or folder of labels", "nothing there")
    readers: Mapping[str, Callable[[Path, Reading], LabelTable]] = {
        "kitti": _kitti,
        "coco": _coco,
        "yolo": _yolo,
        "vkitti1": _virtual,
        "vkitti2": _virtual,
        "run": _run,
    }
    if layout not in readers:
        raise RangeError("layout", f"one of {', '.join(LAYOUTS)}", layout)
    if how.scores and layout.startswith("vkitti"):
        raise FormatError(str(path), "detections with scores", "Virtual KITTI, which holds labels only")
    return readers[layout](path, how)


# ---- KITTI ----


def _kitti(path: Path, how: Reading) -> LabelTable:
    folder = kitti_folder(path) if path.is_dir() else None
    if folder is None:
        raise FormatError(str(path), "a folder of KITTI label files (NNNNNN.txt)", "none")
    paths = _text_files(folder)
    lines: list[str] = []
    counts = np.zeros(len(paths), np.int64)
    for i, file in enumerate(paths):
        found = [line for line in files.read_text(file).splitlines() if line and not line.isspace()]
        lines += found
        counts[i] = len(found)
    if how.scores and not lines:
        raise FormatError(str(folder), "at least one detection", f"{len(paths)} empty files")
    frame = np.repeat(np.arange(len(paths)), counts)
    fields = 16 if how.scores else 15
    words = [line.split() for line in lines]
    values = _numbers(words, fields)
    if values is None:
        values = _by_line(paths, counts, lines, fields)
    _check_kitti(paths, frame, counts, values)
    names = [word[0] for word in words]
    kinds = sorted({name for name in names if name.lower() != DONT_CARE})
    number = {name: i for i, name in enumerate(kinds)}
    occlusion = values[:, 1].astype(np.int64)
    size, position = values[:, [9, 7, 8]], values[:, 10:14]
    known = (size > 0).all(axis=1) & (position[:, :3] != UNKNOWN_POSITION).any(axis=1)
    return LabelTable.of(
        [file.stem for file in paths],
        kinds,
        frame,
        [number.get(name, REGION) for name in names],
        values[:, 3:7].copy(),
        "xyxy",
        score=values[:, 14].copy() if how.scores else np.full(len(lines), np.nan),
        truncation=values[:, 0].copy(),
        occlusion=occlusion,
        alpha=np.where(values[:, 2] == UNKNOWN_ANGLE, np.nan, values[:, 2]),
        pose=np.where(known[:, None], np.concatenate([size, position], axis=1), np.nan),
    )


def _numbers(words: Sequence[Sequence[str]], fields: int) -> np.ndarray | None:
    """The numbers (N, 14 or 15) of lines that all have as many fields; None where a look at each is needed."""
    lengths = {len(word) for word in words}
    if len(lengths) != 1 or not lengths <= {fields, 16}:
        return None
    try:
        return np.array([text for word in words for text in word[1:]], dtype=np.float64).reshape(len(words), -1)
    except ValueError:
        return None


def _where(paths: Sequence[Path], counts: np.ndarray, row: int) -> str:
    """File and line of a row; blank lines are counted too."""
    ends = np.cumsum(counts)
    i = int(np.searchsorted(ends, row, side="right"))
    wanted = row - int(ends[i] - counts[i])
    numbers = [n for n, line in enumerate(files.read_text(paths[i]).splitlines(), start=1) if line.strip()]
    return f"{paths[i]}:{numbers[wanted]}"


def _by_line(paths: Sequence[Path], counts: np.ndarray, lines: Sequence[str], fields: int) -> np.ndarray:
    """The numbers of every line, one by one. FormatError naming the first line that is not as it should be."""
    rows: list[list[float]] = []
    for row, line in enumerate(lines):
        parts = line.split()
        if len(parts) not in {fields, 16}:
            expected = "16 fields (with a score)" if fields == 16 else "15 or 16 fields"
            raise FormatError(_where(paths, counts, row), expected, len(parts))
        numbers: list[float] = []
        for name, part in zip(FIELDS[1:], parts[1:], strict=False):
            try:
                numbers.append(float(part))
            except ValueError:
                raise FormatError(f"{_where(paths, counts, row)}: {name}", "a number", repr(part)) from None
        rows.append(numbers[: fields - 1])
    return np.array(rows, np.float64).reshape(-1, fields - 1)


def _check_kitti(paths: Sequence[Path], frame: np.ndarray, counts: np.ndarray, values: np.ndarray) -> None:
    if not len(values):
        return
    wrong = ~np.isfinite(values)
    if wrong.any():
        row, column = np.argwhere(wrong)[0].tolist()
        where = f"{_where(paths, counts, row)}: {FIELDS[column + 1]}"
        raise FormatError(where, "a finite number", f"{values[row, column]:g}")
    for low, high, name in ((3, 5, "right"), (4, 6, "bottom")):
        turned = values[:, high] < values[:, low]
        if turned.any():
            row = int(np.flatnonzero(turned)[0])
            where = f"{_where(paths, counts, row)}: {name}"
            raise FormatError(where, f"at least {values[row, low]:g}", f"{values[row, high]:g}")


# ---- COCO ----


def _coco(path: Path, how: Reading) -> LabelTable:
    paths = [path] if path.is_file() else sorted((path / "annotations").glob("instances_*.json"))
    if len(paths) != 1:
        names = ", ".join(p.name for p in paths) or "none"
        raise FormatError(str(path), "one COCO file (name it)", names)
    path = paths[0]
    if not files.read_bytes(path).strip():
        raise FormatError(str(path), "COCO annotations or results", "an empty file")
    content = files.read_json(path)
    if isinstance(content, list):
        if not how.scores:
            raise FormatError(str(path), "images, annotations and categories", "a list (of results?)")
        if how.truth is None:
            raise FormatError(str(path), "labels beside a list of results", "none")
        return _coco_results(path, content, how.truth)
    if not isinstance(content, dict):
        raise FormatError(str(path), "a COCO data set or a list of results", type(content).__name__)
    images = sorted(_entries(path, content, "images"), key=lambda row: row.get("id", -1))
    categories = sorted(_entries(path, content, "categories"), key=lambda row: row.get("id", -1))
    image_ids = _whole(f"{path}: images", images, "id")
    category_ids = _whole(f"{path}: categories", categories, "id")
    for name, ids in (("images", image_ids), ("categories", category_ids)):
        if len(np.unique(ids)) != len(ids):
            raise FormatError(f"{path}: {name}", "an id of its own for each", "one twice")
    names = [str(row.get("name", row["id"])) for row in categories]
    frames = [_identifier(row) for row in images]
    if len(set(frames)) != len(frames):
        frames = [str(i) for i in image_ids.tolist()]
    sizes = [(row.get("width") or 0, row.get("height") or 0) for row in images]
    rows = _entries(path, content, "annotations")
    table = _annotations(f"{path}: annotations", rows, image_ids, category_ids, frames, names, how.scores)
    order = np.argsort(table.frame, kind="stable")
    cameras = {i: row["camera"] for i, row in enumerate(images) if "camera" in row}
    table = _merged_regions(table.rows(order))
    return _with(table, sizes_wh=np.array(sizes, np.int64).reshape(-1, 2), image_ids=image_ids, cameras=cameras)


def _merged_regions(table: LabelTable) -> LabelTable:
    """Crowds of every class that are one region in which nothing is judged ("dontcare") become that region."""
    marks = table.extra.get("dontcare")
    if marks is None:
        return table
    marked = np.array([bool(mark) for mark in marks], np.bool_)
    kind = np.where(marked, REGION, table.kind)
    keys = [
        (frame, *box) if mark else i
        for i, (frame, box, mark) in enumerate(
            zip(table.frame.tolist(), table.boxes.tolist(), marked, strict=True)
        )
    ]
    first = np.array(_firsts(keys), np.int64)
    extra = {name: values for name, values in table.extra.items() if name != "dontcare"}
    return _with(table, kind=kind, extra=extra).rows(first)


def _firsts(keys: Sequence[Any]) -> list[int]:
    """The first place of each key, ascending."""
    seen: dict[Any, int] = {}
    for i, key in enumerate(keys):
        seen.setdefault(key, i)
    return list(seen.values())


def _coco_results(path: Path, rows: list[Any], truth: LabelTable) -> LabelTable:
    """A list of results, whose ids are those of the labels' file, or frames named by numbers."""
    if truth.image_ids is not None:
        image_ids = truth.image_ids
    else:
        numeric = [int(name) if name.isdecimal() else -1 for name in truth.frames]
        image_ids = np.array(numeric, np.int64)
    if truth.kind_ids is None:
        raise FormatError(str(path), "categories (a COCO data set), as the labels are no COCO file", "a list")
    table = _annotations(str(path), rows, image_ids, truth.kind_ids, truth.frames, truth.kinds, True)
    order = np.argsort(table.frame, kind="stable")
    return _with(table.rows(order), image_ids=truth.image_ids)


def _with(table: LabelTable, **changes: Any) -> LabelTable:
    return replace(table, **changes)


def _identifier(row: Mapping[str, Any]) -> str:
    name = row.get("file_name")
    return "_".join(Path(str(name)).with_suffix("").parts) if name else str(row["id"])


def _entries(path: Path, content: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    rows = content.get(name)
    if not isinstance(rows, list) or any(not isinstance(row, dict) for row in rows):
        raise FormatError(f"{path}: {name}", "a list of objects", "none" if rows is None else type(rows).__name__)
    return rows


def _whole(where: str, rows: Sequence[Mapping[str, Any]], key: str) -> np.ndarray:
    """Whole numbers (N,) under a key. FormatError naming the first row without one."""
    values = [row.get(key) for row in rows]
    if not set(map(type, values)) <= {int}:
        i, value = next((i, v) for i, v in enumerate(values) if type(v) is not int)
        raise FormatError(f"{where}[{i}].{key}", "a whole number", json.dumps(value))
    return np.array(values, np.int64)


def _column(where: str, rows: Sequence[Mapping[str, Any]], key: str, missing: float | None) -> np.ndarray:
    """Finite numbers (N,) under a key, `missing` where a row has none; None: each must have one. FormatError."""
    values = [row.get(key, missing) for row in rows]
    if not set(map(type, values)) <= {int, float}:
        values = [missing if value is None else value for value in values]
        for i, value in enumerate(values):
            if type(value) not in (int, float):
                raise FormatError(f"{where}[{i}].{key}", "a finite number", json.dumps(value))
    found = np.array(values, np.float64)
    wrong = ~np.isfinite(found)
    if missing is not None and math.isnan(missing):
        wrong &= np.array([row.get(key) is not None for row in rows], np.bool_) if wrong.any() else wrong
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise FormatError(f"{where}[{i}].{key}", "a finite number", json.dumps(values[i]))
    return found


def _boxes(where: str, rows: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """Left, top, width, height (N, 4). FormatError naming the first row that has no such box."""
    values = [row.get("bbox") for row in rows]
    try:
        boxes = np.array(values, dtype=np.float64).reshape(len(rows), 4)
        if np.isfinite(boxes).all() and (boxes[:, 2:] >= 0).all() and not any(type(v) is str for v in values):
            return boxes
    except (ValueError, TypeError):
        pass  # one of them is no box: found below
    for i, value in enumerate(values):
        place = f"{where}[{i}].bbox"
        if not (isinstance(value, list) and len(value) == 4 and all(type(v) in (int, float) for v in value)):
            raise FormatError(place, "x, y, width, height", json.dumps(value)[:60])
        if not all(map(math.isfinite, value)) or value[2] < 0 or value[3] < 0:
            raise FormatError(place, "finite numbers, width and height of at least 0", json.dumps(value)[:60])
    return np.array(values, dtype=np.float64).reshape(len(rows), 4)


def _places(where: str, key: str, values: np.ndarray, ids: np.ndarray, what: str) -> np.ndarray:
    """The place of each of `values` among `ids`. FormatError for those that are not there."""
    order = np.argsort(ids)
    found = order[np.searchsorted(ids[order], values).clip(0, max(len(ids) - 1, 0))] if len(ids) else values * 0
    other = ids[found] != values if len(ids) else np.ones(len(values), np.bool_)
    if other.any():
        unknown = np.unique(values[other])
        shown = ", ".join(map(str, unknown[:_SHOWN])) + (", ..." if len(unknown) > _SHOWN else "")
        raise FormatError(f"{where}: {key}", f"ids of the {len(ids)} {what}", f"{len(unknown)} others ({shown})")
    return found


_OWN_COLUMNS = ("truncation", "occlusion", "alpha", "pose", "score", "area", "bbox", "iscrowd", "image_id", "id")


def _annotations(
    where: str,
    rows: list[Any],
    image_ids: np.ndarray,
    category_ids: np.ndarray,
    frames: Sequence[str],
    kinds: Sequence[str],
    scores: bool,
) -> LabelTable:
    if not set(map(type, rows)) <= {dict}:
        i, row = next((i, r) for i, r in enumerate(rows) if not isinstance(r, dict))
        raise FormatError(f"{where}[{i}]", "an object", type(row).__name__)
    keys = set().union(*rows)
    nothing = np.full(len(rows), np.nan)

    def column(key: str, missing: float = math.nan) -> np.ndarray:
        return _column(where, rows, key, missing) if key in keys else np.full(len(rows), missing)

    frame = _places(where, "image_id", _whole(where, rows, "image_id"), image_ids, "images")
    kind = _places(where, "category_id", _whole(where, rows, "category_id"), category_ids, "categories")
    boxes = _boxes(where, rows)
    area = nothing if scores else column("area")
    numbers = [row.get("id") for row in rows] if "id" in keys else []
    names = sorted(keys - {*_OWN_COLUMNS, "category_id"}) if not scores else []
    return LabelTable.of(
        frames,
        kinds,
        frame,
        kind,
        boxes,
        "xywh",
        ignore=np.array([bool(row.get("iscrowd")) for row in rows], np.bool_),
        score=_column(where, rows, "score", None) if scores else nothing,
        truncation=column("truncation", -1.0),
        occlusion=column("occlusion", -1.0).astype(np.int64),
        alpha=column("alpha"),
        pose=np.array([_pose(row.get("pose")) for row in rows], np.float64).reshape(-1, 7)
        if "pose" in keys
        else np.full((len(rows), 7), np.nan),
        area=np.where(np.isnan(area), boxes[:, 2] * boxes[:, 3], area),
        box_ids=np.array(numbers, np.int64) if numbers and set(map(type, numbers)) == {int} else None,
        kind_ids=category_ids,
        extra={name: [row.get(name) for row in rows] for name in names},
    )


def _pose(value: Any) -> list[float]:
    """Length, height, width, x, y, z, yaw of the entry that this project's files have; NaN for any other."""
    try:
        return [float(v) for v in (*value["size_lhw"], *value["translation"], value["yaw"])]
    except (TypeError, KeyError, ValueError):
        return [math.nan] * 7


# ---- YOLO ----


def _yolo(path: Path, how: Reading) -> LabelTable:
    if not how.scores:
        dataset = YoloDataset(path)
        found = [dataset.rows(name) for name in dataset.identifiers]
        names = [dataset.class_names[i] for i in sorted(dataset.class_names)]
        rows = [(i, names.index(kind), box) for i, (lines, _) in enumerate(found) for kind, box in lines]
        return _table_of(dataset.identifiers, names, rows, sizes_wh=np.array([s for _, s in found], np.int64))
    return _yolo_results(path, how.truth)


def _yolo_results(path: Path, truth: LabelTable | None) -> LabelTable:
    """Text files `class cx cy w h score`; classes and image sizes are those of the labels."""
    folder = path / "labels" if (path / "labels").is_dir() else path
    paths = sorted(folder.rglob("[!.]*.txt"))
    if truth is None or not truth.sizes_wh.all():
        raise FormatError(str(path), "labels with image sizes (YOLO's or COCO's) beside it", "none")
    names = dict(enumerate(truth.kinds))
    place = {name: i for i, name in enumerate(truth.frames)}
    frames = [file.stem for file in paths]
    rows: list[tuple[int, int, list[float]]] = []
    scores: list[float] = []
    for i, file in enumerate(paths):
        if file.stem not in place:
            raise FormatError(str(file), f"a name of one of the {len(place)} labelled frames", repr(file.stem))
        width, height = truth.sizes_wh[place[file.stem]].tolist()
        for n, line in enumerate(files.read_text(file).splitlines(), start=1):
            parts = line.split()
            if not parts:
                continue
            if len(parts) != 6:
                raise FormatError(f"{file}:{n}", "6 fields: class cx cy w h score", len(parts))
            kind, box = parse_line(f"{file}:{n}", parts[:5], names, (width, height))
            rows.append((i, truth.kinds.index(kind), box))
            scores.append(finite_number(f"{file}:{n}: score", parts[5]))
    if not rows:
        raise FormatError(str(path), "at least one detection", f"{len(paths)} empty files")
    return _table_of(frames, truth.kinds, rows, score=np.array(scores, float))


def _table_of(
    frames: Sequence[str], kinds: Sequence[str], rows: Sequence[tuple[int, int, list[float]]], **columns: Any
) -> LabelTable:
    boxes = np.array([box for _, _, box in rows], float).reshape(-1, 4)
    table = LabelTable.of(frames, kinds, [r[0] for r in rows], [r[1] for r in rows], boxes, "xywh", **columns)
    return _with(table, area=boxes[:, 2] * boxes[:, 3])


# ---- Virtual KITTI, runs ----


def _virtual(path: Path, how: Reading) -> LabelTable:
    dataset: Vkitti1Dataset | Vkitti2Dataset
    first = (how.layout or layout_of(path)) == "vkitti1"
    dataset = Vkitti1Dataset(path) if first else Vkitti2Dataset(path)
    things = [(i, thing) for i, name in enumerate(dataset.identifiers) for thing in dataset.objects(name)]
    kinds = sorted({thing.kind for _, thing in things if thing.labelled})
    sizes = np.tile(np.array([SIZE_HW[1], SIZE_HW[0]], np.int64), (len(dataset.identifiers), 1))
    if not first:
        sizes[:] = 0
    return LabelTable.of(
        dataset.identifiers,
        kinds,
        [i for i, _ in things],
        [kinds.index(thing.kind) if thing.labelled else REGION for _, thing in things],
        np.array([thing.box_ltrb for _, thing in things], float).reshape(-1, 4),
        "xyxy",
        truncation=np.array([thing.truncation for _, thing in things], float),
        occlusion=np.array([thing.occlusion for _, thing in things], np.int64),
        pose=np.array([_pose_of(thing) for _, thing in things], float).reshape(-1, 7),
        sizes_wh=sizes,
        extra={
            "track": [thing.track for _, thing in things],
            "visible": [thing.visible for _, thing in things],
            "model": [thing.model for _, thing in things],
            "paint": [thing.paint for _, thing in things],
            "moving": [thing.moving for _, thing in things],
            "kind": [thing.kind for _, thing in things],
            "pixels": [None if first else thing.pixels for _, thing in things],
            "world": [_finite(thing.world) for _, thing in things],
            "world_yxz": [_finite(thing.world_yxz) for _, thing in things],
        },
    )


def _finite(values: tuple[float, float, float]) -> list[float] | None:
    return list(values) if all(map(math.isfinite, values)) else None


def _pose_of(thing: TrackedObject) -> list[float]:
    return [*thing.size_lhw, *thing.translation, thing.yaw]


def _run(path: Path, how: Reading) -> LabelTable:
    paths = sorted((path / "frames").glob(f"*/{RESULT}"))
    if not paths:
        raise FormatError(str(path / "frames"), f"frames with {RESULT}", "none")
    if how.stage not in STAGES:
        raise RangeError("stage", f"one of {', '.join(STAGES)}", how.stage)
    results = [load_frame(file) for file in paths]
    records: list[tuple[int, BoxRecord]] = []
    for i, result in enumerate(results):
        if how.scores:
            of_stage = {"benign": result.detections_benign, "rerendered": result.detections_rerendered}
            chosen = of_stage.get(how.stage, result.detections_attacked)
        else:
            chosen = result.targets_moved if how.stage == "attacked" else result.targets_benign
        records += [(i, record) for record in chosen]
    kinds = sorted({record.label for _, record in records})
    return LabelTable.of(
        [result.identifier for result in results],
        kinds,
        [i for i, _ in records],
        [kinds.index(record.label) for _, record in records],
        np.array([record.xyxy for _, record in records], float).reshape(-1, 4),
        "xyxy",
        ignore=np.array([record.ignore for _, record in records], np.bool_),
        score=np.array([math.nan if r.score is None else r.score for _, r in records], float),
    )


def with_sizes(table: LabelTable, images: Path) -> LabelTable:
    """The table with image sizes from the headers of `images/IDENTIFIER.png` (or .jpg), where it has none."""
    sizes = table.sizes_wh.copy()
    for i, name in enumerate(table.frames):
        if not sizes[i].all():
            found = [file for s in IMAGE_SUFFIXES if (file := images / f"{name}{s}").is_file()]
            if not found:
                raise FormatError(str(images / f"{name}.png"), "an image, for its size", "none")
            sizes[i] = size_of_image(found[0])
    return _with(table, sizes_wh=sizes)
