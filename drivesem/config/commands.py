"""Settings of each command: one dataclass of shared blocks and fields of its own.

A docstring below a field is the option's help. The command line wins over a preset (`--config NAME`), which wins
over the defaults here. `drivesem --help` loads this module: it imports nothing heavy.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from typing import Annotated, ClassVar, Literal

import tyro

from drivesem.config.constraints import (
    POSITIVE,
    AllowsUrl,
    ExistingFolder,
    NumberRange,
    OneOf,
    OnlyWith,
    ParsedBy,
    Required,
    at_least,
    is_url,
    parse_integers,
    parse_part,
)
from drivesem.config.errors import refuse
from drivesem.config.options import (
    DATASETS,
    DEFAULT_FINDER,
    DEMO,
    MIN_DRAWS,
    SCENES,
    BootstrapOption,
    ClassMap,
    CommandConfig,
    Count,
    DataSourceOptions,
    DetectionOptions,
    DeviceOption,
    Flag,
    FolderOrUrl,
    FrameCommandConfig,
    FrameFilterOptions,
    GradingOptions,
    InferenceOptions,
    NotNegative,
    Repeated,
    RunFolder,
    RunOption,
    SceneAttackOptions,
    SceneOptions,
    SearchOptions,
    TargetClassesOption,
    ThresholdOption,
    TileOption,
    TrainingOptions,
    TrustOption,
    WorkerOptions,
    option_name,
)

COMBO_NUMBERS = (1, 2, 3, 4)
DEFAULT_COMBO = 2
DEFAULT_QUERIES = 64
SYNTH = "synth"
"""Value of --dataset of training: frames from the generator."""
GRADIENT_FREE_METHODS = ("random", "halton", "cma-es")
"""Search methods that use detections alone."""
QUERY_METHODS = (*GRADIENT_FREE_METHODS, "scw")
"""Search methods that end after --queries."""
MIN_PASSES = 24
"""The fewest --passes: with fewer, searches end with their first samples."""
SearchMethod = Literal[
    "si-fgsm", "apgd", "fgsm", "sgd", "scw", "random", "halton", "cma-es", "corners", "climb", "learn"
]
"""Methods that search for failures; a placebo does not."""

_DEFAULT_NETWORK = "squeezenet"
"""The classifier of `drivesem classify`."""
_STEP_METHODS = ("si-fgsm", "apgd", "sgd", "scw")
_CLASSIFY_RUN = ("confirm", "explain", "holes", "gate")
"""What `drivesem classify` does with a finished run."""

RunArguments = Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN...")]
RunFolders = Annotated[RunArguments, Required("folders of drivesem attack", "RUN")]
Combo = Annotated[int, NumberRange(1, 4, expected="1, 2, 3 or 4")]
Fraction = Annotated[float, NumberRange(0, 1, "()", "a fraction between 0 and 1")]
FractionOrEnds = Annotated[float, NumberRange(0, 1, expected="a fraction from 0 to 1")]
NewFolder = Annotated[str | None, Required("a new or empty folder"), tyro.conf.arg(aliases=["-o"])]
PictureFile = Annotated[str | None, tyro.conf.arg(aliases=["-o"])]
SceneFolder = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
LabelFormat = Literal["kitti", "coco", "yolo", "vkitti1", "vkitti2", "fiftyone"]
Stage = Literal["attacked", "attacked-paper", "rerendered", "benign"]


@dataclass(frozen=True, kw_only=True)
class AttackConfig(TileOption, GradingOptions, TargetClassesOption, SceneAttackOptions, FrameCommandConfig):
    """Search for feasible scene changes that make a detector fail."""

    basic: ClassVar[tuple[str, ...]] = (
        *("detector", "dataset", "root", "limit", "combo", "params", "budget", "changes", "method", "passes"),
        *("steps", "objective", "confirm", "second_detector", "out", "workers", "device", "seed", "json"),
    )

    combo: Combo | None = None
    """Combination of the paper: 1 translate+rotate, 2 translate+rotate+mesh, 3 translate+mesh, 4 rotate+mesh."""
    params: str | None = None
    """Parameters, with commas, not a combo: color, weather, foliage, translate, rotate, mesh, size, sun, lamps."""
    method: Literal[SearchMethod, "placebo"] = "si-fgsm"
    """Search method; climb, corners and learn look for failures that hold; placebo makes a random edit (--like)."""
    passes: Annotated[Count, at_least(MIN_PASSES, "which the search needs")] | None = None
    """Detector passes per frame (a gradient counts as 3); climb, corners and learn take 90 by default."""
    queries: Annotated[Count, OnlyWith("method", QUERY_METHODS)] | None = None
    """Query budget: gradients for scw, evaluated renders for gradient-free methods (default: 64)."""
    step_form: Annotated[Literal["raw", "l2"], OnlyWith("method", ("sgd",))] = "l2"
    """Step of sgd: the gradient itself (raw), or its direction in steps as long as si-fgsm's (l2)."""
    rate: Annotated[
        float, OnlyWith("method", _STEP_METHODS), NumberRange(0, ends="()", expected="a number above 0")
    ] = 1.0
    """Length of a (first) step of si-fgsm, apgd, sgd and scw, in units of each parameter's own step."""
    momentum: Annotated[float, OnlyWith("method", ("si-fgsm", "sgd")), NumberRange(0, 1)] = 0.0
    """Weight of earlier gradients in si-fgsm and sgd, 0 to 1 (MI-FGSM: 1)."""
    norm: Annotated[Literal[1, 2], OnlyWith("method", ("scw",))] = 2
    """Norm of the change that scw keeps small."""
    like: Annotated[str, OnlyWith("method", ("placebo",)), ExistingFolder("a run of drivesem attack")] | None = (
        None
    )
    """Run that sets the size of a placebo's edits: that of its counterexamples."""
    range: Literal["bounds", "steps"] = "bounds"
    """Region in which gradient-free methods sample: all of the bounds, or what --steps steps can reach."""
    early_stop: Flag = False
    """Stop a frame at its first success."""
    grade: bool = True
    """Compute certificates; without them every failure has the grade threshold."""
    changes: Annotated[str, OnlyWith("method", ("climb", "corners", "learn"))] | None = None
    """Changes of objects with --budget street: leave, park, swap, load, emerge (people), with commas."""
    mesh: str | None = None
    """Mesh of a vehicle that --changes adds: OBJ, GLB or PLY in metres (default: the templates)."""
    target_objects: str | None = None
    """Objects that count as failures when lost, such as 0,2; phantoms do not count then."""
    backend: Literal["warp", "reference"] = "warp"
    """Renderer: the fast kernels, or the plain torch reference that defines them."""

    out: FolderOrUrl = None
    """Folder or URL of the results; the same command resumes what it finds there."""
    part: Annotated[str | None, ParsedBy(parse_part)] = None
    """Part of the frames for one of several machines: K/N is every N-th, from the K-th (drivesem runs merge)."""

    @property
    def samples_states(self) -> bool:
        """Whether the searched states are a sample of the bounds, which no score influences."""
        return self.method in ("random", "halton") and self.range == "bounds" and not self.early_stop

    def check(self) -> None:
        super().check()
        method, gradient_free = self.method, self.method in GRADIENT_FREE_METHODS
        refuse(None not in (self.combo, self.params), "--params", "no --combo", f"--combo {self.combo}")
        free = f"--method {', '.join(GRADIENT_FREE_METHODS)}"
        refuse(self.range != "bounds" and not gradient_free, "--range", free, f"--method {method}")
        exact = f"float32 with {method}, which takes no gradient"
        refuse(gradient_free and self.precision != "float32", "--precision", exact, self.precision)
        whole = self.early_stop and method in ("fgsm", "placebo", "corners", "climb", "learn")
        refuse(whole, "--early-stop", "a method that can end at its first success", f"--method {method}")
        refuse(None not in (self.passes, self.queries), "--queries", "no --passes", f"--passes {self.passes}")
        street = self.budget.split(",")[0] == "street"
        refuse(self.changes is not None and not street, "--changes", "--budget street", f"--budget {self.budget}")
        emerge = "emerge" in [part.strip() for part in (self.changes or "").split(",")]
        refuse(emerge and not self.moves_people, "--changes", "no emerge without --people", self.changes)
        refuse(self.mesh is not None and self.changes is None, "--mesh", "--changes", "none")
        unlike = method == "placebo" and self.like is None
        refuse(unlike, "--like", "a run of drivesem attack, for --method placebo", "nothing")


