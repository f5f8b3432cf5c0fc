"""`drivesem transfer`: counterexamples of finished runs before other detectors."""

from __future__ import annotations

import json
import sys
from dataclasses import fields
from pathlib import Path

from rich.console import Console

from drivesem.attack.judging import HEADLINE
from drivesem.evaluation.resampling import DRAWS
from drivesem.questions.transfer.asking import DETECTIONS, detector_names, detectors_of, rows_of, words
from drivesem.questions.transfer.report import print_rows, write_report
from drivesem.run.finished import load_runs
from drivesem.run.folder import claim
from drivesem.settings.commands import Transfer
from scene_ir import files

_WRITTEN = ("transfer.json", "transfer.md", "transfer.csv", "transfer.png", DETECTIONS)


def run(config: Transfer) -> int:
    """Look, count, report; exit code 0. Raises UsageError or SceneError for bad input."""
    runs = load_runs(words(config.run or ""), config.limit)
    specs = detector_names(config.detectors or "")
    out = Path(config.out) if config.out else runs[0].folder / "transfer"
    detectors = detectors_of(specs, config, out)
    # Detections are kept by content, so that no setting of an earlier call is in the way.
    claim(out, config, _WRITTEN, presentation=[field.name for field in fields(config)])
    console = Console(stderr=True)
    rows, failed = rows_of(runs, detectors, config, console)
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    data = {"rows": [r.to_json() for r in rows], "headline": HEADLINE, "bootstrap": draws, "frames_failed": failed}
    files.write_json(out / "transfer.json", data)
    write_report(out, rows, draws)
    if config.json:
        sys.stdout.write(json.dumps(data, allow_nan=False) + "\n")
    print_rows(rows, draws, console if config.json else Console())
    for path, reason in failed.items():
        console.print(f"{path} could not be used: {reason}", soft_wrap=True)
    console.print(f"written to {out}", soft_wrap=True)
    return 0
