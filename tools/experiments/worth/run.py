"""Information worth of runs, of a table of probabilities, or of the arms of a study, and what detectors gained."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS, Interval
from drivesem.reporting.tables import AnalysisReport, Console, ReportTable
from drivesem.run.finished import AttackRun, load_runs
from drivesem.run.folder import ARMS, CONFIG, HELD_OUT, RETRAINED, resolve_output_folder
from drivesem.run.run_report import PAPER_FID, PAPER_LPIPS
from drivesem.training.retrain import WEIGHTS
from scene_ir import files
from scene_ir.errors import FormatError
from tools.experiments.detection.arms import PLACEBO, RANDOM
from tools.experiments.realism.comparison import FrameRegions, RealismRow, measure_frame, realism_rows
from tools.experiments.realism.metrics import METRICS, load_metrics
from tools.experiments.realism.report import REGION_NAMES, choose_metrics, format_value
from tools.experiments.settings import WorthConfig
from tools.experiments.tables import interval_columns
from tools.experiments.worth.measures import (
    MEMBERSHIPS,
    Integers,
    MembershipPoints,
    WorthSettings,
    information_gain,
    points_from_probabilities,
    realism,
    worth_interval,
)
from tools.experiments.worth.points import (
    PICTURE_NAMES,
    SecondDetector,
    attacked_detector_points,
    choose_distance,
    object_distances,
    realism_weights,
)

_DISTANCES = ("distance", "realism")
"""Columns of a table that are not classes."""
_SUM_TOLERANCE = 1e-3
"""Tolerance of the sum of a point's probabilities: tables are rounded."""
_TEXT_COLUMNS = ("set", "detector", "membership", "realism weight")
_NOTE = (
    "Information worth: entropy of the true label that is left once the report is known; 0: nothing is left. Gain: the "
    "worth under the first detector less that under the second, on the same pictures. In brackets 95 % of the "
    "jackknife over frames, with the bias of few frames removed: a value may lie below its interval."
)


_PAIR = ("benign", "attacked")
_PAPER = {"lpips-alex": PAPER_LPIPS, "fid": PAPER_FID}
"""The paper's values by metric; it does not name LPIPS' network."""
_ARM_TEXT_COLUMNS = ("arm", "where", "detector", "second detector", "membership", "realism weight")
_ARM_NOTE = (
    "Photograph and counterexample: mean over frames, and 95 % of the bootstrap over frames; vehicles: the rectangle "
    "around each before and after. The paper states LPIPS and FID of its pictures, but neither which pictures nor "
    "LPIPS' network; distances by other names are neither, and a Frechet distance of few pictures only ranks. "
    "Information worth: entropy of the true label that is left once the answer of the attacked detector is known, of "
    "the same objects in the photographs and in the counterexamples, with 95 % of the jackknife over frames and the "
    "bias of few frames removed: a value may lie below its interval. Realism weight: less for objects that changed "
    "more, relative to the largest change of all arms. Gain: the worth under that detector less that under the second."
)


@dataclass(frozen=True, slots=True)
class PointSet:
    """A data set under one or two detectors."""

    name: str
    """Name of the data set."""
    first: MembershipPoints
    """Points under the first detector."""
    second: MembershipPoints | None
    """Points under the second one."""


