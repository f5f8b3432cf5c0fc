"""The study `retrain`: results, report, and the whole on embedded frames."""

import csv
import io
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rich.console import Console

from detectors.registry import load_detector
from detectors.types import CLASSES, Detections, Targets
from drivesem.analysis.transfer import (
    SourceRun,
    TransferCounts,
    TransferTarget,
)
from drivesem.attacks.methods.base import Attack
from drivesem.evaluation.matched_class import ThresholdMatches
from drivesem.run.frame import detections_from_records
from drivesem.run.results import FrameResult
from drivesem.run.run_report import PROTOCOL
from tests.tools.experiments.conftest import REQUIRED_KEYS
from tests.tools.experiments.detection.conftest import arm, arm_run, frame
from tools.experiments.__main__ import main
from tools.experiments.detection import retraining, retraining_arms
from tools.experiments.detection.arms import AttackTotals
from tools.experiments.detection.counts import ArmCounts
from tools.experiments.detection.report import OWN_PROTOCOL
from tools.experiments.detection.retraining import cached_detections
from tools.experiments.detection.retraining_arms import BENIGN, build_retraining_arms, paper_reference
from tools.experiments.detection.retraining_report import retraining_report
from tools.experiments.detection.retraining_results import (
    BenignMatches,
    RetrainingCounts,
    RetrainingResults,
    summarise_retraining,
)
from tools.experiments.settings import StudyConfig

FRAMES, DRAWS = 8, 40
THEIRS = {name: value for name, value in PROTOCOL.items() if name != "early_stop"}
"""The paper's protocol, as a study is told it."""
CAR = torch.tensor([[10.0, 20.0, 60.0, 50.0]])


def benign_frames(missed: Sequence[int]) -> tuple[list[Detections], list[Targets]]:
    """Frames of one car; it is not found in those of `missed`."""
    wanted = [Targets(CAR, torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.bool))] * FRAMES
    none = Detections(CAR[:0], torch.zeros(0, dtype=torch.int64), torch.zeros(0))
    hit = Detections(CAR, torch.zeros(1, dtype=torch.int64), torch.tensor([0.9]))
    return [none if i in missed else hit for i in range(FRAMES)], wanted


def seen(missed: Sequence[int] = ()) -> BenignMatches:
    found, wanted = benign_frames(missed)
    return BenignMatches(ThresholdMatches.from_frames(wanted, found, 0), 0.5)


def known(name: str, results: Sequence[FrameResult], stored: int) -> TransferCounts:
    """A detector that finds the first car of the attacked picture in the first `kept` frames, others always."""
    source = SourceRun(BENIGN, "squeezedet", "si-fgsm", "rotate")
    target = TransferTarget(name, name, CLASSES, 0.5)
    found = {
        "benign": [detections_from_records(r.detections_benign, CLASSES) for r in results],
        "rerendered": [detections_from_records(r.detections_benign, CLASSES) for r in results],
        "attacked": [
            detections_from_records(r.detections_benign if i < stored else r.detections_attacked, CLASSES)
            for i, r in enumerate(results)
        ],
    }
    return TransferCounts.from_detections(source, target, results, found)


@pytest.fixture
def found() -> RetrainingResults:
    """Four frames: the detector as it was loses a car in all of them; the retrained ones in half."""
    study = StudyConfig(name="retrain", quick=True, bootstrap=DRAWS, **THEIRS)  # pyright: ignore[reportArgumentType]
    plan = build_retraining_arms(study)
    lost = [frame(str(i), found=False, success=True) for i in range(4)]
    half = [frame(str(i), found=i < 2, success=i >= 2) for i in range(4)]
    names = [BENIGN, *(lesson.name for lesson in plan)]
    runs = [arm_run(arm(name), lost if name == BENIGN else half) for name in names]
    counts = RetrainingCounts(
        attack="combo 2",
        training_attacks=AttackTotals(4, 4, 4, 1, {}),
        test_attacks=AttackTotals(4, 4 * len(names), 4 * len(names), 0, {"9": "no camera"}),
        counterexamples={lesson.name: 4 for lesson in plan},
        benign_training_frames=4,
        benign_frames=tuple(f"{i:03d}" for i in range(FRAMES)),
        benign_matches={name: seen() if name == BENIGN else seen([0]) for name in names},
        known=[known(name, lost, 0 if name == BENIGN else 2) for name in names],
        fresh=[ArmCounts.from_run(run) for run in runs],
    )
    return summarise_retraining(study, counts)


