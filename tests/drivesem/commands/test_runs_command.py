"""`drivesem runs` as a user types it, and parts of an attack that become one run."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from drivesem.cli import main
from scene_ir import files
from tests.drivesem.commands.test_attack_command import without_times
from tests.drivesem.invoke import invoke, refusal, run_json

WORDS = [
    "attack",
    "--params",
    "color",
    "--method",
    "fgsm",
    "--second-detector",
    "off",
    "--limit",
    "3",
    "--workers",
    "1",
]


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three frames, and the same in two parts."""
    home = tmp_path_factory.mktemp("runs")
    assert main([*WORDS, "--out", str(home / "whole")]) == 0
    for number in (1, 2):
        assert main([*WORDS, "--part", f"{number}/2", "--out", str(home / f"part{number}")]) == 0
    return home


@pytest.mark.slow
def test_parts_are_every_nth_frame_and_merge_into_the_whole(parts: Path, tmp_path: Path) -> None:
    names = {folder: {p.name for p in (parts / folder / "frames").iterdir()} for folder in ("part1", "part2")}
    assert names == {"part1": {"demo-000", "demo-002"}, "part2": {"demo-001"}}
    out = tmp_path / "merged"
    both = [str(parts / "part1"), str(parts / "part2")]
    merged = run_json("runs", "merge", *both, str(parts / "whole"), "--out", str(out))
    whole = json.loads((parts / "whole" / "metrics.json").read_text())
    assert without_times(merged) == without_times(whole)
    hashes = [json.loads((folder / "manifest.json").read_text()) for folder in (out, parts / "whole")]
    assert hashes[0] == hashes[1]
    assert main(["verify", "--run", str(out)]) == 0
    assert run_json("runs", "merge", *both, "--out", str(out))["frames"] == 3, "it goes on"


