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
from drivesem.run.search_memory import MARGINS, SearchMemory, read_margin_rows
from scene_ir import files
from scene_ir.errors import FormatError

COLUMNS = len(OBJECT_FEATURES) + 1


def rows(seed: int, count: int = 100) -> np.ndarray:
    return np.random.default_rng(seed).random((count, COLUMNS)).astype(np.float32)


def write(folder: Path, frame: str, values: np.ndarray) -> None:
    (folder / frame).mkdir(parents=True)
    files.write_npz(folder / frame / MARGINS, {"rows": values})


def test_a_model_comes_after_four_frames_and_changes_after_four_more() -> None:
    memory = SearchMemory()
    models = []
    for number in range(9):
        models.append(memory.model())
        memory.add(f"{number:03}", rows(number))
    assert models[:4] == [None] * 4
    assert models[4] is not None
    assert models[4] is models[7]
    assert models[8] not in (None, models[4])


def test_few_rows_give_no_model() -> None:
    memory = SearchMemory()
    for number in range(4):
        memory.add(str(number), rows(number, 3))
    assert memory.model() is None


def test_a_resumed_run_has_the_model_that_it_had(tmp_path: Path) -> None:
    memory = SearchMemory()
    for number in range(5):
        write(tmp_path, f"{number:03}", rows(number))
        memory.read(tmp_path)
    resumed = SearchMemory()
    resumed.read(tmp_path)
    features = torch.rand(3, COLUMNS - 1)
    first, second = memory.model(), resumed.model()
    assert first is not None
    assert second is not None
    assert torch.equal(first.predict(features), second.predict(features))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(b"no archive"),
        lambda path: files.write_npz(path, {"others": rows(0)}),
        lambda path: files.write_npz(path, {"rows": rows(0)[:, 1:]}),
        lambda path: files.write_npz(path, {"rows": np.full((2, COLUMNS), np.nan)}),
    ],
)
def test_a_damaged_file_is_named_and_left_out(
    spoil: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(5):
        write(tmp_path, f"{number:03}", rows(number))
    path = tmp_path / "002" / MARGINS
    spoil(path)  # pyright: ignore[reportCallIssue]
    with pytest.raises(FormatError):
        read_margin_rows(path)
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
