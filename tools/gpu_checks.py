"""Parts of tools/gpu.sh that no bench has: the environment, the kernels on the GPU, the profile of an attack step,
and batches of one frame. `python -m tools.gpu_checks environment|kernels|step|batches [--device cuda]` prints JSON;
`merge LOGS FILE` gathers what the parts printed.
"""

from __future__ import annotations

import argparse
import collections
import importlib
import json
import platform
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivesem.bench.step import AttackSteps
    from drivesem.bench.timing import PairedTimer

ROOT = Path(__file__).parents[1]
_PACKAGES = (
    "torch", "warp-lang", "numpy", "kornia", "scipy", "opencv-contrib-python-headless", "trimesh", "pycocotools",
    "tyro", "cma", "loky", "pyrender", "open3d", "pytest",
)  # fmt: skip
_CARS, _TRIANGLES, _SEED = 4, 2000, 0
_WARM_UP, _TIMES, _PROFILED = 3, 20, 5
_BATCH, _DRAWS = 64, 16
"""Thetas of one frame; nuisance samples on either side of a certificate."""
_TAIL = 15
"""Lines of standard error that a failed part leaves."""


def measure_environment() -> dict[str, Any]:
    """The card, its driver, the packages and the processor."""
    from importlib.metadata import PackageNotFoundError, version

    versions: dict[str, str | None] = {}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = None
    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total,clocks.sm", "--format=csv,noheader"]
    try:
        card = subprocess.run(query, capture_output=True, text=True, timeout=20, check=False).stdout.strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        card = str(error)
    import torch

    return {
        "card": card,
        "python": platform.python_version(),
        "packages": versions,
        "torch_cuda": torch.version.cuda,
        "cudnn": torch.backends.cudnn.version(),
        "cuda_available": torch.cuda.is_available(),
        "capability": torch.cuda.get_device_capability() if torch.cuda.is_available() else None,
        "threads": torch.get_num_threads(),
    }


def kernel_modules() -> list[str]:
    """Names of the modules with Warp kernels."""
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in ("scene_ir", "drivesem", "detectors")
        for path in sorted((ROOT / package).rglob("*.py"))
        if "@wp.kernel" in path.read_text(encoding="utf-8")
    ]


def measure_kernels(device: str) -> dict[str, Any]:
    """Compile and load every kernel module on the CPU and on the device; seconds, and modules that fail."""
    import torch
    import warp as wp

    from scene_ir.raster.launch import start_warp

    start_warp()
    names = kernel_modules()
    modules = [wp.get_module(importlib.import_module(name).__name__) for name in names]
    out: dict[str, Any] = {"modules": names}
    for where in dict.fromkeys((device, "cpu")):
        place, start, failed = str(wp.get_device(where)), time.perf_counter(), {}
        try:
            wp.force_load(place, modules, max_workers=max(torch.get_num_threads(), 1))
        except Exception as error:  # which of them, below
            failed["all"] = str(error)[:500]
        for name, module in zip(names, modules, strict=True):
            try:
                if module.load(place) is None:
                    failed[name] = "not loaded"
            except Exception as error:
                failed[name] = str(error)[:500]
        out[where] = {"seconds": round(time.perf_counter() - start, 2), "failed": failed}
    return out


def measure_step(device: str) -> dict[str, Any]:
    """Times, kernel launches, host synchronisations and copies of an attack step, and of each of its parts."""
    from drivesem.bench.timing import PairedTimer, Spread

    step, clock = _make_step(device), PairedTimer(device)
    for _ in range(_WARM_UP):
        step()
    spread = Spread.from_values([clock.milliseconds(step) for _ in range(_TIMES)])
    out: dict[str, Any] = {
        "cars": _CARS,
        "step_ms": round(spread.median, 3),
        "step_iqr_ms": round(spread.iqr, 3),
        "step": _profile(step, device, lists=True),
        "synchronisations": _synchronising_lines(step, device),
    }
    out["parts"] = {name: _measure_part(call, clock, device) for name, call in _step_parts(step).items()}
    return out


def _make_step(device: str) -> AttackSteps:
    from detectors.registry import load_detector
    from drivesem.attacks.space import combo_parameters
    from drivesem.bench.scenes import build_bench_scene
    from drivesem.bench.step import AttackSteps

    scene = build_bench_scene(_CARS, _TRIANGLES, _SEED).scene
    return AttackSteps(scene, combo_parameters(2), load_detector("squeezedet", device), _SEED, device)


