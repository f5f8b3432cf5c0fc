"""Save and load a scene as a folder: `scene.json`, images, arrays, meshes. Without pickle, and exact to the bit.

    scene.json        schema version, camera, objects, sources, occluders, environment, provenance
    photograph.png    8-bit RGB if the tensor holds exactly k / 255; else in arrays.npz
    background.png    likewise
    arrays.npz        depth, maps, and the crops of sources and occluders
    meshes/0.glb      see `scene_ir.meshes.load`: opens in any viewer, keeps every bit of float32
    before/           `SceneIR.before`, if there is one, in the same form

With `lossy=True` a scene takes a tenth of that: both images are JPEG, the background only where it differs, and
`arrays.npz` holds codes of 8 bits, and of 16 bits for depth, without compression: whoever packs the folder compresses
better.

A folder of another schema version is rejected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from scene_ir import files
from scene_ir.errors import FormatError, SceneError
from scene_ir.types import (
    CLOTHES_DIM,
    FOLIAGE_DIM,
    LATTICE_POINTS,
    LIGHT_DIM,
    PAST_WEATHER_DIMS,
    TEXTURE_DIM,
    WEATHER_DIM,
    Camera,
    Crop,
    Environment,
    Labels,
    Mesh,
    Objects,
    Occluder,
    SceneIR,
    Source,
    check_shape,
)

SCHEMA = "drivesem.scene"
VERSION = 4
"""Increment it with every change that an older reader would misread."""

_T = TypeVar("_T")
_DTYPES = {str(d).removeprefix("torch."): d for d in (torch.float32, torch.float64, torch.int64, torch.int32)}
_MAPS = ("sky", "foliage_map", "road")
_CLOSED_SKY = "closed_sky"
_IMAGES = ("photograph", "background")
_OBJECT_FIELDS: dict[str, tuple[int, ...]] = {
    "mesh_index": (),
    "translation": (3,),
    "yaw": (),
    "size_lhw": (3,),
    "ffd": (LATTICE_POINTS, 3),
    "texture_code": (TEXTURE_DIM,),
    "category": (),
    "box2d": (4,),
    "truncation": (),
    "occlusion": (),
    "lamps": (),
}
_LABEL_FIELDS: dict[str, tuple[int, ...]] = {
    "boxes_xyxy": (4,),
    "truncation": (),
    "occlusion": (),
    "translation": (3,),
    "yaw": (),
    "size_lhw": (3,),
}
_ENVIRONMENT_FIELDS = {"weather": WEATHER_DIM, "foliage": FOLIAGE_DIM, "light": LIGHT_DIM, "sun": 3, "ground": 4}
_DROPS = "drops"
"""Of the environment; scenes saved before there were any have none."""
_SOURCE_FIELDS: dict[str, tuple[int, ...]] = {
    "translation": (3,),
    "yaw": (),
    "size_lhw": (3,),
    "ffd": (LATTICE_POINTS, 3),
    "paint": (3,),
}
_MESH_DTYPES = {
    "vertices": torch.float32,
    "faces": torch.int64,
    "part": torch.int64,
    "colours": torch.float32,
    "uv": torch.float32,
}
_INTEGERS = ("mesh_index", "category", "occlusion")
_JPEG_QUALITY = 95
_SAME = "background_same"
"""Array of a lossy scene: pixels in which the background equals the photograph."""
_BLOCK_PX = 8
"""JPEG's block."""
_LEVELS = 31
"""Levels of a lossy map, from 0 to 1."""
_NEAREST_M, _STEPS = 0.01, 250
"""Lossy depth: distance of code 0, and codes per factor e, so one step is 0.4 %."""
_INFINITE = 65535
"""Code of an infinite depth."""


