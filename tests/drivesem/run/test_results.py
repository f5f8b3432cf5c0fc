"""Results survive the way through a file, and a broken file is named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from drivesem.run.results import BoxRecord, Coordinate, Failure, FrameResult, dump_frame, load_frame
from scene_ir.errors import FormatError


def frame_result(identifier: str = "000001", lost: bool = True) -> FrameResult:
    true = BoxRecord((10.0, 20.25, 60.0, 55.5), "Car", index=0)
    return FrameResult(
        identifier=identifier,
        objects=1,
        queries=10,
        loss_trace=(0.1, 0.2 + 1e-17, 1 / 3),
        theta=(Coordinate("objects[0].yaw", "rad", 0.1, -0.35, 0.35, "5.73 deg"),),
        active_constraints=("objects[0]: strain",),
        violations=(),
        targets_benign=(true,),
        targets_moved=(
            BoxRecord((11.0, 20.0, 61.0, 55.0), "Car", index=0),
            BoxRecord((0, 0, 5, 5), "Car", ignore=True),
        ),
        detections_benign=(BoxRecord((10.0, 20.0, 60.0, 55.0), "Car", score=0.9),),
        detections_rerendered=(BoxRecord((10.0, 20.0, 60.0, 55.0), "Car", score=0.9),),
        detections_attacked=(BoxRecord((100.0, 20.0, 120.0, 55.0), "Pedestrian", score=0.8),),
        failures=(Failure("lost", "Car", (11.0, 20.0, 61.0, 55.0), index=0),) if lost else (),
        became_ignored=(),
        judged=(0,),
        found_before=(0,),
        success_paper=lost,
        success_moved=lost,
        identity_psnr_db=None,
        seconds=1.5,
    )


def test_round_trip_is_exact(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text(dump_frame(frame_result()))
    assert load_frame(path) == frame_result()
    assert load_frame(path).feasible


def test_results_from_before_the_start_and_the_judge_were_named_still_load(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    data = json.loads(dump_frame(frame_result()))
    data["violated_at_start"] = ["objects[0]: collision"]
    path.write_text(json.dumps(data))
    assert load_frame(path).violated_at_start == ("objects[0]: collision",)
    del data["violated_at_start"], data["checked_by"]
    path.write_text(json.dumps(data))
    assert load_frame(path) == frame_result()


@pytest.mark.parametrize("spoil", ["missing", "schema", "text", "field"])
def test_broken_file_is_named(tmp_path: Path, spoil: str) -> None:
    path = tmp_path / "result.json"
    data = json.loads(dump_frame(frame_result()))
    if spoil == "schema":
        data["schema"] = 99
    if spoil == "field":
        data["theta"][0].pop("unit")
    if spoil != "missing":
        path.write_text("{" if spoil == "text" else json.dumps(data))
    with pytest.raises(FormatError, match=r"result\.json"):
        load_frame(path)
