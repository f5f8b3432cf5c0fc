"""The paper's questions to people (section 4.2): what is this object, and how real is the change, 1 to 10, beside
the original. One page without network; answers leave it as a CSV file."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from detectors.types import CLASSES
from drivesem.evaluation.resampling import Interval, NamedMetric, bootstrap_intervals
from drivesem.report import web
from drivesem.report.drawing import encode_jpeg_data_url
from drivesem.run.finished import AttackRun, RunFrame
from drivesem.run.records import from_json
from drivesem.run.results import BoxRecord
from scene_ir import files
from scene_ir.errors import FormatError, ShapeError
from tools.experiments.realism.closeness import Picture
from tools.experiments.realism.comparison import area_of, rectangle_around, vehicles
from tools.experiments.realism.frechet import Floats
from tools.experiments.survey.agreement import alpha, interval, nominal

PAGE, KEY = "survey.html", "survey-key.json"
"""Files of a survey: what people open, and what its pictures are."""
CHANGED, UNCHANGED = "counterexample", "unchanged"
KINDS = (CHANGED, UNCHANGED)
OTHER, NOT_SURE = "Other", "Not sure"
_WORDS = {"Car": "car or van", "Truck": "truck, bus or tram", "Pedestrian": "person on foot", "Cyclist": "cyclist"}
CHOICES = {
    **{name: _WORDS.get(name, name.lower()) for name in CLASSES},
    OTHER: "something else",
    NOT_SURE: "not sure",
}
"""Answers to the first question, and how the page words them."""
LEAST, MOST = 1, 10
"""The scale of realism."""
COLUMNS = ("survey", "participant", "item", "position", "named", "realism", "seconds")
_CONTEXT = 2.0
"""A picture is so many times as wide and high as its vehicle, so that one sees where it stands."""
_LEAST_HW = (180, 320)
"""px; smaller views of far vehicles would be mostly vehicle and blur."""
_SHOWN_WIDTH = 640
"""px; views are enlarged up to it, so that all are seen at one size."""


@dataclass(frozen=True, slots=True)
class Item:
    """A question. item: name of no meaning, which the page shows to nobody; kind: of KINDS; truth: the class."""

    item: str
    kind: str
    run: str
    params: str
    frame: str
    object: int
    truth: str


@dataclass(frozen=True, slots=True)
class View:
    """original, changed: (h, w, 3) uint8 of one size; outline_xyxy: of the vehicle, as fractions of the view."""

    original: Picture
    changed: Picture
    outline_xyxy: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Response:
    """One person's answers to one item. named: of CHOICES; realism: LEAST to MOST."""

    participant: str
    item: str
    named: str
    realism: int


def items_of(runs: Sequence[AttackRun], count: int, controls: int, seed: int) -> list[tuple[Item, View]]:
    """Counterexamples drawn from the runs, successes before others, and re-renders without any change.

    Of each frame the vehicle that was lost, else the one with the largest box, among those that the changed
    picture shows: one that left is no question. Raises ShapeError where no frame has a vehicle.
    """
    generator = np.random.default_rng(seed)
    frames = [(run, frame) for run in runs for frame in run.frames if all(_seen(frame, kind) for kind in KINDS)]
    if not frames:
        raise ShapeError("survey", "a run with vehicles", "none")
    order = [frames[i] for i in generator.permutation(len(frames))]
    ranked = sorted(order, key=lambda pair: not pair[1].result.success_moved)
    wanted = [(CHANGED, *pair) for pair in ranked[:count]]
    wanted += [(UNCHANGED, *pair) for pair in reversed(ranked[-controls:] if controls else [])]
    found = []
    for number in generator.permutation(len(wanted)).tolist():
        kind, run, frame = wanted[number]
        before, after = _shown_vehicle(frame, kind)
        truth = after.label if kind == CHANGED else before.label
        name = hashlib.sha256(f"{seed} {number} {run.name} {frame.result.identifier}".encode()).hexdigest()[:8]
        assert before.index is not None
        item = Item(name, kind, run.name, run.params, frame.result.identifier, before.index, truth)
        found.append((item, _view(frame, kind, before, after)))
    return found


