"""Settings that several commands share, each declared once: its type and range, its default, what `--help` says.

A block is a base class. A command's settings are its blocks' fields and its own, in one flat dataclass: options,
keys of config.yaml and attributes do not tell which block a setting is from. A function takes the narrowest block
that it reads, as `open_source(config: Scenes)` does. A command for which a setting means something else declares
it again, with a default or a docstring of its own.

This module is loaded by `drivesem --help`: it imports nothing heavy.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, get_args, get_type_hints

import tyro

from drivesem.config.constraints import (
    POSITIVE,
    AllowsUrl,
    Constraint,
    ForMethods,
    NumberRange,
    OneOf,
    Parsed,
    Required,
    at_least,
)
from drivesem.config.errors import refuse
from drivesem.config.values import interval, is_url, size_hw

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
Repeated = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
Count = Annotated[int, at_least(1)]
NotNegative = Annotated[int, at_least(0)]
RunFolder = Annotated[str | None, Required("a folder of drivesem attack")]
FolderOrUrl = Annotated[str | None, AllowsUrl()]
"""A folder, or its URL."""
CommandName = Annotated[str, tyro.conf.Fixed]
"""The name under which a command was called: set by the parser, for classes that serve several commands."""
Score = Annotated[float, NumberRange(0, 1, "(]", "a score in (0, 1]")]
LabelMode = Literal["moved", "paper"]

DEMO = "demo"
DATASETS = ("kitti", "vkitti1", "vkitti2", "coco", "yolo")
"""The readers of `drivesem.data.registry`."""
PHOTOGRAPHS, SCENES = "photographs", "scenes"
SOURCES = (DEMO, *DATASETS, PHOTOGRAPHS, SCENES)
"""What --dataset takes: the embedded scenes, the readers, photographs without labels, and scenes' folders."""
NO_CAMERA = ("coco", "yolo", PHOTOGRAPHS)
"""Where photographs need not tell their cameras."""

FINDER = "squeezedet"
"""Who finds vehicles in photographs without labels."""
CERTIFYING_DRAWS = 16
"""What the rule of certificates needs at least (`truth.certificate`)."""
KEEP_MB = 800.0
"""Of a detector's layers that a process keeps: SqueezeDet's are 24 MB for each picture of 1242 x 375 px."""
_MOST_PROCESSES = 4
"""Each process takes about 1 GB."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What all blocks have in common."""

    def check(self) -> None:
        """Raise UsageError for values that no command accepts: of a field, what its type declares; in blocks and
        commands that extend this, conditions between fields.
        """
        markers = constraints(type(self))
        for field in fields(self):
            value = getattr(self, field.name)
            if not any(isinstance(marker, AllowsUrl) for marker in markers[field.name]):
                for text in value if isinstance(value, tuple) else (value,):
                    here = not (isinstance(text, str) and is_url(text))
                    refuse(not here, option(field.name), "what is on this machine (docs/scale.md)", text)
            for marker in markers[field.name]:
                if isinstance(marker, ForMethods):
                    if value != field.default:
                        marker.check(option(field.name), vars(self)["method"])
                elif value is not None or isinstance(marker, Required):
                    marker.check(option(field.name), value)


def constraints(block: type[Options]) -> dict[str, tuple[Constraint, ...]]:
    """What each field's type declares of its values."""
    return {name: tuple(_markers(kind)) for name, kind in get_type_hints(block, include_extras=True).items()}


def _markers(kind: Any) -> Iterator[Constraint]:
    yield from (marker for marker in getattr(kind, "__metadata__", ()) if isinstance(marker, Constraint))
    for part in get_args(kind):
        yield from _markers(part)


def option(name: str) -> str:
    """How a setting is written on the command line."""
    return f"--{name.replace('_', '-')}"


def shared_options(config: Options, block: type[Options]) -> dict[str, Any]:
    """The settings of one block, to make another command's of."""
    return {field.name: getattr(config, field.name) for field in fields(block)}


