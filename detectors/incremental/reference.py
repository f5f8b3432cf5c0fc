"""A picture whose layers are kept, and a detector's passes on pictures that differ from it in a few regions."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from detectors.base import Detector, RawPredictions, Trunk
from detectors.incremental.graph import Graph, Layer, UntraceableError
from detectors.incremental.passes import Changed, Picturing, forward
from detectors.incremental.plan import Plan, Shapes
from detectors.incremental.regions import Rect, Region

LIMIT_MB = 120.0
"""Of a picture's kept layers. Beyond it, more is computed anew around the regions."""
MOST_SHARE = 0.95
"""Of the cost of a whole pass, from which on that is taken: it has fewer calls and copies than its cost tells."""
AGREES = 1e-3
"""By how much logits of a whole pass may differ at most, the first time."""
_BLOCK = 8  # bytes of an int64
"""Pixels to which regions are rounded, so that the next step's often fit into this one's plan."""
_PLANS = 16
_AHEAD = 8
"""Pixels that each plan but the first reaches beyond what is asked for."""
_ROOM = 32
"""Pixels by which a plan's region may be larger than what is asked for: a new plan, oneDNN's first look at its
sizes included, takes as long as a tenth of a pass, and an attack's steps move cars only a little."""


class Incremental:
    """A detector's network, read once. `of` gives one for all who ask for the same weights.

    disagrees: whether a pass on a changed picture was other than the whole one; then all are whole.
    """

    _known: ClassVar[WeakKeyDictionary[Detector, tuple[object, Incremental | None]]] = WeakKeyDictionary()

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.disagrees = False
        self.compared = False
        self._shapes: dict[tuple[tuple[int, int], float], Shapes] = {}

    @classmethod
    def of(cls, detector: Detector) -> Incremental | None:
        """None where its layers are not known, or may change."""
        state = [(p.data_ptr(), p._version, p.dtype, p.requires_grad) for p in detector.parameters()]
        known = cls._known.get(detector)
        if known is None or known[0] != state:
            trunk = None if any(needs for *_, needs in state) else detector.trunk((64, 64))
            try:
                made = None if trunk is None else cls(Graph.of(trunk.network))
            except UntraceableError:
                made = None
            known = cls._known[detector] = (state, made)
        return known[1]

    def shapes(self, hw: tuple[int, int], limit_mb: float) -> Shapes:
        """For padded pictures of that size."""
        key = hw, limit_mb
        if key not in self._shapes:
            self._shapes[key] = Shapes.of(self.graph, hw, limit_mb * 1e6)
        return self._shapes[key]


