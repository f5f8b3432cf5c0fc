"""Gradients for ONNX graphs: the graph as a torch module, converted by onnx2pytorch and compared with ONNX Runtime.

onnx2pytorch converts more than onnx2torch (of one network exported in 30 layouts all instead of 26) and is maintained.
Detections come from ONNX Runtime, which is faster; passes with a gradient go through the converted module, tile by
tile, with the same preparation of the image. A gradient thus sees all that a detection sees.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors import boxes
from detectors.adapters.dense import BatchNormGradientFix, DenseDetector, DensePredictions
from detectors.adapters.onnx import INSIDE, OnnxPredictor, is_cut_by_tile
from detectors.base import Candidates, DetectorError, Predictor
from detectors.types import Detections

MAX_DIFFERENCE = 1e-3
"""Largest difference from ONNX Runtime in logits of scores; boxes may differ by 100 times as many px."""
MAX_HALF_DIFFERENCE = 3e-2
"""The same for graphs that compute in half precision, because libraries round in different places."""
_LEAST_PROBABILITY = 1e-3
"""Lower scores are not compared."""
_COMPARED = 100
"""Predictions that are compared, best first."""


class OnnxDetector(DenseDetector):
    """An ONNX detector with a gradient."""

    def __init__(self, predictor: OnnxPredictor, network: nn.Module) -> None:
        """network: the converted graph of `predictor`."""
        super().__init__(predictor.name, predictor.classes)
        self.t_star = getattr(predictor, "t_star", self.t_star)
        self.network = network
        self._predictor = predictor

    def predict(self, images: Tensor) -> DensePredictions:
        """Run the graph on every tile of every image; by ONNX Runtime where no gradient is needed."""
        predictor, graph = self._predictor, self._predictor.graph
        image_hw = int(images.shape[2]), int(images.shape[3])
        tiles = predictor.tiles(*image_hw)
        differentiable = torch.is_grad_enabled() and images.requires_grad
        is_exact = differentiable or images.dtype != torch.float32 or images.device.type != "cpu"
        run = (lambda *given: graph.run_converted(self.network, *given)) if is_exact else graph.run
        with BatchNormGradientFix():
            found = [[predictor.predict_tile(image, tile, run) for tile in tiles] for image in images]
        tile_counts = tuple(tuple(len(scores) for _, scores in of_tiles) for of_tiles in found)
        most = max(sum(counts) for counts in tile_counts)
        # Padded with boxes of no size and no probability, so that images share one tensor.
        padding = [(0, 0, 0, most - sum(counts)) for counts in tile_counts]
        stacked = [
            torch.stack([F.pad(torch.cat(parts), pad) for parts, pad in zip(kind, padding, strict=True)])
            for kind in zip(*([[b for b, _ in one], [s for _, s in one]] for one in found), strict=True)
        ]
        return DensePredictions(
            stacked[0][:, :, None],
            stacked[1],
            image_hw,
            counts=tuple(map(sum, tile_counts)),
            tile_counts=tile_counts,
        )

    @torch.no_grad()
    def decode(self, raw: DensePredictions) -> list[Detections]:
        """The detections of all tiles, merged; ONNX Runtime's detector gives the same."""
        return [self._merge(raw, image)[0] for image in range(len(raw))]

    def candidates(self, raw: DensePredictions) -> Candidates:
        """Every prediction; those at a tile border that are part of a complete detection have no score."""
        found = super().candidates(raw)
        (rows,) = raw.tile_counts
        if len(rows) == 1:
            return found
        with torch.no_grad():
            detections, is_cut = self._merge(raw, 0)
            edges = raw.boxes_xyxy[0, :, 0]
            parts = zip(self._predictor.tiles(*raw.image_hw), edges.split(rows), strict=True)
            cut = torch.cat([is_cut_by_tile(part, tile, raw.image_hw) for tile, part in parts])
            inside = boxes.ioa_matrix(edges, detections.boxes_xyxy[~is_cut]) > INSIDE
            classes = F.one_hot(detections.labels[~is_cut], len(self.classes))
            is_part = cut[:, None] & (inside.to(classes.dtype) @ classes > 0)
        return Candidates(found.boxes_xyxy, found.log_scores.masked_fill(is_part, float(found.log_scores.min())))

    def _merge(self, raw: DensePredictions, image: int) -> tuple[Detections, Tensor]:
        rows = list(raw.tile_counts[image])
        edges = raw.boxes_xyxy[image, : sum(rows), 0].detach().float()
        scores = raw.probabilities[image, : sum(rows)].detach().float()
        tiles = self._predictor.tiles(*raw.image_hw)
        return self._predictor.merge(
            list(zip(tiles, edges.split(rows), scores.split(rows), strict=True)), raw.image_hw
        )


