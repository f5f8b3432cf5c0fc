"""How well the model of `--method learn` predicts margins in frames that it has not seen, and what each feature adds.

    python -m tools.margin_model runs/learn

A Markdown table: all features, then all but one. The rows of a run's `margins.npz` are split by frame into five parts;
each is predicted by a model of the other four. Explained: share of the margins' variance. AUC: of a missed and a found
object, how often the missed one has the lower prediction. Inside: share of margins between the tenth and the ninetieth
percentile of the trees, whose 80 % would be a perfect spread.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from drivesem.attacks.methods.learned import HIGHEST_MARGIN, LOWEST_MARGIN, MarginModel
from drivesem.config.errors import UsageError
from drivesem.failures.search_log import OBJECT_FEATURES
from drivesem.run.search_memory import MARGINS, Experience
from tools.run_table import print_table

_PARTS = 5
_COLUMNS = ("features", "frames", "rows", "missed", "explained", "AUC", "inside")


def judge_model(rows: np.ndarray, frames: np.ndarray) -> tuple[float, float, float]:
    """Explained variance, AUC of misses, and share of margins inside the trees' middle 80 %, in frames that are not
    in the fit.

    Args:
        rows: (R, F + 1), features and margin in logits.
        frames: (R,), number of the frame of each row.
    """
    from sklearn.metrics import roc_auc_score

    margins = rows[:, -1].clip(LOWEST_MARGIN, HIGHEST_MARGIN)
    predicted = np.zeros((3, len(rows)))
    known = np.unique(frames)
    for part in range(_PARTS):
        out = np.isin(frames, known[part::_PARTS])
        if out.any():
            by_tree = MarginModel(rows[~out]).predict(torch.from_numpy(rows[out, :-1])).numpy()
            predicted[:, out] = [by_tree.mean(0), *np.quantile(by_tree, (0.1, 0.9), axis=0)]
    mean, low, high = predicted
    explained = 1 - np.square(mean - margins).mean() / margins.var()
    return (
        float(explained),
        float(roc_auc_score(margins < 0, -mean)),
        float(np.mean((low <= margins) & (margins <= high))),
    )


def compare_features(folder: Path) -> list[tuple[str, ...]]:
    """Rows of the table. Raises UsageError for too few frames, FormatError for a damaged file."""
    paths = sorted(folder.glob(f"frames/*/{MARGINS}"))
    by_frame = [Experience.read(path).rows for path in paths]
    if len(paths) < _PARTS:
        raise UsageError("run", f"{_PARTS} frames with {MARGINS} or more", f"{len(paths)} in {folder}")
    rows = np.concatenate(by_frame)
    frames = np.repeat(np.arange(len(by_frame)), [len(part) for part in by_frame])
    counts = (str(len(paths)), str(len(rows)), str(int((rows[:, -1] < 0).sum())))
    table: list[tuple[str, ...]] = []
    for left_out in (None, *range(len(OBJECT_FEATURES))):
        chosen = rows if left_out is None else np.delete(rows, left_out, 1)
        name = "all" if left_out is None else f"without {OBJECT_FEATURES[left_out]}"
        table.append((name, *counts, *(f"{figure:.2f}" for figure in judge_model(chosen, frames))))
    return table


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a run with --method learn")
    run = parser.parse_args(arguments).run
    print_table(parser, "Predicted margins", _COLUMNS, lambda: compare_features(run))


if __name__ == "__main__":
    main()
