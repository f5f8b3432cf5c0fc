"""Labels or detections of many frames in columns, as every layout's reader makes them and its writer takes them:
each value as its file has it, in float64, and nothing of images. A frame's `Labels` are made of them.

**Boxes without an area.** A box may end where it begins (left == right): a thin object that fills one column of
pixels, or a detection that was cut at the image's edge. Every layout reads such boxes. None can be met: as a label
it is a miss, as a detection a false positive, as pycocotools and KITTI's development kit count; what a detector is
trained on ignores it (`ClassMap.targets`). A box that ends before it begins is a mistake, and refused.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from scene_ir.errors import FormatError

if TYPE_CHECKING:  # torch takes a second to load, and most of what reads label files needs none
    from torch import Tensor

    from scene_ir.types import Labels

Edges = Literal["xyxy", "xywh"]
"""How boxes are held: left, top, right, bottom where pixel centres are whole numbers (KITTI), or left, top, width,
height where pixel edges are (COCO)."""
REGION = -1
"""Kind of a region in which nothing is judged (DontCare)."""
HALF_PX = 0.5
"""From pixel centres at whole numbers to COCO's pixel edges at whole numbers."""
DECIMALS = 9
"""Of px, after a change of edges: the noise of a sum of decimals lies far below."""
UNKNOWN_OCCLUSION = 3
"""KITTI's own code for an occlusion that is not known, which `Labels` have too."""
WEATHERS = ("clone", "fog", "morning", "overcast", "rain", "sunset")
"""Virtual KITTI's variations that are weather or time of day; the others turn the camera."""


def to_coco(boxes_xyxy: NDArray[np.float64]) -> NDArray[np.float64]:
    """x, y, width, height (..., 4) in COCO's pixels of left, top, right, bottom."""
    low, high = boxes_xyxy[..., :2], boxes_xyxy[..., 2:]
    return np.concatenate([low + HALF_PX, high - low], axis=-1)


def from_coco(boxes_xywh: NDArray[np.float64]) -> NDArray[np.float64]:
    """Left, top, right, bottom (..., 4) of x, y, width, height in COCO's pixels."""
    low, size = boxes_xywh[..., :2] - HALF_PX, boxes_xywh[..., 2:]
    return np.concatenate([low, low + size], axis=-1)


