"""Vehicles as triangles: a mesh's faces, cut finer where lamps, plates, grilles and seams are painted on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch

from drivesem.synth.layout import Actor
from drivesem.synth.soup import Material, Soup, creased_normals, join, make
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
_SIGNS = 8
"""Characters on a number plate."""
_GREY_TO_LINEAR = 2.2


@dataclass(frozen=True, slots=True)
class VehicleShape:
    """A vehicle in the unit box. soup: its triangles, paint in a neutral tint; points (P, 3): their distinct
    corners; index (F, 3) into them. Plate faces that a character may darken have pattern[:, 3] >= 1.
    """

    soup: Soup
    points: np.ndarray
    index: np.ndarray


def vehicle_mesh(kind: str, variant: int) -> Mesh:
    """The mesh of a vehicle, in the unit box."""
    return template(kind, variant)


def instance_ffd(actor: Actor) -> np.ndarray:
    """Lattice offsets (64, 3) float32 that tell this vehicle from others of its mesh, in unit-box lengths.

    Symmetric, a function of the actor's seed alone. Lattice points stay inside the unit box and those of its
    outer faces on them, hence so does the vehicle (Bernstein polynomials keep the hull), and wheels stay on the
    ground.
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
    return mirrored.numpy().astype(np.float32)


def deformed(shape: VehicleShape, offsets: np.ndarray) -> Soup:
    """The vehicle's triangles after a free-form deformation: offsets (64, 3)."""
    points = torch.from_numpy(shape.points)
    lattice = torch.from_numpy(np.ascontiguousarray(offsets, np.float32).reshape(LATTICE_POINTS, 3))
    moved = ffd.deform(points, ffd.lattice_weights(points), lattice).numpy()
    slope = ffd.jacobian(points, lattice).numpy()
    # normals turn with the cofactors of the Jacobian
    cofactor = np.stack(
        [np.cross(slope[..., (i + 1) % 3], slope[..., (i + 2) % 3]) for i in range(3)], axis=-1
    ).astype(np.float32)
    normals = np.matmul(cofactor[shape.index], shape.soup.normals[..., None])[..., 0]
    return replace(shape.soup, corners=moved[shape.index], normals=normals)


def cut(soup: Soup, normal: tuple[float, float, float], offset: float) -> Soup:
    """The same surface, its triangles divided where they cross the plane normal . x = offset."""
    side = soup.corners @ np.asarray(normal, np.float32) - np.float32(offset)
    tolerance = 1e-4
    crossing = (side.max(axis=1) > tolerance) & (side.min(axis=1) < -tolerance)
    if not crossing.any():
        return soup
    whole, split = soup.take(~crossing), soup.take(crossing)
    side = side[crossing]
    above = side > 0
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), above.argmin(axis=1))
    order = (lone[:, None] + np.arange(3)) % 3
    side = np.take_along_axis(side, order, axis=1)
    share = [(side[:, 0] / (side[:, 0] - side[:, i]))[:, None] for i in (1, 2)]

    def pieces(values: np.ndarray) -> np.ndarray:
        a, b, c = np.moveaxis(np.take_along_axis(values, order[..., None], axis=1), 1, 0)
        p, q = a + share[0] * (b - a), a + share[1] * (c - a)
        return np.concatenate([np.stack(t, axis=1) for t in ((a, p, q), (p, b, c), (p, c, q))])

    parts = split.take(np.tile(np.arange(len(split)), 3))
    corners = pieces(split.corners)
    double_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    parts = replace(parts, corners=corners, normals=pieces(split.normals), uv=pieces(split.uv))
    return join([whole, parts.take(double_area > 1e-8)])


def _cuts(soup: Soup, normal: tuple[float, float, float], offsets: np.ndarray) -> Soup:
    for offset in offsets:
        soup = cut(soup, normal, float(offset))
    return soup


