"""The holes of a detector that runs' certain failures lie in: samples around each, gathered over frames."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from drivesem.analysis.holes.frame import Effort, Further, look_around, look_inside
from drivesem.analysis.holes.merged import Explained, merged
from drivesem.analysis.holes.pooled import Key, Told, rules_of
from drivesem.analysis.holes.report import answer_of
from drivesem.analysis.holes.results import (
    FRESH,
    HOLES,
    RECHECK,
    FrameHoles,
    FrameInside,
    Samples,
    load,
    load_inside,
)
from drivesem.attack.space import parse_params
from drivesem.config.commands import Holes
from drivesem.failures.rules import Where
from drivesem.report.answer import Answer
from drivesem.report.tables import number_of
from drivesem.report.terminal import Console
from drivesem.run.ask import Bar, KeptFrames
from drivesem.run.finished import Run, load_runs
from drivesem.run.folder import FRAMES, PRESENTATION, claim, detector_of, folder_of, trusted_attack
from drivesem.run.tally import certain_losses

_WRITTEN = ("holes.json", "holes.md", "holes.csv", "holes.png", "runs", "fresh", "rechecks")
_FREE = (*PRESENTATION, "runs", "recheck")


def holes_run(config: Holes) -> Answer:
    """Look around the certain failures of runs, or go on with it, and write what is said. Raises UsageError or
    SceneError for bad input.
    """
    runs = load_runs(config.runs, config.limit, "RUN")
    out = folder_of(config.out, runs[0].folder / "holes")
    for run in runs:
        trusted_attack(run.folder, config.trust, "RUN")  # before anything is written
    claim(out, config, _WRITTEN, _FREE)
    _tell_effort(runs, config)
    found: dict[str, FrameHoles] = {}
    failed: dict[str, str] = {}
    marks = [f"{run.name}/" if len(runs) > 1 else "" for run in runs]
    for place, (run, mark) in enumerate(zip(runs, marks, strict=True)):
        below = out / "runs" / str(place)
        build = partial(HolesWorker, config, run, below)
        names = [frame.result.identifier for frame in run.frames] if config.contrast else _chosen(run)
        bar = Bar(f"looking around failures of {run.name}", remaining=True)
        kept, left = KeptFrames(run.folder, below, HOLES, load).ask(
            names if _chosen(run) else [], build(), build, config, bar
        )
        found |= {mark + one.identifier: one for one in kept}
        failed |= {mark + name: reason for name, reason in left.items()}
    told = rules_of(found)
    inside: dict[str, dict[Key, Samples]] = {}
    passes = sum(one.passes for one in found.values())
    stages = {"fresh": Further.fresh(config.samples, config.fresh)}
    if config.recheck is not None:
        stages[f"rechecks/{config.recheck}"] = Further.again(config.recheck)
    for folder, further in stages.items():
        inside[further.file] = {}
        for place, (run, mark) in enumerate(zip(runs, marks, strict=True)):
            checks, left = _inside(
                config, run, _of_run(told, found, run, mark), further, out / folder / str(place)
            )
            for check in checks:
                own = zip(check.indices, check.inside, strict=True)
                inside[further.file] |= {(mark + check.identifier, index): samples for index, samples in own}
                passes += check.passes
            failed |= {mark + name: reason for name, reason in left.items()}
    facts = {
        "out": str(out),
        "runs": [str(run.folder) for run in runs],
        "detector": runs[0].detector,
        "params": runs[0].params,
        "frames": sum(len(run.frames) for run in runs),
        "failures": len(told),
        "passes": passes,
        "frames_failed": failed,
    }
    nothing = Samples((), (), ())
    explained = {
        (frame, one.index): Explained(one, told[frame, one.index], inside[FRESH].get((frame, one.index), nothing))
        for frame, holes in found.items()
        for one in holes.around
    }
    answer = answer_of(out, merged(explained, inside.get(RECHECK, {})), facts, failed)
    answer.write()
    return answer


class HolesWorker:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: Holes, run: Run, out: Path) -> None:
        self.run, self.out = run, out
        self.effort = Effort(config.samples, config.contrast, config.reach, config.seed)
        self.attack, self.params = trusted_attack(run.folder, config.trust, "RUN"), parse_params(run.params)
        self.detector = detector_of(self.attack, config.device, "RUN")

    def __call__(self, name: str) -> None:
        """One frame, from the run's folder to its own."""
        folder = self.run.folder / FRAMES / name
        look_around(folder, self.attack, self.params, self.detector, self.effort, self.out / FRAMES / name)


class InsideWorker(HolesWorker):
    """The same for further samples. rules: by frame and object."""

    def __init__(
        self, config: Holes, run: Run, rules: dict[str, dict[int, Where]], further: Further, out: Path
    ) -> None:
        super().__init__(config, run, out)
        self.rules, self.further = rules, further

    def __call__(self, name: str) -> None:
        """One frame, of which rules are known."""
        folder, rules, out = self.run.folder / FRAMES / name, self.rules[name], self.out / FRAMES / name
        look_inside(folder, self.attack, self.params, self.detector, self.effort, rules, self.further, out)


def _inside(
    config: Holes, run: Run, rules: dict[str, dict[int, Where]], further: Further, out: Path
) -> tuple[list[FrameInside], dict[str, str]]:
    """Further samples inside of the rules of a run's failures, and why there are none of others. They are kept in
    `out` by what the rules are: those of other rules say nothing of these.
    """
    below = out / hashlib.sha256(repr(sorted(rules.items())).encode()).hexdigest()[:12]
    build = partial(InsideWorker, config, run, rules, further, below)
    bar = Bar(f"checking rules of {run.name}", remaining=True)
    return KeptFrames(run.folder, below, further.file, load_inside).ask(list(rules), build(), build, config, bar)


def _of_run(
    told: Mapping[Key, Told], found: Mapping[str, FrameHoles], run: Run, mark: str
) -> dict[str, dict[int, Where]]:
    """The rules of a run's failures, by frame and object, of those that have samples."""
    rules: dict[str, dict[int, Where]] = {}
    for frame in run.frames:
        name = mark + frame.result.identifier
        own = {
            one.index: told[name, one.index].where
            for one in (found[name].around if name in found else ())
            if one.asked.margins
        }
        if own:
            rules[frame.result.identifier] = own
    return rules


def _chosen(run: Run) -> list[str]:
    return [frame.result.identifier for frame in run.frames if certain_losses(frame.result)]


def _tell_effort(runs: list[Run], config: Holes) -> None:
    """How much there is to do, before it begins; by the pace of the runs, whose seconds hold more than passes."""
    count = sum(len(certain_losses(frame.result)) for run in runs for frame in run.frames)
    results = [frame.result for run in runs for frame in run.frames if frame.result.passes]
    seconds, passes = sum(r.seconds for r in results), sum(r.passes or 0 for r in results)
    wanted = count * (config.samples + config.fresh + (config.recheck or 0))
    wanted += config.contrast * sum(len(run.frames) for run in runs) if count else 0
    minutes = wanted * seconds / passes / 60 if passes else None
    pace = "" if minutes is None or not count else f", at most {max(minutes, 0.1):.1f} min in one process"
    told = f"{number_of(count, 'certain failure')}, about {number_of(wanted, 'pass', 'passes')}{pace}; "
    told += "more where losses are rare or rules narrow"
    Console(stderr=True).print(told, soft_wrap=True)
