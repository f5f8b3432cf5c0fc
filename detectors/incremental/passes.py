"""A pass over the rectangles of a plan, and its way back to the picture, as one function of autograd."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from detectors.convolving import convolve, convolve_onto, empty, mask, rectified
from detectors.incremental.graph import (
    Convolved,
    Each,
    Enlarged,
    Graph,
    Kernel,
    Layer,
    Picture,
    Pooled,
    Rectified,
    Scaled,
    Sliding,
)
from detectors.incremental.plan import Gathered, Plan, Reading, Step
from detectors.incremental.regions import Rect

_BACK_POOL = torch.ops.aten.max_pool2d_with_indices_backward


@dataclass(frozen=True, slots=True)
class Picturing:
    """An image (1, 3, H, W). at: row and column of the padded picture at which it begins; mean: what is subtracted
    from its channels.
    """

    image: Tensor
    at: tuple[int, int] = (0, 0)
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def view(self, rect: Rect) -> Tensor:
        """The image in a rectangle of the padded picture, in which it lies."""
        top, left = rect.top - self.at[0], rect.left - self.at[1]
        return self.image[:, :, top : top + rect.hw[0], left : left + rect.hw[1]]

    def part(self, rect: Rect) -> Tensor:
        """What the network takes there."""
        view = self.view(rect)
        return view - view.new_tensor(self.mean).view(1, 3, 1, 1) if any(self.mean) else view


@dataclass(frozen=True, slots=True)
class Placed:
    """A gradient to a rectangle of a layer, that waits to be added. own: whether nobody else has this tensor."""

    rect: Rect
    gradient: Tensor
    own: bool


@dataclass(slots=True)
class Traces:
    """What the way back needs of a step, rectangle by rectangle. given: what came out, where a rectifier ended it;
    taken: what went in, where a function of places wants it; indices: of maxima.
    """

    given: list[Tensor] = field(default_factory=list)
    taken: list[tuple[Tensor, ...]] = field(default_factory=list)
    indices: list[Tensor] = field(default_factory=list)


def forward(
    graph: Graph, plan: Plan, picture: Picturing, kept: Mapping[Layer, Tensor], keep: Collection[Layer]
) -> tuple[dict[Layer, list[Tensor]], list[Traces]]:
    """What layers `keep` give in their rectangles, and what the way back needs. kept: the reference's layers."""
    fresh: dict[Layer, list[Tensor]] = {}
    found: dict[Layer, list[Tensor]] = {}
    traces: list[Traces] = []
    for step in plan.steps:
        trace = Traces()
        fresh[step.layer] = [
            _given(graph, step, k, _inputs(step, k, fresh, kept), picture, trace) for k in range(len(step.rects))
        ]
        traces.append(trace)
        if step.layer in keep:
            found[step.layer] = fresh[step.layer]
        for layer in step.done:
            del fresh[layer]
    return found, traces


def backward(
    graph: Graph, plan: Plan, traces: Sequence[Traces], gradients: Mapping[Layer, Tensor]
) -> list[tuple[Rect, Tensor]]:
    """The gradient to each of the picture's rectangles.

    gradients: of a function of the outputs to each of them (1, C, h, w).
    """
    like = next(iter(gradients.values()))
    told: dict[Layer, list[Tensor]] = {}
    waiting: dict[Layer, list[Placed]] = {}
    for layer, gradient in gradients.items():
        waiting[layer] = [Placed(Rect(0, gradient.shape[2], 0, gradient.shape[3]), gradient, False)]
    for step, trace in zip(reversed(plan.steps), reversed(traces), strict=True):
        layer = step.layer
        placed = waiting.pop(layer, [])
        totals = [_total(graph, step, k, told, placed, like) for k in range(len(step.rects))]
        if isinstance(layer, Picture):
            return list(zip(step.rects, totals, strict=True))
        slope = layer.slope if isinstance(layer, (Sliding, Rectified)) else None
        if slope is not None:
            for total, given in zip(totals, trace.given, strict=True):
                mask(total, given, slope)
        if isinstance(layer, Convolved) and layer.plain:
            told[layer] = totals
            continue
        for k, total in enumerate(totals):
            for rows, columns in step.twice[k]:
                total[:, :, rows, columns] = 0
            for source, gradient in zip(layer.sources, _back(graph, step, k, total, trace), strict=True):
                own = len(layer.sources) == 1
                waiting.setdefault(source, []).append(Placed(step.windows[k], gradient, own))
    raise AssertionError("a plan begins with the picture")


