"""Darknet's `.cfg`: what is read, what is written, what is refused; the published networks."""

import pytest

from detectors.base import DetectorError
from detectors.yolov3 import cfg as layouts
from detectors.yolov3.cfg import (
    ConvolutionLayer,
    MaxPoolLayer,
    RouteLayer,
    ShortcutLayer,
    UpsampleLayer,
    YoloHead,
    parse,
    write,
)
from detectors.yolov3.network import DarknetNetwork


def numbers(network: DarknetNetwork) -> tuple[int, int]:
    """How many are learned, and how many are measured: means and variances."""
    norms = [block.norm for block in network.blocks.values() if block.norm is not None]
    return sum(p.numel() for p in network.parameters()), sum(2 * norm.num_features for norm in norms)


def test_layers_of_a_file(mini_text: str) -> None:
    cfg = parse(mini_text, "mini.cfg")
    assert cfg.layers[0] == ConvolutionLayer(4, 3, 2, 1, True, True)
    assert cfg.layers[4] == ShortcutLayer(1)
    assert cfg.layers[5:7] == (MaxPoolLayer(2, 2), MaxPoolLayer(2, 1))
    assert cfg.layers[7] == ConvolutionLayer(16, 1, 1, 0, False, False)
    anchors = ((6.0, 6.0), (12.0, 8.0), (20.0, 20.0), (40.0, 24.0))
    assert cfg.layers[8] == YoloHead(anchors, (2, 3), 3, 0.7, 1.0)
    assert (cfg.layers[9], cfg.layers[11], cfg.layers[12]) == (
        RouteLayer((6,)),
        UpsampleLayer(2),
        RouteLayer((11, 4)),
    )
    assert cfg.strides == (2, 4, 4, 4, 4, 8, 8, 8, 8, 8, 8, 4, 4, 4, 4)
    assert cfg.channels == (4, 8, 4, 8, 8, 8, 8, 16, 16, 8, 4, 4, 12, 16, 16)
    assert (cfg.stride, cfg.classes, [i for i, _ in cfg.heads]) == (8, 3, [8, 14])


def test_what_is_written_is_read_again(mini_text: str) -> None:
    cfg = parse(mini_text)
    again = parse(write(cfg))
    assert again == cfg
    assert again.sections[0].options["learning_rate"] == "0.001"
    assert again.sections[9].options["jitter"] == ".3"


def test_published_yolov3() -> None:
    cfg = layouts.yolov3()
    assert len(cfg.layers) == 107  # numbered 0 to 106
    assert [i for i, _ in cfg.heads] == [82, 94, 106]
    assert [cfg.strides[i] for i, _ in cfg.heads] == [32, 16, 8]
    assert sum(isinstance(layer, ConvolutionLayer) for layer in cfg.layers) == 75
    assert sum(isinstance(layer, ConvolutionLayer) for layer in cfg.layers[:75]) == 52  # Darknet-53 less its last
    assert (cfg.layers[86], cfg.layers[98]) == (RouteLayer((85, 61)), RouteLayer((97, 36)))
    learned, measured = numbers(DarknetNetwork(cfg))
    assert learned == 61_949_149
    assert 20 + 4 * (learned + measured) == 248_007_048  # bytes of the published yolov3.weights
    assert parse(write(cfg)) == cfg


def test_published_yolov3_tiny() -> None:
    cfg = layouts.yolov3_tiny()
    assert len(cfg.layers) == 24
    assert [i for i, _ in cfg.heads] == [16, 23]
    assert (cfg.layers[17], cfg.layers[20]) == (RouteLayer((13,)), RouteLayer((19, 8)))
    learned, measured = numbers(DarknetNetwork(cfg))
    assert (learned, learned + measured) == (8_852_366, 8_858_734)  # 8.86 M, as the published file holds them
    assert 20 + 4 * (learned + measured) == 35_434_956  # bytes of the published yolov3-tiny.weights


