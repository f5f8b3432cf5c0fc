"""`python -m tools.bench detector`: consistent metrics, and a gradient that is one."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from detectors.registry import load_detector
from drivesem.bench.timing import CallTime, PairedTimer
from tools.bench import __main__ as bench
from tools.bench import detector, memory, probe
from tools.bench.__main__ import main


@pytest.fixture(autouse=True)
def _one_thread_more_or_less_stays_here() -> Iterator[None]:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def test_both_gives_the_gradient_to_the_image() -> None:
    found, image = load_detector("squeezedet"), torch.rand(1, 3, 64, 96)
    gradient = probe.image_gradient(found, image)
    assert gradient.shape == image.shape
    assert float(gradient.abs().sum()) > 0
    assert not image.requires_grad


def test_rounds_are_in_turn_and_the_fastest_stands_beside_the_median(monkeypatch: pytest.MonkeyPatch) -> None:
    class Ticks(PairedTimer):
        """Forward 2, both 5, decode 1, at worst 3 ms; ten times as slow in the second of three rounds. Four at
        once take as long of the processor as three.
        """

        def __init__(self) -> None:
            super().__init__()
            self.calls = 0

        def time_call(self, call: object) -> CallTime:
            turn, kind = divmod(self.calls, 6)
            self.calls += 1
            slow = 10 if turn == 1 else 1 + turn
            return CallTime((2.0, 5.0, 1.0, 3.0, 8.0, 20.0)[kind] * slow, (2.0, 5.0, 1.0, 3.0, 6.0, 15.0)[kind])

    monkeypatch.setattr(detector, "_peak_mb", lambda name, height, width: 12.5)
    image = torch.rand(1, 3, 32, 48)
    row = detector._row("squeezedet", load_detector("squeezedet"), image, Ticks(), 0.0)
    assert (row.size, row.rounds) == ("48x32", 3)
    assert (row.forward_ms, row.forward_min_ms) == (6.0, 2.0)
    assert (row.both_ms, row.both_min_ms) == (15.0, 5.0)
    assert (row.decode_ms, row.decode_min_ms, row.decode_worst_ms) == (3.0, 1.0, 9.0)
    assert (row.forward_cpu_ms, row.forward_each_cpu_ms) == (2.0, 1.5)
    assert (row.both_cpu_ms, row.both_each_cpu_ms) == (5.0, 3.75)
    assert row.peak_mb == (12.5 if memory.supported() else None)


def test_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bench, "_DETECTOR_SECONDS", (0.0, 0.0))
    monkeypatch.setattr(bench, "SHIPPED", {"squeezedet": Path()})
    monkeypatch.setattr(detector, "SIZES_HW", ((64, 96),))
    words = ["detector", "--quick", "--threads", "1", "--json"]
    assert main([*words, "--markdown", str(tmp_path / "all.md")]) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    (row,) = result["rows"]
    assert (row["detector"], row["size"], row["threads"]) == ("squeezedet", "96x64", 1)
    assert 0 < row["forward_min_ms"] <= row["forward_ms"]
    assert 0 < row["both_min_ms"] <= row["both_ms"]
    assert 0 < row["decode_min_ms"] <= row["decode_ms"]
    if memory.supported():
        # At least the first convolution's output: 64 channels, a quarter of the pixels, 4 bytes each.
        assert row["peak_mb"] > 64 * 32 * 48 * 4 / 2**20
    text = (tmp_path / "all.md").read_text()
    assert f"### {detector.TITLE}" in text
    assert "| forward and backward, ms |" in text
    assert "`python -m tools.bench detector --quick --threads 1`" in text
