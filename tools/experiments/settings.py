"""Settings of the experiments: one dataclass each, as `drivesem.config.commands` has them for the product."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Literal

import tyro

from drivesem.config.commands import MIN_PASSES, Fraction, RunArguments, RunFolders
from drivesem.config.constraints import POSITIVE, ExistingFolder, NumberRange, OneOf, Required, at_least
from drivesem.config.errors import refuse
from drivesem.config.options import (
    DEMO,
    BootstrapOption,
    CommandConfig,
    CommandName,
    Count,
    Flag,
    FolderOrUrl,
    FrameCommandConfig,
    GradingOptions,
    LabelMode,
    NotNegative,
    RunOption,
    SceneAttackOptions,
    SeededBootstrapOptions,
    option_name,
)

_REPORT_SETTINGS = ("name", "results", "out", "bootstrap", "json")
"""Settings that --from accepts."""


@dataclass(frozen=True, kw_only=True)
class StudyConfig(BootstrapOption, GradingOptions, SceneAttackOptions, FrameCommandConfig):
    """Experiments of the paper and others: every arm attacks the same frames."""

    name: CommandName = ""
    """Experiment. single: the six parameters, one at a time; multi: the combinations 1 to 4; grades: reliability of
    failures by gradient, sampling and placebo; searches: methods at an equal number of passes; samples: success
    against queries for each algorithm; steps: success against number and size of steps; labels: effect of labels
    that do not move with the cars; attribution: points of score due to each part of the paper's protocol;
    transfer: counterexamples of combination 2 on other detectors; retrain: detectors fine-tuned on
    counterexamples, tested on benign frames, known and fresh counterexamples; classification: the paper's tables
    for image classifiers (docs/guide/classifiers.md)."""
    out: FolderOrUrl = None
    """Folder of the results, or its URL (docs/guide/scale.md); the same command resumes what it finds there."""
    results: Annotated[str | None, ExistingFolder(), tyro.conf.arg(aliases=["--from"])] = None
    """Folder of stored results, such as OUT/results or docs/data/NAME: report them again without data or attacks.
    Only --out, --bootstrap and --json go with it."""
    quick: Flag = False
    """6 frames instead of 200, and fewer arms: takes minutes. The full study resumes in the same folder; retrain,
    which trains on other frames, needs another one."""
    detector: str = "squeezedet"
    """Detector with gradients: a shipped one, a file, or another project's (docs/reference/detectors.md)."""
    bootstrap: NotNegative | None = None
    """Bootstrap samples of frames for intervals (default: 1000, classification 200); 0 for no intervals."""
    steps: Count = 10
    """Steps of the attack; the experiment steps takes up to twice as many."""
    queries: Count = 64
    """samples: queries of each gradient-free method."""
    passes: Annotated[int, at_least(MIN_PASSES, "which the search needs")] = 90
    """searches, and retrain with climb: detector passes of each method per frame (a gradient counts as 3)."""
    pace: Annotated[str | None, ExistingFolder()] = None
    """searches: folder of such a study; each method gets as many more passes as fit into the seconds per frame of the
    slowest method there."""
    params: str | None = None
    """searches, retrain: parameters to change, with commas: color, weather, foliage, translate, rotate, mesh
    (default: those of combination 2)."""
    objective_labels: LabelMode = "moved"
    """Labels in the attack's objective: moved with the cars, or benign as in the paper (labels has both)."""
    method: Literal["si-fgsm", "apgd", "climb"] = "si-fgsm"
    """single, multi, labels, transfer, retrain: attack of all arms; si-fgsm is the paper's; climb, only for retrain,
    finds failures that hold."""
    controls: bool = True
    """single, multi: add to each arm random samples of the same box, and one random edit of the same size."""
    seeds: Count | None = None
    """single, multi: seeds of each control (default: 3, with --quick 1). retrain: seeds of the arms benign, random,
    certain and consistent (default: 1)."""
    paper_protocol: bool = True
    """single, multi: add each arm under the paper's exact protocol (--config paper), if the detector has its loss."""
    confirm: Flag = False
    """single, multi, labels: also re-render the pictures of each attack with a second renderer, like drivesem
    confirm. Certain failures are always re-rendered."""
    other_detector: str | None = None
    """attribution: the paper's detector, if --detector is another one, as one more factor."""
    detectors: str = "squeezedet,yolov3-slim"
    """transfer: detectors to test, with commas: shipped ones, files, or other projects', also without gradients."""
    sources: str | None = None
    """transfer: detectors to attack, with commas (default: only --detector)."""
    benign_root: str | None = None
    """retrain: folders of additional benign training frames, with commas (default: all frames of --root)."""
    held_out: str | None = None
    """retrain: folder of frames that are never trained on (default: a quarter of --root's)."""
    validation: str | None = None
    """retrain: folder of frames of the same layout that set t* of retrained detectors (default: the benign test
    frames)."""
    arms: str | None = None
    """retrain: training arms, with commas: benign, re-rendered, random, generator, ours, certain, consistent, worst,
    paper (docs/research/detection.md; default: re-rendered, ours and, without --quick, paper)."""
    states: NotNegative = 16
    """retrain: states of each held-out frame in which all detectors are tested; 0 for none."""
    consistency: Annotated[float, POSITIVE] = 1.0
    """retrain: weight of the additional loss of consistent, which compares margins of objects and background in the
    two pictures of a failure, and of worst, which uses the worst of four pictures."""
    fraction: Fraction = 0.25
    """retrain: share of the extra pictures in a batch; not in the paper's protocol."""
    near: Annotated[float, NumberRange(0, 1, expected="a share from 0 to 1")] = 0.5
    """retrain: share of the states around a failure that are close to it."""
    reattack: bool = True
    """retrain: also attack held-out frames against each retrained detector, not only against the original one."""
    benign_frames: Count | None = None
    """retrain: number of benign test frames (default: 1000, with --quick 12)."""
    fresh: Count | None = None
    """retrain: number of frames to attack with every detector (default: 200, with --quick 3)."""
    train_steps: Count | None = None
    """retrain: training steps (default: 1500, 6000 for the paper's protocol, 40 with --quick)."""
    mix: Literal["add", "replace"] = "add"
    """retrain: add counterexamples to the benign frames, or replace some of them; not in the paper's protocol."""
    label_mode: LabelMode = "moved"
    """retrain: labels of counterexamples in training; not in the paper's protocol."""
    networks: str = "squeezenet"
    """classification: networks to attack, with commas: squeezenet, or weights of drivesem classify train."""
    objects: str | None = None
    """classification: source of objects, as in drivesem classify; --limit counts their pictures (default: 480, with
    --quick 12), --fresh those on which retrained networks are attacked (default: 232, with --quick 3)."""
    backgrounds: Annotated[str, ExistingFolder("a folder of photographs")] | None = None
    """classification: folder of photographs as backgrounds (default: generated pictures)."""
    train_pictures: Count | None = None
    """classification: training pictures, of which half become counterexamples (default: 960, with --quick 12)."""
    whole_pictures: NotNegative | None = None
    """classification: training pictures for whole networks, as the code trains them (default: 240, with --quick 0);
    0 trains last layers instead, on all training pictures."""
    readings: str = "text,code"
    """classification: readings of the paper, with commas: text, code (configs/paper-text.yaml, paper-code.yaml)."""
    tables: str | None = None
    """classification: tables to compute, with commas: degradation, parameters, hyperparameters, retraining,
    robustness, worth, realism, transfer, attribution, pixels, sizes (default: all; with --quick not parameters,
    hyperparameters, pixels)."""

    def check(self) -> None:
        super().check()
        further = (self.held_out, self.benign_root) != (None, None)
        refuse(
            self.dataset == DEMO and further, "--held-out, --benign-root", "none with the embedded frames", "one"
        )
        experiment = self.name
        if self.results is not None:
            for field in fields(self):
                value, alone = getattr(self, field.name), "none with --from, which uses the study's own settings"
                changed = field.name not in _REPORT_SETTINGS and value != field.default
                refuse(changed, option_name(field.name), alone, value)
        refuse(self.pace is not None and self.name != "searches", "--pace", "experiment searches", experiment)
        divided = self.split is not None and self.name == "retrain"
        refuse(divided, "--split", "none with retrain, which divides --root itself (--held-out)", self.split)
        other = self.other_detector is not None and self.name != "attribution"
        refuse(other, "--other-detector", "experiment attribution", experiment)
        climbs = self.method == "climb" and self.name != "retrain"
        refuse(climbs, "--method", "si-fgsm or apgd; climb only with retrain", self.method)
        made = self.dataset == DEMO and self.validation is not None
        refuse(made, "--validation", "none with the embedded frames", self.validation)


