"""One dataclass a command. Command-line values win over `--config FILE.yaml`, which wins over the defaults here.

This module is loaded by `drivesem --help`: it imports nothing heavy.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


Repeated = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]


COMBO_NUMBERS = (1, 2, 3, 4)


DEFAULT_COMBO = 2


DEMO = "demo"


DATASETS = (DEMO, "kitti", "vkitti1", "vkitti2", "coco", "yolo")
"""What --dataset takes: the embedded scenes, and the readers of `drivesem.data.registry`."""


SYNTH = "synth"
"""What --dataset takes for training: frames that the generator makes."""


GRADIENT_FREE = ("random", "halton", "sobol", "cma-es")
"""Attacks that ask a detector only what it finds."""


COUNTED = (*GRADIENT_FREE, "scw", "subsets")
"""Attacks that end after --queries."""


RESTARTED = ("si-fgsm", "apgd", "fgsm", "sgd", "scw")
"""Attacks that may begin elsewhere."""


DEFAULT_QUERIES = 64


_MOST_PROCESSES = 4
"""Each process takes about 1 GB."""


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
    """List a frame that cannot be used, or on which drivesem fails, in the results and go on with the rest."""
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
    """A shipped detector, a file, or another project's (docs/detectors.md); without a gradient, such as an ONNX
    graph, for the methods that need none."""
    method: Literal[
        "si-fgsm", "apgd", "fgsm", "sgd", "scw", "subsets", "random", "halton", "sobol", "cma-es", "placebo"
    ] = "si-fgsm"
    """si-fgsm, fgsm, sgd follow the gradient, apgd by steps that halve where the loss stops rising; scw
    (Carlini-Wagner) also keeps the change small; subsets finds the fewest parameters that are enough; random
    (uniform), halton, sobol (scrambled sequences) and cma-es ask only what the detector finds."""
    steps: int = 10
    """Steps, each one query of the detector's gradient; FGSM goes as far in one; of scw, for each constant."""
    queries: int | None = None
    """Of scw: gradients; of methods without gradient: renders that are judged; of subsets: both. By default 64."""
    step_form: Literal["raw", "l2"] = "l2"
    """Of sgd: the gradient as it is, or its direction, each parameter's as long as a step of si-fgsm."""
    rate: float = 1.0
    """Of si-fgsm, apgd, sgd and scw: length of a (first) step in units of each parameter's own step."""
    momentum: float = 0.0
    """Of si-fgsm and sgd: what is left of earlier gradients after a step, 0 to 1 (MI-FGSM: 1)."""
    norm: Literal[1, 2] = 2
    """Of scw: the norm of the change that is kept small."""
    restarts: int = 0
    """Of si-fgsm, apgd, fgsm, sgd and scw: how often to begin again at random near the photograph."""
    scouts: int = 0
    """Of the same: how many samples of all the bounds are judged first; the attack begins at the best."""
    like: str | None = None
    """Of placebo, one random edit of each frame: the run whose counterexamples are as large."""
    budget: str = "paper"
    """How far parameters may go: paper; parking (0.5 m, 5 degrees); a YAML file; or translate=0.5m,rotate=5deg."""
    range: Literal["bounds", "steps"] = "bounds"
    """Of methods without gradient: search all of the parameters' bounds, or what --steps steps reach."""
    early_stop: Flag = False
    """Stop a frame at its first success instead of using all steps or queries."""
    objective_labels: Literal["moved", "paper"] = "moved"
    """Labels the attack aims at: moved with the cars, or the benign ones as in the paper."""
    objective: Literal["objectness", "confidence", "total", "failure", "hide", "phantom", "localisation"] = (
        "objectness"
    )
    """What the attack raises. objectness: the detector's confidence term, with 1 as the target of what finds the
    true objects; confidence: SqueezeDet's as published, with the IoU of the predicted box; total: its whole loss;
    hide: objects fall below t*; phantom: something rises to t* where nothing is; failure: both; localisation:
    boxes leave their objects."""
    target_objects: str | None = None
    """Only these objects of each frame, such as 0,2: others may be lost, which is no success; nor are phantoms."""
    target_classes: str | None = None
    """Only objects and phantoms of these classes, such as Car,Pedestrian."""
    fit: bool = True
    """Fit template, pose and shape to the photograph's silhouettes (data sets of photographs only)."""
    backend: Literal["warp", "reference"] = "warp"
    """Renderer: the fast kernels, or the plain torch reference that defines them."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """What the detector computes its gradients in; what counts as a failure is always judged in float32."""
    t_star: float | None = None
    """Score from which a detection counts; by default the detector's own, or 0.3 where it has none."""
    tiles: Literal["auto", "off"] = "auto"
    """Of an ONNX detector: auto looks at the whole frame and at overlapping parts of it, enlarged."""


