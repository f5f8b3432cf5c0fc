"""Cars moved far beside the generator's truth: a perfect scene gets good marks, and what cannot be is left out."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from detectors.types import Detections
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import render_frame
from scene_ir.types import SceneIR
from tools.bench import derender, moves
from tools.bench.__main__ import main
from tools.bench.derender import EditedStreet, VehicleMove
from tools.bench.moves import MovedRow
from tools.bench.sights import DetectorView


class Dazzled:
    """Sees one car where it is told, and nothing in every second picture."""

    name = "dazzled"
    classes = ("Car",)

    def __init__(self, box: Tensor) -> None:
        self.box, self.looks = box, 0

    def forward(self, images: Tensor) -> Tensor:
        self.looks += 1
        return images

    def decode(self, raw: Tensor) -> list[Detections]:
        boxes = self.box[None][: self.looks % 2]
        return [Detections(boxes, torch.zeros(len(boxes), dtype=torch.int64), torch.full((len(boxes),), 0.9))]


@pytest.fixture(scope="module")
def case() -> EditedStreet:
    return derender.make_case(0, 0, "train")


@pytest.fixture(scope="module")
def perfect(case: EditedStreet) -> SceneIR:
    tracks = _tracks(case)
    return derender.perfect_scene(case.before, derender.without(case, tracks), tracks)


def _tracks(case: EditedStreet) -> list[int]:
    return [
        t.actor.track for t in case.before.truths if t.labelled and t.actor.label in derender.VEHICLE_CATEGORIES
    ]


def test_a_vehicle_that_grows_grows_in_truth_and_in_the_scene(case: EditedStreet, perfect: SceneIR) -> None:
    move = VehicleMove(case.move.track, (0.0, 0.0), 0.0, 0.1)
    moved = render_frame(apply_edit(case.plan, derender.move_to_edit(move)))
    assert moved is not None
    old, new = (derender.true_shape(frame, move.track).box_xyxy for frame in (case.before, moved))
    assert ((new[2:] - new[:2]) / (old[2:] - old[:2])).tolist() == pytest.approx([1.1, 1.1], abs=0.05)
    ours = derender.apply_move(replace(case, move=move, moved=moved), perfect, _tracks(case))
    row = _tracks(case).index(move.track)
    grown = ours.objects.size_lhw[row] / perfect.objects.size_lhw[row]
    assert grown.tolist() == pytest.approx([1.1, 1.1, 1.1])


def test_a_perfect_scene_holds_and_the_detector_is_heard(case: EditedStreet, perfect: SceneIR) -> None:
    box = torch.from_numpy(derender.true_shape(case.before, case.move.track).box_xyxy).float()
    rng = np.random.default_rng(0)
    rows, strips = moves.judge(case, perfect, _tracks(case), DetectorView(Dazzled(box)), rng)
    assert len(rows) == len(strips) > 10
    by_name = {row.change: row for row in rows}
    assert by_name["0.5 m farther"].psnr_db > by_name["0.5 m farther"].unchanged_db + 3
    assert by_name["0.5 m farther"].found == pytest.approx(0.9)
    assert by_name["0.5 m farther"].ours is None
    assert moves.judge(case, perfect, [-1] * len(_tracks(case)), DetectorView(Dazzled(box)), rng) == ([], [])


def test_a_line_counts_what_both_see() -> None:
    def row(psnr_db: float, found: float | None, ours: float | None, change: str = "1 m farther") -> MovedRow:
        return MovedRow("train", 0, change, "sedan", 20.0, (1.0, 0.0), 0.0, psnr_db, 15.0, 22.0, found, ours, 1)

    near = row(25, 0.5, 0.6, "1 m nearer")
    rows = [row(20, 0.9, 0.7), row(30, 0.8, None), row(25, None, None), near, row(25, 0.5, 0.6, "5 degrees")]
    nearer, farther, turned, share = moves.summary(rows)
    assert (farther["split"], farther["change"], farther["count"]) == ("train", "1 m farther", 3)
    assert (farther["psnr_db"], farther["tail_db"]) == (25.0, 21.0)
    assert (farther["found"], farther["detected_ours"], farther["agree"]) == (2, 1, 0.667)
    assert farther["score_apart"] == farther["score_tail"] == pytest.approx(0.2)
    assert [line["change"] for line in (nearer, turned)] == ["1 m nearer", "5 degrees"]
    # One metre of twenty.
    assert (share["change"], share["count"]) == ("0 to 0.1 of its distance nearer", 1)


@pytest.mark.slow
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["moves", "--frames", "2", "--workers", "1", "--json", "--out", str(tmp_path)]
    assert main([*words, "--markdown", str(tmp_path / "all.md")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert {row["split"] for row in result["rows"]} == {"train", "heldout"}
    assert "<!-- bench moves: begin -->" in (tmp_path / "all.md").read_text()
    assert len(list((tmp_path / "moves").glob("*.png"))) == 2
