"""What each study compares: arms, their controls, and the paper's figures."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivesem.analysis.transfer.asking import detector_names, short_names
from drivesem.attack.methods.base import GRADIENT_PASSES
from drivesem.attack.space import SIX, Parameter
from drivesem.config.blocks import Attacking, Grading, Sharing, shared
from drivesem.config.commands import COMBO_NUMBERS, DEFAULT_COMBO, Attack, Study
from drivesem.report.paper import PAPER_COMBOS, PAPER_SINGLE
from drivesem.run.protocol import PROTOCOL, follows_paper
from scene_ir import files
from scene_ir.errors import FormatError

QUICK_FRAMES, FRAMES = 6, 200
"""Frames of a study with --quick, and without."""
DRAWS = 1000
"""Of frames, for a study's intervals."""
RANDOM, PLACEBO = "random", "placebo"
"""Controls: the best of as many random samples as the attack takes steps, of the box that those steps reach; and
one random edit as large as the attack's own."""
SEEDS = 3
"""Of random numbers, for each control of a full study."""
PAPERS = "paper's protocol"
_LONGER = 4
"""Steps of Auto-PGD in the study `multi`, in multiples of --steps: enough for its own steps to grow short."""
FIGURES = "study.json"
"""A study's figures, in its folder."""
SEARCHES = ("climb", "corners", "si-fgsm", "apgd", "halton", "cma-es")
"""Methods of the study `searches`; the placebo is as large as what the first finds."""
_FAR = 2
"""Steps of the study `steps`, in multiples of --steps: far enough to see where more are of no use."""


@dataclass(frozen=True, slots=True)
class Arm:
    """One attack on all frames. folder: of its run; reference: the paper's mAP after it, a fraction; control:
    RANDOM or PLACEBO where it stands beside the arm named `of`.
    """

    name: str
    folder: str
    config: Attack
    reference: float | None = None
    control: str | None = None
    of: str | None = None


def attack_of(study: Study) -> Attack:
    """The attack that a study's arms vary."""
    limit = study.limit or (QUICK_FRAMES if study.quick else FRAMES)
    alike = shared(study, Attacking) | shared(study, Grading) | shared(study, Sharing)
    # A study that confirms asks `drivesem confirm` of its arms; what is certain is confirmed anyway.
    return Attack(**alike | {"limit": limit, "method": study.method, "confirm": Attack.confirm})


def draws_of(study: Study) -> int:
    """Of frames, for intervals."""
    return DRAWS if study.bootstrap is None else study.bootstrap


def arms_of(study: Study, out: Path) -> list[Arm]:
    """The arms of a study that writes into `out`; a placebo comes after the arm whose size it takes."""
    base = attack_of(study)
    if study.name in ("single", "multi"):
        ours = [_arm(p.value, replace(base, params=p.value), PAPER_SINGLE[p]) for p in SIX]
        if study.name == "multi":
            ours = [_combo(base, number) for number in COMBO_NUMBERS]
        arms = [*ours, *(_papers(ours) if _has_papers(study) else [])]
        if study.name == "multi" and study.method == "si-fgsm":
            longer = replace(base, combo=DEFAULT_COMBO, method="apgd", steps=_LONGER * study.steps)
            arms.append(_arm(f"combo {DEFAULT_COMBO}, apgd", longer))
        seeds = study.seeds or (1 if study.quick else SEEDS)
        return _controlled(arms, out, seeds=seeds) if study.controls else arms
    if study.name == "grades":
        return _grades(base, out)
    if study.name == "searches":
        return _searches(base, study, out)
    if study.name == "samples":
        return _samples(replace(base, combo=DEFAULT_COMBO), study)
    if study.name == "transfer":
        sources = _sources(base, study)
        return _controlled(sources, out, (PLACEBO,)) if study.controls else sources
    if study.name == "steps":
        steps = _FAR * study.steps
        far = replace(base, combo=DEFAULT_COMBO, method="si-fgsm", steps=steps, early_stop=True)
        rates = (0.5, 1.0, 2.0) if study.quick else (0.25, 0.5, 1.0, 2.0, 4.0)
        return [_arm(f"rate {rate:g}", replace(far, rate=rate)) for rate in rates]
    return _labels(base, study.quick)


def _arm(name: str, config: Attack, reference: float | None = None) -> Arm:
    """reference: the paper's figure; it stands beside the paper's own protocol only."""
    return Arm(name, re.sub(r"[^a-z0-9.]+", "-", name), config, reference if follows_paper(config) else None)


def _combo(base: Attack, number: int) -> Arm:
    return _arm(f"combo {number}", replace(base, combo=number), PAPER_COMBOS[number])


def _has_papers(study: Study) -> bool:
    """Whether the paper's protocol can stand beside: its loss is that of this project's own architectures."""
    elsewhere = ":" in study.detector or study.detector.endswith(".onnx")
    return study.paper_protocol and not elsewhere and not follows_paper(attack_of(study))


def _papers(arms: Sequence[Arm]) -> list[Arm]:
    """The same by the paper's exact protocol."""
    papers: dict[str, Any] = PROTOCOL
    references = {f"combo {number}": value for number, value in PAPER_COMBOS.items()} | PAPER_SINGLE
    return [_arm(f"{a.name}, {PAPERS}", replace(a.config, **papers), references[a.name]) for a in arms]


def matching(config: Attack) -> str:
    """The control that has as many chances as an attack: one draw, or the best of as many where the best of all
    iterates is kept.
    """
    return RANDOM if config.keep == "best" else PLACEBO


