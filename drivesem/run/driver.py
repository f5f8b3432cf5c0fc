"""Runs an analysis: shares its jobs among workers, caches each frame's result, and publishes the report."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from drivesem.config.options import WorkerOptions
from drivesem.reporting.tables import AnalysisReport, Console, print_json, progress_bar
from drivesem.run.finished import AttackRun
from drivesem.run.folder import FRAMES
from drivesem.run.labels import RESULT
from drivesem.run.records import dump_record, load_record
from drivesem.run.workers import run_jobs
from scene_ir import files
from scene_ir.errors import SceneError


class CachedFrameResult(Protocol):
    """The stored result of one frame."""

    @property
    def source(self) -> str:
        """Digest of the run's result.json that was analysed."""
        ...


J = TypeVar("J", bound=Hashable)
R = TypeVar("R")
K = TypeVar("K", bound=CachedFrameResult)


@dataclass(frozen=True, slots=True)
class JobResults(Generic[J, R]):
    """Outcomes of jobs."""

    results: dict[J, R]
    """Results by job, in order of completion."""
    failed: dict[str, str]
    """Reasons by name of the jobs without a result."""


@dataclass(frozen=True, slots=True)
class ProgressSettings:
    """Appearance of a progress bar."""

    title: str
    """Text in front of the bar."""
    keep: bool = True
    """Leave the bar on the screen at the end."""
    show_remaining: bool = False
    """Show an estimate of the time left."""


def run_frame_jobs(
    jobs: Sequence[J],
    worker: Callable[[J], R],
    make_worker: Callable[[], Callable[[J], R]],
    config: WorkerOptions,
    progress_settings: ProgressSettings,
    name: Callable[[J], str] = str,
    size: Callable[[J], int] = lambda job: 1,
) -> JobResults[J, R]:
    """Run all jobs in this process or several, with a progress bar.

    Args:
        jobs: The jobs.
        worker: Runs a job in this process; mostly the result of `make_worker`, made early so that bad input shows.
        make_worker: Makes the worker of another process; can be pickled.
        config: Number of workers, engine, and whether to keep going.
        progress_settings: Appearance of the bar.
        name: Name of a job that failed.
        size: Amount by which a job advances the bar.

    Raises:
        SceneError: A job failed, and `keep_going` is not set.
    """
    results: dict[J, R] = {}
    failed: dict[str, str] = {}
    with progress_bar(
        Console(stderr=True),
        keep=progress_settings.keep,
        show_remaining=progress_settings.show_remaining,
        hidden=not jobs,
    ) as progress:
        task = progress.add_task(progress_settings.title, total=sum(map(size, jobs)))
        for job, outcome in run_jobs(worker, make_worker, jobs, config):
            try:
                results[job] = outcome()
            except SceneError as error:
                if not config.keep_going:
                    raise
                failed[name(job)] = str(error)
            progress.advance(task, size(job))
    return JobResults(results, failed)


class FrameAnalyser(ABC, Generic[K]):
    """Analyses frames of a run and stores each result in a folder of its own; made once per process."""

    file: str
    """JSON file with a frame's result; its presence marks the frame as done."""
    kind: ClassVar[type[Any]]
    """Dataclass of a result."""
    schema: ClassVar[int]
    """Version of its fields."""

    def __init__(self, run_folder: Path, out: Path) -> None:
        self.run_folder, self.out = run_folder, out

    @abstractmethod
    def analyse(self, name: str, folder: Path) -> K:
        """Analyse a frame, and write pictures to `folder`. The result has the frame's `source_digest`."""

    def __call__(self, name: str) -> None:
        """Analyse one frame and write its folder, completely or not at all."""
        with files.atomic_folder(self.out / FRAMES / name) as folder:
            files.write_text(folder / self.file, dump_record(self.analyse(name, folder), self.schema))

    def source_digest(self, name: str) -> str:
        """Return the digest of a frame's result.json in the run."""
        return files.sha256_digest(self.run_folder / FRAMES / name / RESULT)

    def load_result(self, name: str) -> K:
        """Load the stored result of a frame. Raises FormatError for a damaged file."""
        return load_record(self._result_path(name), self.kind, self.schema)

    def is_done(self, name: str) -> bool:
        """Whether there is a stored result of the frame as it is now in the run."""
        return self._result_path(name).is_file() and self.load_result(name).source == self.source_digest(name)

    def _result_path(self, name: str) -> Path:
        return self.out / FRAMES / name / self.file