@dataclass(frozen=True, kw_only=True)
class DriveConfig(TileOption, TargetClassesOption, SearchOptions, FrameCommandConfig):
    """Attack a video clip with one consistent change per vehicle, or person."""

    basic: ClassVar[tuple[str, ...]] = (
        *("clip", "sequence", "limit", "detector", "combo", "params", "budget", "method", "steps", "queries"),
        *("objective", "certify", "out", "workers", "device", "seed", "json"),
    )

    clip: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="CLIP"), AllowsUrl()] = None
    """Folder or URL of a Virtual KITTI or KITTI tracking data set (default: a generated drive)."""
    sequence: str | None = None
    """Clip in the folder, such as 0003, 0001/clone or Scene01/clone (default: the first)."""
    combo: Combo | None = None
    """Combination of the paper instead of --params, as in drivesem attack."""
    params: str | None = None
    """Parameters, with commas (default: color,translate,mesh); translate is a smooth path over time."""
    method: Literal["si-fgsm", "fgsm", "sgd", "random", "halton", "cma-es"] = "si-fgsm"
    """Search method: si-fgsm, fgsm and sgd use gradients; random, halton and cma-es do not."""
    queries: Annotated[Count, OnlyWith("method", QUERY_METHODS)] | None = None
    """Query budget of gradient-free methods, in evaluated clips (default: 64)."""
    bend: Annotated[int, NumberRange(0, 5, expected="0 to 5")] = 3
    """Degree of the polynomial of an object's path over time; 0: the same offset in all frames."""
    keys: Count = 8
    """Frames per gradient step, evenly spread and different in each step."""
    certify: NotNegative = 6
    """Frames with new misses, evenly spread, in which failures get certificates."""
    fit: bool = True
    """Fit each vehicle's shape in the photograph that shows it best."""
    limit: Count | None = None
    """Number of frames, from the first (default for the generated drive: 30)."""

    def check(self) -> None:
        super().check()
        refuse(None not in (self.combo, self.params), "--params", "no --combo", f"--combo {self.combo}")
        refuse(self.sequence is not None and self.clip is None, "--sequence", "a CLIP", "none")
        refuse(self.moves_people and self.clip is None, "--people", "a CLIP with people", "none")


@dataclass(frozen=True, kw_only=True)
class DerenderConfig(SceneOptions, FrameCommandConfig):
    """Turn photographs into editable 3D scenes."""

    basic: ClassVar[tuple[str, ...]] = (
        *("photo", "dataset", "root", "split", "limit", "finder", "focal", "fast", "meshes", "segmenter"),
        *("velodyne", "sheet", "out", "workers", "seed", "json"),
    )

    out: FolderOrUrl = None
    """Folder or URL of the scenes; the same command resumes what it finds there."""
    photo: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="PHOTO")] = None
    """Photograph without labels, or a folder of them; a detector finds the vehicles, a network their poses."""
    finder: Annotated[str, tyro.conf.arg(aliases=["--detector"])] = DEFAULT_FINDER
    """Detector that finds vehicles in photographs without labels."""
    velodyne: Flag = False
    """Use the laser's points too (KITTI, where a frame has them)."""
    fit: bool = True
    """Fit template, pose and shape to the silhouettes in photographs."""
    fast: Flag = False
    """Skip the fit: templates stay where the labels put them; the same as --no-fit."""
    meshes: Annotated[str, ExistingFolder()] | None = None
    """Folder of vehicle meshes (OBJ, GLB, PLY) to choose from, with the templates."""
    segmenter: str | None = None
    """ONNX network that segments sky, foliage and road (default: the shipped one)."""
    sheet: Flag = False
    """Write sheet.jpg to each scene: photograph, mattes, normals, depth, maps, re-render and difference."""

    def check(self) -> None:
        super().check()
        data, labelled = f"--dataset {self.dataset}", self.photo is None
        refuse(not labelled and self.dataset != DEMO, "PHOTO", "no --dataset", data)
        for name in ("meshes", "segmenter"):
            unused = getattr(self, name) is not None and labelled and self.dataset == DEMO
            refuse(unused, f"--{name}", "a PHOTO or a --dataset of photographs", data)
        refuse(self.velodyne and self.dataset != "kitti", "--velodyne", "--dataset kitti", data)
        refuse(self.device != "cpu", "--device", "cpu", self.device)
        refuse(self.cache is not None, "--cache", "none: the scenes are the result", self.cache)
        refuse(self.dataset == SCENES, "--dataset", "photographs", data)

    def _check_photographs(self, data: str) -> None:
        if self.photo is None:
            super()._check_photographs(data)


