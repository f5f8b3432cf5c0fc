"""Fetch an optional pack of vehicles and skies from package registries, and convert it for `drivesem synth`.

    python tools/fetch_assets.py --out assets

writes `vehicles/*.glb` and `vehicles.yaml` (kind, size, author, licence of each), `skies/*.npz` (linear radiance)
and `LICENCES.md`. The vehicles are of the Debian package sweethome3d-furniture 1.8 (CC-BY 3.0 and CC0), the skies
of the npm package @pmndrs/assets 1.7.0 (CC0). Both are fetched by the ordinary clients, apt-get and npm; where one
is missing, the package can be given as a file (--deb, --skies). What is there already is not made again, so that a
run that was stopped goes on; files are written whole or not at all. Skies need OpenEXR, which
`pip install -e ".[assets]"` brings.
"""

from __future__ import annotations

import argparse
import base64
import io
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
import yaml
from trimesh.remesh import subdivide_to_size
from trimesh.visual.material import SimpleMaterial

from drivesem.reporting.tables import format_count
from drivesem.synth.render import rasterise
from scene_ir import files
from scene_ir.errors import FormatError, SceneError
from scene_ir.meshes.load import save_mesh
from scene_ir.meshes.lod import simplify
from scene_ir.types import Mesh, Part

DEBIAN_PACKAGE = "sweethome3d-furniture"
NPM_PACKAGE = "@pmndrs/assets@1.7.0"
_CATALOGUE = "PluginFurnitureCatalog.properties"
_MOST_FACES = 20_000
"""A vehicle of the pack has no more triangles: enough for one 700 px high."""
_CUTS = ((1 / 170, 0.2), (1 / 100, 0.3), (1 / 70, 0.35), (1 / 45, 0.45))
"""Textured triangles are coloured face by face. They are cut to edges of this share of the length, 3 cm of a car,
unless their texture varies by less than the second number of a channel's range; the finest of these is taken that
gives at most `_MOST_TEXTURED` triangles."""
_MOST_TEXTURED = 15_000
_COLOUR_STEPS = 16
"""Levels a channel of texture colours, so that even areas stay even and simplify well."""
_BRIGHTEST_METAL = 0.55
"""Most sRGB value of chrome and aluminium, which the generator shades as trim: what they mirror it adds."""
_DARKEST = 0.2
"""Least sRGB value of trim: black plastic reflects about 3 %; some models give 0."""
SKIES = {"dawn": 5.0, "night": 14.0, "park": 7.0, "sky": 1.5, "sunrise": 11.0, "venice": 20.0}
"""Outdoor skies, and how many degrees their trees and hills rise above the horizon: at 512x256 they are a blur, so
the sky above is drawn down over them. The other skies are rooms, a forest, and towns with towers that are too high."""
_FREE_DEG = 50.0
"""From here upwards a sky stays as it is."""


@dataclass(frozen=True)
class ModelFile:
    """How to read one model."""

    kind: str
    """Body."""
    paint: tuple[str, ...]
    """Names of materials, all others are trim."""
    glass: tuple[str, ...] = ("glass",)
    """Names of materials, all others are trim."""
    tyre: tuple[str, ...] = ("tires",)
    """Names of materials, all others are trim."""
    light: tuple[str, ...] = ()
    """Names of materials, all others are trim."""
    front: str = "+z"
    """The axis that it looks along."""
    plain: tuple[str, ...] = ()
    """Materials with a texture that is too fine."""
    roof_m: float | None = None
    """What lies wholly above this is left out (aerials)."""


