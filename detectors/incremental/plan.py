"""Plans what is recomputed for an image that differs from the reference in a region.

From the image on, the places that can differ are found layer by layer; then, from the outputs back, those needed.
A stored layer is computed where it can differ and read from the reference elsewhere. Any other layer is computed
wherever a later one needs it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from detectors.incremental.graph import (
    Convolution,
    InputLayer,
    LayerGraph,
    MaxPool,
    NetworkLayer,
    Upsample,
    WindowOp,
)
from detectors.incremental.regions import ColumnRegion, ReceptiveField, Rect

Slices = tuple[slice, slice]

_BYTES = 4
"""Per value: limits refer to single precision."""
_VALUE_COST, _CALL_COST = 8.0, 2e6
"""What it costs to write a number, and to compute a rectangle, in multiply-adds."""
_BILINEAR_FIELD = ReceptiveField((3, 3), (1, 1), (1, 1))
"""Places that bilinear interpolation reads."""


@dataclass(frozen=True, slots=True)
class LayerWindow:
    """A window of a layer, assembled from its rectangles and, for a stored layer, from the reference."""

    hw: tuple[int, int]
    """Its size."""
    needs_fill: bool
    """Whether parts are in neither and are filled."""
    from_reference: tuple[Slices, Slices] | None
    """Rows and columns of the reference and their place in the window."""
    from_rects: tuple[tuple[int, Slices, Slices], ...]
    """Index of a rectangle, its rows and columns, and their place in the window."""
    is_slice: bool
    """Whether the window is a slice of a single rectangle."""

    @classmethod
    def locate(cls, window: Rect, rects: Sequence[Rect], hw: tuple[int, int], stored: bool) -> LayerWindow:
        """Locate a window in a layer.

        Args:
            window: The window.
            rects: Computed rectangles of the layer.
            hw: Size of the layer.
            stored: Whether the layer is stored.
        """
        within = window.intersect(Rect(0, hw[0], 0, hw[1]))
        for number, rect in enumerate(rects):
            if rect.intersect(window) == window:
                return cls(
                    window.hw, False, None, ((number, window.slices_in(rect), window.slices_in(window)),), True
                )
        pieces = []
        for number, rect in enumerate(rects):
            shared = rect.intersect(within)
            if shared.area:
                pieces.append((number, shared.slices_in(rect), shared.slices_in(window)))
        reference = (within.slices_in(Rect(0, hw[0], 0, hw[1])), within.slices_in(window)) if stored else None
        covered = stored
        if not stored:
            parts = [rect.intersect(within) for rect in rects]
            overlaps = any(a.intersect(b).area for i, a in enumerate(parts) for b in parts[:i])
            covered = not overlaps and sum(part.area for part in parts) == within.area
        return cls(
            window.hw, not covered or within != window, reference if within.area else None, tuple(pieces), False
        )


@dataclass(frozen=True, slots=True)
class GradientGather:
    """How a rectangle's gradient follows from that of a consuming convolution."""

    layer: Convolution
    """The convolution."""
    source_index: int
    """Index of this layer among its sources."""
    window: LayerWindow
    """Window of its gradient."""
    crop: Slices
    """Rows and columns of the result."""


@dataclass(frozen=True, slots=True)
class PlanStep:
    """The rectangles of one layer."""

    layer: NetworkLayer
    """The layer."""
    rects: tuple[Rect, ...]
    """Its rectangles."""
    reads: tuple[tuple[LayerWindow, ...], ...]
    """Per rectangle, the window of each source."""
    windows: tuple[Rect, ...]
    """Per rectangle, its rectangle in the sources."""
    gathers: tuple[tuple[GradientGather, ...], ...]
    """Per rectangle, its gradient from convolutions."""
    overlaps: tuple[tuple[Slices, ...], ...]
    """Per rectangle, rows and columns that earlier rectangles contain too."""
    last_used: tuple[NetworkLayer, ...]
    """Layers that no later step reads."""