@dataclass(frozen=True, kw_only=True)
class TransferConfig(DetectionOptions, FrameCommandConfig):
    """Test counterexamples on other detectors."""

    run: RunFolder = None
    """Folder of a run of drivesem attack; several with commas."""
    detectors: Annotated[str | None, Required("detectors with commas")] = None
    """Detectors to test, with commas: shipped ones, weights files, or other projects'."""


@dataclass(frozen=True, kw_only=True)
class ExplainConfig(TrustOption, InferenceOptions, BootstrapOption, RunOption, FrameCommandConfig):
    """Find which change causes each failure, and the smallest one that suffices."""

    frame: str | None = None
    """Frames of the run, by name with commas (default: all that fail)."""
    points: Count = 16
    """Scales of the change to evaluate before the smallest failing one is bisected."""
    permutations: int = 32
    """Random orders of the vehicles for Shapley values; up to 6 vehicles, all subsets are evaluated."""

    def check(self) -> None:
        super().check()
        odd = self.permutations < 2 or self.permutations % 2 == 1
        refuse(odd, "--permutations", "an even number, at least 2", self.permutations)


@dataclass(frozen=True, kw_only=True)
class ConfirmConfig(TrustOption, RunOption, FrameCommandConfig):
    """Re-test counterexamples with a second renderer."""

    run: RunFolder = None
    """Folder of a run of drivesem attack; generated frames need the generator, photographs pyrender."""
    root: FolderOrUrl = None
    """Folder or URL of the run's data set, if it has moved."""


@dataclass(frozen=True, kw_only=True)
class HolesConfig(TrustOption, FrameCommandConfig):
    """Map failure regions around certain failures."""

    runs: RunFolders = ()
    """Folders of runs of drivesem attack."""
    limit: Count | None = None
    """Number of certain failures, in turn from different failing cells of the runs' map (default: all)."""
    samples: Annotated[int, at_least(24, "which a rule needs")] = 96
    """Samples around each failure, each evaluated once with nuisances."""
    fresh: Count = 32
    """New samples inside each rule, which estimate its failure rate."""
    contrast: NotNegative = 4
    """Samples per frame in which all objects change, as contrast for rules of several failures."""
    recheck: Count | None = None
    """Samples with other seeds inside each rule, which test its stated failure rate again."""
    reach: Annotated[float, NumberRange(0, 1, ends="(]", expected="a fraction above 0, up to 1")] = 1.0
    """Distance from the counterexample, as a fraction of each bound's width."""


@dataclass(frozen=True, kw_only=True)
class GateConfig(TrustOption, BootstrapOption, TileOption, FrameCommandConfig):
    """Compare two detectors on a run's failure regions; for CI."""

    runs: RunFolders = ()
    """Folders of runs of drivesem attack, or packages of drivesem export RUN --to gate."""
    before: str | None = None
    """Current detector: shipped, a weights file, or another project's (default: the runs' own)."""
    after: Annotated[str | None, Required("the detector that replaces --before")] = None
    """New detector; exit code 1 if it fails more often."""
    tolerance: FractionOrEnds = 0.05
    """Accepted increase of the rate of lost objects: per region, per kind of failure, and overall."""
    samples: Count = 32
    """Samples around each failure, the same for both detectors."""
    allow_empty: Flag = False
    """Pass (exit code 0) if the runs have no certain failure; without it, an empty gate is not passed."""


@dataclass(frozen=True, kw_only=True)
class ReportConfig(CommandConfig):
    """Build the HTML report of one or more runs."""

    runs: RunFolders = ()
    """Folders of runs of drivesem attack, or of an experiment with several runs."""
    out: PictureFile = None
    """HTML file to write (default: report.html in the run's folder, or here for several runs)."""
    frames: Count | None = None
    """Frames to show, worst first (default: as many as 200 pictures hold, 100 of one run)."""


@dataclass(frozen=True, kw_only=True)
class RunsConfig(TrustOption, CommandConfig):
    """List, merge and prune runs."""

    what: tyro.conf.Positional[Literal["list", "show", "merge", "prune"]] = "list"
    """list runs; show their settings and results; merge parts with equal settings; prune unfinished files."""
    folders: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="FOLDER..."), AllowsUrl()] = ()
    """Runs of drivesem attack, or their URLs; for list, folders of runs (default: runs)."""
    out: Annotated[str, OnlyWith("what", ("merge",))] | None = None
    """Folder of the merged run."""
    dry: Annotated[Flag, OnlyWith("what", ("prune",))] = False
    """Print what prune would remove, and remove nothing."""

    def check(self) -> None:
        super().check()
        refuse(self.what != "list" and not self.folders, "FOLDER", f"runs to {self.what}", "nothing")
        refuse(self.what == "merge" and self.out is None, "--out", "the folder of the merged run", "nothing")
        url = next((folder for folder in self.folders if is_url(folder)), None)
        refuse(self.what == "prune" and url is not None, "FOLDER", "a folder on this machine, to prune", url)


@dataclass(frozen=True, kw_only=True)
class VerifyConfig(TrustOption, DeviceOption, WorkerOptions, RunOption, CommandConfig):
    """Recompute a run from its files and compare. Exit code 1 on a mismatch."""

    out: str | None = None
    """JSON file to write (default: verify.json in the run's folder)."""
    limit: Count | None = None
    """Number of frames to check, from the first."""
    keep_going: Flag = False
    """List frames with missing or damaged files in the results and continue with the rest."""


@dataclass(frozen=True, kw_only=True)
class RenderConfig(CommandConfig):
    """Render a scene."""

    scene: SceneFolder
    """Folder of a scene of drivesem derender."""
    out: PictureFile = None
    """PNG file to write (default: render.png in the scene's folder)."""


