"""Settings of the experiments: one dataclass each, as `drivesem.config.commands` has them for the product."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Literal

import tyro

from drivesem.config.commands import MIN_PASSES, Fraction, RunArguments, RunFolders
from drivesem.config.constraints import POSITIVE, ExistingFolder, NumberRange, Required, at_least
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
"""Settings of a study that is told again."""


@dataclass(frozen=True, kw_only=True)
class StudyConfig(BootstrapOption, GradingOptions, SceneAttackOptions, FrameCommandConfig):
    """The paper's experiments, and others: every arm an attack on the same frames."""

    name: CommandName = ""
    """single: the six parameters, each alone; multi: the combinations 1 to 4; grades: how sure failures are, by
    gradient, sampling and placebo; searches: which method finds failures that hold, at as many passes each;
    samples: success against queries for each algorithm; steps: success against number and size of steps; labels:
    what labels that stay behind make of an attack; attribution: which part of the paper's protocol takes how many
    points; transfer: counterexamples of combination 2 before other
    detectors; retrain: detectors trained on with counterexamples, before benign frames, known and fresh
    counterexamples; classification: the paper's tables for image classifiers (docs/guide/classifiers.md)."""
    out: FolderOrUrl = None
    """Folder for the results, or its URL (docs/guide/scale.md); a second run with the same goes on where it stopped."""
    results: Annotated[str | None, ExistingFolder(), tyro.conf.arg(aliases=["--from"])] = None
    """Folder of stored results, such as OUT/results or docs/data/NAME: report them again without data or attacks. Only
    --out, --bootstrap and --json go with it."""
    quick: Flag = False
    """6 frames instead of 200, and fewer arms: minutes. The full study goes on in the same folder; that of
    retrain, which trains on other frames, in another."""
    detector: str = "squeezedet"
    """A shipped detector, a file, or another project's that has a gradient (docs/reference/detectors.md)."""
    bootstrap: NotNegative | None = None
    """Draws of frames for intervals, by default 1000, of classification 200; 0 leaves them out."""
    steps: Count = 10
    """Steps of the attack; steps goes twice as far."""
    queries: Count = 64
    """Samples: queries of each method without gradient."""
    passes: Annotated[int, at_least(MIN_PASSES, "which the search needs")] = 90
    """Searches, and retrain with climb: passes of the detector that each method may take for a frame, a gradient
    counted as 3."""
    pace: Annotated[str | None, ExistingFolder()] = None
    """Searches: folder of such a study; each method takes as many more passes as fit into the seconds that the
    slowest took there for a frame."""
    params: str | None = None
    """Searches, retrain: what is changed, with commas: color, weather, foliage, translate, rotate, mesh; by
    default as combination 2."""
    objective_labels: LabelMode = "moved"
    """Labels the attacks aim at: moved with the cars, or the benign ones as in the paper (labels has both)."""
    method: Literal["si-fgsm", "apgd", "climb"] = "si-fgsm"
    """Single, multi, labels, transfer, retrain: the attack of all arms; si-fgsm is the paper's; climb, of retrain
    alone, finds failures that hold."""
    controls: bool = True
    """Single, multi: beside each arm random samples of the same box, and one random edit of the same size."""
    seeds: Count | None = None
    """Single, multi: seeds of random numbers for each control, by default 3, 1 with --quick. Retrain: seeds by
    which benign, random, certain and consistent are trained, by default one."""
    paper_protocol: bool = True
    """Single, multi: beside each arm the same by the paper's exact protocol (--config paper), where the detector
    has its loss."""
    confirm: Flag = False
    """Single, multi, labels: have a second renderer draw each attack's pictures again, as drivesem confirm does.
    What is certain is drawn by it in any case."""
    other_detector: str | None = None
    """Attribution: a detector that is the paper's where ours is --detector, as one more factor."""
    detectors: str = "squeezedet,yolov3-slim"
    """Transfer: detectors to ask, with commas: shipped ones, files, or other projects', also without gradient."""
    sources: str | None = None
    """Transfer: detectors that are attacked, with commas; by default --detector alone."""
    benign_root: str | None = None
    """Retrain: folders of further benign frames to train on, with commas; by default all of --root."""
    held_out: str | None = None
    """Retrain: folder of frames that are never trained on; by default a quarter of --root's."""
    validation: str | None = None
    """Retrain: folder of further frames, of the same layout, on which retrained detectors' t* is chosen; by
    default the benign frames that judge them."""
    arms: str | None = None
    """Retrain: what is trained, with commas: benign, re-rendered, random, generator, ours, certain, consistent,
    worst, paper (docs/research/detection.md); by default re-rendered, ours and, without --quick, paper."""
    states: NotNegative = 16
    """Retrain: states of each held-out frame in which all detectors look for its cars; 0 leaves this out."""
    consistency: Annotated[float, POSITIVE] = 1.0
    """Retrain: weight of the further term of consistent, which compares margins of objects and of background in
    a failure's two pictures, and of worst, which asks for the object in the worst of four and for nothing beside
    it."""
    fraction: Fraction = 0.25
    """Retrain: share of the extra pictures among all that is shown; not of the paper's protocol."""
    near: Annotated[float, NumberRange(0, 1, expected="a share from 0 to 1")] = 0.5
    """Retrain: share of the states around a failure that lie near it."""
    reattack: bool = True
    """Retrain: attack held-out frames against each retrained detector too, not against the detector as it was
    alone."""
    benign_frames: Count | None = None
    """Retrain: the first so many of these judge what is benign; by default 1000, 12 with --quick."""
    fresh: Count | None = None
    """Retrain: the first so many of these are attacked, with every detector; by default 200, 3 with --quick."""
    train_steps: Count | None = None
    """Retrain: steps of training; by default 1500, of the paper's protocol 6000; 40 with --quick."""
    mix: Literal["add", "replace"] = "add"
    """Retrain: counterexamples beside benign frames, or in the place of some; not of the paper's protocol."""
    label_mode: LabelMode = "moved"
    """Retrain: labels of counterexamples in training; not of the paper's protocol."""
    networks: str = "squeezenet"
    """Classification: networks to attack, with commas: squeezenet, or weights that classify train wrote."""
    objects: str | None = None
    """Classification: where objects come from, as in drivesem classify; --limit counts their pictures, by default
    480, 36 with --quick, and --fresh those on which retrained networks are attacked, 232, 36 with --quick."""
    backgrounds: Annotated[str, ExistingFolder("a folder of photographs")] | None = None
    """Classification: photographs to put behind objects; by default pictures that are made."""
    train_pictures: Count | None = None
    """Classification: pictures to retrain on, of which half become counterexamples; by default 960, 144 with
    --quick."""
    tables: str | None = None
    """Classification: which of them, with commas: degradation, parameters, hyperparameters, retraining,
    robustness, worth, realism, transfer, pixels, sizes; by default all."""

    def check(self) -> None:
        super().check()
        further = (self.held_out, self.benign_root) != (None, None)
        refuse(
            self.dataset == DEMO and further, "--held-out, --benign-root", "none with the embedded frames", "one"
        )
        beside = self.name
        if self.results is not None:
            for field in fields(self):
                value, alone = getattr(self, field.name), "none with --from, which uses the study's own settings"
                changed = field.name not in _REPORT_SETTINGS and value != field.default
                refuse(changed, option_name(field.name), alone, value)
        refuse(self.pace is not None and self.name != "searches", "--pace", "study searches", beside)
        divided = self.split is not None and self.name == "retrain"
        refuse(divided, "--split", "none with study retrain, which divides --root itself (--held-out)", self.split)
        other = self.other_detector is not None and self.name != "attribution"
        refuse(other, "--other-detector", "study attribution", beside)
        climbs = self.method == "climb" and self.name != "retrain"
        refuse(climbs, "--method", "si-fgsm or apgd; climb with study retrain alone", self.method)
        made = self.dataset == DEMO and self.validation is not None
        refuse(made, "--validation", "none with the embedded frames", self.validation)


