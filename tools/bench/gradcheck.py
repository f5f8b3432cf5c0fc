"""The gradients that attacks follow against central differences.

A scene is checked as photographed (theta0) and at a random feasible theta that moves all six parameters. There,
for each parameter with all objects together, the gradient in float64 with backend `reference` and in float32 with
`warp`, the one that attacks follow, is held against differences in float64 with `reference`. What is
differentiated: smooth random functionals of the picture, and the detector's loss as attacks raise it, with labels
and anchors held as they are at the point, since they are constant in the gradient and switch in jumps.

Directions instead of coordinates: a scene has a thousand coordinates, and a difference costs two renders of the
slow reference. Along K random orthonormal directions of a parameter's D coordinates, scaled by sqrt(D / K), an
error has on average the length that it has as a whole, whichever coordinates it sits in.

Shapes: D coordinates of theta, K directions, S steps, F + 1 outputs: F functionals of the picture, then the loss.
"""

from __future__ import annotations

import importlib.metadata
import math
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import kornia
import numpy as np
import torch
from numpy.typing import NDArray
from rich import box
from rich.table import Table
from torch import Tensor

from detectors.base import AnchorPredictions, DetectorError
from detectors.registry import load_detector
from detectors.squeezedet import AnchorAssignment, SqueezeDet
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.labels import Labeller
from drivesem.attacks.space import COMBOS, PAPER_PARAMETERS, Parameter, ParameterSpace, StepSizes
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.reporting.tables import Console, format_count, print_json
from drivesem.run.attack import select_frames
from drivesem.run.driver import ProgressSettings, print_output_folder, run_frame_jobs
from drivesem.scenes.sources import SceneSource, open_source
from scene_ir import files
from scene_ir.errors import RangeError
from scene_ir.raster.verbs import Backend
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import SceneIR, convert_scene
from tools.bench.reach.agreement import reach_rows
from tools.bench.reach.report import ReachWorker, build_reach_worker
from tools.bench.reach.report import build_reach_report as reach_answer
from tools.bench.settings import GradcheckConfig

Array = NDArray[np.float64]

Point = Literal["theta0", "random"]
POINTS: tuple[Point, ...] = ("theta0", "random")
BACKENDS: tuple[Backend, ...] = ("reference", "warp")
PICTURE, LOSS = "picture", "detector loss"

TERM = "objectness"
"""The term of the detector's loss that attacks raise."""
COMBO = 2
"""Combination with a concatenated gradient that is also checked through the detector."""
FUNCTIONALS = 3
SMOOTHING_PX = 2.5
"""Standard deviation of the Gaussian that smooths a functional's weights, so that none hangs on single pixels."""

CODE_STEPS = (1e-5, 1e-6, 1e-7)
"""Steps of the codes, which move no pixel: small enough that few of the detector's rectifiers switch."""
GEOMETRY_STEPS = (1e-7, 1e-8, 1e-9)
"""Steps of what moves vertices. The z-buffer decides in jumps which surface a pixel sees, and that is not
differentiated: a difference is the gradient's counterpart only where no pixel switches between its two sides. A
near car moves by 300 px for a unit of theta, and inner edges are some thousand pixels long, so that at 1e-7 a
pixel switches now and then and at 1e-9 hardly ever, while rounding stays far below the tolerance. As photographed
nothing jumps, but a saturated pixel has its kink within 1e-8 of theta0, and there larger steps are better."""
STEPS: dict[Parameter, tuple[float, float, float]] = {
    Parameter.COLOR: CODE_STEPS,
    Parameter.WEATHER: CODE_STEPS,
    Parameter.FOLIAGE: CODE_STEPS,
    Parameter.TRANSLATE: GEOMETRY_STEPS,
    Parameter.ROTATE: GEOMETRY_STEPS,
    Parameter.MESH: GEOMETRY_STEPS,
}
"""In theta's units: root mean square of what the coordinates of a direction change by."""

_REACH = (0.05, 0.5)
"""A random theta goes between these shares of the bounds, before it is projected onto what is feasible."""
_DRAWS = 6
_SAME_PICTURE = 1e-3
"""Two backends draw one picture if no pixel differs by more. At a random theta a pixel may sit so close to a jump
that rounding to float32 decides what it sees. No gradient means anything there: another theta is drawn."""
_DITHER = 1e-4
"""Largest number that is added to a colour before the detector sees it, the same at every theta. Saturated patches
of a photograph are of one value, and a pooling over equal inputs has no derivative; a fortieth of a file's
smallest step makes them differ."""
_ROUNDING = 1e-15
"""A float64 sum of the outputs' terms is exact to about this share of their magnitude."""