@dataclass(frozen=True, kw_only=True)
class RealismConfig(SeededBootstrapOptions, CommandConfig):
    """Measure how far re-renders and counterexamples are from their photographs: PSNR, SSIM, LPIPS, FID and others."""

    runs: RunFolders = ()
    """Folders of runs of drivesem attack; one table each."""
    metrics: str = "available"
    """Metrics, with commas: psnr, ssim, perceptual, lpips-alex, lpips-vgg, lpips-squeeze, frechet, frechet-mobilenet,
    frechet-inception, fid; or available: all with weights on disk (docs/research/realism.md)."""
    weights: Annotated[str, ExistingFolder()] | None = None
    """Folder of weight files, searched before torch's own cache."""
    fetch: Flag = False
    """Download missing weights from their publishers into torch's cache."""
    successes: Flag = False
    """Only frames in which the attack succeeded."""
    limit: Count | None = None
    """Number of frames per run, from the first."""
    out: str | None = None
    """Folder of the results (default: realism in the first run's folder)."""


@dataclass(frozen=True, kw_only=True)
class FidelityConfig(SeededBootstrapOptions, CommandConfig):
    """Fit the fidelity of edited objects to generated streets, and test it on others (docs/research/realism.md)."""

    out: str
    """Folder of the results; the same command resumes what it finds there."""
    streets: Annotated[int, at_least(2, "one to fit, one to test")] = 60
    """Number of generated streets; every other one is held out."""