def _step_parts(step: AttackSteps) -> dict[str, Callable[[], object]]:
    import torch

    objective, space, theta = step.objective, step.space, step.theta
    compositor, detector = step.compositor, step.detector
    leaf = theta.detach().clone().requires_grad_(True)
    render = compositor.render(space.apply(space.scene, leaf))
    cotangent = torch.randn_like(render.image)
    with torch.no_grad():
        scene = space.apply(space.scene, theta)
        still = compositor.render(scene)
    image = still.image[None].detach().requires_grad_(True)
    targets = [objective.labeller.moved(scene, still).targets]
    raw = detector(image)
    loss = detector.loss(raw, targets)[objective.term]

    def apply_and_render() -> object:
        return compositor.render(space.apply(space.scene, leaf))

    def decode() -> object:
        with torch.no_grad():
            return detector.decode(raw)

    return {
        "scene_at_theta": lambda: space.apply(space.scene, leaf),
        "scene_and_render": apply_and_render,
        "render_backward": lambda: torch.autograd.grad(render.image, leaf, cotangent, retain_graph=True),
        "labels": lambda: objective.labeller.moved(scene, still),
        "predictions_of_regions": lambda: objective.predict_regions(render),
        "detector_forward": lambda: detector(image),
        "detector_loss": lambda: detector.loss(raw, targets),
        "detector_backward": lambda: torch.autograd.grad(loss, image, retain_graph=True),
        "decode": decode,
        "loss_and_grad": lambda: objective.loss_and_grad(theta),
        "projection": lambda: step.feasible.project(theta + 2 * space.step),
    }


def _measure_part(call: Callable[[], object], clock: PairedTimer, device: str) -> dict[str, Any]:
    from drivesem.bench.timing import Spread

    try:
        for _ in range(_WARM_UP):
            call()
        median = Spread.from_values([clock.milliseconds(call) for _ in range(_TIMES // 2)]).median
        return {"ms": round(median, 3), **_profile(call, device)}
    except Exception as error:
        return {"error": f"{type(error).__name__}: {error}"[:300]}


def _profile(call: Callable[[], object], device: str, lists: bool = False) -> dict[str, Any]:
    """Per call: kernels on the GPU and their ms, copies by direction, waits of the host, and operations of torch."""
    import torch
    from torch.profiler import ProfilerActivity, profile

    on_gpu = torch.device(device).type == "cuda"
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])]
    if on_gpu:
        torch.cuda.synchronize()
    with profile(activities=activities) as record:
        for _ in range(_PROFILED):
            call()
        if on_gpu:
            torch.cuda.synchronize()
    counts: collections.Counter[str] = collections.Counter()
    kernels: dict[str, list[float]] = {}
    operations: dict[str, list[float]] = {}
    for event in record.events():
        name = event.name
        if str(event.device_type).endswith("CUDA"):
            if name.startswith(("Memcpy", "Memset")):
                counts[" ".join(name.split()[:2])] += 1
            else:
                kernels.setdefault(name, []).append(event.time_range.elapsed_us() / 1e3)
        elif name.startswith(("cuda", "cu")):
            counts[name] += 1
        elif name.startswith("aten::"):
            operations.setdefault(name, []).append(event.self_cpu_time_total / 1e3)
    durations = [ms for times in kernels.values() for ms in times]
    out: dict[str, Any] = {
        "kernels": len(durations) / _PROFILED,
        "kernel_ms": round(sum(durations) / _PROFILED, 3),
        "operations": sum(map(len, operations.values())) / _PROFILED,
        "calls": {name: count / _PROFILED for name, count in sorted(counts.items())},
    }
    if lists:
        out["longest_kernels"], out["longest_operations"] = _longest(kernels), _longest(operations)
    return out


def _longest(times: dict[str, list[float]], count: int = 25) -> list[tuple[str, float, float]]:
    """Name, number and ms per call of those that take longest."""
    order = sorted(times.items(), key=lambda item: -sum(item[1]))[:count]
    return [(name[:90], len(ms) / _PROFILED, round(sum(ms) / _PROFILED, 4)) for name, ms in order]


def _synchronising_lines(call: Callable[[], object], device: str) -> dict[str, int]:
    """Lines of Python at which the host waits for the GPU in one call, and how often; of the forward pass."""
    import torch

    if torch.device(device).type != "cuda":
        return {}
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            call()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    lines = collections.Counter(f"{_relative(one.filename)}:{one.lineno}" for one in found)
    return dict(lines.most_common())


def _relative(path: str) -> str:
    return str(Path(path).relative_to(ROOT)) if path.startswith(str(ROOT)) else "/".join(Path(path).parts[-3:])


