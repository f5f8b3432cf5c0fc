"""Scenes for notebooks: de-render a photograph, edit the scene, render it, in memory.

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

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drivesem.attacks.labels import Labeller
from drivesem.attacks.scene_edits import apply_edit
from drivesem.attacks.space import Budget, Parameter, ParameterSpace, Perturbation
from drivesem.config.edits import ALL, WEATHER_CODES, merge_edits, parse_frame_edit, parse_setting
from drivesem.config.errors import UsageError
from drivesem.data import kitti
from drivesem.data.photographs import check_image_size, default_camera, read_photograph, read_pixels
from drivesem.data.subsets import FrameFilter, open_selection
from drivesem.scenes.sources import derender_settings, place_vehicles
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


_NO_CHANGE = 1e-6
"""Changes up to this are rounding."""


@dataclass(frozen=True, slots=True, repr=False)
class Scene:
    """A de-rendered photograph: vehicles, their shadows, the background behind them, weather and foliage.

    A notebook displays the rendered image.
    """

    ir: SceneIR
    """The scene in the form that all parts of the project use."""
    name: str = "scene"
    """Name, for example of the photograph."""
    notes: tuple[str, ...] = ()
    """Infeasible places after the last edit, such as `objects[2]: left the road, ...`."""

    def __len__(self) -> int:
        """Number of movable vehicles."""
        return len(self.ir.objects)

    @property
    def photograph(self) -> NDArray[np.uint8]:
        """The original photograph (H, W, 3) RGB."""
        return to_uint8(self.ir.photograph)

    @torch.no_grad()
    def boxes(self) -> NDArray[np.float32]:
        """The labels' boxes (N, 4) px, xyxy, which move with the vehicles."""
        photographed = self.ir.unperturbed()
        labeller = Labeller(photographed, render([photographed])[0])
        return labeller.moved(self.ir, render([self.ir])[0]).boxes_xyxy.cpu().numpy()

    @property
    def weather(self) -> dict[str, float]:
        """The weather codes: fog, rain, time, overcast, night, snow; in [0, 1]."""
        return dict(zip(WEATHER_CODES, self.ir.environment.weather.tolist(), strict=True))

    @property
    def theta(self) -> dict[str, float]:
        """All changes from the photograph, by name, such as objects[3].yaw; empty where nothing is changed."""
        photographed = self.ir.unperturbed()
        budget = Budget(size=1.0, sun=1.0, night=1.0, snow=1.0, lamps=1.0)
        space = ParameterSpace(photographed, tuple(Parameter), budget)
        theta = space.flatten(Perturbation.between(photographed, self.ir)).tolist()
        return {space.name(i): value for i, value in enumerate(theta) if abs(value) > _NO_CHANGE}

    def __repr__(self) -> str:
        _, height, width = self.ir.photograph.shape
        changes = f", {len(self.theta)} changes" if self.theta else ""
        return f"Scene({self.name!r}, {width}x{height} px, {len(self)} objects{changes})"

    def render(self) -> NDArray[np.uint8]:
        """Render the scene, (H, W, 3) RGB."""
        return to_uint8(self.tensor())

    @torch.no_grad()
    def tensor(self) -> Tensor:
        """Render the scene, (3, H, W) RGB in [0, 1]."""
        return render([self.ir])[0].image

    def edit(
        self,
        *settings: str,
        weather: str | Mapping[str, float] | None = None,
        foliage: Mapping[str, float] | None = None,
        objects: Mapping[int | Literal["all"], Mapping[str, Any]] | None = None,
        remove: Iterable[int] | Literal["all"] = (),
    ) -> Scene:
        """Return an edited copy.

            scene.edit("objects[1].translate=0.5m,0m", "foliage.hue=0.4", weather="fog", remove=[3])
            scene.edit(objects={1: {"translate": ["0.5m", "0m"], "rotate": "10deg"}})

        Later changes override earlier ones.

        Args:
            settings: Changes in the syntax of `drivesem edit --set`.
            weather: A name (fog, rain, sunset, overcast, twilight, night, snow), amounts ("fog=0.6,night=1") or codes.
            foliage: Codes.
            objects: Changes by row.
            remove: Rows to remove.

        Raises:
            FormatError, UsageError, RangeError: A change that cannot be applied.
        """
        changes: dict[Any, Any] = {}
        for text in settings:
            changes = merge_edits(changes, parse_setting(text, "edit"))
        named = {"weather": weather, "foliage": foliage, "objects": objects}
        changes = merge_edits(changes, {name: value for name, value in named.items() if value is not None})
        rows = [ALL] if isinstance(remove, str) else [int(row) for row in remove]
        if isinstance(remove, str) and remove != ALL:
            raise UsageError("remove", "rows from 0, or 'all'", repr(remove))
        for row in rows:
            changes = merge_edits(changes, {"objects": {row: {"remove": True}}})
        if not changes:
            raise UsageError("edit", "a change: settings, weather, foliage, objects or remove", "none")
        result = apply_edit(self.ir, parse_frame_edit("edit", changes))
        return Scene(result.scene, self.name, result.notes)

    def rows(self) -> list[dict[str, Any]]:
        """Return the vehicles as dicts for `pandas.DataFrame`, in metres and degrees; `edit` counts by `row`."""
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
        """Write the scene to a folder for `load_scene` and all commands; replaces a scene in it."""
        io.save_scene(self.ir, check_scene_folder(Path(folder), "folder"))

    def _repr_png_(self) -> bytes:
        return encode_png(self.render())


