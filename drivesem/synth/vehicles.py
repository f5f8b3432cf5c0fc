"""Vehicles as triangles: a mesh's faces, cut finer where lamps, plates, grilles and seams are painted on them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np
import torch

from drivesem.synth import mesh_kernels
from drivesem.synth.assets import NEUTRAL, vehicle_soup
from drivesem.synth.layout import Actor
from drivesem.synth.soup import Material, Soup, make
from scene_ir import ffd
from scene_ir.meshes import solids
from scene_ir.meshes.templates import KINDS, template, typical_size_lhw
from scene_ir.types import LATTICE, LATTICE_POINTS, Mesh, Part

_PART_MATERIAL = {
    Part.PAINT: Material.PAINT,
    Part.GLASS: Material.GLASS,
    Part.TYRE: Material.TYRE,
    Part.LIGHT: Material.LIGHT,
    Part.OTHER: Material.TRIM,
}
_DARK = np.array([0.012, 0.012, 0.013], np.float32)
"""Gaps between panels, rubber seals."""
_PLATE_WHITE, _PLATE_YELLOW = np.array([0.50, 0.50, 0.48], np.float32), np.array([0.50, 0.36, 0.03], np.float32)
_PLATE_BLUE = np.array([0.02, 0.05, 0.28], np.float32)
_RED, _DEEP_RED = np.array([0.26, 0.012, 0.012], np.float32), np.array([0.12, 0.008, 0.008], np.float32)
_AMBER, _CLEAR = np.array([0.42, 0.15, 0.015], np.float32), np.array([0.42, 0.42, 0.40], np.float32)
_CHROME, _HOUSING = np.array([0.30, 0.30, 0.31], np.float32), np.array([0.10, 0.10, 0.105], np.float32)
_SIGNS = 7
"""Characters on a number plate."""
_PLATE = 255
"""Cell of what belongs to a plate but to no character."""
_SEAT_M = 0.37
"""How far to the side of the middle the front seats stand."""
_GREY_TO_LINEAR = 2.2

_DOOR_MIRROR = torch.tensor([[0.15, -0.66, -0.5]], dtype=torch.float64)
"""Where about a vehicle is widest, in the unit box."""

Plane = tuple[tuple[float, float, float], float]
"""Normal and offset: points with normal . x = offset."""


@dataclass(frozen=True, slots=True)
class _Base:
    """The mesh's own faces at their size in metres: corners (F, 3, 3), outward directions (F, 3), and the least
    and greatest coordinates (F, 3) of their corners."""

    corners: np.ndarray
    facing: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, corners: np.ndarray, normals: np.ndarray) -> _Base:
        """Of faces' corners and the normals (F, 3, 3) there."""
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        return cls(corners, _mean(normals), low, high)


def _mean(values: np.ndarray) -> np.ndarray:
    """Means (n, 3) of three corners' values (n, 3, 3): np.mean takes five times as long over an axis of three."""
    return (values[:, 0] + values[:, 1] + values[:, 2]) / np.float32(3)


@dataclass(frozen=True, slots=True)
class _Pieces:
    """n triangles that lie in the faces of a mesh. parent (n,): their face; share (n, 3, 3): barycentric
    coordinates of each corner in it; material (n,) uint8; albedo (n, 3) float32; cell (n,): 1 + stroke of a
    plate's character, `_PLATE` for the rest of a plate, or 0.
    """

    parent: np.ndarray
    share: np.ndarray
    material: np.ndarray
    albedo: np.ndarray
    cell: np.ndarray

    def take(self, keep: np.ndarray) -> _Pieces:
        """Those selected by a mask or by indices."""
        return _Pieces(*(getattr(self, f.name)[keep] for f in fields(self)))

    def part(self, start: int, end: int) -> _Pieces:
        """Those of a range, without a copy."""
        return _Pieces(*(getattr(self, f.name)[start:end] for f in fields(self)))

    def middle(self, base: _Base) -> np.ndarray:
        """Centroids (n, 3) m."""
        return np.einsum("ni,nij->nj", _mean(self.share), base.corners[self.parent])

    def facing(self, base: _Base) -> np.ndarray:
        """Outward directions (n, 3) of the faces."""
        return base.facing[self.parent]


def _joined(pieces: list[_Pieces]) -> _Pieces:
    return _Pieces(*(np.concatenate([getattr(p, f.name) for p in pieces]) for f in fields(_Pieces)))


