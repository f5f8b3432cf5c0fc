"""Semantic counterexamples for driving detectors: the Python API.

    import drivesem as ds

    scene = ds.derender("000008.png", labels="label_2/000008.txt", calib="calib/000008.txt")
    result = ds.attack(scene, "squeezedet", params="translate,rotate,mesh")
    result.picture, result.theta, result.failures
    scene.edit("objects[1].translate=0.5m,0m", weather="fog").render()

Each name is loaded when it is first used: importing this package is quick and loads nothing heavy.
docs/reference/python.md describes them; `drivesem --help` lists the commands.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from detectors.adapters.maite import MaiteModel
    from detectors.adapters.supervision import from_supervision, to_supervision
    from detectors.adapters.torchvision_interface import TorchvisionModule
    from detectors.registry import load_predictor as load_detector
    from drivesem.analyses import confirm, explain, gate, holes, report, transfer, verify
    from drivesem.protocols.attack import MaiteAttack
    from drivesem.protocols.dataset import MaiteDataset
    from drivesem.protocols.metric import MaiteMetric
    from drivesem.run.counterexample import Counterexample, attack
    from drivesem.run.finished import AttackRun, load_run
    from drivesem.run.probes import Gradient, detect, gradient, margin
    from drivesem.scenes.scene import Frames, Scene, demo_scene, derender, load_scene, open_dataset

__all__ = [
    "AttackRun",
    "Counterexample",
    "Frames",
    "Gradient",
    "MaiteAttack",
    "MaiteDataset",
    "MaiteMetric",
    "MaiteModel",
    "Scene",
    "TorchvisionModule",
    "attack",
    "confirm",
    "demo_scene",
    "derender",
    "detect",
    "explain",
    "from_supervision",
    "gate",
    "gradient",
    "holes",
    "load_detector",
    "load_run",
    "load_scene",
    "margin",
    "open_dataset",
    "report",
    "to_supervision",
    "transfer",
    "verify",
]
__version__ = "0.1.0"

_NAMES_BY_MODULE = {
    "detectors.adapters.maite": ("MaiteModel",),
    "detectors.adapters.supervision": ("from_supervision", "to_supervision"),
    "detectors.adapters.torchvision_interface": ("TorchvisionModule",),
    "detectors.registry": ("load_detector",),
    "drivesem.analyses": ("confirm", "explain", "gate", "holes", "report", "transfer", "verify"),
    "drivesem.protocols.attack": ("MaiteAttack",),
    "drivesem.protocols.dataset": ("MaiteDataset",),
    "drivesem.protocols.metric": ("MaiteMetric",),
    "drivesem.run.counterexample": ("Counterexample", "attack"),
    "drivesem.run.finished": ("AttackRun", "load_run"),
    "drivesem.run.probes": ("Gradient", "detect", "gradient", "margin"),
    "drivesem.scenes.scene": ("Frames", "Scene", "demo_scene", "derender", "load_scene", "open_dataset"),
}


def __getattr__(name: str) -> Any:
    for module, names in _NAMES_BY_MODULE.items():
        if name in names:
            own_name = "load_predictor" if name == "load_detector" else name
            value = getattr(importlib.import_module(module), own_name)
            globals()[name] = value
            return value
    raise AttributeError(f"module 'drivesem' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
