"""Object detection models of Hugging Face's transformers: DETR, RT-DETR, YOLOS, Deformable DETR and their relatives."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from detectors.adapters.network import NetworkDetector
from detectors.adapters.spec import (
    BACKGROUND_NAMES,
    MAX_SIDE,
    NO_CLASS,
    NetworkSpec,
    load_spec,
    with_project_names,
)
from detectors.base import DetectorError
from detectors.files import read_text

_PREPROCESSING = "preprocessor_config.json"
_MAX_JSON_BYTES = 1 << 20
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class HuggingFaceDetector(NetworkDetector):
    """A model of transformers, with the input of its image processor."""

    def __init__(
        self, name: str, model: nn.Module, settings: dict[str, Any], edges: tuple[int, int] | None, where: str
    ) -> None:
        """Run the model once to recognise its outputs.

        Args:
            name: The detector's name.
            model: The model.
            settings: Of a `NetworkSpec`.
            edges: Shorter side of the input and largest longer side, px; None for an input of fixed size.
            where: Beginning of error messages.
        """
        self._edges = edges
        super().__init__(name, model, settings, where=where)

    def input_spec(self, image_hw: tuple[int, int], spec: NetworkSpec) -> NetworkSpec:
        """The settings for an image of this size, px: its proportions remain where the processor preserves them."""
        if self._edges is None:
            return spec
        shorter, longer = float(min(image_hw)), float(max(image_hw))
        target = self._edges[0]
        if longer / shorter * target > self._edges[1]:
            target = round(self._edges[1] * shorter / longer)
        first, second = image_hw
        other = int(target * longer / shorter)
        return replace(spec, size=(target, other) if first <= second else (other, target))


def load_hugging_face(name: str, spec: Path | None = None) -> HuggingFaceDetector:
    """A model of transformers by its folder, or by its name in Hugging Face's hub or cache; runs no code of it.

    Args:
        name: A folder written by `save_pretrained`, or a name.
        spec: YAML file of settings, which override the model's.

    Raises:
        DetectorError: The library is missing, or there is no such model.
    """
    where = f"hf:{name}"
    try:
        import transformers  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise DetectorError(f"{where}: needs transformers: pip install 'drivesem[transformers]'") from None
    try:
        model: Any = transformers.AutoModelForObjectDetection.from_pretrained(name)
        file = transformers.utils.cached_file(name, _PREPROCESSING, _raise_exceptions_for_missing_entries=False)
    except Exception as error:  # the library raises errors of many kinds
        found = " ".join(str(error).split())[:300]
        raise DetectorError(
            f"{where}: expected an object detection model of transformers, found {found}"
        ) from None
    settings, edges = _input_settings(None if file is None else Path(file))
    labels = model.config.id2label
    names = with_project_names(
        NO_CLASS if labels.get(i) in (None, *BACKGROUND_NAMES) else str(labels[i]) for i in range(len(labels))
    )
    named = settings | {"format": "detr", "boxes": "cxcywh", "normalised": True, "classes": names}
    own = {} if spec is None else load_spec(spec)
    network = _Outputs(model.float().eval(), softmax_columns=len(own.get("classes", names)) + 1)
    return HuggingFaceDetector(Path(name).name, network, named | {"activation": "none"} | own, edges, where)


class _WithoutDetach(TorchFunctionMode):
    """Makes `Tensor.detach` do nothing. Models cut gradients between the stages of their decoder, for training: without
    the cuts, gradients agree with differences.
    """

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return args[0] if func is Tensor.detach else func(*args, **(kwargs or {}))


class _Outputs(nn.Module):
    """A model reduced to probabilities and boxes, with scores as its family computes them."""

    def __init__(self, model: nn.Module, softmax_columns: int) -> None:
        """softmax_columns: columns of scores that are exclusive, the last for no object; others are independent."""
        super().__init__()
        self.model = model
        self._softmax_columns = softmax_columns

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        with _WithoutDetach():
            given = self.model(pixel_values=images)
        logits = given.logits
        exclusive = logits.shape[-1] == self._softmax_columns
        scores = logits.softmax(-1)[..., :-1] if exclusive else logits.sigmoid()
        return given.pred_boxes, scores


def _input_settings(file: Path | None) -> tuple[dict[str, Any], tuple[int, int] | None]:
    """Settings of a `NetworkSpec` from an image processor's file, and its shorter side and largest longer side in px,
    if the image's proportions remain. Without a file, DETR's.
    """
    facts: dict[str, Any] = {}
    if file is not None:
        try:
            facts = json.loads(read_text(file, "an image processor's file", _MAX_JSON_BYTES))
        except ValueError as error:
            raise DetectorError(f"{file}: expected JSON, found {error}") from None
    try:
        size = facts.get("size", {"shortest_edge": 800, "longest_edge": 1333})
        size = (
            {"shortest_edge": size, "longest_edge": facts.get("max_size", 1333)} if isinstance(size, int) else size
        )
        settings: dict[str, Any] = {"resize": "stretch", "scale": 1.0, "mean": (0.0,) * 3, "std": (1.0,) * 3}
        if facts.get("do_rescale", True):
            settings["scale"] = 255 * float(facts.get("rescale_factor", 1 / 255))
        if facts.get("do_normalize", True):
            settings |= {
                "mean": tuple(map(float, facts.get("image_mean", _MEAN))),
                "std": tuple(map(float, facts.get("image_std", _STD))),
            }
        if "height" in size:
            return settings | {"size": (int(size["height"]), int(size["width"]))}, None
        edges = int(size["shortest_edge"]), int(size.get("longest_edge", MAX_SIDE))
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise DetectorError(f"{file}: expected the settings of an image processor, found {error!r}") from None
    return settings, edges
