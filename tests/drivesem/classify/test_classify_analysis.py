"""What is asked of a run of `drivesem classify attack`: confirm, explain, holes, gate, as they are typed."""

import io
import json
import shutil
import xml.etree.ElementTree as ET
from unittest import mock

import numpy as np
import pytest
import torch
from rich.console import Console

from drivesem.classify import attack as attacking
from drivesem.classify import confirm as confirming
from drivesem.classify import explain, pictures
from drivesem.classify.analysis import ClassifyRun
from drivesem.classify.holes import PoseFailureRegion
from drivesem.classify.explain import MinimalObjectChange
from drivesem.classify.networks import loading
from drivesem.classify.scenes import DRAWN_PX, ObjectScene
from drivesem.classify.space import Change
from drivesem.cli import main
from scene_ir import files
from scene_ir.render.lit_mesh import LitMesh, Materials
from tests.drivesem.classify.conftest import Colours
from tests.drivesem.classify.standins import StandIns, model

NAME = "box-0008-forward"
MOST = 0.36


class Areas(Colours):
    """Calls a box a ball as soon as it covers more than MOST of the picture, as it does where it is turned."""

    most = MOST

    def forward(self, images):
        area = area_of(images)
        return torch.stack([0 * area, 40 * (area - self.most), 0 * area - 1], dim=1)


def area_of(images):
    """Share of pictures (B, 3, H, W) before a grey background that red objects cover."""
    return ((images[:, 0] - images[:, 2]) > 0.1).float().mean(dim=(1, 2))


