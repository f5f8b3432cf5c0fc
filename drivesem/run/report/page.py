"""Contents of the report page: runs, charts, and descriptions of kinds and grades. Reads no files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivesem.failures.grades import AGREEMENT_RULE, Certificate, Grade, Kind, SecondOpinion
from drivesem.run.results import Failure, FrameResult, RunSummary

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
    """Failures of one kind."""

    name: str
    """The kind."""
    meaning: str
    """Its meaning."""
    counts: tuple[int, ...]
    """Number of failures by highest grade, highest first."""

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


def format_draws(failure: Failure) -> str:
    """Format draws: `found in 16/16 draws before → 1/16 after`; "" without a certificate."""
    count = failure.count
    if count is None or not count.after_draws:
        return ""
    word, right = _draw_verb(failure.error)
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
    """Format a second opinion: `generator agrees: found in 4/4 → 0/4`; "" without one."""
    if agreement is None:
        return ""
    word, right = _draw_verb(failure.error)
    before, after, of = agreement.before, agreement.draws - agreement.after, agreement.draws
    if not right:
        before, after = agreement.draws - agreement.before, agreement.after
    verdict = "agrees" if agreement.agrees else "does not agree"
    return f"{agreement.by} {verdict}: {word} {before}/{of} → {after}/{of}"


def _draw_verb(error: str | None) -> tuple[str, bool]:
    """Return the verb that draws are counted by, and whether it describes a correct detection."""
    if error == Kind.BACKGROUND:
        return "there in", False
    return ("reported twice in", False) if error == Kind.TWICE else ("found in", True)


def tabulate_kinds(frames: Sequence[FrameResult]) -> list[FailureKindRow]:
    """Tabulate failures by kind and highest grade, followed by those of no kind."""
    failures = [failure for result in frames for failure in result.failures if failure.grade is not None]
    rows = [
        FailureKindRow(name, meaning, _count_by_grade([f for f in failures if f.error == kind]))
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
            "same effect.",
        ),
    ]


def summarise_kinds(failures: Sequence[Failure]) -> str:
    """Summarise failures by kind: `4 missed, 1 on nothing`."""
    named = [(KINDS[kind], sum(f.error == kind for f in failures)) for kind in Kind]
    named.append((NO_KIND, sum(f.error is None for f in failures)))
    return ", ".join(f"{count} {name}" for name, count in named if count)
