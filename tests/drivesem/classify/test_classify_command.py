"""`drivesem classify data | train | attack` as typed, on objects with known outcomes."""

import numpy as np
import pytest
import torch

from drivesem.classify import attack, pictures, training
from drivesem.classify.networks import loading
from drivesem.classify.objective import attacked_parameters, parameter_bounds, step_sizes
from drivesem.config.parsing import parse
from scene_ir import files
from tests.drivesem.classify.conftest import ColourClassifier, error_line, use_solids


def test_attack(solids, tmp_path, classify):
    out = tmp_path / "run"
    words = ("attack", "--out", out, "--params", "pose,lighting", "--views", "left", "--json")
    code, data, _ = classify(*words)
    assert code == 0
    assert {"out", "objects", "accuracy", "grades", "queries", "seconds"} <= data.keys()
    assert set(data["accuracy"]) == {"benign", "attacked"}
    assert data["pictures"] == 6
    assert data["grades"]["certain"] <= data["grades"]["threshold"]
    frames = sorted((out / "frames").iterdir())
    assert len(frames) == 6
    results = [files.read_json(frame / "result.json") for frame in frames]
    right = [r["benign"]["predicted"] == r["label"] for r in results]
    wrong = [r["attacked"]["predicted"] != r["label"] for r in results]
    assert data["accuracy"]["benign"] == pytest.approx(sum(right) / 6, abs=1e-4)
    assert data["accuracy"]["attacked"] == pytest.approx(1 - sum(wrong) / 6, abs=1e-4)
    assert data["grades"]["threshold"] == sum(r and w for r, w in zip(right, wrong, strict=True))
    assert data["queries"] == sum(r["queries"] for r in results)
    page = (out / "report.html").read_text()
    assert page.count("data:image/jpeg") == 12
    assert "box-0008-left" in page
    assert len((out / "classified.csv").read_text().splitlines()) == 7

    # The files have the pictures that were classified.
    network = loading.prepare_for_inference(ColourClassifier())
    for frame, result in zip(frames, results, strict=True):
        picture = torch.from_numpy(files.read_image(frame / "counterexample.png").transpose(2, 0, 1)).float() / 255
        assert network.classes[int(network(picture[None]).argmax())] == result["attacked"]["predicted"]
        theta = files.read_npz(frame / "theta.npz")["theta"]
        assert np.abs(theta).max() == pytest.approx(max(result["sizes"].values()), abs=1e-5)

    before = [(frame / "result.json").stat().st_mtime_ns for frame in frames]
    code, again, _ = classify(*words)
    assert [(frame / "result.json").stat().st_mtime_ns for frame in frames] == before
    assert again | {"seconds": 0} == data | {"seconds": 0}


def test_the_page_marks_pictures_that_were_not_attacked(monkeypatch, tmp_path, classify):
    blind = ColourClassifier()
    with torch.no_grad():
        blind.score.weight[1] = 0  # never predicts ball
    use_solids(monkeypatch, lambda name: blind)
    words = ("--out", tmp_path / "run", "--params", "pose", "--views", "forward", "--json")
    code, data, _ = classify("attack", *words)
    assert code == 0
    balls = next(one for one in data["classes"] if one["name"] == "ball")
    assert balls["benign"] == 0 < balls["pictures"]
    page = (tmp_path / "run" / "report.html").read_text()
    assert page.count("misclassified without a change, so not attacked") == balls["pictures"]
    assert page.count("yaw ") == data["pictures"] - balls["pictures"]


def test_attack_prints_a_table(solids, tmp_path, classify):
    code, printed, _ = classify("attack", "--out", tmp_path / "run", "--limit", "3", "--method", "halton")
    assert code == 0
    assert "accuracy, %" in printed
    assert f"written to {tmp_path / 'run' / 'report.html'}" in printed


def test_limit_interleaves_classes(solids, tmp_path, classify):
    out = tmp_path / "run"
    assert classify("attack", "--out", out, "--limit", "4", "--method", "random", "--json")[0] == 0
    names = [path.name for path in sorted((out / "frames").iterdir())]
    assert names == ["ball-0008-forward", "box-0008-forward", "box-0009-top", "pole-0008-forward"]


