"""A scene on disk: exact round trip, and one line for every malformed file."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_scene, save_scene
from scene_ir.types import WEATHER_DIM, Camera, Crop, Environment, Labels, Mesh, Objects, SceneIR, Source

H, W = 12, 20


def rich_scene(seed: int = 0, count: int = 2, **changes: Any) -> SceneIR:
    """A scene in which every optional thing is present and no number is round."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=g)

    photograph = torch.randint(0, 256, (3, H, W), generator=g).to(torch.float32) / 255
    depth = rand(H, W) * 80
    depth[:3] = torch.inf
    meshes = (
        Mesh(
            rand(5, 3), torch.tensor([[0, 1, 2], [2, 3, 4]]), torch.tensor([0, 3]), "sedan", rand(5, 3), rand(5, 2)
        ),
        Mesh(rand(3, 3), torch.tensor([[0, 1, 2]]), torch.tensor([4])),
    )
    source = tuple(
        Source(
            rand(3),
            rand(1)[0],
            rand(3),
            rand(64, 3),
            Crop(rand(4, 3, 5), 2, 1),
            shadow,
            0.07 + i,
            rand(3),
            0.3 + i,
            region,
        )
        for i, shadow, region in zip(
            range(count), (Crop(rand(3, 4, 2), 0, 6), None), (None, Crop(rand(1, 3, 5), 2, 1)), strict=False
        )
    )
    objects = Objects(
        mesh_index=torch.arange(count) % 2,
        translation=rand(count, 3) * 30,
        yaw=rand(count) - 0.5,
        size_lhw=rand(count, 3) + 1,
        ffd=rand(count, 64, 3) * 0.1,
        texture_code=rand(count, 5),
        category=torch.arange(count),
        box2d=rand(count, 4) * 20,
        truncation=rand(count),
        occlusion=torch.arange(count),
        source=source,
    )
    environment = Environment(rand(4), rand(3), rand(3), rand(4), rand(H, W), rand(H, W), rand(H, W))
    scene = SceneIR(
        camera=Camera(torch.eye(3) * 700.1, H, W, rand(3, 4)),
        meshes=meshes,
        objects=objects,
        environment=environment,
        photograph=photograph,
        background=rand(3, H, W),
        depth=depth,
        ignore=rand(1, 4) * 9,
        provenance={"dataset": "kitti", "Straße": "läßt"},
        other_labels=Labels(
            ("Cyclist",), rand(1, 4), torch.tensor([torch.nan]), torch.tensor([3]), rand(1, 3), rand(1),
            rand(1, 3), torch.zeros(0, 4),
        ),
    )  # fmt: skip
    return dataclasses.replace(scene, **changes)


def assert_same(a: Any, b: Any, where: str = "scene") -> None:
    """Equal types, dtypes, shapes and bits, all the way down."""
    assert type(a) is type(b) or isinstance(a, dict), where
    if isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype, where
        assert torch.equal(a.detach().nan_to_num(12345.0), b.nan_to_num(12345.0)), where
        assert torch.equal(a.isnan(), b.isnan()), where
        assert torch.equal(a.signbit(), b.signbit()), where
    elif dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}[{i}]")
    else:
        assert a == b, where


