"""Benchmark streets with exactly N cars of K triangles each, seen by KITTI's camera.

Photographs come from the scene generator and are de-rendered exactly, so that rendering without changes gives the
photograph. The cars cover about as many pixels as in KITTI's frames with as many vehicles: that, more than their
number, determines the cost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from drivesem.synth.demo import take_apart
from drivesem.synth.frames import Plan, SynthFrame, SynthSettings, plan_frame, render_frame
from drivesem.synth.layout import Actor, Lane, LayoutSettings, Road
from scene_ir.errors import RangeError
from scene_ir.geometry import clip_boxes, place_vertices, project_boxes, to_clip
from scene_ir.meshes.lod import simplify
from scene_ir.meshes.templates import template, typical_size_lhw
from scene_ir.raster import verbs
from scene_ir.types import Camera, Mesh, SceneIR

HEIGHT, WIDTH = 375, 1242
"""Pixels of a frame of KITTI's first camera."""
_CAMERA = 0
"""Index of that camera in the generator."""
KITTI_BOX_PIXELS = {1: 2_700, 4: 18_100, 8: 87_000, 16: 137_700}
"""Median area, px, of the union of vehicle boxes in KITTI's 7,481 labelled frames with that many vehicles."""
_SHAPES = (("hatchback", 101), ("sedan", 100), ("estate", 102), ("suv", 101))
"""Kinds and variants of the cars, in turn; their templates have 4.6 to 4.8 thousand triangles."""
_PAINTS = ((0.42, 0.43, 0.44), (0.018, 0.018, 0.02), (0.36, 0.025, 0.025), (0.78, 0.78, 0.77), (0.03, 0.07, 0.22))
_FAR, _MIDDLE, _NEAR, _LEFT, _OWN, _RIGHT = range(6)
"""Lanes of a motorway, from left to right: three oncoming ones, and the camera's with its neighbours."""
_PLACES: dict[int, tuple[tuple[int, float], ...]] = {
    1: ((_OWN, 14.0),),
    4: ((_LEFT, 14.0), (_RIGHT, 21.0), (_OWN, 24.0), (_NEAR, 25.0)),
    8: ((_NEAR, 12.2), (_RIGHT, 10.4), (_LEFT, 11.5), (_OWN, 20.0), (_MIDDLE, 23.5), (_RIGHT, 22.0), (_LEFT, 27.0),
        (_RIGHT, 42.0)),
    16: ((_NEAR, 12.2), (_RIGHT, 8.3), (_LEFT, 12.0), (_OWN, 13.0), (_RIGHT, 17.0), (_LEFT, 19.0), (_NEAR, 20.0),
         (_RIGHT, 24.0), (_MIDDLE, 22.0), (_LEFT, 26.0), (_NEAR, 29.0), (_RIGHT, 33.0), (_LEFT, 36.0),
         (_MIDDLE, 32.0), (_NEAR, 45.0), (_FAR, 36.0)),
}  # fmt: skip
"""Lane and depth, m, of each car; the image's left border cuts the first of eight and of sixteen."""
MAX_CARS = max(_PLACES)
"""Maximum number of cars on a street."""
_ROADS = 400
"""Roads drawn until one has the required lanes."""
_STRAIGHT = 3e-4
"""Curvature, 1/m, up to which a road counts as straight: a quarter of a metre at 40 m."""


@dataclass(frozen=True, slots=True)
class BenchScene:
    """A scene to measure."""

    scene: SceneIR
    """The scene."""
    cars: int
    """Number of cars."""
    triangles: int
    """Per car, nominal."""
    triangles_actual: float
    """Per car, mean."""
    crop_pixels: int
    """Pixels of the rectangles around the meshes."""
    hit_pixels: int
    """Pixel centres hit by the meshes, summed over cars."""
    box_pixels: int
    """Area of the union of the boxes, px."""


