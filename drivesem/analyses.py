"""The analyses of a run as Python functions: what the commands of the same names do.

```pycon
>>> import drivesem as ds
>>> ds.attack(ds.demo_scene(0), "squeezedet", params="translate,rotate", steps=2).save("found")
>>> ds.verify("found").data["agree"]
True

```
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from drivesem.config.commands import (
    ConfirmConfig,
    ExplainConfig,
    GateConfig,
    HolesConfig,
    ReportConfig,
    TransferConfig,
    VerifyConfig,
)
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.config.options import CommandConfig
from drivesem.reporting.tables import AnalysisReport
from drivesem.run.finished import AttackRun

Run: TypeAlias = "AttackRun | str | Path"
"""A run of `drivesem attack`, or its folder; also the folder of `Counterexample.save`."""
C = TypeVar("C", bound=CommandConfig)
R = TypeVar("R")


def verify(run: Run, **options: Any) -> AnalysisReport:
    """Recompute a run from its files and compare; `data["agree"]` is the verdict. Options: `drivesem verify`."""
    from drivesem.analysis.verify import run_verify

    data, file = _run(run_verify, VerifyConfig, options, run=_folder(run))
    return AnalysisReport(file.parent, file.stem, "verify", data, {}, (), ())


def confirm(run: Run, **options: Any) -> AnalysisReport:
    """Re-test counterexamples with a second renderer. Options: `drivesem confirm`."""
    from drivesem.analysis.confirm import run_confirm

    return _run(run_confirm, ConfirmConfig, options, run=_folder(run))[1]


def explain(run: Run, **options: Any) -> AnalysisReport:
    """Find which change causes each failure, and the smallest one that suffices. Options: `drivesem explain`."""
    from drivesem.analysis.explain.run import run_explain

    return _run(run_explain, ExplainConfig, options, run=_folder(run))


def holes(*runs: Run, **options: Any) -> AnalysisReport:
    """Map failure regions around certain failures. Options: `drivesem holes`."""
    from drivesem.analysis.holes.run import run_holes

    return _run(run_holes, HolesConfig, options, runs=tuple(map(_folder, runs)))


def gate(*runs: Run, after: str, **options: Any) -> AnalysisReport:
    """Compare two detectors on the failure regions of runs; `data["passed"]` is the verdict.

    Args:
        runs: The runs.
        after: Name or file of the new detector.
        options: Others of `drivesem gate`.
    """
    from drivesem.analysis.gate import run_gate

    return _run(run_gate, GateConfig, options, runs=tuple(map(_folder, runs)), after=after)


def transfer(run: Run, detectors: str, **options: Any) -> AnalysisReport:
    """Test counterexamples on other detectors, named with commas. Options: `drivesem transfer`."""
    from drivesem.analysis.transfer import run_transfer

    return _run(run_transfer, TransferConfig, options, run=_folder(run), detectors=detectors)


def report(*runs: Run, out: str | Path | None = None, frames: int | None = None) -> Path:
    """Build the HTML report of runs, and return its file.

    Args:
        runs: The runs.
        out: The file; by default report.html in the run's folder.
        frames: Number of frames to show, worst first.
    """
    from drivesem.run.run_report import build_reports

    options = {"out": None if out is None else str(out), "frames": frames}
    return Path(_run(build_reports, ReportConfig, options, runs=tuple(map(_folder, runs)))["out"])


def _folder(run: Run) -> str:
    if isinstance(run, AttackRun):
        return str(run.folder)
    if isinstance(run, str | Path):
        return str(run)
    raise UsageError("run", "a run (ds.load_run) or its folder", type(run).__name__)


def _run(analysis: Callable[[C], R], command: type[C], options: dict[str, Any], **given: Any) -> R:
    """Check the options of a command and run its analysis. Errors name Python's arguments."""
    from drivesem.run.lock import release_folder_locks

    known = set(command.__dataclass_fields__) - {"json"}
    for name in options:
        if name not in known or name in given:
            raise UsageError(name, f"one of {', '.join(sorted(known - set(given)))}", "another option")
    try:
        config = command(**options, **given)
        config.check()
        check_device(getattr(config, "device", "cpu"))
        with release_folder_locks():
            return analysis(config)
    except UsageError as error:
        raise error.with_arguments() from error
