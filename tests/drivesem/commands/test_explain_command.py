"""`drivesem explain` on a small run of `drivesem attack`, before detectors that cost next to nothing."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from detectors.base import Detector
from detectors.types import CLASSES, Detections
from drivesem.analysis.explain import run as explaining
from drivesem.analysis.explain.attribution import SCHEMA, Explanation
from drivesem.attacks.feasibility_check import check_scene
from drivesem.attacks.methods.gradient_free import FixedTheta
from drivesem.attacks.space import ParameterSpace, parse_params
from drivesem.cli import main
from drivesem.config.commands import AttackConfig
from drivesem.run import attack as run_attack
from drivesem.run import folder as run_folder
from drivesem.run.attack import AttackWorker
from drivesem.run.finished import rebuild_objective
from drivesem.run.frame import write_frame
from drivesem.run.records import load_record
from drivesem.run.results import load_frame
from scene_ir.exchange import remove_vehicle
from scene_ir.io import load_scene
from scene_ir.render.compositor import Compositor
from scene_ir.render.sources import solve_sources
from scene_ir.types import SceneIR
from tests.drivesem.invoke import invoke, run_json

EXPLAIN = ["explain", "--workers", "1", "--points", "4"]
T_STAR = 0.5
GAIN = 2e3
"""Of brightness into score: moved by a few steps, the cars brighten one side of the picture enough to fail."""


def explain(*words: object) -> Any:
    return run_json(*EXPLAIN, *words)


class Raw:
    """Logits (B, 1)."""

    def __init__(self, logits: torch.Tensor) -> None:
        self.logits = logits

    def __len__(self) -> int:
        return len(self.logits)

    def select(self, index: int) -> Raw:
        return Raw(self.logits[index : index + 1])


class Jumpy(Detector):
    """Sees the second car, and one in the sky that is the surer the brighter the left of a picture is than that of its
    first one.
    """

    name, classes, t_star = "jumpy", CLASSES, T_STAR
    car_xyxy: tuple[float, ...]
    """The second car's box, px."""

    def __init__(self) -> None:
        super().__init__()
        self.first: torch.Tensor | None = None

    def forward(self, images: torch.Tensor) -> Raw:
        ramp = torch.linspace(1, -1, images.shape[-1])
        sums = (images * ramp).mean(dim=(1, 2, 3))
        self.first = sums.detach()[:1] if self.first is None else self.first
        return Raw(GAIN * (sums - self.first)[:, None] - 1.2)

    def loss(self, raw: Raw, targets: Any) -> dict[str, torch.Tensor]:
        return {"objectness": raw.logits.mean()}

    def decode(self, raw: Raw) -> list[Detections]:
        boxes = torch.tensor([[2.0, 2.0, 62.0, 42.0], self.car_xyxy])
        scores = [torch.cat([logit.sigmoid(), torch.tensor([0.9])]) for logit in raw.logits]
        return [Detections(boxes, torch.zeros(2, dtype=torch.int64), both) for both in scores]


def _nothing() -> Detections:
    return Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))


class Nameless:
    """The same without gradient."""

    name, classes = "nameless", CLASSES

    def __init__(self) -> None:
        self.inner = Jumpy()

    def forward(self, images: torch.Tensor) -> Any:
        return self.inner(images)

    def decode(self, raw: Any) -> list[Detections]:
        return self.inner.decode(raw)


@pytest.fixture(scope="module")
def scene(street: Callable[..., SceneIR]) -> SceneIR:
    """Two cars on a small grey street, photographed and taken apart."""
    bare = street(positions_xz=((-2.5, 9.0), (2.5, 12.0)))
    shot = Compositor(bare).render(bare)
    Jumpy.car_xyxy = tuple(bare.objects.box2d[1].tolist())
    return solve_sources(replace(bare, photograph=(shot.image * 255).round() / 255), shot.opacity)


@pytest.fixture(autouse=True)
def jumpy(monkeypatch: pytest.MonkeyPatch, scene: SceneIR) -> None:
    _patch(monkeypatch, scene)


def _patch(patch: pytest.MonkeyPatch, scene: SceneIR) -> None:
    patch.setattr("drivesem.synth.demo.demo_scene", lambda *_: scene)
    for module in (run_attack, run_folder):
        patch.setattr(module, "load_predictor", lambda *_: Jumpy())


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory, scene: SceneIR) -> Path:
    """A run of one frame that fails."""
    out = tmp_path_factory.mktemp("runs") / "source"
    words = ["attack", "--params", "translate,rotate", "--steps", "3", "--limit", "1", "--workers", "1", "--json"]
    with pytest.MonkeyPatch.context() as patch:
        _patch(patch, scene)
        assert main([*words, "--out", str(out)]) == 0
    assert load_frame(out / "frames" / "demo-000" / "result.json").success_moved
    return out


