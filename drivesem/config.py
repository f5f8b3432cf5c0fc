"""One dataclass a command. Command-line values win over `--config FILE.yaml`, which wins over the defaults here.

This module is loaded by `drivesem --help`: it imports nothing heavy.
"""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
import yaml

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
Repeated = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]

COMBO_NUMBERS = (1, 2, 3, 4)
DEFAULT_COMBO = 2
DEMO = "demo"
DATASETS = (DEMO, "kitti", "vkitti1", "vkitti2", "coco", "yolo")
"""What --dataset takes: the embedded scenes, and the readers of `drivesem.data.registry`."""
_MOST_PROCESSES = 4
"""Each process takes about 1 GB."""


class UsageError(ValueError):
    """A setting that cannot be. The message is one line: setting, expected, found."""

    def __init__(self, field: str, expected: str, actual: object) -> None:
        self._parts = (field, expected, str(actual))
        super().__init__(f"{field}: expected {expected}, found {actual}")

    def __reduce__(self) -> tuple[type[UsageError], tuple[str, str, str]]:
        """As processes hand errors to one another."""
        return type(self), self._parts


@dataclass(frozen=True)
class Command:
    """The option that every command has."""

    json: Flag = False
    """Print one JSON object on standard output; everything else goes to standard error."""


@dataclass(frozen=True)
class Common(Command):
    """Options that mean the same in every command that works through frames."""

    out: str | None = None
    """Folder for the results; a second run with the same folder goes on where it stopped."""
    limit: int | None = None
    """Take the first N frames (those with vehicles, where a command needs vehicles)."""
    seed: int = 0
    """Seed of everything random."""
    workers: int | None = None
    """Processes that share the frames; by default one a core, at most 4."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1, ..."""
    keep_going: Flag = False
    """List a frame that cannot be used in the results and go on with the rest."""
    resume: bool = True
    """Keep the frames that are already there."""


@dataclass(frozen=True)
class Attack(Common):
    """Find feasible changes of driving scenes that a detector gets wrong."""

    dataset: str = DEMO
    """demo (generated scenes, needs no data), kitti, vkitti1, vkitti2, coco or yolo."""
    root: str | None = None
    """Folder of the data set, such as KITTI's with training/image_2, label_2 and calib."""
    combo: int | None = None
    """The paper's combinations: 1 translate+rotate, 2 translate+rotate+mesh, 3 translate+mesh, 4 rotate+mesh."""
    params: str | None = None
    """Any set instead of a combo, with commas: color, weather, foliage, translate, rotate, mesh."""
    detector: str = "squeezedet"
    """Name of a shipped detector, or a .safetensors file of one."""
    steps: int = 10
    """si-FGSM steps; each is one query of the detector's gradient."""
    early_stop: Flag = False
    """Stop a frame at its first success instead of using all steps."""
    objective_labels: Literal["moved", "paper"] = "moved"
    """Labels the attack aims at: moved with the cars, or the benign ones as in the paper."""
    objective: Literal["objectness", "confidence"] = "objectness"
    """What the attack raises: SqueezeDet's confidence term with 1 as the target of what finds the true objects, or
    as published, with the IoU of the predicted box, which a trained detector meets already."""
    fit: bool = True
    """Fit template, pose and shape to the photograph's silhouettes (data sets of photographs only)."""
    backend: Literal["warp", "reference"] = "warp"
    """Renderer: the fast kernels, or the plain torch reference that defines them."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """What the detector computes its gradients in; what counts as a failure is always judged in float32."""


@dataclass(frozen=True)
class Derender(Common):
    """Take photographs apart into scenes: vehicles, their shadows, and what stood behind them."""

    photo: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="PHOTO")] = None
    """A photograph without labels: vehicles are found by the shipped detector and placed by a small network."""
    focal: float | None = None
    """Focal length of PHOTO in px; by default EXIF's, or 0.58 of its longer side."""
    dataset: str = DEMO
    """demo (generated scenes, needs no data), kitti, vkitti1, vkitti2, coco or yolo."""
    root: str | None = None
    """Folder of the data set, such as KITTI's with training/image_2, label_2 and calib."""
    velodyne: Flag = False
    """Read the laser's points too (KITTI, where a frame has them)."""
    fit: bool = True
    """Fit template, pose and shape to the photograph's silhouettes."""
    fast: Flag = False
    """No fit: templates stay where the labels put them. The same as --no-fit."""
    meshes: str | None = None
    """A folder of vehicle meshes (OBJ, GLB, PLY) to choose from beside the templates."""
    segmenter: str | None = None
    """An ONNX file of a segmentation network that maps sky, foliage and road, instead of the shipped one."""
    sheet: Flag = False
    """Also draw sheet.jpg into each scene's folder: photograph, mattes, normals, depth, maps, shadows, background,
    re-render and difference."""


