"""`drivesem synth` as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

from drivesem.cli import main
from drivesem.commands.synth import build_order
from drivesem.config.commands import SynthConfig
from drivesem.config.parsing import parse
from drivesem.data.registry import open_dataset
from drivesem.synth.assets import choose_split
from scene_ir import files
from scene_ir.meshes.load import save_mesh
from scene_ir.meshes.templates import template
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


def test_suitable_meshes_are_used_and_others_are_named(tmp_path: Path) -> None:
    meshes, out = tmp_path / "meshes", tmp_path / "out"
    meshes.mkdir()
    words = ["synth", "--frames", "1", "--workers", "1", "--meshes", str(meshes), "--out", str(out)]
    (meshes / "draco.gltf").write_text('{"extensionsRequired": ["KHR_draco_mesh_compression"]}')
    left_out = (
        "draco.gltf: extensionsRequired: expected none that cannot be read, found KHR_draco_mesh_compression"
    )
    line = refusal(*words)
    assert f"{meshes}: expected at least one vehicle mesh" in line
    assert left_out in line
    save_mesh(template("sedan", 0), meshes / "a.glb")
    assert (choose_split("a.glb"), choose_split("sedan.glb")) == ("heldout", "train")
    assert f"{meshes}: expected a vehicle of split train (by its file name), found a.glb" in refusal(*words)
    save_mesh(template("sedan", 0), meshes / "sedan.glb")
    lines = [line for line in invoke(*words).err.splitlines() if line.startswith("--meshes: ")]
    assert lines == [
        f"--meshes: left out: {meshes}/{left_out}",
        "--meshes: 1 of 2 meshes belong to the other split by their names",
    ]
    vehicles = {
        name for frame in json.loads((out / "manifest.json").read_text())["frames"] for name in frame["vehicles"]
    }
    assert "mesh-sedan.glb" in vehicles
    assert "mesh-a.glb" not in vehicles


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
