"""Settings that no command accepts."""

from __future__ import annotations

import math
from pathlib import Path

from drivesem.settings.commands import (
    COMBO_NUMBERS,
    COUNTED,
    DATASETS,
    DEMO,
    GRADIENT_FREE,
    RESTARTED,
    SYNTH,
    Anchors,
    Attack,
    Bench,
    Command,
    Common,
    Confirm,
    Derender,
    Eval,
    Explain,
    Gradcheck,
    Plausibility,
    Realism,
    Report,
    Retrain,
    Study,
    Survey,
    SurveyResults,
    Synth,
    Train,
    Transfer,
    Verify,
    Worth,
)
from drivesem.settings.errors import UsageError
from drivesem.settings.values import numbers


def validate(config: Command) -> None:
    """Raise UsageError for values that no command accepts."""
    if isinstance(config, Common | Verify):
        if config.workers is not None and config.workers < 1:
            raise UsageError("--workers", "at least 1", config.workers)
        if config.limit is not None and config.limit < 1:
            raise UsageError("--limit", "at least 1", config.limit)
    if isinstance(config, Report):
        if not config.runs:
            raise UsageError("RUN", "folders of drivesem attack", "none")
        if config.frames is not None and config.frames < 1:
            raise UsageError("--frames", "at least 1", config.frames)
    if isinstance(config, Attack | Study | Derender | Gradcheck):
        check_dataset(config.dataset, config.root)
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
        if config.queries is not None and config.queries < 1:
            raise UsageError("--queries", "at least 1", config.queries)
        if config.method not in GRADIENT_FREE:
            if config.range != "bounds":
                without = f"a method without gradient ({', '.join(GRADIENT_FREE)}) beside it"
                raise UsageError("--range", without, config.method)
        elif config.precision != "float32":
            raise UsageError(
                "--precision", f"float32 with {config.method}, which takes no gradient", config.precision
            )
        _validate_method(config)
    if isinstance(config, Study):
        for name in ("steps", "queries", "benign_frames", "fresh", "train_steps"):
            value = getattr(config, name)
            if value is not None and value < 1:
                raise UsageError(f"--{name.replace('_', '-')}", "at least 1", value)
        if config.dataset == DEMO and (config.held_out, config.benign_root) != (None, None):
            raise UsageError("--held-out, --benign-root", "none with the embedded frames", "one")
        if config.bootstrap is not None and config.bootstrap < 0:
            raise UsageError("--bootstrap", "at least 0", config.bootstrap)
    if isinstance(config, Attack | Study | Transfer) and config.t_star is not None and not 0 < config.t_star <= 1:
        raise UsageError("--t-star", "a score in (0, 1]", config.t_star)
    if isinstance(config, Transfer):
        if not config.run:
            raise UsageError("--run", "a folder of drivesem attack", "nothing")
        if not config.detectors:
            raise UsageError("--detectors", "detectors with commas", "nothing")
        if config.bootstrap is not None and config.bootstrap < 0:
            raise UsageError("--bootstrap", "at least 0", config.bootstrap)
    if isinstance(config, Explain):
        if not config.run:
            raise UsageError("--run", "a folder of drivesem attack", "nothing")
        if config.points < 1:
            raise UsageError("--points", "at least 1", config.points)
        if config.permutations < 2 or config.permutations % 2:
            raise UsageError("--permutations", "an even number, at least 2", config.permutations)
        if config.bootstrap is not None and config.bootstrap < 0:
            raise UsageError("--bootstrap", "at least 0", config.bootstrap)
    if isinstance(config, Confirm | Plausibility | Verify) and not config.run:
        raise UsageError("--run", "a folder of drivesem attack", "nothing")
    if isinstance(config, Plausibility) and config.limit is not None and config.limit < 1:
        raise UsageError("--limit", "at least 1", config.limit)
    if isinstance(config, Worth):
        if bool(config.runs) == (config.table is not None):
            found = "both" if config.runs else "nothing"
            raise UsageError("RUN", "folders of drivesem attack, or --table", found)
        if config.after is not None and config.table is None:
            raise UsageError("--after", "--table beside it", "none")
        if config.second is not None and config.table is not None:
            raise UsageError("--second", "runs (--after is a second table)", f"--table {config.table}")
    if isinstance(config, Survey) and (config.items < 1 or config.controls < 0):
        raise UsageError("--items, --controls", "at least 1, at least 0", f"{config.items}, {config.controls}")
    if isinstance(config, SurveyResults):
        if not config.answers:
            raise UsageError("CSV", "files that the page of drivesem survey saved", "nothing")
        if config.survey is None:
            raise UsageError("--survey", "the folder of drivesem survey", "nothing")
        if config.bootstrap is not None and config.bootstrap < 0:
            raise UsageError("--bootstrap", "at least 0", config.bootstrap)
    if isinstance(config, Realism | Survey) and not config.runs:
        raise UsageError("RUN", "folders of drivesem attack", "nothing")
    if isinstance(config, Realism | Worth):
        if config.limit is not None and config.limit < 1:
            raise UsageError("--limit", "at least 1", config.limit)
        if config.bootstrap is not None and config.bootstrap < 0:
            raise UsageError("--bootstrap", "at least 0", config.bootstrap)
        if config.weights is not None and not Path(config.weights).is_dir():
            raise UsageError("--weights", "a folder", config.weights)
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
        if config.threads is not None and config.threads < 1:
            raise UsageError("--threads", "at least 1", config.threads)
    if isinstance(config, Eval):
        _validate_eval(config)
    if isinstance(config, Anchors):
        if config.dataset not in DATASETS[1:]:
            raise UsageError("--dataset", f"one of {', '.join(DATASETS[1:])}", repr(config.dataset))
        if config.count < 1:
            raise UsageError("--count", "at least 1", config.count)
        if config.limit is not None and config.limit < 1:
            raise UsageError("--limit", "at least 1", config.limit)
    if isinstance(config, Train):
        _validate_train(config)
    if isinstance(config, Retrain):
        _validate_retrain(config)


