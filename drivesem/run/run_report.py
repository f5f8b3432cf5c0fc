"""Builds the HTML report of runs from their metrics on common frames, with the published results of the paper."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.attacks.budgets import STREET, format_budget, parse_budget
from drivesem.attacks.methods.margin_search import Climb
from drivesem.attacks.space import combo_parameters
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.config.commands import COMBO_NUMBERS, AttackConfig, ReportConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import format_command_line
from drivesem.data.label_table import WEATHER_VARIATIONS
from drivesem.evaluation.curves import sampled_curve
from drivesem.evaluation.matched_class import MatchedClass
from drivesem.failures.certificate import CertificateRule
from drivesem.failures.grades import Grade
from drivesem.reporting.tables import format_count
from drivesem.run.finished import METRICS, load_runs
from drivesem.run.folder import CONFIG, load_attack_config
from drivesem.run.frame import build_map, estimate_rates, summarise_frames, targets_and_detections
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
from scene_ir import files
from scene_ir.errors import FormatError

PAPER_DETECTOR = "squeezedet"
PROTOCOL = {
    "method": "si-fgsm",
    "steps": 10,
    "early_stop": False,
    "objective": "confidence",
    "objective_labels": "paper",
    "keep": "last",
    "project": "bounds",
    "parametrisation": "roi",
}
"""Settings of configs/paper.yaml, without the budget and the parameters."""
_DEFAULTS = ("passes", "rate", "momentum", "target_objects", "target_classes", "precision", "t_star")
"""Settings with default values in the protocol."""


def follows_paper(config: AttackConfig) -> bool:
    """Whether an attack uses the paper's method, settings and detector."""
    default = AttackConfig()
    expected = {**PROTOCOL, **{name: getattr(default, name) for name in _DEFAULTS}, "detector": PAPER_DETECTOR}
    if any(getattr(config, name) != value for name, value in expected.items()):
        return False
    return parse_budget(config.budget) == parse_budget("paper")


PAPER_BENIGN = 0.994
"""The paper's mAP of SqueezeDet before any change."""
PAPER_SINGLE = {
    "color": 0.995,
    "weather": 0.988,
    "foliage": 0.997,
    "translate": 0.992,
    "rotate": 0.982,
    "mesh": 0.987,
}
PAPER_COMBOS = {1: 0.82, 2: 0.659, 3: 0.808, 4: 0.987}
"""The paper's mAP after the attack, by parameter and by combination."""
PAPER_LPIPS, PAPER_FID = 0.52, 0.10
"""The paper's LPIPS and FID between attacked pictures and photographs; which pictures and networks is not stated."""
PAPER_TRANSFER = (0.9128, 0.875)
"""The paper's mAP of a YOLOv3, trained on KITTI: on benign frames, and on counterexamples against SqueezeDet."""


PAGE = "report.html"
_STUDY, _ARMS = "study.json", "arms"
PICTURES = 200
"""Default number of pictures on a page: 100 frames of one run, 14 to 21 MB for KITTI."""
_STEP_FIELDS = ("steps", "rate", "momentum", "early_stop")
"""Settings of the default method that climb does not have."""
_OMITTED_NEXT = ("json", "resume", "workers")
"""Settings omitted from the command of the next step."""
_OMITTED_SETTINGS = ("out", "json", "resume", "workers")
"""Settings that do not affect the result, omitted from the command line in the report."""
_MAX_LINES = 7
"""Largest number of lines in a chart, as there are that many colours."""
_OBJECT_FIELDS = ("objects", "missed_before", "lost_by_grade")
_GRADE_FIELDS = ("passes", "grades", "kinds", "fidelity", "frames_ungraded", "grade_notes")


def build_reports(config: ReportConfig) -> dict[str, Any]:
    """Write the page of runs, or of the finished arms of studies. Returns the JSON data.

    Raises UsageError or SceneError for bad input.
    """
    folders: list[str] = []
    charts: list[ReportChart] = []
    for given in config.runs:
        folders += [str(folder) for folder in _find_runs(Path(given))]
        if (Path(given) / _STUDY).is_file():
            charts += query_curves(Path(given))
    out = Path(config.out or (Path(config.runs[0]) / PAGE if len(config.runs) == 1 else PAGE))
    if out.is_dir():
        raise UsageError("--out", "an HTML file", f"the folder {out}")
    runs, left_out = load_reported_runs(folders)
    size = write_report(out, runs, config.frames, left_out, charts)
    return _to_json(out, size, runs, left_out)


def _find_runs(folder: Path) -> list[Path]:
    """Return a run, or the finished arms of a study. Raises UsageError if the folder is neither."""
    if not folder.is_dir():
        raise UsageError("RUN", "a folder of drivesem attack or of an experiment", folder)
    if not (folder / _ARMS).is_dir():
        return [folder]
    arms = [
        arm for arm in sorted((folder / _ARMS).iterdir()) if (arm / CONFIG).is_file() and (arm / METRICS).is_file()
    ]
    if not arms:
        raise UsageError("RUN", "a study with a finished arm", folder)
    return arms


