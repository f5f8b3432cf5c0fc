"""What transfer and retrain keep: read back they tell the same, and what is damaged is refused in one line."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detectors.types import CLASSES
from drivesem.analysis.transfer.matrix import PairCounts, ShownRun, Target
from drivesem.config.commands import Study
from drivesem.evaluation.matches import FALSE, IGNORED, TRUE, Matches
from drivesem.failures.grades import Grade
from drivesem.run.frame import as_detections
from drivesem.run.results import BoxRecord, Failure, FrameResult
from scene_ir.errors import FormatError
from tools.experiments.detection.counts import ArmCounts
from tools.experiments.detection.kept_retrain import keep_retrain, load_retrain
from tools.experiments.detection.kept_transfer import keep_transfer, load_transfer
from tools.experiments.detection.lessons import BENIGN, lessons_of
from tools.experiments.detection.robust import ANYWHERE, AROUND, REDRAWN, Counted, FrameStates
from tools.experiments.detection.running import AttackFacts
from tools.experiments.detection.taught import RetrainCounts, SeenBenign, taught
from tools.experiments.detection.transfer import AskedArm, TransferCounts, matrix_of

DRAWS = 20
SURE = Failure("lost", "Car", (0.0, 0.0, 9.0, 9.0), 0, grade=Grade.CERTAIN)
CYCLIST = BoxRecord((300.0, 20.0, 330.0, 60.0), "Cyclist", score=0.123456)
FEW = ("Car", "Truck")


def before(
    results: Sequence[FrameResult], run: str, target: str, classes: tuple[str, ...], missed: Sequence[int] = ()
) -> PairCounts:
    """A run before a detector that finds nothing in some of the photographs rendered again, and what the run's own
    finds elsewhere.
    """

    def seen(records: Sequence[BoxRecord]) -> Any:
        return as_detections(tuple(one for one in records if one.label in classes), classes)

    found = {
        "benign": [seen((*r.detections_benign, CYCLIST)) for r in results],
        "rerendered": [
            seen(() if i in missed else (*r.detections_benign, CYCLIST)) for i, r in enumerate(results)
        ],
        "attacked": [seen(r.detections_attacked) for r in results],
    }
    source, asked = ShownRun(run, "squeezedet", "si-fgsm", "rotate"), Target(target, target, classes, 0.35)
    return PairCounts.of(source, asked, results, found)


def with_cyclist(results: list[FrameResult]) -> list[FrameResult]:
    """One who is there in the first frame, and made up in the others."""
    there = replace(CYCLIST, score=None, index=2)
    first = results[0]
    sides = {name: (*getattr(first, name), there) for name in ("targets_benign", "targets_moved")}
    return [replace(first, **sides), *results[1:]]


@pytest.fixture
def attacked(frame: Callable[..., FrameResult]) -> list[FrameResult]:
    """Four frames: the car moves, and is lost in two of them, once for certain; a phantom is between them."""
    frames = [frame(f"{i:03d}", moved_by=9.0 * i, found=i < 2, success=i >= 2) for i in range(4)]
    phantom = replace(frames[3].detections_attacked[0], xyxy=(400.0, 20.0, 440.0, 60.0), score=0.5)
    failed = replace(frames[3], detections_attacked=(*frames[3].detections_attacked, phantom))
    return with_cyclist([*frames[:2], replace(frames[2], failures=(SURE,)), failed])


def transferred(
    attacked: Sequence[FrameResult], frame: Callable[..., FrameResult]
) -> tuple[Study, TransferCounts]:
    """A run and its placebo before two detectors, one of which knows fewer classes."""
    study = Study(name="transfer", bootstrap=DRAWS, seed=3, out="elsewhere")
    still = with_cyclist([frame(f"{i:03d}") for i in range(4)])
    pairs = [
        before(results, run, target, classes, missed)
        for run, results in (("squeezedet", attacked), ("squeezedet placebo", still))
        for target, classes, missed in (("squeezedet", CLASSES, [1]), ("other", FEW, []))
    ]
    source = AskedArm("squeezedet", "squeezedet placebo", {"other": (0.9128, 0.875)})
    facts = AttackFacts(4, 8, 7, 2, {"009": "no, camera"})
    return study, TransferCounts(facts, (source,), pairs, {"a.png": "cut off"})


def retrained(
    attacked: list[FrameResult], frame: Callable[..., FrameResult], run: Callable[..., ArmCounts], arm: Any
) -> tuple[Study, RetrainCounts]:
    """A detector as it was and two lessons; the second renderer drew one of three frames."""
    study = Study(name="retrain", quick=True, bootstrap=DRAWS, arms="benign,random,ours")
    lessons = [lesson.name for lesson in lessons_of(study)]
    names = [BENIGN, *lessons]
    draw = np.random.default_rng(0)

    def benign() -> Matches:
        marks = draw.choice([FALSE, TRUE, IGNORED], (9, 10))
        return Matches(
            np.repeat(np.arange(3), 3), draw.random(9, np.float32).astype(np.float64), marks, np.full(3, 3.0)
        )

    def states(number: int) -> FrameStates:
        kinds = (ANYWHERE, REDRAWN, AROUND) if number == 1 else (ANYWHERE, AROUND)
        lost = {kind: tuple(draw.integers(0, 9, len(names)).tolist()) for kind in kinds}
        return FrameStates(
            f"{number:03d}", "digest", {kind: Counted(9, own, 8, own[::-1]) for kind, own in lost.items()}, "why"
        )

    return study, RetrainCounts(
        attack="combo 2",
        learned=AttackFacts(4, 8, 8, 1, {}),
        judged=AttackFacts(4, 16, 16, 0, {"9": "no camera"}),
        shown=dict.fromkeys(lessons, 3),
        benign=7,
        benign_frames=("a", "b", "c"),
        seen={name: SeenBenign(benign(), 0.25 + 0.1 * i) for i, name in enumerate(names)},
        known=[before(attacked, BENIGN, name, CLASSES) for name in names],
        fresh=[run(arm(name), attacked[i:] + attacked[:i]) for i, name in enumerate(names)],
        left_out={"the same, consistently": "no failure"},
        states=[states(number) for number in range(3)],
    )


@pytest.fixture
def transfer(attacked: list[FrameResult], frame: Callable[..., FrameResult]) -> tuple[Study, TransferCounts]:
    return transferred(attacked, frame)


@pytest.fixture
def retrain(
    attacked: list[FrameResult],
    frame: Callable[..., FrameResult],
    counted: Callable[..., ArmCounts],
    arm: Callable[..., Any],
) -> tuple[Study, RetrainCounts]:
    # arms of one study have the same frames in one order
    names = [one.identifier for one in attacked]
    same = lambda of, results: counted(  # noqa: E731
        of, [replace(one, identifier=name) for one, name in zip(results, names, strict=True)]
    )
    return retrained(attacked, frame, same, arm)


def test_transfer_tells_the_same_again(transfer: tuple[Study, TransferCounts], tmp_path: Path) -> None:
    study, counts = transfer
    keep_transfer(tmp_path / "kept", study, counts)
    settings, again = load_transfer(tmp_path / "kept")
    assert settings == replace(study, out=None)
    data, other = (matrix_of(study, one).to_json() for one in (counts, again))
    assert other == data
    own, elsewhere = data["rows"]
    assert own["drop_moved_low"] < own["drop_moved"]
    assert (own["certain_rate"], own["lost"], own["phantoms"]) == (1.0, 2, 1)
    assert own["rerendered_ap50"] < own["benign_ap50"]
    assert elsewhere["reference_drop"] == pytest.approx(0.0378)
    assert (data["frames_failed"], data["feasible_fraction"]) == ({"009": "no, camera", "a.png": "cut off"}, 7 / 8)
    assert own["benign_map50"] == own["benign_ap50"] == 1
    # the placebo shares the photographs; nobody is made up where no true one has a lower score
    text = gzip.decompress((tmp_path / "kept" / "detections.csv.gz").read_bytes()).decode()
    assert text.count("photograph") == 4 * 3 + 4 * 2
    assert text.count("re-render") == 0  # nothing was found there
    assert text.count(",Cyclist,") == 4


def test_retrain_tells_the_same_again(retrain: tuple[Study, RetrainCounts], tmp_path: Path) -> None:
    study, counts = retrain
    keep_retrain(tmp_path / "kept", study, counts)
    settings, again = load_retrain(tmp_path / "kept")
    assert settings == study
    data, other = (taught(study, one).to_json() for one in (counts, again))
    assert other == data
    json.dumps(data, allow_nan=False)
    assert [row["name"] for row in data["rows"]] == list(counts.seen)
    assert data["robust"][0]["failures_redrawn"] is not None
    assert [row["goal"] for row in data["robust"]] == [None, None, None, False]
    assert data["rows"][1]["benign_drop_low"] < data["rows"][1]["benign_drop_high"]
    assert data["left_out"] == {"the same, consistently": "no failure"}
    keep_retrain(tmp_path / "again", settings, again)
    for path in sorted((tmp_path / "kept").rglob("*.*")):
        assert path.read_bytes() == (tmp_path / "again" / path.relative_to(tmp_path / "kept")).read_bytes()


def test_without_new_attacks_or_states(retrain: tuple[Study, RetrainCounts], tmp_path: Path) -> None:
    study, counts = retrain
    less = replace(counts, fresh=counts.fresh[:1], states=())
    keep_retrain(tmp_path / "kept", study, less)
    _, again = load_retrain(tmp_path / "kept")
    assert taught(study, again).to_json() == taught(study, less).to_json()


def refused(load: Callable[[Path], object], kept: Path, message: str) -> None:
    """In one line."""
    with pytest.raises(FormatError, match=message) as error:
        load(kept)
    assert "\n" not in str(error.value)


def changed(path: Path, before: str, after: str) -> None:
    packed = path.suffix == ".gz"
    text = gzip.decompress(path.read_bytes()).decode() if packed else path.read_text()
    assert before in text
    data = text.replace(before, after, 1).encode()
    path.write_bytes(gzip.compress(data) if packed else data)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("study.json", '"feasible": 7', '"feasible": 9', "attacks.feasible: expected 0 to 8, found 9"),
        (
            "study.json",
            '"placebo": "squeezedet placebo"',
            '"placebo": "x"',
            r"placebo: expected a run of the same",
        ),
        ("study.json", "0.9128", "91.28", "references.other: expected from 0 to 1"),
        ("study.json", '"name": "transfer"', '"name": "multi"', "settings.name: expected transfer, found multi"),
        ("pairs.json", '"t_star": 0.35', '"t_star": 35', "t_star: score: expected 0 to 1, found 35"),
        ("pairs.json", '"Truck"', '"Tram"', r"pairs\[0\].target.classes: expected Car and others of"),
        ("pairs.json", '"name": "other"', '"name": "squeezedet"', "pairs: expected each pair once"),
        ("frames.csv", ",2,0,0,0,", ",2,3,0,0,", "frames.csv:2: lost: expected 0 to 2, found 3"),
        ("frames.csv", ",2,0,0,0,", ",2,-1,0,0,", "frames.csv:2: lost: expected 0 to 2, found -1"),
        ("frames.csv", "squeezedet,001", "squeezedet,000", "frames.csv:3: expected each frame once a pair"),
        ("frames.csv", "squeezedet,other", "squeezedet,another", "expected a pair of pairs.json"),
        ("frames.csv", "placebo,other,000,squeezedet", "placebo,other,000,x", "photograph: expected a run that"),
        ("objects.csv.gz", "Car,2,2", "Car,1,2", "Car: expected no more true ones than objects"),
        ("objects.csv.gz", "Car,2,2", "Tram,2,2", "objects.csv.gz:2: category: expected one of Car"),
        ("detections.csv.gz", "photograph,Car", "photo,Car", ":2: picture: expected one of photograph, re-render"),
        ("detections.csv.gz", "photograph,Car", "re-render,Car", "no picture of which another's"),
        ("detections.csv.gz", ",0.9,t,", ",0.9,tx,", ":2: benign: expected at most 10 of the letters fti"),
        ("detections.csv.gz", ",0.9,t,\n", ",0.9,t,t\n", ":2: moved: expected of counterexamples alone"),
        ("detections.csv.gz", ",0.9,t,", ",1.9,t,", ":2: score: expected 0 to 1"),
    ],
)
def test_what_is_damaged_of_transfer_is_one_line(
    file: str, old: str, new: str, message: str, transfer: tuple[Study, TransferCounts], tmp_path: Path
) -> None:
    keep_transfer(tmp_path / "kept", *transfer)
    changed(tmp_path / "kept" / file, old, new)
    refused(load_transfer, tmp_path / "kept", message)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("study.json", '"retrained, ours": 3', '"theirs": 3', "shown: expected lessons of these settings"),
        ("study.json", '"retrained, ours": 0.55', '"theirs": 0.5', "detectors: expected benign detector, "),
        ("study.json", '"frames": 4,\n  "pictures": 16', '"frames": 5,\n  "pictures": 16', "judged.frames"),
        ("benign.csv", "b,3", "a,3", "benign.csv:3: frame: expected each once"),
        ("benign.csv", "a,3", "a,0", "benign detector: expected no more true ones than objects"),
        ("benign_detections.csv.gz", "benign detector,a", "x,a", ":2: expected a detector of study.json"),
        (
            "states.csv.gz",
            "000,anywhere",
            "000,nowhere",
            "states.csv.gz:2: kind: expected one of anywhere, redrawn",
        ),
        ("states.csv.gz", "detector,9,", "detector,1,", "states.csv.gz:2: lost: expected 0 to 1"),
        ("states.csv.gz", "detector,9,", "detector,99,", "000, anywhere: expected as many cars and pictures"),
        ("states.csv.gz", "000,anywhere,benign detector", "009,anywhere,benign detector", "expected a row of"),
        ("known/pairs.json", '"retrained, ours"', '"theirs"', "known|pair of pairs.json"),
        ("fresh/study.json", '"retrained, ours"', '"theirs"', "fresh.*expected"),
    ],
)
def test_what_is_damaged_of_retrain_is_one_line(
    file: str, old: str, new: str, message: str, retrain: tuple[Study, RetrainCounts], tmp_path: Path
) -> None:
    keep_retrain(tmp_path / "kept", *retrain)
    changed(tmp_path / "kept" / file, old, new)
    refused(load_retrain, tmp_path / "kept", message)
