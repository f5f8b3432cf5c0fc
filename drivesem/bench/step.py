"""Times a whole attack step against the detector alone, in pairs in one process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from detectors.base import Detector
from detectors.types import Targets
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.labels import Labeller
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import Parameter, ParameterSpace, combo_parameters
from drivesem.bench.scenes import BenchScene, build_bench_scene
from drivesem.bench.session import Columns
from drivesem.bench.timing import CallTime, PairedTimer, Spread, TimeBudget, repetitions
from drivesem.config.commands import AttackConfig
from drivesem.config.options import DEFAULT_KEEP_MB
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import SceneIR, convert_scene

TITLE, EXTRA_TITLE = (
    "One attack step against the detector alone",
    "For comparison: full-frame parameters, and no level of detail",
)
COLUMNS: Columns = {
    "cars": ("cars", "cars"), "triangles": ("triangles a car", "triangles"), "params": ("parameters", None),
    "lod": ("level of detail", "detail"), "ratio": ("ratio", "ratio"), "ratio_iqr": ("IQR", "IQR"),
    "cpu_ratio": ("of processor time", "cpu ratio"),
    "step_ms": ("step, ms", "step ms"), "detector_ms": ("detector, ms", "detector"),
    "step_cpu_ms": ("step, processor ms", None), "detector_cpu_ms": ("detector, processor ms", None),
    "render_forward_ms": ("render forward, ms", "forward"),
    "render_backward_ms": ("render backward, ms", "backward"), "labels_ms": ("labels, ms", "labels"),
    "project_ms": ("projection, ms", "project"), "pixels": ("pixels of the cars", None),
    "repetitions": ("pairs", None),
}  # fmt: skip
METHOD = (
    "A step is Objective.loss_and_grad at a feasible theta other than 0 (scene at theta, render, labels, "
    "detector forward, loss, backward through all of it; the detector where vehicles are drawn, with --whole "
    "everywhere) and FeasibleSet.project of the theta that a sign "
    "step leads to; the steps follow each other as an attack's do, and start anew at another random theta now "
    "and then. detector_ms is the same detector's forward and backward to the input image, with the same loss "
    "and fixed targets, in the faster of the two memory layouts of that image. Both are measured in turn in "
    "one process after a warm-up, the order swapped every time; ratio is the median of the paired ratios, "
    "ratio_iqr the distance of their quartiles, the milliseconds are medians. render_forward_ms (scene at "
    "theta and render, recorded for gradients), render_backward_ms, labels_ms and project_ms are medians of "
    "the parts on their own. Of processor time: the same pairs by the processor's time, all threads together, "
    "which depends less on other work on the machine. pixels: crop_pixels of the rectangles "
    "around the meshes, hit_pixels of the meshes."
)
_TERM = "objectness"
_START_STEPS = 10
"""Random starts lie within this many steps of the photograph; an attack of the paper takes 10."""
_RESTART = 12
"""Steps until a new random start, so that measured thetas are neither all near a start nor far from it."""
_FEWEST, _MOST = 3, 200
_WARM_UP = 1
_LAYOUT_TRIES = 3
_PARTS = ("render_forward_ms", "render_backward_ms", "labels_ms", "project_ms")
"""Results of `AttackSteps.parts`."""


@dataclass(frozen=True, slots=True)
class StepCase:
    """One row to measure."""

    cars: int
    """Number of cars."""
    triangles: int
    """Per car."""
    params: tuple[Parameter, ...] = combo_parameters(2)
    """Attacked parameters."""
    lod: bool = True
    """Whether level of detail is on."""


def cases(cars: Sequence[int], triangles: Sequence[int]) -> tuple[list[StepCase], list[StepCase]]:
    """The sizes to measure, and two variants of the one nearest to 8 cars of the most triangles: with weather and
    foliage, and without level of detail.
    """
    sizes = [StepCase(n, k) for n in cars for k in triangles]
    usual = 8 if 8 in cars else max(cars)
    variants = [StepCase(usual, max(triangles), (Parameter.WEATHER, Parameter.FOLIAGE))]
    return sizes, [*variants, StepCase(usual, max(triangles), lod=False)]


def measure(
    case_list: Sequence[StepCase],
    detector: Detector,
    seconds: float,
    seed: int,
    device: str,
    whole: bool = False,
    keep_mb: float = DEFAULT_KEEP_MB,
) -> Iterator[dict[str, Any]]:
    """Measure one row per case; ratios are of a step to the detector, times are medians in ms.

    Args:
        case_list: What to measure.
        detector: The detector.
        seconds: Total time, exceeded only for the least number of repetitions.
        seed: Seed of scenes and thetas.
        device: Device to measure.
        whole: As in `Objective`.
        keep_mb: As in `Objective`.
    """
    budget = TimeBudget(seconds, len(case_list))
    clock = PairedTimer(device)
    layout: torch.memory_format | None = None
    for case in case_list:
        start = time.perf_counter()
        bench = build_bench_scene(case.cars, case.triangles, seed)
        step = AttackSteps(bench.scene, case.params, detector, seed, device, case.lod, whole, keep_mb)
        layout = layout or step.faster_layout(clock)
        alone = step.detector_alone(layout)
        for _ in range(_WARM_UP):
            alone()
            step()
        step.parts(clock)
        yield _row(case, bench, step, alone, clock, budget.share(time.perf_counter() - start))


def _row(
    case: StepCase,
    bench: BenchScene,
    step: AttackSteps,
    alone: Callable[[], None],
    clock: PairedTimer,
    seconds: float,
) -> dict[str, Any]:
    pairs: list[tuple[CallTime, CallTime]] = []
    parts: list[tuple[float, ...]] = []
    # If the time is already used up on a busy machine, one pair per row must suffice.
    for i in repetitions(seconds, _FEWEST if seconds > 0 else 1, _MOST):
        pairs.append(time_pair(clock, step, alone, swapped=bool(i % 2)))
        if i % 2 == 0:
            parts.append(step.parts(clock))
    ratio = Spread.from_values([whole.ms / single.ms for whole, single in pairs])
    medians = [Spread.from_values(part).median for part in zip(*parts, strict=True)]
    return {
        "cars": case.cars,
        "triangles": case.triangles,
        "triangles_actual": bench.triangles_actual,
        "params": ",".join(case.params),
        "lod": case.lod,
        "ratio": round(ratio.median, 4),
        "ratio_iqr": round(ratio.iqr, 4),
        **pair_medians(pairs),
        **{name: round(median, 3) for name, median in zip(_PARTS, medians, strict=True)},
        "pixels": bench.hit_pixels,
        "crop_pixels": bench.crop_pixels,
        "box_pixels": bench.box_pixels,
        "repetitions": len(pairs),
    }


def pair_medians(pairs: Sequence[tuple[CallTime, CallTime]]) -> dict[str, float]:
    """Medians over pairs of a step and the detector: the ratio of processor time, and times, ms."""
    times = {
        "step_ms": [whole.ms for whole, _ in pairs],
        "detector_ms": [single.ms for _, single in pairs],
        "step_cpu_ms": [whole.cpu_ms for whole, _ in pairs],
        "detector_cpu_ms": [single.cpu_ms for _, single in pairs],
    }
    cpu_ratio = Spread.from_values([whole.cpu_ms / single.cpu_ms for whole, single in pairs])
    return {"cpu_ratio": round(cpu_ratio.median, 4)} | {
        name: round(Spread.from_values(values).median, 3) for name, values in times.items()
    }


def time_pair(
    clock: PairedTimer, step: Callable[[], None], alone: Callable[[], None], swapped: bool
) -> tuple[CallTime, CallTime]:
    """Time a step and the detector alone, one after the other.

    Args:
        clock: The timer.
        step: One attack step.
        alone: The detector alone.
        swapped: Whether the step comes first.
    """
    if swapped:
        whole = clock.time_call(step)
        return whole, clock.time_call(alone)
    single = clock.time_call(alone)
    return clock.time_call(step), single


class AttackSteps:
    """Consecutive attack steps on one scene."""

    def __init__(
        self,
        scene: SceneIR,
        params: tuple[Parameter, ...],
        detector: Detector,
        seed: int,
        device: str,
        lod: bool = True,
        whole: bool = False,
        keep_mb: float = DEFAULT_KEEP_MB,
    ) -> None:
        """Prepare the scene.

        Args:
            scene: The scene.
            params: Attacked parameters.
            detector: The detector.
            seed: Seed of the random starts.
            device: Device to use.
            lod: Whether level of detail is on.
            whole: As in `Objective`.
            keep_mb: As in `Objective`.
        """
        scene = convert_scene(scene, torch.float32, device)
        self.space = ParameterSpace(scene, params)
        self.compositor = Compositor(scene, RenderSettings(lod=lod))
        config = AttackConfig(objective=_TERM, whole=whole, keep_mb=keep_mb)
        self.objective = Objective(self.compositor, self.space, detector, config)
        self.feasible = FeasibleSet(self.space)
        self.detector = detector
        with torch.no_grad():
            self._benign = self.compositor.render(scene)
        self._labeller = Labeller(scene, self._benign)
        self._generator = torch.Generator().manual_seed(seed)
        self._steps_done = 0
        self.theta = self._start()
        self._cotangent = torch.randn(scene.photograph.shape, generator=self._generator).to(scene.photograph)

    def _start(self) -> Tensor:
        """A random feasible theta other than 0, such as an attack passes through."""
        noise = torch.rand(self.space.dim, generator=self._generator).to(self.space.step)
        theta = self.feasible.project(_START_STEPS * self.space.step * (2 * noise - 1)).theta
        assert bool(theta.any())
        return theta

    def __call__(self) -> None:
        """One step: gradient, sign step, projection."""
        _, gradient = self.objective.loss_and_grad(self.theta)
        self.theta = self.feasible.project(self.theta + self.space.step * torch.sign(gradient)).theta
        self._steps_done += 1
        if self._steps_done % _RESTART == 0:
            self.theta = self._start()

    def parts(self, clock: PairedTimer) -> tuple[float, float, float, float]:
        """Milliseconds of render forward, render backward, labels and projection at the current theta."""
        leaf = self.theta.detach().clone().requires_grad_(True)
        images: list[Tensor] = []
        scene = self.space.apply(self.space.scene, self.theta)

        def forward() -> None:
            images.append(self.compositor.render(self.space.apply(self.space.scene, leaf)).image)

        first = clock.milliseconds(forward)
        second = clock.milliseconds(lambda: torch.autograd.grad(images[0], leaf, self._cotangent))
        with torch.no_grad():
            render = self.compositor.render(scene)
        third = clock.milliseconds(lambda: self._labeller.moved(scene, render))
        signs = torch.randn(self.space.dim, generator=self._generator).sign().to(self.theta)
        fourth = clock.milliseconds(lambda: self.feasible.project(self.theta + self.space.step * signs))
        return first, second, third, fourth

    def drawn_share(self) -> float:
        """Share of the image covered by vehicles and shadows at the current theta."""
        with torch.no_grad():
            render = self.compositor.render(self.space.apply(self.space.scene, self.theta))
        drawn = torch.zeros(render.image.shape[1:], dtype=torch.bool)
        for x0, y0, x1, y1 in [] if render.vehicle_regions is None else render.vehicle_regions.tolist():
            drawn[y0:y1, x0:x1] = True
        return float(drawn.float().mean())

    def faster_layout(self, clock: PairedTimer) -> torch.memory_format:
        """The memory layout of its input in which the detector is faster."""
        layouts = (torch.contiguous_format, torch.channels_last)
        calls = [self.detector_alone(layout) for layout in layouts]
        calls[0]()
        times = [min(clock.milliseconds(call) for _ in range(_LAYOUT_TRIES)) for call in calls]
        return layouts[times.index(min(times))]

    def detector_alone(self, layout: torch.memory_format) -> Callable[[], None]:
        """The detector's forward and backward pass, for an input in that layout."""
        image = self._benign.image[None].detach().contiguous(memory_format=layout)
        targets = self._labeller.paper().targets
        return lambda: self._alone(image, targets)

    def _alone(self, image: Tensor, targets: Targets) -> None:
        leaf = image.detach().requires_grad_(True)
        loss = self.detector.loss(self.detector(leaf), [targets])[_TERM]
        torch.autograd.grad(loss, leaf)
