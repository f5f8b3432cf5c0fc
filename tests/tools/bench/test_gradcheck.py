"""Gradients against central differences: the measures themselves, and a whole check of a small street."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from drivesem.attacks.space import PAPER_PARAMETERS, Parameter
from scene_ir.types import Camera, Mesh, SceneIR
from tools.bench import gradcheck
from tools.bench import gradcheck as gradcheck_command
from tools.bench.__main__ import main
from tools.bench.gradcheck import LOSS, PICTURE, FiniteDifferences, GradcheckRow, gradcheck_rows

COUNT, OUTPUTS = 12, gradcheck.FUNCTIONALS + 1


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


def _differences(gradient: np.ndarray, where: slice, directions: int = 4) -> FiniteDifferences:
    """What exact differences of a function with this gradient (F + 1, D) would be."""
    size = where.stop - where.start
    chosen = gradcheck.orthonormal(size, min(directions, size), _generator()).numpy()
    slopes = np.stack([gradient[:, where] @ chosen.T] * 3)
    return FiniteDifferences(where, chosen, slopes, np.full_like(slopes, 1e-12))


def _gradient() -> np.ndarray:
    return torch.randn(OUTPUTS, COUNT, generator=_generator(), dtype=torch.float64).numpy()


def _rows(analytic: np.ndarray, truth: np.ndarray) -> dict[tuple[str, str], GradcheckRow]:
    blocks = (Parameter.TRANSLATE, Parameter.ROTATE, Parameter.MESH)
    found = {p: _differences(truth, slice(4 * i, 4 * i + 4)) for i, p in enumerate(blocks)}
    rows = gradcheck_rows("a scene", "theta0", {"warp": analytic}, found)
    return {(row.name, row.functional): row for row in rows}


def test_equal_gradients_agree_and_combo_2_is_all_three() -> None:
    rows = _rows(_gradient(), _gradient())
    assert set(rows) == {(p, f) for p in ("translate", "rotate", "mesh") for f in (PICTURE, LOSS)} | {
        ("combo 2 detector loss", LOSS)
    }
    for row in rows.values():
        assert row.cosine == pytest.approx(1)
        assert row.relative_error == pytest.approx(0, abs=1e-12)
        assert row.passes(0.99, 0.05)
        assert len(row.steps) == 3


def test_an_error_shows_where_it_is_with_its_own_size() -> None:
    truth, wrong = _gradient(), _gradient()
    wrong[-1, 4:8] *= 1.25  # the loss's gradient to rotate
    rows = _rows(wrong, truth)
    assert rows["rotate", LOSS].relative_error == pytest.approx(0.25)
    assert not rows["rotate", LOSS].passes(0.99, 0.05)
    share = np.linalg.norm(truth[-1, 4:8]) / np.linalg.norm(truth[-1])
    assert rows["combo 2 detector loss", LOSS].relative_error == pytest.approx(0.25 * share)
    for key in (("rotate", PICTURE), ("translate", LOSS), ("mesh", LOSS)):
        assert rows[key].passes(0.99, 0.05)


def test_the_best_of_three_steps_is_reported_and_all_are_listed() -> None:
    found = _differences(_gradient(), slice(0, 4))
    found.slopes[0] *= 2.0
    found.slopes[2] *= 1.1
    row = gradcheck_rows("a scene", "theta0", {"warp": _gradient()}, {Parameter.ROTATE: found})[0]
    assert row.step == gradcheck.STEPS[Parameter.ROTATE][1]
    assert [a.relative_error for a in row.steps] == pytest.approx([0.5, 0, 1 - 1 / 1.1])


@pytest.mark.parametrize("size", [3, 40, 900])
def test_errors_keep_their_length_on_few_directions(size: int) -> None:
    generator = _generator()
    truth, error = torch.randn(2, 400, size, generator=generator, dtype=torch.float64)
    directions = gradcheck.orthonormal(size, 2, generator).numpy()
    slopes = truth.numpy() @ directions.T
    found = FiniteDifferences(slice(0, size), directions, np.stack([slopes] * 3), np.zeros((3, 400, 2)))
    row = gradcheck_rows("a scene", "theta0", {"warp": (truth + 0.1 * error).numpy()}, {Parameter.COLOR: found})[0]
    assert row.relative_error == pytest.approx(0.1, rel=0.1)
    assert directions @ directions.T == pytest.approx(np.eye(2))


def test_no_effect_is_neither_a_pass_nor_a_failure() -> None:
    still = np.zeros((OUTPUTS, COUNT))
    row = _rows(still, still)["rotate", PICTURE]
    assert (row.cosine, row.relative_error, row.step, row.steps) == (None, None, None, ())


def test_a_gradient_of_what_has_no_effect_fails() -> None:
    row = _rows(_gradient(), np.zeros((OUTPUTS, COUNT)))["rotate", PICTURE]
    assert row.cosine == 0
    assert not row.passes(0.99, 0.05)


class _Streets:
    """A source of one small street."""

    def __init__(self, scene: SceneIR) -> None:
        self._scene = scene

    def identifiers(self) -> Iterator[str]:
        return iter(["street"])

    def has_vehicles(self, identifier: str) -> bool:
        return True

    def scene(self, identifier: str) -> SceneIR:
        return self._scene


@pytest.fixture
def small_street(street: Callable[..., SceneIR], monkeypatch: pytest.MonkeyPatch) -> None:
    """The embedded scenes' place taken by two boxes in a picture of 96 x 64 px."""
    whole = street(((-2.0, 8.0), (2.0, 11.0)))
    rows, columns = slice(80, 144), slice(214, 310)
    intrinsics = whole.camera.intrinsics - torch.tensor([[0.0, 0, 214], [0, 0, 80], [0, 0, 0]])
    environment = replace(
        whole.environment,
        **{name: getattr(whole.environment, name)[rows, columns] for name in ("sky", "foliage_map", "road")},
    )
    # No two pixels alike: a pooling whose largest inputs are equal has no derivative.
    shade = 0.2 + 0.6 * torch.rand(3, 64, 96, generator=_generator())
    box = whole.objects.box2d - torch.tensor([214.0, 80, 214, 80])
    corners = torch.cartesian_prod(torch.tensor([-0.5, 0.5]), torch.tensor([-1.0, 0.0]), torch.tensor([-0.5, 0.5]))
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = torch.tensor([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    scene = replace(
        whole,
        meshes=(Mesh(corners, faces, torch.zeros(12, dtype=torch.int64)),),
        camera=Camera(intrinsics, 64, 96),
        environment=environment,
        photograph=shade,
        background=shade,
        depth=whole.depth[rows, columns],
        objects=replace(whole.objects, box2d=box.clamp(min=0).minimum(torch.tensor([95.0, 63, 95, 63]))),
    )
    monkeypatch.setattr(gradcheck_command, "open_source", lambda _: _Streets(scene))


@pytest.mark.slow
@pytest.mark.usefixtures("small_street")
def test_a_whole_check_passes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["gradcheck", "--json", "--workers", "1", "--directions", "1", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    out = capsys.readouterr().out
    summary = json.loads(out)
    assert summary == json.loads((tmp_path / "out" / "gradcheck.json").read_text())
    assert summary["passed"] is True
    names = {row["name"] for row in summary["rows"]}
    assert names == {*(p.value for p in PAPER_PARAMETERS), "combo 2 detector loss"}
    assert len(summary["rows"]) == len(summary["scenes"]["street"]) == 2 * 2 * (2 * 6 + 1)
    silent = {row["name"] for row in summary["rows"] if row["cosine"] is None}
    assert silent == {"foliage"}, "a street without leaves"


@pytest.mark.usefixtures("small_street")
@pytest.mark.parametrize(("factor", "code"), [(1.0, 0), (1.04, 0), (1.2, 1), (-1.0, 1)])
def test_exit_code(
    factor: float, code: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = _rows(factor * _gradient(), _gradient()).values()
    monkeypatch.setattr(gradcheck_command, "_check_all", lambda *_: ({"street": tuple(rows)}, {}))
    assert main(["gradcheck", "--json"]) == code
    assert json.loads(capsys.readouterr().out)["passed"] is (code == 0)


@pytest.mark.usefixtures("small_street")
def test_table(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    still = np.zeros((OUTPUTS, COUNT))
    rows = [*_rows(1.2 * _gradient(), _gradient()).values(), *_rows(still, still).values()]
    monkeypatch.setattr(gradcheck_command, "_check_all", lambda *_: ({"street": tuple(rows)}, {}))
    monkeypatch.setattr(gradcheck_command, "worst", tuple)
    assert main(["gradcheck", "--max-error", "0.1"]) == 1
    out = capsys.readouterr().out
    assert "no effect" in out
    assert "0 of 14 rows inside the tolerance" in out
    assert "7 outside, 7 without effect" in out
