# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: E501, UP018, RUF046, SIM102, SIM110 - the line above; Warp needs int(0) to declare what a loop changes, and
# evaluates both sides of `and`, so that a cheap test first saves time only as an `if` of its own.
"""Edge collapses in order of their quadric error (Garland and Heckbert 1997), as one serial Warp kernel.

The order matters, so one thread collapses one mesh; other threads may do other meshes at the same time, since kernels
release the interpreter's lock. Always on the CPU.

P points, F faces. A corner is `3 face + k`; the corners around a point are a linked list that starts at `first[point]`,
continues at `after[corner]` and ends with -1; it may contain corners of dead faces.
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
"""Least cosine between the old and new normal of a face in one collapse."""
REGULAR = wp.constant(wp.float64(1e-3))
"""Quadrics with a smaller determinant, relative to a round one of the same trace, have no unique best point."""
LENGTH = wp.constant(wp.float64(1e-9))
"""Weight of the edge's squared length, which orders collapses within flat regions."""
FLAT = wp.constant(wp.float64(1e-12))
"""Twice the area below which a face is degenerate and has no normal."""
HALF = wp.constant(wp.float64(0.5))


@wp.struct
class Candidate:
    """An edge that may collapse; outdated once one of its points has changed since `stamp`."""

    cost: wp.float64
    a: int
    b: int
    stamp: int


@wp.func
def _is_cheaper(left: Candidate, right: Candidate):
    """Compare costs, then points, so that the result does not depend on the layout of the heap."""
    if left.cost != right.cost:
        return left.cost < right.cost
    if left.a != right.a:
        return left.a < right.a
    return left.b < right.b


@wp.func
def _sift_up(heap: wp.array(dtype=Candidate), at: int):
    """Move the entry `at` up to its place."""
    i = int(at)
    moving = heap[at]
    while i > 0:
        parent = (i - 1) // 2
        if not _is_cheaper(moving, heap[parent]):
            break
        heap[i] = heap[parent]
        i = parent
    heap[i] = moving


@wp.func
def _sift_down(heap: wp.array(dtype=Candidate), at: int, size: int):
    """Move the entry `at` down to its place."""
    i = int(at)
    moving = heap[at]
    while 2 * i + 1 < size:
        child = 2 * i + 1
        if child + 1 < size:
            if _is_cheaper(heap[child + 1], heap[child]):
                child = child + 1
        if not _is_cheaper(heap[child], moving):
            break
        heap[i] = heap[child]
        i = child
    heap[i] = moving


@wp.func
def _quadric_error(matrix: wp.mat33d, vector: wp.vec3d, constant: wp.float64, point: wp.vec3d):
    """Weighted sum of squared distances between a point and a quadric's planes."""
    return wp.dot(point, matrix * point) + wp.float64(2.0) * wp.dot(vector, point) + constant


@wp.struct
class Points:
    """Per point: position; the quadric x.A x + 2 b.x + c; bounds that it must stay on, bit k of `pins` for low[k] and bit
    k + 3 for high[k]; whether it is on an open border; number of changes; a mark for traversals.
    """

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
    """corners, labels (F, 3); alive (F,); first (P,), after (3 F,): lists of the corners around points."""

    corners: wp.array2d(dtype=int)
    labels: wp.array2d(dtype=int)
    alive: wp.array(dtype=int)
    first: wp.array(dtype=int)
    after: wp.array(dtype=int)


@wp.func
def _add_plane(points: Points, p: int, normal: wp.vec3d, offset: wp.float64, weight: wp.float64):
    points.matrix[p] = points.matrix[p] + weight * wp.outer(normal, normal)
    points.vector[p] = points.vector[p] + weight * offset * normal
    points.constant[p] = points.constant[p] + weight * offset * offset


@wp.func
def _clamp_to_bounds(points: Points, point: wp.vec3d, pins: int):
    """The point moved into the bounds, and onto those that it is pinned to."""
    moved = wp.max(points.low, wp.min(points.high, point))
    for k in range(3):
        if (pins >> k) % 2 == 1:
            moved[k] = points.low[k]
        if (pins >> (k + 3)) % 2 == 1:
            moved[k] = points.high[k]
    return moved


