"""Read Wavefront OBJ files: relative indices count from their line, polygons become fans."""

from __future__ import annotations

import re
from array import array
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange.obj import parse_mtl
from trimesh.resolvers import Resolver
from trimesh.visual import TextureVisuals
from trimesh.visual.material import SimpleMaterial

from scene_ir.errors import FormatError

_GREY = (204, 204, 204, 255)
"""Colour of a material that no file defines."""


def read_obj(data: bytes, file: Path, resolver: Resolver) -> tuple[trimesh.Scene, list[str]]:
    """Read an OBJ file. Normals, lines, points and free-form surfaces are not read.

    Args:
        data: The file's content.
        file: The file, for messages.
        resolver: Finds materials and textures.

    Returns:
        The scene, with the vertices that faces use; and what was left out, one line each.

    Raises:
        FormatError: A vertex without three coordinates, or a face with a vertex that does not exist.
    """
    points, colours, texture = array("d"), array("d"), array("d")
    groups: defaultdict[tuple[str, str], array[int]] = defaultdict(lambda: array("q"))
    libraries: list[str] = []
    name = material = ""
    faces = short = 0
    line = b""
    try:
        for line in re.sub(rb"\\\r?\n", b" ", data.removeprefix(b"\xef\xbb\xbf")).splitlines():
            words = line.split(None, 1)
            if len(words) < 2:
                continue
            key, rest = words
            if key == b"v":
                values = [float(word) for word in rest.partition(b"#")[0].split()]
                if len(values) < 3:
                    raise FormatError(f"{file}: vertices", "three coordinates each", len(values))
                points.extend(values[:3])
                colours.extend(values[3:6] if len(values) >= 6 else ())
            elif key == b"vt":
                values = [float(word) for word in rest.partition(b"#")[0].split()]
                texture.extend((*values, 0.0)[:2])
            elif key == b"f":
                faces += 1
                corners = _resolve_face(rest.partition(b"#")[0].split(), len(points) // 3, len(texture) // 2)
                if corners is None:
                    expected = f"vertices from 1, or from -1 to -{len(points) // 3:,}"
                    raise FormatError(f"{file}: face {faces:,}", expected, _decode(rest))
                short += len(corners) < 3
                group = groups[name, material]
                for second, third in pairwise(corners[1:]):
                    group.extend((*corners[0], *second, *third))
            elif key == b"usemtl":
                material = _decode(rest)
            elif key == b"o":
                name = _decode(rest)
            elif key == b"mtllib":
                libraries.append(_decode(rest))
    except FormatError:
        raise
    except ValueError:
        raise FormatError(str(file), "a readable mesh, with numbers in lines v, vt and f", _decode(line)) from None
    notes = [f"{short:,} faces with fewer than three corners left out"] if short else []
    vertices = np.frombuffer(points, dtype=np.float64).reshape(-1, 3)
    rgb = np.frombuffer(colours, dtype=np.float64).reshape(-1, 3) if len(colours) == len(points) else None
    uv = np.frombuffer(texture, dtype=np.float64).reshape(-1, 2)
    materials = _read_materials(libraries, resolver)
    undefined = {m for _, m in groups if m and m not in materials}
    notes += [f"materials that no file defines: {', '.join(sorted(undefined))}"] if undefined else []
    scene = trimesh.Scene()
    for (name, material), group in groups.items():
        if not len(group):
            continue
        index = np.frombuffer(group, dtype=np.int64).reshape(-1, 2)
        if index[:, 0].max() >= len(vertices):
            found = f"vertex {index[:, 0].max() + 1:,}"
            raise FormatError(f"{file}: faces", f"indices of {len(vertices):,} vertices", found)
        known = np.where(index[:, 1] < len(uv), index[:, 1], -1)
        pairs, corner = np.unique(index[:, 0] * (len(uv) + 1) + known + 1, return_inverse=True)
        at, coordinate = np.divmod(pairs, len(uv) + 1)
        shape = trimesh.Trimesh(
            vertices[at],
            corner.reshape(-1, 3),
            process=False,
            vertex_colors=None if rgb is None else rgb[at],
        )
        own_uv = _pick(uv, coordinate - 1)
        if material in materials or (material and rgb is None):
            shape.visual = TextureVisuals(
                uv=own_uv, material=materials.get(material) or SimpleMaterial(name=material, diffuse=_GREY)
            )
        elif own_uv is not None:
            shape.visual = TextureVisuals(uv=own_uv)
        scene.add_geometry(shape, geom_name=" ".join(filter(None, (name, material))) or "geometry")
    return scene, notes


def _decode(words: bytes) -> str:
    """A name in a file: UTF-8, or else Latin-1."""
    try:
        return words.decode("utf-8").strip()
    except UnicodeDecodeError:
        return words.decode("latin-1").strip()


def _resolve_face(words: list[bytes], points: int, coordinates: int) -> list[tuple[int, int]] | None:
    """The vertex and texture coordinate of each corner, from 0; -1 without a texture coordinate.

    Args:
        words: The corners as written: v, v/vt, v//vn or v/vt/vn, from 1, or from -1 backwards.
        points: Number of vertices before this line.
        coordinates: Number of texture coordinates before this line.

    Returns:
        The corners, or None if one has no vertex.
    """
    corners = []
    for word in words:
        first, *others = word.split(b"/", 2)
        vertex = int(first)
        vertex = vertex - 1 if vertex > 0 else points + vertex if vertex < 0 else -1
        if vertex < 0:
            return None
        texture = int(others[0]) if others and others[0] else 0
        corners.append((vertex, max(texture - 1 if texture >= 0 else coordinates + texture, -1)))
    return corners


def _pick(uv: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Texture coordinates (n, 2) of rows, (0, 0) for row -1; None if no corner has any."""
    if not (rows >= 0).any():
        return None
    return np.where(rows[:, None] >= 0, uv[rows], 0.0)


def _read_materials(libraries: list[str], resolver: Resolver) -> dict[str, SimpleMaterial]:
    """Materials by name; the resolver notes files that are missing or cannot be read."""
    materials: dict[str, SimpleMaterial] = {}
    for line in libraries:
        for library in (
            (line,) if line.lower().endswith(".mtl") and line.lower().count(".mtl") == 1 else line.split()
        ):
            try:
                found = parse_mtl(resolver.get(library), resolver=resolver)
            except FileNotFoundError:
                continue
            for name, values in found.items():
                wrong = [
                    key for key in ("ambient", "diffuse", "specular") if np.size(values.get(key, (0,) * 3)) != 3
                ]
                materials[name] = SimpleMaterial(**{k: v for k, v in values.items() if k not in wrong})
    return materials
