"""Networks as differentiable detectors: torch modules, TorchScript and torch.export files, Ultralytics models.

A network gets one image at a time: traced and exported graphs have a fixed batch size, and networks with built-in
suppression return another number of boxes for each image.
"""

from __future__ import annotations

import importlib.util
import inspect
import json
import pkgutil
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors.adapters.dense import (
    LEAST_SCORE,
    NMS_IOU,
    T_STAR,
    BatchNormGradientFix,
    DenseDetector,
    DensePredictions,
)
from detectors.adapters.formats import OutputDecoder, flatten_outputs, make_decoder
from detectors.adapters.function import FunctionPredictor
from detectors.adapters.maite import adapt_maite_model, is_maite_model
from detectors.adapters.spec import (
    NetworkSpec,
    fit_images,
    load_settings,
    load_spec,
    normalise_images,
    validate_settings,
    with_project_names,
)
from detectors.base import Detector, DetectorError, Predictor, describe_error, detector_device
from detectors.types import Detections, Targets

PROBE_HW = (128, 256)
"""Size of the first image for a network of any size, px: a multiple of all strides."""
_ULTRALYTICS_FACTS = "config.txt"
"""Name of the metadata file in a TorchScript file from Ultralytics."""


class NetworkDetector(DenseDetector):
    """A network with `DenseDetector`'s loss and decoding."""

    def __init__(
        self,
        name: str,
        network: Callable[[Any], Any],
        settings: Mapping[str, Any],
        names: tuple[str, ...] | None = None,
        where: str = "detector",
    ) -> None:
        """Run the network once to recognise its outputs.

        Args:
            name: The detector's name.
            network: A module, or any callable of images.
            settings: Settings of a `NetworkSpec` that override the format's.
            names: Class names from the network's file.
            where: Beginning of error messages.

        Raises:
            DetectorError: The network does not take such an image, or its outputs have no known format.
        """
        super().__init__(name, (), T_STAR)
        if isinstance(network, nn.Module) and not isinstance(network, torch.fx.GraphModule):
            self.network = network
        elif isinstance(network, nn.Module):
            network.requires_grad_(False)
        # An exported module refuses train() and eval(), so it is hidden from nn.Module in a tuple.
        self._call = (network,)
        self._decoder: OutputDecoder | None = None
        self._settings = dict(settings)
        self._probe(names, where)

    @property
    def decoder(self) -> OutputDecoder:
        """How its outputs are decoded."""
        assert self._decoder is not None
        return self._decoder

    def predict(self, images: Tensor) -> DensePredictions:
        """Fit each image to the network's input, run it, and map its boxes back."""
        decoder = self.decoder
        predictions = [self._predict_one(image[None], decoder) for image in images]
        counts = tuple(int(scores.shape[1]) for _, scores in predictions)
        most = max(counts)
        # Padded with boxes of no size and no probability, so that images share one tensor.
        boxes = torch.cat([F.pad(b, (0, 0, 0, most - b.shape[1])) for b, _ in predictions])
        scores = torch.cat([F.pad(s, (0, 0, 0, most - s.shape[1])) for _, s in predictions])
        image_hw = int(images.shape[2]), int(images.shape[3])
        return DensePredictions(boxes[:, :, None], scores, image_hw, counts=counts)

    def _predict_one(self, image: Tensor, decoder: OutputDecoder) -> tuple[Tensor, Tensor]:
        spec = self.input_spec((int(image.shape[2]), int(image.shape[3])), decoder.spec)
        network_input, placement = fit_images(image, spec)
        input_hw = int(network_input.shape[2]), int(network_input.shape[3])
        boxes, scores = decoder.decode(self._outputs(network_input, decoder.spec), input_hw)
        return placement.to_image(boxes), scores

    def input_spec(self, image_hw: tuple[int, int], spec: NetworkSpec) -> NetworkSpec:
        """The settings for an image of this size, px."""
        return spec

    def _outputs(self, network_input: Tensor, spec: NetworkSpec) -> list[Tensor]:
        given: Any = normalise_images(network_input, spec)
        if spec.input != "batch":
            given = given[0] if spec.input == "image" else [given[0]]
        with BatchNormGradientFix():
            return flatten_outputs(self._call[0](given))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move or convert the hidden exported module too."""
        network = self._call[0]
        if isinstance(network, torch.fx.GraphModule):
            network._apply(fn, recurse)
        return super()._apply(fn, recurse)

    @torch.no_grad()
    def _probe(self, names: tuple[str, ...] | None, where: str) -> None:
        """Run the network on a grey image and settle how its outputs are decoded."""
        initial = replace(NetworkSpec(), **self._settings)
        size = initial.size or PROBE_HW
        try:
            outputs = self._outputs(torch.full((1, 3, *size), 0.5), initial)
        except (RuntimeError, TypeError, ValueError, AssertionError) as error:
            raise DetectorError(
                f"{where}: expected a network that takes an image of {size[0]} x {size[1]} px (set `size` and "
                f"`input` in a YAML file), found {_last_line(error)}"
            ) from error
        found = make_decoder(outputs, size, self._settings, names, where)
        spec = found.spec
        self._decoder = found
        self.classes = found.classes
        self.t_star = T_STAR if spec.t_star is None else spec.t_star
        self.nms_iou = NMS_IOU if spec.nms_iou is None else spec.nms_iou
        self.least_score = LEAST_SCORE if spec.least_score is None else spec.least_score


def load_torchscript(path: Path, spec: Path | None = None) -> NetworkDetector:
    """A TorchScript file as a detector. Loading runs the file's code.

    Raises:
        DetectorError: The file is not one.
    """
    settings = _settings(path, spec, "a TorchScript file")
    facts = {_ULTRALYTICS_FACTS: ""}
    try:
        with warnings.catch_warnings():
            # TorchScript is deprecated, but such files exist.
            for kind in (DeprecationWarning, FutureWarning):
                warnings.simplefilter("ignore", kind)
            network = torch.jit.load(str(path), map_location="cpu", _extra_files=facts).eval()
            network.to(memory_format=torch.channels_last)  # BatchNormGradientFix cannot reach into it
    except (RuntimeError, ValueError) as error:
        raise DetectorError(f"{path}: expected a TorchScript file, found {_last_line(error)}") from None
    names, size = _parse_ultralytics_facts(facts[_ULTRALYTICS_FACTS])
    if size is not None:
        settings.setdefault("size", size)
    return NetworkDetector(path.stem, network, settings, names, where=str(path))


def load_exported(path: Path, spec: Path | None = None) -> NetworkDetector:
    """A program from `torch.export.save` as a detector, with the program's input size if that is fixed.

    Raises:
        DetectorError: The file is not one.
    """
    settings = _settings(path, spec, "a program of torch.export")
    try:
        program = torch.export.load(str(path))
    except Exception as error:  # the reader raises errors of zip, JSON and the schema
        raise DetectorError(f"{path}: expected a program of torch.export, found {_last_line(error)}") from None
    size = _exported_size(program)
    if size is not None:
        settings.setdefault("size", size)
    return NetworkDetector(path.stem, program.module(), settings, where=str(path))


def _settings(path: Path, spec: Path | None, what: str) -> dict[str, Any]:
    if not path.is_file():
        raise DetectorError(f"{path}: expected {what}, found none")
    return load_settings(path, spec)


def _exported_size(program: torch.export.ExportedProgram) -> tuple[int, int] | None:
    """Height and width of a program's image, px, if they are fixed."""
    for node in program.graph.nodes:
        if node.op == "placeholder" and node.name in program.graph_signature.user_inputs:
            shape = node.meta["val"].shape
            if len(shape) >= 3 and all(isinstance(side, int) for side in shape[-2:]):
                return int(shape[-2]), int(shape[-1])
    return None