@dataclass(frozen=True, kw_only=True)
class RealityConfig(SeededBootstrapOptions, CommandConfig):
    """Compare failures on dry-day photographs with failures in real fog, rain, snow, dusk and night."""

    part: tyro.conf.Positional[Literal["attack", "rules", "observe", "retrain", "survey", "report"]] = "report"
    """attack: attack days of half A and sample objects; rules: fix the rules; observe: run detectors on the frames of
    --half; retrain: train the arms and test them; survey: write a page that asks people about certain failures and
    real misses; report: compute the tables."""
    out: str | None = None
    """Folder of the results; the same command resumes what it finds there."""
    results: Annotated[str | None, ExistingFolder(), tyro.conf.arg(aliases=["--from"])] = None
    """report: folder of stored tables, such as docs/data/reality (default: those of --out)."""
    root: str | None = None
    """Folder of BDD100K's frames in COCO's layout, with weather and timeofday."""
    fog_root: str | None = None
    """Folder of real frames in fog (DAWN) in COCO's layout."""
    kitti_root: str | None = None
    """attack: folder of KITTI frames to attack as well."""
    train_root: str | None = None
    """retrain: folder of real dry days in COCO's layout."""
    half: Annotated[str, OneOf(("A", "B"))] = "B"
    """observe: half of the real frames."""
    half_a: str | None = None
    """Folder of tools.bench conditions with scenes and pictures of half A (default: half-A in --out)."""
    half_b: str | None = None
    """The same of half B."""
    detectors: str = "squeezedet,yolov3-slim"
    """Detectors to observe, with commas; NAME@SCORE sets a threshold other than t*."""
    attacked: str = "squeezedet"
    """Detectors to attack, with commas."""
    drawn: Count = 24
    """Most sunny days of half B on which weather is drawn."""
    placebos: Count = 24
    """How many of them get placebos."""
    real: Count = 1000
    """Most real frames of each adverse condition of half B."""
    real_days: Count = 1000
    """Most real dry days of a half."""
    real_a: Count = 24
    """Most real frames of each adverse condition of half A."""
    days_a: Count = 12
    """Most sunny days of half A in which objects are sampled."""
    attack_frames: NotNegative = 3
    """How many of them to attack; objects are sampled in all."""
    kitti_frames: Count = 2
    """Frames of --kitti-root to attack."""
    passes: Count = 30
    """Detector passes of each attack."""
    samples: Count = 16
    """Samples around each certain failure."""
    contrast: Count = 12
    """Samples of each day in which all objects change."""
    rules: Count = 5
    """Rules of each attacked detector."""
    detector: str = "squeezedet"
    """retrain: detector to fine-tune."""
    arms: str = "days,usual,random,worst"
    """retrain: arms, with commas."""
    days: Count = 300
    """retrain: dry days to train on."""
    edited: Count = 60
    """retrain: how many of them are de-rendered and edited."""
    states: Count = 4
    """retrain: random states of each; the arm worst takes the one with the largest loss."""
    train_steps: Count = 200
    """retrain: training steps of each arm."""
    batch: Count = 4
    """retrain: pictures per step."""
    seeds: Count = 1
    """retrain: seeds of each arm."""
    items: Count = 40
    """survey: questions of each kind."""
    test: Count = 40
    """retrain: most real frames of each condition of half B to test on."""

    def check(self) -> None:
        super().check()
        refuse(self.part != "report" and self.results is not None, "--from", "none but with report", self.part)
        refuse(self.part != "report" and self.out is None, "--out", "a folder", "none")
        refuse(self.part == "report" and self.out is self.results is None, "--from", "a folder, or --out", "none")
        refuse(
            self.part in ("attack", "observe", "retrain", "survey") and self.root is None,
            "--root",
            "a folder",
            "none",
        )
        refuse(self.part == "retrain" and self.train_root is None, "--train-root", "a folder", "none")