@dataclass(frozen=True, slots=True)
class SizedGraph:
    """A graph for one image size."""

    graph: LayerGraph
    """The network."""
    hw: Mapping[NetworkLayer, tuple[int, int]]
    """Size of each layer."""
    consumers: Mapping[NetworkLayer, tuple[NetworkLayer, ...]]
    """Of each layer."""
    stored: frozenset[NetworkLayer]
    """Layers with stored reference activations, among them the input and the outputs."""

    @classmethod
    def for_size(cls, graph: LayerGraph, hw: tuple[int, int], limit_bytes: float) -> SizedGraph:
        """A graph for padded images of one size.

        Layers that exceed the limit are not stored, the largest first: these come early, where recomputing a
        little more around the regions costs least.

        Args:
            graph: The network.
            hw: Size of the padded image.
            limit_bytes: Limit of the stored activations.
        """
        sizes: dict[NetworkLayer, tuple[int, int]] = {}
        consumers: dict[NetworkLayer, list[NetworkLayer]] = {layer: [] for layer in graph.layers}
        for layer in graph.layers:
            sizes[layer] = hw if isinstance(layer, InputLayer) else layer.output_hw(sizes[layer.sources[0]])
            for source in layer.sources:
                consumers[source].append(layer)
        required = {graph.layers[0], *graph.outputs}
        optional = _read_beyond(graph) - required
        sized = {
            layer: layer.channels * sizes[layer][0] * sizes[layer][1] * _BYTES for layer in optional | required
        }
        total = sum(sized.values())
        for layer in sorted(optional, key=lambda layer: -sized[layer]):
            if total <= limit_bytes:
                break
            optional.remove(layer)
            total -= sized[layer]
        return cls(graph, sizes, {k: tuple(v) for k, v in consumers.items()}, frozenset(optional | required))

    def plan(self, changed: ColumnRegion, image: Rect) -> RecomputePlan:
        """The plan for a padded image that differs in a region; `image` is the unpadded image's rectangle."""
        rects = self._rects([rect.intersect(image) for rect in changed.rects()])
        steps: list[PlanStep] = []
        last_reader: dict[NetworkLayer, NetworkLayer] = {}
        for layer in self.graph.layers:
            last_reader.update(dict.fromkeys((*layer.sources, layer), layer))
        last_used: dict[NetworkLayer, list[NetworkLayer]] = {}
        for layer, user in last_reader.items():
            if layer not in self.graph.outputs:
                last_used.setdefault(user, []).append(layer)
        for layer in self.graph.layers:
            layer_rects = rects[layer]
            windows = [self._window(layer, rect) for rect in layer_rects]
            reads = [
                tuple(LayerWindow.locate(w, rects[s], self.hw[s], s in self.stored) for s in layer.sources)
                for w in windows
            ]
            gathered = tuple(self._gathers(layer, rect, rects) for rect in layer_rects)
            overlaps = tuple(_overlaps(rect, layer_rects[:k]) for k, rect in enumerate(layer_rects))
            steps.append(
                PlanStep(
                    layer,
                    layer_rects,
                    tuple(reads),
                    tuple(windows),
                    gathered,
                    overlaps,
                    tuple(last_used.get(layer, ())),
                )
            )
        whole = {layer: (Rect(0, hw[0], 0, hw[1]),) for layer, hw in self.hw.items()}
        return RecomputePlan(tuple(steps), self._cost(rects) / self._cost(whole))

    def _rects(self, changed: Sequence[Rect]) -> dict[NetworkLayer, tuple[Rect, ...]]:
        """The rectangles computed in each layer, for those of the image."""
        picture = self.graph.layers[0]
        regions: dict[NetworkLayer, ColumnRegion] = {picture: ColumnRegion.from_rects(changed, self.hw[picture])}
        for layer in self.graph.layers[1:]:
            regions[layer] = self._region(layer, regions)
        covered: dict[bytes, tuple[Rect, ...]] = {}
        needed: dict[NetworkLayer, list[Rect]] = {layer: [] for layer in self.graph.layers}
        rects: dict[NetworkLayer, tuple[Rect, ...]] = {}
        for layer in reversed(self.graph.layers):
            hw = self.hw[layer]
            if layer is picture:
                rects[layer] = tuple(changed)
            elif layer in self.stored:
                rects[layer] = _cover(regions[layer], covered)
            else:
                clipped = [window.intersect(Rect(0, hw[0], 0, hw[1])) for window in needed[layer]]
                if len(self.consumers[layer]) == 1:
                    rects[layer] = tuple(dict.fromkeys(rect for rect in clipped if rect.area))
                else:
                    rects[layer] = _cover(ColumnRegion.from_rects(clipped, hw), covered)
            for source in layer.sources:
                needed[source] += [self._window(layer, rect) for rect in rects[layer]]
        return rects

    def _region(self, layer: NetworkLayer, regions: Mapping[NetworkLayer, ColumnRegion]) -> ColumnRegion:
        before = regions[layer.sources[0]]
        for source in layer.sources[1:]:
            before = before.union(regions[source])
        if isinstance(layer, WindowOp):
            return before.propagate(layer.receptive_field, self.hw[layer])
        if isinstance(layer, Upsample):
            around = before if layer.mode == "nearest" else before.propagate(_BILINEAR_FIELD, before.hw)
            return around.upsample(layer.scale_factor)
        return before

    def _window(self, layer: NetworkLayer, rect: Rect) -> Rect:
        """The rectangle of the sources that a layer reads for a rectangle; beyond them it is filled."""
        if not layer.sources:
            return rect
        source = Rect(0, self.hw[layer.sources[0]][0], 0, self.hw[layer.sources[0]][1])
        if isinstance(layer, WindowOp):
            window = layer.receptive_field.input_rect(rect)
            return window.intersect(source) if isinstance(layer, MaxPool) and not any(layer.padding) else window
        if isinstance(layer, Upsample):
            f = layer.scale_factor
            small = Rect(rect.top // f, -(-rect.bottom // f), rect.left // f, -(-rect.right // f))
            return (small if layer.mode == "nearest" else _BILINEAR_FIELD.input_rect(small)).intersect(source)
        return rect

    def _gathers(
        self, layer: NetworkLayer, rect: Rect, rects: Mapping[NetworkLayer, tuple[Rect, ...]]
    ) -> tuple[GradientGather, ...]:
        found = []
        for consumer in dict.fromkeys(self.consumers[layer]):
            if not (isinstance(consumer, Convolution) and consumer.uses_onednn):
                continue
            stride, (top, left) = consumer.stride[0], consumer.receptive_field.padding
            taps = -(-consumer.kernel[0] // stride) - 1
            first = (rect.top + top) // stride, (rect.left + left) // stride
            end = (rect.bottom - 1 + top) // stride + 1, (rect.right - 1 + left) // stride + 1
            window = Rect(first[0] - taps, end[0], first[1] - taps, end[1])
            layer_window = LayerWindow.locate(window, rects[consumer], self.hw[consumer], False)
            if not layer_window.from_rects:
                continue
            corner = rect.top + top - stride * first[0], rect.left + left - stride * first[1]
            cut = tuple(slice(at, at + side) for at, side in zip(corner, rect.hw, strict=True))
            found += [
                GradientGather(consumer, number, layer_window, (cut[0], cut[1]))
                for number, source in enumerate(consumer.sources)
                if source is layer
            ]
        return tuple(found)

    def _cost(self, rects: Mapping[NetworkLayer, Sequence[Rect]]) -> float:
        """In multiply-adds, as far as it depends on rectangles."""
        total = 0.0
        for layer, several in rects.items():
            area = sum(rect.area for rect in several)
            work = layer.channels * _VALUE_COST
            if isinstance(layer, Convolution):
                work += layer.channels * float(layer.weight[0].numel())
            total += area * work + len(several) * _CALL_COST
        return total


@dataclass(frozen=True, slots=True)
class RecomputePlan:
    """Steps to recompute an image's changed regions."""

    steps: tuple[PlanStep, ...]
    """One per layer."""
    cost_share: float
    """Cost relative to a whole pass."""


def _overlaps(rect: Rect, others: Sequence[Rect]) -> tuple[Slices, ...]:
    """Rows and columns of a rectangle that others contain too."""
    return tuple(shared.slices_in(rect) for other in others if (shared := rect.intersect(other)).area)


def _cover(region: ColumnRegion, known: dict[bytes, tuple[Rect, ...]]) -> tuple[Rect, ...]:
    key = region.top.tobytes() + region.bottom.tobytes()
    if key not in known:
        known[key] = region.rects()
    return known[key]


def _read_beyond(graph: LayerGraph) -> set[NetworkLayer]:
    """Layers that others read both where they can differ and where they cannot, and that are worth storing.

    Not the inputs of strided maxima, such as in the first layers, which are large: one more row of them is
    recomputed.
    """
    reach: dict[NetworkLayer, int] = {}
    jump: dict[NetworkLayer, float] = {}
    found: set[NetworkLayer] = set()
    for layer in graph.layers:
        if not layer.sources:
            reach[layer], jump[layer] = 0, 1.0
            continue
        furthest = max(reach[source] for source in layer.sources)
        found |= {source for source in layer.sources if reach[source] < furthest}
        jump[layer] = jump[layer.sources[0]]
        reach[layer] = furthest
        if isinstance(layer, WindowOp):
            extent = max(layer.receptive_field.extent)
            reach[layer] += int((extent - 1) * jump[layer])
            jump[layer] *= layer.stride[0]
            if extent > 1 and not (isinstance(layer, MaxPool) and min(layer.stride) > 1):
                found |= set(layer.sources)
        elif isinstance(layer, Upsample):
            jump[layer] /= layer.scale_factor
            if layer.mode != "nearest":
                reach[layer] += int(2 * jump[layer] * layer.scale_factor)
                found |= set(layer.sources)
    sliding: dict[NetworkLayer, bool] = {}
    for layer in graph.layers:
        for source in layer.sources:
            slides = isinstance(layer, WindowOp) and max(layer.receptive_field.extent) > 1
            sliding[source] = sliding.get(source, False) or slides
    # A 1x1 convolution of stored layers is as fast to compute as to read.
    return {
        layer
        for layer in found
        if sliding[layer]
        or not (
            isinstance(layer, Convolution)
            and layer.receptive_field.extent == (1, 1)
            and found.issuperset(layer.sources)
        )
    }
