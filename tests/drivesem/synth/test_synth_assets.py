"""Vehicles and skies from a user's folders."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yaml

from drivesem.synth import assets
from drivesem.synth.light import draw_light
from drivesem.synth.soup import Material
from drivesem.synth.view import noise_set
from scene_ir.errors import FormatError, RangeError
from scene_ir.meshes.load import save_mesh
from scene_ir.meshes.templates import template
from scene_ir.types import Mesh, Part
from tests.drivesem.synth.reference_light import sky_radiance

KENNEY = Path(__file__).resolve().parents[4] / "shared" / "data" / "meshes_kenney"
UP = np.array([0.0, -1.0, 0.0])


def write_template(path: Path, kind: str, size_lhw: tuple[float, float, float], z_up: bool = False) -> None:
    """A template as other programs export it: y up and looking along +z (or z up, along -y), one mesh a part."""
    mesh = template(kind, 0)
    length, height, width = size_lhw
    points = mesh.vertices.numpy() * [length, height, width]
    points = np.stack([-points[:, 2], -points[:, 1], points[:, 0]], axis=1)
    if z_up:
        points = np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1)
    scene = trimesh.Scene()
    for part in Part:
        faces = mesh.faces.numpy()[mesh.part.numpy() == part]
        if len(faces):
            name = {Part.PAINT: "paint", Part.GLASS: "glass", Part.TYRE: "tire", Part.LIGHT: "headlight"}.get(
                part, "trim"
            )
            shape = trimesh.Trimesh(points, faces[:, ::-1], process=False)
            shape.visual = trimesh.visual.TextureVisuals(
                material=trimesh.visual.material.SimpleMaterial(name=name, diffuse=[120, 120, 120])
            )
            scene.add_geometry(shape, geom_name=name, node_name=name)
    content = scene.export(file_type="glb")
    assert isinstance(content, bytes)
    path.write_bytes(content)


def _ends(mesh: Mesh) -> list[float]:
    """Where along the length windows and tyres are, on average."""
    middle = mesh.vertices[mesh.faces].mean(dim=1)[:, 0]
    return [float(middle[mesh.part == part].mean()) for part in (Part.GLASS, Part.TYRE)]


def gradient(height: int = 32, sun: tuple[int, int] | None = None, power: float = 2e4) -> np.ndarray:
    """A panorama, blue above and pale at the horizon, with a sun of one pixel at (row, column)."""
    rise = np.clip(1 - np.arange(height) / (height / 2), 0, 1)[:, None, None]
    pixels = np.broadcast_to(rise * [0.2, 0.4, 0.9] + (1 - rise) * [0.9, 0.9, 1.0], (height, 2 * height, 3)).copy()
    if sun is not None:
        pixels[sun] = power
    return pixels.astype(np.float32)


def test_a_folder_of_exports_gives_vehicles_the_right_way_round(tmp_path: Path) -> None:
    write_template(tmp_path / "my_sedan.glb", "sedan", (4.5, 1.45, 1.8))
    write_template(tmp_path / "post_van.glb", "van", (5.2, 2.1, 2.0))
    vehicles = assets.meshes_in(tmp_path)
    assert [(v.name, v.kind) for v in vehicles] == [("my_sedan.glb", "sedan"), ("post_van.glb", "van")]
    assert vehicles[0].size_lhw == pytest.approx((4.5, 1.45, 1.8), abs=1e-3)
    mesh = vehicles[0].mesh
    assert mesh.vertices[:, 1].max() == pytest.approx(0, abs=1e-6)
    assert mesh.vertices.amin(dim=0).tolist() == pytest.approx([-0.5, -1.0, -0.5], abs=1e-6)
    tyres = mesh.vertices[mesh.faces[mesh.part == Part.TYRE]].mean(dim=1)[:, 1]
    assert tyres.mean() > -0.4
    # The template's front wheels and ours are at the same place: its front is along +x.
    original = template("sedan", 0)
    assert _ends(mesh) == pytest.approx(_ends(original), abs=1e-3)


def test_which_axis_points_up_is_found(tmp_path: Path) -> None:
    write_template(tmp_path / "a_sedan.glb", "sedan", (4.5, 1.45, 1.8))
    write_template(tmp_path / "b_sedan.glb", "sedan", (4.5, 1.45, 1.8), z_up=True)
    first, second = assets.meshes_in(tmp_path)
    assert (first.up, second.up) == ("y", "z")
    assert second.size_lhw == pytest.approx(first.size_lhw, abs=1e-3)
    assert _ends(second.mesh) == pytest.approx(_ends(first.mesh), abs=1e-4)


def test_of_centimetres_and_toys_usual_sizes_are_made(tmp_path: Path) -> None:
    write_template(tmp_path / "sedan_cm.glb", "sedan", (450.0, 145.0, 180.0))
    write_template(tmp_path / "sedan_toy.glb", "sedan", (2.6, 1.3, 1.5))
    large, toy = assets.meshes_in(tmp_path)
    assert large.size_lhw == pytest.approx((4.5, 1.45, 1.8), rel=0.06)
    assert 3.9 <= toy.size_lhw[0] <= 5.2
    assert 1.25 <= toy.size_lhw[1] <= 1.6


def test_the_sidecar_overrides_and_leaves_out(tmp_path: Path) -> None:
    write_template(tmp_path / "a.glb", "sedan", (4.5, 1.45, 1.8))
    write_template(tmp_path / "b.glb", "sedan", (4.5, 1.45, 1.8))
    before = assets.meshes_in(tmp_path)[0].mesh
    (tmp_path / "vehicles.yaml").write_text(
        yaml.safe_dump(
            {"a.glb": {"kind": "suv", "front": "-z", "size_lhw_m": [4, 1.7, 1.9]}, "b.glb": {"use": False}}
        )
    )
    (only,) = assets.meshes_in(tmp_path)
    assert (only.name, only.kind, only.size_lhw) == ("a.glb", "suv", (4.0, 1.7, 1.9))
    assert _ends(only.mesh) == pytest.approx([-x for x in _ends(before)], abs=1e-5)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"a.glb": {"kind": "rocket"}}, "kind"),
        ({"a.glb": {"front": "ahead"}}, "front"),
        ({"a.glb": {"front": "+y", "up": "y"}}, "front"),
        ({"a.glb": {"up": "w"}}, "up"),
        ({"a.glb": {"size_lhw_m": [1, 2]}}, "size_lhw_m"),
        ({"a.glb": {"metres_per_unit": 0}}, "metres_per_unit"),
        ({"a.glb": {"use": "no"}}, "use"),
        ({"a.glb": {"colour": "red"}}, "colour"),
        ({"a.glb": 3}, "a.glb"),
        ({"b.glb": {}}, "b.glb"),
        ([1], "vehicles.yaml"),
    ],
)
def test_faults_in_the_sidecar_are_named(tmp_path: Path, entry: object, message: str) -> None:
    write_template(tmp_path / "a.glb", "sedan", (4.5, 1.45, 1.8))
    (tmp_path / "vehicles.yaml").write_text(yaml.safe_dump(entry))
    with pytest.raises(FormatError, match=message):
        assets.meshes_in(tmp_path)


def test_what_cannot_be_read_is_listed_and_the_rest_used(tmp_path: Path) -> None:
    write_template(tmp_path / "good.glb", "sedan", (4.5, 1.45, 1.8))
    (tmp_path / "bad.glb").write_bytes(b"glTF rubbish")
    assert [v.name for v in assets.meshes_in(tmp_path)] == ["good.glb"]
    ((name, reason),) = assets.unreadable_in(tmp_path)
    assert name == "bad.glb"
    assert "bad.glb" in reason
    (tmp_path / "good.glb").unlink()
    with pytest.raises(FormatError, match="1 of 1 unreadable"):
        assets.meshes_in(tmp_path)


def test_each_unsuitable_file_is_noted_and_drops_no_other(tmp_path: Path) -> None:
    write_template(tmp_path / "good.glb", "sedan", (4.5, 1.45, 1.8))
    block = "mtllib none.mtl\n" + "".join(f"v {x} {y} {z}\n" for x in (0, 4) for y in (0, 1.5) for z in (0, 1.8))
    (tmp_path / "block.obj").write_text(f"{block}f 1 2 4 3\nf 5 7 8 6\n")
    (tmp_path / "cut.glb").write_bytes((tmp_path / "good.glb").read_bytes()[:3000])
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "gone.obj").symlink_to(tmp_path / "nowhere.obj")
    (tmp_path / "zero.obj").write_text(f"{block}f 0 1 2\n")
    assert [v.name for v in assets.meshes_in(tmp_path)] == ["block.obj", "good.glb"]
    notes = assets.notes_in(tmp_path)
    assert [note.split("/")[-1].split(":")[0] for note in notes[:4]] == [
        "cut.glb",
        "folder.ply",
        "gone.obj",
        "zero.obj",
    ]
    assert all(note.startswith("left out: ") and "expected" in note and "\n" not in note for note in notes[:4])
    assert notes[4:] == ("block.obj: none.mtl is missing",)


def test_one_file_is_read_as_in_its_folder(tmp_path: Path) -> None:
    write_template(tmp_path / "a.glb", "sedan", (4.5, 1.45, 1.8), z_up=True)
    assert assets.read_vehicle(tmp_path / "a.glb") == assets.meshes_in(tmp_path)[0]
    assert assets.read_vehicle(tmp_path / "a.glb").stated_lhw == pytest.approx((4.5, 1.45, 1.8), abs=1e-3)
    (tmp_path / "vehicles.yaml").write_text("a.glb: {front: +y, metres_per_unit: 2, kind: suv}\n")
    vehicle = assets.read_vehicle(tmp_path / "a.glb")
    assert vehicle == assets.meshes_in(tmp_path)[0]
    assert (vehicle.kind, vehicle.up, vehicle.front) == ("suv", "z", "+y")
    assert vehicle.stated_lhw == pytest.approx((9.0, 2.9, 3.6), abs=1e-3)


@pytest.mark.parametrize(
    ("front", "up"), [("+x", "z"), ("-x", "z"), ("auto", "z"), ("+z", "y")], ids=["right", "left", "found", "roof"]
)
def test_up_is_found_for_a_given_front(tmp_path: Path, front: str, up: str) -> None:
    write_template(tmp_path / "a.glb", "sedan", (4.5, 1.45, 1.8), z_up=True)
    (tmp_path / "vehicles.yaml").write_text(f"a.glb: {{front: {front}}}\n")
    assert assets.meshes_in(tmp_path)[0].up == up


def test_a_missing_or_empty_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="nowhere"):
        assets.meshes_in(tmp_path / "nowhere")
    with pytest.raises(FormatError, match=tmp_path.name):
        assets.meshes_in(tmp_path)


def test_splits_are_by_name_alone_and_share_nothing() -> None:
    names = [f"car{i}.glb" for i in range(600)]
    vehicles = [assets.VehicleMesh(name, "sedan", (4.0, 1.5, 1.8), Path(name)) for name in names]
    train, held = assets.of_split(vehicles, "train"), assets.of_split(vehicles[::-1], "heldout")
    assert len(train) + len(held) == 600
    assert not {v.name for v in train} & {v.name for v in held}
    assert 0.27 < len(held) / 600 < 0.40
    with pytest.raises(RangeError, match="test"):
        assets.of_split(vehicles, "test")


@pytest.mark.parametrize(
    ("name", "size", "kind"),
    [
        ("city_bus", (12.0, 3.0, 2.5), "bus"),
        ("DeliveryVan", (5.0, 2.3, 2.0), "van"),
        ("truck", (3.0, 1.3, 1.5), "pickup"),
        ("truck", (7.0, 3.3, 2.5), "truck"),
        ("police-car", (4.6, 1.5, 1.8), "sedan"),
        ("x1", (4.7, 1.45, 1.8), "sedan"),
        ("x2", (3.9, 1.5, 1.75), "hatchback"),
        ("x3", (4.5, 1.7, 1.9), "suv"),
        ("x4", (5.3, 2.2, 2.0), "van"),
        ("x5", (12.0, 3.2, 2.5), "bus"),
    ],
)
def test_kinds_by_name_and_by_proportions(name: str, size: tuple[float, float, float], kind: str) -> None:
    assert assets.classify_vehicle(name, size) == kind


def test_a_palette_body_gets_windows_and_trim() -> None:
    base = template("sedan", 0)
    part = torch.where(base.part == Part.TYRE, int(Part.TYRE), int(Part.PAINT))
    colours = torch.tensor([0.9, 0.3, 0.2]).repeat(base.vertices.shape[0], 1)
    glass = base.faces[base.part == Part.GLASS].unique()
    colours[glass] = torch.tensor([0.9, 0.957, 1.0])
    sills = base.faces[(base.part == Part.OTHER)].unique()
    colours[sills] = torch.tensor([0.42, 0.42, 0.5])
    found = assets.with_parts(Mesh(base.vertices, base.faces, part, "toy", colours)).part
    pure = base.vertices[base.faces][..., 1].mean(dim=1) < -0.45
    assert (found[(base.part == Part.GLASS) & pure] == Part.GLASS).float().mean() > 0.95
    assert (found[base.part == Part.PAINT] == Part.GLASS).float().mean() < 0.2
    assert (found == Part.OTHER).any()
    assert (found[base.part == Part.TYRE] == Part.TYRE).all()


def test_a_soup_has_neutral_paint_and_normals_that_fit_its_size(tmp_path: Path) -> None:
    save_mesh(template("sedan", 3), tmp_path / "sedan.glb")
    (vehicle,) = assets.meshes_in(tmp_path)
    soup = assets.vehicle_soup(vehicle)
    paint = soup.material == Material.PAINT
    assert np.median(soup.albedo[paint]) == pytest.approx(0.5, abs=0.05)
    assert set(np.unique(soup.material)) <= {
        Material.PAINT,
        Material.GLASS,
        Material.TYRE,
        Material.LIGHT,
        Material.TRIM,
    }
    size = np.asarray(vehicle.size_lhw)
    flat = np.cross(*((soup.corners[:, i] - soup.corners[:, 0]) * size for i in (1, 2)))
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    normals = soup.normals.mean(axis=1) / size
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    slanted = soup.material == Material.GLASS
    assert soup.albedo[slanted].max() < 0.03
    assert (flat * normals).sum(axis=1)[slanted].mean() > 0.97
    coarse = assets.vehicle_soup(vehicle, fine=False)
    assert len(coarse) <= 2500 < len(soup)
    assert assets.vehicle_soup(vehicle) is soup


def test_the_sun_is_measured_and_taken_out() -> None:
    plain, sunny = assets.measured("plain", gradient()), assets.measured("sunny", gradient(sun=(8, 40)))
    assert not plain.sunny
    assert plain.sun_colour.max() == 0
    assert sunny.sunny
    assert sunny.sun_elevation == pytest.approx(np.pi / 2 * (1 - 8.5 / 16), abs=1e-6)
    assert sunny.sun_azimuth == pytest.approx((40.5 / 64 - 0.5) * 2 * np.pi, abs=1e-6)
    solid = np.cos(sunny.sun_elevation) * (np.pi / 32) * (2 * np.pi / 64)
    assert sunny.sun_colour.max() == pytest.approx(2e4 * solid / np.pi, rel=0.01)
    assert np.abs(sunny.pixels - plain.pixels).max() < 0.1
    assert sunny.ambient == pytest.approx(plain.ambient, rel=0.02)
    even = assets.measured("even", np.ones((64, 128, 3), np.float32))
    assert even.ambient == pytest.approx(np.ones(3), rel=2e-3)


@pytest.mark.parametrize("pixels", [np.ones((32, 32, 3)), np.full((32, 64, 3), np.nan), -np.ones((32, 64, 3))])
def test_a_faulty_panorama_is_named(pixels: np.ndarray) -> None:
    with pytest.raises(FormatError, match="dusk"):
        assets.measured("dusk", pixels.astype(np.float32))


@pytest.mark.parametrize("sun", [None, (8, 40), (15, 3)])
def test_a_road_under_another_sky_is_as_bright(sun: tuple[int, int] | None) -> None:
    sky = assets.measured("sky", gradient(sun=sun))
    before = draw_light(np.random.default_rng(4), UP, sunny=True)
    after = assets.with_sky(before, sky, np.random.default_rng(7))
    weights = np.array([0.2126, 0.7152, 0.0722])
    levels = [(light.ambient + light.sun_colour * (light.sun @ UP)) @ weights for light in (before, after)]
    assert levels[1] == pytest.approx(levels[0], rel=1e-6)
    assert after.sun @ UP > 0.19
    assert after.sun_colour @ weights < 1.6
    assert after.weather == ("overcast" if sun is None else "sun" if sun[0] == 8 else "dusk")
    assert assets.with_sky(before, sky, np.random.default_rng(7)).sun == pytest.approx(after.sun)


def test_the_picture_has_the_sun_where_shadows_have_it() -> None:
    pixels = gradient(64, sun=(20, 90), power=5e4)
    # A glow around the disc that stays in the picture.
    pixels[14:27, 84:97] += 1.0
    before = draw_light(np.random.default_rng(4), UP, sunny=True)
    after = assets.with_sky(before, assets.measured("sky", pixels), np.random.default_rng(1))
    azimuth = np.linspace(-np.pi, np.pi, 721)
    rise = np.arcsin(after.sun @ UP)
    right, forward = after.ahead
    ring = (
        np.cos(rise) * (np.sin(azimuth)[:, None] * right + np.cos(azimuth)[:, None] * forward) + np.sin(rise) * UP
    )
    bright = sky_radiance(after, ring.astype(np.float32), noise_set(0)).sum(axis=1)
    middle = ring[bright > bright.max() * 0.9].mean(axis=0)
    assert middle / np.linalg.norm(middle) @ after.sun > 0.995


def test_fog_hides_the_sky() -> None:
    rng = np.random.default_rng(0)
    fog = next(light for light in (draw_light(rng, UP, sunny=False) for _ in range(400)) if light.weather == "fog")
    assert assets.with_sky(fog, assets.measured("sky", gradient()), rng) is fog


def test_a_pack_holds_vehicles_and_skies(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="vehicles/"):
        assets.assets_from(tmp_path)
    (tmp_path / "vehicles").mkdir()
    write_template(tmp_path / "vehicles" / "a.glb", "sedan", (4.5, 1.45, 1.8))
    assert assets.assets_from(tmp_path).skies == ()
    (tmp_path / "skies").mkdir()
    np.savez(tmp_path / "skies" / "noon.npz", pixels=gradient(sun=(8, 40)).clip(0, 6e4).astype(np.float16))
    pack = assets.assets_from(tmp_path)
    assert [s.name for s in pack.skies] == ["noon"]
    assert pack.skies[0].sunny
    (tmp_path / "skies" / "broken.npz").write_bytes(b"no archive")
    with pytest.raises(FormatError, match="broken"):
        assets.assets_from(tmp_path)


@pytest.mark.skipif(not KENNEY.is_dir(), reason=f"{KENNEY} is missing")
def test_a_folder_of_toys_is_read_upright_and_forwards() -> None:
    vehicles = assets.meshes_in(KENNEY)
    assert len(vehicles) == 14
    kinds = {v.name: v.kind for v in vehicles}
    assert kinds["sedan.glb"] == "sedan"
    assert kinds["firetruck.glb"] == "truck"
    assert kinds["ambulance.glb"] == "van"
    assert kinds["truck.glb"] == "pickup"
    for vehicle in vehicles:
        mesh = vehicle.mesh
        middle = mesh.vertices[mesh.faces].mean(dim=1)
        assert middle[mesh.part == Part.TYRE][:, 1].mean() > -0.4, vehicle.name
        assert (mesh.part == Part.GLASS).any(), vehicle.name
        assert 1.7 < vehicle.size_lhw[0] / vehicle.size_lhw[1] < 4.0
    assert assets.unreadable_in(KENNEY) == ()
