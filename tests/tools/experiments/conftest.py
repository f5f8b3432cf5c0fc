"""Fixtures of the experiments: finished runs, a browser, and their command line."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.drivesem.commands.conftest import write_finished_run
from tests.drivesem.conftest import chromium, refused  # noqa: F401  # fixtures
from tools.experiments.__main__ import main

REQUIRED_KEYS = {
    *("name", "benign_ap50", "paper_ap50", "moved_ap50", "drop_paper", "drop_moved", "recall_paper"),
    *("recall_moved", "reference"),
}
"""What other programs read of a study's row."""


@pytest.fixture
def command_line() -> Callable[[list[str]], int]:
    """The program that `refused` calls."""
    return main


@pytest.fixture
def output_json(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    """Run an experiment with --json; what it prints."""

    def call(*words: object) -> dict[str, Any]:
        capsys.readouterr()
        assert main([*map(str, words), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    return call


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished run of three frames of two cars; a car is lost in two of them."""
    return write_finished_run(tmp_path / "run")
