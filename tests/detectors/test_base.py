"""Prediction in parts when device memory runs out, and atomic writing."""

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from detectors.base import DetectorError, predict, run_in_halves
from detectors.files import write_atomically
from detectors.types import Detections


class SmallMemoryPredictor:
    """A predictor on a device that holds no more than `most` images at once. What it finds is an image's mean."""

    name, classes = "few", ("Car",)

    def __init__(self, most: int) -> None:
        self.most, self.seen = most, list[int]()

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        if len(images) > self.most:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        self.seen.append(len(images))
        return images.mean((1, 2, 3))

    def decode(self, raw: torch.Tensor) -> list[Detections]:
        one = torch.zeros(1, dtype=torch.int64)
        return [Detections(torch.zeros(1, 4), one, mean[None]) for mean in raw]


@pytest.mark.parametrize(("most", "parts"), [(7, [7]), (4, [4, 3]), (3, [2, 2, 3]), (1, 7 * [1])])
def test_images_are_split_when_memory_runs_out(
    most: int, parts: Sequence[int], capsys: pytest.CaptureFixture[str]
) -> None:
    predictor, images = SmallMemoryPredictor(most), torch.rand(7, 3, 4, 5)
    found = predict(predictor, images)
    assert predictor.seen == parts
    torch.testing.assert_close(torch.cat([one.scores for one in found]), images.mean((1, 2, 3)))
    lines = capsys.readouterr().err.splitlines()
    assert lines[:1] == ([] if most == 7 else ["drivesem: 7 images at once exceed the device's memory: trying 4"])


def test_single_image_beyond_memory_is_an_error() -> None:
    with pytest.raises(torch.OutOfMemoryError):
        predict(SmallMemoryPredictor(0), torch.rand(2, 3, 4, 5))


def test_other_errors_are_not_retried() -> None:
    calls: list[int] = []

    def fail(items: Sequence[int]) -> list[int]:
        calls.append(len(items))
        raise RuntimeError("shapes")

    with pytest.raises(RuntimeError, match="shapes"):
        run_in_halves(fail, [1, 2], "numbers")
    assert calls == [2]


def test_weights_that_cannot_be_written_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.weights"
    write_atomically(path, b"old")

    def half(self: Path, data: bytes) -> None:
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(DetectorError, match=r"a\.weights: expected a place .*, found no space left on device"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_predictions_carry_no_gradient() -> None:
    images = torch.rand(2, 3, 4, 5, requires_grad=True)
    assert not any(found.scores.requires_grad for found in predict(SmallMemoryPredictor(2), images))
