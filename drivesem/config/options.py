"""Options that several commands share: each option's type, range, default and help text, declared once.

Blocks of options are base classes; a command's settings are one flat dataclass of its blocks' fields and its own
(`drivesem.config.commands`). A function takes the narrowest block that it reads, as `open_source(config:
SceneOptions)` does. A command for which an option means something else declares it again.

`drivesem --help` loads this module: it imports nothing heavy.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Collection, Iterator
from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin, get_type_hints

import tyro

from drivesem.config.constraints import (
    POSITIVE,
    AllowsUrl,
    Constraint,
    NumberRange,
    OneOf,
    OnlyWith,
    ParsedBy,
    Required,
    at_least,
    is_url,
    parse_attributes,
    parse_class_map,
    parse_interval,
    parse_size_hw,
)
from drivesem.config.errors import refuse

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
Repeated = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
Count = Annotated[int, at_least(1)]
NotNegative = Annotated[int, at_least(0)]
RunFolder = Annotated[str | None, Required("a folder of drivesem attack")]
FolderOrUrl = Annotated[str | None, AllowsUrl()]
"""A folder or its URL."""
CommandName = Annotated[str, tyro.conf.Fixed]
"""The name of the command that was called: the parser sets it in classes that serve several commands."""
Score = Annotated[float, NumberRange(0, 1, "(]", "a score in (0, 1]")]
ClassMap = Annotated[str, ParsedBy(parse_class_map)]
LabelMode = Literal["moved", "paper"]

DEMO = "demo"
DATASETS = ("kitti", "vkitti1", "vkitti2", "coco", "yolo", "voc", "bdd100k")
"""The readers of `drivesem.data.registry`."""
PHOTOGRAPHS, SCENES = "photographs", "scenes"
SOURCES = (DEMO, *DATASETS, PHOTOGRAPHS, SCENES)
"""Values of --dataset: generated scenes, the readers, photographs without labels, and scene folders."""
WITHOUT_CAMERA = ("coco", "yolo", "voc", "bdd100k", PHOTOGRAPHS)
"""Data sets with photographs that may lack a camera."""

DEFAULT_FINDER = "squeezedet"
"""The detector that finds vehicles in photographs without labels."""
MIN_DRAWS = 16
"""The fewest draws for which the rule of certificates is defined (`drivesem.failures.certificate`)."""
DEFAULT_KEEP_MB = 800.0
"""MB of cached layers: SqueezeDet's take 24 MB per picture of 1242 x 375 px."""
_MAX_PROCESSES = 4
"""By default: each process takes about 1 GB."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Base class of all options and settings."""

    def check(self) -> None:
        """Raise UsageError for a value of another type than its field's, or that the field's type excludes.

        Blocks and commands extend this with conditions between fields.
        """
        hints = get_type_hints(type(self), include_extras=True)
        for field in fields(self):
            kind, option, value = hints[field.name], option_name(field.name), getattr(self, field.name)
            refuse(not _has_type(value, kind), option, _type_name(kind), repr(value))
            constraints = tuple(_find_constraints(kind))
            if not any(isinstance(constraint, AllowsUrl) for constraint in constraints):
                for text in value if isinstance(value, tuple) else (value,):
                    remote = isinstance(text, str) and is_url(text)
                    refuse(remote, option, "a path on this machine (docs/guide/scale.md)", text)
            for constraint in constraints:
                if isinstance(constraint, OnlyWith):
                    if value != field.default:
                        constraint.check(option, getattr(self, constraint.field))
                elif value is not None or isinstance(constraint, Required):
                    constraint.check(option, value)


def find_constraints(command: type[Options], field: str) -> tuple[Constraint, ...]:
    """What the type of a field demands of its values."""
    return tuple(_find_constraints(get_type_hints(command, include_extras=True)[field]))


def _find_constraints(kind: Any) -> Iterator[Constraint]:
    yield from (marker for marker in getattr(kind, "__metadata__", ()) if isinstance(marker, Constraint))
    for part in get_args(kind):
        yield from _find_constraints(part)


def _has_type(value: object, kind: Any) -> bool:
    """Whether a value fits a type hint of a field."""
    parts = get_args(kind)
    if get_origin(kind) is Literal:
        return value in parts
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(_has_type(item, parts[0]) for item in value)
    if hasattr(kind, "__metadata__"):
        return _has_type(value, parts[0])
    if parts:
        return any(_has_type(value, part) for part in parts)
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, int | float if kind is float else kind)


