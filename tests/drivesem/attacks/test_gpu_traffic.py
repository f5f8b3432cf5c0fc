"""What an attack step asks of a GPU, counted on a pretended one: waits, copies, kernels."""

from __future__ import annotations

import torch

from detectors.registry import load_detector
from drivesem.attacks.space import combo_parameters
from drivesem.bench.scenes import build_bench_scene
from drivesem.bench.step import AttackSteps
from tests.pretended_gpu import pretended

MOST = {"waits": 12, "copies": 19, "launches": 28, "operations": 459}
"""Of loss and gradient, reached; each wait empties the GPU's queue."""
MOST_OF_PROJECTION = {"waits": 3, "copies": 3, "launches": 0, "operations": 0}


def test_a_step_hardly_waits_for_the_gpu() -> None:
    scene = build_bench_scene(4, 2000, 0).scene
    with pretended() as traffic:
        step = AttackSteps(scene, combo_parameters(2), load_detector("squeezedet", "cuda"), 0, "cuda")
        step()
        traffic.clear()
        _, gradient = step.objective.loss_and_grad(step.theta)
        found = traffic.totals()
        moved = step.theta + step.space.step * torch.sign(gradient)
        traffic.clear()
        step.feasible.project(moved)
        projection = traffic.totals()
    assert found["launches"] > 20  # it counts
    assert all(found[name] <= most for name, most in MOST.items()), found
    assert all(projection[name] <= most for name, most in MOST_OF_PROJECTION.items()), projection


def test_a_pretended_gpu_counts_by_line() -> None:
    with pretended() as traffic:
        there = torch.ones(3, device="cuda")
        traffic.clear()
        float(there.sum())  # one operation, one copy with a wait
        there[there > 0]  # two operations and a wait for the number of rows
        torch.ones(3).to("cuda", non_blocking=True)  # a copy without a wait
        assert traffic.totals() == {"waits": 2, "copies": 2, "launches": 0, "operations": 3}