@dataclass(frozen=True, slots=True)
class GradientAgreement:
    """How well a gradient agrees with differences of one step."""

    step: float
    """In theta's units."""
    cosine: float
    """Of the two vectors."""
    relative_error: float
    """Length of their difference over that of the differences."""


@dataclass(frozen=True, slots=True)
class GradcheckRow:
    """One comparison."""

    name: str
    """The parameter, or `combo 2 detector loss`."""
    at: Point
    """Of what."""
    functional: str
    """Of what."""
    backend: Backend
    """Of what."""
    scene: str
    """Of what."""
    cosine: float | None
    """Those of the step that agrees best, None where the parameter has no effect on the functional by either
    account."""
    relative_error: float | None
    """Those of the step that agrees best, None where the parameter has no effect on the functional by either
    account."""
    step: float | None
    """Those of the step that agrees best, None where the parameter has no effect on the functional by either
    account."""
    steps: tuple[GradientAgreement, ...]
    """All three."""

    def passes(self, least_cosine: float, largest_error: float) -> bool:
        """Whether it is inside the tolerance; so it is where there is nothing to compare."""
        if self.cosine is None or self.relative_error is None:
            return True
        return self.cosine >= least_cosine and self.relative_error <= largest_error

    @property
    def severity(self) -> float:
        """What orders rows from good to bad. An error of r < 1 alone keeps the cosine above sqrt(1 - r^2)."""
        return -1.0 if self.relative_error is None else self.relative_error


@dataclass(frozen=True, slots=True)
class FiniteDifferences:
    """Along some directions of one parameter."""

    where: slice
    """Its coordinates in theta; directions (K, D'), orthonormal; slopes (S, F + 1, K), by step."""
    directions: Array
    slopes: Array
    noise: Array
    """What rounding alone can make of them. All float64, (S, F + 1, K)."""


Gradients = dict[Backend, Array]
"""By backend (F + 1, D) float64, of all six parameters."""


class _Path:
    """theta -> picture -> outputs, by one backend in its own precision."""

    def __init__(
        self, scene: SceneIR, backend: Backend, detector: SqueezeDet, weights: Tensor, dither: Tensor
    ) -> None:
        self.dtype = torch.float64 if backend == "reference" else torch.float32
        device = next(detector.parameters()).device
        self.scene = convert_scene(scene, self.dtype, device)
        self.space = ParameterSpace(self.scene, PAPER_PARAMETERS)
        self.detector = detector
        self.weights, self._dither = weights.to(device, self.dtype), dither.to(device, self.dtype)
        self.compositor = Compositor(self.scene, RenderSettings(backend=backend))

    def render(self, theta: Tensor) -> Tensor:
        """The picture (3, H, W) at theta (D,)."""
        return self.compositor.render(self.apply(theta)).image

    def apply(self, theta: Tensor) -> SceneIR:
        """The scene at theta (D,), not held inside the bounds of weather and foliage: theta0 lies on one."""
        scene = self.space.apply(self.scene, theta)
        part = self.space.unflatten(theta)
        assert part.weather is not None
        assert part.foliage is not None
        start, count = self.scene.environment, len(part.weather)
        weather = torch.cat([start.weather[:count] + part.weather, start.weather[count:]])
        return scene.with_environment(weather=weather, foliage=start.foliage + part.foliage)

    def detect(self, picture: Tensor) -> AnchorPredictions:
        """The detector's scores of a picture (3, H, W)."""
        return self.detector((picture + self._dither)[None])

    def loss(self, picture: Tensor, assignment: AnchorAssignment) -> Tensor:
        """The detector's loss ()."""
        fixed = convert_scene(assignment, self.dtype, self.weights.device)
        return self.detector.loss_terms(self.detect(picture), fixed)[TERM]

    @torch.no_grad()
    def outputs(self, theta: Tensor, assignment: AnchorAssignment) -> Tensor:
        """(F + 1,) at theta (D,)."""
        picture = self.render(theta)
        return torch.cat([(picture * self.weights).flatten(1).sum(dim=1), self.loss(picture, assignment)[None]])

    def gradients(self, theta: Tensor, assignment: AnchorAssignment, exact: Tensor) -> Array:
        """(F + 1, D) float64 at theta (D,), each by a way forward and back of its own, as attacks go.

        exact: (3, H, W) float64, the picture that the detector is shown. Rounding to float32 moves vertices by
        some 1e-4 px, and of a million rectifiers and poolings a few are so close to switching that this does it:
        the gradient of the loss to the picture would be another by some percent, though neither is wrong.
        """
        rows = []
        for k in range(len(self.weights) + 1):
            live = theta.to(self.scene.photograph).requires_grad_()
            picture = self.render(live)
            if k == len(self.weights):
                output = self.loss(picture + (exact.to(picture) - picture).detach(), assignment)
            else:
                output = (picture * self.weights[k]).sum()
            (gradient,) = torch.autograd.grad(output, live)
            bad = (~torch.isfinite(gradient)).nonzero()
            if len(bad):
                i = int(bad[0])
                raise RangeError(f"gradient of {self.space.name(i)}", "a finite value", float(gradient[i]))
            rows.append(gradient.double().cpu().numpy())
        return np.stack(rows)