def _controlled(
    arms: Sequence[Arm], out: Path, kinds: Sequence[str] = (RANDOM, PLACEBO), seeds: int = 1
) -> list[Arm]:
    """Each arm, followed by its controls, by so many seeds. Random samples are of attacks that keep the best."""
    found: list[Arm] = []
    for arm in arms:
        # As the run's own settings say it: relative to where the command is called.
        size_of = os.path.join(out, "arms", arm.folder)
        configs = {
            RANDOM: replace(arm.config, method="random", range="steps", queries=arm.config.steps),
            PLACEBO: replace(arm.config, method="placebo", like=size_of),
        }
        found.append(arm)
        for kind in (kind for kind in kinds if kind == PLACEBO or matching(arm.config) == kind):
            for number in range(seeds):
                name, folder = f"{arm.name} {kind}", f"{arm.folder}-{kind}"
                if number:
                    name, folder = f"{name} {number + 1}", f"{folder}-{number + 1}"
                config = replace(configs[kind], seed=arm.config.seed + number)
                found.append(Arm(name, folder, config, control=kind, of=arm.name))
    return found


def _sources(base: Attack, study: Study) -> list[Arm]:
    """The default combination against each source: the arm of the first has the name that `multi` gives it."""
    sources = detector_names(study.sources or study.detector, "--sources")
    arms = []
    for place, (source, short) in enumerate(zip(sources, short_names(sources), strict=True)):
        arm = _combo(replace(base, detector=source), DEFAULT_COMBO)
        folder = arm.folder if place == 0 else f"{arm.folder}-{re.sub(r'[^a-zA-Z0-9.]+', '-', short)}"
        arms.append(replace(arm, name=short, folder=folder))
    return arms


def _grades(base: Attack, out: Path) -> list[Arm]:
    """How sure failures are: si-FGSM, Auto-PGD with time for its steps to grow short, samples that take as many
    passes as si-FGSM's gradients, and a placebo as large as either attack, for three sets of parameters.
    """
    sets = {
        f"combo {DEFAULT_COMBO}": replace(base, combo=DEFAULT_COMBO),
        "weather": replace(base, params=Parameter.WEATHER.value),
        "all six": replace(base, params=",".join(p.value for p in SIX)),
    }
    arms: list[Arm] = []
    for name, config in sets.items():
        apgd = replace(config, method="apgd", steps=_LONGER * base.steps)
        halton = replace(config, method="halton", queries=GRADIENT_PASSES * base.steps)
        arms += _controlled([_arm(name, replace(config, method="si-fgsm"))], out, (PLACEBO,))
        arms += _controlled([_arm(f"{name}, apgd", apgd)], out, (PLACEBO,))
        arms.append(_arm(f"{name}, halton", halton))
    return arms


def _searches(base: Attack, study: Study, out: Path) -> list[Arm]:
    """Methods that look for failures of the same parameters, at as many passes each, or at as many seconds."""
    combo = DEFAULT_COMBO if study.params is None else None
    config = replace(base, combo=combo, params=study.params)
    passes = dict.fromkeys(SEARCHES, study.passes) if study.pace is None else _paced(study.passes, study.pace)
    first, *others = (_arm(name, replace(config, method=name, passes=passes[name])) for name in SEARCHES)
    (searching, placebo) = _controlled([first], out, (PLACEBO,))
    return [searching, *others, replace(placebo, config=replace(placebo.config, passes=None))]


def _paced(passes: int, folder: str) -> dict[str, int]:
    """Passes by method, of which as many take as long as the slowest method's, by what a study's frames took."""
    study = Path(folder) / FIGURES
    try:
        rows = {row["name"]: float(row["seconds"]) for row in files.read_json(study)["searches"]}
        seconds = {name: rows[name] for name in SEARCHES}
    except (TypeError, KeyError, ValueError) as error:
        raise FormatError(f"{study}: searches", f"seconds of {', '.join(SEARCHES)}", error) from error
    if not all(0 < own < math.inf for own in seconds.values()):
        raise FormatError(f"{study}: searches", "positive seconds", seconds)
    slowest = max(seconds.values())
    return {name: round(passes * slowest / own) for name, own in seconds.items()}


def _samples(base: Attack, study: Study) -> list[Arm]:
    """Each method until its first success. Without gradient it looks where the steps of si-FGSM may lead; the full
    study also lets it look in all of the bounds.
    """
    arms = [
        _arm("si-fgsm", replace(base, method="si-fgsm", early_stop=True)),
        _arm("apgd", replace(base, method="apgd", early_stop=True)),
        _arm("fgsm", replace(base, method="fgsm")),
    ]
    searches = ("random", "halton", "sobol", "cma-es")
    for method in searches:
        search = replace(base, method=method, queries=study.queries, early_stop=True)
        arms.append(_arm(method, replace(search, range="steps")))
        if not study.quick:
            arms.append(_arm(f"{method}, bounds", search))
    if not study.quick:
        arms.append(_arm("sgd", replace(base, method="sgd", early_stop=True)))
    return arms


def _labels(base: Attack, quick: bool) -> list[Arm]:
    """Attacks that aim at the benign labels, as the paper's do, and one that aims at labels that move."""
    stay = replace(base, objective_labels="paper")
    arms = [_arm("translate", replace(stay, params="translate"))]
    if not quick:
        arms.append(_arm("rotate", replace(stay, params="rotate")))
    arms += [_combo(stay, number) for number in ((DEFAULT_COMBO,) if quick else COMBO_NUMBERS)]
    aimed = _arm(f"combo {DEFAULT_COMBO}, moved", replace(base, combo=DEFAULT_COMBO, objective_labels="moved"))
    return [replace(arm, reference=None) for arm in arms] + [aimed]
