"""Detectors from ONNX files: planted predictions, tiles, and files that are something else."""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
import torch

from detectors.adapters import formats as nanodet
from detectors.adapters.onnx import OnnxPredictor
from detectors.adapters.spec import COCO_NAMES, normalise_images
from detectors.base import DetectorError, predict
from detectors.registry import load_detector, load_predictor
from tools.onnx_graph import constant_graph

NANODET = Path(__file__).resolve().parents[4] / "shared" / "data" / "detectors" / "nanodet_m.onnx"
SIDE = 64
"""Of the tiny graphs' input: 8 x 8, 4 x 4 and 2 x 2 cells."""
CAR, TRUCK = COCO_NAMES.index("car"), COCO_NAMES.index("truck")


def outputs(plants: Mapping[tuple[int, int, int, int], tuple[float, ...]]) -> dict[str, np.ndarray]:
    """NanoDet's outputs: (stride, row, column, class) -> (score, left, top, right, bottom), in strides."""
    found = {}
    for stride in (8, 16, 32):
        cells = SIDE // stride
        scores, bins = np.zeros((1, cells * cells, 80)), np.zeros((1, cells * cells, 4, 8))
        for (level, row, column, label), (score, *distances) in plants.items():
            if level != stride:
                continue
            scores[0, row * cells + column, label] = score
            for side, distance in enumerate(distances):
                low = int(distance)
                # softmax over two bins alone: their mean is the distance
                bins[0, row * cells + column, side] = -50.0
                bins[0, row * cells + column, side, low] = np.log(max(1 - (distance - low), 1e-9))
                bins[0, row * cells + column, side, min(low + 1, 7)] = np.log(max(distance - low, 1e-9))
        found[f"scores{stride}"] = scores
        found[f"boxes{stride}"] = bins.reshape(1, cells * cells, 32)
    return found


Make = Callable[..., Path]


@pytest.fixture
def graph(tmp_path: Path) -> Make:
    """A file with constant outputs, for an input (1, 3, SIDE, SIDE) or another one."""

    def make(given: Mapping[str, np.ndarray], shape: tuple[int | str, ...] = (1, 3, SIDE, SIDE)) -> Path:
        path = tmp_path / "tiny.onnx"
        path.write_bytes(constant_graph(shape, given))
        return path

    return make


def test_a_planted_box_is_read(graph: Make) -> None:
    path = graph(
        outputs({(8, 2, 3, CAR): (0.9, 1.5, 1.0, 2.25, 0.5), (16, 1, 1, TRUCK): (0.4, 0.5, 0.5, 0.5, 0.5)})
    )
    predictor = OnnxPredictor(path)
    (found,) = predict(predictor, torch.zeros(1, 3, SIDE, SIDE))
    assert [predictor.classes[int(label)] for label in found.labels] == ["Car", "truck"]
    torch.testing.assert_close(found.scores, torch.tensor([0.9, 0.4]))
    # centres at (column + 1/2) strides; from edges to pixel centres, half a pixel less
    x, y = 3.5 * 8 - 0.5, 2.5 * 8 - 0.5
    expected = [[x - 12, y - 8, x + 18, y + 4], [24 - 8.5, 24 - 8.5, 24 + 7.5, 24 + 7.5]]
    torch.testing.assert_close(found.boxes_xyxy, torch.tensor(expected), atol=1e-3, rtol=0)


def test_a_picture_of_another_shape_is_scaled_and_centred(graph: Make) -> None:
    # 2 px of a picture of 64 x 128 make one of the network, whose rows 16 to 47 show it
    path = graph(outputs({(8, 4, 2, CAR): (0.9, 1.0, 1.0, 1.0, 1.0)}))
    (found,) = predict(OnnxPredictor(path, "off"), torch.zeros(1, 3, 64, 128))
    expected = torch.tensor([[24.0, 24, 56, 56]]) - 0.5
    torch.testing.assert_close(found.boxes_xyxy, expected, atol=1e-3, rtol=0)


def test_every_window_has_its_place(graph: Make) -> None:
    # The graph sees the same in every window: in the whole picture and in three of 64 x 64.
    path = graph(outputs({(8, 4, 4, CAR): (0.9, 1.0, 1.0, 1.0, 1.0)}))
    (found,) = predict(OnnxPredictor(path), torch.zeros(1, 3, 64, 128))
    centres = (found.boxes_xyxy[:, 0] + found.boxes_xyxy[:, 2]) / 2
    assert sorted(round(float(c), 1) for c in centres) == [35.5, 67.5, 71.5, 99.5]


