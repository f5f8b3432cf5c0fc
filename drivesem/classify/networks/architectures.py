"""Interface of classifiers; published networks with torchvision's names of weights, and those of torchvision and timm.

SqueezeNet 1.1: Iandola et al. 2016, arXiv:1602.07360. VGG-16: Simonyan and Zisserman 2015, arXiv:1409.1556,
configuration D. ResNet-50: He et al. 2015, arXiv:1512.03385.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors.squeezedet import BGR_MEAN, Fire, SqueezeDet
from scene_ir.errors import FormatError

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Normalisation of RGB in [0, 1] with which torchvision's weights were trained."""
RENDERED_MEAN, RENDERED_STD = (0.6109, 0.7387, 0.7765), (0.2715, 0.3066, 0.3395)
"""Mean and deviation of the rendered pictures in the paper's code."""


class ImageClassifier(Protocol):
    """A classifier that can be attacked."""

    differentiable: bool
    """Whether scores have a gradient with respect to pictures."""
    classes: tuple[str, ...]
    """Names of the classes, in the order of scores."""

    def __call__(self, images: Tensor) -> Tensor:
        """Compute scores before softmax (B, C) of pictures (B, 3, H, W), RGB in [0, 1]."""
        ...


class Classifier(nn.Module, ABC):
    """A network with a linear last layer, which can be replaced for other classes."""

    differentiable = True
    architecture: str
    """Name in weights files."""
    head: ClassVar[str]
    """Path of the last layer, by torchvision's names if torchvision has the network."""
    published_head: str = ""
    """Path of the last layer in files of published weights, if it differs."""

    classes: tuple[str, ...]
    """Names of the classes, in the order of scores."""
    mean: Tensor
    """Mean of RGB (3, 1, 1)."""
    std: Tensor
    """Deviation of RGB (3, 1, 1)."""

    def __init__(
        self, classes: Sequence[str], mean: Sequence[float] = IMAGENET_MEAN, std: Sequence[float] = IMAGENET_STD
    ) -> None:
        """
        Args:
            classes: Names of the classes.
            mean: Mean of RGB.
            std: Deviation of RGB.
        """
        super().__init__()
        self.classes = tuple(classes)
        self.register_buffer("mean", torch.tensor(mean).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std).view(3, 1, 1), persistent=False)

    def normalise_by(self, mean: Sequence[float], std: Sequence[float]) -> None:
        """Set the mean and the deviation of RGB."""
        self.mean.copy_(torch.tensor(mean).view(3, 1, 1))
        self.std.copy_(torch.tensor(std).view(3, 1, 1))

    @abstractmethod
    def encode(self, normalised: Tensor) -> Tensor:
        """Compute features (B, K) of normalised pictures (B, 3, H, W)."""

    @property
    def last(self) -> nn.Linear:
        """The last layer."""
        layer = self.get_submodule(self.head)
        assert isinstance(layer, nn.Linear)
        return layer

    def embed(self, images: Tensor) -> Tensor:
        """Compute features (B, K) of pictures (B, 3, H, W), RGB in [0, 1]."""
        return self.encode((images - self.mean) / self.std)

    def forward(self, images: Tensor) -> Tensor:
        """Compute scores before softmax (B, C) of pictures (B, 3, H, W), RGB in [0, 1], on any device."""
        return self.last(self.embed(images.to(self.mean))).to(images)

    def local_name(self, published: str) -> str:
        """The name here of a tensor of the published weights."""
        return published

    def replace_last_layer(self, classes: Sequence[str], generator: torch.Generator) -> None:
        """Replace the last layer by one for other classes, with small random weights."""
        layer = nn.Linear(self.last.in_features, len(classes))
        with torch.no_grad():
            layer.weight.normal_(0, 0.01, generator=generator)
            layer.bias.zero_()
        self.set_submodule(self.head, layer)
        self.classes = tuple(classes)


PREFIXES = ("torchvision:", "timm:")
"""Prefixes of names of libraries' networks."""

_FIRES = dict(list(SqueezeDet.layout.fires.items())[:8])
"""Up to fire9: SqueezeDet's further layers are not SqueezeNet's."""


class SqueezeNet(Classifier):
    """SqueezeNet up to its last Fire module, and one layer on the spatial mean and maximum of its features.

    Its convolutions have the names of SqueezeDet, which begins with the same ones.
    """

    architecture = "squeezenet"
    head = "classifier"
    published_head = "conv10"

    def __init__(self, classes: Sequence[str]) -> None:
        mean = [value / 255 for value in reversed(BGR_MEAN)]
        super().__init__(classes, mean, [1 / 255] * 3)
        channels = SqueezeDet.layout.channels
        self.conv1 = nn.Conv2d(3, channels, SqueezeDet.layout.kernel, 2)
        self.fires = nn.ModuleDict()
        for name, (squeeze, expand) in _FIRES.items():
            self.fires[name] = Fire(channels, squeeze, expand)
            channels = 2 * expand
        self.classifier = nn.Linear(2 * channels, len(self.classes))

    def encode(self, normalised: Tensor) -> Tensor:
        x = F.max_pool2d(F.relu(self.conv1(normalised.flip(1))), 3, 2, ceil_mode=True)  # its weights read BGR
        for name, fire in self.fires.items():
            x = fire(x)
            if name in SqueezeDet.layout.pooled:
                x = F.max_pool2d(x, 3, 2, ceil_mode=True)
        return torch.cat([x.mean(dim=(2, 3)), x.amax(dim=(2, 3))], dim=1)


