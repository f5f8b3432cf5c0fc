"""Mesh files: our GLB keeps every bit; foreign OBJ, GLB, PLY come into the unit box with colours and parts."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from scene_ir.errors import FormatError, RangeError
from scene_ir.meshes import load
from scene_ir.meshes.load import import_mesh, load_mesh, save_mesh
from scene_ir.meshes.templates import template
from scene_ir.types import Mesh, Part

KENNEY = Path(__file__).parents[3] / "shared" / "data" / "meshes_kenney"


def assert_same(left: Mesh, right: Mesh) -> None:
    for name in ("vertices", "faces", "part", "colours", "uv"):
        a, b = getattr(left, name), getattr(right, name)
        assert (a is None) == (b is None), name
        if a is not None:
            assert a.dtype == b.dtype
            assert torch.equal(a, b), name
    assert left.name == right.name


def wedge_car(towards: tuple[float, float, float] = (0, 0, 1), up: tuple[float, float, float] = (0, 1, 0)):
    """A body 4 long, 1 high, 1.6 wide with a cabin behind its middle, looking along `towards`."""
    body = trimesh.creation.box((4.0, 0.6, 1.6))
    cabin = trimesh.creation.box((1.6, 0.4, 1.4))
    cabin.apply_translation((-0.8, 0.5, 0.0))
    axes = np.eye(4)
    axes[:3, 0], axes[:3, 1], axes[:3, 2] = towards, up, np.cross(towards, up)
    for piece in (body, cabin):
        piece.apply_transform(axes)
        piece.apply_translation((5.0, -2.0, 3.0))
    return body, cabin


@pytest.mark.parametrize("uv", [False, True])
@pytest.mark.parametrize("colours", [False, True])
def test_saved_mesh_comes_back_to_the_bit(tmp_path: Path, colours: bool, uv: bool) -> None:
    generator = torch.Generator().manual_seed(5)
    mesh = template("hatchback", 2)
    count = mesh.vertices.shape[0]
    mesh = replace(
        mesh,
        colours=torch.rand(count, 3, generator=generator) if colours else None,
        uv=torch.rand(count, 2, generator=generator) * 4 - 1 if uv else None,
        name='größer "x"',
    )
    save_mesh(mesh, tmp_path / "a.glb")
    assert_same(load_mesh(tmp_path / "a.glb"), mesh)
    assert [p.name for p in tmp_path.iterdir()] == ["a.glb"]


def test_odd_meshes_come_back_too(tmp_path: Path) -> None:
    """Unused and duplicate vertices, several parts, vertices outside the unit box stay as they are."""
    mesh = Mesh(
        vertices=torch.tensor([[0.1, -3.0, 0], [1 / 3, 0, 0], [0, 1e-30, 0], [0.1, -3.0, 0], [9, 9, 9.0]]),
        faces=torch.tensor([[0, 1, 2], [2, 1, 3], [2, 2, 1]]),
        part=torch.tensor([4, 0, 2]),
    )
    save_mesh(mesh, tmp_path / "odd.glb")
    assert_same(load_mesh(tmp_path / "odd.glb"), mesh)


def test_saving_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.glb", "b.glb"):
        save_mesh(template("sedan", 1), tmp_path / name)
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def test_viewers_get_colours_and_an_upright_mesh(tmp_path: Path) -> None:
    mesh = template("sedan", 0)
    save_mesh(mesh, tmp_path / "a.glb")
    scene = trimesh.load_scene(tmp_path / "a.glb", process=False)
    loaded_scene = scene.to_mesh()
    assert loaded_scene.bounds[:, 1] == pytest.approx([0.0, 1.0], abs=1e-6)
    assert loaded_scene.volume > 0
    linear = torch.where(mesh.colours <= 0.04045, mesh.colours / 12.92, ((mesh.colours + 0.055) / 1.055) ** 2.4)
    loaded_scene = np.asarray(next(iter(scene.geometry.values())).visual.vertex_colors)[:, :3]
    np.testing.assert_allclose(loaded_scene, 255 * linear.numpy(), atol=0.51)


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb"])
@pytest.mark.parametrize("front", ["auto", "given"])
@pytest.mark.parametrize(
    ("towards", "axis", "up_vector", "up"),
    [
        ((0, 0, 1), "+z", (0, 1, 0), "y"),
        ((0, 0, -1), "-z", (0, 1, 0), "y"),
        ((1, 0, 0), "+x", (0, 1, 0), "y"),
        ((0, -1, 0), "-y", (0, 0, 1), "z"),
        ((-1, 0, 0), "-x", (0, -1, 0), "-y"),
    ],
)
def test_any_axes_come_into_the_unit_box(tmp_path, suffix, front, towards, axis, up_vector, up) -> None:
    whole = trimesh.util.concatenate(wedge_car(towards, up_vector))
    whole.export(tmp_path / f"car.{suffix}")
    imported = import_mesh(tmp_path / f"car.{suffix}", up=up, front=axis if front == "given" else "auto")
    points, faces = imported.mesh.vertices, imported.mesh.faces
    assert imported.size_lhw == pytest.approx((4.0, 1.0, 1.6), abs=1e-5)
    torch.testing.assert_close(points.amin(0), torch.tensor([-0.5, -1.0, -0.5]))
    torch.testing.assert_close(points.amax(0), torch.tensor([0.5, 0.0, 0.5]))
    roof = points[points[:, 1] < -0.99]
    assert float(roof[:, 0].mean()) == pytest.approx(-0.2, abs=1e-5)
    corners = points[faces]
    volume = (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert float(volume) > 0


def test_units_scale_the_size_alone(tmp_path: Path) -> None:
    trimesh.util.concatenate(wedge_car()).export(tmp_path / "car.obj")
    metres, centimetres = (import_mesh(tmp_path / "car.obj", metres_per_unit=u) for u in (1.0, 0.01))
    assert torch.equal(metres.mesh.vertices, centimetres.mesh.vertices)
    assert centimetres.size_lhw == pytest.approx(tuple(0.01 * s for s in metres.size_lhw))


def test_materials_of_an_obj_give_colours_and_parts(tmp_path: Path) -> None:
    (tmp_path / "car.mtl").write_text(
        "newmtl carpaint\nKd 0.8 0.1 0.1\nnewmtl Windows_Glass\nKd 0.1 0.1 0.2\nnewmtl rubber\nKd 0 0 0\n"
        "newmtl Headlight\nKd 1 1 0.8\nnewmtl thing\nKd 0.2 0.4 0.6\n"
    )
    box = trimesh.creation.box((1, 1, 4))
    lines, expected = ["mtllib car.mtl"], {}
    for i, name in enumerate(("carpaint", "Windows_Glass", "rubber", "Headlight", "thing")):
        lines += [f"v {x + 2 * i} {y} {z}" for x, y, z in box.vertices]
        lines += [f"usemtl {name}"] + [f"f {' '.join(str(v + 1 + 8 * i) for v in face)}" for face in box.faces]
    (tmp_path / "car.obj").write_text("\n".join(lines))
    mesh = load_mesh(tmp_path / "car.obj", front="+z")
    colours = mesh.colours[mesh.faces[:, 0]]
    expected = {
        Part.PAINT: (0.8, 0.1, 0.1),
        Part.GLASS: (0.1, 0.1, 0.2),
        Part.TYRE: (0.0, 0.0, 0.0),
        Part.LIGHT: (1.0, 1.0, 0.8),
        Part.OTHER: (0.2, 0.4, 0.6),
    }
    for part, colour in expected.items():
        rows = colours[mesh.part == part]
        assert rows.shape[0] == 12
        torch.testing.assert_close(rows, torch.tensor(colour).expand(12, 3), atol=1 / 255, rtol=0)


def test_a_palette_texture_becomes_vertex_colours(tmp_path: Path) -> None:
    palette = np.zeros((2, 2, 3), dtype=np.uint8)
    palette[0, 0], palette[0, 1], palette[1, 0], palette[1, 1] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (9, 9, 9)
    material = trimesh.visual.material.PBRMaterial(name="colormap", baseColorTexture=Image.fromarray(palette))
    scene = trimesh.Scene()
    for i, (uv, name) in enumerate(
        [((0.25, 0.75), "wheel-front"), ((0.75, 0.75), "wheel-back"), ((0.25, 0.25), "b")]
    ):
        box = trimesh.creation.box((1, 1, 1))
        box.visual = trimesh.visual.TextureVisuals(uv=np.tile(uv, (8, 1)), material=material)
        move = np.eye(4)
        move[:3, 3] = (0, 0, (3, -3, 0)[i])
        scene.add_geometry(box, node_name=name, geom_name=name, transform=move)
    scene.export(tmp_path / "car.glb")
    mesh = load_mesh(tmp_path / "car.glb")
    x, colours = mesh.vertices[:, 0], mesh.colours
    assert mesh.part.tolist().count(int(Part.TYRE)) == 24
    assert colours[x > 0.3].unique(dim=0).tolist() == [[1.0, 0.0, 0.0]]
    assert colours[x < -0.3].unique(dim=0).tolist() == [[0.0, 1.0, 0.0]]
    assert colours[x.abs() < 0.2].unique(dim=0).tolist() == [[0.0, 0.0, 1.0]]


def test_glb_colour_factors_are_linear_light(tmp_path: Path) -> None:
    box = trimesh.creation.box((2, 1, 1))
    material = trimesh.visual.material.PBRMaterial(name="m", baseColorFactor=[55, 255, 0, 255])
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    box.export(tmp_path / "a.glb")
    torch.testing.assert_close(
        load_mesh(tmp_path / "a.glb").colours[0], torch.tensor([0.5017, 1.0, 0.0]), atol=5e-3, rtol=0
    )


LINEAR = (0.2, 0.05, 0.6)
SRGB = torch.tensor([0.4845, 0.2478, 0.7977])


def painted_glb(path: Path, colour: tuple[float, ...], dtype: str, factor: tuple[float, ...] | None) -> None:
    """A box with vertex colours of a type, normalised where it is an integer one, and a material's colour."""
    box = trimesh.creation.box((4, 1.5, 1.8))
    most = 1.0 if dtype == "f4" else float(np.iinfo(dtype).max)
    values = np.tile(np.round(np.array([*colour, 1.0]) * most, 0 if most > 1 else 9), (8, 1)).astype(f"<{dtype}")
    blobs = [box.vertices.astype("<f4").tobytes(), box.faces.astype("<u4").tobytes(), values.tobytes()]
    kinds = {"f4": 5126, "u2": 5123, "u1": 5121}
    starts = np.cumsum([0, *map(len, blobs)]).tolist()
    low, high = box.bounds.tolist()
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1}
    if factor is not None:
        primitive["material"] = 0
    message = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [*(factor or (1, 1, 1)), 1]}}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3", "min": low, "max": high},
            {"bufferView": 1, "componentType": 5125, "count": 36, "type": "SCALAR"},
            {"bufferView": 2, "componentType": kinds[dtype], "count": 8, "type": "VEC4", "normalized": most > 1},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(blob)}
            for start, blob in zip(starts, blobs, strict=False)
        ],
        "buffers": [{"uri": "my%20box%20%C3%A9.bin", "byteLength": starts[-1]}],
    }
    (path.parent / "my box é.bin").write_bytes(b"".join(blobs))
    path.write_text(json.dumps(message))


