"""One frame: the change drawn by a second renderer, the detector asked before and after, its folder on disk."""

from __future__ import annotations

import time
from pathlib import Path

from detectors.base import Predictor
from detectors.types import CLASSES
from drivesem.analysis.confirm.judge import findings, rows_of, stands
from drivesem.analysis.confirm.results import Confirmed, dump
from drivesem.analysis.confirm.sheet import sheet_of
from drivesem.attack.judging import JudgedClasses
from drivesem.failures.second_renderer.choose import SecondRenderers
from drivesem.run.finished import Frame
from drivesem.run.frame import RESULT, detection_records, target_records
from drivesem.run.looking import as_picture, detections_in
from scene_ir import files
from scene_ir.io import load_scene, to_uint8

SHEET, CONFIRMED = "sheet.png", "confirmed.json"


def picture_of(renderer: str) -> str:
    """The file of a second renderer's picture of the change."""
    return f"{renderer}.png"


def confirm_frame(
    frame: Frame,
    source: Path,
    second: SecondRenderers,
    detector: Predictor,
    device: str,
    t_star: float,
    folder: Path,
) -> Confirmed:
    """Draw one frame of a run again and write `folder`, whole or not at all. source: the frame's folder in the
    run; t_star: score from which a detection counts.

    Raises SceneError where no second renderer draws the frame, or not as the photograph shows it.
    """
    start = time.perf_counter()
    changed = load_scene(source / "scene")
    identifier, still = frame.result.identifier, changed.as_photographed()
    renderer = second.of(identifier, changed)
    before, after = renderer.redraw(still), renderer.redraw(changed)
    rows = rows_of(before, after, len(changed.objects))
    judged = JudgedClasses.of(detector)
    pictures = [to_uint8(drawn.image) for drawn in (before, after)]
    seen = [detections_in(detector, as_picture(picture, device)) for picture in pictures]
    found = findings(frame.result, rows, seen, judged, t_star)
    count, names = len(changed.objects), judged.names
    result = Confirmed(
        identifier=identifier,
        source=files.digest(source / RESULT),
        renderer=renderer.name,
        compositor=found[0],
        second=found[1],
        stands=stands(frame.result, rows, count),
        targets_benign=target_records(rows.benign, CLASSES, count),
        targets_changed=target_records(rows.changed, CLASSES, count),
        detections_benign=detection_records(seen[0], names),
        detections_changed=detection_records(seen[1], names),
        not_carried=renderer.not_carried(changed),
        seconds=round(time.perf_counter() - start, 3),
    )
    with files.whole_folder(folder) as part:
        files.write_png(part / picture_of(renderer.name), pictures[1])
        files.write_png(part / SHEET, sheet_of(frame, result, pictures[1], t_star))
        files.write_text(part / CONFIRMED, dump(result))
    return result