def test_data_and_training(solids, tmp_path, classify):
    out = tmp_path / "pictures"
    code, data, _ = classify("data", "--out", out, "--views", "left", "--json")
    assert (code, data["pictures"]) == (0, {"train": 18, "val": 6, "test": 6})
    assert files.read_image(out / "train" / "box" / "box-0000-left.png").shape == (224, 224, 3)
    code, trained, _ = classify("train", "--data", out, "--out", tmp_path / "net", "--epochs", "30", "--json")
    assert code == 0
    assert trained["accuracy"]["train"] == 1.0
    low, high = trained["intervals"]["test"]
    assert 0 <= low < trained["accuracy"]["test"] <= high <= 1
    assert trained["intervals"]["train"] == [pytest.approx(18 / (18 + 1.96**2), abs=1e-3), 1.0]
    assert len(trained["epochs"]) == 30
    network = loading.load_classifier(trained["weights"], solids.classes)
    images, labels = pictures.read_pictures(out, "test", solids.classes)
    accuracy = (network(images.float() / 255).argmax(1) == labels).float().mean()
    assert float(accuracy) == pytest.approx(trained["accuracy"]["test"], abs=1e-3)


ALL_LAYERS = ("train", "--views", "left", "--limit", "3", "--layers", "all", "--json")


def test_training_of_all_layers(solids, tmp_path, classify):
    more = ("--epochs", "1", "--batch", "4", "--precision", "bfloat16")
    code, trained, _ = classify(*ALL_LAYERS, *more, "--out", tmp_path / "net")
    assert code == 0
    start = loading.load_for_training("squeezenet", None, solids.classes, torch.Generator())
    network = loading.load_classifier(trained["weights"], solids.classes)
    assert not torch.equal(network.get_parameter("conv1.weight"), start.get_parameter("conv1.weight"))


def test_equal_seeds_give_equal_networks_despite_dropout(solids, tmp_path, classify, monkeypatch):
    embed = loading.SqueezeNet.embed
    dropout = torch.nn.functional.dropout
    monkeypatch.setattr(loading.SqueezeNet, "embed", lambda self, x: dropout(embed(self, x), 0.5, self.training))
    for name in ("one", "other"):
        torch.rand(1)
        assert classify(*ALL_LAYERS, "--epochs", "1", "--out", tmp_path / name)[0] == 0
    one, other = ((tmp_path / name / "squeezenet.safetensors").read_bytes() for name in ("one", "other"))
    assert one == other


def test_interrupted_training_continues_to_equal_weights(solids, tmp_path, classify, monkeypatch):
    def train(name, *more):
        words = (*ALL_LAYERS, "--epochs", "3", "--batch", "2", "--out", tmp_path / name)
        return classify(*words, *more)

    _, whole, _ = train("whole")
    state = training._ClassifierTrainingState
    save = state.save

    def interrupt(self, path, curve):
        save(self, path, curve)
        if len(curve) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(state, "save", interrupt)
    assert train("cut")[0] != 0
    assert not (tmp_path / "cut" / "squeezenet.safetensors").exists()
    saved = []
    monkeypatch.setattr(state, "save", lambda self, path, curve: saved.append(len(curve)))
    _, cut, _ = train("cut")
    assert saved == [3]
    assert (cut["epochs"], cut["accuracy"]) == (whole["epochs"], whole["accuracy"])
    weights = [(tmp_path / name / "squeezenet.safetensors").read_bytes() for name in ("whole", "cut")]
    assert weights[0] == weights[1]
    code, _, printed = train("cut", "--limit", "2")
    assert code == 2
    assert "limit" in printed
    path = tmp_path / "cut" / "checkpoint.safetensors"
    facts, tensors = training.read_weights(path)
    others = training.read_weights(tmp_path / "cut" / "squeezenet.safetensors")
    for bad in (others, (facts | {"curve": "3"}, tensors), (facts | {"schedule": "3"}, tensors)):
        training.write_weights(path, *bad)
        code, _, printed = train("cut")
        assert code == 2
        assert "checkpoint.safetensors: expected a checkpoint of this network" in printed