def load_scene(folder: str | Path) -> Scene:
    """Load a scene from a folder of `Scene.save`, `drivesem derender` or `drivesem attack`. Raises FormatError."""
    return Scene(io.load_scene(Path(folder)), Path(folder).resolve().name)


def demo_scene(index: int = 0, seed: int = 0) -> Scene:
    """Generate one of the embedded scenes, the default of `drivesem attack`."""
    from drivesem.synth.demo import demo_scene as generate

    if index < 0:
        raise UsageError("index", "at least 0", index)
    return Scene(generate(seed, index), f"demo-{index:03d}")


@dataclass(frozen=True, slots=True)
class Frames:
    """The frames of a data set, by name or by iteration, read on demand."""

    dataset: Dataset
    """Reader of the frames."""

    @property
    def names(self) -> tuple[str, ...]:
        """Sorted names of the frames."""
        return self.dataset.identifiers

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[Frame]:
        return map(self.dataset.frame, self.names)

    def __getitem__(self, name: str) -> Frame:
        """Read one frame. Raises RangeError for an unknown name, FormatError naming a damaged file."""
        return self.dataset.frame(name)


def open_dataset(
    name: str,
    root: str | Path,
    *,
    velodyne: bool = False,
    split: str | None = None,
    where: Mapping[str, Sequence[str]] | None = None,
    classes: Mapping[str, str | None] | None = None,
) -> Frames:
    """Open a data set.

        for frame in ds.open_dataset("kitti", "PATH_TO_KITTI"):
            scene = ds.derender(frame)

    Args:
        name: Layout: kitti, vkitti1, vkitti2, coco, yolo, voc or bdd100k.
        root: Folder or URL.
        velodyne: Read laser points, which only KITTI has.
        split: Split of the data set, as `--split`.
        where: Allowed values by attribute, as `--where`: {"timeofday": ["night"]}.
        classes: What class names mean, as `--map`: {"lorry": "Truck"}; None makes a class background.

    Raises:
        RangeError: Unknown name.
        FormatError: The folder is not of this layout.
        UsageError: The URL cannot be read.
    """
    choice = FrameFilter(split, {key: tuple(values) for key, values in (where or {}).items()}, classes or {})
    return Frames(open_selection(name, root, choice, velodyne))