class SceneCheck:
    """Checks one scene at several points. detectors: by backend, of its precision; seed: of the
    functionals, of the random theta and of the directions; directions: K, at most."""

    def __init__(self, scene: SceneIR, detectors: dict[Backend, SqueezeDet], seed: int, directions: int) -> None:
        generator = _generator(seed, 0)
        weights = functionals(scene.camera.height, scene.camera.width, generator)
        dither = _DITHER * (2 * torch.rand(weights.shape[1:], generator=generator, dtype=weights.dtype) - 1)
        self._paths: dict[Backend, _Path] = {b: _Path(scene, b, detectors[b], weights, dither) for b in BACKENDS}
        self._exact = self._paths["reference"]
        self._seed, self._count = seed, directions
        self._points: dict[Point, tuple[Tensor, AnchorAssignment, Tensor]] = {}
        with torch.no_grad():
            base = self._exact.compositor.render(self._exact.scene)
        self._labeller = Labeller(self._exact.scene, base)

    @property
    def space(self) -> ParameterSpace:
        """What theta is."""
        return self._exact.space

    def gradients(self, at: Point) -> Gradients:
        """The gradients at a point, by both backends."""
        theta, assignment, picture = self._at(at)
        return {b: path.gradients(theta, assignment, picture) for b, path in self._paths.items()}

    def differences(self, at: Point, parameter: Parameter) -> FiniteDifferences:
        """Central differences of the float64 reference at a point, along random directions of one parameter."""
        theta, assignment, _ = self._at(at)
        where = self.space.blocks.get(parameter)
        assert where is not None
        size = where.stop - where.start
        generator = _generator(self._seed, 2 + PAPER_PARAMETERS.index(parameter))
        chosen = orthonormal(size, min(self._count, size), generator)
        slopes, noise = [], []
        for step in STEPS[parameter]:
            length = step * math.sqrt(size)
            columns, largest = [], []
            for direction in chosen:
                move = torch.zeros_like(theta)
                move[where] = length * direction
                ahead, behind = (self._exact.outputs(theta + side * move, assignment) for side in (1, -1))
                columns.append((ahead - behind) / (2 * length))
                largest.append(_ROUNDING * ahead.abs() / length)
            slopes.append(torch.stack(columns, dim=1).numpy())
            noise.append(torch.stack(largest, dim=1).numpy())
        return FiniteDifferences(where, chosen.numpy(), np.stack(slopes), np.stack(noise))

    def _at(self, at: Point) -> tuple[Tensor, AnchorAssignment, Tensor]:
        """Of a point: theta (D,) float64, which anchors answer for which objects, the picture (3, H, W)."""
        if at not in self._points:
            theta = self.space.theta0 if at == "theta0" else self._random()
            scene = self._exact.apply(theta)
            with torch.no_grad():
                render = self._exact.compositor.render(scene)
                raw = self._exact.detect(render.image)
            targets = self._labeller.moved(scene, render).targets
            self._points[at] = (theta, self._exact.detector.assign(raw, [targets]), render.image)
        return self._points[at]

    def _random(self) -> Tensor:
        """A random feasible theta (D,) at which both backends see the same; the best of some draws."""
        space, generator, feasible = self.space, _generator(self._seed, 1), FeasibleSet(self.space)
        best, least = space.theta0, math.inf
        for _ in range(_DRAWS):
            signed = 2 * torch.rand(space.dim, generator=generator, dtype=torch.float64) - 1
            reach = _REACH[0] + (_REACH[1] - _REACH[0]) * signed.abs()
            bound = torch.where((signed < 0) & (space.lower < 0), space.lower, space.upper)
            # float32 values, so that both backends stand at the same point.
            theta = feasible.project((reach * bound).float().double()).theta.float().double()
            with torch.no_grad():
                exact, fast = (self._paths[b].render(theta.to(self._paths[b].scene.photograph)) for b in BACKENDS)
            apart = float((exact - fast.cpu()).abs().max())
            if apart < least:
                best, least = theta, apart
            if apart <= _SAME_PICTURE:
                break
        return best