def analyse_frames(
    names: Sequence[str],
    analyser: FrameAnalyser[K],
    make_analyser: Callable[[], FrameAnalyser[K]],
    config: WorkerOptions,
    progress_settings: ProgressSettings,
) -> tuple[list[K], dict[str, str]]:
    """Analyse the frames that have no stored result yet.

    Args:
        names: The frames.
        analyser: The analyser of this process.
        make_analyser: Makes that of another process; can be pickled.
        config: Number of workers, engine, and whether to keep going.
        progress_settings: Appearance of the progress bar.

    Returns:
        The results in the order of `names`, and reasons by name of the frames without one.
    """
    unfinished = [name for name in names if not analyser.is_done(name)]
    failed = run_frame_jobs(unfinished, analyser, make_analyser, config, progress_settings).failed
    return [analyser.load_result(name) for name in names if name not in failed], failed


def analyse_runs(
    frames_by_run: Sequence[tuple[AttackRun, Sequence[str]]],
    make_analyser: Callable[[AttackRun, Path], FrameAnalyser[K]],
    out: Path,
    config: WorkerOptions,
    title: str,
) -> tuple[dict[str, K], dict[str, str]]:
    """Analyse frames of several runs.

    Args:
        frames_by_run: The runs, each with the names of the frames to analyse.
        make_analyser: Makes the analyser of a run with the folder of its results; can be pickled.
        out: Folder of all results; each run gets a folder with its number.
        config: Number of workers, engine, and whether to keep going.
        title: Text in front of each progress bar, followed by the name of the run.

    Returns:
        The results by frame, and reasons by frame without one. Names of frames start with that of their run if
        there are several.
    """
    results: dict[str, K] = {}
    failed: dict[str, str] = {}
    for i, (run, names) in enumerate(frames_by_run):
        make = partial(make_analyser, run, out / str(i))
        progress_settings = ProgressSettings(f"{title} {run.name}", show_remaining=True)
        records, errors = analyse_frames(names, make(), make, config, progress_settings)
        prefix = f"{run.name}/" if len(frames_by_run) > 1 else ""
        done = (name for name in names if name not in errors)
        results |= {prefix + name: record for name, record in zip(done, records, strict=True)}
        failed |= {prefix + name: reason for name, reason in errors.items()}
    return results, failed


def publish_report(report: AnalysisReport, as_json: bool, end: Console | None = None) -> None:
    """Print a report, what was left out, and its folder.

    Args:
        report: The report, already written.
        as_json: Print the data to standard output as JSON, and the tables to standard error.
        end: Console of the last lines; standard error by default.
    """
    print_report(report, as_json)
    print_output_folder(report.out, end or Console(stderr=True), report.failed, report.failure_text)


def print_report(report: AnalysisReport, as_json: bool) -> None:
    """Print the JSON data, the tables, or both: with `as_json`, the tables go to standard error."""
    if as_json:
        print_json(report.data)
    if not (as_json and report.json_only):
        report.print(Console(stderr=as_json))


def print_output_folder(
    out: Path, console: Console, failed: Mapping[str, str] | None = None, failure_text: str = "could not be used"
) -> None:
    """Print what was left out, and where the output is.

    Args:
        out: Folder or file of the output.
        console: Where to print.
        failed: Reasons by what was left out.
        failure_text: Verb phrase between a key of `failed` and its reason.
    """
    for name, reason in (failed or {}).items():
        console.print(f"{name} {failure_text}: {reason}", soft_wrap=True, markup=False)
    console.print(f"written to {out}", soft_wrap=True, markup=False)