def save_scene(scene: SceneIR, folder: Path, lossy: bool = False) -> None:
    """Write `scene` as `folder`, atomically, in place of an older one. Gradients are lost.

    Args:
        scene: The scene.
        folder: The folder.
        lossy: Write a smaller folder that holds images, depth and maps approximately.
    """
    with files.atomic_folder(Path(folder)) as temporary:
        arrays = {"depth": _array(scene.depth)}
        arrays |= {name: _array(getattr(scene.environment, name)) for name in _MAPS}
        if scene.environment.closed_sky is not None:
            arrays[_CLOSED_SKY] = _array(scene.environment.closed_sky)
        if scene.environment.ego is not None:
            arrays["ego"] = _array(scene.environment.ego)
        in_png = {}
        for name in _IMAGES:
            image = getattr(scene, name).detach().cpu()
            if lossy:
                continue
            in_png[name] = _as_bytes(image)
            if in_png[name] is None:
                arrays[name] = _array(image)
            else:
                files.write_png(temporary / f"{name}.png", in_png[name])
        record = {
            "schema": SCHEMA,
            "version": VERSION,
            "provenance": _provenance(scene.provenance),
            "camera": {
                "height": scene.camera.height,
                "width": scene.camera.width,
                "intrinsics": _numbers(scene.camera.intrinsics),
                "projection": None if scene.camera.projection is None else _numbers(scene.camera.projection),
            },
            "images": {name: "jpg" if lossy else "npz" if in_png[name] is None else "png" for name in _IMAGES},
            "meshes": len(scene.meshes),
            "objects": {name: _numbers(getattr(scene.objects, name)) for name in _OBJECT_FIELDS},
            "sources": [_source_record(i, source, arrays) for i, source in enumerate(scene.objects.source)],
            "front": [_occluder_record(i, occluder, arrays) for i, occluder in enumerate(scene.occluders)],
            "environment": {
                name: _numbers(getattr(scene.environment, name)) for name in (*_ENVIRONMENT_FIELDS, _DROPS)
            },
            "ignore": _numbers(scene.ignore),
            "others": None if scene.other_labels is None else _labels_record(scene.other_labels),
            "before": scene.before is not None,
        }
        files.write_json(temporary / "scene.json", record)
        if lossy:
            arrays = {name: _to_codes(name, array) for name, array in arrays.items()}
            arrays[_SAME] = _write_lossy_images(scene, temporary)
        files.write_npz(temporary / "arrays.npz", arrays, compressed=not lossy)
        (temporary / "meshes").mkdir()
        from scene_ir.meshes.load import save_mesh

        for i, mesh in enumerate(scene.meshes):
            _check_mesh(i, mesh)
            save_mesh(mesh, temporary / "meshes" / f"{i}.glb")
        if scene.before is not None:
            save_scene(scene.before, temporary / "before", lossy)


def load_scene(folder: Path) -> SceneIR:
    """The scene that was saved as `folder`, on the CPU.

    Raises FormatError naming file and key: missing, of another version, shape or type.
    """
    return _load(Path(folder), with_before=True)


