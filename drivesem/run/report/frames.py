"""A frame as the page shows it: pictures, boxes, what failed, what changed. Boxes are px of the run's pictures."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from drivesem.report.tables import format_count
from drivesem.run.report import page as grading
from drivesem.run.report.page import ReportedRun
from drivesem.run.results import BoxRecord, Coordinate, Failure, FrameResult
from scene_ir import files
from scene_ir.errors import FormatError

if TYPE_CHECKING:
    from PIL.Image import Image

QUALITIES = (82, 74, 66, 58)
"""Of WebP, the best that keeps a frame's photograph small enough; all pictures of a frame have the same, lest the
flip from one to another show what only the encoder did. At 82 generated frames have the PSNR of JPEG at 88 in half
of the bytes.
"""
MOST_BYTES = 72_000
"""Of an encoded photograph: with as much for the counterexample, and close-ups, 100 frames stay below 25 MB."""
CLOSE_QUALITY = 80
_EFFORT = 2
"""Of WebP's encoder: 0.02 s a frame; 4, the default, gains 5 % and takes ten times as long."""
LARGEST_PX = 1600
"""Longest side of a picture in the page; the full one lies beside it."""
_CLOSE_UPS = 3
"""Failures of a frame that are shown close up."""
_CLOSE_ROOM, _CLOSE_LEAST_PX, _CLOSE_LARGEST_PX = 1.8, 96, 280
"""A close-up is so many times as large as the box, at least so wide, and encoded at most so wide."""
_ASPECT = 4 / 3
_THREADS = 2
_OVERLAP = 0.5
"""IoU from which a detection is of a box, as failures are judged."""
_PARAMETERS = {
    "paint": "color",
    "weather": "weather",
    "foliage": "foliage",
    "translate": "translate",
    "yaw": "rotate",
    "ffd": "mesh",
    "size": "size",
    "sun": "sun",
}
"""The parameter by the first word of a coordinate's name, after the object it belongs to."""
_FAILED = ("lost", "phantom")
_CUT_BEFORE, _CUT_LEAST = 4, 2
"""Percent of the width."""
_LABEL_ROOM = 8.0
"""Percent of the height that a label takes."""
_NEAR = 0.2
"""IoU with a failure from which another box is shown in its close-up."""


@dataclass(frozen=True, slots=True)
class BoxMark:
    """A box to be drawn. kind: true, ignored, found, lost or phantom; x, y, width, height: px; left, top, bottom:
    percent of the picture; text: of its label; unsure: a failure that chance may explain.
    """

    kind: str
    x: float
    y: float
    width: float
    height: float
    left: float
    top: float
    bottom: float
    text: str
    unsure: bool = False

    @property
    def label_below(self) -> bool:
        """Where its label hangs: below what was made up, which often lies on something lost."""
        return self.kind == "phantom" or self.top < _LABEL_ROOM

    @property
    def label_top(self) -> float:
        """Of the corner at which the label is, percent of the picture; inside the box at the picture's edge."""
        if not self.label_below:
            return self.top
        return self.bottom if self.bottom < 100 - _LABEL_ROOM else self.top


@dataclass(frozen=True, slots=True)
class CloseUp:
    """A failure, cut out of both pictures. view: x, y, width, height, px, of what is shown; text: what happened;
    grade: how sure that is, "" where nobody asked; rank: of it, as of `grading.rank`; evidence: draws, and what a
    second renderer and another detector say; scores: what the detector said of it before and after.
    """

    kind: str
    text: str
    grade: str
    rank: int
    evidence: tuple[str, ...]
    scores: str
    view: tuple[float, float, float, float]
    before: str
    after: str
    marks_before: tuple[BoxMark, ...]
    marks_after: tuple[BoxMark, ...]


@dataclass(frozen=True, slots=True)
class OwnerChange:
    """What happened to one owner (`object 2`, `scene`): parts such as ("along", "+0.14 m")."""

    owner: str
    parts: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class FailureRow:
    """A failure as text. margin: in logits, before and after; score: the detector's, before and after."""

    text: str
    grade: str
    draws: str
    margin: str
    second: str
    peer: str
    score: str


