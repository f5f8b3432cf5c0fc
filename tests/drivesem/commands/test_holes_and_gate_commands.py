"""`drivesem holes` and `gate` on a run whose detector is blind to cars of a lightness: rules, worse detectors."""

from __future__ import annotations

import csv
import json
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from torch import Tensor

from detectors.planted import compute_features
from detectors.types import Detections
from drivesem.analysis import gate as gate_analysis
from drivesem.analysis.holes.rules import FrameHoles, FrameRuleSamples
from drivesem.attacks.labels import Labeller
from drivesem.cli import main
from drivesem.run import attack as run_attack
from drivesem.run import folder as run_folder
from drivesem.run.finished import load_run
from drivesem.run.records import load_record
from scene_ir import files
from scene_ir.render.compositor import Compositor
from scene_ir.render.sources import solve_sources
from scene_ir.types import SceneIR
from tests.drivesem.invoke import invoke, refusal, run_json

ATTACK = [
    "attack",
    "--detector",
    "any",
    "--method",
    "halton",
    "--queries",
    "48",
    "--params",
    "color",
    "--limit",
    "1",
    "--seed",
    "1",
]
STILL = ["--nuisances", "off", "--no-confirm", "--second-detector", "off", "--workers", "1", "--json"]
HOLES = ["--workers", "1", "--json", "--samples", "64", "--fresh", "10"]
SHORT_HOLES = ["--workers", "1", "--json", "--samples", "24", "--fresh", "1", "--contrast", "0"]
WIDE = 0.06
"""Of the band of lightness in which cars are not seen, below the lightness of either car as photographed."""


class Blind:
    """Sees each car where it was photographed, but for those whose paint is as dark as its band says."""

    name, t_star = "blind", 0.5
    classes: tuple[str, ...] = ("Car",)

    def __init__(self, boxes_xyxy: Tensor, band: tuple[float, float]) -> None:
        self.boxes, self.band = boxes_xyxy, band

    def forward(self, images: Tensor) -> Tensor:
        return compute_features(images, self.boxes.expand(len(images), -1, -1), ("lightness",))[0]

    def decode(self, raw: Tensor) -> list[Detections]:
        found = []
        for lightness in raw:
            seen = self.boxes[(lightness < self.band[0]) | (lightness > self.band[1])]
            found.append(
                Detections(seen, torch.zeros(len(seen), dtype=torch.int64), torch.full((len(seen),), 0.9))
            )
        return found


class Imagining(Blind):
    """The same, and a car in the sky."""

    def decode(self, raw: Tensor) -> list[Detections]:
        sky = Detections(torch.tensor([[10.0, 1.0, 40.0, 16.0]]), torch.tensor([0]), torch.tensor([0.95]))
        return [
            Detections(
                torch.cat([sky.boxes_xyxy, found.boxes_xyxy]),
                torch.cat([sky.labels, found.labels]),
                torch.cat([sky.scores, found.scores]),
            )
            for found in super().decode(raw)
        ]


class Other(Blind):
    """The same of other classes."""

    classes = ("Car", "Bus")


@pytest.fixture(scope="module")
def scene(street: Callable[..., SceneIR]) -> SceneIR:
    """Two cars on a small grey street, photographed and taken apart."""
    bare = street(positions_xz=((-2.5, 9.0), (2.5, 12.0)))
    shot = Compositor(bare).render(bare)
    return solve_sources(replace(bare, photograph=(shot.image * 255).round() / 255), shot.opacity)


@pytest.fixture(scope="module")
def blind(scene: SceneIR) -> Blind:
    labels = Labeller(scene, Compositor(scene).render(scene)).paper()
    cars = labels.targets.boxes_xyxy[: len(scene.objects)]
    usual = float(compute_features(scene.photograph[None], cars[None], ("lightness",)).min())
    return Blind(cars, (usual - 0.02 - WIDE, usual - 0.02))


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory, scene: SceneIR, blind: Blind) -> Path:
    out = tmp_path_factory.mktemp("runs") / "dark"
    with pytest.MonkeyPatch.context() as patch:
        _patch(patch, scene, blind)
        assert main([*ATTACK, *STILL, "--out", str(out)]) == 0
    return out