@dataclass(frozen=True, kw_only=True)
class Render(Command):
    """Render a scene folder as it stands."""

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    """The scene's folder, as `drivesem derender` writes it."""
    out: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """PNG to write; by default render.png in the scene's folder."""


@dataclass(frozen=True, kw_only=True)
class Edit(Command):
    """Change a scene folder by physical units, and render it."""

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    """The scene's folder, as `drivesem derender` writes it; objects are numbered by row, from 0."""
    set: Repeated = ()
    """A change, as often as needed: 'objects[2].translate=0.5m,0m' (along the heading, to the left),
    'objects[2].rotate=10deg', 'objects[1].color=0.3,0,0,0,0', 'objects[all].rotate=2deg', weather=fog (or rain,
    sunset, overcast, night), weather.rain=0.4, foliage.hue=0.5."""
    remove: Repeated = ()
    """Rows of vehicles to take out, with their shadows; or all."""
    edits: str | None = None
    """A YAML file of changes; what --set says of the same thing wins."""
    out: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """PNG to write; by default edit.png in the scene's folder, or nothing where there is --save."""
    save: str | None = None
    """Folder to write the changed scene to."""


@dataclass(frozen=True)
class Synth(Common):
    """Make driving frames with exact ground truth by code."""

    frames: int = 10
    """How many frames; each is made in every one of --variations."""
    layout: Literal["kitti", "vkitti2", "vkitti1", "coco", "yolo"] = "kitti"
    """Layout of the folder that is written: KITTI object, Virtual KITTI 2 or 1.3.1, COCO JSON, YOLO."""
    split: Literal["train", "heldout"] = "train"
    """Pools of vehicle shapes and surroundings; the two share nothing."""
    variations: str | None = None
    """Virtual KITTI's, with commas, or all: clone, fog, morning, overcast, rain, sunset, 15-deg-left,
    15-deg-right, 30-deg-left, 30-deg-right; or mixed: weather drawn for each street. By default clone for Virtual
    KITTI's layouts, else mixed."""
    sequence: int | None = None
    """Frames of one drive, ten a second, with moving cars and tracks; by default 10 for Virtual KITTI's layouts,
    else 1: every frame a street of its own."""
    people: bool | None = None
    """Pedestrians and cyclists too; by default in all layouts but Virtual KITTI's, which have no class for
    them."""
    cameras: Literal[1, 2] = 1
    """2: Virtual KITTI 2's right camera too."""
    validation: float = 0.0
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


@dataclass(frozen=True)
class Bench(Common):
    """Measure: one attack step, the renderer, peak memory, the scene generator, or de-rendering."""

    what: tyro.conf.Positional[Literal["step", "render", "memory", "synth", "derender", "found", "label-free"]] = (
        "step"
    )
    """step: a whole attack step beside the detector alone; render: the renderer, beside others; memory: peak
    memory above the detector's own; synth: the scene generator; derender: de-rendered generated frames beside the
    generator's truth; found: whether a detector finds removed cars again, and moved ones where they are;
    label-free: vehicles of photographs whose labels are hidden, beside those labels."""
    quick: Flag = False
    """Fewer repetitions: some 50 s."""
    cars: str = "1,4,8,16"
    """How many cars, 1 to 16, with commas."""
    triangles: str = "2000,5000"
    """Triangles a car, with commas."""
    frames: int | None = None
    """Frames that bench synth makes in each row, by default 200, with --quick 40; that bench derender takes apart,
    by default 100, with --quick 12; or that bench label-free looks at, by default 60, with --quick 12."""
    ablate: Flag = False
    """Bench derender: also with labels, masks, geometry, mattes or background given by the generator."""
    threads: int | None = None
    """Threads of torch and of the kernels; by default as many as torch chooses."""
    detector: str = "squeezedet"
    """Name of a shipped detector, or a .safetensors file of one; bench found also takes onnx:FILE, a detector that
    was trained elsewhere."""
    dataset: str = DEMO
    """Bench found, label-free: demo (generated scenes, needs no data), kitti, vkitti1, vkitti2, coco or yolo."""
    root: str | None = None
    """Bench found, label-free: folder of the data set, such as KITTI's with training/image_2, label_2, calib."""
    scenes: str | None = None
    """Bench found: a folder of scenes that drivesem derender wrote, instead of a data set."""
    tiles: Literal["auto", "off"] = "auto"
    """Of an ONNX detector: auto looks at the whole frame and at overlapping parts of it, enlarged."""
    markdown: str | None = None
    """A Markdown file whose section on this benchmark is written anew (docs/benchmarks.md)."""


