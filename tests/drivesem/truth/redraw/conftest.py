"""OpenGL without a window, where this machine has it."""

from __future__ import annotations

import pytest

from drivesem.truth.redraw.base import NoSecondRendererError
from drivesem.truth.redraw.screen import Screen, shared_screen


@pytest.fixture(scope="session")
def screen() -> Screen:
    """Skipped by name where neither EGL nor OSMesa is there."""
    try:
        return shared_screen()
    except NoSecondRendererError as error:
        pytest.skip(str(error))