def float64_camera() -> Camera:
    return Camera(torch.tensor([[1 / 3 + 700, 0, 10], [0, 700, 6], [0, 0, 1]], dtype=torch.float64), H, W)


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(rich_scene(), id="rich"),
        pytest.param(rich_scene(count=0), id="no-objects"),
        pytest.param(rich_scene(camera=float64_camera()), id="float64-no-projection"),
        pytest.param(
            rich_scene(ignore=torch.zeros(0, 4), other_labels=None, meshes=rich_scene().meshes[::-1]),
            id="no-ignore",
        ),
        pytest.param(
            rich_scene().with_objects(box2d=torch.tensor([[torch.nan] * 4, [-torch.inf, 0, 1, 2]])), id="nan"
        ),
        pytest.param(
            rich_scene(photograph=rich_scene().background, background=rich_scene().photograph), id="swap"
        ),
        pytest.param(
            rich_scene(photograph=rich_scene().photograph.double(), depth=rich_scene().depth.double()),
            id="float64",
        ),
        pytest.param(rich_scene().with_objects(source=()), id="no-sources"),
        pytest.param(rich_scene(background=-torch.zeros(3, H, W)), id="negative-zero"),
    ],
)
def test_round_trip_is_exact(scene: SceneIR, tmp_path: Path) -> None:
    save_scene(scene, tmp_path / "scene")
    assert_same(scene, load_scene(tmp_path / "scene"))


def test_a_lossy_scene_is_near_and_loads_as_often_as_it_is_saved(tmp_path: Path) -> None:
    scene = rich_scene()
    smooth = torch.linspace(0, 1, W).expand(3, H, W)  # noise is not what JPEG is for
    changed = smooth.clone()
    changed[:, 4:9, 5:12] = 0.3
    scene = dataclasses.replace(scene, photograph=smooth, background=changed)
    save_scene(scene, tmp_path / "a", lossy=True)
    near = load_scene(tmp_path / "a")
    assert near.photograph == pytest.approx(smooth.numpy(), abs=0.02)
    assert near.background == pytest.approx(changed.numpy(), abs=0.05)
    same = torch.ones(H, W, dtype=torch.bool)
    same[4:9, 5:12] = False
    assert torch.equal(near.background[:, same], near.photograph[:, same]), "no seam where nothing is behind"
    known = scene.depth.isfinite()
    assert torch.equal(near.depth.isfinite(), known)
    assert near.depth[known] == pytest.approx(scene.depth[known].numpy(), rel=0.0021, abs=0.01)
    assert near.environment.road == pytest.approx(scene.environment.road.numpy(), abs=0.5 / 31 + 0.5 / 255)
    assert near.objects.source[0].foreground.values == pytest.approx(
        scene.objects.source[0].foreground.values.numpy(), abs=0.5 / 255 + 1e-6
    )
    assert_same(near.objects.translation, scene.objects.translation)
    assert_same(near.meshes, scene.meshes)
    save_scene(scene, tmp_path / "b", lossy=True)
    assert_same(load_scene(tmp_path / "b"), near)


def test_perturbed_tensors_are_saved_without_their_gradient(tmp_path: Path) -> None:
    theta = torch.full((2,), 0.1, requires_grad=True)
    scene = rich_scene()
    moved = scene.with_objects(yaw=scene.objects.yaw + theta).with_environment(
        weather=scene.environment.weather * theta[0]
    )
    save_scene(moved, tmp_path / "scene")
    loaded = load_scene(tmp_path / "scene")
    assert_same(moved, loaded)
    assert not loaded.objects.yaw.requires_grad


@pytest.mark.parametrize("codes", [[0.1, 0.2, 0.3, 0.4], [0.1, 0.2, 0.3, 0.4, 0.5]])
def test_a_scene_saved_before_night_or_snow_has_none(tmp_path: Path, codes: list[float]) -> None:
    scene = rich_scene()
    save_scene(scene, tmp_path / "scene")
    edit("environment", "weather", value=codes)(tmp_path / "scene")
    expected = (codes + [0.0] * WEATHER_DIM)[:WEATHER_DIM]
    assert load_scene(tmp_path / "scene").environment.weather.tolist() == pytest.approx(expected)


def test_eight_bit_photograph_is_a_png_and_others_are_not(tmp_path: Path) -> None:
    save_scene(rich_scene(), tmp_path / "scene")
    assert (tmp_path / "scene" / "photograph.png").exists()
    assert not (tmp_path / "scene" / "background.png").exists()