def _patch(patch: pytest.MonkeyPatch, scene: SceneIR, detector: Any) -> None:
    patch.setattr("drivesem.synth.demo.demo_scene", lambda *_: scene)
    for module in (run_attack, run_folder):
        patch.setattr(module, "load_predictor", lambda *_: detector)


@pytest.fixture(autouse=True)
def patched(monkeypatch: pytest.MonkeyPatch, scene: SceneIR, blind: Blind) -> None:
    _patch(monkeypatch, scene, blind)


@pytest.fixture(scope="module")
def mapped(attacked: Path, tmp_path_factory: pytest.TempPathFactory, scene: SceneIR, blind: Blind) -> Path:
    """What is written of that run."""
    out = tmp_path_factory.mktemp("looked") / "holes"
    with pytest.MonkeyPatch.context() as patch:
        _patch(patch, scene, blind)
        assert main(["holes", str(attacked), *HOLES, "--out", str(out)]) == 0
    return out


def test_the_feature_and_the_band_are_named(attacked: Path, mapped: Path, blind: Blind) -> None:
    (frame,) = load_run(attacked).frames
    certain = [f for f in frame.result.failures if f.grade != "threshold"]
    assert certain
    found = json.loads((mapped / "holes.json").read_text())
    assert found["failures"] == len(certain)
    first = found["holes"][0]
    named = [(f["frame"], f["object"], f["grade"]) for hole in found["holes"] for f in hole["failures"]]
    assert sorted(named) == sorted((frame.result.identifier, f.index, f.grade) for f in certain)
    assert first["parameters"] == ["lightness"]
    low, high = first["where"]["lightness"]
    assert (low, high) == pytest.approx(blind.band, abs=0.3 * WIDE)
    assert first["probability"] >= 0.8
    assert first["interval"][0] <= first["probability"] <= first["interval"][1]
    assert first["outside"] < 0.05
    size = first["size"]
    assert size["interval"][0] < size["probability"] < size["interval"][1] < 0.7
    assert first["frames"] == ["demo-000"]
    rows = list(csv.DictReader((mapped / "holes.csv").read_text().splitlines()))
    assert rows[0]["where"].startswith("in the picture, 0 dark to 1 light: ")
    assert cv2.imread(str(mapped / "holes.png")).std() > 10
    assert "0 dark to 1 light" in (mapped / "holes.md").read_text()


def test_a_second_call_resumes_with_equal_results(attacked: Path, mapped: Path) -> None:
    before, cached = (
        (mapped / "holes.json").read_text(),
        mapped / "runs" / "0" / "frames" / "demo-000" / "holes.json",
    )
    written = cached.stat().st_mtime_ns
    run_json("holes", attacked, *HOLES, "--out", mapped)
    assert (mapped / "holes.json").read_text() == before
    assert cached.stat().st_mtime_ns == written


def test_a_limit_counts_failures_and_a_later_call_takes_more(attacked: Path, tmp_path: Path) -> None:
    """The frame has two failures in two cells; what is sampled with a limit equals what is sampled without."""
    run = shutil.copytree(attacked, tmp_path / "run")
    path = run / "frames" / "demo-000" / "result.json"
    result = json.loads(path.read_text())
    (failure,) = (one for one in result["failures"] if one["grade"] == "certain")
    result["failures"].append(failure | {"index": 1 - failure["index"]})
    path.write_text(json.dumps(result))
    words = [str(run), *SHORT_HOLES, "--out", str(tmp_path / "holes")]
    (limited, record), (whole, all_records) = (
        (run_json("holes", *words, *limit), _load_holes(tmp_path / "holes")) for limit in (("--limit", "1"), ())
    )
    for data, sampled in ((limited, 1), (whole, 2)):
        failing = {row["cell"]: row["certain"] for row in data["map"]["cells"]}
        assert list(failing.values()) == [1, 1]
        assert (data["failures"], sum(row["sampled"] for row in data["map"]["cells"])) == (sampled, sampled)
        named = {failure["cell"] for hole in data["holes"] for failure in hole["failures"]}
        assert len(named) == sampled
        assert named <= failing.keys()
    assert [one for one in all_records.around if one.index == record.around[0].index] == list(record.around)
    assert run_json("holes", *words, "--limit", "1")["holes"] == limited["holes"]
    assert _load_holes(tmp_path / "holes").around == all_records.around


