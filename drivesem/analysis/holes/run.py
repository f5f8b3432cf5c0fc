"""Samples the neighbourhoods of runs' certain failures, and reports the holes that they lie in."""

from __future__ import annotations

import hashlib
import time
from abc import ABC
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from detectors.types import CLASSES
from drivesem.analysis.holes.rules import (
    ContrastSamples,
    FailureKey,
    FailureRule,
    FailureSamples,
    FailureWithRule,
    FeatureSamples,
    FrameHoles,
    FrameRuleSamples,
    Hole,
    RuleRecheck,
    fit_rules,
    join_samples,
    merge_holes,
)
from drivesem.attacks.space import parse_params
from drivesem.config.commands import HolesConfig
from drivesem.failures.failure_probability import UnitCubePoint, estimate_failure_probability
from drivesem.failures.neighbourhood import NEAR_REACH, Neighbourhood, ObjectSample, SceneSampler
from drivesem.failures.rules import Floats, Intervals, contains
from drivesem.reporting.plots import PLOT_COLOURS, PLOT_STYLE, write_figure
from drivesem.reporting.tables import AnalysisReport, Console, ReportTable, format_count, progress_bar
from drivesem.run.driver import FrameAnalyser, K, analyse_runs
from drivesem.run.finished import AttackRun, RebuiltFrame, load_runs
from drivesem.run.folder import (
    FRAMES,
    PRESENTATION,
    claim_folder,
    load_run_detector,
    load_trusted_config,
    resolve_output_folder,
)
from drivesem.run.frame import certain_losses
from drivesem.run.results import Failure

_WRITTEN = ("holes.json", "holes.md", "holes.csv", "holes.png", "runs", "fresh", "rechecks")
_FREE = (*PRESENTATION, "runs", "recheck")
_TRIES = 6
"""States tried for each fresh sample inside a rule."""
_RECHECK_TRIES = 20
"""The same for a recheck: a rule may contain as little as a twentieth of the samples it was fitted to."""

Rules = dict[str, dict[int, Intervals]]
"""Rules of a run's failures, by frame and object."""


@dataclass(frozen=True, slots=True)
class ExtraSamples:
    """Which further samples to draw inside each rule."""

    count: int
    """Number of samples."""
    numbers: range
    """Numbers of the states to try."""
    stream: str
    """Suffix of the seed."""
    file: str
    """File of a frame's samples."""

    @classmethod
    def fresh(cls, fitted: int, count: int) -> ExtraSamples:
        """Return the samples that test a rule, which was fitted to the first `fitted` samples."""
        return cls(count, range(fitted, fitted + _TRIES * count), "", "fresh.json")

    @classmethod
    def recheck(cls, count: int) -> ExtraSamples:
        """Return the samples that test a rule's failure rate, by new seeds."""
        return cls(count, range(_RECHECK_TRIES * count), ":recheck", "recheck.json")


def run_holes(config: HolesConfig) -> AnalysisReport:
    """Sample around the certain failures of runs, or resume, and write the report.

    Raises UsageError or SceneError for bad input.
    """
    runs = load_runs(config.runs, config.limit, "RUN")
    out = resolve_output_folder(config.out, runs[0].folder / "holes")
    for run in runs:
        load_trusted_config(run.folder, config.trust, "RUN")  # before anything is written
    claim_folder(out, config, _WRITTEN, _FREE)
    _print_workload(runs, config)
    chosen = [(run, _choose_frames(run, config)) for run in runs]
    title = "sampling around failures of"
    frames, failed = analyse_runs(chosen, partial(HolesAnalyser, config), out / "runs", config, title)
    failures = {(name, one.index): one for name, frame in frames.items() for one in frame.around}
    with progress_bar(Console(stderr=True), hidden=not failures) as progress:
        rules = fit_rules(frames, progress)
    passes = sum(frame.passes for frame in frames.values())
    stages = {"fresh": ExtraSamples.fresh(config.samples, config.fresh)}
    if config.recheck is not None:
        stages["rechecks"] = ExtraSamples.recheck(config.recheck)
    samples_by_stage: dict[str, dict[FailureKey, FeatureSamples]] = {}
    for stage, extra in stages.items():
        prefixes = {run.name: f"{run.name}/" if len(runs) > 1 else "" for run in runs}
        rules_by_run = {run.name: _select_rules(run, prefixes[run.name], rules, failures) for run in runs}
        make = partial(_make_rule_analyser, config, rules_by_run, extra)
        folder = out / stage if stage == "fresh" else out / stage / str(config.recheck)
        chosen = [(run, list(rules_by_run[run.name])) for run in runs]
        results, errors = analyse_runs(chosen, make, folder, config, "testing rules of")
        samples_by_stage[stage] = {
            (name, index): samples
            for name, result in results.items()
            for index, samples in zip(result.indices, result.inside, strict=True)
        }
        passes += sum(result.passes for result in results.values())
        failed |= errors
    facts = {
        "out": str(out),
        "runs": [str(run.folder) for run in runs],
        "detector": runs[0].detector,
        "params": runs[0].params,
        "frames": sum(len(run.frames) for run in runs),
        "failures": len(rules),
        "passes": passes,
        "frames_failed": failed,
    }
    no_samples = FeatureSamples((), (), ())
    explained = {
        key: FailureWithRule(failure, rules[key], samples_by_stage["fresh"].get(key, no_samples))
        for key, failure in failures.items()
    }
    report = build_holes_report(out, merge_holes(explained, samples_by_stage.get("rechecks")), facts, failed)
    report.write()
    return report


