"""What the study of classifiers keeps: read back it tells the same, and what is damaged is refused in one line."""

from __future__ import annotations

import gzip
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from drivesem.config.commands import Study
from scene_ir.errors import FormatError
from tools.experiments.classification import pixels
from tools.experiments.classification.arms import STRATEGIES
from tools.experiments.classification.kept import keep_results, load_results
from tools.experiments.classification.lab import BENIGN
from tools.experiments.classification.results import OVERALL, Facts, Network, Results
from tools.experiments.classification.tables import tables_of

CLASSES = ("box", "ball")
PICTURES = ("box/0", "box/0", "ball/0", "ball/1", "box/1")
FACTS = Facts(
    study=Study(name="classification", quick=True, bootstrap=30, seed=4),
    classes=CLASSES,
    networks=(Network("one", "vgg16", deep=True), Network("two", "resnet50", deep=False)),
    tables=("degradation", "worth", "realism", "transfer", "pixels", "sizes"),
    measures=("psnr", "ssim", "frechet"),
    distance="perceptual",
    toolbox=True,
    pictures=PICTURES,
    few=(0, 2),
    counts={"test": 5, "train": 8, "retrained": 2},
    objects={split: {"box": 2, "ball": 3} for split in ("train", "val", "test")},
    used={split: {"box": 3, "ball": 2} for split in ("test", "train")},
    failed={"box-9": "no, camera"},
)


@pytest.fixture
def results() -> Results:
    """Made up, but as a study notes it."""
    draw, names, count = np.random.default_rng(0), ("one", "two"), len(PICTURES)
    strategies = (BENIGN, *STRATEGIES)

    def right() -> np.ndarray:
        return draw.random(count) < 0.6

    found = Results(FACTS)
    for name, strategy in product(names, strategies):
        found.right["attacked", name, strategy, "test"] = right()
        found.right["crossed", name, strategy, "two" if name == "one" else "one"] = right()
        found.certain[name, strategy] = None
        for trained in ("", strategy):
            found.chances[name, strategy, trained] = draw.dirichlet((0.4, 0.6), count)
        for metric in ("psnr", "ssim", "perceptual"):
            found.distances["counterexamples", name, strategy, metric] = draw.random(count) / 3
        for kind in (*CLASSES, OVERALL):
            found.sets[name, strategy, "frechet", kind] = None if kind == "ball" else float(draw.random())
    for attack in pixels.ATTACKS:
        found.right["pixels", "one", attack, ""] = right()
        found.distances["pixels", "one", attack, ""] = draw.random(count)
    return found


def test_it_tells_the_same_again(results: Results, tmp_path: Path) -> None:
    keep_results(tmp_path / "kept", results)
    again = load_results(tmp_path / "kept")
    assert again.facts == FACTS
    told = tables_of(results)
    assert tables_of(again) == told
    assert [table.name for table in told] == [*FACTS.tables, "orders"]
    assert any(row["worth_low"] < row["worth_high"] for row in told[1].rows)
    keep_results(tmp_path / "again", again)
    for path in (tmp_path / "kept").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("study.json", '"name": "classification"', '"name": "multi"', "settings.name: expected classification"),
        (
            "study.json",
            '"tables": [\n   "degradation"',
            '"tables": [\n   "all"',
            "tables: expected of deg",
        ),
        ("study.json", '"distance": "perceptual"', '"distance": "fid"', "distance: expected one of pictures"),
        ("study.json", '"box/1"', '"tram/1"', "pictures: expected objects of these classes"),
        ("study.json", '"few": [\n   0', '"few": [\n   7', "few: expected 0 to 4, found 7"),
        ("study.json", '"val"', '"value"', "objects: expected train, val, test, each class"),
        ("answers.csv", "attacked,one,benign,test,", "attacked,one,benign,test,1", ":2: right: expected 5 of"),
        ("answers.csv", "attacked,one,sgd,test", "attacked,one,si-fgsm,test", "each set of pictures once"),
        (
            "answers.csv",
            "attacked,two,sgd,test",
            "attacked,two,xgd,test",
            "expected figures of attacked, two, sgd",
        ),
        ("distances.csv.gz", "benign,psnr,1,", "benign,psnr,3,", ":3: picture: expected 1, of 5, found 3"),
        ("distances.csv.gz", "benign,psnr,0,", "benign,psnr,0,-", ":2: distance: expected at least 0"),
        ("chances.csv.gz", "one,benign,,0,0", "one,benign,,0,x0", ":2: chances: expected numbers"),
        ("chances.csv.gz", "one,benign,,0,0", "one,benign,,0,7", ":2: chances: expected 2 from 0 to 1"),
        ("sets.csv", "frechet,box,", "frechet,tram,", "sets.csv:2: kind: expected a class or overall"),
    ],
)
def test_what_is_damaged_is_one_line(
    file: str, old: str, new: str, message: str, results: Results, tmp_path: Path
) -> None:
    keep_results(tmp_path / "kept", results)
    path, packed = tmp_path / "kept" / file, file.endswith(".gz")
    text = gzip.decompress(path.read_bytes()).decode() if packed else path.read_text()
    assert old in text
    data = text.replace(old, new, 1).encode()
    path.write_bytes(gzip.compress(data) if packed else data)
    with pytest.raises(FormatError, match=message) as refused:
        tables_of(load_results(tmp_path / "kept"))
    assert "\n" not in str(refused.value)
