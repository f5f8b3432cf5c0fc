"""One frame: samples around each of its certain failures, each before both detectors."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from detectors.base import Predictor
from drivesem.analysis.gate.results import GATE, FrameGate, Pair, dump
from drivesem.attack.feasible.bounds import Limits
from drivesem.attack.judging import t_star_of
from drivesem.attack.space import Parameter
from drivesem.config.commands import Attack
from drivesem.failures.certificate import SampleOutcome
from drivesem.failures.neighbourhood import NEAR, Neighbourhood
from drivesem.failures.nuisances import Nuisances
from drivesem.run.frame import RESULT
from drivesem.run.rebuilt import rebuilt
from drivesem.run.results import Failure, load_frame
from drivesem.run.tally import certain_losses
from scene_ir import files


def compare_frame(
    folder: Path,
    attack: Attack,
    params: Sequence[Parameter],
    detectors: tuple[Predictor, Predictor],
    samples: int,
    seed: int,
    out: Path,
) -> FrameGate:
    """Show a frame's neighbourhoods to the detectors before and after, and write the folder `out`, whole or not
    at all. folder: of the frame in its run; attack, params: the run's. Raises FormatError where the scene is not
    there or is damaged.
    """
    start = time.perf_counter()
    result = load_frame(folder / RESULT)
    before, after = detectors
    objective, theta = rebuilt(result, folder, attack, params, before)
    feasible = objective.feasible_set(Limits(joint_weather=result.joint_weather), attack.project == "bounds")
    nuisances = Nuisances.of(attack.nuisances)
    pairs = []
    for failure in certain_losses(result):
        assert failure.index is not None
        name = f"{result.identifier}:{failure.index}:{seed}"
        near = Neighbourhood(objective, feasible, theta, failure.index, nuisances, name)
        pairs.append(_pair(failure, failure.index, near, after, samples))
    found = FrameGate(
        result.identifier, files.digest(folder / RESULT), tuple(pairs), round(time.perf_counter() - start, 3)
    )
    with files.whole_folder(out) as part:
        files.write_text(part / GATE, dump(found))
    return found


def _pair(failure: Failure, index: int, near: Neighbourhood, after: Predictor, samples: int) -> Pair:
    camera = near.camera_of(after, t_star_of(after))
    looks: list[tuple[SampleOutcome, SampleOutcome]] = []
    for number in range(samples):
        # One half near the failure: a hole may be small beside its neighbourhood.
        sample = near.sample(number, 1.0 if number % 2 == 0 else NEAR)
        if sample is not None:
            looks.append((near.look(sample), near.look(sample, camera)))
    lost = [tuple(not bool(look.judged.found[index]) for look in both) for both in looks]
    phantoms = [tuple(bool(look.judged.background) for look in both) for both in looks]
    return Pair(
        index,
        failure.label,
        failure.error or "",
        tuple(one for one, _ in lost),
        tuple(other for _, other in lost),
        tuple(one for one, _ in phantoms),
        tuple(other for _, other in phantoms),
    )