def _inputs(
    step: Step, k: int, fresh: Mapping[Layer, Sequence[Tensor]], kept: Mapping[Layer, Tensor]
) -> list[Tensor]:
    """What the layer takes for its k-th rectangle."""
    fill = -torch.inf if isinstance(step.layer, Pooled) else 0.0
    return [
        _read(reading, fresh[source], kept.get(source), fill)
        for reading, source in zip(step.reads[k], step.layer.sources, strict=True)
    ]


def _read(reading: Reading, fresh: Sequence[Tensor], kept: Tensor | None, fill: float) -> Tensor:
    if reading.only:
        number, (rows, columns), _ = reading.pieces[0]
        return fresh[number][:, :, rows, columns]
    like = fresh[0] if kept is None else kept
    window = empty((1, like.shape[1], *reading.hw), like.dtype, like.device)
    if reading.beyond:
        window.fill_(fill)
    if reading.kept is not None and kept is not None:
        (rows, columns), (to_rows, to_columns) = reading.kept
        window[:, :, to_rows, to_columns] = kept[:, :, rows, columns]
    for number, (rows, columns), (to_rows, to_columns) in reading.pieces:
        window[:, :, to_rows, to_columns] = fresh[number][:, :, rows, columns]
    return window


def _given(
    graph: Graph, step: Step, k: int, inputs: Sequence[Tensor], picture: Picturing, trace: Traces
) -> Tensor:
    """What the layer gives in its k-th rectangle."""
    layer, rect = step.layer, step.rects[k]
    match layer:
        case Picture():
            return picture.part(rect)
        case Convolved():
            result = _convolved(layer, graph.kernels[layer], inputs)
        case Pooled():
            result, indices = F.max_pool2d_with_indices(
                inputs[0], layer.kernel, layer.stride, (0, 0), layer.dilation, ceil_mode=layer.ceil
            )
            trace.indices.append(indices)
            if layer.slope is not None:
                result = rectified(result, layer.slope)
        case Rectified():
            result = F.leaky_relu(inputs[0], layer.slope)
        case Scaled():
            result = inputs[0] * layer.scale[:, None, None] + layer.shift[:, None, None]
        case Each():
            result = layer.call(*inputs)
            trace.taken.append(() if layer.sum else tuple(inputs))
        case Enlarged():
            result = _enlarged(layer, rect, step.windows[k], inputs[0])
        case _:
            raise AssertionError(type(layer).__name__)
    if isinstance(layer, (Sliding, Rectified)) and layer.slope is not None:
        trace.given.append(result)
    return result


def _convolved(layer: Convolved, kernel: Kernel, inputs: Sequence[Tensor]) -> Tensor:
    if not layer.plain:
        joined = inputs[0] if len(inputs) == 1 else torch.cat(list(inputs), 1)
        weight = layer.weight.to(joined)
        result = F.conv2d(joined, weight, kernel.bias, layer.stride, 0, layer.dilation, layer.groups)
        return rectified(result, layer.slope)
    stride, final = layer.stride[0], len(inputs) - 1
    result = convolve(inputs[0], kernel.weights[0], kernel.bias, stride, slope=None if final else layer.slope)
    for i in range(1, len(inputs)):
        slope = layer.slope if i == final else None
        result = convolve_onto(result, inputs[i], kernel.weights[i], stride, slope=slope)
    return result


def _enlarged(layer: Enlarged, rect: Rect, window: Rect, x: Tensor) -> Tensor:
    align = None if layer.mode == "nearest" else False
    large = F.interpolate(x, scale_factor=float(layer.factor), mode=layer.mode, align_corners=align)
    top, left = rect.top - layer.factor * window.top, rect.left - layer.factor * window.left
    return large[:, :, top : top + rect.hw[0], left : left + rect.hw[1]]


def _total(
    graph: Graph,
    step: Step,
    k: int,
    told: Mapping[Layer, Sequence[Tensor]],
    waiting: Sequence[Placed],
    like: Tensor,
) -> Tensor:
    """The gradient to what the layer gives in its k-th rectangle, from all that take it. Nobody else has this
    tensor, and where rectangles overlap, each has all of it.
    """
    rect, total = step.rects[k], None
    for gathered in step.gathered[k]:
        total = _gather(graph, gathered, told[gathered.layer], total)
    meeting = [(placed, shared) for placed in waiting if (shared := placed.rect.meet(rect)).area]
    if total is None and len(meeting) == 1 and meeting[0][0].own and meeting[0][0].rect == rect:
        return meeting[0][0].gradient
    if total is None:
        total = _zeros(step.layer.channels, rect.hw, like)
    for placed, shared in meeting:
        rows, columns = shared.inside(rect)
        of_rows, of_columns = shared.inside(placed.rect)
        total[:, :, rows, columns] += placed.gradient[:, :, of_rows, of_columns]
    return total


