"""Noise in a detector's weights: how much of it there is, and that a file of it is a detector."""

import sys
from pathlib import Path

import pytest
import torch

from detectors.registry import load_detector
from tools.noisy_weights import main, with_noise


def test_noise_is_a_share_of_each_tensors_deviation() -> None:
    clean, noisy = load_detector("squeezedet"), with_noise(load_detector("squeezedet"), 0.3)
    for before, after in zip(clean.parameters(), noisy.parameters(), strict=True):
        if before.ndim == 1:
            assert torch.equal(before, after)
        elif before.numel() > 5000:
            assert float((after - before).std() / before.std()) == pytest.approx(0.3, rel=0.05)


def test_a_file_is_written_that_is_the_same_for_a_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = []
    for seed in ("0", "0", "1"):
        out = tmp_path / f"{len(written)}.safetensors"
        monkeypatch.setattr(sys, "argv", ["noisy_weights", "squeezedet", "0.1", str(out), "--seed", seed])
        main()
        written.append(out.read_bytes())
    assert written[0] == written[1] != written[2]
    found, shipped = load_detector(str(tmp_path / "0.safetensors")), load_detector("squeezedet")
    assert (found.classes, found.t_star) == (shipped.classes, pytest.approx(shipped.t_star))


@pytest.mark.parametrize("words", [("nowhere.safetensors", "0.1"), ("squeezedet", "-1")])
def test_bad_input_is_exit_code_2(words: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out.safetensors"
    monkeypatch.setattr(sys, "argv", ["noisy_weights", words[0], words[1], str(out)])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert not out.exists()
