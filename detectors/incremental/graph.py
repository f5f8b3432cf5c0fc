"""A network as a graph of layers with known receptive fields, traced by torch.fx.

Concatenation along the channels is never computed: a value is a tuple of layers, and a convolution applies a part
of its weights to each. Normalisation is folded into the preceding convolution, rectifiers into the preceding
layer; a rectifier before a maximum moves behind it, where there is less to rectify.
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

from detectors.convolution import OneDnnWeights, gradient_weights, order_weights
from detectors.incremental.regions import ReceptiveField


class UntraceableError(ValueError):
    """A network with an operation of unknown receptive field."""


@dataclass(eq=False)
class NetworkLayer:
    """One layer."""

    sources: list[NetworkLayer]
    """Its inputs."""
    channels: int
    """Number of output channels."""

    def output_hw(self, hw: tuple[int, int]) -> tuple[int, int]:
        """Height and width of the output for inputs of that size."""
        return hw


@dataclass(eq=False)
class InputLayer(NetworkLayer):
    """The padded image."""


@dataclass(eq=False)
class WindowOp(NetworkLayer):
    """A window that slides over the padded inputs."""

    kernel: tuple[int, int]
    """Rows, columns."""
    stride: tuple[int, int]
    """Rows, columns."""
    padding: tuple[int, int, int, int]
    """Top, bottom, left, right; not negative."""
    dilation: tuple[int, int]
    """Rows, columns."""
    slope: float | None = None
    """Negative slope of a following rectifier; None for none."""

    @property
    def receptive_field(self) -> ReceptiveField:
        """The input rows and columns of each output."""
        extent = tuple((k - 1) * d + 1 for k, d in zip(self.kernel, self.dilation, strict=True))
        return ReceptiveField((extent[0], extent[1]), self.stride, (self.padding[0], self.padding[2]))

    def output_hw(self, hw: tuple[int, int]) -> tuple[int, int]:
        total_padding = (self.padding[0] + self.padding[1], self.padding[2] + self.padding[3])
        sides = [
            self._count(side + p - extent, stride) + 1
            for side, p, extent, stride in zip(
                hw, total_padding, self.receptive_field.extent, self.stride, strict=True
            )
        ]
        return sides[0], sides[1]

    def _count(self, room: int, stride: int) -> int:
        return room // stride


@dataclass(eq=False)
class Convolution(WindowOp):
    """A convolution of the inputs, concatenated along the channels."""

    weight: Tensor = field(default_factory=lambda: torch.empty(0))
    """(O, I / groups, k, l)."""
    bias: Tensor | None = None
    """(O,) or None."""
    groups: int = 1
    """Number of groups."""

    @property
    def uses_onednn(self) -> bool:
        """Whether `detectors.convolution` supports it, forward and backward."""
        square = self.kernel[0] == self.kernel[1] and self.stride[0] == self.stride[1]
        return square and self.groups == 1 and self.dilation == (1, 1)


@dataclass(eq=False)
class MaxPool(WindowOp):
    """A maximum."""

    ceil_mode: bool = False
    """Whether windows may extend beyond the last row and column."""

    def _count(self, room: int, stride: int) -> int:
        return -(-room // stride) if self.ceil_mode else room // stride


@dataclass(eq=False)
class PointwiseOp(NetworkLayer):
    """A function of each place alone."""

    call: Callable[..., Tensor]
    """Maps the inputs, in order, to the output."""
    is_sum: bool = False
    """Whether it is the inputs' sum."""


@dataclass(eq=False)
class Rectifier(NetworkLayer):
    """A leaky rectifier."""

    slope: float
    """Negative slope."""


@dataclass(eq=False)
class ChannelAffine(NetworkLayer):
    """Scale and shift per channel."""

    scale: Tensor
    """(C,)."""
    shift: Tensor
    """(C,)."""


@dataclass(eq=False)
class Upsample(NetworkLayer):
    """Upsampling by a whole factor, without aligned corners."""

    scale_factor: int
    """In both directions."""
    mode: str
    """nearest or bilinear."""

    def output_hw(self, hw: tuple[int, int]) -> tuple[int, int]:
        return hw[0] * self.scale_factor, hw[1] * self.scale_factor


