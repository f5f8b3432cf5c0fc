"""Small random models of transformers: boxes equal those of the library's own post-processing; gradients."""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from detectors.base import DetectorError
from detectors.check import check_detector
from detectors.registry import load_detector

HW = (64, 96)
NAMES = {0: "N/A", 1: "person", 2: "car", 3: "bus"}
LABELS: dict[str, Any] = {"id2label": NAMES, "label2id": {name: i for i, name in NAMES.items()}}
SMALL: dict[str, Any] = {
    "d_model": 32, "encoder_layers": 1, "decoder_layers": 2, "encoder_attention_heads": 2,
    "decoder_attention_heads": 2, "encoder_ffn_dim": 32, "decoder_ffn_dim": 32, "num_queries": 12,
}  # fmt: skip
WITHOUT_TIMM: dict[str, Any] = {"use_timm_backbone": False, "use_pretrained_backbone": False}
BACKBONE: dict[str, Any] = {
    "embedding_size": 8, "hidden_sizes": [8, 16, 16, 16], "depths": [1, 1, 1, 1], "layer_type": "basic",
}  # fmt: skip
SIZE = {"shortest_edge": HW[0], "longest_edge": 107}


def make_detr(t: Any) -> tuple[Any, Any]:
    backbone = t.ResNetConfig(**BACKBONE, out_features=["stage4"])
    config = t.DetrConfig(backbone=None, backbone_config=backbone, **WITHOUT_TIMM, **SMALL, **LABELS)
    return t.DetrForObjectDetection(config), t.DetrImageProcessorPil(size=SIZE)


def make_deformable(t: Any) -> tuple[Any, Any]:
    backbone = t.ResNetConfig(**BACKBONE, out_features=["stage2", "stage3", "stage4"])
    levels = {"backbone": None, "backbone_config": backbone, "num_feature_levels": 3}
    config = t.DeformableDetrConfig(**levels, **WITHOUT_TIMM, **SMALL, **LABELS)
    return t.DeformableDetrForObjectDetection(config), t.DeformableDetrImageProcessorPil(size=SIZE)


def make_yolos(t: Any) -> tuple[Any, Any]:
    heads = {"num_hidden_layers": 2, "num_attention_heads": 2, "num_detection_tokens": 12}
    config = t.YolosConfig(
        hidden_size=32,
        intermediate_size=32,
        image_size=[*HW],
        use_mid_position_embeddings=False,
        **heads,
        **LABELS,
    )
    return t.YolosForObjectDetection(config), t.YolosImageProcessorPil(size=SIZE)


def make_rtdetr(t: Any) -> tuple[Any, Any]:
    backbone = t.RTDetrResNetConfig(**BACKBONE, out_features=["stage2", "stage3", "stage4"])
    channels = {"encoder_hidden_dim": 32, "encoder_in_channels": [16] * 3, "decoder_in_channels": [32] * 3}
    config = t.RTDetrConfig(
        backbone_config=backbone, num_denoising=0, **channels, **WITHOUT_TIMM, **SMALL, **LABELS
    )
    return t.RTDetrForObjectDetection(config), t.RTDetrImageProcessorPil(
        size=dict(zip(("height", "width"), HW, strict=True))
    )


@pytest.fixture
def transformers() -> Any:
    if importlib.util.find_spec("transformers") is None:
        pytest.skip("needs transformers")
    return importlib.import_module("transformers")


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("make", [make_detr, make_deformable, make_yolos, make_rtdetr])
def test_boxes_are_those_of_the_library(
    make: Callable[[Any], tuple[Any, Any]], transformers: Any, tmp_path: Path
) -> None:
    torch.manual_seed(0)
    model, processor = make(transformers)
    with torch.no_grad():
        for name, parameter in model.named_parameters():  # a fresh model predicts nearly the same everywhere
            parameter.add_(0.2 * torch.randn_like(parameter))
            if (
                parameter.ndim == 1 and ("class" in name or "score" in name) and len(parameter) in (4, 5)
            ):  # N/A is rare
                parameter[0] = -5
    model.eval().save_pretrained(tmp_path)
    processor.save_pretrained(tmp_path)
    detector = load_detector(f"hf:{tmp_path}")
    assert detector.classes == ("person", "Car", "bus")
    image = (torch.rand(1, 3, *HW) * 255).byte()
    with torch.no_grad():
        given = processor(images=image[0].permute(1, 2, 0).numpy(), return_tensors="pt")
        outputs = model(pixel_values=given["pixel_values"])
        (expected,) = processor.post_process_object_detection(outputs, threshold=0, target_sizes=[HW])
        raw = detector(image.float() / 255)
    compared = 0
    for score, label, box in zip(*(expected[key] for key in ("scores", "labels", "boxes")), strict=True):
        if NAMES[int(label)] != "N/A":
            # pixel centres lie at integers, the library counts from the corner
            distance = (raw.boxes_xyxy[0, :, 0] + 0.5 - box).abs().max(1).values
            off = (raw.probabilities[0, :, int(label) - 1] - score).abs()
            assert float((distance / 100 + off).min()) < 1e-3
            compared += 1
    assert compared
    check_detector(detector, HW).require()


def test_a_folder_without_a_model(transformers: Any, tmp_path: Path) -> None:
    with pytest.raises(DetectorError, match=r"^hf:\S+: expected an object detection model of transformers, found"):
        load_detector(f"hf:{tmp_path}")