@dataclass(frozen=True, kw_only=True)
class EditConfig(CommandConfig):
    """Change a scene by physical amounts."""

    scene: SceneFolder
    """Folder of a scene of drivesem derender; its objects are numbered from 0."""
    set: Repeated = ()
    """Change, repeatable: objects[2].translate=0.5m,0m, objects[all].rotate=2deg, weather=fog, foliage.hue=0.5."""
    remove: Repeated = ()
    """Vehicles to remove with their shadows, by number with commas, or all."""
    photographed: Flag = False
    """Start from the scene as photographed, where it holds a counterexample or an edit."""
    edits: str | None = None
    """YAML file of changes; --set wins over it."""
    out: PictureFile = None
    """PNG file to write (default: edit.png in the scene's folder, or none with --save)."""
    save: str | None = None
    """Folder for the changed scene."""


@dataclass(frozen=True, kw_only=True)
class ViewConfig(TrustOption, ThresholdOption, TileOption, DeviceOption, CommandConfig):
    """Explore a scene or run in the browser."""

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE|RUN")]
    """Scene of drivesem derender, a folder of scenes, or a run of drivesem attack."""
    frame: str | None = None
    """Frame to start with, by name (default: the first)."""
    detector: str | None = None
    """Detector: shipped, a weights file, or another project's (default: the run's, else squeezedet)."""
    budget: str = "street"
    """Range of the sliders: a preset, a YAML file, or NAME=VALUE with commas, as in drivesem attack."""
    port: Annotated[int, NumberRange(0, 65535, expected="0 (any that is free) to 65535")] | None = None
    """Port of 127.0.0.1 (default: 8321, or the next that is free)."""
    browser: bool = True
    """Open the page in the browser."""


@dataclass(frozen=True, kw_only=True)
class SynthConfig(FrameCommandConfig):
    """Generate street scenes with exact ground truth."""

    out: FolderOrUrl = None
    """Folder or URL of the data set; the same command resumes what it finds there."""
    frames: Count = 10
    """Number of frames; each is made in every variation."""
    layout: Literal["kitti", "vkitti2", "vkitti1", "coco", "yolo"] = "kitti"
    """Layout of the data set: KITTI object, Virtual KITTI 2 or 1.3.1, COCO JSON, YOLO."""
    split: Literal["train", "heldout"] = "train"
    """Pool of vehicle shapes and surroundings; the two pools share nothing."""
    variations: str | None = None
    """Variations of Virtual KITTI with commas, such as clone,fog,15-deg-left; all; or mixed weather."""
    sequence: Count | None = None
    """Frames per drive, at 10 per second, with tracks (default: 10 for Virtual KITTI, else 1)."""
    people: bool | None = None
    """Add pedestrians and cyclists (default: in all layouts but Virtual KITTI's)."""
    varied_people: Flag = False
    """Vary people: coats, skirts, hats, bags, children, people side by side, motorcycles."""
    cameras: Literal[1, 2] = 1
    """Number of cameras; 2 adds the right camera of Virtual KITTI 2."""
    validation: Annotated[float, NumberRange(0, 1, "[)", "a fraction in [0, 1)")] = 0.0
    """Fraction of the frames in part val, with shapes that part train does not contain."""
    night: Annotated[float, NumberRange(0, 1, "[]", "a fraction in [0, 1]")] = 0.0
    """Fraction of the streets by night: lamps, lit windows, some in rain."""
    edits: str | None = None
    """YAML file of changes to the scenes: vehicles, weather, foliage."""
    meshes: str | None = None
    """Folder of vehicle meshes (OBJ, GLB, PLY) instead of the generated ones."""
    assets: str | None = None
    """Folder of the optional vehicles and skies of tools/fetch_assets.py."""
    sheet: Flag = False
    """Write sheet.jpg: frames with boxes, depth, classes and instances, as read back."""
    compare: Flag = False
    """Write distributions.png and .md: sizes, distances, angles and occlusion, compared with KITTI."""

    def check(self) -> None:
        super().check()
        refuse(self.cameras == 2 and self.layout != "vkitti2", "--cameras", "1, or --layout vkitti2", self.cameras)
        no_people = f"False with --layout {self.layout}, which has no class for them"
        refuse(bool(self.people) and self.layout.startswith("vkitti"), "--people", no_people, True)
        without = self.people is False or self.layout.startswith("vkitti")
        refuse(self.varied_people and without, "--varied-people", "a data set with people", "one without")


@dataclass(frozen=True, kw_only=True)
class BenchOptions(InferenceOptions, SceneOptions, FrameCommandConfig):
    """Options that benchmarks share."""

    quick: Flag = False
    """Measure with fewer repetitions."""
    cars: Annotated[str, ParsedBy(parse_integers)] = "1,4,8,16"
    """Numbers of cars, 1 to 16, with commas."""
    triangles: Annotated[str, ParsedBy(partial(parse_integers, minimum=4))] = "2000,5000"
    """Triangles per car, with commas."""
    threads: Count | None = None
    """Threads of torch and of the kernels (default: torch's choice)."""
    detector: str = "squeezedet"
    """Detector: a shipped one, or a .safetensors file of one."""
    markdown: str | None = None
    """Markdown file in which the section on this benchmark is rewritten."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig(BenchOptions):
    """Measure attack steps, rendering and run time on this machine."""

    basic: ClassVar[tuple[str, ...]] = (
        *("what", "quick", "cars", "triangles", "boxes", "frames", "dataset", "root", "limit", "count", "attack"),
        *("threads", "detector", "out", "markdown", "workers", "device", "seed", "json"),
    )

    what: tyro.conf.Positional[Literal["step", "render", "night"]] = "step"
    """step: an attack step and the detector alone; render: both renderers; night: run time for all of --root."""
    boxes: Annotated[str, OnlyWith("what", ("step",))] | None = None
    """Tar archive of KITTI's label_2 and calib with the vehicles that step measures."""
    frames: Count = 40
    """Frames of --boxes; a quarter of them with --quick."""
    limit: Count | None = None
    """Frames that night measures, evenly spread (default: 20)."""
    count: Count | None = None
    """Frames that night estimates for (default: all with vehicles)."""
    attack: str | None = None
    """Attack that night times: its options in quotes, a run's folder, a preset or a YAML file (default: no options)."""

    def check(self) -> None:
        super().check()
        data = self.what == "night" or self.dataset == DEMO
        refuse(not data, "--dataset", "demo, except with night", self.dataset)


