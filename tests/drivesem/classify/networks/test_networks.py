"""Classifiers: torchvision's names of weights, passes checked by hand, files and what is wrong with them."""

import json
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import nn

from detectors.base import DetectorError
from drivesem.classify.networks import architectures
from drivesem.classify.networks.architectures import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    VGG16,
    PooledVGG16,
    ResNet50,
    SqueezeNet,
)
from drivesem.classify.networks.loading import (
    ARCHITECTURES,
    OnnxClassifier,
    load_classifier,
    load_for_training,
    prepare_for_inference,
    save_classifier,
)
from scene_ir.errors import FormatError, RangeError
from tools.onnx_graph import constant_graph

CLASSES = ("box", "ball", "pole")
VGG_CONVOLUTIONS = {0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128), 10: (128, 256)}
VGG_CONVOLUTIONS |= dict.fromkeys((12, 14), (256, 256)) | {17: (256, 512)}
VGG_CONVOLUTIONS |= dict.fromkeys((19, 21, 24, 26, 28), (512, 512))


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def vgg_file(small=False):
    """Random weights under torchvision's names. small: the convolutions alone."""
    tensors = {}
    for place, (before, after) in VGG_CONVOLUTIONS.items():
        tensors[f"features.{place}.weight"] = torch.randn(after, before, 3, 3, generator=seeded(place)) * 0.05
        tensors[f"features.{place}.bias"] = torch.randn(after, generator=seeded(place)) * 0.1
    if not small:
        for place, (before, after) in {0: (25088, 4096), 3: (4096, 4096), 6: (4096, 1000)}.items():
            tensors[f"classifier.{place}.weight"] = torch.full((after, before), 1e-3)
            tensors[f"classifier.{place}.bias"] = torch.zeros(after)
    return tensors


def resnet_names():
    """torchvision's names and shapes of ResNet-50."""
    shapes = {"conv1.weight": (64, 3, 7, 7), "fc.weight": (1000, 2048), "fc.bias": (1000,)}

    def norm(name, size):
        return {f"{name}.{part}": (size,) for part in ("weight", "bias", "running_mean", "running_var")}

    shapes |= norm("bn1", 64)
    before = 64
    for layer, (count, width) in enumerate(((3, 64), (4, 128), (6, 256), (3, 512)), start=1):
        for block in range(count):
            at = f"layer{layer}.{block}"
            shapes |= {f"{at}.conv1.weight": (width, before, 1, 1), f"{at}.conv2.weight": (width, width, 3, 3)}
            shapes |= {f"{at}.conv3.weight": (4 * width, width, 1, 1)}
            shapes |= norm(f"{at}.bn1", width) | norm(f"{at}.bn2", width) | norm(f"{at}.bn3", 4 * width)
            if block == 0:
                shapes |= {f"{at}.downsample.0.weight": (4 * width, before, 1, 1)}
                shapes |= norm(f"{at}.downsample.1", 4 * width)
            before = 4 * width
    return shapes


@pytest.mark.slow
def test_torchvisions_file_of_vgg16(tmp_path):
    tensors = vgg_file()
    torch.save(tensors, tmp_path / "vgg16.pth")
    network = prepare_for_inference(load_for_training("vgg16", str(tmp_path / "vgg16.pth"), CLASSES, seeded()))
    images = torch.rand(1, 3, 64, 64, generator=seeded())
    x = (images - torch.tensor(IMAGENET_MEAN).view(3, 1, 1)) / torch.tensor(IMAGENET_STD).view(3, 1, 1)
    for place in VGG_CONVOLUTIONS:
        x = F.relu(F.conv2d(x, tensors[f"features.{place}.weight"], tensors[f"features.{place}.bias"], padding=1))
        if place in (2, 7, 14, 21, 28):
            x = F.max_pool2d(x, 2)
    x = F.adaptive_avg_pool2d(x, 7).flatten(1)
    for place in (0, 3):
        x = F.relu(F.linear(x, tensors[f"classifier.{place}.weight"], tensors[f"classifier.{place}.bias"]))
    with torch.no_grad():
        torch.testing.assert_close(network.embed(images), x, rtol=1e-3, atol=1e-4)
        expected = F.linear(x, network.last.weight, network.last.bias)
        torch.testing.assert_close(network(images), expected, rtol=1e-3, atol=1e-4)
    assert network(images).shape == (1, 3)