def _load(folder: Path, with_before: bool) -> SceneIR:
    """Load a scene; unless `with_before`, it must have no scene before it."""
    if not folder.is_dir():
        raise FormatError(str(folder), "a folder with a scene", "no such folder")
    root = _record(folder)
    camera = _camera(root["camera"])
    size = (camera.height, camera.width)
    arrays = _NpzArrays(folder / "arrays.npz")
    images = {name: _load_image(folder, root["images"][name], arrays, size, name) for name in _IMAGES}
    sources = tuple(_load_source(i, node, arrays) for i, node in enumerate(root["sources"].items()))
    occluders = tuple(_load_occluder(i, node, arrays) for i, node in enumerate(root["front"].items()))
    objects_node, environment_node = root["objects"], root["environment"]
    count = objects_node["translation"].rows()
    parted = objects_node["texture_code"].columns() == CLOTHES_DIM
    shapes = _OBJECT_FIELDS | {"texture_code": (CLOTHES_DIM if parted else TEXTURE_DIM,)}
    objects = objects_node.build(
        lambda: Objects(
            **{
                name: objects_node[name].tensor(count, *shape, integer=name in _INTEGERS)
                for name, shape in shapes.items()
                if name != "lamps" or name in objects_node.mapping()  # scenes saved before there were any
            },
            source=sources,
        )
    )
    environment = environment_node.build(
        lambda: Environment(
            **{
                name: environment_node[name].tensor(
                    environment_node[name].rows()
                    if name == "weather" and environment_node[name].rows() in PAST_WEATHER_DIMS
                    else width
                )
                for name, width in _ENVIRONMENT_FIELDS.items()
            },
            **{name: arrays.tensor(name, *size) for name in _MAPS},
            closed_sky=arrays.tensor(_CLOSED_SKY, 2, 3, None, None) if _CLOSED_SKY in arrays else None,
            ego=arrays.tensor("ego", *size) if "ego" in arrays else None,
            drops=environment_node[_DROPS].tensor(1) if _DROPS in environment_node.mapping() else torch.zeros(1),
        )
    )
    meshes = tuple(_load_mesh(folder / "meshes" / f"{i}.glb") for i in range(root["meshes"].integer()))
    ignore = root["ignore"]
    provenance = {key: root["provenance"][key].text() for key in root["provenance"].mapping()}
    exchanged = root["before"].flag()
    if exchanged and not with_before:
        raise FormatError(f"{root['before'].where}", "false, in the scene before another", "true")
    before = _load(files.resolve_inside(folder, "before"), with_before=False) if exchanged else None
    return root.build(
        lambda: SceneIR(
            camera=camera,
            meshes=meshes,
            objects=objects,
            environment=environment,
            photograph=images["photograph"],
            background=images["background"],
            depth=arrays.tensor("depth", *size),
            ignore=ignore.tensor(ignore.rows(), 4),
            provenance=provenance,
            occluders=occluders,
            before=before,
            other_labels=_other_labels(root),
        )
    )


def load_camera(folder: Path) -> Camera:
    """The camera of the scene in `folder`, from its record alone. Raises FormatError."""
    return _camera(_record(Path(folder))["camera"])


def _camera(node: _JsonNode) -> Camera:
    return node.build(
        lambda: Camera(
            node["intrinsics"].tensor(3, 3),
            node["height"].integer(),
            node["width"].integer(),
            None if node["projection"].value is None else node["projection"].tensor(3, 4),
        )
    )


def count_objects(folder: Path) -> int:
    """The number of objects of the scene in `folder`, from its record alone. Raises FormatError."""
    root = _record(Path(folder))
    return root["objects"]["translation"].rows()


def load_other_labels(folder: Path) -> Labels | None:
    """`SceneIR.other_labels` of the scene in `folder`, from its record alone. Raises FormatError."""
    return _other_labels(_record(Path(folder)))


def _other_labels(root: _JsonNode) -> Labels | None:
    if root["others"].value is None:
        return None
    node = root["others"]
    kinds = tuple(kind.text() for kind in node["kind"].items())
    known = {
        name: node[name].tensor(len(kinds), *shape, integer=name in _INTEGERS)
        for name, shape in _LABEL_FIELDS.items()
    }
    regions = node["ignore_xyxy"]
    return node.build(lambda: Labels(kinds, **known, ignore_xyxy=regions.tensor(regions.rows(), 4)))


def _labels_record(labels: Labels) -> dict[str, Any]:
    values = {name: _numbers(getattr(labels, name)) for name in (*_LABEL_FIELDS, "ignore_xyxy")}
    return {"kind": list(labels.kind), **values}


def _record(folder: Path) -> _JsonNode:
    """The record of a scene."""
    path = folder / "scene.json"
    root = _JsonNode(str(path), files.read_json(path))
    root.expect("schema", SCHEMA)
    if root["version"].value != VERSION:
        found = f"version {root['version'].value!r}, of another drivesem"
        raise FormatError(f"{root.where}: version", f"version {VERSION}", found)
    return root