@wp.func
def _best_merge(points: Points, p: int, q: int):
    """The point of least error that may replace two points, and its error."""
    matrix = points.matrix[p] + points.matrix[q]
    vector = points.vector[p] + points.vector[q]
    constant = points.constant[p] + points.constant[q]
    pins = points.pins[p] | points.pins[q]
    a = _clamp_to_bounds(points, points.place[p], pins)
    b = _clamp_to_bounds(points, points.place[q], pins)
    middle = HALF * (a + b)
    best = a
    least = _quadric_error(matrix, vector, constant, a)
    other = _quadric_error(matrix, vector, constant, b)
    if other < least:
        least = other
        best = b
    other = _quadric_error(matrix, vector, constant, middle)
    if other < least:
        least = other
        best = middle
    mean = wp.trace(matrix) / wp.float64(3.0)
    if wp.determinant(matrix) > REGULAR * mean * mean * mean:
        free = _clamp_to_bounds(points, -(wp.inverse(matrix) * vector), pins)
        # far from the edge the planes are no longer those of the surface
        if wp.length_sq(free - middle) <= wp.length_sq(points.place[p] - points.place[q]):
            other = _quadric_error(matrix, vector, constant, free)
            if other < least:
                least = other
                best = free
    return wp.vec4d(best[0], best[1], best[2], least)


@wp.func
def _push_edge(points: Points, heap: wp.array(dtype=Candidate), size: int, p: int, q: int):
    """Push an edge on the heap and return its new size."""
    entry = Candidate()
    entry.a = wp.min(p, q)
    entry.b = wp.max(p, q)
    spot = _best_merge(points, entry.a, entry.b)
    length = wp.length_sq(points.place[p] - points.place[q])
    entry.cost = spot[3] + LENGTH * length
    entry.stamp = points.stamp[p] + points.stamp[q]
    heap[size] = entry
    _sift_up(heap, size)
    return size + 1


@wp.func
def _is_current(candidate: Candidate, points: Points):
    return candidate.stamp == points.stamp[candidate.a] + points.stamp[candidate.b]


@wp.func
def _next_point(faces: Faces, face: int, corner: int, step: int):
    """The point `step` corners after `corner` in its face."""
    return faces.corners[face, (corner - 3 * face + step) % 3]


@wp.func
def _faces_at_edge(a: int, b: int, faces: Faces, but: int):
    """Number of faces other than `but` with the edge, and the last of them."""
    count = int(0)
    found = int(-1)
    c = int(faces.first[a])
    while c >= 0:
        f = c // 3
        if f != but:
            if _next_point(faces, f, c, 1) == b or _next_point(faces, f, c, 2) == b:
                count += 1
                found = f
        c = faces.after[c]
    return wp.vec2i(count, found)


@wp.func
def _label_at(point: int, face: int, faces: Faces):
    for k in range(3):
        if faces.corners[face, k] == point:
            return faces.labels[face, k]
    return -1


@wp.func
def _satisfies_link(a: int, b: int, points: Points, faces: Faces, tick: int):
    """Whether collapsing the edge preserves the topology (link condition)."""
    shared = int(0)
    x0 = int(-1)
    x1 = int(-1)
    c = int(faces.first[a])
    while c >= 0:
        f = c // 3
        if faces.alive[f] == 1:
            u = _next_point(faces, f, c, 1)
            w = _next_point(faces, f, c, 2)
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
            u = _next_point(faces, f, c, 1)
            w = _next_point(faces, f, c, 2)
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
                u = _next_point(faces, f, c, 1)
                w = _next_point(faces, f, c, 2)
                if wp.min(u, w) == wp.min(x0, x1) and wp.max(u, w) == wp.max(x0, x1):
                    return False
            c = faces.after[c]
    return True


