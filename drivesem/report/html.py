"""One self-contained HTML page from a run's results: no network, no server."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import cv2
import jinja2

from drivesem.results import BoxRecord, FrameResult, RunSummary

JPEG_QUALITY = 88
_SCORE_COLUMNS = (
    ("AP50", "ap50"),
    ("AP70", "ap70"),
    ("AP50:95", "ap"),
    ("recall", "recall"),
    ("recall at t*", "recall_at_t_star"),
)


@dataclass(frozen=True, slots=True)
class _Picture:
    """A frame as the page shows it."""

    result: FrameResult
    width: int
    height: int
    before: str
    after: str
    true_boxes: tuple[BoxRecord, ...]
    detected_boxes: tuple[BoxRecord, ...]
    changes: tuple[tuple[str, str], ...]


def render_report(summary: RunSummary, frames: Sequence[FrameResult], folder: Path, command: str) -> str:
    """The page's text. `folder` holds `frames/<id>/benign.png` and `counterexample.png`; worst frames come first.

    command: what reproduces the run.
    """
    order = sorted(frames, key=lambda f: (not f.success_moved, -len(f.failures), f.identifier))
    pictures = [_picture(result, folder / "frames" / result.identifier, summary.t_star) for result in order]
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(
        resources.files("drivesem.report").joinpath("template.html").read_text(encoding="utf-8")
    )
    rows = [
        ("benign", summary.benign),
        ("benign re-rendered", summary.rerendered),
        ("attacked, labels moved with the cars", summary.attacked_moved),
        ("attacked, benign labels (as in the paper)", summary.attacked_paper),
    ]
    return template.render(
        summary=summary,
        rows=[
            (name, [_percent(getattr(scores.headline, key)) for _, key in _SCORE_COLUMNS]) for name, scores in rows
        ],
        columns=[title for title, _ in _SCORE_COLUMNS],
        drop=_drop(summary.rerendered.headline.ap50, summary.attacked_moved.headline.ap50),
        pictures=pictures,
        command=command,
    )


def _drop(before: float | None, after: float | None) -> str:
    return "-" if before is None or after is None else f"{100 * (before - after):.1f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _picture(result: FrameResult, folder: Path, threshold: float) -> _Picture:
    before, height, width = _jpeg(folder / "benign.png")
    after, _, _ = _jpeg(folder / "counterexample.png")
    largest = sorted(result.theta, key=lambda c: -abs(c.value) / max(c.upper - c.lower, 1e-12))
    shown = [c for c in largest if ".ffd[" not in c.name and c.value != 0]
    bent = sum(1 for c in result.theta if ".ffd[" in c.name and c.value != 0)
    changes = [(c.name, c.display) for c in shown]
    if bent:
        changes.append(("mesh", f"{bent} lattice offsets changed (theta.json lists them)"))
    return _Picture(
        result=result,
        width=width,
        height=height,
        before=before,
        after=after,
        true_boxes=result.targets_moved,
        detected_boxes=tuple(
            box for box in result.detections_attacked if box.score is not None and box.score >= threshold
        ),
        changes=tuple(changes),
    )


def _jpeg(path: Path) -> tuple[str, int, int]:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise FileNotFoundError(f"{path}: expected a picture of the run, found none")
    encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode("ascii"), *image.shape[:2]
