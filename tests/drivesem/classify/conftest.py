"""Objects and networks with known outcomes: boxes, balls and poles, and a network that knows them by colour."""

import json

import pytest
import torch
import trimesh
from torch import nn

from drivesem.classify import attack, gate, pictures, training
from drivesem.classify.networks.architectures import Classifier
from drivesem.classify.networks.loading import prepare_for_inference
from drivesem.classify.objects.types import ObjectModel
from drivesem.cli import main
from scene_ir.errors import RangeError
from scene_ir.types import Mesh

KINDS = ("box", "ball", "pole")
_NUMBERS = {"train": range(6), "val": range(6, 8), "test": range(8, 10)}
_COLOURS = {"box": (0.7, 0.15, 0.1), "ball": (0.1, 0.6, 0.2), "pole": (0.15, 0.2, 0.8)}


def make_solid(kind: str, number: int = 0) -> trimesh.Trimesh:
    stretch = 1 - 0.03 * number
    if kind == "box":
        return trimesh.creation.box((0.5 * stretch, 0.6, 1.0))
    if kind == "ball":
        return trimesh.creation.icosphere(subdivisions=2, radius=0.5).apply_scale((1, stretch, 1))
    upright = trimesh.transformations.rotation_matrix(torch.pi / 2, (1, 0, 0))
    return trimesh.creation.cylinder(0.12 * stretch, 1.0, sections=16).apply_transform(upright)


def make_model(kind: str, number: int = 0) -> ObjectModel:
    solid = make_solid(kind, number)
    faces = torch.tensor(solid.faces, dtype=torch.int64)
    count = len(faces)
    return ObjectModel(
        f"{kind}/{number:04d}",
        KINDS.index(kind),
        Mesh(
            torch.tensor(solid.vertices, dtype=torch.float32), faces, torch.zeros(count, dtype=torch.int64), kind
        ),
        torch.tensor(_COLOURS[kind]).expand(count, 3).contiguous(),
        torch.full((count,), 0.2),
        torch.full((count,), 20.0),
    )


class SolidObjects:
    """An `ObjectSet`. broken: names that cannot be loaded."""

    classes = KINDS

    def __init__(self, broken: tuple[str, ...] = ()) -> None:
        self.broken = broken

    def names(self, split):
        return tuple(f"{kind}/{number:04d}" for kind in KINDS for number in _NUMBERS[split])

    def load(self, name):
        if name in self.broken:
            raise RangeError(f"{name}: mesh.vertices[0, 0]", "a finite value", "nan")
        kind, _, number = name.partition("/")
        return make_model(kind, int(number))


class ColourClassifier(Classifier):
    """Scores are the mean of each channel over the picture, times ten."""

    architecture = "colours"
    head = "score"

    def __init__(self, classes=KINDS) -> None:
        super().__init__(classes, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        self.score = nn.Linear(3, len(classes), bias=False)
        with torch.no_grad():
            self.score.weight.copy_(10 * torch.eye(len(classes), 3))

    def encode(self, normalised):
        return normalised.mean(dim=(2, 3))


@pytest.fixture
def colours():
    return prepare_for_inference(ColourClassifier())


def use_solids(patch, make_network=lambda name: ColourClassifier(), objects=None):
    """Use the solids instead of the embedded objects, and a network by its name."""
    objects = objects or SolidObjects()
    for module in (pictures, training):
        patch.setattr(module, "open_objects", lambda source: objects)
    for module in (attack, gate):
        patch.setattr(
            module, "open_network", lambda name, classes, device: prepare_for_inference(make_network(name))
        )
    return objects


@pytest.fixture
def solids(monkeypatch):
    return use_solids(monkeypatch)


@pytest.fixture
def classify(capsys):
    """Run `drivesem classify`: exit code, JSON or other output, and standard error."""

    def run(*words):
        code = main(["classify", *map(str, words), "--workers", "1"])
        printed = capsys.readouterr()
        return code, json.loads(printed.out) if printed.out.startswith("{") else printed.out, printed.err

    return run


def error_line(printed: str) -> str:
    (line,) = (line for line in printed.splitlines() if line.startswith("drivesem: "))
    return line