@pytest.mark.parametrize("layout", [layouts.yolov3, layouts.yolov3_tiny, layouts.yolov3_slim])
def test_layouts_for_other_classes(layout) -> None:
    cfg = layout(7)
    assert cfg.classes == 7
    assert write(cfg).count("classes=7") == len(cfg.heads)
    with pytest.raises(ValueError, match=r"anchors: expected \d, found 2"):
        layout(7, ((10, 10), (20, 20)))


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1


@pytest.mark.parametrize(
    ("before", "after", "at", "message"),
    [
        ("[upsample]", "[deconvolutional]", "[upsample]", r"expected one of \[convolutional\].*found \[deconv"),
        ("[net]", "[region]", "[net]", r"expected \[net\] first, found \[region\]"),
        ("batch=64", "batch 64", "batch=64", r"expected \[section\] or key=value, found 'batch 64'"),
        ("from=-3", "from=-9", "[shortcut]", r"\[shortcut\] from: expected a layer before this one, number 4"),
        ("from=-3", "from=-4", "[shortcut]", r"from: expected 8 channels at stride 4, found 4 at 2"),
        (
            "layers = -1, 4",
            "layers = -1, 6",
            "layers = -1, 4",
            r"expected layers of one stride, found strides \[4, 8",
        ),
        ("layers = -3", "layers = first", "[route]", r"\[route\] layers: expected integers, found 'first'"),
        ("num=4", "num=9", "[yolo]", r"\[yolo\] num: expected 4, as many as anchors, found 9"),
        ("mask = 2,3", "mask = 2,4", "[yolo]", r"mask: expected indices of 4 anchors, found \[2, 4\]"),
        ("mask = 2,3", "mask = 2", "[yolo]", r"mask, classes: expected 16 numbers a cell .* found 8"),
        (
            "ignore_thresh = .7",
            "ignore_thresh = high",
            "[yolo]",
            r"ignore_thresh: expected a number, found 'high'",
        ),
        ("filters=4", "filters=0", "[convolutional]", r"filters: expected an integer of at least 1, found 0"),
        (
            "activation=leaky",
            "activation=mish",
            "[convolutional]",
            r"activation: expected leaky or linear, found mi",
        ),
        ("channels=3", "channels=1", "[net]", r"channels: expected 3, found 1"),
    ],
)
def test_errors_name_the_line(mini_text: str, before: str, after: str, at: str, message: str) -> None:
    line = line_of(mini_text, at)
    if at == "layers = -1, 4":
        line -= 1  # the section's
    with pytest.raises(DetectorError, match=message) as caught:
        parse(mini_text.replace(before, after, 1), "own.cfg")
    assert str(caught.value).startswith(f"own.cfg:{line}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("section", "line", "message"),
    [
        ("yolo", "scale_x_y=1.2", "scale_x_y: expected 1, found 1.2"),
        ("yolo", "new_coords=1", "new_coords: expected 0, found 1"),
        ("yolo", "scale_xy=1", "scale_xy: expected a key of YOLOv3's networks, found an unknown one"),
        ("convolutional", "dilation=2", "dilation: expected 1, found 2"),
        ("convolutional", "xnor=1", "xnor: expected 0, found 1"),
        ("convolutional", "flipped=1", "flipped: expected 0, found 1"),
        ("convolutional", "antialiasing=1", "antialiasing: expected 0, found 1"),
        ("convolutional", "dontload=1", "dontload: expected 0, found 1"),
        ("convolutional", "stride_x=1", "stride_x: expected 2, the stride, found 1"),
        ("convolutional", "jitter=.3", "jitter: expected a key of YOLOv3's networks, found an unknown one"),
        ("maxpool", "stride_y=1", "stride_y: expected 2, the stride, found 1"),
        ("maxpool", "maxpool_depth=1", "maxpool_depth: expected 0, found 1"),
        ("maxpool", "maxpool_depth=", "maxpool_depth: expected 0, found "),
        ("route", "groups=2", "groups: expected 1, found 2"),
        ("shortcut", "weights_type=per_feature", "weights_type: expected none, found per_feature"),
        ("upsample", "reverse=1", "reverse: expected a key of YOLOv3's networks, found an unknown one"),
        ("upsample", "scale=2", "scale: expected 1, found 2"),
    ],
)
def test_keys_that_make_another_network_are_refused(section: str, line: str, message: str, mini_text: str) -> None:
    at = line_of(mini_text, f"[{section}]")
    with pytest.raises(DetectorError) as caught:
        parse(mini_text.replace(f"[{section}]", f"[{section}]\n{line}", 1), "own.cfg")
    assert str(caught.value) == f"own.cfg:{at}: [{section}] {message}"


