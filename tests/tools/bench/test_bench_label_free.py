"""What is estimated without labels, held against labels."""

import json
import math
from dataclasses import replace

import pytest
import torch

from scene_ir.types import Camera, Labels
from tools.bench import label_free as bench
from tools.bench.__main__ import main
from tools.bench.label_free import FrameRows, VehicleError, VehicleRow

CAMERA = Camera(torch.tensor([[720.0, 0, 620.0], [0, 720.0, 180.0], [0, 0, 1.0]]), 375, 1242)


def labels() -> Labels:
    """A car that counts, one too small, one hidden, one cut, one of unknown place, and a person."""
    boxes = [[100, 100, 200, 160], [300, 100, 330, 120], [400, 100, 500, 160], [600, 100, 700, 160],
             [800, 100, 900, 160], [900, 100, 930, 160]]  # fmt: skip
    size = torch.tensor([[4.0, 1.5, 1.7]]).repeat(6, 1)
    size[4] = -1
    return Labels(
        ("Car", "Car", "Van", "Truck", "Car", "Pedestrian"),
        torch.tensor(boxes).float(),
        torch.tensor([0.0, 0.0, 0.0, 0.6, 0.0, 0.0]),
        torch.tensor([1, 0, 2, 0, 0, 0]),
        torch.tensor([[1.0, 1.6, 20.0]]).repeat(6, 1),
        torch.full((6,), 0.5),
        size,
        torch.zeros(0, 4),
    )


def test_what_is_judged() -> None:
    assert bench.judged(labels()) == [0]


def test_errors_are_of_heading_depth_and_place() -> None:
    found = bench.vehicle_error(labels(), 0, torch.tensor([1.3, 1.2, 20.4]), 0.5 - math.radians(3), CAMERA)
    assert found.yaw_deg == pytest.approx(3, abs=0.01)
    assert found.depth == pytest.approx(0.02, abs=1e-4)
    assert found.place_m == pytest.approx(0.5, abs=1e-3)
    behind = bench.vehicle_error(labels(), 0, torch.tensor([1.0, 1.6, 20.0]), 0.5 + math.pi + 2 * math.pi, CAMERA)
    assert behind.yaw_deg == pytest.approx(180, abs=0.01)


def test_summary_keeps_both_stages_apart() -> None:
    before = [VehicleError(4.0 + i, 0.05, 1.0) for i in range(5)]
    rows = tuple(
        VehicleRow("000", i, 60.0, e, None if i == 4 else replace(e, yaw_deg=1.0)) for i, e in enumerate(before)
    )
    turned = VehicleRow("001", 0, 60.0, VehicleError(178.0, 0.1, 2.0), VehicleError(178.0, 0.1, 2.0))
    lines = {
        s["measure"]: s for s in bench.summary([FrameRows(6, rows, (0.2,)), FrameRows(2, (turned,), (0.1, 1.0))])
    }
    assert lines["vehicles found, share"]["median"] == 0.75
    near = lines["1 - IoU of boxes from 120 px high, cut ones too"]
    assert (near["median"], near["worst"], near["count"]) == (0.2, 1.0, 3)
    assert lines["heading, degrees, as placed"]["median"] == 6.5
    assert lines["heading, degrees, after the fit"]["median"] == 1.0
    assert lines["heading, degrees, after the fit"]["count"] == 5
    assert lines["heading, degrees, after the fit"]["goal"] == "median 5"
    assert lines["axis, degrees, as placed"]["worst"] == 8
    assert lines["turned, share, as placed"]["median"] == pytest.approx(1 / 6, abs=1e-3)
    assert bench.summary([FrameRows(0, ())]) == []


@pytest.mark.slow
def test_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["label-free", "--frames", "2", "--workers", "1", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["frames"] == 2
    assert result["command"] == "python -m tools.bench label-free --workers 1 --frames 2"
    for row in result["rows"]:
        assert 0 <= row["before"]["yaw_deg"] <= 180
        assert row["height_px"] >= bench.LEAST_HEIGHT_PX
    assert "vehicles found, share" in {line["measure"] for line in result["summary"]}