def _load_holes(out: Path) -> FrameHoles:
    return load_record(out / "runs" / "0" / "frames" / "demo-000" / "holes.json", FrameHoles, 3)


@pytest.mark.usefixtures("gate")
def test_a_run_of_an_older_version_has_no_cells(attacked: Path, tmp_path: Path) -> None:
    """Its frames have no record of the search: holes and gate do the same without cells, and count them."""
    run = shutil.copytree(attacked, tmp_path / "run")
    path = run / "frames" / "demo-000" / "result.json"
    result = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in result.items() if key != "visits"}))
    data = run_json("holes", run, *SHORT_HOLES, "--out", tmp_path / "holes")
    assert data["map"] == {"cells": [], "frames_without_record": 1}
    assert data["failures"] == 1
    assert {failure["cell"] for hole in data["holes"] for failure in hole["failures"]} == {None}
    assert "1 frame without a record of the search: in no cell" in (tmp_path / "holes" / "holes.md").read_text()
    both = run_json("holes", run, attacked, *SHORT_HOLES, "--limit", "2", "--out", tmp_path / "both")
    (cell,) = both["map"]["cells"]
    assert (cell["sampled"], both["map"]["frames_without_record"]) == (1, 1)
    named = {failure["frame"]: failure["cell"] for hole in both["holes"] for failure in hole["failures"]}
    assert named == {"run/demo-000": None, "dark/demo-000": cell["cell"]}
    words = ["--before", "any", "--after", "any", "--samples", "4", "--workers", "1"]
    for folder, levels in ((attacked, {"hole", "cell", "kind", "all", "phantoms"}),
                           (run, {"hole", "kind", "all", "phantoms"})):  # fmt: skip
        data = run_json("gate", folder, *words, "--out", tmp_path / f"gate-{folder.name}")
        assert {row["level"] for row in data["rows"]} == levels
        assert data["frames_without_record"] == int(folder is run)
    page = (tmp_path / "gate-run" / "gate.md").read_text()
    assert "1 frame without a record of the search: in no cell" in page


@pytest.mark.slow
def test_a_rule_is_checked_by_draws_of_its_own(attacked: Path, mapped: Path, tmp_path: Path) -> None:
    """After the holes, which are kept: of seeds that neither the rule nor its probability knew."""
    out, name = tmp_path / "holes", Path("0") / "frames" / "demo-000"
    shutil.copytree(mapped, out)
    cached = out / "runs" / name / "holes.json"
    written = cached.stat().st_mtime_ns
    words = [str(attacked), *HOLES, "--out", str(out)]
    found = run_json("holes", *words, "--recheck", "16")
    assert cached.stat().st_mtime_ns == written
    assert (found["rechecked"], found["hold"]) == (len(found["holes"]), len(found["holes"]))
    (checked,) = (out / "rechecks" / "16" / "0").glob("*/frames/demo-000/recheck.json")
    (fresh,) = (out / "fresh" / "0").glob("*/frames/demo-000/fresh.json")
    again = found["holes"][0]["recheck"]
    assert again["draws"] == 16 * len(found["holes"][0]["failures"])
    assert again["probability"] >= 0.5
    assert again["interval"][0] <= again["probability"] <= again["interval"][1]
    assert again["holds"]
    inside_first, inside_again = (
        load_record(fresh, FrameRuleSamples, 3).inside,
        load_record(checked, FrameRuleSamples, 3).inside,
    )
    for around, first, inside in zip(
        load_record(cached, FrameHoles, 3).around, inside_first, inside_again, strict=True
    ):
        known = {*around.samples.values, *around.near.values, *first.values}
        assert len(inside.values) == 16
        assert not known & set(inside.values)
    page, rows = (out / "holes.md").read_text(), (out / "holes.csv").read_text().splitlines()
    assert "again, %" in page
    assert f"{found['hold']} of {found['rechecked']} hold" in page
    assert next(csv.DictReader(rows))["holds"] == "True"

    checked_at = checked.stat().st_mtime_ns
    assert run_json("holes", *words, "--recheck", "16") == found
    assert checked.stat().st_mtime_ns == checked_at
    assert run_json("holes", *words)["holes"][0]["recheck"] is None