def functionals(height: int, width: int, generator: torch.Generator) -> Tensor:
    """Weights (F, 3, H, W) float64 of the pictures' functionals: low-passed noise of variance 1."""
    noise = torch.randn(FUNCTIONALS, 3, height, width, generator=generator, dtype=torch.float64)
    size = 2 * math.ceil(2.5 * SMOOTHING_PX) + 1
    smooth = kornia.filters.gaussian_blur2d(noise, (size, size), (SMOOTHING_PX, SMOOTHING_PX))
    return smooth / smooth.std()


def orthonormal(size: int, count: int, generator: torch.Generator) -> Tensor:
    """Random orthonormal directions (count, size) float64, count <= size."""
    noise = torch.randn(size, count, generator=generator, dtype=torch.float64)
    return torch.linalg.qr(noise)[0].T.contiguous()


def _generator(seed: int, purpose: int) -> torch.Generator:
    """A stream of its own for each purpose, so that one scene's numbers hang on its seed alone."""
    return torch.Generator().manual_seed(1000 * seed + purpose)


def gradcheck_rows(
    scene: str, at: Point, gradients: Gradients, differences: dict[Parameter, FiniteDifferences]
) -> tuple[GradcheckRow, ...]:
    """All comparisons of one scene at one point."""
    rows = []
    for backend, gradient in gradients.items():
        known = {p: _GradientErrors.of(gradient, found) for p, found in differences.items()}
        for parameter, compared in known.items():
            for functional, outputs in ((PICTURE, slice(0, -1)), (LOSS, slice(-1, None))):
                where = (parameter.value, at, functional, backend, scene)
                rows.append(_row(where, STEPS[parameter], compared.of_outputs(outputs)))
        together = [known[p].of_outputs(slice(-1, None)) for p in COMBOS[COMBO] if p in known]
        if len(together) == len(COMBOS[COMBO]):
            where = (f"combo {COMBO} {LOSS}", at, LOSS, backend, scene)
            rows.append(_row(where, GEOMETRY_STEPS, _GradientErrors.joined(together)))
    return tuple(rows)


def worst(rows: Iterable[GradcheckRow]) -> tuple[GradcheckRow, ...]:
    """Of the rows that differ by their scene alone the one that agrees worst, in the order of first appearance."""
    found: dict[tuple[str, str, str, str], GradcheckRow] = {}
    for row in rows:
        key = (row.name, row.at, row.functional, row.backend)
        if key not in found or row.severity > found[key].severity:
            found[key] = row
    return tuple(found.values())


@dataclass(frozen=True, slots=True)
class _GradientErrors:
    """Slopes (S, outputs, directions) by gradient and by differences, and the noise of the latter."""

    analytic: Array
    numeric: Array
    noise: Array

    @classmethod
    def of(cls, gradient: Array, found: FiniteDifferences) -> _GradientErrors:
        """Slopes along K of D directions, as long together as the whole gradient on average."""
        count, size = found.directions.shape
        scale = math.sqrt(size / count)
        along = gradient[:, found.where] @ found.directions.T
        return cls(scale * np.broadcast_to(along, found.slopes.shape), scale * found.slopes, scale * found.noise)

    @classmethod
    def joined(cls, parts: Sequence[_GradientErrors]) -> _GradientErrors:
        """Parameters one after the other, as theta holds them."""
        return cls(
            np.concatenate([p.analytic for p in parts], axis=-1),
            np.concatenate([p.numeric for p in parts], axis=-1),
            np.concatenate([p.noise for p in parts], axis=-1),
        )

    def of_outputs(self, which: slice) -> _GradientErrors:
        """Some outputs only."""
        return _GradientErrors(self.analytic[:, which], self.numeric[:, which], self.noise[:, which])


