"""Explanation of one counterexample, as plain dataclasses that are stored as JSON."""

from __future__ import annotations

from dataclasses import dataclass

from drivesem.analysis.explain.attribution import ChangeSize
from drivesem.run.results import Coordinate, Failure

SCHEMA = 1
EXPLANATION = "explain.json"
"""File of a frame's explanation."""


@dataclass(frozen=True, slots=True)
class PartOutcome:
    """The detector's result at one theta, with moved labels."""

    loss: float
    """The attack's objective."""
    lost: int
    """Number of lost objects."""
    phantoms: int
    """Number of phantoms."""
    success: bool
    """Whether the detector fails."""
    held_back: bool
    """Whether the projection onto the feasible set changed theta."""


@dataclass(frozen=True, slots=True)
class Contribution:
    """Contribution of one part of the change: a parameter or an object."""

    kind: str
    """"parameter" or "object"."""
    name: str
    """Name of the part."""
    loss: float
    """Shapley value of the loss."""
    loss_error: float | None
    """Its standard error, if orders were sampled."""
    fails: float
    """Shapley value of failing (1) or not (0)."""
    fails_error: float | None
    """Its standard error, if orders were sampled."""
    gradient: float | None
    """Sum of gradient at theta0 times theta; None without a gradient."""
    gradient_share: float | None
    """Share of the sum of |gradient times theta| over all parts; None without a gradient."""
    alone: PartOutcome
    """Result of this part only."""
    without: PartOutcome
    """Result of all other parts."""


@dataclass(frozen=True, slots=True)
class MinimalChange:
    """The smallest change found that still fails."""

    scan: tuple[bool, ...]
    """Whether the whole change fails at each scale of the grid, 0 and 1 included."""
    sign_changes: int
    """Changes between failing and not failing along the grid."""
    scale_whole: float
    """Smallest failing scale of the whole change, in [0, 1]."""
    scale: float
    """Smallest failing scale after dropping parts, in [0, 1]."""
    dropped: tuple[str, ...]
    """Names of the dropped parts, in order."""
    norm_found: float
    """Size of the counterexample, steps."""
    norm_whole: float
    """Size of the whole change at `scale_whole`, steps."""
    norm: float
    """Size of the minimal change, steps."""
    outcome: PartOutcome
    """The detector's result at the minimal change."""
    violations: tuple[str, ...]
    """Violations found by the independent feasibility check."""
    sizes: tuple[ChangeSize, ...]
    """Size of each parameter of each object."""
    failures: tuple[Failure, ...]
    """Failures at the minimal change."""
    theta: tuple[Coordinate, ...]
    """Coordinates of the minimal change that are not 0."""

    @property
    def left(self) -> float:
        """Size relative to the counterexample's."""
        return self.norm / self.norm_found

    @property
    def parameters(self) -> tuple[str, ...]:
        """Parameters of the minimal change."""
        return tuple(dict.fromkeys(size.parameter for size in self.sizes))

    @property
    def objects(self) -> tuple[int, ...]:
        """Objects that the minimal change moves."""
        return tuple(sorted({size.object for size in self.sizes if size.object is not None}))


@dataclass(frozen=True, slots=True)
class PixelSensitivity:
    """Distribution of |d loss / d pixel| over one picture."""

    objects: tuple[float, ...]
    """Share on each object, in [0, 1]."""
    background: float
    """Share on the background, in [0, 1]."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Explanation of one counterexample."""

    identifier: str
    """The frame."""
    source: str
    """Digest of the run's result.json."""
    objects: int
    """Number of objects in the scene."""
    benign: PartOutcome
    """The detector's result at theta0."""
    found: PartOutcome
    """Its result at the counterexample."""
    contributions: tuple[Contribution, ...]
    """Contributions of parameters, then of objects."""
    exact: tuple[str, ...]
    """Kinds of parts with exact Shapley values."""
    sizes: tuple[ChangeSize, ...]
    """Size of each parameter of each object."""
    least: MinimalChange
    """The minimal change."""
    sensitivity: dict[str, PixelSensitivity]
    """Pixel gradients of `benign` and `counterexample`; empty without a gradient."""
    renders: int
    """Number of thetas evaluated."""
    seconds: float
    """Run time; the only field that may differ between two calls."""

    @property
    def by_exchange(self) -> bool:
        """Whether the scene fails at theta0 already, by the exchange of vehicles alone; there are no contributions
        then, and the minimal change is empty.
        """
        return self.least.scan[0]

    def of_kind(self, kind: str) -> tuple[Contribution, ...]:
        """Return the contributions of one kind, `parameter` or `object`."""
        return tuple(c for c in self.contributions if c.kind == kind)
