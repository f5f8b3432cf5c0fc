"""The matrix for people and programs: a table on the terminal, Markdown, CSV, a heat-map."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from drivesem.eval_report import percent
from drivesem.evaluation.resampling import Interval
from drivesem.judged import HEADLINE
from drivesem.transfer.matrix import AP50, FRAMES, LOST, TRANSFER, Row
from drivesem.transfer.plot import write_heatmap
from scene_ir import files

COLUMNS = (
    *("source", "target", "benign AP50", "paper AP50", "moved AP50", "moved AP70", "benign recall"),
    *("moved recall", "drop (moved)", "transfer rate", "lost anyway", "frames"),
)


def cells(row: Row) -> tuple[str, ...]:
    """One line of the table, in the order of COLUMNS; percentages."""
    drop = next(one for one in row.drops["moved"] if one.name == AP50)
    fallen = Interval(AP50, _less(drop.difference), _less(drop.high), _less(drop.low))
    return (
        row.run.name,
        row.target.name,
        *(percent(scores.headline.ap50) for scores in (row.benign, row.paper, row.moved)),
        percent(row.moved.headline.ap70),
        percent(row.benign.headline.recall_at_t_star),
        percent(row.moved.headline.recall_at_t_star),
        _bounded(fallen),
        *(f"{_bounded(row.shares[name])}, {row.counts[name][0]}/{row.counts[name][1]}" for name in _SHARES),
    )


_SHARES = (TRANSFER, LOST, FRAMES)


def notes(rows: Sequence[Row], draws: int) -> list[str]:
    """What the columns mean."""
    spread = f", in brackets 95 % of {draws} draws of frames" if draws else ""
    return [
        f"{HEADLINE}, %; recall at each target's own t*; drop: benign AP50 less attacked{spread}.",
        "Transfer rate: of the objects that the source lost and the target found in the photograph, those that the "
        "target loses too. Lost anyway: of all that it found in the photograph, those it loses. Frames: of those "
        "that fail the source, those that fail the target. All by moved labels.",
        "; ".join(dict.fromkeys(f"{r.target.name}: t* {r.target.t_star:.3f}" for r in rows)) + ".",
    ]


def print_rows(rows: Sequence[Row], draws: int, console: Console) -> None:
    """The table, and what it means."""
    table = Table(title="transfer", title_justify="left")
    for place, title in enumerate(COLUMNS):
        table.add_column(title, justify="left" if place < 2 else "right", overflow="fold")
    for row in rows:
        table.add_row(*cells(row))
    console.print(table)
    for note in notes(rows, draws):
        console.print(note, soft_wrap=True)


def write_report(out: Path, rows: Sequence[Row], draws: int) -> None:
    """transfer.md, transfer.csv and transfer.png."""
    flat = [row.flat() for row in rows]
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(flat[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    files.write_text(out / "transfer.csv", buffer.getvalue())
    lines = ["# Transfer", "", "![](transfer.png)", "", _line(COLUMNS), _line(("---",) * len(COLUMNS))]
    lines += [_line(cells(row)) for row in rows]
    lines += ["", *(f"{note}\n" for note in notes(rows, draws))]
    files.write_text(out / "transfer.md", "\n".join(lines))
    write_heatmap(out / "transfer.png", rows)


def _line(parts: Sequence[str]) -> str:
    return "| " + " | ".join(part.replace("|", "\\|") for part in parts) + " |"


def _bounded(one: Interval) -> str:
    if one.value is None or one.low is None or one.high is None:
        return percent(one.value)
    return f"{100 * one.value:.1f} [{100 * one.low:.1f}, {100 * one.high:.1f}]"


def _less(value: float | None) -> float | None:
    return None if value is None else -value
