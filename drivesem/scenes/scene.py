"""Scenes as a notebook holds them: a photograph taken apart, changed, rendered; nothing touches the disk unasked.

```pycon
>>> import drivesem as ds
>>> scene = ds.demo_scene(0)
>>> foggy = scene.edit("objects[1].translate=0.5m,0m", weather="fog", remove=[3])
>>> len(foggy) == len(scene) - 1
True
>>> foggy.render().shape, foggy.render().dtype
((376, 1241, 3), dtype('uint8'))

```
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drivesem.attack.scene_edits import edited
from drivesem.config.edits import ALL, frame_edit, merged, parse_setting
from drivesem.config.errors import UsageError
from drivesem.data import kitti, registry
from drivesem.data.photographs import camera_for, photograph, read_pixels
from drivesem.scenes.sources import derender_settings, placed
from scene_ir import io
from scene_ir.io import to_tensor, to_uint8
from scene_ir.render.compositor import render
from scene_ir.types import Camera, Category, Frame, Labels, SceneIR

if TYPE_CHECKING:
    from drivesem.data.registry import Dataset

Photo: TypeAlias = "str | Path | NDArray[np.uint8] | Tensor"
"""A file, an array (H, W, 3) of uint8, or a tensor (3, H, W) of floats in [0, 1]; RGB."""
Calib: TypeAlias = "str | Path | Camera | NDArray[np.floating[Any]] | Tensor"
"""A calibration file of KITTI, a camera, intrinsics (3, 3) or a projection (3, 4), px."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A photograph taken apart: vehicles, their shadows, what stood behind them, weather and foliage.

    ir: the scene itself, as all rooms of the project take it. notes: what the last edit did that no car can do,
    such as `objects[2]: left the road, ...`. A notebook shows the rendered picture.
    """

    ir: SceneIR
    name: str = "scene"
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        """How many vehicles can be moved."""
        return len(self.ir.objects)

    @property
    def photograph(self) -> NDArray[np.uint8]:
        """The photograph (H, W, 3) RGB that the scene was taken from."""
        return to_uint8(self.ir.photograph)

    def render(self) -> NDArray[np.uint8]:
        """The scene as it stands, (H, W, 3) RGB."""
        return to_uint8(self.tensor())

    @torch.no_grad()
    def tensor(self) -> Tensor:
        """The scene as it stands, (3, H, W) RGB in [0, 1]."""
        return render([self.ir])[0].image

    def edit(
        self,
        *settings: str,
        weather: str | Mapping[str, float] | None = None,
        foliage: Mapping[str, float] | None = None,
        objects: Mapping[int | Literal["all"], Mapping[str, Any]] | None = None,
        remove: Iterable[int] | Literal["all"] = (),
    ) -> Scene:
        """A changed copy, by the words of `drivesem edit --set`.

            scene.edit("objects[1].translate=0.5m,0m", "foliage.hue=0.4", weather="fog", remove=[3])
            scene.edit(objects={1: {"translate": ["0.5m", "0m"], "rotate": "10deg"}})

        weather: a name (fog, rain, sunset, overcast, twilight) or codes; foliage: codes; objects: changes by row;
        remove: rows. What is said later of the same thing counts. Raises FormatError, UsageError or RangeError.
        """
        changes: dict[Any, Any] = {}
        for text in settings:
            changes = merged(changes, parse_setting(text, "edit"))
        named = {"weather": weather, "foliage": foliage, "objects": objects}
        changes = merged(changes, {name: value for name, value in named.items() if value is not None})
        rows = [ALL] if isinstance(remove, str) else [int(row) for row in remove]
        if isinstance(remove, str) and remove != ALL:
            raise UsageError("remove", "rows from 0, or 'all'", repr(remove))
        for row in rows:
            changes = merged(changes, {"objects": {row: {"remove": True}}})
        if not changes:
            raise UsageError("edit", "a change: settings, weather, foliage, objects or remove", "none")
        result = edited(self.ir, frame_edit("edit", changes))
        return Scene(result.scene, self.name, result.notes)

    def rows(self) -> list[dict[str, Any]]:
        """The vehicles as flat dicts, for `pandas.DataFrame`: `row` is what `edit` counts by; metres, degrees."""
        objects = self.ir.objects
        return [
            {
                "row": i,
                "class": Category(int(objects.category[i])).name.capitalize(),
                **dict(zip(("x_m", "y_m", "z_m"), objects.translation[i].tolist(), strict=True)),
                "yaw_deg": float(objects.yaw[i].rad2deg()),
                **dict(zip(("length_m", "height_m", "width_m"), objects.size_lhw[i].tolist(), strict=True)),
                "template": self.ir.meshes[int(objects.mesh_index[i])].name,
                "occlusion": int(objects.occlusion[i]),
                "truncation": float(objects.truncation[i]),
            }
            for i in range(len(self))
        ]

    def save(self, folder: str | Path) -> None:
        """Write the scene as a folder that `load_scene` and all commands read; in place of one that is there."""
        io.save_scene(self.ir, free_folder(Path(folder), "folder"))

    def _repr_png_(self) -> bytes:
        return png(self.render())


def load_scene(folder: str | Path) -> Scene:
    """The scene of a folder that `Scene.save`, `drivesem derender` or `drivesem attack` wrote. FormatError."""
    return Scene(io.load_scene(Path(folder)), Path(folder).resolve().name)


def demo_scene(index: int = 0, seed: int = 0) -> Scene:
    """One of the embedded scenes, which `drivesem attack` takes where no data set is named. Made by code."""
    from drivesem.synth.demo import demo_scene as made

    if index < 0:
        raise UsageError("index", "at least 0", index)
    return Scene(made(seed, index), f"demo-{index:03d}")


@dataclass(frozen=True, slots=True)
class Frames:
    """The frames of a data set: by name, or one after the other. Each is read when it is asked for."""

    dataset: Dataset

    @property
    def names(self) -> tuple[str, ...]:
        """The frames' names, sorted."""
        return self.dataset.identifiers

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[Frame]:
        return map(self.dataset.frame, self.names)

    def __getitem__(self, name: str) -> Frame:
        """One frame. RangeError for a name that is none, FormatError naming a file that is not as it should be."""
        return self.dataset.frame(name)


