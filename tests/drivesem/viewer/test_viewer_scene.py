"""What a state looks like, what is found in it, and the street from above."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from detectors.registry import load_detector
from detectors.types import Detections, Targets
from drivesem.attacks.budgets import PRESETS, STREET, change_limits
from drivesem.attacks.feasibility_check import check_places
from drivesem.attacks.objective import Objective, RenderEvaluation
from drivesem.viewer.scene import InteractiveScene, best_score
from scene_ir.io import load_scene, to_uint8
from scene_ir.types import Render, SceneIR
from tests.drivesem.viewer.conftest import SCORE, Stubborn


@pytest.fixture(scope="module")
def stage(still: Path, stubborn: Stubborn) -> InteractiveScene:
    return InteractiveScene(still, stubborn, PRESETS["street"], None)


def pixels(encoded: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)


def judged(stage: InteractiveScene) -> int:
    """A vehicle that is found as photographed, and may go a metre."""
    cars = stage.facts()["cars"]
    reach = {slider.car: slider.high for slider in stage.sliders.sliders.values() if slider.name.endswith("along")}
    return next(car["car"] for car in cars if car["status"] == "found" and reach.get(car["car"], 0) >= 1)


def test_at_rest_it_is_the_photograph(stage: InteractiveScene) -> None:
    drawn = stage.render_state({})
    assert (to_uint8(drawn.render.image) == to_uint8(stage.sliders.rest.photograph)).all()
    picture = pixels(stage.encode_picture(drawn))[..., ::-1]
    assert picture.shape == (stage.sliders.rest.camera.height, stage.sliders.rest.camera.width, 3)
    assert cv2.PSNR(picture, to_uint8(stage.sliders.rest.photograph)) > 35
    assert (pixels(stage.encode_photograph())[..., ::-1] == picture).all()


def test_few_rendered_states_are_cached(stage: InteractiveScene) -> None:
    first = stage.render_state({"weather.fog": 0.5})
    assert stage.render_state({"weather.fog": 0.5}) is first
    assert stage.render_state({"weather.fog": 0.4}, keep=False) is not stage.render_state(
        {"weather.fog": 0.4}, keep=False
    )
    for i in range(4):
        stage.render_state({"weather.rain": 0.1 * (i + 1)})
    assert stage.render_state({"weather.fog": 0.5}) is not first


def test_a_vehicle_beyond_the_match_distance_is_lost(stage: InteractiveScene) -> None:
    car = judged(stage)
    state = stage.sliders.state({f"objects[{car}].translate.along": 1.0, f"objects[{car}].yaw": 20.0})
    still, after = stage.detect({}, stage.render_state({})), stage.detect(state, stage.render_state(state))
    assert (still["lost"], still["phantoms"], still["words"]) == (0, 0, "nothing lost, no phantom")
    assert still["cars"][car] == {"status": "found", "score": pytest.approx(SCORE)}
    boxes = {mark["car"]: mark for mark in still["boxes"] if mark["car"] is not None}
    assert boxes[car]["xyxy"] == stage.sliders.rest.objects.box2d[car].tolist()
    assert sum(mark["kind"] == "found" for mark in still["boxes"]) == len(stage.sliders.rest.objects)
    moved = {mark["car"]: mark for mark in after["boxes"] if mark["car"] is not None}
    assert moved[car]["xyxy"] != boxes[car]["xyxy"], "labels move"
    overlap = best_score(*_one(moved[car]["xyxy"], boxes[car]["xyxy"]), 0)
    lost = overlap == 0
    assert (after["cars"][car]["status"] == "lost") == lost == bool(after["lost"])
    assert f"--set 'objects[{car}].translate=1m,0m'" in after["command"]


def _one(truth: list[float], found: list[float]) -> tuple[Targets, Detections]:
    label = torch.tensor([0])
    targets = Targets(torch.tensor([truth]), label, torch.tensor([False]))
    return targets, Detections(torch.tensor([found]), label, torch.tensor([SCORE]))


def test_far_away_it_is_lost_for_certain(still: Path) -> None:
    scene = load_scene(still)
    detector = Stubborn(scene)
    stage = InteractiveScene(still, detector, PRESETS["street"], None)
    car = judged(stage)
    # a detector that looks a box's width beside what is there, once the scene moves
    detector.found = Detections(
        detector.found.boxes_xyxy + torch.tensor([400.0, 0.0, 400.0, 0.0]),
        detector.found.labels,
        detector.found.scores,
    )
    state = {"weather.fog": 0.1}
    seen = stage.detect(state, stage.render_state(state))
    assert seen["cars"][car]["status"] == "lost"
    assert next(mark["kind"] for mark in seen["boxes"] if mark["car"] == car) == "lost"
    assert seen["lost"] >= 1
    assert seen["words"].startswith(f"{seen['lost']} object")
    assert stage.known_score(state, car) is None
    result = stage.score(state, car, stage.render_state(state))
    assert result == seen["cars"][car] == stage.known_score(state, car)


def test_only_changed_regions_are_detected_again(still: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = InteractiveScene(still, load_detector("squeezedet"), PRESETS["street"], None)
    car = judged(stage)
    drawn = stage.render_state({f"objects[{car}].translate.along": 0.5})
    objective, seen = stage.objective, []
    everywhere = objective.evaluate_render(drawn.scene, drawn.render)

    def evaluate(scene: SceneIR, render: Render) -> RenderEvaluation:
        seen.append(render.vehicle_regions)
        return Objective.evaluate_render(objective, scene, render)

    monkeypatch.setattr(objective, "evaluate_render", evaluate)
    result = stage.detect({f"objects[{car}].translate.along": 0.5}, drawn)
    assert drawn.render.vehicle_regions is not None
    assert 0 < len(seen[0]) < len(drawn.render.vehicle_regions)
    first = everywhere.detections
    marks = [mark for mark in result["boxes"] if mark["kind"] in ("found", "phantom")]
    above = first.scores >= objective.t_star
    boxes = torch.tensor([mark["xyxy"] for mark in marks])
    torch.testing.assert_close(boxes, first.boxes_xyxy[above], atol=0.01, rtol=0)
    fog = stage.render_state({"weather.fog": 0.5})
    stage.detect({"weather.fog": 0.5}, fog)
    assert seen[1] is None, "fog is everywhere"


def test_best_score_is_of_what_meets_the_target() -> None:
    targets = Targets(torch.tensor([[0.0, 0.0, 10.0, 10.0]]), torch.tensor([0]), torch.tensor([False]))
    found = Detections(
        torch.tensor(
            [[0.0, 0.0, 10.0, 9.0], [0.0, 0.0, 10.0, 10.0], [6.0, 0.0, 16.0, 10.0], [0.0, 0.0, 10.0, 8.0]]
        ),
        torch.tensor([0, 1, 0, 0]),
        torch.tensor([0.5, 0.9, 0.8, 0.6]),
    )
    assert best_score(targets, found, 0) == pytest.approx(0.6)
    nothing = Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))
    assert best_score(targets, nothing, 0) == 0


def test_infeasible_states_have_notes(stage: InteractiveScene) -> None:
    assert stage.notes(stage.render_state({})) == []
    sliders_of_position = [k for k in stage.sliders.sliders.values() if k.name.endswith(("along", "across"))]
    for state in ({k.name: k.high for k in sliders_of_position}, {k.name: k.low for k in sliders_of_position}):
        drawn = stage.render_state(state)
        rows = range(len(stage.sliders.rest.objects))
        limits = change_limits(PRESETS[STREET])
        assert stage.notes(drawn) == check_places(stage.sliders.rest, drawn.scene, rows, limits)


def test_the_street_is_as_wide_as_its_vehicles(stage: InteractiveScene) -> None:
    x0, x1, z0, z1 = stage.street_m()
    for car in stage.facts()["cars"]:
        assert x0 < car["x"] < x1
        assert z0 < car["z"] < z1
    rgba = pixels(stage.encode_street())
    assert rgba.shape[2] == 4
    assert rgba.shape[1] / rgba.shape[0] == pytest.approx((x1 - x0) / (z1 - z0), rel=0.01)
    assert 0 < (rgba[..., 3] > 0).mean() < 1
    # straight ahead, ten metres off, the ground has the colour of its pixel in the background
    rest, z = stage.sliders.rest, 10.0
    ground = rest.environment.ground.tolist()
    point = torch.tensor([0.0, -(ground[2] * z + ground[3]) / ground[1], z, 1.0])
    u, v, w = (rest.camera.matrix.float() @ point).tolist()
    there = to_uint8(rest.background)[round(v / w), round(u / w)].astype(int)
    here = rgba[round((z1 - z) / (z1 - z0) * rgba.shape[0]), round(-x0 / (x1 - x0) * rgba.shape[1])]
    assert np.abs(here[2::-1].astype(int) - there).max() < 40


def test_the_vehicle_to_begin_with(stage: InteractiveScene, changed: Path, stubborn: Stubborn) -> None:
    cars = stage.facts()["cars"]
    found = [car for car in cars if car["status"] == "found"]
    assert stage.focus == min(found, key=lambda car: car["z"])["car"]
    other = InteractiveScene(changed, stubborn, PRESETS["street"], None)
    assert other.facts()["found"] == other.sliders.found != {}
    state = other.sliders.found
    lost = [
        i
        for i, car in enumerate(other.detect(state, other.render_state(state))["cars"])
        if car["status"] == "lost"
    ]
    assert not lost or other.focus in lost
