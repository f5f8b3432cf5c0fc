"""Settings of the maintainers' benchmarks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

from drivesem.config.commands import MIN_PASSES, BenchOptions
from drivesem.config.constraints import (
    NumberRange,
    OneOf,
    ParsedBy,
    at_least,
    parse_attributes,
    parse_integers,
)
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
    """Measure accuracy against the generator's truth, and speed against other programs."""

    what: CommandName = ""
    """Benchmark. derender: de-rendered generated frames against the generator's truth; parts: the time of each part
    of de-rendering, with a fit and with --fast; depth: depth of the surroundings against the generator's truth, a
    laser, and in fog; found: whether a detector still finds removed cars, and finds moved ones; label-free:
    vehicles of photographs with hidden labels against those labels; moves: cars moved farther and farther, against
    the generator's truth; people: whether a detector finds people where they were moved, and not where they were;
    redraw: the second renderer of photographs against the photograph and the compositor;
    weather, foliage: the compositor against the generator; synth: the scene generator; rivals: other renderers
    against the project's; devices: a GPU (--device) against the processor; eval: drivesem eval of many frames
    against pycocotools; viewer: response time of drivesem view to a slider; install: megabytes and seconds from a
    clone to the first report, and of each start; paths: minutes from a clone to the report of each --detector."""
    quick: Flag = False
    """Fewer repetitions or frames."""
    cars: Annotated[str, ParsedBy(parse_integers)] = "1,4,8,16"
    """rivals: numbers of cars, 1 to 16, with commas."""
    triangles: Annotated[str, ParsedBy(partial(parse_integers, minimum=4))] = "2000,5000"
    """rivals: triangles per car, with commas."""
    frames: int | None = None
    """Frames: generated per row by synth (default: 200, with --quick 40); de-rendered by derender (100, 12); used by
    moves (80, 6), depth (40, 6), weather and foliage (24, 4), devices (12, 2), label-free and parts (60, 12), or
    evaluated by eval (20,000, 1,000); people: with somebody who moves (default: all)."""
    ablate: Flag = False
    """derender: also with labels, masks, geometry, mattes or background from the generator."""
    fast: Flag = False
    """derender: as drivesem derender --fast."""
    threads: Count | None = None
    """Threads of torch and of the kernels (default: torch's choice)."""
    detector: str = "squeezedet"
    """devices, found, moves, people, redraw, weather, viewer: a shipped detector, a .safetensors file of one, or
    onnx:FILE. paths: detectors of any kind, with commas."""
    dataset: Annotated[str, OneOf(SOURCES)] = DEMO
    """found, label-free, parts, people, redraw, depth: demo (generated scenes; needs no data), kitti, vkitti1,
    vkitti2, coco or yolo."""
    root: str | None = None
    """found, label-free, parts, people, redraw, depth: folder of the data set, such as KITTI's with
    training/image_2, label_2, calib."""
    where: Annotated[str, ParsedBy(parse_attributes)] | None = None
    """people: frames with these attributes, such as timeofday=daytime."""
    scenes: str | None = None
    """Folder of scenes written by drivesem derender. found, redraw: instead of a data set; depth: in addition to one;
    viewer: the first one is moved (default: an embedded scene)."""
    markdown: str | None = None
    """Markdown file in which this benchmark's section is replaced (docs/research/benchmarks.md)."""

    def check(self) -> None:
        super().check()
        fewest = 10 if self.what == "synth" else 1
        few = self.frames is not None and self.frames < fewest
        refuse(few, "--frames", f"at least {fewest}", self.frames)
        refuse(self.fast and self.what != "derender", "--fast", "the benchmark derender", self.what)
        refuse(self.where is not None and self.what != "people", "--where", "the benchmark people", self.what)
        refuse(self.what == "people" and self.dataset == DEMO, "--dataset", "a data set with people", self.dataset)
        both = self.what != "depth" and self.scenes is not None and self.dataset != DEMO
        refuse(both, "--scenes", "no --dataset", f"--dataset {self.dataset}")


