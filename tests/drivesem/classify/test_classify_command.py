"""`drivesem classify` as it is typed, on objects that are known."""

import json

import numpy as np
import pytest
import torch

from drivesem.classify import attack as attacking
from drivesem.classify import pictures, training
from drivesem.classify.networks import loading
from drivesem.cli import main
from scene_ir import files
from tests.drivesem.classify.conftest import Colours
from tests.drivesem.classify.standins import StandIns


@pytest.fixture
def standins(monkeypatch):
    """Boxes, balls and poles instead of the embedded objects, and the network that knows their colours by the name
    of a file.
    """
    objects = StandIns()
    for module in (pictures, training):
        monkeypatch.setattr(module, "open_objects", lambda source: objects)
    monkeypatch.setattr(
        attacking, "load_classifier", lambda name, classes, device: loading.prepare_for_inference(Colours(classes))
    )
    return objects


def answer(capsys, *words):
    """Exit code, the JSON, and what else was said."""
    code = main(["classify", *words, "--workers", "1"])
    said = capsys.readouterr()
    return code, json.loads(said.out) if said.out.startswith("{") else said.out, said.err


def test_attack(standins, tmp_path, capsys):
    out = tmp_path / "run"
    words = ("attack", "--out", str(out), "--params", "pose,lighting", "--views", "forward,left", "--json")
    code, data, _ = answer(capsys, *words)
    assert code == 0
    assert {"out", "objects", "accuracy", "grades", "queries", "seconds"} <= data.keys()
    assert set(data["accuracy"]) == {"benign", "attacked"}
    assert data["pictures"] == 12
    assert data["grades"]["certain"] <= data["grades"]["threshold"]
    frames = sorted((out / "frames").iterdir())
    assert len(frames) == 12
    results = [files.read_json(frame / "result.json") for frame in frames]
    right = [r["benign"]["predicted"] == r["label"] for r in results]
    wrong = [r["attacked"]["predicted"] != r["label"] for r in results]
    assert data["accuracy"]["benign"] == pytest.approx(sum(right) / 12, abs=1e-4)
    assert data["accuracy"]["attacked"] == pytest.approx(1 - sum(wrong) / 12, abs=1e-4)
    assert data["grades"]["threshold"] == sum(r and w for r, w in zip(right, wrong, strict=True))
    assert data["queries"] == sum(r["queries"] for r in results)
    page = (out / "report.html").read_text()
    assert page.count("data:image/jpeg") == 24
    assert "box-0008-forward" in page
    assert len((out / "classified.csv").read_text().splitlines()) == 13

    # what is written is what was judged, and the page's figures are those of the pictures
    network = loading.prepare_for_inference(Colours())
    for frame, result in zip(frames, results, strict=True):
        picture = torch.from_numpy(files.read_image(frame / "counterexample.png").transpose(2, 0, 1)).float() / 255
        scores = network(picture[None])[0]
        assert network.classes[int(scores.argmax())] == result["attacked"]["predicted"]
        theta = files.read_npz(frame / "theta.npz")["theta"]
        assert np.abs(theta).max() == pytest.approx(max(result["sizes"].values()), abs=1e-5)

    before = [(frame / "result.json").stat().st_mtime_ns for frame in frames]
    code, again, _ = answer(capsys, *words)
    assert [(frame / "result.json").stat().st_mtime_ns for frame in frames] == before
    assert {k: v for k, v in again.items() if k != "seconds"} == {k: v for k, v in data.items() if k != "seconds"}


def test_the_page_says_what_was_not_attacked(standins, monkeypatch, tmp_path, capsys):
    blind = Colours()
    with torch.no_grad():
        blind.score.weight[1] = 0  # nothing is called a ball
    monkeypatch.setattr(
        attacking, "load_classifier", lambda name, classes, device: loading.prepare_for_inference(blind)
    )
    words = ("--out", str(tmp_path / "run"), "--params", "pose", "--views", "forward", "--json")
    code, data, _ = answer(capsys, "attack", *words)
    assert code == 0
    balls = next(one for one in data["classes"] if one["name"] == "ball")
    assert balls["benign"] == 0 < balls["pictures"]
    page = (tmp_path / "run" / "report.html").read_text()
    assert page.count("wrong from the start and so not attacked") == balls["pictures"]
    assert page.count("yaw ") == data["pictures"] - balls["pictures"]


def test_attack_in_words(standins, tmp_path, capsys):
    code, told, _ = answer(capsys, "attack", "--out", str(tmp_path / "run"), "--limit", "3", "--method", "halton")
    assert code == 0
    assert "accuracy, %" in told
    assert f"written to {tmp_path / 'run' / 'report.html'}" in told


def test_limit_takes_classes_in_turn(standins, tmp_path, capsys):
    out = tmp_path / "run"
    assert answer(capsys, "attack", "--out", str(out), "--limit", "4", "--method", "random", "--json")[0] == 0
    names = [path.name for path in sorted((out / "frames").iterdir())]
    assert names == ["ball-0008-forward", "box-0008-forward", "box-0009-top", "pole-0008-forward"]


