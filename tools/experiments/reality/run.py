"""The experiment `reality`: its parts in order, and the record of what was fixed before half B was opened."""

from __future__ import annotations

import time
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drivesem.config.errors import UsageError
from drivesem.reporting.tables import AnalysisReport
from drivesem.run.folder import PRESENTATION
from scene_ir import files
from tools.experiments.settings import RealityConfig
from tools.experiments.tables import METADATA, RESULTS

RULES = "rules.json"
"""File of the fixed rules."""
_SPLIT = "half A or B by the parity of the first byte of the SHA-256 of a frame's name without suffix"
_UNRECORDED = ("part", "results", "half", "bootstrap", *PRESENTATION)


def run_reality(config: RealityConfig) -> AnalysisReport | int:
    """Run a part of the experiment, or continue it. Raises UsageError or SceneError for bad input."""
    if config.part == "report":
        from tools.experiments.reality.report import DRAWS, build_report, load_results, write_plots

        folder = Path(config.results) if config.results is not None else Path(config.out or "") / RESULTS
        results = load_results(folder, DRAWS if config.bootstrap is None else config.bootstrap, config.seed)
        report = build_report(results, Path(config.out or folder))
        if config.out is not None:
            report.write()
            write_plots(results, report.out)
        return report
    out = Path(config.out or "")
    results = out / RESULTS
    start, cpu = time.perf_counter(), time.process_time()
    facts: dict[str, Any] = {}
    if config.part == "attack":
        from tools.experiments.reality.samples import attack_days

        attack_days(config, out)
    elif config.part == "rules":
        facts["rules_fixed"] = _fix_rules(config, out)
    elif config.part == "observe":
        from tools.experiments.reality.observations import TABLE, observe_half

        if config.half == "B":
            if not (results / RULES).is_file():
                raise UsageError("--half", "A, until the part rules has fixed the rules", "B")
            facts["opened_b"] = _now()
            _record(config, results, facts)  # before anything of half B is read
        observe_half(config, config.half, results / TABLE.format(config.half))
    else:
        from tools.experiments.reality.retraining import run_retraining

        run_retraining(config, out)
    name = f"{config.part} {config.half}" if config.part == "observe" else config.part
    seconds = {"wall": round(time.perf_counter() - start), "cpu": round(time.process_time() - cpu)}
    _record(config, results, facts, {name: seconds})
    return 0


def _fix_rules(config: RealityConfig, out: Path) -> str:
    """Choose the rules of all attacked detectors and write them. Returns the time."""
    from tools.experiments.reality.rules import fit_stored_rules

    results = out / RESULTS
    if (results / RULES).is_file():
        raise UsageError("--out", "a folder without fixed rules", results / RULES)
    rules = fit_stored_rules(results, config.rules, config.seed)
    if not rules:
        raise UsageError("--out", "samples of the part attack, and rules in them", results)
    files.write_json(results / RULES, [rule.to_json() for rule in rules])
    return _now()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _record(
    config: RealityConfig, results: Path, facts: dict[str, Any], seconds: dict[str, Any] | None = None
) -> None:
    """Add to the study's record; what was recorded first stays."""
    path = results / METADATA
    record = files.read_json(path) if path.is_file() else {"split": _SPLIT, "settings": {}, "seconds": {}}
    settings = {name: value for name, value in asdict(config).items() if name not in _UNRECORDED}
    paths = ("root", "fog_root", "kitti_root", "train_root", "half_a", "half_b", "out")
    changed = {name: value for name, value in settings.items() if name not in paths}
    record["settings"] = {"name": "reality"} | changed
    record["seconds"] |= seconds or {}
    files.write_json(path, facts | record)
