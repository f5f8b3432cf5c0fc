"""A GPU that is pretended: tensors that are made for "cuda" lie on the processor and say that they do not.

What a real one refuses is refused here: operations whose tensors lie on both, a kernel's array that lies
elsewhere, NumPy's view of one. So whoever has no GPU finds what was forgotten where one is meant.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves

from scene_ir.raster import launch

GPU, CPU = torch.device("cuda:0"), torch.device("cpu")
_EITHER = torch.device("meta")
"""Of what torch itself makes within an operation, such as zeros for a gradient that is missing: it lies where it
is needed."""
_WARPS_GPU = SimpleNamespace(is_cuda=True)
_MADE = (
    "zeros",
    "ones",
    "empty",
    "full",
    "arange",
    "linspace",
    "eye",
    "rand",
    "randn",
    "randint",
    "randperm",
    "tensor",
)
_ANY_INDEX = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")
_COPIES = ("aten::copy_", "aten::_to_copy", "aten::_copy_from")
_NO_SCALARS = ("aten::cat", "aten::stack")
_WAITS = {f"aten::{name}" for name in ("equal", "nonzero", "masked_select", "bincount", "_unique2", "unique_dim")}
"""What the processor waits for: it needs the value, or the size, of the result."""
_NO_KERNEL = {
    f"aten::{name}" for name in ("empty", "empty_like", "new_empty", "empty_strided", "detach", "record")
}
_ROOT = f"{Path(__file__).parents[1]}/"


@dataclass
class GpuTraffic:
    """What a GPU was asked to do, by the project's line that asked; of `pretended`."""

    waits: Counter[str] = field(default_factory=Counter)
    """The processor waited for it; with torch it does so for every copy that is not asynchronous."""
    copies: Counter[str] = field(default_factory=Counter)
    """Tensors and numbers copied to or from it."""
    launches: Counter[str] = field(default_factory=Counter)
    """Kernels of Warp."""
    operations: Counter[str] = field(default_factory=Counter)
    """Operations of torch with at least one kernel."""

    def totals(self) -> dict[str, int]:
        """Sums over all lines."""
        return {entry.name: sum(getattr(self, entry.name).values()) for entry in fields(self)}

    def clear(self) -> None:
        """Start anew."""
        for entry in fields(self):
            getattr(self, entry.name).clear()


_traffic = GpuTraffic()


def _line() -> str:
    frame = sys._getframe(1)
    while frame is not None:
        path = frame.f_code.co_filename.removeprefix(_ROOT)
        if not path.startswith(("/", "tests", "<")):
            return f"{path}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"


def _count_copy(waits: bool = True) -> None:
    _traffic.copies[_line()] += 1
    _traffic.waits[_line()] += waits


def place(tensor: Tensor) -> torch.device:
    """Where a tensor is said to lie."""
    return getattr(_storage(tensor), "pretended", CPU)


def _put(tensor: Tensor, where: torch.device) -> None:
    storage = _storage(tensor)
    if storage is not None:
        storage.pretended = where


def _storage(tensor: Tensor) -> Any:
    """None of oneDNN's weights, which only the processor has."""
    with torch._C.DisableTorchFunction():
        return None if tensor.is_mkldnn else tensor.untyped_storage()


class _Move(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, where: torch.device, waits: bool = True) -> Tensor:
        ctx.back = place(tensor)
        with _disable_current_modes():
            moved = tensor.clone()
        _count_copy(waits)
        _put(moved, where)
        return moved

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        return _moved(grads[0], ctx.back), None, None


def _moved(tensor: Tensor, where: torch.device, waits: bool = True) -> Tensor:
    return tensor if place(tensor) == where else _Move.apply(tensor, where, waits)  # pyright: ignore