def test_other_cars_are_sampled_too(mapped: Path) -> None:
    """By default four states of the frame, in which both cars change."""
    cached = load_record(mapped / "runs" / "0" / "frames" / "demo-000" / "holes.json", FrameHoles, 3)
    (contrast,) = cached.contrast
    assert (contrast.label, len(contrast.objects)) == ("Car", 8)
    assert set(contrast.by_object()) == {0, 1}
    assert all(len(samples.margins) == 4 for samples in contrast.by_object().values())


def test_without_contrast_there_are_none(attacked: Path, tmp_path: Path) -> None:
    words = [str(attacked), "--workers", "1", "--json", "--samples", "24", "--fresh", "1", "--contrast", "0"]
    run_json("holes", *words, "--out", tmp_path / "out")
    assert (
        load_record(tmp_path / "out" / "runs" / "0" / "frames" / "demo-000" / "holes.json", FrameHoles, 3).contrast
        == ()
    )


def test_an_answer_of_an_older_version_is_refused_in_one_line(
    attacked: Path, mapped: Path, tmp_path: Path
) -> None:
    out = tmp_path / "holes"
    shutil.copytree(mapped, out)
    cached = out / "runs" / "0" / "frames" / "demo-000" / "holes.json"
    old = json.loads(cached.read_text())
    cached.write_text(json.dumps(old | {"schema": 2}))
    error_line = invoke("holes", attacked, *HOLES, "--out", out, code=2).err.strip().splitlines()[-1]
    assert error_line.startswith("drivesem: ")
    assert "holes.json" in error_line


@pytest.mark.slow
def test_samples_follow_from_the_seed(attacked: Path, tmp_path: Path) -> None:
    cached = []
    for name, seed in (("one", "0"), ("again", "0"), ("other", "1")):
        words = [str(attacked), "--workers", "1", "--json", "--samples", "24", "--fresh", "1", "--seed", seed]
        run_json("holes", *words, "--out", tmp_path / name)
        cached.append(
            load_record(
                tmp_path / name / "runs" / "0" / "frames" / "demo-000" / "holes.json", FrameHoles, 3
            ).around
        )
    one, again, other = cached
    assert one == again != other


def test_a_run_without_certain_failures(tmp_path: Path, scene: SceneIR, blind: Blind) -> None:
    with pytest.MonkeyPatch.context() as patch:
        _patch(patch, scene, Blind(blind.boxes, (2.0, 3.0)))
        assert main([*ATTACK, *STILL, "--out", str(tmp_path / "fine")]) == 0
    found = run_json("holes", tmp_path / "fine", *HOLES)
    assert found["holes"] == []
    assert "no certain failure" in (tmp_path / "fine" / "holes" / "holes.md").read_text()


