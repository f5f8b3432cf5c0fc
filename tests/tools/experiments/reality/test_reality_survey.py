"""The survey of certain failures and real misses, on a run and frames made by hand."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from drivesem.run.finished import load_run
from drivesem.run.results import Failure, dump_frame
from scene_ir import files
from tests.drivesem.commands.conftest import write_finished_run
from tests.tools.bench.test_bench_conditions import names_of
from tools.experiments.__main__ import main
from tools.experiments.reality.features import ObjectFeatures
from tools.experiments.reality.observations import DRAWN, REAL, TABLE, ObservedObject
from tools.experiments.tables import RESULTS, write_table

BOX = (60.0, 40.0, 40.0, 30.0)


def write_dusk(root: Path, names: list[str]) -> None:
    """Grey frames at dusk, each with a bus and a car."""
    attributes = {"weather": "clear", "timeofday": "dawn/dusk"}
    for name in names:
        (root / "images").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / "images" / f"{name}.jpg"), np.full((180, 320, 3), 90, np.uint8))
    images = [
        {"id": i, "file_name": f"{name}.jpg", "width": 320, "height": 180, "attributes": attributes}
        for i, name in enumerate(names)
    ]
    objects = [
        {"id": 2 * i + k, "image_id": i, "category_id": k, "bbox": BOX, "area": 1, "iscrowd": 0}
        for i in range(len(names))
        for k in range(2)
    ]
    categories = [{"id": 0, "name": "bus"}, {"id": 1, "name": "car"}]
    files.write_json(
        root / "annotations.json", {"images": images, "annotations": objects, "categories": categories}
    )


def test_the_survey_has_certain_failures_and_real_misses(tmp_path: Path) -> None:
    names = names_of("B", "dawn", 2)
    write_dusk(tmp_path / "data", names)
    run = write_finished_run(tmp_path / "out" / "attacks" / "squeezedet-bdd")
    frame = load_run(run).frames[0]
    box = frame.result.targets_moved[1].xyxy
    grades = ("certain", "by threshold")
    failures = tuple(Failure("lost", "Car", box, i, error="missed", grade=grade) for i, grade in enumerate(grades))
    files.write_text(frame.folder / "result.json", dump_frame(replace(frame.result, failures=failures)))
    features = ObjectFeatures(40.0, 1.0, 0.5, 0.5, 0.1, 0.5, 0.1, 0.0)
    rows = [
        (ObservedObject("B", "dusk", REAL, name, k, False, "squeezedet" if missed else "other"), features)
        for name in names
        for k, missed in enumerate((name == names[0], False))
    ]
    drawn = ObservedObject("B", "dusk", DRAWN, names[1], 1, False, "squeezedet")
    rows.append((drawn, features))  # missed, but in a drawn picture
    write_table(tmp_path / "out" / RESULTS / TABLE.format("B"), (ObservedObject, ObjectFeatures), rows)
    assert main(["reality", "survey", "--root", str(tmp_path / "data"), "--out", str(tmp_path / "out")]) == 0
    key = json.loads((tmp_path / "out" / "survey" / "survey-key.json").read_text())
    items = {item["kind"]: item for item in key["items"]}
    assert len(key["items"]) == 2
    changed, photograph = items["counterexample"], items["photograph"]
    assert (changed["run"], changed["frame"], changed["object"]) == ("squeezedet-bdd", frame.result.identifier, 0)
    assert (photograph["run"], photograph["frame"], photograph["truth"]) == ("dusk", names[0], "Truck")
    page = (tmp_path / "out" / "survey" / "survey.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 3  # the real miss has one picture