@dataclass(frozen=True, kw_only=True)
class EvalConfig(FrameFilterOptions, TileOption, WorkerOptions, CommandConfig):
    """Compute detection metrics (COCO, KITTI, VOC) for a detector or a prediction file."""

    gt: FolderOrUrl = None
    """Labels: a KITTI, YOLO, VOC or Virtual KITTI folder, a COCO or BDD100K JSON file, or a run of drivesem attack."""
    pred: FolderOrUrl = None
    """Detections: KITTI result files with scores, COCO results, YOLO text files, or a run."""
    pred_b: FolderOrUrl = None
    """Second detections of the same frames, compared with the first by a paired test."""
    protocol: Literal["coco", "kitti", "voc"] = "coco"
    """Evaluation protocol."""
    gt_format: Literal["auto", "kitti", "coco", "yolo", "vkitti1", "vkitti2", "voc", "bdd100k", "run"] = "auto"
    """Layout of --gt; auto detects it."""
    pred_format: Literal["auto", "kitti", "coco", "yolo", "run"] = "auto"
    """Layout of --pred and --pred-b; auto detects it."""
    small_detections: Literal["ignore", "count"] = "ignore"
    """KITTI detections below the minimum height: ignored (development kit of 2017) or counted (the older one)."""
    map: ClassMap | None = None
    """Class names of the detections (with --detector: of the data set), such as person=Pedestrian; bus=- drops one."""
    map_gt: ClassMap | None = None
    """Class names of the labels, in the same form."""
    classes: str | None = None
    """Classes to evaluate, with commas (default: all)."""
    frames: str | None = None
    """File of the frames to evaluate, one identifier per line (default: all)."""
    by: str | None = None
    """Attributes of frames, such as weather,timeofday: a table of recall by condition, at equal box heights too."""
    reference: str | None = None
    """Values of --by that give the box heights, such as clear,daytime (default: the condition with most frames)."""
    stage: Stage = "attacked"
    """Detections of a run: after the attack by moved or benign labels, re-rendered, or in the photograph."""
    stage_b: Stage | None = None
    """The same for --pred-b (default: --stage)."""
    bootstrap: NotNegative | None = None
    """Bootstrap samples for intervals and paired tests (default: 200; 0 for over 5,000 frames of one detector)."""
    seed: int = 0
    """Seed of the bootstrap."""
    out: str | None = None
    """Folder for metrics.json, CSV, Markdown and PNG."""
    detector: str | None = None
    """Detector to run instead of reading --pred: shipped, a weights file, or another project's."""
    dataset: Annotated[str, OneOf(DATASETS)] = "kitti"
    """Data set for --detector: kitti, vkitti1, vkitti2, coco or yolo."""
    root: FolderOrUrl = None
    """Folder or URL of that data set."""
    limit: Count | None = None
    """Number of its frames, from the first."""
    device: str = "cpu"
    """torch device of --detector."""
    min_height: float = 25.0
    """Smallest height of an object that counts with --detector, px."""
    max_occlusion: int = 1
    """Largest occlusion of an object that counts with --detector, KITTI's 0 to 3."""
    max_truncation: float = 1.0
    """Largest truncated fraction of an object that counts with --detector."""
    pictures: NotNegative = 0
    """Number of frames with most errors of --detector to draw into --out."""

    def check(self) -> None:
        super().check()
        files, detector = None not in (self.gt, self.pred), self.detector is not None
        given = "both" if self.gt else "neither"
        refuse(files == detector, "--gt and --pred, or --detector", "one or the other", given)
        refuse(detector and self.root is None, "--root", f"the folder of data set {self.dataset!r}", "nothing")
        changed = [field.name for field in fields(WorkerOptions) if getattr(self, field.name) != field.default]
        refuse(bool(changed) and not detector, option_name("".join(changed[:1])), "--detector", "none")
        nowhere = self.pictures > 0 and (not detector or self.out is None)
        refuse(nowhere, "--pictures", "--detector and --out", "one of them missing")
        refuse(self.reference is not None and self.by is None, "--reference", "--by", "none")
        refuse(self.split is not None and not detector, "--split", "--detector", "none")


@dataclass(frozen=True, kw_only=True)
class CheckConfig(TileOption, DeviceOption, DataSourceOptions, CommandConfig):
    """Test a detector against the contract, and see what it detects. Exit code 1 if a promise is broken."""

    detector: str
    """Detector: shipped, a weights file, or another project's."""
    size: str = "320x192"
    """Size of the test pictures, WIDTHxHEIGHT, px."""
    out: PictureFile = None
    """File of a picture of the streets with the detected boxes, PNG or JPEG; an existing one is replaced."""


@dataclass(frozen=True, kw_only=True)
class InspectConfig(FrameFilterOptions, CommandConfig):
    """Show what is read of a data set: files, classes, splits, and a contact sheet."""

    root: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ROOT")]
    """Folder or URL of the data set, or its COCO or YOLO file."""
    dataset: Annotated[str, OneOf(("auto", *DATASETS))] = "auto"
    """Layout: kitti, vkitti1, vkitti2, coco, yolo, voc, bdd100k; auto detects it."""
    images: NotNegative = 12
    """Number of images on the contact sheet, evenly spaced; 0 for no sheet."""
    out: Annotated[str, tyro.conf.arg(aliases=["-o"])] = "contact-sheet.jpg"
    """File of the contact sheet, JPEG or PNG; an existing one is replaced."""


