"""A network as layers whose reach is known, read from its modules by torch.fx.

What joins channels is never computed: a value is a tuple of layers whose channels follow each other, and a
convolution takes each by its own part of the weights. Normalisation goes into the convolution before it,
rectifiers into what they follow, and after a maximum rather than before it, where there is less to rectify.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.fx
import torch.nn.functional as F
from torch import Tensor, nn

from detectors.convolving import Ordered, ordered, phases
from detectors.incremental.regions import Span


class UntraceableError(ValueError):
    """A network that has something whose reach is not known."""


@dataclass(eq=False)
class Layer:
    """One of a network's layers. sources: what it takes; channels: of what it gives."""

    sources: list[Layer]
    channels: int

    def size(self, hw: tuple[int, int]) -> tuple[int, int]:
        """Height and width of what it gives for a source of that size."""
        return hw


@dataclass(eq=False)
class Picture(Layer):
    """The padded picture."""


@dataclass(eq=False)
class Sliding(Layer):
    """A window that slides over padded sources. padding: (top, bottom, left, right), may be negative nowhere;
    slope: below 0, of a rectifier that follows; None for none.
    """

    kernel: tuple[int, int]
    stride: tuple[int, int]
    padding: tuple[int, int, int, int]
    dilation: tuple[int, int]
    slope: float | None = None

    @property
    def span(self) -> Span:
        extent = tuple((k - 1) * d + 1 for k, d in zip(self.kernel, self.dilation, strict=True))
        return Span((extent[0], extent[1]), self.stride, (self.padding[0], self.padding[2]))

    def size(self, hw: tuple[int, int]) -> tuple[int, int]:
        around = (self.padding[0] + self.padding[1], self.padding[2] + self.padding[3])
        sides = [
            self._count(side + p - extent, stride) + 1
            for side, p, extent, stride in zip(hw, around, self.span.extent, self.stride, strict=True)
        ]
        return sides[0], sides[1]

    def _count(self, room: int, stride: int) -> int:
        return room // stride


@dataclass(eq=False)
class Convolved(Sliding):
    """weight (O, I / groups, k, l), bias (O,) or None. The sources' channels follow each other."""

    weight: Tensor = field(default_factory=lambda: torch.empty(0))
    bias: Tensor | None = None
    groups: int = 1

    @property
    def plain(self) -> bool:
        """Whether oneDNN's way takes it, in both directions."""
        square = self.kernel[0] == self.kernel[1] and self.stride[0] == self.stride[1]
        return square and self.groups == 1 and self.dilation == (1, 1)