@dataclass(frozen=True, slots=True)
class FrameOutcome:
    """A frame in one run. size: the greatest share of its bound that a coordinate takes, percent; params: those
    that changed; furthest, turned: the greatest move and turn, as text; risen: the loss, last less first.
    """

    run: ReportedRun
    result: FrameResult
    lost: int
    phantoms: int
    size: float
    params: tuple[str, ...]
    furthest: str
    turned: str
    risen: float
    changes: tuple[OwnerChange, ...]
    rows: tuple[FailureRow, ...]

    @property
    def failures(self) -> int:
        """Lost objects and phantoms."""
        return self.lost + self.phantoms

    @property
    def rank(self) -> int:
        """Of its surest failure, as of `grading.rank`."""
        return max(map(grading.grade_rank, self.result.failures), default=0)

    @property
    def surest(self) -> int:
        """Failures of the highest grade."""
        return sum(grading.grade_rank(f) == self.rank for f in self.result.failures) if self.rank else 0

    @property
    def sure(self) -> int:
        """Failures that are certain, or more than that."""
        return sum(map(grading.is_certain, self.result.failures))

    @property
    def grade(self) -> str:
        """The highest; "" without a failure, or where nobody asked."""
        ranks = {grading.grade_rank(f): f.grade or "" for f in self.result.failures}
        return ranks[max(ranks)] if ranks else ""


@dataclass(frozen=True, slots=True)
class PictureLayer:
    """A picture with its boxes. sets: the boxes by run, each with the places of the runs that share them."""

    title: str
    alt: str
    source: str
    sets: tuple[tuple[tuple[int, ...], tuple[BoxMark, ...]], ...]


@dataclass(frozen=True, slots=True)
class FrameCard:
    """A frame in all runs; layers (the photograph, then one a run) and close-ups where it is in the gallery."""

    identifier: str
    anchor: str
    weather: str | None
    outcomes: tuple[FrameOutcome, ...]
    width: int = 0
    height: int = 0
    layers: tuple[PictureLayer, ...] = ()
    close_ups: tuple[tuple[CloseUp, ...], ...] = ()

    @property
    def cut(self) -> int:
        """Where the slider begins, percent: in the middle, or left of what failed, which is then seen."""
        failed = (
            m.left for layer in self.layers[1:2] for _, marks in layer.sets for m in marks if m.kind in _FAILED
        )
        return max(min(round(min(failed, default=100.0)) - _CUT_BEFORE, 50), _CUT_LEAST)

    @property
    def failures(self) -> int:
        """Of all runs."""
        return sum(one.failures for one in self.outcomes)

    @property
    def rank(self) -> int:
        """Of the surest failure in any run, as of `grading.rank`."""
        return max(one.rank for one in self.outcomes)

    @property
    def grade(self) -> str:
        """The highest in any run; "" without a failure, or where nobody asked."""
        return max(self.outcomes, key=lambda one: one.rank).grade

    @property
    def surest(self) -> int:
        """Failures of the highest grade, of all runs."""
        return sum(one.surest for one in self.outcomes if one.rank == self.rank)

    @property
    def lost(self) -> int:
        """The most that a run lost."""
        return max(one.lost for one in self.outcomes)

    @property
    def phantoms(self) -> int:
        """The most that a run made up."""
        return max(one.phantoms for one in self.outcomes)

    @property
    def size(self) -> float:
        """The largest change, percent of a bound."""
        return max(one.size for one in self.outcomes)

    @property
    def params(self) -> tuple[str, ...]:
        """Those that a run changed."""
        return tuple(p for p in _PARAMETERS.values() if any(p in one.params for one in self.outcomes))


def build_cards(runs: Sequence[ReportedRun], gallery: int) -> list[FrameCard]:
    """All frames, worst first: by the highest grade, then most failures of it, then most of any, then the smallest
    change that was enough; pictures for the first `gallery`. Raises FormatError where a picture is missing.
    """
    plain = [
        FrameCard(
            identifier=results[0].identifier,
            anchor=f"frame-{place}",
            weather=runs[0].weathers[place],
            outcomes=tuple(_outcome(run, result) for run, result in zip(runs, results, strict=True)),
        )
        for place, results in enumerate(zip(*(run.frames for run in runs), strict=True))
    ]
    plain.sort(key=lambda card: (-card.rank, -card.surest, -card.failures, card.size, card.identifier))
    # decoding and encoding run outside the interpreter's lock
    with ThreadPoolExecutor(_THREADS) as pool:
        return [*pool.map(_with_pictures, plain[:gallery]), *plain[gallery:]]


