# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportReturnType=false
# ruff: noqa: UP018, RUF046, SIM102 - the line above; Warp needs int(0) to declare what a loop changes, and evaluates
# both sides of `and`, so that a cheap test first saves time only as an `if` of its own.
"""What is done to triangles one by one, as Warp kernels: cutting, smoothing, bending; leaves around a crown."""

from __future__ import annotations

import numpy as np
import warp as wp

from scene_ir.raster.launch import launch, start_warp
from scene_ir.raster.simd import SIMD_OPTIONS
from scene_ir.types import LATTICE, LATTICE_POINTS

start_warp()
wp.set_module_options(SIMD_OPTIONS)

Floats = wp.array(dtype=wp.float32)
Ints = wp.array(dtype=wp.int32)
Vec3s = wp.array(dtype=wp.vec3f)
Vec4s = wp.array(dtype=wp.vec4f)
Mat33s = wp.array(dtype=wp.mat33f)

SLIVER_M = wp.constant(wp.float32(1e-4))
"""A tenth of a millimetre: thinner slivers are not worth a triangle."""
NOTHING = wp.constant(wp.float32(1e-6))
"""Share of a face below which a piece of it is dropped."""
DEEP, WIDE = wp.constant(LATTICE[1] * LATTICE[2]), wp.constant(LATTICE[2])
assert LATTICE == (4, 4, 4)


@wp.kernel
def cut_kernel(
    start: int, corners: Vec3s, parent: Ints, whole: Vec3s, planes: Vec4s, room: int, slots: Vec3s, counts: Ints
):
    """One triangle of a face, cut by every plane. room: triangles in the slots of each; a larger count means that they
    did not suffice."""
    i = start + wp.tid()
    base = 3 * i * room
    for j in range(3):
        slots[base + j] = whole[3 * i + j]
    face = 3 * parent[i]
    count = int(1)
    for p in range(planes.shape[0]):
        plane = planes[p]
        normal = wp.vec3f(plane[0], plane[1], plane[2])
        reach = wp.vec3f(
            wp.dot(corners[face], normal) - plane[3],
            wp.dot(corners[face + 1], normal) - plane[3],
            wp.dot(corners[face + 2], normal) - plane[3],
        )
        if wp.max(reach) > SLIVER_M:
            if wp.min(reach) < -SLIVER_M:
                until = wp.min(count, room)
                for t in range(until):
                    at = base + 3 * t
                    side = wp.vec3f(
                        wp.dot(slots[at], reach), wp.dot(slots[at + 1], reach), wp.dot(slots[at + 2], reach)
                    )
                    if wp.max(side) > SLIVER_M:
                        if wp.min(side) < -SLIVER_M:
                            up = wp.vec3i(int(side[0] > 0.0), int(side[1] > 0.0), int(side[2] > 0.0))
                            alone = wp.where(up[0] + up[1] + up[2] == 1, 1, 0)
                            k = wp.where(up[0] == alone, 0, wp.where(up[1] == alone, 1, 2))
                            k1 = wp.where(k == 2, 0, k + 1)
                            k2 = wp.where(k == 0, 2, k - 1)
                            a = slots[at + k]
                            b = slots[at + k1]
                            c = slots[at + k2]
                            one = a + (side[k] / (side[k] - side[k1])) * (b - a)
                            two = a + (side[k] / (side[k] - side[k2])) * (c - a)
                            slots[at] = a
                            slots[at + 1] = one
                            slots[at + 2] = two
                            if count + 2 <= room:
                                more = base + 3 * count
                                slots[more] = one
                                slots[more + 1] = b
                                slots[more + 2] = c
                                slots[more + 3] = one
                                slots[more + 4] = c
                                slots[more + 5] = two
                            count += 2
    if count <= room:
        rows = int(0)
        for t in range(count):
            at = base + 3 * t
            if wp.abs(wp.dot(slots[at], wp.cross(slots[at + 1], slots[at + 2]))) > NOTHING:
                to = base + 3 * rows
                for j in range(3):
                    slots[to + j] = slots[at + j]
                rows += 1
        count = rows
    counts[i] = count


