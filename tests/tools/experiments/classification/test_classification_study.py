"""Experiment `classification` from the command line, on objects that are known."""

import functools
import json
import shutil

import numpy as np
import pytest
import torch
from torch import nn

from drivesem.classify import pictures, scenes
from drivesem.classify.networks import loading
from scene_ir import files
from tests.drivesem.classify.conftest import KINDS, ColourClassifier, SolidObjects
from tools.experiments.__main__ import main
from tools.experiments.classification import study as study_module
from tools.experiments.classification.arms import DIFFERENCES, STRATEGIES
from tools.experiments.classification.features import PIXEL_ATTACKS, PIXELS_HINT, attack_pixels, has_pixel_attacks
from tools.experiments.classification.study import TABLES, classify_features, retrain_last_layer


class Tints(ColourClassifier):
    """As `ColourClassifier`, with a last layer as others have."""

    architecture = "tints"

    def __init__(self, classes=KINDS) -> None:
        super().__init__(classes)
        weight = self.score.weight.detach()
        self.score = nn.Linear(3, len(classes))
        with torch.no_grad():
            self.score.weight.copy_(weight)
            self.score.bias.zero_()


@pytest.fixture
def two_networks(monkeypatch, tmp_path):
    """Small pictures of boxes, balls and poles; the files of two networks that go by colour."""
    for name, size in (("DRAWN_PX", 96), ("SEEN_PX", 64)):
        monkeypatch.setattr(scenes, name, size)
    monkeypatch.setattr(scenes, "picture_camera", functools.partial(scenes.picture_camera, 96))
    for module in (pictures, study_module):
        monkeypatch.setattr(module, "open_objects", lambda source: SolidObjects())
    monkeypatch.setitem(loading.ARCHITECTURES, Tints.architecture, Tints)
    paths = []
    for name in ("one", "two"):
        network = Tints()
        with torch.no_grad():
            network.score.bias[0] = {"one": 0.0, "two": 0.3}[name]
        paths.append(tmp_path / f"{name}.safetensors")
        loading.save_classifier(network, paths[-1], {})
    return ",".join(map(str, paths))


def study(capsys, *words):
    """Exit code, the JSON, and what else was said."""
    code = main(["classification", "--quick", "--workers", "1", "--bootstrap", "20", *words])
    output = capsys.readouterr()
    return code, json.loads(output.out) if output.out.startswith("{") else output.out, output.err


def test_sizes_need_no_attack(two_networks, tmp_path, capsys):
    words = ("--networks", two_networks, "--out", str(tmp_path / "out"), "--limit", "3", "--tables", "sizes")
    code, data, _ = study(capsys, *words, "--json")
    assert code == 0
    assert set(data["tables"]) == {"sizes"}
    counts = {row["class"]: row for row in data["tables"]["sizes"]["rows"]}
    assert counts["ball"] == {
        "class": "ball",
        "train objects": 6,
        "val objects": 2,
        "test objects": 2,
        "train pictures": 4,
        "test pictures": 1,
    }
    code, printed, _ = study(capsys, *words)
    assert code == 0
    assert "Sizes" in printed
    assert "skateboard (paper)" in (tmp_path / "out" / "study.md").read_text()


@pytest.mark.slow
def test_pixels(two_networks, tmp_path, capsys, monkeypatch):
    """Whatever attacks pixels, what comes of it is judged and measured: here all pictures become blue."""

    def blue(network, images, labels):
        assert images.shape == (3, 3, 64, 64)
        assert images.max() <= 1
        after = np.zeros(images.shape, np.uint8)
        after[:, 2] = 255
        return dict.fromkeys(PIXEL_ATTACKS, after)

    monkeypatch.setattr(study_module, "attack_pixels", blue)
    monkeypatch.setattr(study_module, "has_pixel_attacks", lambda: True)
    words = ("--networks", two_networks, "--out", str(tmp_path / "out"), "--limit", "3", "--tables", "pixels")
    words += ("--readings", "text")
    code, data, _ = study(capsys, *words, "--json")
    rows = data["tables"]["pixels"]["rows"]
    assert code == 0
    assert [(row["network"], row["strategy"]) for row in rows] == [
        (network, name) for network in ("one", "two") for name in PIXEL_ATTACKS
    ]
    assert all(row["overall"] == pytest.approx(1 / 3, abs=1e-4) for row in rows)  # the pole, which is blue
    assert all(row["distance"] > 0 for row in rows)
    monkeypatch.setattr(study_module, "has_pixel_attacks", lambda: False)
    code, data, _ = study(capsys, *words, "--json")
    assert (code, data["tables"]["pixels"]["rows"]) == (0, [])
    assert PIXELS_HINT in data["tables"]["pixels"]["notes"][0]


