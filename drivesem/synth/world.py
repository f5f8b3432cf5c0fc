"""The static surroundings of a road, and actors as triangles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from drivesem.synth import buildings, flora, furniture, people, vehicles
from drivesem.synth.layout import PUSHES_PRAM, Actor, Road
from drivesem.synth.soup import Material, Semantic, Soup, box, join, make, placed, quad, stick, tagged

_STATIONS_M = np.array([-14, -8, -4, 0, 4, 8, 12, 18, 24, 32, 40, 50, 62, 76, 92, 110, 135, 165, 200.0])
"""Where ribbons of ground are cut along s; gentle bends need no more."""
_GROUND_ALBEDO = {
    Material.ROAD: (0.115, 0.113, 0.112),
    Material.PARKING: (0.15, 0.145, 0.14),
    Material.PAVEMENT: (0.20, 0.19, 0.18),
    Material.KERB: (0.24, 0.235, 0.225),
    Material.GRASS: (0.085, 0.115, 0.035),
    Material.GRAVEL: (0.17, 0.15, 0.125),
}
"""Linear albedo; asphalt 0.08 to 0.15, concrete 0.2 to 0.3, grass about 0.1 in the visible range."""
_CROWN = 0.36
"""Radius of the widest crowns, as a fraction of the tree's width scale."""
_LAYER_M = 0.004
"""Height of patches and paint above the road: nothing to see, enough for the depth test."""
_HALVES = np.array([[0, 1, 2], [0, 2, 3]])
"""Corners of a quadrilateral's two triangles."""
_LEAVES = 52_000
"""Triangles of plants on one side of the road; once they are spent, what follows (farther away) is coarse."""
_FINE_M = 20.0
"""Nearer vehicles have plates with characters, seams and bars in their grilles: beyond, these are below a
pixel."""
_SEMANTIC = {
    "Car": Semantic.CAR,
    "Van": Semantic.VAN,
    "Truck": Semantic.TRUCK,
    "Pedestrian": Semantic.PEDESTRIAN,
    "Cyclist": Semantic.CYCLIST,
}
"""What the triangles of an actor with this label belong to."""


@dataclass(frozen=True, slots=True)
class Pool:
    """First ids and counts of the shapes a split may use: held-out scenes share none with training scenes."""

    offset: int
    buildings: int
    trees: int
    surfaces: int


POOLS = {"train": Pool(0, 160, 48, 40), "heldout": Pool(10_000, 60, 24, 20)}
"""Ids below 10,000 belong to training scenes, the others to held-out ones."""


class _Builder:
    """Collects soups at road coordinates and remembers which shapes were used."""

    def __init__(self, road: Road, pool: Pool, rng: np.random.Generator) -> None:
        self.road, self.pool, self.rng = road, pool, rng
        self.parts: list[Soup] = []
        self.leaves = 0
        self.plants: list[tuple[float, float]] = []
        self.used: dict[str, set[int]] = {"building": set(), "tree": set(), "bush": set(), "surface": set()}

    def draw(self, name: str, count: int) -> int:
        """A random id of the pool, noted in the manifest."""
        identifier = self.pool.offset + int(self.rng.integers(count))
        self.used[name].add(identifier)
        return identifier

    def free(self, s: float, reach: float) -> bool:
        """Whether nothing within `reach` of s stands on a crossing road."""
        crossing = self.road.crossing
        return crossing is None or s + reach < crossing[0] - 1 or s - reach > crossing[1] + 1

    def clear_of_plants(self, d: float, s: float, reach: float) -> bool:
        """Whether no tree or bush stands within `reach` of (d, s)."""
        return all(np.hypot(d - other_d, s - other_s) > reach for other_d, other_s in self.plants)

    def put(
        self,
        soup: Soup,
        d: float,
        s: float,
        turn: float = 0.0,
        scale: tuple[float, float, float] = (1, 1, 1),
        y: float = 0.0,
    ) -> None:
        """Place a soup turned by `turn`; at 0 its x runs along the road."""
        x, z = self.road.point(d, s)
        self.parts.append(placed(soup, (float(x), y, float(z)), self.road.yaw(s, 1) + turn, scale))


