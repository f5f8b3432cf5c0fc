"""The arms of a finished study side by side: how real their pictures are, and what these are worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import track

from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import Interval
from drivesem.report.tables import AnalysisReport, ReportTable
from drivesem.report.terminal import Console
from drivesem.run.finished import AttackRun, load_runs
from drivesem.run.folder import ARMS, CONFIG, HELD_OUT, RETRAINED
from drivesem.run.protocol import PAPER_FID, PAPER_LPIPS
from drivesem.training.retraining import WEIGHTS
from scene_ir import files
from tools.experiments.realism.asking import REGION, chosen, shown
from tools.experiments.realism.comparison import FrameParts, RealismRow, frame_parts, rows
from tools.experiments.realism.measures import METRICS, load
from tools.experiments.settings import WorthConfig
from tools.experiments.worth.measures import MEMBERSHIPS, Setting, gain_of, worth_of
from tools.experiments.worth.runs import SHOWN, SecondDetector, distances_of, own_points, realism_of

_CONTROLS = ("random", "placebo")
"""Methods of arms that stand beside others."""
_PAIR = ("benign", "attacked")
_PAPER = {"lpips-alex": PAPER_LPIPS, "fid": PAPER_FID}
"""By metric; the paper does not name LPIPS' network."""
_WORDS = ("arm", "where", "detector", "second detector", "membership", "realism weight")
_NOTE = (
    "Photograph and counterexample: mean over frames, and 95 % of the bootstrap over frames; vehicles: the "
    "rectangle around each before and after. The paper tells LPIPS and FID of its pictures, and neither which "
    "pictures nor LPIPS' network; distances by other names are no LPIPS and no FID, and a Frechet distance of few "
    "pictures only ranks. Information worth: entropy of the true label that is left once the answer of the "
    "attacked detector is known; of the same objects in the photographs and in the counterexamples, with 95 % of "
    "the jackknife over frames, less what few of them make too small: a figure may lie below it. Realism "
    "weight: less for objects that changed more, beside the greatest change of all arms. Gain: the worth before "
    "that detector less that before the second one."
)


@dataclass(frozen=True, slots=True)
class Gain:
    """What a second detector gained on an arm's counterexamples."""

    arm: str
    second: str
    setting: Setting
    worth: Interval
    gain: Interval

    def flat(self) -> dict[str, Any]:
        """Numbers by name."""
        found: dict[str, Any] = {"arm": self.arm, "second": self.second}
        found |= {"membership": self.setting.kind, "realism_weight": self.setting.weighted}
        return found | _bounded("worth", self.worth) | _bounded("gain", self.gain)


@dataclass(frozen=True, slots=True)
class ArmFigures:
    """One arm. realism: of its photographs and counterexamples; worth: by picture of SHOWN and setting."""

    run: AttackRun
    realism: Sequence[RealismRow]
    worth: Mapping[tuple[str, Setting], Interval]
    vehicles: int

    def flat(self) -> dict[str, Any]:
        """Numbers by name."""
        found: dict[str, Any] = {"arm": self.run.name, "params": self.run.params, "method": self.run.method}
        found |= {"detector": self.run.detector, "frames": len(self.run.frames), "vehicles": self.vehicles}
        for row in self.realism:
            one = Interval(row.metric, row.value, row.low, row.high)
            found |= _bounded(f"{REGION[row.region]}_{row.metric}", one)
        for (picture, setting), one in self.worth.items():
            weight = "_by_realism" if setting.weighted else ""
            found |= _bounded(f"worth_{SHOWN[picture]}_{setting.kind}{weight}", one)
        return found


def _bounded(name: str, one: Interval) -> dict[str, float | None]:
    return {name: one.value, f"{name}_low": one.low, f"{name}_high": one.high}


def by_arm(config: WorthConfig, base: float, draws: int, distance: str | None, out: Path) -> AnalysisReport:
    """All that is said of the study's arms. base: of the logarithm; distance: behind realism.

    Raises UsageError for a folder that is none of a finished study.
    """
    study = Path(config.study or "")
    runs = _runs(study, config.limit)
    folder = None if config.weights is None else Path(config.weights)
    metrics, absent = chosen(config.metrics, folder, fetch=False)
    measured = [*metrics, *([distance] if distance is not None and distance not in metrics else [])]
    parts = [_parts(run, measured, folder) for run in runs]
    far = [
        [distances_of(f, p if distance else None, distance or "") for f, p in zip(run.frames, of, strict=True)]
        for run, of in zip(runs, parts, strict=True)
    ]
    rho = realism_of(far)
    weights = (False,) if distance is None else (False, True)
    settings = [Setting(kind, w, base) for kind in MEMBERSHIPS for w in weights]
    seconds = _seconds(config, study, out)
    asked = [run for run in runs if run.name == HELD_OUT or config.second is not None]
    for second in seconds.values():
        second.look(asked, ["attacked"])
    arms: list[ArmFigures] = []
    gains: list[Gain] = []
    for run, own, frames in zip(runs, rho, parts, strict=True):
        points = {picture: own_points(run, picture, own if picture == "attacked" else None) for picture in SHOWN}
        told = [row for row in rows(frames, metrics, draws, config.seed) if (row.first, row.second) == _PAIR]
        # Photographs are as real as can be.
        worth = {
            (picture, setting): worth_of(points[picture], setting)
            for picture in SHOWN
            for setting in settings
            if picture == "attacked" or not setting.weighted
        }
        arms.append(ArmFigures(run, told, worth, sum(len(frame.region("boxes")) for frame in frames)))
        for name, second in seconds.items() if run in asked else ():
            after = second.points(run, "attacked", own)
            gains += [
                Gain(run.name, name, one, worth_of(after, one), gain_of(points["attacked"], after, one))
                for one in settings
            ]
    return _answer(config, arms, gains, metrics, absent, distance, out)


