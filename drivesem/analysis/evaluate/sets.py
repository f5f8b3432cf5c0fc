"""Reads and aligns labels and detections for `drivesem eval`: the same frames, classes and box edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.config.commands import EvalConfig
from drivesem.config.constraints import parse_attributes, parse_class_map
from drivesem.config.errors import UsageError
from drivesem.data.account import write_account
from drivesem.data.classes import object_type
from drivesem.data.kitti_labels import TYPES
from drivesem.data.label_table import REGION, LabelTable
from drivesem.data.subsets import select_by_attributes
from drivesem.evaluation import kitti
from drivesem.evaluation.instances import DetectionTable, GroundTruthTable, boxes_from_xywh, boxes_from_xyxy
from drivesem.report.tables import format_count
from drivesem.run.labels import detect_labels_layout, read_labels
from drivesem.store import local_copy
from scene_ir import files

_MAX_LISTED = 3
_KITTI_TYPES = tuple(kind for kind in TYPES if kind != "DontCare")


@dataclass(frozen=True, slots=True)
class EvaluationData:
    """Labels, and one or two sets of detections."""

    frames: tuple[str, ...]
    """Names of the frames."""
    classes: tuple[str, ...]
    """Class names; labels are indices into them."""
    truths: GroundTruthTable
    """Labels."""
    found: list[DetectionTable]
    """One or two sets of detections."""
    truth_ids: np.ndarray | None
    """Ids of the labels in their file (M,), if it has them."""
    weather: tuple[str | None, ...]
    """Weather of each frame, if known."""
    notes: tuple[str, ...] = ()
    """Remarks on the evaluation."""
    attributes: tuple[Mapping[str, str], ...] = ()
    """Attributes of each frame."""
    account: Mapping[str, Any] = field(default_factory=dict)
    """Files and rows of the labels, as JSON."""


def load_evaluation_data(config: EvalConfig) -> EvaluationData:
    """Read labels and detections, and map their classes.

    Raises UsageError or FormatError for frames that do not match, unmapped classes, invalid scores, or no
    detections.
    """
    gt_path = local_copy(config.gt or "", "--gt")
    paths = [local_copy(p, "--pred") for p in (config.pred, config.pred_b) if p is not None]
    gt_layout = detect_labels_layout(gt_path) if config.gt_format == "auto" else config.gt_format
    truth = read_labels(gt_path, gt_layout, stage=config.stage)
    account = truth.account
    wanted = _wanted(config, truth)
    gt_known = _known(gt_layout, truth)
    stages = (config.stage, config.stage_b or config.stage)
    tables: list[LabelTable] = []
    for path, stage in zip(paths, stages, strict=False):
        layout = detect_labels_layout(path) if config.pred_format == "auto" else config.pred_format
        table = read_labels(path, layout, scored=True, stage=stage, truth=truth)
        # KITTI and runs have a file for every frame; in other layouts a frame without detections has none
        needed = (wanted or truth.frames) if layout in ("kitti", "run") else ()
        table = _aligned(table, truth, path, needed)
        tables.append(table)
    if wanted is not None:
        truth, tables = truth.reindex(wanted), [table.reindex(wanted) for table in tables]
    else:
        tables = [t if t.frames == truth.frames else t.reindex(truth.frames) for t in tables]
    classes = _classes(config, truth, tables, gt_known)
    chosen = _chosen(config, classes)
    truths, ids = _truths(
        _renamed(truth, parse_class_map("--map-gt", config.map_gt), classes, gt_path, "--map-gt"), chosen
    )
    found = [
        _found(
            _renamed(table, parse_class_map("--map", config.map), classes, path, "--map").with_box_format(
                truth.box_format
            ),
            chosen,
        )
        for table, path in zip(tables, paths, strict=True)
    ]
    judged = tuple(classes) if chosen is None else tuple(chosen)
    if truths.ignore.all():
        raise UsageError(str(gt_path), f"objects of {', '.join(judged) or 'some class'} to evaluate", "none")
    return EvaluationData(
        truth.frames,
        judged,
        truths,
        found,
        ids,
        tuple(truth.weather()),
        _notes(config, truths),
        _attributes(truth),
        write_account(account, roles=False),
    )


def _known(layout: str, truth: LabelTable) -> tuple[str, ...]:
    """Return the classes that a layout defines, and those that occur."""
    fixed: tuple[str, ...] = _KITTI_TYPES if layout in ("kitti", "vkitti1", "vkitti2") else ()
    if layout == "run":
        from detectors.types import CLASSES

        fixed = CLASSES
    return tuple(dict.fromkeys((*fixed, *truth.kinds)))


def _wanted(config: EvalConfig, truth: LabelTable) -> tuple[str, ...] | None:
    if config.where is not None:
        attributes = dict(zip(truth.frames, _attributes(truth), strict=True))
        return tuple(select_by_attributes(attributes, parse_attributes("--where", config.where)))
    if config.frames is None:
        return None
    names = [line.strip() for line in files.read_text(Path(config.frames)).splitlines() if line.strip()]
    missing = sorted(set(names) - set(truth.frames))
    if missing or not names:
        raise UsageError("--frames", f"identifiers of {config.gt}", _some(missing) if missing else "none")
    return tuple(dict.fromkeys(names))


def _attributes(table: LabelTable) -> tuple[Mapping[str, str], ...]:
    """Return the attributes of each frame that are texts."""
    rows = (table.frame_attributes.get(i, {}) for i in range(len(table.frames)))
    return tuple({name: value for name, value in row.items() if isinstance(value, str)} for row in rows)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_MAX_LISTED]) + (f", ... ({len(names)} in all)" if len(names) > _MAX_LISTED else "")


def _aligned(table: LabelTable, truth: LabelTable, path: Path, needed: Sequence[str]) -> LabelTable:
    """The table, if its frames are labelled ones, and those `needed` among them. Files name them with _ for /."""
    flat = {"_".join(name.split("/")): name for name in truth.frames}
    if not set(table.frames) <= set(truth.frames) and set(table.frames) <= set(flat):
        table = replace(table, frames=tuple(flat[name] for name in table.frames))
    others = sorted(set(table.frames) - set(truth.frames))
    if others:
        raise UsageError(str(path), f"ids of the {len(truth.frames)} labelled frames", f"{_some(others)}")
    missing = sorted(set(needed) - set(table.frames))
    if missing:
        raise UsageError(
            str(path), "detections of every labelled frame (or --frames)", f"none of {_some(missing)}"
        )
    return table


def _classes(
    config: EvalConfig, truth: LabelTable, tables: Sequence[LabelTable], known: Sequence[str]
) -> tuple[str, ...]:
    """All class names after mapping. For KITTI its types; else those of the labels, and of detections by them."""
    if config.protocol == "kitti":
        return _KITTI_TYPES
    mapping = parse_class_map("--map-gt", config.map_gt)
    names = [mapping.get(kind, kind) for kind in truth.kinds]
    allowed = {mapping.get(kind, kind) for kind in known} | set(names)
    own = parse_class_map("--map", config.map)
    detected = {own.get(kind, kind) for table in tables for kind in _used(table)}
    extra = sorted(name for name in detected if name is not None and name in allowed and name not in names)
    return tuple(dict.fromkeys(name for name in (*names, *extra) if name is not None))


def _used(table: LabelTable) -> list[str]:
    """Return the classes that occur."""
    return [table.kinds[i] for i in np.unique(table.kind[table.kind >= 0]).tolist()]


def _chosen(config: EvalConfig, classes: Sequence[str]) -> tuple[str, ...] | None:
    if config.classes is None:
        return None
    names = parse_class_list(config.classes)
    for name in names:
        if name not in classes:
            raise UsageError("--classes", f"some of {', '.join(classes)}", repr(name))
    # KITTI's neighbouring classes must stay: its own rules leave out what is not judged
    return None if config.protocol == "kitti" else names


def parse_class_list(text: str) -> tuple[str, ...]:
    """Parse "Car,Van" into unique names."""
    return tuple(dict.fromkeys(word.strip() for word in text.split(",")))


def _renamed(
    table: LabelTable, mapping: Mapping[str, str | None], classes: Sequence[str], path: Path, option: str
) -> LabelTable:
    """Rename classes, and drop the boxes of excluded ones.

    Args:
        table: The boxes.
        mapping: New names of classes; None excludes a class.
        classes: Classes of the result.
        path: File of the table, for errors.
        option: Option of the mapping, for errors.
    """
    index = {name.lower(): i for i, name in reversed(list(enumerate(classes)))}
    exact = {name: i for i, name in enumerate(classes)}
    types = [object_type(name) for name in classes]
    meant = {kind: i for i, kind in enumerate(types) if kind is not None and types.count(kind) == 1}
    unknown = sorted(set(mapping) - set(table.kinds))
    if unknown and not set(mapping) & set(table.kinds):
        raise UsageError(option, f"classes of {path} ({', '.join(table.kinds) or 'none'})", _some(unknown))
    out = len(classes)
    places = np.full(len(table.kinds) + 1, REGION)
    for i, kind in enumerate(table.kinds):
        name = mapping.get(kind, kind)
        if name is None:
            places[i] = out
            continue
        # letter case decides only where two classes differ by nothing else, synonyms only where names do not match
        place = exact.get(name, index.get(name.lower(), meant.get(object_type(name))))
        if place is None:
            if not (table.kind == i).any():
                place = out
            else:
                expected = f"one of {', '.join(classes) or 'none'}, or {option} {kind}=CLASS (or {kind}=-)"
                raise UsageError(
                    f"{path}: class {kind!r}",
                    expected,
                    f"{format_count(int((table.kind == i).sum()), 'box', 'boxes')} of it",
                )
        places[i] = place
    kind = places[table.kind]  # REGION, -1, is the last place
    table = replace(table, kinds=tuple(classes), kind=kind)
    return table.select(kind != out) if (kind == out).any() else table


def _selection(
    kind: np.ndarray, kinds: Sequence[str], chosen: Sequence[str] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return which boxes belong to a selected class or a region, and their labels among the selected classes."""
    if chosen is None:
        return np.ones(len(kind), np.bool_), kind
    places = np.full(len(kinds) + 1, len(chosen))
    places[-1] = REGION
    for i, name in enumerate(chosen):
        places[kinds.index(name)] = i
    labels = places[kind]
    return labels != len(chosen), labels


