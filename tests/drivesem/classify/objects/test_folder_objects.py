"""Objects from folders: ShapeNetCore's layout, meshes by class, materials, splits, files that are no objects."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.objects.folders import SHAPENET, FolderObjects
from drivesem.classify.objects.types import CLASSES
from scene_ir.errors import FormatError, RangeError

BUS, CAR = "02924116", "02958343"
CUBE = trimesh.creation.box((2.0, 1.0, 4.0))
KENNEY = Path(__file__).resolve().parents[4] / "shared" / "data" / "meshes_kenney"
MTL = "newmtl red\nKd 0.8 0.1 0.2\nKs 0.5 0.5 0.5\nNs 40\nnewmtl blue\nKd 0 0 1\nKs 0 0 0\nNs 5\n"


def obj_text(mesh: trimesh.Trimesh = CUBE, library: str = "model_normalized.mtl") -> str:
    """A mesh as OBJ, its first half of faces red, the others blue."""
    lines = [f"mtllib {library}", *("v {} {} {}".format(*v) for v in mesh.vertices + 3.0)]
    half = len(mesh.faces) // 2
    for name, faces in (("red", mesh.faces[:half]), ("blue", mesh.faces[half:])):
        lines += [f"usemtl {name}", *("f {} {} {}".format(*(f + 1)) for f in faces)]
    return "\n".join(lines) + "\n"


def shapenet(root: Path, synset: str, code: str, mesh: str | None = None, mtl: str = MTL) -> Path:
    """One object in ShapeNetCore's second layout."""
    folder = root / synset / code / "models"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model_normalized.obj").write_text(obj_text() if mesh is None else mesh)
    (folder / "model_normalized.mtl").write_text(mtl)
    return folder


def test_an_object_with_its_materials(tmp_path: Path) -> None:
    shapenet(tmp_path, BUS, "abc")
    objects = open_objects(str(tmp_path))
    assert objects.classes == CLASSES
    model = objects.load("bus/abc")
    assert (model.name, model.label) == ("bus/abc", 3)
    vertices = model.mesh.vertices
    extent = vertices.amax(0) - vertices.amin(0)
    torch.testing.assert_close(extent, torch.tensor([0.5, 0.25, 1.0]))
    torch.testing.assert_close(vertices.amax(0) + vertices.amin(0), torch.zeros(3))
    red = model.specular > 0
    assert int(red.sum()) == 6
    torch.testing.assert_close(model.diffuse[red], torch.tensor([[0.8, 0.1, 0.2]]).expand(6, 3))
    torch.testing.assert_close(model.specular[red], torch.full((6,), 0.5))
    assert set(model.shininess[red].tolist()) == {40.0}
    assert set(model.shininess[~red].tolist()) == {5.0}
    corners = vertices[model.mesh.faces]
    assert float(torch.det(corners).sum()) / 6 == pytest.approx(0.125, rel=1e-4)  # outwards as in the file


@pytest.mark.parametrize(
    ("lines", "diffuse", "specular", "shininess"),
    [
        ("", 0.5, 0.1, 10.0),
        ("Kd 0.25 0.25 0.25\n", 0.25, 0.1, 10.0),
        ("Ks 0.75 0.75 0.75\nNs -5\n", 0.5, 0.75, 0.0),
        ("Kd nan 0 0\nKs 1e999 0 0\nNs nan\n", 0.5, 0.1, 10.0),
        ("Kd 7 7 7\nKs -1 -1 -1\nNs 1e30\n", 1.0, 0.0, 1000.0),
        ("Kd a b c\nKs 1 1\n", 0.5, 0.1, 10.0),
    ],
)
def test_missing_and_invalid_materials(
    tmp_path: Path, lines: str, diffuse: float, specular: float, shininess: float
) -> None:
    shapenet(tmp_path, BUS, "abc", mtl=f"newmtl red\n{lines}newmtl blue\n{lines}")
    model = open_objects(str(tmp_path)).load("bus/abc")
    assert model.diffuse.unique().tolist() == pytest.approx([diffuse])
    assert model.specular.unique().tolist() == pytest.approx([specular])
    assert model.shininess.unique().tolist() == [shininess]


