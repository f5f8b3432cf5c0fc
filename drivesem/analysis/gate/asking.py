"""Two detectors in the neighbourhoods of runs' certain failures: does the new one fail more often?"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from detectors.base import DetectorError, Predictor
from detectors.registry import load_predictor
from drivesem.analysis.gate.frame import compare_frame
from drivesem.analysis.gate.report import answer_of
from drivesem.analysis.gate.results import GATE, Pair, load
from drivesem.analysis.gate.rows import rows_of
from drivesem.attack.judging import JudgedClasses
from drivesem.attack.space import parse_params
from drivesem.config.commands import Gate
from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS
from drivesem.report.answer import Answer
from drivesem.run.ask import Bar, KeptFrames
from drivesem.run.finished import Run, load_runs
from drivesem.run.folder import FRAMES, PRESENTATION, attack_of, claim, folder_of, trusted_attack
from drivesem.run.tally import certain_losses

_WRITTEN = ("gate.json", "gate.md", "gate.csv", "gate.xml", "runs")
_FREE = (*PRESENTATION, "runs", "tolerance", "bootstrap")


def gate_run(config: Gate) -> tuple[bool, Answer]:
    """Whether the gate is passed, and what is said. Raises UsageError or SceneError for bad input."""
    runs = load_runs(config.runs, config.limit, "RUN")
    if config.before is None:
        config = replace(config, before=_own_detector(runs, config.trust))
    detectors_of(config)
    out = folder_of(config.out, runs[0].folder / "gate")
    claim(out, config, _WRITTEN, _FREE, renews=True)
    found: dict[str, list[Pair]] = {}
    failed: dict[str, str] = {}
    for place, run in enumerate(runs):
        below = out / "runs" / str(place)
        build = partial(GateWorker, config, run, below)
        names = [frame.result.identifier for frame in run.frames if certain_losses(frame.result)]
        kept, left = KeptFrames(run.folder, below, GATE, load).ask(
            names, build(), build, config, Bar(f"comparing in {run.name}", remaining=True)
        )
        mark = f"{run.name}/" if len(runs) > 1 else ""
        found |= {mark + one.identifier: list(one.pairs) for one in kept}
        failed |= {mark + name: reason for name, reason in left.items()}
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    rows = rows_of(found, config.tolerance, draws, config.seed)
    answer = answer_of(out, rows, sum(map(len, found.values())), _facts(config, runs), failed)
    answer.write()
    return answer.data["passed"], answer


def _own_detector(runs: list[Run], trust: bool) -> str:
    """The detector that runs attacked. Raises UsageError where they have several, where it runs code that is not
    trusted, and where its file is no longer the one that a run was made with: that may be the new one.
    """
    names = list(dict.fromkeys(trusted_attack(run.folder, trust, "RUN").detector for run in runs))
    if len(names) > 1:
        raise UsageError("--before", "the detector that stands: these runs have several", ", ".join(names))
    return names[0]


def detectors_of(config: Gate) -> tuple[Predictor, Predictor]:
    """The two. Raises UsageError where one cannot be had, or they do not know the same classes."""
    found: list[Predictor] = []
    for setting, name in (("--before", config.before or ""), ("--after", config.after or "")):
        try:
            found.append(load_predictor(name, config.device, config.tiles))
            JudgedClasses.of(found[-1])
        except DetectorError as error:
            raise UsageError.of(setting, "a detector", error) from error
    before, after = found
    lacking = [name for name in before.classes if name not in after.classes]
    further = [name for name in after.classes if name not in before.classes]
    if lacking or further:
        first = f"no {lacking[0]}" if lacking else f"{further[0]}, which --before does not know"
        raise UsageError("--after", "the classes of --before", first)
    return before, after


class GateWorker:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: Gate, run: Run, out: Path) -> None:
        self.config, self.run, self.out = config, run, out
        self.attack, self.params = attack_of(run.folder, "RUN"), parse_params(run.params)
        self.detectors = detectors_of(config)

    def __call__(self, name: str) -> None:
        """One frame, from the run's folder to its own."""
        compare_frame(
            self.run.folder / FRAMES / name,
            self.attack,
            self.params,
            self.detectors,
            self.config.samples,
            self.config.seed,
            self.out / FRAMES / name,
        )


def _facts(config: Gate, runs: list[Run]) -> dict[str, object]:
    return {
        "runs": [str(run.folder) for run in runs],
        "before": config.before,
        "after": config.after,
        "tolerance": config.tolerance,
    }