@dataclass
class Reference:
    """An image (1, 3, H, W) and what the network's layers make of it. most_share: of a whole pass's cost, beyond
    which that is taken.
    """

    incremental: Incremental
    detector: Detector
    trunk: Trunk
    image: Tensor
    shapes: Shapes
    kept: dict[Layer, Tensor]
    most_share: float = MOST_SHARE
    _plans: list[tuple[Region, Plan]] = field(default_factory=list)

    @classmethod
    @torch.no_grad()
    def of(cls, detector: Detector, image: Tensor, limit_mb: float = LIMIT_MB) -> Reference | None:
        """None where the detector's layers are not known, and on what is no CPU. A pass over the whole image."""
        incremental = Incremental.of(detector)
        image_hw = (int(image.shape[2]), int(image.shape[3]))
        trunk = detector.trunk(image_hw)
        if incremental is None or trunk is None or incremental.disagrees or image.device.type != "cpu":
            return None
        picture = trunk.padded(image)
        hw = int(picture.shape[2]), int(picture.shape[3])
        shapes = incremental.shapes(hw, limit_mb)
        everywhere = Rect(0, hw[0], 0, hw[1])
        plan = shapes.plan(Region.of([everywhere], hw), everywhere)
        found, _ = forward(incremental.graph, plan, Picturing(picture), {}, shapes.kept)
        kept = {layer: parts[0] for layer, parts in found.items()}
        return cls(incremental, detector, trunk, image, shapes, kept)

    @property
    def bytes(self) -> int:
        """Of what is kept."""
        return sum(tensor.numel() * tensor.element_size() for tensor in self.kept.values())

    def __call__(self, image: Tensor, rects: Sequence[Rect] | None = None) -> RawPredictions:
        """What the detector says of an image of that size (1, 3, H, W); differentiable to it inside `rects` and
        wherever it differs from the reference.

        rects: in which a gradient is wanted; None where it may be wanted everywhere.
        """
        plan = None if rects is None or self.incremental.disagrees else self._plan(image, rects)
        if plan is None or plan.share > self.most_share:
            return self.detector(image)
        raw = self._changed(image, plan)
        if not self.incremental.compared:
            self.incremental.compared = True
            whole: RawPredictions = self.detector(image)
            worst = max(
                float((found - expected).detach().abs().max())
                for found, expected in (
                    (raw.confidence_logits, whole.confidence_logits),
                    (raw.class_logits, whole.class_logits),
                )
            )
            if not worst <= AGREES:
                self.incremental.disagrees = True
                sys.stderr.write(
                    f"drivesem: detector {self.detector.name}: passes on changed regions differ from whole ones "
                    f"by {worst:.2g} of a logit (at most {AGREES:g} is expected): whole passes from here on\n"
                )
                return whole
        return raw

    def _changed(self, image: Tensor, plan: Plan) -> RawPredictions:
        picture = Picturing(image.detach(), self.trunk.at, self.trunk.mean)
        outputs = Changed.apply(image, picture, self.incremental.graph, plan, self.kept)
        assert isinstance(outputs, tuple)
        return self.trunk.interpret(outputs, (int(image.shape[2]), int(image.shape[3])))

    @torch.no_grad()
    def _plan(self, image: Tensor, rects: Sequence[Rect]) -> Plan:
        """For those rectangles and what differs, in whole blocks."""
        changed = self._region(image, rects)
        around = changed.grown(_ROOM)
        for i, (region, plan) in enumerate(self._plans):
            if region.contains(changed) and around.contains(region):
                self._plans.insert(0, self._plans.pop(i))
                return plan
        # A plan for all of a frame's steps so far serves the next ones too, and those that go a little further.
        for region, _ in self._plans:
            if around.contains(region):
                changed = changed.joined(region)
        changed = changed.grown(_AHEAD) if self._plans else changed
        top, left = self.trunk.at
        within = Rect(top, top + changed.hw[0], left, left + changed.hw[1])
        moved = changed.placed((top, left), self.shapes.hw[self.incremental.graph.layers[0]])
        plan = self.shapes.plan(moved, within)
        self._plans.insert(0, (changed, plan))
        del self._plans[_PLANS:]
        return plan

    def _region(self, image: Tensor, rects: Sequence[Rect]) -> Region:
        height, width = int(image.shape[2]), int(image.shape[3])
        now, before = image.detach()[0].numpy(), self.image[0].numpy()  # numpy compares twice as fast
        differs = np.zeros((height + -height % _BLOCK, width + -width % _BLOCK), np.bool_)
        for first, second in zip(now, before, strict=True):
            differs[:height, :width] |= first != second
        # Eight columns of bytes are one number.
        blocks = (differs.view(np.int64) != 0).reshape(-1, _BLOCK, differs.shape[1] // _BLOCK).any(1)
        for rect in rects:
            seen = rect.meet(Rect(0, height, 0, width))
            if seen.area:
                rows = slice(seen.top // _BLOCK, -(-seen.bottom // _BLOCK))
                blocks[rows, seen.left // _BLOCK : -(-seen.right // _BLOCK)] = True
        return Region.of_blocks(blocks, _BLOCK, (height, width))
