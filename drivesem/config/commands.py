"""One dataclass a command, of shared blocks and settings of its own. The command line wins over a preset
(`--config FILE.yaml`), which wins over the defaults here.

This module is loaded by `drivesem --help`: it imports nothing heavy.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from typing import Annotated, Literal

import tyro

from drivesem.config.blocks import (
    CERTIFYING_DRAWS,
    DATASETS,
    DEMO,
    FINDER,
    SCENES,
    BootstrapOption,
    CommandConfig,
    Count,
    DetectionOptions,
    DeviceOption,
    Flag,
    FolderOrUrl,
    FrameCommandConfig,
    GradingOptions,
    InferenceOptions,
    NotNegative,
    Repeated,
    RunFolder,
    RunOption,
    SceneAttackOptions,
    SceneOptions,
    SearchOptions,
    ThresholdOption,
    TileOption,
    TrainingOptions,
    TrustOption,
    WorkerOptions,
    option,
)
from drivesem.config.constraints import (
    POSITIVE,
    AllowsUrl,
    ExistingFolder,
    ForMethods,
    NumberRange,
    OneOf,
    Parsed,
    Required,
    at_least,
)
from drivesem.config.errors import refuse
from drivesem.config.values import class_map, is_url, numbers, part_of

COMBO_NUMBERS = (1, 2, 3, 4)
DEFAULT_COMBO = 2
DEFAULT_QUERIES = 64
SYNTH = "synth"
"""What --dataset takes for training: frames that the generator makes."""
GRADIENT_FREE = ("random", "halton", "sobol", "cma-es")
"""Attacks that ask a detector only what it finds."""
LEAST_PASSES = 24
"""Of --passes: with fewer, searches have nothing left after a look around."""
COUNTED = (*GRADIENT_FREE, "scw", "subsets")
"""Attacks that end after --queries."""
RESTARTED = ("si-fgsm", "apgd", "fgsm", "sgd", "scw")
"""Attacks that may begin elsewhere."""
Search = Literal[
    "si-fgsm", "apgd", "fgsm", "sgd", "scw", "subsets", "random", "halton", "sobol", "cma-es", "corners", "climb"
]  # fmt: skip
"""Attacks that look for failures; the placebo looks for none."""

_NETWORK = "squeezenet"
"""The classifier that is attacked, or trained, where none is named."""

RunArguments = Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN...")]
RunFolders = Annotated[RunArguments, Required("folders of drivesem attack", "RUN")]
Fraction = Annotated[float, NumberRange(0, 1, "()", "a share between 0 and 1")]


@dataclass(frozen=True, kw_only=True)
class AttackConfig(TileOption, GradingOptions, SceneAttackOptions, FrameCommandConfig):
    """Find feasible changes of driving scenes that a detector gets wrong."""

    combo: Annotated[int, NumberRange(1, 4, expected="1, 2, 3 or 4")] | None = None
    """The paper's combinations: 1 translate+rotate, 2 translate+rotate+mesh, 3 translate+mesh, 4 rotate+mesh."""
    params: str | None = None
    """Any set instead of a combo, with commas: color, weather, foliage, translate, rotate, mesh; size and
    sun, with --budget street alone."""
    method: Literal[Search, "placebo"] = "si-fgsm"
    """si-fgsm, fgsm, sgd follow the gradient, apgd by steps that halve where the loss stops rising; scw
    (Carlini-Wagner) also keeps the change small; subsets finds the fewest parameters that are enough; random
    (uniform), halton, sobol (scrambled sequences) and cma-es ask only what the detector finds; climb lowers what
    each object's margin is on average over draws of --nuisances, and finds failures that hold; corners is its
    baseline, which tries corners of the bounds."""
    passes: Annotated[Count, at_least(LEAST_PASSES, "which the search needs")] | None = None
    """Passes of the detector that a frame may take, a gradient counted as 3: methods take as many steps or queries
    as fit, whatever --steps says. By default only climb and corners count them, 90."""
    queries: Annotated[Count, ForMethods(COUNTED)] | None = None
    """Of scw: gradients; of methods without gradient: renders that are judged; of subsets: both. By default 64."""
    step_form: Annotated[Literal["raw", "l2"], ForMethods(("sgd",))] = "l2"
    """Of sgd: the gradient as it is, or its direction, each parameter's as long as a step of si-fgsm."""
    rate: Annotated[
        float,
        ForMethods(("si-fgsm", "apgd", "sgd", "scw")),
        NumberRange(0, ends="()", expected="a number above 0"),
    ] = 1.0
    """Of si-fgsm, apgd, sgd and scw: length of a (first) step in units of each parameter's own step."""
    momentum: Annotated[float, ForMethods(("si-fgsm", "sgd")), NumberRange(0, 1)] = 0.0
    """Of si-fgsm and sgd: what is left of earlier gradients after a step, 0 to 1 (MI-FGSM: 1)."""
    norm: Annotated[Literal[1, 2], ForMethods(("scw",))] = 2
    """Of scw: the norm of the change that is kept small."""
    restarts: Annotated[NotNegative, ForMethods(RESTARTED)] = 0
    """Of si-fgsm, apgd, fgsm, sgd and scw: how often to begin again at random near the photograph."""
    scouts: Annotated[NotNegative, ForMethods(RESTARTED)] = 0
    """Of the same: how many samples of all the bounds are judged first; the attack begins at the best."""
    like: Annotated[str, ForMethods(("placebo",)), ExistingFolder("a run of drivesem attack")] | None = None
    """Of placebo, one random edit of each frame: the run whose counterexamples are as large."""
    range: Literal["bounds", "steps"] = "bounds"
    """Of methods without gradient: search all of the parameters' bounds, or what --steps steps reach."""
    early_stop: Flag = False
    """Stop a frame at its first success instead of using all steps or queries."""
    grade: bool = True
    """See how sure failures are; without, all are by threshold, and certificates take no time."""
    changes: Annotated[str, ForMethods(("climb", "corners"))] | None = None
    """Of climb and corners, with --budget street: what else may change, with commas: leave (a car is gone), park
    (one more stands there), swap (another vehicle in its place), load (on its roof). Some are tried on what was
    found, within the same passes; the best is kept."""
    mesh: str | None = None
    """Of --changes: the vehicle that parks or comes in a car's place, a mesh (OBJ, GLB, PLY) in metres, y up; by
    default templates.
    """
    target_objects: str | None = None
    """Only these objects of each frame, such as 0,2: others may be lost, which is no success; nor are phantoms."""
    target_classes: str | None = None
    """Only objects and phantoms of these classes, such as Car,Pedestrian."""
    backend: Literal["warp", "reference"] = "warp"
    """Renderer: the fast kernels, or the plain torch reference that defines them."""

    out: FolderOrUrl = None
    """Folder for the results, or its URL (docs/scale.md); a second run with the same goes on where it stopped."""
    part: Annotated[str | None, Parsed(part_of)] = None
    """K/N, such as 2/4: the 2nd, 6th, 10th frame and so on, for one of four machines (drivesem runs merge)."""

    def check(self) -> None:
        super().check()
        beside = f"--combo {self.combo}"
        refuse(self.combo is not None and self.params is not None, "--params", "no --combo beside it", beside)
        free = self.method in GRADIENT_FREE
        without = f"a method without gradient ({', '.join(GRADIENT_FREE)}) beside it"
        refuse(self.range != "bounds" and not free, "--range", without, self.method)
        none = f"float32 with {self.method}, which takes no gradient"
        refuse(free and self.precision != "float32", "--precision", none, self.precision)
        single = self.early_stop and self.method in ("fgsm", "placebo")
        refuse(single, "--early-stop", "a method of several steps or queries", self.method)
        both = self.passes is not None and self.queries is not None
        refuse(both, "--queries", "no --passes beside it", f"--passes {self.passes}")
        subsets = self.method == "subsets"
        whole = self.early_stop and self.method in ("subsets", "corners", "climb")
        refuse(whole, "--early-stop", "a method that may end at the first success", self.method)
        street = self.budget.split(",")[0] == "street"
        refuse(self.changes is not None and not street, "--changes", "--budget street beside it", self.budget)
        refuse(self.mesh is not None and self.changes is None, "--mesh", "--changes beside it", self.mesh)
        unlike = self.method == "placebo" and self.like is None
        refuse(unlike, "--like", "a run of drivesem attack, for --method placebo", "nothing")
        refuse(subsets and self.queries == 1, "--queries", "at least 2 with subsets", self.queries)