def _ground(b: _Builder) -> None:
    road = b.road
    surface_rng = np.random.default_rng([0x5F, b.draw("surface", b.pool.surfaces)])
    tone = {m: surface_rng.uniform(0.75, 1.3) * surface_rng.uniform(0.96, 1.04, 3) for m in _GROUND_ALBEDO}
    tone[Material.GRASS] = surface_rng.uniform(0.8, 1.4) * np.array(
        [surface_rng.uniform(0.8, 1.6), 1.0, surface_rng.uniform(0.8, 1.2)]
    )
    seed = float(surface_rng.integers(1000))
    spans = [(_STATIONS_M[0], _STATIONS_M[-1])]
    if road.crossing:
        spans = [(_STATIONS_M[0], road.crossing[0]), (road.crossing[1], _STATIONS_M[-1])]
        c0, c1 = road.crossing
        outline = np.array([[-90, c0], [90, c0], [90, c1], [-90, c1]])
        albedo = _GROUND_ALBEDO[Material.ROAD] * tone[Material.ROAD]
        b.parts.append(_patch(outline, 0.0, Material.ROAD, albedo, seed))
        # Half the road's width of lines across: the edge is drawn by kerbs only.
        for strip in road.strips:
            if strip.height_m > 0:
                for at, sign in ((c0, 1.0), (c1, -1.0)):
                    face = np.array(
                        [
                            [strip.d0, 0, at],
                            [strip.d1, 0, at],
                            [strip.d1, -strip.height_m, at],
                            [strip.d0, -strip.height_m, at],
                        ]
                    )
                    normal = np.broadcast_to([0, 0, sign], (2, 3, 3))
                    colour = _GROUND_ALBEDO[Material.KERB] * tone[Material.KERB]
                    b.parts.append(make(quad(face), Material.KERB, colour, normal, pattern=(seed, 0, 0, 0)))
    for strip in road.strips:
        albedo = _GROUND_ALBEDO[strip.material] * tone[strip.material]
        for start, end in spans:
            inner = _STATIONS_M[(start < _STATIONS_M) & (end > _STATIONS_M)]
            s = np.concatenate([[start], inner, [end]])
            b.parts.append(
                _ribbon(
                    road, (strip.d0, strip.d1), s, (strip.height_m, strip.height_m), strip.material, albedo, seed
                )
            )
            if strip.material == Material.KERB or strip.height_m:
                for edge in (strip.d0, strip.d1):
                    b.parts.append(
                        _ribbon(
                            road,
                            (edge, edge),
                            s,
                            (0.0, strip.height_m),
                            Material.KERB,
                            _GROUND_ALBEDO[Material.KERB] * tone[Material.KERB],
                            seed,
                        )
                    )
    far = np.array([[-500, -30], [500, -30], [500, 700], [-500, 700]])
    b.parts.append(_patch(far, -0.12, Material.GRASS, _GROUND_ALBEDO[Material.GRASS] * tone[Material.GRASS], seed))


def _patch(outline: np.ndarray, height_m: float, material: Material, albedo: np.ndarray, seed: float) -> Soup:
    """A flat, cut-up ground rectangle: outline (4, 2) of (x, z)."""
    xs = np.linspace(outline[0, 0], outline[1, 0], 9)
    zs = np.linspace(outline[0, 1], outline[2, 1], 9)
    cells = np.full((8, 8, 4, 3), -height_m)
    cells[..., [0, 3], 0], cells[..., [1, 2], 0] = xs[:-1, None, None], xs[1:, None, None]
    cells[..., [0, 1], 2], cells[..., [2, 3], 2] = zs[None, :-1, None], zs[None, 1:, None]
    corners = cells[:, :, _HALVES].reshape(-1, 3, 3)
    normals = np.broadcast_to([0.0, -1.0, 0.0], corners.shape)
    return make(corners, material, albedo, normals, corners[..., [0, 2]] + [300.0, 0.0], (seed, 0, 0, 0))


def _ribbon(
    road: Road,
    d: tuple[float, float],
    s: np.ndarray,
    heights_m: tuple[float, float],
    material: Material,
    albedo: np.ndarray,
    seed: float,
) -> Soup:
    """A band along the road between two offsets, cut at stations s; vertical where both offsets are equal."""
    count = len(s) - 1
    points, uv = np.empty((count, 4, 3)), np.empty((count, 4, 2))
    for i, (near, far) in enumerate(((0, 3), (1, 2))):
        x, z = road.point(d[i], s)
        for corner, ends in ((near, slice(None, -1)), (far, slice(1, None))):
            points[:, corner, 0], points[:, corner, 1], points[:, corner, 2] = x[ends], -heights_m[i], z[ends]
            uv[:, corner, 0], uv[:, corner, 1] = d[i], s[ends]
    upright = np.array([1.0 if d[0] < 0 else -1.0, -0.05, 0.0])
    normal = upright if d[0] == d[1] else np.array([0.0, -1.0, 0.0])
    normals = np.broadcast_to(normal / np.linalg.norm(normal), (2 * count, 3, 3))
    return make(points[:, _HALVES], material, albedo, normals, uv[:, _HALVES], (seed, 0, 0, 0))