@dataclass(frozen=True, kw_only=True)
class WorthConfig(SeededBootstrapOptions, CommandConfig):
    """Measure the information worth of counterexamples and the gain of a second or retrained detector (section 3)."""

    runs: RunArguments = ()
    """Folders of runs of drivesem attack against one detector; each object and as many empty places are points."""
    second: str | None = None
    """Second detector, or a folder of drivesem retrain; the gain is the decrease in worth."""
    table: str | None = None
    """Instead of runs, a classifier's predictions: a CSV file of label, one probability per class, and optionally
    distance or realism."""
    after: str | None = None
    """The same table of a second or retrained classifier."""
    study: str | None = None
    """Instead of runs, the folder of a finished study, such as multi, single or retrain: realism and worth of each
    arm's pictures; with retrain also the gain of its detectors."""
    metrics: str = "available"
    """With --study: metrics, as in the experiment realism."""
    bootstrap: NotNegative | None = None
    """With --study: bootstrap samples of frames for intervals of distances (default: 200); 0 for no intervals."""
    distance: str | None = None
    """Distance that defines realism: lpips-alex, lpips-vgg, lpips-squeeze, perceptual, or none (default: lpips-alex
    if its weights are on disk, else perceptual; docs/research/realism.md)."""
    weights: Annotated[str, ExistingFolder()] | None = None
    """Folder of weight files of that distance, searched before torch's own cache."""
    base: str = "e"
    """Base of the logarithm: e, 2, 10 or another number above 1."""
    limit: Count | None = None
    """Number of frames per run, from the first."""
    device: str = "cpu"
    """torch device of the second detector: cpu, cuda, cuda:1, ..."""
    tiles: Literal["auto", "off"] = "auto"
    """Tiling of a second ONNX detector: auto adds enlarged, overlapping parts of the frame."""
    out: str | None = None
    """Folder of the results (default: worth in the first run's folder, or in the table's)."""

    def check(self) -> None:
        super().check()
        given = sum((bool(self.runs), self.table is not None, self.study is not None))
        sources = "folders of drivesem attack, or --table, or --study"
        refuse(given != 1, "RUN", sources, "several of them" if given else "nothing")
        refuse(self.after is not None and self.table is None, "--after", "--table", "none")
        twice = self.second is not None and self.table is not None
        refuse(twice, "--second", "runs (--after is a second table)", f"--table {self.table}")
        other = self.metrics != "available" and self.study is None
        refuse(other, "--metrics", "--study (for runs: realism)", "none")
        drawn = self.bootstrap is not None and self.study is None
        refuse(drawn, "--bootstrap", "--study (worth itself has jackknife intervals)", "none")


@dataclass(frozen=True, kw_only=True)
class PlausibilityConfig(RunOption, CommandConfig):
    """Compare the poses and shapes of a run's vehicles, before and after the attack, with KITTI's labels."""

    out: str | None = None
    """Folder of the results (default: plausibility in the run's folder)."""
    limit: Count | None = None
    """Number of frames, from the first."""


@dataclass(frozen=True, kw_only=True)
class SurveyConfig(CommandConfig):
    """Build an offline page on which people name what they see and rate how real it looks, as in the paper."""

    runs: RunFolders = ()
    """Folders of runs of drivesem attack."""
    items: Count = 15
    """Number of counterexamples, as in the paper: successes first, drawn at random."""
    controls: NotNegative = 0
    """Number of additional re-renders without any change, as controls."""
    seed: int = 0
    """Seed of the draw; the page orders its items at random for each participant."""
    out: str | None = None
    """Folder of survey.html and its key (default: survey in the first run's folder)."""


@dataclass(frozen=True, kw_only=True)
class SurveyResultsConfig(SeededBootstrapOptions, CommandConfig):
    """Evaluate survey answers: share named correctly, realism, agreement."""

    answers: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="CSV..."),
        Required("files saved by the survey page", "CSV"),
    ] = ()
    """Files saved by the survey page."""
    survey: Annotated[str | None, Required("the folder of a survey")] = None
    """Folder of the survey, or its key."""
    bootstrap: NotNegative | None = None
    """Bootstrap samples of participants for intervals (default: 200); 0 for no intervals."""
    out: str | None = None
    """Folder of the results (default: results in the key's folder)."""