@dataclass(frozen=True, kw_only=True)
class DriveConfig(TileOption, SearchOptions, FrameCommandConfig):
    """Attack a whole clip: one change of each car over its whole track, and how long the detector misses it."""

    clip: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="CLIP"), AllowsUrl()] = None
    """A folder, or its URL: Virtual KITTI 1.3.1 or 2, KITTI's tracking benchmark, or what drivesem synth
    --sequence wrote (kitti, vkitti2); by default an embedded drive, made by code."""
    sequence: str | None = None
    """Which clip of the folder, such as 0003, 0001/clone or Scene01/clone; by default the first."""
    combo: Annotated[int, NumberRange(1, 4, expected="1, 2, 3 or 4")] | None = None
    """The paper's combinations, as of drivesem attack, instead of --params."""
    params: str | None = None
    """What may change, with commas, as of drivesem attack; by default color,translate,mesh. translate is a smooth
    path aside; all else is the same in all frames."""
    method: Literal["si-fgsm", "fgsm", "sgd", "random", "halton", "sobol", "cma-es"] = "si-fgsm"
    """si-fgsm, fgsm, sgd follow the gradient; the others ask only what the detector finds in the whole clip."""
    queries: Annotated[Count, ForMethods(COUNTED)] | None = None
    """Of methods without gradient: whole clips that are judged, by default 64."""
    bend: Annotated[int, NumberRange(0, 5, expected="0 to 5")] = 3
    """Degree of the polynomial of a car's path over time; 0 sets it aside by the same in all frames."""
    keys: Count = 8
    """Frames that a gradient step looks at, evenly spread; each step looks at others, in turn."""
    certify: NotNegative = 6
    """Frames with new misses, evenly spread, that are looked at again in draws: are they missed for certain?"""
    fit: bool = True
    """Fit each car's shape in the frame that shows it best (photographs only)."""
    limit: Count | None = None
    """Take the first N frames; of the embedded drive N, by default 30."""

    def check(self) -> None:
        super().check()
        both = self.combo is not None and self.params is not None
        refuse(both, "--params", "no --combo beside it", f"--combo {self.combo}")
        refuse(self.sequence is not None and self.clip is None, "--sequence", "a CLIP beside it", self.sequence)


@dataclass(frozen=True, kw_only=True)
class DerenderConfig(SceneOptions, FrameCommandConfig):
    """Take photographs apart into scenes: vehicles, their shadows, and what stood behind them."""

    out: FolderOrUrl = None
    """Folder for the results, or its URL (docs/scale.md); a second run with the same goes on where it stopped."""
    photo: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="PHOTO")] = None
    """A photograph without labels, or a folder of them: vehicles are found by a detector and placed by a small
    network."""
    finder: Annotated[str, tyro.conf.arg(aliases=["--detector"])] = FINDER
    """Of PHOTO, and of --dataset photographs: the detector that finds the vehicles, shipped or a file."""
    velodyne: Flag = False
    """Read the laser's points too (KITTI, where a frame has them)."""
    fit: bool = True
    """Fit template, pose and shape to the photograph's silhouettes."""
    fast: Flag = False
    """No fit: templates stay where the labels put them. The same as --no-fit."""
    meshes: Annotated[str, ExistingFolder()] | None = None
    """A folder of vehicle meshes (OBJ, GLB, PLY) to choose from beside the templates."""
    segmenter: str | None = None
    """An ONNX file of a segmentation network that maps sky, foliage and road, instead of the shipped one."""
    sheet: Flag = False
    """Also draw sheet.jpg into each scene's folder: photograph, mattes, normals, depth, maps, shadows, background,
    re-render and difference."""

    def check(self) -> None:
        super().check()
        alone, beside = self.photo is None, f"--dataset {self.dataset}"
        demo = self.dataset == DEMO
        refuse(not alone and not demo, "PHOTO", "no --dataset beside it", beside)
        photographs = "a PHOTO or a --dataset of photographs beside it"
        refuse(self.meshes is not None and alone and demo, "--meshes", photographs, beside)
        refuse(self.segmenter is not None and alone and demo, "--segmenter", photographs, beside)
        refuse(self.velodyne and self.dataset != "kitti", "--velodyne", "--dataset kitti beside it", beside)
        refuse(self.device != "cpu", "--device", "cpu", self.device)
        refuse(self.cache is not None, "--cache", "none: scenes are what is written", self.cache)
        refuse(self.dataset == SCENES, "--dataset", "photographs to take apart", beside)

    def _check_photographs(self, beside: str) -> None:
        if self.photo is None:
            super()._check_photographs(beside)


