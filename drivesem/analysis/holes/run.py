"""Samples the neighbourhoods of runs' certain failures, and reports the holes that they lie in."""

from __future__ import annotations

import hashlib
import time
from abc import ABC
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from detectors.types import CLASSES
from drivesem.analysis.holes.rules import (
    ContrastSamples,
    FailureKey,
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
from drivesem.run.feature_map import FailureMap
from drivesem.run.finished import AttackRun, RebuiltFrame, RunFrame, load_runs, map_failing_frames, name_frames
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
ChosenObjects = dict[str, set[int]]
"""Objects of a run to sample around, by frame; none in frames that only serve as contrast."""


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
    runs = load_runs(config.runs, setting="RUN")
    out = resolve_output_folder(config.out, runs[0].folder / "holes")
    for run in runs:
        load_trusted_config(run.folder, config.trust, "RUN")  # before anything is written
    claim_folder(out, config, _WRITTEN, _FREE)
    named = name_frames(runs)
    failing = map_failing_frames(named)
    cells = failing.cells_by_failure()
    chosen = _choose_failures(named, cells, config)
    _print_workload(runs, chosen, config)
    frames, failed = analyse_runs(
        [(run, list(chosen[run.name])) for run in runs],
        partial(HolesAnalyser, config, chosen),
        out / "runs",
        config,
        "sampling around failures of",
    )
    failures = {(name, one.index): one for name, frame in frames.items() for one in frame.around}
    with progress_bar(Console(stderr=True), hidden=not failures) as progress:
        rules = fit_rules(frames, progress)
    rules_by_run: dict[str, Rules] = {run.name: {} for run in runs}
    for (name, index), failure in failures.items():
        run, frame = named[name]
        if failure.samples.margins:
            rules_by_run[run.name].setdefault(frame.result.identifier, {})[index] = rules[name, index].where
    passes = sum(frame.passes for frame in frames.values())
    stages = {"fresh": ExtraSamples.fresh(config.samples, config.fresh)}
    if config.recheck is not None:
        stages["rechecks"] = ExtraSamples.recheck(config.recheck)
    samples_by_stage: dict[str, dict[FailureKey, FeatureSamples]] = {}
    for stage, extra in stages.items():
        make = partial(_make_rule_analyser, config, rules_by_run, extra)
        folder = out / stage if stage == "fresh" else out / stage / str(config.recheck)
        tested = [(run, list(rules_by_run[run.name])) for run in runs]
        results, errors = analyse_runs(tested, make, folder, config, "testing rules of")
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
        key: FailureWithRule(failure, rules[key], samples_by_stage["fresh"].get(key, no_samples), cells.get(key))
        for key, failure in failures.items()
    }
    holes = merge_holes(explained, samples_by_stage.get("rechecks"))
    report = build_holes_report(out, holes, failing, facts, failed)
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

    def __init__(
        self, config: HolesConfig, chosen: Mapping[str, ChosenObjects], run: AttackRun, out: Path
    ) -> None:
        super().__init__(config, run, out)
        self.chosen = chosen[run.name]

    def load_result(self, name: str) -> FrameHoles:
        """See `FrameAnalyser`. An earlier call may have sampled around more failures of the frame."""
        result = super().load_result(name)
        return replace(result, around=tuple(one for one in result.around if one.index in self.chosen[name]))

    def is_done(self, name: str) -> bool:
        """See `FrameAnalyser`. An earlier call may have sampled around fewer failures of the frame."""
        return super().is_done(name) and {one.index for one in self.load_result(name).around} == self.chosen[name]

    def analyse(self, name: str, folder: Path) -> FrameHoles:
        """See `FrameAnalyser`."""
        start = time.perf_counter()
        config, frame = self.config, self.load_frame(name)
        around = tuple(
            _sample_failure(failure, neighbourhood, config.samples, config.seed)
            for failure, neighbourhood in frame.neighbourhoods(str(config.seed), config.reach)
            if neighbourhood.index in self.chosen[name]
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


def _choose_failures(
    frames: Mapping[str, tuple[AttackRun, RunFrame]], cells: Mapping[FailureKey, str], config: HolesConfig
) -> dict[str, ChosenObjects]:
    """Choose the failures to sample around, by run. Without --limit, all frames of a run with failures serve as
    contrast, if any is wanted; else the frames of the chosen failures.
    """
    failures = [
        (name, failure.index)
        for name, (_, frame) in frames.items()
        for failure in certain_losses(frame.result)
        if failure.index is not None
    ]
    taken = take_in_turn(failures, cells)[: config.limit]
    runs = {frames[name][0].name for name, _ in taken}
    chosen: dict[str, ChosenObjects] = {run.name: {} for run, _ in frames.values()}
    for name, (run, frame) in frames.items():
        objects = {index for key, index in taken if key == name}
        if objects or (config.limit is None and config.contrast and run.name in runs):
            chosen[run.name][frame.result.identifier] = objects
    return chosen


def take_in_turn(failures: Sequence[FailureKey], cells: Mapping[FailureKey, str]) -> list[FailureKey]:
    """Order failures so that the first ones lie in as many cells as possible: one of each cell, then the second of
    each, and so on; of cells with more failures first. Those without a cell count as one more cell.
    """
    sizes = Counter(cells.get(key) for key in failures)
    seen: Counter[str | None] = Counter()
    turns: dict[FailureKey, tuple[int, int]] = {}
    for key in failures:
        cell = cells.get(key)
        turns[key] = seen[cell], -sizes[cell]
        seen[cell] += 1
    return sorted(failures, key=lambda key: turns[key])


def _print_workload(runs: Sequence[AttackRun], chosen: Mapping[str, ChosenObjects], config: HolesConfig) -> None:
    """Print the number of passes, and the time at the pace of the runs, which is an upper limit: their seconds
    include more than passes.
    """
    count = sum(len(objects) for frames in chosen.values() for objects in frames.values())
    results = [frame.result for run in runs for frame in run.frames if frame.result.passes]
    seconds, passes = sum(r.seconds for r in results), sum(r.passes or 0 for r in results)
    needed = count * (config.samples + config.fresh + (config.recheck or 0))
    needed += config.contrast * sum(map(len, chosen.values()))
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
"""Failures and cells of a hole, and rules of a cell, that a table names; holes.json has all."""
_CELLS_NOTE = (
    "Cells are those of the run's map; a failure lies in the cell of its counterexample. {sampled} of {certain} "
    "were sampled around, in turn from different cells. Rules for {ruled} of {failing}."
)


def build_holes_report(
    out: Path, holes: Sequence[Hole], failing: FailureMap, facts: Mapping[str, Any], failed: Mapping[str, str]
) -> AnalysisReport:
    """Build the report of all frames.

    Args:
        out: Output folder.
        holes: The holes.
        failing: Map of the failing frames.
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
            _shorten([failure.text for failure in hole.failures]),
            _shorten(hole.cells) or "-",
            *((_format_recheck(hole.recheck),) if rechecks else ()),
        )
        for hole in holes
    )
    columns = ("where", "class", "lost, %", "elsewhere, %", "size, %", "failures", "cells")
    columns += ("again, %",) if rechecks else ()
    hold = sum(recheck.holds for recheck in rechecks)
    recheck_notes = (_RECHECK_NOTE.format(hold=hold, count=len(rechecks)),) if rechecks else ()
    title = f"Holes of {facts['detector']}, within {facts['params']}"
    cells = _list_failing_cells(failing, holes)
    cell_map = {"cells": cells, "frames_without_record": failing.frames_without_record}
    return AnalysisReport(
        out=out,
        name="holes",
        heading="Holes",
        data={
            **facts,
            "map": cell_map,
            "rechecked": len(rechecks),
            "hold": hold,
            "holes": [hole.to_json() for hole in holes],
        },
        csv_tables={"holes": [_csv_row(hole) for hole in holes]} if holes else {},
        tables=[ReportTable(title, columns, lines), *([_build_cell_table(cells, holes)] if cells else [])],
        notes=(*_NOTES, _describe_cells(failing, cells, holes), *recheck_notes) if holes else (_NO_FAILURES,),
        text_columns=("where", "class", "failures", "cells", "cell", "rule"),
        picture=partial(plot_holes, holes=holes) if holes else None,
        failed=failed,
    )


def _list_failing_cells(failing: FailureMap, holes: Sequence[Hole]) -> list[dict[str, Any]]:
    """For each failing cell, count its failures and those sampled around, and list the holes of these with a rule."""
    cells = []
    for cell in failing.cells:
        counts = [sum(failure.cell == cell.name for failure in hole.failures) for hole in holes]
        ruled = [number for number, count in enumerate(counts) if count and holes[number].where]
        if cell.certain:
            cells.append({"cell": cell.name, "certain": cell.certain, "sampled": sum(counts), "holes": ruled})
    return cells


def _build_cell_table(cells: Sequence[Mapping[str, Any]], holes: Sequence[Hole]) -> ReportTable:
    rules = (_shorten([holes[number].rule_text for number in cell["holes"]]) for cell in cells)
    lines = tuple(
        (
            cell["cell"],
            str(cell["certain"]),
            str(cell["sampled"]),
            rule or ("no rule found" if cell["sampled"] else "not sampled"),
        )
        for cell, rule in zip(cells, rules, strict=True)
    )
    return ReportTable("Failing cells of the map", ("cell", "certain", "sampled", "rule"), lines)


def _describe_cells(failing: FailureMap, cells: Sequence[Mapping[str, Any]], holes: Sequence[Hole]) -> str:
    certain = sum(cell["certain"] for cell in cells)
    ruled = sum(bool(cell["holes"]) for cell in cells)
    text = _CELLS_NOTE.format(
        sampled=sum(cell["sampled"] for cell in cells),
        certain=format_count(certain, "certain failure"),
        ruled=ruled,
        failing=format_count(len(cells), "failing cell"),
    )
    left_out = failing.frames_without_record
    return (
        f"{text} {format_count(left_out, 'frame')} without a record of the search: in no cell."
        if left_out
        else text
    )


def _shorten(texts: Sequence[str]) -> str:
    """Join the first texts as lines, and count the others."""
    more = len(texts) - _MAX_NAMED
    return "\n".join([*texts[:_MAX_NAMED], *([f"and {more} more"] if more > 0 else [])])


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
        "cells": "; ".join(hole.cells),
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
