"""Hand-made runs: three frames of random pictures with two cars each; no renderer, no detector."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivesem.config.commands import AttackConfig
from drivesem.config.options import to_yaml
from drivesem.run.results import SCHEMA, BoxRecord, FrameResult, dump_frame
from scene_ir import files

HEIGHT, WIDTH = 80, 130
CARS = ((10.0, 20.0, 60.0, 50.0), (70.0, 10.0, 125.0, 60.0))
SHIFT = 3.0


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def frame_result(name: str, found: tuple[bool, bool] = (False, True), score: float = 0.8) -> FrameResult:
    """Two cars that move by SHIFT; all are found before, those of `found` afterwards."""
    moved = tuple((x0 + SHIFT, y0, x1 + SHIFT, y1) for x0, y0, x1, y1 in CARS)
    seen = tuple(BoxRecord(box, "Car", score=score) for box in CARS)
    after = tuple(BoxRecord(box, "Car", score=score) for box, there in zip(moved, found, strict=True) if there)
    return FrameResult(
        identifier=name,
        objects=2,
        queries=1,
        loss_trace=(0.0,),
        theta=(),
        active_constraints=(),
        violations=(),
        targets_benign=tuple(BoxRecord(box, "Car", index=i) for i, box in enumerate(CARS)),
        targets_moved=tuple(BoxRecord(box, "Car", index=i) for i, box in enumerate(moved)),
        detections_benign=seen,
        detections_rerendered=seen,
        detections_attacked=after,
        failures=(),
        became_ignored=(),
        judged=(0, 1),
        found_before=(0, 1),
        success_paper=not all(found),
        success_moved=not all(found),
        identity_psnr_db=None,
        seconds=0.0,
    )


def write_finished_run(folder: Path, same: bool = False, params: str = "rotate") -> Path:
    """same: the counterexample is the photograph."""
    names = ("a", "b", "c")
    files.write_text(folder / "config.yaml", to_yaml(AttackConfig(params=params)))
    files.write_json(folder / "metrics.json", {"schema": SCHEMA, "params": params.split(","), "t_star": 0.5})
    files.write_json(folder / "manifest.json", {"frames": {name: {} for name in names}})
    for seed, name in enumerate(names):
        part = folder / "frames" / name
        photograph = picture(seed)
        after = photograph.copy()
        if not same:
            after[20:50, 10:60] = picture(100 + seed)[20:50, 10:60]
        for file, image in (("benign", photograph), ("rerender", photograph), ("counterexample", after)):
            files.write_png(part / f"{file}.png", image)
        found = (True, True) if same or name == "c" else (False, True)
        files.write_text(part / "result.json", dump_frame(frame_result(name, found)))
    return folder


@pytest.fixture
def write_run() -> Callable[..., Path]:
    return write_finished_run