def _row(
    where: tuple[str, Point, str, Backend, str], steps: Sequence[float], compared: _GradientErrors
) -> GradcheckRow:
    agreements = []
    silent = True
    for step, analytic, numeric, noise in zip(
        steps, compared.analytic, compared.numeric, compared.noise, strict=True
    ):
        lengths = float(np.linalg.norm(analytic)), float(np.linalg.norm(numeric))
        floor = max(float(np.linalg.norm(noise)), sys.float_info.min)
        silent = silent and max(lengths) <= floor
        product = lengths[0] * lengths[1]
        cosine = float((analytic * numeric).sum()) / product if product > 0 else 0.0
        error = float(np.linalg.norm(analytic - numeric)) / max(lengths[1], floor)
        agreements.append(GradientAgreement(step, cosine, error))
    if silent:
        return GradcheckRow(*where, cosine=None, relative_error=None, step=None, steps=())
    best = min(agreements, key=lambda a: a.relative_error)
    return GradcheckRow(*where, best.cosine, best.relative_error, best.step, tuple(agreements))


_DEFAULT_SCENES = 1
_FILE_WIDTH = 120
"""Characters a line of the table where it goes to a file and not to a terminal."""
_PACKAGES = ("drivesem", "torch", "kornia", "numpy", "warp-lang")


def run(config: GradcheckConfig) -> int:
    """Check the chosen scenes; exit code 0 if all gradients are within the tolerance, else 1.

    Raises UsageError or SceneError for bad input.
    """
    if config.reach:
        return _reach(config)
    start = time.perf_counter()
    worker = GradcheckWorker(config)
    names, _, unreadable = select_frames(worker.source, replace(config, limit=config.limit or _DEFAULT_SCENES))
    if not names:
        raise UsageError("gradcheck", "at least one frame with vehicles", "none")
    scenes, failed = _check_all(worker, names)
    failed = unreadable | failed
    rows = worst(row for found in scenes.values() for row in found)
    passed = bool(rows) and all(row.passes(config.min_cosine, config.max_error) for row in rows)
    summary = {
        "rows": [asdict(row) for row in rows],
        "passed": passed,
        "tolerance": {"cosine": config.min_cosine, "relative_error": config.max_error},
        "scenes": {name: [asdict(row) for row in found] for name, found in scenes.items()},
        "frames_failed": dict(sorted(failed.items())),
        "settings": {
            "dataset": config.dataset,
            "detector": config.detector,
            "term": TERM,
            "seed": config.seed,
            "directions": config.directions,
            "functionals": FUNCTIONALS,
        },
        "versions": {package: importlib.metadata.version(package) for package in _PACKAGES},
        "seconds": round(time.perf_counter() - start, 3),
    }
    if config.out:
        files.write_json(Path(config.out) / "gradcheck.json", summary)
    if config.json:
        print_json(summary)
    else:
        console = Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)
        _print(rows, config, console, len(scenes))
        for name, reason in failed.items():
            console.print(f"frame {name} could not be used: {reason}", soft_wrap=True)
    return 0 if passed else 1


def _reach(config: GradcheckConfig) -> int:
    """How far gradients of margins hold; exit code 0."""
    check_device(config.device)
    worker = ReachWorker.of(config)
    names, _, unreadable = select_frames(worker.source, replace(config, limit=config.limit or _DEFAULT_SCENES))
    bar = ProgressSettings("comparing gradients and slopes", show_remaining=True)
    measuring = run_frame_jobs(names, worker.measure, partial(build_reach_worker, config), config, bar)
    rows = reach_rows([measuring.results[name] for name in names if name in measuring.results], config.seed)
    if not rows:
        raise UsageError("gradcheck --reach", "at least one vehicle that the detector finds", "none")
    facts = {
        "settings": {
            "dataset": config.dataset,
            "detector": config.detector,
            "seed": config.seed,
            "draws": config.draws,
            "frames": len(measuring.results),
            "steps": asdict(StepSizes()),
        },
    }
    report = reach_answer(Path(config.out or "."), rows, facts, unreadable | measuring.failed)
    if config.out:
        report.write()
    if config.json:
        print_json(report.data)
    else:
        report.print(Console(width=None if sys.stdout.isatty() else _FILE_WIDTH))
    if config.out:
        print_output_folder(report.out, Console(stderr=True), report.failed)
    return 0


@dataclass(frozen=True, slots=True)
class _Task:
    """A part of one scene's work at one point: the gradients, or the differences of one parameter."""

    identifier: str
    at: Point
    parameter: Parameter | None