def _type_name(kind: Any) -> str:
    """The type of a field in words."""
    parts = [part for part in get_args(kind) if part is not type(None)]
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, parts))}"
    if parts:
        return _type_name(parts[0])
    return {int: "a whole number", float: "a number", bool: "true or false"}.get(kind, "text")


def option_name(name: str) -> str:
    """The command-line spelling of a field's name."""
    return f"--{name.replace('_', '-')}"


def shared_options(config: Options, block: type[Options]) -> dict[str, Any]:
    """The settings of one block, to construct another command's with."""
    return {field.name: getattr(config, field.name) for field in fields(block)}


@dataclass(frozen=True, kw_only=True)
class CommandConfig(Options):
    """Settings of one command."""

    basic: ClassVar[tuple[str, ...]] = ()
    """Fields that `--help` shows, in this order; empty: all but `help.ADVANCED`."""

    json: Flag = False
    """Print one JSON object on standard output; everything else goes to standard error."""


@dataclass(frozen=True, kw_only=True)
class OutputOptions(Options):
    """The folder of results."""

    out: str | None = None
    """Folder of the results; the same command resumes what it finds there."""
    resume: bool = True
    """Keep frames that are already done."""


@dataclass(frozen=True, kw_only=True)
class LimitOption(Options):
    """How many frames to take."""

    limit: Count | None = None
    """Number of frames, from the first (with vehicles, where vehicles are needed)."""


@dataclass(frozen=True, kw_only=True)
class SeedOption(Options):
    """The seed."""

    seed: int = 0
    """Seed of all random numbers."""


@dataclass(frozen=True, kw_only=True)
class WorkerOptions(Options):
    """The processes among which frames are shared."""

    workers: Count | None = None
    """Worker processes (default: one per core, at most 4)."""
    keep_going: Flag = False
    """List unusable frames in the results and continue with the rest."""
    engine: Literal["local", "ray"] = "local"
    """Where workers run: on this machine (local), or on a Ray cluster."""
    address: Annotated[str | None, AllowsUrl()] = None
    """Address of the Ray cluster, such as auto or ray://HOST:10001 (default: one on this machine)."""

    def check(self) -> None:
        super().check()
        refuse(self.address is not None and self.engine == "local", "--address", "--engine ray", "--engine local")

    @property
    def processes(self) -> int:
        """Number of processes among which frames are shared."""
        return self.workers or min(os.cpu_count() or 1, _MAX_PROCESSES)


