"""`drivesem eval --by`: recall by the attributes of frames, as a table, a CSV and a plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from drivesem.config.commands import EvalConfig
from drivesem.config.errors import UsageError
from drivesem.evaluation.conditions import ConditionRow, DetectedObjects, group_frames, recall_by_condition
from drivesem.reporting.plots import write_intervals
from drivesem.reporting.tables import ReportTable, cells_to_csv, format_percent
from scene_ir import files

CONDITION_COLUMNS = ("condition",)
"""Columns of text in the table of conditions; the others hold numbers."""
_FEW_OBJECTS = 30
"""Fewer objects are marked in the table, since their interval is wide."""


def measure_conditions(
    config: EvalConfig,
    objects: Mapping[str, DetectedObjects],
    attributes: Sequence[Mapping[str, str]],
    draws: int,
) -> list[ConditionRow]:
    """Compute recall by condition of each class.

    Args:
        config: `--by`, `--reference` and the seed.
        objects: Objects by class.
        attributes: Attributes of each frame.
        draws: Number of bootstrap draws.

    Raises:
        UsageError: No frame has one of the attributes, or the reference does not occur.
    """
    names = [name.strip() for name in (config.by or "").split(",")]
    known = sorted({name for values in attributes for name in values})
    for name in names:
        if name not in known:
            raise UsageError("--by", f"some of {', '.join(known) or 'no attribute'}", repr(name))
    groups = group_frames(attributes, names)
    reference = next(iter(groups))
    if config.reference is not None:
        reference = ", ".join(value.strip() for value in config.reference.split(","))
        if reference not in groups:
            raise UsageError("--reference", f"one of {'; '.join(groups)}", config.reference)
    generator = np.random.default_rng([config.seed, 8])
    rows: list[ConditionRow] = []
    for name, own in objects.items():
        found = recall_by_condition(own, len(attributes), groups, reference, draws, generator)
        rows += [replace(row, condition=f"{name}: {row.condition}") if len(objects) > 1 else row for row in found]
    return rows


def tabulate_conditions(rows: Sequence[ConditionRow]) -> ReportTable:
    """Make the table of conditions."""
    columns = (
        *CONDITION_COLUMNS,
        "frames",
        "objects",
        "median px",
        "recall",
        "95 %",
        "at equal heights",
        "95 %",
        "share",
    )
    title = f"Recall by condition, %; equal heights: those of {rows[0].condition}; *: under {_FEW_OBJECTS} objects"
    return ReportTable(title, columns, tuple(_cells(row) for row in rows))


def _cells(row: ConditionRow) -> tuple[str, ...]:
    few = "*" if row.objects < _FEW_OBJECTS else ""
    height = "-" if row.median_height is None else f"{row.median_height:.0f}"
    return (
        *(row.condition, str(row.frames), f"{row.objects}{few}", height),
        *(format_percent(row.recall), _range(row.low, row.high)),
        *(format_percent(row.equal_recall), _range(row.equal_low, row.equal_high), format_percent(row.covered)),
    )


def _range(low: float | None, high: float | None) -> str:
    return "-" if low is None or high is None else f"{100 * low:.1f} to {100 * high:.1f}"


def write_conditions(out: Path, rows: Sequence[ConditionRow]) -> None:
    """Write conditions.csv and conditions.png into a folder; nothing without rows."""
    if not rows:
        return
    sheet = tabulate_conditions(rows)
    files.write_text(out / "conditions.csv", cells_to_csv(sheet.columns, sheet.rows))
    known = [row for row in rows if row.equal_recall is not None]
    title = "Recall by condition, at equal box heights"
    values = [(row.equal_recall or 0.0, row.equal_low, row.equal_high) for row in known]
    names = [f"{row.condition} ({row.objects})" for row in known]
    write_intervals(out / "conditions.png", title, names, values, "recall, %")