def test_a_texture_in_another_folder_is_averaged(tmp_path: Path) -> None:
    text = "mtllib model_normalized.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0.1 0.1\nvt 0.4 0.1\nvt 0.1 0.4\n"
    text += "usemtl red\nf 1/1 3/2 2/3\nf 1/1 2/2 4/3\nf 1/1 4/2 3/3\nf 2/1 3/2 4/3\n"
    shapenet(tmp_path, BUS, "abc", text, "newmtl red\nKd 1 1 1\nmap_Kd ../images/texture0.png\n")
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[4:, :4] = (255, 0, 188)  # low in the picture is low in texture coordinates
    (tmp_path / BUS / "abc" / "images").mkdir()
    Image.fromarray(pixels).save(tmp_path / BUS / "abc" / "images" / "texture0.png")
    model = open_objects(str(tmp_path)).load("bus/abc")
    torch.testing.assert_close(model.diffuse, torch.tensor([[1.0, 0.0, 0.5028865]]).expand(4, 3))


def test_what_a_material_names_elsewhere_is_not_read(tmp_path: Path) -> None:
    """A file outside the object's folder, a device, a huge file: the object comes without it."""
    Image.fromarray(np.full((4, 4, 3), 255, np.uint8)).save(tmp_path / "secret.png")
    names = {"a": "../../../secret.png", "b": "/dev/zero", "c": str(tmp_path / "secret.png"), "e": "huge.png"}
    (tmp_path / BUS / "e" / "models").mkdir(parents=True)
    with (tmp_path / BUS / "e" / "models" / "huge.png").open("wb") as stream:
        stream.write((tmp_path / "secret.png").read_bytes())
        stream.truncate((1 << 28) + 1)  # sparse: takes no room
    for code, name in names.items():
        shapenet(tmp_path, BUS, code, mtl=MTL.replace("Kd 0 0 1", f"Kd 0 0 1\nmap_Kd {name}"))
        model = open_objects(str(tmp_path)).load(f"bus/{code}")
        assert float(model.diffuse[:, 1].max()) < 0.2
    shapenet(tmp_path, BUS, "d", obj_text(library="/dev/zero"))
    assert open_objects(str(tmp_path)).load("bus/d").mesh.faces.shape == (12, 3)