def _detail(distance_m: float) -> int:
    return 3 if distance_m < 11 else 2 if distance_m < 24 else 1 if distance_m < 48 else 0


def _plant_detail(b: _Builder, spot: tuple[float, float], scale: float, reach_m: float) -> int:
    """Level of detail of a plant at (x, z) with leaves of 1 / scale the usual size: what the flank affords."""
    x, z = spot
    if abs(x) - reach_m > 1.1 * z + 2:
        # out of sight for a camera that looks along the road: it throws shadows
        return min(_detail(float(np.hypot(x, z)) * scale), 1)
    most = 3 if b.leaves < _LEAVES // 2 else 2 if b.leaves < _LEAVES else 0
    return min(_detail(float(np.hypot(x, max(z, 0.0))) * scale), most)


def _tree(b: _Builder, d: float, s: float, height_m: float, room_m: float = np.inf) -> None:
    """A tree; room_m: from its trunk to the next wall, into which its crown must not grow."""
    if not b.free(s, 0.5):
        return
    b.plants.append((d, s))
    identifier = b.draw("tree", b.pool.trees)
    x, z = b.road.point(d, s)
    detail = _plant_detail(b, (float(x), float(z)), 9.0 / height_m, 0.35 * height_m)
    width = height_m * float(b.rng.uniform(0.85, 1.15))
    width = min(width, max(room_m / _CROWN, 0.45 * height_m))
    soup = flora.tree(identifier, detail)
    b.leaves += len(soup)
    b.put(
        tagged(soup, Semantic.TREE),
        d,
        s,
        float(b.rng.uniform(0, 6.28)),
        (width, height_m, width),
    )


def _bush(b: _Builder, d: float, s: float, size_m: float) -> None:
    if not b.free(s, size_m):
        return
    b.plants.append((d, s))
    identifier = b.draw("bush", b.pool.trees)
    wide = size_m * float(b.rng.uniform(0.9, 1.5))
    x, z = b.road.point(d, s)
    detail = _plant_detail(b, (float(x), float(z)), 1.4 / size_m, wide)
    soup = flora.bush(identifier, detail)
    b.leaves += len(soup)
    b.put(
        soup,
        d,
        s,
        float(b.rng.uniform(0, 6.28)),
        (wide, size_m, wide),
    )


def _city_row(b: _Builder, side: int, edge: float) -> float:
    """Adjoining blocks of flats or houses along one side; returns how far behind `edge` they stand, m."""
    rng = b.rng
    s = float(rng.uniform(-14, -6))
    storeys = int(rng.integers(2, 6))
    set_back = float(rng.uniform(0.0, 2.0) if rng.random() < 0.7 else rng.uniform(3, 8))
    while s < 150:
        length, depth = float(rng.uniform(8, 18)), float(rng.uniform(9, 13))
        middle = s + length / 2
        if b.free(middle, length / 2) and rng.random() < 0.92:
            levels = max(storeys + int(rng.integers(-1, 2)), 1)
            identifier = b.draw("building", b.pool.buildings)
            soup = buildings.building(
                identifier,
                length,
                depth,
                levels,
                bool(rng.random() < 0.8),
                front=float(side) * (middle < 70),
                city=True,
            )
            b.put(soup, edge + side * (set_back + depth / 2 + float(rng.uniform(0, 0.4))), middle)
        s += length + (float(rng.uniform(3, 8)) if rng.random() < 0.15 else 0.02)
    return set_back