@pytest.mark.parametrize("dtype", ["f4", "u2", "u1"])
@pytest.mark.parametrize(
    ("colour", "factor"), [(LINEAR, None), (LINEAR, (1, 1, 1)), ((1, 1, 1), LINEAR)], ids=["alone", "white", "one"]
)
def test_vertex_colours_of_gltf_are_linear_factors(tmp_path: Path, dtype: str, colour, factor) -> None:
    painted_glb(tmp_path / "a.gltf", colour, dtype, factor)
    colours = load_mesh(tmp_path / "a.gltf").colours
    torch.testing.assert_close(colours, SRGB.expand_as(colours), atol=4e-3, rtol=0)


@pytest.mark.parametrize(
    ("corners", "rows"),
    [(((0.6, 0.5), (0.8, 0.5), (1.0, 0.9)), "column"), (((0.5, 0.0), (0.8, 0.2), (0.6, 0.3)), "row")],
)
def test_a_texture_ends_where_its_coordinates_end(tmp_path: Path, corners, rows: str) -> None:
    image = np.zeros((4, 4, 3), np.uint8)
    image[..., 0] = 255
    image[(slice(None), slice(2, None)) if rows == "column" else (slice(2, None),)] = (0, 0, 255)
    Image.fromarray(image).save(tmp_path / "t.png")
    (tmp_path / "m.mtl").write_text("newmtl paint\nmap_Kd t.png\n")
    box = trimesh.creation.box((4, 1.5, 1.8))
    lines = ["mtllib m.mtl", "usemtl paint", *(f"v {x} {y} {z}" for x, y, z in box.vertices)]
    lines += [f"vt {u} {v}" for u, v in corners]
    lines += [f"f {a + 1}/1 {b + 1}/2 {c + 1}/3" for a, b, c in box.faces]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    assert load_mesh(tmp_path / "a.obj").colours.unique(dim=0).tolist() == [[0.0, 0.0, 1.0]]


