"""Plots of the experiment `reality`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drivesem.evaluation.resampling import Interval
from drivesem.reporting.plots import PLOT_COLOURS, PLOT_STYLE, write_figure
from tools.experiments.reality.losses import Losses
from tools.experiments.reality.observations import PREDICTED
from tools.experiments.reality.rules import RuleLift

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MARKERS = "osD^vP"


def _create(width: float, height: float, columns: int = 1, rows: int = 1) -> tuple[Figure, list[Axes]]:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(dict(PLOT_STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(width, height), layout="constrained")
        axes = [figure.add_subplot(rows, columns, i + 1) for i in range(rows * columns)]
    return figure, axes


def plot_losses(path: Path, losses: Losses) -> None:
    """Plot real losses over predicted ones: colours are conditions, markers detectors."""
    figure, axes = _create(9.5, 4.9, 2)
    detectors = list(dict.fromkeys(point.detector for point in losses.points))
    ends = 100 * np.array([losses.real[0], losses.drawn[0], losses.placebo[0]])
    low, high = float(np.nanmin(ends)) - 4, float(np.nanmax(ends)) + 4
    for one, title, predicted in zip(
        axes, ("drawn weather", "placebo of the same size"), (losses.drawn, losses.placebo), strict=True
    ):
        one.plot([low, high], [low, high], color="#999999", linewidth=1)
        one.axhline(0, color="#999999", linewidth=0.6)
        one.axvline(0, color="#999999", linewidth=0.6)
        for i, point in enumerate(losses.points):
            one.plot(
                [100 * predicted[0, i]],
                [100 * losses.real[0, i]],
                _MARKERS[detectors.index(point.detector) % len(_MARKERS)],
                color=PLOT_COLOURS[PREDICTED.index(point.condition)],
                markersize=4 + 2 * (point.heights_px[0] >= 48) + 2 * (point.heights_px[0] >= 96),
                alpha=0.8,
            )
        one.set(
            xlim=(low, high), ylim=(low, high), xlabel=f"loss under {title}, points", ylabel="real loss, points"
        )
    for i, name in enumerate(PREDICTED):
        axes[0].plot([], [], "o", color=PLOT_COLOURS[i], label=name)
    for i, name in enumerate(detectors):
        axes[0].plot([], [], _MARKERS[i % len(_MARKERS)], color="#666666", label=name)
    figure.legend(loc="outside lower center", ncols=4, fontsize=9)
    write_figure(path, figure)


def plot_lifts(path: Path, names: Sequence[str], rules: Sequence[RuleLift], placebos: Sequence[RuleLift]) -> None:
    """Plot the lifts of rules and of their placebos with intervals, one below the other."""
    figure, (axes,) = _create(9.0, 1.4 + 0.5 * len(names))
    for lifts, shift, colour, marker, label in (
        (rules, -0.14, PLOT_COLOURS[0], "o", "rule"),
        (placebos, 0.14, PLOT_COLOURS[1], "s", "placebo: random box of the same size"),
    ):
        for i, one in enumerate(lifts):
            if one.lift.value is None:
                continue
            ends = [one.lift.low or one.lift.value, one.lift.high or one.lift.value]
            axes.plot(ends, [i + shift] * 2, color=colour, linewidth=1.4)
            axes.plot([one.lift.value], [i + shift], marker, color=colour, markersize=5)
        axes.plot([], [], marker, color=colour, label=label)
    axes.axvline(1, color="#444444", linewidth=0.9)
    axes.set_xscale("log")
    axes.set_xticks([0.25, 0.5, 1, 2, 4], ["0.25", "0.5", "1", "2", "4"])
    axes.minorticks_off()
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("misses inside over misses of matched vehicles outside, 95 % interval")
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    write_figure(path, figure)


def plot_retraining(
    path: Path, detectors: Mapping[str, Mapping[str, Mapping[str, Interval]]], titles: Mapping[str, str]
) -> None:
    """Plot average precisions with intervals by set of frames and arm, a panel for each detector."""
    figure, panels = _create(9.0, 1.0 + 3.2 * len(detectors), rows=len(detectors))
    for axes, (detector, arms) in zip(panels, detectors.items(), strict=True):
        sets = list(next(iter(arms.values())))
        for k, (arm, values) in enumerate(arms.items()):
            place = np.arange(len(sets)) + 0.13 * (k - (len(arms) - 1) / 2)
            for x, name in zip(place, sets, strict=True):
                one = values[name]
                if one.value is not None and one.low is not None and one.high is not None:
                    axes.plot([x, x], [100 * one.low, 100 * one.high], color=PLOT_COLOURS[k], linewidth=1.4)
                    axes.plot([x], [100 * one.value], "o", color=PLOT_COLOURS[k], markersize=5)
            if axes is panels[0]:
                axes.plot([], [], "o", color=PLOT_COLOURS[k], label=titles[arm])
        axes.set_xticks(range(len(sets)), sets)
        axes.set_ylabel("AP50 of cars, %")
        axes.set_title(detector, fontsize=10)
    figure.legend(loc="outside lower center", ncols=5, fontsize=9)
    write_figure(path, figure)
