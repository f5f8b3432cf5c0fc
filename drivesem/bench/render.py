"""Times the renderer against its reference, as a whole and verb by verb."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from drivesem.bench.scenes import BenchScene, PackedMeshes, build_bench_scene
from drivesem.bench.session import Columns
from drivesem.bench.timing import PairedTimer, Spread, TimeBudget, repetitions
from scene_ir.raster import verbs
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import convert_scene

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
"""A longer call is repeated less often: its noise is relatively small, s."""
_SCALES = (0.5, 1.5)
"""Further image scales than 1."""


@dataclass(frozen=True, slots=True)
class SceneSize:
    """One size to measure."""

    cars: int
    """Number of cars."""
    triangles: int
    """Per car."""
    scale: float = 1.0
    """Pixels along an axis, as a multiple of 1242x375."""


@dataclass(frozen=True, slots=True)
class RenderTimes:
    """Times of a call, ms."""

    forward: Spread
    """Without gradients."""
    backward: Spread | None
    """None if there is no gradient."""
    both: Spread | None
    """Recorded forward and backward; None if there is no gradient."""
    cpu: Spread
    """Processor time of both, or of forward if there is no gradient."""


def sizes(cars: Sequence[int], triangles: Sequence[int]) -> list[SceneSize]:
    """All combinations of cars and triangles, and the default size at other scales."""
    return [SceneSize(n, k) for n in cars for k in triangles] + [
        replace(default_size(cars, triangles), scale=scale) for scale in _SCALES
    ]


def default_size(cars: Sequence[int], triangles: Sequence[int]) -> SceneSize:
    """The size for everything but speed against size: 8 cars, if requested, of the most triangles."""
    return SceneSize(8 if 8 in cars else max(cars), max(triangles))


def measure(size_list: Sequence[SceneSize], seconds: float, seed: int, device: str) -> Iterator[dict[str, Any]]:
    """Measure one row per backend and size; times are medians in ms.

    Args:
        size_list: What to measure.
        seconds: Total time, about.
        seed: Seed of scenes and gradients.
        device: Device to measure.
    """
    budget = TimeBudget(seconds, len(size_list))
    for size in size_list:
        start = time.perf_counter()
        bench = build_bench_scene(size.cars, size.triangles, seed, size.scale)
        share = budget.share(time.perf_counter() - start) / len(BACKENDS)
        for backend in BACKENDS:
            yield _picture_row(size, bench, backend, (share, seed, device))


def measure_verbs(size: SceneSize, seconds: float, seed: int, device: str) -> Iterator[dict[str, Any]]:
    """Measure the four verbs in both backends, for all cars together; times are medians in ms.

    Args:
        size: The size.
        seconds: Total time, about.
        seed: Seed of the scene and the lookups.
        device: Device to measure.
    """
    bench = build_bench_scene(size.cars, size.triangles, seed, size.scale)
    scene = convert_scene(bench.scene, torch.float32, device)
    placed, clock = PackedMeshes.from_scene(scene), PairedTimer(device)
    layout = placed.layout(scene.camera)
    budget = TimeBudget(seconds, 4 * len(BACKENDS))
    generator = torch.Generator().manual_seed(seed)
    colours = torch.rand(placed.points.shape, generator=generator).to(placed.points)
    # Off the pixel centres, where a lookup would be a plain copy.
    uv = layout.pixel_xy().to(colours) + torch.rand(layout.size, 2, generator=generator).to(colours)
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
            times = time_render(call, None if leaf is None else _backward_to(leaf), clock, budget.share())
            yield {
                "verb": verb,
                "backend": backend,
                "cars": size.cars,
                "triangles": size.triangles,
                "pixels": bench.hit_pixels,
                "crop_pixels": layout.size,
                "forward_ms": round_median(times.forward),
                "backward_ms": None if times.backward is None else round_median(times.backward),
            }


def _backward_to(leaf: Tensor) -> Callable[[Tensor], object]:
    """Backward of a verb's result to `leaf`, from a gradient of ones."""
    return lambda result: torch.autograd.grad(result, leaf, torch.ones_like(result))


def _picture_row(
    size: SceneSize, bench: BenchScene, backend: verbs.Backend, how: tuple[float, int, str]
) -> dict[str, Any]:
    """Measure the whole re-rendered picture with gradients to pose and shape."""
    seconds, seed, device = how
    scene = convert_scene(bench.scene, torch.float32, device)
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
    times = time_render(
        forward, lambda image: torch.autograd.grad(image, inputs, weight), PairedTimer(device), seconds
    )
    assert times.backward is not None
    assert times.both is not None
    return {
        "backend": backend,
        "cars": size.cars,
        "triangles": size.triangles,
        "scale": size.scale,
        "pixels": bench.hit_pixels,
        "forward_ms": round_median(times.forward),
        "backward_ms": round_median(times.backward),
        "forward_backward_ms": round_median(times.both),
        "both_cpu_ms": round_median(times.cpu),
        "forward_iqr": round(times.forward.iqr, 3),
        "backward_iqr": round(times.backward.iqr, 3),
    }


def time_render(
    forward: Callable[[], Any], backward: Callable[[Any], object] | None, clock: PairedTimer, seconds: float
) -> RenderTimes:
    """Time forward without gradients, then forward and backward, repeated after a warm-up.

    Args:
        forward: The call.
        backward: Maps its result to gradients; None if it has none.
        clock: The timer.
        seconds: Total time, about.
    """
    alone: list[float] = []
    back: list[float] = []
    both: list[float] = []
    cpu: list[float] = []
    results: list[Any] = []

    def run_forward() -> None:
        results[:] = [forward()]

    def once() -> None:
        with torch.no_grad():
            call_time = clock.time_call(run_forward)
        alone.append(call_time.ms)
        if backward is None:
            cpu.append(call_time.cpu_ms)
            return
        first, last = clock.time_call(run_forward), clock.time_call(partial(backward, results[0]))
        back.append(last.ms)
        both.append(first.ms + last.ms)
        cpu.append(first.cpu_ms + last.cpu_ms)

    start = time.perf_counter()
    once()
    if time.perf_counter() - start < _SLOW_S:  # the first call of a slow function counts
        for times in (alone, back, both, cpu):
            times.clear()
    for _ in repetitions(seconds - (time.perf_counter() - start), 1 if alone else _FEWEST, _MOST):
        once()
    of_both = Spread.from_values(both) if both else None
    return RenderTimes(
        Spread.from_values(alone), Spread.from_values(back) if back else None, of_both, Spread.from_values(cpu)
    )


def round_median(spread: Spread) -> float:
    """The median, rounded to microseconds."""
    return round(spread.median, 3)
