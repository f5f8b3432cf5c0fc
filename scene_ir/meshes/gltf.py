"""Check glTF files before and after trimesh reads them: what it does not read is refused, what it reads must agree."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.visual import TextureVisuals

from scene_ir import files
from scene_ir.errors import FormatError

VERTEX_COLOURS = "_COLOR0"
"""Name of glTF's vertex colours under which trimesh leaves them unchanged."""
_VERTEX_UV = "_TEXCOORD0"
"""The same for texture coordinates."""
_HEAD = 20
"""Bytes before a GLB's JSON."""
_READ = ("KHR_mesh_quantization", "EXT_texture_webp", "KHR_materials_", "KHR_lights_", "KHR_xmp", "KHR_animation_")
"""Extensions, or beginnings of their names, that are read or change no shape and no base colour."""
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_FLOAT = 5126
_MAX_POINTS = 20_000_000
"""Bounds of more vertices are not compared: their faces are too many as well."""
_TOLERANCE = 1e-3
"""Largest difference of bounds, as a fraction of the largest side: files give them with few digits."""


@dataclass(frozen=True, slots=True)
class GltfContents:
    """What the header of a glTF file states."""

    header: dict[str, Any]
    """The header without what is not drawn."""
    notes: list[str]
    """What is left out, one line each."""

    @classmethod
    def read(cls, data: bytes, kind: str, file: Path) -> GltfContents:
        """Read a file's header.

        Args:
            data: The file's content.
            kind: "glb" or "gltf".
            file: The file, for messages.

        Raises:
            FormatError: No header, or a file with geometry that is not read.
        """
        header = parse_header(data, kind, file)
        for name in header.get("extensionsRequired", []):
            if not str(name).startswith(_READ):
                raise FormatError(f"{file}: extensionsRequired", "none that cannot be read", name)
        unread = sorted({str(n) for n in header.get("extensionsUsed", []) if not str(n).startswith(_READ)})
        notes = [f"glTF extensions that are not read: {', '.join(unread)}"] if unread else []
        without = others = 0
        for mesh in header.get("meshes", []):
            whole = [p for p in mesh["primitives"] if "POSITION" in p["attributes"]]
            surfaces = [p for p in whole if p.get("mode", _TRIANGLES) >= _TRIANGLES]
            without, others = without + len(mesh["primitives"]) - len(whole), others + len(whole) - len(surfaces)
            mesh["primitives"] = [_simplify_primitive(p, header, file) for p in surfaces]
        nodes = header.get("nodes", [])
        for node in nodes:
            node.pop("camera", None)  # trimesh drops the meshes of its node
            if "mesh" in node and not header["meshes"][node["mesh"]]["primitives"]:
                del node["mesh"]  # trimesh drops the children of such a node
        skinned = sum("skin" in node for node in nodes)
        counts = {
            "primitives without positions, not drawn": without,
            "primitives of points or lines, not drawn": others,
            "skinned nodes, placed by their own transform": skinned,
        }
        notes += [f"{text}: {count}" for text, count in counts.items() if count]
        return cls(header, notes)

    def encode(self, data: bytes, kind: str) -> bytes:
        """The file's content with this header."""
        text = json.dumps(self.header, separators=(",", ":")).encode()
        if kind == "gltf":
            return text
        text += b" " * (-len(text) % 4)
        rest = data[_HEAD + _json_length(data) :]
        length = _HEAD + len(text) + len(rest)
        return b"".join(
            (data[:8], length.to_bytes(4, "little"), len(text).to_bytes(4, "little"), data[16:_HEAD], text, rest)
        )

    def check_scene(self, scene: trimesh.Scene, file: Path) -> None:
        """Compare what was imported with the header, decode integers, and note textures that were not read.

        Raises:
            FormatError: Another number of meshes, vertices or triangles, or other bounds.
        """
        primitives = [p for mesh in self.header.get("meshes", []) for p in mesh["primitives"]]
        shapes = list(scene.geometry.values())
        compare_counts(f"{file}: primitives", len(primitives), len(shapes))
        for primitive, shape in zip(primitives, shapes, strict=True):
            self._check_primitive(primitive, shape, file)
        instances: defaultdict[int, list[NDArray[np.float64]]] = defaultdict(list)
        for mesh, matrix in _mesh_instances(self.header, file):
            instances[mesh].append(matrix)
        owner = [i for i, mesh in enumerate(self.header.get("meshes", [])) for _ in mesh["primitives"]]
        stated = [(shape, matrix) for shape, mesh in zip(shapes, owner, strict=True) for matrix in instances[mesh]]
        places = [scene.graph[node] for node in scene.graph.nodes_geometry]
        found = [(scene.geometry[name], matrix) for matrix, name in places]
        triangles = [sum(len(shape.faces) for shape, _ in group) for group in (stated, found)]
        compare_counts(f"{file}: triangles", *triangles)
        if stated and sum(len(shape.vertices) for shape, _ in found) < _MAX_POINTS:
            _compare_bounds(f"{file}: bounds", *(_placed_bounds(group) for group in (stated, found)))

    def _check_primitive(self, primitive: dict[str, Any], shape: trimesh.Trimesh, file: Path) -> None:
        accessors = self.header["accessors"]
        index = primitive["attributes"]["POSITION"]
        position = accessors[index]
        compare_counts(f"{file}: accessor {index}: vertices", position["count"], len(shape.vertices))
        corners = accessors[primitive["indices"]]["count"] if "indices" in primitive else position["count"]
        strip = primitive.get("mode", _TRIANGLES) == _STRIP
        compare_counts(f"{file}: triangles", corners - 2 if strip else corners // 3, len(shape.faces))
        if len(shape.vertices) and {"min", "max"} <= position.keys():
            stated = np.array([position["min"], position["max"]], dtype=float)
            _compare_bounds(f"{file}: accessor {index}", stated, _bounds(np.asarray(shape.vertices, dtype=float)))
        if position["componentType"] != _FLOAT:
            shape.vertices = _decode_integers(np.asarray(shape.vertices), position)
        raw = shape.vertex_attributes.pop(_VERTEX_UV, None)
        visual = shape.visual
        if isinstance(visual, TextureVisuals):
            if raw is not None:
                uv = _decode_integers(np.asarray(raw), accessors[primitive["attributes"]["TEXCOORD_0"]])
                visual.uv = np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)
            source = self.header.get("materials", [{}])[primitive.get("material", 0)]
            texture = source.get("pbrMetallicRoughness", {}).get("baseColorTexture")
            if texture is not None and getattr(visual.material, "baseColorTexture", None) is None:
                note = f"the texture of material {source.get('name', primitive['material'])} is not read"
                if note not in self.notes:
                    self.notes.append(note)