class _NeighbourhoodAnalyser(FrameAnalyser[K], ABC):
    """Samples around the certain failures of a run's frames."""

    def __init__(self, config: HolesConfig, run: AttackRun, out: Path) -> None:
        super().__init__(run.folder, out)
        self.config = config
        self.attack, self.params = load_trusted_config(run.folder, config.trust, "RUN"), parse_params(run.params)
        self.detector = load_run_detector(self.attack, config.device, "RUN")

    def load_frame(self, name: str) -> RebuiltFrame:
        """Rebuild a frame of the run."""
        return RebuiltFrame.load(self.run_folder / FRAMES / name, self.attack, self.params, self.detector)


class HolesAnalyser(_NeighbourhoodAnalyser[FrameHoles]):
    """Draws the samples that rules are fitted to."""

    file, kind, schema = "holes.json", FrameHoles, 3

    def analyse(self, name: str, folder: Path) -> FrameHoles:
        """See `FrameAnalyser`."""
        start = time.perf_counter()
        config, frame = self.config, self.load_frame(name)
        around = tuple(
            _sample_failure(failure, neighbourhood, config.samples, config.seed)
            for failure, neighbourhood in frame.neighbourhoods(str(config.seed), config.reach)
        )
        passes = sum(len(one.all_samples().margins) + one.lost.extra_samples for one in around)
        contrast, contrast_passes = _sample_all_objects(frame, config.contrast, config.seed)
        seconds = round(time.perf_counter() - start, 3)
        return FrameHoles(name, self.source_digest(name), around, contrast, passes + contrast_passes, seconds)


class RuleRegionAnalyser(_NeighbourhoodAnalyser[FrameRuleSamples]):
    """Draws further samples inside the rules of a run's failures."""

    kind, schema = FrameRuleSamples, 3

    def __init__(self, config: HolesConfig, run: AttackRun, rules: Rules, extra: ExtraSamples, out: Path) -> None:
        super().__init__(config, run, out)
        self.rules, self.extra, self.file = rules, extra, extra.file

    def analyse(self, name: str, folder: Path) -> FrameRuleSamples:
        """See `FrameAnalyser`."""
        start = time.perf_counter()
        config, extra, rules = self.config, self.extra, self.rules[name]
        inside = {
            neighbourhood.index: _draw_samples(
                neighbourhood, extra.numbers, extra.count, rules[neighbourhood.index]
            )[0]
            for _, neighbourhood in self.load_frame(name).neighbourhoods(
                f"{config.seed}{extra.stream}", config.reach
            )
            if neighbourhood.index in rules
        }
        return FrameRuleSamples(
            identifier=name,
            source=self.source_digest(name),
            indices=tuple(inside),
            inside=tuple(inside.values()),
            passes=sum(len(samples.margins) for samples in inside.values()),
            seconds=round(time.perf_counter() - start, 3),
        )


