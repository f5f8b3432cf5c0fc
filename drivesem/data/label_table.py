"""Labels or detections of many frames in columns, as evaluation and conversion need them: every value as its file
has it, in float64, and nothing of images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from drivesem.data.coco import HALF_PX

Edges = Literal["xyxy", "xywh"]
"""How boxes are held: left, top, right, bottom where pixel centres are whole numbers (KITTI), or left, top, width,
height where pixel edges are (COCO)."""
REGION = -1
"""Kind of a region in which nothing is judged (DontCare)."""
DECIMALS = 9
"""Of px, after a change of edges: the noise of a sum of decimals lies far below."""
WEATHERS = ("clone", "fog", "morning", "overcast", "rain", "sunset")
"""Virtual KITTI's variations that are weather or time of day; the others turn the camera."""


@dataclass(frozen=True, slots=True)
class LabelTable:
    """N boxes of F frames, by frame, then in file order.

    frames: identifiers. kinds: types that occur or may. frame, kind (N,): indices into them, kind REGION for
    DontCare. boxes (N, 4) float64 px in `edges`; ignore (N,): crowds and regions. score (N,), NaN for labels;
    truncation (N,), -1 where unknown; occlusion (N,) 0 to 3, -1 where unknown; alpha (N,) rad, NaN where unknown;
    pose (N, 7): length, height, width, x, y, z m, yaw rad, NaN where unknown; area (N,) px^2, NaN where unknown.
    sizes_wh (F, 2) px, 0 where unknown; image_ids (F,), box_ids (N,), kind_ids: COCO's numbers, where known.
    extra: further columns (N) by name, None where a box has none; cameras: by frame, COCO's "camera" entries.
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
    image_ids: NDArray[np.int64] | None = None
    box_ids: NDArray[np.int64] | None = None
    kind_ids: NDArray[np.int64] | None = None
    extra: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    cameras: Mapping[int, Any] = field(default_factory=dict)

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
        low, high = self.boxes[:, :2], self.boxes[:, 2:]
        if edges == "xywh":
            boxes = np.concatenate([low + HALF_PX, high - low], axis=1)
        else:
            boxes = np.concatenate([low - HALF_PX, low - HALF_PX + high], axis=1)
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
            ids = np.zeros(len(frames), np.int64)
            ids[new[old]] = self.image_ids[old]
        return replace(
            kept,
            frames=tuple(frames),
            frame=new[kept.frame],
            sizes_wh=sizes,
            image_ids=ids,
            cameras={int(new[i]): camera for i, camera in self.cameras.items() if new[i] >= 0},
        )

    def weather(self) -> list[str | None]:
        """Virtual KITTI's variation in a frame's identifier, where that says something of the weather."""
        parts = [name.replace("_", "/").split("/") for name in self.frames]
        return [next((word for word in words if word in WEATHERS), None) for words in parts]