@dataclass(frozen=True, kw_only=True)
class ConvertConfig(CommandConfig):
    """Convert labels between formats."""

    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SOURCE")]
    """Labels: a KITTI, YOLO or Virtual KITTI folder, a COCO JSON file, or a run of drivesem attack."""
    out: Annotated[str, tyro.conf.arg(aliases=["-o"])]
    """Folder to write, new or empty; or a .json file for COCO."""
    to_format: Annotated[LabelFormat, tyro.conf.arg(aliases=["--to"])]
    """Format to write."""
    from_format: Annotated[
        Literal["auto", "kitti", "coco", "yolo", "vkitti1", "vkitti2", "voc", "bdd100k", "run"],
        tyro.conf.arg(aliases=["--from"]),
    ] = "auto"
    """Format of SOURCE; auto detects it."""
    scores: Flag = False
    """Read detections with scores, not labels."""
    images: str | None = None
    """Folder of the images, for their sizes in COCO and YOLO (default: where SOURCE has them)."""
    image_size: str | None = None
    """Size of all images, WIDTHxHEIGHT, px, instead of reading it from the files."""
    copy_images: Flag = False
    """Copy the images to the output."""
    map: ClassMap | None = None
    """Class names, such as car=Car,person=Pedestrian; bus=- leaves a class out."""


@dataclass(frozen=True, kw_only=True)
class ExportConfig(CommandConfig):
    """Export counterexamples as training data, tables or 3D files."""

    run: RunFolder = None
    """Folder of a run of drivesem attack; for gltf also a scene, or a folder of scenes."""
    out: NewFolder = None
    """Folder to write, new or empty."""
    to_format: Annotated[Literal[LabelFormat, "tables", "gltf", "gate"], tyro.conf.arg(aliases=["--to"])]
    """Format: a labelled data set; tables (CSV, Parquet); gltf (3D scenes); gate (a package for drivesem gate)."""
    grade: Literal["all", "threshold", "certain", "confirmed", "shared"] = "threshold"
    """Lowest grade of the failures to export; all also exports frames without failures."""
    map: ClassMap | None = None
    """Class names, such as Car=car,Truck=truck; Truck=- leaves a class out."""

    def check(self) -> None:
        super().check()
        whole = self.to_format == "gate" and (self.grade, self.map) != (ExportConfig.grade, None)
        refuse(whole, "--grade, --map", "none with --to gate, which takes all certain failures", "one")


@dataclass(frozen=True, kw_only=True)
class TrainConfig(FrameFilterOptions, TrainingOptions, FrameCommandConfig):
    """Train a detector."""

    basic: ClassVar[tuple[str, ...]] = (
        *("detector", "dataset", "root", "split", "held_out", "held_out_split", "validation", "frames", "weights"),
        *("start", "anchors", "steps", "minutes", "batch", "rate", "semantic", "out", "device", "seed", "json"),
    )

    detector: str = "squeezedet"
    """Architecture: squeezedet, or another one of the training guide."""
    dataset: Annotated[str, OneOf((*DATASETS, SYNTH))] = "kitti"
    """Data set: kitti, vkitti1, vkitti2, coco, yolo, voc, bdd100k; or synth: frames that the generator makes first."""
    root: str | None = None
    """Folder of the data set; several with commas are joined."""
    held_out: str | None = None
    """Folder of frames that select the best weights and set t*, in the same layout."""
    held_out_split: str | None = None
    """Frames of --held-out, or of --root without it, in the form of --split."""
    validation: str | None = None
    """Folder of frames that select weights and t* instead of --held-out, which then only measures."""
    also: str | None = None
    """Folder of further frames to evaluate for the model card, in KITTI's layout."""
    frames: Annotated[int, POSITIVE] = 1000
    """Frames to generate for training with --dataset synth."""
    held_out_frames: NotNegative = 100
    """Frames to generate for evaluation, with other shapes and surroundings; 0 for none."""
    weights: str | None = None
    """File for the best weights and their model card (default: DETECTOR.safetensors in the run's folder)."""
    start: str = "auto"
    """First weights: auto (shipped), none, squeezenet, darknet:FILE.cfg,FILE.weights, or a .safetensors file."""
    anchors: Literal["published", "kmeans"] | int = "published"
    """Anchors of SqueezeDet: published, or kmeans of the boxes; a number N prints N anchors and trains nothing."""
    steps: Annotated[int, POSITIVE] = 10000
    """Training steps."""
    batch: Annotated[int, POSITIVE] = 16
    """Views per step, over all processes."""
    optimiser: Literal["adamw", "sgd"] = "adamw"
    """Optimiser; sgd uses --momentum."""
    momentum: Annotated[float, NumberRange(0, 1, "[)")] = 0.9
    """Momentum of sgd."""
    rate: Annotated[float, POSITIVE] = 1e-3
    """Peak learning rate."""
    backbone_rate: float = 0.3
    """Learning rate of a pretrained backbone, relative to the other layers'."""
    weight_decay: float = 1e-4
    """Weight decay per step, relative to the learning rate."""
    warmup_power: float = 1.0
    """Power of the steps with which the learning rate rises (Darknet's burn-in: 4)."""
    drops: Annotated[str, ParsedBy(parse_integers)] | None = None
    """Steps, with commas, at which the learning rate drops (default: a half cosine instead)."""
    drop_factor: float = 0.1
    """Factor of each drop of the learning rate."""
    clip: Annotated[float, POSITIVE] = 50.0
    """Largest norm of a gradient."""
    average: Annotated[float, NumberRange(0, 1, "[)")] = 0.998
    """Decay per step of the moving average of the weights, which is evaluated and saved."""
    dropout: Annotated[float, NumberRange(0, 1, "[)")] = 0.5
    """Dropout rate, of detectors with dropout."""
    evaluate_every: NotNegative = 500
    """Steps between evaluations; 0 evaluates at the end only."""
    thin: Annotated[int, POSITIVE] = 1
    """Stride of the frames in evaluations before the last."""
    semantic: Annotated[float, NumberRange(0, 1, "[)")] = 0.0
    """Fraction of views with random scene changes, by the project's renderer; needs 3D boxes."""
    loaders: NotNegative = 0
    """Threads that prepare views ahead (for GPUs); 0 prepares them between steps."""
    note: Annotated[str, AllowsUrl()] = ""
    """Remark for the model card."""

    def check(self) -> None:
        super().check()
        synth, root = self.dataset == SYNTH, self.root is not None
        refuse(not synth and not root, "--root", f"the folder of data set {self.dataset!r}", "nothing")
        given = root or (self.held_out, self.validation) != (None, None)
        folders = "--root, --held-out, --validation"
        refuse(synth and given, folders, "none with --dataset synth, which makes its own frames", "one")
        split = self.split or self.held_out_split
        refuse(synth and split is not None, "--split, --held-out-split", "none with --dataset synth", split)
        chosen = self.where or self.map
        refuse(synth and chosen is not None, "--where, --map", "none with --dataset synth", chosen)
        unheld = self.validation is not None and self.held_out is None
        refuse(unheld, "--held-out", "frames to measure on, with --validation", "none")
        fitted = not isinstance(self.anchors, int) or (self.anchors > 0 and not synth)
        refuse(not fitted, "--anchors", "a number above 0 and a data set with labels", self.anchors)


