"""Launch of Warp kernels: in one piece on a GPU, in ranges of several threads on a CPU.

A kernel takes the first index of its range as its first argument and adds `wp.tid()` to it. Warp's kernels release
the interpreter's lock, but its atomic operations are not atomic on a CPU: ranges that may write to one place
belong to one thread. Gradients that many pixels add to a vertex are therefore split between objects.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

# Types of kernel arguments.
Floats, Ints, Longs, Mat33ds, Mat33fs, Vec2ds, Vec2fs, Vec3ds, Vec3fs, Vec3is, Vec4ds, Vec4fs, Vec4is, Words = (
    wp.array(dtype=t)
    for t in (
        wp.float32,
        wp.int32,
        wp.int64,
        wp.mat33d,
        wp.mat33f,
        wp.vec2d,
        wp.vec2f,
        wp.vec3d,
        wp.vec3f,
        wp.vec3i,
        wp.vec4d,
        wp.vec4f,
        wp.vec4i,
        wp.uint64,
    )
)
Bytes2D, Floats2D, Ints2D, Longs2D = (wp.array2d(dtype=t) for t in (wp.uint8, wp.float32, wp.int32, wp.int64))
Floats3D = wp.array3d(dtype=wp.float32)

_MIN_PIXELS = 32768
"""Least pixels (some 10 ns each) for a second thread: waking one takes up to 150 microseconds. Work of several
kernels is handed over once, by `run_in_threads`.
"""


@contextmanager
def suppress_stderr() -> Iterator[None]:
    """Discard what native code writes to standard error."""
    saved, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


@cache
def start_warp() -> None:
    """Initialise Warp silently; every kernel module calls this first."""
    wp.config.quiet = True  # pyright: ignore[reportAttributeAccessIssue]
    wp.config.log_level = 40  # errors only; older versions read `quiet`
    # Otherwise each launch on an x86 CPU puts an arena on its stack and stores its address in one static variable:
    # with several threads, one reads another's pointer, or none, and crashes (Warp 1.19).
    wp.config.enable_tiles_in_stack_memory = None
    # Without a GPU, Warp's native code warns of the missing CUDA driver at any log level.
    with nullcontext() if torch.cuda.is_available() else suppress_stderr():
        wp.init()


@cache
def _pool(process: int) -> ThreadPoolExecutor:  # a forked process has no threads of its parent
    return ThreadPoolExecutor(max_workers=15, thread_name_prefix="warp")


def threads() -> int:
    """Threads that share a launch on the CPU: as many as torch uses, at most 16."""
    return min(torch.get_num_threads(), 16)


def split_range(count: int) -> list[int]:
    """Bounds of about equal ranges of [0, count), one per thread."""
    parts = threads() if count >= _MIN_PIXELS else 1
    return [count * i // parts for i in range(parts + 1)]


def split_by_work(edges: Sequence[int], weights: Sequence[float] | None = None) -> list[int]:
    """Choose from ascending `edges` those that divide the work most evenly between threads.

    weights: work of each range; by default its length.
    """
    work = [float(b - a) for a, b in itertools.pairwise(edges)] if weights is None else list(weights)
    parts, total = threads(), sum(work)
    if parts < 2 or total < _MIN_PIXELS or len(work) < 2:
        return [edges[0], edges[-1]]
    cuts, done, target = [edges[0]], 0.0, total / parts
    for i, share in enumerate(work):
        if len(cuts) < parts and done + share / 2 > target * len(cuts) and edges[i] > cuts[-1]:
            cuts.append(edges[i])
        done += share
    return [*cuts, edges[-1]] if edges[-1] > cuts[-1] else cuts


def load_kernel(kernel: Any) -> None:
    """Compile or load a kernel's module for the CPU before several threads need it."""
    wp.load_module(kernel.module, "cpu")


def run_in_threads(work: Callable[[int, int], None], edges: Sequence[int]) -> None:
    """Call `work(start, end)` for each range between ascending `edges` in its own thread.

    For work on the CPU that launches several kernels in turn; the kernels must be loaded.
    """
    ranges = [(a, b) for a, b in itertools.pairwise(edges) if b > a]
    pool = _pool(os.getpid())
    rest: list[Future[None]] = [pool.submit(work, start, end) for start, end in ranges[1:]]
    for start, end in ranges[:1]:
        work(start, end)
    for future in rest:
        future.result()


def launch(
    kernel: Any, edges: Sequence[int], arguments: Sequence[Any], device: torch.device | None = None
) -> None:
    """Run a kernel over ranges of indices: in torch's stream on a GPU, else in one thread per range.

    Args:
        kernel: Warp kernel; its first argument is the first index.
        edges: Ascending bounds of the ranges.
        arguments: Arguments after the first index.
        device: Device of the arrays; by default that of the first array.
    """
    if len(edges) < 2 or edges[-1] <= edges[0]:
        return
    if device is None:
        device = torch.device(wp.device_to_torch(next(i.device for i in arguments if isinstance(i, wp.array))))
    if device.type != "cpu":
        where, stream = wp.device_from_torch(device), wp.stream_from_torch(device)
        _launch_range(kernel, edges[0], edges[-1] - edges[0], arguments, where, stream)
        return
    if len(edges) > 2:
        load_kernel(kernel)
    run_in_threads(lambda start, end: _launch_range(kernel, start, end - start, arguments, "cpu", None), edges)


def _launch_range(kernel: Any, start: int, count: int, arguments: Sequence[Any], device: Any, stream: Any) -> None:
    wp.launch(kernel, dim=count, inputs=[start, *arguments], device=device, stream=stream)


def array(values: Tensor, dtype: Any = None) -> Any:
    """A tensor as a Warp array, without a copy; the array keeps the tensor alive.

    A frame passes some two hundred tensors to kernels, and Warp's own conversion takes longer than some kernels.
    It runs once per dtype and row shape here; later arrays are copies of its result.
    """
    key = values.dtype, dtype, values.shape[1:]
    template = _array_templates.get(key)
    if template is not None and values.is_contiguous():
        kind, head = template
        warp_array = kind.from_buffer_copy(head)
        warp_array.data = values.data_ptr()
        warp_array.shape[0] = values.shape[0]
        warp_array._ref = values
        return warp_array
    warp_array: Any = wp.from_torch(values.detach(), dtype=dtype, requires_grad=False, return_ctype=True)
    # Warp turns a single vector into an array of one: only an array's number of rows can be replaced.
    if template is None and values.ndim and values.is_contiguous() and warp_array.shape[0] == values.shape[0] > 1:
        _array_templates[key] = type(warp_array), bytes(warp_array)
    return warp_array


_array_templates: dict[tuple[torch.dtype, Any, torch.Size], tuple[Any, bytes]] = {}
"""Warp's array type and bytes, by the tensor's dtype, the kernel's dtype, and the shape of a row."""


class KernelStruct:
    """A Warp struct of arrays in the form that is fastest to build; keeps the tensors alive."""

    def __init__(self, kind: Any) -> None:
        self._kind, self._ctype = kind, kind.ctype()
        self._held: dict[str, Tensor] = {}

    def __ctype__(self) -> Any:
        return self._ctype

    def set_array(self, name: str, values: Tensor) -> None:
        """Set the array field `name`."""
        self._held[name] = values
        setattr(self._ctype, name, array(values, self._kind.vars[name].type.dtype))


def make_struct(kind: Any, *tensors: Tensor) -> KernelStruct:
    """A struct with one array per tensor, in the order of its fields."""
    out = KernelStruct(kind)
    for name, values in zip(kind.vars, tensors, strict=True):
        out.set_array(name, values)
    return out