def _houses(b: _Builder, side: int, edge: float) -> None:
    """Detached houses in gardens behind hedges, walls or fences."""
    rng = b.rng
    s = float(rng.uniform(-16, -8))
    while s < 120:
        length, depth = float(rng.uniform(8, 14)), float(rng.uniform(8, 12))
        gap = float(rng.uniform(3, 9))
        middle, back = s + length / 2, float(rng.uniform(2.5, 8.0))
        if b.free(middle, length / 2 + 1):
            identifier = b.draw("building", b.pool.buildings)
            soup = buildings.building(
                identifier,
                length,
                depth,
                int(rng.integers(1, 4)),
                bool(rng.random() < 0.6),
                front=float(side) * (middle < 70),
            )
            b.put(soup, edge + side * (back + depth / 2), middle)
            plot = length + gap - 0.6
            if gap > 4.5 and rng.random() < 0.5:
                garage = furniture.shed(rng, min(gap - 1.2, 5.5))
                b.put(garage, edge + side * (back + float(rng.uniform(2.0, 4.5))), s + length + gap / 2)
            _boundary(b, side, edge + side * float(rng.uniform(0.2, 0.5)), middle, plot)
            for _ in range(int(rng.integers(0, 4))):
                where = s + float(rng.uniform(-gap, length + gap))
                if rng.random() < 0.45:
                    off = float(rng.uniform(1.6, 3.2 + back * 0.5))
                    room = max(back - off, 0.8) if abs(where - middle) < length / 2 + 2 else 3.0
                    _tree(b, edge + side * off, where, min(float(rng.uniform(4, 9)), 3.0 + 2.5 * room), room)
                else:
                    _bush(b, edge + side * float(rng.uniform(1.2, 2.5)), where, float(rng.uniform(0.8, 2.2)))
            if rng.random() < 0.5:
                off = float(rng.uniform(3, 8))
                _tree(b, edge + side * (back + depth + off), middle, float(rng.uniform(8, 14)), off)
        s += length + gap


def _boundary(b: _Builder, side: int, d: float, middle: float, length: float) -> None:
    """What separates a garden from the pavement."""
    rng = b.rng
    draw = rng.random()
    height = float(rng.uniform(0.7, 1.7))
    if draw < 0.4:
        b.put(
            flora.hedge((length, height, 0.7), float(side), _detail(float(np.hypot(d, middle - length / 4))), rng),
            d + side * 0.35,
            middle,
        )
    elif draw < 0.6:
        colour = np.array([0.35, 0.33, 0.30]) * rng.uniform(0.5, 1.3)
        b.put(buildings.garden_wall(length, height * 0.8, Material.WALL, colour), d, middle)
    elif draw < 0.78:
        colour = np.array([0.17, 0.11, 0.06]) * rng.uniform(0.6, 1.6)
        b.put(buildings.garden_wall(length, height, Material.FENCE, colour), d, middle)
    elif draw < 0.92:
        colour = np.full(3, 0.05) * rng.uniform(0.5, 4.0)
        b.put(tagged(buildings.railing(length, height, colour), Semantic.BUILDING), d, middle)


def _tree_row(
    b: _Builder, d: float, spacing: tuple[float, float], height: tuple[float, float], room_m: float = np.inf
) -> None:
    s = float(b.rng.uniform(-6, 6))
    while s < 130:
        _tree(b, d + float(b.rng.normal(0, 0.15)), s, float(b.rng.uniform(*height)), room_m)
        s += float(b.rng.uniform(*spacing))


def _guard_rail(b: _Builder, d: float) -> None:
    """A steel rail on posts."""
    s = _STATIONS_M[3:-2]
    steel = np.array([0.30, 0.31, 0.32])
    for low, high, out in ((0.50, 0.58, 0.02), (0.58, 0.66, -0.03), (0.66, 0.74, 0.02)):
        offset = d + out
        x, z = b.road.point(offset, s)
        x1, z1 = b.road.point(d - out, s)
        a, c = np.stack([x, np.full_like(s, -low), z], 1), np.stack([x1, np.full_like(s, -high), z1], 1)
        points = np.stack([a[:-1], c[:-1], c[1:], a[1:]], axis=1)[:, np.array([[0, 1, 2], [0, 2, 3]])]
        b.parts.append(tagged(make(points.reshape(-1, 3, 3), Material.METAL, steel), Semantic.GUARD_RAIL))
    post = tagged(box((0.1, 0.6, 0.08), Material.METAL, steel * 0.8), Semantic.GUARD_RAIL)
    for at in np.arange(1.0, 80.0, 4.0):
        b.put(post, d + np.sign(d) * 0.08, float(at))


def _edge(b: _Builder, side: int) -> float:
    return b.road.flank_m[0] if side < 0 else b.road.flank_m[1]


