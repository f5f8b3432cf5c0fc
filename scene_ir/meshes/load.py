"""Read meshes from OBJ, GLB, GLTF and PLY files, and write GLB files that keep every bit."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from trimesh.resolvers import Resolver
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.meshes.gltf import VERTEX_COLOURS, GltfContents, compare_counts, parse_header
from scene_ir.meshes.obj import read_obj
from scene_ir.types import Mesh, Part

_Number = TypeVar("_Number", np.float32, np.float64)
NOTES = "notes"
"""Key in a scene's metadata of what was left out or is missing."""
_VERSION = 1
_KEY = "drivesem_mesh"
"""Key in the GLB mesh's `extras` that marks files of `save_mesh`."""
_SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".webp", ".gif")
_MAX_BYTES = 1 << 27
"""Size limit of a file: text takes ten times as much memory."""
_MAX_FACES = 2_000_000
"""Limit of faces placed by a file: hand-made vehicles have thousands, scans hundreds of thousands."""
_MAX_DECLARED = 20_000_000
"""Limit of the elements that a header declares: a face may have its own vertices, normals and more."""
_MAX_COORDINATE = 1e9
"""Limit of coordinates in a file's own units: a car in micrometres is smaller."""
_MAX_NODES = 10_000
_MAX_TEXELS = 1 << 26
_PLY_HEAD = 1 << 16
_MAX_DIGITS = 18
"""Length limit of a number in a header."""
_AXES = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
_UP = {"y": "+y", "z": "+z", "-y": "-y"}
_GLTF_TRANSFORM = np.diag([1.0, -1.0, -1.0, 1.0])
"""Node transform of our GLBs: glTF's y points up, ours down."""
_PART_PATTERNS = (
    (
        Part.LIGHT,
        r"(head|tail|brake|fog|turn|stop)[ _-]?light|lights?\b|lights?[_-](front|rear|back|left|right|[lr]\b|\d)"
        r"|lamp|blinker|indicator|turn[ _-]?signal|\bfaros?\b|\bphares?\b|scheinwerfer",
    ),
    (
        Part.OTHER,
        r"rim\b|rims|alloy|hubcap|brake|seat|interior|dash|steer|grill|plate|underbody|engine|chassis"
        r"|door[ _-]?lines?|inside",
    ),
    (Part.TYRE, r"tyre|tire|wheel|rubber|pneu|neumatico|reifen"),
    (Part.GLASS, r"glass|window|windshield|windscreen|vitre|vidrio|cristal|fenster"),
    (
        Part.PAINT,
        r"paint|body|carros|karosserie|chapa|door|hood|bonnet|roof|fender|shell"
        r"|(first|second|main|car)[ _-]?colou?r",
    ),
)
"""Parts by patterns of material and mesh names; the first match counts."""
_DEFAULT_COLOUR = 0.8
_CAB_OFFSET = 0.2
"""Distance of the windows' centre from the middle, in lengths, beyond which they are a cab's."""


@dataclass(frozen=True, slots=True)
class ImportedMesh:
    """A mesh in the unit box with its original size."""

    mesh: Mesh
    """The mesh."""
    size_lhw: tuple[float, float, float]
    """Length, height, width, m."""
    up: str = "y"
    """The file's axis that points up."""
    notes: tuple[str, ...] = ()
    """What was left out of the file or is missing, one line each."""


