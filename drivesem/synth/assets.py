"""A user's own meshes and skies for the generator: folders of vehicles, and packs of vehicles and skies.

A folder of vehicles holds mesh files (.glb, .gltf, .obj, .ply) and may hold `vehicles.yaml`, with what the
files lack. It maps file names to entries; all keys of an entry may be left out:

    taxi.glb:
      kind: sedan               # sedan, hatchback, estate, suv, pickup, van, truck or bus; else guessed
      up: z                     # the file's axis that points up: y, z or -y, or auto (the default)
      front: -x                 # the file's axis that the vehicle looks along: +x ... -z, or auto (the default)
      size_lhw_m: [4.6, 1.5, 1.8]   # length, height, width in metres; else the file's own, where plausible
      metres_per_unit: 0.01     # of the file's coordinates, used where size_lhw_m is absent
      use: false                # leaves the file out
      author: ..., licence: ..., source: ...   # for people, not read

A pack is a folder with `vehicles/` and `skies/` in it, as `tools/fetch_assets.py` writes it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import torch

from drivesem.synth.light import Light, Panorama
from drivesem.synth.soup import Material, Soup, creased_normals, make
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, SceneError, make_printable
from scene_ir.meshes.load import ImportedMesh, import_mesh
from scene_ir.meshes.lod import simplify
from scene_ir.meshes.templates import KINDS
from scene_ir.types import Mesh, Part

SIDECAR = "vehicles.yaml"
_SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
_MOST_FACES = 20_000
"""Heavier meshes are simplified when read: a car 500 px high shows no more."""
_PANE = (0.022, 0.025, 0.026)
"""Linear albedo of windows: what is seen of a car's inside from the street."""
_FAR_FACES = 2500
"""Enough for 90 px and less, with wheels and mirrors."""
_KEYS = frozenset(
    ("kind", "up", "front", "size_lhw_m", "metres_per_unit", "use", "author", "licence", "source", "name")
)
_NAMES = (
    ("bus", r"\bbus|coach|minibus|schoolbus"),
    ("pickup", r"pick ?up|flat ?bed|\bute\b"),
    ("truck", r"truck|lorry|fire|garbage|trailer|tractor|\bhgv|\bdaf\b|peterbilt"),
    ("van", r"\bvans?\b|ambulance|delivery|transporter|sprinter|minivan|\bvan"),
    ("suv", r"suv|jeep|4x4|off ?road|crossover"),
    ("estate", r"estate|wagon|kombi|avant|touring"),
    ("hatchback", r"hatch|compact|\bmini\b|smart|city ?car|golf|polo|leon|focus|beetle"),
    ("sedan", r"sedan|saloon|limousine|taxi|police|coupe|roadster|sport|\bcar\b|race"),
)
"""Vehicle kinds by words in file names; the first match counts."""
_RANGE_LHW = {
    "sedan": ((3.9, 5.2), (1.25, 1.60), (1.60, 2.05)),
    "hatchback": ((3.3, 4.5), (1.25, 1.65), (1.50, 2.00)),
    "estate": ((4.1, 5.1), (1.35, 1.65), (1.60, 2.05)),
    "suv": ((3.8, 5.1), (1.55, 1.95), (1.70, 2.10)),
    "pickup": ((4.6, 5.8), (1.60, 1.95), (1.70, 2.15)),
    "van": ((4.3, 6.5), (1.80, 2.80), (1.75, 2.45)),
    "truck": ((5.5, 18.0), (2.50, 4.00), (2.10, 2.65)),
    "bus": ((8.0, 15.0), (2.80, 3.60), (2.40, 2.85)),
}
"""Plausible length, height and width (some with mirrors) in m by body, from makers' data sheets."""
_PART_MATERIAL = np.array(
    [
        int({Part.PAINT: Material.PAINT, Part.GLASS: Material.GLASS, Part.TYRE: Material.TYRE,
             Part.LIGHT: Material.LIGHT, Part.OTHER: Material.TRIM}[part])
        for part in Part
    ],
    np.uint8,
)  # fmt: skip

NEUTRAL = 0.5
"""Albedo of paint that is neither lighter nor darker than a mesh's main paint."""