@dataclass(frozen=True, kw_only=True)
class RealismConfig(SeededBootstrapOptions, CommandConfig):
    """How far re-renders and counterexamples are from their photographs: PSNR, SSIM, LPIPS, FID and their kin."""

    runs: RunFolders = ()
    """Folders of runs of drivesem attack; a table each."""
    metrics: str = "available"
    """With commas: psnr, ssim, perceptual, lpips-alex, lpips-vgg, lpips-squeeze, frechet, frechet-mobilenet,
    frechet-inception, fid; or available: those whose weights are on disk (docs/research/realism.md)."""
    weights: Annotated[str, ExistingFolder()] | None = None
    """A folder of weight files, looked at before torch's own cache."""
    fetch: Flag = False
    """Download missing weights into torch's cache, from where their publishers keep them."""
    successes: Flag = False
    """Only frames in which the attack succeeded."""
    limit: Count | None = None
    """Take the first N frames of each run."""
    out: str | None = None
    """Folder for the results; by default realism in the first run's folder."""


@dataclass(frozen=True, kw_only=True)
class WorthConfig(SeededBootstrapOptions, CommandConfig):
    """Information worth of counterexamples, and what a second or retrained detector gained (section 3)."""

    runs: RunArguments = ()
    """Folders of runs of drivesem attack against one detector; each object and as many empty places are points."""
    second: str | None = None
    """A second detector, or a folder of drivesem retrain: the gain is what its worth is less."""
    table: str | None = None
    """Instead of runs, a classifier's answers: a CSV file of label, a probability a class, and distance or realism
    where known."""
    after: str | None = None
    """The same table of a second or retrained classifier."""
    study: str | None = None
    """Instead of runs, the folder of a finished study, such as multi, single or retrain: of each arm how real
    its pictures are, as drivesem realism tells it, and their worth; of retrain also what its detectors gained."""
    metrics: str = "available"
    """With --study, as of drivesem realism."""
    bootstrap: NotNegative | None = None
    """With --study: draws of frames for intervals of its distances, by default 200; 0 leaves them out."""
    distance: str | None = None
    """What realism is counted from: lpips-alex, lpips-vgg, lpips-squeeze, perceptual, or none; by default
    lpips-alex where its weights are on disk, else perceptual (docs/research/realism.md)."""
    weights: Annotated[str, ExistingFolder()] | None = None
    """A folder of weight files of that distance, looked at before torch's own cache."""
    base: str = "e"
    """Base of the logarithm: e, 2, 10 or another number above 1."""
    limit: Count | None = None
    """Take the first N frames of each run."""
    device: str = "cpu"
    """torch device of the second detector: cpu, cuda, cuda:1, ..."""
    tiles: Literal["auto", "off"] = "auto"
    """Of a second detector in ONNX: auto looks at the whole frame and at overlapping parts of it, enlarged."""
    out: str | None = None
    """Folder for the results; by default worth in the first run's folder, or beside the table."""

    def check(self) -> None:
        super().check()
        given = sum((bool(self.runs), self.table is not None, self.study is not None))
        ways = "folders of drivesem attack, or --table, or --study"
        refuse(given != 1, "RUN", ways, "several of them" if given else "nothing")
        refuse(self.after is not None and self.table is None, "--after", "--table beside it", "none")
        twice = self.second is not None and self.table is not None
        refuse(twice, "--second", "runs (--after is a second table)", f"--table {self.table}")
        other = self.metrics != "available" and self.study is None
        refuse(other, "--metrics", "--study beside it (drivesem realism measures runs)", "none")
        drawn = self.bootstrap is not None and self.study is None
        refuse(drawn, "--bootstrap", "--study beside it (worth itself has the jackknife's intervals)", "none")