def import_mesh(
    path: str | Path, *, up: str = "auto", front: str = "auto", metres_per_unit: float = 1.0
) -> ImportedMesh:
    """Read a mesh file and transform it to the unit box: front along +x, y down, sides at z = -0.5 and 0.5.

    The scene graph is flattened. Materials and textures become vertex colours: a texture is sampled at the vertices,
    which is exact for palettes and coarse for photographs. Parts are guessed from material and mesh names. Files of
    `save_mesh` are returned as saved, regardless of the options.

    Args:
        path: An OBJ, GLB, GLTF or PLY file.
        up: The file's axis that points up: "y", "z", "-y", or "auto": y or z, whichever puts the tyres low, or makes a
            file without tyres lower than long.
        front: The file's axis that the vehicle faces, "+x" ... "-z", or "auto": the longest horizontal axis, towards
            parts named front, else towards the end with all windows (lorries), else away from the roof's centre
            (bonnets are longer than boots).
        metres_per_unit: Scale of the file.

    Returns:
        The mesh and its size.

    Raises:
        FormatError: The file cannot be read or has no faces.
        RangeError: An unknown axis.
    """
    file = Path(path)
    if up not in (*_UP, "auto"):
        raise RangeError("up", " or ".join((*_UP, "auto")), up)
    if up == "auto" and front[1:] == "y":
        up = "z"  # what faces along y can only stand on z
    if front != "auto" and (front not in _AXES or front[1] == up[-1]):
        raise RangeError("front", "auto or an axis at right angles to up, such as +x", front)
    if not metres_per_unit > 0:
        raise RangeError("metres_per_unit", "a positive number", metres_per_unit)
    scene = read_scene(file)
    own = _saved_mesh(scene, file)
    if own is not None:
        extent = own.vertices.amax(dim=0) - own.vertices.amin(dim=0)
        return ImportedMesh(own, (float(extent[0]), float(extent[1]), float(extent[2])))
    soup = _flatten(scene, file)
    if up == "auto":
        up = _find_up(soup, front)
    turned = soup.vertices @ _file_rotation(soup, _AXES[_UP[up]], front).T
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent = high - low
    if not np.all(extent > 0):
        raise FormatError(str(file), "a solid with length, height and width", f"extents {extent.tolist()}")
    unit = (turned - low) / extent - np.array([0.5, 1.0, 0.5])
    faces = soup.faces
    corners = unit[faces]
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1].copy()
    mesh = Mesh(
        vertices=torch.from_numpy(unit.astype(np.float32)),
        faces=torch.from_numpy(faces),
        part=torch.from_numpy(soup.part),
        name=file.stem,
        colours=torch.from_numpy(soup.colours.astype(np.float32)),
        uv=None if soup.uv is None else torch.from_numpy(soup.uv.astype(np.float32)),
    )
    length, height, width = (float(e) * metres_per_unit for e in extent)
    return ImportedMesh(mesh, (length, height, width), up, tuple(scene.metadata[NOTES]))


def load_mesh(path: str | Path, *, up: str = "auto", front: str = "auto") -> Mesh:
    """The mesh of `import_mesh`.

    Args:
        path: An OBJ, GLB, GLTF or PLY file.
        up: The file's axis that points up, or "auto".
        front: The file's axis that the vehicle faces, or "auto".

    Returns:
        The mesh; for a file of `save_mesh`, exactly the saved one.
    """
    return import_mesh(path, up=up, front=front).mesh


def save_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a GLB that `load_mesh` reads back exactly (float32), and that viewers show in its colours.

    Raises FormatError for another suffix than .glb, or a mesh without faces (glTF has no empty meshes).
    """
    file = Path(path)
    if file.suffix.lower() != ".glb":
        raise FormatError(str(file), "a file name that ends in .glb", file.suffix or "no suffix")
    if mesh.faces.shape[0] == 0:
        raise FormatError(str(file), "a mesh with faces", "none")
    shape = trimesh.Trimesh(
        vertices=mesh.vertices.detach().cpu().numpy().astype(np.float32),
        faces=mesh.faces.cpu().numpy(),
        process=False,
        metadata={_KEY: _VERSION, "name_for_people": mesh.name, "part": mesh.part.cpu().tolist()},
    )
    if mesh.colours is not None:
        colours = mesh.colours.detach().cpu().numpy().astype(np.float32)
        colours_8bit = np.round(srgb_to_linear(colours.clip(0, 1)) * 255).astype(np.uint8)
        shape.visual = ColorVisuals(shape, vertex_colors=colours_8bit)
        shape.vertex_attributes["_rgb"] = colours
    if mesh.uv is not None:
        shape.vertex_attributes["_uv"] = mesh.uv.detach().cpu().numpy().astype(np.float32)
    scene = trimesh.Scene()
    scene.add_geometry(shape, geom_name="mesh", node_name="vehicle", transform=_GLTF_TRANSFORM)
    content = scene.export(file_type="glb", include_normals=False)
    assert isinstance(content, bytes)
    files.write_bytes(file, content)


def read_scene(file: Path, root: Path | None = None, max_bytes: int = _MAX_BYTES) -> trimesh.Scene:
    """Read the scene in a mesh file.

    Args:
        file: An OBJ, GLB, GLTF or PLY file.
        root: Folder that materials and textures must be in; the file's own by default.
        max_bytes: Size limit of each file.

    Returns:
        The scene; its metadata has what was left out or is missing, one line each, under `NOTES`.

    Raises:
        FormatError: The file is missing, too large, no mesh, or its import differs from its own counts and bounds.
    """
    if file.suffix.lower() not in _SUFFIXES:
        raise FormatError(str(file), f"a mesh file ({', '.join(_SUFFIXES)})", file.suffix or "no suffix")
    if not file.is_file():
        raise FormatError(str(file), "a mesh file", "no such file")
    data, kind = files.read_bytes(file, max_bytes), file.suffix.lower().removeprefix(".")
    _check_declared_sizes(file, kind, data)
    resolver = _MeshFiles(file.parent, root or file.parent, max_bytes)
    try:
        if kind == "obj":
            scene, notes = read_obj(data, file, resolver)
        elif kind == "ply":
            scene, notes = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False), []
            _check_ply(scene, file, data)
        else:
            contents = GltfContents.read(data, kind, file)
            content, notes = io.BytesIO(contents.encode(data, kind)), contents.notes
            scene = trimesh.load_scene(content, file_type=kind, resolver=resolver, process=False)
            contents.check_scene(scene, file)
    except FormatError:
        raise
    except Exception as error:  # the parsers behind trimesh raise many types
        reason = next(iter(f"{type(error).__name__}: {error}".splitlines()))
        raise FormatError(str(file), "a readable mesh", reason) from None
    scene.metadata[NOTES] = [*resolver.faults, *notes]
    return scene


def _check_ply(scene: trimesh.Scene, file: Path, data: bytes) -> None:
    """Compare what was imported with a PLY's header; polygons may become several triangles."""
    counts = _ply_counts(data)
    shapes = [shape for shape in scene.geometry.values() if isinstance(shape, trimesh.Trimesh)]
    if shapes:
        compare_counts(f"{file}: vertices", counts.get("vertex", 0), sum(len(shape.vertices) for shape in shapes))
        faces = sum(len(shape.faces) for shape in shapes)
        if faces < counts.get("face", 0):
            compare_counts(f"{file}: faces", counts["face"], faces)