def test_equal_scenes_are_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        save_scene(rich_scene(), tmp_path / name)
    contents = [
        {p.relative_to(tmp_path / n).as_posix(): p.read_bytes() for p in (tmp_path / n).rglob("*") if p.is_file()}
        for n in ("a", "b")
    ]
    assert contents[0] == contents[1]
    assert len(contents[0]) == 5


def test_saving_replaces_the_folder_and_leaves_nothing_else(tmp_path: Path) -> None:
    save_scene(rich_scene(0), tmp_path / "scene")
    (tmp_path / "scene" / "stray").write_text("old")
    save_scene(rich_scene(1), tmp_path / "scene")
    assert_same(rich_scene(1), load_scene(tmp_path / "scene"))
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]
    assert not (tmp_path / "scene" / "stray").exists()


def test_a_failed_save_keeps_what_was_there(tmp_path: Path) -> None:
    save_scene(rich_scene(0), tmp_path / "scene")
    with pytest.raises(FormatError, match="float16"):
        save_scene(rich_scene(depth=torch.zeros(H, W, dtype=torch.float16)), tmp_path / "scene")
    assert_same(rich_scene(0), load_scene(tmp_path / "scene"))
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


def test_meshes_that_a_glb_cannot_hold_are_refused(tmp_path: Path) -> None:
    mesh = rich_scene().meshes[0]
    double = dataclasses.replace(mesh, vertices=mesh.vertices.double())
    with pytest.raises(
        FormatError, match=r"scene\.meshes\[1\]\.vertices: expected torch\.float32, found torch\.float64"
    ):
        save_scene(rich_scene(meshes=(mesh, double)), tmp_path / "scene")
    assert not list(tmp_path.iterdir())


def test_provenance_is_text(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"provenance\['frame'\].*text.*8"):
        save_scene(rich_scene(provenance={"frame": 8}), tmp_path / "scene")


def test_provenance_that_is_no_text_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"provenance\['image'\].*UTF-8.*caf.udce9"):
        save_scene(rich_scene(provenance={"image": "caf\udce9.png"}), tmp_path / "scene")
    assert not list(tmp_path.iterdir())


