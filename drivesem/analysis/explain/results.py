"""What is said of one frame, as plain dataclasses: written as JSON, read by the report and a resumed command."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from drivesem.analysis.explain.players import Size
from drivesem.run.records import load_record
from drivesem.run.results import Coordinate, Failure
from scene_ir import files

SCHEMA = 1
EXPLANATION = "explain.json"
"""The file that marks a frame as done."""


@dataclass(frozen=True, slots=True)
class PartOutcome:
    """What the detector makes of one theta, by `moved` labels. loss: the attack's objective; held_back: the
    projection onto the feasible set changed the theta.
    """

    loss: float
    lost: int
    phantoms: int
    success: bool
    held_back: bool


@dataclass(frozen=True, slots=True)
class Contribution:
    """What one player adds. loss, fails: Shapley values of the loss and of failing (1) or not (0); loss_error,
    fails_error: their standard errors where orders were drawn. gradient: gradient at theta0 times theta, added up;
    gradient_share: the same with every coordinate's sign left out, as a share of all players'; None without a
    gradient. alone: this player's part of the change only; without: all but it.
    """

    kind: str
    name: str
    loss: float
    loss_error: float | None
    fails: float
    fails_error: float | None
    gradient: float | None
    gradient_share: float | None
    alone: PartOutcome
    without: PartOutcome


@dataclass(frozen=True, slots=True)
class Least:
    """The least change that was found. scan: whether the change fails at each scale of the grid, 0 and 1 included;
    sign_changes: among them; scale_whole: the smallest failing scale of the whole change; scale: of what is left
    of it after `dropped` went. norm_found, norm_whole, norm: sizes in steps, of the counterexample, of the whole
    change shortened, and of what is left. violations: of the second feasibility check. sizes, failures, theta (its
    coordinates that are not 0): of what is left.
    """

    scan: tuple[bool, ...]
    sign_changes: int
    scale_whole: float
    scale: float
    dropped: tuple[str, ...]
    norm_found: float
    norm_whole: float
    norm: float
    outcome: PartOutcome
    violations: tuple[str, ...]
    sizes: tuple[Size, ...]
    failures: tuple[Failure, ...]
    theta: tuple[Coordinate, ...]

    @property
    def left(self) -> float:
        """Share of the counterexample's size that is left."""
        return self.norm / self.norm_found

    @property
    def parameters(self) -> tuple[str, ...]:
        """Those that are left."""
        return tuple(dict.fromkeys(size.parameter for size in self.sizes))

    @property
    def objects(self) -> tuple[int, ...]:
        """Those that are left."""
        return tuple(sorted({size.object for size in self.sizes if size.object is not None}))


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Share of |d loss / d pixel| on each object, and on the background, of one picture."""

    objects: tuple[float, ...]
    background: float


@dataclass(frozen=True, slots=True)
class Explanation:
    """One frame. source: digest of the result that is explained. benign, found: the scene at theta0 and the
    counterexample; contributions: parameters first, then objects; exact: kinds of players whose Shapley values are
    of all coalitions; sizes: of the counterexample. sensitivity: by picture, `benign` and `counterexample`, empty
    without a gradient. renders: thetas judged.
    """

    identifier: str
    source: str
    objects: int
    benign: PartOutcome
    found: PartOutcome
    contributions: tuple[Contribution, ...]
    exact: tuple[str, ...]
    sizes: tuple[Size, ...]
    least: Least
    sensitivity: dict[str, Sensitivity]
    renders: int
    seconds: float

    @property
    def by_exchange(self) -> bool:
        """Whether the scene fails at theta0 already, by its exchange of vehicles alone: no part of theta is
        weighed then, and the least change is none.
        """
        return self.least.scan[0]

    def of_kind(self, kind: str) -> tuple[Contribution, ...]:
        """Contributions of `parameter` or `object`."""
        return tuple(c for c in self.contributions if c.kind == kind)


def write_explanation(path: Path, explanation: Explanation) -> None:
    """As JSON, exact and in a fixed order."""
    files.write_json(path, {"schema": SCHEMA, **asdict(explanation)})


def read_explanation(path: Path) -> Explanation:
    """What `write_explanation` wrote. Raises FormatError naming the file and the field."""
    return load_record(path, Explanation, SCHEMA)