@dataclass(frozen=True, slots=True)
class PackedMeshes:
    """The meshes of a scene's cars in one list, as input of the four verbs."""

    points: torch.Tensor
    """(V, 3) m, camera axes."""
    clip: torch.Tensor
    """(V, 3) clip coordinates."""
    faces: torch.Tensor
    """(F, 3) int64."""
    vertex_ranges: torch.Tensor
    """(N, 2) int64."""
    face_ranges: torch.Tensor
    """(N, 2) int64."""

    @classmethod
    def from_scene(cls, scene: SceneIR) -> PackedMeshes:
        """The meshes at their poses, undeformed."""
        objects = scene.objects
        points, faces, corners, ends = [], [], 0, [(0, 0)]
        for i, index in enumerate(objects.mesh_index.tolist()):
            mesh = scene.meshes[index]
            points.append(
                place_vertices(mesh.vertices, objects.size_lhw[i], objects.yaw[i], objects.translation[i])
            )
            faces.append(mesh.faces + corners)
            corners += mesh.vertices.shape[0]
            ends.append((corners, ends[-1][1] + mesh.faces.shape[0]))
        edges = torch.tensor(ends, dtype=torch.int64, device=scene.photograph.device)
        all_points = torch.cat(points)
        ranges = torch.stack([edges[:-1], edges[1:]], dim=1)
        return cls(
            points=all_points,
            clip=to_clip(all_points, scene.camera.matrix),
            faces=torch.cat(faces),
            vertex_ranges=ranges[..., 0].contiguous(),
            face_ranges=ranges[..., 1].contiguous(),
        )

    def layout(self, camera: Camera) -> verbs.PixelLayout:
        """The image rectangles that contain the meshes."""
        return verbs.PixelLayout.from_rects(
            verbs.bounding_rects(self.clip, self.vertex_ranges, camera.height, camera.width)
        )


def build_bench_scene(cars: int, triangles: int, seed: int = 0, scale: float = 1.0) -> BenchScene:
    """Build a street with cars. Equal arguments give equal scenes.

    Args:
        cars: Number of cars.
        triangles: Per car.
        seed: Seed of the street.
        scale: Pixels along an axis, as a multiple of 1242x375.

    Raises:
        RangeError: No street has that many cars.
    """
    if not 1 <= cars <= MAX_CARS:
        raise RangeError("cars", f"1 to {MAX_CARS}", cars)
    scene = take_apart(
        _render_street(cars, seed, scale),
        f"bench-{cars}x{triangles}",
        lambda kind, variant: _car_mesh(kind, variant, triangles),
    )
    assert len(scene.objects) == cars
    placed = PackedMeshes.from_scene(scene)
    layout = placed.layout(scene.camera)
    fragments = verbs.rasterize(placed.clip, placed.faces, placed.face_ranges, layout)
    return BenchScene(
        scene=scene,
        cars=cars,
        triangles=triangles,
        triangles_actual=placed.faces.shape[0] / cars,
        crop_pixels=layout.size,
        hit_pixels=int((fragments.face >= 0).sum()),
        box_pixels=_box_union_area(scene),
    )


@lru_cache(maxsize=16)
def _car_mesh(kind: str, variant: int, triangles: int) -> Mesh:
    return set_triangle_count(template(kind, variant), triangles)


@lru_cache(maxsize=4)
def _render_street(cars: int, seed: int, scale: float) -> SynthFrame:
    """The street with its cars, rendered once for all numbers of triangles."""
    plan = _draw_road(seed)
    road, lanes = plan.setting.road, _sorted_lanes(plan.setting.road)
    places = _PLACES[min(count for count in _PLACES if count >= cars)][:cars]
    actors = tuple(_place_car(i, lanes[lane], depth, road, seed) for i, (lane, depth) in enumerate(places))
    view = plan.setting.view
    setting = replace(plan.setting, view=replace(view, camera=_scale_camera(view.camera, scale)))
    frame = render_frame(replace(plan, actors=actors, setting=setting), with_background=True)
    assert frame is not None
    return frame


def _draw_road(seed: int) -> Plan:
    """The first straight motorway of a stream with the camera in the middle one of three lanes."""
    layout = LayoutSettings(people=False, vehicles=(0, 0), kinds=("motorway",))
    settings = SynthSettings(layout, sunny=True, tilt_rad=0.004, camera=_CAMERA)
    for attempt in range(_ROADS):
        plan = plan_frame(seed, 0, "heldout", settings, attempt)
        road = plan.setting.road
        lanes = _sorted_lanes(road)
        if len(lanes) == 6 and lanes[_OWN].middle_m == 0 and abs(road.curvature) < _STRAIGHT:
            return plan
    raise RangeError(f"road of seed {seed}", f"a straight one among {_ROADS}", "none")


def _sorted_lanes(road: Road) -> list[Lane]:
    """From left to right."""
    return sorted(road.lanes, key=lambda lane: lane.middle_m)


def _place_car(index: int, lane: Lane, depth_m: float, road: Road, seed: int) -> Actor:
    kind, variant = _SHAPES[index % len(_SHAPES)]
    x, z = road.point(lane.middle_m, depth_m)
    return Actor(
        kind=kind,
        variant=variant,
        position_xz=(float(x), float(z)),
        # A slight turn per car: cars aligned exactly with an axis are an easy case.
        yaw=road.yaw(depth_m, lane.direction) + 0.02 * ((index * 7) % 5 - 2),
        size_lhw=typical_size_lhw(kind, variant),
        paint=_PAINTS[index % len(_PAINTS)],
        parked=False,
        seed=seed + index,
    )