@pytest.fixture
def gate(
    attacked: Path,
    blind: Blind,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Callable[[str], tuple[int, dict[str, Any]]]:
    """The blind detector before, another after: exit code, and what is said."""
    low, high = blind.band
    known = {
        "any": blind,
        "better": Blind(blind.boxes, (2.0, 3.0)),
        "worse": Blind(blind.boxes, (low - 0.3, high)),
        "other": Other(blind.boxes, blind.band),
        "seeing things": Imagining(blind.boxes, blind.band),
    }
    monkeypatch.setattr(gate_analysis, "load_predictor", lambda name, *_: known[name])

    def call(after: str) -> tuple[int, dict[str, Any]]:
        capsys.readouterr()
        words = ["--before", "any", "--after", after, "--samples", "20", "--workers", "1", "--json"]
        code = main(["gate", str(attacked), *words, "--out", str(tmp_path / after)])
        return code, json.loads(capsys.readouterr().out or "{}")

    return call


def test_a_detector_passes_its_own_gate(gate: Callable[[str], tuple[int, dict[str, Any]]]) -> None:
    code, data = gate("any")
    assert (code, data["passed"]) == (0, True)
    assert {row["difference"] for row in data["rows"]} == {0}
    assert data["rows"][0]["before"] > 0


def test_a_worse_one_does_not_and_a_better_one_does(
    gate: Callable[[str], tuple[int, dict[str, Any]]], tmp_path: Path
) -> None:
    code, data = gate("worse")
    assert (code, data["passed"]) == (1, False)
    row = data["rows"][0]
    assert (row["level"], row["grew"]) == ("hole", True)
    assert row["interval"][0] > 0.05
    suite = ET.parse(tmp_path / "worse" / "gate.xml").getroot()
    assert int(suite.attrib["failures"]) == sum(row["grew"] for row in data["rows"]) > 0
    code, data = gate("better")
    assert (code, data["passed"]) == (0, True)
    phantoms, whole = data["rows"][-1], data["rows"][-2]
    assert (whole["level"], phantoms["level"]) == ("all", "phantoms")
    assert whole["difference"] < -0.03
    assert (phantoms["before"], phantoms["after"]) == (0, 0)


def test_one_that_sees_what_is_not_there_does_not_pass(
    gate: Callable[[str], tuple[int, dict[str, Any]]], tmp_path: Path
) -> None:
    """It loses no more objects."""
    code, data = gate("seeing things")
    assert (code, data["passed"]) == (1, False)
    assert [row["hole"] for row in data["rows"] if row["grew"]] == ["phantoms"]
    phantoms = data["rows"][-1]
    assert (phantoms["before"], phantoms["after"]) == (0, 1)
    assert "phantoms" in (tmp_path / "seeing things" / "gate.md").read_text()


def test_frames_that_cannot_be_compared_do_not_pass(
    gate: Callable[[str], tuple[int, dict[str, Any]]], attacked: Path, tmp_path: Path
) -> None:
    """The run is kept without its scenes."""
    run, out = tmp_path / "run", tmp_path / "out"
    shutil.copytree(attacked, run, ignore=shutil.ignore_patterns("scene"))
    words = ["gate", str(run), "--before", "any", "--after", "any", "--workers", "1", "--out", str(out)]
    data = run_json(*words, "--keep-going", code=1)
    assert (data["passed"], data["rows"]) == (False, [])
    (reason,) = data["frames_failed"].values()
    assert "scene" in reason
    suite = ET.parse(out / "gate.xml").getroot()
    assert (suite.attrib["tests"], suite.attrib["errors"], suite.attrib["failures"]) == ("1", "1", "0")
    error = suite.find("testcase[@name='demo-000']/error")
    assert error is not None
    assert error.attrib["message"] == reason
    page = (out / "gate.md").read_text()
    assert "1 frame could not be compared, so the gate is not passed." in page
    assert "no certain failure" not in page


def test_a_package_gives_the_numbers_of_its_run(
    gate: Callable[[str], tuple[int, dict[str, Any]]], attacked: Path, tmp_path: Path
) -> None:
    package = tmp_path / "package"
    exported = run_json("export", attacked, "--to", "gate", "--out", package)
    assert (exported["frames"], exported["sha256"]) == (1, files.sha256_digest(package / "package.json"))
    assert exported["bytes"] == sum(path.stat().st_size for path in package.rglob("*") if path.is_file()) < 1e6
    (frame,) = load_run(attacked).frames
    certain = [f.index for f in frame.result.failures if f.grade != "threshold"]
    assert [row["object"] for row in files.read_json(package / "package.json")["failures"]] == certain
    words = ["--before", "any", "--samples", "20", "--workers", "1"]
    for after in ("worse", "any"):
        code, data = gate(after)
        of_package = run_json(
            "gate", package, *words, "--after", after, "--out", tmp_path / f"p-{after}", code=code
        )
        assert of_package["rows"] == data["rows"]
        assert of_package["failures"] == data["failures"] == len(certain)
    page = (tmp_path / "p-worse" / "gate.html").read_text()
    assert page.count("<img ") == 2 * len(certain)
    assert not (package / "gate").exists()
    assert "--to gate, which takes all certain failures" in refusal(
        "export", attacked, "--to", "gate", "--grade", "shared", "--out", tmp_path / "none"
    )


@pytest.mark.usefixtures("gate")
def test_a_damaged_package_is_refused_in_one_line(attacked: Path, tmp_path: Path) -> None:
    package = tmp_path / "package"
    invoke("export", attacked, "--to", "gate", "--out", package)
    archive = package / "frames" / "demo-000" / "frame.tar.xz"
    whole = archive.read_bytes()
    for damaged in (whole[:-40], whole[:1000] + bytes([whole[1000] ^ 1]) + whole[1001:], None):
        archive.unlink() if damaged is None else archive.write_bytes(damaged)
        reason = refusal("gate", package, "--after", "worse", "--out", tmp_path / "out")
        assert reason.startswith(str(archive))
    digests = files.read_json(package / "package.json")
    archive.write_bytes(whole[: len(whole) // 2])
    digests["files"]["frames/demo-000/frame.tar.xz"] = files.sha256_digest(archive)
    files.write_json(package / "package.json", digests)
    assert f"{archive}: expected an archive of a frame" in refusal("gate", package, "--after", "worse")
    files.write_json(package / "package.json", {"schema": 9})
    assert "package.json: expected a package of schema 1" in refusal("gate", package, "--after", "worse")


def test_a_run_without_certain_failures_is_no_gate(
    gate: Callable[[str], tuple[int, dict[str, Any]]], attacked: Path, tmp_path: Path
) -> None:
    run = shutil.copytree(attacked, tmp_path / "run")
    path = run / "frames" / "demo-000" / "result.json"
    result = json.loads(path.read_text())
    words = ["gate", run, "--before", "any", "--after", "any", "--workers", "1"]
    for number, (grade, reason) in enumerate((("threshold", "no certain failure of an object in 1 attacked frame"),
                                              (None, "the failures of 1 frame have no grade"))):  # fmt: skip
        failures = [failure | {"grade": grade} for failure in result["failures"]]
        path.write_text(json.dumps(result | {"failures": failures}))
        data = run_json(*words, "--out", tmp_path / f"{number}", code=1)
        assert (data["passed"], data["failures"], data["rows"]) == (False, 0, [])
        suite = ET.parse(tmp_path / f"{number}" / "gate.xml").getroot()
        assert (suite.attrib["tests"], suite.attrib["failures"]) == ("1", "1")
        printed = invoke(*words, "--allow-empty", "--out", tmp_path / f"{number}").out
        (line,) = (line for line in printed.splitlines() if line.startswith("Gate passed: nothing was compared"))
        assert reason in line
        assert ET.parse(tmp_path / f"{number}" / "gate.xml").getroot().attrib["skipped"] == "1"
    assert "expected a run with a certain failure" in refusal(
        "export", run, "--to", "gate", "--out", tmp_path / "package"
    )


@pytest.mark.usefixtures("gate")
def test_other_classes_are_no_comparison(attacked: Path) -> None:
    other = refusal("gate", attacked, "--after", "other")
    assert other == "--after: expected the classes of --before, found Bus, which --before does not know"
    fewer = refusal("gate", attacked, "--before", "other", "--after", "any")
    assert fewer == "--after: expected the classes of --before, found no Bus"


def test_the_gate_needs_the_new_detector(attacked: Path) -> None:
    """The old detector compared with itself would always pass."""
    wanted = "the detector that replaces --before"
    assert refusal("gate", attacked) == f"--after: expected {wanted}, found nothing"
    assert not (attacked / "gate").exists()


def test_before_defaults_to_the_detector_of_the_runs(
    gate: Callable[[str], tuple[int, dict[str, Any]]], attacked: Path, tmp_path: Path
) -> None:
    _, named = gate("worse")
    words = ["--after", "worse", "--samples", "20", "--workers", "1"]
    data = run_json("gate", attacked, *words, "--out", tmp_path / "own", code=1)
    assert (data["before"], data["rows"]) == ("any", named["rows"])
    assert "before: any" in (tmp_path / "own" / "config.yaml").read_text()


def test_runs_without_a_usable_detector_need_before(attacked: Path, tmp_path: Path) -> None:
    run = shutil.copytree(attacked, tmp_path / "run")
    config, as_it_was = run / "config.yaml", (run / "config.yaml").read_text()

    def of(detector: str) -> None:
        config.write_text(as_it_was.replace("detector: any\n", f"detector: {detector}\n"))

    of("better")
    several = "the current detector, as these runs have several"
    assert refusal("gate", attacked, run, "--after", "worse") == f"--before: expected {several}, found any, better"
    of("module:evil.py:D")
    trusted = f"{config}: detector: expected a detector that is data alone, or --trust"
    assert refusal("gate", run, "--after", "worse").startswith(trusted)
    # weights that were written over: the new detector may be in the old one's file
    weights = tmp_path / "weights.safetensors"
    weights.write_bytes(b"new")
    of(str(weights))
    (run / "files.json").write_text(json.dumps({str(weights): "0" * 64}))
    made_with = f"expected the files that this run was made with, found another {weights}"
    assert made_with in refusal("gate", run, "--after", "worse")