class Other:
    """Draws what the own renderer draws, or nothing at all."""

    def __init__(self, name, blank=False):
        self.name, self.blank = name, blank

    def draw(self, solid):
        points, faces = torch.from_numpy(solid.points), torch.arange(len(solid.points)).reshape(-1, 3)
        looks = Materials(*map(torch.from_numpy, (solid.diffuse, solid.specular, solid.shininess)))
        drawn = LitMesh(points, faces, looks).render(points, solid.camera, solid.lights)
        return 0 * drawn if self.blank else drawn


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run on one picture, with a certain failure."""
    root = tmp_path_factory.mktemp("finished")
    files.write_png(root / "grey" / "grey.png", np.full((64, 64, 3), 128, np.uint8))
    with pytest.MonkeyPatch.context() as patch:
        patched(patch)
        words = ("--params", "pose", "--method", "halton", "--views", "forward", "--limit", "1")
        words += ("--within-pose", "0.4", "--queries", "8", "--backgrounds", str(root / "grey"), "--workers", "1")
        assert main(["classify", "attack", "--out", str(root / "run"), *words]) == 0
    assert files.read_json(root / "run" / "frames" / NAME / "result.json")["grade"] == "certain"
    return root / "run"


def patched(patch):
    patch.setattr(pictures, "open_objects", lambda source: StandIns())
    patch.setattr(
        attacking, "load_classifier", lambda name, classes, device: loading.prepare_for_inference(open_network(name))
    )


def open_network(name):
    network = Areas()
    network.most = {"squeezenet": MOST, "blind": 0.0, "keen": 1.0}[name]
    return network


@pytest.fixture
def run(finished, tmp_path, monkeypatch):
    """A copy of it."""
    patched(monkeypatch)
    return shutil.copytree(finished, tmp_path / "run")


def answer(capsys, *words):
    code = main(["classify", *map(str, words), "--workers", "1", "--json"])
    said = capsys.readouterr()
    return code, json.loads(said.out) if said.out else {}, said.err


def test_confirm_reads_a_run_twice_however_many_failures_there_are(run, capsys, monkeypatch):
    monkeypatch.setattr(confirming, "open_second_renderer", lambda name: Other("twin"))
    monkeypatch.setattr(ClassifyRun, "failures", lambda self, limit: [NAME] * 5)
    read = mock.Mock(side_effect=ClassifyRun.load)
    monkeypatch.setattr(ClassifyRun, "of", read)
    assert answer(capsys, "confirm", run)[0] == 0
    assert read.call_count == 2


def test_confirm_writes_the_grade_and_the_page(run, capsys, monkeypatch):
    monkeypatch.setattr(confirming, "open_second_renderer", lambda name: Other("twin"))
    code, data, _ = answer(capsys, "confirm", run)
    assert code == 0
    assert data["grades"] == {"threshold": 1, "certain": 1, "confirmed": 1}
    assert data["second"]["agree"] == 1
    assert data["second"]["iou"]["least"] >= 0.995
    assert data["second"]["colour"]["most"] <= 1.0
    result = files.read_json(run / "frames" / NAME / "result.json")
    assert result["grade"] == "confirmed"
    assert result["second"]["agreement"] == {"by": "twin", "before": 4, "after": 4, "draws": 4}
    assert files.read_json(run / "metrics.json")["grades"]["confirmed"] == 1
    page = (run / "report.html").read_text()
    assert "drawn by twin" in page
    assert "twin agrees" in page
    # asked again, it goes on; another renderer has its own say
    written = (run / "frames" / NAME / "result.json").stat().st_mtime_ns
    assert answer(capsys, "confirm", run)[1]["second"]["agree"] == 1
    assert (run / "frames" / NAME / "result.json").stat().st_mtime_ns == written
    monkeypatch.setattr(confirming, "open_second_renderer", lambda name: Other("blank", blank=True))
    code, data, _ = answer(capsys, "confirm", run)
    assert data["grades"] == {"threshold": 1, "certain": 1, "confirmed": 0}
    assert data["second"]["agree"] == 0
    assert data["second"]["iou"]["least"] == 0


def test_explain_finds_the_least_turn(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(least, "_POINTS", 6)
    code, data, _ = answer(capsys, "explain", run, "--out", tmp_path / "why")
    assert code == 0
    (found,) = data["least"]
    angles = torch.tensor([found["angles"][f"pose.{axis}"] for axis in ("pitch", "yaw", "roll")])
    whole = torch.tensor([found["found"][f"pose.{axis}"] for axis in ("pitch", "yaw", "roll")])
    assert 0 < found["share"] <= 1
    assert bool((angles.abs() <= whole.abs() + 1e-6).all())
    grey = torch.full((3, DRAWN_PX, DRAWN_PX), 128 / 255)
    scene = ObjectScene(NAME, model("box", 8), "forward", grey)
    areas = [float(area_of(scene.render(Change(angles=share * angles))[None])) for share in (0.9, 1.0)]
    assert areas[0] <= MOST
    assert areas[1] >= MOST - 1e-3
    assert f"{NAME} is called ball with" in found["sentence"]
    assert (tmp_path / "why" / "explain.csv").is_file()
    assert files.read_image(tmp_path / "why" / "frames" / NAME / "least.png").shape == (224, 224, 3)


@pytest.mark.parametrize("name", ["skateboard-0080-forward", f"motorcycle-{32 * 'a'}-forward"])
def test_the_table_of_least_changes_breaks_no_number_at_80_columns(name):
    angles = {"pose.pitch": -0.276, "pose.yaw": 0.238, "pose.roll": -0.476}
    dropped = ("vertex", "lighting")
    change = MinimalObjectChange(name, "", "bus", "motorcycle", 1.0, angles, angles, 0.0074, 0.0, dropped, 1, 1)
    shown = io.StringIO()
    sheet = least.build_table([change], "squeezenet")
    Console(width=80, file=shown).print(sheet.to_rich(least.WORDS, **sheet.rich_options))
    told = shown.getvalue()
    assert {"-0.276", "+0.238", "-0.476", "0.0074", "motorcycle", "vertex,", "lighting"} <= set(told.split())
    first = "".join(line.split(" ")[0] for line in told.splitlines()[4:])
    assert first == name  # on one line where it is short, else it goes on below itself
    assert (name in told) == (len(name) <= 24)


def test_holes_tell_poses(run, tmp_path, capsys):
    words = ("holes", run, "--out", tmp_path / "holes", "--samples", "24", "--fresh", "8", "--reach", "0.4")
    code, data, _ = answer(capsys, *words)
    assert code == 0
    (hole,) = data["holes"]
    assert hole["predicted"] == "ball"
    assert hole["where"]
    assert hole["probability"] == hole["fails"] / hole["count"]
    assert hole["count"] == 8
    assert hole["probability"] > hole["fails_outside"] / hole["count_outside"]
    assert hole["interval"][0] < hole["probability"] <= hole["interval"][1]
    before = (tmp_path / "holes" / "frames" / NAME / "hole.json").stat().st_mtime_ns
    assert answer(capsys, *words)[1]["holes"] == data["holes"]
    assert (tmp_path / "holes" / "frames" / NAME / "hole.json").stat().st_mtime_ns == before


def test_a_hole_in_words():
    hole = PoseFailureRegion("bus-0007-left", "", "bus", "train", {"yaw": (31.2, 43.8)}, 30, 32, 2, 40, 20, 64, 96)
    assert hole.sentence() == (
        "The bus of bus-0007-left is misclassified, mostly as train, in 94 % [80, 98] of poses with yaw "
        "from 31 to 44 degrees"
    )


@pytest.mark.parametrize(("after", "code", "grew"), [("keen", 0, False), ("blind", 1, True)])
def test_gate(run, tmp_path, capsys, after, code, grew):
    words = ("gate", run, "--network", after, "--samples", "24", "--out", tmp_path / "gate")
    found, data, _ = answer(capsys, *words)
    assert (found, data["passed"]) == (code, not grew)
    assert {row["level"] for row in data["rows"]} == {"hole", "kind", "all"}
    (whole,) = (row for row in data["rows"] if row["level"] == "all")
    assert whole["samples"] == 24
    expected = {"keen": 0.0, "blind": 1.0}
    assert whole["after"] == expected[after]
    assert 0 < whole["before"] < 1
    suite = ET.parse(tmp_path / "gate" / "gate.xml").getroot()
    assert (suite.get("failures") != "0") == grew


def test_a_gate_of_poses_that_cannot_be_drawn_is_not_passed(run, tmp_path, capsys):
    for path in run.glob("frames/*/theta.npz"):
        path.unlink()
    words = ("gate", run, "--network", "keen", "--samples", "24", "--keep-going", "--out", tmp_path / "gate")
    code, data, _ = answer(capsys, *words)
    assert (code, data["passed"], data["rows"]) == (1, False, [])
    assert data["frames_failed"]
    suite = ET.parse(tmp_path / "gate" / "gate.xml").getroot()
    assert suite.get("errors") == str(len(data["frames_failed"]))


def test_bad_input_is_one_line_and_exit_code_2(run, tmp_path, capsys):
    cases = {
        ("explain",): "RUN: expected a folder of drivesem classify attack, to explain, found nothing",
        ("holes", tmp_path): "RUN: expected a folder of drivesem classify attack, found",
        ("attack", run): "RUN: expected no folder, for classify attack",
        ("confirm", run, "--out", tmp_path): "--out: expected none: confirm goes on in the run",
        ("holes", run, "--samples", "5"): "--samples: expected at least 24",
        ("gate", run): "--network: expected the network that is to take the place of the run's, found nothing",
    }
    for words, message in cases.items():
        code, _, said = answer(capsys, *words)
        lines = [line for line in said.splitlines() if line.startswith("drivesem: ")]
        assert (code, len(lines)) == (2, 1), words
        assert message in lines[0]


def test_a_network_without_gradient_is_asked_for_samples_only(tmp_path, capsys, monkeypatch):
    patched(monkeypatch)
    monkeypatch.setattr(Areas, "differentiable", False)
    words = ("attack", "--out", tmp_path / "run", "--limit", "1", "--views", "forward")
    code, _, said = answer(capsys, *words)
    assert code == 2
    assert "--method: expected random or halton: squeezenet has no gradient, found si-fgsm" in said
    assert answer(capsys, *words, "--method", "random", "--queries", "1")[0] == 0
