"""`drivesem classify gate`: another network, in the poses around a run's certain failures."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from drivesem.classify.attack import Attacker, network_of
from drivesem.classify.finished import ClassifyRun
from drivesem.classify.holes import Poses, bounds_of
from drivesem.classify.objective import Seen
from drivesem.evaluation.resampling import DRAWS
from drivesem.questions.gate.report import answer_of
from drivesem.questions.gate.results import Pair
from drivesem.questions.gate.rows import rows_of
from drivesem.report.answer import Answer
from drivesem.run.ask import Bar
from drivesem.run.folder import FRAMES, PRESENTATION, claim
from drivesem.run.frame import RESULT
from drivesem.run.records import dump_record, load_record
from drivesem.settings.commands import Classify
from drivesem.truth.grades import Grade
from drivesem.truth.neighbourhood import NEAR
from scene_ir import files

_SCHEMA = 1
_PAIR = "pair.json"
_WRITTEN = ("gate.json", "gate.md", "gate.csv", "gate.xml", FRAMES)
_WORDS = (
    "wrong",
    "Wrong: share of poses around a certain failure in which a network misclassifies the object; both see the "
    "same pictures. In brackets: 95 % by paired bootstrap, over poses of one failure, and over failures for "
    "classes and for all. A row grew where the difference is above the tolerance and its interval above 0.",
)


@dataclass(frozen=True, slots=True)
class FramePair:
    """One failure before two networks. source: digest of the run's result."""

    identifier: str
    source: str
    pair: Pair


class GateWorker:
    """What one process needs: built once, used for many failures."""

    def __init__(self, config: Classify, run: ClassifyRun, out: Path) -> None:
        self.config, self.run, self.out, self.attacker = config, run, out, Attacker.of(run.config)
        self.after = network_of(config.network, self.attacker.network.classes, config.device)

    def __call__(self, name: str) -> None:
        """One failure, from the run's folder to its own."""
        objective, theta = self.run.rebuilt(self.attacker, name)
        change, label = objective.space.change(theta), objective.scene.model.label
        poses = Poses(objective, change, self.attacker, f"gate:{name}:{self.config.seed}")
        rng = np.random.default_rng([self.config.seed, zlib.crc32(name.encode())])
        wrong: list[tuple[bool, bool]] = []
        for number in range(self.config.samples):
            # One half near the failure: a hole may be small beside its neighbourhood.
            bounds = bounds_of(change, self.config.reach * (1.0 if number % 2 == 0 else NEAR))
            picture = poses.picture(rng.uniform(bounds[:, 0], bounds[:, 1]), number)
            after = Seen(self.after(picture[None])[0], label)
            wrong.append((not objective.look(picture).right, not after.right))
        before, after = zip(*wrong, strict=True)
        own = self.run.frames[name].label
        source = files.digest(self.run.folder / FRAMES / name / RESULT)
        with files.whole_folder(self.out / FRAMES / name) as part:
            record = FramePair(name, source, Pair(None, own, own, before, after))
            files.write_text(part / _PAIR, dump_record(record, _SCHEMA))


def gate_run(config: Classify) -> tuple[bool, Answer]:
    """Whether --network may take the place of the run's, and what is said. Raises UsageError or SceneError."""
    run = ClassifyRun.of(config)
    out = Path(config.out) if config.out else run.folder / "gate"
    build = partial(GateWorker, config, run, out)
    build()
    claim(out, config, _WRITTEN, (*PRESENTATION, "folder", "tolerance"))
    read = partial(load_record, kind=FramePair, schema=_SCHEMA)
    grades = (Grade.CERTAIN, Grade.CONFIRMED)
    found, failed = run.ask(config, out, (_PAIR, read), build, Bar("comparing", remaining=True), grades)
    rows = rows_of({one.identifier: [one.pair] for one in found}, config.tolerance, DRAWS, config.seed)
    passed = not any(row.grew for row in rows)
    facts = {"run": str(run.folder), "before": run.config.network, "after": config.network}
    answer = answer_of(out, passed, rows, {**facts, "tolerance": config.tolerance}, failed, _WORDS)
    answer.write()
    return passed, answer