@dataclass(frozen=True, slots=True)
class _Entry:
    """One line of the sidecar, checked."""

    kind: str | None = None
    up: str = "auto"
    front: str = "auto"
    size_lhw_m: tuple[float, float, float] | None = None
    metres_per_unit: float = 1.0
    use: bool = True


@dataclass(frozen=True, slots=True)
class VehicleMesh:
    """A vehicle from a file. name: the file's, its id; kind: one of the templates' KINDS; size_lhw: usual size, m.

    Small, hashable and picklable: triangles are read on demand, and few are cached.
    """

    name: str
    kind: str
    size_lhw: tuple[float, float, float]
    path: Path
    up: str = "y"
    front: str = "auto"
    stated_lhw: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Length, height, width in m as the file or the sidecar states them."""
    notes: tuple[str, ...] = ()
    """What is missing, or was left out of the file, one line each."""

    @property
    def mesh(self) -> Mesh:
        """In the unit box, parts found, at most 20,000 faces."""
        return _mesh(self)

    @property
    def split(self) -> str:
        """ "train" or "heldout", by the name alone."""
        return choose_split(self.name)


def choose_split(name: str) -> str:
    """ "heldout" for one name in three, else "train": the same on every machine and in every folder."""
    return "heldout" if hashlib.sha256(name.encode()).digest()[0] % 3 == 0 else "train"


def of_split(meshes: Sequence[VehicleMesh], split: str) -> tuple[VehicleMesh, ...]:
    """Those of one split, in the same order. Raises RangeError for an unknown split."""
    if split not in ("train", "heldout"):
        raise RangeError("split", "train or heldout", split)
    return tuple(m for m in meshes if m.split == split)


def meshes_in(folder: str | Path) -> tuple[VehicleMesh, ...]:
    """The vehicles of a folder, sorted by name; of folders below it only what OBJ and GLTF files point to.

    Files that cannot be read are left out; `unreadable_in` names them. The result is cached per process while the
    folder's list of files stays the same. Raises FormatError for an unreadable folder, if no mesh in it can be read,
    and for a faulty `vehicles.yaml`.
    """
    return _folder(*_listing(folder))[0]


def unreadable_in(folder: str | Path) -> tuple[tuple[str, str], ...]:
    """(file name, what is wrong) of the meshes that `meshes_in` leaves out, sorted by name."""
    return _folder(*_listing(folder))[1]


def read_vehicle(path: str | Path) -> VehicleMesh:
    """The vehicle in one file, read as `meshes_in` reads it: with its entry in its folder's `vehicles.yaml`.

    Raises FormatError for an unreadable file or a faulty `vehicles.yaml`.
    """
    place = Path(path)
    sidecar = place.parent / SIDECAR
    entries = _sidecar(sidecar) if sidecar.is_file() else {}
    return _vehicle(place, entries.get(place.name, _Entry()))


def notes_in(folder: str | Path) -> tuple[str, ...]:
    """What is left out of a folder's meshes, or missing, one line each: files that cannot be read, parts of others."""
    vehicles, faults = _folder(*_listing(folder))
    lines = [f"left out: {fault}" for _, fault in faults]
    lines += [f"{vehicle.name}: {note}" for vehicle in vehicles for note in vehicle.notes]
    return tuple(make_printable(line) for line in lines)


_Stamp = tuple[str, int, int]


def _listing(folder: str | Path) -> tuple[Path, tuple[_Stamp, ...]]:
    """The folder, and name, size and time of its meshes and sidecar."""
    place = Path(folder).resolve()
    if not place.is_dir():
        raise FormatError(str(folder), "a folder of meshes", "no such folder")
    found = []
    for path in sorted(place.iterdir()):
        if path.suffix.lower() in _SUFFIXES or path.name == SIDECAR:
            try:
                status = path.stat()
                found.append((path.name, status.st_size, status.st_mtime_ns))
            except OSError:  # a broken link is left out as any unreadable file
                found.append((path.name, 0, 0))
    return place, tuple(found)