def run_worth(config: WorthConfig) -> AnalysisReport:
    """Compute information worth, and write the report. Raises UsageError or SceneError for bad input."""
    base = math.e if config.base == "e" else _parse_base(config.base)
    first = Path(config.table).parent if config.table is not None else Path(config.study or config.runs[0])
    out = resolve_output_folder(config.out, first / "worth")
    if config.study is not None:
        report = compare_arm_worth(
            config, base, DRAWS if config.bootstrap is None else config.bootstrap, choose_distance(config), out
        )
        report.write()
        return report
    facts: dict[str, Any] = {"base": config.base}
    if config.table is not None:
        point_sets, names = _table_point_sets(
            Path(config.table), None if config.after is None else Path(config.after)
        )
        weighted = [False, True] if any((e.first.realism != 1).any() for e in point_sets) else [False]
        distance = None
    else:
        runs = load_runs(config.runs, config.limit, "RUN")
        distance = choose_distance(config)
        point_sets, names = _run_point_sets(runs, config, distance, out)
        weighted = [False] if distance is None else [False, True]
    facts |= {"distance": distance, "detectors": names}
    settings = [WorthSettings(kind, w, base) for w in weighted for kind in MEMBERSHIPS]
    rows = [
        row for point_set in point_sets for setting in settings for row in _worth_rows(point_set, setting, names)
    ]
    report = AnalysisReport(
        out=out,
        name="worth",
        heading="Information worth",
        data={**facts, "rows": rows},
        csv_tables={"worth": rows},
        tables=[_worth_table(rows)],
        notes=[_NOTE],
        text_columns=_TEXT_COLUMNS,
        json_only=True,
    )
    report.write()
    return report


def _parse_base(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 1):
        raise UsageError("--base", "e, or a number above 1", repr(text))
    return value


def _run_point_sets(
    runs: Sequence[AttackRun], config: WorthConfig, distance: str | None, out: Path
) -> tuple[list[PointSet], list[str]]:
    """Point sets of the photographs and counterexamples of each run, and the names of the detectors."""
    attacked = sorted({one.detector for one in runs})
    if len(attacked) > 1:
        raise UsageError("RUN", "runs against one detector", " and ".join(attacked))
    second = None if config.second is None else SecondDetector(config.second, config, out)
    folder = None if config.weights is None else Path(config.weights)
    measures = {} if distance is None else load_metrics([distance], folder, fetch=False)
    far = [
        [object_distances(f, measure_frame(f, measures) if measures else None, distance or "") for f in one.frames]
        for one in runs
    ]
    rho = realism_weights(far)
    if second is not None:
        second.detect(runs)
    point_sets: list[PointSet] = []
    for one, own in zip(runs, rho, strict=True):
        for picture, name in PICTURE_NAMES.items():
            weights = own if picture == "attacked" else None
            other = None if second is None else second.points(one, picture, weights)
            point_sets.append(
                PointSet(
                    f"{one.name} ({one.params}): {name}", attacked_detector_points(one, picture, weights), other
                )
            )
    return point_sets, attacked if second is None else [*attacked, second.name]


def _table_point_sets(path: Path, after: Path | None) -> tuple[list[PointSet], list[str]]:
    first, classes, labels = _read_table(path)
    second = None
    if after is not None:
        second, other, truth = _read_table(after)
        if other != classes or not np.array_equal(labels, truth):
            raise UsageError("--after", f"the classes and labels of {path.name}, line by line", after)
    return [PointSet(path.stem, first, second)], [path.stem, *([] if after is None else [after.stem])]


def _read_table(path: Path) -> tuple[MembershipPoints, tuple[str, ...], Integers]:
    """Read a CSV file of probabilities: label, a column for each class, and distance or realism if known.

    Raises FormatError naming the line.
    """
    reader = csv.DictReader(io.StringIO(files.read_text(path), newline=""))
    columns = list(reader.fieldnames or ())
    classes = tuple(name for name in columns if name not in ("label", *_DISTANCES))
    if "label" not in columns or not classes or len(set(columns)) < len(columns):
        raise FormatError(str(path), "columns label and one a class", ", ".join(columns) or "nothing")
    if set(_DISTANCES) <= set(columns):
        raise FormatError(str(path), "one of distance and realism", "both")
    probabilities, labels, extra = [], [], []
    for number, line in enumerate(reader, start=2):
        where = f"{path}:{number}"
        if line["label"] not in classes:
            raise FormatError(f"{where}: label", f"one of {', '.join(classes)}", repr(line["label"]))
        labels.append(classes.index(line["label"]))
        probabilities.append([_parse_number(where, name, line) for name in classes])
        if abs(sum(probabilities[-1]) - 1) > _SUM_TOLERANCE:
            raise FormatError(where, "probabilities that add up to 1", f"{sum(probabilities[-1]):.4g}")
        if "realism" in columns:
            extra.append(_parse_number(where, "realism", line))
        elif "distance" in columns:
            extra.append(_parse_number(where, "distance", line, math.inf))
    if not labels:
        raise FormatError(str(path), "a line a point", "none")
    rho = np.array(extra) if extra else None
    if rho is not None and "distance" in columns:
        rho = realism(rho)
    label = np.array(labels, np.int64)
    return points_from_probabilities(np.array(probabilities), label, rho), classes, label


