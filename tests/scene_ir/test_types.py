"""What the central types refuse: one line with the field, what was expected and what was found."""

import dataclasses
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch

from scene_ir.errors import FormatError, RangeError, SceneError, ShapeError
from scene_ir.types import (
    Camera,
    Category,
    Crop,
    Environment,
    Frame,
    Labels,
    Mesh,
    Objects,
    SceneIR,
    Source,
    check_finite,
    check_shape,
)

H, W, N = 6, 8, 2


def camera(**changes: Any) -> Camera:
    values = {"intrinsics": torch.eye(3) * 100, "height": H, "width": W}
    return Camera(**values | changes)


def mesh(**changes: Any) -> Mesh:
    values = {
        "vertices": torch.rand(4, 3),
        "faces": torch.tensor([[0, 1, 2], [1, 2, 3]]),
        "part": torch.zeros(2).long(),
    }
    return Mesh(**values | changes)


def source(**changes: Any) -> Source:
    values = {
        "translation": torch.zeros(3),
        "yaw": torch.zeros(()),
        "size_lhw": torch.ones(3),
        "ffd": torch.zeros(64, 3),
        "foreground": Crop(torch.zeros(4, 2, 3), 0, 0),
        "shadow": Crop(torch.ones(3, 2, 3), 0, 0),
        "inflation": 0.1,
        "paint": torch.zeros(3),
        "sunlight": 0.5,
    }
    return Source(**values | changes)


def objects(**changes: Any) -> Objects:
    values = {
        "mesh_index": torch.zeros(N).long(),
        "translation": torch.zeros(N, 3),
        "yaw": torch.zeros(N),
        "size_lhw": torch.ones(N, 3),
        "ffd": torch.zeros(N, 64, 3),
        "texture_code": torch.zeros(N, 5),
        "category": torch.zeros(N).long(),
        "box2d": torch.zeros(N, 4),
        "truncation": torch.zeros(N),
        "occlusion": torch.zeros(N).long(),
    }
    return Objects(**values | changes)


def environment(**changes: Any) -> Environment:
    values = {
        "weather": torch.zeros(4),
        "foliage": torch.zeros(3),
        "sun": torch.zeros(3),
        "ground": torch.zeros(4),
    }
    maps = {name: torch.zeros(H, W) for name in ("sky", "foliage_map", "road")}
    return Environment(**values | maps | changes)


def scene(**changes: Any) -> SceneIR:
    values = {
        "camera": camera(),
        "meshes": (mesh(),),
        "objects": objects(),
        "environment": environment(),
        "photograph": torch.zeros(3, H, W),
        "background": torch.zeros(3, H, W),
        "depth": torch.ones(H, W),
        "ignore": torch.zeros(0, 4),
    }
    return SceneIR(**values | changes)


def labels(**changes: Any) -> Labels:
    values = {
        "kind": ("Car", "Van"),
        "boxes_xyxy": torch.zeros(N, 4),
        "truncation": torch.zeros(N),
        "occlusion": torch.zeros(N).long(),
        "translation": torch.zeros(N, 3),
        "yaw": torch.zeros(N),
        "size_lhw": torch.ones(N, 3),
        "ignore_xyxy": torch.zeros(1, 4),
    }
    return Labels(**values | changes)


def frame(**changes: Any) -> Frame:
    values = {"identifier": "000008", "photograph": torch.zeros(3, H, W), "camera": camera(), "labels": labels()}
    return Frame(**values | changes)


@pytest.mark.parametrize("make", [camera, mesh, source, objects, environment, scene, labels, frame])
def test_the_plain_case_is_accepted_frozen_and_slotted(make: Callable[[], Any]) -> None:
    value = make()
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(value, dataclasses.fields(value)[0].name, None)
    assert not hasattr(value, "__dict__")


