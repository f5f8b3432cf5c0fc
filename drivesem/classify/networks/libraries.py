"""Networks of torchvision and timm by name, where these are installed: all but their last layer, which is new."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from drivesem.classify.networks.base import IMAGENET_MEAN, IMAGENET_STD, Classifier
from scene_ir.errors import FormatError

PREFIXES = ("torchvision:", "timm:")
"""Of names of their networks."""


class LibraryClassifier(Classifier):
    """`torchvision:NAME` or `timm:NAME`. architecture: that name. pretrained: with the library's own weights,
    which it fetches where it has not. Raises FormatError where library or network is not there.
    """

    head = "last_layer"

    def __init__(self, architecture: str, classes: Sequence[str], *, pretrained: bool = False) -> None:
        library, _, name = architecture.partition(":")
        try:
            if library == "timm":
                body: Any = importlib.import_module("timm").create_model(name, pretrained=pretrained)
            else:
                models: Any = importlib.import_module("torchvision.models")
                body = models.get_model(name, weights="DEFAULT" if pretrained else None)
        except ImportError as error:
            raise FormatError("--network", f"{library} installed, for {architecture}", error) from error
        except Exception as error:  # libraries and networks raise what they like
            found = " ".join(f"{type(error).__name__} {error}".split())[:160]
            raise FormatError("--network", f"a network of {library}", f"{architecture}: {found}") from error
        linear = [(path, part) for path, part in body.named_modules() if isinstance(part, nn.Linear)]
        if not linear:
            raise FormatError("--network", "a network that ends in a linear layer", architecture)
        config = getattr(body, "default_cfg", {})
        super().__init__(classes, config.get("mean", IMAGENET_MEAN), config.get("std", IMAGENET_STD))
        path, last = linear[-1]
        body.set_submodule(path, nn.Identity())
        self.architecture = architecture
        self.published_head = f"body.{path}"
        self.body = body
        self.last_layer = nn.Linear(last.in_features, len(self.classes))

    def encode(self, prepared: Tensor) -> Tensor:
        return torch.flatten(self.body(prepared), 1)

    def own_name(self, published: str) -> str:
        return published if published.startswith(f"{self.head}.") else f"body.{published.removeprefix('body.')}"