def test_data_and_training(standins, tmp_path, capsys):
    out = tmp_path / "pictures"
    code, data, _ = answer(capsys, "data", "--out", str(out), "--views", "left", "--json")
    assert (code, data["pictures"]) == (0, {"train": 18, "val": 6, "test": 6})
    assert files.read_image(out / "train" / "box" / "box-0000-left.png").shape == (224, 224, 3)
    code, trained, _ = answer(
        capsys, "train", "--data", str(out), "--out", str(tmp_path / "net"), "--epochs", "30", "--json"
    )
    assert code == 0
    assert trained["accuracy"]["train"] == 1.0
    low, high = trained["intervals"]["test"]
    assert 0 <= low < trained["accuracy"]["test"] <= high <= 1
    assert trained["intervals"]["train"] == [pytest.approx(18 / (18 + 1.96**2), abs=1e-3), 1.0]
    assert len(trained["epochs"]) == 30
    network = loading.load_classifier(trained["weights"], standins.classes)
    images, labels = pictures.read_pictures(out, "test", standins.classes)
    found = (network(images.float() / 255).argmax(1) == labels).float().mean()
    assert float(found) == pytest.approx(trained["accuracy"]["test"], abs=1e-3)


def test_the_whole_network_can_be_trained(standins, tmp_path, capsys):
    words = ("train", "--out", str(tmp_path / "net"), "--views", "left", "--limit", "3", "--layers", "all")
    code, trained, _ = answer(capsys, *words, "--epochs", "1", "--batch", "4", "--json")
    assert code == 0
    start = loading.load_for_training("squeezenet", None, standins.classes, torch.Generator())
    network = loading.load_classifier(trained["weights"], standins.classes)
    assert not torch.equal(network.get_parameter("conv1.weight"), start.get_parameter("conv1.weight"))


def test_equal_seeds_give_equal_networks_with_dropout_too(standins, tmp_path, capsys, monkeypatch):
    embed = loading.SqueezeNet.embed
    dropout = torch.nn.functional.dropout
    monkeypatch.setattr(loading.SqueezeNet, "embed", lambda self, x: dropout(embed(self, x), 0.5, self.training))
    words = ("train", "--views", "left", "--limit", "3", "--layers", "all", "--epochs", "1")
    for name in ("one", "other"):
        torch.rand(1)
        assert answer(capsys, *words, "--out", str(tmp_path / name))[0] == 0
    one, other = ((tmp_path / name / "squeezenet.safetensors").read_bytes() for name in ("one", "other"))
    assert one == other


def test_training_goes_on_to_the_bit(standins, tmp_path, capsys, monkeypatch):
    words = ("train", "--views", "left", "--limit", "3", "--layers", "all", "--epochs", "3", "--batch", "2")

    def train(name, *more):
        code, data, said = answer(capsys, *words, "--out", str(tmp_path / name), *more, "--json")
        return code, data, said

    _, whole, _ = train("whole")
    saved = training._State.save

    def dies(self, path, curve):
        saved(self, path, curve)
        if len(curve) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(training._State, "save", dies)
    code, _, _ = train("cut")
    assert code != 0
    assert not (tmp_path / "cut" / "squeezenet.safetensors").exists()
    asked = []
    monkeypatch.setattr(training._State, "save", lambda self, path, curve: asked.append(len(curve)))
    _, cut, _ = train("cut")
    assert asked == [3]
    assert (cut["epochs"], cut["accuracy"]) == (whole["epochs"], whole["accuracy"])
    weights = [(tmp_path / name / "squeezenet.safetensors").read_bytes() for name in ("whole", "cut")]
    assert weights[0] == weights[1]
    code, _, said = answer(capsys, *words[:3], "--limit", "2", *words[5:], "--out", str(tmp_path / "cut"))
    assert code == 2
    assert "limit" in said
    path = tmp_path / "cut" / "checkpoint.safetensors"
    facts, tensors = training.read_weights(path)
    others = training.read_weights(tmp_path / "cut" / "squeezenet.safetensors")
    for bad in (others, (facts | {"curve": "3"}, tensors), (facts | {"schedule": "3"}, tensors)):
        training.write_weights(path, *bad)
        code, _, said = train("cut")
        assert code == 2
        assert "checkpoint.safetensors: expected a checkpoint of this network" in said