NOT_FINITE = {
    *("source.translation", "source.yaw", "source.size_lhw", "source.ffd", "source.paint", "objects.box2d"),
    *("objects.truncation", "environment.sky", "environment.foliage_map", "environment.road"),
    *("scene.photograph", "scene.background", "scene.depth", "scene.ignore", "labels.boxes_xyxy"),
    *("labels.truncation", "labels.translation", "labels.yaw", "labels.size_lhw", "labels.ignore_xyxy"),
    "frame.photograph",
}
"""Tensors that may hold values that are not finite, or whose values are checked elsewhere."""
TENSORS = [
    (make, field.name)
    for make in (camera, mesh, source, objects, environment, scene, labels, frame)
    for field in dataclasses.fields(make())
    if isinstance(getattr(make(), field.name), torch.Tensor)
]


@pytest.mark.parametrize(("make", "field"), TENSORS, ids=[f"{make.__name__}-{field}" for make, field in TENSORS])
def test_every_tensor_has_its_type_shape_and_range(make: Callable[..., Any], field: str) -> None:
    value, name = getattr(make(), field), f"{make.__name__}.{field}"
    floating = value.is_floating_point()
    wrong = [
        (value.tolist(), ShapeError, "expected a torch tensor, found "),
        (value[None], ShapeError, "expected shape "),
        (value.long() if floating else value.float(), ShapeError, "expected a"),
    ]
    if value.ndim and field != "sky":  # the shape of which is that of other maps
        wrong.append((torch.cat([value, value], dim=-1), ShapeError, "expected shape "))
    if floating and name not in NOT_FINITE:
        wrong.append((value * torch.nan, RangeError, "expected a finite value"))
    for changed, error, message in wrong:
        with pytest.raises(error, match=rf"^{re.escape(name)}.*: {message}.*$"):
            make(**{field: changed})


BAD: list[tuple[Callable[..., Any], dict[str, Any], type[SceneError], str]] = [
    (camera, {"intrinsics": -torch.eye(3)}, RangeError, "focal lengths: expected positive px"),
    (camera, {"projection": torch.eye(3)}, ShapeError, r"camera\.projection: expected shape \(3, 4\)"),
    (camera, {"projection": torch.full((3, 4), torch.inf)}, RangeError, r"camera\.projection\[0, 0\]"),
    (camera, {"height": 0}, RangeError, "camera size: expected at least 1x1 px, found 8x0"),
    (
        mesh,
        {"faces": torch.tensor([[0, 1, 4]]), "part": torch.zeros(1).long()},
        RangeError,
        r"indices in \[0, 4\)",
    ),
    (mesh, {"faces": torch.tensor([[0, 1, -1], [0, 1, 2]])}, RangeError, "mesh.faces: expected indices"),
    (mesh, {"part": torch.zeros(3).long()}, ShapeError, r"mesh\.part: expected shape \(2,\), found \(3,\)"),
    (mesh, {"colours": torch.zeros(3, 3)}, ShapeError, r"mesh\.colours: expected shape \(4, 3\)"),
    (mesh, {"uv": torch.zeros(4, 3)}, ShapeError, r"mesh\.uv: expected shape \(4, 2\)"),
    (source, {"foreground": Crop(torch.zeros(3, 2, 2), 0, 0)}, ShapeError, r"foreground: expected shape \(4"),
    (source, {"shadow": Crop(torch.zeros(1, 2, 2), 0, 0)}, ShapeError, r"source\.shadow: expected shape \(3"),
    (objects, {"yaw": torch.zeros(N + 1)}, ShapeError, r"objects\.yaw: expected shape \(2,\), found \(3,\)"),
    (objects, {"size_lhw": torch.zeros(N, 3)}, RangeError, r"objects\.size_lhw: expected positive metres"),
    (objects, {"source": (source(),)}, ShapeError, r"objects\.source: expected 2 entries or none, found 1"),
    (scene, {"other_labels": labels()}, ShapeError, r"scene\.ignore: expected shape \(3, 4\), found \(0, 4\)"),
    (scene, {"camera": camera(width=9)}, ShapeError, r"scene\.photograph: expected shape \(3, 6, 9\)"),
    (scene, {"meshes": ()}, RangeError, r"objects\.mesh_index: expected indices in \[0, 0\)"),
    (scene, {"objects": objects(mesh_index=torch.tensor([0, -1]))}, RangeError, "mesh_index: expected indices"),
    (labels, {"boxes_xyxy": torch.zeros(3, 4)}, ShapeError, r"labels\.boxes_xyxy: expected shape \(2, 4\)"),
    (labels, {"kind": ("Car",)}, ShapeError, r"labels\.boxes_xyxy: expected shape \(1, 4\)"),
    (frame, {"masks": torch.zeros(3, H, W)}, ShapeError, r"frame\.masks: expected shape \(2, 6, 8\)"),
    (frame, {"depth": torch.zeros(H, 2)}, ShapeError, r"frame\.depth"),
    (frame, {"classes": torch.zeros(H, W)}, ShapeError, r"frame\.classes: expected an integer dtype"),
    (frame, {"points": torch.zeros(5, 4)}, ShapeError, r"frame\.points: expected shape \('\*', 3\)"),
]


