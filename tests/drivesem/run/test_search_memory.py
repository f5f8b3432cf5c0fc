"""What a search knows of finished frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from drivesem.config.commands import AttackConfig
from drivesem.config.errors import UsageError
from drivesem.failures.search_log import OBJECT_FEATURES
from drivesem.run import attack
from drivesem.run.search_memory import (
    MARGINS,
    SearchedFrame,
    SearchMemory,
    read_searched_frame,
    write_searched_frame,
)
from scene_ir import files
from scene_ir.errors import FormatError

COLUMNS = len(OBJECT_FEATURES) + 1
PASSES = np.array(90)


def rows(seed: int, count: int = 100) -> np.ndarray:
    return np.random.default_rng(seed).random((count, COLUMNS)).astype(np.float32)


def searched(seed: int, count: int = 100, passes: int = 90) -> SearchedFrame:
    return SearchedFrame(rows(seed, count), passes)


def write(folder: Path, identifier: str, frame: SearchedFrame) -> None:
    (folder / identifier).mkdir(parents=True)
    write_searched_frame(folder / identifier / MARGINS, frame)


def test_a_model_comes_after_four_frames_and_changes_after_four_more() -> None:
    memory = SearchMemory()
    models = []
    for number in range(9):
        models.append(memory.model())
        memory.add(f"{number:03}", searched(number))
    assert models[:4] == [None] * 4
    assert models[4] is not None
    assert models[4] is models[7]
    assert models[8] not in (None, models[4])


def test_few_rows_give_no_model() -> None:
    memory = SearchMemory()
    for number in range(4):
        memory.add(str(number), searched(number, 3))
    assert memory.model() is None


def test_a_resumed_run_has_the_model_that_it_had(tmp_path: Path) -> None:
    memory = SearchMemory()
    for number in range(5):
        write(tmp_path, f"{number:03}", searched(number))
        memory.read(tmp_path)
    resumed = SearchMemory()
    resumed.read(tmp_path)
    features = torch.rand(3, COLUMNS - 1)
    first, second = memory.model(), resumed.model()
    assert first is not None
    assert second is not None
    assert torch.equal(first.predict(features), second.predict(features))


def test_what_a_frame_leaves_is_read_as_it_was_written(tmp_path: Path) -> None:
    write(tmp_path, "000", searched(0, passes=41))
    read = read_searched_frame(tmp_path / "000" / MARGINS)
    assert read.passes == 41
    assert np.array_equal(read.rows, rows(0))


def test_passes_that_earlier_frames_left_go_to_later_ones() -> None:
    memory = SearchMemory()
    allowed, taken = [], []
    for number, wanted in enumerate((20, 90, 400, 400, 10, 10, 400)):
        allowed.append(memory.allowance(90))
        taken.append(min(wanted, allowed[-1]))
        memory.add(str(number), searched(number, passes=taken[-1]))
    assert allowed == [90, 160, 160, 90, 90, 170, 180]
    assert sum(taken) <= 90 * len(taken)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(b"no archive"),
        lambda path: files.write_npz(path, {"others": rows(0), "passes": PASSES}),
        lambda path: files.write_npz(path, {"rows": rows(0)[:, 1:], "passes": PASSES}),
        lambda path: files.write_npz(path, {"rows": np.full((2, COLUMNS), np.nan), "passes": PASSES}),
        lambda path: files.write_npz(path, {"rows": rows(0)}),
        lambda path: files.write_npz(path, {"rows": rows(0), "passes": np.array([9, 9])}),
    ],
)
def test_a_damaged_file_is_named_and_left_out(
    spoil: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(5):
        write(tmp_path, f"{number:03}", searched(number))
    path = tmp_path / "002" / MARGINS
    spoil(path)  # pyright: ignore[reportCallIssue]
    with pytest.raises(FormatError):
        read_searched_frame(path)
    memory = SearchMemory()
    memory.read(tmp_path)
    memory.read(tmp_path)
    (line,) = capsys.readouterr().err.splitlines()
    assert str(path) in line
    assert memory.model() is not None


def test_without_scikit_learn_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attack, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"drivesem\[learn\]"):
        attack.build_attack(AttackConfig(method="learn"))
