"""Commands that are killed with SIGKILL at random moments, and given again until they are done: do they leave what
one leaves that nobody kills?

    python -m tools.killed --out killed.json                                # 100 kills of attack, 25 of each other
    python -m tools.killed --kills attack=5,train=5 --frames 6 --work DIR   # fewer; DIR keeps what they wrote

Compared are hashes of all files, without what no two runs share (`tools/same.py: VARYING`: seconds, versions), the
lock, and what a killed command leaves under names of its own, which `drivesem runs prune` removes. Exit code 1
where anything differs.
"""

from __future__ import annotations

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from drivesem.reporting.tables import Console, format_count, progress_bar
from scene_ir import files
from tools.same import Hasher, command_words, differences, environment
from tools.small_frames import small_frames

RUN = "run"
"""Folder that every command writes."""
_FRAMES = "--dataset kitti --root ../../small"
COMMANDS = {
    "attack": f"attack {_FRAMES} --no-fit --params translate,rotate --steps 3 --workers 1",
    "synth": "synth --frames {count} --seed 3 --workers 2",
    "derender": f"derender {_FRAMES} --fast --workers 2",
    "train": "train --root ../../small --held-out ../../small --steps {count} --batch 2 --window 96x64"
    " --checkpoint-every 4 --evaluate-every 5 --semantic 0.5",
    "multi": f"tools.experiments multi --quick {_FRAMES} --no-fit --steps 1 --bootstrap 20 --workers 1",
}
"""What is killed, each in a folder of its own below the work folder."""
KILLS = "attack=100,synth=25,derender=25,train=25,multi=25"
_MINUTES = 20
"""A command that takes longer is stopped."""


@dataclass
class KillTrial:
    """What became of a command."""

    name: str
    command: str
    unbroken_s: float = 0.0
    """What it takes that nobody kills."""
    kills: int = 0
    """Of these `begun` after it had made its folder."""
    begun: int = 0
    runs: int = 0
    """How many were killed until they were done."""
    files: int = 0
    left: int = 0
    """The most files and folders that kills left behind of one."""
    differing: list[str] = field(default_factory=list)
    """Files of such a run that are others than those of one that nobody killed."""


def run_unbroken(words: Sequence[str], folder: Path) -> None:
    """Run the command in `folder` to its end. RuntimeError for an exit code other than 0."""
    with (folder / "output.txt").open("w") as log:
        done = subprocess.run(
            words, cwd=folder, env=environment(folder.parent), stdout=log, stderr=log, timeout=60 * _MINUTES
        )
    _check(done.returncode, folder)


def run_killed(
    words: Sequence[str], folder: Path, delays: Sequence[float], trial: KillTrial, killed: Callable[[], object]
) -> int:
    """Run the command, killed and restarted once for each delay.

    Args:
        words: Command line.
        folder: Folder the command runs in.
        delays: Seconds until each kill.
        trial: Counts that this adds to.
        killed: Called after each kill.

    Returns:
        Number of kills before the command finished.

    Raises:
        RuntimeError: The command failed.
    """
    for used, delay in enumerate(delays):
        with (folder / "output.txt").open("w") as log:
            process = subprocess.Popen(words, cwd=folder, env=environment(folder.parent), stdout=log, stderr=log)
            try:
                _check(process.wait(delay), folder)
                return used
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                trial.kills += 1
                trial.begun += (folder / RUN).exists()
                killed()
    run_unbroken(words, folder)
    return len(delays)


def _check(code: int, folder: Path) -> None:
    if code != 0:
        raise RuntimeError(f"{folder}: exit code {code}: {(folder / 'output.txt').read_text()[-2000:]}")


def hashes(folder: Path, trial: KillTrial) -> dict[str, str]:
    """Of what a run left in `folder`, less what kills left, which is removed."""
    left = files.find_leftovers(folder / RUN)
    trial.left = max(trial.left, len(left))
    for path in left:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    return Hasher({folder.parent: "WORK"}).rows(RUN, folder / RUN)


def try_out(
    trial: KillTrial,
    words: Sequence[str],
    work: Path,
    kills: int,
    spread: float,
    seed: int,
    killed: Callable[[], object] = lambda: None,
) -> None:
    """Kill the command so often, at moments that are drawn from the first part, `spread` of the whole, of what it
    takes unbroken: a run that goes on is done with what lies behind it.
    """
    generator = random.Random(f"{trial.name}:{seed}")
    whole = work / trial.name / "whole"
    whole.mkdir(parents=True)
    start = time.monotonic()
    run_unbroken(words, whole)
    trial.unbroken_s = round(time.monotonic() - start, 1)
    expected = hashes(whole, trial)
    trial.files = len(expected)
    while trial.kills < kills:
        folder = work / trial.name / f"run-{trial.runs:03d}"
        folder.mkdir()
        delays = [generator.uniform(0, spread * trial.unbroken_s) for _ in range(kills - trial.kills)]
        run_killed(words, folder, delays, trial, killed)
        trial.runs += 1
        found = differences(expected, hashes(folder, trial))
        trial.differing += [f"{folder.name}: {line}" for line in found]
        if not found:
            shutil.rmtree(folder)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; exit code 1 where anything differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", default=KILLS, help="how many of each command")
    parser.add_argument("--frames", type=int, default=30, help="and steps of training")
    parser.add_argument("--spread", type=float, default=0.4, help="share of the time unbroken, for kills")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--work", type=Path, help="folder to work in, which stays; by default a temporary one")
    given = parser.parse_args(argv)
    console = Console(stderr=True)
    trials: list[KillTrial] = []
    with tempfile.TemporaryDirectory() as temporary:
        work = (given.work or Path(temporary)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        if not (work / "small").is_dir():
            with files.atomic_folder(work / "small") as part:
                small_frames(part, given.frames)
        for name, kills in (one.split("=") for one in given.kills.split(",")):
            command = COMMANDS[name].format(count=given.frames) + f" --out {RUN}"
            trial = KillTrial(name, command)
            trials.append(trial)
            shutil.rmtree(work / name, ignore_errors=True)
            words = [sys.executable, "-m", *command_words(command, work / name, work / name)]
            with progress_bar(console, keep=False) as progress:
                task = progress.add_task(f"kills of {name}", total=int(kills))
                try:
                    try_out(
                        trial, words, work, int(kills), given.spread, given.seed, partial(progress.advance, task)
                    )
                except RuntimeError as error:
                    trial.differing.append(str(error))
            if given.out is not None:
                files.write_json(given.out, [asdict(one) for one in trials])
            console.print(
                f"{name}: {format_count(trial.kills, 'kill')} ({trial.begun} after the folder was made) in"
                f" {format_count(trial.runs, 'run')} of {trial.unbroken_s:g} s and {format_count(trial.files, 'file')}:"
                f" {format_count(len(trial.differing), 'difference')}",
                *trial.differing[:20],
                sep="\n",
                soft_wrap=True,
                markup=False,
            )
    return int(any(trial.differing for trial in trials))


if __name__ == "__main__":
    sys.exit(main())
