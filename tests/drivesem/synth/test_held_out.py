"""What detectors are judged by shares nothing with the frames that the shipped ones were trained on: the embedded
scenes, and the held-out frames of the model cards."""

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
def test_demo_scenes_are_held_out(index: int) -> None:
    trained_on = json.loads((WEIGHTS / "squeezedet_data.json").read_text())
    provenance = demo_scene(0, index).provenance
    assert int(provenance["seed"]) not in trained_on["seed"] or provenance["split"] not in trained_on["split"]
    for kind in SHAPES:
        shapes = set(ast.literal_eval(provenance[kind]))
        assert trained_on[kind], f"the training frames name no {kind}"
        assert not shapes & set(trained_on[kind]), kind


def test_the_cards_held_out_frames_are_held_out() -> None:
    trained_on = json.loads((WEIGHTS / "squeezedet_data.json").read_text())
    judged_by = json.loads((WEIGHTS / "heldout_data.json").read_text())
    assert judged_by["frames"] >= 500
    for kind in ("split", "seed", *SHAPES):
        assert trained_on[kind], f"the training frames name no {kind}"
        assert judged_by[kind], f"the held-out frames name no {kind}"
        assert not set(map(str, judged_by[kind])) & set(map(str, trained_on[kind])), kind
