"""Forward and backward pass over the rectangles of a plan, as one autograd function."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from detectors.convolution import convolve, convolve_add, empty_channels_last, mask_gradient, rectify
from detectors.incremental.graph import (
    ChannelAffine,
    Convolution,
    ConvolutionWeights,
    InputLayer,
    LayerGraph,
    MaxPool,
    NetworkLayer,
    PointwiseOp,
    Rectifier,
    Upsample,
    WindowOp,
)
from detectors.incremental.plan import GradientGather, LayerWindow, PlanStep, RecomputePlan
from detectors.incremental.regions import Rect

_MAX_POOL_BACKWARD = torch.ops.aten.max_pool2d_with_indices_backward


@dataclass(frozen=True, slots=True)
class ImageInput:
    """An image inside the padded network input."""

    image: Tensor
    """(1, 3, H, W)."""
    origin: tuple[int, int] = (0, 0)
    """Row and column of its first pixel in the padded image."""
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Subtracted from its channels."""

    def view(self, rect: Rect) -> Tensor:
        """The image in a rectangle of the padded image, which must lie inside the image."""
        top, left = rect.top - self.origin[0], rect.left - self.origin[1]
        return self.image[:, :, top : top + rect.hw[0], left : left + rect.hw[1]]

    def network_input(self, rect: Rect) -> Tensor:
        """The network's input there."""
        view = self.view(rect)
        return view - view.new_tensor(self.mean).view(1, 3, 1, 1) if any(self.mean) else view


@dataclass(frozen=True, slots=True)
class PendingGradient:
    """A gradient of a rectangle of a layer that is still to be added."""

    rect: Rect
    """The rectangle."""
    gradient: Tensor
    """(1, C, h, w)."""
    exclusive: bool
    """Whether nothing else refers to the tensor."""


@dataclass(slots=True)
class SavedForBackward:
    """What the backward pass needs of a step, per rectangle."""

    outputs: list[Tensor] = field(default_factory=list)
    """Outputs of layers that end in a rectifier."""
    inputs: list[tuple[Tensor, ...]] = field(default_factory=list)
    """Inputs of pointwise functions."""
    indices: list[Tensor] = field(default_factory=list)
    """Of maxima."""


def forward(
    graph: LayerGraph,
    plan: RecomputePlan,
    image_input: ImageInput,
    stored: Mapping[NetworkLayer, Tensor],
    returned_layers: Collection[NetworkLayer],
) -> tuple[dict[NetworkLayer, list[Tensor]], list[SavedForBackward]]:
    """Compute a plan's rectangles.

    Args:
        graph: The network.
        plan: What to compute.
        image_input: The image.
        stored: Stored activations of the reference.
        returned_layers: Layers to return.

    Returns:
        The rectangles of the returned layers, and what the backward pass needs.
    """
    computed: dict[NetworkLayer, list[Tensor]] = {}
    returned: dict[NetworkLayer, list[Tensor]] = {}
    saved: list[SavedForBackward] = []
    for step in plan.steps:
        saved_step = SavedForBackward()
        computed[step.layer] = [
            _compute(graph, step, k, _inputs(step, k, computed, stored), image_input, saved_step)
            for k in range(len(step.rects))
        ]
        saved.append(saved_step)
        if step.layer in returned_layers:
            returned[step.layer] = computed[step.layer]
        for layer in step.last_used:
            del computed[layer]
    return returned, saved


def backward(
    graph: LayerGraph,
    plan: RecomputePlan,
    saved: Sequence[SavedForBackward],
    gradients: Mapping[NetworkLayer, Tensor],
) -> list[tuple[Rect, Tensor]]:
    """The gradient of each rectangle of the image.

    Args:
        graph: The network.
        plan: The plan of the forward pass.
        saved: Saved by the forward pass.
        gradients: (1, C, h, w) of each output.
    """
    like = next(iter(gradients.values()))
    convolution_gradients: dict[NetworkLayer, list[Tensor]] = {}
    pending: dict[NetworkLayer, list[PendingGradient]] = {}
    for layer, gradient in gradients.items():
        pending[layer] = [PendingGradient(Rect(0, gradient.shape[2], 0, gradient.shape[3]), gradient, False)]
    for step, saved_step in zip(reversed(plan.steps), reversed(saved), strict=True):
        layer = step.layer
        placed = pending.pop(layer, [])
        totals = [_total(graph, step, k, convolution_gradients, placed, like) for k in range(len(step.rects))]
        if isinstance(layer, InputLayer):
            return list(zip(step.rects, totals, strict=True))
        slope = layer.slope if isinstance(layer, (WindowOp, Rectifier)) else None
        if slope is not None:
            for total, output in zip(totals, saved_step.outputs, strict=True):
                mask_gradient(total, output, slope)
        if isinstance(layer, Convolution) and layer.uses_onednn:
            convolution_gradients[layer] = totals
            continue
        for k, total in enumerate(totals):
            for rows, columns in step.overlaps[k]:
                total[:, :, rows, columns] = 0
            for source, gradient in zip(
                layer.sources, _backpropagate(graph, step, k, total, saved_step), strict=True
            ):
                own = len(layer.sources) == 1
                pending.setdefault(source, []).append(PendingGradient(step.windows[k], gradient, own))
    raise AssertionError("a plan begins with the image")