def test_training_pictures_are_mirrored_and_halved(solids, tmp_path, classify, monkeypatch):
    batches = []
    embed = loading.SqueezeNet.embed

    def record(self, images):
        if self.training:
            batches.append(images)
        return embed(self, images)

    monkeypatch.setattr(loading.SqueezeNet, "embed", record)
    more = ("--epochs", "6", "--half", "2", "--batch", "3")
    code, trained, _ = classify(*ALL_LAYERS, *more, "--out", tmp_path / "net")
    assert (code, trained["pictures"]["train"]) == (0, 3)
    assert [tuple(images.shape) for images in batches] == [(3, 3, 112, 112)] * 2 + [(3, 3, 224, 224)] * 4
    images, _ = pictures.read_pictures(tmp_path / "net" / training.PICTURES, "train", solids.classes)
    originals = [image.float() / 255 for image in images]
    inputs = [image for images in batches[2:] for image in images]
    unchanged = sum(any(torch.equal(image, one) for one in originals) for image in inputs)
    mirrored = sum(any(torch.equal(image, one.flip(-1)) for one in originals) for image in inputs)
    assert unchanged + mirrored == len(inputs) == 12
    assert min(unchanged, mirrored) > 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("attack --views back", "--views: expected names among forward, top, left, right"),
        ("attack --params colour", "params: expected names among vertex, pose, lighting"),
        ("attack --backgrounds {folder}/gone", "--backgrounds: expected a folder of photographs"),
        ("attack --backgrounds {folder}/empty", "expected a folder with photographs"),
        ("attack --backgrounds {folder}/torn", "sky.png"),
        ("attack --weights x.pth", "--weights: expected only with train, found attack"),
        ("attack --half 2", "--half: expected only with train, found attack"),
        ("attack --precision bfloat16", "--precision: expected only with train, found attack"),
        ("attack --queries 7", "--queries: expected only with --method random, halton"),
        ("attack --step-pose 0", "--step-pose: expected a number above 0"),
        ("attack --nuisances fog=1", "--nuisances"),
        ("train --half 2", "--half: expected --layers all, found --layers last"),
        ("train --precision bfloat16", "--precision: expected --layers all, found --layers last"),
    ],
)
def test_bad_settings_are_one_line_and_exit_code_2(solids, tmp_path, classify, words, message):
    (tmp_path / "empty").mkdir()
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "sky.png").write_bytes(b"\x89PNG no picture")
    words = words.format(folder=tmp_path).split()
    code, _, printed = classify(*words, "--out", tmp_path / "run", "--limit", "1")
    assert code == 2
    assert message in error_line(printed)


def test_an_unknown_network(solids, classify, monkeypatch):
    monkeypatch.setattr(attack, "open_network", loading.open_network)
    code, _, printed = classify("attack", "--network", "resnet50")
    assert code == 2
    assert "--network: expected squeezenet, weights" in printed


def test_a_damaged_object(solids, tmp_path, classify):
    solids.broken = ("ball/0008",)
    words = ("attack", "--out", tmp_path / "run", "--limit", "3", "--method", "random")
    code, _, printed = classify(*words)
    assert code == 2
    assert "ball/0008: mesh.vertices[0, 0]: expected a finite value, found nan" in printed
    code, data, _ = classify(*words, "--keep-going", "--json")
    assert code == 0
    assert list(data["frames_failed"]) == ["ball-0008-forward"]
    assert data["pictures"] == 2


def test_a_class_without_pictures(solids, tmp_path, classify):
    for split in ("train", "val", "test"):
        for name in solids.classes:
            (tmp_path / "pictures" / split / name).mkdir(parents=True)
    code, _, printed = classify("train", "--data", tmp_path / "pictures", "--out", tmp_path / "net")
    assert code == 2
    assert "train/box: expected pictures of this class, found none" in printed


@pytest.mark.parametrize(
    ("network", "method", "amounts"),
    [
        ("vgg16", "si-fgsm", (0.002, 0.15)),
        ("vgg16", "sgd", (0.01, 0.20, 0.05, 1.0)),
        ("vgg16", "scw", (0.01, 0.30)),
        ("resnet50", "si-fgsm", (0.01, 0.45)),
        ("resnet50", "sgd", (0.01, 0.60, 0.05, 3.0)),
        ("resnet50", "scw", (0.01, 0.90)),
    ],
)
def test_presets_are_the_papers(network, method, amounts):
    config = parse(["classify", "attack", "--config", f"configs/classify-{network}-{method}.yaml"])
    steps, bounds = step_sizes(config), parameter_bounds(config)
    assert (config.method, config.steps) == (method, 5)
    assert [str(one) for one in attacked_parameters(config)] == ["vertex", "pose"]
    assert (steps.vertex, steps.pose, bounds.vertex, bounds.pose)[: len(amounts)] == amounts
    if network == "vgg16":
        default = parse(["classify", "attack", "--method", method])
        assert (step_sizes(default), parameter_bounds(default)) == (steps, bounds)
