"""Analyses the failures of a finished run of `drivesem classify attack`, one folder per failure."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor

from drivesem.classify.attack import Attacker
from drivesem.classify.objective import ClassifierObjective, create_objective
from drivesem.classify.pictures import ObjectView
from drivesem.classify.results import SCHEMA, ClassifiedPicture
from drivesem.config.commands import ClassifyConfig
from drivesem.config.errors import UsageError
from drivesem.failures.grades import Grade
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_count
from drivesem.run.driver import CachedFrameResult, FrameAnalyser, ProgressSettings, analyse_frames
from drivesem.run.folder import CONFIG, FRAMES, PRESENTATION, check_referenced_files, claim_folder
from drivesem.run.labels import RESULT
from drivesem.run.records import from_json, load_record
from scene_ir import files
from scene_ir.errors import FormatError

K = TypeVar("K", bound=CachedFrameResult)


@dataclass(frozen=True)
class ClassifyRun:
    """A finished run."""

    folder: Path
    """Its folder."""
    config: ClassifyConfig
    """Its settings, with the device of the analysis."""
    results: dict[str, ClassifiedPicture]
    """Results by picture."""

    @classmethod
    def load(cls, config: ClassifyConfig) -> ClassifyRun:
        """Load the run in an analysis's `folder`. Raises UsageError if there is none, FormatError if it is damaged."""
        folder = Path(config.folder or "")
        path = folder / CONFIG
        settings = files.read_yaml(path) if path.is_file() else None
        if not isinstance(settings, dict) or settings.get("what") != "attack":
            raise UsageError("RUN", "a folder of drivesem classify attack", folder)
        run_config: ClassifyConfig = from_json(ClassifyConfig, settings, str(path))
        run_config.check()
        check_referenced_files(folder, run_config)
        paths = sorted((folder / FRAMES).glob(f"*/{RESULT}"))
        results = [load_record(one, ClassifiedPicture, SCHEMA) for one in paths]
        if not results:
            raise UsageError("RUN", "a run with pictures", f"none in {folder}")
        by_name = {one.identifier: one for one in results}
        return cls(folder, replace(run_config, device=config.device), by_name)

    def failure_names(self, limit: int | None, grades: Collection[str] = tuple(Grade)) -> list[str]:
        """Names of at most `limit` pictures with failures of these grades."""
        return [name for name, result in self.results.items() if result.grade in grades][:limit]

    def view(self, name: str) -> ObjectView:
        """The view of a picture."""
        result = self.results[name]
        return ObjectView(self.config.split, result.object, result.view)

    def load_objective(self, attacker: Attacker, name: str) -> tuple[ClassifierObjective, Tensor]:
        """Load a picture's objective and the theta that the attack found (D,).

        Args:
            attacker: The run's network and objects.
            name: The picture.

        Raises:
            SceneError: An object that cannot be used, or a damaged theta.
        """
        scene, space = attacker.load_scene(self.view(name))
        path = self.folder / FRAMES / name / "theta.npz"
        theta = torch.from_numpy(files.read_npz(path)["theta"]).to(space.theta0)
        if theta.shape != space.theta0.shape:
            raise FormatError(f"{path}: theta", f"shape {tuple(space.theta0.shape)}", tuple(theta.shape))
        return create_objective(scene, space, attacker.network, self.config), theta


class FailureAnalyser(FrameAnalyser[K]):
    """Analyses failures of a run; built once per process."""

    command: ClassVar[str]
    """Name of the analysis, of its folder in the run's, and of its files."""
    schema = SCHEMA
    grades: ClassVar[Collection[str]] = tuple(Grade)
    """Grades of the failures it analyses."""
    needs_failures: ClassVar[bool] = True
    """Whether a run without such failures is an error."""
    renews: ClassVar[bool] = False
    """See `claim_folder`."""
    free: ClassVar[tuple[str, ...]] = ()
    """Settings that do not affect stored results."""

    def __init__(self, config: ClassifyConfig, run: ClassifyRun, out: Path) -> None:
        super().__init__(run.folder, out)
        self.config, self.run, self.attacker = config, run, Attacker.from_config(run.config)


@dataclass(frozen=True, slots=True)
class AnalysisResults(Generic[K]):
    """Results of an analysis."""

    run: ClassifyRun
    """The run."""
    out: Path
    """Folder of the analysis."""
    results: list[K]
    """Results in the order of the run's pictures."""
    failed: dict[str, str]
    """Reason by picture without a result."""

    def write_report(
        self,
        name: str,
        heading: str,
        data: Mapping[str, Any],
        rows: Sequence[Mapping[str, Any]],
        table: ReportTable,
        notes: Sequence[str],
        text_columns: Collection[str] = (),
    ) -> AnalysisReport:
        """Write the report.

        Args:
            name: Name of its files.
            heading: Its title.
            data: Contents of the JSON file, after the run's facts.
            rows: Rows of the CSV file.
            table: The table.
            notes: Explanations below it.
            text_columns: Left-aligned columns; by default the first.
        """
        config = self.run.config
        facts = {"out": str(self.out), "run": str(self.run.folder), "network": config.network}
        report = AnalysisReport(
            out=self.out,
            name=name,
            heading=heading,
            data={**facts, "method": config.method, "frames_failed": self.failed, **data},
            csv_tables={name: rows} if rows else {},
            tables=[table],
            notes=notes,
            text_columns=text_columns,
            failed={f"picture {picture}": reason for picture, reason in self.failed.items()},
        )
        report.write()
        return report


def analyse_failures(config: ClassifyConfig, analyser: type[FailureAnalyser[K]], title: str) -> AnalysisResults[K]:
    """Analyse the failures of a run that have no stored result yet.

    Args:
        config: Settings of the analysis.
        analyser: The analysis.
        title: Text in front of the progress bar.

    Raises:
        UsageError: There is no such run, or it has no failures.
        SceneError: A failure that cannot be analysed, without --keep-going.
    """
    run = ClassifyRun.load(config)
    names = run.failure_names(config.limit, analyser.grades)
    if analyser.needs_failures and not names:
        raise UsageError("RUN", "a run with failures", f"none in {format_count(len(run.results), 'picture')}")
    out = Path(config.out) if config.out else run.folder / analyser.command
    make = partial(analyser, config, run, out)
    worker = make()
    written = (*(f"{analyser.command}.{suffix}" for suffix in ("json", "md", "csv", "xml")), FRAMES)
    claim_folder(out, config, written, (*PRESENTATION, "folder", *analyser.free), renews=analyser.renews)
    progress = ProgressSettings(title, show_remaining=True)
    return AnalysisResults(run, out, *analyse_frames(names, worker, make, config, progress))