def _extent(base: _Base, pieces: _Pieces) -> tuple[np.ndarray, np.ndarray]:
    return base.low[pieces.parent].min(axis=0), base.high[pieces.parent].max(axis=0)


def divided(base: _Base, pieces: _Pieces, planes: list[Plane]) -> _Pieces:
    """The same surface, its triangles cut in two or three where they cross a plane."""
    table = np.array([(*normal, offset) for normal, offset in planes], np.float32)
    source, share = mesh_kernels.cut(base.corners, pieces.parent, pieces.share, table)
    return replace(pieces.take(source), share=share)


@dataclass(frozen=True, slots=True)
class VehicleShape:
    """A vehicle in the unit box: n triangles that lie in the faces of a mesh. vertices (V, 3), faces (F, 3),
    normals (F, 3, 3): of the mesh, and of its faces' corners; parent (n,) int32, share (n, 3, 3): as in
    `_Pieces`; material (n,) uint8; albedo (n, 3), paint in a neutral tint; cell (n,) uint8: 1 + stroke of a
    plate's character that may darken it, 255 for the rest of a plate, or 0.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    parent: np.ndarray
    share: np.ndarray
    material: np.ndarray
    albedo: np.ndarray
    cell: np.ndarray

    @classmethod
    def of(cls, soup: Soup) -> VehicleShape:
        """The shape of a soup in the unit box, each triangle a face of its own."""
        count = len(soup)
        every = np.arange(count, dtype=np.int32)
        corners = np.arange(3 * count, dtype=np.int32).reshape(count, 3)
        whole = np.broadcast_to(np.eye(3, dtype=np.float32), (count, 3, 3))
        plain = np.zeros(count, np.uint8)
        return cls(
            soup.corners.reshape(-1, 3), corners, soup.normals, every, whole, soup.material, soup.albedo, plain
        )

    @property
    def soup(self) -> Soup:
        """The triangles as they are, not bent."""
        return deformed(self, np.zeros((LATTICE_POINTS, 3), np.float32))


def vehicle_mesh(kind: str, variant: int) -> Mesh:
    """The mesh of a vehicle, in the unit box."""
    return template(kind, variant)


def instance_ffd(actor: Actor) -> np.ndarray:
    """Lattice offsets (64, 3) float32 that distinguish this vehicle from others of its mesh, in unit-box lengths.

    Symmetric, a function of the actor's seed alone. Ends, roof and ground stay where they are (their lattice
    points do, and Bernstein polynomials keep the hull), and the width over the mirrors to within a centimetre.
    """
    rng = np.random.default_rng([0xFFD, actor.seed])
    spread = np.zeros((*LATTICE, 3))
    # Sideways offsets first along the length, then over the height (from the roof down), then across.
    spread[1:3, :, :, 0] = np.array([0.030, 0.030, 0.022, 0.014])[None, :, None]
    spread[:, 1, :, 1] = 0.030
    spread[:, 2, :, 1] = 0.012
    spread[:, :2, 1:3, 2] = 0.025
    offsets = rng.uniform(-1, 1, (*LATTICE, 3)) * spread
    # The roof's and the ends' outer edges may only come in.
    offsets[:, 0, 0, 2] += rng.uniform(0, 0.03)
    offsets[0, :3, 0, 2] += rng.uniform(0, 0.02)
    offsets[3, :3, 0, 2] += rng.uniform(0, 0.02)
    offsets[:, :, 3, 2] = -offsets[:, :, 0, 2]
    mirrored = ffd.symmetrise(torch.from_numpy(offsets.reshape(LATTICE_POINTS, 3)))
    # that makes it a little narrower where it is widest, at the door mirrors: widen it all by as much
    narrower = float((ffd.lattice_weights(_DOOR_MIRROR) @ mirrored)[0, 2])
    across = torch.linspace(-0.5, 0.5, LATTICE[2], dtype=torch.float64).repeat(LATTICE[0] * LATTICE[1])
    mirrored[:, 2] += across * (1 / (1 - 2 * narrower) - 1)
    return mirrored.numpy().astype(np.float32)


def deformed(shape: VehicleShape, offsets: np.ndarray) -> Soup:
    """The vehicle's triangles after a free-form deformation of its mesh: offsets (64, 3)."""
    lattice = np.asarray(offsets, np.float32).reshape(LATTICE_POINTS, 3)
    mesh = shape.vertices, shape.faces, shape.normals
    corners, normals = mesh_kernels.bent(mesh, (shape.parent, shape.share), lattice)
    soup = make(corners, Material.PAINT, shape.albedo, normals)
    soup.pattern[:, 3] = shape.cell
    return replace(soup, material=shape.material)


