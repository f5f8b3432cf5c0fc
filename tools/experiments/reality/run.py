"""The experiment `reality`: its parts in order, and the record of what was fixed before half B was opened."""

from __future__ import annotations

import time
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drivesem.config.errors import UsageError
from drivesem.reporting.tables import AnalysisReport
from scene_ir import files
from tools.experiments.settings import RealityConfig
from tools.experiments.tables import METADATA, RESULTS

RULES = "rules.json"
"""File of the fixed rules."""
_SPLIT = "half A or B by the parity of the first byte of the SHA-256 of a frame's name without suffix"
_UNRECORDED = (
    *("results", "bootstrap", "json", "out", "root", "fog_root", "kitti_root", "train_root", "half_a", "half_b"),
)
"""Settings that the record leaves out."""


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
    elif config.part == "survey":
        from tools.experiments.reality.survey import write_reality_survey

        facts["survey"] = write_reality_survey(config, out)
    else:
        from tools.experiments.reality.retraining import run_retraining

        run_retraining(config, out)
    seconds = {"wall_s": round(time.perf_counter() - start), "cpu_s": round(time.process_time() - cpu)}
    _record(config, results, facts, seconds)
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
    """Add a part to the study's record; facts that were recorded first stay."""
    path = results / METADATA
    record = files.read_json(path) if path.is_file() else {"split": _SPLIT, "settings": {}, "parts": []}
    record["settings"] = {"name": "reality", "seed": config.seed, "rules": config.rules}
    if seconds is not None:
        changed = {
            field.name: value
            for field in fields(config)
            if field.name not in _UNRECORDED and (value := getattr(config, field.name)) != field.default
        }
        for name in {"detectors", "attacked"} & changed.keys():  # files without their folders
            changed[name] = ",".join(part.rpartition("/")[2] for part in changed[name].split(","))
        record["parts"].append(changed | seconds)
    files.write_json(path, facts | record)
