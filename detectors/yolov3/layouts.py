"""The published networks and a slim one as `.cfg` descriptions, for any number of classes."""

from __future__ import annotations

from collections.abc import Sequence

from detectors.yolov3.cfg import CfgSection, DarknetCfg, build

Anchors = Sequence[tuple[float, float]]
"""Widths and heights, px of the input, smallest first."""

COCO_CLASSES = 80
ANCHORS: Anchors = (
    *((10, 13), (16, 30), (33, 23)),
    *((30, 61), (62, 45), (59, 119)),
    *((116, 90), (156, 198), (373, 326)),
)
"""For COCO at 416 px: section 2.3 of the paper."""
TINY_ANCHORS: Anchors = ((10, 14), (23, 27), (37, 58), (81, 82), (135, 169), (344, 319))
"""From yolov3-tiny.cfg."""

SLIM_CLASSES = 4
SLIM_ANCHORS: Anchors = (
    *((26, 18), (13, 36), (52, 31)),
    *((33, 79), (92, 51), (70, 149)),
    *((151, 79), (228, 134), (390, 223)),
)
"""`detectors.anchors.fit_anchors` for the sizes in 3,000 generated frames (objects from 12 px on), zoomed as in
training; mean IoU 0.67.
"""

_BLOCKS = ((64, 1), (128, 2), (256, 8), (512, 8), (1024, 4))
"""Darknet-53: channels of each stage, and its residual blocks (table 1 of the paper)."""
_SLIM_BLOCKS = ((48, 1), (96, 2), (192, 3), (384, 2))
"""One stage fewer than Darknet-53, at three eighths of its width. The first convolution is strided too: at full
size its channels would cost more than all the rest.
"""
_IGNORE = 0.7
"""`ignore_thresh` of the published files; the paper states 0.5."""
_SLIM_MATCH = 0.35
"""`iou_thresh`: about three anchors predict an object, which speeds up learning."""


class _CfgBuilder:
    """Collects sections. ValueError if the number of anchors does not fit the layout."""

    def __init__(self, size_hw: tuple[int, int], anchors: Anchors, anchor_count: int) -> None:
        if len(anchors) != anchor_count:
            raise ValueError(f"anchors: expected {anchor_count}, found {len(anchors)}")
        net = {"height": str(size_hw[0]), "width": str(size_hw[1]), "channels": "3"}
        self.sections = [CfgSection("net", net)]

    def add(self, kind: str, **options: object) -> int:
        """Append a layer and return its number."""
        self.sections.append(CfgSection(kind, {key: str(value) for key, value in options.items()}))
        return len(self.sections) - 2

    def convolve(self, filters: int, size: int, stride: int = 1) -> int:
        shape = {"filters": filters, "size": size, "stride": stride, "pad": 1}
        return self.add("convolutional", batch_normalize=1, **shape, activation="leaky")

    def residual(self, channels: int) -> int:
        self.convolve(channels // 2, 1)
        self.convolve(channels, 3)
        return self.add("shortcut", **{"from": -3, "activation": "linear"})

    def head(self, anchors: Anchors, mask: Sequence[int], classes: int, **options: object) -> int:
        filters = len(mask) * (5 + classes)
        self.add("convolutional", size=1, stride=1, pad=1, filters=filters, activation="linear")
        return self.add(
            "yolo",
            mask=",".join(map(str, mask)),
            anchors=", ".join(f"{w:g},{h:g}" for w, h in anchors),
            classes=classes,
            num=len(anchors),
            **options,
        )


def yolov3(classes: int = COCO_CLASSES, anchors: Anchors = ANCHORS) -> DarknetCfg:
    """Darknet-53 and three heads at strides 32, 16 and 8; nine anchors."""
    layers = _CfgBuilder((416, 416), anchors, len(ANCHORS))
    layers.convolve(32, 3)
    ends = []
    for channels, blocks in _BLOCKS:
        layers.convolve(channels, 3, 2)
        ends.append([layers.residual(channels) for _ in range(blocks)][-1])
    for level, (channels, skip) in enumerate(((512, None), (256, ends[3]), (128, ends[2]))):
        if skip is not None:
            layers.add("route", layers=-4)
            layers.convolve(channels, 1)
            layers.add("upsample", stride=2)
            layers.add("route", layers=f"-1, {skip}")
        for _ in range(3):
            layers.convolve(channels, 1)
            layers.convolve(2 * channels, 3)
        first = 3 * (2 - level)
        layers.head(anchors, range(first, first + 3), classes, ignore_thresh=_IGNORE, truth_thresh=1)
    return build(layers.sections, "yolov3")


def yolov3_tiny(classes: int = COCO_CLASSES, anchors: Anchors = TINY_ANCHORS) -> DarknetCfg:
    """Seven convolutions with poolings, and two heads at strides 32 and 16; six anchors."""
    layers = _CfgBuilder((416, 416), anchors, len(TINY_ANCHORS))
    for channels in (16, 32, 64, 128):
        layers.convolve(channels, 3)
        layers.add("maxpool", size=2, stride=2)
    skip = layers.convolve(256, 3)
    layers.add("maxpool", size=2, stride=2)
    layers.convolve(512, 3)
    layers.add("maxpool", size=2, stride=1)
    layers.convolve(1024, 3)
    layers.convolve(256, 1)
    layers.convolve(512, 3)
    layers.head(anchors, (3, 4, 5), classes, ignore_thresh=_IGNORE, truth_thresh=1)
    layers.add("route", layers=-4)
    layers.convolve(128, 1)
    layers.add("upsample", stride=2)
    layers.add("route", layers=f"-1, {skip}")
    layers.convolve(256, 3)
    layers.head(anchors, (0, 1, 2), classes, ignore_thresh=_IGNORE, truth_thresh=1)
    return build(layers.sections, "yolov3-tiny")


def yolov3_slim(classes: int = SLIM_CLASSES, anchors: Anchors = SLIM_ANCHORS) -> DarknetCfg:
    """A Darknet of eight narrow residual blocks, and three heads with short necks at strides 32, 16 and 8."""
    layers = _CfgBuilder((384, 1248), anchors, len(SLIM_ANCHORS))
    layers.convolve(24, 3, 2)
    ends = []
    for channels, blocks in _SLIM_BLOCKS:
        layers.convolve(channels, 3, 2)
        ends.append([layers.residual(channels) for _ in range(blocks)][-1])
    layers.convolve(128, 1)
    layers.convolve(256, 3)
    for level, skip in enumerate((None, ends[2], ends[1])):
        if skip is not None:
            layers.add("route", layers=-4)
            layers.convolve(32, 1)
            layers.add("upsample", stride=2)
            layers.add("route", layers=f"-1, {skip}")
        channels = 128 if skip is None else 64
        layers.convolve(channels, 1)
        layers.convolve(2 * channels, 3)
        first = 3 * (2 - level)
        mask = range(first, first + 3)
        layers.head(anchors, mask, classes, ignore_thresh=0.5, truth_thresh=1, iou_thresh=_SLIM_MATCH)
    return build(layers.sections, "yolov3-slim")
