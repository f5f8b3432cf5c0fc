"""Other renderers against the project's own four verbs, at the same job."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import get_context

import torch

from drivesem.bench.render import RenderTimes, SceneSize, round_median, time_render
from drivesem.bench.scenes import BenchScene, PackedMeshes, build_bench_scene
from drivesem.bench.session import Columns
from drivesem.bench.timing import PairedTimer, TimeBudget
from scene_ir.types import convert_scene
from tools.bench import renderers
from tools.bench.renderers import RenderTask

TITLE = "Other renderers"
COLUMNS: Columns = {
    "backend": ("backend", "backend"), "cars": ("cars", "cars"), "triangles": ("triangles a car", "triangles"),
    "scale": ("scale", "scale"), "pixels": ("pixels of the cars", None),
    "forward_ms": ("forward, ms", "forward ms"), "forward_iqr": ("IQR", None),
    "backward_ms": ("backward, ms", "backward"), "backward_iqr": ("IQR", None),
    "forward_backward_ms": ("both, ms", "both"), "cpu_ms": ("processor ms", "cpu"),
    "visible_pixels": ("pixels it shows", None), "shows": ("shows", None),
    "unavailable": ("not available", "not available"),
}  # fmt: skip
METHOD = (
    "All draw the same meshes, whole frames (warp-verbs: the cars' rectangles), from vertices that are new in "
    "each call: see `shows`. What drivesem bench render measures is the whole picture: texture from the "
    "photograph, completion, halo, shadows, blending. forward_ms: no gradients recorded, if the backend "
    "allows it; backward_ms: from a random gradient of the picture to the vertices; forward_backward_ms: recorded "
    "forward and backward together; processor ms: of both, or of forward where there is no backward, by the "
    "processor's time, all threads together. Medians after a warm-up. scale: pixels along an axis, as a multiple "
    "of 1242x375; pixels: hits of the meshes, car by car; visible_pixels: pixels of the frame that show a car, as "
    "the backend itself counts them."
)
OWN = "warp-verbs"
_START_S = 30.0
"""What starting a process and importing a library may take."""
_PATIENCE = 4.0
"""A renderer that takes this many times its share of the seconds for one size is given up."""


@dataclass(frozen=True, slots=True)
class RivalRow:
    """What was measured; times in ms, None where the backend lacks it or cannot run: `unavailable`."""

    backend: str
    cars: int
    triangles: int
    scale: float
    pixels: int
    shows: str
    forward_ms: float | None = None
    backward_ms: float | None = None
    forward_backward_ms: float | None = None
    cpu_ms: float | None = None
    forward_iqr: float | None = None
    backward_iqr: float | None = None
    visible_pixels: int | None = None
    unavailable: str | None = None


def measure(sizes: Sequence[SceneSize], seconds: float, seed: int, device: str) -> Iterator[RivalRow]:
    """A row a size of the project's verbs and of each other renderer, within about `seconds`."""
    names = list(renderers.RENDERERS)
    budget = TimeBudget(seconds, len(sizes) + len(names))
    clock = PairedTimer(device)
    tasks: list[tuple[SceneSize, int, RenderTask]] = []
    for size in sizes:
        start = time.perf_counter()
        bench = build_bench_scene(size.cars, size.triangles, seed, size.scale)
        task = _task(bench, seed, device)
        tasks.append((size, bench.hit_pixels, task))
        own = renderers.own_verbs(task)
        times = time_render(own.forward, own.backward, clock, budget.share(time.perf_counter() - start))
        yield _row(OWN, size, bench.hit_pixels, own.shows, times)
    for name in names:
        yield from _rival_rows(name, tasks, budget.share(), device)


def _task(bench: BenchScene, seed: int, device: str) -> RenderTask:
    scene = convert_scene(bench.scene, torch.float32, device)
    placed = PackedMeshes.from_scene(scene)
    generator = torch.Generator().manual_seed(seed)
    colours = torch.rand(placed.points.shape, generator=generator).to(placed.points)
    height, width = scene.camera.height, scene.camera.width
    weight = torch.randn(height, width, 3, generator=generator).to(placed.points)
    return RenderTask(placed, scene.camera, colours, weight)


def _row(
    backend: str, size: SceneSize, pixels: int, shows: str, times: RenderTimes, visible: int | None = None
) -> RivalRow:
    return RivalRow(
        backend=backend,
        cars=size.cars,
        triangles=size.triangles,
        scale=size.scale,
        pixels=pixels,
        shows=shows,
        forward_ms=round_median(times.forward),
        forward_iqr=round(times.forward.iqr, 3),
        backward_ms=None if times.backward is None else round_median(times.backward),
        backward_iqr=None if times.backward is None else round(times.backward.iqr, 3),
        forward_backward_ms=None if times.both is None else round_median(times.both),
        cpu_ms=round_median(times.cpu),
        visible_pixels=visible,
    )


def _rival_rows(
    name: str, tasks: Sequence[tuple[SceneSize, int, RenderTask]], seconds: float, device: str
) -> Iterator[RivalRow]:
    """Measured in a process of its own: a library that takes its process down takes no results along."""
    patience = _START_S + _PATIENCE * seconds
    on_host = [(size, pixels, _to(task, "cpu")) for size, pixels, task in tasks]
    pool = ProcessPoolExecutor(1, get_context("spawn"), initializer=_quieten, initargs=(torch.get_num_threads(),))
    try:
        found: list[RivalRow] = []
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


def _unavailable(name: str, task: tuple[SceneSize, int, RenderTask], reason: str) -> RivalRow:
    size, pixels, _ = task
    return RivalRow(name, size.cars, size.triangles, size.scale, pixels, "", unavailable=reason)


def _quieten(threads: int) -> None:
    """A rival's process prints nothing: standard output belongs to the results."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    torch.set_num_threads(threads)


def _measure_rival(name: str, task: tuple[SceneSize, int, RenderTask], seconds: float, device: str) -> RivalRow:
    size, pixels, work = task
    try:
        renderer = renderers.RENDERERS[name](_to(work, device))
    except renderers.UnavailableError as error:
        return _unavailable(name, task, str(error))
    try:
        times = time_render(renderer.forward, renderer.backward, PairedTimer(device), seconds)
        return _row(name, size, pixels, renderer.shows, times, renderer.hits(renderer.forward()))
    except Exception as error:  # anything a library raises while it draws
        return _unavailable(name, task, f"{type(error).__name__}: {' '.join(str(error).split())}"[:160])


def _to(task: RenderTask, device: str) -> RenderTask:
    return replace(
        task,
        placed=convert_scene(task.placed, torch.float32, device),
        camera=convert_scene(task.camera, torch.float32, device),
        colours=task.colours.to(device),
        weight=task.weight.to(device),
    )