@dataclass(frozen=True, slots=True)
class ConcatenatedLayers:
    """A value: layers concatenated along the channels, with padding for the next layer to include."""

    layers: tuple[NetworkLayer, ...]
    """In channel order."""
    padding: tuple[int, int, int, int] = (0, 0, 0, 0)
    """Top, bottom, left, right."""
    fill: float = 0.0
    """Value of the padding."""

    @property
    def channels(self) -> int:
        """Number of channels."""
        return sum(layer.channels for layer in self.layers)

    def unpadded_layers(self, what: str) -> tuple[NetworkLayer, ...]:
        """The layers of a value without padding; `what` names the next operation in the error."""
        if any(self.padding):
            raise UntraceableError(f"padding before {what}")
        return self.layers

    def joined_layer(self, what: str) -> NetworkLayer:
        """A single layer with all channels."""
        layers = self.unpadded_layers(what)
        return layers[0] if len(layers) == 1 else PointwiseOp(list(layers), self.channels, _concatenate)


@dataclass(frozen=True, slots=True)
class ConvolutionWeights:
    """A convolution's weights as used; empty if the layer's own are used."""

    forward: tuple[Tensor | OneDnnWeights, ...]
    """Of each source."""
    backward: tuple[Tensor | OneDnnWeights, ...]
    """For the gradient of each source (see `convolution.gradient_weights`)."""
    bias: Tensor | None
    """(O,) or None."""

    @classmethod
    def from_layer(cls, layer: Convolution) -> ConvolutionWeights:
        """The weights of a layer."""
        counts = [source.channels for source in layer.sources]
        if not layer.uses_onednn:
            return cls((), (), layer.bias)
        parts = layer.weight.detach().split(counts, 1)
        return cls(
            tuple(order_weights(part.contiguous()) for part in parts),
            tuple(order_weights(gradient_weights(part, layer.stride[0])) for part in parts),
            layer.bias,
        )


@dataclass(frozen=True, slots=True)
class LayerGraph:
    """Layers in topological order, beginning with the input."""

    layers: tuple[NetworkLayer, ...]
    """All layers."""
    outputs: tuple[NetworkLayer, ...]
    """The network's outputs."""
    weights: Mapping[Convolution, ConvolutionWeights]
    """Of each convolution."""

    @classmethod
    @torch.no_grad()
    def trace(cls, network: nn.Module) -> LayerGraph:
        """Trace a network in eval mode that maps images with three channels to one or several tensors.

        Raises:
            UntraceableError: Some operation has an unknown receptive field.
        """
        try:
            traced = torch.fx.symbolic_trace(network)
        except Exception as error:  # tracing runs the network's code
            raise UntraceableError(f"torch.fx: {error}") from error
        input_layer = InputLayer([], 3)
        given = _LayerTracer(traced).run(ConcatenatedLayers((input_layer,)))
        values = given if isinstance(given, (tuple, list)) else (given,)
        if not all(isinstance(value, ConcatenatedLayers) for value in values):
            raise UntraceableError("outputs other than tensors")
        outputs = _simplify([value.joined_layer("an output") for value in values])
        layers = _topological_order(input_layer, outputs)
        kernels = {
            layer: ConvolutionWeights.from_layer(layer) for layer in layers if isinstance(layer, Convolution)
        }
        return cls(layers, tuple(outputs), kernels)


