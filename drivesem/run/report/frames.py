"""Prepares frames for the page: pictures, boxes, failures and changes. Boxes are in px of the run's pictures."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from drivesem.reporting.tables import format_count
from drivesem.run.report import page as grading
from drivesem.run.report.page import ReportedRun
from drivesem.run.results import BoxRecord, Coordinate, Failure, FrameResult
from scene_ir import files
from scene_ir.errors import FormatError

if TYPE_CHECKING:
    from PIL.Image import Image

QUALITIES = (82, 74, 66, 58)
"""WebP qualities, best first; the first that keeps a frame's photograph small enough serves all its pictures, so that
flipping between them shows no encoder artefacts. Generated frames at 82 have the PSNR of JPEG at 88 in half the size.
"""
MOST_BYTES = 72_000
"""Largest size of an encoded photograph; with counterexamples and close-ups, 100 frames stay below 25 MB."""
CLOSE_QUALITY = 80
_EFFORT = 2
"""Effort of the WebP encoder, 0.02 s per frame; the default, 4, saves 5 % and takes ten times as long."""
LARGEST_PX = 1600
"""Longest side of a picture on the page; the run's folder has it at full size."""
_CLOSE_UPS = 3
"""Number of close-ups per frame."""
_CLOSE_ROOM, _CLOSE_LEAST_PX, _CLOSE_LARGEST_PX = 1.8, 96, 280
"""Size of a close-up relative to the box, its least width in the picture, and its largest encoded width, px."""
_ASPECT = 4 / 3
_THREADS = 2
_OVERLAP = 0.5
"""IoU from which a detection matches a box."""
_PARAMETERS = {
    "paint": "color",
    "weather": "weather",
    "foliage": "foliage",
    "translate": "translate",
    "yaw": "rotate",
    "ffd": "mesh",
    "size": "size",
    "sun": "sun",
    "lamps": "lamps",
}
"""Parameter by the first word of a coordinate's name after its object."""
_FAILED = ("lost", "phantom")
_CUT_BEFORE, _CUT_LEAST = 4, 2
"""Percent of the picture's width."""
_LABEL_ROOM = 8.0
"""Height of a label, percent of the picture's height."""
_NEAR = 0.2
"""IoU with a failure from which another box appears in its close-up."""


@dataclass(frozen=True, slots=True)
class BoxMark:
    """A box drawn on a picture."""

    kind: str
    """true, ignored, found, lost or phantom."""
    x: float
    """Left side, px."""
    y: float
    """Top side, px."""
    width: float
    """Width, px."""
    height: float
    """Height, px."""
    left: float
    """Left side, percent of the picture."""
    top: float
    """Top side, percent."""
    bottom: float
    """Bottom side, percent."""
    text: str
    """Label."""
    unsure: bool = False
    """Whether chance may explain the failure."""

    @property
    def label_below(self) -> bool:
        """Whether its label hangs below the box, as for phantoms, which often lie on a lost object."""
        return self.kind == "phantom" or self.top < _LABEL_ROOM

    @property
    def label_top(self) -> float:
        """Top of the label, percent of the picture; inside the box at the picture's edge."""
        if not self.label_below:
            return self.top
        return self.bottom if self.bottom < 100 - _LABEL_ROOM else self.top


@dataclass(frozen=True, slots=True)
class CloseUp:
    """A failure, cropped from both pictures."""

    kind: str
    """"lost" or "phantom"."""
    text: str
    """Description of the failure."""
    grade: str
    """Grade."""
    rank: int
    """Its rank (`grade_rank`)."""
    evidence: tuple[str, ...]
    """Draws and second opinions."""
    scores: str
    """Scores of the detector before and after."""
    view: tuple[float, float, float, float]
    """Cropped part: x, y, width, height, px."""
    before: str
    """Crop before the change, a data URL."""
    after: str
    """Crop after the change, a data URL."""
    marks_before: tuple[BoxMark, ...]
    """Boxes before."""
    marks_after: tuple[BoxMark, ...]
    """Boxes after."""