def vgg16_convolutions() -> list[nn.Module]:
    """Build the layers of VGG-16 up to relu5_3, in torchvision's order."""
    layers: list[nn.Module] = []
    channels = 3
    for width, count in zip((64, 128, 256, 512, 512), (2, 2, 3, 3, 3), strict=True):
        if layers:
            layers.append(nn.MaxPool2d(2, 2))
        for _ in range(count):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
            channels = width
    return layers


class VGG16(Classifier):
    """VGG-16."""

    architecture = "vgg16"
    head = "classifier.6"

    def __init__(self, classes: Sequence[str]) -> None:
        super().__init__(classes)
        self.features = nn.Sequential(*vgg16_convolutions(), nn.MaxPool2d(2, 2))
        wide = [nn.Linear(512 * 7 * 7, 4096), nn.ReLU(inplace=True), nn.Dropout()]
        deep = [nn.Linear(4096, 4096), nn.ReLU(inplace=True), nn.Dropout()]
        self.classifier = nn.Sequential(*wide, *deep, nn.Linear(4096, len(self.classes)))

    def encode(self, normalised: Tensor) -> Tensor:
        pooled = F.adaptive_avg_pool2d(self.features(normalised), 7)
        return self.classifier[:6](torch.flatten(pooled, 1))


class PooledVGG16(Classifier):
    """VGG-16's convolutions, and one layer on the spatial mean and maximum of their features.

    It does without the three large layers, which hold nine tenths of the weights.
    """

    architecture = "vgg16-pooled"
    head = "classifier"

    def __init__(self, classes: Sequence[str]) -> None:
        super().__init__(classes)
        self.features = nn.Sequential(*vgg16_convolutions(), nn.MaxPool2d(2, 2))
        self.classifier = nn.Linear(2 * 512, len(self.classes))

    def encode(self, normalised: Tensor) -> Tensor:
        x = self.features(normalised)
        return torch.cat([x.mean(dim=(2, 3)), x.amax(dim=(2, 3))], dim=1)


_BLOCKS = (3, 4, 6, 3)
_EXPANSION = 4


class Bottleneck(nn.Module):
    """Residual block of 1x1, 3x3 and 1x1 convolutions; the 3x3 has the stride, as in torchvision."""

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        out = _EXPANSION * width
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out)
        self.downsample: nn.Module = nn.Identity()
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out))

    def forward(self, x: Tensor) -> Tensor:
        inner = F.relu(self.bn1(self.conv1(x)))
        inner = F.relu(self.bn2(self.conv2(inner)))
        return F.relu(self.bn3(self.conv3(inner)) + self.downsample(x))


class ResNet50(Classifier):
    """ResNet-50."""

    architecture = "resnet50"
    head = "fc"

    def __init__(self, classes: Sequence[str]) -> None:
        super().__init__(classes)
        self.conv1 = nn.Conv2d(3, 64, 7, 2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, 2, padding=1)
        channels = 64
        for i, count in enumerate(_BLOCKS):
            width, blocks = 64 << i, []
            for k in range(count):
                blocks.append(Bottleneck(channels, width, 2 if i > 0 and k == 0 else 1))
                channels = _EXPANSION * width
            self.add_module(f"layer{i + 1}", nn.Sequential(*blocks))
        self.fc = nn.Linear(channels, len(self.classes))

    def encode(self, normalised: Tensor) -> Tensor:
        x = self.maxpool(F.relu(self.bn1(self.conv1(normalised))))
        for i in range(len(_BLOCKS)):
            x = self.get_submodule(f"layer{i + 1}")(x)
        return torch.flatten(F.adaptive_avg_pool2d(x, 1), 1)


class LibraryClassifier(Classifier):
    """A network of a library: all but its last layer, which is new."""

    head = "last_layer"

    def __init__(self, architecture: str, classes: Sequence[str], *, pretrained: bool = False) -> None:
        """
        Args:
            architecture: `torchvision:NAME` or `timm:NAME`.
            classes: Names of the classes.
            pretrained: Use the library's weights, which it may download.

        Raises:
            FormatError: The library or the network is missing.
        """
        library, _, name = architecture.partition(":")
        try:
            if library == "timm":
                body: Any = importlib.import_module("timm").create_model(name, pretrained=pretrained)
            else:
                models: Any = importlib.import_module("torchvision.models")
                body = models.get_model(name, weights="DEFAULT" if pretrained else None)
        except ImportError as error:
            raise FormatError("--network", f"{library} installed, for {architecture}", error) from error
        except Exception as error:  # libraries and networks raise anything
            found = " ".join(f"{type(error).__name__} {error}".split())[:160]
            raise FormatError("--network", f"a network of {library}", f"{architecture}: {found}") from error
        linear_layers = [(path, part) for path, part in body.named_modules() if isinstance(part, nn.Linear)]
        if not linear_layers:
            raise FormatError("--network", "a network that ends in a linear layer", architecture)
        config = getattr(body, "default_cfg", {})
        super().__init__(classes, config.get("mean", IMAGENET_MEAN), config.get("std", IMAGENET_STD))
        path, last = linear_layers[-1]
        body.set_submodule(path, nn.Identity())
        self.architecture = architecture
        self.published_head = f"body.{path}"
        self.body = body
        self.last_layer = nn.Linear(last.in_features, len(self.classes))

    def encode(self, normalised: Tensor) -> Tensor:
        return torch.flatten(self.body(normalised), 1)

    def local_name(self, published: str) -> str:
        return published if published.startswith(f"{self.head}.") else f"body.{published.removeprefix('body.')}"