def _make_rule_analyser(
    config: HolesConfig, rules_by_run: Mapping[str, Rules], extra: ExtraSamples, run: AttackRun, out: Path
) -> RuleRegionAnalyser:
    """Make the analyser of a run. Its folder is named after the rules, as results of other rules do not apply."""
    rules = rules_by_run[run.name]
    digest = hashlib.sha256(repr(sorted(rules.items())).encode()).hexdigest()[:12]
    return RuleRegionAnalyser(config, run, rules, extra, out / digest)


def _choose_frames(run: AttackRun, config: HolesConfig) -> list[str]:
    """Return the frames with certain failures, or all frames if contrast is wanted and any frame has one."""
    with_failures = [f.result.identifier for f in run.frames if certain_losses(f.result)]
    return [f.result.identifier for f in run.frames] if with_failures and config.contrast else with_failures


def _select_rules(
    run: AttackRun,
    prefix: str,
    rules: Mapping[FailureKey, FailureRule],
    failures: Mapping[FailureKey, FailureSamples],
) -> Rules:
    """Select the rules of a run's failures that have samples. prefix: of its frames' names in `rules`."""
    selected: Rules = {}
    names = {prefix + frame.result.identifier: frame.result.identifier for frame in run.frames}
    for key, failure in failures.items():
        if key[0] in names and failure.samples.margins:
            selected.setdefault(names[key[0]], {})[key[1]] = rules[key].where
    return selected


def _print_workload(runs: Sequence[AttackRun], config: HolesConfig) -> None:
    """Print the number of passes, and the time at the pace of the runs, which is an upper limit: their seconds
    include more than passes.
    """
    count = sum(len(certain_losses(frame.result)) for run in runs for frame in run.frames)
    results = [frame.result for run in runs for frame in run.frames if frame.result.passes]
    seconds, passes = sum(r.seconds for r in results), sum(r.passes or 0 for r in results)
    needed = count * (config.samples + config.fresh + (config.recheck or 0))
    needed += config.contrast * sum(len(run.frames) for run in runs) if count else 0
    pace = ""
    if passes and count:
        pace = f", at most {max(needed * seconds / passes / 60, 0.1):.1f} min in one process"
    text = f"{format_count(count, 'certain failure')}, about {format_count(needed, 'pass', 'passes')}{pace}; "
    Console(stderr=True).print(text + "more if losses are rare or rules narrow", soft_wrap=True)


def draw_samples_around(neighbourhood: Neighbourhood, count: int) -> FeatureSamples:
    """Draw samples around a failure, half of them in the whole neighbourhood, half close to the failure."""
    samples, near, _ = _draw_both_halves(neighbourhood, count)
    return join_samples((samples, near))


def _sample_failure(failure: Failure, neighbourhood: Neighbourhood, count: int, seed: int) -> FailureSamples:
    samples, near, states = _draw_both_halves(neighbourhood, count)

    def margin_at(place: Floats, draw: int) -> float | None:
        sample = neighbourhood.sample_at(place, draw)
        return None if sample is None else neighbourhood.margin(sample)

    rng = np.random.default_rng([seed, neighbourhood.index])
    return FailureSamples(
        index=neighbourhood.index,
        label=failure.label,
        error=failure.error or "",
        grade=failure.grade or "",
        samples=samples,
        near=near,
        lost=estimate_failure_probability(states, margin_at, rng),
    )


def _draw_both_halves(
    neighbourhood: Neighbourhood, count: int
) -> tuple[FeatureSamples, FeatureSamples, list[UnitCubePoint]]:
    """Draw samples in the whole neighbourhood, samples close to the failure, and the points of the former."""
    half = count // 2
    samples, states = _draw_samples(neighbourhood, range(half), half, {})
    near, _ = _draw_samples(neighbourhood, range(half, count), count - half, {}, NEAR_REACH)
    return samples, near, states


