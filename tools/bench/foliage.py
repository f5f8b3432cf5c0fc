"""The compositor's foliage against the generator's: crowns and grass under other hues, lightness and density."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.bench.session import Columns
from drivesem.config.edits import FOLIAGE_CODES, FrameEdit
from drivesem.reporting.drawing import write_picture
from drivesem.synth import frames as generated
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import SPLITS, Plan, SynthSettings
from scene_ir.derender.derender import derender
from scene_ir.io import to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.types import Frame
from tools.bench.pictures import SheetStrip, psnr, sheet
from tools.bench.weather import rendered, to_tensor

TITLE = "Foliage, ours against the generator's"
COLUMNS: Columns = {
    "pool": ("pool", "pool"), "foliage": ("foliage", "foliage"), "frames": ("frames", "frames"),
    "crowns_db": ("PSNR of crowns, dB", "crowns"), "crowns_unchanged_db": ("unchanged", "unchanged"),
    "grass_db": ("PSNR of grass, dB", "grass"), "grass_unchanged_db": ("unchanged ", "unchanged"),
}  # fmt: skip
METHOD = (
    "Clear generated frames of both pools, de-rendered from their labels alone; a code of foliage is drawn by the "
    "compositor on the photograph and by the generator in its world, where leaves fall or grow. Where the "
    "scene's map has at least half foliage: crowns stand above the ground, grass does not. PSNR of one picture to "
    "the other, at most 99, means over frames with 500 such pixels; unchanged: the photograph as the answer."
)
QUICK_FRAMES, FULL_FRAMES = 4, 24
CODES: dict[str, FrameEdit] = {
    f"{name} {code:g}": FrameEdit(foliage=tuple(code if i == at else 0.0 for i in range(len(FOLIAGE_CODES))))
    for at, name in enumerate(FOLIAGE_CODES)
    for code in (-1.0, -0.5, 0.5, 1.0)
}
_SEED = 83
"""Of the frames: of no training and no other test."""
_LEAST_PIXELS = 500


@dataclass(frozen=True, slots=True)
class FoliageRow:
    """One code of one frame; None where too little of it is seen."""

    pool: str
    frame: str
    foliage: str
    crowns_db: float | None
    crowns_unchanged_db: float | None
    grass_db: float | None
    grass_unchanged_db: float | None


def measure(frames: int, sheets: Path | None) -> Iterator[list[FoliageRow]]:
    """Rows of a frame at a time, pools in turn."""
    for number in range(frames):
        pool = SPLITS[number % len(SPLITS)]
        plan = generated.plan_frame(_SEED, number // len(SPLITS), pool, SynthSettings(bent=True, sunny=True))
        yield foliage_rows(pool, number, plan, sheets)


def foliage_rows(pool: str, number: int, plan: Plan, sheets: Path | None = None) -> list[FoliageRow]:
    """The figures of one frame. sheets: folder for its pictures."""
    made = rendered(plan, generated.build_street(plan))
    scene = derender(Frame(f"{number:03d}", to_tensor(made.image), made.camera, made.labels))
    compositor = Compositor(scene)
    leaves = (scene.environment.foliage_map >= 0.5).numpy()
    stands = (compositor.crown_maps[:2].sum(0) >= 0.5).numpy()
    zones = [leaves & stands, leaves & ~stands]
    rows, strips = [], []
    for name, edit in CODES.items():
        changed = scene.with_environment(foliage=scene.environment.foliage.new_tensor(edit.foliage))
        ours = to_uint8(compositor.render(changed).image)
        edited = apply_edit(plan, edit)
        truth = rendered(edited, generated.build_street(edited)).image
        metrics = [
            round(psnr(picture, truth, zone), 4) if int(zone.sum()) >= _LEAST_PIXELS else None
            for zone in zones
            for picture in (ours, made.image)
        ]
        rows.append(FoliageRow(pool, f"{number:03d}", name, *metrics))
        strips.append(SheetStrip(made.image, ours, truth, np.ones(leaves.shape, bool), name))
    if sheets is not None:
        write_picture(sheets / f"{number:03d}_{pool}.png", sheet(strips, 3200))
    return rows


def summary(rows: Sequence[FoliageRow]) -> list[dict[str, Any]]:
    """Means over frames, by pool and code."""
    out: list[dict[str, Any]] = []
    for pool in SPLITS:
        for name in CODES:
            chosen = [row for row in rows if (row.pool, row.foliage) == (pool, name)]
            if not chosen:
                continue
            line: dict[str, Any] = {"pool": pool, "foliage": name, "frames": len(chosen)}
            for figure in ("crowns_db", "crowns_unchanged_db", "grass_db", "grass_unchanged_db"):
                values = [value for value in (getattr(row, figure) for row in chosen) if value is not None]
                line[figure] = round(float(np.mean(values)), 2) if values else None
            out.append(line)
    return out