@pytest.mark.parametrize(
    ("make", "changes", "error", "message"),
    BAD,
    ids=[f"{b[0].__name__}-{next(iter(b[1]))}-{i}" for i, b in enumerate(BAD)],
)
def test_what_is_refused(
    make: Callable[..., Any], changes: dict[str, Any], error: type[SceneError], message: str
) -> None:
    with pytest.raises(error, match=message) as caught:
        make(**changes)
    assert "\n" not in str(caught.value)


def test_errors_are_value_errors_that_carry_their_parts() -> None:
    error = FormatError("a.txt:3", "15 fields", 4)
    assert isinstance(error, ValueError)
    assert (error.field, error.expected, error.actual) == ("a.txt:3", "15 fields", 4)
    assert str(error) == "a.txt:3: expected 15 fields, found 4"


def test_check_finite_names_the_first_coordinate() -> None:
    with pytest.raises(RangeError, match=r"theta\[1, 0\]: expected a finite value, found inf"):
        check_finite("theta", torch.tensor([[0.0, 1.0], [torch.inf, torch.nan]]))


def test_check_shape_accepts_any_size_for_none() -> None:
    check_shape("x", torch.zeros(5, 3), None, 3)
    with pytest.raises(ShapeError, match="x: expected shape"):
        check_shape("x", torch.zeros(5), None, 3)


def test_camera_matrix() -> None:
    assert torch.equal(camera().matrix, torch.cat([torch.eye(3) * 100, torch.zeros(3, 1)], dim=1))
    projection = torch.rand(3, 4)
    assert camera(projection=projection).matrix is projection


def test_with_objects_and_with_environment_replace_only_what_is_named() -> None:
    base = scene()
    changed = base.with_objects(yaw=torch.ones(N)).with_environment(weather=torch.ones(4))
    assert torch.equal(changed.objects.yaw, torch.ones(N))
    assert changed.objects.translation is base.objects.translation
    assert changed.environment.foliage is base.environment.foliage
    assert float(base.objects.yaw.sum()) == 0
    with pytest.raises(ShapeError, match=r"objects\.yaw"):
        base.with_objects(yaw=torch.ones(N + 1))


def test_a_scene_without_objects_needs_no_mesh() -> None:
    empty = objects(**{f.name: getattr(objects(), f.name)[:0] for f in dataclasses.fields(Objects)})
    assert len(scene(objects=empty, meshes=()).objects) == 0


def test_requires_grad_is_no_obstacle() -> None:
    size = torch.ones(N, 3, requires_grad=True)
    assert objects(size_lhw=size).size_lhw is size


def test_categories_are_in_the_detectors_order() -> None:
    assert [c.name for c in Category] == ["CAR", "TRUCK", "PEDESTRIAN", "CYCLIST"]