def _runs(study: Path, limit: int | None) -> list[AttackRun]:
    """The arms that are no controls."""
    settings = files.read_yaml(study / CONFIG) if (study / CONFIG).is_file() else None
    folders = sorted(path for path in (study / ARMS).glob("*") if (path / CONFIG).is_file())
    if not isinstance(settings, dict) or "name" not in settings or not folders:
        raise UsageError("--study", "the folder of a finished drivesem study with arms", study)
    runs = [run for run in load_runs(list(map(str, folders)), limit, "--study") if run.method not in _CONTROLS]
    if not runs:
        raise UsageError("--study", "an arm that is no control", study)
    return runs


def _parts(run: AttackRun, metrics: Sequence[str], folder: Path | None) -> list[FrameParts]:
    measures, console = load(metrics, folder, fetch=False), Console(stderr=True)
    looked = track(run.frames, run.name, console=console, transient=True, disable=not console.is_terminal)
    return [frame_parts(frame, measures) for frame in looked]


def _seconds(config: WorthConfig, study: Path, out: Path) -> dict[str, SecondDetector]:
    """By name: --second, or else those that the study retrained."""
    if config.second is not None:
        return {config.second: SecondDetector(config.second, config, out)}
    retrained = sorted((study / RETRAINED).glob(f"*/{WEIGHTS}"))
    return {path.parent.name: SecondDetector(str(path), config, out) for path in retrained}


def _answer(
    config: WorthConfig,
    arms: Sequence[ArmFigures],
    gains: Sequence[Gain],
    metrics: Sequence[str],
    absent: Mapping[str, str],
    distance: str | None,
    out: Path,
) -> AnalysisReport:
    flat, told = [one.flat() for one in arms], [one.flat() for one in gains]
    reference = {"lpips": PAPER_LPIPS, "fid": PAPER_FID}
    data = {"base": config.base, "distance": distance, "reference": reference, "rows": flat, "gains": told}
    return AnalysisReport(
        out=out,
        name="arms",
        heading="Realism and information worth by arm",
        data=data | {"unavailable": dict(absent)},
        csv_tables={"arms": flat, **({"gains": told} if told else {})},
        tables=[_realism(arms, metrics), _worth(arms), *([_gains(gains)] if gains else [])],
        notes=[_NOTE],
        text_columns=_WORDS,
        failed=absent,
        failure_text="left out",
        json_only=True,
    )


def _realism(arms: Sequence[ArmFigures], metrics: Sequence[str]) -> ReportTable:
    """The paper's two figures stand in the columns of their names, also where nothing of ours does."""
    columns = [name for name in METRICS if name in metrics or name in _PAPER]
    lines = []
    for one in arms:
        for region, where in REGION.items():
            by_metric = {row.metric: row for row in one.realism if row.region == region}
            cells = (shown(by_metric[name]) if name in by_metric else "-" for name in columns)
            lines.append((one.run.name, where, *cells))
    theirs = (f"{_PAPER[name]:.2f}" if name in _PAPER else "-" for name in columns)
    lines.append(("the paper", "-", *theirs))
    units = [METRICS[name] for name in columns]
    heads = (f"{metric.name}, {metric.unit}" if metric.unit else metric.name for metric in units)
    return ReportTable("Photograph and counterexample", ("arm", "where", *heads), tuple(lines))


def _worth(arms: Sequence[ArmFigures]) -> ReportTable:
    lines, heads = [], []
    for one in arms:
        heads = [
            f"{SHOWN[picture]}, {setting.kind}{', realism weight' if setting.weighted else ''}"
            for picture, setting in one.worth
        ]
        detector = Path(one.run.detector)
        name = detector.parent.name if detector.name == WEIGHTS else str(detector)
        lines.append((one.run.name, name, *map(_number, one.worth.values())))
    return ReportTable("Information worth", ("arm", "detector", *heads), tuple(lines))


def _gains(gains: Sequence[Gain]) -> ReportTable:
    lines = [
        (
            *(one.arm, one.second, one.setting.kind, "yes" if one.setting.weighted else "no"),
            *(_number(one.worth), _number(one.gain)),
        )
        for one in gains
    ]
    columns = ("arm", "second detector", "membership", "realism weight", "worth before it", "gain")
    return ReportTable("Information gain on counterexamples", columns, tuple(lines))


def _number(one: Interval) -> str:
    if one.value is None:
        return "-"
    bounds = "" if one.low is None or one.high is None else f" ({one.low:.4f} to {one.high:.4f})"
    return f"{one.value:.4f}{bounds}"