def measure_batches(device: str) -> dict[str, Any]:
    """Milliseconds of thetas of one frame through renderer and detector, together and one by one, and of a
    certificate's draws.
    """
    import torch

    from drivesem.bench.timing import PairedTimer, Spread
    from drivesem.failures.certificate import CompositorRenderer, NuisanceCamera
    from drivesem.failures.nuisances import Nuisances
    from scene_ir.render.compositor import render_batch

    step, clock = _make_step(device), PairedTimer(device)
    objective, space, detector = step.objective, step.space, step.detector
    noise = torch.rand(_BATCH, space.dim, generator=torch.Generator().manual_seed(_SEED)).to(space.step)
    thetas = [step.feasible.project(10 * space.step * (2 * row - 1)).theta for row in noise]
    ignore = torch.zeros(len(space.scene.objects), dtype=torch.bool, device=space.step.device)
    renderer = CompositorRenderer(step.compositor, objective.labeller)
    camera = NuisanceCamera(renderer, detector, objective.t_star, Nuisances(), "bench")
    base = space.scene
    with torch.no_grad():
        states = [space.apply(base, theta) for theta in thetas]

    def detect_together(count: int) -> None:
        with torch.no_grad():
            renders = render_batch([(step.compositor, state) for state in states[:count]])
            detector.decode(detector(torch.stack([render.image for render in renders])))

    def render_together(count: int) -> None:
        with torch.no_grad():
            render_batch([(step.compositor, state) for state in states[:count]])

    def detect_in_turn(count: int) -> None:
        with torch.no_grad():
            for state in states[:count]:
                detector.decode(detector(step.compositor.render(state).image[None]))

    def certify() -> None:
        for state in (states[0], base):
            camera.evaluate_all(state, range(_DRAWS), ignore)

    calls: dict[str, Callable[[], object]] = {
        "thetas_64": partial(detect_together, _BATCH),
        "thetas_64_render_alone": partial(render_together, _BATCH),
        "thetas_64_in_turn": partial(detect_in_turn, _BATCH),
        "thetas_16": partial(detect_together, _BATCH // 4),
        "certificate_32_draws": certify,
        "nuisance_render": lambda: camera.render(states[0], 0, ignore),
        "scenes_at_64_thetas": lambda: [space.apply(base, theta) for theta in thetas],
    }
    out: dict[str, Any] = {"cars": _CARS}
    for name, call in calls.items():
        try:
            call()
            times = [clock.milliseconds(call) for _ in range(3)]
            out[name] = {"ms": round(Spread.from_values(times).median, 2), **_profile_once(call, device)}
        except Exception as error:
            out[name] = {"error": f"{type(error).__name__}: {error}"[:300]}
    if torch.device(device).type == "cuda":
        out["peak_gb"] = round(torch.cuda.max_memory_allocated() / 2**30, 3)
    return out


def _profile_once(call: Callable[[], object], device: str) -> dict[str, Any]:
    global _PROFILED
    before, _PROFILED = _PROFILED, 1
    try:
        return _profile(call, device)
    finally:
        _PROFILED = before


def merge(logs: Path, out: Path) -> None:
    """Write one JSON object of the parts' results, exit codes and seconds."""
    parts: dict[str, Any] = {}
    for row in (logs / "parts.tsv").read_text(encoding="utf-8").splitlines():
        name, code, seconds, command = row.split("\t")
        part: dict[str, Any] = {"exit_code": code if code == "skipped" else int(code)}
        part |= {"seconds": round(float(seconds), 1), "command": command}
        printed, errors = _read(logs / f"{name}.out"), _read(logs / f"{name}.err")
        try:
            part["result"] = json.loads(
                printed[printed.index("{") :]
            )  # libraries may print lines of their own first
        except ValueError:
            part["printed"] = printed.splitlines()[-_TAIL:]
        if code not in ("0", "skipped"):
            part["errors"] = errors.splitlines()[-_TAIL:]
        parts[name] = part
    out.write_text(json.dumps(parts, indent=1) + "\n", encoding="utf-8")


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=["environment", "kernels", "step", "batches", "merge"])
    parser.add_argument("paths", nargs="*", type=Path)
    parser.add_argument("--device", default="cuda")
    options = parser.parse_args()
    if options.part == "merge":
        merge(*options.paths)
        return
    measures = {"kernels": measure_kernels, "step": measure_step, "batches": measure_batches}
    result = measure_environment() if options.part == "environment" else measures[options.part](options.device)
    json.dump(result, sys.stdout, indent=1)


if __name__ == "__main__":
    main()