def _street_furniture(b: _Builder) -> None:
    """Lamps, signs, bins, boxes, shelters along the pavements or verges."""
    rng, road = b.rng, b.road
    lamp_side = int(rng.choice([-1, 1]))
    s, height = float(rng.uniform(3, 25)), float(rng.uniform(5.5, 10))
    post = furniture.lamp(height, lamp_side)
    while s < 120:
        if b.free(s, 0.3):
            b.put(post, _edge(b, lamp_side) - lamp_side * 0.3, s)
        s += float(rng.uniform(22, 38))
    for _ in range(int(rng.integers(1, 6))):
        side = int(rng.choice([-1, 1]))
        where = float(rng.uniform(7, 60))
        if b.free(where, 1.0):
            # those of the other side of the road face the other way
            turn = np.pi if side < 0 and rng.random() < 0.7 else 0.0
            b.put(
                furniture.sign(rng),
                _edge(b, side) - side * float(rng.uniform(0.0, 0.5)),
                where,
                turn + rng.normal(0, 0.06),
            )
    small = bool(road.pavements)
    for _ in range(int(rng.integers(0, 5))):
        side = int(rng.choice([-1, 1]))
        where = float(rng.uniform(6, 55))
        if b.free(where, 3.0):
            # on the pavement's outer side, or well off the road
            d = _edge(b, side) + side * (-0.55 if small else float(rng.uniform(1.8, 3.0)))
            turn = float(rng.normal(0, 0.02 if small else 0.2)) + (np.pi if rng.random() < 0.5 else 0.0)
            clutter = furniture.clutter(rng, small)
            if small or b.clear_of_plants(d, where, 3.5):
                b.put(clutter, d, where, turn)
    if road.pavements and rng.random() < 0.3:
        side = int(rng.choice([-1, 1]))
        where = float(rng.uniform(10, 45))
        if b.free(where, 3.0):
            b.put(furniture.bus_stop(rng), _edge(b, side) - side * 0.75, where, 0.0 if side < 0 else np.pi)
    if road.crossing:
        for at, side, turn in ((road.crossing[0] - 1.0, 1, 0.0), (road.crossing[1] + 1.0, -1, np.pi)):
            reach = float(rng.uniform(2.5, 4.5)) if rng.random() < 0.5 else 0.0
            b.put(furniture.traffic_light(rng, reach), _edge(b, side) - side * 0.6, at, turn)
    if road.kind in ("country", "residential") and rng.random() < 0.4:
        _wires(b, int(rng.choice([-1, 1])))


def _wires(b: _Builder, side: int) -> None:
    """Poles with overhead lines along the road."""
    rng = b.rng
    d, height = _edge(b, side) + side * float(rng.uniform(0.3, 3.0)), float(rng.uniform(7, 9))
    stations = np.arange(float(rng.uniform(-20, 0)), 170.0, float(rng.uniform(32, 45)))
    pole = furniture.wire_pole(height)
    for s in stations:
        if b.free(float(s), 0.4):
            b.put(pole, d, float(s))
    for out in (-0.8, 0.0, 0.8):
        for s0, s1 in pairwise(stations):
            steps = np.linspace(s0, s1, 5)
            x, z = b.road.point(d + out, steps)
            sag = 0.9 * (1 - (2 * (steps - s0) / (s1 - s0) - 1) ** 2)
            points = np.stack([x, -height + 0.5 + sag, z], axis=1)
            b.parts += [
                tagged(stick(p, q, (0.014, 0.014), Material.TRIM, (0.02, 0.02, 0.02), 3), Semantic.POLE)
                for p, q in pairwise(points)
            ]


_PAINTED = (0.50, 0.50, 0.48)
"""Linear albedo of worn road paint."""


def _decal(
    b: _Builder, d: tuple[float, float], s: tuple[float, float], material: Material, albedo: np.ndarray
) -> None:
    """A thin layer on the road between two offsets and two stations."""
    steps = np.linspace(s[0], s[1], max(int((s[1] - s[0]) / 8), 1) + 1)
    layer = _ribbon(b.road, d, steps, (_LAYER_M, _LAYER_M), material, albedo, float(b.rng.integers(1000)))
    b.parts.append(tagged(layer, Semantic.ROAD))