def _plates(base: _Base, pieces: _Pieces, yellow: bool, fine: bool) -> _Pieces:
    """Number plates: a blue band at the left, a row of characters with strokes of each vehicle's own."""
    colour = _PLATE_YELLOW if yellow else _PLATE_WHITE
    # the mean of the ground and the characters
    pieces.albedo[:] = colour * 0.72
    pieces.cell[:] = _PLATE
    if not fine:
        return pieces
    facing, middle = pieces.facing(base)[:, 0], pieces.middle(base)[:, 0]
    found = [pieces.take((np.abs(facing) <= 0.5) | (facing * middle <= 0))]
    edges = 0.13 + 0.84 * (np.arange(_SIGNS)[:, None] + np.array([0.0, 0.36, 0.72])).reshape(-1) / _SIGNS
    rows = np.array([0.16, 0.5, 0.84])
    for end in (1.0, -1.0):
        part = pieces.take((facing * end > 0.5) & (middle * end > 0))
        if not len(part.parent):
            continue
        low, high = _extent(base, part)
        span = high - low
        left = low[2] if end > 0 else high[2]
        across = end * span[2]
        planes: list[Plane] = [((0.0, 0.0, 1.0), float(left + across * e)) for e in (0.1, *edges)]
        planes += [((0.0, 1.0, 0.0), float(low[1] + span[1] * r)) for r in rows]
        part = divided(base, part, planes)
        spot = part.middle(base)
        u, v = (spot[:, 2] - left) / across, (spot[:, 1] - low[1]) / span[1]
        part.albedo[:] = colour
        part.albedo[u < 0.1] = _PLATE_BLUE
        column, row = np.searchsorted(edges, u) - 1, np.searchsorted(rows, v) - 1
        sign, half = np.divmod(column, 3)
        stroke = (column >= 0) & (half < 2) & (row >= 0) & (row < 2)
        part.cell[:] = np.where(stroke, 1 + (2 * sign + half) * 2 + row, _PLATE)
        found.append(part)
    return _joined(found)


def _lamp_outline(
    style: int, low: np.ndarray, high: np.ndarray, side: float, rng: np.random.Generator
) -> list[Plane]:
    """Planes (normal, offset) that cut corners off a lamp's rectangle (z, y): their outer side is sheet metal."""
    wide, tall = high[2] - low[2], high[1] - low[1]
    inner, outer = (low[2], high[2]) if side > 0 else (high[2], low[2])
    top, bottom = low[1], high[1]
    lean = rng.uniform(0.15, 0.5, 3)
    lines = [
        # inner lower corner, inner upper corner, the whole lower edge rising inwards or outwards
        ((inner + side * wide * lean[0], bottom), (inner, bottom - tall * (0.3 + 0.6 * lean[1]))),
        ((inner, top + tall * (0.2 + 0.5 * lean[2])), (inner + side * wide * lean[1], top)),
        ((inner, bottom - tall * 0.45 * lean[0]), (outer, bottom - tall * 0.02)),
        ((outer, bottom - tall * 0.55 * lean[1]), (inner + side * wide * 0.35, bottom)),
    ]
    chosen = {0: (0,), 1: (0, 1), 2: (1, 2), 3: (1, 3), 4: (0, 1, 3), 5: ()}[style]
    centre = np.array([(inner + outer) / 2, (top + bottom) / 2])
    planes = []
    for i in chosen:
        a, b = (np.array(p) for p in lines[i])
        normal = np.array([-(b - a)[1], (b - a)[0]])
        normal /= np.linalg.norm(normal)
        if (centre - a) @ normal > 0:
            normal = -normal
        planes.append(((0.0, float(normal[1]), float(normal[0])), float(normal @ a)))
    return planes


