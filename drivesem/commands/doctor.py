"""`drivesem doctor`: which features work on this machine, and how to add what is missing.

Each feature is checked in a process of its own, since an import may abort; this process imports none of them.
"""

from __future__ import annotations

import importlib.metadata
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any, Literal

from rich.table import Table
from rich.text import Text

import drivesem
from drivesem.config.commands import DoctorConfig
from drivesem.reporting.tables import Console, print_json, progress_bar

_COLOURS = {"works": "green", "missing": "yellow", "broken": "red"}


Status = Literal["works", "missing", "broken"]
TIMEOUT_S = 120.0
"""Seconds for one feature: a first import from a slow disk takes long."""
_ABSENT = "AssertionError: "
"""Prefix of the error of a feature that is installed, but lacks a device or a file."""
_MISSING = ("ModuleNotFoundError", _ABSENT)


@dataclass(frozen=True, slots=True)
class OptionalFeature:
    """Something that may be installed."""

    name: str
    """Its name."""
    gives: str
    """What works only with it."""
    bring: str
    """The command that installs it."""
    code: str
    """What a fresh interpreter runs: prints a version, or ends in an error."""
    needed: bool = False
    """Whether nothing works without it."""


@dataclass(frozen=True, slots=True)
class FeatureStatus:
    """The state of a feature on this machine."""

    feature: OptionalFeature
    """The feature."""
    status: Status
    """Whether it works."""
    detail: str
    """Its version, or why it does not work, on one line."""

    def to_json(self) -> dict[str, Any]:
        """A flat object."""
        row = {key: value for key, value in asdict(self.feature).items() if key != "code"}
        return row | {"status": self.status, "detail": self.detail}


def _version_code(module: str, also: str = "") -> str:
    return f"import {module}; {also}print(getattr({module}, '__version__', 'installed'))"


