"""The matrix for people and programs: a table on the terminal, Markdown, CSV, a heat-map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from drivesem.analysis.transfer.matrix import AP50, CERTAIN, FRAMES, LOST, THRESHOLD, TRANSFER, TransferRow
from drivesem.analysis.transfer.plot import write_heatmap
from drivesem.attack.judging import HEADLINE
from drivesem.evaluation.resampling import Interval
from drivesem.report.answer import Answer
from drivesem.report.tables import Sheet, percent

_SHARES = {
    TRANSFER: "transfer rate",
    CERTAIN: "of certain",
    THRESHOLD: "of others",
    LOST: "lost anyway",
    FRAMES: "frames",
}
_SIDES = ("source", "target")
_LABELS = "labels"
"""Of the photographs (benign), or of the counterexamples by either label mode."""


def sheets(rows: Sequence[TransferRow]) -> list[Sheet]:
    """Two tables, %: precision and recall by picture and label mode; what falls and what transfers."""
    figures: list[tuple[str, ...]] = []
    shares: list[tuple[str, ...]] = []
    for row in rows:
        sides = (row.source.name, row.target.name)
        for name in ("benign", "paper", "moved"):
            scores = getattr(row, name)
            one = scores.headline
            values = (one.ap50, one.ap70, one.ap, scores.overall.ap50, one.recall, one.recall_at_t_star)
            figures.append((*sides, name, *map(percent, values)))
        fall = {mode: next(one for one in row.drops[mode] if one.name == AP50) for mode in row.drops}
        counted = [f"{bounded(row.shares[n])}\n{row.counts[n][0]} of {row.counts[n][1]}" for n in _SHARES]
        shares.append((*sides, bounded(fall["paper"]), bounded(fall["moved"]), *counted))
    scored = ("AP50", "AP70", "AP50:95", "mAP50", "recall", "recall at t*")
    fallen = ("AP50 falls, paper", "AP50 falls, moved")
    return [
        Sheet(f"{HEADLINE}, %", (*_SIDES, _LABELS, *scored), tuple(figures)),
        Sheet("transfer, %", (*_SIDES, *fallen, *_SHARES.values()), tuple(shares)),
    ]


def notes(rows: Sequence[TransferRow], draws: int) -> list[str]:
    """What the columns mean."""
    spread = f" In brackets: 95 % of {draws} draws of frames." if draws else ""
    stars = "; ".join(dict.fromkeys(f"{r.target.name}: t* {r.target.t_star:.3f}" for r in rows))
    return [
        "Labels: benign are the photographs, paper and moved the counterexamples by either label mode.",
        f"mAP50: mean over the target's classes; AP50 falls: benign less attacked.{spread}",
        "Transfer rate: of the objects that the source lost and the target found in the photograph, those that "
        "the target loses too; of certain, of others: the same of those that the source lost for certain, and of "
        "those that it lost by threshold alone. Lost anyway: of all that it found in the photograph, those it "
        "loses. Frames: of those that fail the source, those that fail the target. All by moved labels.",
        f"{stars}.",
    ]


def answer_of(
    out: Path, rows: Sequence[TransferRow], draws: int, failed: Mapping[str, str], data: Mapping[str, Any]
) -> Answer:
    """All that is written and printed of a transfer. failed: pictures that could not be used, and why."""
    figures, shares = sheets(rows)
    return Answer(
        out=out,
        name="transfer",
        heading="Transfer",
        data=data,
        tables={"transfer": [row.flat() for row in rows]},
        sheets=[figures, replace(shares, looks={"show_lines": True})],
        notes=notes(rows, draws),
        words=(*_SIDES, _LABELS),
        picture=partial(write_heatmap, rows=rows),
        failed=failed,
    )


def bounded(one: Interval) -> str:
    """A fraction and its bounds as percentages."""
    if one.value is None or one.low is None or one.high is None:
        return percent(one.value)
    return f"{100 * one.value:.1f} [{100 * one.low:.1f}, {100 * one.high:.1f}]"