@dataclass(eq=False)
class Pooled(Sliding):
    """A maximum. ceil: whether windows may reach beyond the last row and column."""

    ceil: bool = False

    def _count(self, room: int, stride: int) -> int:
        return -(-room // stride) if self.ceil else room // stride


@dataclass(eq=False)
class Each(Layer):
    """A function that treats each place by itself, of the sources in the order of `call`'s arguments. sum: whether
    it is their sum.
    """

    call: Callable[..., Tensor]
    sum: bool = False


@dataclass(eq=False)
class Rectified(Layer):
    """A rectifier of that slope below 0."""

    slope: float


@dataclass(eq=False)
class Scaled(Layer):
    """Channel by channel times scale (C,), plus shift (C,)."""

    scale: Tensor
    shift: Tensor


@dataclass(eq=False)
class Enlarged(Layer):
    """`factor` times as large; nearest or bilinear, corners not aligned."""

    factor: int
    mode: str

    def size(self, hw: tuple[int, int]) -> tuple[int, int]:
        return hw[0] * self.factor, hw[1] * self.factor


@dataclass(frozen=True, slots=True)
class Parts:
    """A value: layers whose channels follow each other. padding: (top, bottom, left, right) around it, of that
    fill, which the next layer takes in.
    """

    layers: tuple[Layer, ...]
    padding: tuple[int, int, int, int] = (0, 0, 0, 0)
    fill: float = 0.0

    @property
    def channels(self) -> int:
        return sum(layer.channels for layer in self.layers)

    def whole(self, what: str) -> tuple[Layer, ...]:
        """The layers of a value without padding."""
        if any(self.padding):
            raise UntraceableError(f"padding before {what}")
        return self.layers

    def one(self, what: str) -> Layer:
        """One layer that gives them all."""
        layers = self.whole(what)
        return layers[0] if len(layers) == 1 else Each(list(layers), self.channels, _concatenated)


@dataclass(frozen=True, slots=True)
class Kernel:
    """A convolution's weights as they are used: of a plain one `weights` and `back` (see `convolving.phases`) of
    each source; else none, and the layer's own are taken.
    """

    weights: tuple[Tensor | Ordered, ...]
    back: tuple[Tensor | Ordered, ...]
    bias: Tensor | None

    @classmethod
    def of(cls, layer: Convolved) -> Kernel:
        counts = [source.channels for source in layer.sources]
        if not layer.plain:
            return cls((), (), layer.bias)
        parts = layer.weight.detach().split(counts, 1)
        return cls(
            tuple(ordered(part.contiguous()) for part in parts),
            tuple(ordered(phases(part, layer.stride[0])) for part in parts),
            layer.bias,
        )


@dataclass(frozen=True, slots=True)
class Graph:
    """Layers in an order in which each comes after its sources, the first the picture; what is given back; the
    kernels of the convolutions.
    """

    layers: tuple[Layer, ...]
    outputs: tuple[Layer, ...]
    kernels: Mapping[Convolved, Kernel]

    @classmethod
    @torch.no_grad()
    def of(cls, network: nn.Module) -> Graph:
        """Of a network in eval mode that takes a batch of pictures with three channels and gives one tensor or
        several. Raises UntraceableError where it is none whose reach is known.
        """
        try:
            traced = torch.fx.symbolic_trace(network)
        except Exception as error:  # it runs the network's own code
            raise UntraceableError(f"torch.fx: {error}") from error
        picture = Picture([], 3)
        given = _Reader(traced).run(Parts((picture,)))
        values = given if isinstance(given, (tuple, list)) else (given,)
        if not all(isinstance(value, Parts) for value in values):
            raise UntraceableError("outputs that are no tensors")
        outputs = _simplified([value.one("an output") for value in values])
        layers = _in_order(picture, outputs)
        kernels = {layer: Kernel.of(layer) for layer in layers if isinstance(layer, Convolved)}
        return cls(layers, tuple(outputs), kernels)


class _Reader(torch.fx.Interpreter):
    """Runs a traced network on `Parts`."""

    def __init__(self, traced: torch.fx.GraphModule) -> None:
        super().__init__(traced)
        self.extra_traceback = False

    def run_node(self, n: torch.fx.Node) -> Any:
        changed = n.args[0] if n.args else None
        in_place = bool(n.kwargs.get("inplace")) or n.target in _IN_PLACE or str(n.target).endswith("_")
        if n.op == "call_module":
            in_place = bool(getattr(self.fetch_attr(str(n.target)), "inplace", False))
        if in_place and isinstance(changed, torch.fx.Node) and len(changed.users) > 1:
            raise UntraceableError(f"{n.target}: changes in place what others read")
        return super().run_node(n)

    def call_module(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        module = self.fetch_attr(target)
        for kind, read in _MODULES.items():
            if type(module) is kind and isinstance(args[0], Parts):
                return read(module, args[0])
        raise UntraceableError(f"{target}: {type(module).__name__}")

    def call_function(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if not _told(args, kwargs):
            return super().call_function(target, args, kwargs)
        if target in _FUNCTIONS:
            return _FUNCTIONS[target](*args, **kwargs)
        if target in _EACH:
            return _each(target, args, kwargs)
        raise UntraceableError(getattr(target, "__name__", str(target)))

    def call_method(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if target in _METHODS:
            return self.call_function(_METHODS[target], args, kwargs)
        raise UntraceableError(f"method {target}")


def _told(args: Iterable[Any], kwargs: Mapping[str, Any]) -> bool:
    """Whether any argument is of the picture."""
    flat: list[Any] = []
    for value in (*args, *kwargs.values()):
        flat += value if isinstance(value, (tuple, list)) else [value]
    return any(isinstance(value, Parts) for value in flat)


def _concatenated(*parts: Tensor) -> Tensor:
    return torch.cat(parts, 1)


def _pair(value: Any) -> tuple[int, int]:
    both = (value, value) if isinstance(value, int) else tuple(value)
    return int(both[0]), int(both[-1])


def _plus(padding: tuple[int, int], value: Parts) -> tuple[int, int, int, int]:
    top, bottom, left, right = value.padding
    return top + padding[0], bottom + padding[0], left + padding[1], right + padding[1]


def _convolve(module: nn.Conv2d, value: Parts) -> Parts:
    if module.padding_mode != "zeros":
        raise UntraceableError(f"padding mode {module.padding_mode}")
    padding = module.padding
    if isinstance(padding, str):
        raise UntraceableError(f"padding {padding!r}")
    return _convolution(value, module.weight, module.bias, module.stride, padding, module.dilation, module.groups)


def _convolution(
    value: Parts,
    weight: Tensor,
    bias: Tensor | None = None,
    stride: Any = 1,
    padding: Any = 0,
    dilation: Any = 1,
    groups: int = 1,
) -> Parts:
    if any(value.padding) and value.fill != 0:
        raise UntraceableError("a convolution of what is padded by other than 0")
    layers: list[Layer] = list(value.layers)
    if groups > 1 and len(layers) > 1:
        layers = [Each(layers, value.channels, _concatenated)]
    kernel = int(weight.shape[2]), int(weight.shape[3])
    around = _plus(_pair(padding), value)
    layer = Convolved(
        layers, int(weight.shape[0]), kernel, _pair(stride), around, _pair(dilation),
        weight=weight.detach(), bias=None if bias is None else bias.detach(), groups=groups,
    )  # fmt: skip
    return Parts((layer,))


def _normalise(module: nn.BatchNorm2d, value: Parts) -> Parts:
    if module.running_mean is None or module.running_var is None or module.training:
        raise UntraceableError("normalisation by the batch's own statistics")
    scale = torch.rsqrt(module.running_var + module.eps)
    if module.affine:
        scale = module.weight * scale
    shift = (module.bias if module.affine else 0) - module.running_mean * scale
    layers, counts = value.whole("a normalisation"), [layer.channels for layer in value.layers]
    return Parts(
        tuple(
            Scaled([layer], layer.channels, s, t)
            for layer, s, t in zip(layers, scale.split(counts), shift.split(counts), strict=True)
        )
    )


def _pool(
    value: Parts,
    kernel_size: Any,
    stride: Any = None,
    padding: Any = 0,
    dilation: Any = 1,
    ceil_mode: bool = False,
    return_indices: bool = False,
) -> Parts:
    if any(value.padding) and value.fill != -torch.inf:
        raise UntraceableError("a maximum of what is padded by other than -inf")
    if return_indices:
        raise UntraceableError("a maximum that tells its places")
    around = _plus(_pair(padding), value)
    if ceil_mode and any(around):
        raise UntraceableError("a padded maximum in ceil mode")
    kernel = _pair(kernel_size)
    steps = kernel if stride is None or stride == [] else _pair(stride)
    return Parts(
        tuple(
            Pooled([layer], layer.channels, kernel, steps, around, _pair(dilation), ceil=ceil_mode)
            for layer in value.layers
        )
    )


def _mean(
    value: Parts,
    kernel_size: Any,
    stride: Any = None,
    padding: Any = 0,
    ceil_mode: bool = False,
    count_include_pad: bool = True,
    divisor_override: int | None = None,
) -> Parts:
    """As a convolution, channel by channel."""
    if ceil_mode or divisor_override or (not count_include_pad and _pair(padding) != (0, 0)):
        raise UntraceableError("a mean that counts otherwise at the border")
    kernel = _pair(kernel_size)
    steps = kernel if stride is None or stride == [] else _pair(stride)
    layers = value.whole("a mean")
    return Parts(
        tuple(
            _convolution(
                Parts((layer,)),
                torch.full((layer.channels, 1, *kernel), 1 / (kernel[0] * kernel[1])),
                stride=steps,
                padding=padding,
                groups=layer.channels,
            ).layers[0]
            for layer in layers
        )
    )


def _pad(around: Parts, pad: Sequence[int], mode: str = "constant", value: float | None = None) -> Parts:
    left, right, top, bottom = (*pad, *(0,) * (4 - len(pad)))
    amount = 0.0 if value is None else float(value)
    if mode != "constant" or min(pad) < 0 or len(pad) > 4:
        raise UntraceableError(f"padding {tuple(pad)}, {mode}")
    if any(around.padding) and around.fill != amount:
        raise UntraceableError("padding of two kinds")
    t, b, le, r = around.padding
    return Parts(around.layers, (t + top, b + bottom, le + left, r + right), amount)


def _rectify(value: Parts, slope: float) -> Parts:
    if slope < 0:  # what comes out no longer tells what went in, which gradients need
        raise UntraceableError(f"a rectifier of slope {slope} below 0")
    layers = value.whole("a rectifier")
    return Parts(tuple(Rectified([layer], layer.channels, slope) for layer in layers))


def _enlarge(
    value: Parts,
    size: Any = None,
    scale_factor: Any = None,
    mode: str = "nearest",
    align_corners: bool | None = None,
    recompute_scale_factor: bool | None = None,
    antialias: bool = False,
) -> Parts:
    factors = (0.0, 0.0) if scale_factor is None else scale_factor
    rows, columns = (factors, factors) if isinstance(factors, (int, float)) else factors
    whole = rows == columns and float(rows).is_integer() and rows >= 1
    if size is not None or not whole or mode not in ("nearest", "bilinear") or align_corners or antialias:
        raise UntraceableError(f"interpolation: {mode} by {scale_factor}")
    layers = value.whole("an interpolation")
    return Parts(tuple(Enlarged([layer], layer.channels, int(rows), mode) for layer in layers))


def _cat(values: Sequence[Parts], dim: int = 0) -> Parts:
    if dim not in (1, -3) or not all(isinstance(value, Parts) for value in values):
        raise UntraceableError(f"torch.cat along {dim}")
    return Parts(tuple(layer for value in values for layer in value.whole("torch.cat")))


def _each(function: Callable[..., Tensor], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Parts:
    """Of values and constants; the former must have as many channels."""
    inputs = [value for value in args if isinstance(value, Parts)]
    if any(isinstance(value, Parts) for value in kwargs.values()):
        raise UntraceableError("a value by name")
    for value in args:
        if isinstance(value, Tensor) and (value.ndim > 4 or any(side != 1 for side in value.shape[-2:])):
            raise UntraceableError("a constant that differs from place to place")
    channels = {value.channels for value in inputs}
    if len(channels) > 1 and channels != {1, max(channels)}:
        raise UntraceableError("values of different channels")
    settings = {name: value for name, value in kwargs.items() if name != "inplace"}
    places = [i for i, value in enumerate(args) if isinstance(value, Parts)]

    def call(*tensors: Tensor) -> Tensor:
        filled = list(args)
        for place, tensor in zip(places, tensors, strict=True):
            filled[place] = tensor
        return function(*filled, **settings)

    adds = function in _ADDING and len(inputs) == len(args) and len(channels) == 1 and not settings
    return Parts((Each([value.one("a function of places") for value in inputs], max(channels), call, adds),))


def _module(module: nn.Module, value: Parts) -> Parts:
    """A module that treats each place by itself."""
    inner = module
    if getattr(module, "inplace", False):
        inner = type(module)()
    layer = value.one(type(module).__name__)
    return Parts((Each([layer], layer.channels, inner),))


_MODULES: dict[type[nn.Module], Callable[[Any, Parts], Parts]] = {
    nn.Conv2d: _convolve,
    nn.BatchNorm2d: _normalise,
    nn.MaxPool2d: lambda m, v: _pool(
        v, m.kernel_size, m.stride, m.padding, m.dilation, m.ceil_mode, m.return_indices
    ),
    nn.AvgPool2d: lambda m, v: _mean(
        v, m.kernel_size, m.stride, m.padding, m.ceil_mode, m.count_include_pad, m.divisor_override
    ),
    nn.ReLU: lambda m, v: _rectify(v, 0.0),
    nn.LeakyReLU: lambda m, v: _rectify(v, m.negative_slope),
    nn.Upsample: lambda m, v: _enlarge(v, m.size, m.scale_factor, m.mode, m.align_corners),
    nn.ZeroPad2d: lambda m, v: _pad(v, m.padding),
    nn.Identity: lambda m, v: v,
    nn.Dropout: lambda m, v: _unless_training(m, v),
    nn.Dropout2d: lambda m, v: _unless_training(m, v),
    **dict.fromkeys((nn.SiLU, nn.Hardswish, nn.Hardsigmoid, nn.ReLU6, nn.Mish), _module),
    **dict.fromkeys((nn.Sigmoid, nn.Tanh, nn.GELU, nn.ELU, nn.Softplus, nn.PReLU), _module),
}


def _unless_training(module: nn.Module, value: Parts) -> Parts:
    if module.training:
        raise UntraceableError("dropout in training mode")
    return value


_FUNCTIONS: dict[Any, Callable[..., Parts]] = {
    F.conv2d: _convolution,
    torch.conv2d: _convolution,
    F.max_pool2d: _pool,
    torch.max_pool2d: _pool,
    F.avg_pool2d: _mean,
    F.pad: _pad,
    F.interpolate: _enlarge,
    torch.cat: _cat,
    torch.concat: _cat,
    F.relu: lambda value, inplace=False: _rectify(value, 0.0),
    F.relu_: lambda value: _rectify(value, 0.0),
    torch.relu: lambda value: _rectify(value, 0.0),
    torch.relu_: lambda value: _rectify(value, 0.0),
    F.leaky_relu: lambda value, negative_slope=0.01, inplace=False: _rectify(value, negative_slope),
    F.leaky_relu_: lambda value, negative_slope=0.01: _rectify(value, negative_slope),
}

_EACH = frozenset({
    operator.add, operator.sub, operator.mul, operator.truediv, operator.neg, operator.iadd, operator.imul,
    torch.add, torch.sub, torch.mul, torch.div, torch.sigmoid, torch.tanh, torch.clamp, torch.maximum,
    torch.minimum, F.silu, F.sigmoid, F.tanh, F.hardswish, F.hardsigmoid, F.relu6, F.gelu, F.elu, F.mish,
    F.softplus, F.hardtanh,
})  # fmt: skip
_ADDING = (operator.add, operator.iadd, torch.add)
_IN_PLACE = (operator.iadd, operator.imul)
_METHODS: dict[str, Any] = {
    "add": torch.add, "sub": torch.sub, "mul": torch.mul, "div": torch.div, "relu": torch.relu,
    "sigmoid": torch.sigmoid, "tanh": torch.tanh, "clamp": torch.clamp, "relu_": torch.relu,
    "add_": torch.add, "mul_": torch.mul,
}  # fmt: skip


def _consumers(outputs: Sequence[Layer]) -> dict[Layer, list[Layer]]:
    """Who takes each layer; an output is taken by itself too."""
    found: dict[Layer, list[Layer]] = {}
    for layer in _in_order(None, outputs):
        for source in layer.sources:
            found.setdefault(source, []).append(layer)
    for output in outputs:
        found.setdefault(output, []).append(output)
    return found


def _simplified(outputs: list[Layer]) -> list[Layer]:
    """The same with what can be folded: see the module."""
    while True:
        takers = _consumers(outputs)
        replaced: dict[Layer, Layer] = {}
        for layer in _in_order(None, outputs):
            if not layer.sources or len(takers[layer.sources[0]]) > 1:
                continue
            source = layer.sources[0]
            if source in replaced:
                continue
            if isinstance(layer, Scaled) and isinstance(source, Convolved) and source.slope is None:
                source.weight = source.weight * layer.scale[:, None, None, None]
                source.bias = layer.shift if source.bias is None else source.bias * layer.scale + layer.shift
                replaced[layer] = source
            elif isinstance(layer, Rectified) and isinstance(source, Sliding) and source.slope is None:
                source.slope = layer.slope
                replaced[layer] = source
            elif isinstance(layer, Pooled) and layer.slope is None and _rises(source):
                if isinstance(source, Rectified):
                    layer.slope, layer.sources = source.slope, source.sources
                else:
                    assert isinstance(source, Sliding)
                    layer.slope, source.slope = source.slope, None
        if not replaced:
            return outputs
        for layer in _in_order(None, outputs):
            layer.sources = [replaced.get(source, source) for source in layer.sources]
        outputs = [replaced.get(output, output) for output in outputs]


def _rises(layer: Layer) -> bool:
    """Whether it ends in a rectifier: that keeps the order of numbers."""
    return isinstance(layer, (Rectified, Sliding)) and layer.slope is not None


def _in_order(picture: Layer | None, outputs: Sequence[Layer]) -> tuple[Layer, ...]:
    """All that the outputs are made of, each after its sources."""
    found: dict[Layer, None] = {} if picture is None else {picture: None}
    waiting = [(output, False) for output in reversed(outputs)]
    while waiting:
        layer, ready = waiting.pop()
        if layer in found:
            continue
        if ready:
            found[layer] = None
        else:
            waiting.append((layer, True))
            waiting += [(source, False) for source in reversed(layer.sources)]
    return tuple(found)