@dataclass(frozen=True, slots=True)
class LabelTable:
    """N boxes of F frames, by frame, then in file order.

    frames: identifiers. kinds: types that occur or may. frame, kind (N,): indices into them, kind REGION for
    DontCare. boxes (N, 4) float64 px in `edges`; ignore (N,): crowds and regions. score (N,), NaN for labels;
    truncation (N,), -1 where unknown; occlusion (N,) 0 to 3, -1 where unknown; alpha (N,) rad, NaN where unknown;
    pose (N, 7): length, height, width, x, y, z m, yaw rad, NaN where unknown; area (N,) px^2, NaN where unknown.
    sizes_wh (F, 2) px, 0 where unknown; image_ids (F,), box_ids (N,), kind_ids: COCO's ids, where known, of images
    also texts.
    extra: further columns (N) by name, None where a box has none; cameras: by frame, COCO's "camera" entries;
    image_files: by frame, where its image lies if it is not named after the frame; told: by frame, what else is
    known of it, as JSON.
    """

    frames: tuple[str, ...]
    kinds: tuple[str, ...]
    frame: NDArray[np.int64]
    kind: NDArray[np.int64]
    boxes: NDArray[np.float64]
    edges: Edges
    ignore: NDArray[np.bool_]
    score: NDArray[np.float64]
    truncation: NDArray[np.float64]
    occlusion: NDArray[np.int64]
    alpha: NDArray[np.float64]
    pose: NDArray[np.float64]
    area: NDArray[np.float64]
    sizes_wh: NDArray[np.int64]
    image_ids: NDArray[np.int64] | NDArray[np.str_] | None = None
    box_ids: NDArray[np.int64] | None = None
    kind_ids: NDArray[np.int64] | None = None
    extra: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    cameras: Mapping[int, Any] = field(default_factory=dict)
    image_files: Mapping[int, str] = field(default_factory=dict)
    told: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def of(
        cls,
        frames: Sequence[str],
        kinds: Sequence[str],
        frame: Sequence[int] | NDArray[np.int64],
        kind: Sequence[int] | NDArray[np.int64],
        boxes: NDArray[np.float64],
        edges: Edges,
        **columns: Any,
    ) -> LabelTable:
        """A table in which all that is not given is unknown."""
        n = len(boxes)
        kind = np.asarray(kind, np.int64)
        unknown: dict[str, Any] = {
            "ignore": kind == REGION,
            "score": np.full(n, np.nan),
            "truncation": np.full(n, -1.0),
            "occlusion": np.full(n, -1, np.int64),
            "alpha": np.full(n, np.nan),
            "pose": np.full((n, 7), np.nan),
            "area": np.full(n, np.nan),
            "sizes_wh": np.zeros((len(frames), 2), np.int64),
        }
        frame = np.asarray(frame, np.int64)
        return cls(tuple(frames), tuple(kinds), frame, kind, boxes, edges, **(unknown | columns))

    def in_edges(self, edges: Edges) -> LabelTable:
        """The same boxes in other edges; areas, which COCO measures in its own way, are kept."""
        if edges == self.edges:
            return self
        boxes = to_coco(self.boxes) if edges == "xywh" else from_coco(self.boxes)
        return replace(self, boxes=np.round(boxes, DECIMALS), edges=edges)

    def rows(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> LabelTable:
        """Some of the boxes, ascending by frame; all frames are kept."""
        columns = ("frame", "kind", "boxes", "ignore", "score", "truncation", "occlusion", "alpha", "pose", "area")
        index = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
        return replace(
            self,
            **{name: getattr(self, name)[index] for name in columns},
            box_ids=None if self.box_ids is None else self.box_ids[index],
            extra={name: [values[i] for i in index.tolist()] for name, values in self.extra.items()},
        )

    def over(self, frames: Sequence[str]) -> LabelTable:
        """The boxes of other frames: those of `frames` that the table does not know have none; those of its own
        that are not among them are left out.
        """
        place = {name: i for i, name in enumerate(frames)}
        new = np.array([place.get(name, -1) for name in self.frames], np.int64)
        index = np.flatnonzero(new[self.frame] >= 0) if len(self) else np.zeros(0, np.int64)
        index = index[np.argsort(new[self.frame[index]], kind="stable")]
        kept = self.rows(index)
        old = np.flatnonzero(new >= 0)
        sizes = np.zeros((len(frames), 2), np.int64)
        sizes[new[old]] = self.sizes_wh[old]
        ids = None
        if self.image_ids is not None and len(old) == len(frames):
            ids = np.zeros(len(frames), self.image_ids.dtype)
            ids[new[old]] = self.image_ids[old]
        return replace(
            kept,
            frames=tuple(frames),
            frame=new[kept.frame],
            sizes_wh=sizes,
            image_ids=ids,
            cameras={int(new[i]): camera for i, camera in self.cameras.items() if new[i] >= 0},
            image_files={int(new[i]): name for i, name in self.image_files.items() if new[i] >= 0},
            told={int(new[i]): words for i, words in self.told.items() if new[i] >= 0},
        )

    def labels(self) -> Labels:
        """All boxes as a scene takes them, float32: objects in file order, and what is ignored as regions. Unknown
        are NaN, and an occlusion of 3.
        """
        import torch

        from scene_ir.types import Labels

        boxes = torch.from_numpy(self.boxes if self.edges == "xyxy" else from_coco(self.boxes)).float()
        objects = ~self.ignore
        pose = torch.from_numpy(self.pose[objects]).float()
        truncation, occlusion = self.truncation[objects], self.occlusion[objects]
        return Labels(
            kind=tuple(self.kinds[k] for k in self.kind[objects].tolist()),
            boxes_xyxy=boxes[torch.from_numpy(objects)],
            truncation=torch.from_numpy(np.where(truncation < 0, np.nan, truncation)).float(),
            occlusion=torch.from_numpy(np.where(occlusion < 0, UNKNOWN_OCCLUSION, occlusion)),
            translation=pose[:, 3:6].clone(),
            yaw=pose[:, 6].clone(),
            size_lhw=pose[:, :3].clone(),
            ignore_xyxy=boxes[torch.from_numpy(self.ignore)],
        )

    def weather(self) -> list[str | None]:
        """Virtual KITTI's variation in a frame's identifier, where that says something of the weather."""
        parts = [name.replace("_", "/").split("/") for name in self.frames]
        return [next((word for word in words if word in WEATHERS), None) for words in parts]

    # ---- what writers of any layout ask ----

    @property
    def scored(self) -> bool:
        """Whether these are detections: there is something besides regions, and all of it has a score."""
        scores = self.score[self.kind != REGION]
        return len(scores) > 0 and bool(np.isfinite(scores).all())

    def by_frame(self) -> list[range]:
        """The rows of each frame."""
        ends = np.cumsum(np.bincount(self.frame, minlength=len(self.frames))).tolist()
        return [range(a, b) for a, b in zip([0, *ends], ends, strict=False)]

    def known(self) -> dict[str, NDArray[np.bool_]]:
        """Which boxes (N,) have a value, by field."""
        found = {
            "truncation": self.truncation >= 0,
            "occlusion": self.occlusion >= 0,
            "alpha": np.isfinite(self.alpha),
            "3D box": np.isfinite(self.pose).all(axis=1),
            "score": np.isfinite(self.score),
            "region": self.kind == REGION,
            "crowd": self.ignore & (self.kind != REGION),
        }
        columns = self.extra.items()
        return found | {name: np.array([v is not None for v in values], np.bool_) for name, values in columns}

    def lost(self, kept: Sequence[str], more: Mapping[str, int]) -> dict[str, int]:
        """Boxes by field that is not among `kept`, cameras, and what `more` counts."""
        counts = {name: int(rows.sum()) for name, rows in self.known().items() if name not in kept}
        return counts | ({} if "camera" in kept else {"camera": len(self.cameras)}) | dict(more)

    def file_names(self) -> tuple[list[str], dict[str, int]]:
        """Identifiers as file names, and how many had to change, as a loss."""
        names = ["_".join(name.split("/")) for name in self.frames]
        if len(set(names)) != len(names):
            raise FormatError("frames", "names that differ when / becomes _", "two alike")
        return names, {"/ in frame names": sum(a != b for a, b in zip(names, self.frames, strict=True))}

    def need_sizes(self, layout: str) -> None:
        """FormatError where the size of an image is not known."""
        missing = int((self.sizes_wh <= 0).any(axis=1).sum())
        if missing:
            expected = "--images FOLDER or --image-size WIDTHxHEIGHT"
            raise FormatError(f"{layout}: image sizes", expected, f"none for {missing} frames")


@dataclass(frozen=True, slots=True)
class Written:
    """What became of a table. files: how many were written; lost: boxes (or frames) by field that the layout has
    no place for; assumed: those for which a value had to be made up, by field.
    """

    files: int
    lost: Mapping[str, int]
    assumed: Mapping[str, int]

    @classmethod
    def of(cls, files: int, lost: Mapping[str, int], assumed: Mapping[str, int] | None = None) -> Written:
        """Counts of 0 are left out."""
        kept = ({name: int(count) for name, count in c.items() if count} for c in (lost, assumed or {}))
        return cls(files, *kept)


def copy_images(targets: Mapping[str, Path], images: Mapping[str, Path], only: str | None = None) -> int:
    """Copy each frame's image to its place, which has no suffix yet; how many. FormatError for all but `only`."""
    for identifier, source in images.items():
        target, suffix = targets[identifier], source.suffix.lower()
        if only not in (None, suffix):
            raise FormatError(str(source), f"a {only} image", source.suffix or "none")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target.with_name(target.name + suffix))
    return len(images)


