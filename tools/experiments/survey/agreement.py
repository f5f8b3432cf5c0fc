"""How far people agree: Krippendorff's alpha.

alpha = 1 - D_o / D_e: the disagreement within items, over what is expected of values dealt at random
(Krippendorff, Content Analysis, ch. 11). 1: all agree; 0: as by chance; below 0: worse. It takes gaps and any
number of people.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np


def alpha(items: Sequence[Sequence[Any]], squared_distance: Callable[[Any, Any], float]) -> float | None:
    """Of the answers to each item; None where no item has two answers, or all answers are the same.

    squared_distance: of two answers, such as `nominal` or `interval`.
    """
    pairable = [list(answers) for answers in items if len(answers) >= 2]
    everything = [answer for answers in pairable for answer in answers]
    count = len(everything)
    if not count:
        return None
    within = sum(_sum_of_pairs(answers, squared_distance) / (len(answers) - 1) for answers in pairable) / count
    expected = _sum_of_pairs(everything, squared_distance) / (count * (count - 1))
    return None if expected == 0 else 1 - within / expected


def nominal(first: Hashable, second: Hashable) -> float:
    """For names: 1 where they differ."""
    return float(first != second)


def interval(first: float, second: float) -> float:
    """For numbers on an even scale."""
    return float(first - second) ** 2


def _sum_of_pairs(answers: Sequence[Any], squared_distance: Callable[[Any, Any], float]) -> float:
    """Over ordered pairs of different answers, equal values counted together."""
    values = list(dict.fromkeys(answers))
    times = np.array([answers.count(value) for value in values], np.float64)
    apart = np.array([[squared_distance(a, b) for b in values] for a in values])
    return float(times @ apart @ times)
