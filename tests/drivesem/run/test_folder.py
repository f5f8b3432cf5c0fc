"""A run's folder: whose it is, and which files it was made with."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivesem.config.commands import AttackConfig
from drivesem.config.errors import UsageError
from drivesem.run.folder import REFERENCED_FILES, check_referenced_files, claim_folder
from drivesem.run.lock import release_folder_locks


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "new, of:today.safetensors"
    path.write_bytes(b"one")
    return path


def claimed(config: AttackConfig, out: Path, renews: bool = False) -> None:
    with release_folder_locks():
        claim_folder(out, config, ("frames",), renews=renews)


@pytest.mark.parametrize("spelled", ["{}", "module:{}:Detector", "squeezedet,{}"])
def test_a_run_goes_on_with_the_files_that_it_was_made_with(spelled: str, tmp_path: Path) -> None:
    path, out = tmp_path / "weights.bin", tmp_path / "run"
    path.write_bytes(b"one")
    config = AttackConfig(detector=spelled.format(path))
    for _ in range(2):
        claimed(config, out)
        check_referenced_files(out, config)
    path.write_bytes(b"two")
    for check in (lambda: claimed(config, out), lambda: check_referenced_files(out, config)):
        with pytest.raises(
            UsageError, match=rf"{out / REFERENCED_FILES}: expected the files .*another.*weights\.bin"
        ):
            check()
    claimed(AttackConfig(detector=spelled.format(path), resume=False), out)
    check_referenced_files(out, config)


def test_what_renews_begins_again_where_a_file_is_another(weights: Path, tmp_path: Path) -> None:
    config, out = AttackConfig(detector=weights.name), tmp_path / "run"
    claimed(config, out, renews=True)
    (out / "frames").mkdir()
    claimed(config, out, renews=True)
    assert (out / "frames").is_dir()
    weights.write_bytes(b"two")
    claimed(config, out, renews=True)
    assert not (out / "frames").exists()


def test_names_that_are_no_files_leave_none(tmp_path: Path) -> None:
    config = AttackConfig(detector="squeezedet")
    claimed(config, tmp_path / "run")
    assert not (tmp_path / "run" / REFERENCED_FILES).exists()
    check_referenced_files(tmp_path / "run", config)
