"""Stored results: read back they give the same tables, and damaged ones are refused in one line."""

import gzip
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors.types import CLASSES
from drivesem.analysis.confirm import Confirmation, SurvivalRate
from drivesem.analysis.transfer import SourceRun, TransferCounts, TransferTarget
from drivesem.config.commands import AttackConfig
from drivesem.evaluation.coco import IOU_THRESHOLDS
from drivesem.evaluation.matched_class import FALSE, IGNORED, TRUE, ThresholdMatches
from drivesem.failures.grades import Grade, Kind, SecondOpinion
from drivesem.run.frame import detections_from_records
from drivesem.run.results import BoxRecord, Failure, FrameResult
from scene_ir.errors import FormatError
from tests.tools.experiments.detection.conftest import arm, arm_run, counted, frame
from tools.experiments.detection.arms import PLACEBO, RANDOM, AttackArm, AttackTotals
from tools.experiments.detection.counts import ArmCounts, DetectedObject, FailureRecord, FrameCounts, StudyCounts
from tools.experiments.detection.labels import compare_frame_labels, compare_labels
from tools.experiments.detection.report import build_results
from tools.experiments.detection.retraining_arms import BENIGN, build_retraining_arms
from tools.experiments.detection.retraining_results import BenignMatches, RetrainingCounts, summarise_retraining
from tools.experiments.detection.robustness import ANYWHERE, AROUND, KINDS, FailureCounts, FrameStateCounts
from tools.experiments.detection.stored_results import (
    load_retraining,
    load_study,
    load_transfer,
    save_retraining,
    save_study,
    save_transfer,
)
from tools.experiments.detection.transfer import TransferSource, TransferStudyCounts, build_matrix
from tools.experiments.settings import StudyConfig

DRAWS = 20
PLACES = len(IOU_THRESHOLDS)
CERTAIN_LOSS = Failure("lost", "Car", (0.0, 0.0, 9.0, 9.0), 0, None, Kind.MISSED, Grade.CERTAIN)
CYCLIST = BoxRecord((300.0, 20.0, 330.0, 60.0), "Cyclist", score=0.123456)


@pytest.fixture
def single() -> tuple[StudyConfig, StudyCounts]:
    """A graded attack by which cars are lost; a control of another detector; one that does nothing."""
    names = [f"{i:03d}" for i in range(4)]
    drawn = replace(CERTAIN_LOSS, error=None, index=None, second=SecondOpinion("generator", 4, 1, 4))
    failures = (CERTAIN_LOSS, drawn)
    lost = [replace(frame(n, moved_by=7.0 * i, found=i < 2), failures=failures) for i, n in enumerate(names)]
    blind = [replace(one, detections_benign=one.detections_benign[:1]) for one in lost]
    arms = (
        counted(arm("rotate", 0.982), lost),
        counted(arm("rotate random", control=(RANDOM, "rotate"), detector="other"), blind),
        counted(arm("rotate placebo", control=(PLACEBO, "rotate"), keep="last"), [frame(n) for n in names]),
    )
    counts = StudyCounts(arms, 2, {"009": "no, camera"}, {"000": (DetectedObject(1, 30.5, 12.25),)})
    return StudyConfig(name="single", steps=3, seed=5, out="elsewhere", bootstrap=DRAWS), counts


@pytest.fixture
def labels() -> tuple[StudyConfig, StudyCounts]:
    """Cars that move away from their labels; one is ignored, one is lost."""
    results = [frame(f"{i:03d}", moved_by=11.0 * i, found=i < 3) for i in range(4)]
    ignored = replace(results[1].targets_moved[1], ignore=True)
    results[1] = replace(results[1], targets_moved=(results[1].targets_moved[0], ignored))
    run = arm_run(arm("translate"), results)
    counts = StudyCounts((ArmCounts.from_run(run),), 0, {}, labels={"translate": compare_frame_labels(run)})
    return StudyConfig(name="labels"), counts


def same_matches(one: ThresholdMatches, other: ThresholdMatches) -> bool:
    return all(np.array_equal(getattr(one, key), getattr(other, key)) for key in ThresholdMatches.__slots__)


