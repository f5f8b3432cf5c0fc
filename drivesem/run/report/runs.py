"""What a report shows of runs of `drivesem attack`: their figures on the frames that they share, and curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.attack.space import combo_parameters
from drivesem.attack.targets import EvaluatedClasses
from drivesem.config.commands import COMBO_NUMBERS, AttackConfig, ReportConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import format_command_line
from drivesem.data.label_table import WEATHERS
from drivesem.evaluation.curves import sampled_curve
from drivesem.evaluation.matched_class import MatchedClass
from drivesem.failures.certificate import CertificateRule
from drivesem.run.finished import METRICS, load_runs
from drivesem.run.folder import CONFIG, load_attack_config
from drivesem.run.protocol import PAPER_BENIGN, PAPER_COMBOS, PAPER_SINGLE, follows_paper
from drivesem.run.records import from_json
from drivesem.run.report.html import render_report
from drivesem.run.report.page import (
    ChartLine,
    GradeRequirements,
    PaperFigure,
    ReportChart,
    ReportedRun,
    ReportPage,
)
from drivesem.run.results import FrameResult, RunSummary
from drivesem.run.summary import count_grades, summarise_frames, targets_and_detections
from scene_ir import files
from scene_ir.errors import FormatError

PAGE = "report.html"
_STUDY, _ARMS = "study.json", "arms"
PICTURES = 200
"""Pictures of a page, unless asked otherwise: 100 frames of one run, 14 to 21 MB of KITTI."""
_NOT_TOLD = ("out", "json", "resume", "workers")
"""Settings that change nothing in the result: left out of the report's command line."""
_MOST_LINES = 7
"""Of a chart: as many as there are colours."""


def build_reports(config: ReportConfig) -> dict[str, Any]:
    """Write the page of runs, or of the finished arms of studies: the JSON's form. Raises UsageError or SceneError
    for bad input.
    """
    folders: list[str] = []
    charts: list[ReportChart] = []
    for given in config.runs:
        folders += [str(folder) for folder in _runs_of(Path(given))]
        if (Path(given) / _STUDY).is_file():
            charts += query_curves(Path(given))
    # In the folder that was given, or where the command is called.
    out = Path(config.out or (Path(config.runs[0]) / PAGE if len(config.runs) == 1 else PAGE))
    if out.is_dir():
        raise UsageError("--out", "an HTML file", f"the folder {out}")
    shown, left_out = load_reported_runs(folders)
    size = write_report(out, shown, config.frames, left_out, charts)
    return _data(out, size, shown, left_out)


def _runs_of(folder: Path) -> list[Path]:
    """A run itself, or the finished arms of a study. Raises UsageError where it is neither."""
    if not folder.is_dir():
        raise UsageError("RUN", "a folder of drivesem attack or drivesem study", folder)
    if not (folder / _ARMS).is_dir():
        return [folder]
    arms = [
        arm for arm in sorted((folder / _ARMS).iterdir()) if (arm / CONFIG).is_file() and (arm / METRICS).is_file()
    ]
    if not arms:
        raise UsageError("RUN", "a study with a finished arm", folder)
    return arms


def _data(out: Path, size: int, shown: list[ReportedRun], left_out: int) -> dict[str, Any]:
    """What `--json` prints: fractions of 1."""
    rows = []
    for one in shown:
        summary = one.summary.to_json()
        del summary["out"], summary["seconds"]
        rows.append(
            {
                "name": one.name,
                "run": str(one.folder),
                "method": one.method,
                **summary,
                "paper": asdict(one.paper) if one.paper else None,
            }
        )
    frames = [
        {
            "frame": results[0].identifier,
            "failures": {
                one.name: [f.kind for f in result.failures] for one, result in zip(shown, results, strict=True)
            },
            "kinds": {
                one.name: [f.error for f in result.failures] for one, result in zip(shown, results, strict=True)
            },
            "grades": {
                one.name: [f.grade for f in result.failures] for one, result in zip(shown, results, strict=True)
            },
        }
        for results in zip(*(one.frames for one in shown), strict=True)
    ]
    return {"out": str(out), "bytes": size, "frames_left_out": left_out, "runs": rows, "frames": frames}


def write_run_report(out: Path, config: AttackConfig, summary: RunSummary, results: Sequence[FrameResult]) -> None:
    """`report.html` of one run in its folder."""
    write_report(out / PAGE, [_shown(out.name, out, config, summary, results)])


