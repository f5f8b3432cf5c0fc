"""Contents of the report page: runs, charts as inline SVG, and descriptions of kinds and grades. Reads no files.

Colours are CSS classes (`s0`, `s1`, ...) for light and dark; dashes distinguish lines without colour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup, escape

from drivesem.failures.grades import AGREEMENT_RULE, Certificate, Grade, Kind, SecondOpinion, draw_verb
from drivesem.reporting.tables import format_count
from drivesem.run.results import Failure, FrameResult, RunSummary

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


Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """The paper's mAP for the same parameters."""

    before: float
    """Before the attack, in [0, 1]."""
    after: float
    """After the attack."""


@dataclass(frozen=True, slots=True)
class ReportedRun:
    """A run on the page."""

    name: str
    """Unique name."""
    folder: Path
    """Folder of the run."""
    summary: RunSummary
    """Summary of `frames`."""
    frames: tuple[FrameResult, ...]
    """Frames, the same and in the same order for all runs."""
    method: str
    """Search method."""
    command: str
    """Command that repeats the run."""
    weathers: tuple[str | None, ...]
    """Weather of each frame, if known."""
    grade_requirements: GradeRequirements
    """Requirements of the grades."""
    next_step: str
    """What to do next, with the command."""
    paper: PaperFigure | None = None
    """The paper's mAP, if the run follows its protocol."""


@dataclass(frozen=True, slots=True)
class ChartLine:
    """A curve."""

    name: str
    """Label."""
    points: tuple[Point, ...]
    """Points (x, y) by ascending x."""
    mark: Point | None = None
    """Highlighted point."""
    band: tuple[tuple[float, float, float], ...] = ()
    """Band (x, low, high)."""
    steps: bool = False
    """Whether y stays until the next point."""


@dataclass(frozen=True, slots=True)
class ReportChart:
    """Curves in one coordinate system, y from 0 to 100."""

    title: str
    """Title."""
    x_label: str
    """Label of the x axis."""
    y_label: str
    """Label of the y axis."""
    lines: Sequence[ChartLine]
    """The curves."""
    note: str
    """Explanation of lines and marks."""
    x_range: Point = (0.0, 100.0)
    """Range of x."""
    log2_x: bool = False
    """Whether the x axis is logarithmic, base 2."""


@dataclass(frozen=True, slots=True)
class ReportPage:
    """The page."""

    runs: Sequence[ReportedRun]
    """At least one run."""
    charts: Sequence[ReportChart]
    """Charts below the metrics."""
    gallery: int
    """Number of frames with pictures."""
    left_out: int = 0
    """Number of frames that not all runs have."""


KINDS = {
    Kind.MISSED: "missed",
    Kind.CLASS: "wrong class",
    Kind.PLACED: "badly placed",
    Kind.TWICE: "found twice",
    Kind.BACKGROUND: "on nothing",
}
"""Short names for people."""
NO_KIND = "none of a kind"
_MEANINGS = {
    Kind.MISSED: "no detection of the object",
    Kind.CLASS: "detected as another class only",
    Kind.PLACED: "correct class, but a poor box (IoU 0.1 to 0.5)",
    Kind.TWICE: "detected, and reported once more",
    Kind.BACKGROUND: "a detection where nothing is",
}
_NO_KIND_MEANING = "detected as far as visible; or a detection on an object, or suspected before"
UNKNOWN = "the failures of this run are not graded"
CHANCE = "which chance may explain"


@dataclass(frozen=True, slots=True)
class GradeRequirements:
    """Requirements of the grades of a run."""

    draws: int
    """Draws before and after the change."""
    right: int
    """Least number of correct draws before it."""
    wrong: int
    """Least number of failing draws after it."""
    second: bool
    """Whether a second renderer was used."""
    peer: bool
    """Whether a second detector was used."""


@dataclass(frozen=True, slots=True)
class GradeRule:
    """A grade in the legend."""

    grade: str
    """The grade."""
    text: str
    """Its meaning."""


@dataclass(frozen=True, slots=True)
class FailureKindRow:
    """Failures of one kind, in one class or in all."""

    name: str
    """The kind."""
    meaning: str
    """Its meaning."""
    counts: tuple[int, ...]
    """Number of failures by highest grade, highest first."""
    label: str = ""
    """The class; empty: all classes."""

    @property
    def total(self) -> int:
        """Number of failures."""
        return sum(self.counts)


def grade_rank(failure: Failure) -> int:
    """Rank a failure by its grade: 0 ungraded or of no kind, 1 threshold, ... 4 shared."""
    if failure.grade is None or (failure.error is None and failure.grade == Grade.THRESHOLD):
        return 0
    return 1 + list(Grade).index(Grade(failure.grade))


def is_certain(failure: Failure) -> bool:
    """Whether a failure is at least certain."""
    return grade_rank(failure) > rank_of_grade(Grade.THRESHOLD)


def rank_of_grade(grade: Grade) -> int:
    """Return the rank of a grade (`grade_rank`)."""
    return 1 + list(Grade).index(grade)


def highest_grade(summary: RunSummary) -> Grade | None:
    """Return the highest grade of a run's failures above the threshold's, if there is one."""
    return next((g for g in reversed(Grade) if g is not Grade.THRESHOLD and summary.grades[str(g)]), None)


def is_known(summary: RunSummary, frames: Sequence[FrameResult]) -> bool:
    """Whether any failure is graded, or there is none."""
    failures = [failure for result in frames for failure in result.failures]
    return not failures or any(failure.grade is not None for failure in failures)