def parse_header(data: bytes, kind: str, file: Path) -> dict[str, Any]:
    """The JSON of a glTF file. Raises FormatError for a file without."""
    if kind == "glb":
        data = data[_HEAD : _HEAD + _json_length(data)]
    try:
        header = files.parse_json(data.decode("utf-8"), str(file))
    except (UnicodeDecodeError, FormatError) as error:
        found = error.actual if isinstance(error, FormatError) else "bytes that are no text"
        raise FormatError(str(file), "a readable mesh", found) from error
    if not isinstance(header, dict):
        raise FormatError(str(file), "a readable mesh", f"a header that is a {type(header).__name__}")
    return header


def compare_counts(field: str, stated: int, imported: int) -> None:
    """Raise FormatError if a file states another number than was imported."""
    if stated != imported:
        raise FormatError(field, f"{stated:,} as stated in the file", f"{imported:,} after the import")


def _json_length(data: bytes) -> int:
    """Length of a GLB's JSON, bytes."""
    return int.from_bytes(data[12:16], "little")


def _simplify_primitive(primitive: dict[str, Any], header: dict[str, Any], file: Path) -> dict[str, Any]:
    """The primitive with the attributes that are used. Raises FormatError if they are in no plain buffer."""
    if (mode := primitive.get("mode", _TRIANGLES)) >= _FAN:
        raise FormatError(f"{file}: mode", "triangles or strips (4 or 5)", mode)
    names = primitive["attributes"]
    attributes = {n: i for n, i in names.items() if n in ("POSITION", "TEXCOORD_0") or n.startswith("_")}
    if "COLOR_0" in names:
        attributes[VERTEX_COLOURS] = names["COLOR_0"]
    accessors = header["accessors"]
    if "TEXCOORD_0" in names and accessors[names["TEXCOORD_0"]]["componentType"] != _FLOAT:
        attributes[_VERTEX_UV] = names["TEXCOORD_0"]
    for index in (*attributes.values(), *([primitive["indices"]] if "indices" in primitive else ())):
        if "sparse" in accessors[index]:
            raise FormatError(f"{file}: accessor {index}", "values in one buffer", "a sparse accessor")
        if "bufferView" not in accessors[index]:
            found = ", ".join(primitive.get("extensions", ())) or "none"
            raise FormatError(f"{file}: accessor {index}", "values in a buffer", found)
    rest = {key: primitive[key] for key in ("indices", "material", "mode") if key in primitive}
    return {"attributes": attributes, **rest}