def open_dataset(name: str, root: str | Path, *, velodyne: bool = False) -> Frames:
    """A data set: kitti, vkitti1, vkitti2, coco or yolo, under `root`, a folder or its URL.

        for frame in ds.open_dataset("kitti", "PATH_TO_KITTI"):
            scene = ds.derender(frame)

    velodyne: read the laser's points too, which only KITTI has. RangeError for an unknown name, FormatError for a
    folder that is none of the kind, UsageError for a URL that cannot be read.
    """
    return Frames(registry.open_dataset(name, root, with_points=velodyne))


def derender(
    photo: Photo | Frame,
    labels: str | Path | Labels | None = None,
    calib: Calib | None = None,
    *,
    focal: float | None = None,
    fit: bool = True,
    meshes: str | Path | None = None,
    segmenter: str | Path | None = None,
) -> Scene:
    """Take a photograph apart into a scene.

        scene = ds.derender("000008.png", labels="label_2/000008.txt", calib="calib/000008.txt")
        scene = ds.derender(photo)                          # no labels: networks find and place the vehicles
        scene = ds.derender(ds.open_dataset("kitti", root)["000008"])

    photo: a file, an array, a tensor, or a frame of a data set, which brings labels and camera along. labels: a
    file as KITTI's, which needs a calib. focal: px, where there is no calib; by default EXIF's, or 0.58 of the
    longer side. fit, meshes, segmenter: as of `drivesem derender`. Raises UsageError naming the argument,
    FormatError naming the file, ShapeError or RangeError.
    """
    from scene_ir.derender.derender import derender as taken_apart

    if meshes is not None and not Path(meshes).is_dir():
        raise UsageError("meshes", "a folder", meshes)
    settings = derender_settings(fit, meshes, segmenter)
    if isinstance(photo, Frame):
        if labels is not None or calib is not None or focal is not None:
            raise UsageError("labels, calib, focal", "none beside a frame of a data set", "one")
        frame = photo
    else:
        if labels is not None and calib is None:
            raise UsageError("calib", "a calibration beside labels", "none")
        if calib is not None and focal is not None:
            raise UsageError("focal", "none beside a calib", focal)
        frame = _frame(photo, labels, calib, focal)
    if frame.labels is None:
        from drivesem.scenes.label_free import detect, label_free, settings_for

        frame, settings = label_free(frame, detect(frame)), settings_for(settings)
    frame, settings = placed(frame, settings)
    return Scene(taken_apart(frame, settings), frame.identifier)


