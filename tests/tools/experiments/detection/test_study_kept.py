"""What a study keeps: read back it is the same, tables and all, and what is damaged is refused in one line."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivesem.analysis.confirm.report import Confirmation, Share
from drivesem.config.commands import Attack, Study
from drivesem.evaluation.coco import IOU_THRESHOLDS
from drivesem.evaluation.matches import FALSE, IGNORED, TRUE, Matches
from drivesem.failures.grades import Agreement, Grade, Kind
from drivesem.run.results import Failure
from scene_ir.errors import FormatError
from tools.experiments.detection.arms import PLACEBO, RANDOM, Arm
from tools.experiments.detection.counts import ArmCounts, CountedFailure, FrameCounts, SeenObject, StudyCounts
from tools.experiments.detection.kept import keep, load_kept
from tools.experiments.detection.labels import label_frames, label_sets
from tools.experiments.detection.rows import rows_of
from tools.experiments.detection.running import ArmRun

STUDY = Study(name="single", steps=3, seed=5, out="elsewhere")
SURE = Failure("lost", "Car", (0.0, 0.0, 9.0, 9.0), 0, None, Kind.MISSED, Grade.CERTAIN)
DRAWS = 20
PLACES = len(IOU_THRESHOLDS)


@pytest.fixture
def counts(frame: Callable[..., Any], counted: Callable[..., ArmCounts], arm: Callable[..., Arm]) -> StudyCounts:
    """An attack by which cars are lost, graded; a control of another detector; one that does nothing."""
    names = [f"{i:03d}" for i in range(4)]
    asked = replace(SURE, error=None, index=None, second=Agreement("generator", 4, 1, 4))
    lost = [replace(frame(n, moved_by=7.0 * i, found=i < 2), failures=(SURE, asked)) for i, n in enumerate(names)]
    blind = [replace(one, detections_benign=one.detections_benign[:1]) for one in lost]
    runs = (
        counted(arm("rotate", 0.982), lost),
        counted(arm("rotate random", control=(RANDOM, "rotate"), detector="other"), blind),
        counted(arm("rotate placebo", control=(PLACEBO, "rotate"), keep="last"), [frame(n) for n in names]),
    )
    return StudyCounts(runs, 2, {"009": "no, camera"}, {"000": (SeenObject(1, 30.5, 12.25),)})


def same(one: Matches, other: Matches) -> bool:
    return all(np.array_equal(getattr(one, key), getattr(other, key)) for key in Matches.__slots__)


def test_it_comes_back_and_so_do_its_rows(counts: StudyCounts, tmp_path: Path) -> None:
    shares = tuple(Share.of(name, outcomes) for name, outcomes in (("frames", [True, True, False]), ("lost", [])))
    confirmed = {"rotate": Confirmation(3, {}, shares, {}, None)}
    keep(tmp_path / "kept", STUDY, counts, confirmed)
    kept = load_kept(tmp_path / "kept", "single")
    assert kept.settings == replace(STUDY, out=None)
    assert kept.confirmed == confirmed
    again = kept.counts
    assert (again.without_vehicles, again.failed) == (2, {"009": "no, camera"})
    assert {name: seen for name, seen in again.seen.items() if seen} == counts.seen
    for one, other in zip(counts.arms, again.arms, strict=True):
        assert one.frames == other.frames
        assert same(one.before, other.before)
        assert all(same(one.after[mode], other.after[mode]) for mode in ("paper", "moved"))
    rows = [[row.flat() for row in rows_of(these.arms, DRAWS, 0)] for these in (counts, again)]
    assert rows[0] == rows[1]
    assert rows[0][0]["drop_moved_low"] < rows[0][0]["drop_moved_high"]
    # a photograph stands once: the placebo's is the attack's, the other detector's its own
    text = gzip.decompress((tmp_path / "kept" / "detections.csv.gz").read_bytes()).decode()
    assert text.count("photograph") == 4 * 2 + 4


@pytest.fixture
def labelled(
    frame: Callable[..., Any], arm_run: Callable[..., ArmRun], arm: Callable[..., Arm]
) -> tuple[Study, StudyCounts]:
    """The study of labels: cars that move away from their labels; one is ignored, one is lost."""
    results = [frame(f"{i:03d}", moved_by=11.0 * i, found=i < 3) for i in range(4)]
    ignored = replace(results[1].targets_moved[1], ignore=True)
    results[1] = replace(results[1], targets_moved=(results[1].targets_moved[0], ignored))
    run = arm_run(arm("translate"), results)
    counts = StudyCounts((ArmCounts.of(run),), 0, {}, labels={"translate": label_frames(run)})
    return replace(STUDY, name="labels"), counts


def test_labels_come_back(labelled: tuple[Study, StudyCounts], tmp_path: Path) -> None:
    study, counts = labelled
    keep(tmp_path / "kept", study, counts, {})
    again = load_kept(tmp_path / "kept", "labels").counts
    assert again.labels == counts.labels
    one = label_sets("translate", again.labels["translate"])
    assert (one.objects, one.counted[0.5].only_unmoved, one.counted[0.7].lost_only_unmoved) == (7, 1, 2)
    for file, old, new, message in (
        ("labels.csv", "translate,000,1", "translate,000,0", "labels.csv:3: object: expected each once a frame"),
        ("labels.csv", "1.0", "1.5", "labels.csv:2: iou: expected 0 to 1"),
        ("label_failures.csv", "000,0.5", "000,0.4", "label_failures.csv:2: iou: expected one of 0.5, 0.7"),
        ("label_failures.csv", "000,0.5", "000,0.7", "expected rows of arm translate, frame 000"),
    ):
        keep(tmp_path / "kept", study, counts, {})
        path = tmp_path / "kept" / file
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, 1))
        with pytest.raises(FormatError, match=message):
            load_kept(tmp_path / "kept", "labels")


def test_equal_counts_give_equal_bytes(counts: StudyCounts, tmp_path: Path) -> None:
    for name in "ab":
        keep(tmp_path / name, STUDY, counts, {})
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


scores = st.floats(0, 1, width=32)
marks = st.lists(st.sampled_from((FALSE, TRUE, IGNORED)), min_size=PLACES, max_size=PLACES)
frames = st.lists(st.lists(st.tuples(scores, marks, marks), max_size=4), min_size=1, max_size=3)


def matches(pictures: list[list[tuple[float, list[int]]]]) -> Matches:
    """Of any marks, with as many objects as there are detections."""
    rows = [row for picture in pictures for row in picture]
    return Matches(
        frame=np.repeat(np.arange(len(pictures)), [len(one) for one in pictures]),
        score=np.array([score for score, _ in rows], np.float64),
        marks=np.array([mark for _, mark in rows], np.int64).reshape(-1, PLACES),
        objects=np.array([len(one) for one in pictures], np.float64),
    )


@settings(max_examples=20, deadline=None)
@given(frames, st.just(0.0) | st.floats(1e-30, 1e6), st.text(st.characters(exclude_categories=("C",)), min_size=1))
def test_any_detections_come_back_to_the_last_bit(
    tmp_path_factory: pytest.TempPathFactory, pictures: list, size: float, name: str
) -> None:
    told = [
        FrameCounts(f"{i}", 3, 9, size, True, True, False, size, 2, (CountedFailure(None, None, None, False),))
        for i in range(len(pictures))
    ]
    benign, moved = (matches([[(row[0], row[k]) for row in one] for one in pictures]) for k in (1, 2))
    one = ArmCounts(Arm(name, "a", Attack()), tuple(told), benign, {"paper": benign, "moved": moved})
    folder = tmp_path_factory.mktemp("kept") / "a"
    keep(folder, STUDY, StudyCounts((one,), 0, {}), {})
    (other,) = load_kept(folder, "single").counts.arms
    assert (other.arm.name, other.frames) == (name, one.frames)
    assert same(other.before, benign)
    assert same(other.after["moved"], moved)


@pytest.mark.parametrize(
    ("file", "before", "after", "message"),
    [
        ("study.json", '"schema": 1', '"schema": 9', "study.json: schema: expected 1"),
        ("study.json", '"name": "single"', '"name": "multi"', "settings.name: expected single, found multi"),
        ("study.json", '"steps": 3', '"steps": 0', "settings: --steps: expected at least 1"),
        ("study.json", '"bootstrap": null', '"bootstrap": 1000000000', "bootstrap: expected at most"),
        ("study.json", '"control": "random"', '"control": "placebos"', r"arms\[1\].control: expected random or"),
        ("study.json", '"reference": 0.982', '"reference": 98.2', r"arms\[0\].reference: expected 0 to 1"),
        ("frames.csv", "arm,frame", "frame,arm", "frames.csv: expected columns arm, frame"),
        ("frames.csv", "000,rotate,10", "000,rotate,ten", "frames.csv:2: queries: expected an integer"),
        ("frames.csv", "000,rotate,10", "000,rotate,-1", "frames.csv:2: queries: expected 0, or from 1e-30"),
        ("frames.csv", "000,rotate,10", "000,rotate", "frames.csv:2: expected 13 cells, found 12"),
        ("frames.csv", "rotate,001,", "rotate,000,", "frames.csv:3: expected each frame once an arm"),
        ("frames.csv", "rotate,001,", "rotate,007,", "frames.csv:3: expected an arm and a frame of study.json"),
        ("frames.csv", "placebo,000,rotate,", "placebo,000,elsewhere,", "photograph: expected an arm that"),
        ("detections.csv.gz", "photograph", "picture", ":2.*picture: expected one of photograph, counterexample"),
        ("detections.csv.gz", "photograph,0.9", "photograph,nan", ":2: score: expected a finite number"),
        ("detections.csv.gz", "photograph,0.9", "photograph,1.5", ":2: score: expected 0 to 1, found 1.5"),
        ("detections.csv.gz", "0.9,t,\n", "0.9,x,\n", ":2: benign: expected at most 10 of the letters fti"),
        ("detections.csv.gz", "0.9,t,\n", "0.9,t,t\n", ":2: moved: expected marks of counterexamples alone"),
        (
            "detections.csv.gz",
            "rotate,000,photograph,0.9,t,\n",
            3 * "rotate,000,photograph,0.9,t,\n",
            "no more true",
        ),
        ("failures.csv", "certain", "sure", "failures.csv:2: grade: expected one of threshold, certain"),
        ("failures.csv", "missed", "gone", "failures.csv:2: kind: expected one of missed"),
        ("failures.csv", "rotate,000,0", "rotate,000,-4", "failures.csv:2: object: expected at least 0"),
        ("objects.csv", "30.5", "-1", "objects.csv:2: height_px: expected at least 0"),
        ("objects.csv", "000,1", "003,1\n004,1", "objects.csv:.*expected 4 cells|frame: expected a frame"),
    ],
)
def test_what_is_damaged_is_one_line(
    file: str, before: str, after: str, message: str, counts: StudyCounts, tmp_path: Path
) -> None:
    folder = tmp_path / "kept"
    keep(folder, STUDY, counts, {})
    path, packed = folder / file, file.endswith(".gz")
    text = gzip.decompress(path.read_bytes()).decode() if packed else path.read_text()
    assert before in text
    changed = text.replace(before, after, 1).encode()
    path.write_bytes(gzip.compress(changed) if packed else changed)
    with pytest.raises(FormatError, match=message) as refused:
        load_kept(folder, "single")
    assert "\n" not in str(refused.value)


def test_what_is_missing_or_no_archive_is_one_line(counts: StudyCounts, tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    keep(folder, STUDY, counts, {})
    rows = (folder / "frames.csv").read_text().splitlines(keepends=True)
    (folder / "frames.csv").write_text("".join(rows[:-1]))
    with pytest.raises(
        FormatError, match=r"frames\.csv: expected a row of arm rotate placebo, frame 003, found none"
    ):
        load_kept(folder, "single")
    (folder / "frames.csv").write_text("".join(rows))
    packed = (folder / "detections.csv.gz").read_bytes()
    for data in (b"no archive", packed[:-9], packed[:40]):
        (folder / "detections.csv.gz").write_bytes(data)
        with pytest.raises(FormatError, match=r"detections\.csv\.gz: expected a gzip file"):
            load_kept(folder, "single")
    (folder / "failures.csv").unlink()
    (folder / "detections.csv.gz").write_bytes(packed)
    with pytest.raises(FormatError, match=r"failures\.csv: expected a readable file"):
        load_kept(folder, "single")
