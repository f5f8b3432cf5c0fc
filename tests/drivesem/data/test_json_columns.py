"""Columns of COCO annotations: the same rows as dicts, and refusal of what they cannot hold."""

import json
from pathlib import Path
from typing import Any

import pytest

from drivesem.data.coco_labels import CocoFiles
from drivesem.data.json_columns import BoxRowColumns

ROWS: list[dict[str, Any]] = [
    {"id": 1, "image_id": 7, "category_id": 1, "bbox": [1.5, 2.5, 3.25, 4.0], "area": 13, "iscrowd": 0},
    {"id": 2, "image_id": 7, "category_id": 1, "bbox": [1.0, 2.0, 3.0, 4.0], "iscrowd": 1, "track": None},
    {"id": 3, "image_id": 8, "category_id": 1, "bbox": [0.0, 0.0, 1.0, 1.0], "attributes": {"occluded": True}},
]


def _parse(rows: Any) -> tuple[BoxRowColumns, Any]:
    columns = BoxRowColumns()
    return columns, json.loads(json.dumps(rows), object_hook=columns.store)


def test_rows_and_columns() -> None:
    columns, parsed = _parse(ROWS)
    assert columns.holds(parsed)
    assert list(columns) == ROWS
    assert columns[1:] == ROWS[1:]
    assert columns.key_names() == set().union(*ROWS)
    for key in columns.key_names():
        assert columns.column(key, None) == [row.get(key) for row in ROWS]
    assert columns.boxes().tolist() == [row["bbox"] for row in ROWS]


@pytest.mark.parametrize(
    "rows",
    [
        [],
        [*ROWS, {"id": 4, "image_id": 8}],
        [*ROWS, {"id": 4, "image_id": 8, "bbox": [1, 2, 3]}],
        [*ROWS, {"id": 4, "image_id": 8, "bbox": [1, 2, 3, True]}],
        [*ROWS, {"id": 4, "image_id": 8, "bbox": [10**400, 2, 3, 4]}],
        [*ROWS[:2], {"other": ROWS[2]}],
        ROWS[0],
    ],
)
def test_other_lists_are_not_held(rows: Any) -> None:
    columns, parsed = _parse(rows)
    assert not columns.holds(parsed)


def test_rows_in_another_row_are_read_as_values(tmp_path: Path) -> None:
    rows = [{**ROWS[0], "image_id": 1, "attributes": {"before": ROWS[1]}}]
    content = {"images": [{"id": 1, "width": 9, "height": 9}], "categories": [{"id": 1, "name": "Car"}]}
    (tmp_path / "a.json").write_text(json.dumps({**content, "annotations": rows}))
    table = CocoFiles(tmp_path / "a.json").to_table(False)
    assert table.extra["attributes"] == [{"before": ROWS[1]}]
    assert table.boxes.tolist() == [[1.5, 2.5, 3.25, 4.0]]
