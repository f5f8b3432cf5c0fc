"""Studies on one embedded frame: files, metrics, resuming; each arm is an attack like any other."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
import yaml

from drivesem.cli import main as drivesem_main
from drivesem.failures.second_renderer.base import NoSecondRendererError
from drivesem.synth.write import Order, synthesise
from tests.tools.experiments.conftest import REQUIRED_KEYS
from tools.experiments.__main__ import main
from tools.experiments.detection import study as study_module
from tools.experiments.detection.arms import AttackArm, build_arms
from tools.experiments.settings import StudyConfig

WORDS = ["multi", "--quick", "--limit", "1", "--steps", "1", "--workers", "1", "--bootstrap", "5"]


def first_arm(config: StudyConfig, out: Path) -> list[AttackArm]:
    """Combination 1 and its controls."""
    return build_arms(config, out)[:3]


@pytest.fixture(autouse=True)
def fewer_arms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study_module, "build_arms", first_arm)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_module, "build_arms", first_arm)
        assert main([*WORDS, "--out", str(out)]) == 0
    return out


def result(folder: Path) -> dict[str, Any]:
    data = json.loads((folder / "frames" / "demo-000" / "result.json").read_text())
    data.pop("seconds")
    return data


def test_files(finished: Path) -> None:
    data = json.loads((finished / "study.json").read_text())
    (row,) = data["rows"]
    assert set(row) >= REQUIRED_KEYS
    assert (row["name"], row["reference"]) == ("combo 1", None)  # the paper takes more steps
    assert row["drop_moved"] == pytest.approx(row["benign_ap50"] - row["moved_ap50"], abs=1e-9)
    assert (data["frames"], data["feasible_fraction"], data["frames_without_vehicles"]) == (1, 1.0, 0)
    (line,) = csv.DictReader((finished / "study.csv").read_text().splitlines())
    assert float(line["paper_ap50"]) == row["paper_ap50"]
    assert "| combo 1 |" in (finished / "study.md").read_text()
    assert min(cv2.imread(str(finished / "study.png")).shape[:2]) > 400
    settings = yaml.safe_load((finished / "config.yaml").read_text())
    assert (settings["name"], settings["steps"]) == ("multi", 1)


def test_tables_come_again_from_what_is_stored(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], output_json: Callable[..., Any]
) -> None:
    """Rows, intervals and p values to the last bit; and other draws give other intervals."""
    words = ["multi", "--from", str(finished / "results")]
    assert output_json(*words) == json.loads((finished / "study.json").read_text())
    assert output_json(*words, "--out", str(tmp_path / "again"))["bootstrap"] == 5
    again = {path.name: path.read_bytes() for path in (tmp_path / "again").iterdir()}
    assert set(again) == {"study.md", "study.csv", "study.json", "study.png", "grades.csv"}
    assert all(data == (finished / name).read_bytes() for name, data in again.items())
    (row,) = output_json(*words, "--bootstrap", "0")["rows"]
    assert (row["drop_moved_low"], row["p"]) == (None, None)
    assert main(["multi", "--results", str(finished / "results")]) == 0
    assert "combo 1" in capsys.readouterr().out


def test_labels_come_again_from_what_is_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output_json: Callable[..., Any]
) -> None:
    monkeypatch.setattr(study_module, "build_arms", lambda config, out: build_arms(config, out)[:1])
    out = tmp_path / "labels"
    data = output_json("labels", *WORDS[1:], "--out", str(out))
    assert data["label_sets"][0]["objects"] > 0
    assert output_json("labels", "--from", str(out / "results")) == data


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("classification --from {0}/results", "settings.name: expected classification, found multi"),
        ("single --from {0}/results", "settings.name: expected single, found multi"),
        ("multi --steps 7 --from {0}/results", "--steps: expected none with --from, which uses the study's own"),
        (" ".join(WORDS) + " --seed 5 --out {0}", "other values of seed"),
    ],
)
def test_refused_of_a_finished_study(
    words: str, message: str, finished: Path, refused: Callable[..., str]
) -> None:
    assert message in refused(*words.format(finished).split())


def test_what_arms_have_in_common_takes_room_once(finished: Path) -> None:
    arms = sorted((finished / "arms").iterdir())
    frames = [arm / "frames" / "demo-000" for arm in arms]
    for name in ("benign.png", "scene/background.png"):
        assert all((frame / name).samefile(frames[0] / name) for frame in frames)
    assert not (frames[1] / "result.json").samefile(frames[0] / "result.json")


def test_the_generator_draws_again_on_request(
    finished: Path, tmp_path: Path, output_json: Callable[..., Any]
) -> None:
    out = tmp_path / "drawn"
    shutil.copytree(finished, out)
    (row,) = output_json(*WORDS, "--confirm", "--out", str(out))["rows"]
    drawn = json.loads((out / "arms" / "combo-1" / "confirm" / "confirm.json").read_text())
    assert row["survive_share"] == drawn["survive"]
    assert row["survive_failures"] == drawn["rows"][0]["failures"]
    assert "| combo 1 |" in (out / "study.md").read_text().split("Failures that survive")[1]
    assert output_json("multi", "--from", str(out / "results"))["rows"] == [row]


def test_without_a_second_renderer_nothing_is_attacked(
    tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing() -> None:
        raise NoSecondRendererError("pyrender", "EGL or OSMesa", "neither")

    monkeypatch.setattr("drivesem.failures.second_renderer.selection.shared_context", nothing)
    for _ in synthesise(Order(tmp_path / "data", 1, seed=3, split="heldout")):
        pass
    (tmp_path / "data" / "manifest.json").unlink()  # now nobody knows that they were generated
    words = ["multi", "--confirm", "--dataset", "kitti", "--root", str(tmp_path / "data")]
    assert "expected EGL or OSMesa, found neither" in refused(*words, "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out" / "arms").exists()


def test_the_placebo_is_as_large_as_the_attack(finished: Path) -> None:
    attack, placebo = (result(finished / "arms" / name) for name in ("combo-1", "combo-1-placebo"))
    sizes = [sorted(abs(c["value"]) for c in one["theta"]) for one in (attack, placebo)]
    assert placebo["queries"] == 1
    assert sum(sizes[0]) > 0
    # projection onto what is feasible may have lessened it, and nothing else
    assert all(small <= large + 1e-6 for large, small in zip(*sizes, strict=True))


@pytest.mark.slow
def test_an_arm_is_an_attack_like_any_other(finished: Path, tmp_path: Path) -> None:
    """The same settings, by drivesem attack alone, give the same frame."""
    words = ["attack", "--combo", "1", "--steps", "1", "--limit", "1", "--workers", "1", "--seed", "0"]
    assert drivesem_main([*words, "--out", str(tmp_path / "alone")]) == 0
    assert result(tmp_path / "alone") == result(finished / "arms" / "combo-1")
    for part in ("counterexample.png", "labels_moved.txt"):
        alone, arm = (
            f / "frames" / "demo-000" / part for f in (tmp_path / "alone", finished / "arms" / "combo-1")
        )
        assert alone.read_bytes() == arm.read_bytes()


@pytest.mark.slow
def test_a_stopped_study_goes_on(finished: Path, tmp_path: Path, output_json: Callable[..., Any]) -> None:
    out = Path(shutil.copytree(finished, tmp_path / "stopped"))
    shutil.rmtree(out / "arms" / "combo-1-random" / "frames" / "demo-000")
    (out / "study.json").unlink()
    stored = out / "arms" / "combo-1" / "frames" / "demo-000" / "result.json"
    # the placebo's size is of a run at another place: as it was set
    for folder in out.glob("arms/*-placebo"):
        text = (folder / "config.yaml").read_text()
        (folder / "config.yaml").write_text(text.replace(str(finished), str(out)))
    before = stored.stat().st_mtime_ns
    data = output_json(*WORDS, "--out", str(out))
    assert stored.stat().st_mtime_ns == before
    assert data == json.loads((finished / "study.json").read_text())


@pytest.mark.slow
def test_searches_of_one_parameter(tmp_path: Path, output_json: Callable[..., Any]) -> None:
    """The first three arms: a search, its baseline and a gradient, within the passes that were asked for."""
    words = ["searches", "--params", "color", "--passes", "24", "--limit", "1", "--workers", "1"]
    found = output_json(*words, "--bootstrap", "5", "--out", str(tmp_path / "a"))
    assert [row["name"] for row in found["searches"]] == ["climb", "corners", "si-fgsm"]
    assert all(row["passes"] <= 24 for row in found["grades"])
    assert found["standing"][0]["objects"] == sum(
        row["objects"] for row in found["standing"] if row["name"].startswith("distance")
    )
    assert (tmp_path / "a" / "standing.csv").is_file()
    assert output_json("searches", "--from", str(tmp_path / "a" / "results")) == found


@pytest.mark.slow
def test_attribution_sums_to_the_difference_and_goes_on(tmp_path: Path, output_json: Callable[..., Any]) -> None:
    out = tmp_path / "attribution"
    words = ["attribution", *WORDS[1:], "--out", str(out)]
    data = output_json(*words)
    *factors, labels, total = data["rows"]
    assert sum(row["points"] for row in factors) == pytest.approx(data["papers"] - data["ours"], abs=1e-9)
    assert total["points"] == pytest.approx(data["papers"] - data["ours"], abs=1e-9)
    assert labels["points"] == pytest.approx(factors[0]["points"] + factors[1]["points"], abs=1e-9)
    assert {"study.md", "study.csv", "study.json", "study.png", "arms.csv"} <= {
        path.name for path in out.iterdir()
    }
    done = {path: path.stat().st_mtime_ns for path in out.glob("arms/*/frames/*/result.json")}
    assert len(done) == len(data["arms"]) == 13
    assert output_json(*words) == data
    assert {path: path.stat().st_mtime_ns for path in done} == done
    assert output_json("attribution", "--from", str(out / "results")) == data
