"""What the tables of the study are computed from: predictions, probabilities and distances, at work or stored.

Stored results are a folder of `study.json` (settings, networks, pictures), `predictions.csv`, `sets.csv`,
`certain.csv`, `distances.csv.gz` and `probabilities.csv.gz`. Columns are the fields of the dataclasses below.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivesem.evaluation.resampling import DRAWS, Interval, bootstrap_intervals, ratio_metric
from scene_ir import files
from scene_ir.errors import FormatError
from tools.experiments.realism.metrics import METRICS, psnr_db
from tools.experiments.settings import StudyConfig
from tools.experiments.tables import matching_tables, read_metadata, read_table, write_metadata, write_table
from tools.experiments.worth.measures import MembershipPoints, points_from_probabilities

OVERALL = "overall"
"""All classes together."""
_PREDICTIONS, _SETS, _CERTAIN = "predictions.csv", "sets.csv", "certain.csv"
_DISTANCES, _PROBABILITIES = "distances.csv.gz", "probabilities.csv.gz"
K = TypeVar("K", bound=tuple[str, ...])
V = TypeVar("V")
Key = tuple[str, str, str, str]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class RatioBootstrap:
    """Bootstrap intervals of ratios."""

    draws: int
    """Draws of units."""
    seed: int
    """Seed of the draws."""

    def ratio(self, hits: Floats, totals: Floats, unit: Integers) -> Interval:
        """sum(hits) / sum(totals) with its interval.

        Args:
            hits: Numerators (M,).
            totals: Denominators (M,).
            unit: What is drawn together (M,), such as the object.
        """
        places, inverse = np.unique(unit, return_inverse=True)
        sums = [np.bincount(inverse, values, len(places)).astype(np.float64) for values in (hits, totals)]
        rng = np.random.default_rng(self.seed)
        return bootstrap_intervals([ratio_metric("ratio", *sums)], len(places), self.draws, rng)[0]


@dataclass(frozen=True, slots=True)
class Predictions:
    """Whether a network classifies M pictures correctly."""

    correct: np.ndarray
    """Whether a picture is classified correctly (M,) bool."""
    label: Integers
    """Index of its class (M,)."""
    object_id: Integers
    """Index of its object (M,)."""

    def by_class(self, count: int) -> list[float | None]:
        """Accuracy within each of `count` classes; None for a class without pictures."""
        own = [self.correct[self.label == place] for place in range(count)]
        return [float(correct.mean()) if len(correct) else None for correct in own]

    def overall(self, bootstrap: RatioBootstrap, sizes: Sequence[int] | None = None) -> Interval:
        """Mean of the classes' accuracies weighted by `sizes`, by default those of these pictures; classes without
        pictures do not count.
        """
        weights = np.ones(len(self.label))
        if sizes is not None:
            counts = np.bincount(self.label, minlength=len(sizes))
            weights = (np.asarray(sizes) / np.maximum(counts, 1))[self.label]
        return bootstrap.ratio(self.correct * weights, weights, self.object_id)

    def accuracy_drop(self, other: Predictions, bootstrap: RatioBootstrap) -> Interval:
        """How much lower the accuracy is than the other's on the same pictures, paired."""
        difference = other.correct.astype(np.float64) - self.correct
        return bootstrap.ratio(difference, np.ones(len(self.correct)), self.object_id)


def sample_stratified(labels: Sequence[int], size: int, generator: np.random.Generator) -> list[int]:
    """Draw `size` indices at random so that classes keep their shares.

    Each class gets its share rounded down, and one more where rounding takes most. All if there are not more.

    Args:
        labels: Class of each element.
        size: Elements to draw.
        generator: Source of randomness.
    """
    classes = np.asarray(labels, np.int64)
    if size >= len(classes):
        return list(range(len(classes)))
    counts = np.bincount(classes)
    wanted = counts * size / len(classes)
    taken = np.floor(wanted).astype(np.int64)
    more = np.argsort(taken - wanted, kind="stable")[: size - int(taken.sum())]
    taken[more] += 1
    drawn = [generator.permutation(np.flatnonzero(classes == label))[:n] for label, n in enumerate(taken)]
    return sorted(int(place) for places in drawn for place in places)