@dataclass(frozen=True, kw_only=True)
class RetrainConfig(TrustOption, TrainingOptions, FrameCommandConfig):
    """Fine-tune a detector on counterexamples and attack it again."""

    basic: ClassVar[tuple[str, ...]] = (
        *("run", "dataset", "root", "start", "fraction", "mix", "label_mode", "validation", "fresh", "steps"),
        *("attack_steps", "minutes", "batch", "rate", "out", "workers", "device", "seed", "json"),
    )

    run: str
    """Folder of a run of drivesem attack."""
    dataset: Annotated[str, OneOf(DATASETS)] | None = None
    """Benign frames: kitti, vkitti1, vkitti2, coco or yolo (default: the run's photographs)."""
    root: str | None = None
    """Folder of that data set."""
    start: str | None = None
    """First weights: a shipped detector or a .safetensors file (default: the detector of the run)."""
    fraction: Fraction = 0.25
    """Fraction of counterexamples in the training set."""
    mix: Literal["replace", "add"] = "replace"
    """Counterexamples replace random benign frames, or are added to them."""
    label_mode: Literal["paper", "moved"] = "paper"
    """Training labels of counterexamples: benign as in the paper, or moved with the vehicles."""
    ramp: FractionOrEnds = 0.0
    """Fraction of the steps over which counterexamples come in; 0: all from the first step."""
    validation: Fraction = 0.25
    """Fraction of the run's frames to evaluate on; they are never trained on."""
    fresh: NotNegative | None = None
    """Evaluation frames to attack again with the retrained detector (default: all)."""
    attack_steps: Count | None = None
    """Steps of that attack (default: the run's)."""
    steps: Annotated[int, POSITIVE] = 6000
    """Training steps."""
    rate: Annotated[float, POSITIVE] = 3e-4
    """Peak learning rate of AdamW, which falls in a half cosine."""

    def check(self) -> None:
        super().check()
        single = (self.dataset is None) != (self.root is None)
        refuse(single, "--dataset and --root", "both or none", "one of them")


