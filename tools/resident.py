"""Memory of a command that attacks many frames, over the frames that it has done: figures and a plot.

    python -m tools.small_frames 2000 small
    python -m tools.resident memory.png attack --dataset kitti --root small --workers 1 --out run

Resident memory of the one process is read from outside (Linux's /proc), now and then, with the number of frames
that are there. A JSON file of the same name is written next to the plot.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from scene_ir import files

_SECONDS = 0.5
"""Between two looks."""
_STOPPED = 130, 143
"""Exit codes of a command that was interrupted: what it did until then counts."""
_EARLY = 0.1
"""Share of the frames in which caches fill: the line is fitted to the rest."""


@dataclass(frozen=True, slots=True)
class MemoryTrace:
    """seconds, frames, mb: at each look; growth_kb: a frame, of a line through all but the first frames, from_mb
    to to_mb at its ends; peak_mb: the most.
    """

    command: str
    seconds: list[float]
    frames: list[int]
    mb: list[float]
    peak_mb: float
    growth_kb: float
    from_mb: float
    to_mb: float


def watch(words: Sequence[str], run: Path) -> MemoryTrace:
    """Run a command and sample its memory until it ends. run: the folder that it writes. RuntimeError if it fails;
    an interrupt is no failure.
    """
    start = time.monotonic()
    process = subprocess.Popen([sys.executable, "-m", "drivesem.cli", *words])
    samples: list[tuple[float, int, float]] = []
    while process.poll() is None:
        samples.append((round(time.monotonic() - start, 1), _frames_in(run), _resident_mb(process.pid)))
        time.sleep(_SECONDS)
    if process.returncode not in (0, *_STOPPED):
        raise RuntimeError(f"exit code {process.returncode}")
    return summarise_samples("drivesem " + " ".join(words), samples)


def summarise_samples(command: str, samples: Sequence[tuple[float, int, float]]) -> MemoryTrace:
    """What was seen: seconds, frames, MB."""
    samples = [sample for sample in samples if sample[2] > 0]  # a process that has just ended has none
    seconds, frames, mb = (list(column) for column in zip(*samples, strict=True))
    late = np.array(samples)[np.array(frames) >= _EARLY * max(frames)]
    slope, level = np.polyfit(late[:, 1], late[:, 2], 1)
    ends = [round(float(level + slope * late[place, 1]), 1) for place in (0, -1)]
    return MemoryTrace(command, seconds, frames, mb, max(mb), round(float(slope) * 1024, 2), *ends)


def _frames_in(run: Path) -> int:
    folder = run / "frames"
    return sum(not entry.name.startswith(".") for entry in os.scandir(folder)) if folder.is_dir() else 0


def _resident_mb(pid: int) -> float:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, 1)


def draw(found: MemoryTrace, path: Path) -> None:
    """The plot, as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.add_subplot(xlabel="frames attacked", ylabel="resident memory, MB")
    axes.plot(found.frames, found.mb, linewidth=0.8)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.set_title(f"growth {found.growth_kb:g} KB a frame, peak {found.peak_mb:.0f} MB", fontsize=10)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path, help="PNG file to write")
    parser.add_argument("words", nargs=argparse.REMAINDER, help="a command of drivesem with --out")
    given = parser.parse_args(argv)
    found = watch(given.words, Path(given.words[given.words.index("--out") + 1]))
    draw(found, given.picture)
    files.write_json(given.picture.with_suffix(".json"), asdict(found))
    scalars = {name: value for name, value in asdict(found).items() if not isinstance(value, list)}
    sys.stdout.write(json.dumps(scalars | {"frames": max(found.frames)}, indent=1) + "\n")


if __name__ == "__main__":
    main()
