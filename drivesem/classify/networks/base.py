"""What every classifier is: pictures to features, and features to one score a class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Protocol

import torch
from torch import Tensor, nn

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of RGB in [0, 1]: what torchvision's weights were trained with."""


class Scorer(Protocol):
    """What attacks ask of a classifier. differentiable: whether its scores have a gradient to the pictures."""

    differentiable: bool
    classes: tuple[str, ...]

    def __call__(self, images: Tensor) -> Tensor:
        """Scores (B, C) before softmax, of pictures (B, 3, H, W), RGB in [0, 1]."""
        ...


class Classifier(nn.Module, ABC):
    """A network whose last layer, a linear one, tells `classes` apart. architecture: its name in weights files;
    head: the path of that layer, by torchvision's names where it has the network; published_head: what files of
    the published weights hold in its place, where that has another name.
    """

    differentiable = True
    architecture: str
    head: ClassVar[str]
    published_head: str = ""

    classes: tuple[str, ...]
    mean: Tensor
    std: Tensor

    def __init__(
        self, classes: Sequence[str], mean: Sequence[float] = IMAGENET_MEAN, std: Sequence[float] = IMAGENET_STD
    ) -> None:
        super().__init__()
        self.classes = tuple(classes)
        self.register_buffer("mean", torch.tensor(mean).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std).view(3, 1, 1), persistent=False)

    @abstractmethod
    def encode(self, prepared: Tensor) -> Tensor:
        """What the last layer reads (B, K) of prepared pictures (B, 3, H, W)."""

    @property
    def last(self) -> nn.Linear:
        """The last layer."""
        layer = self.get_submodule(self.head)
        assert isinstance(layer, nn.Linear)
        return layer

    def embed(self, images: Tensor) -> Tensor:
        """Features (B, K) of pictures (B, 3, H, W), RGB in [0, 1]."""
        return self.encode((images - self.mean) / self.std)

    def forward(self, images: Tensor) -> Tensor:
        """Scores (B, C) before softmax, of pictures (B, 3, H, W), RGB in [0, 1], wherever they lie."""
        return self.last(self.embed(images.to(self.mean))).to(images)

    def own_name(self, published: str) -> str:
        """What a tensor of the published weights is called here."""
        return published

    def retarget(self, classes: Sequence[str], generator: torch.Generator) -> None:
        """Have a new last layer, for other classes, with small random weights."""
        layer = nn.Linear(self.last.in_features, len(classes))
        with torch.no_grad():
            layer.weight.normal_(0, 0.01, generator=generator)
            layer.bias.zero_()
        self.set_submodule(self.head, layer)
        self.classes = tuple(classes)
