# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: E501, UP018, RUF046, SIM102 - the line above; Warp needs int(0) to declare what a loop changes, and
# evaluates both sides of `and`, so that a cheap test first saves time only as an `if` of its own.
"""Edge collapses in the order of their quadric error (Garland and Heckbert 1997), as one serial Warp kernel.

The order matters, so one thread does one mesh; other meshes may be done by other threads at the same time, since
kernels release the interpreter's lock. Always on the CPU.

Shapes: P points, F faces. A corner is `3 face + k`; the corners around a point are a linked list that starts at
`first[point]`, goes on at `after[corner]` and ends with -1; corners of dead faces may remain in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scene_ir.raster.launch import launch, start_warp

start_warp()
wp.set_module_options({"fuse_fp": False, "fast_math": False, "enable_backward": False})

MIN_COSINE = wp.constant(wp.float64(0.1))
"""A face may turn by no more than this allows (cosine between old and new normal) in one collapse."""
REGULAR = wp.constant(wp.float64(1e-3))
"""Quadrics whose determinant is smaller, against that of a round one of the same trace, have no one best point."""
LENGTH = wp.constant(wp.float64(1e-9))
"""A trace of the edge's squared length orders the collapses within flat regions."""
FLAT = wp.constant(wp.float64(1e-12))
"""Twice the area below which a face counts as degenerate: it has no direction to keep."""
HALF = wp.constant(wp.float64(0.5))


@wp.struct
class Candidate:
    """An edge that may collapse; outdated once a point of it has changed since `stamp`."""

    cost: wp.float64
    a: int
    b: int
    stamp: int


@wp.func
def earlier(left: Candidate, right: Candidate):
    """Cheaper first; equal costs in the order of their points, so that the heap's layout does not matter."""
    if left.cost != right.cost:
        return left.cost < right.cost
    if left.a != right.a:
        return left.a < right.a
    return left.b < right.b


@wp.func
def rise(heap: wp.array(dtype=Candidate), at: int):
    """Move the entry `at` up to its place."""
    i = int(at)
    moving = heap[at]
    while i > 0:
        parent = (i - 1) // 2
        if not earlier(moving, heap[parent]):
            break
        heap[i] = heap[parent]
        i = parent
    heap[i] = moving


@wp.func
def sink(heap: wp.array(dtype=Candidate), at: int, size: int):
    """Move the entry `at` down to its place."""
    i = int(at)
    moving = heap[at]
    while 2 * i + 1 < size:
        child = 2 * i + 1
        if child + 1 < size:
            if earlier(heap[child + 1], heap[child]):
                child = child + 1
        if not earlier(heap[child], moving):
            break
        heap[i] = heap[child]
        i = child
    heap[i] = moving


@wp.func
def error(matrix: wp.mat33d, vector: wp.vec3d, constant: wp.float64, point: wp.vec3d):
    """Weighted sum of squared distances between a point and a quadric's planes."""
    return wp.dot(point, matrix * point) + wp.float64(2.0) * wp.dot(vector, point) + constant


@wp.struct
class Points:
    """Per point: place; the quadric x.A x + 2 b.x + c; bounds the point must stay on: bit k of `pins`
    for low[k], bit k + 3 for high[k]; whether it lies at an open border; how often it changed; a mark for walks."""

    place: wp.array(dtype=wp.vec3d)
    matrix: wp.array(dtype=wp.mat33d)
    vector: wp.array(dtype=wp.vec3d)
    constant: wp.array(dtype=wp.float64)
    pins: wp.array(dtype=int)
    border: wp.array(dtype=int)
    stamp: wp.array(dtype=int)
    mark: wp.array(dtype=int)
    low: wp.vec3d
    high: wp.vec3d


@wp.struct
class Faces:
    """corners, labels (F, 3); alive (F,); first (P,), after (3 F,): the lists of the corners around points."""

    corners: wp.array2d(dtype=int)
    labels: wp.array2d(dtype=int)
    alive: wp.array(dtype=int)
    first: wp.array(dtype=int)
    after: wp.array(dtype=int)