def test_frames_that_differ_and_other_settings_are_refused(parts: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(parts / "part2", other)
    result = other / "frames" / "demo-001" / "result.json"
    result.write_text(json.dumps(json.loads(result.read_text()) | {"objects": 99}))
    merge = ["runs", "merge", str(parts / "part2"), str(other), "--out", str(tmp_path / "merged")]
    assert "FOLDER: expected runs in which a frame is the same, found two results of frame demo-001" in (
        refusal(*merge)
    )
    config = other / "config.yaml"
    config.write_text(config.read_text().replace("seed: 0", "seed: 7"))
    assert f"found {other}: another seed" in refusal(*merge)


def test_a_part_that_takes_the_others_keeps_its_frames(parts: Path, tmp_path: Path) -> None:
    """Also one that was made with --no-resume, which removes frames that are there."""
    own = tmp_path / "own"
    shutil.copytree(parts / "part1", own)
    config = own / "config.yaml"
    config.write_text(config.read_text().replace("resume: true", "resume: false"))
    merged = run_json("runs", "merge", str(own), str(parts / "part2"), "--out", str(own))
    assert without_times(merged) == without_times(json.loads((parts / "whole" / "metrics.json").read_text()))
    assert "resume: true" in config.read_text()


def test_frames_that_are_there_are_compared_with_the_parts(parts: Path, tmp_path: Path) -> None:
    part, out = tmp_path / "part", tmp_path / "merged"
    shutil.copytree(parts / "part2", part)
    merge = ["runs", "merge", str(part), "--out", str(out)]
    assert main(merge) == 0
    metrics = (out / "metrics.json").read_text()
    result = part / "frames" / "demo-001" / "result.json"
    files.write_json(result, json.loads(result.read_text()) | {"objects": 99})
    assert f"--out: expected a new folder, or one of the same frames, found another demo-001 in {out}" in (
        refusal(*merge)
    )
    assert (out / "metrics.json").read_text() == metrics


@pytest.mark.slow
def test_parts_without_vehicles_merge_into_the_whole(tmp_path: Path) -> None:
    """Frames whose vehicles cannot be attacked count once, whichever part had them; a part may have no frame."""
    words = [*WORDS, "--no-grade", "--target-objects", "6"]
    assert main([*words, "--out", str(tmp_path / "whole")]) == 0
    names = [str(tmp_path / f"part{number}") for number in (1, 2, 3, 4)]
    for number, name in enumerate(names, 1):
        assert main([*words, "--part", f"{number}/4", "--out", name]) == 0
    manifests = [json.loads((Path(name) / "manifest.json").read_text()) for name in names]
    assert [one["empty"] for one in manifests] == [["demo-000"], [], ["demo-002"], []]
    assert [len(one["frames"]) for one in manifests] == [0, 1, 0, 0]
    whole = json.loads((tmp_path / "whole" / "metrics.json").read_text())
    assert whole["frames_without_vehicles"] == 2
    for runs in (names, [*names, str(tmp_path / "whole")]):
        merged = run_json("runs", "merge", *runs, "--out", str(tmp_path / "merged"))
        assert without_times(merged) == without_times(whole)
    assert f"FOLDER: expected runs with frames, found none in {names[3]}" in refusal(
        "runs", "merge", names[3], "--out", tmp_path / "nothing"
    )


def test_list_and_show(parts: Path) -> None:
    rows = {Path(row["run"]).name: row for row in run_json("runs", "list", str(parts))["runs"]}
    assert {name: row["frames"] for name, row in rows.items()} == {"part1": 2, "part2": 1, "whole": 3}
    assert rows["whole"]["params"] == "color"
    assert rows["whole"]["finished"]
    (row,) = run_json("runs", "show", str(parts / "whole"))["runs"]
    assert row["settings"] == {"params": "color", "method": "fgsm", "second_detector": "off"}
    output = invoke("runs", "list", parts).out
    assert "whole: 3 frames, " in output
    assert "color by fgsm on squeezedet" in output
    assert "  method: fgsm\n" in invoke("runs", "show", parts / "whole").out


def test_a_run_that_stopped_early_is_listed(parts: Path, tmp_path: Path) -> None:
    shutil.copytree(parts / "part2", tmp_path / "run")
    (tmp_path / "run" / "metrics.json").unlink()
    (tmp_path / "run" / "plan.json").write_text('{"frames": 40}')
    assert "run: interrupted, 1 of 40 frames (the same command resumes)" in invoke("runs", "list", tmp_path).out
    shutil.rmtree(tmp_path / "run" / "frames")
    output = invoke("runs", "list", tmp_path).out
    assert "run: interrupted, 0 of 40 frames" in output
    assert "1 in total" in output


def test_runs_of_other_commands_are_passed_over(parts: Path, tmp_path: Path) -> None:
    """`drivesem drive` puts its folder beside them, with frames too."""
    shutil.copytree(parts / "part2", tmp_path / "run")
    (tmp_path / "clip" / "frames").mkdir(parents=True)
    (tmp_path / "clip" / "config.yaml").write_text("detector: squeezedet\nclip: null\nbend: 3\n")
    assert [row["run"] for row in run_json("runs", "list", str(tmp_path))["runs"]] == [str(tmp_path / "run")]
    assert "expected a run of drivesem attack, found" in refusal("runs", "list", tmp_path / "clip")


def test_prune_removes_what_a_killed_command_left(parts: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(parts / "part2", run)
    half = run / "frames" / ".demo-002.0123abcd.tmp"
    half.mkdir()
    (half / ".benign.png.89abcdef.tmp").write_bytes(b"half")
    before = {p for p in run.rglob("*") if half not in (p, *p.parents) and p.name != ".lock"}
    assert files.find_leftovers(run) == [half]
    assert run_json("runs", "prune", str(run), "--dry") == {"removed": [str(half)]}
    assert half.is_dir()
    assert run_json("runs", "prune", str(run)) == {"removed": [str(half)]}
    assert {p for p in run.rglob("*") if p.name != ".lock"} == before


_HOLDER = """
import sys
from pathlib import Path
from drivesem.run.lock import acquire_folder_lock
acquire_folder_lock(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def test_prune_passes_over_what_a_question_is_writing(parts: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(parts / "part2", run)
    halves = [run / question / "frames" / ".demo-001.0123abcd.tmp" for question in ("explain", "holes")]
    for half in halves:
        half.mkdir(parents=True)
        (half.parent.parent / ".lock").touch()
    command = [sys.executable, "-c", _HOLDER, str(run / "explain")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        assert run_json("runs", "prune", str(run)) == {"removed": [str(halves[1])]}
        holder.communicate()
    assert halves[0].is_dir()
    assert run_json("runs", "prune", str(run)) == {"removed": [str(halves[0])]}