def _outcome(run: ReportedRun, result: FrameResult) -> FrameOutcome:
    kinds = [failure.kind for failure in result.failures]
    changed = [c for c in result.theta if c.value != 0]
    trace = result.loss_trace
    return FrameOutcome(
        run=run,
        result=result,
        lost=kinds.count("lost"),
        phantoms=kinds.count("phantom"),
        size=max((100 * _share(c) for c in changed), default=0.0),
        params=tuple(p for p in _PARAMETERS.values() if any(_parameter(c) == p for c in changed)),
        furthest=_greatest(changed, "translate"),
        turned=_greatest(changed, "rotate"),
        risen=trace[-1] - trace[0] if trace else 0.0,
        changes=_changes(changed),
        rows=tuple(_row(result, failure) for failure in _surest_first(result.failures)),
    )


def _surest_first(failures: Sequence[Failure]) -> list[Failure]:
    return sorted(failures, key=lambda failure: -grading.grade_rank(failure))


def _row(result: FrameResult, failure: Failure) -> FailureRow:
    return FailureRow(
        text=_named(failure),
        grade=failure.grade or "",
        draws=grading.format_draws(failure),
        margin=grading.format_margins(failure.count),
        second=grading.format_second_opinion(failure, failure.second),
        peer=grading.format_second_opinion(failure, failure.peer),
        score=_scores(result, failure, _before_it_moved(result, failure)),
    )


def _named(failure: Failure) -> str:
    return grading.describe_failure(failure) + ("" if failure.index is None else f", object {failure.index}")


def _parameter(coordinate: Coordinate) -> str:
    """`rotate` of `objects[3].yaw`; the word itself where it is unknown."""
    word = coordinate.name.split("].", 1)[-1].split(".")[0].split("[")[0]
    return _PARAMETERS.get(word, word)


def _share(c: Coordinate) -> float:
    """How much of the bound on its side a coordinate takes."""
    bound = c.upper if c.value > 0 else -c.lower
    return abs(c.value) / bound if bound > 0 else 0.0


def _amount(display: str) -> float:
    """The number in front of a unit, without its sign; 0 where there is none."""
    try:
        return abs(float(display.split(" ")[0]))
    except ValueError:
        return 0.0


def _greatest(changed: Sequence[Coordinate], parameter: str) -> str:
    """The display of a parameter's greatest change, without its sign; "" where there is none."""
    mine = [c.display.lstrip("+-") for c in changed if _parameter(c) == parameter]
    return max(mine, key=_amount, default="")


def _changes(changed: Sequence[Coordinate]) -> tuple[OwnerChange, ...]:
    """By owner, in their order; the many offsets of a mesh as one."""
    owners: dict[str, list[Coordinate]] = {}
    for c in changed:
        head, _, _ = c.name.partition("].")
        owner = head.replace("objects[", "object ") if "]." in c.name else "scene"
        owners.setdefault(owner, []).append(c)
    found = []
    for owner, mine in owners.items():
        parts = [(_word(c), _signed(c.display)) for c in mine if _parameter(c) != "mesh"]
        offsets = [c.display.lstrip("-") for c in mine if _parameter(c) == "mesh"]
        if offsets:
            parts.append(("mesh", f"{len(offsets)} offsets, up to {max(offsets, key=_amount)}"))
        found.append(OwnerChange(owner, tuple(parts)))
    return tuple(found)


def _word(c: Coordinate) -> str:
    """`along` of `objects[0].translate.along`, `turn` of a yaw."""
    name = c.name.split("].", 1)[-1].removeprefix("translate.").replace("_", " ").replace(".", " ")
    return "turn" if name == "yaw" else name


def _signed(display: str) -> str:
    """With a true minus or a plus, and the degree sign."""
    text = display.removesuffix(" deg") + "°" if display.endswith(" deg") else display
    return f"−{text[1:]}" if text.startswith("-") else f"+{text}"


def format_size(display: str) -> str:
    """A size for people: `1.6°`, `0.14 m`, or a dash."""
    return _signed(display)[1:] if display else "–"


