"""Commands with --device cuda, on a GPU that is pretended: nothing is forgotten on the processor, and what they
find is what the processor finds.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from detectors.registry import load_detector
from drivesem.attacks.budgets import parse_budget
from drivesem.attacks.methods.gradient_free import Sampling
from drivesem.attacks.objective import Objective
from drivesem.cli import main
from drivesem.config.commands import AttackConfig
from drivesem.failures.certificate import CompositorRenderer, NuisanceCamera, SampleOutcome
from drivesem.failures.margin_oracle import NuisanceMarginOracle
from drivesem.failures.nuisances import Nuisances
from drivesem.viewer.scene import InteractiveScene
from scene_ir.io import load_scene
from scene_ir.raster import launch
from scene_ir.raster.kernels import unpack_kernel
from scene_ir.types import convert_scene
from tests.pretended_gpu import CPU, GPU, place, pretended

ALL = "color,weather,foliage,translate,rotate,mesh"
ONE_STEP = ["--params", "color,translate", "--steps", "1", "--no-confirm", "--detector"]
ATTACKS = {
    "si-fgsm": ["--params", ALL, "--steps", "2"],
    "climb": ["--combo", "2", "--method", "climb", "--passes", "60"],
    "yolov3-slim": [*ONE_STEP, "yolov3-slim"],
    "ensemble": [*ONE_STEP, "ensemble:squeezedet+yolov3-slim"],
    "planted": [*ONE_STEP, "planted:height_px=20:60@squeezedet"],
}


@pytest.fixture(autouse=True)
def exact() -> Iterator[None]:
    before = torch.backends.cudnn.allow_tf32
    yield
    torch.backends.cudnn.allow_tf32 = before


def run(words: Sequence[str], out: Path, device: str) -> None:
    assert main([*words, "--workers", "1", "--device", device, "--out", str(out)]) == 0


def on_both(words: Sequence[str], folder: Path) -> tuple[Path, Path]:
    run(words, folder / "cpu", "cpu")
    with pretended():
        run(words, folder / "gpu", "cuda")
    return folder / "cpu", folder / "gpu"


def results(out: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted(out.glob("frames/*/result.json"))]


def test_the_pretended_one_refuses_what_a_real_one_does() -> None:
    with pretended():
        there, here = torch.ones(3, device="cuda"), torch.ones(3)
        assert (there * 2).device == GPU
        assert (there + here[0]).is_cuda  # a number may lie anywhere
        assert there.new_tensor([1.0]).is_cuda
        assert there[here > 0].is_cuda
        assert there.cpu().device == CPU
        for mixed in (lambda: there + here, lambda: here[there > 0], lambda: torch.cat([there, here])):
            with pytest.raises(RuntimeError, match="cuda"):
                mixed()
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()
        with pytest.raises(RuntimeError, match="array lies on"):
            launch.launch(unpack_kernel, [0, 3], [launch.array(here)] * 3, GPU)


def test_gradients_come_back_to_where_their_tensors_lie() -> None:
    leaf = torch.ones(3, requires_grad=True)
    with pretended():
        first, second = (leaf.to("cuda") * 2).split([1, 2])
        assert first.is_cuda
        (gradient,) = torch.autograd.grad(second.sum(), leaf)
        assert gradient.device == CPU
        assert place(second) == GPU
    assert gradient.tolist() == [0, 2, 2]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "climb" else []) for name in ATTACKS]
)
def test_an_attack_finds_what_it_finds_on_the_processor(name: str, tmp_path: Path) -> None:
    here, there = (results(out)[0] for out in on_both(["attack", *ATTACKS[name], "--limit", "1"], tmp_path))
    first, second = ([c["value"] for c in one["theta"]] for one in (here, there))
    np.testing.assert_allclose(second, first, atol=1e-4)
    np.testing.assert_allclose(there["loss_trace"], here["loss_trace"], rtol=1e-3)
    for name in ("queries", "success_moved", "success_paper", "violations"):
        assert here[name] == there[name]
    scores = [[found["score"] for found in one["detections_attacked"]] for one in (here, there)]
    np.testing.assert_allclose(scores[1], scores[0], atol=1e-3)


def test_a_classifier_is_attacked_as_on_the_processor(tmp_path: Path) -> None:
    here, there = on_both(["classify", "attack", "--limit", "2"], tmp_path)
    for mine, other in zip(results(here), results(there), strict=True):
        assert (mine["label"], mine["grade"], mine["queries"]) == (
            other["label"],
            other["grade"],
            other["queries"],
        )
        np.testing.assert_allclose(other["loss_trace"], mine["loss_trace"], rtol=1e-3)


@pytest.mark.parametrize("layers", ["all", pytest.param("last", marks=pytest.mark.slow)])
def test_a_classifier_learns_what_it_learns_on_the_processor(layers: str, tmp_path: Path) -> None:
    words = ["classify", "train", "--layers", layers, "--limit", "12", "--views", "forward", "--batch", "6"]
    here, there = on_both([*words, "--epochs", "1", "--json"], tmp_path)
    trainings = [json.loads((out / "training.json").read_text()) for out in (here, there)]
    for one, other in zip(trainings[0]["epochs"], trainings[1]["epochs"], strict=True):
        assert other == pytest.approx(one, abs=2e-3)
    assert trainings[0]["accuracy"] == pytest.approx(trainings[1]["accuracy"], abs=0.1)


def test_a_gpu_convolves_in_float32() -> None:
    torch.backends.cudnn.allow_tf32 = True
    with pretended():
        load_detector("squeezedet", "cuda")
    assert not torch.backends.cudnn.allow_tf32


def test_a_scene_is_rendered(tmp_path: Path) -> None:
    run(["attack", "--combo", "1", "--steps", "1", "--no-grade", "--limit", "1"], tmp_path / "run", "cpu")
    (scene,) = (tmp_path / "run").glob("frames/*/scene")
    with pretended():
        stage = InteractiveScene(scene, load_detector("squeezedet", "cuda"), parse_budget("street"), None)
        drawn = stage.render_state({})
        assert all((stage.encode_picture(drawn), stage.encode_photograph(), stage.encode_street()))
        assert stage.detect({}, drawn)["cars"]
        assert 0 < stage.score({}, 0, drawn)["score"] <= 1


def test_samples_of_a_state_are_detected_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(["attack", "--combo", "1", "--steps", "1", "--no-grade", "--limit", "1"], tmp_path / "run", "cpu")
    (folder,) = (tmp_path / "run").glob("frames/*/scene")

    def outcomes(device: str) -> tuple[list[SampleOutcome], list[int]]:
        detector, sizes = load_detector("squeezedet", device), list[int]()
        state = convert_scene(load_scene(folder), None, device)
        objective = Objective.from_config(state, detector, AttackConfig())
        forward = detector.forward
        monkeypatch.setattr(detector, "forward", lambda images: (sizes.append(len(images)), forward(images))[1])
        renderer = CompositorRenderer(objective.compositor, objective.labeller)
        camera = NuisanceCamera(renderer, detector, objective.t_star, Nuisances(), "test")
        found = camera.evaluate_all(state, range(3), torch.zeros(len(state.objects), dtype=torch.bool))
        return found, sizes

    here, one_by_one = outcomes("cpu")
    with pretended():
        there, together = outcomes("cuda")
    assert one_by_one == [1, 1, 1]
    assert together == [3]
    for mine, other in zip(here, there, strict=True):
        found, expected = (one.labelled.detections for one in (other, mine))
        np.testing.assert_allclose(np.asarray(found.scores.tolist()), expected.scores, atol=1e-3)
        assert other.outcome.detected.tolist() == mine.outcome.detected.tolist()


def test_a_population_is_scored_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(["attack", "--combo", "1", "--steps", "1", "--no-grade", "--limit", "1"], tmp_path / "run", "cpu")
    (folder,) = (tmp_path / "run").glob("frames/*/scene")

    def scores(device: str) -> tuple[list[tuple[float, ...]], list[int], int]:
        detector, sizes = load_detector("squeezedet", device), list[int]()
        state = convert_scene(load_scene(folder), None, device)
        objective = Objective.from_config(state, detector, AttackConfig(combo=1))
        problem = objective.problem(objective.feasible_set())
        forward = detector.forward
        monkeypatch.setattr(detector, "forward", lambda images: (sizes.append(len(images)), forward(images))[1])
        result = Sampling(queries=5, kind="halton")(problem, objective.space.theta0)
        return [result.loss_trace, tuple(result.theta.tolist())], sizes, objective.passes

    (here, theta), _, passes = scores("cpu")
    with pretended():
        (there, on_gpu), sizes, passes_on_gpu = scores("cuda")
    assert sizes[0] == 5
    assert passes_on_gpu == passes == 6  # and the benign one
    assert there == pytest.approx(here, abs=1e-3)
    assert on_gpu == pytest.approx(theta, abs=1e-6)


def test_margins_of_several_points_are_found_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(["attack", "--combo", "1", "--steps", "1", "--no-grade", "--limit", "1"], tmp_path / "run", "cpu")
    (folder,) = (tmp_path / "run").glob("frames/*/scene")

    def margins(device: str) -> tuple[torch.Tensor, list[int]]:
        detector, sizes = load_detector("squeezedet", device), list[int]()
        objective = Objective.from_config(
            convert_scene(load_scene(folder), None, device), detector, AttackConfig(combo=1, whole=True)
        )
        oracle = NuisanceMarginOracle.for_objective(objective, Nuisances(), "test")
        detect, passes = detector.forward_for_search, objective.passes
        monkeypatch.setattr(
            detector, "forward_for_search", lambda images: (sizes.append(len(images)), detect(images))[1]
        )
        upper = objective.space.upper
        found = oracle.margins([0.5 * upper, -0.5 * upper, 0 * upper], [3, 4, 3])
        assert objective.passes == passes + 3
        assert len(objective.search_log.margin_rows()) >= 3
        assert sum(visit.passes for visit in objective.cell_visits(objective.benign)) >= 3
        return found.cpu(), sizes

    here, one_by_one = margins("cpu")
    with pretended():
        there, together = margins("cuda")
    assert one_by_one == [1, 1, 1]
    assert together == [3]
    assert bool(torch.isfinite(here).any(1).all())
    torch.testing.assert_close(there, here, atol=1e-3, rtol=1e-3)


@pytest.mark.slow
def test_a_clip(tmp_path: Path) -> None:
    here, there = on_both(["drive", "--limit", "3", "--steps", "2"], tmp_path)
    first, second = (json.loads((out / "drive.json").read_text()) for out in (here, there))
    assert first["tracks"] == second["tracks"]
    np.testing.assert_allclose(second["loss_trace"], first["loss_trace"], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_questions_on_a_run(tmp_path: Path) -> None:
    """A certain failure looked around, explained, drawn again and shown to another detector."""
    found = tmp_path / "found"
    words = [
        "attack",
        "--params",
        ALL,
        "--method",
        "corners",
        "--passes",
        "40",
        "--budget",
        "street",
        "--limit",
        "1",
        "--seed",
        "3",
    ]
    with pretended():
        run(words, found, "cuda")
        assert results(found)[0]["failures"]
        for question in ("explain", "confirm", "holes"):
            run([question, str(found)], tmp_path / question, "cuda")
        run(["gate", str(found), "--before", "squeezedet", "--after", "squeezedet"], tmp_path / "gate", "cuda")
        run(["transfer", str(found), "--detectors", "squeezedet"], tmp_path / "transfer", "cuda")