HOSTILE = {
    "nothing": ("", "a mesh with faces"),
    "words": ("this is no mesh\n", "a mesh with faces"),
    "a point": ("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "an object with some extent"),
    "a line": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "at least one face with an area"),
    "NaN": ("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
    "infinity": ("v inf 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
    "too far apart": ("v 1e308 0 0\nv -1e308 0 0\nv 0 1 0\nf 1 2 3\n", "some extent"),
    "out of range": ("v 0 0 0\nv 1 0 0\nf 1 2 9\n", "indices of 2 vertices, found vertex 9"),
}


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("what", HOSTILE)
def test_a_file_that_is_no_object(tmp_path: Path, what: str) -> None:
    text, expected = HOSTILE[what]
    folder = shapenet(tmp_path, CAR, "abc", text)
    with pytest.raises(FormatError) as error:
        open_objects(str(tmp_path)).load("car/abc")
    message = str(error.value)
    assert message.startswith(str(folder / "model_normalized.obj"))
    assert expected in message
    assert "\n" not in message


def test_missing_and_odd_files(tmp_path: Path) -> None:
    folder = shapenet(tmp_path, CAR, "abc")
    (folder / "model_normalized.obj").unlink()
    with pytest.raises(FormatError, match=r"model_normalized\.obj: expected a mesh file, found no such file"):
        open_objects(str(tmp_path)).load("car/abc")
    (folder / "model_normalized.obj").mkdir()
    with pytest.raises(FormatError, match=r"model_normalized\.obj: expected a mesh file"):
        open_objects(str(tmp_path)).load("car/abc")
    with pytest.raises(RangeError, match="object: expected one of the 1 in"):
        open_objects(str(tmp_path)).load("car/../abc")


def test_a_file_too_large_is_not_read(tmp_path: Path) -> None:
    folder = shapenet(tmp_path, CAR, "abc")
    with (folder / "model_normalized.obj").open("r+b") as stream:
        stream.truncate((1 << 28) + 1)  # sparse: takes no room
    with pytest.raises(FormatError, match="at most 268,435,456 bytes"):
        open_objects(str(tmp_path)).load("car/abc")


@pytest.mark.parametrize("content", [None, "readme.txt"])
def test_a_folder_without_objects(tmp_path: Path, content: str | None) -> None:
    if content:
        (tmp_path / content).write_text("")
    with pytest.raises(FormatError, match=r"expected ShapeNetCore's folders, or .* by class, found no object"):
        open_objects(str(tmp_path))
    with pytest.raises(FormatError, match="a folder of objects, found no such folder"):
        open_objects(str(tmp_path / "none"))


@pytest.mark.parametrize("listed", ["bus/a", f"{BUS}/a", "a"])
def test_lists_of_splits(tmp_path: Path, listed: str) -> None:
    for code in "abc":
        shapenet(tmp_path, BUS, code)
    (tmp_path / "splits.json").write_text(json.dumps({"train": [listed], "test": ["b"]}))
    objects = open_objects(str(tmp_path))
    assert [objects.names(s) for s in ("train", "val", "test")] == [("bus/a",), (), ("bus/b",)]
    (tmp_path / "splits.json").unlink()
    (tmp_path / "test.txt").write_text(f"c\n{listed}\n")
    assert open_objects(str(tmp_path)).names("test") == ("bus/a", "bus/c")


def test_names_with_blanks_have_a_line(tmp_path: Path) -> None:
    for name in ("my box", "my", "ball"):
        folder = tmp_path / ("cat" if name == "ball" else "dog")
        folder.mkdir(exist_ok=True)
        CUBE.export(folder / f"{name}.ply")
    (tmp_path / "train.txt").write_text("dog/my box\n\n  cat/ball \n")
    assert open_objects(str(tmp_path)).names("train") == ("cat/ball", "dog/my box")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("cat/one", "cat/two"), "expected objects of at least two classes, found only cat"),
        (("fire/truck-3", "fire-truck/3"), "names that differ with - for /, found fire-truck-3 twice"),
    ],
)
def test_folders_without_distinct_names_or_classes(tmp_path: Path, names: tuple[str, ...], message: str) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        CUBE.export(tmp_path / f"{name}.ply")
    with pytest.raises(FormatError, match=message):
        open_objects(str(tmp_path))


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        ('{"train": ["bus/z"]}', r"splits\.json: train: expected objects of .*, found 'bus/z'"),
        ('{"train": ["a"], "test": ["bus/a"]}', r"splits\.json: test: expected objects of no other split"),
        ('{"train": "a"}', r"splits\.json: train: expected a list of names, found str"),
        ('{"exam": ["a"]}', r"splits\.json: expected lists by train, val, test"),
        ("[", r"splits\.json:1:2: expected JSON"),
    ],
)
def test_lists_that_do_not_fit(tmp_path: Path, lists: str, message: str) -> None:
    shapenet(tmp_path, BUS, "a")
    (tmp_path / "splits.json").write_text(lists)
    with pytest.raises(FormatError, match=message) as error:
        open_objects(str(tmp_path))
    assert "\n" not in str(error.value)


def test_splits_are_drawn_by_seed_and_share_nothing(tmp_path: Path) -> None:
    for code in range(20):
        shapenet(tmp_path, BUS, f"{code:02d}")
    first, again, other = (FolderObjects(tmp_path, seed=seed) for seed in (0, 0, 1))
    sizes = [len(first.names(split)) for split in ("train", "val", "test")]
    assert sizes == [14, 2, 4]
    assert first.names("train") == again.names("train") != other.names("train")
    assert len({name for split in ("train", "val", "test") for name in first.names(split)}) == 20