class _MeshFiles(Resolver):
    """Files that a mesh file refers to, such as materials and textures.

    They must be regular files below `root` of at most `most` bytes, and images within the size limit. A name that
    leads elsewhere is looked up in `folder` by its last part, as asset packs need it.
    """

    def __init__(self, folder: Path, root: Path, most: int) -> None:
        self._folder, self._root, self._most = folder, root, most
        self.faults: list[str] = []
        """Files that are missing or cannot be read, one line each: trimesh goes on without them."""

    def get(self, key: str) -> bytes:
        """The content of a file. Raises FormatError, and FileNotFoundError if there is none."""
        try:
            return self._read(key)
        except (FormatError, FileNotFoundError) as error:
            missing = f"{key.strip()} is missing"
            self.faults.append(str(error) if isinstance(error, FormatError) else missing)
            raise

    def _read(self, key: str) -> bytes:
        name = key.strip().replace("\\", "/")
        name = name.split()[-1] if name.startswith("-") else name  # options of a texture precede its name
        for candidate in dict.fromkeys((name, unquote(name), name.rpartition("/")[2])):  # glTF's are quoted
            path = self._folder / candidate
            if path.resolve().is_relative_to(self._root.resolve()) and path.is_file():
                data = files.read_bytes(path, self._most)
                if path.suffix.lower() in _IMAGES:
                    files.read_image_size(path, data)
                return data
        raise FileNotFoundError(key)

    def keys(self) -> list[str]:
        """No names: files are requested one by one."""
        return []

    def namespaced(self, namespace: str) -> _MeshFiles:
        """Files in a subfolder."""
        return _MeshFiles(self._folder / namespace, self._root, self._most)

    def write(self, name: str, data: str | bytes) -> None:
        """Raises FormatError: reading a mesh writes nothing."""
        raise FormatError(str(self._folder / name), "a mesh that is read", "one that is written")


def _check_declared_sizes(file: Path, kind: str, data: bytes) -> None:
    """Raise FormatError for a file that declares more elements than a vehicle has, before it is parsed."""
    counts: list[Any] = []
    if kind in ("glb", "gltf"):
        lists = parse_header(data, kind, file)
        accessors, nodes = (
            lists[key] if isinstance(lists.get(key), list) else [] for key in ("accessors", "nodes")
        )
        counts = [one.get("count", 0) for one in accessors if isinstance(one, dict)]
        if len(nodes) > _MAX_NODES:
            raise FormatError(f"{file}: nodes", f"at most {_MAX_NODES:,}", f"{len(nodes):,}")
    elif kind == "ply":
        counts = list(_ply_counts(data).values())
    whole = [count for count in counts if type(count) is int]
    if sum(whole) > _MAX_DECLARED:
        raise FormatError(
            str(file), f"at most {_MAX_DECLARED:,} vertices, faces and their values", f"{sum(whole):,}"
        )


