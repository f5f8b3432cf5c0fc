"""Which frames of a run are its own."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from drivesem.run.labels import list_frames
from scene_ir import files
from scene_ir.errors import FormatError


@pytest.fixture
def run(tmp_path: Path) -> Path:
    for name in ("000000", "000001", "Scene01/clone/00002", ".part"):
        files.write_json(tmp_path / "frames" / name / "result.json", {})
    return tmp_path


def test_frames_of_a_run_that_is_not_finished_are_those_in_its_folder(run: Path) -> None:
    assert list_frames(run) == ["000000", "000001", "Scene01/clone/00002"]


def test_frames_of_a_finished_run_are_those_of_its_manifest(run: Path) -> None:
    """The same command with a smaller --limit leaves the other frames where they are."""
    files.write_json(run / "manifest.json", {"frames": {"000001": {}, "000000": {}}})
    assert list_frames(run) == ["000000", "000001"]


def test_a_damaged_manifest_is_refused(run: Path) -> None:
    for frames in (["000000"], {"../other": {}}, None):
        files.write_json(run / "manifest.json", {"frames": frames})
        with pytest.raises(FormatError, match="frames"):
            list_frames(run)


def test_a_folder_without_frames_is_no_run(run: Path) -> None:
    shutil.rmtree(run / "frames")
    files.write_json(run / "manifest.json", {"frames": ["of a generator"]})
    assert list_frames(run) == []