@dataclass(frozen=True, kw_only=True)
class DeviceOption(Options):
    """The torch device."""

    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1, ..."""


@dataclass(frozen=True, kw_only=True)
class FrameCommandConfig(DeviceOption, WorkerOptions, SeedOption, LimitOption, OutputOptions, CommandConfig):
    """Settings of a command that processes frames into a folder."""


@dataclass(frozen=True, kw_only=True)
class DataSourceOptions(SeedOption, LimitOption):
    """Where frames come from."""

    dataset: Annotated[str, OneOf(SOURCES)] = DEMO
    """Data set: demo (generated), kitti, vkitti1, vkitti2, coco, yolo, voc, bdd100k, photographs, scenes."""
    root: FolderOrUrl = None
    """Folder or URL of the data set; a photograph or scene; or a folder of them."""

    def check(self) -> None:
        super().check()
        demo, given = self.dataset == DEMO, self.root is not None
        refuse(not demo and not given, "--root", f"the folder of data set {self.dataset!r}", "nothing")
        refuse(demo and given, "--root", "none with data set 'demo' (did you mean --dataset kitti?)", self.root)


@dataclass(frozen=True, kw_only=True)
class FrameFilterOptions(Options):
    """Which frames of a data set are used, and what its class names mean."""

    split: str | None = None
    """Frames of --root: its own split (train, val), 3d-sdn, random:FRACTION, random:FRACTION:rest, or a file."""
    where: Annotated[str, ParsedBy(parse_attributes)] | None = None
    """Frames with these attributes: weather=rainy|foggy,timeofday=night."""
    map: ClassMap | None = None
    """What class names of the data set mean, such as lorry=Truck,cart=Misc; bus=- makes a class background."""


@dataclass(frozen=True, kw_only=True)
class PeopleOption(Options):
    """Whether people move."""

    people: Flag = False
    """Make objects of labelled pedestrians and cyclists too; --target-classes with one of them does it as well."""

    @property
    def moves_people(self) -> bool:
        """Whether people and cyclists become objects."""
        return self.people


@dataclass(frozen=True, kw_only=True)
class TargetClassesOption(PeopleOption):
    """Which classes an attack targets."""

    target_classes: str | None = None
    """Classes in which lost objects and phantoms count as failures, such as Car,Pedestrian."""

    @property
    def moves_people(self) -> bool:
        named = (self.target_classes or "").split(",")
        return self.people or any(name.strip() in ("Pedestrian", "Cyclist") for name in named)


@dataclass(frozen=True, kw_only=True)
class SceneOptions(PeopleOption, FrameFilterOptions, DataSourceOptions):
    """Where frames come from, and how photographs become scenes."""

    fit: bool = True
    """Fit template, pose and shape to the silhouettes in photographs."""
    cache: str | None = None
    """Folder that stores de-rendered photographs for later runs."""
    cache_gb: Annotated[float, NumberRange(0, ends="()", expected="a number above 0")] = 4.0
    """Size limit of --cache, GB; the least recently used scenes are removed."""
    focal: Annotated[float, NumberRange(0, ends="()", expected="positive px")] | None = None
    """Focal length of photographs without a camera, px (default: EXIF's, or 0.58 of the longer side)."""
    finder: str = DEFAULT_FINDER
    """Detector that finds vehicles in --dataset photographs."""

    def check(self) -> None:
        super().check()
        data = f"--dataset {self.dataset}"
        cached = self.cache is not None and self.dataset in (DEMO, SCENES)
        refuse(cached, "--cache", "a --dataset of photographs", data)
        labelled = self.dataset in DATASETS
        for name in ("split", "where", "map"):
            unused = getattr(self, name) is not None and not labelled
            refuse(unused, f"--{name}", f"--dataset {', '.join(DATASETS)}", data)
        self._check_photographs(data)

    def _check_photographs(self, data: str) -> None:
        with_camera = self.focal is not None and self.dataset not in WITHOUT_CAMERA
        refuse(with_camera, "--focal", f"--dataset {', '.join(WITHOUT_CAMERA)}", data)
        labelled = self.finder != DEFAULT_FINDER and self.dataset != PHOTOGRAPHS
        refuse(labelled, "--finder", f"--dataset {PHOTOGRAPHS}", data)


@dataclass(frozen=True, kw_only=True)
class ThresholdOption(Options):
    """The score threshold of detections."""

    t_star: Score | None = None
    """Score threshold of a detection (default: the detector's own, or 0.3)."""


@dataclass(frozen=True, kw_only=True)
class TileOption(Options):
    """Tiling of ONNX detectors."""

    tiles: Literal["auto", "off"] = "auto"
    """Tiling of ONNX detectors: auto adds enlarged, overlapping parts of the frame."""


@dataclass(frozen=True, kw_only=True)
class PrecisionOptions(DeviceOption):
    """Device and floating-point format of networks."""

    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """Floating-point format of the network: bfloat16 where the CPU has it, float16 on GPUs."""

    def check(self) -> None:
        super().check()
        slow = self.precision == "float16" and self.device.startswith("cpu")
        refuse(slow, "--precision", "float32 or bfloat16 on a CPU", self.precision)


@dataclass(frozen=True, kw_only=True)
class BootstrapOption(Options):
    """Confidence intervals."""

    bootstrap: NotNegative | None = None
    """Bootstrap samples of frames for intervals (default: 200); 0 for no intervals."""


@dataclass(frozen=True, kw_only=True)
class SeededBootstrapOptions(BootstrapOption, SeedOption):
    """Confidence intervals, where nothing else is random."""

    seed: int = 0
    """Seed of the bootstrap."""


@dataclass(frozen=True, kw_only=True)
class DetectionOptions(BootstrapOption, ThresholdOption, TileOption, DeviceOption, WorkerOptions, SeedOption):
    """How detectors are run on the pictures of runs."""

    t_star: Score | None = None
    """Score threshold of detectors without one of their own (default: 0.3)."""


@dataclass(frozen=True, kw_only=True)
class RunOption(Options):
    """The run to analyse."""

    run: RunFolder = None
    """Folder of a run of drivesem attack."""


@dataclass(frozen=True, kw_only=True)
class TrustOption(Options):
    """Whether a run's detector may execute code."""

    trust: Flag = False
    """Run the code that the run's detector names (module:, torchscript:, export:, ultralytics:)."""


@dataclass(frozen=True, kw_only=True)
class InferenceOptions(Options):
    """Incremental inference on changed pictures."""

    whole: Flag = False
    """Compute each detector pass in full, not only where the picture changed; slower, same results."""
    incremental: Flag = False
    """Compute only where the picture changed (the default), even for a run made with --whole."""
    keep_mb: Annotated[float, at_least(1)] = DEFAULT_KEEP_MB
    """Memory limit of the cached layers of a frame in each process, MB."""

    def check(self) -> None:
        super().check()
        refuse(self.whole and self.incremental, "--incremental", "only one of --incremental and --whole", "both")

    def resolve_whole(self, of_run: bool) -> bool:
        """Whether passes are computed in full in the analysis of a run; `of_run`: whether they were in the run."""
        return self.whole or (of_run and not self.incremental)


@dataclass(frozen=True, kw_only=True)
class SearchOptions(ThresholdOption, PrecisionOptions):
    """What is attacked, within which limits, and to what end."""

    detector: str = "squeezedet"
    """Detector: a shipped one, a weights file, or another project's, such as onnx:FILE."""
    steps: Count = 10
    """Search steps; each takes one gradient of the detector."""
    budget: str = "paper"
    """Limits of the change: paper, parking, street, or a YAML file; also NAME=VALUE, as in street,translate=2m."""
    parametrisation: Literal["ground", "roi"] = "ground"
    """Position parameters: ground (along and across the heading), or 3D-SDN's roi (box offset, log depth)."""
    objective_labels: LabelMode = "moved"
    """Labels in the objective: moved with the vehicles, or benign as in the paper."""
    objective: Literal["objectness", "confidence", "total", "failure", "hide", "phantom", "localisation"] = (
        "objectness"
    )
    """What the search raises: a loss of the detector (objectness, confidence, total), or failures at t*."""
    keep: Literal["best", "last"] = "best"
    """Iterate to return: the best, or the last as in the paper."""
    project: Literal["feasible", "bounds"] = "feasible"
    """Set to which each step is projected: feasible changes, or the bounds alone as in the paper."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """Floating-point format of the detector's gradients; failures are always judged in float32."""


@dataclass(frozen=True, kw_only=True)
class SceneAttackOptions(InferenceOptions, SearchOptions, SceneOptions):
    """Settings that all arms of an experiment share."""


@dataclass(frozen=True, kw_only=True)
class GradingOptions(Options):
    """Certificates, and re-tests by other renderers and detectors."""

    draws: Annotated[int, at_least(MIN_DRAWS, "which a certificate's rule needs")] = MIN_DRAWS
    """Nuisance samples before and after the change, for each certificate."""
    nuisances: str = "default"
    """Nuisances of the samples: default, off, or NAME=NUMBER with commas (docs/guide/ideas.md)."""
    confirm: bool = True
    """Re-test certain failures with a second renderer."""
    reference_detector: str | None = None
    """Detector that rules out phantoms by its detections in the photograph."""
    second_detector: str = "auto"
    """Detector of another architecture that re-tests confirmed failures; auto: a shipped one; off."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions(PrecisionOptions):
    """Training of weights."""

    minutes: Annotated[float, at_least(0)] = 0.0
    """Time limit of the training, minutes; 0 for none."""
    batch: Annotated[int, POSITIVE] = 16
    """Views per step."""
    window: Annotated[str, ParsedBy(parse_size_hw)] = "640x224"
    """Size of the views, WIDTHxHEIGHT, px."""
    scale: Annotated[str, ParsedBy(parse_interval)] = "0.5,1.35"
    """Zoom of the views, LOW,HIGH."""
    warmup: NotNegative = 60
    """Steps in which the learning rate rises."""
    loss: Literal["published", "quality"] = "published"
    """SqueezeDet's loss: as published, or with the overlap as confidence (quality)."""
    checkpoint_every: Annotated[int, POSITIVE] = 50
    """Steps between checkpoints."""


def format_command_line(command: str, config: CommandConfig, omit: Collection[str] = ()) -> str:
    """The shell command that gives these settings.

    Args:
        command: Name of the command.
        config: Its settings; those with default values are left out.
        omit: Fields to leave out.
    """
    words = ["drivesem", command]
    for field in fields(config):
        value = getattr(config, field.name)
        if value == field.default or field.name in omit:
            continue
        if isinstance(value, bool):
            words.append(option_name(field.name if value else f"no-{field.name}"))
        else:
            words += [option_name(field.name), str(value)]
    return shlex.join(words)


def to_yaml(config: Options) -> str:
    """The settings as YAML, in the order of their fields."""
    import yaml  # which --help does not need

    return yaml.safe_dump(asdict(config), sort_keys=False)