def test_torchvisions_names_of_resnet50(tmp_path):
    own = {k: tuple(v.shape) for k, v in ResNet50([str(i) for i in range(1000)]).state_dict().items()}
    counted = {name for name in own if name.endswith("num_batches_tracked")}
    assert {name: shape for name, shape in own.items() if name not in counted} == resnet_names()
    file = {name: torch.zeros(shape) for name, shape in resnet_names().items()}
    file = {name: t + ("running_var" in name) for name, t in file.items()}
    torch.save(file | {name: torch.tensor(0) for name in counted}, tmp_path / "resnet50.pth")
    network = prepare_for_inference(
        load_for_training("resnet50", str(tmp_path / "resnet50.pth"), CLASSES, seeded())
    )
    assert network.classes == CLASSES
    assert torch.equal(network(torch.rand(1, 3, 64, 64)), torch.zeros(1, 3))


def test_a_block_of_resnet50_by_hand():
    network = prepare_for_inference(ResNet50(CLASSES))
    block = network.get_submodule("layer2")[0]
    x = torch.rand(1, 256, 8, 8, generator=seeded())

    def norm(x, bn):
        mean, scale = bn.running_mean.view(-1, 1, 1), bn.weight / (bn.running_var + 1e-5).sqrt()
        return (x - mean) * scale.view(-1, 1, 1) + bn.bias.view(-1, 1, 1)

    inner = F.relu(norm(F.conv2d(x, block.conv1.weight), block.bn1))
    inner = F.relu(norm(F.conv2d(inner, block.conv2.weight, stride=2, padding=1), block.bn2))
    inner = norm(F.conv2d(inner, block.conv3.weight), block.bn3)
    shortcut = norm(F.conv2d(x, block.downsample[0].weight, stride=2), block.downsample[1])
    with torch.no_grad():
        torch.testing.assert_close(block(x), F.relu(inner + shortcut), rtol=1e-3, atol=1e-4)


def test_vggs_convolutions_alone(tmp_path):
    save_file(vgg_file(small=True), tmp_path / "vgg.safetensors")
    network = prepare_for_inference(
        load_for_training("vgg16-pooled", str(tmp_path / "vgg.safetensors"), CLASSES, seeded())
    )
    assert isinstance(network, PooledVGG16)
    assert network.embed(torch.rand(2, 3, 64, 64)).shape == (2, 1024)


def test_squeezenets_layers_are_squeezedets(tmp_path):
    from detectors.registry import load_detector

    detector = load_detector("squeezedet")
    beyond = ("convdet", "fires.fire10", "fires.fire11")
    file = {k: v.contiguous() for k, v in detector.state_dict().items() if not k.startswith(beyond)}
    file |= {"conv10.weight": torch.zeros(1000, 512, 1, 1), "conv10.bias": torch.zeros(1000)}
    save_file(file, tmp_path / "squeezenet.safetensors")
    network = prepare_for_inference(
        load_for_training("squeezenet", str(tmp_path / "squeezenet.safetensors"), CLASSES, seeded())
    )
    images = torch.rand(1, 3, 64, 64, generator=seeded())
    pixels = 255 * images.flip(1) - torch.tensor([103.939, 116.779, 123.68]).view(3, 1, 1)
    x = F.max_pool2d(F.relu(detector.conv1(pixels)), 3, 2, ceil_mode=True)
    for name in ("fire2", "fire3", "fire4", "fire5", "fire6", "fire7", "fire8", "fire9"):
        x = detector.fires[name](x)
        x = F.max_pool2d(x, 3, 2, ceil_mode=True) if name in ("fire3", "fire5") else x
    expected = torch.cat([x.mean((2, 3)), x.amax((2, 3))], 1)
    torch.testing.assert_close(network.embed(images), expected, rtol=1e-3, atol=1e-2)


