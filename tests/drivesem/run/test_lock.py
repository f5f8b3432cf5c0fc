"""Two commands and one folder."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivesem.cli import main
from drivesem.config.errors import UsageError
from drivesem.run.lock import LOCK, acquire_folder_lock, is_locked_elsewhere, release_folder_locks
from tests.drivesem.invoke import invoke, refusal

OTHER = """
import sys
from pathlib import Path
from drivesem.run.lock import acquire_folder_lock
acquire_folder_lock(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


@contextmanager
def another_process(folder: Path) -> Iterator[Callable[[], None]]:
    """It holds the folder. Yields what kills it."""
    with subprocess.Popen(
        [sys.executable, "-c", OTHER, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"

        def kill() -> None:
            other.kill()
            other.wait()

        try:
            yield kill
        finally:
            kill()


def test_a_run_that_is_being_made_is_no_run_that_stopped(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    config = "detector: squeezedet\ndataset: demo\nparams: null\ncombo: null\nmethod: si-fgsm\n"
    (folder / "config.yaml").write_text(config)
    with another_process(folder):
        assert is_locked_elsewhere(folder)
        assert f"found {folder}, into which an attack is still writing" in refusal("explain", folder)
        (folder / "frames").mkdir()
        assert "run: running, 0 frames; combo 2 by si-fgsm" in invoke("runs", "list", tmp_path).out
    assert not is_locked_elsewhere(folder)
    assert f"found {folder}, which stopped early" in refusal("explain", folder)
    acquire_folder_lock(folder)  # by this process: nobody else
    assert not is_locked_elsewhere(folder)


COMMANDS = {
    "attack": ["attack", "--limit", "1", "--steps", "1"],
    "synth": ["synth", "--frames", "1"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_second_command_is_one_line_and_writes_nothing(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    with another_process(out):
        assert main([*COMMANDS[name], "--out", str(out)]) == 2
    written = capsys.readouterr()
    expected = "a folder that no other command writes into now"
    assert written.err == f"drivesem: --out: expected {expected}, found {out}\n"
    assert written.out == ""
    assert [path.name for path in out.iterdir()] == [LOCK]


def test_a_killed_command_holds_nothing(tmp_path: Path) -> None:
    with another_process(tmp_path) as kill:
        with pytest.raises(UsageError, match="no other command writes"):
            acquire_folder_lock(tmp_path)
        kill()
        with release_folder_locks():
            acquire_folder_lock(tmp_path)


def test_what_was_begun_and_killed_at_once_is_a_new_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    with another_process(out) as kill:
        kill()
    words = ["attack", "--limit", "1", "--steps", "1", "--workers", "1", "--no-fit", "--out", str(out)]
    assert main(words) == 0, capsys.readouterr().err
    assert (out / "metrics.json").is_file()


def test_a_process_may_lock_again_and_unlocks_at_its_end(tmp_path: Path) -> None:
    with release_folder_locks():
        acquire_folder_lock(tmp_path)
        with release_folder_locks():
            acquire_folder_lock(tmp_path)
        with pytest.raises(subprocess.CalledProcessError):  # what was held outside stays held
            _by_another(tmp_path)
    _by_another(tmp_path)


def _by_another(folder: Path) -> None:
    command = [sys.executable, "-c", OTHER, str(folder)]
    subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=True)