@dataclass(frozen=True, kw_only=True)
class CommandConfig(Options):
    """The option that every command has."""

    json: Flag = False
    """Print one JSON object on standard output; everything else goes to standard error."""


@dataclass(frozen=True, kw_only=True)
class OutputOptions(Options):
    """A folder of results that a second run goes on with."""

    out: str | None = None
    """Folder for the results; a second run with the same folder goes on where it stopped."""
    resume: bool = True
    """Keep the frames that are already there."""


@dataclass(frozen=True, kw_only=True)
class LimitOption(Options):
    """How many frames."""

    limit: Count | None = None
    """Take the first N frames (those with vehicles, where a command needs vehicles). They follow one another:
    of Virtual KITTI, --split too, they are of one drive."""


@dataclass(frozen=True, kw_only=True)
class SeedOption(Options):
    """Where random numbers begin."""

    seed: int = 0
    """Seed of everything random."""


@dataclass(frozen=True, kw_only=True)
class WorkerOptions(Options):
    """Frames that are shared by processes."""

    workers: Count | None = None
    """Processes that share the frames; by default one a core, at most 4."""
    keep_going: Flag = False
    """List a frame that cannot be used, or on which drivesem fails, in the results and go on with the rest."""
    engine: Literal["local", "ray"] = "local"
    """What shares the frames: processes of this machine, or of a Ray cluster (docs/scale.md)."""
    address: Annotated[str | None, AllowsUrl()] = None
    """Address of the Ray cluster, such as auto or ray://HOST:10001; by default one on this machine alone."""

    def check(self) -> None:
        super().check()
        refuse(self.address is not None and self.engine == "local", "--address", "--engine ray beside it", "local")

    @property
    def processes(self) -> int:
        """How many processes share the frames."""
        return self.workers or min(os.cpu_count() or 1, _MOST_PROCESSES)


@dataclass(frozen=True, kw_only=True)
class DeviceOption(Options):
    """Where networks run."""

    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1, ..."""


@dataclass(frozen=True, kw_only=True)
class FrameCommandConfig(DeviceOption, WorkerOptions, SeedOption, LimitOption, OutputOptions, CommandConfig):
    """What every command takes that works through frames into a folder."""


@dataclass(frozen=True, kw_only=True)
class DataSourceOptions(SeedOption, LimitOption):
    """Frames: the embedded scenes, or a data set's."""

    dataset: Annotated[str, OneOf(SOURCES)] = DEMO
    """demo (generated scenes, needs no data), kitti, vkitti1, vkitti2, coco or yolo; photographs (without labels);
    scenes (of drivesem derender)."""
    root: FolderOrUrl = None
    """Folder of the data set, such as KITTI's with training/image_2, label_2 and calib, or its URL; one photograph
    or a folder of them; one scene or a folder of them."""

    def check(self) -> None:
        super().check()
        demo, given = self.dataset == DEMO, self.root is not None
        refuse(not demo and not given, "--root", f"the folder of data set {self.dataset!r}", "nothing")
        no_folder = "no folder for data set 'demo' (did you mean --dataset kitti?)"
        refuse(demo and given, "--root", no_folder, self.root)


