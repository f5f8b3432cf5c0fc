"""Interface and base class of classifiers: pictures to features, and features to one score per class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Protocol

import torch
from torch import Tensor, nn

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Normalisation of RGB in [0, 1] with which torchvision's weights were trained."""


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