class _Body:
    """A vehicle's soup in metres while details are painted on it."""

    def __init__(self, soup: Soup, source: np.ndarray, rng: np.random.Generator) -> None:
        # the template's material travels in a pattern slot until the vehicle is done
        soup.pattern[:, 0] = source
        self.soup, self.rng = soup, rng

    def middle(self) -> np.ndarray:
        """Centroids (F, 3)."""
        return self.soup.corners.mean(axis=1)

    def facing(self) -> np.ndarray:
        """Unit normals (F, 3) of the faces, outwards."""
        return self.soup.normals.mean(axis=1)

    def of(self, source: solids.Material) -> np.ndarray:
        """Mask of the faces that the template made of this."""
        return self.soup.pattern[:, 0] == int(source)

    def divide(self, mask: np.ndarray, planes: list[tuple[tuple[float, float, float], float]]) -> None:
        """Cut the faces of a mask along planes (normal, offset)."""
        part = self.soup.take(mask)
        for normal, offset in planes:
            part = cut(part, normal, offset)
        self.soup = join([self.soup.take(~mask), part])

    def paint(self, mask: np.ndarray, material: Material, albedo: np.ndarray) -> None:
        """Make the faces of a mask of a material."""
        self.soup.material[mask] = material
        self.soup.albedo[mask] = albedo


