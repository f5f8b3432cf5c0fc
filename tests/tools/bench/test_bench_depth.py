"""Depth of surroundings beside the truth, a laser and fog."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from drivesem.synth.demo import demo_scene
from scene_ir.derender import depth as derendered
from scene_ir.types import SceneIR
from tools.bench import depth as bench
from tools.bench.__main__ import main
from tools.bench.depth import DepthRow, DepthStreet

HEIGHT, WIDTH = 100, 400


@pytest.fixture(scope="module")
def scene() -> SceneIR:
    return demo_scene(0, 0)


@pytest.fixture(scope="module")
def street(scene: SceneIR) -> DepthStreet:
    return DepthStreet.of(scene)


def step(at: int = 200) -> np.ndarray:
    """Depth (H, W) m that jumps from 10 to 60 m at a column."""
    depth = np.full((HEIGHT, WIDTH), 60.0, np.float32)
    depth[:, :at] = 10
    return depth


def test_a_step_without_an_edge_is_a_band() -> None:
    plain = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    assert bench.bands_px(step(), plain) == pytest.approx(HEIGHT, rel=0.1)
    assert bench.bands_px(np.full((HEIGHT, WIDTH), 10.0, np.float32), plain) == 0


def test_a_step_at_an_edge_of_the_picture_is_none() -> None:
    edged = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    edged[:, 200:] = 0.8
    assert bench.bands_px(step(), edged) == 0
    elsewhere = np.roll(edged, 100, axis=1)
    assert bench.bands_px(step(), elsewhere) > 0.9 * HEIGHT


def test_errors_are_relative_and_told_apart(street: DepthStreet) -> None:
    shape = street.ties.sky.shape
    truth = np.full(shape, np.inf, np.float32)
    truth[50, :100] = 20
    found = np.full(shape, 30.0, np.float32)
    found[50, :50] = 22
    row = bench.depth_row("here", "000", "a guess", found, truth, street)
    assert row.abs_rel == pytest.approx((0.1 + 0.5) / 2, abs=1e-3)
    assert row.within == pytest.approx(0.5)
    assert row.within_up == pytest.approx(0.5)
    assert bench.depth_row("here", "000", "a guess", found, None, street).abs_rel is None


def test_both_together_beat_walls_on_an_embedded_street(scene: SceneIR, street: DepthStreet) -> None:
    used = derendered.estimate_depth(street.picture, street.plane, street.camera, street.ties)
    rows = {
        row.depth: row
        for row in bench.judge(
            "here", "0", replace(scene, depth=torch.from_numpy(used)), scene.depth.numpy(), None
        )
    }
    both, walls = rows[bench.USED], rows["guessed walls"]
    assert set(rows) == {"guessed walls", "walls, relaxed", "network alone", bench.USED}
    assert both.abs_rel == pytest.approx(GOLDEN, abs=0.02)
    assert both.abs_rel < walls.abs_rel
    assert both.bands_px < 5


GOLDEN = 0.14
"""Relative error on that street."""


def test_summary_is_a_line_for_each_source_and_depth() -> None:
    rows = [
        DepthRow("kitti", "0", "a", 10.0, 0.1, 0.8, 0.2, 0.7),
        DepthRow("kitti", "1", "a", 30.0),
        DepthRow("kitti", "0", "b", 0.0),
    ]
    first, second = bench.summary(rows)
    assert (first["frames"], first["bands_px"], first["worst_px"], first["abs_rel"]) == (2, 20.0, 30.0, 0.1)
    assert (second["depth"], second["abs_rel"]) == ("b", None)


@pytest.mark.slow
def test_the_command(capsys: pytest.CaptureFixture[str], tmp_path) -> None:
    assert main(["depth", "--frames", "1", "--json", "--out", str(tmp_path / "depth")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert {line["depth"] for line in result["summary"]} >= {"guessed walls", bench.USED, "exact"}
    assert (tmp_path / "depth" / "depth" / "generated_000.png").is_file()