def _zeros(channels: int, hw: tuple[int, int], like: Tensor) -> Tensor:
    return empty((1, channels, *hw), like.dtype, like.device).zero_()


def _gather(graph: Graph, gathered: Gathered, told: Sequence[Tensor], total: Tensor | None) -> Tensor:
    """`total`, plus the gradient by way of one convolution."""
    weight, stride = graph.kernels[gathered.layer].back[gathered.number], gathered.layer.stride[0]
    seen = _read(gathered.reading, told, None, 0.0)
    if stride == 1:
        return convolve(seen, weight) if total is None else convolve_onto(total, seen, weight)
    # (1, rows, columns, s * s * I) -> (1, I, s * rows, s * columns)
    places = convolve(seen, weight).permute(0, 2, 3, 1).unflatten(3, (stride, stride, -1))
    large = places.transpose(2, 3).flatten(1, 2).flatten(2, 3).permute(0, 3, 1, 2)
    rows, columns = gathered.cut
    part = large[:, :, rows, columns]
    return part.contiguous(memory_format=torch.channels_last) if total is None else total.add_(part)


def _back(graph: Graph, step: Step, k: int, total: Tensor, trace: Traces) -> list[Tensor]:
    """The gradients to the k-th window of each source."""
    layer = step.layer
    match layer:
        case Pooled():
            before = empty((1, layer.channels, *step.reads[k][0].hw), total.dtype, total.device)
            into: Tensor = _BACK_POOL(
                total, before, layer.kernel, layer.stride, [0, 0], layer.dilation, layer.ceil, trace.indices[k]
            )
            return [into]
        case Convolved():
            window = F.conv_transpose2d(
                total, layer.weight.to(total), None, layer.stride, groups=layer.groups, dilation=layer.dilation
            )
            return list(window.split([source.channels for source in layer.sources], 1))
        case Rectified():
            return [total]
        case Scaled():
            return [total * layer.scale[:, None, None]]
        case Each() if layer.sum:
            return [total] * len(layer.sources)
        case Each():
            return _slopes(layer.call, trace.taken[k], total)
        case Enlarged():
            window, rect = step.windows[k], step.rects[k]
            like = total.new_empty((1, layer.channels, *window.hw))
            return _slopes(lambda x: _enlarged(layer, rect, window, x), (like,), total)
        case _:
            raise AssertionError(type(layer).__name__)


def _slopes(call: Any, inputs: Sequence[Tensor], gradient: Tensor) -> list[Tensor]:
    """By autograd."""
    with torch.enable_grad():
        leaves = [x.detach().requires_grad_(True) for x in inputs]
        return list(torch.autograd.grad(call(*leaves), leaves, gradient))


class Changed(torch.autograd.Function):
    """A plan's outputs, each a whole tensor, as a function of the picture's image."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, picture: Picturing, graph: Graph, plan: Plan, kept: Mapping[Layer, Tensor]
    ) -> tuple[Tensor, ...]:
        found, traces = forward(graph, plan, picture, kept, graph.outputs)
        rects = {step.layer: step.rects for step in plan.steps}
        outputs = []
        for layer in graph.outputs:
            whole = kept[layer].clone()
            for rect, part in zip(rects[layer], found[layer], strict=True):
                whole[:, :, rect.top : rect.bottom, rect.left : rect.right] = part
            outputs.append(whole)
        if ctx.needs_input_grad[0]:
            ctx.graph, ctx.plan, ctx.traces = graph, plan, traces
            ctx.at, ctx.shape = picture.at, image.shape
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None, None, None, None]:
        graph: Graph = ctx.graph
        given = dict(zip(graph.outputs, gradients, strict=True))
        image = gradients[0].new_zeros(ctx.shape)
        for rect, part in backward(graph, ctx.plan, ctx.traces, given):
            Picturing(image, ctx.at).view(rect).copy_(part)
        return image, None, None, None, None