@dataclass(frozen=True, kw_only=True)
class DetectorBenchConfig(BenchOptions):
    """Measure memory, detectors, attacks on planted faults, and a cluster."""

    what: CommandName = ""
    """Benchmark. memory: peak memory in excess of the detector's own; detector: its forward and backward pass; climb:
    a search by climb and the parts of its passes; planted: planted faults found by each attack; scale: frames
    shared by Ray compared with local processes."""
    methods: str = "climb,corners,si-fgsm,halton,cma-es"
    """planted: attacks to compare, with commas (drivesem attack --method)."""
    passes: Annotated[int, at_least(MIN_PASSES)] = 90
    """climb, planted: detector passes of each attack (a gradient counts as 3)."""
    params: str = "color,weather,foliage,translate,rotate,mesh"
    """climb, planted: parameters that attacks may change, with commas."""
    faults: Count | None = None
    """planted: faults per frame, alternately easy and rare, different ones in each frame (default: all kinds)."""
    budget: str = "paper"
    """planted: limits of the change (drivesem attack --budget)."""
    across: Count | None = None
    """planted: plant one fault per detector for the cars of all frames, and fit rules to all frames. The number of
    Halton states per frame, shared by all faults. --faults: number of faults searched for per frame, in turn."""
    rarity: Literal["common", "rare"] = "common"
    """planted with --across: common faults hide 2 to 15 % of the cars in Halton states, rare ones 0.3 to 2 %."""
    each: Count = 1
    """planted with --across: faults of each kind."""
    searched: NotNegative | None = None
    """planted with --across: frames to search (default: all); 0 uses only the Halton states."""
    naming: str | None = None
    """planted: those of --methods, with commas, with failures explained by rules too, as in drivesem holes, and
    compared with the fault; the same for the detector without a fault."""
    limit: Count | None = None
    """planted: number of frames (default: 3). scale: frames per engine (default: 200)."""

    def check(self) -> None:
        super().check()
        refuse(self.across is not None and self.naming is not None, "--naming", "no --across", self.naming)
        refuse(self.across is None and self.searched is not None, "--searched", "--across", self.searched)
        learns = "learn" in self.methods.split(",")
        refuse(learns and self.across is None, "--methods", "--across, for learn", self.methods)
        refuse(
            learns and self.workers != 1, "--workers", "1 with learn, which goes from frame to frame", self.workers
        )
        demo = self.what == "planted" or self.dataset == DEMO
        refuse(not demo, "--dataset", "--dataset demo, but for planted", self.dataset)


@dataclass(frozen=True, kw_only=True)
class ConditionsConfig(TileOption, FrameCommandConfig):
    """Compare drawn weather with real frames in it."""

    what: CommandName = ""
    """Benchmark. conditions: light, colour, sharpness, noise and lamps of drawn and real frames by condition, a probe
    that separates them, sheets of both, and detectors' recalls."""
    dataset: Annotated[str, OneOf(("bdd100k", "coco"))] = "coco"
    """Layout of --root: bdd100k or coco, with the attributes weather and timeofday."""
    root: str | None = None
    """Folder of BDD100K's frames."""
    fog_root: str | None = None
    """Folder of real frames in fog (DAWN) in COCO's layout."""
    half: Annotated[str, OneOf(("A", "B", "all"))] = "B"
    """Half of the real frames, by a hash of their names: A (constants may be chosen on it), B (for reports), or all."""
    frames: Count = 24
    """Drawn frames of each condition."""
    real: Count = 48
    """Most real frames of each condition, in the order of the hash."""
    states: NotNegative = 0
    """Random feasible states of all codes, of the budget street, drawn on each frame."""
    full: Flag = False
    """Draw each weather with its own code at 1, and no other code, instead of its preset."""
    redraw: Flag = False
    """Draw the pictures in --out again, after a change of the renderer. To de-render again, delete --out/scenes."""
    recall: Flag = False
    """Measure detectors' recalls too."""
    detectors: str = "squeezedet,yolov3-slim"
    """Detectors of --recall, with commas; NAME@SCORE sets a threshold other than t*."""
    bootstrap: Annotated[Count, at_least(10)] = 400
    """Bootstrap draws."""
    threads: Count | None = None
    """Threads of torch (default: torch's choice)."""
    markdown: str | None = None
    """Markdown file in which this benchmark's section is replaced."""

    def check(self) -> None:
        super().check()
        refuse(self.root is None, "--root", "the folder of BDD100K's frames", "nothing")
        refuse(self.out is None, "--out", "a folder for scenes, pictures and sheets", "nothing")
        refuse(self.out is not None and self.out.endswith(".json"), "--out", "a folder", self.out)
        refuse(self.device != "cpu", "--device", "cpu", self.device)


@dataclass(frozen=True, kw_only=True)
class GradcheckConfig(SceneOptions, FrameCommandConfig):
    """Compare gradients with central differences; exit code 1 on a mismatch. One scene without --limit."""

    detector: str = "squeezedet"
    """A shipped detector, or a .safetensors file of one."""
    directions: Count = 2
    """Random directions per parameter for differences; each takes six renders per point."""
    min_cosine: Annotated[float, NumberRange(-1, 1)] = 0.99
    """Smallest cosine between gradient and differences."""
    max_error: Annotated[float, NumberRange(0, ends="(]", expected="a positive number")] = 0.05
    """Largest relative error of the gradient."""
    reach: Flag = False
    """Instead: how well the gradient of each object's margin predicts the effect of 1, 4 and 16 attack steps, by
    parameter and distance; some minutes per frame."""
    draws: Annotated[Count, at_least(2, "to compare two halves")] = 4
    """With --reach: nuisance samples that margins and gradients are averaged over."""

    def check(self) -> None:
        super().check()
        for name in ("directions", "min_cosine", "max_error"):
            value = getattr(self, name)
            refuse(
                self.reach and value != getattr(GradcheckConfig, name),
                f"--{name.replace('_', '-')}",
                "no --reach",
                value,
            )
        refuse(not self.reach and self.draws != GradcheckConfig.draws, "--draws", "--reach", self.draws)
