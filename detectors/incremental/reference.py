"""A reference image with stored activations, and a detector's passes on images with a few changed regions."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from detectors.base import AnchorPredictions, Detector, DetectorStages
from detectors.incremental.graph import LayerGraph, NetworkLayer, UntraceableError
from detectors.incremental.passes import ChangedOutputs, ImageInput, forward
from detectors.incremental.plan import RecomputePlan, SizedGraph
from detectors.incremental.regions import ColumnRegion, Rect

LIMIT_MB = 120.0
"""Default limit of an image's stored activations; beyond it, more is recomputed around the regions."""
MAX_COST_SHARE = 0.95
"""Cost relative to a whole pass from which a whole pass is used: it has fewer calls and copies than its cost
suggests.
"""
MAX_LOGIT_DIFFERENCE = 1e-3
"""Largest difference of logits from a whole pass in the first comparison."""
_BLOCK = 8  # bytes of an int64
"""Pixels to which regions are rounded, so that the next step's region often fits the present plan."""
_PLANS = 16
_AHEAD = 8
"""Pixels by which all plans but the first exceed the requested region."""
_ROOM = 32
"""Pixels by which a plan's region may exceed the requested one. A new plan takes as long as a tenth of a pass,
with oneDNN's preparation for its sizes, and an attack's steps move cars only a little.
"""


class IncrementalNetwork:
    """A detector's traced network; `for_detector` shares one among all users of the same weights."""

    _known: ClassVar[WeakKeyDictionary[Detector, tuple[object, IncrementalNetwork | None]]] = WeakKeyDictionary()

    def __init__(self, graph: LayerGraph) -> None:
        self.graph = graph
        self.disagrees = False
        self.compared = False
        self._shapes: dict[tuple[tuple[int, int], float], SizedGraph] = {}

    @classmethod
    def for_detector(cls, detector: Detector) -> IncrementalNetwork | None:
        """The traced network; None if it is untraceable or its weights may change."""
        state = [(p.data_ptr(), p._version, p.dtype, p.requires_grad) for p in detector.parameters()]
        cached = cls._known.get(detector)
        if cached is None or cached[0] != state:
            detector_stages = None if any(needs for *_, needs in state) else detector.stages((64, 64))
            try:
                network = None if detector_stages is None else cls(LayerGraph.trace(detector_stages.network))
            except UntraceableError:
                network = None
            cached = cls._known[detector] = (state, network)
        return cached[1]

    def sized_graph(self, hw: tuple[int, int], limit_mb: float) -> SizedGraph:
        """The graph for padded images of that size."""
        key = hw, limit_mb
        if key not in self._shapes:
            self._shapes[key] = SizedGraph.for_size(self.graph, hw, limit_mb * 1e6)
        return self._shapes[key]