def _inputs(
    step: PlanStep,
    k: int,
    computed: Mapping[NetworkLayer, Sequence[Tensor]],
    stored: Mapping[NetworkLayer, Tensor],
) -> list[Tensor]:
    """The layer's inputs for its k-th rectangle."""
    fill = -torch.inf if isinstance(step.layer, MaxPool) else 0.0
    return [
        _read(window, computed[source], stored.get(source), fill)
        for window, source in zip(step.reads[k], step.layer.sources, strict=True)
    ]


def _read(window: LayerWindow, computed: Sequence[Tensor], stored: Tensor | None, fill: float) -> Tensor:
    if window.is_slice:
        number, (rows, columns), _ = window.from_rects[0]
        return computed[number][:, :, rows, columns]
    like = computed[0] if stored is None else stored
    values = empty_channels_last((1, like.shape[1], *window.hw), like.dtype, like.device)
    if window.needs_fill:
        values.fill_(fill)
    if window.from_reference is not None and stored is not None:
        (rows, columns), (to_rows, to_columns) = window.from_reference
        values[:, :, to_rows, to_columns] = stored[:, :, rows, columns]
    for number, (rows, columns), (to_rows, to_columns) in window.from_rects:
        values[:, :, to_rows, to_columns] = computed[number][:, :, rows, columns]
    return values


def _compute(
    graph: LayerGraph,
    step: PlanStep,
    k: int,
    inputs: Sequence[Tensor],
    image_input: ImageInput,
    saved_step: SavedForBackward,
) -> Tensor:
    """The layer's output in its k-th rectangle."""
    layer, rect = step.layer, step.rects[k]
    match layer:
        case InputLayer():
            return image_input.network_input(rect)
        case Convolution():
            result = _convolve(layer, graph.weights[layer], inputs)
        case MaxPool():
            result, indices = F.max_pool2d_with_indices(
                inputs[0], layer.kernel, layer.stride, (0, 0), layer.dilation, ceil_mode=layer.ceil_mode
            )
            saved_step.indices.append(indices)
            if layer.slope is not None:
                result = rectify(result, layer.slope)
        case Rectifier():
            result = F.leaky_relu(inputs[0], layer.slope)
        case ChannelAffine():
            result = inputs[0] * layer.scale[:, None, None] + layer.shift[:, None, None]
        case PointwiseOp():
            result = layer.call(*inputs)
            saved_step.inputs.append(() if layer.is_sum else tuple(inputs))
        case Upsample():
            result = _upsample(layer, rect, step.windows[k], inputs[0])
        case _:
            raise AssertionError(type(layer).__name__)
    if isinstance(layer, (WindowOp, Rectifier)) and layer.slope is not None:
        saved_step.outputs.append(result)
    return result


def _convolve(layer: Convolution, kernel: ConvolutionWeights, inputs: Sequence[Tensor]) -> Tensor:
    if not layer.uses_onednn:
        joined = inputs[0] if len(inputs) == 1 else torch.cat(list(inputs), 1)
        weight = layer.weight.to(joined)
        result = F.conv2d(joined, weight, kernel.bias, layer.stride, 0, layer.dilation, layer.groups)
        return rectify(result, layer.slope)
    stride, final = layer.stride[0], len(inputs) - 1
    result = convolve(inputs[0], kernel.forward[0], kernel.bias, stride, slope=None if final else layer.slope)
    for i in range(1, len(inputs)):
        slope = layer.slope if i == final else None
        result = convolve_add(result, inputs[i], kernel.forward[i], stride, slope=slope)
    return result


def _upsample(layer: Upsample, rect: Rect, window: Rect, x: Tensor) -> Tensor:
    align = None if layer.mode == "nearest" else False
    large = F.interpolate(x, scale_factor=float(layer.scale_factor), mode=layer.mode, align_corners=align)
    top, left = rect.top - layer.scale_factor * window.top, rect.left - layer.scale_factor * window.left
    return large[:, :, top : top + rect.hw[0], left : left + rect.hw[1]]


def _total(
    graph: LayerGraph,
    step: PlanStep,
    k: int,
    convolution_gradients: Mapping[NetworkLayer, Sequence[Tensor]],
    pending: Sequence[PendingGradient],
    like: Tensor,
) -> Tensor:
    """The gradient of the layer's output in its k-th rectangle, from all consumers; a tensor of its own.

    Where rectangles overlap, each has the whole gradient.
    """
    rect, total = step.rects[k], None
    for gathered in step.gathers[k]:
        total = _gather(graph, gathered, convolution_gradients[gathered.layer], total)
    overlapping = [(placed, shared) for placed in pending if (shared := placed.rect.intersect(rect)).area]
    if total is None and len(overlapping) == 1 and overlapping[0][0].exclusive and overlapping[0][0].rect == rect:
        return overlapping[0][0].gradient
    if total is None:
        total = _zeros(step.layer.channels, rect.hw, like)
    for placed, shared in overlapping:
        rows, columns = shared.slices_in(rect)
        of_rows, of_columns = shared.slices_in(placed.rect)
        total[:, :, rows, columns] += placed.gradient[:, :, of_rows, of_columns]
    return total