@pytest.mark.slow
def test_transfer(two_networks, tmp_path, capsys):
    words = ("--networks", two_networks, "--out", str(tmp_path / "out"), "--limit", "3", "--json")
    words += ("--readings", "text")
    code, data, _ = study(capsys, *words, "--tables", "transfer")
    assert code == 0
    assert set(data["tables"]) == {"transfer"}
    rows = data["tables"]["transfer"]["rows"]
    assert [(r["source"], r["target"]) for r in rows[::4]] == [("one", "two"), ("two", "one")]
    assert [r["strategy"] for r in rows[:4]] == ["benign", "si-fgsm", "sgd", "scw"]
    assert sorted(path.name for path in (tmp_path / "out" / "arms").iterdir()) == sorted(
        f"{network}-{method}" for network in ("one", "two") for method in ("si-fgsm", "sgd", "scw", "timing")
    )
    # what the second network says of the first one's pictures, looked up anew
    network = loading.load_classifier(two_networks.split(",")[1], KINDS)
    right = []
    for frame in sorted((tmp_path / "out" / "arms" / "one-sgd" / "frames").iterdir()):
        image = torch.from_numpy(files.read_image(frame / "counterexample.png").transpose(2, 0, 1)).float() / 255
        right.append(KINDS[int(network(image[None])[0].argmax())] == frame.name.partition("-")[0])
    assert rows[2]["overall"] == pytest.approx(np.mean(right), abs=1e-4)