@dataclass(frozen=True, kw_only=True)
class TransferConfig(DetectionOptions, FrameCommandConfig):
    """Show the counterexamples of finished runs to other detectors: whose failures are shared?"""

    run: RunFolder = None
    """Folder of a run of drivesem attack; several with commas."""
    detectors: Annotated[str | None, Required("detectors with commas")] = None
    """Detectors to ask, with commas: shipped ones, files, or other projects' (docs/detectors.md)."""


@dataclass(frozen=True, kw_only=True)
class ExplainConfig(TrustOption, InferenceOptions, BootstrapOption, RunOption, FrameCommandConfig):
    """Say why the counterexamples of a finished run fail: which parameter, which car, and how little is enough."""

    frame: str | None = None
    """Frames of the run by name, with commas; by default all that fail by moved labels."""
    least: Literal["fails", "lost"] = "fails"
    """What the least change must still do: fail in any way, or lose an object where the counterexample does."""
    points: Count = 16
    """How many scales of a change are looked at before the smallest that fails is bisected."""
    permutations: int = 32
    """Walks through the cars, in random orders and back, where more than 6 moved; up to 6, all subsets are
    judged."""

    def check(self) -> None:
        super().check()
        odd = self.permutations < 2 or self.permutations % 2 == 1
        refuse(odd, "--permutations", "an even number, at least 2", self.permutations)


@dataclass(frozen=True, kw_only=True)
class ConfirmConfig(TrustOption, RunOption, FrameCommandConfig):
    """Draw a run's counterexamples again by a second renderer: which failures survive it?"""

    run: RunFolder = None
    """Folder of a run of drivesem attack. Generated frames are drawn by the generator, photographs by pyrender."""
    root: FolderOrUrl = None
    """Folder of the run's data set, or its URL, where it is no longer where the run found it."""


@dataclass(frozen=True, kw_only=True)
class HolesConfig(TrustOption, FrameCommandConfig):
    """Look around the certain failures of runs: where, and how often, does the detector lose such an object?"""

    runs: RunFolders = ()
    """Folders of drivesem attack."""
    samples: Annotated[int, at_least(24, "of which a rule can be made")] = 96
    """States around each failure, within what the run could change; each is seen once, with nuisances."""
    fresh: Count = 32
    """Further ones inside of the rule that was found, which it is held against."""
    contrast: NotNegative = 4
    """States of every frame in which all objects change: they say where none is lost, for rules of many."""
    recheck: Count | None = None
    """Then so many inside of each rule by seeds of their own, of a hole's stated probability: does it hold?"""
    reach: Annotated[float, NumberRange(0, 1, ends="(]", expected="a share above 0, up to 1")] = 1.0
    """How far from the counterexample, as a share of each bound's width, within the bounds."""


@dataclass(frozen=True, kw_only=True)
class GateConfig(TrustOption, BootstrapOption, TileOption, FrameCommandConfig):
    """Compare two detectors around certain failures of runs: exit code 1 where the new one fails more often."""

    runs: RunFolders = ()
    """Folders of drivesem attack."""
    before: str | None = None
    """The detector that stands: shipped, a file, or another project's; by default the runs' own."""
    after: Annotated[str | None, Required("the detector that is to take the place of --before")] = None
    """The one that is to take its place; it has to be named."""
    tolerance: Annotated[float, NumberRange(0, 1, expected="a share from 0 to 1")] = 0.05
    """By how much the share of lost objects may grow, of a hole, of a kind of failure, and of all."""
    samples: Count = 32
    """States around each failure, the same for both detectors."""


@dataclass(frozen=True, kw_only=True)
class ReportConfig(CommandConfig):
    """The page of a finished run, or of several beside each other: one HTML file with its pictures in it."""

    runs: RunFolders = ()
    """Folders of drivesem attack; a folder of drivesem study stands for its arms."""
    out: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """HTML file to write; by default report.html in the one folder given, else where the command is called."""
    frames: Count | None = None
    """Frames whose pictures are shown, worst first; by default as many as hold 200 pictures: 100 of one run."""


@dataclass(frozen=True, kw_only=True)
class RunsConfig(TrustOption, CommandConfig):
    """Tell what runs there are, make one of several parts, and remove what was never finished."""

    what: tyro.conf.Positional[Literal["list", "show", "merge", "prune"]] = "list"
    """list: the runs in folders, by default in runs; show: what was asked for and found; merge: one run, --out, of
    parts that were made with the same settings, on several machines for instance; prune: remove what commands left
    that were killed."""
    folders: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="FOLDER..."), AllowsUrl()] = ()
    """Runs of drivesem attack, or their URLs; to list, folders that hold some."""
    out: str | None = None
    """Merge: the folder of the run that is made."""
    dry: Flag = False
    """Prune: only say what would be removed."""

    def check(self) -> None:
        super().check()
        refuse(self.what != "list" and not self.folders, "FOLDER", f"runs to {self.what}", "nothing")
        merges, given = self.what == "merge", self.out is not None
        refuse(merges and not given, "--out", "the folder of the run that is made", "nothing")
        refuse(given and not merges, "--out", "runs merge", f"runs {self.what}")
        refuse(self.dry and self.what != "prune", "--dry", "runs prune", f"runs {self.what}")
        elsewhere = next((folder for folder in self.folders if is_url(folder)), None)
        here = elsewhere is None or self.what != "prune"
        refuse(not here, "FOLDER", "a folder of this machine, to prune", elsewhere)


