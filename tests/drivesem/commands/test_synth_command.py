"""`drivesem synth` as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

from drivesem.cli import main
from drivesem.commands.synth import build_order
from drivesem.config.commands import SynthConfig
from drivesem.config.parsing import parse
from drivesem.data.registry import open_dataset
from scene_ir import files
from tests.drivesem.invoke import invoke, refusal


def test_defaults_follow_the_layout() -> None:
    kitti, virtual = build_order(SynthConfig(frames=12)), build_order(SynthConfig(frames=12, layout="vkitti2"))
    assert (kitti.variations, kitti.sequence, kitti.people) == (("mixed",), 1, True)
    assert (virtual.variations, virtual.sequence, virtual.people) == (("clone",), 10, False)
    assert build_order(SynthConfig(frames=12, limit=3)).frames == 3
    assert parse(["synth", "--people", "False", "--cameras", "2", "--layout", "vkitti2"]) == SynthConfig(
        people=False, cameras=2, layout="vkitti2"
    )


def test_it_writes_a_data_set_a_sheet_and_distributions(tmp_path: Path) -> None:
    out = tmp_path / "set"
    words = ["synth", "--layout", "coco", "--frames", "2", "--seed", "3", "--workers", "1", "--out", str(out)]
    captured = invoke(*words, "--sheet", "--compare", "--json")
    assert captured.out.count("\n") == 1
    summary = json.loads(captured.out)
    assert summary["frames"] == 2
    assert summary["out"] == str(out)
    assert len(open_dataset("coco", out).identifiers) == 2
    assert files.read_image(out / "sheet.jpg").shape[1] > 1000
    assert (out / "distributions.png").read_bytes().startswith(b"\x89PNG")
    assert "depth" in (out / "distributions.md").read_text().lower()
    before = (out / "manifest.json").read_bytes()
    assert main([*words, "--no-resume", "--json"]) == 0
    assert (out / "manifest.json").read_bytes() == before


def test_another_recipe_is_one_line(tmp_path: Path) -> None:
    """No bar before it."""
    out = tmp_path / "set"
    stamp = out / ".drivesem" / "recipe.json"
    files.write_json(stamp, build_order(SynthConfig(frames=1, seed=7, out=str(out))).recipe())
    captured = invoke("synth", "--frames", "1", "--seed", "8", "--out", out, code=2)
    assert (captured.out, captured.err) == ("", f"drivesem: {stamp}: seed: expected 8, found 7\n")


def test_a_folder_that_is_a_file_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("")
    assert "--out: expected a folder, found the file" in refusal("synth", "--out", path)
