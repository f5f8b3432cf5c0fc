"""`python -m tools.bench synth` as a maintainer types it."""

import json
from pathlib import Path

import pytest

from tools.bench.__main__ import main


@pytest.mark.slow
def test_synth(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["synth", "--frames", "10", "--workers", "2", "--json"]
    assert main([*words, "--out", str(tmp_path), "--markdown", str(tmp_path / "all.md")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [(row["layout"], row["workers"]) for row in result["rows"]] == [
        ("vkitti2", 2),
        ("vkitti2", 1),
        ("kitti", 2),
    ]
    assert result["frames_per_second"] == result["rows"][0]["frames_per_second"] > 0
    assert result["peak_rss_mb"] > 200
    assert result["command"] == "python -m tools.bench synth --workers 2 --frames 10"
    assert "frames a second" in (tmp_path / "all.md").read_text()