_KATOR_01 = ModelFile(
    "sedan", ("Car",), ("Glass",), ("Tire_Rubber",), ("Turn_signals", "Headlights", "Taillights", "Reflector")
)
_KATOR_02 = ModelFile(
    "sedan",
    ("PAINT_lt_blue",),
    ("GLASS_car_window", "GLASS_car_defroster"),
    ("RUBBER_tread", "RUBBER"),
    ("GLASS", "GLASS_headlights", "GLASS_brake_light2", "GLASS_brakelight", "GLASS_turn_signals"),
)
MODELS: Mapping[str, ModelFile] = {
    "scopia/seat_leon": ModelFile(
        "hatchback",
        ("chapa_roja",),
        ("cristales",),
        ("neumaticos",),
        ("faros_rojos", "faros_blan_back", "faros_blancos_faro1_leon.jpg"),
    ),
    "scopia/suv": ModelFile("suv", ("firstcolor",)),
    "scopia/smart-car": ModelFile(
        "hatchback",
        ("first-color", "second-color"),
        ("glass", "black-glass"),
        ("wheels-rubber",),
        ("back-lights",),
    ),
    "scopia/chevrolet": ModelFile("sedan", ("firstcolor",), light=("glassfocus",)),
    "scopia/peugeot-308": ModelFile("sedan", ("color-exterior",), light=("front-lights", "rear-lights")),
    "scopia/renault-scenic": ModelFile(
        "estate",
        ("color-beige-green",),
        ("glass", "dark-glass"),
        light=("front-lights", "back-lights"),
        roof_m=1.66,
    ),
    "scopia/van": ModelFile("van", ("firstcolor", "whiteglass"), light=("redlights",)),
    "scopia/bus": ModelFile("bus", ("firstcolor",)),
    "scopia/cityBus": ModelFile("bus", ("whiteBase", "accentColor"), ("glass", "darkglass")),
    "scopia/truck": ModelFile(
        "truck", ("red-cabin", "white-container"), tyre=("black-plastic",), light=("orange-lights",)
    ),
    "katorlegaz/VW-new-beetle": ModelFile(
        "hatchback",
        ("PAINT_yellow",),
        ("GLASS_car_window", "GLASS_car_defroster"),
        ("RUBBER_tread", "RUBBER"),
        (
            "GLASS",
            "GLASS_lens",
            "GLASS_headlights",
            "GLASS_parking_light",
            "GLASS_brake_light",
            "GLASS_brake_light2",
            "GLASS_turn_signals",
            "GLASS_turn_signal2",
            "GLASS_turn_signals3",
        ),
    ),
    "katorlegaz/concept-sedan-01v1": _KATOR_01,
    "katorlegaz/concept-sedan-01v2": _KATOR_01,
    "katorlegaz/concept-sedan-02": _KATOR_02,
    "katorlegaz/concept-sedan-02-sport": _KATOR_02,
    "blendswap-cc-by/fordFocus": ModelFile(
        "hatchback", ("carPaint",), tyre=("black_rubber",), light=("glass_red", "white", "yellow_chrome")
    ),
    "blendswap-cc-by/dafTruck": ModelFile(
        "truck", ("Cabin", "Payload"), ("Glass",), (), plain=("Payload", "Trailer")
    ),
    "blendswap-cc-0/peterbilt": ModelFile(
        "truck", ("body", "bodyTrailer"), tyre=("tires", "tiresTrailer"), light=("reflector", "reflectorTrailer")
    ),
}
"""Vehicles of the catalogue that are of use on a street, by folder."""


@dataclass(frozen=True)
class PackEntry:
    """A model in a catalogue."""

    name: str
    file: str
    size_lhw_m: tuple[float, float, float]
    """Of its bounds; folder and file: in the archive."""
    author: str
    licence: str

    @property
    def folder(self) -> str:
        """Where the model and its textures lie."""
        return self.file.rpartition("/")[0]