def test_the_papers_sizes_where_there_are_enough(tmp_path: Path) -> None:
    for code in range(80):
        (tmp_path / "03710193" / f"{code:03d}").mkdir(parents=True)
    objects = FolderObjects(tmp_path)
    sizes = {name: numbers for name, (_, numbers) in SHAPENET.items()}
    assert [len(objects.names(split)) for split in ("test", "train", "val")] == [15, 53, 8]
    assert np.array(list(sizes.values())).sum(axis=0).tolist() == [3670, 12843, 1835]
    assert tuple(sizes) == CLASSES


def test_meshes_by_class(tmp_path: Path) -> None:
    for folder in ("cat", "dog"):
        (tmp_path / folder).mkdir()
        for name, mesh in (("one", CUBE), ("two", trimesh.creation.icosphere(3))):
            mesh.export(tmp_path / folder / f"{name}.ply")
        (tmp_path / folder / "notes.txt").write_text("")
    objects = open_objects(str(tmp_path), max_triangles=400)
    assert objects.classes == ("cat", "dog")
    assert len(objects.names("train")) + len(objects.names("val")) + len(objects.names("test")) == 4
    assert objects.load("dog/one").label == 1
    ball = objects.load("cat/two")
    assert 300 < ball.mesh.faces.shape[0] <= 400 == len(ball.diffuse) + 400 - ball.mesh.faces.shape[0]
    assert FolderObjects(tmp_path).load("cat/two").mesh.faces.shape[0] == 1280
    with pytest.raises(RangeError, match="max_triangles: expected at least 4"):
        FolderObjects(tmp_path, max_triangles=3)
    CUBE.export(tmp_path / "cat" / "one.obj")
    with pytest.raises(FormatError, match=r"expected one mesh per name, found also one\.obj"):
        open_objects(str(tmp_path))


def test_gltfs_front_is_turned(tmp_path: Path) -> None:
    """A wedge whose thick end is at +z, glTF's front, has it at -z afterwards."""
    (tmp_path / "car").mkdir()
    wedge = trimesh.creation.box((1.0, 1.0, 2.0))
    wedge.vertices[(wedge.vertices[:, 2] < 0) & (wedge.vertices[:, 1] > 0), 1] = -0.4
    wedge.export(tmp_path / "car" / "wedge.glb")
    model = open_objects(str(tmp_path)).load("car/wedge")
    top = model.mesh.vertices[model.mesh.vertices[:, 1] > 0.2]
    assert top[:, 2].max() < 0
    assert model.label == CLASSES.index("car")
    corners = model.mesh.vertices[model.mesh.faces]
    assert float(torch.det(corners).sum()) > 0


@pytest.mark.skipif(not KENNEY.is_dir(), reason=f"{KENNEY} is missing")
def test_a_kit_of_cars_from_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "car").mkdir()
    shutil.copytree(KENNEY, tmp_path / "car", dirs_exist_ok=True)
    objects = open_objects(str(tmp_path))
    for name in objects.names("train"):
        assert objects.load(name).diffuse.std() > 0.05


@pytest.mark.parametrize("most", [None, 200])
def test_vertices_that_no_face_has_are_left_out(tmp_path: Path, most: int | None) -> None:
    """Of a file, and of what simplifying leaves over: an attack on vertices would move them all the same."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    lonely = "v 9 9 9\n" + obj_text(ball).replace("f ", "F ")
    lines = [
        "f " + " ".join(str(int(i) + 1) for i in line[2:].split()) if line.startswith("F ") else line
        for line in lonely.splitlines()
    ]
    shapenet(tmp_path, BUS, "abc", "\n".join(lines))
    mesh = open_objects(str(tmp_path), max_triangles=most).load("bus/abc").mesh
    assert (len(mesh.faces) <= 200) == (most is not None)
    assert torch.equal(mesh.faces.unique(), torch.arange(len(mesh.vertices)))
    assert float((mesh.vertices.amax(0) - mesh.vertices.amin(0)).max()) == pytest.approx(1.0, rel=1e-3)