@lru_cache(maxsize=8)
def _folder(
    place: Path, listing: tuple[_Stamp, ...]
) -> tuple[tuple[VehicleMesh, ...], tuple[tuple[str, str], ...]]:
    names = [name for name, _, _ in listing if name != SIDECAR]
    entries = _sidecar(place / SIDECAR) if len(names) < len(listing) else {}
    for name in entries:
        if name not in names:
            raise FormatError(
                f"{place / SIDECAR}: {name}", "the name of a mesh file in the same folder", "no such file"
            )
    vehicles, faults = [], []
    for name in names:
        entry = entries.get(name, _Entry())
        if not entry.use:
            continue
        try:
            vehicles.append(_vehicle(place / name, entry))
        except SceneError as error:
            faults.append((name, str(error)))
    if not vehicles:
        reason = f"{len(faults)} of {len(names)} unreadable" + (f", first {faults[0][1]}" if faults else "")
        raise FormatError(str(place), f"at least one vehicle mesh ({', '.join(_SUFFIXES)})", reason)
    return tuple(vehicles), tuple(faults)


def _sidecar(path: Path) -> dict[str, _Entry]:
    raw = files.read_yaml(path)
    if not isinstance(raw, dict):
        raise FormatError(str(path), "file names and their entries", type(raw).__name__)
    return {str(name): _entry(f"{path}: {name}", value) for name, value in raw.items()}


def _entry(field: str, raw: object) -> _Entry:
    if not isinstance(raw, Mapping):
        raise FormatError(field, "an entry of keys and values", type(raw).__name__)
    unknown = sorted(str(k) for k in raw if k not in _KEYS)
    if unknown:
        raise FormatError(field, f"keys among {', '.join(sorted(_KEYS))}", unknown[0])
    kind = raw.get("kind")
    if kind is not None and kind not in KINDS:
        raise FormatError(f"{field}: kind", " or ".join(KINDS), kind)
    up, front = str(raw.get("up", "auto")), str(raw.get("front", "auto"))
    if up not in ("auto", "y", "z", "-y"):
        raise FormatError(f"{field}: up", "auto, y, z or -y", up)
    if front != "auto" and not re.fullmatch(r"[+-][xyz]", front):
        raise FormatError(f"{field}: front", "auto or an axis such as +x", front)
    if front[1] == up[-1]:
        raise FormatError(f"{field}: front", f"an axis other than up, {up}", front)
    size = raw.get("size_lhw_m")
    if size is not None and not (isinstance(size, list) and len(size) == 3 and all(_positive(v) for v in size)):
        raise FormatError(f"{field}: size_lhw_m", "three positive numbers", size)
    unit = raw.get("metres_per_unit", 1.0)
    if not _positive(unit):
        raise FormatError(f"{field}: metres_per_unit", "a positive number", unit)
    use = raw.get("use", True)
    if not isinstance(use, bool):
        raise FormatError(f"{field}: use", "true or false", use)
    return _Entry(
        kind=None if kind is None else str(kind),
        up=up,
        front=front,
        size_lhw_m=None if size is None else cast(tuple[float, float, float], tuple(float(v) for v in size)),
        metres_per_unit=float(unit),
        use=use,
    )


