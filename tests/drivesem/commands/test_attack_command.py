"""`drivesem attack` as a user types it: metrics, files, resuming, bad frames."""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
import torch

from detectors.incremental import reference
from detectors.types import Detections
from drivesem.attacks.feasibility_check import check_scene
from drivesem.cli import main
from drivesem.config.commands import GRADIENT_FREE_METHODS, AttackConfig
from drivesem.run import attack as run_attack
from drivesem.run.results import load_frame
from drivesem.synth.demo import demo_scene
from drivesem.synth.write import Order, synthesise
from scene_ir.io import load_scene
from tests.drivesem.invoke import invoke, refusal, run_json
from tests.drivesem.timid import CLASS, MISSED, PLACED, Timid

WORDS = ["attack", "--params", "color,translate", "--steps", "2"]
PARTS = ("benign.png", "rerender.png", "counterexample.png", "overlay.png", "difference.png", "theta.json")


def without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if k not in ("seconds", "out")}
    return [without_times(v) for v in value] if isinstance(value, list) else value


def contents(folder: Path) -> dict[str, Any]:
    """Every file of a run: bytes of pictures and scenes, JSON without times; the page apart, which shows times."""
    found: dict[str, Any] = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.name != "report.html"):
        name = str(path.relative_to(folder))
        if path.suffix == ".json":
            found[name] = without_times(json.loads(path.read_text()))
        elif path.suffix == ".yaml":
            lines = path.read_text().splitlines()
            found[name] = [line for line in lines if not line.startswith(("out:", "limit:", "workers:"))]
        else:
            found[name] = path.read_bytes()
    return found


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "whole"
    run_json(*WORDS, "--limit", "2", "--workers", "2", "--out", out)
    return out


