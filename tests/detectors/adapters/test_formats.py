"""Outputs of the known families, planted by hand, and the YAML files that say how to read others."""

from pathlib import Path

import pytest
import torch

from detectors.adapters.formats import flatten_outputs, make_decoder
from detectors.adapters.spec import (
    COCO_CLASSES,
    COCO_CLASSES_91,
    NetworkSpec,
    fit_images,
    load_spec,
    normalise_images,
)
from detectors.base import DetectorError

INPUT_HW = (64, 128)
BOX = [10.0, 20.0, 50.0, 40.0]
CENTRED = [30.0, 30.0, 40.0, 20.0]


def yolov8(classes: int = 3, places: int = 40) -> torch.Tensor:
    output = torch.zeros(1, 4 + classes, places)
    output[0, :4, 7], output[0, 4 + 2, 7] = torch.tensor(CENTRED), 0.75
    return output


def yolov5(classes: int = 3, places: int = 40) -> torch.Tensor:
    output = torch.zeros(1, places, 5 + classes)
    output[0, 7] = torch.tensor([*CENTRED, 0.8, *[0.0] * classes])
    output[0, 7, 5 + 2] = 0.5
    return output


def read(outputs, settings=None, names=("a", "b", "c")):
    found = make_decoder(outputs, INPUT_HW, settings or {}, names, "own")
    boxes, scores = found.decode(outputs, INPUT_HW)
    image, place, label = (scores > 0.1).nonzero()[0].tolist()
    return found, boxes[image, place].tolist(), found.classes[label], float(scores[image, place, label])


def end_to_end() -> torch.Tensor:
    rows = torch.zeros(1, 300, 6)
    rows[0, 4] = torch.tensor([*BOX, 0.75, 2])
    return rows


CHOSEN = [torch.tensor([BOX]), torch.tensor([2]), torch.tensor([0.75])]
ANCHORS = torch.tensor(BOX).expand(1, 9, 4) * (torch.arange(9) == 3)[None, :, None]
SCORES = torch.tensor([0.0, 0.0, 0.75]).expand(1, 9, 3) * (torch.arange(9) == 3)[None, :, None]


@pytest.mark.parametrize(
    ("name", "outputs", "score"),
    [
        ("yolov8", [yolov8()], 0.75),
        ("yolov5", [yolov5()], 0.4),
        ("end2end", [end_to_end()], 0.75),
        ("torchvision", CHOSEN, 0.75),
        ("torchvision", [CHOSEN[2][None], CHOSEN[0][None], CHOSEN[1][None]], 0.75),
        ("ssd", [ANCHORS, SCORES], 0.75),
        ("ssd", [SCORES, ANCHORS], 0.75),
    ],
)
def test_a_planted_box_is_read(name: str, outputs: list[torch.Tensor], score: float) -> None:
    found, box, label, value = read(outputs)
    assert found.format.name == name
    assert label == "c"
    assert box == pytest.approx(BOX)
    assert value == pytest.approx(score)


CAR = COCO_CLASSES.index("Car")
CAR_91 = COCO_CLASSES_91.index("Car")
CELLS = 16 * 8 + 8 * 4 + 4 * 2
"""Cells of 8, 16 and 32 px in an input of 64 x 128."""