def catalogue(archive: zipfile.ZipFile) -> list[PackEntry]:
    """The models of a furniture library (.sh3f), in its order. Raises FormatError where it has no catalogue."""
    try:
        text = archive.read(_CATALOGUE).decode("latin-1")
    except KeyError:
        raise FormatError(str(archive.filename), f"a furniture library with {_CATALOGUE}", "none") from None
    common: dict[str, str] = {}
    numbered: dict[int, dict[str, str]] = {}
    for line in text.splitlines():
        match = re.match(r"\s*(\w+)(?:#(\d+))?\s*[=:]\s*(.*)", line)
        if match:
            key, number, value = match.groups()
            (common if number is None else numbered.setdefault(int(number), {}))[key] = value.strip()
    licence = re.split(r"\s+license|\s+licence|\s*\xa9|\s+by ", common.get("license", "unknown"))[0].strip()
    found = []
    for values in numbered.values():
        if {"model", "name", "width", "depth", "height"} <= values.keys():
            width, depth, height = (float(values[k]) / 100 for k in ("width", "depth", "height"))
            author = values.get("creator", common.get("provider", "unknown"))
            found.append(
                PackEntry(values["name"], values["model"].lstrip("/"), (depth, height, width), author, licence)
            )
    return found


def vehicle(
    scene: trimesh.Scene, model: ModelFile, entry: PackEntry, most_faces: int = _MOST_FACES
) -> tuple[Mesh, tuple[float, float, float]]:
    """A model in the unit box, and its size (length, height, width) in m.

    Parts by material, colours by face, what is hidden inside taken out. scene: y up, one geometry a material.
    Raises FormatError where nothing of it is left.
    """
    forward = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}[model.front]
    down = np.array([0.0, -1.0, 0.0])
    turn = np.stack([np.array(forward, float), down, np.cross(forward, down)])
    shapes = []
    for node in sorted(scene.graph.nodes_geometry):
        transform, key = scene.graph[node]
        shape = scene.geometry[key]
        if isinstance(shape, trimesh.Trimesh) and len(shape.faces):
            shapes.append((key, shape, trimesh.transform_points(shape.vertices, transform) @ turn.T))
    if not shapes:
        raise FormatError(entry.name, "a model with triangles", "none")
    everything = np.concatenate([points for _, _, points in shapes])
    low, high = everything.min(axis=0), everything.max(axis=0)
    metres = np.array(entry.size_lhw_m) / np.maximum(high - low, 1e-9)
    placed = [(points - [low[0], high[1], low[2]]) * metres for _, _, points in shapes]
    names = [str(getattr(shape.visual.material, "name", "") or key) for key, shape, _ in shapes]
    pieces = [(p, s, name in model.plain) for p, (_, s, _), name in zip(placed, shapes, names, strict=True)]
    solid, tints, counts = _cut(pieces, entry)
    kinds = np.repeat([int(_part(model, name)) for name in names], counts)
    metal = np.repeat([re.search("chrome|alumin|metal", name.lower()) is not None for name in names], counts)
    tints[metal] = np.minimum(tints[metal], _BRIGHTEST_METAL)
    if model.roof_m is not None:
        below = solid[..., 1].max(axis=1) > -model.roof_m
        solid, tints, kinds = solid[below], tints[below], kinds[below]
        solid[..., 1] = np.maximum(solid[..., 1], -model.roof_m)
    mesh, size = _boxed(solid, tints, kinds, entry.name)
    return _lamps(simplify(mesh, most_faces)), size


def _part(model: ModelFile, material: str) -> Part:
    for part, names in (
        (Part.PAINT, model.paint),
        (Part.GLASS, model.glass),
        (Part.TYRE, model.tyre),
        (Part.LIGHT, model.light),
    ):
        if material in names:
            return part
    return Part.OTHER