@dataclass(frozen=True, slots=True)
class OwnerChange:
    """Changes of one object, or of the scene."""

    owner: str
    """Such as `object 2` or `scene`."""
    parts: tuple[tuple[str, str], ...]
    """Names and values, such as ("along", "+0.14 m")."""


@dataclass(frozen=True, slots=True)
class FailureRow:
    """A failure as text."""

    text: str
    """Description."""
    grade: str
    """Grade."""
    draws: str
    """Draws of the certificate."""
    margin: str
    """Margins before and after, logits."""
    second: str
    """Opinion of the second renderer."""
    peer: str
    """Opinion of the second detector."""
    score: str
    """Scores before and after."""


@dataclass(frozen=True, slots=True)
class FrameOutcome:
    """One frame in one run."""

    run: ReportedRun
    """The run."""
    result: FrameResult
    """The result."""
    lost: int
    """Number of lost objects."""
    phantoms: int
    """Number of phantoms."""
    size: float
    """Largest share of its bound that a coordinate takes, percent."""
    params: tuple[str, ...]
    """Changed parameters."""
    furthest: str
    """Largest move, as text."""
    turned: str
    """Largest turn, as text."""
    risen: float
    """Rise of the loss from first to last query."""
    changes: tuple[OwnerChange, ...]
    """Changes by owner."""
    rows: tuple[FailureRow, ...]
    """Failures, highest grade first."""

    @property
    def failures(self) -> int:
        """Number of lost objects and phantoms."""
        return self.lost + self.phantoms

    @property
    def rank(self) -> int:
        """Rank of its highest grade (`grade_rank`)."""
        return max(map(grading.grade_rank, self.result.failures), default=0)

    @property
    def surest(self) -> int:
        """Number of failures of the highest grade."""
        return sum(grading.grade_rank(f) == self.rank for f in self.result.failures) if self.rank else 0

    @property
    def sure(self) -> int:
        """Number of failures that are at least certain."""
        return sum(map(grading.is_certain, self.result.failures))

    @property
    def grade(self) -> str:
        """Highest grade; "" without a failure."""
        ranks = {grading.grade_rank(f): f.grade or "" for f in self.result.failures}
        return ranks[max(ranks)] if ranks else ""


@dataclass(frozen=True, slots=True)
class PictureLayer:
    """A picture with its boxes."""

    title: str
    """Title."""
    alt: str
    """Text alternative."""
    source: str
    """Data URL."""
    sets: tuple[tuple[tuple[int, ...], tuple[BoxMark, ...]], ...]
    """Sets of boxes, each with the numbers of the runs that have it."""


@dataclass(frozen=True, slots=True)
class FrameCard:
    """A frame in all runs."""

    identifier: str
    """The frame."""
    anchor: str
    """Anchor on the page."""
    weather: str | None
    """Weather of the frame, if known."""
    outcomes: tuple[FrameOutcome, ...]
    """Outcome in each run."""
    width: int = 0
    """Width of the pictures, px."""
    height: int = 0
    """Height, px."""
    layers: tuple[PictureLayer, ...] = ()
    """The photograph, then a picture per run; empty outside the gallery."""
    close_ups: tuple[tuple[CloseUp, ...], ...] = ()
    """Close-ups per run."""

    @property
    def cut(self) -> int:
        """Initial position of the slider, percent: in the middle, or left of the first failure."""
        failed = (
            m.left for layer in self.layers[1:2] for _, marks in layer.sets for m in marks if m.kind in _FAILED
        )
        return max(min(round(min(failed, default=100.0)) - _CUT_BEFORE, 50), _CUT_LEAST)

    @property
    def attacked(self) -> bool:
        """Whether any run attacked the frame."""
        return any(one.result.attacked for one in self.outcomes)

    @property
    def failures(self) -> int:
        """Number of failures in all runs."""
        return sum(one.failures for one in self.outcomes)

    @property
    def rank(self) -> int:
        """Rank of the highest grade in any run (`grade_rank`)."""
        return max(one.rank for one in self.outcomes)

    @property
    def grade(self) -> str:
        """Highest grade in any run; "" without a failure."""
        return max(self.outcomes, key=lambda one: one.rank).grade

    @property
    def surest(self) -> int:
        """Number of failures of the highest grade, in all runs."""
        return sum(one.surest for one in self.outcomes if one.rank == self.rank)

    @property
    def lost(self) -> int:
        """Largest number of lost objects in a run."""
        return max(one.lost for one in self.outcomes)

    @property
    def phantoms(self) -> int:
        """Largest number of phantoms in a run."""
        return max(one.phantoms for one in self.outcomes)

    @property
    def size(self) -> float:
        """Largest change, percent of its bound."""
        return max(one.size for one in self.outcomes)

    @property
    def params(self) -> tuple[str, ...]:
        """Parameters that a run changed."""
        return tuple(p for p in _PARAMETERS.values() if any(p in one.params for one in self.outcomes))