def _scale_camera(camera: Camera, scale: float) -> Camera:
    """The same view with `scale` times as many pixels along each axis; pixel centres are integers."""
    if scale == 1.0:
        return camera
    shift = (scale - 1.0) / 2.0
    to_new = torch.tensor([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]])
    height, width = round(camera.height * scale), round(camera.width * scale)
    projection = None if camera.projection is None else to_new @ camera.projection
    return Camera(to_new @ camera.intrinsics, height, width, projection)


def _box_union_area(scene: SceneIR) -> int:
    """Pixels in the union of the cars' projected boxes."""
    objects, camera = scene.objects, scene.camera
    boxes = project_boxes(objects.size_lhw, objects.yaw, objects.translation, camera.matrix)
    covered = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    for x0, y0, x1, y1 in clip_boxes(boxes, camera.height, camera.width).round().to(torch.int64).tolist():
        covered[y0 : y1 + 1, x0 : x1 + 1] = True
    return int(covered.sum())


_PROPORTION = np.array([2.7, 1.0, 1.15])
"""Length and width of a typical car in units of its height, to measure edges on the car instead of the unit box.
"""


def set_triangle_count(mesh: Mesh, triangles: int) -> Mesh:
    """The mesh with `triangles` faces, or one fewer if that number is odd.

    Edges are collapsed, or the longest ones split at their middles, which preserves the surface. Closed surfaces
    stay closed.

    Raises:
        RangeError: Fewer than 4 triangles.
    """
    if triangles < 4:
        raise RangeError("triangles", "at least 4", triangles)
    mesh = simplify(mesh, triangles)
    while mesh.faces.shape[0] + 2 <= triangles:
        before = mesh.faces.shape[0]
        mesh = _split_edges(mesh, (triangles - before) // 2)
        if mesh.faces.shape[0] == before:
            break
    return mesh


def _split_edges(mesh: Mesh, most: int) -> Mesh:
    """Split at most `most` edges, the longest first, no two of the same face.

    Edges are identified by position: both sides of a colour seam are split together.
    """
    vertices, faces = mesh.vertices.double().numpy(), mesh.faces.numpy()
    positions = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    corners = positions[faces]
    for f, face in enumerate(corners.tolist()):
        for k in range(3):
            a, b = face[k], face[(k + 1) % 3]
            pairs.setdefault((min(a, b), max(a, b)), []).append((f, k))
    shared = [sides for sides in pairs.values() if len(sides) == 2]
    length = np.array([_length(vertices, faces, sides[0]) for sides in shared])
    used = np.zeros(len(faces), dtype=bool)
    chosen: list[list[tuple[int, int]]] = []
    for i in np.argsort(-length, kind="stable").tolist():
        sides = shared[i]
        if len(chosen) == most or used[[f for f, _ in sides]].any():
            continue
        used[[f for f, _ in sides]] = True
        chosen.append(sides)
    return _insert_middles(mesh, chosen)


def _length(vertices: NDArray[np.float64], faces: NDArray[np.int64], side: tuple[int, int]) -> float:
    f, k = side
    return float(np.linalg.norm((vertices[faces[f, k]] - vertices[faces[f, (k + 1) % 3]]) * _PROPORTION))


def _insert_middles(mesh: Mesh, edges: list[list[tuple[int, int]]]) -> Mesh:
    """Cut each edge's two faces (face, corner at which the edge begins) from its middle to the opposite corner."""
    faces, part = mesh.faces.clone(), mesh.part
    count, ends, owners, added = mesh.vertices.shape[0], [], [], []
    middles: dict[tuple[int, int], int] = {}
    for sides in edges:
        for f, k in sides:
            a, b, c = (int(faces[f, (k + j) % 3]) for j in range(3))
            key = (min(a, b), max(a, b))
            if key not in middles:
                middles[key] = count + len(ends)
                ends.append(key)
            middle = middles[key]
            faces[f] = torch.tensor([a, middle, c])
            added.append((middle, b, c))
            owners.append(f)
    if not edges:
        return mesh
    pair = torch.tensor(ends, dtype=torch.int64)

    def with_middles(values: torch.Tensor) -> torch.Tensor:
        return torch.cat([values, values[pair].mean(dim=1)])

    return Mesh(
        vertices=with_middles(mesh.vertices),
        faces=torch.cat([faces, torch.tensor(added, dtype=torch.int64)]),
        part=torch.cat([part, part[torch.tensor(owners, dtype=torch.int64)]]),
        name=mesh.name,
        colours=None if mesh.colours is None else with_middles(mesh.colours),
        uv=None if mesh.uv is None else with_middles(mesh.uv),
    )