def _positive(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < float("inf")


def _vehicle(path: Path, entry: _Entry) -> VehicleMesh:
    imported = _read(path, entry.up, entry.front)
    length, height, width = (e * entry.metres_per_unit for e in imported.size_lhw)
    kind = entry.kind or classify_vehicle(path.stem, (length, height, width))
    size = entry.size_lhw_m or usual_size(kind, (length, height, width))
    own = entry.size_lhw_m or (length, height, width)
    return VehicleMesh(path.name, kind, size, path, imported.up, entry.front, own, imported.notes)


def classify_vehicle(name: str, size_lhw: tuple[float, float, float]) -> str:
    """The body of a vehicle, by its file's name or else by its proportions (of any unit)."""
    words = re.sub(r"[^a-z0-9]+", " ", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    length, height, width = size_lhw
    for kind, pattern in _NAMES:
        if re.search(pattern, words):
            # What Americans and toy makers call a truck may be a pickup, which is no higher than it is wide.
            return "pickup" if kind == "truck" and height < 0.97 * width else kind
    slender, upright = length / height, height / width
    if upright > 1.15:
        # Trucks are as high as buses, but mostly shorter; both are long against vans.
        return "van" if slender < 2.6 else "truck" if slender < 3.2 else "bus"
    if upright > 0.95:
        return "van" if slender < 2.7 else "truck"
    return "suv" if upright > 0.87 else "sedan" if slender > 2.85 else "hatchback"


def usual_size(kind: str, size_lhw: tuple[float, float, float]) -> tuple[float, float, float]:
    """A plausible size in m for a body of given proportions (of any unit).

    The given size where it is plausible in metres; else scaled as a whole, then stretched as little as gets it
    there: toys are short and high.
    """
    low, high = np.array(_RANGE_LHW[kind]).T
    given = np.array(size_lhw)
    if not ((given > low * 0.9) & (given < high * 1.1)).all():
        given = given * np.exp(np.mean(np.log((low + high) / 2 / given)))
    length, height, width = (round(float(v), 3) for v in np.clip(given, low, high))
    return length, height, width


@lru_cache(maxsize=4)
def _read(path: Path, up: str, front: str) -> ImportedMesh:
    return import_mesh(path, up=up, front=front)


@lru_cache(maxsize=48)
def _mesh(vehicle: VehicleMesh) -> Mesh:
    mesh = _read(vehicle.path, vehicle.up, vehicle.front).mesh
    if mesh.faces.shape[0] > _MOST_FACES:
        mesh = simplify(mesh, _MOST_FACES)
    return with_parts(mesh)


def with_parts(mesh: Mesh) -> Mesh:
    """The mesh with windows, trim and lights found by colour, if its names distinguish paint and tyres at most.

    Many models have one material for the whole body, with a palette: pale blue or nearly black high up is glass,
    dark grey is trim unless it is the main colour, small yellow, red or white patches at the ends are lights.
    """
    if mesh.colours is None or bool((mesh.part == Part.GLASS).any()):
        return mesh
    part = mesh.part.numpy().copy()
    body = part == Part.PAINT
    corners = mesh.vertices.numpy()[mesh.faces.numpy()].astype(np.float64)
    colour = mesh.colours.numpy()[mesh.faces.numpy()].mean(axis=1)
    middle = corners.mean(axis=1)
    height = -middle[:, 1]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    top, bottom = colour.max(axis=1), colour.min(axis=1)
    saturation = (top - bottom) / np.maximum(top, 1e-6)
    # Greys of such palettes are a little blue too, but no more green than red.
    pale = (top > 0.7) & (colour[:, 1] - colour[:, 0] > 0.03) & (colour[:, 2] > colour[:, 1]) & (saturation < 0.35)
    glass = body & (height > 0.4) & (pale | ((top < 0.16) & (height > 0.55)))
    rest = body & ~glass
    dark, vivid = rest & (saturation < 0.3) & (top < 0.62), rest & (saturation >= 0.3)
    light_grey = rest & ~dark & ~vivid
    upper = height > 0.4
    shares = [float(area[group & upper].sum()) for group in (vivid, light_grey, dark)]
    main = int(np.argmax(shares))
    part[glass] = Part.GLASS
    if main != 2:
        part[dark] = Part.OTHER
    ends = (np.abs(middle[:, 0]) > 0.4) & (height > 0.2) & (height < 0.75)
    warm = (colour[:, 0] >= top - 1e-6) & (saturation > 0.6)
    lamps = vivid & ends & warm
    if main == 0:
        # On a red or yellow car, only what differs from its paint.
        reference = np.median(colour[vivid & upper], axis=0)
        lamps &= np.abs(colour - reference).max(axis=1) > 0.25
    if area[lamps].sum() < 0.03 * area.sum():
        part[lamps] = Part.LIGHT
    return Mesh(mesh.vertices, mesh.faces, torch.from_numpy(part), mesh.name, mesh.colours, mesh.uv)


def mesh_soup(mesh: Mesh, size_lhw: tuple[float, float, float], crease_rad: float = 0.65) -> Soup:
    """A vehicle's triangles in the unit box with its parts' materials; normals are smooth at the given size.

    albedo: of paint, NEUTRAL times its tint against the main paint, so that it can be painted anew; of windows,
    dark; of the rest, its own.
    """
    vertices, faces = mesh.vertices.numpy(), mesh.faces.numpy()
    corners = vertices[faces]
    part = mesh.part.numpy()
    count = len(faces)
    colours = np.full((count, 3), 0.5) if mesh.colours is None else mesh.colours.numpy()[faces].mean(axis=1)
    albedo = np.power(np.clip(colours, 0, 1), 2.2)
    paint = part == Part.PAINT
    if paint.any():
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        albedo[paint] = NEUTRAL * _tint(albedo[paint], np.linalg.norm(flat[paint], axis=1))
    albedo[part == Part.GLASS] = _PANE
    soup = make(corners, Material.PAINT, (0.5, 0.5, 0.5))
    soup.material[:] = _PART_MATERIAL[part]
    soup.albedo[:] = albedo
    # Placing divides normals by the size, as it must: they are given as the unit box has them.
    size = np.asarray(size_lhw, np.float32)
    normals = creased_normals(corners * size, crease_rad) * size
    soup.normals[:] = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return soup


@lru_cache(maxsize=48)
def vehicle_soup(vehicle: VehicleMesh, fine: bool = True) -> Soup:
    """`mesh_soup` of a vehicle at its usual size, cached. fine: with the triangles that only show from near."""
    mesh = vehicle.mesh
    return mesh_soup(mesh if fine else simplify(mesh, _FAR_FACES), vehicle.size_lhw)


def _tint(albedo: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Paint (n, 3) against the main paint, in [0, 2]: hue is preserved where the main paint is grey, else dropped."""
    order = np.argsort(albedo.sum(axis=1), kind="stable")
    share = np.cumsum(area[order])
    main = albedo[order[np.searchsorted(share, share[-1] / 2)]] if share[-1] > 0 else albedo[0]
    if main.max() - main.min() < 0.3 * main.max():
        return np.clip(albedo / np.maximum(main, 0.01), 0.0, 2.0)
    grey = albedo @ np.array([0.2126, 0.7152, 0.0722])
    return np.clip(grey / max(float(main @ [0.2126, 0.7152, 0.0722]), 0.01), 0.0, 2.0)[:, None].repeat(3, axis=1)


_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_LEAST_SUN_RAD = 0.2
"""The sun stands at least this high (11 degrees): the road must get its light."""
_MOST_SUN = 1.4
"""Most the sun gives a surface that faces it, where a level one in the open has about 1 at noon."""
_BALANCE = 0.75
"""How far white balance takes the colour of the light out, of 1."""
_LEAST_HORIZON = 0.7
"""Luminance of the sky near the horizon, where a sunlit white surface has 1: skies of driving photographs are all
but overexposed."""
_SUN_LOBE = 4.0
"""Pixels of a panorama this many times as bright as its brightest clouds belong to the sun."""


@dataclass(frozen=True, slots=True)
class Sky:
    """A photographed sky. pixels (h, w, 3) float32: linear radiance without the sun, equirectangular, zenith in
    the top row, horizon in the middle; sun_azimuth, sun_elevation: rad, the azimuth to the right of the middle
    column; sun_colour (3,): what the sun adds on a surface that faces it; ambient (3,): what the sky's upper half
    gives a level surface; both divided by pi, so that albedo times them is radiance.
    """

    name: str
    pixels: np.ndarray
    sun_azimuth: float
    sun_elevation: float
    sun_colour: np.ndarray
    ambient: np.ndarray

    @property
    def sunny(self) -> bool:
        """Whether the sun gives more of a level surface's light than half the sky does."""
        sun = float(self.sun_colour @ _LUMINANCE) * np.sin(self.sun_elevation)
        return bool(sun > 0.5 * float(self.ambient @ _LUMINANCE))

    @property
    def split(self) -> str:
        """ "train" or "heldout", by the name alone."""
        return choose_split(self.name)


def measured(name: str, pixels: np.ndarray) -> Sky:
    """The sky of a panorama (h, w, 3), linear radiance with its sun: the sun is measured and taken out.

    Raises FormatError for anything but a panorama twice as wide as high, of finite numbers >= 0.
    """
    shape = pixels.shape
    if len(shape) != 3 or shape[2] != 3 or shape[1] != 2 * shape[0] or shape[0] < 8:
        raise FormatError(f"{name}: pixels", "(h, 2 h, 3), h at least 8", shape)
    if not np.isfinite(pixels).all() or pixels.min() < 0:
        raise FormatError(f"{name}: pixels", "finite radiance of at least 0", "others")
    height, width = shape[:2]
    elevation = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    azimuth = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    solid = np.broadcast_to((np.cos(elevation) * (np.pi / height) * (2 * np.pi / width))[:, None], (height, width))
    above = elevation > 0
    value = pixels.astype(np.float64) @ _LUMINANCE
    # Clouds in the sun are a few times as bright as the sky around them, the sun some thousand times.
    limit = _SUN_LOBE * float(np.quantile(value[above], 0.98))
    disc = (value > limit) & above[:, None]
    rest = pixels.astype(np.float64).copy()
    sun_colour, sun_azimuth, sun_elevation = np.zeros(3), 0.0, np.pi / 4
    if disc.any():
        weight = (value - limit) * disc * solid
        spread = np.cos(elevation)[:, None] * np.ones(width)
        x = (weight * spread * np.sin(azimuth)).sum()
        z = (weight * spread * np.cos(azimuth)).sum()
        y = (weight * np.sin(elevation)[:, None]).sum()
        sun_azimuth, sun_elevation = float(np.arctan2(x, z)), float(np.arctan2(y, np.hypot(x, z)))
        shade = rest * (limit / np.maximum(value, 1e-9))[..., None]
        # Compressed panoramas keep the disc's strength but not its colour, which follows from its height well enough.
        strength = float((((rest - shade) * (disc * solid)[..., None]).sum(axis=(0, 1)) / np.pi).max())
        low = float(np.clip(1 - sun_elevation / np.deg2rad(30), 0, 1))
        sun_colour = strength * np.array([1.0, 0.95 - 0.2 * low, 0.86 - 0.42 * low])
        rest = _mended(rest, disc)
    fall = (np.clip(np.sin(elevation), 0, None)[:, None] * solid)[..., None]
    ambient = (rest * fall).sum(axis=(0, 1)) / np.pi
    return Sky(name, rest.astype(np.float32), sun_azimuth, sun_elevation, sun_colour, ambient)


def _mended(pixels: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """The panorama (h, w, 3) with a hole (h, w) and its rim filled from around; the left edge meets the right."""
    height, width = hole.shape
    reach = max(width // 64, 2)
    pad = 4 * reach
    wide = np.pad(hole, ((0, 0), (pad, pad)), mode="wrap").astype(np.uint8)
    rim = cv2.dilate(wide, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)).astype(bool)
    around = np.pad(pixels, ((0, 0), (pad, pad), (0, 0)), mode="wrap")
    weight = (~rim).astype(np.float64)
    # Only the sky fills the sky.
    weight[height // 2 :] = 0
    blurred = cv2.GaussianBlur(around * weight[..., None], (0, 0), 1.5 * reach)
    share = cv2.GaussianBlur(weight, (0, 0), 1.5 * reach)
    fill = rim & (share > 1e-4)
    around[fill] = blurred[fill] / share[fill][:, None]
    return around[:, pad : pad + width]


def skies_in(folder: str | Path) -> tuple[Sky, ...]:
    """The skies (.npz with `pixels`, see `measured`) of a folder, sorted by name; cached per process.

    Raises FormatError where the folder holds none, or one cannot be read.
    """
    place = Path(folder).resolve()
    if not place.is_dir():
        raise FormatError(str(folder), "a folder of skies", "no such folder")
    found = sorted(place.glob("*.npz"))
    if not found:
        raise FormatError(str(folder), "skies (.npz)", "none")
    return _skies(tuple((path, path.stat().st_mtime_ns) for path in found))


@lru_cache(maxsize=2)
def _skies(found: tuple[tuple[Path, int], ...]) -> tuple[Sky, ...]:
    skies = []
    for path, _ in found:
        arrays = files.read_npz(path)
        if "pixels" not in arrays or arrays["pixels"].dtype.kind not in "fiu":
            raise FormatError(str(path), "a sky with `pixels`", ", ".join(arrays) or "nothing")
        skies.append(measured(path.stem, arrays["pixels"].astype(np.float32)))
    return tuple(skies)


def with_sky(light: Light, sky: Sky, rng: np.random.Generator) -> Light:
    """The light under a photographed sky, turned at random about the vertical.

    A level surface in the open stays as bright as it was and nearly of its colour, as a camera's exposure and
    white balance see to. Fog stays as it is, for it hides the sky.
    """
    turn = float(rng.uniform(-np.pi, np.pi))
    if light.weather == "fog":
        return light
    right, forward = (axis.astype(np.float64) for axis in light.ahead)
    elevation = max(sky.sun_elevation, _LEAST_SUN_RAD)
    azimuth = sky.sun_azimuth + turn
    sun = np.cos(elevation) * (np.sin(azimuth) * right + np.cos(azimuth) * forward) + np.sin(elevation) * light.up
    before = light.ambient + light.sun_colour * max(float(light.sun @ light.up), 0.0)
    shining = sky.sun_colour * _dimming(sky, float(before @ _LUMINANCE), float(np.sin(elevation)))
    now = np.maximum(sky.ambient + shining * np.sin(elevation), 1e-9)
    whole = float(before @ _LUMINANCE) / float(now @ _LUMINANCE)
    gain = whole ** (1 - _BALANCE) * (before / now) ** _BALANCE
    gain *= float(before @ _LUMINANCE) / float((gain * now) @ _LUMINANCE)
    rows = sky.pixels.shape[0] // 2
    horizon = sky.pixels[rows - max(rows // 6, 1) : rows].mean(axis=(0, 1)) * gain
    brightening = max(_LEAST_HORIZON / max(float(horizon @ _LUMINANCE), 1e-9), 1.0)
    pixels = sky.pixels * (gain * brightening).astype(np.float32)
    return replace(
        light,
        weather=("dusk" if elevation < 0.26 else "sun") if sky.sunny else "overcast",
        sun=sun,
        sun_colour=shining * gain,
        zenith=pixels[: max(rows // 3, 1)].mean(axis=(0, 1)).astype(np.float64),
        horizon=horizon * brightening,
        ambient=sky.ambient * gain,
        panorama=Panorama(pixels, turn),
    )


def _dimming(sky: Sky, level: float, height: float) -> float:
    """What the sun is multiplied by so that it gives at most `_MOST_SUN`, once a level surface gets `level`.

    A low sun is so much stronger than its sky that no photograph shows both. height: sine of its elevation.
    """
    sun, ambient = float(sky.sun_colour @ _LUMINANCE), float(sky.ambient @ _LUMINANCE)
    room = level - _MOST_SUN * height
    if sun <= 0 or room <= 0:
        return 1.0
    # level * sun / (ambient + sun * height) <= _MOST_SUN, solved for the sun
    return min(1.0, _MOST_SUN * ambient / room / sun)


@dataclass(frozen=True, slots=True)
class Assets:
    """What a pack holds; either may be empty, not both."""

    vehicles: tuple[VehicleMesh, ...]
    skies: tuple[Sky, ...]


def assets_from(folder: str | Path) -> Assets:
    """The vehicles and skies of a pack: a folder with `vehicles/` or `skies/`, or both.

    Raises FormatError where it has neither, and what `meshes_in` and `skies_in` raise.
    """
    place = Path(folder)
    vehicles, skies = place / "vehicles", place / "skies"
    if not vehicles.is_dir() and not skies.is_dir():
        raise FormatError(
            str(folder), "a folder with vehicles/ or skies/ (tools/fetch_assets.py writes one)", "none"
        )
    return Assets(meshes_in(vehicles) if vehicles.is_dir() else (), skies_in(skies) if skies.is_dir() else ())
