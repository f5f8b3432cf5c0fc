"""`drivesem gradcheck`: gradients against central differences."""

from __future__ import annotations

from drivesem.bench import gradcheck
from drivesem.settings.commands import Gradcheck


def run(config: Gradcheck) -> int:
    """Compare; exit code 1 where a tolerance is passed. Raises UsageError or SceneError for bad input."""
    return gradcheck.run(config)
