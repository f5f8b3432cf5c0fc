"""The renderer on its own: against its reference, against other renderers, and verb by verb."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import torch
from torch import Tensor

from drivesem.bench import rivals
from drivesem.bench.scenes import BenchScene, Placed, bench_scene
from drivesem.bench.timing import Budget, Clock, Spread, rounds
from scene_ir.raster import verbs
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import scene_to

METHOD = (
    "Backends warp and reference re-render the whole picture (texture from the photograph, completion, halo, "
    "shadows, blending) with every car moved, turned and bent a little; the others draw the same meshes, "
    "whole frames (warp-verbs: the cars' rectangles), from vertices that are new in each call: see `shows`. "
    "forward_ms: no gradients recorded, where the backend can tell; backward_ms: from a random gradient of "
    "the picture to the cars' parameters, or to the vertices; forward_backward_ms: recorded forward and "
    "backward together. Medians after a warm-up. scale: pixels along an axis, as a multiple of 1242x375; "
    "pixels: hits of the meshes, car by car; visible_pixels: pixels of the frame that show a car, as the "
    "backend itself counts them."
)
BACKENDS: tuple[verbs.Backend, ...] = ("warp", "reference")
_FEWEST, _MOST = 2, 60
_SLOW_S = 0.5
"""A call that takes longer than this is measured fewer times: noise is small beside it."""
_SCALES = (0.5, 1.5)
"""Beside 1: fewer and more pixels of the same view."""
_START_S = 30.0
"""What starting a process and importing a library may take."""
_PATIENCE = 4.0
"""Another renderer that takes this many times its share of the seconds for one size is given up."""


@dataclass(frozen=True, slots=True)
class Size:
    """One size to measure at."""

    cars: int
    triangles: int
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class Row:
    """What was measured; times in ms, None where the backend has no such thing or cannot run: `unavailable`."""

    backend: str
    cars: int
    triangles: int
    scale: float
    pixels: int
    shows: str
    forward_ms: float | None = None
    backward_ms: float | None = None
    forward_backward_ms: float | None = None
    forward_iqr: float | None = None
    backward_iqr: float | None = None
    visible_pixels: int | None = None
    unavailable: str | None = None


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
class _Times:
    forward: Spread
    backward: Spread | None
    both: Spread | None


def sizes(cars: Sequence[int], triangles: Sequence[int]) -> list[Size]:
    """All numbers of cars and triangles, and the usual size at other scales."""
    return [Size(n, k) for n in cars for k in triangles] + [
        replace(usual(cars, triangles), scale=scale) for scale in _SCALES
    ]


def usual(cars: Sequence[int], triangles: Sequence[int]) -> Size:
    """The size at which more than speed against size is looked at: 8 cars, where they are asked for."""
    return Size(8 if 8 in cars else max(cars), max(triangles))


def measure(size_list: Sequence[Size], seconds: float, seed: int, device: str) -> Iterator[Row]:
    """One row a backend and size, within about `seconds`."""
    names = list(rivals.RIVALS)
    budget = Budget(seconds, len(size_list) + len(names))
    clock = Clock(device)
    tasks: list[tuple[Size, int, rivals.Task]] = []
    for size in size_list:
        start = time.perf_counter()
        bench = bench_scene(size.cars, size.triangles, seed, size.scale)
        task = _task(bench, seed, device)
        tasks.append((size, bench.hit_pixels, task))
        share = budget.share(time.perf_counter() - start) / (len(BACKENDS) + 1)
        for backend in BACKENDS:
            yield _picture_row(size, bench, backend, clock, (share, seed, device))
        own = rivals.own_verbs(task)
        times = _timed(own.forward, own.backward, clock, share)
        yield _row("warp-verbs", size, bench.hit_pixels, own.shows, times)
    for name in names:
        yield from _rival_rows(name, tasks, budget.share(), device)


def measure_verbs(size: Size, seconds: float, seed: int, device: str) -> Iterator[VerbRow]:
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
            times = _timed(call, None if leaf is None else _pull(leaf), clock, budget.share())
            yield VerbRow(
                verb=verb,
                backend=backend,
                cars=size.cars,
                triangles=size.triangles,
                pixels=bench.hit_pixels,
                crop_pixels=layout.size,
                forward_ms=_rounded(times.forward),
                backward_ms=None if times.backward is None else _rounded(times.backward),
            )


def _pull(leaf: Tensor) -> Callable[[Tensor], object]:
    """Backward of a verb's result to `leaf`, from a gradient of ones."""
    return lambda result: torch.autograd.grad(result, leaf, torch.ones_like(result))


def _task(bench: BenchScene, seed: int, device: str) -> rivals.Task:
    scene = scene_to(bench.scene, torch.float32, device)
    placed = Placed.of(scene)
    generator = torch.Generator().manual_seed(seed)
    colours = torch.rand(placed.points.shape, generator=generator).to(placed.points)
    height, width = scene.camera.height, scene.camera.width
    weight = torch.randn(height, width, 3, generator=generator).to(placed.points)
    return rivals.Task(placed, scene.camera, colours, weight)