def build_cards(runs: Sequence[ReportedRun], gallery: int) -> list[FrameCard]:
    """Prepare all frames, worst first, with pictures for the first `gallery`.

    Attacked frames come first, by highest grade, number of failures of that grade, number of failures, and smallest
    change.
    Raises FormatError if a picture is missing.
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
    plain.sort(
        key=lambda card: (not card.attacked, -card.rank, -card.surest, -card.failures, card.size, card.identifier)
    )
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
        rows=tuple(_failure_row(result, failure) for failure in _by_grade(result.failures)),
    )


def _by_grade(failures: Sequence[Failure]) -> list[Failure]:
    return sorted(failures, key=lambda failure: -grading.grade_rank(failure))


def _failure_row(result: FrameResult, failure: Failure) -> FailureRow:
    return FailureRow(
        text=grading.name_failure(failure),
        grade=failure.grade or "",
        draws=grading.format_evidence(failure),
        margin=grading.format_margins(failure.count),
        second=grading.format_second_opinion(failure, failure.second),
        peer=grading.format_second_opinion(failure, failure.peer),
        score=_scores(result, failure, _before_it_moved(result, failure)),
    )


def _parameter(coordinate: Coordinate) -> str:
    """Return the parameter of a coordinate, such as `rotate` for `objects[3].yaw`."""
    word = coordinate.name.split("].", 1)[-1].split(".")[0].split("[")[0]
    return _PARAMETERS.get(word, word)


def _share(c: Coordinate) -> float:
    """Return a coordinate's share of its bound, in [0, 1]."""
    bound = c.upper if c.value > 0 else -c.lower
    return abs(c.value) / bound if bound > 0 else 0.0


def _amount(display: str) -> float:
    """Return the absolute number in front of a unit, or 0."""
    try:
        return abs(float(display.split(" ")[0]))
    except ValueError:
        return 0.0


def _greatest(changed: Sequence[Coordinate], parameter: str) -> str:
    """Return the display of a parameter's largest change without its sign, or ""."""
    mine = [c.display.lstrip("+-") for c in changed if _parameter(c) == parameter]
    return max(mine, key=_amount, default="")


def _changes(changed: Sequence[Coordinate]) -> tuple[OwnerChange, ...]:
    """Group changes by owner, with the offsets of a mesh as one entry."""
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
    """Return a short name, such as `along` for `objects[0].translate.along`, or `turn` for a yaw."""
    name = c.name.split("].", 1)[-1].removeprefix("translate.").replace("_", " ").replace(".", " ")
    return "turn" if name == "yaw" else name


def _signed(display: str) -> str:
    """Format a value with a minus or plus sign, and a degree sign."""
    text = display.removesuffix(" deg") + "°" if display.endswith(" deg") else display
    return f"−{text[1:]}" if text.startswith("-") else f"+{text}"


def format_size(display: str) -> str:
    """Format a size for people: `1.6°`, `0.14 m`, or a dash."""
    return _signed(display)[1:] if display else "–"