@pytest.fixture(scope="module")
def explained(attacked: Path, tmp_path_factory: pytest.TempPathFactory, scene: SceneIR) -> Path:
    """That run with its explanation."""
    run = Path(shutil.copytree(attacked, tmp_path_factory.mktemp("explained") / "source"))
    with pytest.MonkeyPatch.context() as patch:
        _patch(patch, scene)
        run_json(*EXPLAIN, "--run", run, "--bootstrap", "5")
    return run


@pytest.fixture
def run(attacked: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(attacked, tmp_path / "source"))


def test_a_frame_explained(explained: Path) -> None:
    out = explained / "explain"
    data = json.loads((out / "explain.json").read_text())
    assert (data["frames"], data["frames_of_run"], data["frames_failed"]) == (1, 1, {})
    folder = out / "frames" / "demo-000"
    found = load_record(folder / "explain.json", Explanation, SCHEMA)
    result = load_frame(explained / "frames" / "demo-000" / "result.json")
    # what adds up: the loss, from the photograph's to the counterexample's, and failing, from no to yes
    assert found.found.loss == pytest.approx(result.loss_trace[-1], rel=1e-4)
    for kind in ("parameter", "object"):
        team = found.of_kind(kind)
        assert sum(c.loss for c in team) == pytest.approx(found.found.loss - found.benign.loss, abs=1e-9)
        assert sum(c.fails[0] for c in team) == pytest.approx(1, abs=1e-9)
        assert sum(c.gradient_share or 0 for c in team) == pytest.approx(1, abs=1e-5)
    assert [c.name for c in found.of_kind("parameter")] == ["translate", "rotate"]
    alone, without = (getattr(found.of_kind("parameter")[0], name) for name in ("alone", "without"))
    assert alone == found.of_kind("parameter")[1].without
    assert without == found.of_kind("parameter")[1].alone
    # brightness hardly bends on so short a way: the gradient foresees what each adds
    for one in found.contributions:
        assert one.gradient == pytest.approx(one.loss, rel=0.5, abs=0.2)
    for picture in found.sensitivity.values():
        assert sum(picture.objects) + picture.background == pytest.approx(1)