def _parse_number(where: str, name: str, line: Mapping[str, str | None], most: float = 1.0) -> float:
    try:
        value = float(line[name] or "")
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and 0 <= value <= most):
        raise FormatError(
            f"{where}: {name}", "a number in [0, 1]" if most == 1 else "a number of at least 0", repr(line[name])
        )
    return value


def _worth_rows(point_set: PointSet, setting: WorthSettings, names: Sequence[str]) -> list[dict[str, Any]]:
    """Worth under each detector, and the gain."""

    def row(detector: str, what: str, one: Interval) -> dict[str, Any]:
        return {
            "set": point_set.name,
            "detector": detector,
            "membership": setting.kind,
            "realism_weight": setting.weighted,
            "what": what,
            "value": one.value,
            "low": one.low,
            "high": one.high,
            "points": len(point_set.first.label),
        }

    found = [row(names[0], "worth", worth_interval(point_set.first, setting))]
    if point_set.second is not None:
        found.append(row(names[1], "worth", worth_interval(point_set.second, setting)))
        found.append(row(names[1], "gain", information_gain(point_set.first, point_set.second, setting)))
    return found


def _worth_table(rows: Sequence[Mapping[str, Any]]) -> ReportTable:
    columns = ("set", "detector", "membership", "realism weight", "worth", "gain", "points")
    lines = []
    for row in rows:
        value = "-" if row["value"] is None else f"{row['value']:.4f}"
        if row["low"] is not None:
            value += f" ({row['low']:.4f} to {row['high']:.4f})"
        weight = "yes" if row["realism_weight"] else "no"
        cells = (value, "") if row["what"] == "worth" else ("", value)
        lines.append((row["set"], row["detector"], row["membership"], weight, *cells, str(row["points"])))
    return ReportTable("information worth", columns, tuple(lines))


@dataclass(frozen=True, slots=True)
class InformationGain:
    """What a second detector gained on an arm's counterexamples."""

    arm: str
    """Name of the arm."""
    second: str
    """Name of the detector."""
    setting: WorthSettings
    """How worth is computed."""
    worth: Interval
    """Worth under the second detector."""
    gain: Interval
    """Information gain."""

    def to_row(self) -> dict[str, Any]:
        """Numbers by name."""
        row: dict[str, Any] = {"arm": self.arm, "second": self.second}
        row |= {"membership": self.setting.kind, "realism_weight": self.setting.weighted}
        return row | interval_columns("worth", self.worth) | interval_columns("gain", self.gain)


@dataclass(frozen=True, slots=True)
class ArmWorth:
    """Realism and information worth of one arm."""

    run: AttackRun
    """Its run."""
    realism: Sequence[RealismRow]
    """Distances of its photographs and counterexamples."""
    worth: Mapping[tuple[str, WorthSettings], Interval]
    """Worth by picture of PICTURE_NAMES and settings."""
    vehicles: int
    """Number of vehicles."""

    def to_row(self) -> dict[str, Any]:
        """Numbers by name."""
        row: dict[str, Any] = {"arm": self.run.name, "params": self.run.params, "method": self.run.method}
        row |= {"detector": self.run.detector, "frames": len(self.run.frames), "vehicles": self.vehicles}
        for one in self.realism:
            interval = Interval(one.metric, one.value, one.low, one.high)
            row |= interval_columns(f"{REGION_NAMES[one.region]}_{one.metric}", interval)
        for (picture, setting), one in self.worth.items():
            weight = "_by_realism" if setting.weighted else ""
            row |= interval_columns(f"worth_{PICTURE_NAMES[picture]}_{setting.kind}{weight}", one)
        return row


