"""What is computed where, for a picture that differs from the reference in a region.

Layer by layer from the picture on, the places that can differ are found; then, from the outputs back, those that
are needed. A kept layer is computed where it can differ, and read from the reference elsewhere. One that is not
kept is computed wherever a later one needs it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from detectors.incremental.graph import (
    Convolved,
    Enlarged,
    Graph,
    Layer,
    Picture,
    Pooled,
    Sliding,
)
from detectors.incremental.regions import Rect, Region, Span

Slices = tuple[slice, slice]

_BYTES = 4
"""Of a number: limits are those of single precision."""
_A_NUMBER, _A_CALL = 8.0, 2e6
"""What it costs to write a number, and to compute a rectangle, in multiply-adds."""
_AROUND = Span((3, 3), (1, 1), (1, 1))
"""What bilinear interpolation sees around a place."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A window of a layer, put together of its rectangles and, where it is kept, of the reference.

    hw: of the window; beyond: whether parts of it are neither, and are filled; kept: rows and columns of the
    reference and where they go; pieces: number of a rectangle, its rows and columns, and where they go; only:
    whether the one piece is the window.
    """

    hw: tuple[int, int]
    beyond: bool
    kept: tuple[Slices, Slices] | None
    pieces: tuple[tuple[int, Slices, Slices], ...]
    only: bool

    @classmethod
    def of(cls, window: Rect, rects: Sequence[Rect], hw: tuple[int, int], kept: bool) -> Reading:
        """hw: of the layer."""
        within = window.meet(Rect(0, hw[0], 0, hw[1]))
        for number, rect in enumerate(rects):
            if rect.meet(window) == window:
                return cls(window.hw, False, None, ((number, window.inside(rect), window.inside(window)),), True)
        pieces = []
        for number, rect in enumerate(rects):
            shared = rect.meet(within)
            if shared.area:
                pieces.append((number, shared.inside(rect), shared.inside(window)))
        reference = (within.inside(Rect(0, hw[0], 0, hw[1])), within.inside(window)) if kept else None
        covered = kept
        if not kept:
            parts = [rect.meet(within) for rect in rects]
            twice = any(a.meet(b).area for i, a in enumerate(parts) for b in parts[:i])
            covered = not twice and sum(part.area for part in parts) == within.area
        return cls(
            window.hw, not covered or within != window, reference if within.area else None, tuple(pieces), False
        )


@dataclass(frozen=True, slots=True)
class Gathered:
    """How a rectangle's gradient comes from a convolution that takes it. layer: the convolution; number: of the
    source that this is to it; reading: of its gradient; cut: rows and columns of what the weights give.
    """

    layer: Convolved
    number: int
    reading: Reading
    cut: Slices


@dataclass(frozen=True, slots=True)
class Step:
    """A layer's rectangles, and of each of them: reads, of each source; windows, in the sources; gathered, its
    gradient; twice, rows and columns that one before it has too. done: layers that nobody reads after this one.
    """

    layer: Layer
    rects: tuple[Rect, ...]
    reads: tuple[tuple[Reading, ...], ...]
    windows: tuple[Rect, ...]
    gathered: tuple[tuple[Gathered, ...], ...]
    twice: tuple[tuple[Slices, ...], ...]
    done: tuple[Layer, ...]


@dataclass(frozen=True, slots=True)
class Shapes:
    """A graph for pictures of one size. hw: of each layer; takers: of each layer; kept: layers whose reference is
    kept; the picture and the outputs are among them.
    """

    graph: Graph
    hw: Mapping[Layer, tuple[int, int]]
    takers: Mapping[Layer, tuple[Layer, ...]]
    kept: frozenset[Layer]

    @classmethod
    def of(cls, graph: Graph, hw: tuple[int, int], limit_bytes: float) -> Shapes:
        """hw: of the padded picture. limit_bytes: of what is kept. The largest are left out, which lie early,
        where computing a little more around the regions costs least.
        """
        sizes: dict[Layer, tuple[int, int]] = {}
        takers: dict[Layer, list[Layer]] = {layer: [] for layer in graph.layers}
        for layer in graph.layers:
            sizes[layer] = hw if isinstance(layer, Picture) else layer.size(sizes[layer.sources[0]])
            for source in layer.sources:
                takers[source].append(layer)
        always = {graph.layers[0], *graph.outputs}
        wanted = _read_beyond(graph) - always
        sized = {layer: layer.channels * sizes[layer][0] * sizes[layer][1] * _BYTES for layer in wanted | always}
        total = sum(sized.values())
        for layer in sorted(wanted, key=lambda layer: -sized[layer]):
            if total <= limit_bytes:
                break
            wanted.remove(layer)
            total -= sized[layer]
        return cls(graph, sizes, {k: tuple(v) for k, v in takers.items()}, frozenset(wanted | always))

    def plan(self, changed: Region, image: Rect) -> Plan:
        """For a padded picture that differs in that region. image: where the image is in it."""
        rects = self._rects([rect.meet(image) for rect in changed.rects()])
        steps: list[Step] = []
        last: dict[Layer, Layer] = {}
        for layer in self.graph.layers:
            last.update(dict.fromkeys((*layer.sources, layer), layer))
        done: dict[Layer, list[Layer]] = {}
        for layer, user in last.items():
            if layer not in self.graph.outputs:
                done.setdefault(user, []).append(layer)
        for layer in self.graph.layers:
            own = rects[layer]
            windows = [self._window(layer, rect) for rect in own]
            reads = [
                tuple(Reading.of(w, rects[s], self.hw[s], s in self.kept) for s in layer.sources) for w in windows
            ]
            gathered = tuple(self._gathered(layer, rect, rects) for rect in own)
            twice = tuple(_shared(rect, own[:k]) for k, rect in enumerate(own))
            steps.append(
                Step(layer, own, tuple(reads), tuple(windows), gathered, twice, tuple(done.get(layer, ())))
            )
        whole = {layer: (Rect(0, hw[0], 0, hw[1]),) for layer, hw in self.hw.items()}
        return Plan(tuple(steps), self._cost(rects) / self._cost(whole))

    def _rects(self, changed: Sequence[Rect]) -> dict[Layer, tuple[Rect, ...]]:
        """Of each layer the rectangles that are computed. changed: the picture's."""
        picture = self.graph.layers[0]
        regions: dict[Layer, Region] = {picture: Region.of(changed, self.hw[picture])}
        for layer in self.graph.layers[1:]:
            regions[layer] = self._region(layer, regions)
        covered: dict[bytes, tuple[Rect, ...]] = {}
        needed: dict[Layer, list[Rect]] = {layer: [] for layer in self.graph.layers}
        rects: dict[Layer, tuple[Rect, ...]] = {}
        for layer in reversed(self.graph.layers):
            hw = self.hw[layer]
            if layer is picture:
                rects[layer] = tuple(changed)
            elif layer in self.kept:
                rects[layer] = _cover(regions[layer], covered)
            else:
                clipped = [window.meet(Rect(0, hw[0], 0, hw[1])) for window in needed[layer]]
                if len(self.takers[layer]) == 1:
                    rects[layer] = tuple(dict.fromkeys(rect for rect in clipped if rect.area))
                else:
                    rects[layer] = _cover(Region.of(clipped, hw), covered)
            for source in layer.sources:
                needed[source] += [self._window(layer, rect) for rect in rects[layer]]
        return rects

    def _region(self, layer: Layer, regions: Mapping[Layer, Region]) -> Region:
        before = regions[layer.sources[0]]
        for source in layer.sources[1:]:
            before = before.joined(regions[source])
        if isinstance(layer, Sliding):
            return before.reached(layer.span, self.hw[layer])
        if isinstance(layer, Enlarged):
            around = before if layer.mode == "nearest" else before.reached(_AROUND, before.hw)
            return around.enlarged(layer.factor)
        return before

    def _window(self, layer: Layer, rect: Rect) -> Rect:
        """What a layer takes of its sources for a rectangle: beyond them only what is filled."""
        if not layer.sources:
            return rect
        source = Rect(0, self.hw[layer.sources[0]][0], 0, self.hw[layer.sources[0]][1])
        if isinstance(layer, Sliding):
            window = layer.span.window(rect)
            return window.meet(source) if isinstance(layer, Pooled) and not any(layer.padding) else window
        if isinstance(layer, Enlarged):
            f = layer.factor
            small = Rect(rect.top // f, -(-rect.bottom // f), rect.left // f, -(-rect.right // f))
            return (small if layer.mode == "nearest" else _AROUND.window(small)).meet(source)
        return rect

    def _gathered(self, layer: Layer, rect: Rect, rects: Mapping[Layer, tuple[Rect, ...]]) -> tuple[Gathered, ...]:
        found = []
        for taker in dict.fromkeys(self.takers[layer]):
            if not (isinstance(taker, Convolved) and taker.plain):
                continue
            stride, (top, left) = taker.stride[0], taker.span.before
            taps = -(-taker.kernel[0] // stride) - 1
            first = (rect.top + top) // stride, (rect.left + left) // stride
            end = (rect.bottom - 1 + top) // stride + 1, (rect.right - 1 + left) // stride + 1
            window = Rect(first[0] - taps, end[0], first[1] - taps, end[1])
            reading = Reading.of(window, rects[taker], self.hw[taker], False)
            if not reading.pieces:
                continue
            corner = rect.top + top - stride * first[0], rect.left + left - stride * first[1]
            cut = tuple(slice(at, at + side) for at, side in zip(corner, rect.hw, strict=True))
            found += [
                Gathered(taker, number, reading, (cut[0], cut[1]))
                for number, source in enumerate(taker.sources)
                if source is layer
            ]
        return tuple(found)

    def _cost(self, rects: Mapping[Layer, Sequence[Rect]]) -> float:
        """In multiply-adds, as far as it depends on rectangles."""
        total = 0.0
        for layer, several in rects.items():
            area = sum(rect.area for rect in several)
            work = layer.channels * _A_NUMBER
            if isinstance(layer, Convolved):
                work += layer.channels * float(layer.weight[0].numel())
            total += area * work + len(several) * _A_CALL
        return total


@dataclass(frozen=True, slots=True)
class Plan:
    """steps: of all layers; share: of the cost of a whole pass."""

    steps: tuple[Step, ...]
    share: float


def _shared(rect: Rect, others: Sequence[Rect]) -> tuple[Slices, ...]:
    """Rows and columns of a rectangle that others have too."""
    return tuple(shared.inside(rect) for other in others if (shared := rect.meet(other)).area)


def _cover(region: Region, known: dict[bytes, tuple[Rect, ...]]) -> tuple[Rect, ...]:
    key = region.top.tobytes() + region.bottom.tobytes()
    if key not in known:
        known[key] = region.rects()
    return known[key]


def _read_beyond(graph: Graph) -> set[Layer]:
    """Layers of which others read places that cannot differ, beside some that can. Not those of which a maximum
    takes a part, such as a stem's, which are large: they are computed anew a row further.
    """
    reach: dict[Layer, int] = {}
    jump: dict[Layer, float] = {}
    found: set[Layer] = set()
    for layer in graph.layers:
        if not layer.sources:
            reach[layer], jump[layer] = 0, 1.0
            continue
        furthest = max(reach[source] for source in layer.sources)
        found |= {source for source in layer.sources if reach[source] < furthest}
        jump[layer] = jump[layer.sources[0]]
        reach[layer] = furthest
        if isinstance(layer, Sliding):
            extent = max(layer.span.extent)
            reach[layer] += int((extent - 1) * jump[layer])
            jump[layer] *= layer.stride[0]
            if extent > 1 and not (isinstance(layer, Pooled) and min(layer.stride) > 1):
                found |= set(layer.sources)
        elif isinstance(layer, Enlarged):
            jump[layer] /= layer.factor
            if layer.mode != "nearest":
                reach[layer] += int(2 * jump[layer] * layer.factor)
                found |= set(layer.sources)
    sliding: dict[Layer, bool] = {}
    for layer in graph.layers:
        for source in layer.sources:
            slides = isinstance(layer, Sliding) and max(layer.span.extent) > 1
            sliding[source] = sliding.get(source, False) or slides
    # What a convolution of single places makes of kept layers is as soon made as read.
    return {
        layer
        for layer in found
        if sliding[layer]
        or not (isinstance(layer, Convolved) and layer.span.extent == (1, 1) and found.issuperset(layer.sources))
    }
