"""The benchmark of foliage: figures of one frame, and what they are means of."""

from dataclasses import replace

import pytest

from drivesem.config.edits import FrameEdit
from drivesem.synth.frames import SynthSettings, plan_frame
from tools.bench import foliage


@pytest.fixture(scope="module")
def rows() -> list[foliage.FoliageRow]:
    plan = plan_frame(83, 0, "train", SynthSettings(bent=True, sunny=True))
    with pytest.MonkeyPatch.context() as patch:
        chosen = {"none": FrameEdit()} | {name: foliage.CODES[name] for name in ("hue 1", "density -1")}
        patch.setattr(foliage, "CODES", chosen)
        return foliage.foliage_rows("train", 0, plan)


@pytest.mark.slow
def test_ours_is_nearer_than_no_change_and_thin_grass_is_grass(rows: list[foliage.FoliageRow]) -> None:
    none, autumn, thin = rows
    assert none.crowns_db == none.grass_db == 99.0
    for row, zones in ((autumn, ("crowns", "grass")), (thin, ("crowns",))):
        for zone in zones:
            assert getattr(row, f"{zone}_db") > getattr(row, f"{zone}_unchanged_db") + 0.3
    assert thin.grass_db is not None
    assert thin.grass_db > 30


def test_the_summary_leaves_out_what_is_not_seen() -> None:
    row = foliage.FoliageRow("train", "000", "hue 1", 20.0, 15.0, None, None)
    told = foliage.summary([row, replace(row, crowns_db=22.0, grass_db=30.0, grass_unchanged_db=25.0)])
    assert told == [
        {
            "pool": "train", "foliage": "hue 1", "frames": 2, "crowns_db": 21.0, "crowns_unchanged_db": 15.0,
            "grass_db": 30.0, "grass_unchanged_db": 25.0,
        }
    ]  # fmt: skip
