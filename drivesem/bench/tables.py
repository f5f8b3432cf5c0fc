"""Figures as tables: for a terminal, and as Markdown for the documentation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from scene_ir import files
from scene_ir.errors import FormatError

COLUMNS: dict[str, dict[str, tuple[str, str | None]]] = {
    "step": {
        "cars": ("cars", "cars"), "triangles": ("triangles a car", "triangles"), "params": ("parameters", None),
        "lod": ("level of detail", "detail"), "ratio": ("ratio", "ratio"), "ratio_iqr": ("IQR", "IQR"),
        "step_ms": ("step, ms", "step ms"), "detector_ms": ("detector, ms", "detector"),
        "render_forward_ms": ("render forward, ms", "forward"),
        "render_backward_ms": ("render backward, ms", "backward"), "labels_ms": ("labels, ms", "labels"),
        "project_ms": ("projection, ms", "project"), "pixels": ("pixels of the cars", None),
        "repetitions": ("pairs", None),
    },
    "render": {
        "backend": ("backend", "backend"), "cars": ("cars", "cars"), "triangles": ("triangles a car", "triangles"),
        "scale": ("scale", "scale"), "pixels": ("pixels of the cars", None),
        "forward_ms": ("forward, ms", "forward ms"), "forward_iqr": ("IQR", None),
        "backward_ms": ("backward, ms", "backward"), "backward_iqr": ("IQR", None),
        "forward_backward_ms": ("both, ms", "both"), "visible_pixels": ("pixels it shows", None),
        "shows": ("shows", None), "unavailable": ("not available", "not available"),
    },
    "verbs": {
        "verb": ("verb", "verb"), "backend": ("backend", "backend"), "cars": ("cars", "cars"),
        "triangles": ("triangles a car", "triangles"), "pixels": ("pixels of the cars", None),
        "crop_pixels": ("pixels of the rectangles", "pixels"), "forward_ms": ("forward, ms", "forward ms"),
        "backward_ms": ("backward, ms", "backward"),
    },
    "memory": {
        "sweep": ("against", "against"), "cars": ("cars", "cars"), "triangles": ("triangles a car", None),
        "batch": ("batch", "batch"), "steps": ("steps", "steps"), "peak_mb": ("peak, MB", "peak MB"),
        "detector_mb": ("detector alone, MB", "detector"), "above_mb": ("above it, MB", "above"),
        "libraries_mb": ("of which libraries, MB", "libraries"), "rss_10": ("after 10 steps, MB", "at 10"),
        "rss_100": ("after 100, MB", "at 100"), "rss_1000": ("after 1,000, MB", "at 1000"),
        "slope_kb": ("growth, KB a step", "KB/step"),
    },
    "synth": {
        "layout": ("layout", "layout"), "workers": ("processes", "processes"), "frames": ("frames", "frames"),
        "frames_per_second": ("frames a second", "frames/s"), "start_s": ("start, s", "start s"),
        "peak_rss_mb": ("peak of all processes, MB", "peak MB"), "growth_kb": ("growth, KB a frame", "KB/frame"),
    },
    "derender": {
        "measure": ("figure", "figure"), "median": ("median", "median"), "tail": ("tail", "tail"),
        "worst": ("worst", "worst"), "count": ("count", "count"), "goal": ("goal", "goal"),
    },
    "label-free": {
        "measure": ("figure", "figure"), "median": ("median", "median"), "tail": ("tail", "tail"),
        "worst": ("worst", "worst"), "count": ("count", "count"), "goal": ("goal", "goal"),
    },
    "detector": {
        "detector": ("detector", "detector"), "size": ("size", "size"), "threads": ("threads", "threads"),
        "forward_ms": ("forward, ms", "forward ms"), "forward_min_ms": ("fastest", "fastest"),
        "both_ms": ("forward and backward, ms", "both"), "both_min_ms": ("fastest", "fastest"),
        "decode_ms": ("decode, ms", "decode"), "decode_worst_ms": ("at worst", "at worst"),
        "peak_mb": ("peak, MB", "peak MB"), "rounds": ("rounds", None),
    },
    "eval": {
        "protocol": ("protocol", "protocol"), "engine": ("counted by", "counted by"),
        "frames": ("frames", "frames"), "detections": ("detections", "detections"),
        "seconds": ("seconds", "seconds"), "ratio": ("ratio", "ratio"),
    },
    "found": {
        "which": ("cars", "cars"), "measure": ("figure", "figure"), "cars": ("count", "count"),
        "found": ("found", "found"), "share": ("share", "share"), "low": ("from", "from"), "high": ("to", "to"),
        "goal": ("goal", "goal"),
    },
}  # fmt: skip
"""Field of a row, its heading in the documentation, and the short one for terminals, where it is shown there."""
TITLES = {
    "step": "One attack step beside the detector alone",
    "beside": "Beside it: full-frame parameters, and no level of detail",
    "render": "The renderer",
    "verbs": "The four verbs",
    "memory": "Memory",
    "synth": "The scene generator",
    "derender": "De-rendering beside the generator's truth",
    "label-free": "Photographs without labels, beside labels that were hidden",
    "detector": "The detectors",
    "eval": "Evaluation of many frames",
    "found": "Cars that a detector finds, removed and moved",
}


@dataclass(frozen=True, slots=True)
class Section:
    """Rows of one kind. columns: a key of `COLUMNS`."""

    title: str
    columns: str
    rows: Sequence[dict[str, Any]]


def sections(result: dict[str, Any]) -> list[Section]:
    """The tables of one benchmark's result."""
    what = result["what"]
    found = [Section(TITLES[what], what, result.get("summary", result["rows"]))]
    if result.get("beside"):
        found.append(Section(TITLES["beside"], what, result["beside"]))
    if result.get("verbs"):
        found.append(Section(TITLES["verbs"], "verbs", result["verbs"]))
    return found