class _LayerTracer(torch.fx.Interpreter):
    """Runs a traced network on `ConcatenatedLayers`."""

    def __init__(self, traced: torch.fx.GraphModule) -> None:
        super().__init__(traced)
        self.extra_traceback = False

    def run_node(self, n: torch.fx.Node) -> Any:
        changed = n.args[0] if n.args else None
        in_place = bool(n.kwargs.get("inplace")) or n.target in _IN_PLACE or str(n.target).endswith("_")
        if n.op == "call_module":
            in_place = bool(getattr(self.fetch_attr(str(n.target)), "inplace", False))
        if in_place and isinstance(changed, torch.fx.Node) and len(changed.users) > 1:
            raise UntraceableError(f"{n.target}: changes a shared value in place")
        return super().run_node(n)

    def call_module(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        module = self.fetch_attr(target)
        for kind, read in _MODULES.items():
            if type(module) is kind and isinstance(args[0], ConcatenatedLayers):
                return read(module, args[0])
        raise UntraceableError(f"{target}: {type(module).__name__}")

    def call_function(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if not _depends_on_image(args, kwargs):
            return super().call_function(target, args, kwargs)
        if target in _FUNCTIONS:
            return _FUNCTIONS[target](*args, **kwargs)
        if target in _POINTWISE:
            return _pointwise(target, args, kwargs)
        raise UntraceableError(getattr(target, "__name__", str(target)))

    def call_method(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if target in _METHODS:
            return self.call_function(_METHODS[target], args, kwargs)
        raise UntraceableError(f"method {target}")


def _depends_on_image(args: Iterable[Any], kwargs: Mapping[str, Any]) -> bool:
    """Whether any argument depends on the image."""
    flat: list[Any] = []
    for value in (*args, *kwargs.values()):
        flat += value if isinstance(value, (tuple, list)) else [value]
    return any(isinstance(value, ConcatenatedLayers) for value in flat)


def _concatenate(*parts: Tensor) -> Tensor:
    return torch.cat(parts, 1)


def _pair(value: Any) -> tuple[int, int]:
    both = (value, value) if isinstance(value, int) else tuple(value)
    return int(both[0]), int(both[-1])


def _add_padding(padding: tuple[int, int], value: ConcatenatedLayers) -> tuple[int, int, int, int]:
    top, bottom, left, right = value.padding
    return top + padding[0], bottom + padding[0], left + padding[1], right + padding[1]


def _convolve(module: nn.Conv2d, value: ConcatenatedLayers) -> ConcatenatedLayers:
    if module.padding_mode != "zeros":
        raise UntraceableError(f"padding mode {module.padding_mode}")
    padding = module.padding
    if isinstance(padding, str):
        raise UntraceableError(f"padding {padding!r}")
    return _convolution(value, module.weight, module.bias, module.stride, padding, module.dilation, module.groups)


def _convolution(
    value: ConcatenatedLayers,
    weight: Tensor,
    bias: Tensor | None = None,
    stride: Any = 1,
    padding: Any = 0,
    dilation: Any = 1,
    groups: int = 1,
) -> ConcatenatedLayers:
    if any(value.padding) and value.fill != 0:
        raise UntraceableError("a convolution of a value padded with other than 0")
    layers: list[NetworkLayer] = list(value.layers)
    if groups > 1 and len(layers) > 1:
        layers = [PointwiseOp(layers, value.channels, _concatenate)]
    kernel = int(weight.shape[2]), int(weight.shape[3])
    total_padding = _add_padding(_pair(padding), value)
    layer = Convolution(
        layers, int(weight.shape[0]), kernel, _pair(stride), total_padding, _pair(dilation),
        weight=weight.detach(), bias=None if bias is None else bias.detach(), groups=groups,
    )  # fmt: skip
    return ConcatenatedLayers((layer,))


def _normalise(module: nn.BatchNorm2d, value: ConcatenatedLayers) -> ConcatenatedLayers:
    if module.running_mean is None or module.running_var is None or module.training:
        raise UntraceableError("normalisation by the batch's own statistics")
    scale = torch.rsqrt(module.running_var + module.eps)
    if module.affine:
        scale = module.weight * scale
    shift = (module.bias if module.affine else 0) - module.running_mean * scale
    layers, counts = value.unpadded_layers("a normalisation"), [layer.channels for layer in value.layers]
    return ConcatenatedLayers(
        tuple(
            ChannelAffine([layer], layer.channels, s, t)
            for layer, s, t in zip(layers, scale.split(counts), shift.split(counts), strict=True)
        )
    )


def _pool(
    value: ConcatenatedLayers,
    kernel_size: Any,
    stride: Any = None,
    padding: Any = 0,
    dilation: Any = 1,
    ceil_mode: bool = False,
    return_indices: bool = False,
) -> ConcatenatedLayers:
    if any(value.padding) and value.fill != -torch.inf:
        raise UntraceableError("a maximum of a value padded with other than -inf")
    if return_indices:
        raise UntraceableError("a maximum with indices")
    total_padding = _add_padding(_pair(padding), value)
    if ceil_mode and any(total_padding):
        raise UntraceableError("a padded maximum in ceil mode")
    kernel = _pair(kernel_size)
    steps = kernel if stride is None or stride == [] else _pair(stride)
    return ConcatenatedLayers(
        tuple(
            MaxPool([layer], layer.channels, kernel, steps, total_padding, _pair(dilation), ceil_mode=ceil_mode)
            for layer in value.layers
        )
    )


def _average_pool(
    value: ConcatenatedLayers,
    kernel_size: Any,
    stride: Any = None,
    padding: Any = 0,
    ceil_mode: bool = False,
    count_include_pad: bool = True,
    divisor_override: int | None = None,
) -> ConcatenatedLayers:
    """Average pooling as a convolution per channel."""
    if ceil_mode or divisor_override or (not count_include_pad and _pair(padding) != (0, 0)):
        raise UntraceableError("average pooling with another divisor at the border")
    kernel = _pair(kernel_size)
    steps = kernel if stride is None or stride == [] else _pair(stride)
    layers = value.unpadded_layers("average pooling")
    return ConcatenatedLayers(
        tuple(
            _convolution(
                ConcatenatedLayers((layer,)),
                torch.full((layer.channels, 1, *kernel), 1 / (kernel[0] * kernel[1])),
                stride=steps,
                padding=padding,
                groups=layer.channels,
            ).layers[0]
            for layer in layers
        )
    )


def _pad(
    padded: ConcatenatedLayers, pad: Sequence[int], mode: str = "constant", value: float | None = None
) -> ConcatenatedLayers:
    left, right, top, bottom = (*pad, *(0,) * (4 - len(pad)))
    amount = 0.0 if value is None else float(value)
    if mode != "constant" or min(pad) < 0 or len(pad) > 4:
        raise UntraceableError(f"padding {tuple(pad)}, {mode}")
    if any(padded.padding) and padded.fill != amount:
        raise UntraceableError("padding of two kinds")
    t, b, le, r = padded.padding
    return ConcatenatedLayers(padded.layers, (t + top, b + bottom, le + left, r + right), amount)


def _rectify(value: ConcatenatedLayers, slope: float) -> ConcatenatedLayers:
    if slope < 0:  # the input cannot be recovered from the output, as the gradient requires
        raise UntraceableError(f"a rectifier of slope {slope} below 0")
    layers = value.unpadded_layers("a rectifier")
    return ConcatenatedLayers(tuple(Rectifier([layer], layer.channels, slope) for layer in layers))


def _enlarge(
    value: ConcatenatedLayers,
    size: Any = None,
    scale_factor: Any = None,
    mode: str = "nearest",
    align_corners: bool | None = None,
    recompute_scale_factor: bool | None = None,
    antialias: bool = False,
) -> ConcatenatedLayers:
    factors = (0.0, 0.0) if scale_factor is None else scale_factor
    rows, columns = (factors, factors) if isinstance(factors, (int, float)) else factors
    whole = rows == columns and float(rows).is_integer() and rows >= 1
    if size is not None or not whole or mode not in ("nearest", "bilinear") or align_corners or antialias:
        raise UntraceableError(f"interpolation: {mode} by {scale_factor}")
    layers = value.unpadded_layers("an interpolation")
    return ConcatenatedLayers(tuple(Upsample([layer], layer.channels, int(rows), mode) for layer in layers))


def _cat(values: Sequence[ConcatenatedLayers], dim: int = 0) -> ConcatenatedLayers:
    if dim not in (1, -3) or not all(isinstance(value, ConcatenatedLayers) for value in values):
        raise UntraceableError(f"torch.cat along {dim}")
    return ConcatenatedLayers(tuple(layer for value in values for layer in value.unpadded_layers("torch.cat")))


def _pointwise(
    function: Callable[..., Tensor], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> ConcatenatedLayers:
    """A function of values and constants; the values must have as many channels."""
    inputs = [value for value in args if isinstance(value, ConcatenatedLayers)]
    if any(isinstance(value, ConcatenatedLayers) for value in kwargs.values()):
        raise UntraceableError("a value as keyword argument")
    for value in args:
        if isinstance(value, Tensor) and (value.ndim > 4 or any(side != 1 for side in value.shape[-2:])):
            raise UntraceableError("a constant that varies over the image")
    channels = {value.channels for value in inputs}
    if len(channels) > 1 and channels != {1, max(channels)}:
        raise UntraceableError("values with different numbers of channels")
    settings = {name: value for name, value in kwargs.items() if name != "inplace"}
    places = [i for i, value in enumerate(args) if isinstance(value, ConcatenatedLayers)]

    def call(*tensors: Tensor) -> Tensor:
        filled = list(args)
        for place, tensor in zip(places, tensors, strict=True):
            filled[place] = tensor
        return function(*filled, **settings)

    adds = function in _ADDING and len(inputs) == len(args) and len(channels) == 1 and not settings
    return ConcatenatedLayers(
        (PointwiseOp([value.joined_layer("a pointwise function") for value in inputs], max(channels), call, adds),)
    )


def _pointwise_module(module: nn.Module, value: ConcatenatedLayers) -> ConcatenatedLayers:
    """A module that treats each place separately."""
    inner = module
    if getattr(module, "inplace", False):
        inner = type(module)()
    layer = value.joined_layer(type(module).__name__)
    return ConcatenatedLayers((PointwiseOp([layer], layer.channels, inner),))


_MODULES: dict[type[nn.Module], Callable[[Any, ConcatenatedLayers], ConcatenatedLayers]] = {
    nn.Conv2d: _convolve,
    nn.BatchNorm2d: _normalise,
    nn.MaxPool2d: lambda m, v: _pool(
        v, m.kernel_size, m.stride, m.padding, m.dilation, m.ceil_mode, m.return_indices
    ),
    nn.AvgPool2d: lambda m, v: _average_pool(
        v, m.kernel_size, m.stride, m.padding, m.ceil_mode, m.count_include_pad, m.divisor_override
    ),
    nn.ReLU: lambda m, v: _rectify(v, 0.0),
    nn.LeakyReLU: lambda m, v: _rectify(v, m.negative_slope),
    nn.Upsample: lambda m, v: _enlarge(v, m.size, m.scale_factor, m.mode, m.align_corners),
    nn.ZeroPad2d: lambda m, v: _pad(v, m.padding),
    nn.Identity: lambda m, v: v,
    nn.Dropout: lambda m, v: _unless_training(m, v),
    nn.Dropout2d: lambda m, v: _unless_training(m, v),
    **dict.fromkeys((nn.SiLU, nn.Hardswish, nn.Hardsigmoid, nn.ReLU6, nn.Mish), _pointwise_module),
    **dict.fromkeys((nn.Sigmoid, nn.Tanh, nn.GELU, nn.ELU, nn.Softplus, nn.PReLU), _pointwise_module),
}


def _unless_training(module: nn.Module, value: ConcatenatedLayers) -> ConcatenatedLayers:
    if module.training:
        raise UntraceableError("dropout in training mode")
    return value


_FUNCTIONS: dict[Any, Callable[..., ConcatenatedLayers]] = {
    F.conv2d: _convolution,
    torch.conv2d: _convolution,
    F.max_pool2d: _pool,
    torch.max_pool2d: _pool,
    F.avg_pool2d: _average_pool,
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

_POINTWISE = frozenset({
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


def _consumers(outputs: Sequence[NetworkLayer]) -> dict[NetworkLayer, list[NetworkLayer]]:
    """The consumers of each layer; an output also consumes itself."""
    found: dict[NetworkLayer, list[NetworkLayer]] = {}
    for layer in _topological_order(None, outputs):
        for source in layer.sources:
            found.setdefault(source, []).append(layer)
    for output in outputs:
        found.setdefault(output, []).append(output)
    return found


def _simplify(outputs: list[NetworkLayer]) -> list[NetworkLayer]:
    """The outputs after folding; see the module."""
    while True:
        consumers = _consumers(outputs)
        replaced: dict[NetworkLayer, NetworkLayer] = {}
        for layer in _topological_order(None, outputs):
            if not layer.sources or len(consumers[layer.sources[0]]) > 1:
                continue
            source = layer.sources[0]
            if source in replaced:
                continue
            if isinstance(layer, ChannelAffine) and isinstance(source, Convolution) and source.slope is None:
                source.weight = source.weight * layer.scale[:, None, None, None]
                source.bias = layer.shift if source.bias is None else source.bias * layer.scale + layer.shift
                replaced[layer] = source
            elif isinstance(layer, Rectifier) and isinstance(source, WindowOp) and source.slope is None:
                source.slope = layer.slope
                replaced[layer] = source
            elif isinstance(layer, MaxPool) and layer.slope is None and _ends_in_rectifier(source):
                if isinstance(source, Rectifier):
                    layer.slope, layer.sources = source.slope, source.sources
                else:
                    assert isinstance(source, WindowOp)
                    layer.slope, source.slope = source.slope, None
        if not replaced:
            return outputs
        for layer in _topological_order(None, outputs):
            layer.sources = [replaced.get(source, source) for source in layer.sources]
        outputs = [replaced.get(output, output) for output in outputs]


def _ends_in_rectifier(layer: NetworkLayer) -> bool:
    """Whether it ends in a rectifier, which preserves the order of values."""
    return isinstance(layer, (Rectifier, WindowOp)) and layer.slope is not None


def _topological_order(
    input_layer: NetworkLayer | None, outputs: Sequence[NetworkLayer]
) -> tuple[NetworkLayer, ...]:
    """All layers that the outputs depend on, each after its sources."""
    found: dict[NetworkLayer, None] = {} if input_layer is None else {input_layer: None}
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
