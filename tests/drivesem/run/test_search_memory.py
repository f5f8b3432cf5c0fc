"""What a search knows of finished frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from detectors.registry import load_detector
from drivesem.attacks.space import Parameter
from drivesem.config.commands import AttackConfig
from drivesem.config.errors import UsageError
from drivesem.failures.feature_cells import CELL_EDGES
from drivesem.failures.search_log import OBJECT_FEATURES
from drivesem.run import attack
from drivesem.run.search_memory import MARGINS, Experience, SearchMemory
from drivesem.synth.demo import demo_scene
from scene_ir import files
from scene_ir.errors import FormatError

COLUMNS = len(OBJECT_FEATURES) + 1


def rows(seed: int, count: int = 100) -> np.ndarray:
    return np.random.default_rng(seed).random((count, COLUMNS)).astype(np.float32)


def experience(seed: int, count: int = 100, cells: Sequence[tuple[int, ...]] = ()) -> Experience:
    scene, objects = np.full(2, seed, np.float32), np.full((len(cells), 3), 10 + seed, np.float32)
    return Experience(rows(seed, count), scene, objects, np.array(cells, int).reshape(-1, len(CELL_EDGES)))


def write(folder: Path, frame: str, what: Experience) -> None:
    (folder / frame).mkdir(parents=True)
    what.write(folder / frame / MARGINS)


def test_a_model_comes_after_four_frames_and_changes_after_four_more() -> None:
    memory = SearchMemory()
    models = []
    for number in range(9):
        models.append(memory.knowledge().model)
        memory.add(f"{number:03}", experience(number))
    assert models[:4] == [None] * 4
    assert models[4] is not None
    assert models[4] is models[7]
    assert models[8] not in (None, models[4])


def test_few_rows_give_no_model() -> None:
    memory = SearchMemory()
    for number in range(4):
        memory.add(str(number), experience(number, 3))
    assert memory.knowledge().model is None


def test_a_resumed_run_has_the_model_that_it_had(tmp_path: Path) -> None:
    memory = SearchMemory()
    for number in range(5):
        write(tmp_path, f"{number:03}", experience(number))
        memory.read(tmp_path)
    resumed = SearchMemory()
    resumed.read(tmp_path)
    features = torch.rand(3, COLUMNS - 1)
    first, second = memory.knowledge().model, resumed.knowledge().model
    assert first is not None
    assert second is not None
    assert torch.equal(first.predict(features), second.predict(features))


def test_scenes_are_those_that_lost_objects_and_cells_those_that_fail(tmp_path: Path) -> None:
    dark, bright = (0, 1, 2, 0), (0, 1, 2, 1)
    for number, cells in enumerate(([dark, dark], [], [bright])):
        write(tmp_path, f"{number:03}", experience(number, cells=cells))
    memory = SearchMemory()
    memory.read(tmp_path)
    known = memory.knowledge()
    found = [(scene.tolist(), own.tolist()) for scene, own in known.losses]
    assert found == [([0, 0], [10, 10, 10])] * 2 + [([2, 2], [12, 12, 12])]
    assert known.failing == {dark, bright}


def test_others_learn_the_scene_and_the_objects_that_are_lost_for_certain() -> None:
    config = AttackConfig(params="weather,translate", method="learn", grade=False)
    worker = attack.AttackWorker.from_config(config, load_detector("squeezedet"))
    attacked = worker.attack_scene("demo-000", demo_scene(0, 0))
    space, theta = attacked.objective.space, attacked.search.theta
    final = {visit.index: visit.cell for visit in attacked.visits if visit.final}
    found = Experience.from_search(attacked.objective, theta, attacked.visits, list(final)[:2])
    assert found.scene.tolist() == theta[space.blocks[Parameter.WEATHER]].tolist()
    moved = theta[space.blocks[Parameter.TRANSLATE]].view(space.count, -1)
    assert found.objects.tolist() == moved[sorted(final)[:2]].tolist()
    assert [tuple(cell) for cell in found.cells.tolist()] == [final[index] for index in sorted(final)[:2]]
    assert found.rows.shape == (len(attacked.objective.found_before) * 2, COLUMNS)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(b"no archive"),
        lambda path: files.write_npz(path, {"others": rows(0)}),
        lambda path: replace(experience(0), rows=rows(0)[:, 1:]).write(path),
        lambda path: replace(experience(0), rows=np.full((2, COLUMNS), np.nan)).write(path),
        lambda path: replace(experience(0), scene=np.full(2, np.inf)).write(path),
        lambda path: replace(experience(0), cells=np.zeros((2, 4), int)).write(path),
    ],
)
def test_a_damaged_file_is_named_and_left_out(
    spoil: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(5):
        write(tmp_path, f"{number:03}", experience(number))
    path = tmp_path / "002" / MARGINS
    spoil(path)  # pyright: ignore[reportCallIssue]
    with pytest.raises(FormatError):
        Experience.read(path)
    memory = SearchMemory()
    memory.read(tmp_path)
    memory.read(tmp_path)
    (line,) = capsys.readouterr().err.splitlines()
    assert str(path) in line
    assert memory.knowledge().model is not None


def test_without_scikit_learn_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attack, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"drivesem\[learn\]"):
        attack.build_attack(AttackConfig(method="learn"))