@dataclass(frozen=True, kw_only=True)
class VerifyConfig(TrustOption, DeviceOption, WorkerOptions, RunOption, CommandConfig):
    """Is a finished run what it says it is? Every frame computed again from its files; exit code 1 where not."""

    out: str | None = None
    """JSON file to write; by default verify.json in the run's folder."""
    limit: Count | None = None
    """Check the first N frames."""
    keep_going: Flag = False
    """List a frame whose files are missing or damaged in the results, and go on with the rest."""


@dataclass(frozen=True, kw_only=True)
class RenderConfig(CommandConfig):
    """Render a scene folder as it stands."""

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    """The scene's folder, as `drivesem derender` writes it."""
    out: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """PNG to write; by default render.png in the scene's folder."""


@dataclass(frozen=True, kw_only=True)
class EditConfig(CommandConfig):
    """Change a scene folder by physical units, and render it."""

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    """The scene's folder, as `drivesem derender` writes it; objects are numbered by row, from 0."""
    set: Repeated = ()
    """A change, as often as needed: 'objects[2].translate=0.5m,0m' (along the heading, to the left),
    'objects[2].rotate=10deg', 'objects[1].color=0.3,0,0,0,0', 'objects[all].rotate=2deg', weather=fog (or rain,
    sunset, overcast, twilight), weather.rain=0.4, foliage.hue=0.5."""
    remove: Repeated = ()
    """Rows of vehicles to take out, with their shadows; or all."""
    photographed: Flag = False
    """Begin with the scene as it was photographed, where the folder holds a counterexample or an edit: every
    vehicle at its place, in its shape and paint, without weather. Vehicles that were removed, exchanged, added,
    loaded or taken away stay so. A shape is then also given as a share of what it was bent to:
    'objects[2].mesh=60%'."""
    edits: str | None = None
    """A YAML file of changes; what --set says of the same thing wins."""
    out: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """PNG to write; by default edit.png in the scene's folder, or nothing where there is --save."""
    save: str | None = None
    """Folder to write the changed scene to."""


@dataclass(frozen=True, kw_only=True)
class ViewConfig(TrustOption, ThresholdOption, TileOption, DeviceOption, CommandConfig):
    """Open a page on which a scene or a counterexample moves as you move it, and the detector answers."""

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE|RUN")]
    """A scene of drivesem derender, a folder of some, or a run of drivesem attack."""
    frame: str | None = None
    """The frame to begin with, by name; by default the first."""
    detector: str | None = None
    """A shipped detector, a file, or another project's (docs/detectors.md); by default the run's, else squeezedet.
    """
    budget: str = "street"
    """How far sliders go: a preset, a YAML file, or NAME=VALUE with commas, as of drivesem attack."""
    port: Annotated[int, NumberRange(0, 65535, expected="0 (any that is free) to 65535")] | None = None
    """Port of 127.0.0.1 to serve the page at; by default 8321, or the next that is free."""
    browser: bool = True
    """Open the page in the browser."""
    window: Flag = False
    """Instead of the page, show the frame in 3D in a window of Open3D, which needs a display."""


@dataclass(frozen=True, kw_only=True)
class SynthConfig(FrameCommandConfig):
    """Make driving frames with exact ground truth by code."""

    out: FolderOrUrl = None
    """Folder for the results, or its URL (docs/scale.md); a second run with the same goes on where it stopped."""
    frames: Count = 10
    """How many frames; each is made in every one of --variations."""
    layout: Literal["kitti", "vkitti2", "vkitti1", "coco", "yolo"] = "kitti"
    """Layout of the folder that is written: KITTI object, Virtual KITTI 2 or 1.3.1, COCO JSON, YOLO."""
    split: Literal["train", "heldout"] = "train"
    """Pools of vehicle shapes and surroundings; the two share nothing."""
    variations: str | None = None
    """Virtual KITTI's, with commas, or all: clone, fog, morning, overcast, rain, sunset, 15-deg-left,
    15-deg-right, 30-deg-left, 30-deg-right; or mixed: weather drawn for each street. By default clone for Virtual
    KITTI's layouts, else mixed."""
    sequence: Count | None = None
    """Frames of one drive, ten a second, with moving cars and tracks; by default 10 for Virtual KITTI's layouts,
    else 1: every frame a street of its own."""
    people: bool | None = None
    """Pedestrians and cyclists too; by default in all layouts but Virtual KITTI's, which have no class for
    them."""
    cameras: Literal[1, 2] = 1
    """2: Virtual KITTI 2's right camera too."""
    validation: Annotated[float, NumberRange(0, 1, "[)", "a share in [0, 1)")] = 0.0
    """Share of the frames that make up part val, from shapes that no frame of part train shows."""
    edits: str | None = None
    """A YAML file of changes to the scenes: vehicles moved, turned, bent, painted, removed; weather; foliage."""
    meshes: str | None = None
    """A folder of vehicle meshes (OBJ, GLB, PLY) to use instead of the generated ones."""
    assets: str | None = None
    """A folder of the optional pack of vehicles and skies, made by tools/fetch_assets.py."""
    sheet: Flag = False
    """Also draw sheet.jpg: frames with boxes, depth, classes, instances, as read back from the folder."""
    compare: Flag = False
    """Also write distributions.png and .md: sizes, distances, angles, occlusion beside KITTI's own."""

    def check(self) -> None:
        super().check()
        refuse(self.cameras == 2 and self.layout != "vkitti2", "--cameras", "1, or --layout vkitti2", self.cameras)
        unknown = f"False with --layout {self.layout}, which has no class for them"
        refuse(bool(self.people) and self.layout.startswith("vkitti"), "--people", unknown, True)