def _extent(body: _Body, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = body.soup.corners[mask].reshape(-1, 3)
    return corners.min(axis=0), corners.max(axis=0)


def _plates(body: _Body, fine: bool) -> None:
    """Number plates: a blue band at the left, a row of signs whose strokes each vehicle fills itself."""
    colour = _PLATE_YELLOW if body.rng.random() < 0.2 else _PLATE_WHITE
    for end in (1.0, -1.0):
        mask = body.of(solids.Material.PLATE) & (body.middle()[:, 0] * end > 0) & (body.facing()[:, 0] * end > 0.5)
        if not mask.any():
            continue
        if not fine:
            # the mean of the ground and the characters
            body.soup.albedo[mask] = colour * 0.72
            continue
        low, high = _extent(body, mask)
        span = high - low
        left = low[2] if end > 0 else high[2]
        across = end * span[2]
        edges = 0.13 + 0.84 * (np.arange(_SIGNS)[:, None] + np.array([0.0, 0.36, 0.72])).reshape(-1) / _SIGNS
        rows = np.array([0.17, 0.40, 0.62, 0.85])
        planes = [((0.0, 0.0, 1.0), left + across * e) for e in (0.02, 0.1, *edges, 0.98)]
        planes += [((0.0, 1.0, 0.0), low[1] + span[1] * r) for r in (0.05, *rows, 0.95)]
        body.divide(mask, planes)
        mask = body.of(solids.Material.PLATE) & (body.middle()[:, 0] * end > 0) & (body.facing()[:, 0] * end > 0.5)
        spot = body.middle()[mask]
        u, v = (spot[:, 2] - left) / across, (spot[:, 1] - low[1]) / span[1]
        albedo = np.broadcast_to(colour, (len(spot), 3)).copy()
        albedo[(u > 0.02) & (u < 0.1)] = _PLATE_BLUE
        albedo[(u < 0.02) | (u > 0.98) | (v < 0.05) | (v > 0.95)] = _DARK * 3
        column, row = np.searchsorted(edges, u) - 1, np.searchsorted(rows, v) - 1
        sign, half = np.divmod(column, 3)
        stroke = (column >= 0) & (half < 2) & (row >= 0) & (row < 3)
        cell = np.where(stroke, 1 + (2 * sign + half) * 3 + row, 0)
        body.soup.albedo[mask] = albedo
        body.soup.pattern[mask, 3] = cell


def _lamp_outline(
    style: int, low: np.ndarray, high: np.ndarray, side: float, rng: np.random.Generator
) -> list[tuple[tuple[float, float, float], float]]:
    """Planes (normal, offset) whose outer side, in a lamp's rectangle (z, y), is sheet metal: corners cut off."""
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


def _lamps(body: _Body, source: solids.Material, fine: bool) -> None:
    """Shape and structure of head or tail lamps."""
    rng = body.rng
    style = int(rng.integers(6))
    seed = int(rng.integers(2**31))
    tint = body.soup.albedo[body.of(solids.Material.PAINT)][:1]
    for side in (1.0, -1.0):
        mask = body.of(source) & (body.middle()[:, 2] * side > 0)
        if not mask.any() or not len(tint):
            continue
        low, high = _extent(body, mask)
        span = high - low
        own = np.random.default_rng([0x1A3, seed])
        outline = _lamp_outline(style, low, high, side, own)
        inner = low[2] if side > 0 else high[2]
        columns, rows = own.uniform(0.28, 0.42), own.uniform(0.3, 0.45)
        planes = list(outline)
        z_edges = (0.05, columns, 0.5, 0.62, 0.8, 0.93) if fine else (columns, 0.5, 0.8)
        y_edges = (0.1, rows, 0.7, 0.9) if fine else (rows, 0.7)
        planes += [((0.0, 0.0, 1.0), inner + side * span[2] * e) for e in z_edges]
        planes += [((0.0, 1.0, 0.0), low[1] + span[1] * e) for e in y_edges]
        body.divide(mask, planes)
        index = np.flatnonzero(body.of(source) & (body.middle()[:, 2] * side > 0))
        spot = body.middle()[index]
        u, v = (spot[:, 2] - inner) / (side * span[2]), (spot[:, 1] - low[1]) / span[1]
        outside = np.zeros(len(index), bool)
        for normal, offset in outline:
            outside |= spot @ np.array(normal) > offset
        albedo = (_head_lamp if source == solids.Material.HEADLIGHT else _tail_lamp)(u, v, columns, rows, own)
        body.soup.albedo[index] = albedo
        sheet = index[outside]
        body.paint(sheet, Material.PAINT, tint[0])


def _head_lamp(u: np.ndarray, v: np.ndarray, columns: float, rows: float, rng: np.random.Generator) -> np.ndarray:
    """Albedo (n, 3) over a head lamp: u from the inner to the outer end, v from top to bottom."""
    albedo = np.broadcast_to(_HOUSING * rng.uniform(0.6, 2.6), (len(u), 3)).copy()
    bright = (u > 0.05) & (u < columns) & (v > 0.1) & (v < 0.9)
    bright |= (u > 0.5) & (u < 0.8) & (v > 0.1) & (v < 0.9)
    albedo[bright] = _CLEAR * rng.uniform(0.7, 1.3)
    albedo[bright & (v > rows) & (v < 0.7)] = _CLEAR * 1.45
    if rng.random() < 0.4:
        albedo[u > 0.8] = _AMBER
    elif rng.random() < 0.5:
        albedo[v > 0.9] = _DARK * 2
    return albedo


def _tail_lamp(u: np.ndarray, v: np.ndarray, columns: float, rows: float, rng: np.random.Generator) -> np.ndarray:
    """Albedo (n, 3) over a tail lamp, as `_head_lamp`."""
    albedo = np.broadcast_to(_RED * rng.uniform(0.6, 1.2), (len(u), 3)).copy()
    albedo[(u < 0.05) | (u > 0.93) | (v < 0.1) | (v > 0.9)] = _DEEP_RED
    layout = int(rng.integers(4))
    if layout == 0:
        albedo[(v > rows) & (v < 0.7) & (u > 0.05)] = _AMBER
        albedo[(v > 0.7) & (v < 0.9)] = _CLEAR
    elif layout == 1:
        albedo[(u > columns) & (u < 0.62) & (v > rows) & (v < 0.9)] = _CLEAR * 0.9
    elif layout == 2:
        albedo[(v > 0.7) & (u < 0.5)] = _CLEAR * 0.8
        albedo[(v > rows) & (v < 0.7) & (u > 0.5)] = _DEEP_RED
    else:
        albedo[(u > columns) & (u < 0.8) & (v > rows) & (v < 0.7)] = _DEEP_RED
    return albedo


def _grille(body: _Body) -> None:
    """Bars across grille and air intake, and a badge."""
    rng = body.rng
    front = body.middle()[:, 0] > 0.36 * np.ptp(body.soup.corners[..., 0])
    mask = (body.of(solids.Material.TRIM) | body.of(solids.Material.CHROME)) & front & (body.facing()[:, 0] > 0.6)
    if not mask.any():
        return
    low, high = _extent(body, mask)
    pitch = float(rng.uniform(0.035, 0.07))
    start = float(low[1]) + pitch * 0.3
    edges = np.arange(start, high[1], pitch / 2)[:24]
    planes = [((0.0, 1.0, 0.0), float(e)) for e in edges]
    planes += [((0.0, 0.0, 1.0), z) for z in (-0.04, 0.04)]
    body.divide(mask, planes)
    front = body.middle()[:, 0] > 0.36 * np.ptp(body.soup.corners[..., 0])
    index = np.flatnonzero(
        (body.of(solids.Material.TRIM) | body.of(solids.Material.CHROME)) & front & (body.facing()[:, 0] > 0.6)
    )
    spot = body.middle()[index]
    bar = (np.searchsorted(edges, spot[:, 1]) % 2).astype(bool)
    upper = spot[:, 1] < (low[1] + high[1]) / 2
    shiny = _CHROME * 0.8 if rng.random() < 0.35 else _DARK * 5
    body.soup.albedo[index] = np.where(
        bar[:, None] & upper[:, None], shiny, _DARK * np.where(bar, 2.5, 0.9)[:, None]
    )
    badge = upper & (np.abs(spot[:, 2]) < 0.04) & (spot[:, 1] > low[1] + 0.01) & (spot[:, 1] < low[1] + 0.10)
    body.paint(index[badge], Material.METAL, _CHROME * 0.7)


def _seam(body: _Body, mask: np.ndarray, normal: tuple[float, float, float], offset: float, width: float) -> None:
    """A dark gap along a plane over the painted faces of a mask."""
    reach = body.soup.corners @ np.asarray(normal, np.float32) - np.float32(offset)
    near = mask & (reach.max(axis=1) > -width / 2) & (reach.min(axis=1) < width / 2)
    if not near.any():
        return
    part = body.soup.take(near)
    for edge in (-width / 2, width / 2):
        part = cut(part, normal, offset + edge)
    inside = np.abs(part.corners.mean(axis=1) @ np.asarray(normal) - offset) < width / 2
    part.material[inside], part.albedo[inside] = Material.TRIM, _DARK
    part.pattern[inside, 0] = int(solids.Material.TRIM)
    body.soup = join([body.soup.take(~near), part])


def _seams(body: _Body) -> None:
    """Gaps between bonnet, wings, bumpers and boot lid; a rub strip along the doors."""
    rng = body.rng
    half = body.soup.corners[..., 0].max()
    wide = body.soup.corners[..., 2].max()
    glass = body.of(solids.Material.GLASS)
    lamps = body.of(solids.Material.HEADLIGHT), body.of(solids.Material.TAIL_LIGHT)
    if not (glass.any() and lamps[0].any() and lamps[1].any()):
        return
    screen_x, belt = float(body.soup.corners[glass][..., 0].max()), float(body.soup.corners[glass][..., 1].max())
    heights = [float(body.soup.corners[m][..., 1].max()) for m in lamps]
    for end, height in zip((1.0, -1.0), heights, strict=True):
        middle, facing = body.middle(), body.facing()
        sheet = body.of(solids.Material.PAINT) & (middle[:, 0] * end > half - rng.uniform(0.45, 0.6))
        _seam(body, sheet & (np.abs(facing[:, 1]) < 0.7), (0, 1, 0), height + 0.015, 0.012)
    lid = float(rng.uniform(0.70, 0.78)) * wide
    for z in (lid, -lid):
        middle, facing = body.middle(), body.facing()
        sheet = body.of(solids.Material.PAINT)
        bonnet = sheet & (middle[:, 0] > screen_x - 0.05) & (facing[:, 1] < -0.6)
        _seam(body, bonnet, (0, 0, 1), z, 0.012)
        middle, facing = body.middle(), body.facing()
        rear = (
            body.of(solids.Material.PAINT)
            & (facing[:, 0] < -0.6)
            & (middle[:, 1] < heights[1])
            & (middle[:, 1] > belt)
        )
        _seam(body, rear, (0, 0, 1), z, 0.012)
    if rng.random() < 0.35:
        middle, facing = body.middle(), body.facing()
        doors = (
            body.of(solids.Material.PAINT) & (np.abs(facing[:, 2]) > 0.75) & (np.abs(middle[:, 0]) < 0.55 * half)
        )
        _seam(body, doors & (middle[:, 1] > belt), (0, 1, 0), 0.55 * belt, 0.045)


def _panes(body: _Body) -> None:
    """Rubber along the upper and lower edges of the windows, of chrome below in some cars."""
    mask = body.of(solids.Material.GLASS)
    if not mask.any():
        return
    low, high = _extent(body, mask)
    body.divide(mask, [((0.0, 1.0, 0.0), float(high[1] - 0.03)), ((0.0, 1.0, 0.0), float(low[1] + 0.025))])
    mask = body.of(solids.Material.GLASS)
    height = body.middle()[:, 1]
    below = mask & (height > high[1] - 0.03)
    chrome = body.rng.random() < 0.2
    body.paint(below, Material.TRIM, _CHROME if chrome else _DARK)
    body.paint(mask & (height < low[1] + 0.025), Material.TRIM, _DARK)


def _sources(mesh: Mesh) -> np.ndarray:
    """What the templates' builder made each face of (F,), told by the colour; other meshes' faces match none."""
    faces = mesh.faces.numpy()
    if mesh.colours is None:
        return np.full(len(faces), -1)
    colour = mesh.colours.numpy()[faces].mean(axis=1)
    table = np.array([solids.COLOUR[m] for m in solids.Material])
    distance = np.abs(colour[:, None] - table[None]).max(axis=2)
    return np.where(distance.min(axis=1) < 2e-3, distance.argmin(axis=1), -1)


@lru_cache(maxsize=96)
def vehicle_shape(kind: str, variant: int, fine: bool) -> VehicleShape:
    """A vehicle's mesh as triangles with details painted on; fine: with those seen from near only."""
    mesh, size = vehicle_mesh(kind, variant), np.array(typical_size_lhw(kind, variant), np.float32)
    vertices, faces = mesh.vertices.numpy(), mesh.faces.numpy()
    corners = vertices[faces] * size
    colours = (
        mesh.colours.numpy()[faces].mean(axis=1) if mesh.colours is not None else np.full((len(faces), 3), 0.5)
    )
    soup = make(corners, Material.PAINT, (0.5, 0.5, 0.5), creased_normals(corners))
    table = np.array([int(_PART_MATERIAL[Part(p)]) for p in range(len(Part))], np.uint8)
    soup.material[:] = table[mesh.part.numpy()]
    soup.albedo[:] = np.power(np.clip(colours, 0, 1), _GREY_TO_LINEAR)
    body = _Body(soup, _sources(mesh), np.random.default_rng([0xCA2, KINDS.index(kind), variant]))
    if kind not in ("bus", "truck"):
        _panes(body)
    _lamps(body, solids.Material.HEADLIGHT, fine)
    _lamps(body, solids.Material.TAIL_LIGHT, fine)
    _plates(body, fine)
    if fine:
        _grille(body)
        if kind not in ("bus", "truck"):
            _seams(body)
    done = body.soup
    done.pattern[:, 0] = 0
    # covectors of the unit box: `placed` divides them by the size again
    done = replace(done, corners=done.corners / size, normals=done.normals * size)
    points, index = np.unique(done.corners.reshape(-1, 3), axis=0, return_inverse=True)
    return VehicleShape(done, points, index.reshape(-1, 3))


@lru_cache(maxsize=512)
def _strokes(seed: int) -> np.ndarray:
    """Whether each cell of a plate's characters is dark, (1 + 3 rows * 2 * signs,) bool; cell 0 never."""
    rng = np.random.default_rng([0x91A, seed])
    dark = rng.random(1 + 6 * _SIGNS) < 0.6
    dark[0] = False
    # a space between the town, the letters and the number
    for sign in (2, 4):
        if rng.random() < 0.6:
            dark[1 + 6 * sign : 7 + 6 * sign] = False
    return dark


def vehicle(actor: Actor, fine: bool = True) -> Soup:
    """A vehicle's triangles in its unit box, of its own shape, in its own paint and with its own number.

    fine: with the details that are seen from near only.
    """
    shape = vehicle_shape(actor.kind, actor.variant, fine)
    soup = shape.soup if actor.ffd is None else deformed(shape, np.array(actor.ffd, np.float32))
    albedo = soup.albedo.copy()
    paint = soup.material == Material.PAINT
    tint = albedo[paint] / max(float(np.median(albedo[paint])) if paint.any() else 1.0, 1e-3)
    albedo[paint] = np.clip(tint * np.asarray(actor.paint, np.float32), 0, 0.9)
    cell = soup.pattern[:, 3].astype(np.int64)
    albedo[_strokes(actor.seed)[np.minimum(cell, 6 * _SIGNS)] & (cell > 0)] = _DARK * 2
    return replace(soup, albedo=albedo)