def _parse_ultralytics_facts(text: str) -> tuple[tuple[str, ...] | None, tuple[int, int] | None]:
    """Classes and input size (height, width) px from the metadata of a TorchScript file from Ultralytics."""
    try:
        facts = json.loads(text)
        names = with_project_names(str(facts["names"][str(i)]) for i in range(len(facts["names"])))
        high, wide = facts["imgsz"]
        return names, (int(high), int(wide))
    except (ValueError, TypeError, KeyError):
        return None, None


def _last_line(error: Exception) -> str:
    """The last line of an error of torch, which states the cause."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


_ULTRALYTICS_STRIDE = 32
"""Ultralytics models get images padded to a multiple of this, px, without resizing."""
_RTDETR_SIDE = 640
"""Input of RT-DETR by default, px: images are stretched to a square."""


class _FirstOutput(nn.Module):
    """A model reduced to its first output, the predictions; the others serve its training."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, images: Tensor) -> Tensor:
        given = self.model(images)
        return given if isinstance(given, Tensor) else given[0]


class _Queries(nn.Module):
    """RT-DETR reduced to the boxes and logits of all its queries: its first output holds the best scores alone."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        _, (boxes, logits, *_) = self.model(images)
        return boxes[-1], logits[-1]


def load_ultralytics(path: Path, spec: Path | None = None) -> NetworkDetector:
    """A model file of Ultralytics (YOLOv8, YOLO11, RT-DETR, ...; AGPL-3.0) as a detector. The file is a pickle of a
    whole module, so loading runs the code in it; torch's `weights_only` is not possible.

    Raises:
        DetectorError: The file is not one, or Ultralytics is missing.
    """
    try:
        from ultralytics import YOLO  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise DetectorError(f"{path}: needs Ultralytics: pip install 'drivesem[ultralytics]'") from None
    except RuntimeError as error:  # a torchvision that does not fit torch
        raise DetectorError(f"{path}: expected Ultralytics and torchvision, found {_last_line(error)}") from None
    if path.suffix != ".pt" or not path.is_file():
        raise DetectorError(f"{path}: expected a .pt file of Ultralytics, found none")
    try:
        loaded: Any = YOLO(str(path))
        model = loaded.model
        head = model.model[-1]
        names = with_project_names(str(model.names[i]) for i in range(len(model.names)))
    except Exception as error:  # the reader and the pickle may raise anything
        raise DetectorError(f"{path}: expected a .pt file of Ultralytics, found {error}") from None
    own, kind = load_settings(path, spec), type(head).__name__
    if kind == "RTDETRDecoder":
        side = int(loaded.overrides.get("imgsz", _RTDETR_SIDE))
        settings = {"format": "rtdetr", "boxes": "cxcywh", "normalised": True, "activation": "sigmoid"}
        network = _Queries(model.float().eval())
        return NetworkDetector(path.stem, network, settings | {"size": (side, side)} | own, names, where=str(path))
    if not kind.endswith("Detect"):
        raise DetectorError(f"{path}: expected a detector, found one that ends in {kind}")
    # End-to-end heads give no gradient to boxes they drop.
    if getattr(head, "end2end", False):
        head.end2end = False
    settings = {"multiple": _ULTRALYTICS_STRIDE, "format": "yolov8"} | own
    return NetworkDetector(path.stem, _FirstOutput(model.float().eval()), settings, names, where=str(path))


class GradientFreePredictor:
    """A detector of which only the detections can be used."""

    gradient_obstacle = "its outputs do not depend on the image by torch's operations"
    """Why it has no gradient."""

    def __init__(self, inner: Detector) -> None:
        self.inner = inner
        self.name, self.classes, self.t_star = inner.name, inner.classes, inner.t_star

    @torch.no_grad()
    def forward(self, images: Tensor) -> Any:
        """The inner detector's raw predictions."""
        return self.inner(images)

    @torch.no_grad()
    def decode(self, raw: Any) -> list[Detections]:
        """The inner detector's detections."""
        return self.inner.decode(raw)