def test_the_least_change_keeps_the_graded_failure_and_is_feasible(explained: Path) -> None:
    folder = explained / "explain" / "frames" / "demo-000"
    (one,) = load_record(folder / "explain.json", Explanation, SCHEMA).failures
    (graded,) = load_frame(explained / "frames" / "demo-000" / "result.json").failures
    assert one.failure == graded
    least = one.least
    assert least is not None
    assert least.outcome.occurs == (True,)
    assert not least.violations
    assert 0 < least.norm <= least.norm_whole <= least.norm_found
    assert len(least.scan) == 5
    assert (least.scan[0], least.scan[-1]) == (False, True)
    assert [f.kind for f in least.failures] == ["phantom"]
    assert least.holds is (least.draws >= 3)
    assert least.of == 4
    (row,) = json.loads((explained / "explain" / "explain.json").read_text())["rows"]
    assert (row["frame"], row["object"], row["grade"]) == ("demo-000", None, graded.grade)
    assert {name: row["least"][name] for name in ("holds", "draws", "of")} == {
        "holds": least.holds,
        "draws": least.draws,
        "of": 4,
    }
    # judged anew from what was written
    frame = explained / "frames" / "demo-000"
    result, attack = load_frame(frame / "result.json"), run_folder.load_attack_config(explained)
    objective, theta = rebuild_objective(result, frame, attack, ("translate", "rotate"), Jumpy())
    names = [objective.space.name(i) for i in range(objective.space.dim)]
    small = torch.zeros_like(theta)
    for coordinate in least.theta:
        small[names.index(coordinate.name)] = coordinate.value
    assert objective.score(small).success
    rendered = objective.evaluate(small)
    assert check_scene(load_scene(frame / "scene").as_photographed(), rendered.scene) == []
    written = cv2.cvtColor(cv2.imread(str(folder / "minimal_1.png")), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(written, explaining.to_uint8(rendered.render.image))


def test_files(explained: Path) -> None:
    out = explained / "explain"
    data = json.loads((out / "explain.json").read_text())
    rows = list(csv.DictReader((out / "explain.csv").read_text().splitlines()))
    assert [row["name"] for row in rows[:2]] == ["translate", "rotate"]
    assert float(rows[0]["loss"]) == pytest.approx(data["parameters"][0]["loss"])
    assert rows[0]["unit"] == "m"
    assert rows[1]["unit"] == "deg"
    page = (out / "explain.md").read_text()
    assert "| whole change |" in page
    names = ("shapley", "sensitivity", "minimal_1_overlay")
    for picture in ("explain.png", *(f"frames/demo-000/{name}.png" for name in names)):
        assert min(cv2.imread(str(out / picture)).shape[:2]) > 150
        assert f"({picture})" in page


def test_a_second_call_explains_no_frame_again(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = explain("--run", run)
    assert json.loads((run / "explain" / "explain.json").read_text()) == first
    explained_frames: list[str] = []
    real = explaining.ExplainAnalyser.analyse
    monkeypatch.setattr(explaining.ExplainAnalyser, "analyse", lambda *w: explained_frames.append("") or real(*w))
    assert explain("--run", run) == first
    assert not explained_frames
    result = run / "frames" / "demo-000" / "result.json"
    result.write_text(result.read_text() + "\n")  # made anew
    again = explain("--run", run)
    assert len(explained_frames) == 1
    assert again == first
    assert main(["explain", "--run", str(run), "--workers", "1", "--points", "5"]) == 2


def test_without_gradient(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "load_predictor", lambda *_: Nameless())
    data = explain("--run", run, "--out", run / "other")
    assert data["parameters"][0]["gradient_share"] is None
    folder = run / "other" / "frames" / "demo-000"
    found = load_record(folder / "explain.json", Explanation, SCHEMA)
    assert found.sensitivity == {}
    assert {c.gradient for c in found.contributions} == {None}
    assert not (folder / "sensitivity.png").exists()
    assert (folder / "minimal_1.png").is_file()


def exchanged(run: Path, name: str, share: float, scene: SceneIR) -> None:
    """A further frame of the run, whose first car is gone, which makes it fail. share: of the step that its second
    car goes as well.
    """
    scene, params = remove_vehicle(scene, 0), parse_params("translate,rotate")
    space = ParameterSpace(scene, params)
    theta = share * space.step * (torch.arange(space.dim) >= space.dim - 1)
    config = AttackConfig(params="translate,rotate", grade=False, seed=0)
    worker = replace(AttackWorker.from_config(config, Jumpy()), method=FixedTheta(theta))
    result = write_frame(worker.attack_scene(name, scene), run / "frames" / name)
    assert result.success_moved
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["frames"][name] = {}
    (run / "manifest.json").write_text(json.dumps(manifest))


def test_frames_that_fail_by_the_exchange_alone_are_left_out(run: Path, scene: SceneIR) -> None:
    alone = explain("--run", run, "--out", run / "alone")
    exchanged(run, "demo-001", 0.0, scene)
    exchanged(run, "demo-002", 0.1, scene)
    data = explain("--run", run)
    assert data["frames_by_exchange"] == ["demo-001", "demo-002"]
    assert (data["frames"], data["frames_failed"]) == (1, {})
    assert data["rows"] == alone["rows"]
    page = (run / "explain" / "explain.md").read_text()
    assert "Left out: frames that fail by the exchange of objects alone: demo-001, demo-002." in page
    for name, theta in (("demo-001", 0), ("demo-002", 1)):
        found = load_record(run / "explain" / "frames" / name / "explain.json", Explanation, SCHEMA)
        assert all(found.benign.occurs)
        assert len(found.sizes) == theta
        assert found.contributions == ()
        assert {one.least for one in found.failures} == {None}
        assert "exchange" in found.failures[0].reason
    error_line = " ".join(
        invoke(
            "explain", "--run", run, "--workers", "1", "--frame", "demo-001", "--points", "4", code=2
        ).err.split()
    )
    assert error_line.endswith("found frames that fail by the exchange of objects alone: demo-001")


def test_bad_input(run: Path, tmp_path: Path) -> None:
    def refused(*words: object) -> str:
        return " ".join(invoke("explain", "--workers", "1", *words, code=2).err.split())

    assert "--run: expected a folder of drivesem attack" in refused("--run", tmp_path / "none")
    assert "--points: expected at least 1" in refused("--run", run, "--points", "0")
    assert "--permutations: expected an even number" in refused("--run", run, "--permutations", "3")
    assert "--bootstrap: expected at least 0" in refused("--run", run, "--bootstrap", "-1")
    assert "--frame: expected a frame of" in refused("--run", run, "--frame", "demo-077")
    assert not (run / "explain").exists()
    shutil.move(run / "frames" / "demo-000" / "scene", tmp_path / "scene")
    assert "scene: expected a folder with a scene" in refused("--run", run)
    left_out = refused("--run", run, "--keep-going")
    assert "a run with frames that can be explained" in left_out
    shutil.move(tmp_path / "scene", run / "frames" / "demo-000" / "scene")
    path = run / "frames" / "demo-000" / "result.json"
    result = json.loads(path.read_text())
    path.write_text(json.dumps(result | {"success_moved": False}))
    assert "--run: expected a run with counterexamples, by moved labels, found none in 1 frame" in refused(
        "--run", run
    )
    assert "found demo-000, which does not" in refused("--run", run, "--frame", "demo-000")


def test_a_counterexample_that_does_not_fail_here_is_named(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calm = Jumpy()
    monkeypatch.setattr(calm, "decode", lambda raw: [_nothing()] * len(raw))
    monkeypatch.setattr(run_folder, "load_predictor", lambda *_: calm)
    error = " ".join(invoke("explain", "--run", run, "--workers", "1", code=2).err.split())
    assert "demo-000: expected a counterexample that fails, found one that the detector gets right here" in error
