"""Fréchet distance of two sets of features, each taken as a Gaussian (Heusel et al., NIPS 2017, eq. 6).

|m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)). With C = R^T R, the square root's trace is the sum of the singular
values of R1 R2^T: no root of a matrix, nothing to add where there are fewer pictures than features, same value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_ir.errors import RangeError, ShapeError

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Gaussian:
    """mean (D,); root (K, D), whose root^T root is the covariance."""

    mean: Floats
    root: Floats

    @classmethod
    def of(cls, features: Floats) -> Gaussian:
        """Of features (N, D), N >= 2, covariance over N - 1.

        Raises ShapeError for fewer than two, RangeError for a feature that is not finite.
        """
        if features.ndim != 2 or len(features) < 2:
            raise ShapeError("features of a Fréchet distance", "at least two pictures", len(features))
        if not np.isfinite(features).all():
            raise RangeError("features of a Fréchet distance", "finite numbers", "others")
        features = features.astype(np.float64)
        mean = features.mean(axis=0)
        root = (features - mean) / np.sqrt(len(features) - 1)
        if len(root) > root.shape[1]:
            root = np.asarray(np.linalg.qr(root, mode="r"))
        return cls(mean, root)

    @classmethod
    def of_moments(cls, mean: Floats, covariance: Floats) -> Gaussian:
        """Of a mean (D,) and a covariance (D, D). Raises ShapeError where they do not fit, RangeError where the
        covariance is not symmetric and positive semi-definite."""
        if mean.ndim != 1 or covariance.shape != (len(mean), len(mean)):
            raise ShapeError("covariance", f"({len(mean)}, {len(mean)})", covariance.shape)
        values, vectors = np.linalg.eigh(covariance)
        # Rounding leaves eigenvalues of 0 a little below it.
        least = -1e-10 * max(float(np.abs(values).max(initial=0)), 1.0)
        if not np.allclose(covariance, covariance.T) or float(values.min(initial=0)) < least:
            raise RangeError("covariance", "symmetric and positive semi-definite", "another matrix")
        return cls(mean.astype(np.float64), np.sqrt(values.clip(0))[:, None] * vectors.T)


def frechet(first: Gaussian, second: Gaussian) -> float:
    """At least 0; 0 for equal ones. Raises ShapeError where the features differ in number."""
    if first.mean.shape != second.mean.shape:
        raise ShapeError("features of a Fréchet distance", f"{len(first.mean)} a picture", len(second.mean))
    apart = first.mean - second.mean
    spread = float(np.square(first.root).sum() + np.square(second.root).sum())
    common = float(np.linalg.svd(first.root @ second.root.T, compute_uv=False).sum())
    return max(float(apart @ apart) + spread - 2 * common, 0.0)