@pytest.mark.slow
def test_all_tables(two_networks, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    words = ("--networks", two_networks, "--out", str(out), "--limit", "6", "--fresh", "3", "--tables")
    words += (",".join(TABLES), "--readings", "text", "--whole-pictures", "6")
    code, data, printed = study(capsys, *words, "--train-pictures", "12", "--json")
    assert code == 0
    assert "hours of one process" in printed
    tables = data["tables"]
    assert set(tables) == {*TABLES, "orders"}
    for name, table in tables.items():
        assert table["rows"] or (name == "pixels" and not has_pixel_attacks()), name
        assert bool(table["reference"]) == (name not in ("attribution", "orders", "pixels"))
    assert data["pictures"] == {"test": 6, "train": 12, "retrained": 3, "whole": 6}
    rows = tables["degradation"]["rows"]
    assert [row["strategy"] for row in rows] == 2 * ["benign", *STRATEGIES]
    differences = {row["difference"] for row in tables["attribution"]["rows"] if row["network"] == "two"}
    assert differences == set(DIFFERENCES)
    for row in rows:
        assert row["overall"] == pytest.approx(np.mean([row[kind] for kind in KINDS]), abs=1e-4)
        assert row["overall_low"] <= row["overall"] <= row["overall_high"]
    for table in ("retraining", "robustness"):
        assert [row["trained_on"] for row in tables[table]["rows"]][-3:] == ["si-fgsm", "sgd", "scw"]
    worth = {(r["network"], r["strategy"], r["membership"], r["weighted"]): r for r in tables["worth"]["rows"]}
    assert len(worth) == 2 * 8 * 2 * 3
    assert "gain" in worth["one", "sgd", "binary", "class"]
    assert {row["verdict"] for row in tables["orders"]["rows"]} <= {"holds", "reversed", "undecided"}
    assert len((out / "study.md").read_text().split("\n## ")) == len(tables) + 1
    # a second time nothing is attacked, and all is as it was
    before = {path: path.stat().st_mtime_ns for path in out.rglob("result.json")}
    code, again, _ = study(capsys, *words, "--train-pictures", "12", "--json")
    assert (code, again) == (0, data)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("result.json")} == before
    # and what is kept tells the same without objects, networks or run
    stored = shutil.copytree(out / "results", tmp_path / "results")
    with monkeypatch.context() as patch:
        patch.setattr(study_module, "open_objects", None)
        assert main(["classification", "--from", str(stored), "--json"]) == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed | {"out": str(out)} == data
        assert main(["classification", "--from", str(stored), "--out", str(tmp_path / "again")]) == 0
    for name in ("study.md", "worth.csv", "orders.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes()
    capsys.readouterr()
    code, _, output = study(capsys, *words, "--train-pictures", "24")
    assert code == 2
    assert "other values of train_pictures" in output


@pytest.mark.slow
def test_both_readings(two_networks, tmp_path, capsys, monkeypatch):
    out, one = tmp_path / "out", two_networks.partition(",")[0]
    sizes = ("--limit", "3", "--fresh", "1", "--train-pictures", "3", "--whole-pictures", "3")
    words = (
        "--networks",
        one,
        "--out",
        str(out),
        *sizes,
        "--tables",
        "degradation,retraining,robustness",
        "--json",
    )
    save = study_module.save_classifier

    def interrupt(*arguments):
        monkeypatch.setattr(study_module, "save_classifier", save)
        raise KeyboardInterrupt

    monkeypatch.setattr(study_module, "save_classifier", interrupt)
    assert study(capsys, *words)[0] != 0
    code, data, _ = study(capsys, *words)
    assert code == 0
    rows = data["tables"]["degradation"]["rows"]
    assert [row["network"] for row in rows[::8]] == ["one", "one-code"]
    for table in ("retraining", "robustness"):
        assert {row["network"] for row in data["tables"][table]["rows"]} == {"one", "one-code"}
    # The code's network has seen the coloured lamp and has its normalisation, and its attacks its settings.
    network = loading.load_classifier(str(out / "retrained" / "one-code.safetensors"), KINDS)
    assert network.mean.flatten().tolist() == pytest.approx([0.6109, 0.7387, 0.7765])
    settings = [(out / "arms" / f"one{name}-scw" / "config.yaml").read_text() for name in ("", "-code")]
    assert ["turns: compose" in text for text in settings] == [False, True]
    first = next((out / "arms" / "one-scw" / "frames").iterdir()).name
    pictures = [
        files.read_image(out / "arms" / f"one{name}-scw" / "frames" / first / "benign.png")
        for name in ("", "-code")
    ]
    assert (pictures[0] != pictures[1]).any()
    # Another table adds arms, and repeats none.
    before = {path: path.stat().st_mtime_ns for path in out.rglob("result.json")}
    code, data, _ = study(capsys, *words[:-3], "--tables", "attribution", "--json")
    assert code == 0
    found = {row["difference"]: row for row in data["tables"]["attribution"]["rows"]}
    assert set(found) == set(DIFFERENCES)
    for row in found.values():
        assert row["effect"] == pytest.approx(row["as_code"] - row["as_text"], abs=1e-4)
        assert row["effect_low"] <= row["effect"] <= row["effect_high"]
    assert all(path.stat().st_mtime_ns == at for path, at in before.items())


def test_bad_input_is_one_line_and_exit_code_2(two_networks, tmp_path, capsys):
    one = two_networks.partition(",")[0]
    cases = {
        ("--tables", "accuracy"): "--tables: expected names among degradation, ",
        ("--networks", f"{one},{one}"): "--networks: expected networks with commas, each of another name",
        ("--readings", "paper"): "--readings: expected names among text, code",
        ("--networks", "vgg16"): "--network: expected squeezenet, weights",
        ("--networks", str(tmp_path / "gone.safetensors")): "gone.safetensors",
        ("--backgrounds", str(tmp_path / "gone")): "--backgrounds: expected a folder of photographs",
    }
    for words, message in cases.items():
        code, _, output = study(capsys, "--out", str(tmp_path / "out"), *words)
        lines = [line for line in output.splitlines() if line.startswith("python -m tools.experiments: ")]
        assert (code, len(lines)) == (2, 1), words
        assert message in lines[0]


@pytest.mark.skipif(not has_pixel_attacks(), reason=f"needs the toolbox: {PIXELS_HINT}")
def test_attacks_on_pixels_keep_near():
    network, generator = loading.prepare_for_inference(Tints()), torch.Generator().manual_seed(0)
    images = (0.5 + 0.02 * torch.rand((6, 3, 32, 32), generator=generator)).numpy()
    labels = network(torch.from_numpy(images)).argmax(1).numpy()
    found = attack_pixels(network, images, labels)
    assert tuple(found) == PIXEL_ATTACKS
    assert bool((network(torch.from_numpy(images)).argmax(1).numpy() == labels).all())
    for name in PIXEL_ATTACKS[:2]:
        assert np.abs(found[name] / 255 - images).max() < 4.6 / 255
        output = network(torch.from_numpy(found[name]) / 255).argmax(1).numpy()
        assert not bool((output == labels).any())


def test_a_retrained_network_knows_what_it_was_given(tmp_path):
    """Pictures whose colours are swapped are learnt; the file is what the network is."""
    network, generator = loading.prepare_for_inference(Tints()), torch.Generator().manual_seed(0)
    network.last.weight.mul_(0.01)
    labels = torch.arange(60) % 3
    features = torch.eye(3)[labels].roll(1, 1) + 0.1 * torch.rand(60, 3, generator=generator)
    loading.ARCHITECTURES["tints"] = Tints
    try:
        learnt = retrain_last_layer(network, tmp_path / "x.safetensors", features, labels, 0, "cpu")
    finally:
        del loading.ARCHITECTURES["tints"]
    assert not classify_features(network, features, labels.tolist()).any()
    assert classify_features(learnt, features, labels.tolist()).all()
