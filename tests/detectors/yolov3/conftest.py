"""A network of the family that is small enough for tests."""

import pytest
import torch

from detectors.yolov3.cfg import DarknetCfg, parse
from detectors.yolov3.yolov3 import YoloV3

CLASSES = ("Car", "Truck", "Cyclist")

MINI = """
[net]
# as people write it: comments, blanks, and settings of the training
batch=64
width=48
height=32
channels=3
learning_rate=0.001

[convolutional]
batch_normalize=1
filters=4
size=3
stride=2
pad=1
activation=leaky

[convolutional]
batch_normalize = 1
filters = 8
size = 3
stride = 2
pad = 1
activation = leaky

[convolutional]
batch_normalize=1
filters=4
size=1
stride=1
pad=1
activation=leaky

[convolutional]
batch_normalize=1
filters=8
size=3
stride=1
pad=1
activation=leaky

[shortcut]
from=-3
activation=linear

[maxpool]
size=2
stride=2

[maxpool]
size=2
stride=1

[convolutional]
size=1
stride=1
pad=1
filters=16
activation=linear

[yolo]
mask = 2,3
anchors = 6,6,  12,8,  20,20,  40,24
classes=3
num=4
jitter=.3
ignore_thresh = .7
truth_thresh = 1
random=1

######################

[route]
layers = -3

[convolutional]
batch_normalize=1
filters=4
size=1
stride=1
pad=1
activation=leaky

[upsample]
stride=2

[route]
layers = -1, 4

[convolutional]
size=1
stride=1
pad=1
filters=16
activation=linear

[yolo]
mask = 0,1
anchors = 6,6,  12,8,  20,20,  40,24
classes=3
num=4
ignore_thresh = .7
"""
"""Heads at strides 8 and 4: in an image of 48x32 px 2 * 6 * 4 and 2 * 12 * 8 anchors."""


@pytest.fixture
def mini_text() -> str:
    return MINI


@pytest.fixture
def mini_cfg() -> DarknetCfg:
    return parse(MINI, "mini.cfg")


@pytest.fixture
def mini(mini_cfg: DarknetCfg) -> YoloV3:
    """Random weights, and statistics that are not those of a new network; in eval mode, not frozen."""
    detector = YoloV3(CLASSES, cfg=mini_cfg)
    generator = torch.Generator().manual_seed(0)
    detector.initialise(generator)
    with torch.no_grad():
        for block in detector.network.blocks.values():
            if block.norm is None:
                block.conv.weight.mul_(30)
                continue
            block.norm.weight.uniform_(0.5, 1.5, generator=generator)
            block.norm.bias.uniform_(-0.5, 0.5, generator=generator)
            block.norm.running_mean.uniform_(-0.5, 0.5, generator=generator)
            block.norm.running_var.uniform_(0.5, 2.0, generator=generator)
    return detector.eval()
