"""The holes of a detector that runs' certain failures lie in: samples around each, gathered over frames."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from drivesem.attack.space import parse_params
from drivesem.questions.holes.frame import Effort, look_again, look_around
from drivesem.questions.holes.merged import merged
from drivesem.questions.holes.report import answer_of
from drivesem.questions.holes.results import (
    HOLES,
    RECHECK,
    Around,
    FrameHoles,
    FrameRecheck,
    Samples,
    load,
    load_recheck,
)
from drivesem.report.answer import Answer
from drivesem.report.terminal import Console
from drivesem.run.ask import Bar, KeptFrames
from drivesem.run.finished import Run, load_runs
from drivesem.run.folder import FRAMES, PRESENTATION, claim, detector_of, folder_of, trusted_attack
from drivesem.run.tally import certain_losses
from drivesem.settings.commands import Holes

_WRITTEN = ("holes.json", "holes.md", "holes.csv", "holes.png", "runs", "rechecks")
_FREE = (*PRESENTATION, "runs", "recheck")


def holes_run(config: Holes) -> Answer:
    """Look around the certain failures of runs, or go on with it, and write what is said. Raises UsageError or
    SceneError for bad input.
    """
    runs = load_runs(config.runs, config.limit, "RUN")
    out = folder_of(config.out, runs[0].folder / "holes")
    for run in runs:
        trusted_attack(run.folder, config.trust)  # before anything is written
    claim(out, config, _WRITTEN, _FREE)
    _tell_effort(runs, config)
    found: dict[str, list[Around]] = {}
    failed: dict[str, str] = {}
    results: list[FrameHoles | FrameRecheck] = []
    again: dict[tuple[str, int], Samples] = {}
    for place, run in enumerate(runs):
        below = out / "runs" / str(place)
        build = partial(HolesWorker, config, run, below)
        names = _chosen(run)
        kept, left = KeptFrames(run, below, HOLES, load).ask(
            names, build(), build, config, Bar(f"looking around failures of {run.name}", remaining=True)
        )
        mark = f"{run.name}/" if len(runs) > 1 else ""
        found |= {mark + one.identifier: list(one.around) for one in kept}
        failed |= {mark + name: reason for name, reason in left.items()}
        results += kept
        if config.recheck is not None:
            beside = out / "rechecks" / str(config.recheck) / str(place)
            checks, left = _rechecked(config, run, kept, below, beside)
            for check in checks:
                inside = zip(check.indices, check.inside, strict=True)
                again |= {(mark + check.identifier, index): samples for index, samples in inside}
            failed |= {mark + name: reason for name, reason in left.items()}
            results += checks
    facts = {
        "out": str(out),
        "runs": [str(run.folder) for run in runs],
        "detector": runs[0].detector,
        "params": runs[0].params,
        "frames": sum(len(run.frames) for run in runs),
        "failures": sum(map(len, found.values())),
        "passes": sum(one.passes for one in results),
        "frames_failed": failed,
    }
    answer = answer_of(out, merged(found, again), facts, failed)
    answer.write()
    return answer


class HolesWorker:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: Holes, run: Run, out: Path) -> None:
        self.run, self.out = run, out
        self.effort = Effort(config.samples, config.fresh, config.reach, config.seed)
        self.attack, self.params = trusted_attack(run.folder, config.trust), parse_params(run.params)
        self.detector = detector_of(self.attack, config.device)

    def __call__(self, name: str) -> None:
        """One frame, from the run's folder to its own."""
        folder = self.run.folder / FRAMES / name
        look_around(folder, self.attack, self.params, self.detector, self.effort, self.out / FRAMES / name)


class RecheckWorker(HolesWorker):
    """The same for further samples. known: where rules are kept."""

    def __init__(self, config: Holes, run: Run, known: Path, out: Path) -> None:
        super().__init__(config, run, out)
        self.known, self.draws = known, config.recheck or 0

    def __call__(self, name: str) -> None:
        """One frame, of which rules are known."""
        folder, known = self.run.folder / FRAMES / name, load(self.known / FRAMES / name / HOLES)
        out = self.out / FRAMES / name
        look_again(folder, self.attack, self.params, self.detector, self.effort, known, self.draws, out)


def _rechecked(
    config: Holes, run: Run, known: list[FrameHoles], below: Path, out: Path
) -> tuple[list[FrameRecheck], dict[str, str]]:
    """Further samples of the frames that are known, kept in `out`, and why there are none of others."""
    build = partial(RecheckWorker, config, run, below, out)
    names = [one.identifier for one in known]
    bar = Bar(f"checking rules of {run.name}", remaining=True)
    return KeptFrames(run, out, RECHECK, load_recheck).ask(names, build(), build, config, bar)


def _chosen(run: Run) -> list[str]:
    return [frame.result.identifier for frame in run.frames if certain_losses(frame.result)]


def _tell_effort(runs: list[Run], config: Holes) -> None:
    """How much there is to do, before it begins; by the pace of the runs, whose seconds hold more than passes."""
    count = sum(len(certain_losses(frame.result)) for run in runs for frame in run.frames)
    results = [frame.result for run in runs for frame in run.frames if frame.result.passes]
    seconds, passes = sum(r.seconds for r in results), sum(r.passes or 0 for r in results)
    wanted = count * (config.samples + config.fresh + (config.recheck or 0))
    minutes = wanted * seconds / passes / 60 if passes else None
    pace = "" if minutes is None or not count else f", at most {max(minutes, 0.1):.1f} min in one process"
    told = f"{count} certain failures, about {wanted} passes{pace}; more where losses are rare or rules narrow"
    Console(stderr=True).print(told, soft_wrap=True)
