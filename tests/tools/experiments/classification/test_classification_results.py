"""What the study of classifiers keeps: read back it tells the same, and what is damaged is refused in one line."""

import gzip
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from scene_ir.errors import FormatError
from tools.experiments.classification.arms import BENIGN, CONTROL, DIFFERENCES, STRATEGIES
from tools.experiments.classification.features import PIXEL_ATTACKS
from tools.experiments.classification.results import (
    OVERALL,
    ClassificationResults,
    StudyFacts,
    StudyNetwork,
    load_results,
    save_results,
)
from tools.experiments.classification.tables import build_tables
from tools.experiments.settings import StudyConfig

CLASSES = ("box", "ball")
PICTURES = ("box/0", "box/0", "ball/0", "ball/1", "box/1")
FACTS = StudyFacts(
    settings=StudyConfig(name="classification", quick=True, bootstrap=30, seed=4),
    classes=CLASSES,
    networks=(
        StudyNetwork("one", "vgg16"),
        StudyNetwork("two", "resnet50", takes_normalisation=False),
    ),
    tables=("degradation", "worth", "realism", "transfer", "attribution", "pixels", "sizes"),
    measures=("psnr", "ssim", "frechet"),
    distance="perceptual",
    toolbox=True,
    pictures=PICTURES,
    retested=(0, 2),
    counts={"test": 5, "train": 8, "retrained": 2, "whole": 4},
    objects={split: {"box": 2, "ball": 3} for split in ("train", "val", "test")},
    used={split: {"box": 3, "ball": 2} for split in ("test", "train")},
    failed={"box-9": "no, camera"},
)


@pytest.fixture
def results() -> ClassificationResults:
    """Random results, as a study records them."""
    draw, names, count = np.random.default_rng(0), ("one", "two"), len(PICTURES)
    strategies = (BENIGN, *STRATEGIES)

    def right() -> np.ndarray:
        return draw.random(count) < 0.6

    found = ClassificationResults(FACTS)
    for name, strategy in product(names, strategies):
        found.correct["attacked", name, strategy, "test"] = right()
        found.correct["crossed", name, strategy, "two" if name == "one" else "one"] = right()
        found.certain_failures[name, strategy] = None
        for trained in ("", strategy):
            found.probabilities[name, strategy, trained] = draw.dirichlet((0.4, 0.6), count)
        for metric in ("psnr", "ssim", "perceptual"):
            found.distances["counterexamples", name, strategy, metric] = draw.random(count) / 3
        for kind in (*CLASSES, OVERALL):
            found.sets[name, strategy, "frechet", kind] = None if kind == "ball" else float(draw.random())
    for name, attack in product(names, PIXEL_ATTACKS):
        found.correct["pixels", name, attack, ""] = right()
        found.distances["pixels", name, attack, ""] = draw.random(count)
    for name, difference, strategy in product(names, (CONTROL, *DIFFERENCES), STRATEGIES):
        found.correct["attacked", name, strategy, f"with {difference}"] = right()
    return found


def test_results_come_back(results: ClassificationResults, tmp_path: Path) -> None:
    save_results(tmp_path / "results", results)
    again = load_results(tmp_path / "results")
    assert again.facts == FACTS
    tables = build_tables(results)
    assert build_tables(again) == tables
    assert [table.name for table in tables] == [*FACTS.tables, "orders"]
    assert any(row["worth_low"] < row["worth_high"] for row in tables[1].rows)
    save_results(tmp_path / "again", again)
    for path in (tmp_path / "results").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()


def test_the_effect_of_a_difference_by_hand(results: ClassificationResults) -> None:
    """Three of five are right by the text, one of them and no other by the code: an effect of -2/5."""
    results.correct["attacked", "one", "scw", "test"] = np.array([True, True, True, False, False])
    results.correct["attacked", "one", "scw", "with scw-step"] = np.array([True, False, False, False, False])
    rows = next(table for table in build_tables(results) if table.name == "attribution").rows
    row = next(r for r in rows if (r["network"], r["difference"]) == ("one", "scw-step"))
    assert (row["as_text"], row["as_code"], row["effect"]) == (0.6, 0.2, -0.4)
    assert row["effect_low"] <= -0.4 <= row["effect_high"]
    normalised = [r["network"] for r in rows if r["difference"] == "normalisation"]
    assert normalised == ["one"]  # --quick: one strategy each
    assert len(rows) == 8 + 6


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("study.json", '"name": "classification"', '"name": "multi"', "settings.name: expected classification"),
        ("predictions.csv", "what,network", "network,what", "predictions.csv: expected columns what, network"),
        ("distances.csv.gz", "benign,psnr,0,", "benign,psnr,x,", ":2: picture: expected a value of this column"),
        ("probabilities.csv.gz", "one,benign,,0,box,", "one,other,,0,box,", "expected tables that fit together"),
    ],
)
def test_damaged_results_are_refused_in_one_line(
    file: str, old: str, new: str, message: str, results: ClassificationResults, tmp_path: Path
) -> None:
    save_results(tmp_path / "results", results)
    path, packed = tmp_path / "results" / file, file.endswith(".gz")
    text = gzip.decompress(path.read_bytes()).decode() if packed else path.read_text()
    assert old in text
    data = text.replace(old, new, 1).encode()
    path.write_bytes(gzip.compress(data) if packed else data)
    with pytest.raises(FormatError, match=message) as refused:
        build_tables(load_results(tmp_path / "results"))
    assert "\n" not in str(refused.value)