def test_what_is_written_is_read_again(tmp_path):
    network = load_for_training("squeezenet", None, CLASSES, seeded(3))
    save_classifier(network, tmp_path / "a.safetensors", {"fact": "1"})
    again = load_classifier(str(tmp_path / "a.safetensors"), CLASSES)
    images = torch.rand(1, 3, 64, 64, generator=seeded())
    with torch.no_grad():
        torch.testing.assert_close(again(images), prepare_for_inference(network)(images), rtol=1e-2, atol=1e-2)
    assert not any(p.requires_grad for p in again.parameters())


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_a_new_last_layer_follows_from_its_generator(name):
    one, other = (ARCHITECTURES[name](("a", "b")) for _ in range(2))
    for network in (one, other):
        network.replace_last_layer(CLASSES, seeded(5))
    assert one.classes == CLASSES
    assert torch.equal(one.last.weight, other.last.weight)
    assert one.last.out_features == 3


def wrong_shape(tensors):
    return tensors | {"features.0.weight": torch.zeros(64, 3, 5, 5)}


def missing(tensors):
    del tensors["features.28.bias"]
    return tensors


def foreign(tensors):
    return tensors | {"layer1.weight": torch.zeros(1)}


def not_finite(tensors):
    tensors["features.5.bias"][3] = torch.nan
    return tensors


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (wrong_shape, r"features\.0\.weight: expected shape \(64, 3, 3, 3\), found \(64, 3, 5, 5\)"),
        (missing, r"features\.28\.bias: expected a tensor, found none"),
        (foreign, r"layer1\.weight: expected none, found a tensor"),
        (not_finite, r"features\.5\.bias: expected finite numbers"),
    ],
)
def test_weights_of_another_network(tmp_path, spoil, message):
    save_file(spoil(vgg_file(small=True)), tmp_path / "other.safetensors")
    with pytest.raises(FormatError, match=message):
        load_for_training("vgg16-pooled", str(tmp_path / "other.safetensors"), CLASSES, seeded())


def test_names_and_files_that_are_no_networks(tmp_path):
    with pytest.raises(
        FormatError, match="squeezenet, vgg16, vgg16-pooled, resnet50, torchvision:NAME, timm:NAME"
    ):
        load_for_training("alexnet", None, CLASSES, seeded())
    with pytest.raises(FormatError, match="--weights: expected a file with weights of vgg16, found nothing"):
        load_for_training("vgg16", None, CLASSES, seeded())
    (tmp_path / "torn.pth").write_bytes(b"PK no weights")
    with pytest.raises(DetectorError, match=r"torn\.pth"):
        load_for_training("vgg16", str(tmp_path / "torn.pth"), CLASSES, seeded())
    with pytest.raises(DetectorError, match=r"gone\.pth"):
        load_for_training("vgg16", str(tmp_path / "gone.pth"), CLASSES, seeded())
    torch.save({"w": torch.zeros(1 << 20)}, tmp_path / "plain.pth")
    with zipfile.ZipFile(tmp_path / "plain.pth") as plain:
        parts = {name: plain.read(name) for name in plain.namelist()}
    with zipfile.ZipFile(tmp_path / "packed.pth", "w", zipfile.ZIP_DEFLATED) as packed:
        for name, data in parts.items():
            packed.writestr(name, data)
    with pytest.raises(DetectorError, match=r"packed\.pth: .* parts of 4,\d+,\d+ bytes in a file of"):
        load_for_training("vgg16", str(tmp_path / "packed.pth"), CLASSES, seeded())
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(FormatError, match=r"list\.pth: expected tensors by name"):
        load_for_training("vgg16", str(tmp_path / "list.pth"), CLASSES, seeded())
    with pytest.raises(FormatError, match="--network"):
        load_classifier("resnet50", CLASSES)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"architecture": "squeezenet", "classes": json.dumps(["cat", "dog"])}, "found one for cat, dog"),
        ({"architecture": "squeezenet", "classes": "cat"}, "classes: expected a list of names"),
        ({"architecture": "squeezedet", "classes": json.dumps(CLASSES)}, "architecture: expected one of"),
        ({}, "classes: expected a list of names"),
    ],
)
def test_a_file_for_something_else(tmp_path, metadata, message):
    network = SqueezeNet(CLASSES)
    save_file({k: v.clone() for k, v in network.state_dict().items()}, tmp_path / "other.safetensors", metadata)
    with pytest.raises(FormatError, match=message):
        load_classifier(str(tmp_path / "other.safetensors"), CLASSES)


