"""Loads a detector from user code: a class in a file or in an installed package."""

from __future__ import annotations

import importlib.util
import pkgutil
import sys
import traceback
from pathlib import Path
from typing import Any

from torch import nn

from detectors.adapters.network import NetworkDetector
from detectors.adapters.spec import load_spec, validate_settings
from detectors.base import Detector, DetectorError, describe_error

RAISES_NOTHING = "methods that raise nothing"
"""Expectation towards user detectors, for errors."""
_LOADED: set[str] = set()
"""Files of the classes loaded so far."""


def describe_user_error(error: Exception) -> str | None:
    """An error of a user class with its location, if the error came through the class's file; otherwise None."""
    frames = traceback.extract_tb(error.__traceback__)
    return describe_error(error) if any(frame.filename in _LOADED for frame in frames) else None


def load_user_detector(spec_name: str, spec: Path | None = None) -> Detector:
    """Load the detector `path/to/file.py:ClassName` or `package.module:ClassName`; runs its code.

    The class is called without arguments. A `Detector` is returned as is; any other module is treated as a network
    in one of `detectors.adapters.formats`, with settings from its attribute `spec`, a mapping, and from a YAML
    file, which wins.

    Raises:
        DetectorError: There is no such class, or it is something else.
    """
    where, colon, name = spec_name.rpartition(":")
    if not (colon and where and name.isidentifier()):
        raise DetectorError(f"module: expected FILE.py:CLASS or PACKAGE.MODULE:CLASS, found {spec_name!r}")
    try:
        return _to_detector(_find_class(where, name)(), spec_name, name, spec)
    except DetectorError:
        raise
    except Exception as error:  # user code may raise anything
        raise DetectorError(
            f"{spec_name}: expected a class that can be created and run, found {describe_error(error)}"
        ) from error


def _to_detector(instance: Any, spec_name: str, name: str, spec: Path | None) -> Detector:
    """An instance of a user's class as a detector."""
    if isinstance(instance, Detector):
        if spec is not None:
            raise DetectorError(f"{spec_name}: expected no YAML file for a Detector, found {spec}")
        return instance
    if not isinstance(instance, nn.Module):
        raise DetectorError(
            f"{spec_name}: expected a Detector or a torch.nn.Module, found {type(instance).__name__}"
        )
    settings = validate_settings(getattr(instance, "spec", {}), f"{spec_name}: spec")
    settings |= load_spec(spec) if spec is not None else {}
    return NetworkDetector(str(getattr(instance, "name", name)), instance.eval(), settings, where=spec_name)


def _find_class(where: str, name: str) -> Any:
    try:
        if where.endswith(".py"):
            loaded = getattr(_import_file(Path(where)), name, None)
        else:
            loaded = pkgutil.resolve_name(f"{where}:{name}")
    except ImportError as error:
        raise DetectorError(f"module: expected a module {where}, found {error}") from None
    except AttributeError:
        loaded = None
    if not isinstance(loaded, type):
        raise DetectorError(f"{where}: expected a class {name}, found {type(loaded).__name__}")
    _LOADED.add(str(getattr(sys.modules.get(loaded.__module__), "__file__", None)))
    return loaded


def _import_file(path: Path) -> Any:
    """A file's module, as if imported; modules that it imports from its folder must be on Python's path."""
    if not path.is_file():
        raise DetectorError(f"{path}: expected a Python file, found none")
    spec = importlib.util.spec_from_file_location(f"_detector_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses and pickle look up a class's module by name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