def _road_details(b: _Builder) -> None:
    """Mended patches, manholes, gutters, marks of parking places, arrows, crossings for people."""
    rng, road = b.rng, b.road
    lanes = [s for s in road.strips if s.material == Material.ROAD and s.d1 - s.d0 > 1.5]
    tar = np.array(_GROUND_ALBEDO[Material.ROAD])
    for _ in range(int(rng.integers(0, 7))):
        strip = lanes[int(rng.integers(len(lanes)))]
        s0 = float(rng.uniform(5, 60))
        wide = min(float(rng.uniform(0.5, 2.6)), strip.d1 - strip.d0 - 0.4)
        long = float(rng.choice([rng.uniform(0.6, 3.0), rng.uniform(6, 30)]))
        d0 = float(rng.uniform(strip.d0 + 0.1, strip.d1 - wide - 0.1))
        if wide > 0.3 and b.free(s0 + long / 2, long / 2):
            _decal(b, (d0, d0 + wide), (s0, s0 + long), Material.ROAD, tar * rng.uniform(0.62, 1.3))
    kerbs = [s for s in road.strips if s.material == Material.KERB]
    spans = [(-8.0, 90.0)]
    if road.crossing:
        spans = [(-8.0, road.crossing[0]), (road.crossing[1], 90.0)]
    for kerb in kerbs:
        sign = 1.0 if kerb.d0 < 0 else -1.0
        edge = kerb.d1 if sign > 0 else kerb.d0
        d = tuple(sorted((edge, edge + sign * 0.3)))
        for span in spans:
            _decal(b, (d[0], d[1]), span, Material.PARKING, tar * 1.25)
        for s in np.arange(float(rng.uniform(6, 14)), 60, 17.0):
            if b.free(float(s), 0.5):
                x = edge + sign * 0.16
                _decal(b, (x - 0.14, x + 0.14), (float(s), float(s) + 0.5), Material.CLOTH, np.full(3, 0.03))
    for _ in range(int(rng.integers(1, 5) if kerbs else rng.integers(2))):
        strip = lanes[0]
        d, s = float(rng.uniform(strip.d0 + 0.6, strip.d1 - 0.6)), float(rng.uniform(6, 40))
        angle = np.linspace(0, 2 * np.pi, 15)
        for radius, grey, up in ((0.40, 0.085, 1.0), (0.32, 0.06, 1.5)):
            x, z = road.point(d + radius * np.cos(angle), s + radius * np.sin(angle))
            middle = np.broadcast_to(np.array([*road.point(d, s)]), (14, 2))
            flat = np.stack([middle, np.stack([x, z], 1)[:-1], np.stack([x, z], 1)[1:]], axis=1)
            corners = np.stack([flat[..., 0], np.full((14, 3), -_LAYER_M * up), flat[..., 1]], axis=2)
            lid = make(corners, Material.CLOTH, np.full(3, grey), np.broadcast_to([0.0, -1.0, 0.0], corners.shape))
            b.parts.append(tagged(lid, Semantic.ROAD))
    for strip in road.strips:
        if strip.material == Material.PARKING and rng.random() < 0.6:
            pitch = 2.6 if strip.d1 - strip.d0 > 3 else 5.8
            for s in np.arange(float(rng.uniform(0, pitch)), 70, pitch):
                if b.free(float(s), 5.0):
                    _decal(b, (strip.d0, strip.d1), (float(s), float(s) + 0.12), Material.ROAD, np.array(_PAINTED))
    if road.kind in ("city", "junction", "residential") and rng.random() < 0.35:
        s0 = road.crossing[0] - 5.2 if road.crossing else float(rng.uniform(9, 40))
        for lane in lanes:
            for d0 in np.arange(lane.d0 + 0.3, lane.d1 - 0.5, 1.0):
                _decal(b, (float(d0), float(d0) + 0.5), (s0, s0 + 3.2), Material.ROAD, np.array(_PAINTED))
    if road.crossing or (road.kind == "arterial" and rng.random() < 0.5):
        end = road.crossing[0] - 8 if road.crossing else float(rng.uniform(20, 40))
        for lane in road.lanes:
            if lane.direction == 1 and not lane.parked and end > 7:
                _arrow(b, lane.middle_m, end, int(rng.integers(3)) - 1)


