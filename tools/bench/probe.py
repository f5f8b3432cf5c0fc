"""Processes for memory measurements: `python -m tools.bench.probe detector|attack ORDER FILE`.

Each imports only what it runs: what the detector alone does not need counts against the attack.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from torch import Tensor

    from detectors.base import Detector

_DETECTOR_STEPS = 12
"""The detector's peak is reached in the first steps."""


@dataclass(frozen=True, slots=True)
class ProbeOrder:
    """What to run."""

    detector: str
    """Name or file."""
    threads: int
    """Of torch."""
    scene: str | tuple[int, int]
    """Its folder, or height and width, px, of a random image for the detector alone."""
    steps: int = _DETECTOR_STEPS
    """Number of steps."""
    seed: int = 0
    """Seed of the image or of theta."""


@dataclass(frozen=True, slots=True)
class ResidentMemory:
    """Resident KB: the peak, with the imports and with the detector loaded, and after each step."""

    peak_kb: int
    libraries_kb: int
    loaded_kb: int
    rss_kb: list[int]


def probe(what: Literal["detector", "attack"], order: ProbeOrder, asker: str) -> ResidentMemory:
    """What a fresh process found out. Raises FormatError, which names `asker`, where it ends without a result."""
    from scene_ir import files
    from scene_ir.errors import FormatError

    with tempfile.TemporaryDirectory(prefix="drivesem-bench-") as folder:
        answer = Path(folder) / "resident.json"
        words = [sys.executable, "-m", "tools.bench.probe", what, json.dumps(asdict(order)), str(answer)]
        done = subprocess.run(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
        if done.returncode != 0 or not answer.is_file():
            last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
            raise FormatError(f"{asker}: process {what}", "a result", f"exit code {done.returncode}: {last}")
        return ResidentMemory(**files.read_json(answer))


def image_gradient(detector: Detector, images: Tensor) -> Tensor:
    """Forward and backward: the gradient to images (B, 3, H, W) of the loss that attacks raise, for one object."""
    import torch

    from detectors.types import Targets

    height, width = images.shape[2:]
    box = images.new_tensor([[width / 4, height / 3, width / 3, height / 2]])
    labels = torch.zeros(1, dtype=torch.int64, device=images.device)
    leaf = images.detach().requires_grad_(True)
    targets = [Targets(box, labels, labels > 0)] * len(images)
    return torch.autograd.grad(detector.loss(detector(leaf), targets)["objectness"], leaf)[0]


def _detector_alone(order: ProbeOrder) -> ResidentMemory:
    """The detector's forward and backward on an image, and nothing else of the project."""
    import torch

    from detectors.registry import load_detector
    from scene_ir.files import read_image

    torch.set_num_threads(order.threads)
    libraries = _resident_kb()
    detector = load_detector(order.detector)
    if isinstance(order.scene, str):
        image = torch.from_numpy(read_image(Path(order.scene) / "photograph.png")).permute(2, 0, 1) / 255
    else:
        image = torch.rand(3, *order.scene, generator=torch.Generator().manual_seed(order.seed))
    images = image[None].contiguous(memory_format=torch.channels_last)
    steps = min(order.steps, _DETECTOR_STEPS)
    return _watched(lambda: image_gradient(detector, images), steps, libraries)


def _attack(order: ProbeOrder) -> ResidentMemory:
    """Steps of an attack of combo 2: gradient, sign step, projection."""
    import torch

    from detectors.registry import load_detector
    from drivesem.attacks.feasible.projection import FeasibleSet
    from drivesem.attacks.objective import Objective
    from drivesem.attacks.space import ParameterSpace, combo_parameters
    from scene_ir.io import load_scene
    from scene_ir.render.compositor import Compositor

    torch.set_num_threads(order.threads)
    libraries = _resident_kb()
    scene = load_scene(Path(str(order.scene)))
    space = ParameterSpace(scene, combo_parameters(2))
    objective = Objective(Compositor(scene), space, load_detector(order.detector))
    feasible = FeasibleSet(space)
    generator = torch.Generator().manual_seed(order.seed)
    noise = torch.rand(space.dim, generator=generator)
    theta = feasible.project(space.step * 10 * (2 * noise - 1)).theta

    def step() -> None:
        nonlocal theta
        _, gradient = objective.loss_and_grad(theta)
        theta = feasible.project(theta + space.step * torch.sign(gradient)).theta

    return _watched(step, order.steps, libraries)


def _watched(step: Callable[[], object], steps: int, libraries_kb: int) -> ResidentMemory:
    loaded, rss = _resident_kb(), []
    for _ in range(steps):
        step()
        rss.append(_resident_kb())
    return ResidentMemory(_peak_kb(), libraries_kb, loaded, rss)


def _resident_kb() -> int:
    """Resident memory of this process now, KB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def _peak_kb() -> int:
    """The largest resident memory that this process has had, KB.

    Not `getrusage`, which starts from the value of the parent process.
    """
    for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1])
    return _resident_kb()


def main(words: list[str]) -> None:
    """Run the measurement that the arguments name and write its result to the file."""
    from drivesem.run.allocation import keep_freed_memory
    from scene_ir.files import write_json

    keep_freed_memory()
    what, order, path = words
    run: dict[str, Callable[[ProbeOrder], Any]] = {"detector": _detector_alone, "attack": _attack}
    write_json(Path(path), asdict(run[what](ProbeOrder(**json.loads(order)))))


if __name__ == "__main__":
    main(sys.argv[1:])