def test_what_the_network_is_fed() -> None:
    image = torch.tensor([1.0, 0.5, 0.0]).view(1, 3, 1, 1)
    blue, green, red = normalise_images(image, nanodet.NANODET_SPEC).flatten().tolist()
    assert blue == pytest.approx(-103.53 / 57.375)
    assert green == pytest.approx((127.5 - 116.28) / 57.12)
    assert red == pytest.approx((255 - 123.675) / 58.395)


def test_a_box_is_cut_at_the_pictures_border(graph: Make) -> None:
    path = graph(outputs({(32, 0, 0, CAR): (0.9, 2.0, 2.0, 0.25, 0.25)}))
    (found,) = predict(OnnxPredictor(path), torch.zeros(1, 3, SIDE, SIDE))
    torch.testing.assert_close(found.boxes_xyxy, torch.tensor([[0.0, 0, 23.5, 23.5]]), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("tiling", "width", "both"), [("off", 64, True), ("auto", 64, True), ("auto", 128, False)]
)
def test_suppression_of_a_yaml_file(tiling: str, width: int, both: bool, graph: Make, tmp_path: Path) -> None:
    """Two boxes at IoU 0.6: one window suppresses as the file says, several ones' boxes at 0.5 as ever."""
    (tmp_path / "tiny.yaml").write_text("classes: coco\nnms_iou: 0.7\n")
    rows = np.zeros((1, 300, 6))
    rows[0, :2] = [10, 10, 50, 30, 0.9, CAR], [20, 10, 60, 30, 0.8, CAR]
    predictor = OnnxPredictor(graph({"out": rows}), tiling)
    (found,) = predict(predictor, torch.zeros(1, 3, SIDE, width))
    assert {round(float(score), 6) for score in found.scores} == ({0.9, 0.8} if both else {0.9})


def test_what_lies_in_the_padding_is_nothing(graph: Make) -> None:
    # a picture of 64 x 128 fills rows 16 to 47 of the input
    rows = np.zeros((1, 300, 6))
    rows[0, :2] = [10, 2, 50, 14, 0.9, CAR], [10, 10, 50, 30, 0.8, CAR]
    (found,) = predict(OnnxPredictor(graph({"out": rows}), "off"), torch.zeros(1, 3, 64, 128))
    torch.testing.assert_close(found.scores, torch.tensor([0.8]))


def yolov8(dtype: type = np.float32) -> np.ndarray:
    rows = np.zeros((1, 84, 100), dtype)
    rows[0, :4, 7], rows[0, 4 + CAR, 7] = (30, 20, 40, 20), 0.75
    return rows


BFLOAT16 = torch.from_numpy(yolov8()).bfloat16().view(torch.uint16).numpy()


@pytest.mark.parametrize(
    ("shape", "output", "options", "yaml"),
    [
        ((1, 3, SIDE, SIDE), yolov8(), {}, ""),
        ((1, 3, SIDE, SIDE), yolov8(), {"open_sides": True}, ""),
        (("batch", 3, "height", "width"), yolov8(), {"open_sides": True}, "size: 64"),
        (("batch", 3, "height", "width"), yolov8(), {"facts": {"imgsz": "[64, 64]"}}, ""),
        ((4, 3, SIDE, SIDE), yolov8().repeat(4, 0), {}, ""),
        ((1, SIDE, SIDE, 3), yolov8(), {}, ""),
        ((1, 3, SIDE, SIDE), yolov8(np.float16), {"inputs": {"image": "float16"}}, ""),
        ((1, 3, SIDE, SIDE), BFLOAT16, {}, ""),
        ((1, SIDE, SIDE, 3), yolov8(), {"inputs": {"image": "uint8"}}, ""),
        ((1, 3, SIDE, SIDE), yolov8(), {"inputs": {"image": "float32", "scale_factor": "float32"}}, ""),
        ((1, 3, SIDE, SIDE), yolov8(), {"inputs": {"image": "float32", "orig_target_sizes": "int64"}}, ""),
    ],
)
def test_a_graph_gets_what_it_declares(
    shape: tuple[int | str, ...], output: np.ndarray, options: dict, yaml: str, tmp_path: Path
) -> None:
    path = tmp_path / "own.onnx"
    path.write_bytes(constant_graph(shape, {"output0": output}, **options))
    if yaml:
        path.with_suffix(".yaml").write_text(yaml)
    predictor = OnnxPredictor(path)
    (found,) = predict(predictor, torch.zeros(1, 3, SIDE, SIDE))
    assert predictor.format.name == "yolov8"
    assert found.boxes_xyxy.tolist() == [[9.5, 9.5, 49.5, 29.5]]
    assert found.scores.tolist() == [0.75]


