"""A detector that is written by a user: a class in a file or in an installed package."""

from __future__ import annotations

import importlib.util
import pkgutil
import sys
import traceback
from pathlib import Path
from typing import Any

from torch import nn

from detectors.adapters.network import NetworkDetector
from detectors.adapters.spec import checked, load_spec
from detectors.base import Detector, DetectorError, raised

RAISES_NOTHING = "methods that raise nothing"
"""What is expected of a detector of the user's own."""
_LOADED: set[str] = set()
"""Files of the classes that were loaded."""


def blamed(error: Exception) -> str | None:
    """What a user's class raised, and where, where an error came through the file of one; else None."""
    frames = traceback.extract_tb(error.__traceback__)
    return raised(error) if any(frame.filename in _LOADED for frame in frames) else None


def load(place: str, spec: Path | None = None) -> Detector:
    """The detector of `path/to/file.py:ClassName` or `package.module:ClassName`; its code is run.

    The class is called without arguments. A `Detector` is taken as it is; any other module is a network whose
    outputs a format reads (`detectors.adapters.formats`), with the settings of its attribute `spec`, a mapping,
    and of a YAML file, which wins. DetectorError where there is no such class, or it is something else.
    """
    where, colon, name = place.rpartition(":")
    if not (colon and where and name.isidentifier()):
        raise DetectorError(f"module: expected FILE.py:CLASS or PACKAGE.MODULE:CLASS, found {place!r}")
    try:
        return _made(_class(where, name)(), place, name, spec)
    except DetectorError:
        raise
    except Exception as error:  # whatever a user's code raises
        raise DetectorError(
            f"{place}: expected a class that can be made and tried, found {raised(error)}"
        ) from error


def _made(made: Any, place: str, name: str, spec: Path | None) -> Detector:
    """An instance of a user's class as a detector."""
    if isinstance(made, Detector):
        if spec is not None:
            raise DetectorError(
                f"{place}: expected no YAML file beside a Detector, which has its own, found {spec}"
            )
        return made
    if not isinstance(made, nn.Module):
        raise DetectorError(f"{place}: expected a Detector or a torch.nn.Module, found {type(made).__name__}")
    settings = checked(getattr(made, "spec", {}), f"{place}: spec")
    settings |= load_spec(spec) if spec is not None else {}
    return NetworkDetector(str(getattr(made, "name", name)), made.eval(), settings, where=place)


def _class(where: str, name: str) -> Any:
    try:
        if where.endswith(".py"):
            found = getattr(_file(Path(where)), name, None)
        else:
            found = pkgutil.resolve_name(f"{where}:{name}")
    except ImportError as error:
        raise DetectorError(f"module: expected a module {where}, found {error}") from None
    except AttributeError:
        found = None
    if not isinstance(found, type):
        raise DetectorError(f"{where}: expected a class {name}, found {type(found).__name__}")
    _LOADED.add(str(getattr(sys.modules.get(found.__module__), "__file__", None)))
    return found


def _file(path: Path) -> Any:
    """A file's module, as if it were imported; what it imports from its own folder must be on Python's path."""
    if not path.is_file():
        raise DetectorError(f"{path}: expected a Python file, found none")
    spec = importlib.util.spec_from_file_location(f"_detector_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses and pickles look a class's module up by name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