@dataclass(frozen=True, slots=True)
class StudyNetwork:
    """A network of the study."""

    name: str
    """Name in files and tables."""
    paper_network: str
    """The paper's network that it is compared with."""
    reading: str = "text"
    """Reading of the paper."""
    takes_normalisation: bool = True
    """Whether the code's normalisation and rate apply to it."""


@dataclass(frozen=True, slots=True)
class StudyFacts:
    """What is known before any table."""

    settings: StudyConfig
    """Settings of the study."""
    classes: tuple[str, ...]
    """Classes of objects."""
    networks: tuple[StudyNetwork, ...]
    """The networks."""
    tables: tuple[str, ...]
    """Tables to make."""
    measures: tuple[str, ...]
    """Metrics of realism."""
    distance: str
    """Metric of the realism weight."""
    toolbox: bool
    """Whether attacks on pixels could be made."""
    pictures: tuple[str, ...]
    """Test pictures that could be used, by the object's name."""
    retested: tuple[int, ...]
    """Indices of those on which retrained networks were attacked."""
    counts: dict[str, int]
    """Numbers of pictures, for the JSON."""
    objects: dict[str, dict[str, int]]
    """Objects by split and class."""
    used: dict[str, dict[str, int]]
    """Pictures by split and class."""
    failed: dict[str, str]
    """Reason by picture that could not be used."""


class ResultSource(Protocol):
    """A study at work, which computes what the tables need."""

    def correct(self, what: str, network: str, strategy: str, other: str) -> np.ndarray:
        """See `ClassificationResults.predictions`."""
        ...

    def probabilities(self, network: str, strategy: str, trained: str) -> Floats:
        """Softmax (N, C) of a network, as it was or retrained."""
        ...

    def distances(self, what: str, network: str, strategy: str, metric: str) -> Floats:
        """See `ClassificationResults.picture_distances`."""
        ...

    def set_distance(self, network: str, strategy: str, metric: str, among: np.ndarray) -> float | None:
        """Frechet distance of some pictures, among (N,) bool, before and after."""
        ...

    def count_certain(self, network: str, strategy: str) -> int | None:
        """Certain failures; None if not graded."""
        ...


