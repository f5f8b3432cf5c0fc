"""The contact sheet of the classifiers' objects."""

from __future__ import annotations

from pathlib import Path

import pytest

from scene_ir import files
from tools.object_sheet import main


def test_a_sheet_has_a_row_a_class(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["--classes", "bus", "mailbox", "--each", "1", "--size", "32", "--views", "forward", "top"]
    for name in ("sheet.png", "sheet.jpg"):
        main([str(tmp_path / name), *words])
        assert files.read_image(tmp_path / name).shape == (64, 64, 3)
    assert capfd.readouterr().err == ""


def test_another_ending_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "sheet")])
    assert ended.value.code == 2
    assert "out: expected a .jpg or .png file, found" in capsys.readouterr().err
