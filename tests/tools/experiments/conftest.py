"""Fixtures of the experiments: finished runs, a browser, and the line with which bad input is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.drivesem.commands.conftest import write_run  # noqa: F401  # a fixture
from tests.drivesem.conftest import chromium  # noqa: F401  # a fixture
from tools.experiments.__main__ import main


@pytest.fixture
def refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., str]:
    """The one line with which a command refuses bad input; it leaves no file behind."""

    def run(*words: str) -> str:
        folder = tmp_path / "empty"
        folder.mkdir()
        monkeypatch.chdir(folder)
        assert main(list(words)) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert not list(folder.iterdir())
        return line

    return run
