"""Holes for people and programs: a table, JSON, CSV, Markdown and a plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from drivesem.analysis.holes.merged import Hole, Recheck
from drivesem.analysis.holes.plots import write_holes
from drivesem.report.answer import Answer
from drivesem.report.tables import Sheet

_NONE = "No certain failure of an object in these runs: nothing to look around."
_NOTES = (
    "Lost: share of fresh samples inside of the rule in which the object is not found, with Wilson's 95 % "
    "interval. Elsewhere: the same of samples outside of it. Size: share of the whole neighbourhood, of what "
    "the run could change, in which the object is lost, inside of the rule or not, with a 95 % interval; by "
    "subset simulation where that is rare. The neighbourhood is that of one object with all others as found.",
    "Features: height_px, aspect (width by height), across (0 left, 1 right) of the label's box; lightness and "
    "contrast of the picture in it; distance_m; yaw_deg; codes of paint, weather and foliage. A rule names what "
    "tells failures best from the rest; what goes along with it may be the reason.",
)


_CHECKED = (
    "Again: the same share in draws by seeds that neither the rule nor its probability knew. A hole holds where "
    "chance alone may explain the difference of the two shares: its 95 % interval, of both Wilson intervals after "
    "Newcombe, has 0 in it. One in twenty does not hold though its probability is right. {hold} of {count} hold."
)


def answer_of(out: Path, holes: Sequence[Hole], facts: Mapping[str, Any], failed: Mapping[str, str]) -> Answer:
    """What is said of all frames. facts: what stands before the holes in the JSON."""
    checks = [hole.recheck for hole in holes if hole.recheck is not None]
    lines = tuple(
        (
            hole.words,
            hole.label,
            "-"
            if hole.probability is None
            else f"{100 * hole.probability:.0f} [{_percent(hole.low)}, {_percent(hole.high)}]",
            "-" if hole.outside is None else f"{100 * hole.outside:.0f}",
            f"{100 * hole.lost.probability:.2g} [{100 * hole.lost.low:.2g}, {100 * hole.lost.high:.2g}]",
            str(len(hole.failures)),
            str(len(hole.frames)),
            *((_again(hole.recheck),) if checks else ()),
        )
        for hole in holes
    )
    columns = ("where", "class", "lost, %", "elsewhere, %", "size, %", "failures", "frames")
    columns += ("again, %",) if checks else ()
    hold = sum(check.holds for check in checks)
    told = (_CHECKED.format(hold=hold, count=len(checks)),) if checks else ()
    title = f"Holes of {facts['detector']}, within {facts['params']}"
    return Answer(
        out=out,
        name="holes",
        heading="Holes",
        data={**facts, "rechecked": len(checks), "hold": hold, "holes": [hole.to_json() for hole in holes]},
        tables={"holes": [_flat(hole) for hole in holes]} if holes else {},
        sheets=[Sheet(title, columns, lines)],
        notes=(*_NOTES, *told) if holes else (_NONE,),
        words=("where", "class"),
        picture=partial(write_holes, holes=holes) if holes else None,
        failed=failed,
    )


def _again(check: Recheck | None) -> str:
    if check is None:
        return "-"
    low, high = check.interval
    share = f"{100 * check.probability:.0f} [{_percent(low)}, {_percent(high)}]"
    return f"{share} {'holds' if check.holds else 'does not hold'}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f}"


def _flat(hole: Hole) -> dict[str, Any]:
    check = hole.recheck
    return {
        "where": hole.words,
        "class": hole.label,
        "probability": hole.probability,
        "low": hole.low,
        "high": hole.high,
        "samples": hole.count,
        "again": None if check is None else check.probability,
        "again_draws": None if check is None else check.again[1],
        "holds": None if check is None else check.holds,
        "outside": hole.outside,
        "size": hole.lost.probability,
        "size_low": hole.lost.low,
        "size_high": hole.lost.high,
        "failures": "; ".join(hole.failures),
    }
