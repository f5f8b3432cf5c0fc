"""The benchmark of devices: its rows on one device, and what the table tells of them."""

from dataclasses import replace

import pytest

from tools.bench import devices

ROW = devices.DeviceRow(
    "all six", "000", 60.0, 0.1, 0.0, 0.01, {"color": 1.0, "mesh": 0.9}, 1.0, 0, 0.001, 0.2, 20.0, 90.0
)


def test_the_summary_is_the_worst_of_all_frames_and_the_median_time() -> None:
    other = replace(ROW, psnr_db=50.0, cosines={"color": 0.8, "mesh": 0.95}, box_off_px=0.1, step_ms=30.0)
    (told,) = devices.summary([ROW, other])
    assert (told["frames"], told["least_psnr_db"], told["cosine"], told["worst"]) == (2, 50.0, 0.8, "color")
    assert (told["box_off_px"], told["step_ms"]) == (0.2, 25.0)


@pytest.mark.slow
def test_the_processor_beside_itself_is_the_same() -> None:
    (rows,) = devices.measure(1, "squeezedet", "cpu")
    assert [row.state for row in rows] == list(devices.STATES)
    for row in rows:
        assert (row.psnr_db, row.furthest, row.loss_off, row.found_off) == (120.0, 0.0, 0.0, 0)
        assert set(row.cosines.values()) == {1.0}
        assert min(row.step_ms, row.step_cpu_ms) > 0