def write_report(
    path: Path,
    runs: Sequence[ReportedRun],
    frames: int | None = None,
    left_out: int = 0,
    charts: Sequence[ReportChart] = (),
) -> int:
    """Write the page of runs on the same frames; how many bytes it has. frames: whose pictures are shown, worst
    first, by default as many as PICTURES allow. charts: beside precision over recall.
    """
    shown = frames or max(PICTURES // (1 + len(runs)), 1)
    page = ReportPage(runs, [*precision_recall(runs), *charts], min(shown, len(runs[0].frames)), left_out)
    text = render_report(page, path).encode("utf-8")
    files.write_bytes(path, text)
    return len(text)


def load_reported_runs(folders: Sequence[str]) -> tuple[list[ReportedRun], int]:
    """Finished runs, as far as their frames are in all of them, and how many frames are not. Figures are those of
    `metrics.json` where all runs have the same frames, else computed again.

    Raises UsageError for folders that hold no finished run, runs that share no frame, and runs on different
    photographs; FormatError for a damaged file.
    """
    loaded = load_runs(folders, setting="RUN")
    names = [{frame.result.identifier for frame in run.frames} for run in loaded]
    shared, every = set.intersection(*names), set.union(*names)
    if not shared:
        raise UsageError("RUN", "runs that share frames", "none that is in all of them")
    shown = []
    for run in loaded:
        results = [frame.result for frame in run.frames if frame.result.identifier in shared]
        summary = _summary(run.folder / METRICS)
        if len(shared) < len(every):
            summary = _again(summary, results)
        shown.append(_shown(run.name, run.folder, load_attack_config(run.folder, "RUN"), summary, results))
    _check_photographs(shown)
    return shown, len(every) - len(shared)


def precision_recall(runs: Sequence[ReportedRun]) -> list[ReportChart]:
    """Precision over recall of the headline's class at IoU 0.5; nothing where there is no object to find.

    Of one run by both label modes, of several by labels that moved.
    """
    several = len(runs) > 1
    before: dict[str, ChartLine | None] = {}
    after: list[ChartLine | None] = []
    for run in runs:
        detector = run.summary.detector
        if detector not in before:
            name = f"before, {detector}" if several else "before"
            before[detector] = _curve(run, "benign", "benign", name)
        after.append(_curve(run, "moved", "attacked", f"{run.name}, after" if several else "after, moved labels"))
        if not several:
            after.append(_curve(run, "benign", "attacked", "after, benign labels (paper)"))
    told, unchanged = ([line for line in lines if line is not None] for lines in (after, before.values()))
    if not told:
        return []
    note = "Best precision at that recall or a higher one, as AP50 has it; dots: where detections from t* on end."
    room = max(_MOST_LINES - len(unchanged), 1)
    if len(told) > room:
        note += f" The first {room} of {len(told)} runs."
    # several runs come first, so that each has one colour in all charts
    lines = [*told[:room], *unchanged] if several else [*unchanged, *told]
    headline = runs[0].summary.headline
    title = f"Precision over recall: {headline}, IoU 0.5"
    return [ReportChart(title, "recall, %", "precision, %", lines, note)]


def query_curves(study: Path) -> list[ReportChart]:
    """Frames broken after so many queries, where a study has these curves. Raises FormatError."""
    found = files.read_json(study / _STUDY)
    points = found.get("curves", []) if isinstance(found, dict) else []
    if not points:
        return []
    try:
        # in the order in which the arms' folders are shown
        lines = [_queries(name, points) for name in sorted({point["name"] for point in points})]
        most = max(int(point["queries"]) for point in points)
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(str(study / _STUDY), "curves of a study", error) from error
    note = "A query is one gradient, or one judged render."
    banded = [line.name for line in lines[:_MOST_LINES] if line.band]
    if banded:
        note += f" Band: 95 % of draws of frames, {banded[0]}."
    if len(lines) > _MOST_LINES:
        note += f" The first {_MOST_LINES} of {len(lines)} arms."
    return [
        ReportChart(
            title="Frames broken after so many queries",
            x_label="queries",
            y_label="frames broken, %",
            lines=lines[:_MOST_LINES],
            note=note,
            x_range=(1.0, float(max(most, 2))),
            log2_x=True,
        )
    ]


def _queries(name: str, points: Sequence[dict[str, Any]]) -> ChartLine:
    mine = [p for p in points if p["name"] == name and p["share"] is not None]
    first = name == points[0]["name"]
    bounded = [p for p in mine if first and p["low"] is not None and p["high"] is not None]
    return ChartLine(
        name=name,
        points=tuple((float(p["queries"]), 100 * float(p["share"])) for p in mine),
        mark=(float(mine[-1]["queries"]), 100 * float(mine[-1]["share"])) if mine else None,
        band=tuple((float(p["queries"]), 100 * float(p["low"]), 100 * float(p["high"])) for p in bounded),
        steps=True,
    )


def _shown(
    name: str, folder: Path, config: AttackConfig, summary: RunSummary, results: Sequence[FrameResult]
) -> ReportedRun:
    return ReportedRun(
        name=name,
        folder=folder,
        summary=summary,
        frames=tuple(sorted(results, key=lambda r: r.identifier)),
        method=config.method,
        command=format_command_line("attack", config, _NOT_TOLD),
        weathers=tuple(_weather(r.identifier) for r in sorted(results, key=lambda r: r.identifier)),
        grade_requirements=_asked(config),
        paper=_paper(summary.params) if follows_paper(config) else None,
    )


def _asked(config: AttackConfig) -> GradeRequirements:
    rule = CertificateRule(config.draws)
    return GradeRequirements(
        rule.draws, rule.before, rule.after, config.confirm, config.confirm and config.second_detector != "off"
    )


def _paper(params: tuple[str, ...]) -> PaperFigure | None:
    """The paper's mAP for the same parameters, alone or as one of its combinations."""
    known = {(str(one),): after for one, after in PAPER_SINGLE.items()}
    known |= {tuple(str(p) for p in combo_parameters(number)): PAPER_COMBOS[number] for number in COMBO_NUMBERS}
    return PaperFigure(PAPER_BENIGN, known[params]) if params in known else None


def _weather(identifier: str) -> str | None:
    """Virtual KITTI's variation in a frame's name, where it is weather."""
    return next((word for word in identifier.replace("_", "/").split("/") if word in WEATHERS), None)


def _curve(run: ReportedRun, labels: str, seen: str, name: str) -> ChartLine | None:
    summary = run.summary
    judged = _judged(summary)
    if summary.headline not in judged.names or not run.frames:
        return None
    targets, found = targets_and_detections(run.frames, judged, labels, seen)
    outcome = MatchedClass.from_frames(targets, found, judged.names.index(summary.headline))
    samples = sampled_curve(outcome.candidates.class_matches(outcome.match, 0))
    if not samples:
        return None
    points = tuple((100 * recall, 100 * precision) for recall, precision, _ in samples)
    above = [i for i, (_, _, score) in enumerate(samples) if score >= summary.t_star]
    return ChartLine(name, points, points[above[-1]] if above else None)


def _judged(summary: RunSummary) -> EvaluatedClasses:
    """Without the detector: a run's results hold none but judged classes."""
    names = tuple(summary.benign.per_class)
    return EvaluatedClasses(names, names)


def _again(summary: RunSummary, results: Sequence[FrameResult]) -> RunSummary:
    """The figures of some of a run's frames."""
    return replace(summary, **summarise_frames(results, _judged(summary), summary.t_star, summary.headline))


def _summary(path: Path) -> RunSummary:
    """The inverse of `RunSummary.to_json`. Raises FormatError naming the file and what is wrong."""
    data = files.read_json(path)
    try:
        plain = {
            name: data[name]
            for name in ("out", "dataset", "detector", "headline", "t_star", "frames", "frames_without_vehicles")
        }
        plain |= {name: data[name] for name in ("frames_failed", "objects", "successes_paper", "successes_moved")}
        plain |= {name: data[name] for name in ("feasible_fraction", "queries", "seconds")}
        plain |= {"params": data["params"]} | _grades(data)
        plain |= {name: _scores(data[name]) for name in ("benign", "rerendered")}
        plain |= {f"attacked_{mode}": _scores(data["attacked"][mode]) for mode in ("paper", "moved")}
        plain |= {name: data[f"{name}_by_class"] for name in ("lost_objects", "phantoms")}
    except (KeyError, TypeError, AttributeError) as error:
        raise FormatError(str(path), "the figures of a run", error) from error
    summary: RunSummary = from_json(RunSummary, plain, str(path))
    if summary.headline not in summary.benign.per_class:
        raise FormatError(f"{path}: headline", f"one of {', '.join(summary.benign.per_class)}", summary.headline)
    return summary


def _grades(data: dict[str, Any]) -> dict[str, Any]:
    """How sure the failures of a run are; of one that was written before anybody asked, that nobody knows."""
    if "grades" in data:
        return {name: data[name] for name in ("passes", "grades", "kinds", "frames_ungraded", "grade_notes")}
    return count_grades([]) | {
        "grades": {**count_grades([])["grades"], "threshold": data["lost_objects"] + data["phantoms"]},
        "frames_ungraded": data["frames"],
    }


def _scores(data: dict[str, Any]) -> dict[str, Any]:
    """The inverse of `Scores.to_json`, as plain objects."""
    beside = {name: data[name] for name in ("overall", "per_class")}
    return {"headline": {name: one for name, one in data.items() if name not in beside}} | beside


def _check_photographs(runs: Sequence[ReportedRun]) -> None:
    """Frames of the same name must be the same photograph."""
    first, *others = runs
    for result in first.frames:
        mine = _photograph(first, result.identifier)
        for run in others:
            if not np.array_equal(mine, _photograph(run, result.identifier)):
                found = f"another picture of frame {result.identifier} in {run.folder} than in {first.folder}"
                raise UsageError("RUN", "runs on the same photographs", found)


def _photograph(run: ReportedRun, identifier: str) -> np.ndarray:
    return np.frombuffer(files.read_bytes(run.folder / "frames" / identifier / "benign.png"), np.uint8)