def derender(
    photo: Photo | Frame,
    labels: str | Path | Labels | None = None,
    calib: Calib | None = None,
    *,
    focal: float | None = None,
    fit: bool = True,
    meshes: str | Path | None = None,
    segmenter: str | Path | None = None,
    people: bool = False,
) -> Scene:
    """De-render a photograph into a scene.

        scene = ds.derender("000008.png", labels="label_2/000008.txt", calib="calib/000008.txt")
        scene = ds.derender(photo)                          # no labels: vehicles are detected
        scene = ds.derender(ds.open_dataset("kitti", root)["000008"])

    Args:
        photo: A file, an array, a tensor, or a frame of a data set with labels and camera.
        labels: Labels, or a label file in KITTI's format; requires `calib`.
        calib: Calibration of the camera.
        focal: Focal length without `calib`, px; by default EXIF's, or 0.58 of the longer side.
        fit: Fit vehicles to their outlines.
        meshes: Folder of additional meshes.
        segmenter: ONNX file of a segmentation network.
        people: Make objects of people and cyclists too.

    Raises:
        UsageError: Names the argument.
        FormatError: Names the file.
        ShapeError, RangeError: An array or a number that does not fit.
    """
    from scene_ir.derender.derender import derender as derender_frame

    if meshes is not None and not Path(meshes).is_dir():
        raise UsageError("meshes", "a folder", meshes)
    settings = derender_settings(fit, meshes, segmenter, people)
    if isinstance(photo, Frame):
        if labels is not None or calib is not None or focal is not None:
            raise UsageError("labels, calib, focal", "none for a frame of a data set", "one")
        frame = photo
    else:
        if labels is not None and calib is None:
            raise UsageError("calib", "a calibration for labels", "none")
        if calib is not None and focal is not None:
            raise UsageError("focal", "none with calib", focal)
        frame = _make_frame(photo, labels, calib, focal)
    if frame.labels is None:
        from drivesem.scenes.label_free import detect, detection_fit_settings, label_from_detections

        frame, settings = label_from_detections(frame, detect(frame)), detection_fit_settings(settings)
    frame, settings = place_vehicles(frame, settings)
    return Scene(derender_frame(frame, settings), frame.identifier)


def _make_frame(
    photo: Photo, labels: str | Path | Labels | None, calib: Calib | None, focal: float | None
) -> Frame:
    """Make a frame of a photograph with its camera, and labels if given."""
    if isinstance(photo, str | Path):
        if calib is None:
            return read_photograph(Path(photo), focal)
        path = Path(photo)
        image = to_tensor(read_pixels(path))
        name = path.stem
        provenance = {"dataset": "photograph", "image": path.name}
    else:
        path, name, provenance = Path("photo"), "photo", {"dataset": "photograph"}
        image = to_image_tensor(photo)
    height, width = image.shape[1:]
    camera = default_camera(height, width, focal) if calib is None else _parse_calib(calib, height, width)
    frame_labels = labels if labels is None or isinstance(labels, Labels) else kitti.read_labels(Path(labels))
    check_image_size(path, camera, frame_labels)
    return Frame(name, image, camera, frame_labels, provenance=provenance)


def to_image_tensor(photo: NDArray[np.uint8] | Tensor) -> Tensor:
    """Convert an array (H, W, 3) uint8 or a tensor (3, H, W) in [0, 1] to a float32 tensor. Raises UsageError."""
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


def _parse_calib(calib: Calib, height: int, width: int) -> Camera:
    if isinstance(calib, Camera):
        return calib
    if isinstance(calib, str | Path):
        projection = kitti.read_calibration(Path(calib)).projection
    else:
        projection = torch.as_tensor(calib).float()
        if tuple(projection.shape) not in ((3, 3), (3, 4)):
            raise UsageError("calib", "intrinsics (3, 3) or a projection (3, 4)", tuple(projection.shape))
    intrinsics = projection[:, :3].clone()
    return Camera(intrinsics, height, width, projection if projection.shape[1] == 4 else None)


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """Encode an image (H, W, 3) RGB as PNG."""
    _, encoded = cv2.imencode(".png", picture[..., ::-1])
    return encoded.tobytes()


def check_scene_folder(folder: Path, setting: str) -> Path:
    """Return the folder. Raises UsageError naming the setting if the folder holds anything but a scene."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir()) and not (folder / "scene.json").is_file()):
        raise UsageError(setting, "a new folder, or one of a scene", folder)
    return folder