def require_gradient(detector: Detector) -> Predictor:
    """The detector, or a `GradientFreePredictor` if its loss has no gradient to the image, as with numpy inside.

    A detector that cannot run at all is returned as it is: `detectors.check` reports the error.
    """
    device = detector_device(detector)
    boxes = torch.tensor([[96.0, 32, 160, 96]], device=device)
    target = Targets(boxes, torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.bool))
    image = torch.rand(1, 3, *PROBE_HW, generator=torch.Generator().manual_seed(0)).to(device)
    try:
        differentiable = detector.loss(detector(image.clone().requires_grad_(True)), [target])[
            "total"
        ].requires_grad
    except Exception:  # user code may raise anything; numpy refuses tensors with a gradient
        try:
            raw = detector(image)
            detector.decode(raw)
            detector.loss(raw, [target])
            differentiable = False
        except Exception:
            differentiable = True
    return detector if differentiable else GradientFreePredictor(detector)


RAISES_NOTHING = "methods that raise nothing"
"""Expectation towards user detectors, for errors."""
_LOADED: set[str] = set()
"""Files of the classes loaded so far."""


def describe_user_error(error: Exception) -> str | None:
    """An error of a user class with its location, if the error came through the class's file; otherwise None."""
    frames = traceback.extract_tb(error.__traceback__)
    files = {frame.filename for frame in frames}
    if isinstance(error, SyntaxError):  # a file that was never run has no frame
        files.add(str(error.filename))
    return describe_error(error) if files & _LOADED else None


def load_user_detector(spec_name: str, spec: Path | None = None) -> Detector:
    """Load the detector `path/to/file.py:ClassName` or `package.module:ClassName`; runs its code.

    The class is called without arguments. A `Detector` is returned as is; any other module is treated as a network
    in one of `detectors.adapters.formats`, with settings from its attribute `spec`, a mapping, and from a YAML
    file, which wins.

    Raises:
        DetectorError: There is no such class, or it is something else.
    """
    found = _find_object("module", spec_name, "CLASS")
    where, _, name = spec_name.rpartition(":")
    if not isinstance(found, type):
        raise DetectorError(f"{where}: expected a class {name}, found {type(found).__name__}")
    with _named_user_errors(spec_name):
        return _to_detector(found(), spec_name, name, spec)


