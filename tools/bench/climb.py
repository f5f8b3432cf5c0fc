"""One search by climb on a street, and what the parts of its passes take."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import torch

from detectors.base import Detector
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import Parameter, ParameterSpace
from drivesem.bench.scenes import build_bench_scene
from drivesem.bench.session import Columns
from drivesem.bench.timing import Spread
from drivesem.config.commands import AttackConfig
from drivesem.failures.margin_oracle import NuisanceMarginOracle
from drivesem.failures.nuisances import Nuisances
from drivesem.run.attack import AttackWorker
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR, convert_scene

TITLE = "A search by climb"
COLUMNS: Columns = {
    "cars": ("cars", "cars"), "params": ("parameters", None), "passes": ("passes", "passes"),
    "precision": ("precision", "precision"), "search_s": ("search, s", "search s"),
    "render_ms": ("render, ms", "render ms"), "picture_ms": ("camera's picture, ms", "picture"),
    "detector_ms": ("detector, ms", "detector"), "pass_ms": ("a pass, ms", "pass"),
    "gradient_ms": ("a gradient, ms", "gradient"), "repetitions": ("repetitions", None),
}  # fmt: skip
METHOD = (
    "Seconds and milliseconds of the processor, all threads together. search: an attack on one frame, from the "
    "scene to what was found, without certificates; a gradient counts as 3 passes. A pass: margins of all objects "
    "at a feasible random place in a draw that was seen before; of it the render, what a camera makes of the "
    "picture, and the detector. A gradient: margins by soft maxima, and their gradient. Medians, measured in turn "
    "after a warm-up."
)
_TRIANGLES = 2000
_DRAWS = 4
PRECISIONS = {"float32": None, "bfloat16": torch.bfloat16}


@dataclass(frozen=True, slots=True)
class ClimbRow:
    """One search; see `METHOD`."""

    cars: int
    params: str
    passes: int
    precision: str
    search_s: float
    render_ms: float
    picture_ms: float
    detector_ms: float
    pass_ms: float
    gradient_ms: float
    repetitions: int


def measure(
    cars: Sequence[int],
    params: tuple[Parameter, ...],
    passes: int,
    repetitions: int,
    detectors: dict[str, Detector],
    seed: int,
) -> Iterator[ClimbRow]:
    """A row for each number of cars and each of `detectors`, which are named by what they compute in."""
    for count in cars:
        scene = convert_scene(build_bench_scene(count, _TRIANGLES, seed).scene, torch.float32, "cpu")
        for precision, detector in detectors.items():
            parts = _parts(scene, params, repetitions, detector, seed)
            config = AttackConfig(method="climb", params=",".join(params), passes=passes, grade=False, seed=seed)
            worker = AttackWorker.from_config(config, detector)
            milliseconds = _ms(partial(worker.attack_scene, "bench", scene))
            yield ClimbRow(
                cars=count,
                params=",".join(params),
                passes=passes,
                precision=precision,
                search_s=round(milliseconds / 1e3, 2),
                repetitions=repetitions,
                **{name: round(Spread.from_values(times).median, 1) for name, times in parts.items()},
            )


def _parts(
    scene: SceneIR, params: tuple[Parameter, ...], repetitions: int, detector: Detector, seed: int
) -> dict[str, list[float]]:
    """Milliseconds of each part, each time at another place."""
    space, compositor = ParameterSpace(scene, params), Compositor(scene)
    objective = Objective(compositor, space, detector)
    views, feasible = NuisanceMarginOracle.for_objective(objective, Nuisances(), "bench"), objective.feasible_set()
    generator = torch.Generator().manual_seed(seed)
    weights = torch.ones(len(views.counted_objects))
    times: dict[str, list[float]] = {}
    for i in range(repetitions + _DRAWS):
        share = torch.rand(space.dim, generator=generator).to(space.lower)
        theta = feasible.project(space.lower + share * (space.upper - space.lower)).theta
        draw = views.sample(i % _DRAWS)
        perturbed = draw.perturb_scene(space.apply(scene, theta))
        with torch.no_grad():
            image = compositor.render(perturbed).image
            picture = draw.degrade_image(image)
        parts: dict[str, Callable[[], object]] = {
            "render_ms": partial(compositor.render, perturbed),
            "picture_ms": partial(draw.degrade_image, image),
            "detector_ms": partial(detector.forward_for_search, picture[None]),
            "pass_ms": partial(views.margins, [theta], [i % _DRAWS]),
        }
        with torch.no_grad():
            taken = {name: _ms(part) for name, part in parts.items()}
        taken["gradient_ms"] = _ms(partial(views.margins_and_grad, theta, i % _DRAWS, weights))
        if i >= _DRAWS:  # each draw has been seen
            for name, value in taken.items():
                times.setdefault(name, []).append(value)
    return times


def _ms(call: Callable[[], object]) -> float:
    """Milliseconds of the processor that a call takes: others on the machine lengthen them little."""
    start = time.process_time()
    call()
    return 1e3 * (time.process_time() - start)