def test_parts_named_front_decide_over_the_outline(tmp_path: Path) -> None:
    body, cabin = wedge_car()
    scene = trimesh.Scene({"body-rear": body, "cabin-front": cabin})
    scene.export(tmp_path / "car.glb")
    mesh = load_mesh(tmp_path / "car.glb")
    assert float(mesh.vertices[mesh.vertices[:, 1] < -0.99][:, 0].mean()) > 0.1


def lorry(folder: Path, end: float, windows: str) -> Mesh:
    """A lorry, read from a file, whose lower cab is at this end: as cars are, by its outline it would look the
    other way. windows: the name of the cab's panes."""
    scene = trimesh.Scene()
    for name, extents, centre in (
        ("cargo", (2.4, 1.6, 6.0), (0.0, 1.6, -1.0 * end)),
        ("cab", (2.3, 2.9, 1.5), (0.0, 1.75, 3.0 * end)),
        (windows, (2.0, 0.8, 0.1), (0.0, 2.4, 3.7 * end)),
    ):
        box = trimesh.creation.box(extents=extents, transform=trimesh.transformations.translation_matrix(centre))
        scene.add_geometry(box, geom_name=name, node_name=name)
    scene.export(folder / "lorry.glb")
    return load_mesh(folder / "lorry.glb")


