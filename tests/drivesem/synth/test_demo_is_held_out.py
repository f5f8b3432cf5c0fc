"""The embedded scenes share nothing with the frames that the shipped detector was trained on."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

from drivesem.synth.demo import demo_scene

WEIGHTS = Path(__file__).parents[3] / "detectors" / "weights"
SHAPES = ("vehicles", "building", "tree", "bush", "surface")


@pytest.mark.parametrize(
    "index",
    [0, 1, *(pytest.param(i, marks=pytest.mark.slow) for i in range(2, 10))],
    ids=lambda i: f"demo-{i:03d}",
)
def test_manifests_are_disjoint(index: int) -> None:
    trained_on = json.loads((WEIGHTS / "squeezedet_data.json").read_text())
    provenance = demo_scene(0, index).provenance
    assert int(provenance["seed"]) not in trained_on["seed"] or provenance["split"] not in trained_on["split"]
    for kind in SHAPES:
        shown = set(ast.literal_eval(provenance[kind]))
        assert trained_on[kind], f"the training frames name no {kind}"
        assert not shown & set(trained_on[kind]), kind