@dataclass(frozen=True)
class Gradcheck(Common):
    """Compare gradients with central differences; exit code 1 where they disagree. One scene without --limit."""

    dataset: str = DEMO
    """demo (generated scenes, needs no data), kitti, vkitti1, vkitti2, coco or yolo."""
    root: str | None = None
    """Folder of the data set, such as KITTI's with training/image_2, label_2 and calib."""
    detector: str = "squeezedet"
    """Name of a shipped detector, or a .safetensors file of one."""
    directions: int = 2
    """Random directions of each parameter along which differences are taken; each costs six renders a point."""
    min_cosine: float = 0.99
    """Least cosine between gradient and differences."""
    max_error: float = 0.05
    """Largest relative error of the gradient."""
    fit: bool = True
    """Fit template, pose and shape to the photograph's silhouettes (data sets of photographs only)."""


@dataclass(frozen=True)
class Eval(Command):
    """Figures of detections against labels, as COCO, KITTI or VOC define them; or of a detector on a data set."""

    gt: str | None = None
    """Labels: a folder of KITTI label files, a KITTI, YOLO or Virtual KITTI folder, a COCO JSON file, or a run of
    drivesem attack."""
    pred: str | None = None
    """Detections: a folder of KITTI result files (with scores), COCO results, YOLO text files, or a run."""
    pred_b: str | None = None
    """A second set of detections of the same frames, compared with the first by a paired test."""
    protocol: Literal["coco", "kitti", "voc"] = "coco"
    """Which benchmark's rules."""
    gt_format: Literal["auto", "kitti", "coco", "yolo", "vkitti1", "vkitti2", "run"] = "auto"
    """Layout of --gt; auto looks at what lies there."""
    pred_format: Literal["auto", "kitti", "coco", "yolo", "run"] = "auto"
    """Layout of --pred and --pred-b."""
    small_detections: Literal["ignore", "count"] = "ignore"
    """KITTI: detections below the minimum height are ignored (development kit of 2017) or counted (the older)."""
    map: str | None = None
    """Classes of the detections by name, with commas: car=Car,person=Pedestrian; bus=- leaves a class out."""
    map_gt: str | None = None
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
    bootstrap: int | None = None
    """Draws of frames for confidence intervals and paired tests; 0 leaves them out. By default 200, and none of
    more than 5,000 frames, whose figures hardly vary, unless two detectors are compared."""
    seed: int = 0
    """Seed of the draws."""
    out: str | None = None
    """Folder for metrics.json, CSV, Markdown and PNG."""
    detector: str | None = None
    """Instead of --gt and --pred: run this detector, a shipped one, a file, or another project's (see
    docs/detectors.md)."""
    dataset: str = "kitti"
    """Of --detector: kitti, vkitti1, vkitti2, coco or yolo."""
    root: str | None = None
    """Of --detector: folder of the data set."""
    tiles: Literal["auto", "off"] = "auto"
    """Of an ONNX detector: auto looks at the whole frame and at overlapping parts of it, enlarged."""
    limit: int | None = None
    """Of --detector: the first N frames."""
    device: str = "cpu"
    """Of --detector: torch device."""
    min_height: float = 25.0
    """Of --detector: lower objects are neither missed nor a hit, px."""
    max_occlusion: int = 1
    """Of --detector: objects occluded more (KITTI's 0 to 3) are neither missed nor a hit."""
    max_truncation: float = 1.0
    """Of --detector: objects of which a larger share lies outside the image are neither missed nor a hit."""
    pictures: int = 0
    """Of --detector: draw hits, misses and false alarms of the N frames with most mistakes into --out."""