@pytest.mark.parametrize("metadata", [["squeezenet"], {"classes": 5}, "squeezenet"])
def test_unreadable_metadata(tmp_path, metadata):
    header = json.dumps({"__metadata__": metadata}).encode()
    path = tmp_path / "other.safetensors"
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(FormatError, match=r"other.safetensors: __metadata__: expected texts by name"):
        load_classifier(str(path), CLASSES)


def test_parameters_of_the_published_networks():
    thousand = [str(i) for i in range(1000)]
    counts = {kind: sum(p.numel() for p in kind(thousand).parameters()) for kind in (VGG16, ResNet50)}
    assert counts == {VGG16: 138_357_544, ResNet50: 25_557_032}


def test_random_weights_without_a_file():
    one, again, other = (
        load_for_training(
            "vgg16-pooled", None, ("cat", "dog"), torch.Generator().manual_seed(seed), random_weights=True
        )
        for seed in (0, 0, 1)
    )
    name = "features.0.weight"
    assert torch.equal(one.get_parameter(name), again.get_parameter(name))
    assert not torch.equal(one.get_parameter(name), other.get_parameter(name))
    assert one.last.out_features == 2


class Body(nn.Module):
    """What a library's network looks like: features, then one linear layer."""

    def __init__(self):
        super().__init__()
        self.conv = nn.Conv2d(3, 4, 3, bias=False)
        self.head = nn.ModuleDict({"fc": nn.Linear(4, 1000)})
        self.default_cfg = {"mean": (0.5, 0.5, 0.5), "std": (0.25, 0.25, 0.25)}

    def forward(self, x):
        return self.head["fc"](self.conv(x).mean(dim=(2, 3)))


@pytest.fixture
def libraries(monkeypatch):
    """timm and torchvision, reduced to what is called."""
    calls = []

    def create(name, **options):
        if name != "tiny":
            raise RuntimeError(f"Unknown model ({name})")
        calls.append(options)
        torch.manual_seed(0)
        return Body()

    found = {"timm": SimpleNamespace(create_model=create), "torchvision.models": SimpleNamespace(get_model=create)}
    monkeypatch.setattr(architectures.importlib, "import_module", lambda name: found[name])
    return calls


@pytest.mark.parametrize("library", ["timm", "torchvision"])
def test_networks_of_libraries_get_a_new_last_layer(library, libraries, tmp_path):
    network = load_for_training(f"{library}:tiny", None, CLASSES, seeded())
    assert libraries[0] in ({"pretrained": True}, {"weights": "DEFAULT"})
    images = torch.rand(2, 3, 16, 16, generator=seeded())
    body = network.body.conv
    features = body((images - 0.5) / 0.25).mean(dim=(2, 3))
    torch.testing.assert_close(network(images), network.last(features))
    save_classifier(network, tmp_path / "a.safetensors", {})
    again = load_classifier(str(tmp_path / "a.safetensors"), CLASSES)
    assert libraries[-1] in ({"pretrained": False}, {"weights": None})
    torch.testing.assert_close(again(images), network(images), rtol=1e-2, atol=1e-2)