def _lamps(
    base: _Base, pieces: _Pieces, head: bool, sheet: np.ndarray, rng: np.random.Generator, fine: bool
) -> _Pieces:
    """Shape and structure of head or tail lamps; sheet (3,): albedo of the metal around them."""
    style, seed = int(rng.integers(6)), int(rng.integers(2**31))
    middle = pieces.middle(base)[:, 2]
    found = []
    for side in (1.0, -1.0):
        part = pieces.take(middle * side > 0)
        if not len(part.parent):
            continue
        low, high = _extent(base, part)
        span = high - low
        own = np.random.default_rng([0x1A3, seed])
        outline = _lamp_outline(style, low, high, side, own)
        inner = low[2] if side > 0 else high[2]
        columns, rows = own.uniform(0.28, 0.42), own.uniform(0.3, 0.45)
        z_edges = (0.06, columns, 0.5, 0.8) if fine else (columns, 0.5)
        y_edges = (0.12, rows, 0.72) if fine else (rows,)
        planes: list[Plane] = list(outline)
        planes += [((0.0, 0.0, 1.0), float(inner + side * span[2] * e)) for e in z_edges]
        planes += [((0.0, 1.0, 0.0), float(low[1] + span[1] * e)) for e in y_edges]
        part = divided(base, part, planes)
        spot = part.middle(base)
        u, v = (spot[:, 2] - inner) / (side * span[2]), (spot[:, 1] - low[1]) / span[1]
        part.albedo[:] = (_head_lamp if head else _tail_lamp)(u, v, columns, rows, own)
        for normal, offset in outline:
            outside = spot @ np.array(normal) > offset
            part.material[outside], part.albedo[outside] = Material.PAINT, sheet
        found.append(part)
    return _joined(found)


def _head_lamp(u: np.ndarray, v: np.ndarray, columns: float, rows: float, rng: np.random.Generator) -> np.ndarray:
    """Albedo (n, 3) over a head lamp: u from the inner to the outer end, v from top to bottom."""
    albedo = np.broadcast_to(_HOUSING * rng.uniform(0.6, 2.6), (len(u), 3)).copy()
    bright = ((u > 0.06) & (u < columns) | (u > 0.5) & (u < 0.8)) & (v > 0.12)
    albedo[bright] = _CLEAR * rng.uniform(0.7, 1.3)
    albedo[bright & (v > rows) & (v < 0.72)] = _CLEAR * 1.45
    if rng.random() < 0.4:
        albedo[u > 0.8] = _AMBER
    return albedo


def _tail_lamp(u: np.ndarray, v: np.ndarray, columns: float, rows: float, rng: np.random.Generator) -> np.ndarray:
    """Albedo (n, 3) over a tail lamp, as `_head_lamp`."""
    albedo = np.broadcast_to(_RED * rng.uniform(0.6, 1.2), (len(u), 3)).copy()
    albedo[(u < 0.06) | (v < 0.12)] = _DEEP_RED
    layout = int(rng.integers(4))
    if layout == 0:
        albedo[(v > rows) & (v < 0.72) & (u > 0.06)] = _AMBER
        albedo[v > 0.72] = _CLEAR * 0.9
    elif layout == 1:
        albedo[(u > columns) & (u < 0.5) & (v > rows)] = _CLEAR * 0.9
    elif layout == 2:
        albedo[(v > 0.72) & (u < 0.5)] = _CLEAR * 0.8
        albedo[(v > rows) & (v < 0.72) & (u > 0.5)] = _DEEP_RED
    else:
        albedo[(u > columns) & (u < 0.8) & (v > rows) & (v < 0.72)] = _DEEP_RED
    return albedo


def _grille(base: _Base, pieces: _Pieces, rng: np.random.Generator) -> _Pieces:
    """Bars across grille and air intake, and a badge."""
    length = np.ptp(base.corners[..., 0])
    ahead = (pieces.middle(base)[:, 0] > 0.36 * length) & (pieces.facing(base)[:, 0] > 0.6)
    if not ahead.any():
        return pieces
    part = pieces.take(ahead)
    low, high = _extent(base, part)
    edges = np.linspace(low[1], high[1], int(rng.integers(5, 10)) * 2)[1:-1]
    planes: list[Plane] = [((0.0, 1.0, 0.0), float(e)) for e in edges]
    part = divided(base, part, [*planes, ((0.0, 0.0, 1.0), -0.04), ((0.0, 0.0, 1.0), 0.04)])
    spot = part.middle(base)
    bar = (np.searchsorted(edges, spot[:, 1]) % 2).astype(bool)
    upper = spot[:, 1] < (low[1] + high[1]) / 2
    shiny = _CHROME * 0.8 if rng.random() < 0.35 else _DARK * 5
    part.albedo[:] = np.where((bar & upper)[:, None], shiny, _DARK * np.where(bar, 2.5, 0.9)[:, None])
    badge = upper & (np.abs(spot[:, 2]) < 0.04) & (spot[:, 1] > low[1] + 0.01) & (spot[:, 1] < low[1] + 0.10)
    part.material[badge], part.albedo[badge] = Material.METAL, _CHROME * 0.7
    return _joined([pieces.take(~ahead), part])