def check_dataset(dataset: str, root: str | None) -> None:
    """Raise UsageError for an unknown data set, or for a folder that is missing or not asked for."""
    if dataset not in DATASETS:
        raise UsageError("--dataset", f"one of {', '.join(DATASETS)}", repr(dataset))
    if dataset != DEMO and root is None:
        raise UsageError("--root", f"the folder of data set {dataset!r}", "nothing")
    if dataset == DEMO and root is not None:
        raise UsageError("--root", "no folder for data set 'demo' (did you mean --dataset kitti?)", root)


def _validate_method(config: Attack) -> None:
    """Options that only some methods have, and what they may be."""
    own = {
        "queries": COUNTED,
        "step_form": ("sgd",),
        "rate": ("si-fgsm", "apgd", "sgd", "scw"),
        "momentum": ("si-fgsm", "sgd"),
        "norm": ("scw",),
        "restarts": RESTARTED,
        "scouts": RESTARTED,
        "like": ("placebo",),
    }
    for name, methods in own.items():
        if getattr(config, name) != getattr(Attack, name) and config.method not in methods:
            flag = f"--{name.replace('_', '-')}"
            raise UsageError(flag, f"--method {', '.join(methods)} beside it", config.method)
    if config.early_stop and config.method in ("fgsm", "placebo"):
        raise UsageError("--early-stop", "a method of several steps or queries", config.method)
    if config.early_stop and config.method == "subsets":
        raise UsageError("--early-stop", "a method that may end at the first success", config.method)
    if not (math.isfinite(config.rate) and config.rate > 0):
        raise UsageError("--rate", "a number above 0", config.rate)
    if not 0 <= config.momentum <= 1:
        raise UsageError("--momentum", "a number in [0, 1]", config.momentum)
    if config.method == "placebo" and config.like is None:
        raise UsageError("--like", "a run of drivesem attack, for --method placebo", "nothing")
    if config.like is not None and not Path(config.like).is_dir():
        raise UsageError("--like", "a run of drivesem attack", config.like)
    if config.restarts < 0:
        raise UsageError("--restarts", "at least 0", config.restarts)
    if config.scouts < 0:
        raise UsageError("--scouts", "at least 0", config.scouts)
    if config.method == "subsets" and config.queries is not None and config.queries < 2:
        raise UsageError("--queries", "at least 2 with subsets", config.queries)


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


def _validate_train(config: Train) -> None:
    known = (*DATASETS[1:], SYNTH)
    if config.dataset not in known:
        raise UsageError("--dataset", f"one of {', '.join(known)}", repr(config.dataset))
    if config.dataset != SYNTH and config.root is None:
        raise UsageError("--root", f"the folder of data set {config.dataset!r}", "nothing")
    if config.dataset == SYNTH and (config.root, config.held_out) != (None, None):
        raise UsageError("--root, --held-out", "none with --dataset synth, which makes both", "one")
    for name in ("steps", "batch", "rate", "clip", "checkpoint_every", "thin", "frames"):
        if not getattr(config, name) > 0:
            raise UsageError(f"--{name.replace('_', '-')}", "a number above 0", getattr(config, name))
    for name in ("minutes", "evaluate_every", "loaders", "held_out_frames", "warmup"):
        if not getattr(config, name) >= 0:
            raise UsageError(f"--{name.replace('_', '-')}", "at least 0", getattr(config, name))
    for name in ("dropout", "average", "momentum", "semantic"):
        if not 0 <= getattr(config, name) < 1:
            raise UsageError(f"--{name}", "a number in [0, 1)", getattr(config, name))
    _validate_precision(config)
    if config.drops is not None:
        numbers("--drops", config.drops)


def _validate_retrain(config: Retrain) -> None:
    if (config.dataset is None) != (config.root is None):
        raise UsageError("--dataset and --root", "both or none", "one of them")
    if config.dataset is not None and config.dataset not in DATASETS[1:]:
        raise UsageError("--dataset", f"one of {', '.join(DATASETS[1:])}", repr(config.dataset))
    if not 0 < config.fraction < 1:
        raise UsageError("--fraction", "a share between 0 and 1", config.fraction)
    if not 0 < config.validation < 1:
        raise UsageError("--validation", "a share between 0 and 1", config.validation)
    if not 0 <= config.ramp <= 1:
        raise UsageError("--ramp", "a share from 0 to 1", config.ramp)
    for name in ("steps", "batch", "rate", "checkpoint_every"):
        if not getattr(config, name) > 0:
            raise UsageError(f"--{name.replace('_', '-')}", "a number above 0", getattr(config, name))
    for name in ("minutes", "warmup", "fresh"):
        if (getattr(config, name) or 0) < 0:
            raise UsageError(f"--{name.replace('_', '-')}", "at least 0", getattr(config, name))
    if config.attack_steps is not None and config.attack_steps < 1:
        raise UsageError("--attack-steps", "at least 1", config.attack_steps)
    _validate_precision(config)


def _validate_precision(config: Train | Retrain) -> None:
    if config.precision == "float16" and config.device.startswith("cpu"):
        raise UsageError("--precision", "float32 or bfloat16 on a CPU", config.precision)
