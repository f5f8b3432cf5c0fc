"""A network that gives boxes and scores as a detector with gradients: TorchScript and torch.export files, modules.

It sees one image at a time: traced and exported graphs are made for one size of batch, and networks that suppress
give each image another number of boxes.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors.adapters import coco
from detectors.adapters.dense import LEAST_SCORE, NMS_IOU, T_STAR, DenseDetector, DensePredictions
from detectors.adapters.formats import Reading, flat, reading
from detectors.adapters.spec import Spec, fit, prepare, settings_of
from detectors.base import DetectorError

PROBE_HW = (128, 256)
"""Size of the first image that a network of any size is shown, to see what it gives: a multiple of all strides."""
_ULTRALYTICS_FACTS = "config.txt"
"""Name of the part of a TorchScript file in which Ultralytics' export keeps what it knows."""


class NetworkDetector(DenseDetector):
    """A network, its settings, and `dense.DenseDetector`'s loss and decoding.

    network: a module, or any callable of images. settings: of a `Spec`; they win over what the format usually
    has. names: of classes, as the file has them. Raises DetectorError, beginning with `where`, where the network
    takes no such image, or gives what no format reads.
    """

    def __init__(
        self,
        name: str,
        network: Callable[[Any], Any],
        settings: Mapping[str, Any],
        names: tuple[str, ...] | None = None,
        where: str = "detector",
    ) -> None:
        super().__init__(name, (), T_STAR)
        if isinstance(network, nn.Module) and not isinstance(network, torch.fx.GraphModule):
            self.network = network
        elif isinstance(network, nn.Module):
            network.requires_grad_(False)
        # An exported module refuses train() and eval(): it is held where nn.Module does not look.
        self._call = (network,)
        self._reading: Reading | None = None
        self._settings = dict(settings)
        self._probe(names, where)

    def predict(self, images: Tensor) -> DensePredictions:
        """Each image fitted, shown to the network, and its boxes brought back."""
        form = self._reading
        assert form is not None
        found = [self._of_one(image[None], form) for image in images]
        counts = tuple(int(scores.shape[1]) for _, scores in found)
        most = max(counts)
        # Filled up with boxes of no size and no probability, so that images share one tensor.
        boxes = torch.cat([F.pad(b, (0, 0, 0, most - b.shape[1])) for b, _ in found])
        scores = torch.cat([F.pad(s, (0, 0, 0, most - s.shape[1])) for _, s in found])
        image_hw = int(images.shape[2]), int(images.shape[3])
        return DensePredictions(boxes[:, :, None], scores, image_hw, counts=counts)

    def _of_one(self, image: Tensor, form: Reading) -> tuple[Tensor, Tensor]:
        fed, fitted = fit(image, form.spec)
        boxes, scores = form.read(self._outputs(fed, form.spec), (int(fed.shape[2]), int(fed.shape[3])))
        return fitted.back(boxes), scores

    def _outputs(self, fed: Tensor, spec: Spec) -> list[Tensor]:
        given: Any = prepare(fed, spec)
        if spec.input != "batch":
            given = given[0] if spec.input == "image" else [given[0]]
        return flat(self._call[0](given))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """What moves and converts a module, for the one that it does not see too."""
        network = self._call[0]
        if isinstance(network, torch.fx.GraphModule):
            network._apply(fn, recurse)
        return super()._apply(fn, recurse)

    @torch.no_grad()
    def _probe(self, names: tuple[str, ...] | None, where: str) -> None:
        """See what the network gives for a grey image, and settle how it is read."""
        asked = replace(Spec(), **self._settings)
        size = asked.size or PROBE_HW
        try:
            outputs = self._outputs(torch.full((1, 3, *size), 0.5), asked)
        except (RuntimeError, TypeError, ValueError, AssertionError) as error:
            raise DetectorError(
                f"{where}: expected a network that takes an image of {size[0]} x {size[1]} px (`size` and `input` "
                f"in a YAML file say otherwise), found {_last_line(error)}"
            ) from error
        shapes = [tuple(output.shape) for output in outputs]
        found = reading(shapes, size, self._settings, names, where)
        spec = found.spec
        self._reading = found
        self.classes = found.classes
        self.t_star = T_STAR if spec.t_star is None else spec.t_star
        self.nms_iou = NMS_IOU if spec.nms_iou is None else spec.nms_iou
        self.least_score = LEAST_SCORE if spec.least_score is None else spec.least_score


def torchscript(path: Path, spec: Path | None = None) -> NetworkDetector:
    """A TorchScript file as a detector. Loading one runs what is in it: see docs/detectors.md.

    Raises DetectorError where it is none.
    """
    settings = _settings(path, spec, "a TorchScript file")
    facts = {_ULTRALYTICS_FACTS: ""}
    try:
        with warnings.catch_warnings():
            # torch has a successor for new files; these are there.
            for kind in (DeprecationWarning, FutureWarning):
                warnings.simplefilter("ignore", kind)
            network = torch.jit.load(str(path), map_location="cpu", _extra_files=facts).eval()
    except (RuntimeError, ValueError) as error:
        raise DetectorError(f"{path}: expected a TorchScript file, found {_last_line(error)}") from None
    names, size = _ultralytics(facts[_ULTRALYTICS_FACTS])
    if size is not None:
        settings.setdefault("size", size)
    return NetworkDetector(path.stem, network, settings, names, where=str(path))


def exported(path: Path, spec: Path | None = None) -> NetworkDetector:
    """A program of `torch.export.save` as a detector, of its own input size where that is fixed.

    Raises DetectorError where it is none.
    """
    settings = _settings(path, spec, "a program of torch.export")
    try:
        program = torch.export.load(str(path))
    except Exception as error:  # its reader raises whatever its parts do: zip, JSON, schema
        raise DetectorError(f"{path}: expected a program of torch.export, found {_last_line(error)}") from None
    size = _exported_size(program)
    if size is not None:
        settings.setdefault("size", size)
    return NetworkDetector(path.stem, program.module(), settings, where=str(path))


def _settings(path: Path, spec: Path | None, what: str) -> dict[str, Any]:
    if not path.is_file():
        raise DetectorError(f"{path}: expected {what}, found none")
    return settings_of(path, spec)


def _exported_size(program: torch.export.ExportedProgram) -> tuple[int, int] | None:
    """Height and width px of the image that a program takes, where they are fixed."""
    for node in program.graph.nodes:
        if node.op == "placeholder" and node.name in program.graph_signature.user_inputs:
            shape = node.meta["val"].shape
            if len(shape) >= 3 and all(isinstance(side, int) for side in shape[-2:]):
                return int(shape[-2]), int(shape[-1])
    return None


def _ultralytics(text: str) -> tuple[tuple[str, ...] | None, tuple[int, int] | None]:
    """Classes and input size (height, width) px as Ultralytics' export writes them into a TorchScript file."""
    try:
        facts = json.loads(text)
        names = coco.ours(str(facts["names"][str(i)]) for i in range(len(facts["names"])))
        high, wide = facts["imgsz"]
        return names, (int(high), int(wide))
    except (ValueError, TypeError, KeyError):
        return None, None


def _last_line(error: Exception) -> str:
    """The end of a message of torch: what went wrong stands there."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
