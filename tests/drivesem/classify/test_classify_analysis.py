"""`drivesem classify confirm | explain | holes | gate` of a run as typed."""

import io
import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import torch
from rich.console import Console

from drivesem.classify import confirm, explain
from drivesem.classify.analysis import ClassifyRun
from drivesem.classify.explain import MinimalObjectChange
from drivesem.classify.holes import PoseFailureRegion
from drivesem.classify.scenes import DRAWN_PX, ObjectScene
from drivesem.classify.space import ObjectChange
from drivesem.cli import main
from scene_ir import files
from scene_ir.render.lit_mesh import LitMesh, Materials
from tests.drivesem.classify.conftest import ColourClassifier, error_line, make_model, use_solids

NAME = "box-0008-forward"
THRESHOLDS = {"squeezenet": 0.36, "blind": 0.0, "keen": 1.0}


class AreaClassifier(ColourClassifier):
    """Predicts ball instead of box if a red object covers more than a threshold of the picture, as when turned."""

    def __init__(self, name):
        super().__init__()
        self.threshold = THRESHOLDS[name]

    def forward(self, images):
        area = red_area(images)
        return torch.stack([0 * area, 40 * (area - self.threshold), 0 * area - 1], dim=1)


def red_area(images):
    """Share of pictures (B, 3, H, W) with a grey background that red objects cover."""
    return ((images[:, 0] - images[:, 2]) > 0.1).float().mean(dim=(1, 2))