def _ply_counts(data: bytes) -> dict[str, int]:
    """Number of elements by name in a PLY's header."""
    head = data[:_PLY_HEAD].partition(b"end_header")[0].decode("latin-1")
    return {name: int(count[:_MAX_DIGITS]) for name, count in re.findall(r"element\s+(\S+)\s+(\d+)", head)}


def _saved_mesh(scene: trimesh.Scene, file: Path) -> Mesh | None:
    """The mesh as `save_mesh` wrote it, or None for another file."""
    shapes = [g for g in scene.geometry.values() if isinstance(g, trimesh.Trimesh) and _KEY in g.metadata]
    if not shapes:
        return None
    shape = shapes[0]
    if shape.metadata[_KEY] != _VERSION:
        raise FormatError(f"{file}: {_KEY}", f"version {_VERSION}", shape.metadata[_KEY])
    part = shape.metadata.get("part")
    if not isinstance(part, list) or len(part) != len(shape.faces):
        raise FormatError(
            f"{file}: part", f"{len(shape.faces)} entries", len(part) if isinstance(part, list) else "none"
        )
    if not all(type(one) is int for one in part):
        raise FormatError(f"{file}: part", "whole numbers", "others")
    rgb, uv = shape.vertex_attributes.get("_rgb"), shape.vertex_attributes.get("_uv")
    return Mesh(
        vertices=torch.from_numpy(np.array(shape.vertices, dtype=np.float32)),
        faces=torch.from_numpy(np.array(shape.faces, dtype=np.int64)),
        part=torch.tensor(part, dtype=torch.int64),
        name=str(shape.metadata.get("name_for_people", "")),
        colours=None if rgb is None else torch.from_numpy(np.array(rgb, dtype=np.float32)),
        uv=None if uv is None else torch.from_numpy(np.array(uv, dtype=np.float32)),
    )


