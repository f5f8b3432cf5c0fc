"""What a maintainers' benchmark may be told."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import tyro

from drivesem.config.blocks import DEMO, SOURCES, Count, DataSource, Flag, FrameCommand, Tiles
from drivesem.config.constraints import OneOf, Parsed
from drivesem.config.errors import refuse
from drivesem.config.values import numbers


@dataclass(frozen=True, kw_only=True)
class BenchTool(Tiles, DataSource, FrameCommand):
    """Measure what shows maintainers that drivesem works: pictures beside the truth, speed beside others'."""

    what: tyro.conf.Positional[
        Literal[
            "derender",
            "parts",
            "depth",
            "found",
            "label-free",
            "moves",
            "redraw",
            "weather",
            "foliage",
            "synth",
            "rivals",
            "devices",
            "eval",
            "viewer",
            "install",
        ]
    ] = "derender"
    """derender: de-rendered generated frames beside the generator's truth; parts: where the
    time of that goes, with a fit and with --fast; depth: how far surroundings are, beside
    the generator's truth, a laser, and in fog; found: whether a detector finds removed
    cars again, and moved ones where they are; label-free: vehicles of photographs whose labels are hidden, beside
    those labels; moves: cars moved farther and farther, beside the generator's truth; redraw: the second renderer
    of photographs beside the photograph and ours; weather, foliage: the compositor's beside the generator's;
    synth: the scene generator; rivals: other renderers beside the project's verbs; devices: a GPU (--device)
    beside the processor; eval: drivesem eval of many
    frames beside pycocotools; viewer: how long drivesem view takes to answer a slider; install: megabytes and
    seconds from a clone to the first report, and of each start."""
    quick: Flag = False
    """Fewer repetitions or frames."""
    cars: Annotated[str, Parsed(numbers)] = "1,4,8,16"
    """Of rivals: how many cars, 1 to 16, with commas."""
    triangles: Annotated[str, Parsed(partial(numbers, least=4))] = "2000,5000"
    """Of rivals: triangles a car, with commas."""
    frames: int | None = None
    """Frames that synth makes in each row, by default 200, with --quick 40; that derender takes apart, by default
    100, with --quick 12; that moves does, by default 80, with --quick 6; that depth does, by default 40, with
    --quick 6; that weather and foliage do, by default 24, with --quick 4; that devices draws, by default 12, with
    --quick 2; that label-free and parts look at, by default 60, with --quick 12; or that eval counts, by default
    20,000, with --quick 1,000."""
    ablate: Flag = False
    """Of derender: also with labels, masks, geometry, mattes or background given by the generator."""
    fast: Flag = False
    """Of derender: as drivesem derender --fast does."""
    threads: Count | None = None
    """Threads of torch and of the kernels; by default as many as torch chooses."""
    detector: str = "squeezedet"
    """Of devices, found, moves, redraw, weather and viewer: name of a shipped detector, a .safetensors file of
    one, or onnx:FILE, a detector that was trained elsewhere."""
    dataset: Annotated[str, OneOf(SOURCES)] = DEMO
    """Of found, label-free, parts, redraw and depth: demo (generated scenes, needs no data), kitti, vkitti1,
    vkitti2, coco or yolo."""
    root: str | None = None
    """Of found, label-free, parts, redraw and depth: the data set's folder, such as KITTI's with training/image_2,
    label_2, calib."""
    scenes: str | None = None
    """A folder of scenes that drivesem derender wrote. Of found and redraw: instead of a data set; of depth:
    besides one; of viewer: whose first is moved, by default an embedded one."""
    markdown: str | None = None
    """A Markdown file whose section on this benchmark is written anew (docs/benchmarks.md)."""

    def check(self) -> None:
        super().check()
        fewest = 10 if self.what == "synth" else 1
        few = self.frames is not None and self.frames < fewest
        refuse(few, "--frames", f"at least {fewest}", self.frames)
        refuse(self.fast and self.what != "derender", "--fast", "derender before it", self.what)
        both = self.what != "depth" and self.scenes is not None and self.dataset != DEMO
        refuse(both, "--scenes", "no --dataset beside it", f"--dataset {self.dataset}")