def _to_json(out: Path, size: int, runs: Sequence[ReportedRun], left_out: int) -> dict[str, Any]:
    """Return the JSON data; rates are fractions."""
    rows = []
    for one in runs:
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
            "attacked": {one.name: result.attacked for one, result in zip(runs, results, strict=True)},
            "failures": {
                one.name: [f.kind for f in result.failures] for one, result in zip(runs, results, strict=True)
            },
            "kinds": {
                one.name: [f.error for f in result.failures] for one, result in zip(runs, results, strict=True)
            },
            "grades": {
                one.name: [f.grade for f in result.failures] for one, result in zip(runs, results, strict=True)
            },
        }
        for results in zip(*(one.frames for one in runs), strict=True)
    ]
    return {"out": str(out), "bytes": size, "frames_left_out": left_out, "runs": rows, "frames": frames}


def write_run_report(out: Path, config: AttackConfig, summary: RunSummary, results: Sequence[FrameResult]) -> None:
    """Write the report.html of one run.

    Args:
        out: The run's folder.
        config: Its settings.
        summary: Its summary.
        results: Its frames.
    """
    write_report(out / PAGE, [_make_reported_run(out.name, out, config, summary, results)])


def write_report(
    path: Path,
    runs: Sequence[ReportedRun],
    frames: int | None = None,
    left_out: int = 0,
    charts: Sequence[ReportChart] = (),
) -> int:
    """Write the page of runs on the same frames.

    Args:
        path: HTML file.
        runs: The runs.
        frames: Number of frames with pictures, worst first; by default as many as PICTURES allow.
        left_out: Number of frames that not all runs have.
        charts: Further charts.

    Returns:
        Size of the page in bytes.
    """
    gallery = frames or max(PICTURES // (1 + len(runs)), 1)
    page = ReportPage(runs, [*precision_recall(runs), *charts], min(gallery, len(runs[0].frames)), left_out)
    text = render_report(page, path).encode("utf-8")
    files.write_bytes(path, text)
    return len(text)


def load_reported_runs(folders: Sequence[str]) -> tuple[list[ReportedRun], int]:
    """Load finished runs on the frames that they have in common. Returns them, and the number of other frames.

    Summaries are those of metrics.json if all runs have the same frames, and recomputed otherwise. Raises
    UsageError for a folder without a finished run, runs without common frames, and runs on different photographs;
    FormatError for a damaged file.
    """
    loaded = load_runs(folders, setting="RUN")
    names = [{frame.result.identifier for frame in run.frames} for run in loaded]
    shared, every = set.intersection(*names), set.union(*names)
    if not shared:
        raise UsageError("RUN", "runs that share frames", "none that is in all of them")
    reported = []
    for run in loaded:
        results = [frame.result for frame in run.frames if frame.result.identifier in shared]
        config = load_attack_config(run.folder, "RUN")
        rates = {} if config.changes else estimate_rates(results)
        summary = replace(_load_summary(run.folder / METRICS), map=build_map(results), **rates)
        if len(shared) < len(every):
            summary = _recompute_summary(summary, results)
        reported.append(_make_reported_run(run.name, run.folder, config, summary, results))
    _check_photographs(reported)
    return reported, len(every) - len(shared)


def precision_recall(runs: Sequence[ReportedRun]) -> list[ReportChart]:
    """Build the chart of precision over recall of the headline class at IoU 0.5, if it has any object.

    One run is evaluated in both label modes, several runs with moved labels.
    """
    several = len(runs) > 1
    before: dict[str, ChartLine | None] = {}
    after: list[ChartLine | None] = []
    for run in runs:
        detector = run.summary.detector
        if detector not in before:
            name = f"before, {detector}" if several else "before"
            before[detector] = _precision_recall_line(run, "benign", "benign", name)
        after.append(
            _precision_recall_line(
                run, "moved", "attacked", f"{run.name}, after" if several else "after, moved labels"
            )
        )
        if not several:
            after.append(_precision_recall_line(run, "benign", "attacked", "after, benign labels (paper)"))
    changed, unchanged = ([line for line in lines if line is not None] for lines in (after, before.values()))
    if not changed:
        return []
    note = (
        "Best precision at this recall or a higher one, as in AP50. Dots: detections with a score of at least t*."
    )
    room = max(_MAX_LINES - len(unchanged), 1)
    if len(changed) > room:
        note += f" The first {room} of {len(changed)} runs."
    # several runs come first, so that each has one colour in all charts
    lines = [*changed[:room], *unchanged] if several else [*unchanged, *changed]
    headline = runs[0].summary.headline
    title = f"Precision over recall: {headline}, IoU 0.5"
    return [ReportChart(title, "recall, %", "precision, %", lines, note)]


def query_curves(study: Path) -> list[ReportChart]:
    """Build the chart of broken frames over queries, if the study has these curves. Raises FormatError."""
    data = files.read_json(study / _STUDY)
    points = data.get("curves", []) if isinstance(data, dict) else []
    if not points:
        return []
    try:
        # in the order in which the arms' folders are shown
        lines = [_query_line(name, points) for name in sorted({point["name"] for point in points})]
        most = max(int(point["queries"]) for point in points)
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(str(study / _STUDY), "curves of a study", error) from error
    note = "A query is one gradient, or one evaluated render."
    banded = [line.name for line in lines[:_MAX_LINES] if line.band]
    if banded:
        note += f" Band: 95 % bootstrap interval over frames, {banded[0]}."
    if len(lines) > _MAX_LINES:
        note += f" The first {_MAX_LINES} of {len(lines)} arms."
    return [
        ReportChart(
            title="Frames broken by number of queries",
            x_label="queries",
            y_label="frames broken, %",
            lines=lines[:_MAX_LINES],
            note=note,
            x_range=(1.0, float(max(most, 2))),
            log2_x=True,
        )
    ]


def _query_line(name: str, points: Sequence[dict[str, Any]]) -> ChartLine:
    own = [p for p in points if p["name"] == name and p["share"] is not None]
    first = name == points[0]["name"]
    bounded = [p for p in own if first and p["low"] is not None and p["high"] is not None]
    return ChartLine(
        name=name,
        points=tuple((float(p["queries"]), 100 * float(p["share"])) for p in own),
        mark=(float(own[-1]["queries"]), 100 * float(own[-1]["share"])) if own else None,
        band=tuple((float(p["queries"]), 100 * float(p["low"]), 100 * float(p["high"])) for p in bounded),
        steps=True,
    )


def _make_reported_run(
    name: str, folder: Path, config: AttackConfig, summary: RunSummary, results: Sequence[FrameResult]
) -> ReportedRun:
    return ReportedRun(
        name=name,
        folder=folder,
        summary=summary,
        frames=tuple(sorted(results, key=lambda r: r.identifier)),
        method=config.method,
        command=format_command_line("attack", config, _OMITTED_SETTINGS),
        weathers=tuple(_find_weather(r.identifier) for r in sorted(results, key=lambda r: r.identifier)),
        grade_requirements=_grade_requirements(config),
        next_step=describe_next_step(config, replace(summary, out=str(folder))),
        paper=_paper_figure(summary.params) if follows_paper(config) else None,
    )


def describe_next_step(config: AttackConfig, summary: RunSummary) -> str:
    """Describe what to do next after a run: one line with the command.

    Args:
        config: The run's settings.
        summary: Its summary, with its folder.
    """
    out, objects = shlex.quote(summary.out), summary.objects
    if not summary.frames_attacked:
        closer = f"frames with closer {summary.noun}s"
        more = "a detector that finds them, lower --t-star" if objects.judged else closer
        frames = "other frames" if config.limit is None else f"more frames than --limit {config.limit}"
        found = f"{objects.judged} judged, {objects.found_before} found by {summary.detector}"
        return (
            f"nothing to attack: {found}, of {format_count(objects.all, summary.noun)} ({_first_reason(summary)}); "
            f"next: {more}, or {frames}"
        )
    if summary.grades[Grade.CERTAIN]:
        return (
            f"next: drivesem explain {out} (which change causes each failure), drivesem holes {out} "
            f"(where else it fails), drivesem view {out} (in the browser)"
        )
    default = AttackConfig()
    step = replace(config, budget=format_budget(parse_budget(config.budget)), grade=True)
    if config.method == default.method:  # climb looks for failures that hold
        step = replace(step, method="climb", **{name: getattr(default, name) for name in _STEP_FIELDS})
    if "weather" not in summary.params and config.parametrisation == "ground":
        params = ",".join((*summary.params, "weather"))
        why, name, step = "add weather", "weather", replace(step, combo=None, params=params)
    elif step.budget != STREET and config.parametrisation == "ground":
        why, name, step = "widen the budget", STREET, replace(step, budget=STREET)
    else:
        why, name, step = "search longer", "longer", replace(step, passes=2 * (config.passes or Climb().passes))
    command = format_command_line("attack", replace(step, out=f"{summary.out}-{name}"), _OMITTED_NEXT)
    return f"next, {why}: {command}"


def _first_reason(summary: RunSummary) -> str:
    """Return the reason that most frames have for not being attacked."""
    reasons = Counter(summary.frames_not_attacked.values())
    return next((f"{format_count(n, 'frame')}: {reason}" for reason, n in reasons.most_common(1)), "no frame")


def _grade_requirements(config: AttackConfig) -> GradeRequirements:
    rule = CertificateRule(config.draws)
    return GradeRequirements(
        rule.draws, rule.before, rule.after, config.confirm, config.confirm and config.second_detector != "off"
    )


def _paper_figure(params: tuple[str, ...]) -> PaperFigure | None:
    """Return the paper's mAP for the same parameters, if it has one."""
    published = {(str(one),): after for one, after in PAPER_SINGLE.items()}
    published |= {
        tuple(str(p) for p in combo_parameters(number)): PAPER_COMBOS[number] for number in COMBO_NUMBERS
    }
    return PaperFigure(PAPER_BENIGN, published[params]) if params in published else None


def _find_weather(identifier: str) -> str | None:
    """Return Virtual KITTI's weather in a frame's name, if there is one."""
    return next((word for word in identifier.replace("_", "/").split("/") if word in WEATHER_VARIATIONS), None)


def _precision_recall_line(run: ReportedRun, labels: str, seen: str, name: str) -> ChartLine | None:
    summary = run.summary
    classes = _evaluated_classes(summary)
    if summary.headline not in classes.names or not run.frames:
        return None
    attacked = [result for result in run.frames if result.attacked]
    targets, found = targets_and_detections(attacked, classes, labels, seen)
    outcome = MatchedClass.from_frames(targets, found, classes.names.index(summary.headline))
    samples = sampled_curve(outcome.candidates.class_matches(outcome.match, 0))
    if not samples:
        return None
    points = tuple((100 * recall, 100 * precision) for recall, precision, _ in samples)
    above = [i for i, (_, _, score) in enumerate(samples) if score >= summary.t_star]
    return ChartLine(name, points, points[above[-1]] if above else None)


def _evaluated_classes(summary: RunSummary) -> EvaluatedClasses:
    """Return the evaluated classes, without loading the detector."""
    names = tuple(summary.benign.per_class)
    return EvaluatedClasses(names, names)


def _recompute_summary(summary: RunSummary, results: Sequence[FrameResult]) -> RunSummary:
    """Recompute the summary for some of a run's frames."""
    return replace(
        summary, **summarise_frames(results, _evaluated_classes(summary), summary.t_star, summary.headline)
    )


def _load_summary(path: Path) -> RunSummary:
    """Load a summary; the inverse of `RunSummary.to_json`. Raises FormatError for a damaged file."""
    data = files.read_json(path)
    try:
        plain = {
            name: data[name]
            for name in ("out", "dataset", "detector", "headline", "t_star", "frames", "frames_without_vehicles")
        }
        plain |= {name: data[name] for name in ("frames_failed", "frames_not_attacked", *_OBJECT_FIELDS)}
        plain |= {name: data[name] for name in ("successes_paper", "successes_moved")}
        plain |= {name: data[name] for name in ("feasible_fraction", "queries", "seconds")}
        plain |= {"by_class": data.get("by_class", {}), "params": data["params"]} | {
            name: data[name] for name in _GRADE_FIELDS
        }
        plain |= {name: _parse_scores(data[name]) for name in ("benign", "rerendered")}
        plain |= {f"attacked_{mode}": _parse_scores(data["attacked"][mode]) for mode in ("paper", "moved")}
        plain |= {name: data[f"{name}_by_class"] for name in ("lost_objects", "phantoms")}
    except (KeyError, TypeError, AttributeError) as error:
        raise FormatError(str(path), "the metrics of a run", error) from error
    summary: RunSummary = from_json(RunSummary, plain, str(path))
    if summary.headline not in summary.benign.per_class:
        raise FormatError(f"{path}: headline", f"one of {', '.join(summary.benign.per_class)}", summary.headline)
    return summary


def _parse_scores(data: dict[str, Any]) -> dict[str, Any]:
    """Parse scores; the inverse of their `to_json`, as plain objects."""
    others = {name: data[name] for name in ("overall", "per_class")}
    return {"headline": {name: one for name, one in data.items() if name not in others}} | others


def _check_photographs(runs: Sequence[ReportedRun]) -> None:
    """Check that frames of the same name have the same photograph."""
    first, *others = runs
    for result in first.frames:
        expected = _read_photograph(first, result.identifier)
        for run in others:
            if not np.array_equal(expected, _read_photograph(run, result.identifier)):
                found = f"another picture of frame {result.identifier} in {run.folder} than in {first.folder}"
                raise UsageError("RUN", "runs on the same photographs", found)


def _read_photograph(run: ReportedRun, identifier: str) -> np.ndarray:
    return np.frombuffer(files.read_bytes(run.folder / "frames" / identifier / "benign.png"), np.uint8)
