import pytest
import torch
from torch import nn

from drivesem.classify.networks.base import Classifier
from drivesem.classify.networks.loading import prepare_for_inference
from tests.drivesem.classify.standins import KINDS


class Colours(Classifier):
    """Knows the stand-ins by their colour: red boxes, green balls, blue poles. Its scores can be checked by hand:
    the mean of a channel over the picture, times ten.
    """

    architecture = "colours"
    head = "score"

    def __init__(self, classes=KINDS) -> None:
        super().__init__(classes, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        self.score = nn.Linear(3, len(classes), bias=False)
        with torch.no_grad():
            self.score.weight.copy_(10 * torch.eye(len(classes), 3))

    def encode(self, prepared):
        return prepared.mean(dim=(2, 3))


@pytest.fixture
def colours():
    return prepare_for_inference(Colours())
