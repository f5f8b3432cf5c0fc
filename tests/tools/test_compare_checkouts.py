"""`python -m tools.compare_checkouts`: two checkouts in turn, a folder each, and one line for what does not work."""

from pathlib import Path

import pytest

from tools import compare_checkouts

_BUSY = """
import sys, time
from pathlib import Path
def main():
    words = sys.argv[1:]
    if "--bad" in words:
        sys.stderr.write("drivesem: --bad: expected nothing, found it\\n")
        return 2
    until = time.process_time() + {seconds}
    while time.process_time() < until:
        pass
    Path(words[1]).mkdir()
    (Path(words[1]) / "said.txt").write_text(" ".join(words[:1]))
    return 0
"""


def checkout(folder: Path, seconds: float) -> Path:
    (folder / "drivesem").mkdir(parents=True)
    (folder / "drivesem" / "__init__.py").write_text("")
    (folder / "drivesem" / "cli.py").write_text(_BUSY.replace("{seconds}", str(seconds)))
    return folder


def test_both_are_measured_in_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = checkout(tmp_path / "a", 0.6)
    monkeypatch.setattr(compare_checkouts, "ROOT", checkout(tmp_path / "b", 0.1))
    keep = tmp_path / "kept"
    assert (
        compare_checkouts.main([str(before), "--rounds", "2", "--keep", str(keep), "--", "attack", "{out}"]) == 0
    )
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in said[:2]] == ["before", "now"]
    assert float(said[0].split()[1]) > float(said[1].split()[1]) + 0.3
    assert float(said[2].split()[-1]) < 1
    assert [(keep / name / "said.txt").read_text() for name in ("before", "now")] == ["attack", "attack"]


def test_what_does_not_work_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = checkout(tmp_path / "a", 0)
    monkeypatch.setattr(compare_checkouts, "ROOT", before)
    assert compare_checkouts.main([str(before), "--", "attack", "--bad"]) == 2
    assert compare_checkouts.main([str(tmp_path), "--", "attack"]) == 2
    assert compare_checkouts.main([str(before), "--rounds", "0", "--", "attack"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 3
    assert "--bad: expected nothing, found it" in said[0]
    assert "a checkout of drivesem" in said[1]
    assert "--rounds: expected at least 1, found 0" in said[2]