def _shown_vehicle(frame: RunFrame, kind: str) -> tuple[BoxRecord, BoxRecord]:
    lost = [failure.index for failure in frame.result.failures if failure.kind == "lost"]
    pairs = _seen(frame, kind)
    candidates = [pair for pair in pairs if pair[0].index in lost] or pairs
    return max(candidates, key=lambda pair: area_of(pair[1].xyxy))


def _seen(frame: RunFrame, kind: str) -> list[tuple[BoxRecord, BoxRecord]]:
    """The vehicles, before and after, that the changed picture of an item of this kind shows."""
    place = 1 if kind == CHANGED else 0
    return [pair for pair in vehicles(frame.result) if area_of(pair[place].xyxy) > 0]


def _view(frame: RunFrame, kind: str, before: BoxRecord, after: BoxRecord) -> View:
    original = files.read_image(frame.pictures["benign"])
    changed = files.read_image(frame.pictures["attacked" if kind == CHANGED else "rerendered"])
    height, width = original.shape[:2]
    box = after.xyxy if kind == CHANGED else before.xyxy
    x0, y0, x1, y1 = rectangle_around((before.xyxy, box))
    rows, columns = _around(y0, y1, height, _LEAST_HW[0]), _around(x0, x1, width, _LEAST_HW[1])
    top, left, h, w = rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start
    outline = ((box[0] - left) / w, (box[1] - top) / h, (box[2] - left) / w, (box[3] - top) / h)
    x0, y0, x1, y1 = (float(np.clip(value, 0, 1)) for value in outline)
    return View(_enlarged(original[rows, columns]), _enlarged(changed[rows, columns]), (x0, y0, x1, y1))


def _around(low: float, high: float, length: int, least: int) -> slice:
    size = min(max(round(_CONTEXT * (high - low)), least), length)
    start = min(max(round((low + high - size) / 2), 0), length - size)
    return slice(start, start + size)


def _enlarged(image: Picture) -> Picture:
    scale = max(_SHOWN_WIDTH / image.shape[1], 1.0)
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def survey_name(items: Sequence[Item]) -> str:
    """A name that only these items have: answers bear it."""
    return hashlib.sha256(json.dumps([asdict(item) for item in items]).encode()).hexdigest()[:12]


def render_page(items: Sequence[tuple[Item, View]]) -> str:
    """The page's text: pictures and questions, and nothing of the truth."""
    shown = [
        {
            "item": item.item,
            "original": encode_jpeg_data_url(view.original),
            "changed": encode_jpeg_data_url(view.changed),
            "outline": view.outline_xyxy,
        }
        for item, view in items
    ]
    # "</" would end the script element, and "<!--" hide its end.
    told = {"survey": survey_name([item for item, _ in items]), "columns": COLUMNS, "items": shown}
    data = json.dumps(told).replace("<", "\\u003c")
    asked = {"count": len(items), "choices": CHOICES, "least": LEAST, "most": MOST}
    home = "tools.experiments.survey"
    return web.render_page(f"{home}:survey.html", f"{home}:survey.js", data=data, **asked)


def write_key(path: Path, items: Sequence[Item], facts: Mapping[str, Any]) -> None:
    """What the page does not tell: the truth of each item."""
    files.write_json(path, {"survey": survey_name(items), **facts, "items": [asdict(item) for item in items]})


def read_key(path: Path) -> tuple[str, list[Item]]:
    """The survey's name and items. Raises FormatError where the file is no key."""
    data = files.read_json(path)
    if not isinstance(data, dict) or "items" not in data:
        raise FormatError(str(path), "a key of drivesem survey", "something else")
    items: tuple[Item, ...] = from_json(tuple[Item, ...], data["items"], f"{path}: items")
    return from_json(str, data.get("survey"), f"{path}: survey"), list(items)


