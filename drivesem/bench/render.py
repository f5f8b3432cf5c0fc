"""The renderer on its own: against its reference, and verb by verb."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from drivesem.bench.scenes import BenchScene, Placed, bench_scene
from drivesem.bench.tables import Columns
from drivesem.bench.timing import Budget, Clock, Spread, rounds
from scene_ir.raster import verbs
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import scene_to

TITLE, VERBS_TITLE = "The renderer", "The four verbs"
COLUMNS: Columns = {
    "backend": ("backend", "backend"), "cars": ("cars", "cars"), "triangles": ("triangles a car", "triangles"),
    "scale": ("scale", "scale"), "pixels": ("pixels of the cars", None),
    "forward_ms": ("forward, ms", "forward ms"), "forward_iqr": ("IQR", None),
    "backward_ms": ("backward, ms", "backward"), "backward_iqr": ("IQR", None),
    "forward_backward_ms": ("both, ms", "both"), "both_cpu_ms": ("both, processor ms", "cpu"),
}  # fmt: skip
VERB_COLUMNS: Columns = {
    "verb": ("verb", "verb"), "backend": ("backend", "backend"), "cars": ("cars", "cars"),
    "triangles": ("triangles a car", "triangles"), "pixels": ("pixels of the cars", None),
    "crop_pixels": ("pixels of the rectangles", "pixels"), "forward_ms": ("forward, ms", "forward ms"),
    "backward_ms": ("backward, ms", "backward"),
}  # fmt: skip
METHOD = (
    "The whole picture is re-rendered (texture from the photograph, completion, halo, shadows, blending) with "
    "every car moved, turned and bent a little. forward_ms: no gradients recorded; backward_ms: from a random "
    "gradient of the picture to the cars' parameters; forward_backward_ms: recorded forward and backward "
    "together; processor ms: the same by the processor's time, all threads together, which other work on the "
    "machine lengthens less than the clock's. Medians after a warm-up. scale: pixels along an axis, as a multiple "
    "of 1242x375; pixels: hits of the meshes, car by car."
)
BACKENDS: tuple[verbs.Backend, ...] = ("warp", "reference")
_FEWEST, _MOST = 2, 60
_SLOW_S = 0.5
"""A call that takes longer than this is measured fewer times: noise is small beside it."""
_SCALES = (0.5, 1.5)
"""Beside 1: fewer and more pixels of the same view."""


@dataclass(frozen=True, slots=True)
class SceneSize:
    """One size to measure at."""

    cars: int
    triangles: int
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class RenderRow:
    """What was measured; times in ms."""

    backend: str
    cars: int
    triangles: int
    scale: float
    pixels: int
    forward_ms: float
    backward_ms: float
    forward_backward_ms: float
    both_cpu_ms: float
    forward_iqr: float
    backward_iqr: float


@dataclass(frozen=True, slots=True)
class VerbRow:
    """One verb alone, of all cars' rectangles at once; backward_ms None where it has no gradient."""

    verb: str
    backend: str
    cars: int
    triangles: int
    pixels: int
    crop_pixels: int
    forward_ms: float
    backward_ms: float | None


@dataclass(frozen=True, slots=True)
class Times:
    """Of forward without gradients, of backward, and of both together; ms, None where there is no backward. spent:
    the processor's, of both, or of forward where that is all.
    """

    forward: Spread
    backward: Spread | None
    both: Spread | None
    spent: Spread


def sizes(cars: Sequence[int], triangles: Sequence[int]) -> list[SceneSize]:
    """All numbers of cars and triangles, and the usual size at other scales."""
    return [SceneSize(n, k) for n in cars for k in triangles] + [
        replace(usual(cars, triangles), scale=scale) for scale in _SCALES
    ]


def usual(cars: Sequence[int], triangles: Sequence[int]) -> SceneSize:
    """The size at which more than speed against size is looked at: 8 cars, where they are asked for."""
    return SceneSize(8 if 8 in cars else max(cars), max(triangles))


def measure(size_list: Sequence[SceneSize], seconds: float, seed: int, device: str) -> Iterator[RenderRow]:
    """One row a backend and size, within about `seconds`."""
    budget = Budget(seconds, len(size_list))
    for size in size_list:
        start = time.perf_counter()
        bench = bench_scene(size.cars, size.triangles, seed, size.scale)
        share = budget.share(time.perf_counter() - start) / len(BACKENDS)
        for backend in BACKENDS:
            yield _picture_row(size, bench, backend, (share, seed, device))