@wp.func
def add_plane(points: Points, p: int, normal: wp.vec3d, offset: wp.float64, weight: wp.float64):
    points.matrix[p] = points.matrix[p] + weight * wp.outer(normal, normal)
    points.vector[p] = points.vector[p] + weight * offset * normal
    points.constant[p] = points.constant[p] + weight * offset * offset


@wp.func
def within(points: Points, point: wp.vec3d, pins: int):
    """The point moved into the bounds, and onto those that it is pinned to."""
    moved = wp.max(points.low, wp.min(points.high, point))
    for k in range(3):
        if (pins >> k) % 2 == 1:
            moved[k] = points.low[k]
        if (pins >> (k + 3)) % 2 == 1:
            moved[k] = points.high[k]
    return moved


@wp.func
def merged(points: Points, p: int, q: int):
    """The point of least error that may replace two, and its error."""
    matrix = points.matrix[p] + points.matrix[q]
    vector = points.vector[p] + points.vector[q]
    constant = points.constant[p] + points.constant[q]
    pins = points.pins[p] | points.pins[q]
    a = within(points, points.place[p], pins)
    b = within(points, points.place[q], pins)
    middle = HALF * (a + b)
    best = a
    least = error(matrix, vector, constant, a)
    other = error(matrix, vector, constant, b)
    if other < least:
        least = other
        best = b
    other = error(matrix, vector, constant, middle)
    if other < least:
        least = other
        best = middle
    mean = wp.trace(matrix) / wp.float64(3.0)
    if wp.determinant(matrix) > REGULAR * mean * mean * mean:
        free = within(points, -(wp.inverse(matrix) * vector), pins)
        # far from the edge the planes are no longer those of the surface
        if wp.length_sq(free - middle) <= wp.length_sq(points.place[p] - points.place[q]):
            other = error(matrix, vector, constant, free)
            if other < least:
                least = other
                best = free
    return wp.vec4d(best[0], best[1], best[2], least)


@wp.func
def push(points: Points, heap: wp.array(dtype=Candidate), size: int, p: int, q: int):
    """Put an edge on the heap; returns its new size."""
    entry = Candidate()
    entry.a = wp.min(p, q)
    entry.b = wp.max(p, q)
    spot = merged(points, entry.a, entry.b)
    length = wp.length_sq(points.place[p] - points.place[q])
    entry.cost = spot[3] + LENGTH * length
    entry.stamp = points.stamp[p] + points.stamp[q]
    heap[size] = entry
    rise(heap, size)
    return size + 1


@wp.func
def valid(candidate: Candidate, points: Points):
    return candidate.stamp == points.stamp[candidate.a] + points.stamp[candidate.b]


@wp.func
def along(faces: Faces, face: int, corner: int, step: int):
    """The point `step` corners after `corner` in its face."""
    return faces.corners[face, (corner - 3 * face + step) % 3]


@wp.func
def faces_at_edge(a: int, b: int, faces: Faces, but: int):
    """How many faces other than `but` contain the edge, and the last of them."""
    count = int(0)
    found = int(-1)
    c = int(faces.first[a])
    while c >= 0:
        f = c // 3
        if f != but:
            if along(faces, f, c, 1) == b or along(faces, f, c, 2) == b:
                count += 1
                found = f
        c = faces.after[c]
    return wp.vec2i(count, found)


@wp.func
def label_at(point: int, face: int, faces: Faces):
    for k in range(3):
        if faces.corners[face, k] == point:
            return faces.labels[face, k]
    return -1


