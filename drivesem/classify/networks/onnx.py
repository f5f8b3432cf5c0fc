"""Classifiers in ONNX files, run by ONNX Runtime, without gradients."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from detectors.adapters import onnx
from detectors.adapters.spec import NetworkSpec, fit_images, load_settings, normalise_images
from detectors.base import DetectorError
from drivesem.classify.networks.base import IMAGENET_MEAN, IMAGENET_STD
from scene_ir.errors import FormatError, RangeError

_SETTINGS = ("size", "resize", "channels", "scale", "mean", "std", "classes")
"""Settings of the YAML file that apply to classifiers."""


class OnnxClassifier:
    """`ImageClassifier` of an ONNX file with one output of logits (B, C).

    An optional YAML file of the same name sets another order of `classes`, or another preprocessing than ImageNet's
    normalisation.
    """

    differentiable = False

    def __init__(self, path: Path, classes: Sequence[str]) -> None:
        """Open a file for these classes. Raises FormatError if it is damaged, or is for other classes."""
        try:
            session = onnx.open_session(path)
            settings = load_settings(path, None)
        except DetectorError as error:
            field, _, rest = str(error).partition(": ")
            raise FormatError(field, "an ONNX classifier", rest) from error
        unknown = settings.keys() - set(_SETTINGS)
        if unknown:
            raise FormatError(
                str(path.with_suffix(".yaml")), f"settings among {', '.join(_SETTINGS)}", min(unknown)
            )
        shape = list(session.get_inputs()[0].shape)
        outputs = [list(output.shape) for output in session.get_outputs()]
        if len(session.get_inputs()) != 1 or len(shape) != 4 or shape[1] != 3:
            raise FormatError(f"{path}: input", "one batch of pictures (B, 3, H, W)", shape)
        if isinstance(shape[0], int) and shape[0] != 1:
            raise FormatError(f"{path}: input", "a batch of any size, or of one picture", shape)
        if len(outputs) != 1 or len(outputs[0]) != 2 or outputs[0][1] not in (len(classes), None):
            raise FormatError(f"{path}: output", f"one score for each of the {len(classes)} classes", outputs)
        order = tuple(settings.pop("classes", classes))
        if sorted(order) != sorted(classes):
            raise FormatError(f"{path}: classes", ", ".join(classes), ", ".join(order))
        sides = [side if isinstance(side, int) else None for side in shape[2:]]
        fixed = None if None in sides else tuple(sides)
        size = settings.get("size")
        if size is not None and not all(
            side in (None, setting) for side, setting in zip(sides, size, strict=True)
        ):
            raise FormatError(
                f"{path.with_suffix('.yaml')}: size", f"{shape[2]} x {shape[3]}, as the graph has", size
            )
        defaults = {"resize": "stretch", "mean": IMAGENET_MEAN, "std": IMAGENET_STD, "size": fixed}
        self._spec = NetworkSpec(**(defaults | settings))
        self._session, self._input = session, session.get_inputs()[0].name
        self._order = [order.index(name) for name in classes]
        self.classes = tuple(classes)

    def __call__(self, images: Tensor) -> Tensor:
        """Compute scores before softmax (B, C) of pictures (B, 3, H, W), RGB in [0, 1], without gradient."""
        inputs = normalise_images(fit_images(images.detach().float().cpu(), self._spec)[0], self._spec)
        rows = [self._session.run(None, {self._input: one.numpy()})[0] for one in inputs.contiguous().split(1)]
        scores = torch.cat([torch.from_numpy(row) for row in rows])[:, self._order]
        if not bool(scores.isfinite().all()):
            raise RangeError("the network's scores", "finite numbers", "others")
        return scores.to(images.device)
