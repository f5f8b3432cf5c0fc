"""The map of a run: states of cells, and the bound on frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from drivesem.failures.feature_cells import Cell, CellVisit
from drivesem.run.feature_map import CELLS, FailureMap, upper_limit

NEAR: Cell = (2, 1, 1, 1)
FAR: Cell = (0, 0, 0, 0)


def frame(
    *visits: tuple[int, Cell, int], final: int | None = None, certain: Sequence[int] = ()
) -> tuple[str, list[CellVisit], set[int | None]]:
    """Visits of object, cell and misses, with two passes each; `final`: the object that ends in its cell."""
    found = [CellVisit(index, cell, 2, misses, final=index == final) for index, cell, misses in visits]
    return "f", found, set(certain)


def test_a_cell_is_clear_from_enough_frames_and_not_from_objects_of_few() -> None:
    few = FailureMap.from_frames([frame(*((i, NEAR, 0) for i in range(10))) for _ in range(12)])
    assert [(cell.objects, cell.frames, cell.passes, cell.state) for cell in few.cells] == [
        (120, 12, 240, "unknown")
    ]
    many = FailureMap.from_frames([frame((0, NEAR, 0)) for _ in range(120)])
    assert (many.searched, many.failing, many.clear) == (1, 0, 1)
    assert many.cells[0].missed_below == pytest.approx(0.0247, abs=1e-4)
    assert many.cells[0].finding == "0 of 120 frames, under 2.5 %"
    assert tuple(many.cells[0].where.values()) == ("from 80 px", "medium contrast", "middle", "bright")


def test_states_and_totals() -> None:
    moved = [CellVisit(0, FAR, 2, 1, final=True), CellVisit(0, NEAR, 2, 0)]
    frames = [("moved", moved, {0}), frame((1, NEAR, 1), (2, NEAR, 0), certain=[2]), frame(), frame((0, NEAR, 0))]
    found = FailureMap.from_frames(frames)
    far, near = found.cells
    assert (far.state, far.certain, far.objects, far.frames_missed) == ("failing", 1, 1, 1)
    assert (far.failures, near.failures) == ((("moved", 0),), ())
    assert (near.state, near.certain, near.objects) == ("missed", 0, 4)
    assert (near.frames, near.frames_missed) == (3, 1)
    assert (found.searched, found.failing, found.clear, found.frames_without_record) == (2, 1, 0, 1)
    line = found.describe()
    assert "2 of 54 cells" in line
    assert "under 40 px, low contrast, left, dark: 1 certain of 1 object" in line
    assert "1 frame without a record" in line


def test_parts_of_a_run_make_the_same_map_in_any_order() -> None:
    frames = [frame((i % 3, NEAR, i % 2), (5, FAR, 0), final=5, certain=[5][: i % 2]) for i in range(9)]
    assert FailureMap.from_frames(frames) == FailureMap.from_frames(frames[::-1])


def test_the_grid_has_every_cell_once() -> None:
    found = FailureMap.from_frames([frame(*((0, cell, 0) for cell in CELLS))])
    grid = found.grid()
    cells = [cell for _, _, row in grid for cell in row]
    assert len(cells) == len({id(cell) for cell in cells}) == len(CELLS) == 54
    assert all(
        cell is not None and (size, contrast) == tuple(cell.where.values())[:2]
        for size, contrast, row in grid
        for cell in row
    )
    nothing = FailureMap.from_frames([frame((0, FAR, 0))]).grid()
    assert sum(cell is not None for _, _, row in nothing for cell in row) == 1


@pytest.mark.parametrize(
    ("found", "count", "limit"), [(0, 59, 0.0495), (0, 29, 0.0981), (1, 46, 0.0990), (4, 4, 1.0), (0, 0, 1.0)]
)
def test_upper_limit(found: int, count: int, limit: float) -> None:
    assert upper_limit(found, count) == pytest.approx(limit, abs=1e-4)


def test_the_limit_covers_where_objects_of_a_frame_fail_together() -> None:
    """Frames whose four cars share their luck: the limit on frames holds in 95 % of runs, one on cars does not."""
    rng, share, count, runs = np.random.default_rng(0), 0.06, 40, 2000
    failing = rng.binomial(count, share, runs)
    by_frame = np.mean([upper_limit(int(n), count) >= share for n in failing])
    by_car = np.mean([upper_limit(int(4 * n), 4 * count) >= share for n in failing])
    assert by_frame >= 0.95 - 2 * 0.005
    assert by_car < 0.93