def cab_side(mesh: Mesh) -> float:
    """Where along the vehicle what is highest lies: the cab."""
    return float(mesh.vertices[mesh.vertices[:, 1] < -0.9][:, 0].mean())


@pytest.mark.parametrize("end", [1.0, -1.0])
def test_windows_at_one_end_only_are_a_cabs(tmp_path: Path, end: float) -> None:
    mesh = lorry(tmp_path, end, "glass")
    assert cab_side(mesh) > 0.3
    assert mesh.vertices[mesh.faces[mesh.part == Part.GLASS]][..., 0].mean() > 0.3


@pytest.mark.parametrize("end", [1.0, -1.0])
def test_without_windows_a_lorry_is_taken_for_a_car_and_faces_backwards(tmp_path: Path, end: float) -> None:
    # what makes the test above one: nothing but the windows tells where this lorry's cab is
    assert cab_side(lorry(tmp_path, end, "panel")) < -0.3


@pytest.mark.parametrize("name", ["sedan", "garbage-truck", "ambulance"])
def test_kenney_vehicles_face_forward_with_palette_colours(name: str) -> None:
    file = KENNEY / f"{name}.glb"
    if not file.is_file():
        pytest.skip(f"../shared/data/meshes_kenney/{name}.glb is missing")
    imported = import_mesh(file)
    length, height, width = imported.size_lhw
    assert length > width > 0.8 * height > 0
    assert imported.mesh.colours.unique(dim=0).shape[0] > 20
    assert (
        float(imported.mesh.vertices[imported.mesh.faces[imported.mesh.part == Part.TYRE]][..., 1].mean()) > -0.3
    )


BROKEN = {
    "garbage.glb": b"not a mesh at all",
    "garbage.ply": b"ply\nformat ascii 1.0\nelement vertex x\nend_header\n",
    "empty.obj": b"",
    "points.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\n",
    "flat.obj": b"v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n",
    "plane.obj": b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n",
    "wide.obj": b"v 0 0 0\nv 1e180 0 0\nv 0 1e180 1\nf 1 2 3\n",
    "nan.obj": b"v 0 nan 0\nv 1 0 0\nv 0 1 1\nf 1 2 3\n",
    "cut.glb": b"glTF\x02\x00\x00\x00\xff\x00\x00\x00",
    "notes.txt": b"hello",
}


@pytest.mark.parametrize("name", [*BROKEN, "missing.glb"])
def test_bad_files_are_named_in_one_line(tmp_path: Path, name: str) -> None:
    if name in BROKEN:
        (tmp_path / name).write_bytes(BROKEN[name])
    with pytest.raises(FormatError) as caught:
        load_mesh(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "options", [{"up": "x"}, {"front": "+q"}, {"front": "+y", "up": "y"}, {"metres_per_unit": 0.0}]
)
def test_unknown_options_are_refused(tmp_path: Path, options: dict) -> None:
    with pytest.raises(RangeError):
        import_mesh(tmp_path / "any.obj", **options)


def test_own_files_of_another_version_or_with_lost_parts_are_refused(tmp_path: Path) -> None:
    for change, field in (({"drivesem_mesh": 99}, "drivesem_mesh"), ({"part": [0]}, "part")):
        box = trimesh.creation.box()
        box.metadata = {"drivesem_mesh": 1, "part": [0] * 12} | change
        box.export(tmp_path / "a.glb")
        with pytest.raises(FormatError, match=field):
            load_mesh(tmp_path / "a.glb")


def test_only_full_meshes_are_saved_and_only_as_glb(tmp_path: Path) -> None:
    mesh = template("sedan", 0)
    with pytest.raises(FormatError, match=r"\.glb"):
        save_mesh(mesh, tmp_path / "a.stl")
    with pytest.raises(FormatError, match="faces"):
        save_mesh(replace(mesh, faces=mesh.faces[:0], part=mesh.part[:0]), tmp_path / "a.glb")
    assert list(tmp_path.iterdir()) == []


def test_texture_names_stay_in_the_folder(tmp_path: Path) -> None:
    """A name that leads elsewhere is looked for by its last part, as packs need it."""
    folder = tmp_path / "pack"
    folder.mkdir()
    faces = "f 1/1 2/2 3/1\nf 1/1 3/1 4/2\nf 1/1 4/2 2/2\nf 2/2 4/2 3/1\n"
    points = "v 0 0 0\nv 4 0 0\nv 4 1 0\nv 0 0 2\nvt 0 0\nvt 1 0\n"
    (folder / "a.obj").write_text(f"mtllib a.mtl\n{points}usemtl m\n{faces}")
    (folder / "a.mtl").write_text(f"newmtl m\nmap_Kd {tmp_path}/red.png\n")
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "red.png")
    assert not (load_mesh(folder / "a.obj").colours == torch.tensor([1.0, 0, 0])).all()
    Image.new("RGB", (2, 2), (0, 255, 0)).save(folder / "red.png")
    assert (load_mesh(folder / "a.obj").colours == torch.tensor([0, 1.0, 0])).all()


