"""What the page is made of, before it is HTML: runs with their figures, and curves. Nothing here reads a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivesem.failures.grades import AGREEMENT_RULE, Certificate, Grade, Kind, SecondOpinion
from drivesem.run.results import Failure, FrameResult, RunSummary

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """The paper's mAP for the same parameters, fractions of 1: before the change and after it."""

    before: float
    after: float


@dataclass(frozen=True, slots=True)
class ReportedRun:
    """One run of the page. name: unique among them; folder: holds `frames/<name>/`; frames: of all runs the same,
    in one order; summary: of these frames; method: the attack's name; command: what repeats the run; weathers: by
    frame, of data sets that say it; asked: how sure its failures had to be; paper: where the run keeps to the
    paper's protocol, and the paper has the same parameters.
    """

    name: str
    folder: Path
    summary: RunSummary
    frames: tuple[FrameResult, ...]
    method: str
    command: str
    weathers: tuple[str | None, ...]
    grade_requirements: GradeRequirements
    paper: PaperFigure | None = None


@dataclass(frozen=True, slots=True)
class ChartLine:
    """A curve. points: (x, y) by ascending x; mark: a point to be singled out; band: (x, low, high); steps: y
    stays until the next point.
    """

    name: str
    points: tuple[Point, ...]
    mark: Point | None = None
    band: tuple[tuple[float, float, float], ...] = ()
    steps: bool = False


@dataclass(frozen=True, slots=True)
class ReportChart:
    """Curves on one pair of axes, y from 0 to 100. doubling: x is on a scale on which each tick is twice the last;
    note: what the lines and marks mean.
    """

    title: str
    x_label: str
    y_label: str
    lines: Sequence[ChartLine]
    note: str
    x_range: Point = (0.0, 100.0)
    log2_x: bool = False


@dataclass(frozen=True, slots=True)
class ReportPage:
    """A page. runs: at least one; charts: beside the figures; gallery: frames whose pictures are shown, worst
    first; left_out: frames that not every run has.
    """

    runs: Sequence[ReportedRun]
    charts: Sequence[ReportChart]
    gallery: int
    left_out: int = 0


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
    Kind.MISSED: "nothing reports the object",
    Kind.CLASS: "reported as another class only",
    Kind.PLACED: "its own class, but framed badly (IoU 0.1 to 0.5)",
    Kind.TWICE: "found, and reported once more",
    Kind.BACKGROUND: "reported where nothing is",
}
_NO_KIND_MEANS = "found as far as it shows; or reported where something is, or was suspected before"
UNKNOWN = "grades unknown: run of an older version, or without them"
CHANCE = "each of which chance may explain"


@dataclass(frozen=True, slots=True)
class GradeRequirements:
    """What a run asks of its failures. draws: of a certificate, before the change and after it; right, wrong: of
    these, how many it needs; second, peer: whether another renderer and another detector were to be asked.
    """

    format_draws: int
    right: int
    wrong: int
    second: bool
    peer: bool


@dataclass(frozen=True, slots=True)
class GradeRule:
    """A grade in the legend."""

    grade: str
    text: str


@dataclass(frozen=True, slots=True)
class FailureKindRow:
    """A kind in the table of kinds by grade: failures whose highest grade is that, highest first; and all."""

    name: str
    meaning: str
    counts: tuple[int, ...]

    @property
    def total(self) -> int:
        return sum(self.counts)


def grade_rank(failure: Failure) -> int:
    """Of its grade, to sort by: 0 unknown, or none of a kind; 1 threshold, ... 4 shared."""
    if failure.grade is None or (failure.error is None and failure.grade == Grade.THRESHOLD):
        return 0
    return 1 + list(Grade).index(Grade(failure.grade))


def is_certain(failure: Failure) -> bool:
    """Whether it is certain, or more than that."""
    return grade_rank(failure) > rank_of_grade(Grade.THRESHOLD)


def rank_of_grade(grade: Grade) -> int:
    """As of `rank`."""
    return 1 + list(Grade).index(grade)


def highest_grade(summary: RunSummary) -> Grade | None:
    """The highest grade above the threshold's that a failure of a run has."""
    return next((g for g in reversed(Grade) if g is not Grade.THRESHOLD and summary.grades[str(g)]), None)


def is_known(summary: RunSummary, frames: Sequence[FrameResult]) -> bool:
    """Whether the grade of any failure is known; a run without failures leaves nothing to ask."""
    failures = [failure for result in frames for failure in result.failures]
    return not failures or any(failure.grade is not None for failure in failures)