def terminal(section: Section) -> Table:
    """For people at a terminal: the columns that matter, those without a value left out."""
    table = Table(title=section.title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    short = {name: brief for name, (_, brief) in _used(section).items() if brief is not None}
    for heading in short.values():
        table.add_column(heading, justify="right")
    for row in section.rows:
        table.add_row(*(_cell(row.get(name)) for name in short))
    return table


def markdown(result: dict[str, Any]) -> str:
    """Tables, method, machine and versions of one benchmark."""
    lines: list[str] = []
    for section in sections(result):
        columns = _used(section)
        lines += [f"### {section.title}", "", _line(title for title, _ in columns.values())]
        lines.append(_line("---:" for _ in columns))
        lines += [_line(_cell(row.get(name)) for name in columns) for row in section.rows]
        lines.append("")
    machine, versions = result["machine"], result["versions"]
    gpu = f", {machine['gpu']}" if "gpu" in machine else ""
    lines += [
        f"Method. {result['method']}",
        "",
        f"Machine: {machine['cpu']}, {machine['cores']} cores, {machine['threads']} threads used, "
        f"{machine['ram']} GB{gpu}. " + ", ".join(f"{name} {version}" for name, version in versions.items()) + ". "
        f"Made by `{result['command']}` in {result['seconds']:.0f} s.",
        "",
    ]
    return "\n".join(lines)


def rewrite(path: Path, result: dict[str, Any]) -> None:
    """Put a benchmark's tables between its marks in a Markdown file; the rest of the file stays as it is.

    A file that is missing is made; marks that are missing are added at its end. Raises FormatError for a beginning
    without an end.
    """
    what = result["what"]
    begin, end = f"<!-- bench {what}: begin -->", f"<!-- bench {what}: end -->"
    text = files.read_text(path) if path.exists() else "# Benchmarks\n"
    body = f"{begin}\n\n{markdown(result)}\n{end}"
    if begin in text:
        before, _, rest = text.partition(begin)
        _, found, after = rest.partition(end)
        if not found:
            raise FormatError(str(path), end, f"none after {begin}")
        text = before + body + after
    else:
        text = f"{text.rstrip()}\n\n{body}\n"
    files.write_text(path, text)


def _used(section: Section) -> dict[str, tuple[str, str | None]]:
    columns = COLUMNS[section.columns]
    return {name: both for name, both in columns.items() if any(_cell(row.get(name)) for row in section.rows)}


def _line(cells: Any) -> str:
    return "| " + " | ".join(cells) + " |"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"
    if isinstance(value, int):
        return f"{value:,}"
    return str(value).replace("|", "/").replace(",", ", ").replace(",  ", ", ")