@dataclass(frozen=True, kw_only=True)
class SceneOptions(DataSourceOptions):
    """Frames, and how photographs are taken apart."""

    split: str | None = None
    """Of --root: the frames that 3D-SDN tests on (3d-sdn; Virtual KITTI) or trains on (3d-sdn-train); a share at
    random (random:0.75) or all others (random:0.75:rest); or a file of names, one a line (docs/derender.md)."""
    fit: bool = True
    """Fit template, pose and shape to the photograph's silhouettes (data sets of photographs only)."""
    cache: str | None = None
    """A folder that keeps photographs as they were taken apart, for the next attack on them."""
    cache_gb: Annotated[float, NumberRange(0, ends="()", expected="a number above 0")] = 4.0
    """How large --cache may grow; what was not asked for longest goes first."""
    focal: Annotated[float, NumberRange(0, ends="()", expected="positive px")] | None = None
    """Focal length, px, of photographs that do not tell their camera (photographs, coco, yolo); by default EXIF's,
    or 0.58 of the longer side."""
    finder: str = FINDER
    """Of --dataset photographs: the detector that finds the vehicles, shipped or a file."""

    def check(self) -> None:
        super().check()
        beside = f"--dataset {self.dataset}"
        useless = self.cache is not None and self.dataset in (DEMO, SCENES)
        refuse(useless, "--cache", "a --dataset of photographs beside it", beside)
        labelled = self.dataset in DATASETS
        refuse(self.split is not None and not labelled, "--split", f"--dataset {', '.join(DATASETS)}", beside)
        self._check_photographs(beside)

    def _check_photographs(self, beside: str) -> None:
        known = self.focal is not None and self.dataset not in NO_CAMERA
        refuse(known, "--focal", f"--dataset {', '.join(NO_CAMERA)}", beside)
        refuse(
            self.finder != FINDER and self.dataset != PHOTOGRAPHS, "--finder", f"--dataset {PHOTOGRAPHS}", beside
        )


@dataclass(frozen=True, kw_only=True)
class ThresholdOption(Options):
    """When a detection counts."""

    t_star: Score | None = None
    """Score from which a detection counts; by default the detector's own, or 0.3 where it has none."""


@dataclass(frozen=True, kw_only=True)
class TileOption(Options):
    """How ONNX detectors look."""

    tiles: Literal["auto", "off"] = "auto"
    """Of an ONNX detector: auto looks at the whole frame and at overlapping parts of it, enlarged."""


@dataclass(frozen=True, kw_only=True)
class PrecisionOptions(DeviceOption):
    """What networks compute in."""

    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """What the network computes in: bfloat16 where the processor has it, float16 on GPUs."""

    def check(self) -> None:
        super().check()
        slow = self.precision == "float16" and self.device.startswith("cpu")
        refuse(slow, "--precision", "float32 or bfloat16 on a CPU", self.precision)


@dataclass(frozen=True, kw_only=True)
class BootstrapOption(Options):
    """Intervals of figures."""

    bootstrap: NotNegative | None = None
    """Draws of frames for intervals, by default 200; 0 leaves them out."""


@dataclass(frozen=True, kw_only=True)
class SeededBootstrapOptions(BootstrapOption, SeedOption):
    """Intervals, where nothing else is random."""

    seed: int = 0
    """Seed of these draws."""


@dataclass(frozen=True, kw_only=True)
class DetectionOptions(BootstrapOption, ThresholdOption, TileOption, DeviceOption, WorkerOptions, SeedOption):
    """How detectors are asked about pictures of runs."""

    t_star: Score | None = None
    """Score from which a detection counts, of detectors that have no threshold of their own; by default 0.3."""


@dataclass(frozen=True, kw_only=True)
class RunOption(Options):
    """A run that a question is asked of."""

    run: RunFolder = None
    """Folder of a run of drivesem attack."""


@dataclass(frozen=True, kw_only=True)
class TrustOption(Options):
    """Whether a run may bring code of its own."""

    trust: Flag = False
    """Run the code that a run's settings name as its detector (module:, torchscript:, export:, ultralytics:)."""


@dataclass(frozen=True, kw_only=True)
class InferenceOptions(Options):
    """How detectors look at changed pictures."""

    whole: Flag = False
    """Compute the detector's whole pass for each picture; by default only what changed, with the same result,
    where its layers are known (docs/detectors.md)."""
    incremental: Flag = False
    """The default by its name: only what changed, also of a run with --whole."""
    keep_mb: Annotated[float, at_least(1)] = KEEP_MB
    """MB of layers that a process keeps of a frame's pictures, at most 120 of one; the rest is computed again."""

    def check(self) -> None:
        super().check()
        refuse(self.whole and self.incremental, "--incremental", "it or --whole", "both")

    def whole_beside(self, run: bool) -> bool:
        """Whether passes are whole in a question to a run. run: whether they were in the run."""
        return self.whole or (run and not self.incremental)