def test_the_drop_is_paired_over_frames(found: RetrainingResults) -> None:
    """One car a frame, the first missed: at weights w the recall is 1 - w0 / n, and precision 1 up to it."""
    flat = found.rows[1].to_row()
    weights = np.random.default_rng(0).multinomial(FRAMES, np.full(FRAMES, 1 / FRAMES), size=DRAWS)
    falls = 1 - (np.floor(100 * (1 - weights[:, 0] / FRAMES) + 1e-9) + 1) / 101
    assert flat["benign_drop"] == pytest.approx(1 - (np.floor(100 * 7 / 8) + 1) / 101)
    assert flat["benign_drop_low"] == pytest.approx(np.quantile(falls, 0.025))
    assert flat["benign_drop_high"] == pytest.approx(np.quantile(falls, 0.975))
    assert flat["benign_recall_drop"] == pytest.approx(1 / 8)
    assert flat["benign_ap50"] == pytest.approx(1 - flat["benign_drop"])
    first = found.rows[0].to_row()
    assert (first["benign_drop"], first["benign_drop_low"], first["benign_drop_high"]) == (0.0, 0.0, 0.0)


def test_gains_are_over_the_detector_as_it_was(found: RetrainingResults) -> None:
    before, after = (r.to_row() for r in found.rows[:2])
    assert (before["gain_moved"], before["fresh_gain_moved"]) == (0.0, 0.0)
    for prefix in ("", "fresh_"):
        rise = after[f"{prefix}moved_ap50"] - before[f"{prefix}moved_ap50"]
        assert rise > 0.2
        assert after[f"{prefix}gain_moved"] == pytest.approx(rise)
        assert after[f"{prefix}gain_moved_low"] <= rise <= after[f"{prefix}gain_moved_high"]
    assert (before["broken_rate"], after["broken_rate"]) == (1.0, 0.5)
    assert (before["fresh_broken_rate"], after["fresh_broken_rate"]) == (1.0, 0.5)
    assert after["drop_moved"] == pytest.approx(after["photographs_ap50"] - after["moved_ap50"])


def test_the_papers_metrics_stand_next_to_its_protocol_only(found: RetrainingResults) -> None:
    study = StudyConfig(name="retrain", **THEIRS)  # pyright: ignore[reportArgumentType]
    plan = build_retraining_arms(study)
    assert paper_reference("retrained, paper's protocol", plan, study) == (0.7276, 0.8473)
    own = StudyConfig(name="retrain")
    assert {paper_reference(lesson.name, plan, own) for lesson in plan} == {None}
    rows = [replace(row, reference=None) for row in found.rows]
    report = retraining_report(replace(found, rows=rows), Path("out"))
    assert OWN_PROTOCOL in report.notes
    assert not any("paper's" in column for table in report.tables for column in table.columns)


def test_what_is_reported(found: RetrainingResults, tmp_path: Path) -> None:
    data = found.to_json()
    json.dumps(data, allow_nan=False)
    assert [REQUIRED_KEYS - set(r) for r in data["rows"]] == [set()] * 3
    assert [(r["reference"], r["reference_benign"]) for r in data["rows"]] == [
        (0.659, 0.994),
        (0.659, 0.994),
        (None, None),  # which is trained in another way than the paper's
    ]
    assert (data["frames"], data["benign_frames"], data["feasible_fraction"]) == (4, FRAMES, 1.0)
    given_frames = {name: (t["pictures"], t["labels"]) for name, t in data["training"].items()}
    assert given_frames["retrained, ours"] == ("counterexample", "moved")
    assert given_frames["retrained on benign re-rendered images"] == ("rerender", "benign")
    report = retraining_report(found, tmp_path)
    report.write()
    text = (tmp_path / "study.md").read_text()
    assert all(f"## {table.title}" in text for table in report.tables)
    for part in (
        "65.90",
        "99.40",
        "92.97",
        "Frame 9 could not be used: no camera",
        "Skipped: 1 frame without vehicles",
    ):
        assert part in text
    lines = list(csv.DictReader((tmp_path / "study.csv").read_text().splitlines()))
    assert [line["name"] for line in lines] == [r.name for r in found.rows]
    stream = io.StringIO()
    report.print(Console(file=stream, width=100))
    assert "retrained, ours" in stream.getvalue()
    assert min(cv2.imread(str(tmp_path / "study.png")).shape[:2]) > 400


