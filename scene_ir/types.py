"""The central types. Frozen, validated on construction, without a batch dimension.

Axes, units, pixel centres and colour space are fixed in `conventions.md`, once for all packages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import IntEnum
from typing import Any, TypeVar

import torch
from torch import Tensor

from scene_ir.errors import RangeError, ShapeError

T = TypeVar("T")

LATTICE = (4, 4, 4)
"""Control points of the free-form deformation along length, height and width (3D-SDN)."""
LATTICE_POINTS = LATTICE[0] * LATTICE[1] * LATTICE[2]
TEXTURE_DIM = 5
"""Texture code: lightness, a*, b*, gloss, dirt."""
WEATHER_DIM = 4
"""Weather code: fog, rain, time of day, overcast."""
LIGHT_DIM = 3
"""Light code: the sun's azimuth (to the right), elevation (up), strength."""
FOLIAGE_DIM = 3
"""Foliage code: hue (season), lightness, density."""


class Part(IntEnum):
    """What a face of a vehicle mesh is made of."""

    PAINT = 0
    GLASS = 1
    TYRE = 2
    LIGHT = 3
    OTHER = 4


class Category(IntEnum):
    """Classes of objects, in the detectors' order."""

    CAR = 0
    TRUCK = 1
    PEDESTRIAN = 2
    CYCLIST = 3


def check_shape(name: str, tensor: Tensor, *shape: int | None, floating: bool = True) -> None:
    """Raise ShapeError unless `tensor` has `shape` (None: any size) and the right kind of dtype."""
    if not isinstance(tensor, Tensor):
        raise ShapeError(name, "a torch tensor", type(tensor).__name__)
    actual = tuple(tensor.shape)
    if len(actual) != len(shape) or any(e is not None and a != e for a, e in zip(actual, shape, strict=True)):
        raise ShapeError(name, f"shape {tuple('*' if e is None else e for e in shape)}", actual)
    if tensor.is_floating_point() != floating:
        raise ShapeError(name, "a floating dtype" if floating else "an integer dtype", tensor.dtype)


def check_finite(name: str, tensor: Tensor) -> None:
    """Raise RangeError naming the first coordinate of `tensor` that is NaN or infinite."""
    finite = torch.isfinite(tensor)
    if not bool(finite.all()):
        index = tuple(int(i) for i in (~finite).nonzero()[0])
        raise RangeError(f"{name}{list(index)}", "a finite value", float(tensor[index]))


def check_indices(name: str, indices: Tensor, count: int) -> None:
    """Raise RangeError naming the first of `indices` that is not in [0, count)."""
    bad = indices[(indices < 0) | (indices >= count)]
    if bad.numel():
        raise RangeError(name, f"indices in [0, {count})", int(bad[0]))