def load_onnx(
    path: Path, tiling: str = "auto", spec: Path | None = None, device: str | torch.device = "cpu"
) -> Predictor:
    """An ONNX detector: with a gradient if its graph can be converted, else without, with the reason as
    `gradient_obstacle`.

    Args:
        path: The ONNX file.
        tiling: As for `OnnxPredictor`.
        spec: YAML file of settings.
        device: Of passes with a gradient.

    Raises:
        DetectorError: As `OnnxPredictor`.
    """
    predictor = OnnxPredictor(path, tiling, spec)
    try:
        facts = path.stat()
        network = convert_graph(path, str(device), facts.st_mtime_ns, facts.st_size)
        detector = OnnxDetector(predictor, network).requires_grad_(False)
        _compare(detector, device)
    except DetectorError as error:
        predictor.gradient_obstacle = str(error)
        return predictor
    return detector


@lru_cache(maxsize=4)
def convert_graph(path: Path, device: str, mtime_ns: int, size: int) -> nn.Module:
    """The graph of an ONNX file as a frozen torch module, converted once a process.

    Args:
        path: The ONNX file.
        device: Of its weights.
        mtime_ns: When the file was written: another file is converted again.
        size: Its bytes.

    Raises:
        DetectorError: onnx2pytorch is missing, or an operator cannot be converted.
    """
    try:
        onnx: Any = importlib.import_module("onnx")
        converter = _import_converter()
    except ImportError as error:
        raise DetectorError(f"needs {error.name}: pip install 'drivesem[onnx]'") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            network: nn.Module = converter.ConvertModel(onnx.load(str(path)))
    except Exception as error:  # the converter raises errors of all kinds
        raise DetectorError(_describe_failure(error)) from None
    for module in list(network.modules()):
        for name, child in module.named_children():
            if type(child).__name__ == "NonMaxSuppression":
                setattr(module, name, BoxSuppression(bool(getattr(child, "center_point_box", 0))))
    return network.requires_grad_(False).eval().to(device)


class BoxSuppression(nn.Module):
    """ONNX's NonMaxSuppression; the converter's compares all boxes in a Python loop."""

    def __init__(self, is_centre: bool) -> None:
        super().__init__()
        self._is_centre = is_centre

    def forward(
        self,
        boxes_xyxy: Tensor,
        scores: Tensor,
        most: Tensor | int = 0,
        iou: Tensor | float = 0.0,
        least: Tensor | float = float("-inf"),
    ) -> Tensor:
        """Indices (K, 3) int64 of image, class and box, from boxes (B, A, 4) and scores (B, C, A).

        Args:
            boxes_xyxy: Two opposite corners, or centre and size.
            scores: Of every class and box.
            most: Boxes a class.
            iou: Largest IoU of two remaining boxes.
            least: Scores must exceed it.
        """
        first, second = boxes_xyxy[..., :2], boxes_xyxy[..., 2:]
        if self._is_centre:
            first, second = first - second / 2, first + second / 2
        corners = torch.cat((torch.minimum(first, second), torch.maximum(first, second)), -1)
        chosen = [torch.zeros((0, 3), dtype=torch.int64, device=scores.device)]
        for image in range(scores.shape[0]):
            for label in range(scores.shape[1]):
                column = scores[image, label]
                rows = (column > float(least)).nonzero()[:, 0]
                rows = rows[boxes.nms(corners[image, rows], column[rows], float(iou))[: int(most)]]
                where = rows.new_tensor([image, label]).expand(len(rows), 2)
                chosen.append(torch.cat((where, rows[:, None]), 1))
        return torch.cat(chosen)


