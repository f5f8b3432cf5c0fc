"""Draws curves and drops of metrics as inline SVG.

Colours are CSS classes (`s0`, `s1`, ...) for light and dark; dashes distinguish lines without colour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from drivesem.run.report.page import ChartLine, Point, ReportChart

SERIES = 7
"""Colours in the style sheet; further lines repeat them with other dashes."""
_DASHES = ("", "7 4", "2 3", "10 3 2 3")
_WIDTH, _HEIGHT = 560, 340
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 14, 12, 46
_TICK = 20
_ROW_PX, _NAME_LEFT, _BAR_LEFT, _BAR_RIGHT = 46, 6, 60, 60


@dataclass(frozen=True, slots=True)
class MetricDrop:
    """A metric before and after the attack."""

    name: str
    """Label."""
    before: float
    """Value before, percent."""
    after: float
    """Value after, percent."""
    from_paper: bool = False
    """Whether it is the paper's."""


@dataclass(frozen=True, slots=True)
class _ChartAxes:
    """Maps values to px."""

    low: float
    high: float
    doubling: bool

    def x(self, value: float) -> float:
        low, high, value = (
            (math.log2(self.low), math.log2(self.high), math.log2(value))
            if self.doubling
            else (self.low, self.high, value)
        )
        return _LEFT + (value - low) / max(high - low, 1e-9) * (_WIDTH - _LEFT - _RIGHT)

    @staticmethod
    def y(value: float) -> float:
        return _TOP + (100 - value) / 100 * (_HEIGHT - _TOP - _BOTTOM)

    def ticks(self) -> list[float]:
        if self.doubling:
            return [2.0**k for k in range(int(math.log2(self.high)) + 1)]
        return [self.low + (self.high - self.low) * k / 5 for k in range(6)]


def curve_chart(chart: ReportChart) -> Markup:
    """Draw a chart as `<svg>`, with a text alternative."""
    axes = _ChartAxes(*chart.x_range, chart.log2_x)
    parts = [_frame(chart, axes)]
    parts += [_line(line, place, axes) for place, line in reversed(list(enumerate(chart.lines)))]
    text = f"{chart.title}: {chart.y_label} over {chart.x_label}. {_describe_lines(chart.lines)}"
    return Markup(
        f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(text)}">'
        f"{''.join(parts)}</svg>"
    )


def legend_key(place: int) -> Markup:
    """Draw the i-th line's sample in a legend."""
    return Markup(
        f'<svg class="sign" viewBox="0 0 34 10" aria-hidden="true"><path class="line s{place % SERIES}"'
        f'{_dash(place)} d="M1 5H33"/></svg>'
    )


def drop_chart(drops: Sequence[MetricDrop], label: str) -> Markup:
    """Draw a row per metric from before to after on a common scale, percent. label: name of the metric."""
    height = _ROW_PX * len(drops) + 34
    lowest = min([100.0, *(min(f.before, f.after) for f in drops)])
    low = max(0.0, 10 * math.floor((lowest - 5) / 10))
    scale = (_WIDTH - _BAR_LEFT - _BAR_RIGHT) / (100 - low)

    def x(value: float) -> float:
        return _BAR_LEFT + (value - low) * scale

    parts = []
    bottom = _ROW_PX * len(drops)
    step = 10 if low >= 40 else 20
    for tick in range(int(low), 101, step):
        parts.append(
            f'<path class="grid" d="M{x(tick):.1f} 0V{bottom}"/>'
            f'<text class="tick" x="{x(tick):.1f}" y="{bottom + 15}" text-anchor="middle">{tick}</text>'
        )
    parts.append(
        f'<text class="axis" x="{x(100):.1f}" y="{bottom + 31}" text-anchor="end">{escape(label)}, %</text>'
    )
    for row, drop in enumerate(drops):
        y = row * _ROW_PX + 31
        kind = "theirs" if drop.from_paper else "ours"
        # values stand outside the dots, so that they cannot overlap
        side = 1 if drop.after >= drop.before else -1
        ends = ("end", "start") if side < 0 else ("start", "end")
        parts.append(
            f'<text class="name" x="{_NAME_LEFT}" y="{y - 14}">{escape(drop.name)}</text>'
            f'<g class="{kind}"><path class="way" d="M{x(drop.before):.1f} {y}H{x(drop.after):.1f}"/>'
            f'<circle class="from" cx="{x(drop.before):.1f}" cy="{y}" r="5"/>'
            f'<circle class="to" cx="{x(drop.after):.1f}" cy="{y}" r="6"/></g>'
            f'<text class="value" x="{x(drop.before) - side * 10:.1f}" y="{y + 4}" text-anchor="{ends[1]}">'
            f"{drop.before:.1f}</text>"
            f'<text class="value strong" x="{x(drop.after) + side * 11:.1f}" y="{y + 4}" text-anchor="{ends[0]}">'
            f"{drop.after:.1f}</text>"
        )
    text = "; ".join(f"{f.name}: {f.before:.1f} to {f.after:.1f}" for f in drops)
    return Markup(
        f'<svg class="chart falls" viewBox="0 0 {_WIDTH} {height}" role="img" '
        f'aria-label="{escape(f"{label}, percent, before and after. {text}")}">{"".join(parts)}</svg>'
    )