def measure_verbs(size: SceneSize, seconds: float, seed: int, device: str) -> Iterator[VerbRow]:
    """The four verbs at one size, fast and reference."""
    bench = bench_scene(size.cars, size.triangles, seed, size.scale)
    scene = scene_to(bench.scene, torch.float32, device)
    placed, clock = Placed.of(scene), Clock(device)
    layout = placed.layout(scene.camera)
    budget = Budget(seconds, 4 * len(BACKENDS))
    generator = torch.Generator().manual_seed(seed)
    colours = torch.rand(placed.points.shape, generator=generator).to(placed.points)
    # Off the pixel centres, where a lookup would be a copy.
    uv = layout.pixels().to(colours) + torch.rand(layout.size, 2, generator=generator).to(colours)
    for backend in BACKENDS:
        rasterize = partial(verbs.rasterize, placed.clip, placed.faces, placed.face_ranges, layout, backend)
        found = rasterize()
        clip = placed.clip.detach().clone().requires_grad_(True)
        where = uv.detach().clone().requires_grad_(True)
        calls: dict[str, tuple[Callable[[], Any], Tensor | None]] = {
            "rasterize": (rasterize, None),
            "interpolate": (partial(verbs.interpolate, found, clip, placed.faces, colours, backend), clip),
            "texture": (partial(verbs.texture, scene.photograph, where, backend), where),
            "antialias": (partial(verbs.antialias, found, clip, placed.faces, backend), clip),
        }
        for verb, (call, leaf) in calls.items():
            times = timed(call, None if leaf is None else _pull(leaf), clock, budget.share())
            yield VerbRow(
                verb=verb,
                backend=backend,
                cars=size.cars,
                triangles=size.triangles,
                pixels=bench.hit_pixels,
                crop_pixels=layout.size,
                forward_ms=rounded(times.forward),
                backward_ms=None if times.backward is None else rounded(times.backward),
            )


def _pull(leaf: Tensor) -> Callable[[Tensor], object]:
    """Backward of a verb's result to `leaf`, from a gradient of ones."""
    return lambda result: torch.autograd.grad(result, leaf, torch.ones_like(result))


def _picture_row(
    size: SceneSize, bench: BenchScene, backend: verbs.Backend, how: tuple[float, int, str]
) -> RenderRow:
    """The whole re-rendered picture, gradients to pose and shape."""
    seconds, seed, device = how
    scene = scene_to(bench.scene, torch.float32, device)
    compositor = Compositor(scene, RenderSettings(backend=backend))
    generator = torch.Generator().manual_seed(seed)
    objects = scene.objects
    names = ("translation", "yaw", "ffd")
    amounts = {"translation": 0.1, "yaw": 0.03, "ffd": 0.01}
    leaves = {
        name: (
            getattr(objects, name)
            + amounts[name] * torch.randn(getattr(objects, name).shape, generator=generator).to(objects.yaw)
        ).requires_grad_(True)
        for name in names
    }
    weight = torch.randn(scene.photograph.shape, generator=generator).to(scene.photograph)
    moved = scene.with_objects(**{name: leaf.detach() for name, leaf in leaves.items()})

    def forward() -> Tensor:
        if torch.is_grad_enabled():
            return compositor.render(scene.with_objects(**leaves)).image
        return compositor.render(moved).image

    inputs = list(leaves.values())
    times = timed(forward, lambda image: torch.autograd.grad(image, inputs, weight), Clock(device), seconds)
    assert times.backward is not None
    assert times.both is not None
    return RenderRow(
        backend=backend,
        cars=size.cars,
        triangles=size.triangles,
        scale=size.scale,
        pixels=bench.hit_pixels,
        forward_ms=rounded(times.forward),
        backward_ms=rounded(times.backward),
        forward_backward_ms=rounded(times.both),
        both_cpu_ms=rounded(times.spent),
        forward_iqr=round(times.forward.iqr, 3),
        backward_iqr=round(times.backward.iqr, 3),
    )


def timed(
    forward: Callable[[], Any], backward: Callable[[Any], object] | None, clock: Clock, seconds: float
) -> Times:
    """Forward without gradients, then forward and backward, repeated in turn after a warm-up."""
    alone: list[float] = []
    back: list[float] = []
    both: list[float] = []
    spent: list[float] = []
    kept: list[Any] = []

    def keep() -> None:
        kept[:] = [forward()]

    def once() -> None:
        with torch.no_grad():
            taken = clock.taken(keep)
        alone.append(taken.ms)
        if backward is None:
            spent.append(taken.cpu_ms)
            return
        first, last = clock.taken(keep), clock.taken(partial(backward, kept[0]))
        back.append(last.ms)
        both.append(first.ms + last.ms)
        spent.append(first.cpu_ms + last.cpu_ms)

    start = time.perf_counter()
    once()
    if time.perf_counter() - start < _SLOW_S:  # what is slow shows how slow it is at once
        for times in (alone, back, both, spent):
            times.clear()
    for _ in rounds(seconds - (time.perf_counter() - start), 1 if alone else _FEWEST, _MOST):
        once()
    of_both = Spread.of(both) if both else None
    return Times(Spread.of(alone), Spread.of(back) if back else None, of_both, Spread.of(spent))


def rounded(spread: Spread) -> float:
    """The median, to the microsecond."""
    return round(spread.median, 3)
