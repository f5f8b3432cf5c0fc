"""Classifiers as ONNX files, run by ONNX Runtime: they predict, and have no gradient."""

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

_ASKED = ("size", "resize", "channels", "scale", "mean", "std", "classes")
"""Of a YAML file's settings those that a classifier has."""


class OnnxClassifier:
    """`Scorer` of an ONNX file with one output (B, C) of logits, in the order of `classes`, unless FILE.yaml
    beside it lists its `classes` in another order. Pictures are taken less ImageNet's mean, over its deviation,
    unless that file says otherwise. Raises FormatError for a file that is none, or tells other classes apart.
    """

    differentiable = False

    def __init__(self, path: Path, classes: Sequence[str]) -> None:
        try:
            session = onnx.open_session(path)
            settings = load_settings(path, None)
        except DetectorError as error:
            field, _, rest = str(error).partition(": ")
            raise FormatError(field, "an ONNX classifier", rest) from error
        strange = settings.keys() - set(_ASKED)
        if strange:
            raise FormatError(str(path.with_suffix(".yaml")), f"settings among {', '.join(_ASKED)}", min(strange))
        shape = list(session.get_inputs()[0].shape)
        outputs = [list(output.shape) for output in session.get_outputs()]
        if len(session.get_inputs()) != 1 or len(shape) != 4 or shape[1] != 3:
            raise FormatError(f"{path}: input", "one batch of pictures (B, 3, H, W)", shape)
        if isinstance(shape[0], int) and shape[0] != 1:
            raise FormatError(f"{path}: input", "a batch of any size, or of one picture", shape)
        if len(outputs) != 1 or len(outputs[0]) != 2 or outputs[0][1] not in (len(classes), None):
            raise FormatError(f"{path}: output", f"one score for each of the {len(classes)} classes", outputs)
        own = tuple(settings.pop("classes", classes))
        if sorted(own) != sorted(classes):
            raise FormatError(f"{path}: classes", ", ".join(classes), ", ".join(own))
        sides = [side if isinstance(side, int) else None for side in shape[2:]]
        fixed = None if None in sides else tuple(sides)
        size = settings.get("size")
        if size is not None and not all(side in (None, given) for side, given in zip(sides, size, strict=True)):
            raise FormatError(
                f"{path.with_suffix('.yaml')}: size", f"{shape[2]} x {shape[3]}, as the graph has", size
            )
        usual = {"resize": "stretch", "mean": IMAGENET_MEAN, "std": IMAGENET_STD, "size": fixed}
        self._spec = NetworkSpec(**(usual | settings))
        self._session, self._input = session, session.get_inputs()[0].name
        self._order = [own.index(name) for name in classes]
        self.classes = tuple(classes)

    def __call__(self, images: Tensor) -> Tensor:
        """Scores (B, C) before softmax, of pictures (B, 3, H, W), RGB in [0, 1]; without a gradient."""
        fed = normalise_images(fit_images(images.detach().float().cpu(), self._spec)[0], self._spec)
        rows = [self._session.run(None, {self._input: one.numpy()})[0] for one in fed.contiguous().split(1)]
        scores = torch.cat([torch.from_numpy(row) for row in rows])[:, self._order]
        if not bool(scores.isfinite().all()):
            raise RangeError("the network's scores", "finite numbers", "others")
        return scores.to(images.device)