def _decode_integers(values: NDArray[Any], accessor: dict[str, Any]) -> NDArray[np.float64]:
    """Values of an accessor as numbers; normalized integers as fractions."""
    decoded = values.astype(np.float64)
    if accessor.get("normalized", False):
        kinds = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16}
        decoded = np.maximum(decoded / np.iinfo(kinds[accessor["componentType"]]).max, -1.0)
    return decoded


def _mesh_instances(header: dict[str, Any], file: Path) -> list[tuple[int, NDArray[np.float64]]]:
    """Mesh and transform (4, 4) into the scene of each node that is drawn."""
    scenes, nodes = header.get("scenes", []), header.get("nodes", [])
    roots = scenes[header.get("scene", 0)].get("nodes", []) if scenes else []
    queue, found = [(int(root), np.eye(4)) for root in roots], []
    for visited, (index, parent) in enumerate(queue):
        if visited >= len(nodes):
            raise FormatError(f"{file}: nodes", "a tree", "a node with several parents")
        node = nodes[index]
        matrix = parent @ _node_matrix(node)
        if "mesh" in node:
            found.append((int(node["mesh"]), matrix))
        queue += [(int(child), matrix) for child in node.get("children", [])]
    return found


def _node_matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    """Transform (4, 4) of a node: its matrix, or translation @ rotation @ scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=float).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=float)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), dtype=float)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _bounds(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lowest and highest coordinates (2, 3) of points (n, 3); without points, infinite ones."""
    if not len(points):
        return np.array([[np.inf] * 3, [-np.inf] * 3])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _placed_bounds(shapes: list[tuple[trimesh.Trimesh, NDArray[np.float64]]]) -> NDArray[np.float64]:
    """Bounds (2, 3) of meshes with their transforms."""
    every = np.array([_bounds(trimesh.transform_points(shape.vertices, matrix)) for shape, matrix in shapes])
    return np.stack([every[:, 0].min(axis=0), every[:, 1].max(axis=0)])


def _compare_bounds(field: str, stated: NDArray[np.float64], imported: NDArray[np.float64]) -> None:
    """Raise FormatError if bounds (2, 3) differ by more than rounding."""
    side = float(np.abs(stated[1] - stated[0]).max())
    if (
        np.isfinite(stated).all()
        and np.abs(stated - imported).max() > _TOLERANCE * side + 1e-6 * np.abs(stated).max()
    ):
        wanted, found = (" to ".join(str(tuple(row.round(4).tolist())) for row in b) for b in (stated, imported))
        raise FormatError(field, f"{wanted} as stated in the file", f"{found} after the import")
