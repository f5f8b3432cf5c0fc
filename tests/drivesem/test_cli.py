"""Commands load their modules, and garbage is collected afterwards."""

from __future__ import annotations

import gc

import pytest

from drivesem import cli


def test_garbage_is_collected_again_once_a_command_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    assert callable(cli._load("runs"))
    assert gc.isenabled()

    def fail(name: str) -> None:
        assert not gc.isenabled()
        raise ImportError(name)

    monkeypatch.setattr(cli.importlib, "import_module", fail)
    with pytest.raises(ImportError, match=r"drivesem\.commands\.runs"):
        cli._load("runs")
    assert gc.isenabled()
