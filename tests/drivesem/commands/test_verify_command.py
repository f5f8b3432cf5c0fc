"""`drivesem verify`: a fresh run agrees with its files, and whatever is changed afterwards is found and named."""

from __future__ import annotations

import functools
import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from detectors.types import CLASSES, Detections
from drivesem.analysis.verify import CHECKS
from drivesem.attacks.budgets import PRESETS
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.space import ParameterSpace, parse_params
from drivesem.cli import main
from drivesem.run import attack as run_attack
from drivesem.run import folder as run_folder
from drivesem.run.finished import rebuild_objective
from drivesem.run.results import load_frame
from drivesem.synth.demo import demo_scene
from scene_ir import files
from scene_ir.io import load_scene
from tests.drivesem.invoke import invoke, refusal, run_json

FRAME = Path("frames") / "demo-000"
WORDS = ("--detector", "any", "--limit", "1", "--workers", "1", "--json", "--params", "weather,translate")


def verify(run: Path, *words: object, code: int = 1) -> Any:
    data = run_json("verify", "--run", run, "--workers", "1", *words, code=code)
    assert data["agree"] == (code == 0)
    return data


@functools.cache
def first_car() -> torch.Tensor:
    """Box (4,) px of the first car of the first embedded frame."""
    return demo_scene(0, 0).objects.box2d[0]


class Drifting:
    """A detector without gradient: the first car, and one that is not there, the further right the brighter it is."""

    name, classes, t_star = "drifting", CLASSES, 0.5

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.mean(dim=(1, 2, 3))

    def decode(self, raw: torch.Tensor) -> list[Detections]:
        lefts = (2000 * raw) % 300
        car = CLASSES.index("Car")
        boxes = [torch.stack([torch.stack([x, 0 * x, x + 20, 0 * x + 20]), first_car()]) for x in lefts]
        return [Detections(pair, torch.tensor([car, car]), torch.tensor([0.9, 0.8])) for pair in boxes]


@pytest.fixture(scope="module", autouse=True)
def drifting() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for command in (run_attack, run_folder):
            patch.setattr(command, "load_predictor", lambda *_: Drifting())
        yield


@pytest.fixture(scope="module")
def finished(drifting: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of an embedded frame in a budget that is tighter than the paper's."""
    out = tmp_path_factory.mktemp("runs") / "source"
    words = ("--method", "random", "--queries", "2", "--budget", "translate=0.05m,weather=0.5")
    assert main(["attack", *WORDS, *words, "--out", str(out)]) == 0
    return out


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "source"))


def change(path: Path, edit: Callable[[Any], None]) -> None:
    """Edit a JSON file in place."""
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data))


