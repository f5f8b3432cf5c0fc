"""On a GPU, where there is one: kernels load, and a step and an attack equal the processor's."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

from detectors.registry import load_detector
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import ParameterSpace, combo_parameters
from drivesem.bench.scenes import build_bench_scene
from drivesem.cli import main
from scene_ir.raster.launch import start_warp
from scene_ir.render.compositor import Compositor
from scene_ir.types import convert_scene
from tools.gpu_checks import kernel_modules

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


@pytest.mark.parametrize("name", kernel_modules())
def test_a_kernel_module_loads(name: str) -> None:
    start_warp()
    __import__(name)
    assert wp.get_module(name).load("cuda:0") is not None


@pytest.mark.parametrize("cars", [1, 4])
def test_loss_and_gradient_equal_the_processors(cars: int) -> None:
    losses, gradients = [], []
    for device in ("cpu", "cuda"):
        scene = convert_scene(build_bench_scene(cars, 2000, 0).scene, torch.float32, device)
        space = ParameterSpace(scene, combo_parameters(2))
        objective = Objective(Compositor(scene), space, load_detector("squeezedet", device))
        noise = torch.rand(space.dim, generator=torch.Generator().manual_seed(3)).to(space.step)
        loss, gradient = objective.loss_and_grad(3 * space.step * (2 * noise - 1))
        losses.append(loss)
        gradients.append(gradient.cpu().double())
    assert losses[1] == pytest.approx(losses[0], rel=1e-3)
    assert float(torch.cosine_similarity(*gradients, dim=0)) > 0.999


def test_an_attack_equals_the_processors(tmp_path: Path) -> None:
    found = []
    for device in ("cpu", "cuda"):
        words = ["attack", "--combo", "2", "--limit", "1", "--steps", "2", "--workers", "1", "--device", device]
        assert main([*words, "--out", str(tmp_path / device)]) == 0
        (path,) = (tmp_path / device).glob("frames/*/result.json")
        found.append(json.loads(path.read_text()))
    # a sign of a derivative near 0 may differ, which one step turns into 0.1 % of the loss
    np.testing.assert_allclose(found[1]["loss_trace"], found[0]["loss_trace"], rtol=5e-3)
    assert found[0]["success_moved"] == found[1]["success_moved"]