FOCAL_PX = (0.01, 1e5)
"""Focal lengths of cameras, far beyond those of any: what is no length does not pass for one."""


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera.

    intrinsics: (3, 3) px. projection: (3, 4) px, where the data set has one (KITTI's P2, whose fourth
    column carries the offset of camera 2); else it is `[intrinsics | 0]`. height, width: px.
    """

    intrinsics: Tensor
    height: int
    width: int
    projection: Tensor | None = None

    def __post_init__(self) -> None:
        check_shape("camera.intrinsics", self.intrinsics, 3, 3)
        check_finite("camera.intrinsics", self.intrinsics)
        if self.projection is not None:
            check_shape("camera.projection", self.projection, 3, 4)
            check_finite("camera.projection", self.projection)
            if not float(torch.linalg.det(self.projection[:, :3].double())):
                raise RangeError("camera.projection", "three columns that can be inverted", "a determinant of 0")
        if self.height < 1 or self.width < 1:
            raise RangeError("camera size", "at least 1x1 px", f"{self.width}x{self.height}")
        focal = self.intrinsics.diagonal()[:2].tolist()
        if not all(FOCAL_PX[0] <= length <= FOCAL_PX[1] for length in focal):
            raise RangeError("camera focal lengths", f"positive px, {FOCAL_PX[0]:g} to {FOCAL_PX[1]:g}", focal)

    @property
    def matrix(self) -> Tensor:
        """(3, 4) projection: `matrix @ (x, y, z, 1)` is `(u w, v w, w)` in pixels."""
        if self.projection is not None:
            return self.projection
        return torch.cat([self.intrinsics, self.intrinsics.new_zeros(3, 1)], dim=1)


@dataclass(frozen=True, slots=True)
class Mesh:
    """A closed triangle mesh in the unit box of its object frame.

    vertices: (V, 3), x in [-0.5, 0.5] along the length (front is +x), y in [-1, 0] (0 is the bottom face,
    -1 the roof: y points down), z in [-0.5, 0.5] along the width. faces: (F, 3) int64, counter-clockwise seen
    from outside in a right-handed frame, so that cross(v1 - v0, v2 - v0) points outwards.
    part: (F,) int64, a `Part`. colours: (V, 3) RGB in [0, 1] or None. uv: (V, 2) or None. name: for people.
    """

    vertices: Tensor
    faces: Tensor
    part: Tensor
    name: str = ""
    colours: Tensor | None = None
    uv: Tensor | None = None

    def __post_init__(self) -> None:
        check_shape("mesh.vertices", self.vertices, None, 3)
        check_finite("mesh.vertices", self.vertices)
        check_shape("mesh.faces", self.faces, None, 3, floating=False)
        check_shape("mesh.part", self.part, self.faces.shape[0], floating=False)
        check_indices("mesh.faces", self.faces, self.vertices.shape[0])
        if self.colours is not None:
            check_shape("mesh.colours", self.colours, self.vertices.shape[0], 3)
        if self.uv is not None:
            check_shape("mesh.uv", self.uv, self.vertices.shape[0], 2)


@dataclass(frozen=True, slots=True)
class Crop:
    """A rectangle of an image: values (C, h, w) whose upper left pixel is column `x0`, row `y0` of the frame."""

    values: Tensor
    x0: int
    y0: int

    def __post_init__(self) -> None:
        check_shape("crop.values", self.values, None, None, None)


@dataclass(frozen=True, slots=True)
class Source:
    """One object as the photograph saw it: the fixed end of the projective texture.

    translation (3,) m, yaw () rad, size_lhw (3,) m, ffd (P, 3): the geometry at which the photograph was taken.
    foreground: Crop of (4, h, w): RGB premultiplied by opacity, and opacity (the matte), in [0, 1].
    shadow: Crop of (3, h, w): the factor in [0, 1] by which the object darkens the ground at each pixel, or None.
    inflation: m beyond the mesh within which the matte may reach: its halo, which moves with the outline.
    paint: (3,) RGB, the base colour of the paint. sunlight: how strongly the sun lights the object, see
    `texture.shade`. region: Crop of (1, h, w) in [0, 1], how much of each pixel is paint, nothing beyond it; None
    where that is known by the mesh's parts alone.
    """

    translation: Tensor
    yaw: Tensor
    size_lhw: Tensor
    ffd: Tensor
    foreground: Crop
    shadow: Crop | None
    inflation: float
    paint: Tensor
    sunlight: float
    region: Crop | None = None

    def __post_init__(self) -> None:
        check_shape("source.translation", self.translation, 3)
        check_shape("source.yaw", self.yaw)
        check_shape("source.size_lhw", self.size_lhw, 3)
        check_shape("source.ffd", self.ffd, LATTICE_POINTS, 3)
        check_shape("source.foreground", self.foreground.values, 4, None, None)
        if self.shadow is not None:
            check_shape("source.shadow", self.shadow.values, 3, None, None)
        check_shape("source.paint", self.paint, 3)
        if not 0 <= self.sunlight < float("inf"):
            raise RangeError("source.sunlight", "at least 0", self.sunlight)
        if self.region is not None:
            check_shape("source.region", self.region.values, 1, None, None)


@dataclass(frozen=True, slots=True)
class Occluder:
    """Something that is no vehicle and may stand in front of one: a person, a pole, a trunk. It never moves.

    foreground: Crop of (4, h, w): RGB premultiplied by opacity, and opacity, in [0, 1]. depth_m: along the optical
    axis, to where it stands.
    """

    foreground: Crop
    depth_m: float

    def __post_init__(self) -> None:
        check_shape("front.foreground", self.foreground.values, 4, None, None)
        if not 0 < self.depth_m < float("inf"):
            raise RangeError("front.depth_m", "positive metres", self.depth_m)


@dataclass(frozen=True, slots=True)
class Objects:
    """N vehicles. mesh_index (N,) into `SceneIR.meshes`; translation (N, 3) m, the bottom-face centre;
    yaw (N,) rad about the camera's y axis (KITTI's rotation_y); size_lhw (N, 3) m; ffd (N, P, 3), lattice offsets
    as fractions of the unit box; texture_code (N, 5); category (N,) a `Category`.
    box2d (N, 4) px, xyxy: the label's box as the data set gives it (`paper` labels, and the base of `moved` ones);
    truncation (N,) in [0, 1]; occlusion (N,) int64, 0 to 3: as labelled.
    source: one `Source` an object, or an empty tuple where nothing was photographed (pure mesh rendering).
    """

    mesh_index: Tensor
    translation: Tensor
    yaw: Tensor
    size_lhw: Tensor
    ffd: Tensor
    texture_code: Tensor
    category: Tensor
    box2d: Tensor
    truncation: Tensor
    occlusion: Tensor
    source: tuple[Source, ...] = ()

    def __post_init__(self) -> None:
        n = self.translation.shape[0] if isinstance(self.translation, Tensor) and self.translation.ndim else -1
        check_shape("objects.translation", self.translation, None, 3)
        check_shape("objects.mesh_index", self.mesh_index, n, floating=False)
        check_shape("objects.yaw", self.yaw, n)
        check_shape("objects.size_lhw", self.size_lhw, n, 3)
        check_shape("objects.ffd", self.ffd, n, LATTICE_POINTS, 3)
        check_shape("objects.texture_code", self.texture_code, n, TEXTURE_DIM)
        check_shape("objects.category", self.category, n, floating=False)
        check_shape("objects.box2d", self.box2d, n, 4)
        check_shape("objects.truncation", self.truncation, n)
        check_shape("objects.occlusion", self.occlusion, n, floating=False)
        for name in ("translation", "yaw", "size_lhw", "ffd", "texture_code"):
            check_finite(f"objects.{name}", getattr(self, name))
        if n and float(self.size_lhw.detach().min()) <= 0:
            raise RangeError("objects.size_lhw", "positive metres", float(self.size_lhw.detach().min()))
        if self.source and len(self.source) != n:
            raise ShapeError("objects.source", f"{n} entries or none", len(self.source))

    def __len__(self) -> int:
        return int(self.translation.shape[0])


@dataclass(frozen=True, slots=True)
class Environment:
    """What surrounds the cars. weather (4,) in [0, 1], foliage (3,) and light (3,) in [-1, 1], 0 is as
    photographed; sun (3,) unit vector towards the photographed sun in camera axes; sky, foliage_map, road: (H, W)
    soft maps in [0, 1]. ground: (4,) plane n.x + d = 0 in camera axes, n (3,) the unit normal pointing up
    (n_y < 0).
    """

    weather: Tensor
    foliage: Tensor
    sun: Tensor
    ground: Tensor
    sky: Tensor
    foliage_map: Tensor
    road: Tensor
    light: Tensor = field(default_factory=lambda: torch.zeros(LIGHT_DIM))

    def __post_init__(self) -> None:
        check_shape("environment.weather", self.weather, WEATHER_DIM)
        check_shape("environment.foliage", self.foliage, FOLIAGE_DIM)
        check_shape("environment.light", self.light, LIGHT_DIM)
        check_shape("environment.sun", self.sun, 3)
        check_shape("environment.ground", self.ground, 4)
        check_shape("environment.sky", self.sky, None, None)
        check_shape("environment.foliage_map", self.foliage_map, *self.sky.shape)
        check_shape("environment.road", self.road, *self.sky.shape)
        for name in ("weather", "foliage", "light", "sun", "ground"):
            check_finite(f"environment.{name}", getattr(self, name))


@dataclass(frozen=True, slots=True)
class SceneIR:
    """One frame, taken apart. photograph, background: (3, H, W) RGB in [0, 1], the background without the cars and
    their shadows, and equal to the photograph elsewhere; depth: (H, W) m of the background, inf in the sky.
    ignore: (K, 4) px, xyxy, regions no detection is judged in (DontCare). provenance: where it came from.
    others: what `ignore` is where labels said so: their regions, then what they tell of all that is no object here
    (people, trams), which stays in the picture as it is.
    front: what may stand in front of vehicles: drawn over those behind it, and part of the background too.
    before: the scene of which this is what became when a vehicle was exchanged, added or taken away; None where
    none was. It has the same objects, row by row; one that is not there stands behind the camera (`in_view`).
    """

    camera: Camera
    meshes: tuple[Mesh, ...]
    objects: Objects
    environment: Environment
    photograph: Tensor
    background: Tensor
    depth: Tensor
    ignore: Tensor
    provenance: Mapping[str, str] = field(default_factory=dict)
    occluders: tuple[Occluder, ...] = ()
    before: SceneIR | None = None
    other_labels: Labels | None = None

    def __post_init__(self) -> None:
        h, w = self.camera.height, self.camera.width
        check_shape("scene.photograph", self.photograph, 3, h, w)
        check_shape("scene.background", self.background, 3, h, w)
        check_shape("scene.depth", self.depth, h, w)
        check_shape("scene.environment.sky", self.environment.sky, h, w)
        check_shape("scene.ignore", self.ignore, None, 4)
        if self.other_labels is not None:
            check_shape(
                "scene.ignore", self.ignore, len(self.other_labels.ignore_xyxy) + len(self.other_labels.kind), 4
            )
        check_indices("objects.mesh_index", self.objects.mesh_index, len(self.meshes))
        for i, source in enumerate(self.objects.source):
            for name in ("foreground", "shadow", "region"):
                self._check_inside(f"objects.source[{i}].{name}", getattr(source, name))
        for i, thing in enumerate(self.occluders):
            self._check_inside(f"scene.front[{i}].foreground", thing.foreground)
        if self.before is not None:
            if self.before.before is not None:
                raise RangeError("scene.before", "a scene without one", "a scene with one")
            if len(self.before.objects) != len(self.objects):
                raise ShapeError("scene.before.objects", f"{len(self.objects)} objects", len(self.before.objects))

    def _check_inside(self, name: str, crop: Crop | None) -> None:
        if crop is None:
            return
        (h, w), (height, width) = crop.values.shape[1:], (self.camera.height, self.camera.width)
        if not (0 <= crop.x0 <= width - w and 0 <= crop.y0 <= height - h):
            found = f"{w}x{h} px at {crop.x0}, {crop.y0}"
            raise RangeError(name, f"a rectangle in {width}x{height} px", found)

    def with_objects(self, **changes: Tensor) -> SceneIR:
        """The same scene with some fields of `objects` replaced."""
        return replace(self, objects=replace(self.objects, **changes))

    def with_environment(self, **changes: Tensor) -> SceneIR:
        """The same scene with some fields of `environment` replaced."""
        return replace(self, environment=replace(self.environment, **changes))

    @property
    def origin(self) -> SceneIR:
        """The scene before vehicles were exchanged, added or taken away; this one where none was."""
        return self if self.before is None else self.before

    def as_photographed(self) -> SceneIR:
        """The scene that the photograph shows: `origin`, at rest.

        A saved counterexample thus carries the scene that it was made from. Needs `objects.source`.
        """
        return self.origin.unperturbed()

    def unperturbed(self) -> SceneIR:
        """The scene at theta0: every object at the geometry of its source, every code at 0. Vehicles that were
        exchanged, added or taken away stay so. Needs `objects.source`.
        """
        source = self.objects.source
        if len(source) != len(self.objects):
            raise RangeError("objects.source", "one entry an object", len(source))
        if not source:
            return self
        objects = replace(
            self.objects,
            translation=torch.stack([s.translation for s in source]),
            yaw=torch.stack([s.yaw for s in source]),
            size_lhw=torch.stack([s.size_lhw for s in source]),
            ffd=torch.stack([s.ffd for s in source]),
            texture_code=torch.zeros_like(self.objects.texture_code),
        )
        environment = replace(
            self.environment,
            weather=torch.zeros_like(self.environment.weather),
            foliage=torch.zeros_like(self.environment.foliage),
            light=torch.zeros_like(self.environment.light),
        )
        return replace(self, objects=objects, environment=environment)


@dataclass(frozen=True, slots=True)
class Labels:
    """What a data set says of the M objects in one frame, in file order, people included, DontCare apart.

    kind: type as written, one a row ("Car", "Van", ...). boxes_xyxy (M, 4) px; truncation (M,) in [0, 1];
    occlusion (M,) int64, 0 to 3; translation (M, 3) m, bottom-face centre; yaw (M,) rad; size_lhw (M, 3) m.
    ignore_xyxy (K, 4) px: DontCare regions.
    """

    kind: tuple[str, ...]
    boxes_xyxy: Tensor
    truncation: Tensor
    occlusion: Tensor
    translation: Tensor
    yaw: Tensor
    size_lhw: Tensor
    ignore_xyxy: Tensor

    def __post_init__(self) -> None:
        m = len(self.kind)
        check_shape("labels.boxes_xyxy", self.boxes_xyxy, m, 4)
        check_shape("labels.truncation", self.truncation, m)
        check_shape("labels.occlusion", self.occlusion, m, floating=False)
        check_shape("labels.translation", self.translation, m, 3)
        check_shape("labels.yaw", self.yaw, m)
        check_shape("labels.size_lhw", self.size_lhw, m, 3)
        check_shape("labels.ignore_xyxy", self.ignore_xyxy, None, 4)

    def select(self, rows: Sequence[int]) -> Labels:
        """Some of the objects, and all regions."""
        columns = ("boxes_xyxy", "truncation", "occlusion", "translation", "yaw", "size_lhw")
        chosen = {name: getattr(self, name)[list(rows)] for name in columns}
        return replace(self, kind=tuple(self.kind[row] for row in rows), **chosen)


@dataclass(frozen=True, slots=True)
class Frame:
    """One photograph as a reader gives it. photograph (3, H, W) RGB in [0, 1]; labels where the data set has them;
    masks (M, H, W) in [0, 1], one a label; depth (H, W) m; classes (H, W) int64 with `class_names`;
    points (P, 3) m in camera axes. identifier: unique within its data set ("000008"). provenance: dataset, files.
    """

    identifier: str
    photograph: Tensor
    camera: Camera
    labels: Labels | None = None
    masks: Tensor | None = None
    depth: Tensor | None = None
    classes: Tensor | None = None
    class_names: tuple[str, ...] = ()
    points: Tensor | None = None
    provenance: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        h, w = self.camera.height, self.camera.width
        check_shape("frame.photograph", self.photograph, 3, h, w)
        if self.masks is not None:
            check_shape("frame.masks", self.masks, len(self.labels.kind) if self.labels else None, h, w)
        if self.depth is not None:
            check_shape("frame.depth", self.depth, h, w)
        if self.classes is not None:
            check_shape("frame.classes", self.classes, h, w, floating=False)
        if self.points is not None:
            check_shape("frame.points", self.points, None, 3)


@dataclass(frozen=True, slots=True)
class Render:
    """A rendered scene. image (3, H, W) RGB in [0, 1]; depth (H, W) m, inf in the sky; object_id (H, W) int64,
    0 is background, i + 1 object i (the front-most object whose opacity is at least one half);
    opacity: one Crop (1, h, w) an object, before others occlude it, in [0, 1]. drawn: (K, 4) int64 px, half-open
    (x0, y0, x1, y1): where vehicles and their shadows show; elsewhere no vehicle changes anything. None where
    weather or foliage may change every pixel, or nobody knows.
    """

    image: Tensor
    depth: Tensor
    object_id: Tensor
    opacity: tuple[Crop, ...]
    vehicle_regions: Tensor | None = None


def convert_scene(value: T, dtype: torch.dtype | None, device: torch.device | str | None = None) -> T:
    """The same scene, or any part of it, with its floating tensors in `dtype`, all tensors on `device`; as they
    are where that is None. What does not change is not copied.
    """
    converted: Any = value
    if isinstance(value, Tensor):
        converted = value.to(device=device, dtype=dtype if value.is_floating_point() else None)
    elif isinstance(value, tuple):
        parts = tuple(convert_scene(part, dtype, device) for part in value)
        converted = value if all(a is b for a, b in zip(parts, value, strict=True)) else parts
    elif is_dataclass(value) and not isinstance(value, type):
        parts = {
            f.name: convert_scene(getattr(value, f.name), dtype, device)
            for f in fields(value)
            if not isinstance(getattr(value, f.name), (int, float, str, Mapping, type(None)))
        }
        changes = {name: part for name, part in parts.items() if part is not getattr(value, name)}
        converted = replace(value, **changes) if changes else value
    return converted
