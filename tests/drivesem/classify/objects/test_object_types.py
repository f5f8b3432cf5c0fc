"""Objects are checked when they are made."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from drivesem.classify.objects.types import CLASSES, ObjectModel
from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import Mesh


def pyramid() -> ObjectModel:
    vertices = torch.tensor([[-0.5, -0.5, -0.5], [0.5, -0.5, -0.5], [0.0, -0.5, 0.5], [0.0, 0.5, 0.0]])
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    mesh = Mesh(vertices, faces, torch.zeros(4, dtype=torch.int64))
    return ObjectModel(
        "tower/0001", 9, mesh, torch.full((4, 3), 0.5), torch.full((4,), 0.2), torch.full((4,), 9.0)
    )


def test_a_good_one_passes_and_the_paper_has_twelve_classes() -> None:
    assert pyramid().name == "tower/0001"
    assert len(set(CLASSES)) == 12
    assert (CLASSES[0], CLASSES[3], CLASSES[-1]) == ("airplane", "bus", "boat")


def test_no_faces_is_an_error() -> None:
    whole = pyramid()
    mesh = Mesh(whole.mesh.vertices, whole.mesh.faces[:0], whole.mesh.part[:0])
    with pytest.raises(ShapeError, match=r"tower/0001: mesh\.faces: expected at least one face"):
        replace(whole, mesh=mesh, diffuse=whole.diffuse[:0])


@pytest.mark.parametrize("field", ["diffuse", "specular", "shininess"])
def test_one_row_a_face(field: str) -> None:
    with pytest.raises(ShapeError, match=f"tower/0001: {field}: expected shape"):
        replace(pyramid(), **{field: getattr(pyramid(), field)[:3]})
    with pytest.raises(ShapeError, match="a floating dtype"):
        replace(pyramid(), **{field: getattr(pyramid(), field).long()})


@pytest.mark.parametrize("field", ["diffuse", "specular", "shininess"])
@given(value=st.sampled_from([float("nan"), float("inf"), -1e-3]), face=st.integers(0, 3))
def test_values_no_material_has(field: str, value: float, face: int) -> None:
    values = getattr(pyramid(), field).clone()
    values[face] = value
    with pytest.raises(RangeError, match=f"tower/0001: {field}"):
        replace(pyramid(), **{field: values})


def test_no_more_than_all_light() -> None:
    with pytest.raises(RangeError, match=r"values in \[0, 1\], found 1\.5"):
        replace(pyramid(), specular=torch.full((4,), 1.5))
    assert replace(pyramid(), shininess=torch.full((4,), 900.0))


def test_a_label_is_a_place() -> None:
    with pytest.raises(RangeError, match="label: expected at least 0, found -1"):
        replace(pyramid(), label=-1)