@dataclass(frozen=True, kw_only=True)
class BenchOptions(InferenceOptions, SceneOptions, FrameCommandConfig):
    """What benchmarks have in common."""

    quick: Flag = False
    """Measure with fewer repetitions."""
    cars: Annotated[str, Parsed(numbers)] = "1,4,8,16"
    """Numbers of cars, 1 to 16, with commas."""
    triangles: Annotated[str, Parsed(partial(numbers, least=4))] = "2000,5000"
    """Triangles a car, with commas."""
    threads: Count | None = None
    """Threads of torch and of the kernels (default: as many as torch chooses)."""
    detector: str = "squeezedet"
    """Shipped detector, or a .safetensors file of one."""
    markdown: str | None = None
    """Markdown file whose section on this benchmark is rewritten (docs/benchmarks.md)."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig(BenchOptions):
    """Measure attack steps, rendering and run time on this machine."""

    what: tyro.conf.Positional[Literal["step", "render", "night"]] = "step"
    """step: a whole attack step, compared with the detector alone; render: the renderer, compared with its
    reference; night: an estimate of how long an attack on all frames of --root takes."""
    boxes: str | None = None
    """Of step: a tar archive of KITTI's label_2 and calib, whose vehicles are measured."""
    frames: Count = 40
    """Of step: frames of --boxes; a quarter of them with --quick."""
    limit: Count | None = None
    """Of night: frames to measure, evenly spread (default: 20)."""
    count: Count | None = None
    """Of night: frames to estimate for (default: all that have vehicles)."""
    attack: str | None = None
    """Of night: preset or YAML file of `drivesem attack` (default: its defaults; data, device and workers are
    given here)."""

    def check(self) -> None:
        super().check()
        refuse(self.what != "step" and self.boxes is not None, "--boxes", "bench step", f"bench {self.what}")
        demo = self.what == "night" or self.dataset == DEMO
        refuse(not demo, "--dataset", "--dataset demo, but for bench night", self.dataset)


@dataclass(frozen=True, kw_only=True)
class EvalConfig(TileOption, WorkerOptions, CommandConfig):
    """Figures of detections against labels, as COCO, KITTI or VOC define them; or of a detector on a data set."""

    gt: FolderOrUrl = None
    """Labels: a folder of KITTI label files, a KITTI, YOLO or Virtual KITTI folder, a COCO JSON file, or a run of
    drivesem attack."""
    pred: FolderOrUrl = None
    """Detections: a folder of KITTI result files (with scores), COCO results, YOLO text files, or a run."""
    pred_b: FolderOrUrl = None
    """A second set of detections of the same frames, compared with the first by a paired test."""
    protocol: Literal["coco", "kitti", "voc"] = "coco"
    """Which benchmark's rules."""
    gt_format: Literal["auto", "kitti", "coco", "yolo", "vkitti1", "vkitti2", "run"] = "auto"
    """Layout of --gt; auto looks at what lies there."""
    pred_format: Literal["auto", "kitti", "coco", "yolo", "run"] = "auto"
    """Layout of --pred and --pred-b."""
    small_detections: Literal["ignore", "count"] = "ignore"
    """KITTI: detections below the minimum height are ignored (development kit of 2017) or counted (the older)."""
    map: Annotated[str, Parsed(class_map)] | None = None
    """Classes of the detections by name, with commas: car=Car,person=Pedestrian; bus=- leaves a class out."""
    map_gt: Annotated[str, Parsed(class_map)] | None = None
    """The same for the labels."""
    classes: str | None = None
    """Judge these classes only, with commas."""
    frames: str | None = None
    """A file with one identifier a line: judge these frames only."""
    stage: Literal["attacked", "attacked-paper", "rerendered", "benign"] = "attacked"
    """Of a run: detections after the attack, beside labels that moved or the benign ones; in the re-rendered
    photograph; in the photograph."""
    stage_b: Literal["attacked", "attacked-paper", "rerendered", "benign"] | None = None
    """The same for --pred-b; by default --stage."""
    bootstrap: NotNegative | None = None
    """Draws of frames for confidence intervals and paired tests; 0 leaves them out. By default 200, and none of
    more than 5,000 frames, whose figures hardly vary, unless two detectors are compared."""
    seed: int = 0
    """Seed of the draws."""
    out: str | None = None
    """Folder for metrics.json, CSV, Markdown and PNG."""
    detector: str | None = None
    """Instead of --gt and --pred: run this detector, a shipped one, a file, or another project's (see
    docs/detectors.md)."""
    dataset: Annotated[str, OneOf(DATASETS)] = "kitti"
    """Of --detector: kitti, vkitti1, vkitti2, coco or yolo."""
    root: FolderOrUrl = None
    """Of --detector: folder of the data set, or its URL."""
    limit: Count | None = None
    """Of --detector: the first N frames."""
    device: str = "cpu"
    """Of --detector: torch device."""
    min_height: float = 25.0
    """Of --detector: lower objects are neither missed nor a hit, px."""
    max_occlusion: int = 1
    """Of --detector: objects occluded more (KITTI's 0 to 3) are neither missed nor a hit."""
    max_truncation: float = 1.0
    """Of --detector: objects of which a larger share lies outside the image are neither missed nor a hit."""
    pictures: NotNegative = 0
    """Of --detector: draw hits, misses and false alarms of the N frames with most mistakes into --out."""

    def check(self) -> None:
        super().check()
        given, asked = self.gt is not None and self.pred is not None, self.detector is not None
        which = "both" if self.gt else "neither"
        refuse(given == asked, "--gt and --pred, or --detector", "one or the other", which)
        refuse(asked and self.root is None, "--root", f"the folder of data set {self.dataset!r}", "nothing")
        sharing = next((f.name for f in fields(WorkerOptions) if getattr(self, f.name) != f.default), None)
        alone = sharing is not None and not asked
        refuse(alone, option(sharing or ""), "--detector beside it", "none")
        nowhere = self.pictures > 0 and (not asked or self.out is None)
        refuse(nowhere, "--pictures", "--detector and --out", "one of them missing")


