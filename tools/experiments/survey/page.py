"""The page of the paper's questions to people (section 4.2): what is this object, and how real is the change?

The page needs no network; answers leave it as a CSV file. The key records what its pictures are.
"""

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
from drivesem.reporting import web
from drivesem.reporting.drawing import encode_jpeg_data_url
from drivesem.reporting.tables import Console, format_count, print_json
from drivesem.run.finished import AttackRun, RunFrame, load_runs
from drivesem.run.folder import resolve_output_folder
from drivesem.run.records import from_json
from drivesem.run.results import BoxRecord
from scene_ir import files
from scene_ir.errors import FormatError, ShapeError
from tools.experiments.realism.comparison import box_area, enclosing_rectangle, vehicle_boxes
from tools.experiments.realism.perceptual import Picture
from tools.experiments.settings import SurveyConfig

PAGE, KEY = "survey.html", "survey-key.json"
"""Files of a survey: the page for people, and the key to its pictures."""
CHANGED, UNCHANGED, PHOTOGRAPH = "counterexample", "unchanged", "photograph"
KINDS = (CHANGED, UNCHANGED, PHOTOGRAPH)
"""Kinds of pictures; photographs, of which there is no other version, come from `experiments reality`."""
OTHER, NOT_SURE = "Other", "Not sure"
_CATEGORY_TEXTS = {
    "Car": "car or van",
    "Truck": "truck, bus or tram",
    "Pedestrian": "person on foot",
    "Cyclist": "cyclist",
}
CHOICES = {
    **{name: _CATEGORY_TEXTS.get(name, name.lower()) for name in CLASSES},
    OTHER: "something else",
    NOT_SURE: "not sure",
}
"""Answers to the first question, and their text on the page."""
LEAST, MOST = 1, 10
"""The scale of realism."""
COLUMNS = ("survey", "participant", "item", "position", "named", "realism", "seconds")
_CONTEXT = 2.0
"""Width and height of a picture, in multiples of its vehicle's, so that the surroundings are visible."""
_LEAST_HW = (180, 320)
"""px; smaller crops of far vehicles would be mostly vehicle and blur."""
_PICTURE_WIDTH_PX = 640
"""Pictures are enlarged to it, so that all have one size."""


Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class SurveyItem:
    """One question of a survey."""

    item: str
    """Random name, which the page does not show."""
    kind: str
    """One of KINDS."""
    run: str
    """Name of the run."""
    params: str
    """Parameters that its attack changed."""
    frame: str
    """Identifier of the frame."""
    object: int
    """Index of the vehicle in the scene."""
    truth: str
    """Class of the vehicle."""


@dataclass(frozen=True, slots=True)
class SurveyPicture:
    """The pictures of one question."""

    original: Picture | None
    """Crop of the photograph (h, w, 3) uint8; None if `changed` is one."""
    changed: Picture
    """Crop of the picture to rate (h, w, 3) uint8."""
    outline_xyxy: tuple[float, float, float, float]
    """Box of the vehicle, fractions of the crop."""


@dataclass(frozen=True, slots=True)
class SurveyResponse:
    """One person's answers to one question."""

    participant: str
    """Name or number of the person."""
    item: str
    """Name of the question."""
    named: str
    """One of CHOICES."""
    realism: int
    """LEAST to MOST."""


