"""Fixtures of the experiments: finished runs, a browser, and their command line."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.drivesem.commands.conftest import write_run  # noqa: F401  # a fixture
from tests.drivesem.conftest import chromium, refused  # noqa: F401  # fixtures
from tools.experiments.__main__ import main


@pytest.fixture
def command_line() -> Callable[[list[str]], int]:
    """The program that `refused` calls."""
    return main