def claiming(path: Path, **changes: object) -> Path:
    """A glTF of a box, with other values in its JSON."""
    parts = trimesh.Scene(trimesh.creation.box()).export(file_type="gltf")
    for name, content in parts.items():
        (path.parent / name).write_bytes(content)
    message = json.loads(parts["model.gltf"])
    path.write_text(json.dumps(message | {key: change(message) for key, change in changes.items()}))
    return path


def test_files_that_claim_more_than_they_hold(tmp_path: Path) -> None:
    path = tmp_path / "a.gltf"
    big = claiming(
        path, accessors=lambda message: [message["accessors"][0] | {"count": 10**9}, *message["accessors"][1:]]
    )
    with pytest.raises(
        FormatError, match=r"a\.gltf: expected at most 20,000,000 vertices, faces .*, found 1,000,000"
    ):
        load_mesh(big)
    with pytest.raises(FormatError, match=r"a\.gltf: nodes: expected at most 10,000, found 20,000"):
        load_mesh(claiming(path, nodes=lambda message: [message["nodes"][0]] * 20_000))
    head = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    for form in ("ascii", "binary_little_endian"):
        (tmp_path / "a.ply").write_text(head.format(form, 3) + "element face 1000000000\nend_header\n0 0 0\n")
        with pytest.raises(FormatError, match=r"a\.ply: expected at most 20,000,000 .*, found 1,000,000,003"):
            load_mesh(tmp_path / "a.ply")


def test_many_places_of_one_mesh_and_faces_without_vertices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = trimesh.Scene()
    for i in range(20):
        scene.add_geometry(
            trimesh.creation.box(), geom_name="one", transform=trimesh.transformations.scale_matrix(i + 1)
        )
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    load_mesh(tmp_path / "a.glb")
    monkeypatch.setattr(load, "_MAX_FACES", 12)
    with pytest.raises(FormatError, match=r"a\.glb: faces: expected at most 12, found more"):
        load_mesh(tmp_path / "a.glb")
    monkeypatch.undo()
    data = bytearray((tmp_path / "a.glb").read_bytes())
    at = data.index(b"BIN\0") + 4
    wide = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    faces = next(one for one in wide["accessors"] if one["type"] == "SCALAR")
    at += wide["bufferViews"][faces["bufferView"]].get("byteOffset", 0)
    data[at : at + 4] = (1 << 20).to_bytes(4, "little")
    (tmp_path / "a.glb").write_bytes(data)
    with pytest.raises(FormatError, match=r"a\.glb: faces: expected indices of \d+ vertices, found 1048576"):
        load_mesh(tmp_path / "a.glb")


def two_boxes(order: str) -> str:
    """A car of two boxes as OBJ text, 4.2 m long, 1.4 m high, 1.8 m wide.

    Args:
        order: "absolute" indices, "relative" ones behind each box's vertices, "cabin first", or "at the end".
    """
    blocks = []
    for low, high in (((-0.9, 0.2, -2.1), (0.9, 1.0, 2.1)), ((-0.75, 1.0, -1.2), (0.75, 1.6, 0.8))):
        box = trimesh.creation.box(bounds=[low, high])
        blocks.append((["v " + " ".join(map(str, point)) for point in box.vertices.tolist()], box.faces))
    if order == "cabin first":
        blocks.reverse()
    if order in ("absolute", "at the end"):
        shift = (1, 9) if order == "absolute" else (-16, -8)
        faces = [f"f {' '.join(map(str, f + s))}" for (_, fs), s in zip(blocks, shift, strict=True) for f in fs]
        return "\n".join([*blocks[0][0], *blocks[1][0], *faces])
    lines = [[*points, *(f"f {' '.join(map(str, f - 8))}" for f in faces)] for points, faces in blocks]
    return "\n".join(line for block in lines for line in block)


@pytest.mark.parametrize("order", ["absolute", "relative", "cabin first", "at the end"])
def test_relative_indices_count_from_their_line(tmp_path: Path, order: str) -> None:
    (tmp_path / "car.obj").write_text(two_boxes(order))
    imported = import_mesh(tmp_path / "car.obj")
    assert imported.size_lhw == pytest.approx((4.2, 1.4, 1.8))
    assert (len(imported.mesh.vertices), len(imported.mesh.faces)) == (16, 24)
    roof = imported.mesh.vertices[imported.mesh.vertices[:, 1] < -0.99]
    assert sorted(set(np.round(roof[:, 0].tolist(), 3))) == pytest.approx([-1.2 / 4.2, 0.8 / 4.2], abs=1e-3)
    assert (imported.up, imported.notes) == ("y", ())


