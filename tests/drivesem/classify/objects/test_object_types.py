"""Objects are checked when they are created."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from drivesem.classify.objects.types import CLASSES
from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import Mesh
from tests.drivesem.classify.conftest import make_model

BOX = make_model("box")
FIELDS = ("diffuse", "specular", "shininess")


def test_the_paper_has_twelve_classes() -> None:
    assert len(set(CLASSES)) == 12
    assert (CLASSES[0], CLASSES[3], CLASSES[-1]) == ("airplane", "bus", "boat")


def test_an_object_needs_faces() -> None:
    mesh = Mesh(BOX.mesh.vertices, BOX.mesh.faces[:0], BOX.mesh.part[:0])
    with pytest.raises(ShapeError, match=r"box/0000: mesh\.faces: expected at least one face"):
        replace(BOX, mesh=mesh, diffuse=BOX.diffuse[:0])


@pytest.mark.parametrize("field", FIELDS)
def test_materials_have_one_row_per_face(field: str) -> None:
    with pytest.raises(ShapeError, match=f"box/0000: {field}: expected shape"):
        replace(BOX, **{field: getattr(BOX, field)[:3]})
    with pytest.raises(ShapeError, match="a floating dtype"):
        replace(BOX, **{field: getattr(BOX, field).long()})


@pytest.mark.parametrize("field", FIELDS)
@given(value=st.sampled_from([float("nan"), float("inf"), -1e-3]), face=st.integers(0, 11))
def test_invalid_material_values(field: str, value: float, face: int) -> None:
    values = getattr(BOX, field).clone()
    values[face] = value
    with pytest.raises(RangeError, match=f"box/0000: {field}"):
        replace(BOX, **{field: values})


def test_reflectance_is_at_most_1_but_shininess_is_unbounded() -> None:
    with pytest.raises(RangeError, match=r"values in \[0, 1\], found 1\.5"):
        replace(BOX, specular=torch.full((12,), 1.5))
    assert replace(BOX, shininess=torch.full((12,), 900.0))


def test_a_label_is_an_index() -> None:
    with pytest.raises(RangeError, match="label: expected at least 0, found -1"):
        replace(BOX, label=-1)