def _with_pictures(card: FrameCard) -> FrameCard:
    first = card.outcomes[0]
    photograph = _opened(first, "benign.png")
    width, height = photograph.size
    pictures = [_opened(one, "counterexample.png") for one in card.outcomes]
    encoded, quality = _small(_reduced(photograph, LARGEST_PX))
    before = PictureLayer(
        title="before",
        alt=f"Frame {card.identifier} before the change: {_describe_objects(first)}",
        source=_address(encoded),
        sets=_shared([_before(one, (width, height)) for one in card.outcomes]),
    )
    several = len(card.outcomes) > 1
    after = [
        PictureLayer(
            title=one.run.name if several else "after",
            alt=f"Frame {card.identifier} after the change{f' by {one.run.name}' if several else ''}: "
            f"{describe_outcome(one)}",
            source=_address(_encoded(_reduced(picture, LARGEST_PX), quality)),
            sets=(((place,), _after(one, (width, height))),),
        )
        for place, (one, picture) in enumerate(zip(card.outcomes, pictures, strict=True))
    ]
    close_ups = tuple(
        tuple(
            _close_up(one, failure, photograph, picture) for failure in _by_grade(one.result.failures)[:_CLOSE_UPS]
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
    """Describe failures, such as `1 certain of 1 lost, 2 phantoms`."""
    parts = [f"{one.lost} lost"] if one.lost else []
    if one.phantoms:
        parts.append(format_count(one.phantoms, "phantom"))
    if not one.result.attacked:
        return f"not attacked: {one.result.reason_not_attacked}"
    if not parts:
        return "withstood"
    sure = f"{one.surest} {one.grade} of " if one.sure else ""
    return sure + ", ".join(parts)


def _describe_objects(one: FrameOutcome) -> str:
    result = one.result
    counts = f"{len(result.judged)} judged, {len(result.found_before)} found before"
    return f"{format_count(result.objects, 'object')}, {counts}"


def _shared(sets: Sequence[tuple[BoxMark, ...]]) -> tuple[tuple[tuple[int, ...], tuple[BoxMark, ...]], ...]:
    """Merge equal sets of boxes; return each with the runs that have it."""
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
            _mark(
                f.kind,
                f.xyxy,
                f"{grading.describe_failure(f)}{f': {f.grade}' if grading.is_certain(f) else ''}",
                size,
            ),
            unsure=f.grade is not None and not grading.is_certain(f),
        )
        # the highest grade is drawn last, over the others
        for f in reversed(_by_grade(result.failures))
    )
    return (
        *_true(result.targets_moved, size),
        *_found(result.detections_attacked, threshold, size),
        *failures,
    )


def _true(boxes: Sequence[BoxRecord], size: tuple[int, int]) -> list[BoxMark]:
    """Mark true boxes; a region that is ignored for several classes is drawn once."""
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
    """Make a mark, clipped so that all sides lie inside the picture."""
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
    row = _failure_row(one.result, failure)
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
    """Return the box before the change: of the lost object, or of the phantom itself."""
    mine = (
        t.xyxy
        for t in result.targets_benign
        if t.index is not None and t.index == failure.index and t.label == failure.label
    )
    return next(mine, failure.xyxy) if failure.kind == "lost" else failure.xyxy


def _scores(result: FrameResult, failure: Failure, before: tuple[float, float, float, float]) -> str:
    """Format the best score of the class on the box, before and after."""
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
    """Return the part of the picture around a box: x, y, width, height, px; 4 to 3 if there is room."""
    x0, y0, x1, y1 = xyxy
    wanted = max(_CLOSE_ROOM * (x1 - x0), _CLOSE_ROOM * (y1 - y0) * _ASPECT, _CLOSE_LEAST_PX)
    width = min(math.ceil(wanted), size[0], math.floor(size[1] * _ASPECT))
    height = min(round(width / _ASPECT), size[1])
    x = min(max(round((x0 + x1 - width) / 2), 0), size[0] - width)
    y = min(max(round((y0 + y1 - height) / 2), 0), size[1] - height)
    return x, y, width, height


def _near(xyxy: tuple[float, float, float, float], marks: Sequence[BoxMark]) -> tuple[BoxMark, ...]:
    """Select the marks that overlap a failure, without ignored ones."""
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
    """Encode a picture at the best quality that is small enough, or the lowest. Returns that quality, too."""
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
