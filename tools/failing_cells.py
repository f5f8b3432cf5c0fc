"""Failing cells of the map, and certain failures, that runs on the same frames find for their passes.

    python -m tools.failing_cells runs/learn runs/si-fgsm runs/climb

A Markdown table: a row a run; the last columns are the first run less this one. Only frames that all runs have count.
Intervals: 95 %, by bootstrap over frames; a failing cell is shared by the objects that are lost for certain in it, so
that each draw of frames has a number of cells.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from drivesem.evaluation.resampling import (
    Interval,
    NamedMetric,
    bootstrap_intervals,
    paired_differences,
    ratio_metric,
)
from drivesem.run.finished import load_runs
from drivesem.run.frame import build_map, certain_losses
from drivesem.run.results import FrameResult
from tools.run_table import print_table

_COLUMNS = (
    "run", "frames", "found before", "certain", "failing cells", "passes", "cells for 1,000 passes",
    "certain for 1,000 passes", "cells a minute", "cells for 1,000 passes: first less this",
)  # fmt: skip


def find_failing_cells(results: Sequence[FrameResult]) -> tuple[int, list[NamedMetric]]:
    """Number of failing cells of a run, and its figures that are ratios over frames: failing cells and certain
    failures for 1,000 passes, failing cells a minute.
    """
    cells = [cell for cell in build_map(results).cells if cell.certain]
    shares: defaultdict[str, float] = defaultdict(float)
    for cell in cells:
        for frame, _ in cell.failures:
            shares[frame] += 1 / cell.certain
    share = np.array([shares[r.identifier] for r in results])
    certain = np.array([len(certain_losses(r)) for r in results], np.float64)
    thousands = np.array([(r.passes or 0) / 1000 for r in results])
    minutes = np.array([r.seconds / 60 for r in results])
    metrics = [("cells", share, thousands), ("certain", certain, thousands), ("minute", share, minutes)]
    return len(cells), [ratio_metric(*metric) for metric in metrics]


def compare(folders: Sequence[str], draws: int = 2000, seed: int = 0) -> list[tuple[str, ...]]:
    """Rows of the table. Raises UsageError or FormatError for folders that are no runs."""
    runs = {
        run.name: {frame.result.identifier: frame.result for frame in run.frames}
        for run in load_runs(folders, setting="runs")
    }
    names = sorted(set.intersection(*(set(frames) for frames in runs.values())))
    rows: list[tuple[str, ...]] = []
    first: list[NamedMetric] = []
    for run, frames in runs.items():
        results = [frames[name] for name in names]
        count, metrics = find_failing_cells(results)
        rates = bootstrap_intervals(metrics, len(names), draws, np.random.default_rng(seed))
        ahead = ""
        if first:
            generator = np.random.default_rng(seed)
            (difference,) = paired_differences(metrics[:1], first[:1], len(names), draws, generator, test=False)
            ahead = _format(Interval("ahead", difference.difference, difference.low, difference.high))
        first = first or metrics
        found, passes = sum(len(r.found_before) for r in results), sum(r.passes or 0 for r in results)
        certain = sum(len(certain_losses(r)) for r in results)
        counts = (str(value) for value in (len(names), found, certain, count, passes))
        rows.append((run, *counts, *map(_format, rates), ahead))
    return rows


def _format(rate: Interval) -> str:
    if rate.value is None or rate.low is None or rate.high is None:
        return "-"
    return f"{rate.value:.1f} [{rate.low:.1f}, {rate.high:.1f}]"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="folders of runs on the same frames")
    runs = parser.parse_args(arguments).runs
    print_table(parser, "Failing cells", _COLUMNS, lambda: compare(runs))


if __name__ == "__main__":
    main()
