"""`drivesem synth`: generated frames in a data set's layout."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from drivesem.config import Synth, UsageError, processes
from drivesem.synth.write import synthesise


def run(config: Synth) -> int:
    """Write the frames that are not there yet; exit code 0. Raises UsageError or SceneError for bad input."""
    start = time.perf_counter()
    out = Path(config.out or f"data/synth-{config.split}-seed{config.seed}")
    if out.exists() and not out.is_dir():
        raise UsageError("--out", "a folder", f"the file {out}")
    frames = config.frames if config.limit is None else min(config.frames, config.limit)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        done = synthesise(out, frames, config.seed, config.split, processes(config), resume=config.resume)
        for _ in progress.track(done, total=frames, description="making frames"):
            pass
    seconds = round(time.perf_counter() - start, 3)
    if config.json:
        sys.stdout.write(json.dumps({"out": str(out), "frames": frames, "seconds": seconds}) + "\n")
    else:
        Console().print(f"{frames} frames in {out} ({seconds:.0f} s)", soft_wrap=True)
    return 0