@dataclass(frozen=True, kw_only=True)
class Study(Common):
    """The paper's experiments, its figures beside ours: every arm an attack on the same frames."""

    name: Annotated[
        tyro.conf.Positional[Literal["single", "multi", "samples", "steps", "labels", "transfer", "retrain"]],
        tyro.conf.arg(metavar="{single,multi,samples,steps,labels,transfer,retrain}"),
    ]
    """single: the six parameters, each alone; multi: the combinations 1 to 4; samples: success against queries for
    each algorithm; steps: success against number and size of steps; labels: what labels that stay behind make of
    an attack; transfer: counterexamples of combination 2 before other detectors; retrain: detectors trained on
    with counterexamples, before benign frames, known and fresh counterexamples."""
    quick: Flag = False
    """6 frames instead of 200, and fewer arms: minutes. The full study goes on in the same folder; that of
    retrain, which trains on other frames, in another."""
    dataset: str = DEMO
    """demo (generated scenes, needs no data), kitti, vkitti1, vkitti2, coco or yolo."""
    root: str | None = None
    """Folder of the data set, such as KITTI's with training/image_2, label_2 and calib."""
    detector: str = "squeezedet"
    """A shipped detector, a file, or another project's that has a gradient (docs/detectors.md)."""
    steps: int = 10
    """Steps of the attack; steps goes twice as far."""
    queries: int = 64
    """Samples: queries of each method without gradient."""
    budget: str = "paper"
    """How far parameters may go: paper; parking (0.5 m, 5 degrees); a YAML file; or translate=0.5m,rotate=5deg."""
    objective_labels: Literal["moved", "paper"] = "moved"
    """Labels the attacks aim at: moved with the cars, or the benign ones as in the paper (labels has both)."""
    objective: Literal["objectness", "confidence", "total", "failure", "hide", "phantom", "localisation"] = (
        "objectness"
    )
    """What the attacks raise, as in drivesem attack."""
    method: Literal["si-fgsm", "apgd"] = "si-fgsm"
    """Single, multi, labels, transfer, retrain: the attack of all arms; si-fgsm is the paper's."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """What the detector computes gradients in; failures are always judged in float32."""
    controls: bool = True
    """Single, multi: beside each arm random samples of the same box, and one random edit of the same size."""
    confirm: Flag = False
    """Single, multi, labels: have the generator draw each attack's pictures again (generated frames only)."""
    detectors: str = "squeezedet,yolov3-slim"
    """Transfer: detectors to ask, with commas: shipped ones, files, or other projects', also without gradient."""
    sources: str | None = None
    """Transfer: detectors that are attacked, with commas; by default --detector alone."""
    benign_root: str | None = None
    """Retrain: folders of further benign frames to train on, with commas; by default all of --root."""
    held_out: str | None = None
    """Retrain: folder of frames that are never trained on; by default a quarter of --root's."""
    benign_frames: int | None = None
    """Retrain: the first so many of these judge what is benign; by default 1000, 12 with --quick."""
    fresh: int | None = None
    """Retrain: the first so many of these are attacked, with every detector; by default 200, 3 with --quick."""
    train_steps: int | None = None
    """Retrain: steps of training; by default 1500, of the paper's protocol 6000; 40 with --quick."""
    mix: Literal["add", "replace"] = "add"
    """Retrain: counterexamples beside benign frames, or in the place of some; not of the paper's protocol."""
    label_mode: Literal["moved", "paper"] = "moved"
    """Retrain: labels of counterexamples in training; not of the paper's protocol."""
    fit: bool = True
    """Fit template, pose and shape to the photograph's silhouettes (data sets of photographs only)."""
    t_star: float | None = None
    """Score from which a detection counts; by default the detector's own, or 0.3 where it has none."""
    bootstrap: int | None = None
    """Draws of frames for intervals, by default 200; 0 leaves them out."""


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