@dataclass
class ClassificationResults:
    """What the tables need, computed on demand and recorded, or stored."""

    facts: StudyFacts
    """Facts of the study."""
    source: ResultSource | None = None
    """A study at work; None if the results are stored."""
    correct: dict[Key, np.ndarray] = field(default_factory=dict[Key, np.ndarray])
    """Correct pictures (M,) bool by kind of pictures, network, strategy and other."""
    probabilities: dict[tuple[str, str, str], Floats] = field(default_factory=dict[tuple[str, str, str], Floats])
    """Softmax (N, C) by network, strategy and training."""
    distances: dict[Key, Floats] = field(default_factory=dict[Key, Floats])
    """Distances (N,) by kind of pictures, network, strategy and metric."""
    sets: dict[Key, float | None] = field(default_factory=dict[Key, "float | None"])
    """Frechet distances by network, strategy, metric and class."""
    certain_failures: dict[tuple[str, str], int | None] = field(
        default_factory=dict[tuple[str, str], "int | None"]
    )
    """Certain failures by network and strategy."""

    @cached_property
    def bootstrap(self) -> RatioBootstrap:
        """Intervals of this study."""
        settings = self.facts.settings
        return RatioBootstrap(DRAWS if settings.bootstrap is None else settings.bootstrap, settings.seed)

    @cached_property
    def labels(self) -> np.ndarray:
        """Class of each picture (N,)."""
        kinds = [name.partition("/")[0] for name in self.facts.pictures]
        return np.array([self.facts.classes.index(kind) for kind in kinds], np.int64)

    @cached_property
    def object_ids(self) -> np.ndarray:
        """Object of each picture (N,)."""
        return np.unique(self.facts.pictures, return_inverse=True)[1]

    def predictions(self, what: str, network: StudyNetwork, strategy: str, other: str = "test") -> Predictions:
        """Whether a network classifies pictures correctly.

        Args:
            what: `attacked`: pictures attacked on this network, of the kind of arms `other`. `known`: those against
                the original network, under it or retrained (`other`). `fresh`: few, against the network itself.
                `crossed`: those against this network, under another (`other`). `pixels`: after attacks on pixels.
            network: The network.
            strategy: The attack, or BENIGN for unchanged pictures.
            other: See `what`.
        """
        key = (what, network.name, strategy, other)
        correct = self._lookup(self.correct, key, lambda source: source.correct(*key)).astype(np.bool_)
        places = list(self.facts.retested) if what == "fresh" else slice(None)
        return Predictions(correct, self.labels[places], self.object_ids[places])

    def points(self, network: StudyNetwork, strategy: str, rho: Floats, trained: str = "") -> MembershipPoints:
        """Pictures as points under a network; an object's are drawn together.

        Args:
            network: The network.
            strategy: The attack.
            rho: Realism of each picture (N,).
            trained: What the network was retrained on; empty for the original one.
        """
        key = (network.name, strategy, trained)
        values = self._lookup(self.probabilities, key, lambda source: source.probabilities(*key))
        return replace(points_from_probabilities(values, self.labels, rho), unit=self.object_ids)

    def picture_distances(
        self, network: StudyNetwork, strategy: str, metric: str, what: str = "counterexamples"
    ) -> Floats:
        """Distances (N,) of counterexamples from the pictures before; PSNR's as squared errors.

        Args:
            network: The network.
            strategy: The attack.
            metric: Name of the metric.
            what: `counterexamples`, or `pixels` for attacks on pixels.
        """
        key = (what, network.name, strategy, metric)
        return self._lookup(self.distances, key, lambda source: source.distances(*key))

    def mean_distance(self, network: StudyNetwork, strategy: str, metric: str, kind: str) -> float | None:
        """Mean distance, or that of the sets, over pictures that were correct before.

        Args:
            network: The network.
            strategy: The attack.
            metric: Name of the metric.
            kind: A class, or OVERALL.
        """
        chosen = self.predictions("attacked", network, "benign").correct
        if kind != OVERALL:
            chosen = chosen & (self.labels == self.facts.classes.index(kind))
        if not METRICS[metric].pairwise:
            key = (network.name, strategy, metric, kind)
            return self._lookup(self.sets, key, lambda source: source.set_distance(*key[:3], chosen))
        if not chosen.any():
            return None
        mean = float(self.picture_distances(network, strategy, metric)[chosen].mean())
        return psnr_db(mean) if METRICS[metric].squared else mean

    def count_certain(self, network: StudyNetwork, strategy: str) -> int | None:
        """Certain failures; None if not graded."""
        key = (network.name, strategy)
        return self._lookup(self.certain_failures, key, lambda source: source.count_certain(*key))

    def _lookup(self, store: dict[K, V], key: K, compute: Callable[[ResultSource], V]) -> V:
        if key not in store:
            if self.source is None:
                raise FormatError("stored results", f"rows of {', '.join(filter(None, key))}", "none")
            store[key] = compute(self.source)
        return store[key]


@dataclass(frozen=True, slots=True)
class PredictionRow:
    """A network on a set of pictures; see `ClassificationResults.predictions`."""

    what: str
    """Kind of pictures."""
    network: str
    """Name of the network."""
    strategy: str
    """The attack, or benign."""
    other: str
    """Kind of arms, training, or network that is tested."""
    correct: str
    """A digit for each picture: 1 if it is classified correctly."""


