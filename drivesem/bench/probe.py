"""The process that `bench memory` measures: `python -m drivesem.bench.probe detector|attack ORDER FILE`.

It imports only what it runs: what the detector alone does not need counts against the attack.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

_DETECTOR_STEPS = 12
"""The detector's peak is reached in the first steps."""


@dataclass(frozen=True, slots=True)
class Order:
    """What to run. scene: folder; detector: name or file; batch: images or thetas at once; threads; seed."""

    scene: str
    detector: str
    batch: int
    steps: int
    threads: int
    seed: int


@dataclass(frozen=True, slots=True)
class Found:
    """Resident KB: the peak, what the imports left, and after each step."""

    peak_kb: int
    libraries_kb: int
    rss_kb: tuple[int, ...]


def resident_kb() -> int:
    """Resident memory of this process now, KB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def peak_kb() -> int:
    """The largest resident memory that this process has had, KB.

    Not `getrusage`, whose figure begins with that of the process that started this one.
    """
    for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1])
    return resident_kb()


def detector_alone(order: Order) -> Found:
    """The detector's forward and backward on `batch` images, and nothing else of the project."""
    import torch

    from detectors.registry import load_detector
    from detectors.types import Targets
    from scene_ir.files import read_image

    torch.set_num_threads(order.threads)
    libraries = resident_kb()
    detector = load_detector(order.detector)
    image = torch.from_numpy(read_image(Path(order.scene) / "photograph.png")).permute(2, 0, 1) / 255
    images = image[None].repeat(order.batch, 1, 1, 1).contiguous(memory_format=torch.channels_last)
    box = torch.tensor([[100.0, 150.0, 200.0, 250.0]])
    targets = [Targets(box, torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.bool))] * order.batch

    def step() -> None:
        leaf = images.detach().requires_grad_(True)
        torch.autograd.grad(detector.loss(detector(leaf), targets)["objectness"], leaf)

    return _watched(step, _DETECTOR_STEPS, libraries)


def attack(order: Order) -> Found:
    """Steps of an attack of combo 2: gradient, sign step, projection."""
    import torch

    from detectors.registry import load_detector
    from drivesem.attack.feasible.projection import FeasibleSet
    from drivesem.attack.objective import Objective
    from drivesem.attack.space import ParameterSpace, combo
    from scene_ir.compositor import Compositor
    from scene_ir.io import load_scene

    torch.set_num_threads(order.threads)
    libraries = resident_kb()
    scene = load_scene(Path(order.scene))
    space = ParameterSpace(scene, combo(2))
    objective = Objective(Compositor(scene), space, load_detector(order.detector))
    feasible = FeasibleSet(space)
    generator = torch.Generator().manual_seed(order.seed)
    noise = torch.rand(order.batch, space.dim, generator=generator)
    thetas = [feasible.project(space.step * 10 * (2 * row - 1)).theta for row in noise]

    def step() -> None:
        if order.batch == 1:
            gradients = [objective.loss_and_grad(thetas[0])[1]]
        else:
            gradients = objective.loss_and_grad_many(torch.stack(thetas))[1]
        thetas[:] = [
            feasible.project(theta + space.step * torch.sign(gradient)).theta
            for theta, gradient in zip(thetas, gradients, strict=True)
        ]

    return _watched(step, order.steps, libraries)


def _watched(step: Callable[[], None], steps: int, libraries_kb: int) -> Found:
    rss = []
    for _ in range(steps):
        step()
        rss.append(resident_kb())
    return Found(peak_kb(), libraries_kb, tuple(rss))


def main(words: list[str]) -> None:
    """Run what the words ask for and leave the result in the file."""
    from scene_ir.files import write_json

    what, order, path = words
    run = {"detector": detector_alone, "attack": attack}[what]
    write_json(Path(path), asdict(run(Order(**json.loads(order)))))


if __name__ == "__main__":
    main(sys.argv[1:])
