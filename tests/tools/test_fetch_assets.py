"""The converter behind the optional pack of vehicles and skies, on made-up packages."""

from __future__ import annotations

import base64
import io
import sys
import tarfile
import zipfile
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh
import yaml

from drivesem.synth.assets import assets_from
from scene_ir.errors import FormatError
from scene_ir.types import Part
from tests.tools.loading import tool

TOOLS = Path(__file__).parents[2] / "tools"
CATALOGUE = """# made up
license=Creative Commons Attribution 3.0 Unported license  \xa9 nobody
name#1=Seat
category#1=Vehicles
model#1=/scopia/seat_leon/car.obj
width#1=180
depth#1=420
height#1=150
creator#1=Somebody
name#2=Chair
model#2=/scopia/chair/chair.obj
width#2=50
depth#2=50
height#2=90
"""


@pytest.fixture(scope="module", name="tool")
def script() -> ModuleType:
    return tool("fetch_assets")


def box_obj(
    name: str, low: tuple[float, ...], high: tuple[float, ...], first: int, inside_out: bool = False
) -> str:
    """A box of one material in OBJ's text, its vertices numbered from `first`."""
    box = trimesh.creation.box(bounds=[low, high])
    faces = box.faces[:, ::-1] if inside_out else box.faces
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + [f"usemtl {name}"]
    return "\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in faces + first)]) + "\n"


def library() -> bytes:
    """A furniture library with a car of boxes: body, cabin towards the rear, wheels, and a seat inside."""
    obj = "mtllib car.mtl\n"
    pieces = [
        ("chapa_roja", (-90.0, 30.0, -210.0), (90.0, 90.0, 210.0), False),
        ("cristales", (-80.0, 90.0, -200.0), (80.0, 150.0, 40.0), True),
        ("asientos", (-20.0, 100.0, -60.0), (20.0, 130.0, -20.0), False),
        ("neumaticos", (-90.0, 0.0, 100.0), (90.0, 30.0, 160.0), False),
        ("neumaticos", (-90.0, 0.0, -160.0), (90.0, 30.0, -100.0), False),
    ]
    for i, (name, low, high, inside_out) in enumerate(pieces):
        obj += box_obj(name, low, high, 1 + 8 * i, inside_out)
    colours = {
        "chapa_roja": "0.8 0.1 0.1",
        "cristales": "0.1 0.1 0.2",
        "asientos": "1 0 1",
        "neumaticos": "0.9 0.9 0.9",
    }
    mtl = "".join(f"newmtl {name}\nKd {colour}\n" for name, colour in colours.items())
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", CATALOGUE.encode("latin-1"))
        archive.writestr("scopia/seat_leon/car.obj", obj)
        archive.writestr("scopia/seat_leon/car.mtl", mtl)
        archive.writestr("scopia/chair/chair.obj", box_obj("wood", (0, 0, 0), (1, 1, 1), 1))
    return out.getvalue()