def test_keys_that_change_nothing_pass(mini_text: str) -> None:
    """Darknet's own values for them, and keys of its training; [net] may have anything."""
    more = {
        "net": "mosaic=1\nwhatever=3",
        "convolutional": "dilation=1\nxnor=0\nstopbackward=1\ngroups=1",
        "maxpool": "maxpool_depth=0\nlearning_rate=0.1",
        "route": "groups=1\ngroup_id=0",
        "shortcut": "weights_type=none",
        "upsample": "scale=1.0",
        "yolo": "scale_x_y = 1.0\nnew_coords=0\niou_loss=ciou\nnms_kind=greedynms\nbeta_nms=0.6\nmax=200",
    }
    text = mini_text
    for section, lines in more.items():
        text = text.replace(f"[{section}]", f"[{section}]\n{lines}")
    assert parse(text).layers == parse(mini_text).layers


def test_heads_agree_on_classes_and_there_is_one() -> None:
    with pytest.raises(DetectorError, match=r"own\.cfg: expected \[yolo\] sections .* found no \[yolo\]"):
        parse("[net]\n[convolutional]\nfilters=4\nactivation=linear", "own.cfg")
    with pytest.raises(DetectorError, match=r"own\.cfg:1: expected \[net\] first, found no section"):
        parse("# nothing\n", "own.cfg")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("filters=16", "filters=1000000000", r"filters: expected at most 1048576, found 1000000000"),
        ("filters=16", "filters=", r"filters: expected an integer, found nothing"),
        ("filters=16", f"filters={'9' * 5000}", r"filters: expected integers"),
        (
            "filters=4",
            "filters=2048",
            r"filters, stride: expected .* numbers a pixel up to 256, 4096 in all, found 2",
        ),
        ("size=3", "size=65", r"size: expected at most 63, found 65"),
        ("anchors = 6,6,", f"anchors = {'1,1,' * 998} 6,6,", r"anchors: expected at most 1000, found 1002"),
    ],
)
def test_networks_that_would_take_all_memory(old: str, new: str, message: str, mini_text: str) -> None:
    assert old in mini_text
    with pytest.raises(DetectorError, match=rf"mini\.cfg:\d+: \[\w+\] {message}"):
        parse(mini_text.replace(old, new), "mini.cfg")


def test_strides_that_would_blow_a_picture_up() -> None:
    layer = "[convolutional]\nfilters=1\nsize=1\nactivation=linear\nstride={}\n"
    with pytest.raises(DetectorError, match=r"filters, stride: expected a stride up to 1024, .* found 2187"):
        parse("[net]\n" + layer.format(3) * 7, "a.cfg")
    head = "[yolo]\nclasses=1\nmask=0\nanchors=4,4\n"
    branch = "[route]\nlayers=-{}\n"
    text = "[net]\n" + layer.format(1) + layer.format(31) + branch.format(2) + layer.format(37)
    text += "[convolutional]\nfilters=6\nsize=1\nactivation=linear\n" + head
    with pytest.raises(DetectorError, match="expected strides with a multiple of at most 1024, found 1147"):
        parse(text, "a.cfg")