SOLID = "v 0 0 0\nv 4 0 0\nv 4 1 0\nv 0 1 0\nv 2 0.5 2\n"
SIDES = "f 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n"


@pytest.mark.parametrize(
    ("text", "faces"),
    [
        (SOLID + SIDES + "f 4 3 2 1\n", 6),
        (SOLID + "f 4 3 2 1\nf 5 4 3 2 1\n", 5),
        ((SOLID + SIDES).replace(" ", "\t"), 4),
        ((SOLID + SIDES).replace("\n", "\n  "), 4),
        ((SOLID + SIDES).replace("\n", "\r\n"), 4),
        ((SOLID + SIDES).replace("\n", " # comment 1/2\n"), 4),
        ((SOLID + SIDES).replace("2 5", "2 \\\n5"), 4),
        ("\ufeff" + SOLID + SIDES, 4),
        (SOLID + SIDES + "f 1 2\nl 1 2\np 3\n", 4),
        (SOLID + "vn 0 0 1\n" + SIDES.replace("f 1 2 5", "f 1//1 2//1 5//1"), 4),
    ],
    ids=["quad", "pentagon", "tabs", "indented", "CRLF", "comments", "continued", "BOM", "lines", "normals"],
)
def test_every_spelling_of_an_obj_is_read(tmp_path: Path, text: str, faces: int) -> None:
    (tmp_path / "a.obj").write_bytes(text.encode())
    imported = import_mesh(tmp_path / "a.obj")
    assert (len(imported.mesh.vertices), len(imported.mesh.faces)) == (5, faces)
    assert imported.size_lhw == pytest.approx((4.0, 1.0, 2.0))
    short = ("1 faces with fewer than three corners left out",) if "f 1 2\n" in text else ()
    assert imported.notes == short


@pytest.mark.parametrize(
    ("face", "found"),
    [
        ("0 1 2", "face 5: expected vertices from 1, or from -1 to -5, found 0 1 2"),
        ("-6 1 2", "face 5: expected vertices from 1, or from -1 to -5, found -6 1 2"),
        ("1 2 6", "faces: expected indices of 5 vertices, found vertex 6"),
        ("1 2 x", "expected a readable mesh, with numbers in lines v, vt and f, found f 1 2 x"),
    ],
)
def test_faces_of_missing_vertices_are_refused(tmp_path: Path, face: str, found: str) -> None:
    (tmp_path / "a.obj").write_text(f"{SOLID}{SIDES}f {face}\n")
    with pytest.raises(FormatError, match=rf"a\.obj: {found}"):
        load_mesh(tmp_path / "a.obj")


def test_faces_with_and_without_texture_coordinates_share_a_material(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2), (0, 255, 0)).save(tmp_path / "green tint.png")
    (tmp_path / "my car.mtl").write_text(
        "newmtl body\nmap_Kd -s 1 1 1 green.png\nnewmtl glass\nmap_Kd green tint.png\n"
    )
    faces = "vt 0 0\nvt 1 1\nvn 0 0 1\nf 1/1 2/2 5/-1\nf 2//1 3//1 5//1\nf 3 4 5\n"
    (tmp_path / "a.obj").write_text(f"mtllib my car.mtl\nusemtl glass\n{SOLID}{faces}")
    imported = import_mesh(tmp_path / "a.obj")
    assert imported.mesh.part.tolist() == [int(Part.GLASS)] * 3
    assert imported.mesh.colours.unique(dim=0).tolist() == [[0.0, 1.0, 0.0]]
    assert imported.notes == ("-s 1 1 1 green.png is missing",)


@pytest.mark.parametrize(
    ("head", "files", "notes"),
    [
        ("", {}, ()),
        ("mtllib a.mtl\n", {"a.mtl": "newmtl blue\nKd 0 0 1\n"}, ()),
        ("mtllib a.mtl\nusemtl tyre\n", {}, ("a.mtl is missing", "materials that no file defines: tyre")),
        ("mtllib a.mtl\nusemtl tyre\n", {"a.mtl": "newmtl tyre\nmap_Kd x/t.png\n"}, ("x/t.png is missing",)),
        ("mtllib a.mtl b.mtl\nusemtl tyre\n", {"a.mtl": "", "b.mtl": "newmtl tyre\nKd 0 0 1\n"}, ()),
    ],
    ids=["none", "not used", "no file", "no texture", "two files"],
)
def test_missing_materials_are_noted(tmp_path: Path, head: str, files: dict, notes: tuple) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "a.obj").write_text(head + SOLID + SIDES)
    imported = import_mesh(tmp_path / "a.obj")
    assert imported.notes == notes
    assert imported.mesh.part.tolist() == [int(Part.TYRE if "tyre" in head else Part.PAINT)] * 4
    colour = [0.0, 0.0, 1.0] if "b.mtl" in files else None
    assert colour is None or imported.mesh.colours.unique(dim=0).tolist() == [colour]