def _write_lossy_images(scene: SceneIR, folder: Path) -> np.ndarray:
    """Write both images as JPEG. Returns the pixels (H, W) uint8 in which they are equal."""
    import cv2

    photograph, background = (to_uint8(getattr(scene, name)) for name in _IMAGES)
    same = (photograph == background).all(axis=-1)
    # Blocks without a change are flat; those with one are whole, as ringing ends at their border.
    near = cv2.dilate((~same).astype(np.uint8), np.ones((2 * _BLOCK_PX - 1, 2 * _BLOCK_PX - 1), np.uint8))
    background = np.where(near[..., None] > 0, background, np.uint8(128))
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    for name, image in zip(_IMAGES, (photograph, background), strict=True):
        files.write_bytes(folder / f"{name}.jpg", cv2.imencode(".jpg", image[..., ::-1], options)[1].tobytes())
    return same.astype(np.uint8) * 255


def _to_codes(name: str, array: np.ndarray) -> np.ndarray:
    """Lossy codes of an array: 8 bits for values from 0 to 1, or 16 bits for depth."""
    if name == "depth":
        known = np.isfinite(array)
        code = _STEPS * np.log(np.maximum(np.where(known, array, 1), _NEAREST_M) / _NEAREST_M)
        return np.where(known, code.round().clip(0, _INFINITE - 1), _INFINITE).astype(np.uint16)
    steps = _LEVELS if name in _MAPS else 255
    return ((array.clip(0, 1) * steps).round() / steps * 255).round().astype(np.uint8)


def _from_codes(array: np.ndarray) -> np.ndarray:
    """The values of an array, which may hold the codes of `_to_codes`."""
    if array.dtype == np.uint8:
        return (array / np.float32(255)).astype(np.float32)
    if array.dtype == np.uint16:
        return np.where(array == _INFINITE, np.inf, _NEAREST_M * np.exp(array / _STEPS)).astype(np.float32)
    return array


def _array(tensor: Tensor) -> np.ndarray:
    if tensor.dtype not in _DTYPES.values():
        raise FormatError("a tensor to save", f"one of {', '.join(_DTYPES)}", tensor.dtype)
    return tensor.detach().cpu().numpy()


def _check_mesh(index: int, mesh: Mesh) -> None:
    """Reject what a GLB does not hold exactly."""
    for name, dtype in _MESH_DTYPES.items():
        tensor = getattr(mesh, name)
        if tensor is not None and tensor.dtype != dtype:
            raise FormatError(f"scene.meshes[{index}].{name}", str(dtype), tensor.dtype)


def _as_bytes(image: Tensor) -> np.ndarray | None:
    """The image (3, H, W) as (H, W, 3) uint8 if that is exact, else None."""
    if image.dtype != torch.float32:
        return None
    rounded = (image * 255).round().nan_to_num(0).clamp(0, 255).to(torch.uint8)
    if not torch.equal(rounded.to(torch.float32) / 255, image) or bool(torch.signbit(image).any()):
        return None
    return np.ascontiguousarray(rounded.permute(1, 2, 0).numpy())


def _numbers(tensor: Tensor) -> Any:
    """A tensor as JSON: nested lists, which hold float32 and int64 exactly, or an object with another dtype."""
    values = _finite(_array(tensor).tolist())
    if tensor.dtype in (torch.float32, torch.int64):
        return values
    return {"dtype": str(tensor.dtype).removeprefix("torch."), "values": values}


def _finite(value: Any) -> Any:
    """Values with those that JSON cannot hold as numbers (nan, inf, -inf) as text."""
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return value if math.isfinite(value) else str(value)


def _provenance(provenance: Mapping[str, str]) -> dict[str, str]:
    for key, value in provenance.items():
        if not isinstance(key, str) or not isinstance(value, str):
            raise FormatError(f"scene.provenance[{key!r}]", "text", repr(value))
        files.check_utf8(f"scene.provenance[{key!r}]", key + value)
    return dict(provenance)


