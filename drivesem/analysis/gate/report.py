"""The gate for people and programs: tables, JSON, CSV, Markdown, and JUnit's XML, which CI servers show."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drivesem.analysis.gate.rows import ALL, HOLE, PHANTOMS, GateRow
from drivesem.report.answer import Answer
from drivesem.report.tables import Sheet, number_of
from scene_ir import files

_SHOWN = 12
"""Holes in the table on a terminal; the files have all."""
_NOTE = (
    "Lost: share of samples around a certain failure in which a detector does not find the object; both see "
    "the same pictures. Phantoms: share of these samples in which a detector reports something where nothing "
    "is, anywhere in the picture. In brackets: 95 % by paired bootstrap, over samples of a hole, and over "
    "holes for kinds, for all, and for phantoms. p: exact sign test of the samples in which one detector alone "
    "fails, Holm's over all rows. A row grew where the difference is above the tolerance, its interval above 0, "
    "and p below 0.05."
)
_NONE = "No certain failure of an object in these runs: nothing to compare, so the gate is passed."
_UNSEEN = "No sample in which the object of a certain failure counts: nothing compared, so the gate is not passed."


def answer_of(
    out: Path,
    rows: Sequence[GateRow],
    holes: int,
    facts: Mapping[str, Any],
    failed: Mapping[str, str],
    words: tuple[str, str] = ("lost", _NOTE),
) -> Answer:
    """The verdict, what is said, and gate.xml. holes: certain failures that were looked at, with samples or not;
    facts: what stands first in the JSON; failed: why, by frames that could not be compared: with one the gate is
    not passed; words: what a failure is called, and what figures mean.
    """
    verb, note = words
    files.write_text(out / "gate.xml", junit(rows, failed, verb))
    unseen = holes > 0 and not rows
    passed = not failed and not unseen and not any(row.grew for row in rows)
    own, others = ([r for r in rows if (r.level == HOLE) == is_hole] for is_hole in (True, False))
    verdict = "passed" if passed else "not passed"
    title = f"Gate {verdict}: {facts['after']} after {facts['before']}"
    notes = [note] if rows else [_UNSEEN] if unseen else [] if failed else [_NONE]
    if failed:
        notes.append(f"{number_of(len(failed), 'frame')} could not be compared, so the gate is not passed.")
    data = {"passed": passed, **facts, "out": str(out), "rows": [row.to_json() for row in rows]}
    return Answer(
        out=out,
        name="gate",
        heading=title,
        data={**data, "frames_failed": {**failed}},
        tables={"gate": [_flat(row) for row in rows]} if rows else {},
        sheets=[_sheet(title, [*others, *own], verb)],
        printed=[_sheet(title, [*others, *own[:_SHOWN]], verb)],
        notes=notes,
        failed=failed,
        failure="could not be compared",
    )


def junit(rows: Sequence[GateRow], failed: Mapping[str, str], lost: str = "lost") -> str:
    """A test case a row, in the XML that JUnit made common; a row that grew is a failure, and a frame that could
    not be compared an error.
    """
    grew = sum(row.grew for row in rows)
    counts = {"tests": len(rows) + len(failed), "failures": grew, "errors": len(failed)}
    suite = ET.Element("testsuite", {"name": "drivesem gate"} | {name: str(n) for name, n in counts.items()})
    for row in rows:
        case = ET.SubElement(suite, "testcase", classname=f"drivesem.gate.{row.level}", name=row.hole)
        if row.grew:
            verb = "phantoms in" if row.level == PHANTOMS else lost
            told = f"{verb} {100 * row.before:.1f} % before, {100 * row.after:.1f} % after"
            ET.SubElement(
                case, "failure", message=told, type="grew"
            ).text = f"{told}; difference {_difference(row)}; p {row.p:.3g}"
    for name, reason in failed.items():
        case = ET.SubElement(suite, "testcase", classname="drivesem.gate.frame", name=name)
        ET.SubElement(case, "error", message=reason, type="failed")
    ET.indent(suite)
    return ET.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def _sheet(title: str, rows: Sequence[GateRow], lost: str) -> Sheet:
    lines = tuple(
        (
            "all holes" if row.level == ALL else row.hole,
            f"{100 * row.before:.0f}",
            f"{100 * row.after:.0f}",
            _difference(row),
            f"{row.p:.3f}",
            str(row.samples),
            "grew" if row.grew else "",
        )
        for row in rows
    )
    columns = ("hole", f"% {lost} before", "% after", "difference, points", "p", "samples", "")
    return Sheet(title, columns, lines)


def _difference(row: GateRow) -> str:
    value = f"{100 * row.difference:+.1f}"
    return (
        value if row.low is None or row.high is None else f"{value} [{100 * row.low:+.1f}, {100 * row.high:+.1f}]"
    )


def _flat(row: GateRow) -> dict[str, Any]:
    data = row.to_json()
    low, high = data.pop("interval")
    return {**data, "low": low, "high": high}