def box_gltf(path: Path, edit: Callable[[dict], object] = lambda header: None, positions: str = "<f4") -> Path:
    """Write a box of 4 x 1.5 x 1.8 as glTF: 8 vertices, 12 triangles.

    Args:
        path: The .gltf file.
        edit: Changes the header.
        positions: Type of the positions; integers are normalized.
    """
    box = trimesh.creation.box((4, 1.5, 1.8))
    values = box.vertices if positions == "<f4" else np.round(box.vertices / 2 * 32767)
    blobs = [values.astype(positions).tobytes(), box.faces.astype("<u4").tobytes()]
    (path.parent / "box.bin").write_bytes(b"".join(blobs))
    low, high = values.min(axis=0).tolist(), values.max(axis=0).tolist()
    kind = {"<f4": 5126, "<i2": 5122}[positions]
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": kind, "count": 8, "type": "VEC3", "min": low, "max": high},
            {"bufferView": 1, "componentType": 5125, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(blobs[0])},
            {"buffer": 0, "byteOffset": len(blobs[0]), "byteLength": len(blobs[1])},
        ],
        "buffers": [{"uri": "box.bin", "byteLength": sum(map(len, blobs))}],
    }
    if positions != "<f4":
        header["accessors"][0]["normalized"] = True
        header["nodes"][0]["scale"] = [2, 2, 2]
    edit(header)
    path.write_text(json.dumps(header))
    return path


def _add(header: dict, key: str, *values: object) -> None:
    header.setdefault(key, []).extend(values)


@pytest.mark.parametrize(
    ("edit", "found"),
    [
        (
            lambda h: _add(h, "extensionsRequired", "KHR_draco_mesh_compression"),
            "found KHR_draco_mesh_compression",
        ),
        (lambda h: _add(h, "extensionsRequired", "EXT_meshopt_compression"), "found EXT_meshopt_compression"),
        (lambda h: h["accessors"][0].pop("bufferView"), "accessor 0: expected values in a buffer, found none"),
        (
            lambda h: h["accessors"][1].update(sparse={}),
            "accessor 1: expected values in one buffer, found a sparse",
        ),
        (
            lambda h: h["meshes"][0]["primitives"][0].update(mode=6),
            r"mode: expected triangles or strips \(4 or 5\)",
        ),
        (
            lambda h: h["accessors"][0].update(min=[-2, -0.75, -4]),
            r"accessor 0: expected \(-2.0, -0.75, -4.0\) to \(2.0, 0.75, 0.9\) as .*, found \(-2.0, -0.75, -0.9\) to",
        ),
        (lambda h: h["nodes"].append({"children": [0, 0]}) or h["scenes"][0].update(nodes=[1]), "expected a tree"),
    ],
    ids=["Draco", "meshopt", "no data", "sparse", "fan", "bounds", "graph"],
)
def test_gltf_that_is_not_read_whole_is_refused(tmp_path: Path, edit, found: str) -> None:
    with pytest.raises(FormatError, match=found) as caught:
        load_mesh(box_gltf(tmp_path / "a.gltf", edit))
    assert str(tmp_path / "a.gltf") in str(caught.value)