@dataclass(frozen=True, slots=True)
class _Soup:
    """A file's geometry in its scene's frame."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    part: NDArray[np.int64]
    colours: NDArray[np.float64]
    uv: NDArray[np.float64] | None
    forward: NDArray[np.float64]


def _flatten(scene: trimesh.Scene, file: Path) -> _Soup:
    vertices, faces, names, colours, uvs, sides = [], [], [], [], [], []
    start = total = 0
    for (label, _), node in _sort_nodes(scene):
        transform, geometry_name = scene.graph[node]
        shape = scene.geometry[geometry_name]
        if not isinstance(shape, trimesh.Trimesh) or len(shape.faces) == 0:
            continue
        total += len(shape.faces)
        if total > _MAX_FACES:
            raise FormatError(f"{file}: faces", f"at most {_MAX_FACES:,}", "more")
        if shape.vertices.shape[1] != 3:
            raise FormatError(f"{file}: vertices", "three coordinates each", shape.vertices.shape[1])
        placed = trimesh.transform_points(shape.vertices, transform)
        index = np.asarray(shape.faces, dtype=np.int64)
        if index.min() < 0 or index.max() >= len(placed):
            raise FormatError(f"{file}: faces", f"indices of {len(placed)} vertices", int(index.max()))
        if np.linalg.det(transform[:3, :3]) < 0:
            index = index[:, ::-1]
        material = getattr(shape.visual, "material", None)
        names.append((f"{getattr(material, 'name', '') or ''}", f"{label} {geometry_name}", len(index)))
        used, index = np.unique(index, return_inverse=True)  # others are part of no surface
        uv = getattr(shape.visual, "uv", None)
        uvs.append(None if uv is None or len(uv) != len(placed) else np.asarray(uv)[used, :2])
        placed = placed[used]
        vertices.append(placed)
        faces.append(index.reshape(-1, 3) + start)
        colours.append(_vertex_colours(shape, file)[used])
        if "front" in label.lower():
            sides.append((1.0, placed.mean(axis=0)))
        elif re.search(r"back|rear", label.lower()):
            sides.append((-1.0, placed.mean(axis=0)))
        start += len(placed)
    if not faces:
        raise FormatError(str(file), "a mesh with faces", "none")
    everything = np.concatenate(vertices)
    if not np.isfinite(everything).all():
        raise FormatError(f"{file}: vertices", "finite coordinates", "NaN or infinity")
    if (most := float(np.abs(everything).max())) > _MAX_COORDINATE:
        raise FormatError(f"{file}: vertices", f"coordinates up to {_MAX_COORDINATE:g}", f"{most:g}")
    forward = np.zeros(3)
    if {sign for sign, _ in sides} == {1.0, -1.0}:
        for sign in (1.0, -1.0):
            forward += sign * np.mean([centre for s, centre in sides if s == sign], axis=0)
    uv = np.concatenate([u for u in uvs if u is not None]) if all(u is not None for u in uvs) else None
    return _Soup(everything, np.concatenate(faces), _parts(names), np.concatenate(colours), uv, forward)


def _sort_nodes(scene: trimesh.Scene) -> list[tuple[tuple[str, int], str]]:
    """((label, position of the mesh), name) of the nodes with meshes, sorted.

    The label is the name as in the file: trimesh adds random letters for meshes of several primitives.
    """
    position = {name: index for index, name in enumerate(scene.geometry)}
    found = []
    for node in scene.graph.nodes_geometry:
        name = scene.graph[node][1]
        several = scene.geometry[name].metadata.get("from_gltf_primitive", False)
        found.append(((node.rpartition("_")[0] if several else node, position[name]), node))
    return sorted(found)


def _parts(names: list[tuple[str, str, int]]) -> NDArray[np.int64]:
    """A part a face from (material name, mesh name, number of faces); unnamed ones are paint if no other is."""
    found = []
    for material, mesh, _ in names:
        texts = (material.lower(), mesh.lower())
        found.append(
            next((p for text in texts for p, pattern in _PART_PATTERNS if re.search(pattern, text)), None)
        )
    unnamed = Part.OTHER if Part.PAINT in found else Part.PAINT
    counts = [count for _, _, count in names]
    return np.repeat([int(unnamed if p is None else p) for p in found], counts).astype(np.int64)


def _vertex_colours(shape: trimesh.Trimesh, file: Path) -> NDArray[np.float64]:
    """RGB (V, 3) in [0, 1] from texture, material, or vertex colours, in this order; of glTF from all of them, as
    they are factors of each other. FormatError for a texture that does not decode, or is too large.
    """
    base, share = _surface_colours(shape, file), painted(shape)
    if share is not None:
        return _srgb(share) * (1.0 if base is None else base)
    return np.full((len(shape.vertices), 3), _DEFAULT_COLOUR) if base is None else base


def painted(shape: trimesh.Trimesh) -> NDArray[np.float64] | None:
    """What glTF's vertex colours multiply a surface's with: linear RGB (V, 3) in [0, 1]; None without any."""
    values = shape.vertex_attributes.get(VERTEX_COLOURS)
    if values is None or len(values) != len(shape.vertices):
        return None
    share = np.asarray(values)[:, :3]
    most = np.iinfo(share.dtype).max if np.issubdtype(share.dtype, np.integer) else 1.0
    return np.nan_to_num(share / most, posinf=1.0).clip(0, 1).astype(np.float64)


def _surface_colours(shape: trimesh.Trimesh, file: Path) -> NDArray[np.float64] | None:
    """Vertex colours (V, 3) of trimesh's materials and textures; None if there are none."""
    count = len(shape.vertices)
    visual = shape.visual
    if isinstance(visual, ColorVisuals):
        return np.asarray(visual.vertex_colors)[:, :3] / 255.0 if visual.defined else None
    if not isinstance(visual, TextureVisuals):
        return None
    material, uv, image, tint = visual.material, visual.uv, None, None
    if isinstance(material, PBRMaterial):
        image = material.baseColorTexture
        if material.baseColorFactor is not None:
            # glTF's factor is linear light, its textures and our colours are sRGB
            tint = _srgb(np.asarray(material.baseColorFactor, dtype=float)[:3] / 255.0)
    elif isinstance(material, SimpleMaterial):
        image = material.image
        if image is None:
            tint = np.asarray(material.main_color, dtype=float)[:3] / 255.0
    if image is None or uv is None or len(uv) != count:
        return None if tint is None else np.tile(tint, (count, 1))
    return sample_texture(image, uv[:, :2], file) * (1.0 if tint is None else tint)