def _zeros(channels: int, hw: tuple[int, int], like: Tensor) -> Tensor:
    return empty_channels_last((1, channels, *hw), like.dtype, like.device).zero_()


def _gather(
    graph: LayerGraph, gathered: GradientGather, convolution_gradients: Sequence[Tensor], total: Tensor | None
) -> Tensor:
    """`total` plus the gradient through one convolution."""
    weight, stride = graph.weights[gathered.layer].backward[gathered.source_index], gathered.layer.stride[0]
    seen = _read(gathered.window, convolution_gradients, None, 0.0)
    if stride == 1:
        return convolve(seen, weight) if total is None else convolve_add(total, seen, weight)
    # (1, rows, columns, s * s * I) -> (1, I, s * rows, s * columns)
    places = convolve(seen, weight).permute(0, 2, 3, 1).unflatten(3, (stride, stride, -1))
    large = places.transpose(2, 3).flatten(1, 2).flatten(2, 3).permute(0, 3, 1, 2)
    rows, columns = gathered.crop
    part = large[:, :, rows, columns]
    return part.contiguous(memory_format=torch.channels_last) if total is None else total.add_(part)


def _backpropagate(
    graph: LayerGraph, step: PlanStep, k: int, total: Tensor, saved_step: SavedForBackward
) -> list[Tensor]:
    """The gradients of the k-th window of each source."""
    layer = step.layer
    match layer:
        case MaxPool():
            before = empty_channels_last((1, layer.channels, *step.reads[k][0].hw), total.dtype, total.device)
            into: Tensor = _MAX_POOL_BACKWARD(
                total,
                before,
                layer.kernel,
                layer.stride,
                [0, 0],
                layer.dilation,
                layer.ceil_mode,
                saved_step.indices[k],
            )
            return [into]
        case Convolution():
            window = F.conv_transpose2d(
                total, layer.weight.to(total), None, layer.stride, groups=layer.groups, dilation=layer.dilation
            )
            return list(window.split([source.channels for source in layer.sources], 1))
        case Rectifier():
            return [total]
        case ChannelAffine():
            return [total * layer.scale[:, None, None]]
        case PointwiseOp() if layer.is_sum:
            return [total] * len(layer.sources)
        case PointwiseOp():
            return _autograd(layer.call, saved_step.inputs[k], total)
        case Upsample():
            window, rect = step.windows[k], step.rects[k]
            like = total.new_empty((1, layer.channels, *window.hw))
            return _autograd(lambda x: _upsample(layer, rect, window, x), (like,), total)
        case _:
            raise AssertionError(type(layer).__name__)


def _autograd(call: Any, inputs: Sequence[Tensor], gradient: Tensor) -> list[Tensor]:
    """Gradients by autograd."""
    with torch.enable_grad():
        leaves = [x.detach().requires_grad_(True) for x in inputs]
        return list(torch.autograd.grad(call(*leaves), leaves, gradient))


class ChangedOutputs(torch.autograd.Function):
    """A plan's outputs, as whole tensors, as a function of the image."""

    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        image_input: ImageInput,
        graph: LayerGraph,
        plan: RecomputePlan,
        stored: Mapping[NetworkLayer, Tensor],
    ) -> tuple[Tensor, ...]:
        """Run the plan; arguments as `forward`.

        Args:
            ctx: Autograd's context.
            image: (1, 3, H, W), the differentiable argument.
            image_input: The same image.
            graph: The network.
            plan: What to compute.
            stored: Stored activations of the reference.
        """
        returned, saved = forward(graph, plan, image_input, stored, graph.outputs)
        rects = {step.layer: step.rects for step in plan.steps}
        outputs = []
        for layer in graph.outputs:
            whole = stored[layer].clone()
            for rect, part in zip(rects[layer], returned[layer], strict=True):
                whole[:, :, rect.top : rect.bottom, rect.left : rect.right] = part
            outputs.append(whole)
        if ctx.needs_input_grad[0]:
            ctx.graph, ctx.plan, ctx.traces = graph, plan, saved
            ctx.at, ctx.shape = image_input.origin, image.shape
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None, None, None, None]:
        graph: LayerGraph = ctx.graph
        output_gradients = dict(zip(graph.outputs, gradients, strict=True))
        image = gradients[0].new_zeros(ctx.shape)
        for rect, part in backward(graph, ctx.plan, ctx.traces, output_gradients):
            ImageInput(image, ctx.at).view(rect).copy_(part)
        return image, None, None, None, None