def _source_record(index: int, source: Source, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The JSON part of one source; its crops are added to `arrays`."""
    arrays[f"source.{index}.foreground"] = _array(source.foreground.values)
    record: dict[str, Any] = {name: _numbers(getattr(source, name)) for name in _SOURCE_FIELDS}
    record["inflation"] = source.inflation
    record["sunlight"] = source.sunlight
    record["foreground"] = {"x0": source.foreground.x0, "y0": source.foreground.y0}
    for name, crop in (("shadow", source.shadow), ("region", source.region)):
        record[name] = None
        if crop is not None:
            arrays[f"source.{index}.{name}"] = _array(crop.values)
            record[name] = {"x0": crop.x0, "y0": crop.y0}
    return record


def _occluder_record(index: int, occluder: Occluder, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The JSON part of one occluder; its crop is added to `arrays`."""
    arrays[f"front.{index}.foreground"] = _array(occluder.foreground.values)
    return {"depth_m": occluder.depth_m, "x0": occluder.foreground.x0, "y0": occluder.foreground.y0}


@dataclass(frozen=True, slots=True)
class _JsonNode:
    """A value in a JSON file, with its location for messages."""

    where: str
    value: Any

    def __getitem__(self, key: str) -> _JsonNode:
        if key not in self.mapping():
            raise FormatError(f"{self.where}: {key}", "a value", "no such key")
        return _JsonNode(f"{self.where}: {key}", self.value[key])

    def _require(self, kind: type | tuple[type, ...], name: str) -> Any:
        if not isinstance(self.value, kind) or isinstance(self.value, bool):
            raise FormatError(self.where, name, type(self.value).__name__)
        return self.value

    def expect(self, key: str, value: str | int) -> None:
        if self[key].value != value:
            raise FormatError(f"{self.where}: {key}", repr(value), repr(self[key].value))

    def mapping(self) -> dict[str, Any]:
        return self._require(dict, "an object")

    def text(self) -> str:
        return self._require(str, "text")

    def flag(self) -> bool:
        if not isinstance(self.value, bool):
            raise FormatError(self.where, "true or false", repr(self.value))
        return self.value

    def integer(self) -> int:
        return self._require(int, "an integer")

    def number(self) -> float:
        return float(self._require((int, float), "a number"))

    def items(self) -> list[_JsonNode]:
        return [_JsonNode(f"{self.where}[{i}]", v) for i, v in enumerate(self._require(list, "a list"))]

    def _values(self) -> tuple[Any, torch.dtype | None]:
        if not isinstance(self.value, dict):
            return self.value, None
        name = self["dtype"].text()
        if name not in _DTYPES:
            raise FormatError(f"{self.where}: dtype", f"one of {', '.join(_DTYPES)}", repr(name))
        return self["values"].value, _DTYPES[name]

    def rows(self) -> int:
        """Size of a tensor's first axis."""
        return len(_JsonNode(self.where, self._values()[0]).items())

    def columns(self) -> int:
        """Size of a tensor's second axis; 0 without rows."""
        rows = _JsonNode(self.where, self._values()[0]).items()
        return len(rows[0].items()) if rows else 0

    def tensor(self, *shape: int, integer: bool = False) -> Tensor:
        """The nested lists as a tensor of `shape`."""
        nested, dtype = self._values()
        dtype = dtype or (torch.int64 if integer else torch.float32)
        flat: list[float] = []
        found = _flatten(nested, flat, self.where)
        # an empty list has no information about further axes
        if found != shape and not (math.prod(shape) == 0 and found == (0,) and shape[0] == 0):
            raise FormatError(self.where, f"shape {shape}", found)
        if not dtype.is_floating_point and not all(isinstance(v, int) for v in flat):
            raise FormatError(self.where, "integers", "other numbers")
        if not dtype.is_floating_point and flat:
            known = torch.iinfo(dtype)
            if min(flat) < known.min or max(flat) > known.max:
                raise FormatError(self.where, f"integers of {known.bits} bits", max(flat, key=abs))
        return torch.tensor(flat, dtype=dtype).reshape(shape)

    def build(self, make: Callable[[], _T]) -> _T:
        """The result of `make`; errors of the types are raised as FormatErrors at this location."""
        try:
            return make()
        except FormatError:
            raise
        except SceneError as error:
            raise FormatError(f"{self.where}: {error.field}", error.expected, error.actual) from error


def _flatten(value: Any, flat: list[float], where: str) -> tuple[int, ...]:
    """Append the leaves of nested lists to `flat` and return their shape. Raises FormatError for ragged lists."""
    if isinstance(value, list):
        shapes = {_flatten(v, flat, where) for v in value}
        if len(shapes) > 1:
            raise FormatError(where, "lists of equal length", f"shapes {sorted(shapes)}")
        return (len(value), *(shapes.pop() if shapes else ()))
    if value in ("nan", "inf", "-inf"):
        value = float(value)
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise FormatError(where, "numbers", repr(value))
    flat.append(value)
    return ()


class _NpzArrays:
    """The arrays of one NPZ."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._arrays = files.read_npz(path)

    def __contains__(self, name: str) -> bool:
        return name in self._arrays

    def tensor(self, name: str, *shape: int | None, integer: bool = False) -> Tensor:
        """The array `name` as a tensor of `shape` (None: any size). Raises FormatError naming file and key."""
        where = f"{self.path}: {name}"
        if name not in self:
            raise FormatError(where, "an array", f"no such key (has {', '.join(self._arrays)})")
        array = _from_codes(self._arrays[name])
        if array.dtype.name not in _DTYPES:
            raise FormatError(where, f"one of {', '.join(_DTYPES)}", array.dtype.name)
        tensor = torch.from_numpy(array.astype(array.dtype.newbyteorder("="), copy=False))
        try:
            check_shape(where, tensor, *shape, floating=not integer)
        except SceneError as error:
            raise FormatError(error.field, error.expected, error.actual) from error
        return tensor


def _load_image(folder: Path, node: _JsonNode, arrays: _NpzArrays, size_hw: tuple[int, int], name: str) -> Tensor:
    if node.text() == "npz":
        return arrays.tensor(name, 3, *size_hw)
    if node.text() not in ("png", "jpg"):
        raise FormatError(node.where, "'png', 'jpg' or 'npz'", repr(node.value))
    image = to_tensor(files.read_image(folder / f"{name}.{node.text()}", size_hw))
    if node.text() == "png" or name != "background":
        return image
    photograph = to_tensor(files.read_image(folder / "photograph.jpg", size_hw))
    return torch.where(arrays.tensor(_SAME, *size_hw) > 0, photograph, image)


def _load_source(index: int, node: _JsonNode, arrays: _NpzArrays) -> Source:
    def crop(name: str, channels: int) -> Crop:
        values = arrays.tensor(f"source.{index}.{name}", channels, None, None)
        return Crop(values, node[name]["x0"].integer(), node[name]["y0"].integer())

    return node.build(
        lambda: Source(
            **{name: node[name].tensor(*shape) for name, shape in _SOURCE_FIELDS.items()},
            foreground=crop("foreground", 4),
            shadow=None if node["shadow"].value is None else crop("shadow", 3),
            inflation=node["inflation"].number(),
            sunlight=node["sunlight"].number(),
            region=None if node["region"].value is None else crop("region", 1),
        )
    )


def _load_occluder(index: int, node: _JsonNode, arrays: _NpzArrays) -> Occluder:
    values = arrays.tensor(f"front.{index}.foreground", 4, None, None)
    return node.build(
        lambda: Occluder(Crop(values, node["x0"].integer(), node["y0"].integer()), node["depth_m"].number())
    )


def _load_mesh(path: Path) -> Mesh:
    from scene_ir.meshes.load import load_mesh

    return _JsonNode(str(path), None).build(lambda: load_mesh(path))


def to_uint8(image: Tensor) -> np.ndarray:
    """An image (3, H, W) in [0, 1] as (H, W, 3) uint8, rounded to nearest."""
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().cpu().numpy()


def round_to_8bit(image: Tensor) -> Tensor:
    """A picture rounded to the 8-bit grid, in [0, 1], as if written and read again."""
    return (image.clamp(0, 1) * 255).round() / 255


def to_tensor(picture: np.ndarray) -> Tensor:
    """A picture (H, W, 3) uint8 as (3, H, W) float32 in [0, 1]; the inverse of `to_uint8`."""
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).to(torch.float32) / 255
