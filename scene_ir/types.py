"""The central types: frozen, validated on construction, without a batch dimension.

`conventions.md` defines axes, units, pixel centres and colour space.
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
CLOTHES_DIM = TEXTURE_DIM + 3
"""Texture code in scenes that may hold people: also lightness, a*, b* of a pedestrian's clothes below the waist."""
LIGHT_DIM = 3
"""Light code: the sun's azimuth (to the right), elevation (up), strength."""
FOLIAGE_DIM = 3
"""Foliage code: hue (season), lightness, density."""


class Weather(IntEnum):
    """Codes of `Environment.weather` by index; each in [0, 1], and 0 as photographed."""

    FOG = 0
    RAIN = 1
    TIME = 2
    OVERCAST = 3
    NIGHT = 4
    SNOW = 5


WEATHER_DIM = len(Weather)
DAYLIGHT_DIM = int(Weather.NIGHT)
"""Codes before `NIGHT`: the paper's."""
PAST_WEATHER_DIMS = (DAYLIGHT_DIM, int(Weather.SNOW))
"""Codes of scenes saved before there was a night, and before there was snow."""


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


UPRIGHT = (Category.PEDESTRIAN, Category.CYCLIST)
"""Objects without a solid mesh: an upright surface, cut out of the photograph, stands for each."""


def check_shape(name: str, tensor: Tensor, *shape: int | None, floating: bool = True) -> None:
    """Check a tensor's shape and kind of dtype.

    Args:
        name: The field, for the message.
        tensor: The tensor.
        shape: Expected sizes; None for any.
        floating: Whether its dtype must be floating or integer.

    Raises:
        ShapeError: It has another shape or dtype.
    """
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
    """Check that indices are in [0, count).

    Args:
        name: The field, for the message.
        indices: Integers of any shape.
        count: Number of entries.

    Raises:
        RangeError: One of them is not.
    """
    bad = indices[(indices < 0) | (indices >= count)]
    if bad.numel():
        raise RangeError(name, f"indices in [0, {count})", int(bad[0]))