def describe_failure(failure: Failure) -> str:
    """Kind and class: `Car missed`, `phantom Car`."""
    if failure.error is not None:
        return f"{failure.label} {KINDS[Kind(failure.error)]}"
    if failure.grade is None:
        return f"{failure.kind} {failure.label}"
    # By threshold a failure, and of no kind.
    excuse = ", found as far as it shows" if failure.kind == "lost" else " where something is"
    return f"{failure.kind} {failure.label}{excuse}"


def format_draws(failure: Failure) -> str:
    """`found in 16/16 draws before → 1/16 after`; "" without a certificate."""
    count = failure.count
    if count is None or not count.after_draws:
        return ""
    word, right = _word(failure.error)
    after = count.after_draws - count.after if right else count.after
    told = f"{after}/{count.after_draws}"
    if not count.before_draws:  # so seldom after the change that nobody looked before it
        return f"{word} {told} draws after"
    before = count.before if right else count.before_draws - count.before
    return f"{word} {before}/{count.before_draws} draws before → {told} after"


def format_margins(count: Certificate | None) -> str:
    """`+1.42 → −0.61`, logits; "" where there are none."""
    if count is None or count.margin_before is None or count.margin_after is None:
        return ""
    return " → ".join(f"{value:+.2f}".replace("-", "−") for value in (count.margin_before, count.margin_after))


def format_second_opinion(failure: Failure, agreement: SecondOpinion | None) -> str:
    """`generator agrees: found in 4/4 → 0/4`; "" where nobody was asked."""
    if agreement is None:
        return ""
    word, right = _word(failure.error)
    before, after, of = agreement.before, agreement.draws - agreement.after, agreement.draws
    if not right:
        before, after = agreement.draws - agreement.before, agreement.after
    verdict = "agrees" if agreement.agrees else "does not agree"
    return f"{agreement.by} {verdict}: {word} {before}/{of} → {after}/{of}"


def _word(error: str | None) -> tuple[str, bool]:
    """What draws are counted by; whether that is right."""
    if error == Kind.BACKGROUND:
        return "there in", False
    return ("reported twice in", False) if error == Kind.TWICE else ("found in", True)


def tabulate_kinds(frames: Sequence[FrameResult]) -> list[FailureKindRow]:
    """Kinds by highest grade, those that occur; a last row of what is none of a kind."""
    failures = [failure for result in frames for failure in result.failures if failure.grade is not None]
    rows = [
        FailureKindRow(name, meaning, _counts([f for f in failures if f.error == kind]))
        for kind, name, meaning in (
            *((kind, KINDS[kind], _MEANINGS[kind]) for kind in Kind),
            (None, NO_KIND, _NO_KIND_MEANS),
        )
    ]
    return [row for row in rows if row.total]


def _counts(failures: Sequence[Failure]) -> tuple[int, ...]:
    return tuple(sum(f.grade == grade for f in failures) for grade in reversed(Grade))


def build_grade_rules(asked: GradeRequirements) -> list[GradeRule]:
    """The legend, highest grade first."""
    needed, of = AGREEMENT_RULE
    no = " Not asked in this run."
    return [
        GradeRule(
            Grade.SHARED,
            f"Confirmed, and a detector of another architecture fails too ({needed} of {of} draws), one that is "
            f"right under a random change as large.{'' if asked.second and asked.peer else no}",
        ),
        GradeRule(
            Grade.CONFIRMED,
            f"Certain, and so it is when a second renderer draws the scene: right before, wrong after in {needed} "
            f"of {of} draws.{'' if asked.second else no}",
        ),
        GradeRule(
            Grade.CERTAIN,
            "The scene is photographed again and again, each time shifted, blurred, lit and placed a little "
            f"otherwise, as never during the search: right in {asked.right} of {asked.draws} draws or more before "
            f"the change, wrong in {asked.wrong} of {asked.draws} or more after it.",
        ),
        GradeRule(
            Grade.THRESHOLD,
            "Right in one picture, wrong in another. A shift of a few pixels may do the same: chance may "
            "explain it.",
        ),
    ]


def summarise_kinds(failures: Sequence[Failure]) -> str:
    """`4 missed, 1 on nothing`, of failures."""
    named = [(KINDS[kind], sum(f.error == kind for f in failures)) for kind in Kind]
    named.append((NO_KIND, sum(f.error is None for f in failures)))
    return ", ".join(f"{count} {name}" for name, count in named if count)