def corners_and_scores() -> tuple[torch.Tensor, torch.Tensor]:
    """One network's boxes (CELLS, 4) px around their cells, and scores (CELLS, 80): one car of 0.75, others low."""
    places = []
    for stride in (8, 16, 32):
        y, x = torch.meshgrid(torch.arange(64 // stride), torch.arange(128 // stride), indexing="ij")
        places.append((torch.stack((x, y), -1).reshape(-1, 2) + 0.5) * stride)
    centres = torch.cat(places)
    boxes = torch.cat((centres - 6, centres + 6), -1)
    boxes[7] = torch.tensor(BOX)
    scores = torch.full((CELLS, 80), 0.001)
    scores[7, CAR] = 0.75
    return boxes, scores


def as_layout(name: str) -> list[torch.Tensor]:
    """The network's outputs, exported in another layout."""
    boxes, scores = corners_and_scores()
    centred = torch.cat(((boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]), -1)
    best, labels = scores.max(-1)
    order = best.argsort(descending=True)[:50]
    top, label, score = boxes[order], labels[order], best[order]
    shares = torch.tensor([128.0, 64, 128, 64])
    sure = torch.ones(CELLS, 1)
    strides = torch.cat([torch.full((128 * 64 // s**2, 1), float(s)) for s in (8, 16, 32)])
    grid = (corners_and_scores()[0][:, :2] + 6) / strides - 0.5
    grid[7] = torch.tensor([7.0, 0])
    raw = torch.cat((centred[:, :2] / strides - grid, (centred[:, 2:] / strides).log(), sure, scores), -1)
    numbers = torch.tensor([i for i, one in enumerate(COCO_CLASSES_91) if one])
    wide = torch.full((CELLS, 91), 1e-6).index_copy(1, numbers, scores)
    with_background = torch.cat((1 - scores.sum(-1, keepdim=True), scores), -1)
    layouts = {
        "yolov8": [torch.cat((centred, scores), -1).T],
        "transposed": [torch.cat((centred, scores), -1)],
        "half": [torch.cat((centred, scores), -1).T.half()],
        "masks": [torch.cat((centred, scores, torch.ones(CELLS, 32)), -1).T, torch.ones(32, 16, 32)],
        "yolov5": [torch.cat((centred, sure, scores), -1)],
        "yolox": [torch.cat((centred, sure, scores), -1)],
        "yolox raw": [raw],
        "tensorrt": [torch.tensor([50]), top, score, label.int()],
        "yolov7": [torch.cat((0 * score[:, None], top, label[:, None], score[:, None]), -1)],
        "mmdet": [torch.cat((top, score[:, None]), -1), label],
        "paddle": [torch.cat((label[:, None], score[:, None], top), -1), torch.tensor([50])],
        "end2end": [torch.cat((top, score[:, None], label[:, None]), -1)],
        "tfod": [(top / shares)[:, [1, 0, 3, 2]], numbers[label].float(), score],
        "torchvision": [top, numbers[label], score],
        "rtdetr": [torch.logit(scores), centred / shares],
        "rtdetr joined": [torch.cat((centred / shares, scores), -1)],
        "rfdetr": [centred / shares, torch.logit(wide)],
        "detr": [torch.cat((wide, 1 - wide.sum(-1, keepdim=True)), -1).log() + 3, centred / shares],
        "ssd": [boxes, scores],
        "ssd background": [with_background.log(), boxes / shares],
    }
    flat = name in ("yolov7", "paddle", "torchvision")
    return layouts[name] if flat else [output[None] for output in layouts[name]]


@pytest.mark.parametrize(
    ("layout", "name", "settings", "nodes"),
    [
        ("yolov8", "yolov8", {}, ()),
        ("transposed", "yolov8", {}, ()),
        ("transposed", "yolov8", {"format": "yolov8"}, ()),
        ("half", "yolov8", {}, ()),
        ("masks", "yolov8", {}, ()),
        ("yolov5", "yolov5", {}, ()),
        ("yolox", "yolox", {"format": "yolox"}, ()),
        ("yolox raw", "yolox", {}, ()),
        ("tensorrt", "tensorrt", {}, ()),
        ("yolov7", "yolov7", {}, ()),
        ("mmdet", "mmdet", {}, ()),
        ("paddle", "paddle", {}, ()),
        ("end2end", "end2end", {}, ()),
        ("end2end", "end2end", {"format": "end2end"}, ()),
        ("tfod", "tfod", {}, ("detection_boxes", "detection_classes", "detection_scores")),
        ("torchvision", "torchvision", {}, ()),
        ("torchvision", "rtdetr-end2end", {"classes": COCO_CLASSES_91}, ("images", "orig_target_sizes")),
        ("rtdetr", "rtdetr", {}, ()),
        ("rtdetr joined", "rtdetr", {}, ()),
        ("rfdetr", "rfdetr", {}, ()),
        ("detr", "detr", {}, ()),
        ("ssd", "ssd", {}, ()),
        ("ssd background", "ssd", {}, ()),
    ],
)
def test_one_network_in_every_layout(layout: str, name: str, settings: dict, nodes: tuple[str, ...]) -> None:
    outputs = as_layout(layout)
    found = make_decoder(outputs, INPUT_HW, settings, None, "own", nodes)
    assert found.format.name == name
    boxes, scores = found.decode(outputs, INPUT_HW)
    image, place, label = (scores > 0.1).nonzero()[0].tolist()
    assert len((scores > 0.1).nonzero()) == 1
    assert found.classes[label] == "Car"
    assert boxes[image, place].tolist() == pytest.approx(BOX, abs=0.05)
    assert float(scores[image, place, label]) == pytest.approx(0.75, abs=1e-3)


def test_a_named_format_wins_and_others_are_named() -> None:
    outputs = as_layout("yolox")
    guessed = make_decoder(outputs, INPUT_HW, {}, None, "own")
    assert guessed.format.name == "yolov5"
    assert "yolox" in guessed.alternatives
    assert "yolox is possible too (`format` in a YAML file)" in guessed.describe()
    named = make_decoder(outputs, INPUT_HW, {"format": "yolox"}, None, "own").spec
    assert (named.channels, named.scale, named.centred) == ("bgr", 255.0, False)


def test_other_boxes_and_activations() -> None:
    shares = [value / side for value, side in zip(BOX, (128, 64) * 2, strict=True)]
    boxes = torch.tensor([shares[1], shares[0], shares[3], shares[2]]).expand(1, 9, 4)
    logits = torch.tensor([0.0, 0.0, 3.0]).expand(1, 9, 3)
    settings = {"boxes": "yxyx", "normalised": True, "activation": "softmax", "classes": ("", "car", "bus")}
    found, box, label, value = read([boxes, logits], settings)
    assert box == pytest.approx(BOX)
    # the column without a name is no class, but counts in the softmax
    assert found.classes == ("car", "bus")
    assert (label, value) == ("bus", pytest.approx(torch.e**3 / (2 + torch.e**3)))
    _, box, _, _ = read([torch.tensor([10.0, 20, 40, 20]).expand(1, 9, 4), logits], {"boxes": "xywh"})
    assert box == pytest.approx(BOX)
    _, _, _, value = read([torch.logit(yolov5(), 1e-4) * (torch.arange(8) > 3)], {"activation": "sigmoid"})
    assert value == pytest.approx(0.4, abs=1e-3)


def test_classes_come_from_the_spec_the_file_or_their_number() -> None:
    assert read([yolov8(80, 100)], names=None)[0].classes == COCO_CLASSES
    assert read([ANCHORS, torch.full((1, 9, 91), 0.5)], names=None)[0].classes[2] == "Car"
    assert read([yolov8()], {"classes": ("x", "y", "z")})[0].classes == ("x", "y", "z")
    with pytest.raises(DetectorError, match="own: classes: expected 3 names in a YAML file, found none"):
        read([yolov8()], names=None)
    with pytest.raises(DetectorError, match="own: classes: expected 3, one a column of scores, found 2"):
        read([yolov8()], names=("a", "b"))


def test_cocos_numbers_with_gaps() -> None:
    assert (
        COCO_CLASSES_91[0],
        COCO_CLASSES_91[1],
        COCO_CLASSES_91[3],
        COCO_CLASSES_91[12],
        COCO_CLASSES_91[90],
    ) == (
        *("", "person", "Car"),
        *("", "toothbrush"),
    )
    assert tuple(name for name in COCO_CLASSES_91 if name) == COCO_CLASSES


def test_what_no_format_reads() -> None:
    with pytest.raises(DetectorError, match=r"own: expected the outputs of nanodet or .*, found \[1, 5\]"):
        read([torch.zeros(1, 5)])
    with pytest.raises(DetectorError, match=r"own: expected the outputs of yolov5, found \[1, 7, 40\]"):
        read([yolov8()], {"format": "yolov5"})
    with pytest.raises(DetectorError, match=r"own: format: expected one of nanodet, .*, found 'yolo9'"):
        read([yolov8()], {"format": "yolo9"})


def test_labels_beyond_the_classes_are_nothing() -> None:
    found = make_decoder(CHOSEN, INPUT_HW, {}, ("a",), "own")
    assert float(found.decode(CHOSEN, INPUT_HW)[1].sum()) == 0


def test_tensors_are_found_wherever_they_are() -> None:
    a, b, c = CHOSEN
    assert [t.shape for t in flatten_outputs(({}, [{"scores": c, "boxes": a, "labels": b}]))] == [
        a.shape,
        b.shape,
        c.shape,
    ]


def test_letterbox_and_stretch_bring_boxes_back() -> None:
    image = torch.zeros(1, 3, 32, 128)
    image[:, :, 8:16, 64:96] = 1
    for resize, size in (("letterbox", (64, 64)), ("stretch", (64, 64)), ("letterbox", (96, 200))):
        fed, fitted = fit_images(image, NetworkSpec(size=size, resize=resize, pad=0.0))
        assert tuple(fed.shape[2:]) == size
        rows, columns = (fed[0, 0] > 0.5).nonzero().unbind(1)
        edges = torch.tensor([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]).float()
        # the block's first and last pixel, half a pixel outside their centres
        torch.testing.assert_close(fitted.to_image(edges), torch.tensor([63.5, 7.5, 95.5, 15.5]), atol=1.1, rtol=0)
    fed, fitted = fit_images(image[..., :120], NetworkSpec(multiple=32, centred=False, pad=0.25))
    assert tuple(fed.shape) == (1, 3, 32, 128)
    assert bool((fed[..., 120:] == 0.25).all())
    assert fitted.to_image(torch.tensor([0.0, 0, 4, 4])).tolist() == [-0.5, -0.5, 3.5, 3.5]


def test_boxes_come_back_by_the_rounded_size() -> None:
    """375 x 1242 px at 416: 125.6 rows, of which 126 are shown; the picture's border comes back to its border."""
    fed, fitted = fit_images(torch.ones(1, 3, 375, 1242), NetworkSpec(size=(416, 416), pad=0.0))
    rows, columns = (fed[0, 0] > 0).nonzero().unbind(1)
    edges = torch.tensor([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]).float()
    torch.testing.assert_close(
        fitted.to_image(edges), torch.tensor([-0.5, -0.5, 1241.5, 374.5]), atol=1e-3, rtol=0
    )


def test_a_picture_too_flat_for_a_row_has_one() -> None:
    fed, fitted = fit_images(torch.ones(1, 3, 1, 1242), NetworkSpec(size=(416, 416), pad=0.0))
    assert float(fed.sum()) == pytest.approx(3 * 416)
    edges = torch.tensor([0.0, 207, 416, 208])
    torch.testing.assert_close(fitted.to_image(edges), torch.tensor([-0.5, -0.5, 1241.5, 0.5]), atol=1e-3, rtol=0)


def test_what_a_network_is_fed() -> None:
    image = torch.tensor([1.0, 0.5, 0.0]).view(1, 3, 1, 1)
    spec = NetworkSpec(channels="bgr", scale=255.0, mean=(1.0, 2.0, 3.0), std=(2.0, 2.0, 4.0))
    assert normalise_images(image, spec).flatten().tolist() == [-0.5, 62.75, 63.0]


def test_a_yaml_file(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text("size: [384, 1248]\nmean: 0.5\nstd: [1, 2, 3]\nclasses: [car, '-', bus]\nresize: stretch\n")
    assert load_spec(path) == {
        "size": (384, 1248),
        "mean": (0.5, 0.5, 0.5),
        "std": (1.0, 2.0, 3.0),
        "classes": ("car", "", "bus"),
        "resize": "stretch",
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]", "expected a mapping of settings, found list"),
        ("sise: 3", "sise: expected one of .*, found an unknown key"),
        ("size: [1, 2, 3]", r"size: expected a number of px up to 8192, or \[height, width\], found \[1, 2, 3\]"),
        ("size: 0", "size: expected a number of px"),
        ("std: 0", "std: expected a positive number, or three, found 0"),
        ("resize: crop", "resize: expected letterbox or stretch, found 'crop'"),
        ("classes: [car, car]", "classes: expected coco, coco91, coco-people, or a list of names, each once"),
        ("classes: kitti", "classes: expected coco, coco91, coco-people"),
        ("normalised: 1", "normalised: expected true or false, found 1"),
        ("t_star: 2", r"t_star: expected a number in \[0, 1\], found 2"),
        ("a: [", "expected a YAML file, found"),
    ],
)
def test_yaml_files_that_are_wrong(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(text)
    with pytest.raises(DetectorError, match=rf"own\.yaml: {message}"):
        load_spec(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &a [x]\nb: [*a, *a]", r"expected a YAML file, found an alias"),
        ("[" * 20_000, r"expected a YAML file, found"),
        (f"t_star: {'9' * 5000}", r"expected a YAML file, found Exceeds the limit"),
        ("#" * (1 << 19), r"expected a YAML file of at most 262,144 bytes, found 524,288"),
        ("2026-99-99", r"expected a YAML file, found month must be"),
        ("size: 100000", r"size: expected a number of px up to 8192"),
        ("multiple: 9000", r"multiple: expected a whole number up to 8192"),
        ("size: .inf", r"size: expected"),
    ],
)
def test_yaml_files_that_were_made_to_harm(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(text)
    with pytest.raises(DetectorError, match=rf"own\.yaml: {message}"):
        load_spec(path)


def test_a_yaml_file_that_never_ends(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").symlink_to("/dev/zero")
    with pytest.raises(DetectorError, match=r"own\.yaml: expected a YAML file, found no regular file"):
        load_spec(tmp_path / "own.yaml")