@dataclass(frozen=True, kw_only=True)
class PlausibilityConfig(RunOption, CommandConfig):
    """How common the vehicles of a run stand and are built, before and after the attack, by KITTI's labels."""

    out: str | None = None
    """Folder for the results; by default plausibility in the run's folder."""
    limit: Count | None = None
    """Take the first N frames."""


@dataclass(frozen=True, kw_only=True)
class SurveyConfig(CommandConfig):
    """A page that asks people what they see and how real it looks, as the paper did; it needs no network."""

    runs: RunFolders = ()
    """Folders of runs of drivesem attack."""
    items: Count = 15
    """Counterexamples that are shown, as in the paper; successes before others, drawn at random."""
    controls: NotNegative = 0
    """Beside them so many re-renders without any change: what people say of nothing."""
    seed: int = 0
    """Seed of the draw; the page itself asks everybody in an order of their own."""
    out: str | None = None
    """Folder for survey.html and its key; by default survey in the first run's folder."""


@dataclass(frozen=True, kw_only=True)
class SurveyResultsConfig(SeededBootstrapOptions, CommandConfig):
    """What people said: share that was named rightly, realism, agreement."""

    answers: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="CSV..."),
        Required("files that the page of drivesem survey saved", "CSV"),
    ] = ()
    """Files that the page saved."""
    survey: Annotated[str | None, Required("the folder of drivesem survey")] = None
    """The folder of drivesem survey, or its key."""
    bootstrap: NotNegative | None = None
    """Draws of people for intervals, by default 200; 0 leaves them out."""
    out: str | None = None
    """Folder for the results; by default results beside the key."""