def _draw_samples(
    neighbourhood: Neighbourhood, numbers: Iterable[int], count: int, where: Intervals, reach: float = 1.0
) -> tuple[FeatureSamples, list[UnitCubePoint]]:
    """Draw samples inside a rule in which the object counts, and evaluate the detector on them.

    Args:
        neighbourhood: Neighbourhood of the failure.
        numbers: Numbers of the states to try.
        count: Largest number of samples.
        where: The rule.
        reach: Share of the neighbourhood's reach.

    Returns:
        The samples, and their points in the unit cube.
    """
    features: list[dict[str, float]] = []
    states: list[UnitCubePoint] = []
    for number in numbers:
        if len(features) == count:
            break
        sample = neighbourhood.sample(number, reach)
        if sample is None:
            continue
        if contains(where, {name: np.array([value]) for name, value in sample.features.items()}, 1)[0]:
            features.append(sample.features)
            margin = neighbourhood.margin(sample)
            states.append(UnitCubePoint(neighbourhood.unit_point(number), number, margin))
    return _tabulate_samples(features, [state.margin for state in states]), states


def _sample_all_objects(frame: RebuiltFrame, count: int, seed: int) -> tuple[tuple[ContrastSamples, ...], int]:
    """Draw samples of all objects of a frame. Returns them by class, and the passes that they took."""
    if not count:
        return (), 0
    name = f"{frame.result.identifier}:{seed}"
    sampler = SceneSampler(frame.objective, frame.feasible, frame.nuisances, name)
    rows: dict[str, list[tuple[int, ObjectSample, float]]] = {}
    passes = 0
    for number in range(count):
        samples = sampler.sample(number)
        passes += bool(samples)
        for index, margin in sampler.margins(samples).items():
            label = CLASSES[int(samples[index].image.targets.labels[index])]
            rows.setdefault(label, []).append((index, samples[index], margin))
    contrast = tuple(
        ContrastSamples(
            label,
            tuple(index for index, _, _ in own),
            _tabulate_samples([sample.features for _, sample, _ in own], [margin for _, _, margin in own]),
        )
        for label, own in rows.items()
    )
    return contrast, passes


def _tabulate_samples(features: Sequence[Mapping[str, float]], margins: Sequence[float]) -> FeatureSamples:
    names = tuple(features[0]) if features else ()
    values = tuple(tuple(round(v, 6) for v in row.values()) for row in features)
    return FeatureSamples(names, values, tuple(round(margin, 6) for margin in margins))


_NO_FAILURES = "These runs have no certain failure of an object: nothing to sample around."
_NOTES = (
    "Lost: share of fresh samples inside the rule in which the object is missed, with its 95 % Wilson interval. "
    "Elsewhere: the same for samples outside the rule. A rule is printed only where both differ beyond their "
    "intervals. Size: share of the whole neighbourhood, that is of what "
    "the run could change, in which the object is lost, inside the rule or not, with a 95 % interval; by subset "
    "simulation if losses are rare. In the neighbourhood of an object, all others stay as found.",
    "Height, width and place are those of the labelled box, lightness and contrast of the picture inside it. A rule "
    "names what separates failures best; the cause may be something that goes along with it.",
)
_RECHECK_NOTE = (
    "Again: the same share among draws with new seeds, independent of the rule and its failure rate. A hole holds "
    "if chance alone may explain the difference of the two shares: its 95 % Newcombe interval contains 0. One in "
    "twenty does not hold although its rate is right. {hold} of {count} hold."
)
_MAX_PLOTTED = 12
"""Holes in the plot; the table has all."""
_MAX_NAMED = 4
"""Failures of a hole that the table names; holes.csv has all."""


def build_holes_report(
    out: Path, holes: Sequence[Hole], facts: Mapping[str, Any], failed: Mapping[str, str]
) -> AnalysisReport:
    """Build the report of all frames.

    Args:
        out: Output folder.
        holes: The holes.
        facts: First entries of the JSON.
        failed: Reasons by frame without samples.
    """
    rechecks = [hole.recheck for hole in holes if hole.recheck is not None]
    lines = tuple(
        (
            hole.rule_text,
            hole.label,
            _format_rate(hole.probability, hole.low, hole.high)
            if hole.where and hole.probability is not None
            else "-",
            "-" if hole.outside is None else f"{100 * hole.outside:.0f}",
            f"{100 * hole.lost.probability:.2g} [{100 * hole.lost.low:.2g}, {100 * hole.lost.high:.2g}]",
            _name_failures(hole),
            *((_format_recheck(hole.recheck),) if rechecks else ()),
        )
        for hole in holes
    )
    columns = ("where", "class", "lost, %", "elsewhere, %", "size, %", "failures")
    columns += ("again, %",) if rechecks else ()
    hold = sum(recheck.holds for recheck in rechecks)
    recheck_notes = (_RECHECK_NOTE.format(hold=hold, count=len(rechecks)),) if rechecks else ()
    title = f"Holes of {facts['detector']}, within {facts['params']}"
    return AnalysisReport(
        out=out,
        name="holes",
        heading="Holes",
        data={**facts, "rechecked": len(rechecks), "hold": hold, "holes": [hole.to_json() for hole in holes]},
        csv_tables={"holes": [_csv_row(hole) for hole in holes]} if holes else {},
        tables=[ReportTable(title, columns, lines)],
        notes=(*_NOTES, *recheck_notes) if holes else (_NO_FAILURES,),
        text_columns=("where", "class", "failures"),
        picture=partial(plot_holes, holes=holes) if holes else None,
        failed=failed,
    )


