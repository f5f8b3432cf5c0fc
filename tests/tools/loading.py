"""Maintainers' scripts as modules."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.append(str(TOOLS))  # as it is where such a script runs


def tool(name: str) -> ModuleType:
    """The script tools/NAME.py, as a module of that name."""
    return importlib.import_module(name)
