"""`drivesem attack --changes`: what is tried within the passes, written, checked again and asked about."""

from __future__ import annotations

from itertools import count
from pathlib import Path

import pytest

import drivesem as ds
from drivesem.cli import main
from drivesem.run import attack as run_attack
from drivesem.run.results import FrameResult, load_frame
from scene_ir.exchange import CHANGE_KEY
from scene_ir.io import load_scene

Runs = dict[str, tuple[Path, FrameResult]]
PASSES = 36
WORDS = ("--method", "climb", "--budget", "street", "--params", "translate", "--passes", str(PASSES))


def attacked(out: Path, kind: str) -> FrameResult:
    words = ("attack", *WORDS, "--changes", kind, "--limit", "1", "--no-confirm")
    assert main([*words, "--out", str(out), "--json"]) == 0
    return load_frame(out / "frames" / "demo-000" / "result.json")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folders = {kind: tmp_path_factory.mktemp(kind) / "run" for kind in ("leave", "park")}
    worse = count(0, -1)
    with pytest.MonkeyPatch.context() as patch:  # the last one tried is kept, whatever it is worth
        patch.setattr(run_attack, "margin_objective", lambda *_: next(worse))
        return {kind: (folder, attacked(folder, kind)) for kind, folder in folders.items()}


@pytest.mark.parametrize(("kind", "words"), [("leave", "is gone"), ("park", "parks as objects[6]")])
def test_a_run_holds_what_was_done_and_agrees_with_its_files(runs: Runs, kind: str, words: str) -> None:
    folder, result = runs[kind]
    assert words in result.change
    assert result.violations == ()
    assert result.passes is not None
    assert result.passes <= PASSES
    scene = load_scene(folder / "frames" / "demo-000" / "scene")
    assert scene.provenance[CHANGE_KEY] == result.change
    assert scene.before is not None
    assert words in (folder / "report.html").read_text()
    assert main(["verify", "--run", str(folder)]) == 0


def test_an_edit_keeps_the_change_and_reports_it(
    runs: Runs, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = runs["leave"][0] / "frames" / "demo-000" / "scene"
    capsys.readouterr()
    assert main(["edit", str(scene), "--photographed", "--out", str(tmp_path / "a.png")]) == 0
    note = "not the photograph: objects that were removed, exchanged, added or loaded remain so"
    assert f"drivesem: {note}" in capsys.readouterr().err.splitlines()


@pytest.mark.slow
def test_the_same_from_python(monkeypatch: pytest.MonkeyPatch) -> None:
    worse = count(0, -1)
    monkeypatch.setattr(run_attack, "margin_objective", lambda *_: next(worse))
    found = ds.attack(
        ds.demo_scene(0), method="climb", budget="street", params="translate", passes=PASSES, changes="park",
        confirm=False,
    )  # fmt: skip
    assert "parks as" in found.result.change
    assert found.feasible