@dataclass(frozen=True, kw_only=True)
class ClassifyConfig(FrameCommandConfig):
    """Attack image classifiers instead of detectors."""

    basic: ClassVar[tuple[str, ...]] = (
        *("what", "folder", "network", "objects", "split", "params", "method", "steps", "queries", "grade"),
        *(
            "layers",
            "epochs",
            "batch",
            "samples",
            "tolerance",
            "out",
            "limit",
            "workers",
            "device",
            "seed",
            "json",
        ),
    )

    what: tyro.conf.Positional[Literal["data", "train", "attack", "confirm", "explain", "holes", "gate"]]
    """data: render pictures; train or attack a network; confirm, explain, holes, gate: analyse a finished RUN."""
    folder: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="RUN")] = None
    """Folder of a run of drivesem classify attack."""
    renderer: Literal["auto", "mitsuba", "pyrender"] = "auto"
    """Second renderer of confirm (auto: Mitsuba if installed, else pyrender)."""
    samples: Annotated[int, at_least(24, "which a rule needs")] = 64
    """Poses around each failure that holes and gate evaluate, with nuisances."""
    fresh: Count = 32
    """New poses inside each rule of holes, which estimate its failure rate."""
    reach: Annotated[float, POSITIVE] = 0.6
    """Range of pitch, yaw and roll around a failure for holes and gate, rad either way."""
    tolerance: FractionOrEnds = 0.05
    """Accepted increase of the misclassification rate for gate: per failure, per class, and overall."""
    allow_empty: Annotated[Flag, OnlyWith("what", ("gate",))] = False
    """Pass gate (exit code 0) if the run has no certain failure."""
    objects: str | None = None
    """Folder of ShapeNetCore v2, or of meshes by class (default: 12 generated classes)."""
    split: Literal["train", "val", "test"] = "test"
    """Split of the objects to attack."""
    views: str = "forward,top,left,right"
    """Camera views of each object, with commas."""
    backgrounds: Annotated[str, ExistingFolder("a folder of photographs")] | None = None
    """Folder of photographs as backgrounds (default: generated ones)."""
    network: str = ""
    """Network: squeezenet, vgg16, resnet50, torchvision:NAME, timm:NAME, weights of classify train, or ONNX."""
    weights: Annotated[str, OnlyWith("what", ("train",))] | None = None
    """First weights of training, such as torchvision's file."""
    data: Annotated[str, OnlyWith("what", ("train",)), ExistingFolder("a folder of classify data")] | None = None
    """Pictures of classify data to train on (default: rendered now)."""
    layers: Literal["last", "all"] = "last"
    """Layers to train: the last, on features that are computed once as in the paper, or all."""
    epochs: Count = 20
    """Training epochs."""
    batch: Count = 32
    """Pictures per training step."""
    optimiser: Literal["adam", "sgd"] = "adam"
    """Optimiser of training: adam with a cosine schedule, or sgd (momentum 0.9) at one rate, as in the paper's code."""
    rate: Annotated[float, POSITIVE] | None = None
    """Learning rate (default: 0.003 for the last layer, 0.0001 for all)."""
    normalisation: Literal["network", "rendered"] = "network"
    """Normalisation of pictures for train: the network's, or the mean and deviation in the paper's code."""
    lamp: Literal["white", "coloured"] = "white"
    """Lamp: white near the camera, or coloured, 100 sizes off, R, G and B attacked apart, as in the paper's code."""
    half: Annotated[NotNegative, OnlyWith("what", ("train",))] = 0
    """Epochs, from the first, with pictures of half the size, for --layers all."""
    precision: Annotated[Literal["float32", "bfloat16"], OnlyWith("what", ("train",))] = "float32"
    """Floating-point format of training with --layers all; bfloat16 where the CPU has it."""
    params: str | None = None
    """Parameters to attack, with commas: vertex, pose, lighting (default: pose,vertex; pose without gradients)."""
    shape: Literal["each", "smooth"] = "each"
    """Motion of vertices: each by itself as in the paper, or with a 4x4x4 lattice around the object."""
    turns: Literal["add", "compose"] = "add"
    """Turns of several steps: add pitch, yaw and roll, or compose about the current centre, as in the paper's code."""
    vertex_groups: Literal["object", "part"] = "object"
    """Normalisation of vertex gradients in sgd and scw: over the object, or each part, as in the paper's code."""
    attack_misclassified: Flag = False
    """Also attack pictures that are misclassified unchanged, and let the last iterate count, as in the paper's code."""
    method: Literal["si-fgsm", "sgd", "scw", "random", "halton"] = "si-fgsm"
    """Search method: si-fgsm, sgd, scw use gradients as in the paper; random, halton sample --within-*."""
    steps: Count = 5
    """Gradient steps; an attack ends at its first success."""
    queries: Annotated[Count, OnlyWith("method", ("random", "halton"))] = 5
    """Samples per picture of random and halton."""
    sampled: Literal["pose", "vertex,turn"] = "pose"
    """Samples of random and halton: of --params, or of vertices and one angle for all turns, as in the paper's code."""
    step_vertex: Annotated[float, POSITIVE] | None = None
    """Step of a vertex, in object sizes (default: the paper's for VGG-16, as for all steps)."""
    step_pose: Annotated[float, POSITIVE] | None = None
    """Step of the pose, rad."""
    step_lighting: Annotated[float, POSITIVE] | None = None
    """Step of the light, as a fraction of it."""
    within_vertex: Annotated[float, POSITIVE] | None = None
    """Bound of a vertex along each axis, in object sizes."""
    within_pose: Annotated[float, POSITIVE] | None = None
    """Bound of pitch, yaw and roll, rad (default for random and halton: 0.75)."""
    within_lighting: Annotated[float, POSITIVE] | None = None
    """Bound of the light, as a fraction of it."""
    constant: Annotated[float, OnlyWith("method", ("scw",)), POSITIVE] = 0.1
    """Weight of a logit relative to the size of the change in scw."""
    norm: Annotated[Literal[1, 2], OnlyWith("method", ("scw",))] = 2
    """Norm of the change that scw keeps small."""
    scw_step: Literal["adam", "unit"] = "adam"
    """Steps of scw: Adam's, or the gradient over its 2-norm, with squared distances, as in the paper's code."""
    target: Annotated[str, OnlyWith("method", ("scw",))] | None = None
    """Class that scw makes the network predict (default: any wrong one)."""
    draws: Annotated[int, at_least(MIN_DRAWS, "which a certificate's rule needs")] = MIN_DRAWS
    """Nuisance samples before and after the change, for each certificate."""
    grade: bool = True
    """Compute certificates; without them every failure has the grade threshold."""
    nuisances: str = "shift_px=3"
    """Nuisances of the samples: NAME=NUMBER with commas (docs/guide/ideas.md)."""

    def __post_init__(self) -> None:
        # gate has no default: a network compared with itself passes every gate.
        if not self.network and self.what != "gate":
            object.__setattr__(self, "network", _DEFAULT_NETWORK)

    def check(self) -> None:
        super().check()
        last = f"--layers {self.layers}"
        for name in ("half", "precision"):
            changed = getattr(self, name) != getattr(ClassifyConfig, name) and self.layers == "last"
            refuse(changed, f"--{name}", "--layers all", last)
        refuse(self.half > self.epochs, "--half", f"at most --epochs, {self.epochs}", self.half)
        trained = self.what == "train" and self.normalisation == "rendered"
        other = "vgg16, resnet50 or another that takes mean and deviation with --normalisation rendered"
        refuse(trained and self.network == _DEFAULT_NETWORK, "--network", other, self.network)
        scw, adam = self.method == "scw", self.scw_step == "adam"
        refuse(self.norm != 2 and not adam, "--norm", f"2 with --scw-step {self.scw_step}", self.norm)
        composed = scw and adam and self.turns == "compose"
        refuse(composed, "--turns", "add with --method scw --scw-step adam", self.turns)
        divided = self.vertex_groups == "part" and self.shape == "smooth"
        refuse(divided, "--vertex-groups", "object with --shape smooth", self.vertex_groups)
        sampled = self.method in ("random", "halton") and self.sampled == "vertex,turn" and self.params is not None
        both = {"vertex", "pose"} <= {part.strip() for part in (self.params or "").split(",")}
        refuse(sampled and not both, "--params", f"vertex and pose with --sampled {self.sampled}", self.params)
        of_run = self.what in _CLASSIFY_RUN
        run = f"a folder of drivesem classify attack, to {self.what}"
        refuse(of_run and not self.folder, "RUN", run, "nothing")
        refuse(not of_run and self.folder is not None, "RUN", f"none with classify {self.what}", self.folder)
        refuse(not self.network, "--network", "the network that replaces the run's", "nothing")
        elsewhere = self.what == "confirm" and self.out is not None
        refuse(elsewhere, "--out", "none with classify confirm, which writes to the run", self.out)


@dataclass(frozen=True, kw_only=True)
class DoctorConfig(CommandConfig):
    """Show what is installed and how to add what is missing."""


COMMANDS: dict[str, type[CommandConfig]] = {
    "attack": AttackConfig,
    "drive": DriveConfig,
    "classify": ClassifyConfig,
    "verify": VerifyConfig,
    "confirm": ConfirmConfig,
    "explain": ExplainConfig,
    "holes": HolesConfig,
    "transfer": TransferConfig,
    "gate": GateConfig,
    "retrain": RetrainConfig,
    "train": TrainConfig,
    "eval": EvalConfig,
    "export": ExportConfig,
    "inspect": InspectConfig,
    "convert": ConvertConfig,
    "derender": DerenderConfig,
    "edit": EditConfig,
    "render": RenderConfig,
    "view": ViewConfig,
    "synth": SynthConfig,
    "check": CheckConfig,
    "doctor": DoctorConfig,
    "bench": BenchConfig,
    "report": ReportConfig,
    "runs": RunsConfig,
}
"""Settings of each command, by name."""
