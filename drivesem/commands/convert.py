"""`drivesem convert`: labels from one layout into another, and one line that says what is lost."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from drivesem.config.commands import ConvertConfig
from drivesem.config.errors import UsageError
from drivesem.config.values import class_map
from drivesem.data.label_table import Written
from drivesem.report.tables import format_count, print_json
from drivesem.run.labels import Conversion, convert, detect_labels_layout


def run(config: ConvertConfig) -> int:
    """Convert; exit code 0. Raises UsageError or SceneError for bad input."""
    out = Path(config.out)
    if out.suffix.lower() == ".json":
        if config.to_format != "coco":
            raise UsageError("--out", f"a folder for {config.to_format}", config.out)
        if out.exists():
            raise UsageError("--out", "a new file", config.out)
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError("--out", "a new or empty folder", config.out)
    source = Path(config.source)
    layout = detect_labels_layout(source) if config.from_format == "auto" else config.from_format
    conversion = Conversion(
        to_format=config.to_format,
        from_format=layout,
        scores=config.scores,
        size_wh=_size(config.image_size),
        images=None if config.images is None else Path(config.images),
        copy_images=config.copy_images,
        mapping=class_map("--map", config.map),
    )
    written = convert(source, out, conversion)
    if config.json:
        print_json({"out": config.out, **asdict(written)})
    sys.stderr.write(f"{sentence(written)}\n")
    if layout == "run" and config.to_format == "coco" and not config.copy_images and not config.scores:
        sys.stderr.write(f"file names of images are below {source / 'frames'} (--copy-images copies them)\n")
    return 0


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if match is None:
        raise UsageError("--image-size", "WIDTHxHEIGHT", repr(text))
    return int(match[1]), int(match[2])


def sentence(written: Written) -> str:
    """What is lost and what was assumed, on one line."""

    def listed(counts: Mapping[str, int]) -> str:
        return ", ".join(f"{name} of {count}" for name, count in sorted(counts.items()))

    parts = [f"lost: {listed(written.lost)}" if written.lost else "nothing lost"]
    parts += [f"assumed: {listed(written.assumed)}"] if written.assumed else []
    return f"{format_count(written.files, 'file')}; {'; '.join(parts)}"