@dataclass(frozen=True)
class Transfer(Common):
    """Show the counterexamples of finished runs to other detectors: whose failures are shared?"""

    run: str | None = None
    """Folder of a run of drivesem attack; several with commas."""
    detectors: str | None = None
    """Detectors to ask, with commas: shipped ones, files, or other projects' (docs/detectors.md)."""
    tiles: Literal["auto", "off"] = "auto"
    """Of ONNX detectors: auto looks at the whole frame and at overlapping parts of it, enlarged."""
    t_star: float | None = None
    """Score from which a detection counts, of detectors that have no threshold of their own; by default 0.3."""
    bootstrap: int | None = None
    """Draws of frames for intervals, by default 200; 0 leaves them out."""


@dataclass(frozen=True)
class Explain(Common):
    """Say why the counterexamples of a finished run fail: which parameter, which car, and how little is enough."""

    run: str | None = None
    """Folder of a run of drivesem attack."""
    frame: str | None = None
    """Frames of the run by name, with commas; by default all that fail by moved labels."""
    least: Literal["fails", "lost"] = "fails"
    """What the least change must still do: fail in any way, or lose an object where the counterexample does."""
    points: int = 16
    """How many scales of a change are looked at before the smallest that fails is bisected."""
    permutations: int = 32
    """Walks through the cars, in random orders and back, where more than 6 moved; up to 6, all subsets are
    judged."""
    bootstrap: int | None = None
    """Draws of frames for intervals, by default 200; 0 leaves them out."""


@dataclass(frozen=True)
class Confirm(Common):
    """Draw a run's counterexamples again by the scene generator: which failures survive another renderer?"""

    run: str | None = None
    """Folder of a run of drivesem attack on generated frames: the embedded scenes, or drivesem synth's in KITTI's
    layout."""
    root: str | None = None
    """Folder of the run's data set, where it is no longer where the run found it."""


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """The page of a finished run, or of several beside each other: one HTML file with its pictures in it."""

    runs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN...")] = ()
    """Folders of drivesem attack; a folder of drivesem study stands for its arms."""
    out: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """HTML file to write; by default report.html in the one folder given, else where the command is called."""
    frames: int | None = None
    """Frames whose pictures are shown, worst first; by default as many as hold 200 pictures: 100 of one run."""


@dataclass(frozen=True)
class Plausibility(Command):
    """How common the vehicles of a run stand and are built, before and after the attack, by KITTI's labels."""

    run: str | None = None
    """Folder of a run of drivesem attack."""
    out: str | None = None
    """Folder for the results; by default plausibility in the run's folder."""
    limit: int | None = None
    """Take the first N frames."""


@dataclass(frozen=True)
class Realism(Command):
    """How far re-renders and counterexamples are from their photographs: PSNR, SSIM, LPIPS, FID and their kin."""

    runs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN...")] = ()
    """Folders of runs of drivesem attack; a table each."""
    metrics: str = "available"
    """With commas: psnr, ssim, perceptual, lpips-alex, lpips-vgg, lpips-squeeze, frechet, frechet-mobilenet,
    frechet-inception, fid; or available: those whose weights are on disk (docs/realism.md)."""
    weights: str | None = None
    """A folder of weight files, looked at before torch's own cache."""
    fetch: Flag = False
    """Download missing weights into torch's cache, from where their publishers keep them."""
    successes: Flag = False
    """Only frames in which the attack succeeded."""
    limit: int | None = None
    """Take the first N frames of each run."""
    bootstrap: int | None = None
    """Draws of frames for intervals, by default 200; 0 leaves them out."""
    seed: int = 0
    """Seed of these draws."""
    out: str | None = None
    """Folder for the results; by default realism in the first run's folder."""