def compare_arm_worth(
    config: WorthConfig, base: float, draws: int, distance: str | None, out: Path
) -> AnalysisReport:
    """The report on the arms of a finished study.

    Args:
        config: Settings, with the folder of the study.
        base: Base of the logarithm.
        draws: Bootstrap draws of frames.
        distance: Distance for realism.
        out: Folder of the report.

    Raises:
        UsageError: A folder that is no finished study.
    """
    study = Path(config.study or "")
    runs = _load_arm_runs(study, config.limit)
    folder = None if config.weights is None else Path(config.weights)
    metrics, absent = choose_metrics(config.metrics, folder, fetch=False)
    measured = [*metrics, *([distance] if distance is not None and distance not in metrics else [])]
    parts = [_measure_run(run, measured, folder) for run in runs]
    far = [
        [object_distances(f, p if distance else None, distance or "") for f, p in zip(run.frames, of, strict=True)]
        for run, of in zip(runs, parts, strict=True)
    ]
    rho = realism_weights(far)
    weights = (False,) if distance is None else (False, True)
    settings = [WorthSettings(kind, w, base) for kind in MEMBERSHIPS for w in weights]
    seconds = _load_second_detectors(config, study, out)
    tested = [run for run in runs if run.name == HELD_OUT or config.second is not None]
    for second in seconds.values():
        second.detect(tested, ["attacked"])
    arms: list[ArmWorth] = []
    gains: list[InformationGain] = []
    for run, own, frames in zip(runs, rho, parts, strict=True):
        points = {
            picture: attacked_detector_points(run, picture, own if picture == "attacked" else None)
            for picture in PICTURE_NAMES
        }
        realism_of_arm = [
            row for row in realism_rows(frames, metrics, draws, config.seed) if (row.first, row.second) == _PAIR
        ]
        # photographs have full realism, and thus no weights
        worth = {
            (picture, setting): worth_interval(points[picture], setting)
            for picture in PICTURE_NAMES
            for setting in settings
            if picture == "attacked" or not setting.weighted
        }
        arms.append(ArmWorth(run, realism_of_arm, worth, sum(len(frame.select("boxes")) for frame in frames)))
        for name, second in seconds.items() if run in tested else ():
            after = second.points(run, "attacked", own)
            gains += [
                InformationGain(
                    run.name,
                    name,
                    one,
                    worth_interval(after, one),
                    information_gain(points["attacked"], after, one),
                )
                for one in settings
            ]
    return _build_arm_report(config, arms, gains, metrics, absent, distance, out)


def _load_arm_runs(study: Path, limit: int | None) -> list[AttackRun]:
    """Runs of the arms that are no controls."""
    settings = files.read_yaml(study / CONFIG) if (study / CONFIG).is_file() else None
    folders = sorted(path for path in (study / ARMS).glob("*") if (path / CONFIG).is_file())
    if not isinstance(settings, dict) or "name" not in settings or not folders:
        raise UsageError("--study", "the folder of a finished study with arms", study)
    runs = [
        run for run in load_runs(list(map(str, folders)), limit, "--study") if run.method not in (RANDOM, PLACEBO)
    ]
    if not runs:
        raise UsageError("--study", "an arm that is no control", study)
    return runs


def _measure_run(run: AttackRun, metrics: Sequence[str], folder: Path | None) -> list[FrameRegions]:
    measures, console = load_metrics(metrics, folder, fetch=False), Console(stderr=True)
    tracked = track(run.frames, run.name, console=console, transient=True, disable=not console.is_terminal)
    return [measure_frame(frame, measures) for frame in tracked]


