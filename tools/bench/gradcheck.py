"""The gradients that attacks follow against central differences.

A scene is looked at as photographed (theta0) and at a random feasible theta that moves all six parameters. There,
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

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import kornia
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.base import RawPredictions
from detectors.squeezedet import Assignment, SqueezeDet
from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.labels import Labeller
from drivesem.attack.space import COMBOS, SIX, Parameter, ParameterSpace
from scene_ir.errors import RangeError
from scene_ir.raster.verbs import Backend
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import SceneIR, scene_to

Array = NDArray[np.float64]

Point = Literal["theta0", "random"]
POINTS: tuple[Point, ...] = ("theta0", "random")
BACKENDS: tuple[Backend, ...] = ("reference", "warp")
PICTURE, LOSS = "picture", "detector loss"

TERM = "objectness"
"""The term of the detector's loss that attacks raise."""
COMBO = 2
"""The combination whose concatenated gradient is compared besides, through the detector."""
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
class Agreement:
    """How well a gradient agrees with differences of one step. step: in theta's units; cosine: of the two vectors;
    relative_error: length of their difference over that of the differences.
    """

    step: float
    cosine: float
    relative_error: float


@dataclass(frozen=True, slots=True)
class GradcheckRow:
    """One comparison. name: the parameter, or `combo 2 detector loss`; at, functional, backend, scene: of what.
    cosine, relative_error, step: those of the step that agrees best, None where the parameter has no effect on the
    functional by either account. steps: all three.
    """

    name: str
    at: Point
    functional: str
    backend: Backend
    scene: str
    cosine: float | None
    relative_error: float | None
    step: float | None
    steps: tuple[Agreement, ...]

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
class Differences:
    """Along some directions of one parameter. where: its coordinates in theta; directions (K, D'), orthonormal;
    slopes (S, F + 1, K), by step; noise (S, F + 1, K): what rounding alone can make of them. All float64.
    """

    where: slice
    directions: Array
    slopes: Array
    noise: Array


Gradients = dict[Backend, Array]
"""By backend (F + 1, D) float64, of all six parameters."""


class _Path:
    """theta -> picture -> outputs, by one backend in its own precision."""

    def __init__(
        self, scene: SceneIR, backend: Backend, detector: SqueezeDet, weights: Tensor, dither: Tensor
    ) -> None:
        self.dtype = torch.float64 if backend == "reference" else torch.float32
        device = next(detector.parameters()).device
        self.scene = scene_to(scene, self.dtype, device)
        self.space = ParameterSpace(self.scene, SIX)
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
        start = self.scene.environment
        return scene.with_environment(weather=start.weather + part.weather, foliage=start.foliage + part.foliage)

    def detect(self, picture: Tensor) -> RawPredictions:
        """What the detector says of a picture (3, H, W)."""
        return self.detector((picture + self._dither)[None])

    def loss(self, picture: Tensor, assignment: Assignment) -> Tensor:
        """The detector's loss ()."""
        fixed = scene_to(assignment, self.dtype, self.weights.device)
        return self.detector.loss_terms(self.detect(picture), fixed)[TERM]

    @torch.no_grad()
    def outputs(self, theta: Tensor, assignment: Assignment) -> Tensor:
        """(F + 1,) at theta (D,)."""
        picture = self.render(theta)
        return torch.cat([(picture * self.weights).flatten(1).sum(dim=1), self.loss(picture, assignment)[None]])

    def gradients(self, theta: Tensor, assignment: Assignment, exact: Tensor) -> Array:
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
    """One scene, to be looked at at several points. detectors: by backend, of its precision; seed: of the
    functionals, of the random theta and of the directions; directions: K, at most."""

    def __init__(self, scene: SceneIR, detectors: dict[Backend, SqueezeDet], seed: int, directions: int) -> None:
        generator = _generator(seed, 0)
        weights = functionals(scene.camera.height, scene.camera.width, generator)
        dither = _DITHER * (2 * torch.rand(weights.shape[1:], generator=generator, dtype=weights.dtype) - 1)
        self._paths: dict[Backend, _Path] = {b: _Path(scene, b, detectors[b], weights, dither) for b in BACKENDS}
        self._exact = self._paths["reference"]
        self._seed, self._count = seed, directions
        self._points: dict[Point, tuple[Tensor, Assignment, Tensor]] = {}
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

    def differences(self, at: Point, parameter: Parameter) -> Differences:
        """Central differences of the float64 reference at a point, along random directions of one parameter."""
        theta, assignment, _ = self._at(at)
        where = self.space.slice_of(parameter)
        assert where is not None
        size = where.stop - where.start
        generator = _generator(self._seed, 2 + SIX.index(parameter))
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
        return Differences(where, chosen.numpy(), np.stack(slopes), np.stack(noise))

    def _at(self, at: Point) -> tuple[Tensor, Assignment, Tensor]:
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


def rows_of(
    scene: str, at: Point, gradients: Gradients, differences: dict[Parameter, Differences]
) -> tuple[GradcheckRow, ...]:
    """All comparisons of one scene at one point."""
    rows = []
    for backend, gradient in gradients.items():
        known = {p: _Compared.of(gradient, found) for p, found in differences.items()}
        for parameter, compared in known.items():
            for functional, outputs in ((PICTURE, slice(0, -1)), (LOSS, slice(-1, None))):
                where = (parameter.value, at, functional, backend, scene)
                rows.append(_row(where, STEPS[parameter], compared.of_outputs(outputs)))
        together = [known[p].of_outputs(slice(-1, None)) for p in COMBOS[COMBO] if p in known]
        if len(together) == len(COMBOS[COMBO]):
            where = (f"combo {COMBO} {LOSS}", at, LOSS, backend, scene)
            rows.append(_row(where, GEOMETRY_STEPS, _Compared.joined(together)))
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
class _Compared:
    """Slopes (S, outputs, directions) by gradient and by differences, and the noise of the latter."""

    analytic: Array
    numeric: Array
    noise: Array

    @classmethod
    def of(cls, gradient: Array, found: Differences) -> _Compared:
        """Slopes along K of D directions, as long together as the whole gradient on average."""
        count, size = found.directions.shape
        scale = math.sqrt(size / count)
        along = gradient[:, found.where] @ found.directions.T
        return cls(scale * np.broadcast_to(along, found.slopes.shape), scale * found.slopes, scale * found.noise)

    @classmethod
    def joined(cls, parts: Sequence[_Compared]) -> _Compared:
        """Parameters one after the other, as theta holds them."""
        return cls(
            np.concatenate([p.analytic for p in parts], axis=-1),
            np.concatenate([p.numeric for p in parts], axis=-1),
            np.concatenate([p.noise for p in parts], axis=-1),
        )

    def of_outputs(self, which: slice) -> _Compared:
        """Some outputs only."""
        return _Compared(self.analytic[:, which], self.numeric[:, which], self.noise[:, which])


def _row(where: tuple[str, Point, str, Backend, str], steps: Sequence[float], compared: _Compared) -> GradcheckRow:
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
        agreements.append(Agreement(step, cosine, error))
    if silent:
        return GradcheckRow(*where, cosine=None, relative_error=None, step=None, steps=())
    best = min(agreements, key=lambda a: a.relative_error)
    return GradcheckRow(*where, best.cosine, best.relative_error, best.step, tuple(agreements))