class GradcheckWorker:
    """What one process needs: built once, used for many tasks. Raises UsageError or SceneError for bad input."""

    def __init__(self, config: GradcheckConfig) -> None:
        self.config = config
        check_device(config.device)
        self.source: SceneSource = open_source(config)
        self._detectors: dict[Backend, SqueezeDet] = {
            "reference": _detector(config.detector, "cpu").double(),
            "warp": _detector(config.detector, config.device),
        }
        self._current: tuple[str, SceneCheck] | None = None

    def do(self, task: _Task) -> Gradients | FiniteDifferences:
        """Run one task; the scene is cached for the next one."""
        if self._current is None or self._current[0] != task.identifier:
            self._current = None
            scene = self.source.scene(task.identifier)
            check = SceneCheck(scene, self._detectors, self.config.seed, self.config.directions)
            self._current = (task.identifier, check)
        check = self._current[1]
        return check.gradients(task.at) if task.parameter is None else check.differences(task.at, task.parameter)

    def __call__(self, tasks: Sequence[_Task]) -> list[Gradients | FiniteDifferences]:
        """Several tasks."""
        return [self.do(task) for task in tasks]


def _check_all(
    worker: GradcheckWorker, names: Sequence[str]
) -> tuple[dict[str, tuple[GradcheckRow, ...]], dict[str, str]]:
    """The rows of each scene, and why others have none."""
    parts = (None, *PAPER_PARAMETERS)
    per_scene = [tuple(_Task(name, at, part) for at in POINTS for part in parts) for name in names]
    # with too few scenes to occupy every process, each process prepares the scene for itself
    single = [(task,) for tasks in per_scene for task in tasks]
    jobs = per_scene if len(names) >= worker.config.processes else single
    answers = run_frame_jobs(
        jobs,
        worker,
        partial(GradcheckWorker, worker.config),
        worker.config,
        ProgressSettings("checking gradients"),
        name=lambda tasks: tasks[0].identifier,
        size=len,
    )
    results: dict[_Task, Any] = {}
    for tasks, outcomes in answers.results.items():
        results.update(zip(tasks, outcomes, strict=True))

    def rows(name: str, at: Point) -> tuple[GradcheckRow, ...]:
        differences = {p: results[_Task(name, at, p)] for p in PAPER_PARAMETERS}
        return gradcheck_rows(name, at, results[_Task(name, at, None)], differences)

    scenes = {
        name: tuple(row for at in POINTS for row in rows(name, at)) for name in names if name not in answers.failed
    }
    return scenes, answers.failed


def _detector(name: str, device: str) -> SqueezeDet:
    try:
        detector = load_detector(name, device)
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    if not isinstance(detector, SqueezeDet):
        raise UsageError("--detector", "one with anchors that can be fixed: SqueezeDet", type(detector).__name__)
    return detector


def _print(rows: Sequence[GradcheckRow], config: GradcheckConfig, console: Console, scenes: int) -> None:
    title = f"gradients against central differences: {config.dataset}, "
    title += "1 scene" if scenes == 1 else f"the worst of {scenes} scenes"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("parameter", "at", "of", "backend"):
        table.add_column(heading)
    for heading in ("cosine", "error", "step", "other steps: error"):
        table.add_column(heading, justify="right")
    if scenes > 1:
        table.add_column("scene")
    for row in rows:
        of = "loss" if row.functional == LOSS else row.functional
        cells = [row.name.removesuffix(f" {LOSS}"), row.at, of, row.backend]
        if row.cosine is None or row.relative_error is None or row.step is None:
            cells += ["no effect", "", "", ""]
        else:
            others = [f"{a.step:.0e}: {a.relative_error:.1e}" for a in row.steps if a.step != row.step]
            cells += [f"{row.cosine:.5f}", f"{row.relative_error:.1e}", f"{row.step:.0e}", ", ".join(others)]
        style = None if row.passes(config.min_cosine, config.max_error) else "bold red"
        table.add_row(*cells, *([row.scene] if scenes > 1 else []), style=style)
    console.print(table)
    outside = sum(not row.passes(config.min_cosine, config.max_error) for row in rows)
    silent = sum(row.cosine is None for row in rows)
    inside = len(rows) - outside - silent
    counts = f"{inside} of {format_count(len(rows), 'row')} inside the tolerance, {outside} outside"
    counts += f", {silent} without effect" if silent else ""
    tolerance = f"cosine at least {config.min_cosine:g}, error at most {config.max_error:g}"
    console.print(f"{counts} ({tolerance})", soft_wrap=True)