@dataclass(frozen=True)
class Worth(Command):
    """Information worth of counterexamples, and what a second or retrained detector gained (section 3)."""

    runs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN...")] = ()
    """Folders of runs of drivesem attack against one detector; each object and as many empty places are points."""
    second: str | None = None
    """A second detector, or a folder of drivesem retrain: the gain is what its worth is less."""
    table: str | None = None
    """Instead of runs, a classifier's answers: a CSV file of label, a probability a class, and distance or realism
    where known."""
    after: str | None = None
    """The same table of a second or retrained classifier."""
    distance: str | None = None
    """What realism is counted from: lpips-alex, lpips-vgg, lpips-squeeze, perceptual, or none; by default
    lpips-alex where its weights are on disk, else perceptual (docs/realism.md)."""
    weights: str | None = None
    """A folder of weight files of that distance, looked at before torch's own cache."""
    base: str = "e"
    """Base of the logarithm: e, 2, 10 or another number above 1."""
    limit: int | None = None
    """Take the first N frames of each run."""
    bootstrap: int | None = None
    """Draws of frames for intervals, by default 200; 0 leaves them out."""
    seed: int = 0
    """Seed of these draws."""
    device: str = "cpu"
    """torch device of the second detector: cpu, cuda, cuda:1, ..."""
    tiles: Literal["auto", "off"] = "auto"
    """Of a second detector in ONNX: auto looks at the whole frame and at overlapping parts of it, enlarged."""
    out: str | None = None
    """Folder for the results; by default worth in the first run's folder, or beside the table."""


@dataclass(frozen=True)
class Survey(Command):
    """A page that asks people what they see and how real it looks, as the paper did; it needs no network."""

    runs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN...")] = ()
    """Folders of runs of drivesem attack."""
    items: int = 15
    """Counterexamples that are shown, as in the paper; successes before others, drawn at random."""
    controls: int = 0
    """Beside them so many re-renders without any change: what people say of nothing."""
    seed: int = 0
    """Seed of the draw; the page itself asks everybody in an order of their own."""
    out: str | None = None
    """Folder for survey.html and its key; by default survey in the first run's folder."""


@dataclass(frozen=True)
class SurveyResults(Command):
    """What people said: share that was named rightly, realism, agreement."""

    answers: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="CSV...")] = ()
    """Files that the page saved."""
    survey: str | None = None
    """The folder of drivesem survey, or its key."""
    bootstrap: int | None = None
    """Draws of people for intervals, by default 200; 0 leaves them out."""
    seed: int = 0
    """Seed of these draws."""
    out: str | None = None
    """Folder for the results; by default results beside the key."""


@dataclass(frozen=True)
class Verify(Command):
    """Is a finished run what it says it is? Every frame computed again from its files; exit code 1 where not."""

    run: str | None = None
    """Folder of a run of drivesem attack."""
    out: str | None = None
    """JSON file to write; by default verify.json in the run's folder."""
    limit: int | None = None
    """Check the first N frames."""
    workers: int | None = None
    """Processes that share the frames; by default one a core, at most 4."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1, ..."""
    keep_going: Flag = False
    """List a frame whose files are missing or damaged in the results, and go on with the rest."""


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
    sunset, overcast, twilight), weather.rain=0.4, foliage.hue=0.5."""
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
    """Measure: one attack step, the renderer, memory, detectors."""

    what: tyro.conf.Positional[Literal["step", "render", "memory", "detector"]] = "step"
    """step: a whole attack step beside the detector alone; render: the renderer beside its reference; memory: peak
    memory above the detector's own; detector: forward, backward and decoding of each detector."""
    quick: Flag = False
    """Fewer repetitions: some 50 s."""
    cars: str = "1,4,8,16"
    """How many cars, 1 to 16, with commas."""
    triangles: str = "2000,5000"
    """Triangles a car, with commas."""
    threads: int | None = None
    """Threads of torch and of the kernels; by default as many as torch chooses."""
    detector: str = "squeezedet"
    """Name of a shipped detector, or a .safetensors file of one."""
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
class Anchors(Command):
    """Anchor shapes for a data set, by k-means of its boxes with 1 - IoU as the distance."""

    dataset: str = "kitti"
    """kitti, vkitti1, vkitti2, coco or yolo."""
    root: str
    """Folder of the data set."""
    count: int = 9
    """How many anchors."""
    classes: str | None = None
    """Boxes of these classes only, with commas, as the data set calls them; by default of all."""
    min_height: float = 12.0
    """Lower boxes are left out, px: nothing is trained on them."""
    limit: int | None = None
    """The first N frames."""
    seed: int = 0
    """Seed of the starts; the best of several is kept."""