def read_answers(path: Path, survey: str, items: Sequence[Item]) -> list[Response]:
    """Answers in a file that the page made, of one or several people. Raises FormatError naming the line."""
    known = {item.item for item in items}
    reader = csv.DictReader(io.StringIO(files.read_text(path), newline=""))
    absent = [name for name in COLUMNS[:6] if name not in (reader.fieldnames or ())]
    if absent:
        raise FormatError(str(path), f"columns {', '.join(COLUMNS)}", f"no {absent[0]}")
    found: list[Response] = []
    for number, line in enumerate(reader, start=2):
        where = f"{path}:{number}"
        if line["survey"] != survey:
            raise FormatError(f"{where}: survey", survey, repr(line["survey"]))
        if line["item"] not in known:
            raise FormatError(f"{where}: item", "an item of the survey", repr(line["item"]))
        if line["named"] not in CHOICES:
            raise FormatError(f"{where}: named", f"one of {', '.join(CHOICES)}", repr(line["named"]))
        rating = line["realism"] or ""
        if rating not in map(str, range(LEAST, MOST + 1)):
            raise FormatError(f"{where}: realism", f"a whole number from {LEAST} to {MOST}", repr(line["realism"]))
        if not line["participant"]:
            raise FormatError(f"{where}: participant", "a name", "nothing")
        one = Response(line["participant"], line["item"], line["named"], int(rating))
        if any((a.participant, a.item) == (one.participant, one.item) for a in found):
            raise FormatError(where, f"each item once from {one.participant}", one.item)
        found.append(one)
    return found


@dataclass(frozen=True, slots=True)
class _Mean:
    """Mean of values (N,) of people (N,), at weights of the people."""

    values: Floats
    person: np.ndarray

    def value(self, weights: Floats | None) -> float | None:
        counts = np.ones(len(self.values)) if weights is None else weights[self.person]
        return float(counts @ self.values / counts.sum()) if counts.sum() > 0 else None


def summary(items: Sequence[Item], answers: Sequence[Response], draws: int, seed: int) -> dict[str, Any]:
    """JSON's form: for each kind of item the share named rightly, mean realism, the mean of the items' medians
    (the paper's average median), agreement; and each item. Intervals: bootstrap over people."""
    people = sorted({answer.participant for answer in answers})
    kinds = {}
    for kind in KINDS:
        chosen = {item.item: item for item in items if item.kind == kind}
        given = [answer for answer in answers if answer.item in chosen]
        if not given:
            continue
        person = np.array([people.index(answer.participant) for answer in given])
        right = np.array([answer.named == chosen[answer.item].truth for answer in given], np.float64)
        ratings = np.array([answer.realism for answer in given], np.float64)
        by_item = [[a for a in given if a.item == name] for name in chosen]
        medians = [float(np.median([a.realism for a in group])) for group in by_item if group]
        named, real = (_interval(values, person, len(people), draws, seed) for values in (right, ratings))
        kinds[kind] = {
            "items": len(chosen),
            "answers": len(given),
            "people": len(set(person.tolist())),
            "named_right": named.value,
            "named_right_low": named.low,
            "named_right_high": named.high,
            "realism_mean": real.value,
            "realism_mean_low": real.low,
            "realism_mean_high": real.high,
            "realism_median": float(np.median(ratings)),
            "realism_average_median": float(np.mean(medians)),
            "alpha_named": alpha([[a.named for a in group] for group in by_item], nominal),
            "alpha_realism": alpha([[a.realism for a in group] for group in by_item], interval),
        }
    return {"people": len(people), "answers": len(answers), "kinds": kinds, "items": _by_item(items, answers)}


def _interval(values: Floats, person: np.ndarray, people: int, draws: int, seed: int) -> Interval:
    figure = NamedMetric("", (_Mean(values, person),))  # pyright: ignore[reportArgumentType]
    (one,) = bootstrap_intervals([figure], people, draws, np.random.default_rng(seed))
    return one


def _by_item(items: Sequence[Item], answers: Sequence[Response]) -> list[dict[str, Any]]:
    found = []
    for item in items:
        given = [answer for answer in answers if answer.item == item.item]
        ratings = [answer.realism for answer in given]
        found.append(
            {
                **asdict(item),
                "answers": len(given),
                "named_right": sum(a.named == item.truth for a in given) / len(given) if given else None,
                "realism_mean": float(np.mean(ratings)) if given else None,
                "realism_median": float(np.median(ratings)) if given else None,
            }
        )
    return found
