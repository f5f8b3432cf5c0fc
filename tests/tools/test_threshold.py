"""tools/threshold.py: the score of best F1 on a folder of frames, beside the detector's own."""

import re
import runpy
from pathlib import Path

import pytest


def test_a_line_a_detector(
    small_kitti: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of one frame all draws are alike: the interval is the score itself, which a detection of the frame has."""
    monkeypatch.setattr("sys.argv", ["threshold", str(small_kitti), "squeezedet"])
    runpy.run_module("tools.threshold", run_name="__main__")
    line = capsys.readouterr().out
    found = re.fullmatch(
        r"squeezedet, 1 frame, (\d+) objects?: best F1 ([\d.]+) at ([\d.]+) \[([\d.]+), ([\d.]+)\]; "
        r"its own t\* is 0\.545\n",
        line,
    )
    assert found, line
    assert int(found[1]) > 0
    assert 0 < float(found[2]) <= 1
    assert found[3] == found[4] == found[5]