def _with_pictures(card: FrameCard) -> FrameCard:
    first = card.outcomes[0]
    photograph = _opened(first, "benign.png")
    width, height = photograph.size
    pictures = [_opened(one, "counterexample.png") for one in card.outcomes]
    encoded, quality = _small(_reduced(photograph, LARGEST_PX))
    before = PictureLayer(
        title="before",
        alt=f"Frame {card.identifier} before the change: {_told_before(first)}",
        source=_address(encoded),
        sets=_shared([_before(one, (width, height)) for one in card.outcomes]),
    )
    several = len(card.outcomes) > 1
    after = [
        PictureLayer(
            title=one.run.name if several else "after",
            alt=f"Frame {card.identifier} after the change{f' by {one.run.name}' if several else ''}: {told(one)}",
            source=_address(_encoded(_reduced(picture, LARGEST_PX), quality)),
            sets=(((place,), _after(one, (width, height))),),
        )
        for place, (one, picture) in enumerate(zip(card.outcomes, pictures, strict=True))
    ]
    close_ups = tuple(
        tuple(
            _close_up(one, failure, photograph, picture)
            for failure in _surest_first(one.result.failures)[:_CLOSE_UPS]
        )
        for one, picture in zip(card.outcomes, pictures, strict=True)
    )
    return FrameCard(
        identifier=card.identifier,
        anchor=card.anchor,
        weather=card.weather,
        outcomes=card.outcomes,
        width=width,
        height=height,
        layers=(before, *after),
        close_ups=close_ups,
    )


def describe_outcome(one: FrameOutcome) -> str:
    """`1 certain of 1 lost, 2 phantoms`."""
    parts = [f"{one.lost} lost"] if one.lost else []
    if one.phantoms:
        parts.append(format_count(one.phantoms, "phantom"))
    if not parts:
        return "withstood"
    sure = f"{one.surest} {one.grade} of " if one.sure else ""
    return sure + ", ".join(parts)


def _told_before(one: FrameOutcome) -> str:
    return format_count(one.result.objects, "vehicle")


def _shared(sets: Sequence[tuple[BoxMark, ...]]) -> tuple[tuple[tuple[int, ...], tuple[BoxMark, ...]], ...]:
    """Equal sets once, with the places that have them."""
    places: dict[tuple[BoxMark, ...], list[int]] = {}
    for place, marks in enumerate(sets):
        places.setdefault(marks, []).append(place)
    return tuple((tuple(mine), marks) for marks, mine in places.items())


def _before(one: FrameOutcome, size: tuple[int, int]) -> tuple[BoxMark, ...]:
    result, threshold = one.result, one.run.summary.t_star
    return (*_true(result.targets_benign, size), *_found(result.detections_benign, threshold, size))


def _after(one: FrameOutcome, size: tuple[int, int]) -> tuple[BoxMark, ...]:
    result, threshold = one.result, one.run.summary.t_star
    failures = tuple(
        replace(
            _mark(f.kind, f.xyxy, f"{grading.what(f)}{f': {f.grade}' if grading.is_sure(f) else ''}", size),
            unsure=f.grade is not None and not grading.is_certain(f),
        )
        # What is surest is drawn last, over the others.
        for f in reversed(_surest_first(result.failures))
    )
    return (
        *_true(result.targets_moved, size),
        *_found(result.detections_attacked, threshold, size),
        *failures,
    )


def _true(boxes: Sequence[BoxRecord], size: tuple[int, int]) -> list[BoxMark]:
    """A region that is ignored for several classes is drawn once."""
    marks = [_mark("ignored" if b.ignore else "true", b.xyxy, b.label, size) for b in boxes]
    seen = {mark.kind + str((mark.x, mark.y, mark.width, mark.height)): mark for mark in marks}
    return list(seen.values())


def _found(boxes: Sequence[BoxRecord], threshold: float, size: tuple[int, int]) -> list[BoxMark]:
    return [
        _mark("found", b.xyxy, f"{b.label} {b.score:.2f}", size)
        for b in boxes
        if b.score is not None and b.score >= threshold
    ]


def _mark(kind: str, xyxy: tuple[float, float, float, float], text: str, size: tuple[int, int]) -> BoxMark:
    """Cut off at the picture's edge, so that every side can be seen."""
    x0, x1 = (min(max(v, 1.0), size[0] - 1.0) for v in xyxy[0::2])
    y0, y1 = (min(max(v, 1.0), size[1] - 1.0) for v in xyxy[1::2])
    return BoxMark(
        kind=kind,
        x=round(x0, 1),
        y=round(y0, 1),
        width=round(max(x1 - x0, 0.0), 1),
        height=round(max(y1 - y0, 0.0), 1),
        left=round(100 * x0 / size[0], 2),
        top=round(100 * y0 / size[1], 2),
        bottom=round(100 * y1 / size[1], 2),
        text=text,
    )