def test_metrics(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    for key in ("benign", "rerendered"):
        assert {"ap50", "ap70", "ap", "recall"} <= set(metrics[key])
    assert set(metrics["attacked"]) == {"paper", "moved"}
    assert metrics["out"] == str(finished)
    assert metrics["frames"] == 2
    assert metrics["frames_without_vehicles"] == 0
    assert metrics["frames_attacked"] == 2
    objects = metrics["objects"]
    assert objects["all"] >= objects["judged"] >= objects["found_before"] >= 8
    missed = {"count": objects["judged"] - objects["found_before"], "of": objects["judged"]}
    assert missed.items() <= metrics["missed_before"].items()
    lost = metrics["lost_by_grade"]["threshold"]
    assert (lost["count"], lost["of"]) == (metrics["lost_objects"], objects["found_before"])
    assert lost["low"] <= lost["count"] / lost["of"] <= lost["high"]
    assert metrics["queries"] == 4
    assert metrics["feasible_fraction"] == 1.0
    assert metrics["rerendered"]["ap50"] == pytest.approx(metrics["benign"]["ap50"], abs=0.01)


def test_map(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    found, objects = metrics["map"], metrics["objects"]["judged"]
    cells = found["cells"]
    assert found["searched"] == len(cells) > 0
    assert found["failing"] == sum(cell["state"] == "failing" for cell in cells)
    assert found["clear"] == 0  # of two frames
    assert sum(cell["objects"] for cell in cells) >= objects
    certain = {
        (name, f.index)
        for name in ("demo-000", "demo-001")
        for f in load_frame(finished / "frames" / name / "result.json").failures
        if f.grade not in (None, "threshold") and f.kind == "lost"
    }
    assert sum(cell["certain"] for cell in cells) == len(certain)
    page = (finished / "report.html").read_text()
    assert all(f'<td class="{cell["state"]}">' in page for cell in cells)


@pytest.mark.parametrize("method", ["halton", "climb", "fgsm", "si-fgsm"])
def test_the_map_counts_all_passes(method: str, tmp_path: Path) -> None:
    """Of the search alone: the photograph as a file and what is rendered again for the result are not part of it."""
    words = ["--method", method, "--params", "color,translate", "--no-grade", "--limit", "1"]
    run_json("attack", *words, *(["--steps", "3"] if "fgsm" in method else ["--passes", "30"]), "--out", tmp_path)
    result = load_frame(tmp_path / "frames" / "demo-000" / "result.json")
    assert {visit.index for visit in result.visits} == set(result.judged)
    assert result.passes is not None
    passes = max(sum(v.passes for v in result.visits if v.index == row) for row in result.found_before)
    assert result.passes - 3 <= passes <= result.passes
    missed_before = set(result.judged) - set(result.found_before)
    assert all(sum(v.misses for v in result.visits if v.index == row) == 1 for row in missed_before)
    lost = {failure.index for failure in result.failures if failure.kind == "lost"}
    assert {visit.index for visit in result.visits if visit.final and visit.misses} >= lost


def test_folder(finished: Path) -> None:
    for name in ("demo-000", "demo-001"):
        folder = finished / "frames" / name
        assert all((folder / part).is_file() for part in PARTS)
        result = load_frame(folder / "result.json")
        assert len(result.loss_trace) == 3
        assert any(c.value != 0 for c in result.theta)
        saved = load_scene(folder / "scene")
        assert check_scene(saved.as_photographed(), saved) == list(result.violations) == []
        assert (folder / "benign.png").read_bytes() == (folder / "rerender.png").read_bytes()
        paper, moved = ((folder / f"labels_{mode}.txt").read_text().splitlines() for mode in ("paper", "moved"))
        assert len(paper) == len(moved) >= result.objects
    page = (finished / "report.html").read_text()
    assert "demo-000" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page


def test_a_stopped_run_goes_on_and_ends_the_same(finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "stopped"
    shutil.copytree(finished, out)
    shutil.rmtree(out / "frames" / "demo-001")
    for name in ("metrics.json", "manifest.json", "report.html"):
        (out / name).unlink()
    retained = (out / "frames" / "demo-000" / "result.json").stat().st_mtime_ns
    run_json(*WORDS, "--limit", "2", "--out", out)
    assert (out / "frames" / "demo-000" / "result.json").stat().st_mtime_ns == retained
    assert contents(out) == contents(finished)


def test_other_settings_do_not_mix(finished: Path) -> None:
    before = contents(finished)
    assert "seed" in refusal(*WORDS, "--limit", "2", "--out", finished, "--seed", "5")
    assert contents(finished) == before


def test_a_run_with_other_settings_is_refused(finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    assert "found other values of target_classes" in refusal(
        *WORDS, "--limit", "2", "--target-classes", "Car", "--out", out
    )


def test_a_folder_of_another_kind_stays_unchanged(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    assert "--out" in refusal(*WORDS, "--limit", "1", "--out", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.fixture(scope="module")
def kitti_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames in KITTI's layout: with vehicles, without, with a broken label, and with a car that is too far."""
    root = tmp_path_factory.mktemp("kitti")
    for _ in synthesise(Order(root, 4, seed=11, split="heldout")):
        pass
    labels = root / "training" / "label_2"
    lines = [ln for ln in (labels / "000001.txt").read_text().splitlines() if ln.split()[0] == "Pedestrian"]
    (labels / "000001.txt").write_text("".join(f"{ln}\n" for ln in lines))
    (labels / "000002.txt").write_text("Car 0.00 0 nan 1 2 30 40 1.5 1.6 3.9 0 1.6 20 0\n")
    (labels / "000003.txt").write_text("Car 0.00 0 0 600 170 606 173 1.5 1.6 3.9 0 1.6 400 0\n")
    return root


def test_kitti_folder(kitti_folder: Path, tmp_path: Path) -> None:
    words = [*WORDS, "--dataset", "kitti", "--root", str(kitti_folder), "--no-fit", "--out", str(tmp_path / "run")]
    error = refusal(*words)
    assert "000002.txt" in error
    metrics = run_json(*words, "--keep-going")
    assert metrics["frames"] == 1
    assert metrics["frames_without_vehicles"] == 2
    assert list(metrics["frames_failed"]) == ["000002"]
    assert "000002.txt:1: alpha: expected a finite number" in metrics["data"]["not_counted"]
    assert metrics["feasible_fraction"] == 1.0
    assert "000002" in (tmp_path / "run" / "report.html").read_text()


def test_a_frame_without_detections_before_is_not_attacked(tmp_path: Path) -> None:
    words = [*WORDS, "--limit", "1", "--out", tmp_path / "run", "--t-star", "0.9999"]
    metrics = run_json(*words)
    assert metrics["frames_not_attacked"] == {"demo-000": "none of 6 judged objects is found before"}
    assert (metrics["frames"], metrics["frames_attacked"], metrics["queries"]) == (1, 0, 0)
    assert metrics["objects"] == {"all": 6, "judged": 6, "found_before": 0}
    assert metrics["broken"] == {"count": 0, "of": 0, "low": None, "high": None}
    assert metrics["feasible_fraction"] is None
    assert metrics["benign"]["objects"] == 0
    output = invoke(*words).out
    assert "1 frame: 0 attacked, 1 not attacked (no vehicle judged and found before)" in output
    assert "missed before the attack: 6 of 6 judged vehicles (100 % [61, 100])" in output
    last = output.splitlines()[-1]
    assert last.startswith("nothing to attack: 6 judged, 0 found by squeezedet, of 6 vehicles")
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "not attacked: none of 6 judged objects is found before" in page
    assert "withstood" not in page
    assert last[1:] in page


@functools.cache
def first_car() -> torch.Tensor:
    """Box (4,) px of the first car of the first embedded frame."""
    return demo_scene(0, 0).objects.box2d[0]


class Blinking:
    """A detector without gradient: the first car of the first embedded frame, surer the brighter the picture is."""

    name, classes = "blinking", ("bus", "Car")

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.mean(dim=(1, 2, 3))

    def decode(self, raw: torch.Tensor) -> list[Detections]:
        box = first_car()[None]
        return [Detections(box, torch.tensor([1]), mean[None].clamp(0, 1)) for mean in raw]


@pytest.mark.parametrize("method", ["random", "cma-es"])
def test_searches_run_on_a_detector_without_gradient(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_attack, "load_predictor", lambda *_: Blinking())
    words = ["attack", "--detector", "any", "--limit", "1", "--workers", "1", "--out", str(tmp_path)]
    metrics = run_json(*words, "--method", method, "--queries", "2", "--t-star", "0.2")
    assert metrics["queries"] == 2
    assert metrics["t_star"] == 0.2
    assert metrics["feasible_fraction"] == 1.0
    assert list(metrics["benign"]["per_class"]) == ["Car"]
    result = load_frame(tmp_path / "frames" / "demo-000" / "result.json")
    assert len(result.loss_trace) == 3
    assert [d.label for d in result.detections_attacked] == ["Car"]
    assert ("cma" in json.loads((tmp_path / "manifest.json").read_text())["versions"]) == (method == "cma-es")


def test_a_detector_without_gradient_gets_a_method_without(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_attack, "load_predictor", lambda *_: Blinking())
    words = [
        "attack",
        "--detector",
        "any",
        "--limit",
        "1",
        "--workers",
        "1",
        "--params",
        "rotate",
        "--passes",
        "24",
    ]
    words += ["--nuisances", "off", "--no-confirm", "--t-star", "0.2", "--out", str(tmp_path)]
    assert main(words) == 0
    captured = "any has no gradient: method climb takes the place of si-fgsm"
    assert capsys.readouterr().err.splitlines()[0] == captured
    assert "method: climb" in (tmp_path / "config.yaml").read_text().splitlines()
    assert main(words) == 0  # and goes on in the same folder
    assert main([*words, "--method", "apgd"]) == 2


def test_failures_have_kinds_and_grades(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    timid = Timid()
    monkeypatch.setattr(run_attack, "load_predictor", lambda *_: timid)
    words = ["attack", "--detector", "any", "--limit", "1", "--workers", "1", "--params", "weather"]
    words += ["--method", "random", "--queries", "8", "--nuisances", "off", "--budget", "weather=0.3"]
    metrics = run_json(*words, "--out", tmp_path / "run")
    grades, kinds = metrics["grades"], metrics["kinds"]
    assert list(grades) == ["threshold", "certain", "confirmed", "shared"]
    assert grades["threshold"] == metrics["lost_objects"] + metrics["phantoms"]
    assert grades["threshold"] >= grades["certain"] >= grades["confirmed"] >= grades["shared"]
    assert kinds == {"missed": 1, "class": 1, "placed": 1, "twice": 1, "background": 1}
    assert grades["certain"] == sum(kinds.values())  # what is none of a kind is certain of nothing
    # The generator's picture of the changed weather is as dark; another detector that errs under any change
    # is not right under a placebo.
    assert (grades["confirmed"], grades["shared"]) == (5, 0)
    assert metrics["passes"] >= metrics["queries"] == 8
    assert metrics["frames_ungraded"] == 0
    result = load_frame(tmp_path / "run" / "frames" / "demo-000" / "result.json")
    assert {f.index: f.error for f in result.failures if f.kind == "lost"} == {
        MISSED: "missed",
        CLASS: "class",
        PLACED: "placed",
    }
    assert {f.grade for f in result.failures if f.error is None} == {"threshold"}
    assert all((f.count.before, f.count.after) == (16, 16) for f in result.failures if f.error and f.count)
    captured = " ".join(invoke(*words, "--out", tmp_path / "run").out.split())
    assert f"failures: 5 certain, 5 confirmed, 0 shared, of {grades['threshold']} by threshold" in captured
    assert "1 missed, 1 wrong class, 1 badly placed, 1 found twice, 1 on nothing" in captured


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--draws", "8"], "--draws: expected at least 16, which a certificate's rule needs, found 8"),
        (["--nuisances", "wind=3"], "--nuisances: expected default, off, or NAME=NUMBER with commas"),
        (["--nuisances", "jpeg=99"], "--nuisances: jpeg: expected a number of at least 0, at most 95, found 99"),
        (
            ["--reference-detector", "blind"],
            "--reference-detector: detector blinking: expected one that knows Car, found dog",
        ),
        (
            ["--second-detector", "blind"],
            "--second-detector: detector blinking: expected one that knows Car, found dog",
        ),
    ],
)
def test_what_cannot_grade_is_refused(
    words: list[str], message: str, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Blind(Blinking):
        classes = ("dog",)

    known = run_attack.load_predictor
    monkeypatch.setattr(run_attack, "load_predictor", lambda n, *w: Blind() if n == "blind" else known(n, *w))
    assert refused("attack", "--limit", "1", *words).startswith(f"drivesem: {message}")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--method", "apgd"],
            "--method: expected one of random, halton, cma-es, corners, climb, learn for any, which has no",
        ),
        (["--method", "halton", "--objective", "confidence"], "--objective: expected one of objectness, hide"),
        (["--queries", "3"], "--queries: expected only with --method random, halton"),
        (
            ["--method", "fgsm", "--range", "steps"],
            "--range: expected --method random, halton, cma-es, found --method fgsm",
        ),
        (["--method", "random", "--queries", "0"], "--queries: expected at least 1, found 0"),
        (["--method", "random", "--precision", "bfloat16"], "--precision: expected float32 with random"),
        (
            ["--method", "fgsm", "--early-stop"],
            "--early-stop: expected a method that can end at its first success",
        ),
        (["--method", "corners", "--early-stop"], "--early-stop: expected a method that can end at its first"),
        (["--params", "rotate,size"], "params: size: expected a budget in which size may change, such as street"),
        (["--budget", "size=5%"], "--budget: size: expected street,size=5%, since only street lets it change"),
        (["--t-star", "1.5"], "--t-star: expected a score in (0, 1], found 1.5"),
    ],
)
def test_what_does_not_go_together_is_named(
    words: list[str], message: str, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_attack, "load_predictor", lambda *_: Blinking())
    assert refused("attack", "--detector", "any", *words).startswith(f"drivesem: {message}")


def test_methods_are_those_that_need_no_gradient() -> None:
    names = get_args(get_type_hints(AttackConfig)["method"])
    free = [name for name in names if not run_attack.build_attack(AttackConfig(method=name)).needs_gradient]
    assert set(free) == {
        *GRADIENT_FREE_METHODS,
        "placebo",
        "corners",
        "climb",
        "learn",
    }  # the last two take gradients where there are any


@pytest.mark.parametrize(
    "objective",
    [
        "failure",
        "total",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("hide", "phantom", "localisation")),
    ],
)
def test_objectives_are_recorded_and_raised(objective: str, tmp_path: Path) -> None:
    words = ["attack", "--params", "rotate", "--steps", "2", "--limit", "1", "--json", "--objective", objective]
    run_json(*words, "--out", tmp_path / "run")
    (folder,) = (tmp_path / "run" / "frames").iterdir()
    result = load_frame(folder / "result.json")
    if not result.failures:  # then the loss alone chose among the iterates
        assert result.loss_trace[-1] >= result.loss_trace[0] - 1e-3
    assert f"objective: {objective}" in (tmp_path / "run" / "config.yaml").read_text()


@pytest.mark.slow
def test_what_is_not_aimed_at_is_no_success(tmp_path: Path) -> None:
    aimed = [*WORDS, "--limit", "2", "--target-objects", "0"]
    run_json(*aimed, "--out", tmp_path / "one")
    for folder in (tmp_path / "one" / "frames").iterdir():
        result = load_frame(folder / "result.json")
        assert all(failure.kind == "lost" and failure.index == 0 for failure in result.failures)
        assert result.success_moved == bool(result.failures)
    assert "1 frame without" in refusal(
        *WORDS, "--limit", "1", "--target-objects", "99", "--out", tmp_path / "none"
    )


def test_a_gradient_that_is_no_number_names_frame_and_coordinate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = torch.autograd.grad
    frames: list[int] = []

    def broken(losses: Any, leaves: Any) -> Any:
        gradients = whole(losses, leaves)
        frames.append(len(gradients[0]))
        if len(frames) == 1:  # of the first frame alone
            gradients[0][0] = torch.nan
        return gradients

    monkeypatch.setattr("drivesem.attacks.objective.torch.autograd.grad", broken)
    words = ["attack", "--params", "rotate", "--steps", "1", "--limit", "2", "--workers", "1"]
    (line,) = [
        ln
        for ln in invoke(*words, "--out", tmp_path / "ends", code=2).err.splitlines()
        if ln.startswith("drivesem:")
    ]
    assert "gradient of objects[0].yaw: expected a finite value, found nan" in line
    assert line.startswith("drivesem: frame ")
    frames.clear()
    captured = run_json(*words, "--keep-going", "--out", tmp_path / "goes")
    ((name, reason),) = captured["frames_failed"].items()
    assert captured["frames"] == 1
    assert reason.startswith(f"frame {name}: gradient of objects[0].yaw")


def test_incremental_passes_that_differ_are_reported_and_whole_ones_used(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """With a limit below 0, every detector's incremental passes differ."""
    words = ["attack", "--params", "rotate", "--steps", "1", "--limit", "2"]
    expected = run_json(*words, "--whole", "--out", tmp_path / "whole")
    monkeypatch.setattr(reference, "MAX_LOGIT_DIFFERENCE", -1.0)
    passes = []
    changed = reference.ReferencePass._changed
    monkeypatch.setattr(
        reference.ReferencePass, "_changed", lambda self, *given: passes.append(0) or changed(self, *given)
    )
    captured = invoke(*words, "--json", "--out", tmp_path / "regions")
    assert captured.err.count("incremental passes differ from whole ones") == 1
    assert len(passes) == 1
    (line,) = [line for line in captured.err.splitlines() if "incremental passes differ" in line]
    assert line.startswith("drivesem: detector squeezedet: ")
    assert without_times(json.loads(captured.out)) == without_times(expected)
    for name in ("result.json", "theta.json"):
        pairs = zip(
            sorted((tmp_path / "whole").rglob(name)), sorted((tmp_path / "regions").rglob(name)), strict=True
        )
        for whole, regions in pairs:
            assert without_times(json.loads(regions.read_text())) == without_times(json.loads(whole.read_text()))