def test_whole_numbers_are_8_bit_values(tmp_path: Path) -> None:
    path = tmp_path / "own.onnx"
    path.write_bytes(constant_graph((1, 3, SIDE, SIDE), {"output0": yolov8()}, inputs={"image": "uint8"}))
    assert OnnxPredictor(path).decoder.spec.scale == 255
    path.write_bytes(constant_graph((1, 3, SIDE, SIDE), {"output0": yolov8()}, inputs={"image": "bfloat16"}))
    with pytest.raises(DetectorError, match=r"own\.onnx: input image: expected tensor\(float\), .*bfloat16"):
        OnnxPredictor(path)


def test_nothing_is_found_in_an_empty_picture(graph: Make) -> None:
    first, second = predict(OnnxPredictor(graph(outputs({}))), torch.zeros(2, 3, 64, 128))
    assert len(first) == len(second) == 0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "expected an ONNX file, found none"),
        (b"this is no graph", "expected an ONNX graph, found"),
    ],
)
def test_files_that_are_none(content: bytes | None, message: str, tmp_path: Path) -> None:
    path = tmp_path / "own.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DetectorError, match=rf"own\.onnx: {message}") as caught:
        load_predictor(f"onnx:{path}")
    assert "\n" not in str(caught.value)


def test_names_that_are_no_text(graph: Make) -> None:
    path = graph({"scores": np.zeros((1, 4, 80))})
    data = path.read_bytes()
    assert b"image" in data
    path.write_bytes(data.replace(b"image", b"im\xffge"))
    with pytest.raises(DetectorError, match=r"tiny\.onnx: expected an ONNX graph, found 'utf-8'"):
        load_predictor(f"onnx:{path}")


def test_graphs_of_no_known_kind(graph: Make) -> None:
    with pytest.raises(DetectorError, match=r"expected the outputs of nanodet or .* or ssd, found \[1, 5\]"):
        OnnxPredictor(graph({"y": np.zeros((1, 5))}))
    wrong = outputs({})
    wrong["scores8"] = wrong["scores8"][:, 1:]
    with pytest.raises(DetectorError, match="expected the outputs of nanodet or"):
        OnnxPredictor(graph(wrong))


@pytest.mark.parametrize("shape", [(1, 3, "height", "width"), (1, 1, 64, 64), (64, 64), (500, 3, 64, 64)])
def test_inputs_that_are_no_image_of_one_size(shape: tuple[int | str, ...], graph: Make) -> None:
    with pytest.raises(
        DetectorError, match=r"expected one input \(1, 3, height, width\) of fixed size .*, found image"
    ):
        OnnxPredictor(graph(outputs({}), shape))


def test_missing_runtime_names_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(DetectorError, match=r"own\.onnx: needs ONNX Runtime: pip install 'onnxruntime>=1\.19'"):
        load_predictor("onnx:own.onnx")


@pytest.mark.parametrize("kind", ["onnx", "onnx-runtime"])
def test_what_has_no_gradient_is_no_detector_to_attack(kind: str, graph: Make) -> None:
    with pytest.raises(DetectorError, match=rf"expected one with gradients, found '{kind}:\S+', which has none"):
        load_detector(f"{kind}:{graph(outputs({}))}")


def test_unknown_tiling_is_refused(graph: Make) -> None:
    with pytest.raises(DetectorError, match="tiles: expected auto or off, found 'some'"):
        load_predictor(f"onnx:{graph(outputs({}))}", tiling="some")


def test_the_shipped_detector_is_a_predictor_too() -> None:
    predictor = load_predictor("squeezedet")
    (found,) = predict(predictor, torch.zeros(1, 3, 64, 96))
    assert "Car" in predictor.classes
    assert bool((found.scores >= 0).all())


@pytest.mark.skipif(not NANODET.is_file(), reason="needs ../shared/data/detectors/nanodet_m.onnx")
def test_nanodet_is_recognised_and_threads_follow_torch() -> None:
    predictor = OnnxPredictor(NANODET)
    assert predictor.format.name == "nanodet"
    assert predictor.input_hw == (416, 416)
    assert predictor.classes.index("Car") == CAR
    assert predictor.graph.session.get_session_options().intra_op_num_threads == torch.get_num_threads()
    raw = predictor.forward(torch.full((1, 3, 375, 1242), 0.5))
    assert [len(tiles) for tiles in raw.predictions] == [4]
    assert all(bool((d.scores <= 1).all()) for d in predictor.decode(raw))
