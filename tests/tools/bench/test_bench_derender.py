"""The benchmark of de-rendering: planted scenes get the marks they deserve, labels are off by what they should."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from drivesem.synth.frames import SynthFrame
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR
from tools.bench import derender as bench
from tools.bench.__main__ import main
from tools.bench.derender import DerenderRow, EditAccuracy, EditedStreet, SilhouetteOverlap


@pytest.fixture(scope="module")
def case() -> EditedStreet:
    return bench.make_case(0, 0)


@pytest.fixture(scope="module")
def tracks(case: EditedStreet) -> list[int]:
    return [t.actor.track for t in case.before.truths if t.labelled and t.actor.label in bench.VEHICLE_CATEGORIES]


@pytest.fixture(scope="module")
def empty(case: EditedStreet, tracks: list[int]) -> SynthFrame:
    return bench.without(case, tracks)


@pytest.fixture(scope="module")
def perfect(case: EditedStreet, tracks: list[int], empty: SynthFrame) -> SceneIR:
    return bench.perfect_scene(case.before, empty, tracks)


def _displaced(scene: SceneIR, metres: float) -> SceneIR:
    """As if its vehicles had been fitted so far to the side."""
    shift = torch.tensor([metres, 0.0, 0.0])
    sources = tuple(replace(s, translation=s.translation + shift) for s in scene.objects.source)
    return replace(
        scene, objects=replace(scene.objects, translation=scene.objects.translation + shift, source=sources)
    )


def test_a_case_has_a_vehicle_that_moves(case: EditedStreet) -> None:
    move = case.move
    assert sorted(abs(v) for v in move.shift_m) == [0, 0.5]
    assert abs(move.turn) == pytest.approx(math.radians(10))
    old, new = (next(t for t in f.truths if t.actor.track == move.track) for f in (case.before, case.moved))
    assert np.linalg.norm(new.translation - old.translation) == pytest.approx(0.5, abs=1e-6)
    assert math.remainder(new.yaw - old.yaw - move.turn, 2 * math.pi) == pytest.approx(0, abs=1e-6)
    assert bench.eligible(old)
    assert all(t.visible >= 0.05 for t in case.before.truths)


def test_the_perfect_scene_gets_nearly_perfect_marks(
    case: EditedStreet, tracks: list[int], perfect: SceneIR
) -> None:
    row, strips = bench.judge(case, perfect, tracks)
    assert len(row.shapes) == sum(map(bench.eligible, case.before.truths)) > 0
    for shape in row.shapes:
        assert shape.mesh_iou > 0.95
        assert shape.matte_iou > 0.95
        assert shape.template_iou is None
        assert (shape.place_m, shape.yaw_deg, shape.stretch) == pytest.approx((0, 0, 0), abs=1e-3)
    assert row.exact
    assert row.identity_db >= 45
    assert row.remove.psnr_db > 40
    assert row.remove.unchanged_db < 25
    assert row.move.psnr_db > row.move.unchanged_db + 3
    assert row.move.perceptual < row.move.unchanged_perceptual
    assert sum(row.move.error.values()) == pytest.approx(1, abs=1e-3)
    assert set(row.move.error) == set(row.move.zones) <= set(bench.ZONES)
    assert [strip.ours.shape for strip in strips] == [case.before.image.shape] * 2
    json.dumps(bench.summary([row]), allow_nan=False)


def test_misplaced_and_missing_vehicles_lose_marks(
    case: EditedStreet, tracks: list[int], perfect: SceneIR
) -> None:
    off = list(bench.compare_silhouettes(case, Compositor(_displaced(perfect, 0.4)), tracks, None))
    assert all(shape.mesh_iou < 0.9 for shape in off)
    assert [shape.place_m for shape in off] == pytest.approx([0.4] * len(off), abs=1e-3)
    gone = list(bench.compare_silhouettes(case, Compositor(perfect), [-1] * len(tracks), None))
    assert gone
    assert all(shape.mesh_iou == shape.matte_iou == 0 for shape in gone)


def test_labels_are_off_by_what_they_should_be(case: EditedStreet) -> None:
    true = case.before.labels
    off = bench.disturb_labels(case.before, np.random.default_rng(1))
    shift = (off.translation - true.translation).double()
    ground = case.before.environment.ground.double()
    assert shift[:, [0, 2]].norm(dim=1).tolist() == pytest.approx([0.2] * len(shift), abs=1e-5)
    assert (shift @ ground[:3]).abs().max() < 1e-5
    assert (off.yaw - true.yaw).abs().tolist() == pytest.approx([math.radians(5)] * len(shift), abs=1e-5)
    ratio = off.size_lhw / true.size_lhw
    assert (ratio - 1).abs().reshape(-1).tolist() == pytest.approx([0.05] * 3 * len(shift), abs=1e-5)
    assert torch.equal(off.boxes_xyxy, true.boxes_xyxy)
    again, other = (bench.disturb_labels(case.before, np.random.default_rng(s)) for s in (1, 2))
    assert torch.equal(again.translation, off.translation)
    assert not torch.equal(other.translation, off.translation)


def test_de_rendering_is_given_neither_mask_nor_depth(case: EditedStreet) -> None:
    frame = bench.synthetic_photograph(case.before, case.before.labels)
    assert frame.masks is None
    assert frame.depth is None
    assert frame.classes is None
    assert frame.points is None
    assert torch.equal(
        (frame.photograph * 255).round().byte(), torch.from_numpy(case.before.image).permute(2, 0, 1)
    )


def test_what_is_in_the_way_forbids_a_move(case: EditedStreet) -> None:
    plan = case.plan
    actor = next(a for a in plan.actors if a.track == case.move.track)
    assert bench.is_free(plan, actor, case.move)
    x, z = actor.position_xz
    cos, sin = math.cos(actor.yaw), math.sin(actor.yaw)
    along, across = case.move.shift_m
    ahead = 2 * along * (actor.size_lhw[0] + 0.6), 2 * across * (actor.size_lhw[2] + 0.6)
    place = (x + ahead[0] * cos + ahead[1] * sin, z - ahead[0] * sin + ahead[1] * cos)
    blocked = replace(plan, actors=(*plan.actors, replace(actor, position_xz=place, track=99)))
    assert not bench.is_free(blocked, actor, case.move)


def _row(index: int, move_db: float, **changes: Any) -> DerenderRow:
    edited = EditAccuracy(move_db, 15.0, 0.1 * index, 0.9, 1000, {"seen": move_db}, {"seen": 1.0})
    shape = SilhouetteOverlap(1, "sedan", 60.0, 1.0, 0.8, 0.9 + 0.01 * index, 0.9)
    row = DerenderRow(
        index, "sun", "city", 3, (shape,), "sedan", (0.5, 0.0), 10.0, 0.1, edited, edited, 99.0, True,
        1.0 + index, 1.0, None,
    )  # fmt: skip
    return replace(row, **changes)


def test_summary_lines() -> None:
    rows = [_row(i, 20.0 + i) for i in range(11)]
    lines = {line["measure"]: line for line in bench.summary(rows)}
    move = lines["move, PSNR, dB"]
    assert (move["median"], move["tail"], move["worst"], move["count"]) == (25, 21, 20, 11)
    assert move["goal"] == "median 28"
    # Where less is better the tail lies at the upper end.
    assert (lines["time, s"]["tail"], lines["time, s"]["worst"]) == (10, 11)
    assert lines["silhouette IoU, mesh"]["median"] == pytest.approx(0.95)
    assert "peak memory, MB" not in lines
    assert "move, ground, PSNR, dB" not in lines
    assert not any(name.startswith("true") for name in lines)
    given = [replace(row, ablations={"true masks": {"move_db": 30.0, "remove_db": 31.0}}) for row in rows[:2]]
    more = {line["measure"]: line for line in bench.summary(given)}
    assert more["true masks: remove, PSNR, dB"]["median"] == 31


@pytest.mark.slow
def test_the_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["derender", "--frames", "2", "--workers", "2", "--ablate", "--json"]
    assert main([*words, "--out", str(tmp_path), "--markdown", str(tmp_path / "all.md")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [row["index"] for row in result["rows"]] == [0, 1]
    for row in result["rows"]:
        assert row["identity_db"] >= 45
        assert row["exact"]
        assert row["derender_s"] > 0
        assert 0 <= row["never_seen"] <= 1
        assert all(0 <= s["mesh_iou"] <= 1 for s in row["shapes"])
        assert all(s["height_px"] >= 40 and s["visible"] >= 0.7 for s in row["shapes"])
        assert set(row["ablations"]) in (set(), set(bench.ABLATIONS))
    assert result["command"] == "python -m tools.bench derender --workers 2 --frames 2 --ablate"
    assert {line["measure"] for line in result["summary"]} >= {"move, PSNR, dB", "remove, PSNR, dB"}
    assert json.loads((tmp_path / "derender.json").read_text()) == result
    assert "SqueezeDet backbone" in (tmp_path / "all.md").read_text()
    assert sorted(p.name for p in (tmp_path / "derender").iterdir())[0].startswith("worst-1-frame-")
