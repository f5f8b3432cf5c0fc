"""The shipped classifier on embedded objects that it was not trained on."""

import pytest
import torch

from drivesem.classify.networks.loading import load_classifier
from drivesem.classify.objects.sources import open_objects
from drivesem.classify.scenes import ObjectScene, generated_background, in_turn


@pytest.mark.slow
@torch.no_grad()
def test_held_out_objects_are_told_apart():
    objects = open_objects(None)
    network = load_classifier("squeezenet", objects.classes)
    right = []
    for i, name in enumerate(in_turn(objects.names("test"))[-24:]):
        model, view = objects.load(name), ("left", "right", "top", "forward")[i % 4]
        picture = ObjectScene(name, model, view, generated_background(f"{name}-{view}")).picture().clamp(0, 1)
        right.append(int(network(picture[None])[0].argmax()) == model.label)
    assert sum(right) / len(right) >= 0.95