def test_a_study_of_arms_comes_back(single: tuple[StudyConfig, StudyCounts], tmp_path: Path) -> None:
    study, counts = single
    shares = tuple(
        SurvivalRate.from_outcomes(name, outcomes)
        for name, outcomes in (("frames", [True, True, False]), ("lost", []))
    )
    confirmed = {"rotate": Confirmation(3, {}, shares, {}, None)}
    save_study(tmp_path / "results", study, counts, confirmed)
    archive = load_study(tmp_path / "results", "single")
    assert archive.settings == replace(study, out=None)
    assert archive.confirmed == confirmed
    again = archive.counts
    assert (again.without_vehicles, again.failed) == (2, {"009": "no, camera"})
    assert {name: own for name, own in again.detected_objects.items() if own} == counts.detected_objects
    for one, other in zip(counts.arms, again.arms, strict=True):
        assert one.frames == other.frames
        assert same_matches(one.before, other.before)
        assert all(same_matches(one.after[mode], other.after[mode]) for mode in ("paper", "moved"))
    first, second = (build_results(study, these, confirmed).to_json() for these in (counts, again))
    assert first == second
    assert first["rows"][0]["drop_moved_low"] < first["rows"][0]["drop_moved_high"]


def test_labels_come_back(labels: tuple[StudyConfig, StudyCounts], tmp_path: Path) -> None:
    study, counts = labels
    save_study(tmp_path / "results", study, counts, {})
    again = load_study(tmp_path / "results", "labels").counts
    assert again.labels == counts.labels
    one = compare_labels("translate", again.labels["translate"])
    assert (one.objects, one.counts[0.5].only_unmoved, one.counts[0.7].lost_only_unmoved) == (7, 1, 2)


def test_equal_counts_give_equal_bytes(single: tuple[StudyConfig, StudyCounts], tmp_path: Path) -> None:
    for name in "ab":
        save_study(tmp_path / name, *single, {})
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


scores = st.floats(0, 1, width=32)
marks = st.lists(st.sampled_from((FALSE, TRUE, IGNORED)), min_size=PLACES, max_size=PLACES)
frames = st.lists(st.lists(st.tuples(scores, marks, marks), max_size=4), min_size=1, max_size=3)


