"""Rows of a large JSON list of objects, stored by column."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

_STORED = object()
"""Stands for a stored row in the parsed JSON."""
_MISSING = object()
"""Value of a key that a row does not have."""


class BoxRowColumns(Sequence[Mapping[str, Any]]):
    """Objects with "image_id" and "bbox" of a JSON text, in a quarter of the memory of dicts.

    `store` is the object hook of the parser. Coordinates become float64.
    """

    def __init__(self) -> None:
        self._columns: dict[str, list[Any]] = {}
        self._boxes = array("d")
        self._count = 0
        self._layout: tuple[str, ...] = ()  # keys of the last row
        self._lists: list[list[Any]] = []  # columns of the last row
        self._image: Any = None
        self._regular = True

    def store(self, row: dict[str, Any]) -> Any:
        """Store a row and return a mark for it; return other objects, and all after an unusual box, unchanged."""
        if "image_id" not in row or "bbox" not in row or not self._regular:
            return row
        box = row.pop("bbox")
        if type(box) is not list or len(box) != 4 or not set(map(type, box)) <= {int, float}:
            self._regular = False
            return row
        try:
            self._boxes.extend(box)
        except OverflowError:
            self._regular = False
            return row
        if row["image_id"] == self._image and type(row["image_id"]) is type(self._image):
            row["image_id"] = self._image  # one object for all rows of an image
        self._image = row["image_id"]
        layout = tuple(row)
        if layout != self._layout:
            self._change_layout(layout)
        for values, value in zip(self._lists, row.values(), strict=True):
            values.append(value)
        self._count += 1
        return _STORED

    def _change_layout(self, layout: tuple[str, ...]) -> None:
        for key in {*self._columns, *layout}:
            values = self._columns.setdefault(key, [])
            values += [_MISSING] * (self._count - len(values))
        self._layout, self._lists = layout, [self._columns[key] for key in layout]

    def holds(self, rows: Any) -> bool:
        """Whether a parsed list consists of the stored rows, all of them."""
        same = isinstance(rows, list) and len(rows) == self._count > 0 and all(row is _STORED for row in rows)
        return same and self._regular

    def key_names(self) -> set[str]:
        """Return the keys that occur."""
        return {*self._columns, "bbox"}

    def column(self, key: str, missing: Any) -> list[Any]:
        """Return the values (N,) of a key, `missing` where a row has none."""
        if key == "bbox":
            return self.boxes().tolist()
        values = self._columns.get(key, [])
        rest = [missing] * (self._count - len(values))
        if key in self._layout and not rest and not any(value is _MISSING for value in values):
            return values
        return [missing if value is _MISSING else value for value in values] + rest

    def boxes(self) -> NDArray[np.float64]:
        """Return the boxes (N, 4) as written."""
        return np.array(self._boxes, np.float64).reshape(-1, 4)

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> dict[str, Any]: ...
    @overload
    def __getitem__(self, index: slice) -> list[dict[str, Any]]: ...
    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._count))]
        if not 0 <= index < self._count:
            raise IndexError(index)
        named = ((key, values[index]) for key, values in self._columns.items() if index < len(values))
        row = {key: value for key, value in named if value is not _MISSING}
        return row | {"bbox": self._boxes[4 * index : 4 * index + 4].tolist()}