def draw_items(
    runs: Sequence[AttackRun], count: int, controls: int, seed: int
) -> list[tuple[SurveyItem, SurveyPicture]]:
    """Draw counterexamples from runs, successes before others, and re-renders without a change.

    Each question is about the frame's lost vehicle, or else the one with the largest box, among those that the
    changed picture shows.

    Args:
        runs: Finished runs.
        count: Counterexamples.
        controls: Re-renders without a change.
        seed: Seed of the draw.

    Returns:
        Questions and their pictures, in random order.

    Raises:
        ShapeError: No frame has a vehicle.
    """
    generator = np.random.default_rng(seed)
    frames = [
        (run, frame)
        for run in runs
        for frame in run.frames
        if all(_visible_vehicles(frame, kind) for kind in KINDS)
    ]
    if not frames:
        raise ShapeError("survey", "a run with vehicles", "none")
    order = [frames[i] for i in generator.permutation(len(frames))]
    ranked = sorted(order, key=lambda pair: not pair[1].result.success_moved)
    wanted = [(CHANGED, *pair) for pair in ranked[:count]]
    wanted += [(UNCHANGED, *pair) for pair in reversed(ranked[-controls:] if controls else [])]
    found = []
    for number in generator.permutation(len(wanted)).tolist():
        kind, run, frame = wanted[number]
        before, after = _select_vehicle(frame, kind)
        truth = after.label if kind == CHANGED else before.label
        name = hashlib.sha256(f"{seed} {number} {run.name} {frame.result.identifier}".encode()).hexdigest()[:8]
        assert before.index is not None
        item = SurveyItem(name, kind, run.name, run.params, frame.result.identifier, before.index, truth)
        found.append((item, _crop_pictures(frame, kind, before, after)))
    return found


def _select_vehicle(frame: RunFrame, kind: str) -> tuple[BoxRecord, BoxRecord]:
    lost = [failure.index for failure in frame.result.failures if failure.kind == "lost"]
    pairs = _visible_vehicles(frame, kind)
    candidates = [pair for pair in pairs if pair[0].index in lost] or pairs
    return max(candidates, key=lambda pair: box_area(pair[1].xyxy))


def _visible_vehicles(frame: RunFrame, kind: str) -> list[tuple[BoxRecord, BoxRecord]]:
    """Vehicles, before and after, that the changed picture of a question of this kind shows."""
    place = 1 if kind == CHANGED else 0
    return [pair for pair in vehicle_boxes(frame.result) if box_area(pair[place].xyxy) > 0]


def _crop_pictures(frame: RunFrame, kind: str, before: BoxRecord, after: BoxRecord) -> SurveyPicture:
    original = files.read_image(frame.pictures["benign"])
    changed = files.read_image(frame.pictures["attacked" if kind == CHANGED else "rerendered"])
    box = after.xyxy if kind == CHANGED else before.xyxy
    return crop_pictures(original, changed, box, enclosing_rectangle((before.xyxy, box)))


def crop_pictures(original: Picture | None, changed: Picture, box: Box, shown: Box | None = None) -> SurveyPicture:
    """Crop pictures (H, W, 3) uint8 around the rectangle `shown`, by default the vehicle's box (xyxy, px)."""
    height, width = changed.shape[:2]
    x0, y0, x1, y1 = shown or box
    rows, columns = _crop_span(y0, y1, height, _LEAST_HW[0]), _crop_span(x0, x1, width, _LEAST_HW[1])
    top, left, h, w = rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start
    outline = ((box[0] - left) / w, (box[1] - top) / h, (box[2] - left) / w, (box[3] - top) / h)
    x0, y0, x1, y1 = (float(np.clip(value, 0, 1)) for value in outline)
    before = None if original is None else _enlarge(original[rows, columns])
    return SurveyPicture(before, _enlarge(changed[rows, columns]), (x0, y0, x1, y1))


def _crop_span(low: float, high: float, length: int, least: int) -> slice:
    size = min(max(round(_CONTEXT * (high - low)), least), length)
    start = min(max(round((low + high - size) / 2), 0), length - size)
    return slice(start, start + size)


def _enlarge(image: Picture) -> Picture:
    scale = max(_PICTURE_WIDTH_PX / image.shape[1], 1.0)
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def survey_name(items: Sequence[SurveyItem]) -> str:
    """A name that identifies these questions; answers carry it."""
    return hashlib.sha256(json.dumps([asdict(item) for item in items]).encode()).hexdigest()[:12]