def number_text(value: float) -> str:
    """Two decimals as KITTI writes where they are enough, else all that are needed."""
    value += 0.0  # no "-0.00"
    text = f"{value:.2f}"
    return text if float(text) == value else positional(value)


def positional(value: float) -> str:
    """The shortest decimals that read back as the same number, without an exponent."""
    return np.format_float_positional(value, trim="-")


def matrix_of(camera: Any) -> NDArray[np.float64]:
    """The projection (3, 4) px of a COCO "camera" entry of this project. FormatError for another's."""
    told = camera if isinstance(camera, dict) else {}
    if "projection" in told:
        values = told["projection"]
    else:
        fx, fy, cx, cy = (told.get(k) for k in ("fx", "fy", "cx", "cy"))
        values = [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]
    good = isinstance(values, list) and all(type(v) in (int, float) and math.isfinite(v) for v in values)
    if not good or len(values) != 12:
        raise FormatError("camera", "projection (12 numbers), or fx, fy, cx, cy", repr(camera))
    return np.array(values, np.float64).reshape(3, 4)


def camera_entry(projection: Tensor) -> dict[str, Any]:
    """COCO's "camera" entry of a projection (3, 4) px."""
    values = shortest(projection)
    places = {"fx": 0, "fy": 5, "cx": 2, "cy": 6}
    return {**{name: values[i] for name, i in places.items()}, "projection": values}


def shortest(values: Tensor) -> list[float]:
    """float32 values as the shortest decimals that read back as the same float32."""
    return [float(str(v)) for v in values.float().flatten().numpy()]


def known_pose(pose: Sequence[float]) -> bool:
    """Whether a row of `pose` is known."""
    return all(map(math.isfinite, pose))