class StubRenderer:
    """Renders as the project's renderer, or nothing at all."""

    def __init__(self, name, blank=False):
        self.name, self.blank = name, blank

    def render(self, posed):
        points, faces = torch.from_numpy(posed.points), torch.arange(len(posed.points)).reshape(-1, 3)
        materials = Materials(*map(torch.from_numpy, (posed.diffuse, posed.specular, posed.shininess)))
        layer = LitMesh(points, faces, materials).render(points, posed.camera, posed.lights)
        return 0 * layer if self.blank else layer


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run on one picture, with a certain failure."""
    root = tmp_path_factory.mktemp("finished")
    files.write_png(root / "grey" / "grey.png", np.full((64, 64, 3), 128, np.uint8))
    with pytest.MonkeyPatch.context() as patch:
        use_solids(patch, AreaClassifier)
        words = ("--params", "pose", "--method", "halton", "--views", "forward", "--limit", "1")
        words += ("--within-pose", "0.4", "--queries", "8", "--backgrounds", str(root / "grey"), "--workers", "1")
        assert main(["classify", "attack", "--out", str(root / "run"), *words]) == 0
    assert files.read_json(root / "run" / "frames" / NAME / "result.json")["grade"] == "certain"
    return root / "run"


@pytest.fixture
def run(finished, tmp_path, monkeypatch):
    use_solids(monkeypatch, AreaClassifier)
    return shutil.copytree(finished, tmp_path / "run")


@pytest.fixture
def second_renderer(monkeypatch):
    """Sets the second renderer."""
    return lambda *args: monkeypatch.setattr(confirm, "open_second_renderer", lambda name: StubRenderer(*args))


def test_confirm_reads_a_run_twice_for_any_number_of_failures(run, classify, second_renderer, monkeypatch):
    second_renderer("twin")
    monkeypatch.setattr(ClassifyRun, "failure_names", lambda self, limit: [NAME] * 5)
    read = mock.Mock(side_effect=ClassifyRun.load)
    monkeypatch.setattr(ClassifyRun, "load", read)
    assert classify("confirm", run)[0] == 0
    assert read.call_count == 2


def test_confirm_writes_the_grade_and_the_page(run, classify, second_renderer):
    second_renderer("twin")
    code, data, _ = classify("confirm", run, "--json")
    assert code == 0
    assert data["grades"] == {"threshold": 1, "certain": 1, "confirmed": 1}
    assert data["second"]["agree"] == 1
    assert data["second"]["iou"]["least"] >= 0.995
    assert data["second"]["colour"]["most"] <= 1.0
    result = files.read_json(run / "frames" / NAME / "result.json")
    assert result["grade"] == "confirmed"
    assert result["second"]["agreement"] == {"by": "twin", "before": 4, "after": 4, "draws": 4, "placebo": None}
    assert files.read_json(run / "metrics.json")["grades"]["confirmed"] == 1
    page = (run / "report.html").read_text()
    assert "rendered by twin" in page
    assert "twin agrees" in page
    # Repeated, it keeps results of the same renderer and replaces those of another.
    written = (run / "frames" / NAME / "result.json").stat().st_mtime_ns
    assert classify("confirm", run, "--json")[1]["second"]["agree"] == 1
    assert (run / "frames" / NAME / "result.json").stat().st_mtime_ns == written
    second_renderer("blank", True)
    _, data, _ = classify("confirm", run, "--json")
    assert data["grades"] == {"threshold": 1, "certain": 1, "confirmed": 0}
    assert data["second"]["agree"] == 0
    assert data["second"]["iou"]["least"] == 0


def test_explain_finds_the_smallest_rotation(run, tmp_path, classify, monkeypatch):
    monkeypatch.setattr(explain, "_POINTS", 6)
    code, data, _ = classify("explain", run, "--out", tmp_path / "why", "--json")
    assert code == 0
    (minimal,) = data["least"]
    angles = torch.tensor([minimal["angles"][f"pose.{axis}"] for axis in ("pitch", "yaw", "roll")])
    whole = torch.tensor([minimal["found"][f"pose.{axis}"] for axis in ("pitch", "yaw", "roll")])
    assert 0 < minimal["share"] <= 1
    assert bool((angles.abs() <= whole.abs() + 1e-6).all())
    grey = torch.full((3, DRAWN_PX, DRAWN_PX), 128 / 255)
    scene = ObjectScene(NAME, make_model("box", 8), "forward", grey)
    areas = [float(red_area(scene.render(ObjectChange(angles=share * angles))[None])) for share in (0.9, 1.0)]
    assert areas[0] <= THRESHOLDS["squeezenet"]
    assert areas[1] >= THRESHOLDS["squeezenet"] - 1e-3
    assert f"{NAME} is classified as ball with" in minimal["sentence"]
    assert (tmp_path / "why" / "explain.csv").is_file()
    assert files.read_image(tmp_path / "why" / "frames" / NAME / "least.png").shape == (224, 224, 3)


@pytest.mark.parametrize("name", ["skateboard-0080-forward", f"motorcycle-{32 * 'a'}-forward"])
def test_the_table_of_explain_wraps_no_number_at_80_columns(name):
    angles = {"pose.pitch": -0.276, "pose.yaw": 0.238, "pose.roll": -0.476}
    dropped = ("vertex", "lighting")
    change = MinimalObjectChange(name, "", "bus", "motorcycle", 1.0, angles, angles, 0.0074, 0.0, dropped, 1, 1)
    output = io.StringIO()
    table = explain.build_table([change], "squeezenet")
    Console(width=80, file=output).print(table.to_rich(explain.TEXT_COLUMNS, **table.rich_options))
    printed = output.getvalue()
    assert {"-0.276", "+0.238", "-0.476", "0.0074", "motorcycle", "vertex,", "lighting"} <= set(printed.split())
    first = "".join(line.split(" ")[0] for line in printed.splitlines()[4:])
    assert first == name  # a long name continues on the next line
    assert (name in printed) == (len(name) <= 24)


def test_holes_describes_poses(run, tmp_path, classify):
    words = ("holes", run, "--out", tmp_path / "holes", "--samples", "24", "--fresh", "8", "--reach", "0.4")
    code, data, _ = classify(*words, "--json")
    assert code == 0
    (hole,) = data["holes"]
    assert hole["predicted"] == "ball"
    assert hole["where"]
    assert hole["probability"] == hole["fails"] / hole["count"]
    assert hole["count"] == 8
    assert hole["probability"] > hole["fails_outside"] / hole["count_outside"]
    assert hole["interval"][0] < hole["probability"] <= hole["interval"][1]
    before = (tmp_path / "holes" / "frames" / NAME / "hole.json").stat().st_mtime_ns
    assert classify(*words, "--json")[1]["holes"] == data["holes"]
    assert (tmp_path / "holes" / "frames" / NAME / "hole.json").stat().st_mtime_ns == before


def test_the_sentence_of_a_region():
    region = PoseFailureRegion(
        "bus-0007-left", "", "bus", "train", {"yaw": (31.2, 43.8)}, 30, 32, 2, 40, 20, 64, 96
    )
    assert region.sentence() == (
        "The bus of bus-0007-left is misclassified, mostly as train, in 94 % [80, 98] of poses with yaw "
        "from 31 to 44 degrees"
    )
    alike = replace(region, fails=16, fails_outside=18)
    assert alike.sentence() == (
        "The bus of bus-0007-left is misclassified, mostly as train; no rule found: in 21 to 43 % of all poses near"
    )


@pytest.mark.parametrize(("after", "code", "grew"), [("keen", 0, False), ("blind", 1, True)])
def test_gate(run, tmp_path, classify, after, code, grew):
    words = ("gate", run, "--network", after, "--samples", "24", "--out", tmp_path / "gate")
    exit_code, data, _ = classify(*words, "--json")
    assert (exit_code, data["passed"]) == (code, not grew)
    assert {row["level"] for row in data["rows"]} == {"hole", "kind", "all"}
    (whole,) = (row for row in data["rows"] if row["level"] == "all")
    assert whole["samples"] == 24
    expected = {"keen": 0.0, "blind": 1.0}
    assert whole["after"] == expected[after]
    assert 0 < whole["before"] < 1
    suite = ET.parse(tmp_path / "gate" / "gate.xml").getroot()
    assert (suite.get("failures") != "0") == grew


def test_a_gate_without_poses_is_not_passed(run, tmp_path, classify):
    for path in run.glob("frames/*/theta.npz"):
        path.unlink()
    words = ("gate", run, "--network", "keen", "--samples", "24", "--keep-going", "--out", tmp_path / "gate")
    code, data, _ = classify(*words, "--json")
    assert (code, data["passed"], data["rows"]) == (1, False, [])
    assert data["frames_failed"]
    suite = ET.parse(tmp_path / "gate" / "gate.xml").getroot()
    assert suite.get("errors") == str(len(data["frames_failed"]))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("explain", "RUN: expected a folder of drivesem classify attack, to explain, found nothing"),
        ("holes {folder}", "RUN: expected a folder of drivesem classify attack, found"),
        ("attack {run}", "RUN: expected none with classify attack"),
        ("confirm {run} --out {folder}", "--out: expected none with classify confirm, which writes to the run"),
        ("holes {run} --samples 5", "--samples: expected at least 24"),
        ("gate {run}", "--network: expected the network that replaces the run's, found nothing"),
    ],
)
def test_bad_settings_are_one_line_and_exit_code_2(run, tmp_path, classify, words, message):
    code, _, printed = classify(*words.format(run=run, folder=tmp_path).split())
    assert code == 2
    assert message in error_line(printed)


def test_a_network_without_gradient_needs_sampling(tmp_path, classify, monkeypatch):
    use_solids(monkeypatch, AreaClassifier)
    monkeypatch.setattr(AreaClassifier, "differentiable", False)
    words = ("attack", "--out", tmp_path / "run", "--limit", "1", "--views", "forward")
    code, _, printed = classify(*words)
    assert code == 2
    assert "--method: expected random or halton: squeezenet has no gradient, found si-fgsm" in printed
    assert classify(*words, "--method", "random", "--queries", "1")[0] == 0