@wp.kernel
def flat_kernel(start: int, corners: Vec3s, flat: Vec3s, unit: Vec3s):
    """Normals of the faces: as long as twice their area, and of length 1."""
    i = start + wp.tid()
    a = corners[3 * i]
    normal = wp.cross(corners[3 * i + 1] - a, corners[3 * i + 2] - a)
    flat[i] = normal
    unit[i] = normal / wp.max(wp.length(normal), 1e-12)


@wp.kernel
def crease_kernel(
    start: int, point: Ints, starts: Ints, order: Ints, flat: Vec3s, unit: Vec3s, least: float, normals: Vec3s
):
    """The mean normal of the faces that meet at one corner at less than the crease angle; least: its cosine."""
    i = start + wp.tid()
    own = unit[i // 3]
    total = wp.vec3f()
    for k in range(starts[point[i]], starts[point[i] + 1]):
        other = order[k] // 3
        if wp.dot(own, unit[other]) > least:
            total += flat[other]
    normals[i] = total / wp.max(wp.length(total), 1e-12)


@wp.func
def cubic(t: float):
    """Bernstein polynomials of degree 3."""
    s = 1.0 - t
    return wp.vec4f(s * s * s, 3.0 * t * s * s, 3.0 * t * t * s, t * t * t)


@wp.func
def cubic_slope(t: float):
    """Their derivatives."""
    s = 1.0 - t
    return wp.vec4f(-3.0 * s * s, 3.0 * s * s - 6.0 * t * s, 6.0 * t * s - 3.0 * t * t, 3.0 * t * t)


@wp.kernel
def bend_kernel(start: int, points: Vec3s, lattice: Vec3s, moved: Vec3s, cofactors: Mat33s):
    """One vertex of the unit box after the free-form deformation, and the cofactors of its Jacobian."""
    i = start + wp.tid()
    p = points[i]
    bx = cubic(p[0] + 0.5)
    by = cubic(p[1] + 1.0)
    bz = cubic(p[2] + 0.5)
    sx = cubic_slope(p[0] + 0.5)
    sy = cubic_slope(p[1] + 1.0)
    sz = cubic_slope(p[2] + 0.5)
    offset = wp.vec3f()
    dx = wp.vec3f(1.0, 0.0, 0.0)
    dy = wp.vec3f(0.0, 1.0, 0.0)
    dz = wp.vec3f(0.0, 0.0, 1.0)
    for j in range(4):
        across = wp.vec3f()
        down = wp.vec3f()
        aside = wp.vec3f()
        for k in range(4):
            at = j * DEEP + k * WIDE
            value = (
                lattice[at] * bz[0] + lattice[at + 1] * bz[1] + lattice[at + 2] * bz[2] + lattice[at + 3] * bz[3]
            )
            slope = (
                lattice[at] * sz[0] + lattice[at + 1] * sz[1] + lattice[at + 2] * sz[2] + lattice[at + 3] * sz[3]
            )
            across += value * by[k]
            down += value * sy[k]
            aside += slope * by[k]
        offset += across * bx[j]
        dx += across * sx[j]
        dy += down * bx[j]
        dz += aside * bx[j]
    moved[i] = p + offset
    one = wp.cross(dy, dz)
    two = wp.cross(dz, dx)
    three = wp.cross(dx, dy)
    cofactors[i] = wp.mat33f(one[0], two[0], three[0], one[1], two[1], three[1], one[2], two[2], three[2])


@wp.kernel
def piece_kernel(
    start: int,
    faces: Ints,
    normals: Vec3s,
    parent: Ints,
    share: Vec3s,
    moved: Vec3s,
    cofactors: Mat33s,
    corners: Vec3s,
    turned: Vec3s,
):
    """Corners and normals of one piece of a bent face."""
    i = start + wp.tid()
    face = 3 * parent[i]
    a = faces[face]
    b = faces[face + 1]
    c = faces[face + 2]
    na = cofactors[a] * normals[face]
    nb = cofactors[b] * normals[face + 1]
    nc = cofactors[c] * normals[face + 2]
    for j in range(3):
        w = share[3 * i + j]
        corners[3 * i + j] = moved[a] * w[0] + moved[b] * w[1] + moved[c] * w[2]
        turned[3 * i + j] = na * w[0] + nb * w[1] + nc * w[2]


@wp.kernel
def crown_kernel(
    start: int,
    centres: Vec3s,
    radii: Vec3s,
    frame: Vec3s,
    blob: Ints,
    direction: Vec3s,
    depth: Floats,
    points: Vec3s,
    outward: Vec3s,
    light: Floats,
):
    """One leaf's place, direction and light; a light below 0 where it lies deep inside a blob. frame: the crown's
    middle and size."""
    i = start + wp.tid()
    to = wp.normalize(direction[i])
    b = blob[i]
    point = centres[b] + wp.cw_mul(to, radii[b]) * depth[i]
    points[i] = point
    light[i] = -1.0
    for k in range(centres.shape[0]):
        off = wp.cw_div(point - centres[k], radii[k])
        if wp.dot(off, off) < 0.6:
            return
    own = wp.normalize(wp.cw_div(to, radii[b]))
    whole = wp.normalize(wp.cw_div(point - frame[0], frame[1]))
    outward[i] = wp.normalize(own * 0.6 + whole * 0.4)
    bright = (0.75 + 0.5 * (depth[i] - 0.8) / 0.3) * (0.92 - 0.2 * own[1]) * (0.95 - 0.2 * whole[1])
    light[i] = wp.clamp(bright, 0.4, 1.5)


@wp.kernel
def leaf_kernel(
    start: int,
    points: Vec3s,
    outward: Vec3s,
    jitter: Vec3s,
    spin: Vec3s,
    reach: Floats,
    corners: Vec3s,
    normals: Vec3s,
):
    """One slender triangle, lit half as the surface that it stands on."""
    i = start + wp.tid()
    facing = wp.normalize(outward[i] + jitter[i] * 0.55)
    one = wp.normalize(wp.cross(facing, spin[i]))
    two = wp.cross(facing, one)
    at = points[i]
    corners[3 * i] = at + one * reach[i]
    corners[3 * i + 1] = at + (two * 0.45 - one * 0.6) * reach[i]
    corners[3 * i + 2] = at - (one + two) * (0.45 * reach[i])
    shade = wp.normalize(outward[i] * 0.85 + facing * 0.35)
    for j in range(3):
        normals[3 * i + j] = shade


def _vectors(values: np.ndarray) -> wp.array:
    return wp.array(
        np.ascontiguousarray(values, np.float32).reshape(-1, 3), dtype=wp.vec3f, copy=False, device="cpu"
    )


def _indices(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.int32).reshape(-1), dtype=wp.int32, copy=False, device="cpu")