def _arrow(b: _Builder, d: float, tip: float, turn: int) -> None:
    """An arrow painted on a lane, its tip at s = tip, 4 m long; turn: -1 left, 0 ahead, 1 right."""
    if turn == 0:
        outline = [[(-0.08, -4.0), (0.08, -4.0), (0.08, -1.4)], [(-0.08, -4.0), (0.08, -1.4), (-0.08, -1.4)]]
        outline.append([(-0.32, -1.4), (0.32, -1.4), (0.0, 0.0)])
    else:
        outline = [[(-0.08, -4.0), (0.08, -4.0), (0.08, -1.6)], [(-0.08, -4.0), (0.08, -1.6), (-0.08, -1.6)]]
        outline += [[(0.0, -2.1), (0.5, -1.3), (0.5, -1.0)], [(0.0, -2.1), (0.5, -1.0), (0.0, -1.6)]]
        outline.append([(0.4, -1.9), (0.45, -0.5), (0.95, -0.9)])
    shape = np.array(outline) * [float(turn or 1), 1.0]
    offset, station = d + shape[..., 0], tip + shape[..., 1]
    x, z = b.road.point(offset, station)
    corners = np.stack([x, np.full_like(x, -_LAYER_M), z], axis=2)
    normals = np.broadcast_to([0.0, -1.0, 0.0], corners.shape)
    paint = make(corners, Material.ROAD, _PAINTED, normals, np.stack([offset, station], axis=2))
    b.parts.append(tagged(paint, Semantic.ROAD))


def _fields(b: _Builder, side: int, edge: float) -> None:
    """Fields of different crops, a fence along the road, hedges between them, bales."""
    rng = b.rng
    s = -10.0
    crops = np.array(
        [[0.20, 0.16, 0.06], [0.10, 0.075, 0.05], [0.07, 0.12, 0.03], [0.12, 0.15, 0.04], [0.22, 0.20, 0.09]]
    )
    while s < 190:
        long = float(rng.uniform(25, 90))
        near, far = edge + side * float(rng.uniform(2, 7)), edge + side * 58
        d = tuple(sorted((near, far)))
        albedo = crops[int(rng.integers(len(crops)))] * rng.uniform(0.8, 1.2)
        steps = np.linspace(s, s + long, 5)
        layer = _ribbon(
            b.road, (d[0], d[1]), steps, (0.02, 0.02), Material.GRASS, albedo, float(rng.integers(1000))
        )
        b.parts.append(layer)
        if rng.random() < 0.5:
            for out in np.arange(4.0, 50.0, 6.0):
                if rng.random() < 0.6:
                    spot = edge + side * float(out), s + long
                    if rng.random() < 0.35:
                        _tree(b, *spot, float(rng.uniform(5, 10)))
                    else:
                        _bush(b, *spot, float(rng.uniform(1.2, 3.0)))
        if albedo[0] > 0.15 and rng.random() < 0.6:
            for _ in range(int(rng.integers(2, 7))):
                where = s + float(rng.uniform(0.1, 0.9)) * long
                b.put(furniture.bale(), edge + side * float(rng.uniform(10, 50)), where, float(rng.uniform(0, 3)))
        s += long
    if rng.random() < 0.6:
        post = tagged(
            stick((0, 0, 0), (0, -1.15, 0), (0.05, 0.045), Material.BARK, (0.13, 0.10, 0.07), 5), Semantic.POLE
        )
        stations, d = np.arange(-4.0, 90.0, 3.0), edge + side * 1.4
        for at in stations:
            b.put(post, d, float(at))
        for height in (0.5, 1.05):
            x, z = b.road.point(d, stations)
            for low, high in pairwise(np.stack([x, np.full_like(x, -height), z], axis=1)):
                wire = stick(low, high, (0.012, 0.012), Material.METAL, (0.2, 0.2, 0.2), 3)
                b.parts.append(tagged(wire, Semantic.POLE))


def surroundings(road: Road, pool: Pool, rng: np.random.Generator) -> tuple[Soup, dict[str, list[int]]]:
    """Everything that does not move, and the ids of the shapes used, by kind."""
    b = _Builder(road, pool, rng)
    _ground(b)
    _road_details(b)
    left, right = road.flank_m
    for side, edge in ((-1, left), (1, right)):
        _flank(b, side, edge)
    _street_furniture(b)
    if road.kind in ("motorway", "country") and rng.random() < 0.6:
        _guard_rail(b, right - 0.2)
    if road.kind in ("motorway", "arterial") and rng.random() < (0.9 if road.kind == "motorway" else 0.4):
        inner = [s for s in road.strips if s.material != Material.ROAD and s.d1 < 0 and s.d0 > left]
        if inner:
            _guard_rail(b, (inner[0].d0 + inner[0].d1) / 2)
    for x0, z0, x1, z1, height in ((-160, 60, -20, 190, 13), (-60, 185, 60, 200, 11), (20, 190, 160, 60, 13)):
        scale = float(rng.uniform(0.7, 1.5))
        line = flora.tree_line(np.array([x0, z0], float), np.array([x1, z1], float), height * scale, rng)
        b.parts.append(tagged(line, Semantic.TREE))
    if rng.random() < 0.35:
        _hill(b)
    return join(b.parts), {k: sorted(v) for k, v in b.used.items()}