@dataclass(frozen=True, kw_only=True)
class AnchorsConfig(CommandConfig):
    """Anchor shapes for a data set, by k-means of its boxes with 1 - IoU as the distance."""

    dataset: Annotated[str, OneOf(DATASETS)] = "kitti"
    """kitti, vkitti1, vkitti2, coco or yolo."""
    root: str
    """Folder of the data set."""
    count: Count = 9
    """How many anchors."""
    classes: str | None = None
    """Boxes of these classes only, with commas, as the data set calls them; by default of all."""
    min_height: float = 12.0
    """Lower boxes are left out, px: nothing is trained on them."""
    limit: Count | None = None
    """The first N frames."""
    seed: int = 0
    """Seed of the starts; the best of several is kept."""


@dataclass(frozen=True, kw_only=True)
class CheckConfig(TileOption, DeviceOption, CommandConfig):
    """Does a detector keep its contract? Shapes, gradient, loss, decoding; exit code 1 where it does not."""

    detector: str
    """A shipped detector, a file, or another project's (docs/detectors.md)."""
    size: str = "320x192"
    """WIDTHxHEIGHT of the pictures it is tried on, px."""
    seed: int = 0
    """Seed of the pictures, and of the directions along which differences are taken."""


@dataclass(frozen=True, kw_only=True)
class ConvertConfig(CommandConfig):
    """Convert labels between KITTI, COCO, YOLO and Virtual KITTI, or to FiftyOne, and say what is lost."""

    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SOURCE")]
    """What to convert: a folder of KITTI label files, a KITTI, YOLO or Virtual KITTI folder, a COCO JSON file, or
    the counterexamples of a run of drivesem attack."""
    out: Annotated[str, tyro.conf.arg(aliases=["-o"])]
    """Folder to write, new or empty; or a .json file for COCO."""
    to_format: Annotated[
        Literal["kitti", "coco", "yolo", "vkitti1", "vkitti2", "fiftyone"], tyro.conf.arg(aliases=["--to"])
    ]
    """Layout to write."""
    from_format: Annotated[
        Literal["auto", "kitti", "coco", "yolo", "vkitti1", "vkitti2", "run"], tyro.conf.arg(aliases=["--from"])
    ] = "auto"
    """Layout of SOURCE; auto looks at what lies there."""
    scores: Flag = False
    """SOURCE holds detections with scores, not labels."""
    images: str | None = None
    """Folder of the images, for their sizes, which COCO and YOLO need; by default where SOURCE has them."""
    image_size: str | None = None
    """WIDTHxHEIGHT of all images, px, instead of looking at them."""
    copy_images: Flag = False
    """Also copy the images into the new layout."""
    map: Annotated[str, Parsed(class_map)] | None = None
    """Classes by name, with commas: car=Car,person=Pedestrian; bus=- leaves a class out."""


@dataclass(frozen=True, kw_only=True)
class ExportConfig(CommandConfig):
    """Hand a run's counterexamples on: as training data with moved labels, as tables, or as 3D files."""

    run: RunFolder = None
    """Folder of a run of drivesem attack; for gltf also a scene of drivesem derender, or a folder of some."""
    out: Annotated[str | None, Required("a new or empty folder"), tyro.conf.arg(aliases=["-o"])] = None
    """Folder to write, new or empty."""
    to_format: Annotated[
        Literal["kitti", "coco", "yolo", "vkitti1", "vkitti2", "fiftyone", "tables", "gltf"],
        tyro.conf.arg(aliases=["--to"]),
    ]
    """kitti, coco, yolo, vkitti1, vkitti2, fiftyone: a data set with its images, and where each is from; coco also
    holds what the detector found. tables: frames, failures and parameters as CSV, and as Parquet where pyarrow is
    there. gltf: vehicles and surroundings in 3D, textured by the photograph."""
    grade: Literal["all", "threshold", "certain", "confirmed", "shared"] = "threshold"
    """Frames with a failure of at least this grade (docs/grades.md); all: also those that withstood."""
    map: Annotated[str, Parsed(class_map)] | None = None
    """Classes by name, with commas: Car=car,Truck=truck; Truck=- leaves a class out."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(TrainingOptions, FrameCommandConfig):
    """Train a detector; killed or stopped, the same command goes on and ends with the same weights."""

    detector: str = "squeezedet"
    """Architecture: squeezedet, or another one of docs/training.md."""
    dataset: Annotated[str, OneOf((*DATASETS, SYNTH))] = "kitti"
    """kitti, vkitti1, vkitti2, coco or yolo; or synth: the generator makes frames in the run's folder first."""
    root: str | None = None
    """Folder of the data set, or several with commas: their frames are joined."""
    held_out: str | None = None
    """Folder of the same layout to judge by: the best weights on it are kept, and t* is set on it."""
    split: str | None = None
    """Frames of --root: 3d-sdn-train or 3d-sdn (of Virtual KITTI), random:0.75 or random:0.75:rest, or a file of
    names (docs/derender.md)."""
    held_out_split: str | None = None
    """The same of --held-out; where that is not given, of --root."""
    validation: str | None = None
    """Folder of the same layout that chooses the best weights and t* in the place of --held-out, which then only
    judges them: its figures are of frames that had no say."""
    also: str | None = None
    """Folder of further frames whose figures go into the model card, KITTI layout."""
    frames: Annotated[int, POSITIVE] = 1000
    """Synth: how many frames to train on."""
    held_out_frames: NotNegative = 100
    """Synth: how many frames to judge by, of shapes and surroundings of their own; 0 is none."""
    weights: str | None = None
    """File for the best weights, with their card beside; by default DETECTOR.safetensors in the run's folder."""
    start: str = "auto"
    """First weights: auto (the shipped ones of this architecture, or none), none, squeezenet (ImageNet backbone),
    darknet:FILE.cfg,FILE.weights, or a .safetensors file: weights, a run's checkpoint, or a backbone."""
    anchors: Literal["published", "kmeans"] = "published"
    """SqueezeDet: as published, or as many by k-means of the data's boxes."""
    steps: Annotated[int, POSITIVE] = 10000
    """Length of the schedule in steps."""
    batch: Annotated[int, POSITIVE] = 16
    """Views a step, over all processes."""
    optimiser: Literal["adamw", "sgd"] = "adamw"
    """sgd is with --momentum."""
    momentum: Annotated[float, NumberRange(0, 1, "[)")] = 0.9
    """Of sgd."""
    rate: Annotated[float, POSITIVE] = 1e-3
    """Peak learning rate."""
    backbone_rate: float = 0.3
    """Rate of the layers that a backbone provides, relative to the others'."""
    weight_decay: float = 1e-4
    """Decay of the weights a step, relative to the rate."""
    warmup_power: float = 1.0
    """The rate rises with this power of the steps (Darknet's burn-in: 4)."""
    drops: Annotated[str, Parsed(numbers)] | None = None
    """Steps, with commas, at which the rate is multiplied by --drop-factor; without, it falls in a half cosine."""
    drop_factor: float = 0.1
    """Of --drops."""
    clip: Annotated[float, POSITIVE] = 50.0
    """Largest norm of a step's gradient."""
    average: Annotated[float, NumberRange(0, 1, "[)")] = 0.998
    """Decay a step of the moving average of the weights, which is what is judged and kept."""
    dropout: Annotated[float, NumberRange(0, 1, "[)")] = 0.5
    """Of detectors that have dropout."""
    evaluate_every: NotNegative = 500
    """Steps between evaluations on the held-out frames; 0 is at the end only."""
    thin: Annotated[int, POSITIVE] = 1
    """Judge by every n-th held-out frame until the best weights are written."""
    semantic: Annotated[float, NumberRange(0, 1, "[)")] = 0.0
    """Share of the views that show a frame with its vehicles moved, turned, bent and painted at random, weather
    and foliage changed, by the project's own renderer; data sets with 3D boxes."""
    loaders: NotNegative = 0
    """Threads that make views ready ahead (where a GPU trains); 0 makes them between the steps."""
    note: Annotated[str, AllowsUrl()] = ""
    """A remark on this run for the model card."""

    def check(self) -> None:
        super().check()
        made, given = self.dataset == SYNTH, (self.root, self.held_out, self.validation) != (None,) * 3
        refuse(not made and self.root is None, "--root", f"the folder of data set {self.dataset!r}", "nothing")
        both = "--root, --held-out, --validation"
        refuse(made and given, both, "none with --dataset synth, which makes what it needs", "one")
        split = self.split or self.held_out_split
        refuse(made and split is not None, "--split, --held-out-split", "none with --dataset synth", split)
        alone = self.validation is not None and self.held_out is None
        refuse(alone, "--held-out", "frames to judge by, beside --validation", "none")