@dataclass
class ReferencePass:
    """A reference image (1, 3, H, W) with its activations. Call it with a changed image."""

    incremental: IncrementalNetwork
    """The traced network."""
    detector: Detector
    """The detector."""
    stages: DetectorStages
    """Its padding and decoding."""
    image: Tensor
    """(1, 3, H, W), RGB in [0, 1]."""
    sized_graph: SizedGraph
    """The graph for this image's size."""
    activations: dict[NetworkLayer, Tensor]
    """Of the stored layers."""
    max_cost_share: float = MAX_COST_SHARE
    """Cost relative to a whole pass above which a whole pass is used."""
    _plans: list[tuple[ColumnRegion, RecomputePlan]] = field(default_factory=list)
    """Recent plans with their regions, latest first."""

    @classmethod
    @torch.no_grad()
    def run(cls, detector: Detector, image: Tensor, limit_mb: float = LIMIT_MB) -> ReferencePass | None:
        """Run the detector on a reference image.

        Args:
            detector: A frozen detector.
            image: (1, 3, H, W), RGB in [0, 1].
            limit_mb: Limit of the stored activations.

        Returns:
            None if the network is untraceable, or the image is not on the CPU.
        """
        incremental = IncrementalNetwork.for_detector(detector)
        image_hw = (int(image.shape[2]), int(image.shape[3]))
        detector_stages = detector.stages(image_hw)
        if incremental is None or detector_stages is None or incremental.disagrees or image.device.type != "cpu":
            return None
        padded_image = detector_stages.pad_image(image)
        hw = int(padded_image.shape[2]), int(padded_image.shape[3])
        shapes = incremental.sized_graph(hw, limit_mb)
        everywhere = Rect(0, hw[0], 0, hw[1])
        plan = shapes.plan(ColumnRegion.from_rects([everywhere], hw), everywhere)
        found, _ = forward(incremental.graph, plan, ImageInput(padded_image), {}, shapes.stored)
        activations = {layer: parts[0] for layer, parts in found.items()}
        return cls(incremental, detector, detector_stages, image, shapes, activations)

    @property
    def bytes(self) -> int:
        """Size of the stored activations."""
        return sum(tensor.numel() * tensor.element_size() for tensor in self.activations.values())

    def __call__(self, image: Tensor, rects: Sequence[Rect] | None = None) -> AnchorPredictions:
        """The detector's predictions for an image of the same size; differentiable inside `rects` and wherever it
        differs from the reference.

        Args:
            image: (1, 3, H, W), RGB in [0, 1].
            rects: Where a gradient is needed; None for everywhere.
        """
        plan = None if rects is None or self.incremental.disagrees else self._plan(image, rects)
        if plan is None or plan.cost_share > self.max_cost_share:
            return self.detector(image)
        raw = self._changed(image, plan)
        if not self.incremental.compared:
            self.incremental.compared = True
            whole: AnchorPredictions = self.detector(image)
            worst = max(
                float((found - expected).detach().abs().max())
                for found, expected in (
                    (raw.confidence_logits, whole.confidence_logits),
                    (raw.class_logits, whole.class_logits),
                )
            )
            if not worst <= MAX_LOGIT_DIFFERENCE:
                self.incremental.disagrees = True
                sys.stderr.write(
                    f"drivesem: detector {self.detector.name}: incremental passes differ from whole ones by "
                    f"{worst:.2g} in a logit (limit {MAX_LOGIT_DIFFERENCE:g}): whole passes from now on\n"
                )
                return whole
        return raw

    def _changed(self, image: Tensor, plan: RecomputePlan) -> AnchorPredictions:
        padded_image = ImageInput(image.detach(), self.stages.image_origin, self.stages.mean)
        outputs = ChangedOutputs.apply(image, padded_image, self.incremental.graph, plan, self.activations)
        assert isinstance(outputs, tuple)
        return self.stages.interpret(outputs, (int(image.shape[2]), int(image.shape[3])))

    @torch.no_grad()
    def _plan(self, image: Tensor, rects: Sequence[Rect]) -> RecomputePlan:
        """The plan for the rectangles and all differences, in whole blocks."""
        changed = self._region(image, rects)
        allowed = changed.dilate(_ROOM)
        for i, (region, plan) in enumerate(self._plans):
            if region.contains(changed) and allowed.contains(region):
                self._plans.insert(0, self._plans.pop(i))
                return plan
        # A plan for all steps so far also serves the next ones and those that go a little further.
        for region, _ in self._plans:
            if allowed.contains(region):
                changed = changed.union(region)
        changed = changed.dilate(_AHEAD) if self._plans else changed
        top, left = self.stages.image_origin
        within = Rect(top, top + changed.hw[0], left, left + changed.hw[1])
        moved = changed.embed((top, left), self.sized_graph.hw[self.incremental.graph.layers[0]])
        plan = self.sized_graph.plan(moved, within)
        self._plans.insert(0, (changed, plan))
        del self._plans[_PLANS:]
        return plan

    def _region(self, image: Tensor, rects: Sequence[Rect]) -> ColumnRegion:
        height, width = int(image.shape[2]), int(image.shape[3])
        now, before = image.detach()[0].numpy(), self.image[0].numpy()  # numpy compares twice as fast
        differs = np.zeros((height + -height % _BLOCK, width + -width % _BLOCK), np.bool_)
        for first, second in zip(now, before, strict=True):
            differs[:height, :width] |= first != second
        # Eight columns of bytes form one int64.
        blocks = (differs.view(np.int64) != 0).reshape(-1, _BLOCK, differs.shape[1] // _BLOCK).any(1)
        for rect in rects:
            visible = rect.intersect(Rect(0, height, 0, width))
            if visible.area:
                rows = slice(visible.top // _BLOCK, -(-visible.bottom // _BLOCK))
                blocks[rows, visible.left // _BLOCK : -(-visible.right // _BLOCK)] = True
        return ColumnRegion.from_blocks(blocks, _BLOCK, (height, width))