def _seam(base: _Base, pieces: _Pieces, mask: np.ndarray, plane: Plane, width_m: float) -> _Pieces:
    """A dark gap along a plane over the faces of a mask."""
    normal, offset = plane
    near = np.flatnonzero(mask)
    reach = base.corners[pieces.parent[near]] @ np.asarray(normal, np.float32) - np.float32(offset)
    a, b, c = reach[:, 0], reach[:, 1], reach[:, 2]
    above, below = np.maximum(np.maximum(a, b), c), np.minimum(np.minimum(a, b), c)
    near = near[(above > -width_m / 2) & (below < width_m / 2)]
    if not len(near):
        return pieces
    others = np.ones(len(mask), bool)
    others[near] = False
    part = divided(base, pieces.take(near), [(normal, offset - width_m / 2), (normal, offset + width_m / 2)])
    inside = np.abs(part.middle(base) @ np.asarray(normal) - offset) < width_m / 2
    part.material[inside], part.albedo[inside] = Material.TRIM, _DARK
    return _joined([pieces.take(others), part])


def _seams(
    base: _Base, pieces: _Pieces, edges: tuple[float, float, float, float], rng: np.random.Generator
) -> _Pieces:
    """Gaps between bonnet, wings, bumpers and boot lid; perhaps a rub strip along the doors.

    edges: foremost point x of the windows, height y of the window line, lower edges y of head and tail lamps.
    """
    screen_x, belt, head_y, tail_y = edges
    half, wide = base.corners[..., 0].max(), base.corners[..., 2].max()
    for end, height in ((1.0, head_y), (-1.0, tail_y)):
        middle, facing = pieces.middle(base), pieces.facing(base)
        sheet = (middle[:, 0] * end > half - rng.uniform(0.45, 0.6)) & (np.abs(facing[:, 1]) < 0.7)
        pieces = _seam(base, pieces, sheet, ((0.0, 1.0, 0.0), height + 0.015), 0.012)
    lid = float(rng.uniform(0.70, 0.78) * wide)
    for z in (lid, -lid):
        middle, facing = pieces.middle(base), pieces.facing(base)
        bonnet = (middle[:, 0] > screen_x - 0.05) & (facing[:, 1] < -0.6)
        boot = (facing[:, 0] < -0.6) & (middle[:, 1] < tail_y) & (middle[:, 1] > belt)
        pieces = _seam(base, pieces, bonnet | boot, ((0.0, 0.0, 1.0), z), 0.012)
    if rng.random() < 0.35:
        middle, facing = pieces.middle(base), pieces.facing(base)
        doors = (np.abs(facing[:, 2]) > 0.75) & (np.abs(middle[:, 0]) < 0.55 * half) & (middle[:, 1] > belt)
        pieces = _seam(base, pieces, doors, ((0.0, 1.0, 0.0), 0.55 * belt), 0.045)
    return pieces