def _with_hidden_primitives(header: dict) -> None:
    """A mesh without positions at a node with a child, lines, and a camera at the drawn node."""
    _add(header, "cameras", {"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1, "aspectRatio": 1}})
    _add(header, "meshes", {"primitives": [{"attributes": {}}, {"attributes": {"POSITION": 0}, "mode": 1}]})
    header["nodes"] = [{"mesh": 1, "children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "camera": 0}]


@pytest.mark.parametrize(
    ("edit", "notes"),
    [
        (
            _with_hidden_primitives,
            ("primitives without positions, not drawn: 1", "primitives of points or lines, not drawn: 1"),
        ),
        (lambda h: h["nodes"].append({"mesh": 0, "scale": [1, 1, 1]}), ()),
        (lambda h: h["accessors"][0].pop("min"), ()),
        (lambda h: _add(h, "extensionsRequired", "KHR_materials_unlit"), ()),
        (lambda h: _add(h, "extensionsUsed", "EXT_x"), ("glTF extensions that are not read: EXT_x",)),
    ],
    ids=["hidden", "outside of the scene", "no bounds", "material", "extension"],
)
@pytest.mark.parametrize("kind", ["gltf", "glb"])
def test_what_gltf_does_not_draw_is_left_out(tmp_path: Path, kind: str, edit, notes: tuple[str, ...]) -> None:
    path = box_gltf(tmp_path / "a.gltf", edit)
    if kind == "glb":
        header, blob = json.loads(path.read_text()), (tmp_path / "box.bin").read_bytes()
        del header["buffers"][0]["uri"]
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        chunks = [
            (len(text)).to_bytes(4, "little"),
            b"JSON",
            text,
            len(blob).to_bytes(4, "little"),
            b"BIN\0",
            blob,
        ]
        content = b"".join(chunks)
        path = tmp_path / "a.glb"
        path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + (12 + len(content)).to_bytes(4, "little") + content)
    imported = import_mesh(path)
    assert imported.size_lhw == pytest.approx((4.0, 1.5, 1.8))
    assert (len(imported.mesh.vertices), len(imported.mesh.faces)) == (8, 12)
    assert imported.notes == notes


def test_quantized_positions_are_fractions(tmp_path: Path) -> None:
    path = box_gltf(tmp_path / "a.gltf", lambda h: _add(h, "extensionsRequired", "KHR_mesh_quantization"), "<i2")
    assert import_mesh(path).size_lhw == pytest.approx((4.0, 1.5, 1.8), abs=1e-3)


def test_integer_texture_coordinates_are_fractions(tmp_path: Path) -> None:
    """Core glTF allows normalized integers: (0.25, 0.75) from the upper left is the blue quarter."""
    palette = np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (9, 9, 9)]], np.uint8)
    Image.fromarray(palette).save(tmp_path / "palette.png")
    (tmp_path / "uv.bin").write_bytes(np.tile(np.array([16384, 49151], "<u2"), 8).tobytes())

    def paint(header: dict) -> None:
        header["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 2
        header["meshes"][0]["primitives"][0]["material"] = 0
        header["materials"] = [{"name": "m", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
        header["textures"], header["images"] = [{"source": 0}], [{"uri": "palette.png"}]
        values = {"bufferView": 2, "componentType": 5123, "count": 8, "type": "VEC2", "normalized": True}
        _add(header, "accessors", values)
        _add(header, "bufferViews", {"buffer": 1, "byteLength": 32})
        _add(header, "buffers", {"uri": "uv.bin", "byteLength": 32})

    imported = import_mesh(box_gltf(tmp_path / "a.gltf", paint))
    assert imported.mesh.colours.unique(dim=0).tolist() == [[0.0, 0.0, 1.0]]
    assert imported.notes == ()
    (tmp_path / "palette.png").unlink()
    missing = ("palette.png is missing", "the texture of material m is not read")
    assert import_mesh(tmp_path / "a.gltf").notes == missing


def test_unused_vertices_change_no_bounds(tmp_path: Path) -> None:
    text = "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
    text += "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
    text += SOLID.replace("v ", "") + "9 9 9\n3 0 1 4\n4 1 2 3 4\n"
    (tmp_path / "a.ply").write_text(text.format(2))
    imported = import_mesh(tmp_path / "a.ply")
    assert imported.size_lhw == pytest.approx((4.0, 1.0, 2.0))
    assert (len(imported.mesh.vertices), len(imported.mesh.faces)) == (5, 3)
    (tmp_path / "a.ply").write_text(text.format(4))
    with pytest.raises(FormatError, match=r"a\.ply: faces: expected 4 as stated in the file, found 3 after"):
        import_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("spoil", ["vertices", "faces", "graph"])
def test_an_import_that_differs_from_the_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: str
) -> None:
    original = trimesh.load_scene

    def load_wrongly(*args: object, **options: object) -> trimesh.Scene:
        scene = original(*args, **options)
        (shape,), (node,) = scene.geometry.values(), scene.graph.nodes_geometry
        if spoil == "vertices":
            shape.vertices = np.zeros((8, 3))
        elif spoil == "faces":
            shape.update_faces(np.arange(12) > 0)
        else:
            scene.graph.update(node, matrix=trimesh.transformations.translation_matrix((0, 0, 1)))
        return scene

    monkeypatch.setattr(trimesh, "load_scene", load_wrongly)
    with pytest.raises(FormatError, match=r"as stated in the file, found .* after the import") as caught:
        load_mesh(box_gltf(tmp_path / "a.gltf"))
    assert ("expected 12" in str(caught.value)) == (spoil == "faces")


def test_meshes_of_several_primitives_come_in_one_order(tmp_path: Path) -> None:
    def split(header: dict) -> None:
        primitives = header["meshes"][0]["primitives"] = [
            dict(header["meshes"][0]["primitives"][0]) for _ in range(6)
        ]
        for index, primitive in enumerate(primitives):
            header["accessors"].append(header["accessors"][1] | {"count": 3, "byteOffset": 12 * index})
            primitive["indices"] = index + 2

    path = box_gltf(tmp_path / "a.gltf", split)
    first, second = (load_mesh(path) for _ in range(2))
    assert_same(first, second)
    assert len(first.faces) == 6