@wp.func
def _count_remaining(a: int, b: int, target: wp.vec3d, longest: wp.float64, points: Points, faces: Faces):
    """Number of faces around a, except those at the edge to b, after a moves; -1 if one would flip or get an edge longer
    than `longest` (squared).
    """
    count = int(0)
    here = points.place[a]
    c = int(faces.first[a])
    while c >= 0:
        f = c // 3
        if faces.alive[f] == 1:
            u = _next_point(faces, f, c, 1)
            w = _next_point(faces, f, c, 2)
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
def _add_faces(points: Points, faces: Faces):
    """Build the corner lists, and add the quadrics of the faces' planes, weighted by area."""
    for f in range(faces.corners.shape[0]):
        origin = points.place[faces.corners[f, 0]]
        normal = wp.cross(points.place[faces.corners[f, 1]] - origin, points.place[faces.corners[f, 2]] - origin)
        area = HALF * wp.length(normal)
        normal = wp.normalize(normal)
        for k in range(3):
            p = faces.corners[f, k]
            faces.after[3 * f + k] = faces.first[p]
            faces.first[p] = 3 * f + k
            _add_plane(points, p, normal, -wp.dot(normal, origin), area)


@wp.func
def _add_seams(points: Points, faces: Faces, seam: wp.float64):
    """Add quadrics of planes perpendicular to the faces along borders and label changes, weighted by squared
    length.
    """
    for f in range(faces.corners.shape[0]):
        origin = points.place[faces.corners[f, 0]]
        normal = wp.cross(points.place[faces.corners[f, 1]] - origin, points.place[faces.corners[f, 2]] - origin)
        normal = wp.normalize(normal)
        for k in range(3):
            a = faces.corners[f, k]
            b = faces.corners[f, (k + 1) % 3]
            others = _faces_at_edge(a, b, faces, f)
            if others[0] == 0:
                points.border[a] = 1
                points.border[b] = 1
            same = others[0] == 1
            if same:
                same = _label_at(a, others[1], faces) == faces.labels[f, k]
                if _label_at(b, others[1], faces) != faces.labels[f, (k + 1) % 3]:
                    same = False
            if not same:
                across = wp.cross(points.place[b] - points.place[a], normal)
                weight = seam * wp.length_sq(across)
                across = wp.normalize(across)
                offset = -wp.dot(across, points.place[a])
                _add_plane(points, a, across, offset, weight)
                _add_plane(points, b, across, offset, weight)


@wp.func
def _add_edges(points: Points, faces: Faces, heap: wp.array(dtype=Candidate)):
    """Push every edge on the empty heap once and return its size."""
    size = int(0)
    for f in range(faces.corners.shape[0]):
        for k in range(3):
            a = faces.corners[f, k]
            b = faces.corners[f, (k + 1) % 3]
            others = _faces_at_edge(a, b, faces, f)
            # lists begin with the latest face: the last that was found is the earliest
            if others[0] == 0 or others[1] > f:
                size = _push_edge(points, heap, size, a, b)
    return size