def sample_texture(
    image: Any, uv: NDArray[np.float64], file: Path, max_side_px: int | None = None
) -> NDArray[np.float64]:
    """Sample a texture at coordinates.

    Args:
        image: A Pillow image.
        uv: Coordinates (..., 2), v upwards.
        file: The mesh's file, for messages.
        max_side_px: A larger image is averaged down to this size first.

    Returns:
        sRGB (..., 3) in [0, 1].

    Raises:
        FormatError: The image is too large or damaged.
    """
    if image.width * image.height > _MAX_TEXELS:
        found = f"{image.width}x{image.height}"
        raise FormatError(f"{file}: texture", f"at most {_MAX_TEXELS:,} px", found)
    try:
        image = image.convert("RGB")
    except (OSError, ValueError, SyntaxError) as error:  # Pillow reads pixels only now
        raise FormatError(f"{file}: texture", "an image", str(error).splitlines()[0]) from error
    if max_side_px is not None:
        image.thumbnail((max_side_px, max_side_px))
    pixels = np.asarray(image)
    height, width = pixels.shape[:2]
    places = np.nan_to_num(uv, posinf=0.0, neginf=0.0)
    if places.size and (places.min() < 0 or places.max() > 1):
        places = np.mod(places, 1.0)  # it repeats; else 1 is its end, and not where it begins again
    columns = np.floor(places[..., 0] * width).astype(int).clip(0, width - 1)
    rows = np.floor((1.0 - places[..., 1]) * height).astype(int).clip(0, height - 1)
    return pixels[rows, columns] / 255.0


def _srgb(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear light to sRGB, in [0, 1] (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clip(1e-9) ** (1 / 2.4) - 0.055)


def srgb_to_linear(srgb: NDArray[_Number]) -> NDArray[_Number]:
    """sRGB to linear light, in [0, 1] (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _find_up(soup: _Soup, front: str) -> str:
    """Which of y and z points up: the tyres lie low; without tyres, no vehicle is higher than long."""
    tyres = soup.vertices[soup.faces[soup.part == int(Part.TYRE)]].reshape(-1, 3)
    for up in ("y", "z"):
        if front[1:] == up:
            continue
        axes = _file_rotation(soup, _AXES[_UP[up]], front)
        length, height, _ = np.ptp(soup.vertices @ axes.T, axis=0)
        down = soup.vertices @ axes[1]
        low = (
            float((tyres @ axes[1]).mean()) > float(down.max()) - 0.4 * height
            if len(tyres)
            else height < 0.95 * length
        )
        if low and height < length:
            return up
    return "y"


def _file_rotation(soup: _Soup, up: tuple[float, float, float], front: str) -> NDArray[np.float64]:
    """Rotation (3, 3) from the file's axes to ours; its rows are our x (front), y (down), z."""
    down = -np.asarray(up)
    if front != "auto":
        forward = np.asarray(_AXES[front])
    else:
        extent = np.ptp(soup.vertices, axis=0)
        horizontal = np.where(np.abs(down) > 0.5, -np.inf, extent)
        forward = np.eye(3)[int(np.argmax(horizontal))]
        lead = float(forward @ soup.forward)
        if lead == 0.0:
            lead = _window_side(soup, forward)
        if lead == 0.0:
            lead = _bonnet_side(soup.vertices, soup.faces, forward, -down)
        if lead < 0:
            forward = -forward
    return np.stack([forward, down, np.cross(forward, down)])


def _window_side(soup: _Soup, forward: NDArray[np.float64]) -> float:
    """Centre of the windows' surface along `forward`, from the middle, in lengths; 0 unless near one end.

    It is within 0.1 of the middle for cars, and beyond 0.25 for lorries and panel vans.
    """
    corners = soup.vertices[soup.faces[soup.part == int(Part.GLASS)]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if area.sum() == 0:
        return 0.0
    along = soup.vertices @ forward
    middle = (along.min() + along.max()) / 2
    centre = float((corners.mean(axis=1) @ forward * area).sum() / area.sum())
    lead = (centre - middle) / float(np.ptp(along))
    return lead if abs(lead) > _CAB_OFFSET else 0.0


def _bonnet_side(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], forward: NDArray[np.float64], up: NDArray[np.float64]
) -> float:
    """Positive if the upper third's surface lies behind the middle along `forward`."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    centre = corners.mean(axis=1)
    height, along = centre @ up, centre @ forward
    bounds = vertices @ up
    upper = height > bounds.min() + 0.67 * np.ptp(bounds)
    weight = np.where(upper, area, 0.0)
    if weight.sum() == 0:
        return 1.0
    middle = (vertices @ forward).min() + np.ptp(vertices @ forward) / 2
    return float(middle - (along * weight).sum() / weight.sum())