def _panes(base: _Base, pieces: _Pieces, rng: np.random.Generator, fine: bool) -> _Pieces:
    """Windows: rubber or chrome along their edges; behind them a dashboard, seats, the light of the other side."""
    low, high = _extent(base, pieces)
    below, above = float(high[1] - 0.03), float(low[1] + 0.025)
    pieces = divided(base, pieces, [((0.0, 1.0, 0.0), below), ((0.0, 1.0, 0.0), above)])
    height, facing = pieces.middle(base)[:, 1], pieces.facing(base)
    pieces.albedo[:] = 0.03 * float(rng.uniform(0.6, 1.3))
    seal = (height > below) | (height < above)
    pieces.material[seal], pieces.albedo[seal] = Material.TRIM, _DARK
    if rng.random() < 0.2:
        pieces.albedo[height > below] = _CHROME
    tinted, light, cloth = rng.random() < 0.15, float(rng.uniform(0.03, 0.06)), float(rng.uniform(0.008, 0.02))
    if not fine:
        return pieces
    screens = ~seal & (np.abs(facing[:, 0]) > 0.3)
    sides = ~seal & ~screens & (np.abs(facing[:, 2]) > 0.7)
    found = [pieces.take(~screens & ~sides)]
    for end in (1.0, -1.0):
        part = pieces.take(screens & (facing[:, 0] * end > 0))
        if not len(part.parent):
            continue
        low, high = _extent(base, part)
        rows = low[1] + (high[1] - low[1]) * np.array([0.28, 0.8])
        columns = np.array([_SEAT_M - 0.16, _SEAT_M + 0.16])
        planes: list[Plane] = [((0.0, 1.0, 0.0), float(y)) for y in rows]
        planes += [((0.0, 0.0, 1.0), float(z)) for z in (*columns, *-columns)]
        part = divided(base, part, planes)
        spot = part.middle(base)
        row, seat = np.searchsorted(rows, spot[:, 1]), np.abs(np.abs(spot[:, 2]) - _SEAT_M) < 0.16
        shade = np.where(row == 2, 0.016, np.where((row == 1) & seat, cloth, light))
        part.albedo[:] = shade[:, None] if end > 0 or not tinted else 0.012
        found.append(part)
    part = pieces.take(sides)
    if len(part.parent):
        low, high = _extent(base, part)
        row = float(low[1] + (high[1] - low[1]) * 0.4)
        columns = (low[0] + high[0]) / 2 + np.array([-0.95, -0.65, -0.05, 0.3])
        part = divided(base, part, [((0.0, 1.0, 0.0), row), *(((1.0, 0.0, 0.0), float(x)) for x in columns)])
        spot = part.middle(base)
        seat = (spot[:, 1] > row) & (np.searchsorted(columns, spot[:, 0]) % 2 == 1)
        part.albedo[:] = np.where(seat, cloth, 0.012 if tinted else light)[:, None]
        found.append(part)
    return _joined(found)


def _sources(mesh: Mesh) -> np.ndarray:
    """Part of each face (F,) in the templates' builder, by colour; faces of other meshes match none."""
    faces = mesh.faces.numpy()
    if mesh.colours is None:
        return np.full(len(faces), -1)
    table = _colour_key(np.array([solids.COLOUR[m] for m in solids.VehicleMaterial]))
    order = np.argsort(table)
    # the templates' vertices are split between materials: one identifies its face
    key = _colour_key(mesh.colours.numpy())[faces[:, 0]]
    place = np.minimum(np.searchsorted(table[order], key), len(order) - 1)
    return np.where(table[order][place] == key, order[place], -1)


def _colour_key(colours: np.ndarray) -> np.ndarray:
    """One integer (n,) for each RGB colour (n, 3), to a thousandth."""
    return np.rint(colours * 1000).astype(np.int64) @ np.array([1_000_000, 1_000, 1])


def _detailed(kind: str, base: _Base, pieces: _Pieces, source: np.ndarray, seed: int, fine: bool) -> _Pieces:
    """Details painted on the faces that the templates' builder made of known materials."""
    rng = np.random.default_rng([0xCA2, KINDS.index(kind), seed])
    pieces = pieces.take(np.argsort(source, kind="stable"))
    ends = np.cumsum(np.bincount(source + 1, minlength=len(solids.VehicleMaterial) + 1))
    found = [pieces.part(0, int(ends[0]))]
    groups = {m: pieces.part(int(ends[m]), int(ends[m + 1])) for m in solids.VehicleMaterial}
    sheet, car = groups[solids.VehicleMaterial.PAINT].albedo[:1], kind not in ("bus", "truck")
    trim = _joined([groups.pop(solids.VehicleMaterial.TRIM), groups.pop(solids.VehicleMaterial.CHROME)])
    glass, paint = groups.pop(solids.VehicleMaterial.GLASS), groups.pop(solids.VehicleMaterial.PAINT)
    plates = groups.pop(solids.VehicleMaterial.PLATE)
    head, tail = groups.pop(solids.VehicleMaterial.HEADLIGHT), groups.pop(solids.VehicleMaterial.TAIL_LIGHT)
    whole = all(len(g.parent) for g in (glass, paint, head, tail))
    if fine and whole and car:
        glass_high = _extent(base, glass)[1]
        edges = (
            float(glass_high[0]),
            float(glass_high[1]),
            float(_extent(base, head)[1][1]),
            float(_extent(base, tail)[1][1]),
        )
        paint = _seams(base, paint, edges, rng)
    found += [_panes(base, glass, rng, fine and car) if len(glass.parent) else glass, paint]
    for lamps, ahead in ((head, True), (tail, False)):
        found.append(
            _lamps(base, lamps, ahead, sheet[0], rng, fine) if len(lamps.parent) and len(sheet) else lamps
        )
    yellow = bool(rng.random() < 0.1)
    found.append(_plates(base, plates, yellow, fine) if len(plates.parent) else plates)
    found.append(_grille(base, trim, rng) if fine else trim)
    return _joined([*found, *groups.values()])