def _cut(
    shapes: list[tuple[np.ndarray, trimesh.Trimesh, bool]], entry: PackEntry
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """All triangles (F, 3, 3) with their colours (F, 3), and the number from each shape, see `_CUTS`.

    shapes: points in m, faces and texture, and whether they stay whole.
    """
    pieces: list[tuple[np.ndarray, np.ndarray]] = []
    for share, even in _CUTS:
        length = entry.size_lhw_m[0]
        limits = {False: (share * length, even), True: (9.0 * length, 1.1)}
        pieces = [_coloured(points, np.asarray(s.faces), s.visual, limits[whole]) for points, s, whole in shapes]
        cut = sum(len(p[0]) for p, (_, s, _) in zip(pieces, shapes, strict=True) if len(p[0]) > len(s.faces))
        if cut <= _MOST_TEXTURED:
            break
    return (
        np.concatenate([p[0] for p in pieces]),
        np.concatenate([p[1] for p in pieces]),
        [len(p[0]) for p in pieces],
    )


def _coloured(
    points: np.ndarray, faces: np.ndarray, visual: object, limits: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (F, 3, 3) and their colours (F, 3); textured ones are cut, see `_CUTS`.

    limits: longest edge, and how much a texture may vary where a triangle stays whole.
    """
    longest, variation = limits
    material, uv = getattr(visual, "material", None), getattr(visual, "uv", None)
    if not isinstance(material, SimpleMaterial):
        return points[faces], np.full((len(faces), 3), 0.5)
    image = material.image
    if image is None or uv is None or len(uv) != len(points):
        colour = np.asarray(material.main_color, float)[:3] / 255
        return points[faces], np.tile(colour, (len(faces), 1))
    # Texture coordinates ride along as two more, tiny, coordinates: edges are as long as before.
    small = 1e-7 * longest
    joint = np.hstack([points, np.asarray(uv)[:, :2] * small])
    divided = subdivide_to_size(joint, faces, longest, max_iter=14, return_index=True)
    assert len(divided) == 3
    cut_points, cut, source = divided
    centre = cut_points[cut][..., 3:].mean(axis=1) / small
    pixels = np.asarray(image.convert("RGB"), float) / 255
    height, width = pixels.shape[:2]
    column = np.floor(np.mod(centre[:, 0], 1) * width).astype(int).clip(0, width - 1)
    row = np.floor(np.mod(1 - centre[:, 1], 1) * height).astype(int).clip(0, height - 1)
    colour = pixels[row, column]
    low, high = np.full((len(faces), 3), np.inf), np.full((len(faces), 3), -np.inf)
    np.minimum.at(low, source, colour)
    np.maximum.at(high, source, colour)
    even = (high - low).max(axis=1) < variation
    rest = ~even[source]
    tint = np.round(np.concatenate([(low + high)[even] / 2, colour[rest]]) * _COLOUR_STEPS) / _COLOUR_STEPS
    return np.concatenate([points[faces[even]], cut_points[cut[rest]][..., :3]]), tint


def _boxed(
    corners: np.ndarray, colours: np.ndarray, parts: np.ndarray, name: str
) -> tuple[Mesh, tuple[float, float, float]]:
    """The visible triangles, turned outwards, in the unit box; and the size (length, height, width) they had."""
    seen = facing(corners)
    keep = seen != 0
    if not keep.any():
        raise FormatError(name, "a model that can be seen", "nothing")
    corners, colours, parts = corners[keep].copy(), colours[keep], parts[keep]
    inside_out = seen[keep] < 0
    corners[inside_out] = corners[inside_out][:, ::-1]
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    unit = ((corners - low) / np.maximum(high - low, 1e-9) - np.array([0.5, 1.0, 0.5])).astype(np.float32)
    trim = parts == Part.OTHER
    colours = colours.copy()
    colours[trim] = np.maximum(colours[trim], _DARKEST)
    colours[parts == Part.TYRE] = np.minimum(colours[parts == Part.TYRE], _DARKEST)
    # One vertex for each point and look, so that surfaces are connected.
    rows = np.hstack([unit.reshape(-1, 3), np.repeat(np.column_stack([colours, parts]), 3, axis=0)])
    unique, index = np.unique(rows.astype(np.float32), axis=0, return_inverse=True)
    mesh = Mesh(
        vertices=torch.from_numpy(np.ascontiguousarray(unique[:, :3])),
        faces=torch.from_numpy(index.reshape(-1, 3).astype(np.int64)),
        part=torch.from_numpy(parts.astype(np.int64)),
        name=name,
        colours=torch.from_numpy(np.ascontiguousarray(unique[:, 3:6])),
    )
    length, tall, wide = (float(v) for v in high - low)
    return mesh, (length, tall, wide)


def facing(corners: np.ndarray, views: int = 60, size_px: int = 640) -> np.ndarray:
    """How each triangle (F, 3, 3) is seen from around: > 0 mostly its front, < 0 its back, 0 never.

    views: directions, from above to 30 degrees below the horizon, y points down; size_px: of each picture.
    """
    middle = (corners.reshape(-1, 3).max(axis=0) + corners.reshape(-1, 3).min(axis=0)) / 2
    centred = corners - middle
    reach = float(np.linalg.norm(centred, axis=-1).max())
    normal = np.cross(centred[:, 1] - centred[:, 0], centred[:, 2] - centred[:, 0])
    score = np.zeros(len(corners))
    scale = size_px / 2 / reach
    far = 50.0
    intrinsics = np.array(
        [[scale * far * reach, 0, size_px / 2], [0, scale * far * reach, size_px / 2], [0, 0, 1.0]]
    )
    golden = np.pi * (3 - np.sqrt(5))
    for i in range(views):
        rise = 0.999 - 1.499 * i / max(views - 1, 1)
        flat = np.sqrt(1 - rise * rise)
        # The way the camera looks: down where it stands above.
        view_direction = -np.array([flat * np.cos(golden * i), -rise, flat * np.sin(golden * i)])
        right = np.cross([0.0, 1.0, 0.0], view_direction)
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(view_direction, right), view_direction])
        placed = (centred @ turn.T + [0, 0, far * reach]).astype(np.float32)
        face, _ = rasterise(
            placed, intrinsics, np.array([[0, 0, size_px, size_px]]), np.array([[0, len(corners)]])
        )
        pixels = np.bincount(face[face >= 0], minlength=len(corners))
        score -= pixels * np.sign(normal @ view_direction + 1e-12)
    return score


def _lamps(mesh: Mesh) -> Mesh:
    """Red and orange patches of trim at the ends are lights: textures hold them together with the rest."""
    faces = mesh.faces.numpy()
    colour = (
        mesh.colours.numpy()[faces].mean(axis=1) if mesh.colours is not None else np.full((len(faces), 3), 0.5)
    )
    middle = mesh.vertices.numpy()[faces].mean(axis=1)
    warm = (colour[:, 0] > 0.45) & (colour[:, 2] < 0.45 * colour[:, 0])
    part = mesh.part.numpy().copy()
    part[(part == Part.OTHER) & warm & (np.abs(middle[:, 0]) > 0.36)] = Part.LIGHT
    return replace(mesh, part=torch.from_numpy(part))


@dataclass
class AssetPack:
    """The folder that is written, and what is in it so far."""

    root: Path
    vehicles: dict[str, dict[str, object]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        listed = self.root / "vehicles" / "vehicles.yaml"
        if listed.is_file():
            self.vehicles = yaml.safe_load(files.read_text(listed)) or {}

    def has(self, name: str) -> bool:
        return name in self.vehicles and (self.root / "vehicles" / name).is_file()

    def add(self, name: str, mesh: Mesh, entry: dict[str, object]) -> None:
        save_mesh(mesh, self.root / "vehicles" / name)
        self.vehicles[name] = entry
        text = yaml.safe_dump(self.vehicles, sort_keys=True, allow_unicode=True, default_flow_style=None)
        files.write_text(self.root / "vehicles" / "vehicles.yaml", text)


def add_vehicles(
    library: zipfile.ZipFile, pack: AssetPack, models: Mapping[str, ModelFile] = MODELS
) -> Iterator[str]:
    """Convert a furniture library's vehicles into the pack; yields a line for each that was made."""
    for entry in catalogue(library):
        model = models.get(entry.folder)
        name = re.sub(r"[^a-z0-9]+", "-", entry.folder.rpartition("/")[2].lower()) + ".glb"
        if model is None or pack.has(name):
            continue
        with tempfile.TemporaryDirectory() as scratch:
            for member in library.namelist():
                if member.startswith(entry.folder + "/") and not member.endswith("/"):
                    target = Path(scratch) / Path(member).name
                    target.write_bytes(library.read(member))
            scene = trimesh.load_scene(Path(scratch) / Path(entry.file).name, process=False)
            mesh, size = vehicle(scene, model, entry)
        described: dict[str, object] = {
            "name": entry.name,
            "kind": model.kind,
            "size_lhw_m": [round(v, 3) for v in size],
            "author": entry.author,
            "licence": entry.licence,
            "source": f"Debian {DEBIAN_PACKAGE}: {entry.folder}",
        }
        pack.add(name, mesh, described)
        yield f"{name}: {mesh.faces.shape[0]} triangles"


def add_skies(package: tarfile.TarFile, root: Path) -> Iterator[str]:
    """Convert the outdoor skies of the npm package; yields a line for each that was made."""
    for name, skyline in SKIES.items():
        target = root / "skies" / f"{name}.npz"
        if target.is_file():
            continue
        try:
            member = package.extractfile(f"package/hdri/{name}.exr.js")
        except KeyError:
            member = None
        if member is None:
            raise FormatError(str(package.name), f"package/hdri/{name}.exr.js", "no such member")
        pixels = without_skyline(equirectangular(member.read().decode("ascii", "replace"), name), skyline)
        files.write_npz(target, {"pixels": pixels.astype(np.float16)})
        yield f"{target.name}: {pixels.shape[1]}x{pixels.shape[0]}"


def equirectangular(module: str, name: str) -> np.ndarray:
    """Radiance (h, w, 3) float32 of a JavaScript module that exports an EXR as base64."""
    match = re.search(r"base64,([A-Za-z0-9+/=]+)", module)
    if match is None:
        raise FormatError(name, "an EXR as base64", "none")
    try:
        import OpenEXR
    except ImportError:
        raise FormatError("skies", "the package OpenEXR", "not installed: pip install OpenEXR") from None
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "sky.exr"
        path.write_bytes(base64.b64decode(match[1]))
        with OpenEXR.File(str(path)) as picture:
            channels = picture.channels()
            planes = channels["RGB"].pixels if "RGB" in channels else [channels[c].pixels for c in "RGB"]
            pixels = np.array(planes, np.float32)
    pixels = pixels if pixels.shape[-1] == 3 else np.moveaxis(pixels, 0, -1)
    return np.clip(np.nan_to_num(pixels, posinf=65504.0), 0.0, 65504.0)


def without_skyline(pixels: np.ndarray, skyline_deg: float) -> np.ndarray:
    """The panorama (h, w, 3) with the sky above `skyline_deg` drawn down to the horizon; the ground stays."""
    height = pixels.shape[0]
    elevation = 90 - (np.arange(height) + 0.5) * 180 / height
    source = np.where(
        elevation < _FREE_DEG, skyline_deg + elevation * (_FREE_DEG - skyline_deg) / _FREE_DEG, elevation
    )
    row = np.where(elevation > 0, (90 - source) * height / 180 - 0.5, np.arange(height))
    upper = np.floor(row).astype(int).clip(0, height - 1)
    share = np.clip(row - upper, 0, 1)[:, None, None]
    lower = (upper + 1).clip(0, height - 1)
    return (pixels[upper] * (1 - share) + pixels[lower] * share).astype(np.float32)


def members(deb: Path) -> Iterator[tuple[str, bytes]]:
    """(file name, content) of the furniture libraries in a Debian package, without Debian's tools.

    A .deb is an ar archive (deb(5)); its data.tar.* holds the files. Raises FormatError for anything else.
    """
    data = files.read_bytes(deb)
    if not data.startswith(b"!<arch>\n"):
        raise FormatError(str(deb), "a Debian package", "another file")
    at = 8
    while at + 60 <= len(data):
        name, size = data[at : at + 16].decode("ascii").strip().rstrip("/"), int(data[at + 48 : at + 58])
        if name.startswith("data.tar"):
            try:
                with tarfile.open(fileobj=io.BytesIO(data[at + 60 : at + 60 + size])) as tar:
                    for member in tar:
                        stream = tar.extractfile(member) if member.name.endswith(".sh3f") else None
                        if stream is not None:
                            yield Path(member.name).name, stream.read()
            except tarfile.TarError as error:
                raise FormatError(f"{deb}: {name}", "a tar archive (gz or xz)", str(error)) from None
            return
        at += 60 + size + size % 2
    raise FormatError(str(deb), "a Debian package with data.tar", "none")


def run(command: list[str], folder: Path, otherwise: str) -> None:
    """Run a package client in a folder. Raises FormatError, one line, where it is missing or fails."""
    if shutil.which(command[0]) is None:
        raise FormatError(command[0], "the program", f"not found; {otherwise}")
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise FormatError(
            " ".join(command), "exit status 0", f"{lines[-1] if lines else done.returncode}; {otherwise}"
        )


def licences(pack: AssetPack, skies: list[str]) -> str:
    """The text of LICENCES.md: who made what, and under which licence."""
    lines = [
        "# Licences of this folder",
        "",
        "Converted: parts from materials, hidden triangles removed, simplified.",
        "",
    ]
    for name, entry in sorted(pack.vehicles.items()):
        lines.append(
            f"- `vehicles/{name}`: {entry['name']} by {entry['author']}, {entry['licence']}, {entry['source']}"
        )
    lines += [f"- `skies/{name}`: CC0 1.0, Poly Haven, by way of npm {NPM_PACKAGE}" for name in skies]
    return "\n".join(lines) + "\n"


def fetch(out: Path, deb: Path | None, tarball: Path | None) -> Iterator[str]:
    """Make or complete the pack at `out`; yields a line for each file."""
    pack = AssetPack(out)
    wanted = [re.sub(r"[^a-z0-9]+", "-", key.rpartition("/")[2].lower()) + ".glb" for key in MODELS]
    with tempfile.TemporaryDirectory() as scratch:
        if not all(pack.has(name) for name in wanted):
            if deb is None:
                run(
                    ["apt-get", "download", DEBIAN_PACKAGE],
                    Path(scratch),
                    f"give {DEBIAN_PACKAGE}'s .deb by --deb",
                )
                deb = next(Path(scratch).glob("*.deb"))
            for _, content in members(deb):
                with zipfile.ZipFile(io.BytesIO(content)) as library:
                    yield from add_vehicles(library, pack)
        if not all((out / "skies" / f"{name}.npz").is_file() for name in SKIES):
            if tarball is None:
                run(["npm", "pack", NPM_PACKAGE], Path(scratch), f"give {NPM_PACKAGE}'s .tgz by --skies")
                tarball = next(Path(scratch).glob("*.tgz"))
            with tarfile.open(tarball) as package:
                yield from add_skies(package, out)
    skies = sorted(path.name for path in (out / "skies").glob("*.npz"))
    files.write_text(out / "LICENCES.md", licences(pack, skies))
    yield f"{out}: {format_count(len(pack.vehicles), 'vehicle')}, {format_count(len(skies), 'sky', 'skies')}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder to make or complete")
    parser.add_argument(
        "--deb", type=Path, help=f"the Debian package {DEBIAN_PACKAGE}, where it is on disk already"
    )
    parser.add_argument("--skies", type=Path, help=f"the npm package {NPM_PACKAGE} (.tgz), likewise")
    arguments = parser.parse_args()
    try:
        for line in fetch(arguments.out, arguments.deb, arguments.skies):
            print(line)
    except (SceneError, OSError, tarfile.TarError, zipfile.BadZipFile) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