def _load_second_detectors(config: WorthConfig, study: Path, out: Path) -> dict[str, SecondDetector]:
    """Second detectors by name: --second, or else those that the study retrained."""
    if config.second is not None:
        return {config.second: SecondDetector(config.second, config, out)}
    retrained = sorted((study / RETRAINED).glob(f"*/{WEIGHTS}"))
    return {path.parent.name: SecondDetector(str(path), config, out) for path in retrained}


def _build_arm_report(
    config: WorthConfig,
    arms: Sequence[ArmWorth],
    gains: Sequence[InformationGain],
    metrics: Sequence[str],
    absent: Mapping[str, str],
    distance: str | None,
    out: Path,
) -> AnalysisReport:
    rows, gain_rows = [one.to_row() for one in arms], [one.to_row() for one in gains]
    reference = {"lpips": PAPER_LPIPS, "fid": PAPER_FID}
    data = {"base": config.base, "distance": distance, "reference": reference, "rows": rows, "gains": gain_rows}
    return AnalysisReport(
        out=out,
        name="arms",
        heading="Realism and information worth by arm",
        data=data | {"unavailable": dict(absent)},
        csv_tables={"arms": rows, **({"gains": gain_rows} if gain_rows else {})},
        tables=[_realism_table(arms, metrics), _arm_worth_table(arms), *([_gain_table(gains)] if gains else [])],
        notes=[_ARM_NOTE],
        text_columns=_ARM_TEXT_COLUMNS,
        failed=absent,
        failure_text="left out",
        json_only=True,
    )


def _realism_table(arms: Sequence[ArmWorth], metrics: Sequence[str]) -> ReportTable:
    """The paper's two values stand in their columns, even where we have none."""
    columns = [name for name in METRICS if name in metrics or name in _PAPER]
    lines = []
    for one in arms:
        for region, where in REGION_NAMES.items():
            by_metric = {row.metric: row for row in one.realism if row.region == region}
            cells = (format_value(by_metric[name]) if name in by_metric else "-" for name in columns)
            lines.append((one.run.name, where, *cells))
    theirs = (f"{_PAPER[name]:.2f}" if name in _PAPER else "-" for name in columns)
    lines.append(("the paper", "-", *theirs))
    units = [METRICS[name] for name in columns]
    heads = (f"{metric.name}, {metric.unit}" if metric.unit else metric.name for metric in units)
    return ReportTable("Photograph and counterexample", ("arm", "where", *heads), tuple(lines))


def _arm_worth_table(arms: Sequence[ArmWorth]) -> ReportTable:
    lines, heads = [], []
    for one in arms:
        heads = [
            f"{PICTURE_NAMES[picture]}, {setting.kind}{', realism weight' if setting.weighted else ''}"
            for picture, setting in one.worth
        ]
        detector = Path(one.run.detector)
        name = detector.parent.name if detector.name == WEIGHTS else str(detector)
        lines.append((one.run.name, name, *map(_format_worth, one.worth.values())))
    return ReportTable("Information worth", ("arm", "detector", *heads), tuple(lines))


def _gain_table(gains: Sequence[InformationGain]) -> ReportTable:
    lines = [
        (
            *(one.arm, one.second, one.setting.kind, "yes" if one.setting.weighted else "no"),
            *(_format_worth(one.worth), _format_worth(one.gain)),
        )
        for one in gains
    ]
    columns = ("arm", "second detector", "membership", "realism weight", "worth before it", "gain")
    return ReportTable("Information gain on counterexamples", columns, tuple(lines))


def _format_worth(one: Interval) -> str:
    if one.value is None:
        return "-"
    bounds = "" if one.low is None or one.high is None else f" ({one.low:.4f} to {one.high:.4f})"
    return f"{one.value:.4f}{bounds}"
