"""Semantic counterexamples for driving detectors: the Python door.

    import drivesem as ds

    scene = ds.derender("000008.png", labels="label_2/000008.txt", calib="calib/000008.txt")
    found = ds.attack(scene, "squeezedet", params="translate,rotate,mesh")
    found.picture, found.theta, found.failures
    scene.edit("objects[1].translate=0.5m,0m", weather="fog").render()

Each name is loaded when it is first asked for: importing this package is quick and loads nothing heavy.
docs/python.md says more; `drivesem --help` has the command line.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from drivesem.version import __version__ as __version__

if TYPE_CHECKING:
    from detectors.registry import load_predictor as load_detector
    from drivesem.run.counterexample import Counterexample, attack
    from drivesem.run.finished import Run, load_run
    from drivesem.scenes.scene import Frames, Scene, demo_scene, derender, load_scene, open_dataset

__all__ = [
    "Counterexample",
    "Frames",
    "Run",
    "Scene",
    "attack",
    "demo_scene",
    "derender",
    "load_detector",
    "load_run",
    "load_scene",
    "open_dataset",
]
_COUNTEREXAMPLE, _FINISHED, _SCENE = (
    "drivesem.run.counterexample",
    "drivesem.run.finished",
    "drivesem.scenes.scene",
)
_HOMES = {
    "Counterexample": (_COUNTEREXAMPLE, "Counterexample"),
    "Frames": (_SCENE, "Frames"),
    "Run": (_FINISHED, "Run"),
    "Scene": (_SCENE, "Scene"),
    "demo_scene": (_SCENE, "demo_scene"),
    "derender": (_SCENE, "derender"),
    "load_detector": ("detectors.registry", "load_predictor"),
    "load_run": (_FINISHED, "load_run"),
    "load_scene": (_SCENE, "load_scene"),
    "open_dataset": (_SCENE, "open_dataset"),
}
"""Where each name lives, and what it is called there. `attack` is a room of the house as well: see `_Door`."""


def __getattr__(name: str) -> Any:
    if name == "attack":
        return importlib.import_module("drivesem.attack")
    if name not in _HOMES:
        raise AttributeError(f"module 'drivesem' has no attribute {name!r}")
    home, own_name = _HOMES[name]
    value = getattr(importlib.import_module(home), own_name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__


class _AttackRoom(ModuleType):
    """The package `drivesem.attack`, which can be called: `ds.attack(scene, ...)`."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Change a scene until a detector gets it wrong: see `drivesem.run.counterexample.attack`."""
        return importlib.import_module(_COUNTEREXAMPLE).attack(*arguments, **options)


class _Door(ModuleType):
    """This module. When Python first imports `drivesem.attack` it sets the package here: it becomes callable."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "attack" and isinstance(value, ModuleType):
            value.__class__ = _AttackRoom
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Door