def differing_fields(data: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Differences by field; all of them are in the first frame or the run's."""
    assert {one["frame"] for one in data["differences"]} <= {"demo-000", "(run)"}
    return {one["field"]: one for one in data["differences"]}


def checks(data: dict[str, Any]) -> set[str]:
    return {row["name"] for row in data["checks"] if row["differing"]}


def test_a_fresh_run_agrees(run: Path) -> None:
    result = load_frame(run / FRAME / "result.json")
    assert (result.success_moved, result.success_paper) == (True, True)
    saved = load_scene(run / FRAME / "scene").as_photographed()
    assert result.violated_at_start == FeasibleSet(ParameterSpace(saved, ("translate",))).violated_at_start
    data = verify(run, code=0)
    assert data["frames"] == data["frames_of_run"] == 1
    assert data["differences"] == []
    assert [row["name"] for row in data["checks"]] == list(CHECKS)
    assert all(row["compared"] > 0 for row in data["checks"])
    assert data["rendered_again"]["rerender.png"] == {"largest_level": 0, "largest_share": 0.0}
    # Another number of threads may round a pixel otherwise.
    assert data["rendered_again"]["counterexample.png"]["largest_share"] < 1e-4
    assert json.loads((run / "verify.json").read_text()) == data


def test_a_run_of_places_in_the_picture_agrees_goes_on_and_may_leave_the_ground(
    drifting: None, tmp_path: Path
) -> None:
    words = ("attack", *WORDS, "--parametrisation", "roi", "--project", "bounds")
    words = (
        *words,
        "--method",
        "random",
        "--queries",
        "2",
        "--keep",
        "last",
        "--no-grade",
        "--out",
        str(tmp_path),
    )
    assert main([*words]) == 0
    assert main([*words]) == 0  # with nothing left to do
    data = verify(tmp_path, code=0)
    assert (data["differences"], data["frames_ungraded"]) == ([], 1)
    result = load_frame(tmp_path / FRAME / "result.json")
    assert result.theta[4 + 2].name == "objects[0].translate.log_depth"
    assert all(c.value for c in result.theta)
    assert any("off the ground" in line for line in result.violations)
    assert result.failures
    assert not result.graded
    assert "parametrisation" in refusal(*words, "--parametrisation", "ground")


@pytest.mark.slow
def test_a_run_beyond_the_paper_s_budget_agrees_and_is_feasible_in_its_own(drifting: None, tmp_path: Path) -> None:
    words = (
        "--method",
        "random",
        "--queries",
        "2",
        "--params",
        "translate,weather,size,sun",
        "--budget",
        "street",
        "--seed",
        "3",
    )
    out = tmp_path / "street"
    data = json.loads(invoke("attack", *WORDS, *words, "--out", out).out)
    assert data["feasible_fraction"] == 1.0
    assert yaml.safe_load((out / "config.yaml").read_text())["budget"] == "street"
    theta = [c for c in load_frame(out / FRAME / "result.json").theta if c.name.endswith("along")]
    assert max(abs(c.value) for c in theta) > 0.25
    assert max(c.upper for c in theta) > 0.5
    sun = [c for c in load_frame(out / FRAME / "result.json").theta if c.name.startswith("sun.")]
    assert 0.1 < max(abs(c.value) for c in sun) <= 1
    grown = [c for c in load_frame(out / FRAME / "result.json").theta if c.name.endswith("size")]
    assert 1 < max(abs(float(c.display.removesuffix(" %"))) for c in grown) <= 10
    assert verify(out, code=0)["differences"] == []
    # What is asked of it next looks as far as it went.
    result, attack = load_frame(out / FRAME / "result.json"), run_folder.load_attack_config(out)
    again, _ = rebuild_objective(
        result, out / FRAME, attack, parse_params("translate,weather,size,sun"), Drifting()
    )
    assert again.space.budget == PRESETS["street"]
    # The same scenes do not pass for a run in a budget as narrow as the paper's, nor for one that holds sizes.
    change_text = (out / "config.yaml").read_text().replace("budget: street", "budget: street,translate=0.25")
    (out / "config.yaml").write_text(change_text)
    found = differing_fields(verify(out))
    assert "own lengths" in found["violations"]["found"]
    (out / "config.yaml").write_text(change_text.replace("budget: street,translate=0.25", "budget: paper"))
    assert "params: size: expected a budget in which size may change" in refusal("verify", "--run", out)


def test_for_people_and_elsewhere(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "told.json"
    assert "no differences" in invoke("verify", "--run", run, "--limit", "1", "--workers", "1", "--out", out).out
    assert json.loads(out.read_text())["frames"] == 1
    assert not (run / "verify.json").exists()


def test_changed_pixels(run: Path) -> None:
    pictures = {
        "benign.png": "detections_benign",
        "rerender.png": "detections_rerendered",
        "counterexample.png": "detections_attacked",
    }
    for name in pictures:
        image = files.read_image(run / FRAME / name)
        image[20:60, 30:70] ^= 128
        files.write_png(run / FRAME / name, image)
    data = verify(run)
    assert checks(data) >= {"files", "pictures", "detections"}
    assert set(differing_fields(data)) >= {*pictures, *pictures.values()}
    share = f"up to 128 levels off, in {100 * 1600 / (image.shape[0] * image.shape[1]):.3g} % of the pixels"
    found = {d["field"]: d["found"] for d in data["differences"] if d["check"] == "pictures"}
    assert found == dict.fromkeys(pictures, share)


def test_many_differences_hide_no_other(run: Path) -> None:
    """A picture with other detections makes differences by the dozen."""
    result = run / FRAME / "result.json"
    change(result, lambda data: data["detections_benign"].extend(data["detections_benign"] * 40))
    settings = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(settings.replace("steps: 10", "steps: 99"))
    output = invoke("verify", "--run", run, "--workers", "1", code=1).out
    lines = [line for line in output.splitlines() if ": expected " in line]
    assert lines[0].startswith("(run): ")
    assert "(run): settings: config.yaml: steps: expected 99, found 10" in lines
    assert len([line for line in lines if ": detections: " in line]) == 5
    assert re.search(r"^and \d+ more$", output, re.MULTILINE)


def test_a_changed_label_in_either_file(run: Path) -> None:
    for name in ("labels_paper.txt", "labels_moved.txt"):
        lines = (run / FRAME / name).read_text().splitlines()
        words = lines[1].split()
        words[4] = f"{float(words[4]) - 3:.2f}"
        (run / FRAME / name).write_text("\n".join([lines[0], " ".join(words), *lines[2:]]) + "\n")
    data = verify(run)
    assert set(differing_fields(data)) == {
        *("labels_paper.txt", "labels_paper.txt: objects[1].boxes_xyxy"),
        *("labels_moved.txt", "labels_moved.txt: objects[1].boxes_xyxy"),
    }
    assert checks(data) == {"files", "labels"}


def test_an_object_struck_from_the_labels_and_another_sum(run: Path) -> None:
    path = run / FRAME / "labels_moved.txt"
    path.write_text("".join(f"{line}\n" for line in path.read_text().splitlines()[1:]))
    change(run / "metrics.json", lambda data: data.update(successes_paper=7))
    data = verify(run)
    found = {path.name, f"{path.name}: type", "metrics.json", "metrics.json: successes_paper"}
    assert set(differing_fields(data)) == found
    assert data["differences"][-1]["expected"] == "7"


def test_a_success_that_is_none(run: Path) -> None:
    def flip(data: dict[str, Any]) -> None:
        data["success_moved"] = not data["success_moved"]

    change(run / FRAME / "result.json", flip)
    data = verify(run)
    found = differing_fields(data)
    assert set(found) == {
        "success_moved",
        "success_moved by labels_moved.txt",
        "metrics.json: successes_moved",
        *(f"metrics.json: broken.{name}" for name in ("count", "low", "high")),
        "result.json",
    }
    assert (found["success_moved"]["expected"], found["success_moved"]["found"]) == ("False", "True")
    assert checks(data) == {"files", "success", "totals"}


def test_failures_detections_and_targets_that_are_others(run: Path) -> None:
    def spoil(data: dict[str, Any]) -> None:
        (phantom,) = data["failures"]
        data["failures"] = [phantom | {"kind": "lost", "index": 1, "score": None}]
        data["detections_rerendered"][0]["score"] = 0.6
        data["targets_moved"][1]["ignore"] ^= True

    change(run / FRAME / "result.json", spoil)
    found = differing_fields(verify(run))
    assert {"lost", "phantoms", "lost by labels_moved.txt", "phantoms by labels_moved.txt"} <= set(found)
    assert (found["lost"]["expected"], found["lost"]["found"]) == ("objects[1]", "none")
    assert found["targets_moved[1]"]["check"] == "labels"
    assert "detections_rerendered" in found


def test_another_grade_kind_or_count(run: Path) -> None:
    path = run / FRAME / "result.json"
    (failure,) = load_frame(path).failures
    assert (failure.error, failure.grade) == ("background", "threshold")
    assert failure.count is not None

    def spoil(**fields: Any) -> dict[str, dict[str, Any]]:
        whole = path.read_text()
        change(path, lambda data: data["failures"][0].update(fields))
        data = verify(run)
        path.write_text(whole)
        return differing_fields(data)

    found = spoil(grade="certain")
    files_changed = {"result.json", "result.json: failures"}
    grades = {"metrics.json: grades.certain", "metrics.json: by_class.Car.grades.certain"}
    assert set(found) == {*files_changed, "failures[0].grade", *grades}
    assert (found["failures[0].grade"]["expected"], found["failures[0].grade"]["found"]) == (
        "certain",
        "threshold",
    )
    found = spoil(error="missed")
    kinds = {
        f"metrics.json: {of}kinds.{kind}" for of in ("", "by_class.Car.") for kind in ("background", "missed")
    }
    assert set(found) == {*files_changed, "failures[0].error", *kinds}
    # As many draws as a certificate needs, and the grade that would follow from them.
    held = {"before": 16, "before_draws": 16, "after": 16, "after_draws": 16}
    found = spoil(count={**asdict(failure.count), **held}, grade="certain")
    assert set(found) == {*files_changed, "failures[0].count", *grades}
    verify(run, code=0)


def test_a_run_of_an_earlier_schema_is_refused_with_the_version_that_made_it(run: Path) -> None:
    change(run / "metrics.json", lambda data: data.update(schema=1))
    (line,) = invoke("verify", "--run", run, "--workers", "1", code=2).err.strip().splitlines()
    assert "expected a run of this version" in line
    assert "made by an earlier drivesem 0.1.0" in line


def nested(*keys: Any, value: Any) -> Callable[[Any], None]:
    """An edit of one value, by the keys to it."""

    def edit(data: Any) -> None:
        for key in keys[:-1]:
            data = data[key]
        data[keys[-1]] = value

    return edit


def by_another_judge(data: Any) -> None:
    """Open3D judges where it can be loaded, or else outlines."""
    data["checked_by"] = "outlines" if data["checked_by"] == "open3d" else "open3d"


def test_each_figure_of_the_run(run: Path) -> None:
    edits = {
        "attacked.moved.ap50": nested("attacked", "moved", "ap50", value=0.05),
        "benign.overall.objects": nested("benign", "overall", "objects", value=7),
        "detector": nested("detector", value="yolov3-slim"),
        "dataset": nested("dataset", value="kitti"),
        "headline": nested("headline", value="Van"),
        "params": nested("params", value=["weather", "mesh"]),
        "t_star": nested("t_star", value=0.6),
        "passes": nested("passes", value=1),
        "phantoms_by_class.Car": nested("phantoms_by_class", "Car", value=5),
        "frames_without_vehicles": nested("frames_without_vehicles", value=9),
        "frames_failed": nested("frames_failed", value={"demo-007": "why"}),
    }
    for edit in edits.values():
        change(run / "metrics.json", edit)
    assert set(differing_fields(verify(run))) == {"metrics.json", *(f"metrics.json: {field}" for field in edits)}


def test_each_figure_of_a_frame(run: Path) -> None:
    peer = {"by": "yolov3-slim", "before": 8, "after": 8, "draws": 8}
    edits = {
        "result.json: loss_trace": nested("loss_trace", value=[9.0]),
        "result.json: queries": nested("queries", value=1),
        "result.json: active_constraints": nested("active_constraints", value=["objects[0]: road"]),
        "result.json: violated_at_start": nested("violated_at_start", value=["objects[0]: road"]),
        "result.json: became_ignored": nested("became_ignored", value=[0]),
        "result.json: checked_by": by_another_judge,
        "result.json: change": nested("change", value="a car is gone"),
        "identity_psnr_db": nested("identity_psnr_db", value=31.0),
        "failures[0].index": nested("failures", 0, "index", value=1),
        "result.json: failures": nested("failures", 0, "peer", value=peer),
        "result.json: grade_notes": nested("grade_notes", value=["no peer"]),
        "result.json: visits": nested("visits", value=[]),
    }
    for edit in edits.values():
        change(run / FRAME / "result.json", edit)
    assert {*edits, "metrics.json: queries", "result.json"} <= set(differing_fields(verify(run)))


def test_runs_from_before_values_had_hashes_of_their_own(run: Path) -> None:
    change(run / "manifest.json", lambda data: data.pop("fields"))
    verify(run, code=0)
    change(run / FRAME / "result.json", nested("loss_trace", value=[9.0]))
    assert set(differing_fields(verify(run))) == {"result.json"}


def test_settings_overlays_and_files_that_were_added_or_taken_away(run: Path) -> None:
    settings = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(settings.replace("steps: 10", "steps: 99").replace("limit: 1", "limit: 7"))
    files.write_png(run / FRAME / "overlay.png", files.read_image(run / FRAME / "benign.png"))
    (run / FRAME / "difference.png").unlink()
    (run / FRAME / "scene" / "more.txt").write_text("more")
    change(run / FRAME / "result.json", nested("seconds", value=1e6))  # no two runs take as long
    found = differing_fields(verify(run))
    assert set(found) == {"config.yaml: steps", "overlay.png", "difference.png", "scene/more.txt"}
    assert (found["config.yaml: steps"]["expected"], found["config.yaml: steps"]["found"]) == ("99", "10")
    assert found["difference.png"]["found"] == found["scene/more.txt"]["expected"] == "no file"


def test_times_and_places_may_be_others(run: Path) -> None:
    change(run / FRAME / "result.json", nested("seconds", value=1.0))
    change(run / "metrics.json", lambda data: data.update(seconds=1.0, out="elsewhere"))
    verify(run, code=0)


def shift(data: dict[str, Any], metres: float) -> None:
    data["objects"]["translation"][0][0] += metres


def test_a_scene_moved_within_the_paper_s_budget_and_beyond_the_run_s(run: Path) -> None:
    change(run / FRAME / "scene" / "scene.json", lambda data: shift(data, 0.15))
    data = verify(run)
    found = differing_fields(data)
    assert "scene: objects[0].translation" in found
    for name in ("budget", "violations"):
        assert found[name]["found"].startswith("objects[0]: moved by")
    assert {"pictures", "feasibility", "theta", "labels"} <= checks(data)


def test_a_scene_that_cannot_be(run: Path) -> None:
    change(run / FRAME / "scene" / "scene.json", lambda data: shift(data, 3.0))
    found = differing_fields(verify(run))
    assert found["violations"]["expected"] == "none"
    assert "own lengths" in found["violations"]["found"]


def test_theta_beyond_the_budget_and_another_in_its_own_file(run: Path) -> None:
    def beyond(data: dict[str, Any]) -> None:
        (own,) = [c for c in data["theta"] if c["name"] == "weather.fog"]
        own["value"] = own["upper"] = 0.9

    name = "objects[0].translate.along"
    change(run / FRAME / "result.json", beyond)
    change(run / FRAME / "theta.json", lambda data: data[name].update(value=0.0))
    found = differing_fields(verify(run))
    assert set(found) == {
        *("weather.fog, budget", "weather.fog, bounds", "theta.json: weather.fog", "scene: weather"),
        *("theta.json", f"theta.json: {name}", "result.json"),
    }
    assert found["weather.fog, budget"]["expected"] == "a value in [0, 0.5]"


def test_what_cannot_be_read(run: Path) -> None:
    (run / FRAME / "scene" / "arrays.npz").write_bytes(b"no archive")
    line = refusal("verify", "--run", run, "--workers", "1")
    assert "arrays.npz" in line
    data = verify(run, "--keep-going")
    assert list(data["frames_failed"]) == ["demo-000"]
    assert data["frames"] == 0


def test_bad_input(run: Path, tmp_path: Path) -> None:
    def refused(*words: object) -> str:
        (line,) = invoke("verify", "--workers", "1", *words, code=2).err.splitlines()
        return line.removeprefix("drivesem: ")

    assert refused("--run", tmp_path).startswith("--run: expected a folder of drivesem attack")
    assert refused("--run", run, "--limit", "0") == "--limit: expected at least 1, found 0"
    assert refused("--run", run, "--out", tmp_path).startswith("--out: expected a file")
    (run / "metrics.json").unlink()
    assert "a finished run" in refused("--run", run)
