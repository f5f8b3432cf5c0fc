"""The lock file: every tested release has a hash, and it says what constraints.txt says."""

import json
import re
from pathlib import Path

import pytest

from scene_ir.errors import FormatError
from tools import lock
from tools.lock import CONSTRAINTS, LOCK, main


def test_the_lock_has_each_tested_release_once_with_a_hash() -> None:
    told = [line for line in LOCK.read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"\S+==\S+ --hash=sha256:[0-9a-f]{64}", line) for line in told)
    assert [line.split()[0] for line in told] == CONSTRAINTS.read_text().split()
    assert len({line.split(":")[-1] for line in told}) == len(told)


def report(path: Path, **releases: str) -> Path:
    """A report of pip, as far as it matters."""
    install = [
        {
            "metadata": {"name": name, "version": "1.0"},
            "download_info": {"archive_info": {"hashes": {"sha256": told}}},
        }
        for name, told in releases.items()
    ]
    path.write_text(json.dumps({"install": install}))
    return path


def test_reports_become_a_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    constraints, out = tmp_path / "constraints.txt", tmp_path / "constraints.lock"
    monkeypatch.setattr(lock, "CONSTRAINTS", constraints)
    monkeypatch.setattr(lock, "LOCK", out)
    constraints.write_text("A_b==1.0\nc==1.0\n")
    first, second = report(tmp_path / "1.json", **{"a-B": "0" * 64}), report(tmp_path / "2.json", c="1" * 64)
    with pytest.raises(FormatError, match=r"report: c==1\.0: expected a hash, found none"):
        main([str(first)])
    assert main([str(first), str(second)]) == 0
    assert out.read_text().splitlines()[1:] == [
        f"A_b==1.0 --hash=sha256:{'0' * 64}",
        f"c==1.0 --hash=sha256:{'1' * 64}",
    ]
    assert main(["--check", str(first), str(second)]) == 0
    assert main(["--check", str(first), str(report(tmp_path / "3.json", c="2" * 64))]) == 1
    assert capsys.readouterr().out == "constraints.lock is another\n"
