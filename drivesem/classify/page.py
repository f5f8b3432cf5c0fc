"""The page of a run on a classifier: figures by class, and each picture before and after."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from drivesem.classify.results import ClassifiedFrame, ClassifiedRun, ClassTally
from drivesem.failures.grades import Grade
from drivesem.report import web
from drivesem.report.drawing import encode_jpeg_data_url
from drivesem.report.tables import format_percent
from scene_ir import files

SECOND_PICTURE = "second.png"
"""A second renderer's picture of a failure, in the folder of its frame."""
_ORDER: dict[str | None, int] = {Grade.CONFIRMED: 0, Grade.CERTAIN: 1, Grade.THRESHOLD: 2}


def write_page(path: Path, run: ClassifiedRun, frames: Sequence[ClassifiedFrame]) -> None:
    """Write the page beside the run's folder of frames. Raises FormatError where a picture is missing."""
    worst = sorted(frames, key=lambda f: (_ORDER.get(f.grade, 3), f.attacked.margin, f.identifier))
    cards = [_card(frame, path.parent / "frames" / frame.identifier) for frame in worst]
    rows = [(one, *shares(one)) for one in run.classes]
    before, after = shares(run.whole)
    shown = {"title": run.network, "run": run, "cards": cards, "before": before, "after": after, "rows": rows}
    redrawn = any(frame.second is not None for frame in frames)
    files.write_text(path, web.render_page("drivesem.classify:page.html", **shown, redrawn=redrawn))


def shares(tally: ClassTally) -> list[str]:
    """Accuracy before and after the change, as percentages."""
    return [format_percent(one) for one in tally.accuracy.values()]


def _card(frame: ClassifiedFrame, folder: Path) -> dict[str, Any]:
    """A picture's frame, its pictures by what they are, and what was moved."""
    told = [f"{name.rpartition('.')[2]} {value}" for name, value in frame.moved.items()]
    if "vertex" in frame.sizes:
        told.append(f"vertices by up to {100 * frame.sizes['vertex']:.1f} % of the size")
    shots = {"before": "benign.png", "after": "counterexample.png"}
    if frame.second is not None:
        shots[frame.second.agreement.by] = SECOND_PICTURE
    pictures = [(name, encode_jpeg_data_url(files.read_image(folder / file))) for name, file in shots.items()]
    return {"frame": frame, "shots": pictures, "moved": ", ".join(told)}