@wp.func
def linked(a: int, b: int, points: Points, faces: Faces, tick: int):
    """Whether the surface stays what it is, topologically, when the edge collapses (link condition)."""
    shared = int(0)
    x0 = int(-1)
    x1 = int(-1)
    c = int(faces.first[a])
    while c >= 0:
        f = c // 3
        if faces.alive[f] == 1:
            u = along(faces, f, c, 1)
            w = along(faces, f, c, 2)
            points.mark[u] = tick
            points.mark[w] = tick
            if u == b or w == b:
                shared += 1
                x1 = x0
                x0 = u + w - b
        c = faces.after[c]
    if shared == 0 or shared > 2 or x0 == x1:
        return False
    if shared == 2 and points.border[a] == 1 and points.border[b] == 1:
        return False
    common = int(0)
    closing = int(0)
    c = faces.first[b]
    while c >= 0:
        f = c // 3
        if faces.alive[f] == 1:
            u = along(faces, f, c, 1)
            w = along(faces, f, c, 2)
            if points.mark[u] == tick:
                points.mark[u] = tick + 1
                common += 1
            if points.mark[w] == tick:
                points.mark[w] = tick + 1
                common += 1
            if shared == 2 and wp.min(u, w) == wp.min(x0, x1) and wp.max(u, w) == wp.max(x0, x1):
                closing = 1
        c = faces.after[c]
    if common != shared:
        return False
    if closing == 1:
        # a tetrahedron would become two faces back to back
        c = faces.first[a]
        while c >= 0:
            f = c // 3
            if faces.alive[f] == 1:
                u = along(faces, f, c, 1)
                w = along(faces, f, c, 2)
                if wp.min(u, w) == wp.min(x0, x1) and wp.max(u, w) == wp.max(x0, x1):
                    return False
            c = faces.after[c]
    return True


@wp.func
def remaining(a: int, b: int, target: wp.vec3d, longest: wp.float64, points: Points, faces: Faces):
    """How many faces around a, without those of the edge to b, are left when a moves; -1 where one would turn over
    or get an edge that is too long (squared length)."""
    count = int(0)
    here = points.place[a]
    c = int(faces.first[a])
    while c >= 0:
        f = c // 3
        if faces.alive[f] == 1:
            u = along(faces, f, c, 1)
            w = along(faces, f, c, 2)
            if u != b and w != b:
                count += 1
                pu = points.place[u]
                pw = points.place[w]
                old = wp.cross(pu - here, pw - here)
                new = wp.cross(pu - target, pw - target)
                size = wp.length(old)
                if size > FLAT:
                    if wp.dot(old, new) <= MIN_COSINE * size * wp.length(new) or wp.length(new) <= FLAT:
                        return -1
                if wp.length_sq(pu - target) > wp.max(longest, wp.length_sq(pu - here)):
                    return -1
                if wp.length_sq(pw - target) > wp.max(longest, wp.length_sq(pw - here)):
                    return -1
        c = faces.after[c]
    return count


@wp.func
def add_faces(points: Points, faces: Faces):
    """Lists of the corners around points, and the quadrics of the faces' planes, weighted by area."""
    for f in range(faces.corners.shape[0]):
        origin = points.place[faces.corners[f, 0]]
        normal = wp.cross(points.place[faces.corners[f, 1]] - origin, points.place[faces.corners[f, 2]] - origin)
        area = HALF * wp.length(normal)
        normal = wp.normalize(normal)
        for k in range(3):
            p = faces.corners[f, k]
            faces.after[3 * f + k] = faces.first[p]
            faces.first[p] = 3 * f + k
            add_plane(points, p, normal, -wp.dot(normal, origin), area)


@wp.func
def add_seams(points: Points, faces: Faces, seam: wp.float64):
    """Quadrics of planes upright on the faces along borders and where labels change, weighted by length squared."""
    for f in range(faces.corners.shape[0]):
        origin = points.place[faces.corners[f, 0]]
        normal = wp.cross(points.place[faces.corners[f, 1]] - origin, points.place[faces.corners[f, 2]] - origin)
        normal = wp.normalize(normal)
        for k in range(3):
            a = faces.corners[f, k]
            b = faces.corners[f, (k + 1) % 3]
            others = faces_at_edge(a, b, faces, f)
            if others[0] == 0:
                points.border[a] = 1
                points.border[b] = 1
            same = others[0] == 1
            if same:
                same = label_at(a, others[1], faces) == faces.labels[f, k]
                if label_at(b, others[1], faces) != faces.labels[f, (k + 1) % 3]:
                    same = False
            if not same:
                across = wp.cross(points.place[b] - points.place[a], normal)
                weight = seam * wp.length_sq(across)
                across = wp.normalize(across)
                offset = -wp.dot(across, points.place[a])
                add_plane(points, a, across, offset, weight)
                add_plane(points, b, across, offset, weight)