class _Operations(TorchDispatchMode):
    """Every operation, those of gradients too: which of its tensors lie where."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        name = func._schema.name
        there = [t for t in given if place(t) == GPU]
        if there and name not in _COPIES:
            self._check(name, given)
        outcome = func(*args, **(kwargs or {}))
        own = [t for t in given if t.ndim] or given
        first = own[0] if name in _ANY_INDEX or name in _COPIES else None
        where = place(first) if first is not None else GPU if there else CPU if given else _EITHER
        known, computes = {id(_storage(t)) for t in given}, func._schema.is_mutable
        for leaf in tree_leaves(outcome):
            if isinstance(leaf, Tensor) and id(_storage(leaf)) not in known:
                _put(leaf, where)
                computes = True
        if there:
            self._count(name, args, given, computes)
        return outcome

    def _count(self, name: str, args: Any, given: list[Tensor], computes: bool) -> None:
        indices = tree_leaves(args[1]) if name in _ANY_INDEX else []
        if name == "aten::_local_scalar_dense":
            _count_copy()
        elif name in _WAITS or any(isinstance(i, Tensor) and i.dtype == torch.bool for i in indices):
            _traffic.waits[_line()] += 1
        if name in _COPIES and len({place(t) for t in given}) > 1:
            _count_copy(waits=args[2:] != (True,))
        elif computes and name not in _NO_KERNEL:
            _traffic.operations[_line()] += 1

    def _check(self, name: str, given: list[Tensor]) -> None:
        if name in _ANY_INDEX:
            given = [given[0]] if place(given[0]) == GPU else given
        for tensor in given:
            if place(tensor) == CPU and (tensor.ndim or name in _NO_SCALARS):
                raise RuntimeError(f"{name}: expected all tensors on the same device, found cuda:0 and cpu")


class _Calls(TorchFunctionMode):
    """Devices requested by name: devices of new tensors, moves, and where a tensor lies."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name, of = getattr(func, "__name__", ""), getattr(func, "__self__", None)
        if name == "__get__" and of is torch.Tensor.device:
            return CPU if place(args[0]) == _EITHER else place(args[0])
        if name == "__get__" and of is torch.Tensor.is_cuda:
            return place(args[0]) == GPU
        if name in ("numpy", "__array__") and place(args[0]) == GPU:
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        if name == "tolist" and place(args[0]) == GPU:
            _count_copy()
        if name == "cpu":
            return _moved(args[0], CPU)
        if name == "cuda":
            return _moved(args[0], GPU)
        if name == "to":
            return self._to(func, args, kwargs)
        requested = place(args[0]) if name == "new_tensor" and "device" not in kwargs else kwargs.get("device")
        if requested is None and name in _MADE:
            requested = CPU
        if requested is None or name == "_parse_to":
            return func(*args, **kwargs)
        kwargs["device"] = CPU
        outcome = func(*args, **kwargs)
        where = _device(requested)
        if name == "as_tensor" and isinstance(args[0], Tensor):
            return _moved(outcome, where)
        if isinstance(outcome, Tensor):
            _put(outcome, where)
            if where == GPU and name in ("tensor", "new_tensor", "as_tensor"):
                _count_copy()
        return outcome

    def _to(self, func: Any, args: Any, kwargs: dict[str, Any]) -> Tensor:
        tensor, where, rest = args[0], place(args[0]), []
        requested = kwargs.pop("device", None)
        other = kwargs.pop("other", None)
        waits = not kwargs.pop("non_blocking", False)
        for value in args[1:]:
            if isinstance(value, Tensor):
                other = value
            elif isinstance(value, str | torch.device):
                requested = value
            elif not isinstance(value, bool):  # whether to wait for it, or to copy
                rest.append(value)
        if other is not None:
            where, rest = place(other), [other.dtype, *rest]
        if requested is not None:
            where = _device(requested)
        rest = [value for value in rest if value is not None]
        changed = func(tensor, *rest, **kwargs) if rest or kwargs else tensor
        return _moved(changed, where, waits)


def _device(requested: Any) -> torch.device:
    return GPU if torch.device(requested).type == "cuda" else CPU


class _Kernels:
    """Warp's arrays and launches: of tensors that are said to lie on the GPU, run by the processor."""

    def __init__(self) -> None:
        self._array, self._run = launch.wp.from_torch, launch._launch_range

    def array(self, tensor: Tensor, *args: Any, **kwargs: Any) -> Any:
        where = place(tensor)
        with torch._C.DisableTorchFunction():
            made = self._array(tensor, *args, **kwargs)
        if where == GPU and isinstance(made, launch.wp.array):
            made.device = _WARPS_GPU
        return made

    def run(self, kernel: Any, start: int, count: int, inputs: Any, device: Any, stream: Any) -> None:
        where, arrays = GPU if device == GPU else CPU, []
        for value in inputs:
            if isinstance(value, launch.wp.array) and value.device is _WARPS_GPU:
                arrays.append(value)
            held = getattr(value, "_held", None)
            for tensor in (
                held.values() if held is not None else [getattr(value, "_tensor", getattr(value, "_ref", None))]
            ):
                if isinstance(tensor, Tensor) and tensor.numel() and place(tensor) != where:
                    raise RuntimeError(f"{kernel.key}: an array lies on {place(tensor)}, the kernel on {where}")
        for value in arrays:
            value.device = launch.wp.get_device("cpu")
        _traffic.launches[_line()] += where == GPU
        self._run(kernel, start, count, inputs, "cpu", None)
        for value in arrays:
            value.device = _WARPS_GPU


@contextmanager
def pretended() -> Iterator[GpuTraffic]:
    """While it lasts, there is a GPU; what it is asked to do is counted."""
    _traffic.clear()
    kernels, to_torch, engine = _Kernels(), launch.wp.device_to_torch, torch.autograd._engine_run_backward

    def backward(*args: Any, **kwargs: Any) -> Any:
        with _Calls():  # which torch switches off while it looks for gradients
            return engine(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(launch, "_launch_range", kernels.run)
        patch.setattr(launch.wp, "from_torch", kernels.array)
        patch.setattr(launch.wp, "device_from_torch", lambda device: device)
        patch.setattr(
            launch.wp, "device_to_torch", lambda device: "cuda:0" if device is _WARPS_GPU else to_torch(device)
        )
        patch.setattr(launch.wp, "stream_from_torch", lambda device: None)
        patch.setattr(torch.cuda, "synchronize", lambda *_: None)
        patch.setattr(torch.cuda, "get_device_name", lambda *_: "pretended")
        patch.setattr(torch.autograd, "_engine_run_backward", backward)
        with _Calls(), _Operations():
            yield _traffic