def _truths(table: LabelTable, chosen: Sequence[str] | None) -> tuple[GroundTruthTable, np.ndarray | None]:
    keep, labels = _selection(table.kind, table.kinds, chosen)
    boxes = boxes_from_xywh(table.boxes) if table.box_format == "xywh" else boxes_from_xyxy(table.boxes)
    truths = GroundTruthTable(
        frames=len(table.frames),
        frame=table.frame,
        label=labels,
        boxes=boxes,
        ignore=table.ignore,
        truncation=table.truncation,
        occlusion=table.occlusion,
        distance_m=np.hypot(table.pose[:, 3], table.pose[:, 5]),
        area=np.where(np.isnan(table.area), boxes[:, 4] * boxes[:, 5], table.area),
    )
    ids = table.box_ids
    return (truths, ids) if keep.all() else (truths.select(keep), None if ids is None else ids[keep])


def _found(table: LabelTable, chosen: Sequence[str] | None) -> DetectionTable:
    keep, labels = _selection(table.kind, table.kinds, chosen)
    boxes = boxes_from_xywh(table.boxes) if table.box_format == "xywh" else boxes_from_xyxy(table.boxes)
    return DetectionTable(table.frame, labels, boxes, table.score).select(keep & (labels >= 0))


def _notes(config: EvalConfig, truths: GroundTruthTable) -> tuple[str, ...]:
    """Return remarks on the evaluation."""
    notes: list[str] = []
    if config.protocol == "kitti":
        unknown = int(((truths.occlusion < 0) & ~truths.ignore & (truths.label >= 0)).sum())
        if unknown:
            notes.append(
                format_count(
                    unknown,
                    "object without occlusion counts as visible",
                    "objects without occlusion count as visible",
                )
            )
        unknown = int(((truths.truncation < 0) & ~truths.ignore & (truths.label >= 0)).sum())
        if unknown:
            notes.append(
                format_count(
                    unknown,
                    "object without truncation counts as whole",
                    "objects without truncation count as whole",
                )
            )
        judged = ", ".join(kitti.CLASSES)
        notes.append(
            f"evaluated classes: {judged}; detections below the minimum height: {config.small_detections}"
        )
    return tuple(notes)