@wp.func
def add_edges(points: Points, faces: Faces, heap: wp.array(dtype=Candidate)):
    """Put every edge on the empty heap, once; returns their number."""
    size = int(0)
    for f in range(faces.corners.shape[0]):
        for k in range(3):
            a = faces.corners[f, k]
            b = faces.corners[f, (k + 1) % 3]
            others = faces_at_edge(a, b, faces, f)
            # lists begin with the latest face: the last that was found is the earliest
            if others[0] == 0 or others[1] > f:
                size = push(points, heap, size, a, b)
    return size


@wp.func
def without_outdated(points: Points, heap: wp.array(dtype=Candidate), size: int):
    """Throw outdated entries off the heap; returns its new size."""
    kept = int(0)
    for i in range(size):
        if valid(heap[i], points):
            heap[kept] = heap[i]
            kept += 1
    for i in range(kept // 2):
        sink(heap, kept // 2 - 1 - i, kept)
    return kept


@wp.func
def spans(points: Points, a: int, b: int):
    """Whether the edge leads from one side of the bounds to the other, so that one would be lost."""
    pins = points.pins[a] | points.pins[b]
    for k in range(3):
        if (pins >> k) % 2 == 1 and (pins >> (k + 3)) % 2 == 1 and points.low[k] < points.high[k]:
            return True
    return False


@wp.func
def merge(points: Points, faces: Faces, a: int, b: int, target: wp.vec3d):
    """Replace b by a, at its new place; returns how many faces went."""
    # the edge's faces go; what they showed at b is what they showed at a
    gone = int(0)
    from0 = int(-1)
    from1 = int(-1)
    into0 = int(-1)
    into1 = int(-1)
    c = int(faces.first[b])
    while c >= 0:
        f = c // 3
        if faces.alive[f] == 1:
            if along(faces, f, c, 1) == a or along(faces, f, c, 2) == a:
                faces.alive[f] = 0
                gone += 1
                from1 = from0
                into1 = into0
                from0 = faces.labels[f, c - 3 * f]
                into0 = label_at(a, f, faces)
        c = faces.after[c]
    # the rest of b's corners become a's; those of dead faces leave the list
    chain = int(-1)
    for side in range(2):
        c = faces.first[a]
        if side == 1:
            c = faces.first[b]
        while c >= 0:
            following = faces.after[c]
            f = c // 3
            if faces.alive[f] == 1:
                if side == 1:
                    k = c - 3 * f
                    faces.corners[f, k] = a
                    if faces.labels[f, k] == from0:
                        faces.labels[f, k] = into0
                    elif faces.labels[f, k] == from1:
                        faces.labels[f, k] = into1
                faces.after[c] = chain
                chain = c
            c = following
    faces.first[a] = chain
    faces.first[b] = -1
    points.place[a] = target
    points.matrix[a] = points.matrix[a] + points.matrix[b]
    points.vector[a] = points.vector[a] + points.vector[b]
    points.constant[a] = points.constant[a] + points.constant[b]
    points.border[a] = wp.max(points.border[a], points.border[b])
    points.pins[a] = points.pins[a] | points.pins[b]
    points.stamp[a] = points.stamp[a] + 1
    points.stamp[b] = points.stamp[b] + 1
    return gone


@wp.kernel
def collapse_kernel(
    start: int,
    triangles: int,
    longest: wp.float64,
    seam: wp.float64,
    points: Points,
    faces: Faces,
    heap: wp.array(dtype=Candidate),
):
    add_faces(points, faces)
    add_seams(points, faces, seam)
    size = int(add_edges(points, faces, heap))
    left = int(faces.corners.shape[0])
    tick = int(0)
    while left > triangles and size > 0:
        top = heap[0]
        size -= 1
        if size > 0:
            heap[0] = heap[size]
            sink(heap, 0, size)
        if not valid(top, points):
            continue
        a = int(top.a)
        b = int(top.b)
        tick += 2
        if spans(points, a, b) or not linked(a, b, points, faces, tick):
            continue
        spot = merged(points, a, b)
        target = wp.vec3d(spot[0], spot[1], spot[2])
        count_a = remaining(a, b, target, longest, points, faces)
        if count_a < 0:
            continue
        count_b = remaining(b, a, target, longest, points, faces)
        if count_b < 0 or count_a + count_b == 0:
            continue
        if wp.length_sq(target - points.place[b]) < wp.length_sq(target - points.place[a]):
            # the nearer point gives its labels
            a = top.b
            b = top.a
        left -= merge(points, faces, a, b, target)
        tick += 2
        c = int(faces.first[a])
        while c >= 0:
            for step in range(1, 3):
                u = along(faces, c // 3, c, step)
                if points.mark[u] != tick:
                    points.mark[u] = tick
                    if size == heap.shape[0]:
                        size = without_outdated(points, heap, size)
                    size = push(points, heap, size, a, u)
            c = faces.after[c]


@dataclass(frozen=True, slots=True)
class Collapsed:
    """points (P, 3) float64, moved; faces, labels (F', 3) int32 and kept (F',) int64: the faces that are left."""

    points: NDArray[np.float64]
    faces: NDArray[np.int32]
    labels: NDArray[np.int32]
    kept: NDArray[np.int64]


def collapse(
    points: NDArray[np.float64],
    faces: NDArray[np.integer],
    labels: NDArray[np.integer],
    bounds: NDArray[np.float64],
    triangles: int,
    longest: float,
    seam: float,
) -> Collapsed:
    """Collapse edges until at most `triangles` faces are left or no edge may go.

    points (P, 3); faces (F, 3), of three different points each; labels (F, 3): what each corner looks like; bounds
    (2, 3): low and high, of the faces; nothing leaves them, and what touches them goes on to. longest: no edge longer
    than this is made, inf for any; seam: weight of the planes that hold edges where labels change in place, against
    the faces' own planes.
    """
    count, total = len(points), len(faces)
    place = np.array(points, dtype=np.float64)
    low, high = bounds

    def floats(dtype: Any) -> Any:
        return wp.zeros(count, dtype=dtype, device="cpu")

    state = Points()
    state.place = _shared(place, wp.vec3d)
    state.matrix, state.vector = floats(wp.mat33d), floats(wp.vec3d)
    state.constant = floats(wp.float64)
    pins = (place == low) @ np.array([1, 2, 4]) + (place == high) @ np.array([8, 16, 32])
    state.pins = _shared(pins.astype(np.int32), int)
    state.border, state.stamp, state.mark = floats(int), floats(int), floats(int)
    state.low, state.high = wp.vec3d(*low), wp.vec3d(*high)
    corners, looks = np.array(faces, dtype=np.int32), np.array(labels, dtype=np.int32)
    alive = np.ones(total, dtype=np.int32)
    surface = Faces()
    surface.corners, surface.labels = _shared(corners, int), _shared(looks, int)
    surface.alive = _shared(alive, int)
    surface.first = wp.full(count, -1, dtype=int, device="cpu")
    surface.after = wp.empty(3 * total, dtype=int, device="cpu")
    # all edges, at most 3 F, and as much again before outdated ones are thrown out
    heap = wp.empty(6 * total, dtype=Candidate, device="cpu")
    launch(collapse_kernel, [0, 1], [triangles, longest**2, seam, state, surface, heap])
    kept = np.flatnonzero(alive)
    return Collapsed(place, corners[kept], looks[kept], kept)


def _shared(values: NDArray[Any], dtype: Any) -> Any:
    """A Warp array of the same memory."""
    return wp.array(values, dtype=dtype, device="cpu", copy=False)