def describe_failure(failure: Failure) -> str:
    """Describe a failure by kind and class: `Car missed`, `phantom Car`."""
    if failure.error is not None:
        return f"{failure.label} {KINDS[Kind(failure.error)]}"
    if failure.grade is None:
        return f"{failure.kind} {failure.label}"
    # a failure by threshold, but of no kind
    excuse = ", detected as far as visible" if failure.kind == "lost" else " on an object"
    return f"{failure.kind} {failure.label}{excuse}"


def name_failure(failure: Failure) -> str:
    """Name a failure and its object: `Car missed, object 6`."""
    return describe_failure(failure) + ("" if failure.index is None else f", object {failure.index}")


def format_grade(failure: Failure) -> str:
    """Format the grade: `certain`, `threshold, picture not trusted`, or `not graded`."""
    grade = failure.grade or "not graded"
    return grade if failure.is_trusted else f"{grade}, picture not trusted"


def format_evidence(failure: Failure) -> str:
    """Format draws and, where it is too low, the fidelity of the picture; "" without a certificate."""
    fidelity = failure.fidelity
    parts = (format_draws(failure), "" if fidelity is None or fidelity.is_trusted else fidelity.describe())
    return "; ".join(filter(None, parts))


def format_draws(failure: Failure) -> str:
    """Format draws: `found in 16/16 draws before → 1/16 after`; "" without a certificate."""
    count = failure.count
    if count is None or not count.after_draws:
        return ""
    word, right = draw_verb(failure.error)
    after = count.after_draws - count.after if right else count.after
    after_text = f"{after}/{count.after_draws}"
    if not count.before_draws:  # too few after the change for draws before it
        return f"{word} {after_text} draws after"
    before = count.before if right else count.before_draws - count.before
    return f"{word} {before}/{count.before_draws} draws before → {after_text} after"


def format_margins(count: Certificate | None) -> str:
    """Format margins in logits: `+1.42 → −0.61`; "" if there are none."""
    if count is None or count.margin_before is None or count.margin_after is None:
        return ""
    return " → ".join(f"{value:+.2f}".replace("-", "−") for value in (count.margin_before, count.margin_after))


def format_second_opinion(failure: Failure, agreement: SecondOpinion | None) -> str:
    """Format a second opinion (`SecondOpinion.describe`); "" without one."""
    return "" if agreement is None else agreement.describe(failure.error)


def tabulate_kinds(frames: Sequence[FrameResult], labels: Sequence[str] = ("",)) -> list[FailureKindRow]:
    """Tabulate failures by kind and highest grade, followed by those of no kind.

    Args:
        frames: Frames of a run.
        labels: Classes to tabulate one after the other; "" stands for all together.
    """
    failures = [failure for result in frames for failure in result.failures if failure.grade is not None]
    rows = [
        FailureKindRow(
            name,
            meaning,
            _count_by_grade([f for f in failures if f.error == kind and label in ("", f.label)]),
            label,
        )
        for label in labels
        for kind, name, meaning in (
            *((kind, KINDS[kind], _MEANINGS[kind]) for kind in Kind),
            (None, NO_KIND, _NO_KIND_MEANING),
        )
    ]
    return [row for row in rows if row.total]


def _count_by_grade(failures: Sequence[Failure]) -> tuple[int, ...]:
    return tuple(sum(f.grade == grade for f in failures) for grade in reversed(Grade))


def build_grade_rules(requirements: GradeRequirements) -> list[GradeRule]:
    """Build the legend of grades, highest first."""
    needed, of = AGREEMENT_RULE
    not_tested = " Not tested in this run."
    no_peer = "" if requirements.second and requirements.peer else not_tested
    return [
        GradeRule(
            Grade.SHARED,
            f"Confirmed, and a detector of another architecture also fails ({needed} of {of} draws), although it "
            f"is right after a random change of the same size.{no_peer}",
        ),
        GradeRule(
            Grade.CONFIRMED,
            f"Certain, and also a failure when a second renderer renders the scene: right before, wrong after in "
            f"{needed} of {of} draws.{'' if requirements.second else not_tested}",
        ),
        GradeRule(
            Grade.CERTAIN,
            "The scene is rendered again and again with small random shifts, blur, light and poses that the "
            "search "
            f"never saw: right in {requirements.right} of {requirements.draws} draws or more before "
            f"the change, wrong in {requirements.wrong} of {requirements.draws} or more after it.",
        ),
        GradeRule(
            Grade.THRESHOLD,
            "Right in one picture, wrong in another. Chance may explain it: a shift of a few pixels can have the "
            "same effect. A failure in a picture that is not trusted gets no higher grade.",
        ),
    ]


def describe_frames(summary: RunSummary) -> str:
    """Describe frames: `3 frames: 2 attacked, 1 not attacked (no vehicle judged and found before)`."""
    text, left = format_count(summary.frames, "frame"), len(summary.frames_not_attacked)
    if not left:
        return f"{text} attacked"
    reason = f"no {summary.noun} judged and found before"
    return f"{text}: {summary.frames_attacked} attacked, {left} not attacked ({reason})"


def describe_objects(summary: RunSummary) -> str:
    """Describe vehicles: `26 vehicles: 13 judged, 8 found before the attack`."""
    objects = summary.objects
    text = (
        f"{format_count(objects.all, summary.noun)}: {objects.judged} judged, {objects.found_before} found before"
    )
    return f"{text} the attack"


def summarise_kinds(failures: Sequence[Failure]) -> str:
    """Summarise failures by kind: `4 missed, 1 on nothing`."""
    named = [(KINDS[kind], sum(f.error == kind for f in failures)) for kind in Kind]
    named.append((NO_KIND, sum(f.error is None for f in failures)))
    return ", ".join(f"{count} {name}" for name, count in named if count)
