"""The shipped classifier on embedded objects that it was not trained on."""

import shutil
from pathlib import Path

import pytest
import torch

from drivesem.classify.networks import loading
from drivesem.classify.networks.loading import load_classifier
from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.objects.types import CLASSES
from drivesem.classify.pictures import interleave_classes
from drivesem.classify.scenes import ObjectScene, generate_background
from scene_ir.errors import FormatError


@pytest.mark.slow
@torch.no_grad()
def test_accuracy_on_held_out_objects():
    objects = open_objects(None)
    network = load_classifier("squeezenet", objects.classes)
    right = []
    for i, name in enumerate(interleave_classes(objects.names("test"))[-24:]):
        model, view = objects.load(name), ("left", "right", "top", "forward")[i % 4]
        picture = ObjectScene(name, model, view, generate_background(f"{name}-{view}")).render().clamp(0, 1)
        right.append(int(network(picture[None])[0].argmax()) == model.label)
    assert sum(right) / len(right) >= 0.95


def test_it_is_held_to_its_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load_classifier("squeezenet", CLASSES)
    for suffix in (".safetensors", ".md"):
        shutil.copy(loading.SHIPPED.with_suffix(suffix), tmp_path)
    path = tmp_path / loading.SHIPPED.name
    monkeypatch.setattr(loading, "SHIPPED", path)
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(FormatError, match=r"squeezenet-objects\.safetensors: expected the SHA-256 of"):
        load_classifier("squeezenet", CLASSES)
    with pytest.raises(FormatError, match="expected the SHA-256 of"):
        loading.load_for_training("squeezenet", None, CLASSES, torch.Generator())
