"""The largest changes of a study, before and after."""

from pathlib import Path

import numpy as np
import pytest

from drivesem.run.folder import ARMS
from scene_ir import files
from tools.experiments.detection.arms import PLACEBO
from tools.experiments.detection.largest import SHOWN, WIDTH_PX, largest, write_largest


@pytest.fixture
def runs(frame, arm_run, arm):
    """Two attacks, of which each changes other frames more, and a control that changes all frames most."""
    small = [frame(f"{i:03d}", yaw=0.01 * i) for i in range(SHOWN + 3)]
    turned = [frame(f"{i:03d}", yaw=-0.02 if i else 0.3) for i in range(SHOWN + 3)]
    edits = [frame(f"{i:03d}", yaw=0.35) for i in range(SHOWN + 3)]
    return [
        arm_run(arm("small"), small),
        arm_run(arm("turned"), turned),
        arm_run(arm("small placebo", control=(PLACEBO, "small")), edits),
    ]


def test_each_frame_once_by_the_arm_that_changed_it_most(runs) -> None:
    found = largest(runs, Path("out"))
    assert [(c.result.identifier, c.arm) for c in found[:3]] == [
        ("000", "turned"),
        ("012", "small"),
        ("011", "small"),
    ]
    assert len(found) == SHOWN
    assert found[0].size == pytest.approx(0.3 / 0.7)
    assert found[0].folder == Path("out", ARMS, "turned", "frames", "000")


def test_what_was_not_changed_is_not_shown(frame, arm_run, arm, tmp_path: Path) -> None:
    still = arm_run(arm("still"), [frame("000", yaw=0.0)])
    assert largest([still], tmp_path) == []
    write_largest(tmp_path / "largest.png", [])
    assert not (tmp_path / "largest.png").exists()


def test_the_sheet_shows_photographs_beside_counterexamples(runs, tmp_path: Path) -> None:
    changes = largest(runs, tmp_path)[:2]
    for level, change in enumerate(changes, start=1):
        for name, value in (("benign.png", 20), ("counterexample.png", 20 + 50 * level)):
            files.write_png(change.folder / name, np.full((30, 100, 3), value, np.uint8))
    write_largest(tmp_path / "largest.png", changes)
    sheet = files.read_image(tmp_path / "largest.png")
    row = sheet.shape[0] // 2
    for level in (1, 2):
        middle = sheet[(level - 1) * row + row // 2 + 10]
        assert int(middle[WIDTH_PX // 2, 0]) == 20
        assert int(middle[WIDTH_PX + WIDTH_PX // 2, 0]) == 20 + 50 * level
