"""What the study's tables are computed from: answers, chances and distances, of a study at work or of one that was
kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from drivesem.classify.objects.types import SPLITS
from drivesem.evaluation.resampling import DRAWS
from scene_ir.errors import FormatError
from tools.experiments.classification import pixels
from tools.experiments.classification.arms import GRADIENT
from tools.experiments.classification.figures import Predictions, RatioBootstrap
from tools.experiments.classification.lab import BENIGN, LEARNT, Lab
from tools.experiments.classification.looking import between
from tools.experiments.realism.measures import METRICS, missing, psnr_db
from tools.experiments.settings import StudyConfig
from tools.experiments.worth.measures import Floats, Points, classified
from tools.experiments.worth.runs import PREFERRED

Key = tuple[str, str, str, str]
OVERALL = "overall"
K = TypeVar("K", bound=tuple[str, ...])
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class StudyNetwork:
    """name: for files and people; theirs: the paper's network that it stands beside; deep: whether it is in the
    tables that take long.
    """

    name: str
    paper_network: str
    in_slow_tables: bool


@dataclass(frozen=True, slots=True)
class StudyFacts:
    """What is known before any table. study: its settings; measures: of realism, distance: what its weight is
    counted from; toolbox: whether attacks on pixels could be made; pictures: those to test on that could be used,
    by the object's name; few: places of those on which retrained networks were attacked; counts: of pictures, for
    the JSON; objects, used: by split and class, how many objects there are and how many pictures are of them;
    failed: pictures that could not be used, and why.
    """

    study: StudyConfig
    classes: tuple[str, ...]
    networks: tuple[StudyNetwork, ...]
    tables: tuple[str, ...]
    measures: tuple[str, ...]
    distance: str
    toolbox: bool
    pictures: tuple[str, ...]
    retested: tuple[int, ...]
    counts: dict[str, int]
    objects: dict[str, dict[str, int]]
    used: dict[str, dict[str, int]]
    failed: dict[str, str]

    @classmethod
    def from_study(cls, study: StudyConfig, lab: Lab) -> StudyFacts:
        """Of a study whose attacks and networks are done. study: its settings, as they were typed."""
        deep = [eyes.name for eyes in lab.deep]

        def by_class(names: list[str]) -> dict[str, int]:
            kinds = [name.partition("/")[0] for name in names]
            return {one: kinds.count(one) for one in lab.classes}

        return cls(
            study=study,
            classes=lab.classes,
            networks=tuple(StudyNetwork(eyes.name, eyes.theirs, eyes.name in deep) for eyes in lab.eyes),
            tables=lab.tables,
            measures=tuple(lab.measures) if lab.wants("realism") else (),
            distance=next(name for name in PREFERRED if missing(name, None) is None),
            toolbox=pixels.available(),
            pictures=tuple(one.name for one in lab.done),
            few=lab.fresh,
            counts={"test": len(lab.done), "train": len(lab.train), "retrained": len(lab.few)},
            objects={split: by_class(list(lab.objects.names(split))) for split in SPLITS},
            used={split: by_class([one.name for one in getattr(lab, split)]) for split in ("test", "train")},
            failed=dict(sorted(lab.failed.items())),
        )


@dataclass
class ClassificationResults:
    """What tables ask for. lab: a study at work, of which each answer is noted; None of one that was kept, which
    has those that were noted. right (M,) bool: of pictures, by what is asked; chances (N, C), distances (N,): of
    all pictures; sets: Frechet distances; certain: how many failures.
    """

    facts: StudyFacts
    source: Lab | None = None
    correct: dict[Key, np.ndarray] = field(default_factory=dict[Key, np.ndarray])
    probabilities: dict[tuple[str, str, str], Floats] = field(default_factory=dict[tuple[str, str, str], Floats])
    distances: dict[Key, Floats] = field(default_factory=dict[Key, Floats])
    sets: dict[Key, float | None] = field(default_factory=dict[Key, "float | None"])
    certain_failures: dict[tuple[str, str], int | None] = field(default_factory=dict[tuple[str, str], "int | None"])

    @property
    def slow_networks(self) -> tuple[StudyNetwork, ...]:
        return tuple(one for one in self.facts.networks if one.in_slow_tables)

    @cached_property
    def bootstrap(self) -> RatioBootstrap:
        study = self.facts.study
        return RatioBootstrap(DRAWS if study.bootstrap is None else study.bootstrap, study.seed)

    @cached_property
    def labels(self) -> np.ndarray:
        """Of all pictures (N,)."""
        kinds = [name.partition("/")[0] for name in self.facts.pictures]
        return np.array([self.facts.classes.index(kind) for kind in kinds], np.int64)

    @cached_property
    def object_ids(self) -> np.ndarray:
        """Which object each picture (N,) is of."""
        return np.unique(self.facts.pictures, return_inverse=True)[1]

    def predictions(self, what: str, network: StudyNetwork, strategy: str, other: str = "test") -> Predictions:
        """What a network makes of pictures, under a strategy or, for BENIGN, as they are.

        what: "attacked", all, by a kind of the lab's arms (other); "known", of the network as it was or retrained
        (other), those made against it as it was; "fresh", of the same, few made against itself; "crossed", of
        another network (other), those made against this one; "pixels", after an attack on pixels.
        """
        key = (what, network.name, strategy, other)
        found = self._noted(self.correct, key, lambda lab: lab.right(*key)).astype(np.bool_)
        places = list(self.facts.retested) if what == "fresh" else slice(None)
        return Predictions(found, self.labels[places], self.object_ids[places])

    def is_retrained(self, network: StudyNetwork, trained: str) -> bool:
        """Whether it was retrained so."""
        return network.in_slow_tables and trained in GRADIENT and any(name in self.facts.tables for name in LEARNT)

    def points(self, network: StudyNetwork, strategy: str, rho: Floats, trained: str = "") -> Points:
        """Pictures before a network, as it was or retrained; what is drawn together are an object's."""
        key = (network.name, strategy, trained)
        found = self._noted(self.probabilities, key, lambda lab: lab.chances(*key))
        return replace(classified(found, self.labels, rho), unit=self.object_ids)

    def picture_distances(self, network: StudyNetwork, strategy: str, metric: str, what: str = "counterexamples") -> Floats:
        """Distances (N,) of counterexamples from the pictures before; PSNR's as squared errors. what: or "pixels",
        after an attack on these.
        """
        key = (what, network.name, strategy, metric)
        return self._noted(self.distances, key, lambda lab: lab.distances(*key))

    def mean(self, network: StudyNetwork, strategy: str, metric: str, kind: str) -> float | None:
        """The mean distance, or the sets' one, of what was right before. kind: a class, or OVERALL."""
        kept = self.predictions("attacked", network, BENIGN).correct
        if kind != OVERALL:
            kept = kept & (self.labels == self.facts.classes.index(kind))
        if not METRICS[metric].pairwise:
            key = (network.name, strategy, metric, kind)
            return self._noted(self.sets, key, lambda lab: between(lab.apart(*key[:2]), metric, kept))
        if not kept.any():
            return None
        mean = float(self.picture_distances(network, strategy, metric)[kept].mean())
        return psnr_db(mean) if METRICS[metric].squared else mean

    def certain_of(self, network: StudyNetwork, strategy: str) -> int | None:
        """How many failures are certain, where that was asked."""
        key = (network.name, strategy)
        return self._noted(self.certain_failures, key, lambda lab: lab.certain(*key))

    def _noted(self, store: dict[K, _T], key: K, compute: Callable[[Lab], _T]) -> _T:
        if key not in store:
            if self.source is None:
                raise FormatError("what was kept", f"figures of {', '.join(filter(None, key))}", "none")
            store[key] = compute(self.source)
        return store[key]