def test_weights_by_a_librarys_names(libraries, tmp_path):
    weights = {"conv.weight": torch.full((4, 3, 3, 3), 0.5), "head.fc.weight": torch.zeros(1000, 4)}
    torch.save(weights | {"head.fc.bias": torch.zeros(1000)}, tmp_path / "tiny.pth")
    network = load_for_training("timm:tiny", str(tmp_path / "tiny.pth"), CLASSES, seeded())
    assert bool((network.body.conv.weight == 0.5).all())
    assert network.last.out_features == 3


def test_libraries_that_are_not_there_and_names_they_do_not_know(libraries, monkeypatch):
    with pytest.raises(FormatError, match="--network: expected a network of timm, found timm:huge: RuntimeError"):
        load_for_training("timm:huge", None, CLASSES, seeded())
    with pytest.raises(FormatError, match="found timm:tiny, which has ImageNet's classes: train it"):
        load_classifier("timm:tiny", CLASSES)

    def missing(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(architectures.importlib, "import_module", missing)
    with pytest.raises(FormatError, match="--network: expected timm installed, for timm:tiny, found No module"):
        load_for_training("timm:tiny", None, CLASSES, seeded())


SCORES = np.array([[1.0, 3.0, 2.0]])


def test_an_onnx_file(tmp_path):
    path = tmp_path / "net.onnx"
    path.write_bytes(constant_graph((1, 3, 8, 8), {"scores": SCORES}))
    network = OnnxClassifier(path, CLASSES)
    assert not network.differentiable
    assert network(torch.rand(2, 3, 16, 16)).tolist() == [[1.0, 3.0, 2.0]] * 2
    (tmp_path / "net.yaml").write_text("classes: [pole, box, ball]\n")
    assert OnnxClassifier(path, CLASSES)(torch.rand(1, 3, 16, 16)).tolist() == [[3.0, 2.0, 1.0]]


def test_scores_that_are_not_finite(tmp_path):
    path = tmp_path / "net.onnx"
    path.write_bytes(constant_graph((1, 3, 8, 8), {"scores": np.full((1, 3), np.nan)}))
    with pytest.raises(RangeError, match="scores: expected finite numbers"):
        OnnxClassifier(path, CLASSES)(torch.rand(1, 3, 8, 8))


@pytest.mark.parametrize(
    ("graph", "settings", "message"),
    [
        (constant_graph((1, 3, 8, 8), {"scores": np.zeros((1, 5))}), None, "one score for each of the 3 classes"),
        (constant_graph((1, 8), {"scores": SCORES}), None, "one batch of pictures"),
        (
            constant_graph((1, 3, 8, 8), {"scores": SCORES}),
            "classes: [a, b, c]",
            "classes: expected box, ball, pole",
        ),
        (
            constant_graph((1, 3, 8, 8), {"scores": SCORES}),
            "t_star: 0.5",
            "net.yaml: expected settings among size",
        ),
        (b"no graph", None, "expected an ONNX classifier"),
        (constant_graph((8, 3, 8, 8), {"scores": SCORES}), None, "a batch of any size, or of one picture"),
        (constant_graph((1, 3, 8, 8), {"scores": SCORES}), "size: 9", "net.yaml: size: expected 8 x 8"),
    ],
)
def test_an_onnx_file_that_is_no_classifier_of_these(tmp_path, graph, settings, message):
    (tmp_path / "net.onnx").write_bytes(graph)
    if settings is not None:
        (tmp_path / "net.yaml").write_text(settings)
    with pytest.raises(FormatError, match=message):
        OnnxClassifier(tmp_path / "net.onnx", CLASSES)
