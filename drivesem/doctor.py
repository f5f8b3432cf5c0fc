"""What is installed on this machine: each part is tried in a process of its own, where an import may abort.

Light: this process imports none of the parts.
"""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any, Literal

import drivesem

Status = Literal["works", "missing", "broken"]
PATIENCE_S = 120.0
"""For one part: a first import from a slow disk takes long."""
_ABSENT = "AssertionError: "
"""Before what a part says that is there, but has nothing to work with."""
_MISSING = ("ModuleNotFoundError", _ABSENT)


@dataclass(frozen=True, slots=True)
class Part:
    """Something that may be there. gives: what works with it, and only with it; bring: the line that brings it;
    code: what a fresh interpreter runs: it prints a version, or ends in an error. needed: nothing works without.
    """

    name: str
    gives: str
    bring: str
    code: str
    needed: bool = False


@dataclass(frozen=True, slots=True)
class Found:
    """What came of a part. told: its version, or why it does not work, on one line."""

    part: Part
    status: Status
    told: str

    def to_json(self) -> dict[str, Any]:
        """A flat object."""
        row = {key: value for key, value in asdict(self.part).items() if key != "code"}
        return row | {"status": self.status, "told": self.told}


def _version(module: str, also: str = "") -> str:
    return f"import {module}; {also}print(getattr({module}, '__version__', 'installed'))"


_EGL = (
    "import os; os.environ.setdefault('PYOPENGL_PLATFORM', 'egl'); "
    "from drivesem.failures.second_renderer.opengl import Screen; Screen(); print('draws')"
)
_WEIGHTS = (
    "from detectors.registry import load_detector; from scene_ir.derender import pose; "
    "[load_detector(name) for name in ('squeezedet', 'yolov3-slim')]; pose.load_network(); print('read')"
)
_KERNELS = "import warp; warp.config.quiet = True; warp.init(); print(warp.__version__)"
_PRESETS = (
    "from drivesem.config.presets import presets; found = presets(); "
    "assert found, 'no preset is installed'; print(len(found))"
)
_GPU = (
    "import torch; assert torch.cuda.is_available(), f'torch {torch.__version__} sees none'; "
    "print(torch.cuda.get_device_name())"
)
_TORCHVISION = (
    "import torch, torchvision; from torchvision.ops import nms; "
    "nms(torch.tensor([[0.0, 0.0, 1.0, 1.0]]), torch.ones(1), 0.5); print(torchvision.__version__)"
)
_BROWSER = (
    "import shutil, playwright; path = shutil.which('chromium'); "
    "assert path, 'no chromium on the path'; print(path)"
)
PARTS = (
    Part("torch", "everything", "pip install drivesem", _version("torch"), True),
    Part("warp", "the renderer's kernels", "pip install drivesem", _KERNELS, True),
    Part(
        "weights", "the shipped detectors and networks", "pip install --force-reinstall drivesem", _WEIGHTS, True
    ),
    Part("presets", "--config NAME", "pip install --force-reinstall drivesem", _PRESETS),
    Part(
        "GPU",
        "--device cuda: faster searches, detectors and training",
        "a build of torch for your GPU (pytorch.org/get-started)",
        _GPU,
    ),
    Part(
        "EGL",
        "the second renderer of photographs (confirm, the grade `confirmed`) and export --to gltf",
        "apt install libegl1 libgl1-mesa-dri",
        _EGL,
    ),
    Part(
        "open3d, libusb",
        "the second check of feasibility by rays; without, by outlines",
        "apt install libusb-1.0-0 libegl1 libgl1 libx11-6 libudev1 libidn2-0",
        _version("open3d"),
    ),
    Part(
        "onnxruntime",
        "ONNX detectors, derender --segmenter",
        "pip install 'drivesem[onnx]'",
        _version("onnxruntime"),
    ),
    Part("torchvision", "torchvision's detectors", "pip install 'drivesem[torchvision]'", _TORCHVISION),
    Part(
        "mitsuba",
        "the second renderer of objects with light that is traced (classify confirm)",
        "pip install 'drivesem[mitsuba]'",
        _version("mitsuba"),
    ),
    Part("ultralytics", "Ultralytics' detectors", "pip install 'drivesem[ultralytics]'", _version("ultralytics")),
    Part("ray", "--engine ray: frames shared by a cluster", "pip install 'drivesem[ray]'", _version("ray")),
    Part("fsspec", "URLs in --root and --out", "pip install 'drivesem[remote]'", _version("fsspec")),
    Part("s3fs", "s3:// URLs", "pip install 'drivesem[remote]'", _version("s3fs")),
    Part("gcsfs", "gs:// URLs", "pip install 'drivesem[remote]'", _version("gcsfs")),
    Part("pyarrow", "Parquet in export --to tables", "pip install 'drivesem[tables]'", _version("pyarrow")),
    Part(
        "ultrafast-pycocotools",
        "COCO's figures several times as fast",
        "pip install 'drivesem[eval]'",
        _version("ultrafast_pycocotools"),
    ),
    Part("OpenEXR", "skies of synth --assets", "pip install 'drivesem[assets]'", _version("OpenEXR")),
    Part("tensorboard", "curves of train in TensorBoard", "pip install tensorboard", _version("tensorboard")),
    Part(
        "browser",
        "tests of the pages, for developers",
        "apt install chromium, and pip install 'drivesem[test]'",
        _BROWSER,
    ),
)


def examine(parts: Sequence[Part] = PARTS, done: Callable[[], object] = lambda: None) -> list[Found]:
    """Try all parts, several at a time. done: called after each."""

    def one(part: Part) -> Found:
        found = _tried(part)
        done()
        return found

    with ThreadPoolExecutor(4) as pool:
        return list(pool.map(one, parts))


def _tried(part: Part) -> Found:
    """One part, in a process of its own: whatever it does to that process says that it is broken."""
    words = [sys.executable, "-W", "ignore", "-c", part.code]
    try:
        ended = subprocess.run(words, capture_output=True, text=True, errors="replace", timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        return Found(part, "broken", f"no answer within {PATIENCE_S:.0f} s")
    except OSError as error:
        return Found(part, "broken", str(error))
    if ended.returncode == 0:
        return Found(part, "works", _last(ended.stdout) or "installed")
    reason = _last(ended.stderr) or f"the process ended with {ended.returncode}"
    if ended.returncode < 0:
        reason = f"the process was ended by signal {-ended.returncode}"
    status: Status = "missing" if reason.startswith(_MISSING) else "broken"
    return Found(part, status, reason.removeprefix(_ABSENT))


def _last(text: str) -> str:
    """The last line with something on it."""
    return next((" ".join(line.split()) for line in reversed(text.splitlines()) if line.strip()), "")


def about() -> dict[str, str]:
    """What the parts are installed in."""
    return {
        "drivesem": drivesem.__version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "executable": sys.executable,
    }
