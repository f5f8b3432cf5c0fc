"""What every question to runs shares: its jobs in one process or several, the answers that are kept frame by
frame, and what is said at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from drivesem.config.blocks import Sharing
from drivesem.report.answer import Answer, print_json
from drivesem.report.progress import progress_bar
from drivesem.report.terminal import Console
from drivesem.run.folder import FRAMES
from drivesem.run.frame import RESULT
from drivesem.run.workers import outcomes
from scene_ir import files
from scene_ir.errors import SceneError


class Kept(Protocol):
    """What is kept of one frame. source: digest of the run's result that it is about."""

    @property
    def source(self) -> str: ...


J = TypeVar("J", bound=Hashable)
R = TypeVar("R")
K = TypeVar("K", bound=Kept)


@dataclass(frozen=True, slots=True)
class JobResults(Generic[J, R]):
    """What came of jobs. results: by job, as they were done; failed: why, by the names of the others."""

    results: dict[J, R]
    failed: dict[str, str]


@dataclass(frozen=True, slots=True)
class Bar:
    """How the progress of jobs is shown. stays: at the end too; remaining: with an estimate of what is left."""

    title: str
    stays: bool = True
    remaining: bool = False


def ask(
    jobs: Sequence[J],
    work: Callable[[J], R],
    build: Callable[[], Callable[[J], R]],
    config: Sharing,
    bar: Bar,
    name: Callable[[J], str] = str,
    size: Callable[[J], int] = lambda job: 1,
) -> JobResults[J, R]:
    """Do all jobs, in this process or in several, with a bar. With `keep_going` a job that cannot be done is
    listed as failed; without, its SceneError ends it all.

    work, build: as of `outcomes`: `build` can be pickled, and `work` is mostly what it gives, made before anything
    is written so that bad input shows at once. name: of a job where it failed; size: what it adds to the bar.
    """
    results: dict[J, R] = {}
    failed: dict[str, str] = {}
    console = Console(stderr=True)
    with progress_bar(console, stays=bar.stays, remaining=bar.remaining, hidden=not jobs) as progress:
        task = progress.add_task(bar.title, total=sum(map(size, jobs)))
        for job, outcome in outcomes(work, build, jobs, config):
            try:
                results[job] = outcome()
            except SceneError as error:
                if not config.keep_going:
                    raise
                failed[name(job)] = str(error)
            progress.advance(task, size(job))
    return JobResults(results, failed)


@dataclass(frozen=True, slots=True)
class KeptFrames(Generic[K]):
    """Answers about frames of a run, each kept in a folder of its own below `out`, and asked for again where the
    run's frame has become another. run: its folder; file: in that folder, which marks it as done; read: reads it.
    """

    run: Path
    out: Path
    file: str
    read: Callable[[Path], K]

    def ask(
        self,
        names: Sequence[str],
        work: Callable[[str], object],
        build: Callable[[], Callable[[str], object]],
        config: Sharing,
        bar: Bar,
    ) -> tuple[list[K], dict[str, str]]:
        """The answers about frames in their order, and why others have none. work: writes a frame's folder."""
        todo = [name for name in names if not self._is_done(name)]
        failed = ask(todo, work, build, config, bar).failed
        return [self.read(self._path(name)) for name in names if name not in failed], failed

    def _path(self, name: str) -> Path:
        return self.out / FRAMES / name / self.file

    def _is_done(self, name: str) -> bool:
        path, source = self._path(name), self.run / FRAMES / name / RESULT
        return path.is_file() and self.read(path).source == files.digest(source)


def say(answer: Answer, as_json: bool, end: Console | None = None) -> None:
    """Print an answer and where it was written. as_json: its data on standard output, and the tables elsewhere.
    end: for the last lines, by default standard error.
    """
    show(answer, as_json)
    say_end(answer.out, end or Console(stderr=True), answer.failed, answer.failure)


def show(answer: Answer, as_json: bool) -> None:
    """Print an answer that is written nowhere. as_json: as of `say`."""
    if as_json:
        print_json(answer.data)
    if not (as_json and answer.only_json):
        answer.print(Console(stderr=as_json))


def say_end(
    out: Path, console: Console, failed: Mapping[str, str] | None = None, failure: str = "could not be used"
) -> None:
    """What could not be used and why, and where all is written."""
    for what, reason in (failed or {}).items():
        console.print(f"{what} {failure}: {reason}", soft_wrap=True, markup=False)
    console.print(f"written to {out}", soft_wrap=True, markup=False)