def render_page(items: Sequence[tuple[SurveyItem, SurveyPicture]]) -> str:
    """The page as HTML: pictures and questions, without the truth."""
    pictures = [
        {
            "item": item.item,
            "original": view.original is not None and encode_jpeg_data_url(view.original),
            "changed": encode_jpeg_data_url(view.changed),
            "outline": view.outline_xyxy,
        }
        for item, view in items
    ]
    # "</" would end the script element, and "<!--" hide its end.
    survey = {"survey": survey_name([item for item, _ in items]), "columns": COLUMNS, "items": pictures}
    data = json.dumps(survey).replace("<", "\\u003c")
    home, facts = (
        "tools.experiments.survey",
        {"count": len(items), "choices": CHOICES, "least": LEAST, "most": MOST},
    )
    return web.render_page(f"{home}:survey.html", f"{home}:survey.js", data=data, **facts)


def write_survey(
    out: Path, questions: Sequence[tuple[SurveyItem, SurveyPicture]], facts: Mapping[str, Any]
) -> float:
    """Write the page, and its key with further entries, to a folder. Returns the page's size, MB."""
    page = render_page(questions)
    files.write_text(out / PAGE, page)
    write_key(out / KEY, [item for item, _ in questions], facts)
    return round(len(page) / 1e6, 2)


def write_key(path: Path, items: Sequence[SurveyItem], facts: Mapping[str, Any]) -> None:
    """Write the truth of each question.

    Args:
        path: File to write.
        items: The questions.
        facts: Further entries, such as the runs.
    """
    files.write_json(path, {"survey": survey_name(items), **facts, "items": [asdict(item) for item in items]})


def read_key(path: Path) -> tuple[str, list[SurveyItem]]:
    """Read the survey's name and questions. Raises FormatError if the file is no key."""
    data = files.read_json(path)
    if not isinstance(data, dict) or "items" not in data:
        raise FormatError(str(path), "a key of the survey", "something else")
    items: tuple[SurveyItem, ...] = from_json(tuple[SurveyItem, ...], data["items"], f"{path}: items")
    return from_json(str, data.get("survey"), f"{path}: survey"), list(items)


def read_answers(path: Path, survey: str, items: Sequence[SurveyItem]) -> list[SurveyResponse]:
    """Read answers of one or several people.

    Args:
        path: File that the page saved.
        survey: Name of the survey.
        items: Its questions.

    Raises:
        FormatError: Naming the line of an answer that does not fit.
    """
    known = {item.item for item in items}
    reader = csv.DictReader(io.StringIO(files.read_text(path), newline=""))
    absent = [name for name in COLUMNS[:6] if name not in (reader.fieldnames or ())]
    if absent:
        raise FormatError(str(path), f"columns {', '.join(COLUMNS)}", f"no {absent[0]}")
    found: list[SurveyResponse] = []
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
        one = SurveyResponse(line["participant"], line["item"], line["named"], int(rating))
        if any((a.participant, a.item) == (one.participant, one.item) for a in found):
            raise FormatError(where, f"each item once from {one.participant}", one.item)
        found.append(one)
    return found


def run_survey(config: SurveyConfig) -> int:
    """Write the page and its key, and print where they are. Raises UsageError or SceneError for bad input."""
    runs = load_runs(config.runs, setting="RUN")
    out = resolve_output_folder(config.out, runs[0].folder / "survey")
    questions = draw_items(runs, config.items, config.controls, config.seed)
    items = [item for item, _ in questions]
    megabytes = write_survey(out, questions, {"runs": [str(run.folder) for run in runs], "seed": config.seed})
    counts = {kind: sum(item.kind == kind for item in items) for kind in KINDS}
    data = {"survey": survey_name(items), "page": str(out / PAGE), "key": str(out / KEY), **counts}
    console = Console(stderr=True)
    if config.json:
        print_json(data | {"megabytes": megabytes})
    if counts[CHANGED] < config.items:
        wanted = format_count(config.items, "picture")
        console.print(f"only {counts[CHANGED]} of {wanted}: the runs have no more", soft_wrap=True)
    console.print(f"give people {out / PAGE}, keep {out / KEY}", soft_wrap=True, highlight=False)
    return 0