def cut(
    corners: np.ndarray, parent: np.ndarray, share: np.ndarray, planes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that lie in faces, cut in two or three wherever they cross a plane.

    corners (F, 3, 3) m: of the faces; parent (n,): each triangle's face; share (n, 3, 3) float32: barycentric
    coordinates of its corners in it; planes (P, 4): normal and offset. Returns the triangle (k,) int64 that each
    piece comes from, in ascending order, and its corners (k, 3, 3) float32, as `share`.
    """
    room, count = 8 + 8 * len(planes), len(parent)
    edges = wp.array(np.ascontiguousarray(planes, np.float32), dtype=wp.vec4f, copy=False, device="cpu")
    inputs = [_vectors(corners), _indices(parent), _vectors(share), edges]
    while True:
        slots, counts = np.empty((count * room, 3, 3), np.float32), np.empty(count, np.int32)
        launch(cut_kernel, [0, count], [*inputs, room, _vectors(slots), _indices(counts)])
        if not count or counts.max() <= room:
            break
        room *= 2
    source = np.repeat(np.arange(count), counts)
    first = np.arange(count) * room - np.cumsum(counts) + counts
    return source, slots[np.arange(len(source)) + first[source]]


def creased_normals(vertices: np.ndarray, faces: np.ndarray, crease_rad: float = 0.65) -> np.ndarray:
    """`soup.creased_normals` of an indexed mesh: vertices (V, 3) m, faces (F, 3) -> (F, 3, 3) float32."""
    # vertices are split between materials: those at one place, to half a millimetre, are one point
    grid = np.rint(vertices * 2000).astype(np.int64) + 2**19
    key = (grid[:, 0] << 40) | (grid[:, 1] << 20) | grid[:, 2]
    rank = np.argsort(key)
    ranked = key[rank]
    point = np.empty(len(key), np.int64)
    point[rank] = np.cumsum(np.concatenate([[False], ranked[1:] != ranked[:-1]]))
    # numbers of 16 bits are sorted in linear time
    at = point[faces].reshape(-1).astype(np.uint16 if len(key) <= 2**16 else np.int64)
    starts = np.concatenate([[0], np.cumsum(np.bincount(at))])
    order = np.argsort(at, kind="stable")
    corners = _vectors(vertices[faces])
    flat, unit, normals = (np.empty((n, 3), np.float32) for n in (len(faces), len(faces), 3 * len(faces)))
    launch(flat_kernel, [0, len(faces)], [corners, _vectors(flat), _vectors(unit)])
    inputs = [_indices(at), _indices(starts), _indices(order), _vectors(flat), _vectors(unit)]
    launch(crease_kernel, [0, len(at)], [*inputs, float(np.cos(crease_rad)), _vectors(normals)])
    return normals.reshape(-1, 3, 3)


def bent(
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray], pieces: tuple[np.ndarray, np.ndarray], lattice: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Corners and normals (n, 3, 3) float32 of pieces of a mesh's faces after a free-form deformation.

    mesh: vertices (V, 3) in the unit box, faces (F, 3), normals (F, 3, 3) of their corners; pieces: parent (n,)
    and share (n, 3, 3), as for `cut`; lattice (64, 3): offsets. Normals turn with the cofactors of the Jacobian.
    """
    vertices, faces, normals = mesh
    parent, share = pieces
    assert lattice.shape == (LATTICE_POINTS, 3)
    moved, cofactors = np.empty_like(vertices, np.float32), np.empty((len(vertices), 3, 3), np.float32)
    table = wp.array(cofactors, dtype=wp.mat33f, copy=False, device="cpu")
    launch(bend_kernel, [0, len(vertices)], [_vectors(vertices), _vectors(lattice), _vectors(moved), table])
    corners, turned = np.empty((2, len(parent), 3, 3), np.float32)
    inputs = [_indices(faces), _vectors(normals), _indices(parent), _vectors(share), _vectors(moved), table]
    launch(piece_kernel, [0, len(parent)], [*inputs, _vectors(corners), _vectors(turned)])
    return corners, turned


def crown(
    blobs: tuple[np.ndarray, np.ndarray], blob: np.ndarray, direction: np.ndarray, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Leaves around blobs (centres and radii, (k, 3)): those that stay (m,) of n, by index, their places and outward
    directions (m, 3) and the light they get (m,), float32.

    blob (n,): on which each grows; direction (n, 3): to which side, of any length; depth (n,): in its radii.
    """
    centres, radii = blobs
    low, high = (centres - radii).min(axis=0), (centres + radii).max(axis=0)
    frame = np.stack([(low + high) / 2, high - low])
    points, outward = np.empty((2, len(blob), 3), np.float32)
    light, depth = np.empty(len(blob), np.float32), np.ascontiguousarray(depth, np.float32)
    inputs = [_vectors(v) for v in (centres, radii, frame)]
    inputs += [_indices(blob), _vectors(direction), wp.array(depth, dtype=wp.float32, copy=False, device="cpu")]
    outputs = [_vectors(points), _vectors(outward), wp.array(light, dtype=wp.float32, copy=False, device="cpu")]
    launch(crown_kernel, [0, len(blob)], [*inputs, *outputs])
    rows = np.flatnonzero(light >= 0)
    return rows, points[rows], outward[rows], light[rows]


def leaves(
    points: np.ndarray, outward: np.ndarray, draws: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Corners and normals (n, 3, 3) float32 of a slender triangle at each point (n, 3) of a surface with normals
    `outward`. draws: normal deviates (n, 3) of its normal and its turn, and its reach (n,) m.
    """
    corners, normals = np.empty((2, len(points), 3, 3), np.float32)
    reach = wp.array(np.ascontiguousarray(draws[2], np.float32), dtype=wp.float32, copy=False, device="cpu")
    inputs = [_vectors(v) for v in (points, outward, draws[0], draws[1])]
    launch(leaf_kernel, [0, len(points)], [*inputs, reach, _vectors(corners), _vectors(normals)])
    return corners, normals
