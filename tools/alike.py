"""Did two runs of `drivesem attack` find the same? Success, failures, kinds and grades, frame by frame.

    python -m tools.alike runs/whole runs/incremental

For what computes the same in another way, such as `--whole` and `--incremental`, of which only rounding may
differ. A frame that differs stands in a row of its own, with the margins of what only one run has.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from typing import Any

from drivesem.config.errors import UsageError
from drivesem.report.tables import number_of
from drivesem.run.finished import load_runs
from drivesem.run.results import Failure, FrameResult
from scene_ir.errors import SceneError

Known = tuple[str, str | None, str | None, int | None]


def known_by(failure: Failure) -> Known:
    """What of a failure must be the same: kind by threshold, kind, grade, object."""
    return failure.kind, failure.error, failure.grade, failure.index


def difference(first: FrameResult, second: FrameResult) -> dict[str, Any] | None:
    """What differs in a frame, and what of the whole answer is only one run's; None where nothing does."""
    successes = [[r.success_moved, r.success_paper] for r in (first, second)]
    counts = [Counter(known_by(f) for f in r.failures) for r in (first, second)]
    only = [counts[0] - counts[1], counts[1] - counts[0]]
    if successes[0] == successes[1] and not any(only):
        return None
    rows = [
        [_told(f) for f in result.failures if known_by(f) in rest]
        for result, rest in zip((first, second), only, strict=True)
    ]
    return {"frame": first.identifier, "success": successes, "first": rows[0], "second": rows[1]}


def _told(failure: Failure) -> dict[str, Any]:
    row = failure.flat()
    kept = ("by_threshold", "kind", "grade", "object", "score", "right_before", "wrong_after", "margin_after")
    return {name: row[name] for name in kept}


def compare(folders: Sequence[str]) -> dict[str, Any]:
    """Two runs by folder. Raises UsageError for what is no finished run, or runs of other frames."""
    one, other = load_runs(folders, setting="runs")
    names = [[f.result.identifier for f in run.frames] for run in (one, other)]
    if names[0] != names[1]:
        raise UsageError("runs", "the same frames", f"{len(names[0])} and {len(names[1])}, or others")
    pairs = [(a.result, b.result) for a, b in zip(one.frames, other.frames, strict=True)]
    thetas = [
        max((abs(x.value - y.value) for x, y in zip(a.theta, b.theta, strict=True)), default=0.0) for a, b in pairs
    ]
    return {
        "frames": len(pairs),
        "failures": [sum(len(pair[i].failures) for pair in pairs) for i in range(2)],
        "same_theta": sum(worst == 0 for worst in thetas),
        "differing": [found for pair in pairs if (found := difference(*pair)) is not None],
    }


def main(words: Sequence[str] | None = None) -> int:
    """Command line; exit code 1 where a frame differs, 2 for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs=2, help="folders of drivesem attack")
    options = parser.parse_args(words)
    try:
        found = compare(options.runs)
    except (UsageError, SceneError) as error:
        sys.stderr.write(f"python -m tools.alike: {' '.join(str(error).split())}\n")
        return 2
    first, second = found["failures"]
    print(
        f"{number_of(found['frames'], 'frame')}, {first} and {number_of(second, 'failure')}, "
        f"theta equal in {found['same_theta']}"
    )
    for row in found["differing"]:
        print(f"{row['frame']}: success {row['success'][0]} and {row['success'][1]}")
        for side in ("first", "second"):
            for failure in row[side]:
                print(f"  {side} only: " + ", ".join(f"{name} {value}" for name, value in failure.items()))
    print(f"{len(found['differing'])} frames differ")
    return int(bool(found["differing"]))


if __name__ == "__main__":
    raise SystemExit(main())
