"""`drivesem classify gate`: compares a new network with a run's, in poses around the run's certain failures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivesem.analysis.gate import GateFacts, PairedSamples, build_gate_report, compute_gate_rows
from drivesem.classify.analysis import ClassifyRun, FailureAnalyser, analyse_failures
from drivesem.classify.holes import PoseSampler
from drivesem.classify.networks.loading import open_network
from drivesem.classify.objective import ClassLogits
from drivesem.config.commands import ClassifyConfig
from drivesem.evaluation.resampling import DRAWS
from drivesem.failures.grades import Grade
from drivesem.failures.neighbourhood import NEAR_REACH
from drivesem.reporting.tables import AnalysisReport

_VERB = "wrong"
_NOTE = (
    "Wrong: share of poses around a certain failure in which a network misclassifies the object; both get the "
    "same pictures. In brackets: 95 % by paired bootstrap, over poses of one failure, and over failures for "
    "classes and for all. p: exact sign test of the poses in which only one network is wrong, with Holm's correction "
    "over all rows. A row grew if the difference is above the tolerance, its interval above 0, and p below 0.05; it "
    "fell if the same holds the other way, and is the same if its interval is within the tolerance."
)


@dataclass(frozen=True, slots=True)
class PairedPoseSamples:
    """Samples around one failure, classified by both networks."""

    identifier: str
    """The picture."""
    source: str
    """Digest of its result in the run."""
    pair: PairedSamples
    """The samples."""


class NetworkGateAnalyser(FailureAnalyser[PairedPoseSamples]):
    """Classifies poses around certain failures with both networks."""

    command, file, kind = "gate", "pair.json", PairedPoseSamples
    grades, needs_failures, free = (Grade.CERTAIN, Grade.CONFIRMED), False, ("tolerance", "allow_empty")
    renews = True

    def __init__(self, config: ClassifyConfig, run: ClassifyRun, out: Path) -> None:
        super().__init__(config, run, out)
        self.new_network = open_network(config.network, self.attacker.network.classes, config.device)

    def analyse(self, name: str, folder: Path) -> PairedPoseSamples:
        """See `FrameAnalyser.analyse`."""
        sampler = PoseSampler(self, name)
        objective = sampler.objective
        wrong: list[tuple[bool, bool]] = []
        for number in range(self.config.samples):
            # Half of them near the failure, since its region may be small within the neighbourhood.
            bounds = sampler.bounds(self.config.reach * (1.0 if number % 2 == 0 else NEAR_REACH))
            picture = sampler.render_sample(sampler.rng.uniform(bounds[:, 0], bounds[:, 1]), number)
            new = ClassLogits(self.new_network(picture[None])[0], objective.scene.model.label)
            wrong.append((not objective.classify(picture).correct, not new.correct))
        before, after = zip(*wrong, strict=True)
        label = self.run.results[name].label
        return PairedPoseSamples(name, self.source_digest(name), PairedSamples(None, label, label, before, after))


def compare_networks(config: ClassifyConfig) -> AnalysisReport:
    """Test whether `network` may replace the run's: `passed` of the data. Raises UsageError or SceneError."""
    analysis = analyse_failures(config, NetworkGateAnalyser, "comparing networks")
    pairs = {one.identifier: [one.pair] for one in analysis.results}
    rows = compute_gate_rows(pairs, config.tolerance, DRAWS, config.seed)
    about = {"run": str(analysis.run.folder), "before": analysis.run.config.network, "after": config.network}
    about |= {"tolerance": config.tolerance, "failures": len(pairs)}
    scope = f"{len(pairs) or 'no'} certain {'failure' if len(pairs) < 2 else 'failures'}"
    facts = GateFacts(about, scope, len(pairs), analysis.failed, config.allow_empty, verb=_VERB, note=_NOTE)
    report = build_gate_report(analysis.out, rows, facts)
    report.write()
    return report