@dataclass(frozen=True, kw_only=True)
class RetrainConfig(TrustOption, TrainingOptions, FrameCommandConfig):
    """Train a detector on with a run's counterexamples, and attack it again. Defaults: the paper's protocol."""

    run: str
    """A run's folder, as drivesem attack writes it."""
    dataset: Annotated[str, OneOf(DATASETS)] | None = None
    """Benign frames to train on: kitti, vkitti1, vkitti2, coco or yolo; by default the run's own photographs."""
    root: str | None = None
    """Folder of that data set."""
    start: str | None = None
    """First weights: a shipped detector or a .safetensors file; by default the detector that the run attacked."""
    fraction: Fraction = 0.25
    """Share of the training set that are counterexamples."""
    mix: Literal["replace", "add"] = "replace"
    """Counterexamples in the place of benign frames, drawn at random, or beside all of them."""
    label_mode: Literal["paper", "moved"] = "paper"
    """Labels of counterexamples in training: the benign ones as in the paper, or moved with the cars."""
    ramp: Annotated[float, NumberRange(0, 1, expected="a share from 0 to 1")] = 0.0
    """Share of the steps over which counterexamples come in little by little; 0: all from the first step."""
    validation: Fraction = 0.25
    """Share of the run's frames that are never trained on: the table's figures are of these."""
    fresh: NotNegative | None = None
    """How many of those are attacked again, against the retrained detector; by default all, 0 is none."""
    attack_steps: Count | None = None
    """Steps of that attack; by default as many as the run's."""
    steps: Annotated[int, POSITIVE] = 6000
    """Steps of training."""
    rate: Annotated[float, POSITIVE] = 3e-4
    """Peak learning rate of AdamW; it falls in a half cosine."""

    def check(self) -> None:
        super().check()
        one = (self.dataset is None) != (self.root is None)
        refuse(one, "--dataset and --root", "both or none", "one of them")


