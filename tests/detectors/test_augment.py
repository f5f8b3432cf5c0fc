"""Views of frames: what happens to pixels happens to boxes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from detectors.augment import AugmentSettings, augment, crop_targets, degrade, flip_targets, jitter_colour
from detectors.types import Targets

QUIET = AugmentSettings(
    window_hw=(96, 160),
    brightness=0,
    contrast=0,
    gamma=0,
    channel_gain=0,
    saturation=0,
    hue_rad=0,
    blur_probability=0,
    noise_probability=0,
    jpeg_probability=0,
)


def frame_with_block(box: tuple[int, int, int, int]) -> tuple[np.ndarray, Targets]:
    """A black frame 120 x 300 with a white block; pixel columns left..right inclusive are white."""
    image = np.zeros((120, 300, 3), np.uint8)
    image[box[1] : box[3] + 1, box[0] : box[2] + 1] = 255
    return image, Targets(torch.tensor([box]).float(), torch.tensor([1]), torch.tensor([False]))


def white_extent(image: torch.Tensor) -> list[float]:
    rows, columns = torch.nonzero(image.mean(0) > 0.5, as_tuple=True)
    return [float(columns.min()), float(rows.min()), float(columns.max()), float(rows.max())]


@pytest.mark.parametrize("seed", range(12))
def test_boxes_follow_the_pixels(seed: int) -> None:
    image, targets = frame_with_block((140, 50, 189, 79))
    window, window_targets = augment(
        image, targets, replace(QUIET, object_probability=1.0), np.random.default_rng(seed)
    )
    assert window.shape == (3, 96, 160)
    assert window_targets.labels.tolist() == [1]
    # Inclusive pixels against edges: at most one pixel, and the rounding of the zoom.
    assert np.abs(np.array(white_extent(window)) - window_targets.boxes_xyxy[0].numpy()).max() <= 1.6


def test_augmentation_is_a_function_of_frame_and_generator() -> None:
    image, targets = frame_with_block((140, 50, 189, 79))
    settings = replace(
        AugmentSettings(window_hw=(96, 160)), blur_probability=1, noise_probability=1, jpeg_probability=1
    )
    first, boxes = augment(image, targets, settings, np.random.default_rng(5))
    again, boxes_again = augment(image, targets, settings, np.random.default_rng(5))
    other, _ = augment(image, targets, settings, np.random.default_rng(6))
    assert torch.equal(first, again)
    assert torch.equal(boxes.boxes_xyxy, boxes_again.boxes_xyxy)
    assert not torch.equal(first, other)
    assert 0 <= float(first.min()) <= float(first.max()) <= 1


def test_a_frame_smaller_than_the_window_is_filled_with_the_mean_colour() -> None:
    image = np.zeros((40, 50, 3), np.uint8)
    nothing = Targets(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.bool))
    settings = replace(QUIET, scale_probability=0, flip_probability=0)
    window, _ = augment(image, nothing, settings, np.random.default_rng(0))
    outside = (window * 255).round().permute(1, 2, 0).reshape(-1, 3).unique(dim=0).tolist()
    assert outside == [[0, 0, 0], [124, 117, 104]]


@pytest.mark.parametrize(
    ("box", "remains", "ignored"),
    [
        ((20, 20, 60, 60), True, False),
        ((-10, 20, 30, 60), True, False),  # 3/4 visible
        ((-30, 20, 10, 60), True, True),  # 1/4 visible
        ((-50, 20, -10, 60), False, False),
        ((20, 20, 60, 28), True, True),  # too low
    ],
)
def test_cropped_boxes(box: tuple, remains: bool, ignored: bool) -> None:
    targets = Targets(torch.tensor([box]).float(), torch.tensor([0]), torch.tensor([False]))
    cut = crop_targets(targets, (0, 0), (1.0, 1.0), QUIET)
    assert len(cut) == int(remains)
    if remains:
        assert bool(cut.ignore[0]) is ignored
        assert float(cut.boxes_xyxy.min()) >= 0


def test_mirror_twice_is_the_same() -> None:
    targets = Targets(torch.tensor([[3.0, 5.0, 20.0, 30.0]]), torch.tensor([0]), torch.tensor([False]))
    once = flip_targets(targets, 100)
    assert once.boxes_xyxy.tolist() == [[79.0, 5.0, 96.0, 30.0]]
    assert torch.equal(flip_targets(once, 100).boxes_xyxy, targets.boxes_xyxy)


def test_no_change_of_colour_is_none() -> None:
    image = torch.rand(3, 16, 24, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(jitter_colour(image, QUIET, np.random.default_rng(0)), image)
    assert torch.equal(degrade(image, QUIET, np.random.default_rng(0)), image)


def test_hue_and_saturation_keep_grey() -> None:
    grey = torch.full((3, 4, 4), 0.3)
    settings = replace(QUIET, hue_rad=0.5, hue_probability=1.0, saturation=0.8)
    torch.testing.assert_close(jitter_colour(grey, settings, np.random.default_rng(1)), grey)


@pytest.mark.parametrize("name", ["blur_probability", "noise_probability", "jpeg_probability"])
def test_degradations_change_little(name: str) -> None:
    ramp = torch.linspace(0.2, 0.8, 48).expand(3, 20, 48).contiguous()
    changed = degrade(ramp, replace(QUIET, **{name: 1.0}), np.random.default_rng(3))
    assert changed.shape == ramp.shape
    difference = float((changed - ramp).abs().mean())
    assert 1e-5 < difference < 0.04
