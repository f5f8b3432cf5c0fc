"""`python -m tools.bench gradcheck --reach`: options, output, and that finished frames stay."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tools.bench.__main__ import main
from tools.bench.reach.report import ReachWorker
from tools.bench.reach.slopes import ProbeSlopes

WORDS = ("gradcheck", "--reach", "--draws", "2", "--limit", "2", "--workers", "1")
SLOPES = ProbeSlopes(
    0, 10.0, "rotate", "yaw", ((1.0, 3.0),) * 3, ((0.0, 1.0),) * 3, ((2.0, 2.0), (1.0, None), (1.0, 1.0))
)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the frames that are measured, which takes no time."""
    names: list[str] = []

    def measure(_: ReachWorker, name: str) -> tuple[ProbeSlopes, ...]:
        names.append(name)
        return (SLOPES, replace(SLOPES, object=1, distance_m=50.0))

    monkeypatch.setattr(ReachWorker, "_measure", measure)
    return names


def test_all_is_written_and_finished_frames_are_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], measured: list[str]
) -> None:
    words = [*WORDS, "--json", "--out", str(tmp_path)]
    assert main(words) == 0
    first = json.loads(capsys.readouterr().out)
    assert len(measured) == 2
    assert {path.name for path in tmp_path.glob("reach.*")} == {"reach.json", "reach.csv", "reach.md", "reach.png"}
    assert first == json.loads((tmp_path / "reach.json").read_text())
    assert {row["distance"] for row in first["rows"]} == {"all", "under 15 m", "over 30 m"}
    assert first["rows"][0]["objects"] == 4
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out) == first
    assert len(measured) == 2, "they were read"
    assert main([*words, "--seed", "5"]) == 0
    assert len(measured) == 4, "another seed is another question"


def test_nothing_that_the_detector_finds_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ReachWorker, "_measure", lambda *_: ())
    assert main(list(WORDS)) == 2
    assert "expected at least one vehicle that the detector finds" in capsys.readouterr().err.splitlines()[-1]