def build_matches(pictures: list[list[tuple[float, list[int]]]]) -> ThresholdMatches:
    """Any marks, with as many objects as there are detections."""
    rows = [row for picture in pictures for row in picture]
    return ThresholdMatches(
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
    counted = [
        FrameCounts(f"{i}", 3, 9, size, True, True, False, size, 2, (FailureRecord(None, None, None, False),))
        for i in range(len(pictures))
    ]
    benign, moved = (build_matches([[(row[0], row[k]) for row in one] for one in pictures]) for k in (1, 2))
    arm = AttackArm(name, "a", AttackConfig())
    one = ArmCounts(arm, tuple(counted), benign, {"paper": benign, "moved": moved})
    folder = tmp_path_factory.mktemp("results") / "a"
    save_study(folder, StudyConfig(name="single"), StudyCounts((one,), 0, {}), {})
    (other,) = load_study(folder, "single").counts.arms
    assert (other.arm.name, other.frames) == (name, one.frames)
    assert same_matches(other.before, benign)
    assert same_matches(other.after["moved"], moved)


def transfer_counts(
    results: Sequence[FrameResult], run: str, target: str, classes: tuple[str, ...], missed: Sequence[int] = ()
) -> TransferCounts:
    """A run on a detector that finds nothing in the re-renders `missed`, and what the run's own finds elsewhere."""

    def select(records: Sequence[BoxRecord]) -> Any:
        return detections_from_records(tuple(one for one in records if one.label in classes), classes)

    detections = {
        "benign": [select((*r.detections_benign, CYCLIST)) for r in results],
        "rerendered": [
            select(() if i in missed else (*r.detections_benign, CYCLIST)) for i, r in enumerate(results)
        ],
        "attacked": [select(r.detections_attacked) for r in results],
    }
    source = SourceRun(run, "squeezedet", "si-fgsm", "rotate")
    return TransferCounts.from_detections(
        source, TransferTarget(target, target, classes, 0.35), results, detections
    )


def with_cyclist(results: list[FrameResult]) -> list[FrameResult]:
    """A cyclist who is there in the first frame, and a phantom in the others."""
    there = replace(CYCLIST, score=None, index=2)
    first = results[0]
    sides = {name: (*getattr(first, name), there) for name in ("targets_benign", "targets_moved")}
    return [replace(first, **sides), *results[1:]]


@pytest.fixture
def attacked() -> list[FrameResult]:
    """Four frames: the car moves, and is lost in two of them, once with certainty; one has a phantom."""
    results = [frame(f"{i:03d}", moved_by=9.0 * i, found=i < 2, success=i >= 2) for i in range(4)]
    phantom = replace(results[3].detections_attacked[0], xyxy=(400.0, 20.0, 440.0, 60.0), score=0.5)
    last = replace(results[3], detections_attacked=(*results[3].detections_attacked, phantom))
    return with_cyclist([*results[:2], replace(results[2], failures=(CERTAIN_LOSS,)), last])


@pytest.fixture
def transfer(attacked: list[FrameResult]) -> tuple[StudyConfig, TransferStudyCounts]:
    """A run and its placebo on two detectors, one of which knows fewer classes."""
    study = StudyConfig(name="transfer", bootstrap=DRAWS, seed=3, out="elsewhere")
    still = with_cyclist([frame(f"{i:03d}") for i in range(4)])
    pairs = [
        transfer_counts(results, run, target, classes, missed)
        for run, results in (("squeezedet", attacked), ("squeezedet placebo", still))
        for target, classes, missed in (("squeezedet", CLASSES, [1]), ("other", ("Car", "Truck"), []))
    ]
    source = TransferSource("squeezedet", "squeezedet placebo", {"other": (0.9128, 0.875)})
    totals = AttackTotals(4, 8, 7, 2, {"009": "no, camera"})
    return study, TransferStudyCounts(totals, (source,), pairs, {"a.png": "cut off"})


@pytest.fixture
def retrain(attacked: list[FrameResult]) -> tuple[StudyConfig, RetrainingCounts]:
    """A detector and three retrained ones; the second renderer drew one of three frames."""
    study = StudyConfig(name="retrain", quick=True, bootstrap=DRAWS, arms="benign,random,ours")
    retrained = [one.name for one in build_retraining_arms(study)]
    names, draw = [BENIGN, *retrained], np.random.default_rng(0)
    identifiers = [one.identifier for one in attacked]

    def benign() -> ThresholdMatches:
        scores = draw.random(9, np.float32).astype(np.float64)
        marks = draw.choice([FALSE, TRUE, IGNORED], (9, PLACES))
        return ThresholdMatches(np.repeat(np.arange(3), 3), scores, marks, np.full(3, 3.0))

    def states(number: int) -> FrameStateCounts:
        kinds = KINDS if number == 1 else (ANYWHERE, AROUND)
        lost = {kind: tuple(draw.integers(0, 9, len(names)).tolist()) for kind in kinds}
        counts = {kind: FailureCounts(9, own, 8, own[::-1]) for kind, own in lost.items()}
        return FrameStateCounts(f"{number:03d}", "digest", counts, "why")

    def fresh(i: int) -> list[FrameResult]:
        rotated = attacked[i:] + attacked[:i]
        return [replace(one, identifier=name) for one, name in zip(rotated, identifiers, strict=True)]

    return study, RetrainingCounts(
        attack="combo 2",
        training_attacks=AttackTotals(4, 8, 8, 1, {}),
        test_attacks=AttackTotals(4, 16, 16, 0, {"9": "no camera"}),
        counterexamples=dict.fromkeys(retrained, 3),
        benign_training_frames=7,
        benign_frames=("a", "b", "c"),
        benign_matches={name: BenignMatches(benign(), 0.25 + 0.1 * i) for i, name in enumerate(names)},
        known=[transfer_counts(attacked, BENIGN, name, CLASSES) for name in names],
        fresh=[counted(arm(name), fresh(i)) for i, name in enumerate(names)],
        left_out={"the same, consistently": "no failure"},
        states=[states(number) for number in range(3)],
    )


def test_transfer_comes_back(transfer: tuple[StudyConfig, TransferStudyCounts], tmp_path: Path) -> None:
    study, counts = transfer
    save_transfer(tmp_path / "results", study, counts)
    stored, again = load_transfer(tmp_path / "results")
    assert stored == replace(study, out=None)
    data, other = (build_matrix(study, one).to_json() for one in (counts, again))
    assert other == data
    own, elsewhere = data["rows"]
    assert own["drop_moved_low"] < own["drop_moved"]
    assert (own["certain_rate"], own["lost"], own["phantoms"]) == (1.0, 2, 1)
    assert own["rerendered_ap50"] < own["benign_ap50"]
    assert elsewhere["reference_drop"] == pytest.approx(0.0378)
    assert (data["frames_failed"], data["feasible_fraction"]) == ({"009": "no, camera", "a.png": "cut off"}, 7 / 8)


def test_retraining_comes_back(retrain: tuple[StudyConfig, RetrainingCounts], tmp_path: Path) -> None:
    study, counts = retrain
    save_retraining(tmp_path / "results", study, counts)
    stored, again = load_retraining(tmp_path / "results")
    assert stored == study
    data, other = (summarise_retraining(study, one).to_json() for one in (counts, again))
    assert other == data
    json.dumps(data, allow_nan=False)
    assert [row["name"] for row in data["rows"]] == list(counts.benign_matches)
    assert data["robust"][0]["failures_redrawn"] is not None
    assert [row["goal"] for row in data["robust"]] == [None, None, None, False]
    assert data["left_out"] == {"the same, consistently": "no failure"}
    save_retraining(tmp_path / "again", stored, again)
    for path in sorted((tmp_path / "results").rglob("*.*")):
        assert path.read_bytes() == (tmp_path / "again" / path.relative_to(tmp_path / "results")).read_bytes()


def test_without_new_attacks_or_states(retrain: tuple[StudyConfig, RetrainingCounts], tmp_path: Path) -> None:
    study, counts = retrain
    fewer = replace(counts, fresh=counts.fresh[:1], states=())
    save_retraining(tmp_path / "results", study, fewer)
    _, again = load_retraining(tmp_path / "results")
    assert summarise_retraining(study, again).to_json() == summarise_retraining(study, fewer).to_json()


def change_file(path: Path, before: str, after: str) -> None:
    packed = path.suffix == ".gz"
    text = gzip.decompress(path.read_bytes()).decode() if packed else path.read_text()
    assert before in text
    data = text.replace(before, after, 1).encode()
    path.write_bytes(gzip.compress(data) if packed else data)


@pytest.mark.parametrize(
    ("file", "before", "after", "message"),
    [
        ("study.json", '"schema": 2', '"schema": 1', "study.json: schema: expected 2"),
        ("study.json", '"name": "single"', '"name": "multi"', "settings.name: expected single, found multi"),
        ("study.json", '"steps": 3', '"steps": 0', "settings: --steps: expected at least 1"),
        ("study.json", f'"bootstrap": {DRAWS}', '"bootstrap": 1000000000', "at most 100000 bootstrap draws"),
        ("frames.csv", "frame,arm", "arm,frame", "frames.csv: expected columns frame, arm"),
        ("frames.csv", ",10,", ",ten,", "frames.csv:2: queries: expected a value of this column"),
        ("frames.csv", ",10,", ",", r"frames.csv:2: expected \d+ cells"),
        ("frames.csv", "001,rotate,", "007,rotate,", "expected tables that fit together"),
        ("detections.csv.gz", "0.9,t", "0.9,x", "expected tables that fit together"),
        ("detections.csv.gz", "0.9,t", "nought,t", "detections.csv.gz:2: score: expected a value"),
    ],
)
def test_damaged_results_are_refused_in_one_line(
    file: str, before: str, after: str, message: str, single: tuple[StudyConfig, StudyCounts], tmp_path: Path
) -> None:
    folder = tmp_path / "results"
    save_study(folder, *single, {})
    change_file(folder / file, before, after)
    with pytest.raises(FormatError, match=message) as refused:
        load_study(folder, "single")
    assert "\n" not in str(refused.value)


def test_missing_files_are_refused_in_one_line(single: tuple[StudyConfig, StudyCounts], tmp_path: Path) -> None:
    folder = tmp_path / "results"
    save_study(folder, *single, {})
    packed = (folder / "detections.csv.gz").read_bytes()
    for data in (b"no archive", packed[:-9], packed[:40]):
        (folder / "detections.csv.gz").write_bytes(data)
        with pytest.raises(FormatError, match=r"detections\.csv\.gz: expected a gzip file"):
            load_study(folder, "single")
    (folder / "failures.csv").unlink()
    with pytest.raises(FormatError, match=r"failures\.csv: expected a readable file"):
        load_study(folder, "single")