@dataclass(frozen=True, kw_only=True)
class SearchOptions(ThresholdOption, PrecisionOptions):
    """What is attacked, how far it may go, and what is raised."""

    detector: str = "squeezedet"
    """A shipped detector, a file, or another project's (docs/detectors.md); without a gradient, such as an ONNX
    graph, for the methods that need none."""
    steps: Count = 10
    """Steps, each one query of the detector's gradient; FGSM goes as far in one; of scw, for each constant."""
    budget: str = "paper"
    """How far parameters may go: paper; parking (0.5 m, 5 degrees); street (4 m along, 1 m across, 20 degrees,
    10 % in size, 15 degrees of sun); a YAML file; or translate=0.5m,rotate=5deg, also after a preset:
    street,translate=2m."""
    parametrisation: Literal["ground", "roi"] = "ground"
    """What a car's place is told in. ground: own lengths along and across its heading; roi: as 3D-SDN, which the
    paper moved: the offset of its middle in sizes of its box in the picture, and log depth (docs/attacks.md)."""
    objective_labels: LabelMode = "moved"
    """Labels the attack aims at: moved with the cars, or the benign ones as in the paper."""
    objective: Literal["objectness", "confidence", "total", "failure", "hide", "phantom", "localisation"] = (
        "objectness"
    )
    """What the attack raises. objectness: the detector's confidence term, with 1 as the target of what finds the
    true objects; confidence: SqueezeDet's as published, with the IoU of the predicted box; total: its whole loss;
    hide: objects fall below t*; phantom: something rises to t* where nothing is; failure: both; localisation:
    boxes leave their objects."""
    keep: Literal["best", "last"] = "best"
    """Which iterate is handed back: the best of all, by failures, then by the objective; or the last, whatever it
    does, as in the paper."""
    project: Literal["feasible", "bounds"] = "feasible"
    """What each step is brought back to: what is feasible; or the bounds alone, as in the paper."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """What the detector computes its gradients in; what counts as a failure is always judged in float32."""


@dataclass(frozen=True, kw_only=True)
class SceneAttackOptions(InferenceOptions, SearchOptions, SceneOptions):
    """An attack, as far as a study gives it to all of its arms."""


@dataclass(frozen=True, kw_only=True)
class GradingOptions(Options):
    """How sure failures must be: certificates and who else is asked."""

    draws: Annotated[int, at_least(CERTIFYING_DRAWS, "which a certificate's rule needs")] = CERTIFYING_DRAWS
    """Draws before a change and after it, in which a failure must hold to be certain: right in 15 of 16, then
    wrong in 12 of 16."""
    nuisances: str = "default"
    """What a draw changes: default, off, or NAME=NUMBER with commas (shift_px, scale, gain, gamma, noise, blur_px,
    jpeg, position_m, angle_deg, size, code); 0 switches one off (docs/grades.md)."""
    confirm: bool = True
    """Draw the scene of what is certain by a second renderer too."""
    witness: str | None = None
    """A detector that is asked what it sees in the photograph: no phantom is where it sees an object, of any
    class.
    """
    peer: str = "auto"
    """Whom confirmed failures are shown to: a detector of another architecture; auto is yolov3-slim, or squeezedet
    where that is attacked; off."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions(PrecisionOptions):
    """How weights are trained."""

    minutes: Annotated[float, at_least(0)] = 0.0
    """Where above 0, training also ends after so many minutes by the clock."""
    batch: Annotated[int, POSITIVE] = 16
    """Views a step."""
    window: Annotated[str, Parsed(size_hw)] = "640x224"
    """WIDTHxHEIGHT of the views, px."""
    scale: Annotated[str, Parsed(interval)] = "0.5,1.35"
    """LOW,HIGH of the zoom of the views."""
    warmup: NotNegative = 60
    """Steps in which the rate rises."""
    loss: Literal["published", "quality"] = "published"
    """SqueezeDet: the published loss, or the one of detectors/quality.py (confidence is the overlap)."""
    checkpoint_every: Annotated[int, POSITIVE] = 50
    """Steps between checkpoints."""