def _flank(b: _Builder, side: int, edge: float) -> None:
    """Everything along one side of the road."""
    rng, kind = b.rng, b.road.kind
    b.leaves = 0
    if kind in ("residential", "city", "junction"):
        draw = rng.random()
        room = 2.5
        if draw < (0.75 if kind == "residential" else 0.25):
            _houses(b, side, edge)
        elif draw < 0.88:
            room = _city_row(b, side, edge)
        else:
            _wood(b, side, edge)
        if rng.random() < 0.45:
            out = float(rng.uniform(0.4, 0.9))
            _tree_row(b, edge - side * out, (8, 15), (6, 11), room + out)
        return
    draw = rng.random()
    if draw < 0.4:
        _wood(b, side, edge)
    elif draw < 0.55 and kind != "motorway":
        _fields(b, side, edge)
    elif draw < 0.75:
        _tree_row(b, edge + side * float(rng.uniform(1.5, 5)), (6, 16), (7, 13))
        if rng.random() < 0.5:
            _wood(b, side, edge + side * 14)
        else:
            _fields(b, side, edge + side * 6)
    elif kind != "country" and draw < 0.9:
        out = float(rng.uniform(4, 12))
        room = _city_row(b, side, edge + side * out)
        _tree_row(b, edge + side * float(rng.uniform(1.5, 3)), (10, 20), (6, 10), room + out - 3)
    else:
        _houses(b, side, edge + side * float(rng.uniform(15, 35)))
        if rng.random() < 0.5:
            _tree_row(b, edge + side * float(rng.uniform(1.5, 4)), (9, 25), (5, 10))


def _wood(b: _Builder, side: int, edge: float) -> None:
    """A belt of trees and bushes."""
    rng = b.rng
    s = -4.0
    density = float(rng.uniform(0.55, 1.0))
    while s < 110:
        step = 2.2 + 0.05 * max(s, 0.0)
        if rng.random() < density:
            _tree(b, edge + side * float(rng.uniform(2.5, 9)), s, float(rng.uniform(5, 12)))
        if rng.random() < density:
            _bush(b, edge + side * float(rng.uniform(1.2, 3.0)), s + 1.0, float(rng.uniform(1.0, 3.0)))
        s += step


def _hill(b: _Builder) -> None:
    """A wooded ridge on the horizon."""
    rng = b.rng
    x = np.linspace(-420, 420, 60)
    crest = np.interp(x, np.linspace(-420, 420, 9), rng.uniform(8, 60, 9)) * float(rng.uniform(0.5, 1.0))
    z = 520 - 0.0004 * x**2
    low, high = np.stack([x, np.zeros(60), z], 1), np.stack([x, -crest, z + 120], 1)
    strip = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)[:, np.array([[0, 1, 2], [0, 2, 3]])]
    normal = np.array([0.0, -0.7, -0.7])
    b.parts.append(
        make(
            strip.reshape(-1, 3, 3),
            Material.LEAF,
            np.array([0.06, 0.08, 0.035]),
            np.broadcast_to(normal, (118, 3, 3)),
        )
    )


def actor_soup(actor: Actor, owner: int, distance_m: float = 0.0) -> Soup:
    """An actor's triangles in its own axes (front +x, bottom at y = 0), in metres, painted.

    distance_m: from the camera; what is far away gets fewer details inside the same outline.
    """
    if actor.label in ("Pedestrian", "Cyclist"):
        rng = np.random.default_rng([0x9E0, actor.seed])
        varied, pram = actor.variant > 0, actor.variant == PUSHES_PRAM
        pedestrian = actor.kind == "pedestrian"
        figure = people.pedestrian(rng, varied, pram) if pedestrian else people.cyclist(rng, varied)
        scale = actor.size_lhw[1] / 1.75
        soup = placed(figure, (0, 0, 0), 0.0, (scale, scale, scale))
    else:
        soup = placed(vehicles.vehicle(actor, distance_m < _FINE_M), (0, 0, 0), 0.0, actor.size_lhw)
    return replace(tagged(soup, _SEMANTIC[actor.label]), owner=np.full(len(soup), owner, np.int32))