@dataclass(frozen=True, slots=True)
class DistanceRow:
    """The distance of a picture from what it was before."""

    what: str
    """Kind of pictures."""
    network: str
    """Name of the network."""
    strategy: str
    """The attack."""
    metric: str
    """Name of the metric."""
    picture: int
    """Index of the picture."""
    distance: float
    """Distance; PSNR's as a squared error."""


@dataclass(frozen=True, slots=True)
class ProbabilityRow:
    """The probability of one class of one picture."""

    network: str
    """Name of the network."""
    strategy: str
    """The attack."""
    trained: str
    """What the network was retrained on."""
    picture: int
    """Index of the picture."""
    category: str
    """Name of the class."""
    probability: float
    """Softmax of the class."""


@dataclass(frozen=True, slots=True)
class SetRow:
    """A Frechet distance between pictures before and after."""

    network: str
    """Name of the network."""
    strategy: str
    """The attack."""
    metric: str
    """Name of the metric."""
    kind: str
    """A class, or overall."""
    distance: float | None
    """The distance; empty for too few pictures."""


@dataclass(frozen=True, slots=True)
class CertainRow:
    """Certain failures of an attack."""

    network: str
    """Name of the network."""
    strategy: str
    """The attack."""
    failures: int | None
    """Number of failures; empty if not graded."""


def save_results(folder: Path, results: ClassificationResults) -> None:
    """Write recorded results as a whole folder."""
    facts = {name: value for name, value in asdict(results.facts).items() if name != "settings"}
    predictions = (
        (PredictionRow(*key, "".join("01"[bool(one)] for one in correct)),)
        for key, correct in results.correct.items()
    )
    distances = (
        (DistanceRow(*key, i, distance),)
        for key, column in results.distances.items()
        for i, distance in enumerate(column.tolist())
    )
    probabilities = (
        (ProbabilityRow(*key, i, category, value),)
        for key, rows in results.probabilities.items()
        for i, row in enumerate(rows.tolist())
        for category, value in zip(results.facts.classes, row, strict=True)
    )
    with files.atomic_folder(folder) as out:
        write_metadata(out, results.facts.settings, **facts)
        write_table(out / _PREDICTIONS, (PredictionRow,), predictions)
        write_table(out / _DISTANCES, (DistanceRow,), distances)
        write_table(out / _PROBABILITIES, (ProbabilityRow,), probabilities)
        write_table(out / _SETS, (SetRow,), ((SetRow(*key, one),) for key, one in results.sets.items()))
        certain = ((CertainRow(*key, count),) for key, count in results.certain_failures.items())
        write_table(out / _CERTAIN, (CertainRow,), certain)


def load_results(folder: Path) -> ClassificationResults:
    """Read what `save_results` wrote. Raises FormatError."""
    facts = read_metadata(folder, StudyFacts, "classification")
    results = ClassificationResults(facts)
    with matching_tables(folder):
        for (row,) in read_table(folder / _PREDICTIONS, (PredictionRow,)):
            key = (row.what, row.network, row.strategy, row.other)
            results.correct[key] = np.array([letter == "1" for letter in row.correct], np.bool_)
        columns: dict[Any, list[float]] = defaultdict(list)
        for (row,) in read_table(folder / _DISTANCES, (DistanceRow,)):
            columns[row.what, row.network, row.strategy, row.metric].append(row.distance)
        results.distances = {key: np.array(column) for key, column in columns.items()}
        columns = defaultdict(list)
        for (row,) in read_table(folder / _PROBABILITIES, (ProbabilityRow,)):
            columns[row.network, row.strategy, row.trained].append(row.probability)
        results.probabilities = {
            key: np.array(column).reshape(len(facts.pictures), len(facts.classes))
            for key, column in columns.items()
        }
        sets = [row for (row,) in read_table(folder / _SETS, (SetRow,))]
        results.sets = {(row.network, row.strategy, row.metric, row.kind): row.distance for row in sets}
        certain = [row for (row,) in read_table(folder / _CERTAIN, (CertainRow,))]
        results.certain_failures = {(row.network, row.strategy): row.failures for row in certain}
    return results