FOCAL_PX = (0.01, 1e5)
"""Bounds of focal lengths, far beyond those of real cameras, px."""


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera."""

    intrinsics: Tensor
    """(3, 3) px."""
    height: int
    """Image height, px."""
    width: int
    """Image width, px."""
    projection: Tensor | None = None
    """(3, 4) px if the data set has one (KITTI's P2 has the offset of camera 2 in its fourth column); else
    `[intrinsics | 0]`."""

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
    """A closed triangle mesh in the unit box of its object frame."""

    vertices: Tensor
    """(V, 3): x in [-0.5, 0.5] along the length, front at +x; y in [-1, 0], roof at -1; z in [-0.5, 0.5] along the
    width."""
    faces: Tensor
    """(F, 3) int64, wound so that cross(v1 - v0, v2 - v0) points outwards."""
    part: Tensor
    """(F,) int64, a `Part`."""
    name: str = ""
    """Display name."""
    colours: Tensor | None = None
    """(V, 3) RGB in [0, 1]."""
    uv: Tensor | None = None
    """(V, 2) texture coordinates."""

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
    """A rectangle of an image."""

    values: Tensor
    """(C, h, w)."""
    x0: int
    """Left column in the frame, px."""
    y0: int
    """Top row in the frame, px."""

    def __post_init__(self) -> None:
        check_shape("crop.values", self.values, None, None, None)


@dataclass(frozen=True, slots=True)
class Source:
    """One object as photographed: the fixed end of the projective texture."""

    translation: Tensor
    """(3,) m, bottom-face centre in the photograph."""
    yaw: Tensor
    """() rad, in the photograph."""
    size_lhw: Tensor
    """(3,) m, in the photograph."""
    ffd: Tensor
    """(P, 3) lattice offsets, in the photograph."""
    foreground: Crop
    """Crop (4, h, w) in [0, 1]: RGB premultiplied by opacity, and opacity (the matte)."""
    shadow: Crop | None
    """Crop (3, h, w) in [0, 1]: factor by which the object darkens the ground, or None."""
    inflation: float
    """Margin of the mesh, m, that the matte may reach; it moves with the outline."""
    paint: Tensor
    """(3,) RGB in [0, 1], base colour of the paint."""
    sunlight: float
    """Strength of the sun on the object, >= 0."""
    region: Crop | None = None
    """Crop (1, h, w) in [0, 1]: share of paint in each pixel; None if only the mesh's parts are known."""

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
    """An object that is no vehicle and may stand in front of one: a person, a pole, a trunk. It never moves."""

    foreground: Crop
    """Crop (4, h, w) in [0, 1]: RGB premultiplied by opacity, and opacity."""
    depth_m: float
    """Depth along the optical axis, m."""

    def __post_init__(self) -> None:
        check_shape("occluder.foreground", self.foreground.values, 4, None, None)
        if not 0 < self.depth_m < float("inf"):
            raise RangeError("occluder.depth_m", "positive metres", self.depth_m)


@dataclass(frozen=True, slots=True)
class Objects:
    """N vehicles, and people and cyclists among them."""

    mesh_index: Tensor
    """(N,) int64, into `SceneIR.meshes`."""
    translation: Tensor
    """(N, 3) m, bottom-face centre."""
    yaw: Tensor
    """(N,) rad about the camera's y axis (KITTI's rotation_y)."""
    size_lhw: Tensor
    """(N, 3) m, length, height, width."""
    ffd: Tensor
    """(N, P, 3) lattice offsets, fractions of the unit box."""
    texture_code: Tensor
    """(N, 5) in (-1, 1), or (N, 8), see `CLOTHES_DIM`; with 5, a pedestrian's clothes change alike."""
    category: Tensor
    """(N,) int64, a `Category`."""
    box2d: Tensor
    """(N, 4) px, xyxy, the labels' 2D boxes: `paper` labels, and the base of `moved` ones."""
    truncation: Tensor
    """(N,) in [0, 1], as labelled."""
    occlusion: Tensor
    """(N,) int64, 0 to 3, as labelled."""
    source: tuple[Source, ...] = ()
    """One `Source` per object; empty if there is no photograph."""
    lamps: Tensor = field(default_factory=lambda: torch.zeros(0))
    """(N,) in [-1, 1]: 0 as the weather makes drivers do it, -1 off, 1 with brake lamps too. Empty is 0 for all."""

    def __post_init__(self) -> None:
        n = self.translation.shape[0] if isinstance(self.translation, Tensor) and self.translation.ndim else -1
        check_shape("objects.translation", self.translation, None, 3)
        check_shape("objects.mesh_index", self.mesh_index, n, floating=False)
        check_shape("objects.yaw", self.yaw, n)
        check_shape("objects.size_lhw", self.size_lhw, n, 3)
        check_shape("objects.ffd", self.ffd, n, LATTICE_POINTS, 3)
        parts = isinstance(self.texture_code, Tensor) and self.texture_code.shape[1:] == (CLOTHES_DIM,)
        check_shape("objects.texture_code", self.texture_code, n, CLOTHES_DIM if parts else TEXTURE_DIM)
        check_shape("objects.category", self.category, n, floating=False)
        check_shape("objects.box2d", self.box2d, n, 4)
        check_shape("objects.truncation", self.truncation, n)
        check_shape("objects.occlusion", self.occlusion, n, floating=False)
        if isinstance(self.lamps, Tensor) and self.lamps.shape == (0,):
            object.__setattr__(self, "lamps", self.translation.new_zeros(max(n, 0)))
        check_shape("objects.lamps", self.lamps, n)
        for name in ("translation", "yaw", "size_lhw", "ffd", "texture_code", "lamps"):
            check_finite(f"objects.{name}", getattr(self, name))
        if n and float(self.size_lhw.detach().min()) <= 0:
            raise RangeError("objects.size_lhw", "positive metres", float(self.size_lhw.detach().min()))
        if self.source and len(self.source) != n:
            raise ShapeError("objects.source", f"{n} entries or none", len(self.source))

    def __len__(self) -> int:
        return int(self.translation.shape[0])

    @property
    def upright(self) -> Tensor:
        """(N,) bool, which are upright surfaces, not vehicles."""
        return torch.isin(self.category, self.category.new_tensor(UPRIGHT))

    @property
    def parted(self) -> Tensor:
        """(N,) bool, objects with a texture code of their own below the waist."""
        return (self.category == Category.PEDESTRIAN) & (self.texture_code.shape[1] == CLOTHES_DIM)


@dataclass(frozen=True, slots=True)
class Environment:
    """Codes and maps of the surroundings."""

    weather: Tensor
    """(6,) in [0, 1], see `Weather`; 0 is as photographed. With fewer, of `PAST_WEATHER_DIMS`, the rest is 0."""
    foliage: Tensor
    """(3,) in [-1, 1]; 0 is as photographed."""
    sun: Tensor
    """(3,) unit vector towards the photographed sun, in camera axes."""
    ground: Tensor
    """(4,), plane n.x + d = 0 in camera axes, with the unit normal n up (n_y < 0)."""
    sky: Tensor
    """(H, W) in [0, 1], share of sky."""
    foliage_map: Tensor
    """(H, W) in [0, 1], share of foliage."""
    road: Tensor
    """(H, W) in [0, 1], share of road."""
    light: Tensor = field(default_factory=lambda: torch.zeros(LIGHT_DIM))
    """(3,) in [-1, 1]; 0 is as photographed."""
    closed_sky: Tensor | None = None
    """(2, 3, h, w) in [0, 1], background and photograph under a closed sky, as codes of the ratio to what they are:
    exp((2 code - 1) `render.model.CLOSED_SKY_LOG`); the second is for the vehicles. None for what is not known."""
    ego: Tensor | None = None
    """(H, W) in [0, 1], opacity of the ego vehicle (bonnet, dashboard), which no code changes but night; None if the
    photograph does not show it."""
    drops: Tensor = field(default_factory=lambda: torch.zeros(1))
    """(1,) in [0, 1], drops of rain on the windscreen; 0 is as photographed. No attack moves it."""

    def __post_init__(self) -> None:
        if isinstance(self.weather, Tensor) and self.weather.shape in [(n,) for n in PAST_WEATHER_DIMS]:
            weather = torch.nn.functional.pad(self.weather, (0, WEATHER_DIM - len(self.weather)))
            object.__setattr__(self, "weather", weather)
        check_shape("environment.weather", self.weather, WEATHER_DIM)
        check_shape("environment.foliage", self.foliage, FOLIAGE_DIM)
        check_shape("environment.light", self.light, LIGHT_DIM)
        check_shape("environment.drops", self.drops, 1)
        check_shape("environment.sun", self.sun, 3)
        check_shape("environment.ground", self.ground, 4)
        check_shape("environment.sky", self.sky, None, None)
        check_shape("environment.foliage_map", self.foliage_map, *self.sky.shape)
        check_shape("environment.road", self.road, *self.sky.shape)
        if self.closed_sky is not None:
            check_shape("environment.closed_sky", self.closed_sky, 2, 3, None, None)
        if self.ego is not None:
            check_shape("environment.ego", self.ego, *self.sky.shape)
        for name in ("weather", "foliage", "light", "drops", "sun", "ground"):
            check_finite(f"environment.{name}", getattr(self, name))


@dataclass(frozen=True, slots=True)
class SceneIR:
    """One photograph as an editable scene."""

    camera: Camera
    """The photograph's camera."""
    meshes: tuple[Mesh, ...]
    """Meshes that objects refer to."""
    objects: Objects
    """The vehicles."""
    environment: Environment
    """Their surroundings."""
    photograph: Tensor
    """(3, H, W) RGB in [0, 1]."""
    background: Tensor
    """(3, H, W) RGB in [0, 1], without vehicles and their shadows; elsewhere the photograph."""
    depth: Tensor
    """(H, W) m of the background; inf in the sky."""
    ignore: Tensor
    """(K, 4) px, xyxy, regions in which no detection counts (DontCare)."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Where the scene comes from, by keyword."""
    occluders: tuple[Occluder, ...] = ()
    """Objects that may stand in front of vehicles, and are part of the background too."""
    before: SceneIR | None = None
    """The scene before a vehicle was exchanged, added or removed, with the same objects row by row; an absent one
    stands behind the camera."""
    other_labels: Labels | None = None
    """The labels that `ignore` was made of: DontCare regions, then labels that are no object here (people,
    trams)."""

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
        for i, occluder in enumerate(self.occluders):
            self._check_inside(f"scene.occluders[{i}].foreground", occluder.foreground)
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
    def riders(self) -> Tensor:
        """(N,) bool, cyclists with a known heading: where places are estimated, people have none."""
        known = self.provenance.get("places") != "estimated"
        return (self.objects.category == Category.CYCLIST) & known

    @property
    def origin(self) -> SceneIR:
        """The scene before vehicles were exchanged, added or removed; itself if none was."""
        return self if self.before is None else self.before

    def as_photographed(self) -> SceneIR:
        """The scene of the photograph: `origin`, unperturbed.

        A saved counterexample thus carries the scene that it was made from. Needs `objects.source`.
        """
        return self.origin.unperturbed()

    def unperturbed(self) -> SceneIR:
        """The scene at theta0: every object at the geometry of its source, every code at 0.

        Exchanged, added and removed vehicles stay so. Needs `objects.source`.
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
            lamps=torch.zeros_like(self.objects.lamps),
        )
        environment = replace(
            self.environment,
            weather=torch.zeros_like(self.environment.weather),
            foliage=torch.zeros_like(self.environment.foliage),
            light=torch.zeros_like(self.environment.light),
            drops=torch.zeros_like(self.environment.drops),
        )
        return replace(self, objects=objects, environment=environment)


@dataclass(frozen=True, slots=True)
class Labels:
    """The M labelled objects of a frame, in file order and with people; DontCare regions are separate."""

    kind: tuple[str, ...]
    """M types as written ("Car", "Van", ...)."""
    boxes_xyxy: Tensor
    """(M, 4) px."""
    truncation: Tensor
    """(M,) in [0, 1]."""
    occlusion: Tensor
    """(M,) int64, 0 to 3."""
    translation: Tensor
    """(M, 3) m, bottom-face centre."""
    yaw: Tensor
    """(M,) rad."""
    size_lhw: Tensor
    """(M, 3) m."""
    ignore_xyxy: Tensor
    """(K, 4) px, DontCare regions."""

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
        """The labels of some rows, with all regions."""
        columns = ("boxes_xyxy", "truncation", "occlusion", "translation", "yaw", "size_lhw")
        chosen = {name: getattr(self, name)[list(rows)] for name in columns}
        return replace(self, kind=tuple(self.kind[row] for row in rows), **chosen)


@dataclass(frozen=True, slots=True)
class Frame:
    """One photograph as a reader returns it."""

    identifier: str
    """Unique within its data set ("000008")."""
    photograph: Tensor
    """(3, H, W) RGB in [0, 1]."""
    camera: Camera
    """The photograph's camera."""
    labels: Labels | None = None
    """Labels, if the data set has them."""
    masks: Tensor | None = None
    """(M, H, W) in [0, 1], one per label."""
    depth: Tensor | None = None
    """(H, W) m."""
    classes: Tensor | None = None
    """(H, W) int64, into `class_names`."""
    class_names: tuple[str, ...] = ()
    """Names of the classes."""
    points: Tensor | None = None
    """(P, 3) m in camera axes."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Data set and files, by keyword."""
    attributes: Mapping[str, str] = field(default_factory=dict)
    """Attributes that the data set states, such as weather and timeofday."""

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
    """A rendered scene."""

    image: Tensor
    """(3, H, W) RGB in [0, 1]."""
    depth: Tensor
    """(H, W) m; inf in the sky."""
    object_id: Tensor
    """(H, W) int64: 0 is background, i + 1 the front-most object i with an opacity of at least one half."""
    opacity: tuple[Crop, ...]
    """One Crop (1, h, w) in [0, 1] per object, before others occlude it."""
    vehicle_regions: Tensor | None = None
    """(K, 4) int64 px, half-open xyxy, outside which no vehicle or shadow is drawn; None if unknown or if weather
    or foliage may change every pixel."""


def replace_unchecked(value: T, **changes: Any) -> T:
    """`dataclasses.replace` without the checks of `__post_init__`, for changes that are valid by construction."""
    changed = object.__new__(type(value))
    for entry in fields(value):  # pyright: ignore[reportArgumentType]
        content = changes[entry.name] if entry.name in changes else getattr(value, entry.name)
        object.__setattr__(changed, entry.name, content)
    return changed


def to_host(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Tensors of one device as float64 on the CPU, without gradients; from a GPU in one transfer."""
    tensors = tuple(tensor.detach() for tensor in tensors)
    if not any(tensor.is_cuda for tensor in tensors):
        return tuple(tensor.double() for tensor in tensors)
    values = torch.cat([tensor.double().flatten() for tensor in tensors]).cpu()
    parts = values.split([tensor.numel() for tensor in tensors])
    return tuple(part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True))


def convert_scene(value: T, dtype: torch.dtype | None, device: torch.device | str | None = None) -> T:
    """Convert a scene, or any part of it, to another dtype or device. Unchanged tensors are not copied.

    Args:
        value: A scene, one of its parts, or a tensor.
        dtype: Of floating tensors; None to keep.
        device: Of all tensors; None to keep.

    Returns:
        The same structure.
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