@dataclass(frozen=True, kw_only=True)
class Convert(Command):
    """Convert labels between KITTI, COCO, YOLO and Virtual KITTI, and say what is lost."""

    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SOURCE")]
    """What to convert: a folder of KITTI label files, a KITTI, YOLO or Virtual KITTI folder, a COCO JSON file."""
    out: Annotated[str, tyro.conf.arg(aliases=["-o"])]
    """Folder to write, new or empty; or a .json file for COCO."""
    to_format: Annotated[Literal["kitti", "coco", "yolo", "vkitti1", "vkitti2"], tyro.conf.arg(aliases=["--to"])]
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
    """Also copy the images into the new layout (KITTI, COCO and YOLO)."""
    map: str | None = None
    """Classes by name, with commas: car=Car,person=Pedestrian; bus=- leaves a class out."""


COMMANDS: dict[str, type[Command]] = {
    "attack": Attack,
    "derender": Derender,
    "render": Render,
    "edit": Edit,
    "synth": Synth,
    "bench": Bench,
    "gradcheck": Gradcheck,
    "eval": Eval,
    "convert": Convert,
}


def processes(config: Common) -> int:
    """How many processes share the frames."""
    return config.workers or min(os.cpu_count() or 1, _MOST_PROCESSES)


def validate(config: Command) -> None:
    """Raise UsageError for values that no command accepts."""
    if isinstance(config, Common):
        if config.workers is not None and config.workers < 1:
            raise UsageError("--workers", "at least 1", config.workers)
        if config.limit is not None and config.limit < 1:
            raise UsageError("--limit", "at least 1", config.limit)
    if isinstance(config, Attack | Derender | Gradcheck | Bench):
        if config.dataset not in DATASETS:
            raise UsageError("--dataset", f"one of {', '.join(DATASETS)}", repr(config.dataset))
        if config.dataset != DEMO and config.root is None:
            raise UsageError("--root", f"the folder of data set {config.dataset!r}", "nothing")
        if config.dataset == DEMO and config.root is not None:
            raise UsageError(
                "--root", "no folder for data set 'demo' (did you mean --dataset kitti?)", config.root
            )
    if isinstance(config, Derender):
        if config.photo is not None and config.dataset != DEMO:
            raise UsageError("PHOTO", "no --dataset beside it", f"--dataset {config.dataset}")
        if config.focal is not None and config.photo is None:
            raise UsageError("--focal", "a PHOTO beside it", "none")
        if config.focal is not None and not (math.isfinite(config.focal) and config.focal > 0):
            raise UsageError("--focal", "positive px", config.focal)
        if config.meshes is not None and config.photo is None and config.dataset == DEMO:
            raise UsageError("--meshes", "a PHOTO or a --dataset of photographs beside it", f"--dataset {DEMO}")
        if config.meshes is not None and not Path(config.meshes).is_dir():
            raise UsageError("--meshes", "a folder", config.meshes)
        if config.segmenter is not None and config.photo is None and config.dataset == DEMO:
            raise UsageError("--segmenter", "a PHOTO or a --dataset of photographs beside it", f"--dataset {DEMO}")
        if config.velodyne and config.dataset != "kitti":
            raise UsageError("--velodyne", "--dataset kitti beside it", f"--dataset {config.dataset}")
        if config.device != "cpu":
            raise UsageError("--device", "cpu", config.device)
    if isinstance(config, Gradcheck):
        if config.directions < 1:
            raise UsageError("--directions", "at least 1", config.directions)
        if not -1 <= config.min_cosine <= 1:
            raise UsageError("--min-cosine", "a number in [-1, 1]", config.min_cosine)
        if not config.max_error > 0:
            raise UsageError("--max-error", "a positive number", config.max_error)
    if isinstance(config, Attack):
        if config.steps < 1:
            raise UsageError("--steps", "at least 1", config.steps)
        if config.precision == "float16" and config.device.startswith("cpu"):
            raise UsageError("--precision", "float32 or bfloat16 on a CPU", config.precision)
        if config.combo is not None and config.combo not in COMBO_NUMBERS:
            raise UsageError("--combo", "1, 2, 3 or 4", config.combo)
        if config.combo is not None and config.params is not None:
            raise UsageError("--params", "no --combo beside it", f"--combo {config.combo}")
    if isinstance(config, Synth):
        if config.frames < 1:
            raise UsageError("--frames", "at least 1", config.frames)
        if config.sequence is not None and config.sequence < 1:
            raise UsageError("--sequence", "at least 1", config.sequence)
        if not 0 <= config.validation < 1:
            raise UsageError("--validation", "a share in [0, 1)", config.validation)
        if config.cameras == 2 and config.layout != "vkitti2":
            raise UsageError("--cameras", "1, or --layout vkitti2", config.cameras)
        if config.people and config.layout.startswith("vkitti"):
            raise UsageError("--people", f"False with --layout {config.layout}, which has no class for them", True)
    if isinstance(config, Bench):
        numbers("--cars", config.cars)
        numbers("--triangles", config.triangles, least=4)
        fewest = 10 if config.what == "synth" else 1
        if config.frames is not None and config.frames < fewest:
            raise UsageError("--frames", f"at least {fewest}", config.frames)
        if config.threads is not None and config.threads < 1:
            raise UsageError("--threads", "at least 1", config.threads)
        if config.scenes is not None and config.dataset != DEMO:
            raise UsageError("--scenes", "no --dataset beside it", f"--dataset {config.dataset}")
    if isinstance(config, Eval):
        _validate_eval(config)