def _frame(photo: Photo, labels: str | Path | Labels | None, calib: Calib | None, focal: float | None) -> Frame:
    """A photograph with its camera, and with labels where they are given."""
    if isinstance(photo, str | Path):
        if calib is None:
            return photograph(Path(photo), focal)
        path = Path(photo)
        image = to_tensor(read_pixels(path))
        name = path.stem
        provenance = {"dataset": "photograph", "image": path.name}
    else:
        path, name, provenance = Path("photo"), "photo", {"dataset": "photograph"}
        image = image_of(photo)
    height, width = image.shape[1:]
    camera = camera_for(height, width, focal) if calib is None else _camera(calib, height, width)
    given = labels if labels is None or isinstance(labels, Labels) else kitti.read_labels(Path(labels))
    kitti.check_size(path, camera, given)
    return Frame(name, image, camera, given, provenance=provenance)


def image_of(photo: NDArray[np.uint8] | Tensor) -> Tensor:
    """An array (H, W, 3) of uint8 or a tensor (3, H, W) of floats in [0, 1] as such a tensor. UsageError."""
    if isinstance(photo, Tensor):
        if photo.ndim != 3 or photo.shape[0] != 3 or not photo.is_floating_point():
            raise UsageError("photo", "a tensor (3, H, W) of floats", f"{tuple(photo.shape)} of {photo.dtype}")
        if not bool(((photo >= 0) & (photo <= 1)).all()):
            raise UsageError("photo", "values in [0, 1]", f"{float(photo.min()):g} to {float(photo.max()):g}")
        return photo.detach().cpu().float()
    if not isinstance(photo, np.ndarray):
        raise UsageError("photo", "a file, an array, a tensor or a frame of a data set", type(photo).__name__)
    if photo.ndim != 3 or photo.shape[2] != 3 or photo.dtype != np.uint8:
        raise UsageError("photo", "an array (H, W, 3) of uint8", f"{photo.shape} of {photo.dtype}")
    return to_tensor(photo)


def _camera(calib: Calib, height: int, width: int) -> Camera:
    if isinstance(calib, Camera):
        return calib
    if isinstance(calib, str | Path):
        projection = kitti.read_calib(Path(calib)).projection
    else:
        projection = torch.as_tensor(calib).float()
        if tuple(projection.shape) not in ((3, 3), (3, 4)):
            raise UsageError("calib", "intrinsics (3, 3) or a projection (3, 4)", tuple(projection.shape))
    intrinsics = projection[:, :3].clone()
    return Camera(intrinsics, height, width, projection if projection.shape[1] == 4 else None)


def png(picture: NDArray[np.uint8]) -> bytes:
    """A picture (H, W, 3) RGB as a PNG file's bytes."""
    _, encoded = cv2.imencode(".png", picture[..., ::-1])
    return encoded.tobytes()


def free_folder(folder: Path, setting: str) -> Path:
    """Where a scene goes. UsageError naming the setting where that would destroy something else than a scene."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir()) and not (folder / "scene.json").is_file()):
        raise UsageError(setting, "a new folder, or one of a scene", folder)
    return folder