def _import_converter() -> ModuleType:
    """onnx2pytorch. It imports torchvision for a few operators: where torchvision is missing or does not fit torch,
    a stand-in takes its place during the import, and a graph with these operators is not converted.
    """
    try:
        importlib.import_module("torchvision.ops")
    except Exception:  # a torchvision of another torch raises RuntimeError
        with _stand_in_torchvision():
            return importlib.import_module("onnx2pytorch")
    return importlib.import_module("onnx2pytorch")


_STAND_INS = {
    "torchvision": (),
    "torchvision.ops": ("deform_conv2d", "roi_align", "roi_pool"),
    "torchvision.io": ("decode_image", "ImageReadMode"),
}
"""What onnx2pytorch imports of torchvision."""


@contextmanager
def _stand_in_torchvision() -> Iterator[None]:
    before = {name: module for name, module in sys.modules.items() if name.split(".")[0] == "torchvision"}
    for name in before:
        del sys.modules[name]
    for name, members in _STAND_INS.items():
        module = sys.modules[name] = ModuleType(name)
        for member in members:
            setattr(module, member, _raise_without_torchvision)
    sys.modules["torchvision"].ops = sys.modules["torchvision.ops"]  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        for name in _STAND_INS:
            del sys.modules[name]
        sys.modules.update(before)


def _raise_without_torchvision(*_: Any, **__: Any) -> Any:
    """Take the place of an operator of torchvision; `_convert` names it as the operator that stands in the way."""
    raise NotImplementedError("needs a torchvision that fits this torch")


def _compare(detector: OnnxDetector, device: str | torch.device) -> None:
    """Raise DetectorError unless the converted graph gives what ONNX Runtime gives, with a gradient."""
    predictor = detector._predictor  # pyright: ignore[reportPrivateUsage]
    height, width = predictor.input_hw
    coarse = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    picture = F.interpolate(coarse, (height, width), mode="bicubic", align_corners=False).clamp(0, 1)
    (tile,) = predictor.tiles(height, width)[:1]
    expected = predictor.predict_tile(picture[0], tile, predictor.graph.run)
    try:
        image = picture[0].to(device).requires_grad_(True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = predictor.predict_tile(
                image, tile, lambda *given: predictor.graph.run_converted(detector.network, *given)
            )
            gradient = torch.autograd.grad(found[1].sum(), image, allow_unused=True)[0]
    except Exception as error:  # the converter raises errors of all kinds
        raise DetectorError(_describe_failure(error)) from None
    if gradient is None or not bool(gradient.isfinite().all()):
        raise DetectorError("its scores have no finite gradient")
    is_half = any(
        tensor.dtype in (torch.float16, torch.bfloat16) for tensor in detector.network.state_dict().values()
    )
    limit = MAX_HALF_DIFFERENCE if is_half else MAX_DIFFERENCE
    difference = _largest_difference(expected, [tensor.detach().cpu() for tensor in found])
    if not difference <= limit:
        raise DetectorError(f"its conversion differs by {difference:.2g} of a logit, expected at most {limit:g}")


def _largest_difference(expected: Sequence[Tensor], found: Sequence[Tensor]) -> float:
    """Between the best expected predictions and the nearest found ones: logits, or hundreds of px of boxes."""
    features = []
    for edges, scores in (expected, found):
        logits = torch.logit(scores.float().clamp(_LEAST_PROBABILITY, 1 - _LEAST_PROBABILITY))
        features.append(torch.cat((edges.float() / 100, logits), 1))
    if not len(features[0]) or not len(features[1]):
        return 0.0 if len(features[0]) == len(features[1]) else float("inf")
    best = expected[1].max(1).values.topk(min(_COMPARED, len(features[0]))).indices
    return float(torch.cdist(features[0][best], features[1], p=float("inf")).min(1).values.max())


def _describe_failure(error: Exception) -> str:
    """The operator at which the converter or the converted graph failed, and why."""
    operator, trace = None, error.__traceback__
    while trace is not None:
        node = trace.tb_frame.f_locals.get("node")
        operator = getattr(node, "op_type", operator)
        trace = trace.tb_next
    reason = " ".join(str(error).split())[:120] or type(error).__name__
    return f"operator {operator or 'unknown'} cannot be converted ({reason})"