def _picture_row(
    size: Size, bench: BenchScene, backend: verbs.Backend, clock: Clock, how: tuple[float, int, str]
) -> Row:
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
    times = _timed(forward, lambda image: torch.autograd.grad(image, inputs, weight), clock, seconds)
    return _row(backend, size, bench.hit_pixels, "the whole picture", times)


def _timed(
    forward: Callable[[], Any], backward: Callable[[Any], object] | None, clock: Clock, seconds: float
) -> _Times:
    """Forward without gradients, then forward and backward, repeated in turn after a warm-up."""
    alone: list[float] = []
    back: list[float] = []
    both: list[float] = []
    kept: list[Any] = []

    def keep() -> None:
        kept[:] = [forward()]

    def once() -> None:
        with torch.no_grad():
            alone.append(clock.ms(keep))
        if backward is not None:
            first = clock.ms(keep)
            back.append(clock.ms(partial(backward, kept[0])))
            both.append(first + back[-1])

    start = time.perf_counter()
    once()
    if time.perf_counter() - start < _SLOW_S:  # what is slow shows how slow it is at once
        for times in (alone, back, both):
            times.clear()
    for _ in rounds(seconds - (time.perf_counter() - start), 1 if alone else _FEWEST, _MOST):
        once()
    return _Times(Spread.of(alone), Spread.of(back) if back else None, Spread.of(both) if both else None)


def _row(backend: str, size: Size, pixels: int, shows: str, times: _Times, visible: int | None = None) -> Row:
    return Row(
        backend=backend,
        cars=size.cars,
        triangles=size.triangles,
        scale=size.scale,
        pixels=pixels,
        shows=shows,
        forward_ms=_rounded(times.forward),
        forward_iqr=round(times.forward.iqr, 3),
        backward_ms=None if times.backward is None else _rounded(times.backward),
        backward_iqr=None if times.backward is None else round(times.backward.iqr, 3),
        forward_backward_ms=None if times.both is None else _rounded(times.both),
        visible_pixels=visible,
    )


def _rounded(spread: Spread) -> float:
    return round(spread.median, 3)


def _rival_rows(
    name: str, tasks: Sequence[tuple[Size, int, rivals.Task]], seconds: float, device: str
) -> Iterator[Row]:
    """Measured in a process of its own: a library that takes its process down takes no results along."""
    patience = _START_S + _PATIENCE * seconds
    on_host = [(size, pixels, _to(task, "cpu")) for size, pixels, task in tasks]
    pool = ProcessPoolExecutor(1, get_context("spawn"), initializer=_quieten, initargs=(torch.get_num_threads(),))
    try:
        found: list[Row] = []
        first = pool.submit(_measure_rival, name, on_host[0], seconds / len(tasks), device)
        try:
            found.append(first.result(timeout=patience))
            if found[0].unavailable is None:
                for task in on_host[1:]:
                    future = pool.submit(_measure_rival, name, task, seconds / len(tasks), device)
                    found.append(future.result(timeout=patience))
        except BrokenProcessPool:
            found.append(_unavailable(name, on_host[len(found)], "its process died"))
        except TimeoutError:
            found.append(_unavailable(name, on_host[len(found)], f"no result in {patience:.0f} s"))
            _end(pool)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    yield from found


def _end(pool: ProcessPoolExecutor) -> None:
    """Stop a process that does not come back."""
    for process in list((pool._processes or {}).values()):  # pyright: ignore[reportPrivateUsage]
        process.kill()


def _unavailable(name: str, task: tuple[Size, int, rivals.Task], reason: str) -> Row:
    size, pixels, _ = task
    return Row(name, size.cars, size.triangles, size.scale, pixels, "", unavailable=reason)


def _quieten(threads: int) -> None:
    """A rival's process says nothing: standard output belongs to the results."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    torch.set_num_threads(threads)


def _measure_rival(name: str, task: tuple[Size, int, rivals.Task], seconds: float, device: str) -> Row:
    size, pixels, work = task
    try:
        renderer = rivals.RIVALS[name](_to(work, device))
    except rivals.UnavailableError as error:
        return _unavailable(name, task, str(error))
    try:
        times = _timed(renderer.forward, renderer.backward, Clock(device), seconds)
        return _row(name, size, pixels, renderer.shows, times, renderer.hits(renderer.forward()))
    except Exception as error:  # whatever a library raises once it draws
        return _unavailable(name, task, f"{type(error).__name__}: {' '.join(str(error).split())}"[:160])


def _to(task: rivals.Task, device: str) -> rivals.Task:
    return replace(
        task,
        placed=scene_to(task.placed, torch.float32, device),
        camera=scene_to(task.camera, torch.float32, device),
        colours=task.colours.to(device),
        weight=task.weight.to(device),
    )