_EGL = (
    "import os; os.environ.setdefault('PYOPENGL_PLATFORM', 'egl'); "
    "from drivesem.failures.second_renderer.opengl import shared_context; shared_context(); print('draws')"
)
_WEIGHTS = (
    "from detectors.registry import load_detector; from scene_ir.derender import pose; "
    "[load_detector(name) for name in ('squeezedet', 'yolov3-slim')]; pose.load_network(); print('read')"
)
_KERNELS = "import warp; warp.config.quiet = True; warp.init(); print(warp.__version__)"
_PRESETS = (
    "from drivesem.config.presets import find_presets; found = find_presets(); "
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


def _torchvision_command() -> str:
    """The command that installs the torchvision of the installed torch, from torch's own index for other builds."""
    try:
        version = importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return "pip install 'drivesem[torchvision]'"
    build = version.partition("+")[2]
    index = f" --index-url https://download.pytorch.org/whl/{build}" if build else ""
    return f"pip install torchvision torch=={version}{index}"


_BROWSER = (
    "import shutil, playwright; path = shutil.which('chromium'); "
    "assert path, 'no chromium on the path'; print(path)"
)
FEATURES = (
    OptionalFeature("torch", "everything", "pip install drivesem", _version_code("torch"), True),
    OptionalFeature("warp", "the renderer's kernels", "pip install drivesem", _KERNELS, True),
    OptionalFeature(
        "weights", "the shipped detectors and networks", "pip install --force-reinstall drivesem", _WEIGHTS, True
    ),
    OptionalFeature("presets", "--config NAME", "pip install --force-reinstall drivesem", _PRESETS),
    OptionalFeature(
        "GPU",
        "--device cuda: faster searches, detectors and training",
        "a build of torch for your GPU (pytorch.org/get-started)",
        _GPU,
    ),
    OptionalFeature(
        "EGL",
        "the second renderer of photographs (confirm, the grade `confirmed`) and export --to gltf",
        "apt install libegl1 libgl1-mesa-dri",
        _EGL,
    ),
    OptionalFeature(
        "open3d, libusb",
        "the independent feasibility check by ray casting; without it, by outlines",
        "apt install libusb-1.0-0 libegl1 libgl1 libx11-6 libudev1 libidn2-0",
        _version_code("open3d"),
    ),
    OptionalFeature(
        "onnxruntime",
        "ONNX detectors, derender --segmenter",
        "pip install 'drivesem[onnx]'",
        _version_code("onnxruntime"),
    ),
    OptionalFeature("torchvision", "torchvision's detectors", _torchvision_command(), _TORCHVISION),
    OptionalFeature(
        "mitsuba",
        "the second renderer of objects, with ray-traced light (classify confirm)",
        "pip install 'drivesem[mitsuba]'",
        _version_code("mitsuba"),
    ),
    OptionalFeature(
        "ultralytics",
        "Ultralytics' detectors",
        "pip install 'drivesem[ultralytics]'",
        _version_code("ultralytics"),
    ),
    OptionalFeature(
        "supervision",
        "detections of supervision in Python (ds.to_supervision)",
        "pip install 'drivesem[supervision]'",
        _version_code("supervision"),
    ),
    OptionalFeature(
        "ray", "--engine ray: frames shared by a cluster", "pip install 'drivesem[ray]'", _version_code("ray")
    ),
    OptionalFeature(
        "fsspec", "URLs in --root and --out", "pip install 'drivesem[remote]'", _version_code("fsspec")
    ),
    OptionalFeature("s3fs", "s3:// URLs", "pip install 'drivesem[remote]'", _version_code("s3fs")),
    OptionalFeature("gcsfs", "gs:// URLs", "pip install 'drivesem[remote]'", _version_code("gcsfs")),
    OptionalFeature(
        "pyarrow", "Parquet in export --to tables", "pip install 'drivesem[tables]'", _version_code("pyarrow")
    ),
    OptionalFeature(
        "scikit-learn", "attack --method learn", "pip install 'drivesem[learn]'", _version_code("sklearn")
    ),
    OptionalFeature(
        "ultrafast-pycocotools",
        "COCO metrics, several times faster",
        "pip install 'drivesem[eval]'",
        _version_code("ultrafast_pycocotools"),
    ),
    OptionalFeature(
        "OpenEXR", "skies of synth --assets", "pip install 'drivesem[assets]'", _version_code("OpenEXR")
    ),
    OptionalFeature(
        "tensorboard", "curves of train in TensorBoard", "pip install tensorboard", _version_code("tensorboard")
    ),
    OptionalFeature(
        "browser",
        "tests of the pages, for developers",
        "apt install chromium, and pip install 'drivesem[test]'",
        _BROWSER,
    ),
)


def check_features(
    features: Sequence[OptionalFeature] = FEATURES, advance: Callable[[], object] = lambda: None
) -> list[FeatureStatus]:
    """Check features, four at a time; `advance` is called after each."""

    def check(feature: OptionalFeature) -> FeatureStatus:
        status = _check_feature(feature)
        advance()
        return status

    with ThreadPoolExecutor(4) as pool:
        return list(pool.map(check, features))


def _check_feature(feature: OptionalFeature) -> FeatureStatus:
    words = [sys.executable, "-W", "ignore", "-c", feature.code]
    try:
        process = subprocess.run(words, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return FeatureStatus(feature, "broken", f"no answer within {TIMEOUT_S:.0f} s")
    except OSError as error:
        return FeatureStatus(feature, "broken", str(error))
    if process.returncode == 0:
        return FeatureStatus(feature, "works", _last_line(process.stdout) or "installed")
    reason = _last_line(process.stderr) or f"the process ended with {process.returncode}"
    if process.returncode < 0:
        reason = f"the process was ended by signal {-process.returncode}"
    status: Status = "missing" if reason.startswith(_MISSING) else "broken"
    return FeatureStatus(feature, status, reason.removeprefix(_ABSENT))


def _last_line(text: str) -> str:
    """The last line that is not blank."""
    return next((" ".join(line.split()) for line in reversed(text.splitlines()) if line.strip()), "")


def describe_machine() -> dict[str, str]:
    """Versions and paths of the installation."""
    return {
        "drivesem": drivesem.__version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "executable": sys.executable,
    }


def doctor_command(config: DoctorConfig) -> int:
    """`drivesem doctor`: exit code 1 if a feature that everything needs does not work."""
    errors = Console(stderr=True)
    with progress_bar(errors, keep=False, show_elapsed=False) as bar:
        task = bar.add_task("checking features", total=len(FEATURES))
        results = check_features(FEATURES, lambda: bar.advance(task))
    fit = all(result.status == "works" for result in results if result.feature.needed)
    if config.json:
        print_json({**describe_machine(), "fit": fit, "parts": [result.to_json() for result in results]})
        return 0 if fit else 1
    console = Console()
    for name, text in describe_machine().items():
        console.print(f"{name}: {text}", soft_wrap=True, highlight=False)
    table = Table(title="features", title_justify="left")
    for column in ("feature", "state", "version", "gives"):
        table.add_column(column)
    for result in results:
        version = result.detail if result.status == "works" else ""
        state = Text(result.status, style=_COLOURS[result.status])
        table.add_row(result.feature.name, state, version, result.feature.gives)
    console.print(table)
    for result in results:
        if result.status != "works":
            console.print(f"{result.feature.name}: {result.feature.bring}", soft_wrap=True, highlight=False)
            if result.status == "broken":
                console.print(f"    {result.detail}", soft_wrap=True, highlight=False)
    console.print("everything that is required works" if fit else "drivesem cannot work here", soft_wrap=True)
    return 0 if fit else 1