def test_numbers_come_in_any_byte_order(saved: Path, tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    shutil.copytree(saved, folder)
    depth = files.read_npz(folder / "arrays.npz")["depth"]
    arrays("arrays.npz", depth=depth.astype(depth.dtype.newbyteorder(">")))(folder)
    assert torch.equal(load_scene(folder).depth, load_scene(saved).depth)


def edit(*keys: str | int, value: Any = ...) -> Any:
    """An edit of scene.json: set, or without `value` delete, what `keys` lead to."""

    def apply(folder: Path) -> None:
        record = json.loads((folder / "scene.json").read_text())
        target = record
        for key in keys[:-1]:
            target = target[key]
        if value is ...:
            del target[keys[-1]]
        else:
            target[keys[-1]] = value
        (folder / "scene.json").write_text(json.dumps(record))

    return apply


def arrays(name: str, **changes: np.ndarray | None) -> Any:
    """An edit of an NPZ: set, or with None delete, arrays."""

    def apply(folder: Path) -> None:
        held = {**files.read_npz(folder / name), **{k.replace("__", "."): v for k, v in changes.items()}}
        files.write_npz(folder / name, {k: v for k, v in held.items() if v is not None})

    return apply


def pickled(folder: Path) -> None:
    np.savez(folder / "arrays.npz", depth=np.array([{"an": "object"}], dtype=object))


def damaged(folder: Path) -> None:
    data = bytearray((folder / "arrays.npz").read_bytes())
    data[len(data) // 3 : len(data) // 3 + 40] = bytes(40)
    (folder / "arrays.npz").write_bytes(bytes(data))


def cut_mesh(folder: Path) -> None:
    path = folder / "meshes" / "0.glb"
    path.write_bytes(path.read_bytes()[:200])


BAD = [
    ("not-json", lambda f: (f / "scene.json").write_text("{"), r"scene\.json:1:2: expected JSON"),
    ("binary", lambda f: (f / "scene.json").write_bytes(b"\xff\xfe\x00"), r"scene\.json: expected UTF-8 text"),
    (
        "no-json",
        lambda f: (f / "scene.json").unlink(),
        r"scene\.json: expected a readable file, found no such file",
    ),
    ("no-npz", lambda f: (f / "arrays.npz").unlink(), r"arrays\.npz: expected a readable file"),
    ("no-mesh", lambda f: (f / "meshes" / "1.glb").unlink(), r"1\.glb: expected a mesh file, found no such file"),
    ("no-png", lambda f: (f / "photograph.png").unlink(), r"photograph\.png: expected a readable file"),
    ("png-cut", lambda f: (f / "photograph.png").write_bytes(b"\x89PNG"), r"photograph\.png: expected an image"),
    ("not-npz", lambda f: (f / "arrays.npz").write_bytes(b"abc"), r"arrays\.npz: expected an NPZ"),
    ("pickle", pickled, r"arrays\.npz: expected an NPZ.*allow_pickle"),
    ("damaged", damaged, r"arrays\.npz: expected an NPZ"),
    ("list", lambda f: (f / "scene.json").write_text("[]"), r"scene\.json: expected an object, found list"),
    ("schema", edit("schema", value="other"), r"scene\.json: schema: expected 'drivesem\.scene', found 'other'"),
    ("version", edit("version", value=99), r"scene\.json: version: expected version 4, found version 99"),
    (
        "missing",
        edit("camera", "intrinsics"),
        r"scene\.json: camera: intrinsics: expected a value, found no such key",
    ),
    ("no-objects", edit("objects"), r"scene\.json: objects: expected a value"),
    (
        "camera-shape",
        edit("camera", "intrinsics", value=[[1, 2, 3]]),
        r"intrinsics: expected shape \(3, 3\), found",
    ),
    ("ragged", edit("camera", "intrinsics", value=[[1, 2, 3], [1], [2]]), r"intrinsics: expected lists of equal"),
    ("height", edit("camera", "height", value="12"), r"camera: height: expected an integer, found str"),
    ("flag", edit("camera", "height", value=True), r"camera: height: expected an integer, found bool"),
    ("yaw", edit("objects", "yaw", value=[0.1]), r"objects: yaw: expected shape \(2,\), found \(1,\)"),
    ("null", edit("objects", "yaw", value=[0.1, None]), r"objects: yaw: expected numbers, found None"),
    (
        "nan-yaw",
        edit("objects", "yaw", value=[0.1, "nan"]),
        r"objects: objects\.yaw\[1\]: expected a finite value",
    ),
    ("category", edit("objects", "category", value=[0, 1.5]), r"objects: category: expected integers"),
    ("index", edit("objects", "mesh_index", value=[0, 7]), r"mesh_index: expected indices in \[0, 2\), found"),
    ("dtype", edit("ignore", value={"dtype": "object", "values": []}), r"ignore: dtype: expected one of"),
    ("others", edit("others", "kind", value=[1]), r"others: kind\[0\]: expected text, found int"),
    ("others-rows", edit("others", "kind", value=[]), r"others: boxes_xyxy: expected shape \(0, 4\), found"),
    ("weather", edit("environment", "weather", value=[0] * 3), r"environment: weather: expected shape \(6,\)"),
    ("sources", edit("sources", 1), r"objects\.source: expected 2 entries or none, found 1"),
    ("source", edit("sources", 0, "ffd"), r"sources\[0\]: ffd: expected a value"),
    (
        "crop-far-away",
        edit("sources", 0, "foreground", "x0", value=10**9),
        r"source\[0\]\.foreground: expected a rectangle in \d+x\d+ px, found \d+x\d+ px at 1000000000",
    ),
    ("crop-before", edit("sources", 0, "foreground", "y0", value=-1), r"expected a rectangle in .* at \d+, -1"),
    ("focal", edit("camera", "intrinsics", 0, 0, value=1e30), r"focal lengths: expected positive px, 0\.01 to"),
    ("nested", lambda f: (f / "scene.json").write_text("[" * 10**5), r"scene\.json: expected JSON.*nested"),
    ("crop", edit("sources", 0, "foreground", "x0"), r"sources\[0\]: foreground: x0: expected a value"),
    (
        "image",
        edit("images", "photograph", value="bmp"),
        r"images: photograph: expected 'png', 'jpg' or 'npz', found 'bmp'",
    ),
    ("provenance", edit("provenance", "dataset", value=1), r"provenance: dataset: expected text, found int"),
    ("depth", arrays("arrays.npz", depth=None), r"arrays\.npz: depth: expected an array, found no such key"),
    (
        "map",
        arrays("arrays.npz", sky=np.zeros((2, 2), np.float32)),
        r"arrays\.npz: sky: expected shape \(12, 20\)",
    ),
    ("map-dtype", arrays("arrays.npz", sky=np.zeros((H, W), np.int64)), r"arrays\.npz: sky: expected a floating"),
    (
        "map-f2",
        arrays("arrays.npz", sky=np.zeros((H, W), np.float16)),
        r"arrays\.npz: sky: expected one of float32",
    ),
    (
        "crop-missing",
        arrays("arrays.npz", source__1__foreground=None),
        r"source\.1\.foreground: expected an array",
    ),
    (
        "int32",
        edit("objects", "occlusion", value={"dtype": "int32", "values": [2**40, 0]}),
        r"objects: occlusion: expected integers of 32 bits, found 1099511627776",
    ),
    (
        "no-way-back",
        edit("camera", "projection", value=[[0.0] * 4] * 3),
        r"camera: camera\.projection: expected three columns that can be inverted",
    ),
    ("mesh-cut", cut_mesh, r"meshes/0\.glb: expected a readable mesh"),
    ("mesh-count", edit("meshes", value=3), r"meshes/2\.glb: expected a mesh file, found no such file"),
    ("mesh-kind", edit("meshes", value=[]), r"scene\.json: meshes: expected an integer, found list"),
    (
        "png-size",
        lambda f: files.write_png(f / "photograph.png", np.zeros((5, 4, 3), np.uint8)),
        r"20x12 px, found 4x5",
    ),
]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved") / "scene"
    save_scene(rich_scene(), folder)
    return folder


@pytest.mark.parametrize(("spoil", "message"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_malformed_folder_is_named_in_one_line(spoil: Any, message: str, saved: Path, tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    shutil.copytree(saved, folder)
    load_scene(folder)
    spoil(folder)
    with pytest.raises(FormatError, match=message) as caught:
        load_scene(folder)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"nowhere: expected a folder with a scene"):
        load_scene(tmp_path / "nowhere")


def test_text_appears_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files.write_text(tmp_path / "a.txt", "old")

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        files.write_text(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_json_rejects_what_json_cannot_hold(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        files.write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not list(tmp_path.iterdir())


def test_png_refuses_floats(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="uint8 or uint16"):
        files.write_png(tmp_path / "a.png", np.zeros((2, 2, 3), np.float32))


def test_the_scene_before_another_is_read_once(tmp_path: Path) -> None:
    """A link to itself, or a scene in a scene in a scene."""
    folder = tmp_path / "scene"
    save_scene(rich_scene(), folder)
    edit("before", value=True)(folder)
    (folder / "before").symlink_to(folder)
    with pytest.raises(
        FormatError, match=r"before/scene\.json: before: expected false, in the scene before another"
    ):
        load_scene(folder)
    (folder / "before").unlink()
    (folder / "before").symlink_to(tmp_path)
    with pytest.raises(FormatError, match=r"scene/before: expected a file in .*scene, found a link to"):
        load_scene(folder)
