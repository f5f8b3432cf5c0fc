"""What a maintainers' benchmark may be told."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated

from drivesem.config.commands import MIN_PASSES, BenchOptions
from drivesem.config.constraints import NumberRange, OneOf, ParsedBy, at_least, parse_integers
from drivesem.config.errors import refuse
from drivesem.config.options import (
    DEMO,
    SOURCES,
    CommandName,
    Count,
    DataSourceOptions,
    Flag,
    FrameCommandConfig,
    NotNegative,
    SceneOptions,
    TileOption,
)


@dataclass(frozen=True, kw_only=True)
class BenchTool(TileOption, DataSourceOptions, FrameCommandConfig):
    """Measure what shows maintainers that drivesem works: pictures beside the truth, speed beside others'."""

    what: CommandName = ""
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
    cars: Annotated[str, ParsedBy(parse_integers)] = "1,4,8,16"
    """Of rivals: how many cars, 1 to 16, with commas."""
    triangles: Annotated[str, ParsedBy(partial(parse_integers, minimum=4))] = "2000,5000"
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
    """A Markdown file whose section on this benchmark is written anew (docs/research/benchmarks.md)."""

    def check(self) -> None:
        super().check()
        fewest = 10 if self.what == "synth" else 1
        few = self.frames is not None and self.frames < fewest
        refuse(few, "--frames", f"at least {fewest}", self.frames)
        refuse(self.fast and self.what != "derender", "--fast", "derender before it", self.what)
        both = self.what != "depth" and self.scenes is not None and self.dataset != DEMO
        refuse(both, "--scenes", "no --dataset beside it", f"--dataset {self.dataset}")


@dataclass(frozen=True, kw_only=True)
class DetectorBenchConfig(BenchOptions):
    """Measure memory, detectors, attacks on planted faults, and a cluster."""

    what: CommandName = ""
    """Benchmark. memory: peak memory above the detector's own; detector: its forward and backward pass;
    climb: a search by climb and the parts of its passes; planted: planted faults that each attack finds; scale: frames
    shared by Ray compared with local processes."""
    methods: str = "climb,corners,si-fgsm,halton,cma-es"
    """Planted: attacks to judge, with commas (drivesem attack --method)."""
    passes: Annotated[int, at_least(MIN_PASSES)] = 90
    """Climb and planted: passes of the detector that each attack may take, a gradient counted as 3."""
    params: str = "color,weather,foliage,translate,rotate,mesh"
    """Climb and planted: what attacks may move, with commas."""
    faults: Count | None = None
    """Planted: so many faults a frame, easy and rare ones in turn, in each frame others; by default all kinds."""
    budget: str = "paper"
    """Planted: how far attacks may go (drivesem attack --budget)."""
    across: Count | None = None
    """Planted: instead, one fault a detector, for the cars of all frames, and rules of what all frames tell; so
    many of Halton's states a frame serve all faults. --faults: so many are searched for in a frame, in turn."""
    each: Count = 1
    """Planted, with --across: so many faults of each kind."""
    searched: NotNegative | None = None
    """Planted, with --across: frames that are searched, by default all; 0 leaves it at Halton's states."""
    naming: str | None = None
    """Planted: of these of --methods, with commas, also ask, as drivesem holes does, what tells a failing car, and
    whether that is the fault; the same of the detector without a fault."""
    limit: Count | None = None
    """Planted: the first N frames, by default 3. Scale: so many frames for each, by default 200."""

    def check(self) -> None:
        super().check()
        refuse(
            self.across is not None and self.naming is not None, "--naming", "no --across beside it", self.naming
        )
        refuse(
            self.across is None and self.searched is not None, "--searched", "--across beside it", self.searched
        )
        demo = self.what == "planted" or self.dataset == DEMO
        refuse(not demo, "--dataset", "--dataset demo, but for planted", self.dataset)


@dataclass(frozen=True, kw_only=True)
class GradcheckConfig(SceneOptions, FrameCommandConfig):
    """Compare gradients with central differences; exit code 1 where they disagree. One scene without --limit."""

    detector: str = "squeezedet"
    """Name of a shipped detector, or a .safetensors file of one."""
    directions: Count = 2
    """Random directions of each parameter along which differences are taken; each costs six renders a point."""
    min_cosine: Annotated[float, NumberRange(-1, 1)] = 0.99
    """Least cosine between gradient and differences."""
    max_error: Annotated[float, NumberRange(0, ends="(]", expected="a positive number")] = 0.05
    """Largest relative error of the gradient."""
    reach: Flag = False
    """Instead: how far the gradient of each object's margin tells what 1, 4 and 16 steps of an attack do to it, by
    parameter and distance; some minutes a frame."""
    draws: Annotated[Count, at_least(2, "of which two halves are compared")] = 4
    """Of --reach: draws of a camera's small changes that margins and gradients are averaged over."""

    def check(self) -> None:
        super().check()
        for name in ("directions", "min_cosine", "max_error"):
            value = getattr(self, name)
            refuse(
                self.reach and value != getattr(GradcheckConfig, name),
                f"--{name.replace('_', '-')}",
                "no --reach beside it",
                value,
            )
        refuse(not self.reach and self.draws != GradcheckConfig.draws, "--draws", "--reach beside it", self.draws)