def _close_up(one: FrameOutcome, failure: Failure, photograph: Image, picture: Image) -> CloseUp:
    size = photograph.size
    before = _before_it_moved(one.result, failure)
    view = _view(_hull(before, failure.xyxy), size)
    row = _row(one.result, failure)
    return CloseUp(
        kind=failure.kind,
        text=row.text,
        grade=row.grade,
        rank=grading.grade_rank(failure),
        evidence=tuple(words for words in (row.draws, row.second, row.peer) if words),
        scores=row.score,
        view=view,
        before=_cut(photograph, view),
        after=_cut(picture, view),
        marks_before=_near(before, _before(one, size)),
        marks_after=_near(failure.xyxy, _after(one, size)),
    )


def _before_it_moved(result: FrameResult, failure: Failure) -> tuple[float, float, float, float]:
    """Where the lost object was; of a phantom, where it is."""
    mine = (
        t.xyxy
        for t in result.targets_benign
        if t.index is not None and t.index == failure.index and t.label == failure.label
    )
    return next(mine, failure.xyxy) if failure.kind == "lost" else failure.xyxy


def _scores(result: FrameResult, failure: Failure, before: tuple[float, float, float, float]) -> str:
    """What the detector said there, of that class: the best score before and after."""
    best = (
        _best(result.detections_benign, before, failure.label),
        _best(result.detections_attacked, failure.xyxy, failure.label),
    )
    return " → ".join("nothing" if score is None else f"{score:.2f}" for score in best)


def _best(detections: Sequence[BoxRecord], xyxy: tuple[float, float, float, float], label: str) -> float | None:
    scores = [
        d.score for d in detections if d.score is not None and d.label == label and _iou(d.xyxy, xyxy) >= _OVERLAP
    ]
    return max(scores, default=None)


def _iou(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    inside = max(width, 0.0) * max(height, 0.0)
    areas = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (a, b))
    return inside / max(areas - inside, 1e-9)


def _hull(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def _view(xyxy: tuple[float, float, float, float], size: tuple[int, int]) -> tuple[float, float, float, float]:
    """A part of the picture around a box: x, y, width, height in whole px, 4 to 3 where there is room."""
    x0, y0, x1, y1 = xyxy
    wanted = max(_CLOSE_ROOM * (x1 - x0), _CLOSE_ROOM * (y1 - y0) * _ASPECT, _CLOSE_LEAST_PX)
    width = min(math.ceil(wanted), size[0], math.floor(size[1] * _ASPECT))
    height = min(round(width / _ASPECT), size[1])
    x = min(max(round((x0 + x1 - width) / 2), 0), size[0] - width)
    y = min(max(round((y0 + y1 - height) / 2), 0), size[1] - height)
    return x, y, width, height


def _near(xyxy: tuple[float, float, float, float], marks: Sequence[BoxMark]) -> tuple[BoxMark, ...]:
    """Those that lie on a failure, but for what is ignored."""
    return tuple(
        m for m in marks if m.kind != "ignored" and _iou(xyxy, (m.x, m.y, m.x + m.width, m.y + m.height)) >= _NEAR
    )


def _opened(one: FrameOutcome, name: str) -> Image:
    path = one.run.folder / "frames" / one.result.identifier / name
    if not path.is_file():
        raise FormatError(str(path), "a picture of the run", "none")
    with files.open_image(path) as picture:
        return picture.convert("RGB")


def _cut(picture: Image, view: tuple[float, float, float, float]) -> str:
    x, y, width, height = view
    part = picture.crop((round(x), round(y), round(x + width), round(y + height)))
    return _address(_encoded(_reduced(part, _CLOSE_LARGEST_PX), CLOSE_QUALITY))


def _reduced(picture: Image, longest: int) -> Image:
    from PIL import Image

    scale = longest / max(picture.size)
    if scale >= 1:
        return picture
    width, height = (max(round(side * scale), 1) for side in picture.size)
    return picture.resize((width, height), Image.Resampling.LANCZOS)


def _small(picture: Image) -> tuple[bytes, int]:
    """A picture at the best quality that is small enough, or at the worst; and that quality."""
    encoded, quality = b"", QUALITIES[0]
    for quality in QUALITIES:
        encoded = _encoded(picture, quality)
        if len(encoded) <= MOST_BYTES:
            break
    return encoded, quality


def _encoded(picture: Image, quality: int) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, "WEBP", quality=quality, method=_EFFORT)
    return buffer.getvalue()


def _address(encoded: bytes) -> str:
    return "data:image/webp;base64," + base64.b64encode(encoded).decode("ascii")