def loss_trace_chart(values: Sequence[float], width: int = 180, height: int = 40) -> Markup:
    """Draw a frame's loss by query.

    Args:
        values: Loss of each query.
        width: Width, px.
        height: Height, px.
    """
    low, high = min(values), max(values)
    places = " ".join(
        f"{4 + (width - 8) * i / max(len(values) - 1, 1):.1f},"
        f"{height - 4 - (height - 8) * (v - low) / max(high - low, 1e-12):.1f}"
        for i, v in enumerate(values)
    )
    text = f"Loss by query: from {values[0]:.3g} to {values[-1]:.3g}, at most {high:.3g}"
    return Markup(
        f'<svg class="trace" viewBox="0 0 {width} {height}" role="img" aria-label="{text}">'
        f'<polyline class="line s0" points="{places}"/></svg>'
    )


def _frame(chart: ReportChart, axes: _ChartAxes) -> str:
    """Draw the grid, ticks and labels of the axes."""
    bottom, right = _HEIGHT - _BOTTOM, _WIDTH - _RIGHT
    parts = []
    for tick in range(0, 101, _TICK):
        y = axes.y(tick)
        parts.append(
            f'<path class="grid" d="M{_LEFT} {y:.1f}H{right}"/>'
            f'<text class="tick" x="{_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{tick}</text>'
        )
    parts += [
        f'<path class="grid" d="M{axes.x(tick):.1f} {_TOP}V{bottom}"/>'
        f'<text class="tick" x="{axes.x(tick):.1f}" y="{bottom + 17}" text-anchor="middle">{tick:g}</text>'
        for tick in axes.ticks()
    ]
    middle = (_TOP + bottom) / 2
    parts.append(
        f'<text class="axis" x="{(_LEFT + right) / 2:.1f}" y="{_HEIGHT - 8}" text-anchor="middle">'
        f"{escape(chart.x_label)}</text>"
        f'<text class="axis" transform="translate(13 {middle:.1f}) rotate(-90)" text-anchor="middle">'
        f"{escape(chart.y_label)}</text>"
    )
    return "".join(parts)


def _line(line: ChartLine, place: int, axes: _ChartAxes) -> str:
    colour = f"s{place % SERIES}"
    parts = []
    if line.band:
        upper = _path([(x, high) for x, _, high in line.band], line.steps, axes)
        lower = _path([(x, low) for x, low, _ in line.band], line.steps, axes)
        back = " ".join(f"L{pair}" for pair in reversed(lower))
        parts.append(f'<path class="band {colour}" d="M{" L".join(upper)} {back}Z"/>')
    if line.points:
        way = " L".join(_path(line.points, line.steps, axes))
        parts.append(f'<path class="line {colour}"{_dash(place)} d="M{way}"/>')
    if line.mark is not None:
        x, y = axes.x(line.mark[0]), axes.y(line.mark[1])
        parts.append(f'<circle class="mark {colour}" cx="{x:.1f}" cy="{y:.1f}" r="5"/>')
    return "".join(parts)


def _path(points: Sequence[Point], steps: bool, axes: _ChartAxes) -> list[str]:
    found: list[str] = []
    for i, (x, y) in enumerate(points):
        if steps and i:
            found.append(f"{axes.x(x):.1f} {axes.y(points[i - 1][1]):.1f}")
        found.append(f"{axes.x(x):.1f} {axes.y(y):.1f}")
    return found


def _dash(place: int) -> str:
    dash = _DASHES[place % len(_DASHES)]
    return f' stroke-dasharray="{dash}"' if dash else ""


def _describe_lines(lines: Sequence[ChartLine]) -> str:
    ends = (
        f"{line.name} ends at {line.points[-1][0]:.0f}, {line.points[-1][1]:.0f}" for line in lines if line.points
    )
    return "; ".join(ends) + "."
