"""What an attack on a classifier leaves behind, as plain dataclasses: written as JSON, read by the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from drivesem.failures.grades import Certificate, Grade, SecondOpinion

SCHEMA = 1


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a network says of one picture. predicted: a class; confidence: its softmax; margin: by how many logits
    the true class is ahead of the best other one.
    """

    predicted: str
    confidence: float
    margin: float


@dataclass(frozen=True, slots=True)
class Likeness:
    """How alike two renderers draw an object. iou: of the pixels that it covers by half at least; colour: mean
    distance in CIE L*a*b* (Delta E of 1976) over the pixels that both cover, at the size that a network sees.
    """

    iou: float
    colour: float


@dataclass(frozen=True, slots=True)
class SecondLook:
    """What a second renderer's pictures of a failure say. before, after: how alike they are to the own ones."""

    agreement: SecondOpinion
    before: Likeness
    after: Likeness


@dataclass(frozen=True, slots=True)
class ClassifiedFrame:
    """One picture of a run. label: the true class; sizes: the largest change of each parameter, in theta's units;
    moved: pose and light by name, as people write them; grade, count: of a failure, see `truth.grades`; None where
    there is none; second: of `classify confirm`. queries: gradients and judged samples; passes: of the network, a
    gradient counted as 3.
    """

    identifier: str
    object: str
    label: str
    view: str
    benign: Verdict
    attacked: Verdict
    grade: str | None
    count: Certificate | None
    sizes: dict[str, float]
    moved: dict[str, str]
    loss_trace: tuple[float, ...]
    queries: int
    passes: int
    seconds: float
    second: SecondLook | None = None

    @property
    def right_before(self) -> bool:
        return self.benign.predicted == self.label

    @property
    def right_after(self) -> bool:
        return self.attacked.predicted == self.label

    def row(self) -> dict[str, Any]:
        """A line of the CSV."""
        data = asdict(self)
        count = self.count or Certificate()
        flat = {key: data[key] for key in ("identifier", "object", "label", "view", "grade", "queries", "passes")}
        for name in ("benign", "attacked"):
            flat |= {f"{name}_{key}": value for key, value in data[name].items()}
        flat |= {"right_before": count.before, "draws_before": count.before_draws}
        flat |= {"wrong_after": count.after, "draws_after": count.after_draws}
        flat |= {"second": self.second.agreement.by if self.second else None}
        return flat | {f"size_{key}": value for key, value in self.sizes.items()} | self.moved


@dataclass(frozen=True, slots=True)
class ClassTally:
    """Pictures of one class. benign, attacked: classified rightly before and after the change; certain, confirmed:
    failures that are at least so sure.
    """

    name: str
    pictures: int
    benign: int
    attacked: int
    certain: int
    confirmed: int = 0

    @property
    def accuracy(self) -> dict[str, float | None]:
        """Before and after the change; None without pictures."""
        counts = {"benign": self.benign, "attacked": self.attacked}
        return {name: count / self.pictures if self.pictures else None for name, count in counts.items()}


@dataclass(frozen=True, slots=True)
class ClassifiedRun:
    """The figures of a run; `to_json` is what `--json` prints. accuracy is the share of all its pictures, that is,
    the mean of classes' accuracies weighed by their sizes, as in the paper.
    """

    out: str
    objects: str
    network: str
    method: str
    params: tuple[str, ...]
    classes: tuple[ClassTally, ...]
    frames_failed: dict[str, str]
    queries: int
    passes: int
    seconds: float

    @classmethod
    def of(cls, frames: Sequence[ClassifiedFrame], classes: Sequence[str], **facts: Any) -> ClassifiedRun:
        """Count frames. facts: the fields that frames do not tell."""
        tallies = []
        for name in classes:
            own = [frame for frame in frames if frame.label == name]
            benign, attacked = (sum(getattr(f, right) for f in own) for right in ("right_before", "right_after"))
            confirmed = sum(frame.grade == Grade.CONFIRMED for frame in own)
            certain = confirmed + sum(frame.grade == Grade.CERTAIN for frame in own)
            tallies.append(ClassTally(name, len(own), benign, attacked, certain, confirmed))
        return cls(
            classes=tuple(tallies),
            queries=sum(frame.queries for frame in frames),
            passes=sum(frame.passes for frame in frames),
            **facts,
        )

    @property
    def whole(self) -> ClassTally:
        """All classes as one."""
        counts = ("pictures", "benign", "attacked", "certain", "confirmed")
        return ClassTally("all", *(sum(getattr(one, name) for one in self.classes) for name in counts))

    @property
    def pictures(self) -> int:
        return self.whole.pictures

    @property
    def grades(self) -> dict[str, int]:
        """How many failures are at least so sure."""
        whole = self.whole
        counts = (whole.benign - whole.attacked, whole.certain, whole.confirmed)
        return dict(zip(map(str, (Grade.THRESHOLD, Grade.CERTAIN, Grade.CONFIRMED)), counts, strict=True))

    def to_json(self) -> dict[str, Any]:
        """A JSON object."""
        accuracy = {name: None if one is None else round(one, 4) for name, one in self.whole.accuracy.items()}
        data = {"schema": SCHEMA, **asdict(self), "pictures": self.pictures}
        return data | {"accuracy": accuracy, "grades": self.grades}