@lru_cache(maxsize=32)
def vehicle_shape(kind: str, variant: int, fine: bool) -> VehicleShape:
    """A vehicle's mesh as triangles with details painted on; fine: with those seen from near only."""
    mesh, size = vehicle_mesh(kind, variant), np.array(typical_size_lhw(kind, variant), np.float32)
    vertices, faces = mesh.vertices.numpy(), mesh.faces.numpy()
    colours = _mean(mesh.colours.numpy()[faces]) if mesh.colours is not None else np.full((len(faces), 3), 0.5)
    corners = vertices[faces] * size
    smooth = mesh_kernels.creased_normals(vertices * size, faces)
    base = _Base.of(corners, smooth)
    table = np.array([int(_PART_MATERIAL[Part(p)]) for p in range(len(Part))], np.uint8)
    pieces = _Pieces(
        parent=np.arange(len(faces)),
        share=np.broadcast_to(np.eye(3, dtype=np.float32), (len(faces), 3, 3)).copy(),
        material=table[mesh.part.numpy()],
        albedo=np.power(np.clip(colours, 0, 1), _GREY_TO_LINEAR).astype(np.float32),
        cell=np.zeros(len(faces), np.int64),
    )
    pieces = _detailed(kind, base, pieces, _sources(mesh), variant, fine)
    return VehicleShape(
        vertices=vertices,
        faces=faces.astype(np.int32),
        # covectors of the unit box: placing a soup divides them by its size again
        normals=smooth * size,
        parent=pieces.parent.astype(np.int32),
        share=pieces.share,
        material=pieces.material,
        albedo=pieces.albedo,
        cell=pieces.cell.astype(np.uint8),
    )


@lru_cache(maxsize=512)
def _strokes(seed: int) -> np.ndarray:
    """Whether each cell is dark, (256,) bool: only strokes of a plate's characters may be."""
    rng = np.random.default_rng([0x91A, seed])
    dark = np.zeros(_PLATE + 1, bool)
    dark[: 1 + 4 * _SIGNS] = rng.random(1 + 4 * _SIGNS) < 0.72
    dark[0] = False
    # spaces between the town, the letters and the number
    sign = int(rng.integers(1, 4))
    dark[1 + 4 * sign : 5 + 4 * sign] = False
    return dark


def vehicle(actor: Actor, fine: bool = True) -> Soup:
    """A vehicle's triangles in its unit box, of its own shape, in its own paint and with its own number.

    fine: with the details that are seen from near only.
    """
    if actor.mesh is None:
        shape = vehicle_shape(actor.kind, actor.variant, fine)
    else:
        shape = VehicleShape.of(vehicle_soup(actor.mesh, fine))
    soup = shape.soup if actor.ffd is None else deformed(shape, np.array(actor.ffd, np.float32))
    albedo = soup.albedo
    paint = soup.material == Material.PAINT
    neutral = float(np.median(albedo[paint])) if actor.mesh is None and paint.any() else NEUTRAL
    albedo[paint] = np.clip(albedo[paint] / max(neutral, 1e-3) * np.asarray(actor.paint, np.float32), 0, 0.9)
    cell = soup.pattern[:, 3].astype(np.int64)
    albedo[_strokes(actor.seed)[cell]] = _DARK * 2
    return soup
