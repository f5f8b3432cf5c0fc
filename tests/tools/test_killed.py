"""Killed commands: is a command told from one that does not end alike?"""

import random
import sys
from pathlib import Path

import pytest

from tools import killed
from tools.killed import KillTrial, main, try_out
from tools.resident import summarise_samples

_SOUND = """
import os, pathlib, time
run = pathlib.Path("run")
run.mkdir(exist_ok=True)
for number in range(12):
    path = run / f"{number}.txt"
    if not path.exists():
        time.sleep(0.02)
        half = run / f".{number}.txt.0123abcd.tmp"
        half.write_text("half")
        time.sleep(0.01)
        half.write_text(f"{number}")
        os.replace(half, path)
"""
_HALF = """
import pathlib, time
run = pathlib.Path("run")
run.mkdir(exist_ok=True)
for number in range(12):
    path = run / f"{number}.txt"
    if not path.exists():
        with path.open("w") as file:
            file.write("half")
            file.flush()
            time.sleep(0.03)
            file.write("whole")
"""


def tried(code: str, folder: Path, kills: int = 12) -> KillTrial:
    trial = KillTrial("stub", "stub")
    try_out(trial, [sys.executable, "-c", code], folder, kills, 0.8, seed=1)
    return trial


def test_a_command_that_goes_on_well_ends_alike(tmp_path: Path) -> None:
    trial = tried(_SOUND, tmp_path)
    assert (trial.kills, trial.differing) == (12, [])
    assert trial.files == 12
    assert trial.begun > 0
    assert trial.runs > 0


def test_a_command_that_takes_half_a_file_for_a_whole_one_does_not(tmp_path: Path) -> None:
    trial = tried(_HALF, tmp_path)
    assert all("differs: run/" in line for line in trial.differing)
    assert trial.differing


def test_a_command_that_fails_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="exit code 3"):
        tried("raise SystemExit(3)", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", killed.COMMANDS)
def test_commands_that_are_killed_end_alike(name: str, tmp_path: Path) -> None:
    """Three kills each; `python -m tools.killed` makes as many as are wanted."""
    seed = str(random.SystemRandom().randrange(10**6))
    words = ["--kills", f"{name}=3", "--frames", "4", "--seed", seed, "--work", str(tmp_path)]
    assert main(words) == 0, f"seed {seed}"


def test_growth_is_that_of_a_line_through_later_frames() -> None:
    looks = [(0.5 * frame, frame, 500.0 + min(frame, 10) * 20 + 0.25 * frame) for frame in range(101)]
    found = summarise_samples("drivesem attack", [*looks, (51.0, 101, 0.0)])
    assert found.growth_kb == pytest.approx(256, rel=1e-3)
    assert (found.from_mb, found.to_mb) == (702.5, 725.0)
    assert found.peak_mb == 725.0
