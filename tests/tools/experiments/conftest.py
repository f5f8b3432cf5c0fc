"""The command line of the experiments."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tools.experiments.__main__ import main


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """The one line with which bad input is refused."""

    def run(*words: object) -> str:
        capsys.readouterr()
        assert main([*map(str, words)]) == 2
        output = capsys.readouterr()
        (line,) = output.err.splitlines()
        assert output.out == ""
        return line

    return run
