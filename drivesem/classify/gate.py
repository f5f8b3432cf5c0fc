"""`drivesem classify gate`: another network, in the poses around a run's certain failures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivesem.analysis.gate import PairedSamples, build_gate_report, compute_gate_rows
from drivesem.classify.attack import network_of
from drivesem.classify.finished import ClassifyRun, FailureWorker, ask_of_failures
from drivesem.classify.holes import Poses
from drivesem.classify.objective import Seen
from drivesem.config.commands import ClassifyConfig
from drivesem.evaluation.resampling import DRAWS
from drivesem.failures.grades import Grade
from drivesem.failures.neighbourhood import NEAR_REACH
from drivesem.report.tables import AnalysisReport

_WORDS = (
    "wrong",
    "Wrong: share of poses around a certain failure in which a network misclassifies the object; both see the "
    "same pictures. In brackets: 95 % by paired bootstrap, over poses of one failure, and over failures for "
    "classes and for all. p: exact sign test of the poses in which one network alone is wrong, Holm's over all "
    "rows. A row grew where the difference is above the tolerance, its interval above 0, and p below 0.05.",
)


@dataclass(frozen=True, slots=True)
class FramePair:
    """One failure before two networks. source: digest of the run's result."""

    identifier: str
    source: str
    pair: PairedSamples


class GateWorker(FailureWorker[FramePair]):
    """Shows poses around a failure to both networks."""

    question, file, kind = "gate", "pair.json", FramePair
    grades, needs_some, free = (Grade.CERTAIN, Grade.CONFIRMED), False, ("tolerance",)
    renews = True

    def __init__(self, config: ClassifyConfig, run: ClassifyRun, out: Path) -> None:
        super().__init__(config, run, out)
        self.after = network_of(config.network, self.attacker.network.classes, config.device)

    def analyse(self, name: str, source: str, folder: Path) -> FramePair:
        """See `FailureWorker`."""
        poses = Poses(self, name)
        objective = poses.objective
        wrong: list[tuple[bool, bool]] = []
        for number in range(self.config.samples):
            # One half near the failure: a hole may be small beside its neighbourhood.
            bounds = poses.bounds(self.config.reach * (1.0 if number % 2 == 0 else NEAR_REACH))
            picture = poses.picture(poses.rng.uniform(bounds[:, 0], bounds[:, 1]), number)
            after = Seen(self.after(picture[None])[0], objective.scene.model.label)
            wrong.append((not objective.look(picture).right, not after.right))
        before, after = zip(*wrong, strict=True)
        own = self.run.frames[name].label
        return FramePair(name, source, PairedSamples(None, own, own, before, after))


def gate_run(config: ClassifyConfig) -> AnalysisReport:
    """Whether --network may take the place of the run's: `passed` of the data. Raises UsageError or SceneError."""
    asked = ask_of_failures(config, GateWorker, "comparing")
    pairs = {one.identifier: [one.pair] for one in asked.answers}
    rows = compute_gate_rows(pairs, config.tolerance, DRAWS, config.seed)
    facts = {"run": str(asked.run.folder), "before": asked.run.config.network, "after": config.network}
    answer = build_gate_report(
        asked.out, rows, len(pairs), facts | {"tolerance": config.tolerance}, asked.failed, *_WORDS
    )
    answer.write()
    return answer