@dataclass(frozen=True, kw_only=True)
class ClassifyConfig(FrameCommandConfig):
    """Image classifiers instead of detectors: objects whose shape, pose or light changes until a network errs."""

    what: tyro.conf.Positional[Literal["data", "train", "attack", "confirm", "explain", "holes", "gate"]]
    """data: pictures of all objects, by split and class; train: a network on these; attack: look for changes that
    a network gets wrong. Of a run of attack, RUN: confirm draws its failures again by a second renderer; explain
    says how little of each change is enough; holes, in which poses the object is misclassified;
    gate, whether --network fails more often there: exit code 1."""
    folder: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="RUN")] = None
    """Folder of a run of drivesem classify attack."""
    renderer: Literal["auto", "mitsuba", "pyrender"] = "auto"
    """Confirm: the second renderer; by default Mitsuba where it is installed, else pyrender."""
    samples: Annotated[int, at_least(24, "of which a rule can be made")] = 64
    """Holes, gate: poses around each failure, each seen once, with nuisances."""
    fresh: Count = 32
    """Holes: further ones inside of the rule that was found, of its stated probability."""
    reach: Annotated[float, POSITIVE] = 0.6
    """Holes, gate: how far pitch, yaw and roll go either way from the pose that was found, rad."""
    tolerance: Annotated[float, NumberRange(0, 1, expected="a share from 0 to 1")] = 0.05
    """Gate: by how much the share of misclassified poses may grow, of a failure, of a class, and of all."""
    objects: str | None = None
    """Where objects come from: ShapeNetCore v2's folder, or one of meshes by class; by default 12 classes that are
    made by code."""
    split: Literal["train", "val", "test"] = "test"
    """Attack: whose objects."""
    views: str = "forward,top,left,right"
    """From where each object is seen, with commas."""
    backgrounds: Annotated[str, ExistingFolder("a folder of photographs")] | None = None
    """Photographs to put behind objects; by default pictures that are made."""
    network: str = ""
    """Attack: squeezenet, weights that classify train wrote, or an ONNX file; train: squeezenet, vgg16,
    vgg16-pooled, resnet50, torchvision:NAME or timm:NAME; by default squeezenet. Gate: the new one, as of attack;
    it has to be named (docs/classify.md)."""
    weights: str | None = None
    """Train: what the network begins with, such as torchvision's file; squeezenet needs none, and with --layers
    all others begin anew where none is named."""
    data: Annotated[str, ExistingFolder("a folder of classify data")] | None = None
    """Train: pictures that classify data wrote; by default they are made now."""
    layers: Literal["last", "all"] = "last"
    """Train: the last layer, on features that are computed once, as in the paper; or the whole network."""
    epochs: Count = 20
    """Train: how often each picture is shown."""
    batch: Count = 32
    """Train: pictures a step."""
    rate: Annotated[float, POSITIVE] | None = None
    """Train: learning rate of Adam; by default 0.003 for the last layer, 0.0001 for all."""
    half: NotNegative = 0
    """Train, --layers all: in the first N epochs pictures have half their size, a quarter of the work."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Train, --layers all: what the network computes in; bfloat16 is faster where the processor has it."""
    params: str | None = None
    """Attack: what is changed, with commas: vertex, pose, lighting; by default pose,vertex, and pose alone for
    random and halton."""
    shape: Literal["each", "smooth"] = "each"
    """Attack: whether vertices move each by itself, as in the paper, or with a 4x4x4 lattice around the object."""
    method: Literal["si-fgsm", "sgd", "scw", "random", "halton"] = "si-fgsm"
    """Attack: by the gradient, after the paper, or samples of --within; of these the misclassified one with the
    highest softmax of a wrong class is kept."""
    steps: Count = 5
    """Attack: steps along the gradient; an attack ends at the first that is misclassified."""
    queries: Annotated[Count, ForMethods(("random", "halton"))] = 5
    """Attack: samples of each picture."""
    step_vertex: Annotated[float, POSITIVE] | None = None
    """Attack: length of a step, in object sizes; by default the paper's for VGG-16, as are the next ones."""
    step_pose: Annotated[float, POSITIVE] | None = None
    """Attack: the same, in radians."""
    step_lighting: Annotated[float, POSITIVE] | None = None
    """Attack: the same, as a share of the light."""
    within_vertex: Annotated[float, POSITIVE] | None = None
    """Attack: how far a vertex may go along each axis."""
    within_pose: Annotated[float, POSITIVE] | None = None
    """Attack: how far pitch, yaw and roll may go, rad; of random and halton by default 0.75."""
    within_lighting: Annotated[float, POSITIVE] | None = None
    """Attack: how far the light may go."""
    constant: Annotated[float, ForMethods(("scw",)), POSITIVE] = 0.1
    """Attack: what a logit counts beside the size of the change."""
    norm: Annotated[Literal[1, 2], ForMethods(("scw",))] = 2
    """Attack: the norm of the change that is kept small."""
    draws: Annotated[int, at_least(CERTIFYING_DRAWS, "which a certificate's rule needs")] = CERTIFYING_DRAWS
    """Attack: draws before a change and after it, in which a failure must hold to be certain: right in 15 of 16,
    then wrong in 12 of 16."""
    grade: bool = True
    """Attack: see whether failures are certain; without, all are by threshold."""
    nuisances: str = "shift_px=3"
    """Attack: what a draw changes of a picture (docs/grades.md)."""

    def __post_init__(self) -> None:
        # Beside a run there is no default: a network compared with itself passes every gate.
        if not self.network and self.what != "gate":
            object.__setattr__(self, "network", _NETWORK)

    def check(self) -> None:
        super().check()
        whole = self.what == "train" and self.layers == "all"
        refuse(self.half > 0 and not whole, "--half", "classify train --layers all", self.half)
        refuse(self.half > self.epochs, "--half", f"at most --epochs, {self.epochs}", self.half)
        refuse(
            self.precision != "float32" and not whole, "--precision", "classify train --layers all", self.precision
        )
        needless = self.weights is not None and self.what != "train"
        refuse(needless, "--weights", "classify train (an attack takes --network FILE)", f"classify {self.what}")
        refuse(self.data is not None and self.what != "train", "--data", "classify train", f"classify {self.what}")
        of_run = self.what in ("confirm", "explain", "holes", "gate")
        refuse(
            of_run and not self.folder, "RUN", f"a folder of drivesem classify attack, to {self.what}", "nothing"
        )
        refuse(not of_run and self.folder is not None, "RUN", f"no folder, for classify {self.what}", self.folder)
        refuse(not self.network, "--network", "the network that is to take the place of the run's", "nothing")
        refuse(
            self.what == "confirm" and self.out is not None, "--out", "none: confirm goes on in the run", self.out
        )


@dataclass(frozen=True, kw_only=True)
class DoctorConfig(CommandConfig):
    """Say what is installed, which optional parts work, what each missing one would give, and how to get it."""


@dataclass(frozen=True, kw_only=True)
class PresetsConfig(CommandConfig):
    """List the presets that --config takes by name."""


COMMANDS: dict[str, type[CommandConfig]] = {
    "attack": AttackConfig,
    "drive": DriveConfig,
    "transfer": TransferConfig,
    "explain": ExplainConfig,
    "confirm": ConfirmConfig,
    "holes": HolesConfig,
    "gate": GateConfig,
    "report": ReportConfig,
    "runs": RunsConfig,
    "verify": VerifyConfig,
    "derender": DerenderConfig,
    "render": RenderConfig,
    "edit": EditConfig,
    "view": ViewConfig,
    "synth": SynthConfig,
    "bench": BenchConfig,
    "eval": EvalConfig,
    "convert": ConvertConfig,
    "export": ExportConfig,
    "check": CheckConfig,
    "anchors": AnchorsConfig,
    "train": TrainConfig,
    "retrain": RetrainConfig,
    "classify": ClassifyConfig,
    "doctor": DoctorConfig,
    "presets": PresetsConfig,
}
"""Commands by name."""