def deb(content: bytes) -> bytes:
    """A Debian package that holds one furniture library."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:xz") as tar:
        member = tarfile.TarInfo("./usr/share/sweethome3d/furniture/Made.sh3f")
        member.size = len(content)
        tar.addfile(member, io.BytesIO(content))
    out = b"!<arch>\n"
    for name, body in (("debian-binary", b"2.0"), ("data.tar.xz", data.getvalue())):
        out += (
            f"{name:<16}{0:<12}{0:<6}{0:<6}{'100644':<8}{len(body):<10}`\n".encode()
            + body
            + b"\n" * (len(body) % 2)
        )
    return out


@pytest.fixture(scope="module")
def pack(tool: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pack")
    with zipfile.ZipFile(io.BytesIO(library())) as archive:
        assert len(list(tool.add_vehicles(archive, tool.AssetPack(root)))) == 1
    return root


def test_a_catalogue_gives_sizes_in_metres_and_who_made_them(tool: ModuleType) -> None:
    with zipfile.ZipFile(io.BytesIO(library())) as archive:
        car, chair = tool.catalogue(archive)
    assert car.size_lhw_m == pytest.approx((4.2, 1.5, 1.8))
    assert (car.folder, car.author) == ("scopia/seat_leon", "Somebody")
    assert car.licence == "Creative Commons Attribution 3.0 Unported"
    assert chair.name == "Chair"


def test_a_car_becomes_a_vehicle_of_the_pack(pack: Path) -> None:
    (vehicle,) = assets_from(pack).vehicles
    assert (vehicle.name, vehicle.kind) == ("seat-leon.glb", "hatchback")
    assert vehicle.size_lhw == pytest.approx((4.2, 1.5, 1.8), abs=1e-3)
    mesh = vehicle.mesh
    corners = mesh.vertices[mesh.faces]
    middle = corners.mean(dim=1)
    # The cabin stands behind the middle, the wheels on the ground.
    assert middle[mesh.part == Part.GLASS][:, 0].mean() < -0.1
    assert mesh.vertices[mesh.faces[mesh.part == Part.TYRE]][..., 1].max() == 0
    # What was inside out is turned; the seat behind the windows is gone, the tyres are black.
    normal = (corners[:, 1] - corners[:, 0]).cross(corners[:, 2] - corners[:, 0], dim=1)
    roof = (mesh.part == Part.GLASS) & (middle[:, 1] < -0.99)
    assert roof.any()
    assert (normal[roof][:, 1] < 0).all()
    assert not (mesh.part == Part.OTHER).any()
    assert mesh.colours is not None
    assert mesh.colours[mesh.faces[mesh.part == Part.TYRE]].max() < 0.21


def test_what_is_there_is_not_made_again(tool: ModuleType, pack: Path) -> None:
    before = (pack / "vehicles" / "seat-leon.glb").stat().st_mtime_ns
    with zipfile.ZipFile(io.BytesIO(library())) as archive:
        assert list(tool.add_vehicles(archive, tool.AssetPack(pack))) == []
        assert (pack / "vehicles" / "seat-leon.glb").stat().st_mtime_ns == before
        # A file that was written before its line in the list counts as missing.
        (pack / "vehicles" / "vehicles.yaml").write_text("{}")
        assert len(list(tool.add_vehicles(archive, tool.AssetPack(pack)))) == 1
    listed = yaml.safe_load((pack / "vehicles" / "vehicles.yaml").read_text())
    assert listed["seat-leon.glb"]["author"] == "Somebody"
    assert "Somebody" in tool.licences(tool.AssetPack(pack), ["park.npz"])


def test_textures_are_cut_into_faces_only_where_they_vary(tool: ModuleType) -> None:
    from PIL import Image

    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:, 32:] = 255
    visual = trimesh.visual.TextureVisuals(
        uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]),
        material=trimesh.visual.material.SimpleMaterial(image=Image.fromarray(picture)),
    )
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1.0, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    corners, colours = tool._coloured(square, faces, visual, (0.1, 0.2))
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert area.sum() == pytest.approx(1)
    assert len(corners) > 100
    clear = np.abs(corners.mean(axis=1)[:, 0] - 0.5) > 0.05
    assert (colours[clear, 0] == (corners.mean(axis=1)[clear, 0] > 0.5)).all()
    visual.material.image = Image.fromarray(np.full((8, 8, 3), 128, np.uint8))
    corners, colours = tool._coloured(square, faces, visual, (0.1, 0.2))
    assert len(corners) == 2
    assert colours == pytest.approx(0.5)


def test_debian_packages_are_read_without_debians_tools(tool: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "made.deb"
    packed = library()  # once: a zip archive holds the time at which it was made
    path.write_bytes(deb(packed))
    ((name, content),) = tool.members(path)
    assert name == "Made.sh3f"
    assert content == packed
    path.write_bytes(b"something else")
    with pytest.raises(FormatError, match=r"made\.deb"):
        list(tool.members(path))


def test_a_missing_client_is_one_clear_line(tool: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"no-such-program.*not found; give it by --deb"):
        tool.run(["no-such-program"], tmp_path, "give it by --deb")
    with pytest.raises(FormatError, match="oh no; give it"):
        tool.run([sys.executable, "-c", "raise SystemExit('oh no')"], tmp_path, "give it by --deb")


def test_skies_are_read_from_javascript(tool: ModuleType, tmp_path: Path) -> None:
    import OpenEXR

    pixels = np.random.default_rng(0).uniform(0, 9, (16, 32, 3)).astype(np.float16)
    path = tmp_path / "a.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": pixels}).write(str(path))
    module = "export default 'data:application/exr;base64," + base64.b64encode(path.read_bytes()).decode() + "'"
    assert tool.equirectangular(module, "a") == pytest.approx(pixels.astype(np.float32))
    with pytest.raises(FormatError, match="nothing"):
        tool.equirectangular("export default 3", "nothing")


def test_the_sky_is_drawn_down_over_its_skyline(tool: ModuleType) -> None:
    elevation = 90 - (np.arange(180) + 0.5)
    pixels = np.repeat(elevation[:, None, None], 3, axis=2).astype(np.float32) * np.ones((1, 360, 1), np.float32)
    low = tool.without_skyline(pixels, 10.0)[:, 0, 0]
    assert low[:39] == pytest.approx(elevation[:39], abs=1e-3)
    assert low[elevation > 0].min() == pytest.approx(10.0, abs=1.0)
    assert (np.diff(low[:90]) < 0).all()
    assert low[90:] == pytest.approx(elevation[90:])