def test_benign_frames_are_evaluated_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Store:
        names = ("a", "b")
        digest = "of their pictures"

        def __len__(self) -> int:
            return len(self.names)

    looks: list[int] = []

    def detect(detector: object, store: Store, indices: Sequence[int], device: str) -> list[Detections]:
        looks.append(len(indices))
        return benign_frames([1])[0][: len(indices)]

    monkeypatch.setattr(retraining, "detect_in_store", detect)
    detector, store, path = load_detector("squeezedet"), Store(), tmp_path / "seen.json"
    first = cached_detections(detector, store, path, "cpu")  # pyright: ignore[reportArgumentType]
    again = cached_detections(detector, store, path, "cpu")  # pyright: ignore[reportArgumentType]
    assert looks == [2]
    assert [len(one) for one in again] == [len(one) for one in first] == [1, 0]
    assert torch.equal(again[0].boxes_xyxy, first[0].boxes_xyxy)
    assert torch.equal(again[0].scores, first[0].scores)
    with torch.no_grad():
        next(iter(detector.parameters())).add_(1.0)
    cached_detections(detector, store, path, "cpu")  # pyright: ignore[reportArgumentType]
    store.names = ("a",)  # pyright: ignore[reportAttributeAccessIssue]
    cached_detections(detector, store, path, "cpu")  # pyright: ignore[reportArgumentType]
    store.digest = "of others"  # pyright: ignore[reportAttributeAccessIssue]
    cached_detections(detector, store, path, "cpu")  # pyright: ignore[reportArgumentType]
    assert looks == [2, 2, 1, 1], "other weights, other frames, other pictures"


@pytest.mark.slow
def test_the_whole_study_and_going_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    words = ["retrain", "--quick", "--limit", "2", "--fresh", "1", "--benign-frames", "2", "--steps", "3"]
    words += ["--train-steps", "2", "--workers", "1", "--bootstrap", "5", "--out", str(out), "--json"]
    words += ["--states", "2"]
    assert main(words) == 0
    data = json.loads(capsys.readouterr().out)
    assert [r["name"] for r in data["rows"]] == [
        "benign detector",
        "retrained on benign re-rendered images",
        "retrained, ours",
    ]
    assert (data["frames"], data["benign_frames"], data["feasible_fraction"]) == (1, 2, 1.0)
    assert json.loads((out / "study.json").read_text()) == data
    assert (data["state_frames"], [row["arm"] for row in data["robust"]]) == (1, [BENIGN, "re-rendered", "ours"])
    assert data["robust"][0]["failures_anywhere"] is not None
    assert {row["goal"] for row in data["robust"]} == {None}
    assert (out / "robust.csv").is_file()
    folders = {path.name for path in (out / "arms").iterdir()}
    assert folders == {"combo-2", "held-out", "held-out-re-rendered", "held-out-ours"}
    learned, judged = ((out / "arms" / n / "frames" / "demo-000" / "benign.png") for n in ("combo-2", "held-out"))
    assert learned.read_bytes() != judged.read_bytes()
    settings = (out / "arms" / "held-out-ours" / "config.yaml").read_text()
    assert f"detector: {out / 'retrained' / 'ours' / 'retrained.safetensors'}" in settings

    def never(*_: object, **__: object) -> None:
        raise AssertionError("done before")

    (out / "study.json").unlink()
    with monkeypatch.context() as patch:
        for place, name in ((retraining_arms, "fine_tune"), (retraining, "detect_in_store"), (Attack, "__call__")):
            patch.setattr(place, name, never)
        assert main(words) == 0
    assert json.loads(capsys.readouterr().out) == data
    results = shutil.copytree(out / "results", tmp_path / "results")
    assert main(["retrain", "--from", str(results), "--out", str(tmp_path / "again"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == data
    for name in ("study.md", "study.csv", "robust.csv", "study.png"):
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes()
    # other weights: what was attacked with the old ones is no longer fresh
    shutil.copy(out / "retrained" / "ours" / "retrained.safetensors", out / "retrained" / "re-rendered")
    assert main(words) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows[1]["fresh_moved_ap50"] == rows[2]["fresh_moved_ap50"]
    assert main([*words, "--limit", "1"]) == 2, "other frames to train on"
    assert "other values of limit" in capsys.readouterr().err