@wp.func
def _drop_outdated(points: Points, heap: wp.array(dtype=Candidate), size: int):
    """Remove outdated entries from the heap and return its new size."""
    count = int(0)
    for i in range(size):
        if _is_current(heap[i], points):
            heap[count] = heap[i]
            count += 1
    for i in range(count // 2):
        _sift_down(heap, count // 2 - 1 - i, count)
    return count


@wp.func
def _spans_bounds(points: Points, a: int, b: int):
    """Whether the edge connects opposite bounds, so that a collapse would lose one."""
    pins = points.pins[a] | points.pins[b]
    for k in range(3):
        if (pins >> k) % 2 == 1 and (pins >> (k + 3)) % 2 == 1 and points.low[k] < points.high[k]:
            return True
    return False


@wp.func
def _merge_points(points: Points, faces: Faces, a: int, b: int, target: wp.vec3d):
    """Replace b by a at its new position and return the number of removed faces."""
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
            if _next_point(faces, f, c, 1) == a or _next_point(faces, f, c, 2) == a:
                faces.alive[f] = 0
                gone += 1
                from1 = from0
                into1 = into0
                from0 = faces.labels[f, c - 3 * f]
                into0 = _label_at(a, f, faces)
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
def _collapse_kernel(
    start: int,
    triangles: int,
    longest: wp.float64,
    seam: wp.float64,
    points: Points,
    faces: Faces,
    heap: wp.array(dtype=Candidate),
):
    _add_faces(points, faces)
    _add_seams(points, faces, seam)
    size = int(_add_edges(points, faces, heap))
    left = int(faces.corners.shape[0])
    tick = int(0)
    while left > triangles and size > 0:
        top = heap[0]
        size -= 1
        if size > 0:
            heap[0] = heap[size]
            _sift_down(heap, 0, size)
        if not _is_current(top, points):
            continue
        a = int(top.a)
        b = int(top.b)
        tick += 2
        if _spans_bounds(points, a, b) or not _satisfies_link(a, b, points, faces, tick):
            continue
        spot = _best_merge(points, a, b)
        target = wp.vec3d(spot[0], spot[1], spot[2])
        count_a = _count_remaining(a, b, target, longest, points, faces)
        if count_a < 0:
            continue
        count_b = _count_remaining(b, a, target, longest, points, faces)
        if count_b < 0 or count_a + count_b == 0:
            continue
        if wp.length_sq(target - points.place[b]) < wp.length_sq(target - points.place[a]):
            # the nearer point gives its labels
            a = top.b
            b = top.a
        left -= _merge_points(points, faces, a, b, target)
        tick += 2
        c = int(faces.first[a])
        while c >= 0:
            for step in range(1, 3):
                u = _next_point(faces, c // 3, c, step)
                if points.mark[u] != tick:
                    points.mark[u] = tick
                    if size == heap.shape[0]:
                        size = _drop_outdated(points, heap, size)
                    size = _push_edge(points, heap, size, a, u)
            c = faces.after[c]


@dataclass(frozen=True, slots=True)
class CollapsedMesh:
    """A mesh after edge collapses."""

    points: NDArray[np.float64]
    """(P, 3) float64, moved."""
    faces: NDArray[np.int32]
    """(F', 3) int32."""
    labels: NDArray[np.int32]
    """(F', 3) int32."""
    faces_left: NDArray[np.int64]
    """(F',) int64, indices of the remaining faces."""


def collapse(
    points: NDArray[np.float64],
    faces: NDArray[np.integer],
    labels: NDArray[np.integer],
    bounds: NDArray[np.float64],
    triangles: int,
    longest: float,
    seam: float,
) -> CollapsedMesh:
    """Collapse edges until at most `triangles` faces are left or no edge may collapse.

    Args:
        points: (P, 3).
        faces: (F, 3), of three different points each.
        labels: (F, 3), appearance of each corner.
        bounds: (2, 3), low and high. Points stay inside; points on a bound stay on it.
        triangles: Number of faces to reach.
        longest: No longer edge is created; inf for no limit.
        seam: Weight of the planes that preserve label borders, against the faces' own planes.

    Returns:
        The collapsed mesh.
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
    corners, appearance = np.array(faces, dtype=np.int32), np.array(labels, dtype=np.int32)
    alive = np.ones(total, dtype=np.int32)
    surface = Faces()
    surface.corners, surface.labels = _shared(corners, int), _shared(appearance, int)
    surface.alive = _shared(alive, int)
    surface.first = wp.full(count, -1, dtype=int, device="cpu")
    surface.after = wp.empty(3 * total, dtype=int, device="cpu")
    # all edges, at most 3 F, and as much again before outdated ones are thrown out
    heap = wp.empty(6 * total, dtype=Candidate, device="cpu")
    launch(_collapse_kernel, [0, 1], [triangles, longest**2, seam, state, surface, heap])
    left = np.flatnonzero(alive)
    return CollapsedMesh(place, corners[left], appearance[left], left)


def _shared(values: NDArray[Any], dtype: Any) -> Any:
    """A Warp array in the same memory."""
    return wp.array(values, dtype=dtype, device="cpu", copy=False)