def _validate_eval(config: Eval) -> None:
    if (config.gt is None or config.pred is None) == (config.detector is None):
        raise UsageError("--gt and --pred, or --detector", "one or the other", "both" if config.gt else "neither")
    if config.detector is not None and config.root is None:
        raise UsageError("--root", f"the folder of data set {config.dataset!r}", "nothing")
    if config.detector is not None and config.dataset not in DATASETS[1:]:
        raise UsageError("--dataset", f"one of {', '.join(DATASETS[1:])}", repr(config.dataset))
    if config.pictures < 0:
        raise UsageError("--pictures", "at least 0", config.pictures)
    if config.pictures and (config.detector is None or config.out is None):
        raise UsageError("--pictures", "--detector and --out", "one of them missing")
    if config.bootstrap is not None and config.bootstrap < 0:
        raise UsageError("--bootstrap", "at least 0", config.bootstrap)
    if config.limit is not None and config.limit < 1:
        raise UsageError("--limit", "at least 1", config.limit)


def class_map(setting: str, text: str | None) -> dict[str, str | None]:
    """The names of "car=Car,bus=-", None where a class is left out. Raises UsageError naming the setting."""
    pairs: dict[str, str | None] = {}
    for part in text.split(",") if text else ():
        name, sign, to = (word.strip() for word in part.partition("="))
        if not (name and sign and to):
            raise UsageError(setting, "NAME=CLASS with commas", repr(part))
        pairs[name] = None if to == "-" else to
    return pairs


def numbers(setting: str, text: str, least: int = 1) -> list[int]:
    """The whole numbers of "1,4,8", each once, in order. Raises UsageError naming the setting."""
    try:
        found = sorted({int(part) for part in text.split(",")})
    except ValueError:
        found = []
    if not found or found[0] < least:
        raise UsageError(setting, f"numbers of at least {least}, with commas", repr(text))
    return found


def yaml_arguments(path: str, command: type[Command]) -> list[str]:
    """The settings of a YAML preset as command-line words, so that both are checked by one parser.

    Raises UsageError naming the file, and the key where there is one.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(path, "a readable YAML file", error) from error
    try:
        loaded: Any = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise UsageError(path, "YAML", " ".join(str(error).split())) from error
    if loaded is None:
        return []
    if not isinstance(loaded, dict):
        raise UsageError(path, "a mapping of settings", type(loaded).__name__)
    fields = {f.name: f for f in dataclasses.fields(command)}
    words: list[str] = []
    for key, value in loaded.items():
        name = str(key).replace("-", "_")
        if name not in fields:
            raise UsageError(f"{path}: {key}", f"one of {', '.join(fields)}", "an unknown key")
        words += _words(path, fields[name], value)
    return words


def _words(path: str, field: dataclasses.Field[Any], value: Any) -> list[str]:
    flag = field.name.replace("_", "-")
    kind = str(field.type)
    if kind in ("Flag", "bool"):
        if not isinstance(value, bool):
            raise UsageError(f"{path}: {field.name}", "true or false", repr(value))
        if value:
            return [f"--{flag}"]
        return [f"--no-{flag}"] if kind == "bool" else []
    if kind == "Repeated" and isinstance(value, list):
        return [f"--{flag}={item}" for item in value]
    if isinstance(value, list | tuple):
        value = ",".join(str(item) for item in value)
    if isinstance(value, dict) or (isinstance(value, float) and not math.isfinite(value)):
        raise UsageError(f"{path}: {field.name}", "one value", repr(value))
    # "=": a value that begins with a dash stays a value.
    return [f"--{flag}={value}"]


def to_yaml(config: Command) -> str:
    """The resolved configuration, as it is written beside the results."""
    return yaml.safe_dump(dataclasses.asdict(config), sort_keys=False)