def test_epochs_show_pictures_mirrored_and_at_half_the_size(standins, tmp_path, capsys, monkeypatch):
    seen = []
    embed = loading.SqueezeNet.embed

    def watched(self, images):
        if self.training:
            seen.append(images)
        return embed(self, images)

    monkeypatch.setattr(loading.SqueezeNet, "embed", watched)
    words = ("train", "--out", str(tmp_path / "net"), "--views", "left", "--limit", "3", "--layers", "all")
    more = ("--epochs", "6", "--half", "2", "--batch", "3", "--precision", "bfloat16")
    code, trained, _ = answer(capsys, *words, *more, "--json")
    assert (code, trained["pictures"]["train"]) == (0, 3)
    assert [tuple(images.shape) for images in seen] == [(3, 3, 112, 112)] * 2 + [(3, 3, 224, 224)] * 4
    images, _ = pictures.read_pictures(tmp_path / "net" / training.PICTURES, "train", standins.classes)
    known = [image.float() / 255 for image in images]
    shown = [image for images in seen[2:] for image in images]
    as_they_are = sum(any(torch.equal(image, one) for one in known) for image in shown)
    mirrored = sum(any(torch.equal(image, one.flip(-1)) for one in known) for image in shown)
    assert as_they_are + mirrored == len(shown) == 12
    assert min(as_they_are, mirrored) > 2


def test_bad_input_is_one_line_and_exit_code_2(standins, tmp_path, capsys, monkeypatch):
    (tmp_path / "empty").mkdir()
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "sky.png").write_bytes(b"\x89PNG no picture")
    cases = {
        ("--views", "back"): "--views: expected names among forward, top, left, right",
        ("--params", "colour"): "params: expected names among vertex, pose, lighting",
        ("--backgrounds", str(tmp_path / "gone")): "--backgrounds: expected a folder of photographs",
        ("--backgrounds", str(tmp_path / "empty")): "expected a folder with photographs",
        ("--backgrounds", str(tmp_path / "torn")): "sky.png",
        ("--weights", "x.pth"): "--weights: expected classify train",
        ("--half", "2"): "--half: expected classify train --layers all, found 2",
        ("--precision", "bfloat16"): "--precision: expected classify train --layers all, found bfloat16",
        ("--queries", "7"): "--queries: expected --method random, halton beside it, found si-fgsm",
        ("--step-pose", "0"): "--step-pose: expected a number above 0",
        ("--nuisances", "fog=1"): "--nuisances",
    }
    for words, message in cases.items():
        code, _, said = answer(capsys, "attack", "--out", str(tmp_path / "run"), "--limit", "1", *words)
        lines = [line for line in said.splitlines() if line.startswith("drivesem: ")]
        assert (code, len(lines)) == (2, 1), words
        assert message in lines[0]
    monkeypatch.setattr(attacking, "load_classifier", loading.load_classifier)
    code, _, said = answer(capsys, "attack", "--network", "resnet50")
    assert code == 2
    assert "--network: expected squeezenet, weights" in said


def test_an_object_that_cannot_be_used(standins, tmp_path, capsys):
    standins.broken = ("ball/0008",)
    words = ("attack", "--out", str(tmp_path / "run"), "--limit", "3", "--method", "random")
    code, _, said = answer(capsys, *words)
    assert code == 2
    assert "ball/0008: mesh.vertices[0, 0]: expected a finite value, found nan" in said
    code, data, _ = answer(capsys, *words, "--keep-going", "--json")
    assert code == 0
    assert list(data["frames_failed"]) == ["ball-0008-forward"]
    assert data["pictures"] == 2


def test_a_class_without_pictures(standins, tmp_path, capsys):
    for split in ("train", "val", "test"):
        for name in standins.classes:
            (tmp_path / "pictures" / split / name).mkdir(parents=True)
    words = ("train", "--data", str(tmp_path / "pictures"), "--out", str(tmp_path / "net"))
    code, _, said = answer(capsys, *words)
    assert code == 2
    assert "train/box: expected pictures of this class, found none" in said


@pytest.mark.parametrize("network", ["vgg16", "resnet50"])
def test_presets_are_the_papers(network):
    from drivesem.classify.methods import attacked_parameters, parameter_bounds, step_sizes
    from drivesem.config.parsing import parse

    table = {
        ("vgg16", "si-fgsm"): (0.002, 0.15),
        ("vgg16", "sgd"): (0.01, 0.20, 0.05, 1.0),
        ("vgg16", "scw"): (0.01, 0.30),
        ("resnet50", "si-fgsm"): (0.01, 0.45),
        ("resnet50", "sgd"): (0.01, 0.60, 0.05, 3.0),
        ("resnet50", "scw"): (0.01, 0.90),
    }
    for method in ("si-fgsm", "sgd", "scw"):
        config = parse(["classify", "attack", "--config", f"configs/classify-{network}-{method}.yaml"])
        steps, reach, expected = step_sizes(config), parameter_bounds(config), table[network, method]
        assert (config.method, config.steps) == (method, 5)
        assert (steps.vertex, steps.pose) == expected[:2]
        assert [str(one) for one in attacked_parameters(config)] == ["vertex", "pose"]
        if len(expected) > 2:
            assert (reach.vertex, reach.pose) == expected[2:]
        if network == "vgg16":
            usual = parse(["classify", "attack", "--method", method])
            assert (step_sizes(usual), parameter_bounds(usual)) == (steps, reach)