@dataclass(frozen=True, kw_only=True)
class Check(Command):
    """Does a detector keep its contract? Shapes, gradient, loss, decoding; exit code 1 where it does not."""

    detector: str
    """A shipped detector, a file, or another project's (docs/detectors.md)."""
    size: str = "320x192"
    """WIDTHxHEIGHT of the pictures it is tried on, px."""
    seed: int = 0
    """Seed of the pictures, and of the directions along which differences are taken."""
    tiles: Literal["auto", "off"] = "auto"
    """Of an ONNX detector: auto looks at the whole picture and at overlapping parts of it, enlarged."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1, ..."""


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


@dataclass(frozen=True)
class Train(Common):
    """Train a detector; killed or stopped, the same command goes on and ends with the same weights."""

    detector: str = "squeezedet"
    """Architecture: squeezedet, or another one of docs/training.md."""
    dataset: str = "kitti"
    """kitti, vkitti1, vkitti2, coco or yolo; or synth: the generator makes frames in the run's folder first."""
    root: str | None = None
    """Folder of the data set, or several with commas: their frames are joined."""
    held_out: str | None = None
    """Folder of the same layout to judge by: the best weights on it are kept, and t* is set on it."""
    also: str | None = None
    """Folder of further frames whose figures go into the model card, KITTI layout."""
    frames: int = 1000
    """Synth: how many frames to train on."""
    held_out_frames: int = 100
    """Synth: how many frames to judge by, of shapes and surroundings of their own; 0 is none."""
    weights: str | None = None
    """File for the best weights, with their card beside; by default DETECTOR.safetensors in the run's folder."""
    start: str = "auto"
    """First weights: auto (the shipped ones of this architecture, or none), none, squeezenet (ImageNet backbone),
    darknet:FILE.cfg,FILE.weights, or a .safetensors file: weights, a run's checkpoint, or a backbone."""
    anchors: Literal["published", "kmeans"] = "published"
    """SqueezeDet: as published, or as many by k-means of the data's boxes."""
    steps: int = 10000
    """Length of the schedule in steps."""
    minutes: float = 0.0
    """Where above 0, the schedule also ends after so many minutes by the clock."""
    batch: int = 16
    """Views a step, over all processes."""
    window: str = "640x224"
    """WIDTHxHEIGHT of the views, px."""
    scale: str = "0.5,1.35"
    """Smallest and largest zoom of the views."""
    optimiser: Literal["adamw", "sgd"] = "adamw"
    """sgd is with --momentum."""
    momentum: float = 0.9
    """Of sgd."""
    rate: float = 1e-3
    """Peak learning rate."""
    backbone_rate: float = 0.3
    """Rate of the layers that a backbone provides, relative to the others'."""
    weight_decay: float = 1e-4
    """Decay of the weights a step, relative to the rate."""
    warmup: int = 60
    """Steps in which the rate rises."""
    warmup_power: float = 1.0
    """The rate rises with this power of the steps (Darknet's burn-in: 4)."""
    drops: str | None = None
    """Steps, with commas, at which the rate is multiplied by --drop-factor; without, it falls in a half cosine."""
    drop_factor: float = 0.1
    """Of --drops."""
    clip: float = 50.0
    """Largest norm of a step's gradient."""
    average: float = 0.998
    """Decay a step of the moving average of the weights, which is what is judged and kept."""
    dropout: float = 0.5
    """Of detectors that have dropout."""
    loss: Literal["published", "quality"] = "published"
    """SqueezeDet: the published loss, or the one of detectors/quality.py (confidence is the overlap)."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """What the network computes in: bfloat16 where the processor has it, float16 on GPUs."""
    checkpoint_every: int = 50
    """Steps between checkpoints."""
    evaluate_every: int = 500
    """Steps between evaluations on the held-out frames; 0 is at the end only."""
    thin: int = 1
    """Judge by every n-th held-out frame until the best weights are written."""
    semantic: float = 0.0
    """Share of the views that show a frame with its vehicles moved, turned, bent and painted at random, weather
    and foliage changed, by the project's own renderer; data sets with 3D boxes."""
    loaders: int = 0
    """Threads that make views ready ahead (where a GPU trains); 0 makes them between the steps."""
    note: str = ""
    """A remark on this run for the model card."""


