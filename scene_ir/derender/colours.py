"""What colours (..., 3) come to, channel by channel: NumPy's own sums over so short an axis take ten times longer.

The order of operations is NumPy's, so that no bit differs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Colours = NDArray[Any]


def largest(colours: Colours) -> Colours:
    """The largest of the three channels."""
    return np.maximum(np.maximum(colours[..., 0], colours[..., 1]), colours[..., 2])


def grey(colours: Colours) -> Colours:
    """The mean of the three channels."""
    return (colours[..., 0] + colours[..., 1] + colours[..., 2]) / np.float32(3)


def square_length(colours: Colours) -> Colours:
    """The squares of the three channels, added up."""
    red, green, blue = (colours[..., channel] for channel in range(3))
    return red * red + green * green + blue * blue
