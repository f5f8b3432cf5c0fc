"""One frame: the change drawn by the generator, the detector asked before and after, its folder on disk."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from detectors.base import Predictor
from detectors.types import CLASSES
from drivesem.attack.judging import JudgedClasses
from drivesem.questions.confirm.judge import findings, stands
from drivesem.questions.confirm.results import Confirmed, dump
from drivesem.questions.confirm.sheet import sheet_of
from drivesem.run.finished import Frame
from drivesem.run.frame import RESULT, detection_records, target_records
from drivesem.run.looking import as_picture, detections_in
from drivesem.run.results import BoxRecord
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import Plan, SynthFrame, render_frame
from drivesem.truth.redraw.carry import carried
from drivesem.truth.redraw.exact import exact_labels
from drivesem.truth.redraw.plans import Plans
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_scene

PICTURE, SHEET = "generator.png", "sheet.png"
_ROUNDING = 1
"""Levels of 255 by which the same picture may differ from one processor to another."""


def confirm_frame(
    frame: Frame, source: Path, plans: Plans, detector: Predictor, device: str, t_star: float, folder: Path
) -> Confirmed:
    """Draw one frame of a run again and write `folder`, whole or not at all. source: the frame's folder in the
    run; t_star: score from which a detection counts.

    Raises FormatError where the plan is not that of the frame, as its picture without the change tells.
    """
    start = time.perf_counter()
    changed = load_scene(source / "scene")
    still = changed.as_photographed()
    identifier = frame.result.identifier
    planned = plans.planned(identifier, changed)
    before = _rendered(planned.plan)
    _check_same(frame.pictures["benign"], before.image)
    change = carried(still, changed, planned)
    after = _rendered(apply_edit(planned.plan, change.edit, f"frame {identifier}"))
    exact = exact_labels(before, after)
    seen = [detections_in(detector, as_picture(image, device)) for image in (before.image, after.image)]
    found = findings(frame.result, planned.tracks, exact, seen, JudgedClasses.of(detector), t_star)
    targets = [target_records(t, CLASSES, len(exact.tracks)) for t in (exact.benign, exact.changed)]
    names = JudgedClasses.of(detector).names
    result = Confirmed(
        identifier=identifier,
        source=files.digest(source / RESULT),
        compositor=found[0],
        generator=found[1],
        stands=stands(frame.result, planned.tracks, exact, before, after),
        targets_benign=_by_track(targets[0], exact.tracks),
        targets_changed=_by_track(targets[1], exact.tracks),
        detections_benign=detection_records(seen[0], names),
        detections_changed=detection_records(seen[1], names),
        not_carried=change.missing,
        seconds=round(time.perf_counter() - start, 3),
    )
    with files.whole_folder(folder) as part:
        files.write_png(part / PICTURE, after.image)
        files.write_png(part / SHEET, sheet_of(frame, result, after.image, t_star))
        files.write_text(part / RESULT, dump(result))
    return result


def _rendered(plan: Plan) -> SynthFrame:
    frame = render_frame(plan)
    assert frame is not None
    return frame


def _check_same(path: Path, image: np.ndarray) -> None:
    """Raises FormatError where the run's photograph is not the picture that the generator makes."""
    given = files.read_image(path, image.shape[:2])
    apart = int(np.abs(given.astype(np.int16) - image).max(initial=0))
    if apart > _ROUNDING:
        raise FormatError(
            str(path), "the picture that the generator makes of this frame", f"one {apart} levels off"
        )


def _by_track(records: Sequence[BoxRecord], tracks: Sequence[int]) -> tuple[BoxRecord, ...]:
    return tuple(r if r.index is None else dataclasses.replace(r, index=tracks[r.index]) for r in records)