@dataclass(frozen=True, kw_only=True)
class Retrain(Common):
    """Train a detector on with a run's counterexamples, and attack it again. Defaults: the paper's protocol."""

    run: str
    """A run's folder, as drivesem attack writes it."""
    dataset: str | None = None
    """Benign frames to train on: kitti, vkitti1, vkitti2, coco or yolo; by default the run's own photographs."""
    root: str | None = None
    """Folder of that data set."""
    start: str | None = None
    """First weights: a shipped detector or a .safetensors file; by default the detector that the run attacked."""
    fraction: float = 0.25
    """Share of the training set that are counterexamples."""
    mix: Literal["replace", "add"] = "replace"
    """Counterexamples in the place of benign frames, drawn at random, or beside all of them."""
    label_mode: Literal["paper", "moved"] = "paper"
    """Labels of counterexamples in training: the benign ones as in the paper, or moved with the cars."""
    ramp: float = 0.0
    """Share of the steps over which counterexamples come in little by little; 0: all from the first step."""
    validation: float = 0.25
    """Share of the run's frames that are never trained on: the table's figures are of these."""
    fresh: int | None = None
    """How many of those are attacked again, against the retrained detector; by default all, 0 is none."""
    attack_steps: int | None = None
    """Steps of that attack; by default as many as the run's."""
    steps: int = 6000
    """Steps of training."""
    minutes: float = 0.0
    """Where above 0, training also ends after so many minutes by the clock."""
    batch: int = 16
    """Views a step."""
    window: str = "640x224"
    """WIDTHxHEIGHT of the views, px."""
    scale: str = "0.5,1.35"
    """LOW,HIGH of the zoom of views."""
    rate: float = 3e-4
    """Peak learning rate of AdamW; it falls in a half cosine."""
    warmup: int = 60
    """Steps in which the rate rises."""
    loss: Literal["published", "quality"] = "published"
    """SqueezeDet: the published loss, or the one of detectors/quality.py (confidence is the overlap)."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """What the network computes in when it is trained."""
    checkpoint_every: int = 50
    """Steps between checkpoints."""


COMMANDS: dict[str, type[Command]] = {
    "attack": Attack,
    "transfer": Transfer,
    "study": Study,
    "explain": Explain,
    "confirm": Confirm,
    "report": Report,
    "plausibility": Plausibility,
    "realism": Realism,
    "worth": Worth,
    "survey": Survey,
    "survey-results": SurveyResults,
    "verify": Verify,
    "derender": Derender,
    "render": Render,
    "edit": Edit,
    "synth": Synth,
    "bench": Bench,
    "gradcheck": Gradcheck,
    "eval": Eval,
    "convert": Convert,
    "check": Check,
    "anchors": Anchors,
    "train": Train,
    "retrain": Retrain,
}


def processes(config: Common) -> int:
    """How many processes share the frames."""
    return config.workers or min(os.cpu_count() or 1, _MOST_PROCESSES)