def _name_failures(hole: Hole) -> str:
    """Name the first failures of a hole, and count the others."""
    texts = [failure.text for failure in hole.failures[:_MAX_NAMED]]
    return "\n".join(texts + ([f"and {more} more"] if (more := len(hole.failures) - _MAX_NAMED) > 0 else []))


def _format_rate(rate: float, low: float | None, high: float | None) -> str:
    ends = ("-" if value is None else f"{100 * value:.0f}" for value in (low, high))
    return f"{100 * rate:.0f} [{', '.join(ends)}]"


def _format_recheck(recheck: RuleRecheck | None) -> str:
    if recheck is None:
        return "-"
    verdict = "holds" if recheck.holds else "does not hold"
    return f"{_format_rate(recheck.probability, *recheck.interval)} {verdict}"


def _csv_row(hole: Hole) -> dict[str, Any]:
    recheck = hole.recheck
    return {
        "where": hole.rule_text,
        "class": hole.label,
        "probability": hole.probability,
        "low": hole.low,
        "high": hole.high,
        "samples": hole.count,
        "again": None if recheck is None else recheck.probability,
        "again_draws": None if recheck is None else recheck.again[1],
        "holds": None if recheck is None else recheck.holds,
        "outside": hole.outside,
        "size": hole.lost.probability,
        "size_low": hole.lost.low,
        "size_high": hole.lost.high,
        "failures": "; ".join(failure.text for failure in hole.failures),
    }


def plot_holes(path: Path, holes: Sequence[Hole]) -> None:
    """Plot the failure rates of the largest holes as bars with intervals, and marks for the rates elsewhere."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    plotted = holes[:_MAX_PLOTTED]
    with mpl.rc_context(dict(PLOT_STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(8.0, 1.9 + 0.5 * len(plotted)), layout="constrained")
        axes = figure.add_subplot()
        inside, elsewhere = "fresh samples inside the rule, 95 % interval", "elsewhere in the neighbourhood"
        everywhere = "no rule: anywhere in the neighbourhood, 95 % interval"
        for i, hole in enumerate(plotted):
            has_rule = bool(hole.where) and hole.probability is not None
            rate, low, high = (
                (hole.probability, hole.low, hole.high)
                if has_rule
                else (hole.lost.probability, hole.lost.low, hole.lost.high)
            )
            colour, label = (PLOT_COLOURS[1], inside) if has_rule else (PLOT_COLOURS[2], everywhere)
            axes.barh([i], [100 * (rate or 0)], color=colour, height=0.6, label=label)
            inside, everywhere = (None, everywhere) if has_rule else (inside, None)  # one entry each in the legend
            axes.plot([100 * (low or 0), 100 * (high or 0)], [i] * 2, color="black", linewidth=1.2)
            if hole.outside is not None:
                rate = 100 * hole.outside
                axes.plot([rate], [i], "D", color=PLOT_COLOURS[0], markersize=6, label=elsewhere, zorder=3)
                elsewhere = None
        labels = [f"{hole.rule_text}\n{format_count(len(hole.failures), 'failure')}" for hole in plotted]
        axes.set_yticks(range(len(plotted)), labels)
        axes.invert_yaxis()
        axes.set(xlim=(0, 102), xlabel="lost, %")
        axes.set_title("Holes, largest first", loc="left", fontsize=11)
        figure.legend(loc="outside lower center", fontsize=9)
        write_figure(path, figure)