def load_maite_model(spec_name: str, spec: Path | None = None) -> Predictor:
    """Load the MAITE model `path/to/file.py:NAME` or `package.module:NAME`; runs its code.

    The name is a model, or a class or function that returns one when it is called without arguments.

    Args:
        spec_name: File or module, and name.
        spec: YAML file of settings, which override the model's attribute `spec`.

    Raises:
        DetectorError: There is no such name, or it is something else.
    """
    found = _find_object("maite", spec_name, "NAME")
    if found is None:
        raise DetectorError(f"maite: expected a model, class or function {spec_name}, found no such name")
    with _named_user_errors(spec_name):
        model = found() if isinstance(found, type) or inspect.isroutine(found) else found
        return adapt_maite_model(model, {} if spec is None else load_spec(spec), spec_name)


@contextmanager
def _named_user_errors(spec_name: str) -> Iterator[None]:
    """Raise DetectorError for any error of a user's code."""
    try:
        yield
    except DetectorError:
        raise
    except Exception as error:  # user code may raise anything
        expected = "code that can be created and run"
        raise DetectorError(f"{spec_name}: expected {expected}, found {describe_error(error)}") from error


def _to_detector(instance: Any, spec_name: str, name: str, spec: Path | None) -> Detector:
    """An instance of a user's class as a detector."""
    if isinstance(instance, Detector):
        if spec is not None:
            raise DetectorError(f"{spec_name}: expected no YAML file for a Detector, found {spec}")
        return instance
    if not isinstance(instance, nn.Module):
        raise DetectorError(
            f"{spec_name}: expected a Detector or a torch.nn.Module, found {type(instance).__name__}"
        )
    return _adapt_module(instance, spec_name, name, {} if spec is None else load_spec(spec))


def _adapt_module(module: nn.Module, where: str, name: str, settings: Mapping[str, Any]) -> NetworkDetector:
    own = validate_settings(getattr(module, "spec", {}), f"{where}: spec")
    return NetworkDetector(str(getattr(module, "name", name)), module.eval(), {**own, **settings}, where=where)


def adapt_object(instance: Any, classes: Sequence[str] | str | None = None) -> Predictor:
    """A torch module, a MAITE model or a function as a detector; see `detectors.registry.load_predictor`.

    Args:
        instance: The object.
        classes: Class names, or "coco" or "coco91"; None uses the module's `spec` or the model's `metadata`.

    Raises:
        DetectorError: It is none of these, or its outputs have no known format.
    """
    settings = {} if classes is None else validate_settings({"classes": classes}, "detector")
    if is_maite_model(instance):
        return adapt_maite_model(instance, settings, f"detector {instance.metadata['id']}")
    if isinstance(instance, nn.Module):
        name = type(instance).__name__
        return require_gradient(_adapt_module(instance, f"detector {name}", name, settings).requires_grad_(False))
    if not callable(instance) or isinstance(instance, type):
        expected = "a name, a file, a detector, a torch.nn.Module, a MAITE model or a function of images"
        raise DetectorError(f"detector: expected {expected}, found {type(instance).__name__} {instance!r:.80}")
    if classes is None:
        raise DetectorError(
            "detector: expected class names for a function (load_detector(..., classes=[...])) or in MAITE's "
            "metadata, found neither"
        )
    return FunctionPredictor(getattr(instance, "__name__", "function"), instance, settings["classes"])


def _find_object(kind: str, spec_name: str, what: str) -> Any:
    """The object FILE.py:NAME or PACKAGE.MODULE:NAME; None if the file has no such name."""
    where, colon, name = spec_name.rpartition(":")
    if not (colon and where and name.isidentifier()):
        raise DetectorError(f"{kind}: expected FILE.py:{what} or PACKAGE.MODULE:{what}, found {spec_name!r}")
    try:
        if where.endswith(".py"):
            found = getattr(_import_file(Path(where)), name, None)
        else:
            found = pkgutil.resolve_name(f"{where}:{name}")
    except ImportError as error:
        raise DetectorError(f"{kind}: expected a module {where}, found {error}") from None
    except AttributeError:
        found = None
    home = found if isinstance(found, type) or inspect.isroutine(found) else type(found)
    _LOADED.add(str(getattr(sys.modules.get(home.__module__), "__file__", None)))
    return found


def _import_file(path: Path) -> Any:
    """A file's module, as if imported; modules that it imports from its folder must be on Python's path."""
    if not path.is_file():
        raise DetectorError(f"{path}: expected a Python file, found none")
    spec = importlib.util.spec_from_file_location(f"_detector_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    _LOADED.add(str(path))
    # Dataclasses and pickle look up a class's module by name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
