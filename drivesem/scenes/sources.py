"""Sources of scenes: the embedded demo, data sets and photographs to de-render, or folders of scenes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from drivesem.config.commands import DerenderConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import DEMO, PHOTOGRAPHS, SCENES, SceneOptions
from drivesem.store import local_copy
from scene_ir.errors import FormatError, SceneError
from scene_ir.types import Frame, SceneIR

if TYPE_CHECKING:
    from torch import Tensor

    from detectors.base import Predictor
    from drivesem.data.account import DataAccount
    from drivesem.data.photographs import FocalLength
    from drivesem.scenes.scene_cache import SceneCache
    from scene_ir.derender.derender import DerenderSettings

DEMO_SCENES = 10
_RECORD, _BEFORE = "scene.json", "before"
"""File in every scene's folder, and subfolder of a scene with exchanged vehicles."""
_MAX_FACES = 5000
"""Faces of a user's mesh, as of the heaviest template; more are invisible and slow down every fit."""


class SceneSource(Protocol):
    """Interface of all sources: scenes by identifier. Cheap to construct: every worker makes its own."""

    def account(self) -> DataAccount | None:
        """Account for the files and label rows of a data set; None where there is nothing to skip or map."""
        ...

    def identifiers(self) -> Iterator[str]:
        """Iterate over all frames in a fixed order."""
        ...

    def has_vehicles(self, identifier: str) -> bool:
        """Whether the frame has a movable object. Raises SceneError for a frame that cannot be read."""
        ...

    def photograph(self, identifier: str) -> Tensor:
        """Read the photograph (3, H, W) of a frame, in [0, 1]. Raises SceneError for a frame that cannot be read."""
        ...

    def scene(self, identifier: str) -> SceneIR:
        """Make the scene of a frame. Raises SceneError for a frame that cannot be used."""
        ...


class NoVehicleError(SceneError):
    """No labelled vehicle of a frame could be de-rendered: all are too small, or outside the image."""


class DemoSource:
    """The embedded scenes, generated from a seed with exact ground truth."""

    def __init__(self, seed: int, count: int) -> None:
        self._seed = seed
        self._names = [f"demo-{index:03d}" for index in range(count)]

    def account(self) -> None:
        return None

    def identifiers(self) -> Iterator[str]:
        return iter(self._names)

    def has_vehicles(self, identifier: str) -> bool:
        return True

    def photograph(self, identifier: str) -> Tensor:
        return self.scene(identifier).photograph

    def scene(self, identifier: str) -> SceneIR:
        from drivesem.synth.demo import demo_scene

        return demo_scene(self._seed, self._names.index(identifier))


class DatasetSource:
    """De-rendered frames of a labelled data set. Without 3D boxes, the shipped network estimates the poses."""

    def __init__(self, config: SceneOptions) -> None:
        from drivesem.data.subsets import FrameFilter, open_selection

        points = isinstance(config, DerenderConfig) and config.velodyne
        choice = FrameFilter.from_options(config)
        self._dataset = open_selection(config.dataset, config.root or "", choice, points, config.focal)
        self._settings = _make_settings(config)
        self._cache = _open_cache(config)

    def account(self) -> DataAccount:
        return self._dataset.account()

    def identifiers(self) -> Iterator[str]:
        return iter(self._dataset.identifiers)

    def has_vehicles(self, identifier: str) -> bool:
        from drivesem.data.classes import count_vehicles

        return count_vehicles(self._dataset.labels(identifier), self._settings.people) > 0

    def photograph(self, identifier: str) -> Tensor:
        return self._dataset.frame(identifier).photograph

    def scene(self, identifier: str) -> SceneIR:
        frame, settings = place_vehicles(self._dataset.frame(identifier), self._settings)
        return _derender(frame, settings, self._cache)


class PhotographSource:
    """De-rendered photographs without labels, a file or a folder: a detector finds the vehicles.

    Raises FormatError for a folder without images, UsageError for an unknown detector.
    """

    def __init__(self, path: Path, config: SceneOptions) -> None:
        from drivesem.data.account import IMAGE_SUFFIXES
        from drivesem.data.photographs import list_images, name_by_path
        from drivesem.scenes.label_free import detection_fit_settings

        self._root = path
        files = list_images(path, recursive=True) if path.is_dir() else [path]
        if not files:
            raise FormatError(str(path), f"photographs ({', '.join(IMAGE_SUFFIXES)})", "none")
        self._paths = name_by_path(files, path)
        self._focal_px = config.focal
        self.focal_length(files[0].stem)  # fails early if this is no image
        self._finder = _load_finder(config)
        self._settings = detection_fit_settings(_make_settings(config))
        self._cache = _open_cache(config)

    def account(self) -> DataAccount | None:
        from drivesem.data.account import DataAccount, account_for_files

        if not self._root.is_dir():
            return None
        read, skipped = account_for_files(self._root, self._paths.values())
        return DataAccount(PHOTOGRAPHS, len(self._paths), read, skipped, {})

    def focal_length(self, identifier: str) -> FocalLength:
        """Return the focal length of a photograph and its source."""
        from drivesem.data.photographs import read_focal_length

        return read_focal_length(self._paths[identifier], self._focal_px)

    def identifiers(self) -> Iterator[str]:
        return iter(self._paths)

    def has_vehicles(self, identifier: str) -> bool:
        from drivesem.scenes.label_free import VEHICLE_CLASSES, detect

        detections = detect(self._frame(identifier), self._finder)
        return any(self._finder.classes[int(label)] in VEHICLE_CLASSES for label in detections.labels)

    def photograph(self, identifier: str) -> Tensor:
        return self._frame(identifier).photograph

    def scene(self, identifier: str) -> SceneIR:
        from drivesem.scenes.label_free import detect, label_from_detections

        frame = self._frame(identifier)
        frame = label_from_detections(frame, detect(frame, self._finder), self._finder.classes)
        return _derender(frame, self._settings, self._cache)

    def _frame(self, identifier: str) -> Frame:
        from drivesem.data.photographs import read_photograph

        return read_photograph(self._paths[identifier], self._focal_px)


class SceneFolderSource:
    """Scenes of a folder, or of all folders below it, as photographed. Raises FormatError if there is none."""

    def __init__(self, root: Path) -> None:
        self._folders = find_scene_folders(root)

    def account(self) -> None:
        return None

    def identifiers(self) -> Iterator[str]:
        return iter(self._folders)

    def has_vehicles(self, identifier: str) -> bool:
        from scene_ir.io import count_objects

        return count_objects(self._folders[identifier]) > 0

    def photograph(self, identifier: str) -> Tensor:
        return self.scene(identifier).photograph

    def scene(self, identifier: str) -> SceneIR:
        from scene_ir.io import load_scene

        return load_scene(self._folders[identifier]).as_photographed()


def find_scene_folders(root: Path) -> dict[str, Path]:
    """Find the scenes in or below a folder, by name. Raises FormatError if there is none."""
    records = [root / _RECORD] if (root / _RECORD).is_file() else sorted(root.rglob(_RECORD))
    # a scene with exchanged vehicles contains the original
    records = [record for record in records if record.parent.name != _BEFORE]
    if not records:
        raise FormatError(str(root), f"a scene of drivesem derender ({_RECORD}), or folders of some", "none")
    folders = {_scene_name(record.parent, root): record.parent for record in records}
    if len(folders) < len(records):
        raise FormatError(str(root), "scenes with unique names", "two alike")
    return folders


def _scene_name(folder: Path, root: Path) -> str:
    """Return a scene's name: its relative folder without generic parts."""
    parts = [part for part in folder.relative_to(root).parts if part not in ("frames", "scene")]
    return "_".join(parts) or folder.resolve().name


def place_vehicles(frame: Frame, settings: DerenderSettings) -> tuple[Frame, DerenderSettings]:
    """Estimate the poses of vehicles if a frame has 2D boxes only; returns the frame and the adapted settings."""
    from drivesem.data.classes import count_vehicles
    from drivesem.scenes.label_free import FIT_TO_LABELS, estimate_label_poses, has_poses

    if frame.labels is None or has_poses(frame.labels) or not count_vehicles(frame.labels, settings.people):
        return frame, settings
    return estimate_label_poses(frame), replace(settings, fitting=FIT_TO_LABELS)


def _derender(frame: Frame, settings: DerenderSettings, cache: SceneCache | None) -> SceneIR:
    from scene_ir.derender.derender import derender

    make = partial(derender, frame, settings)
    return make() if cache is None else cache.get_or_make((frame, settings), make)


def _load_finder(config: SceneOptions) -> Predictor:
    """Load the detector of vehicles in photographs without labels."""
    from detectors.base import DetectorError
    from detectors.registry import load_predictor

    try:
        return load_predictor(config.finder)
    except DetectorError as error:
        raise UsageError.from_detector_error("--finder", "a detector", error) from error


def derender_settings(
    fit: bool, meshes: str | Path | None = None, segmenter: str | Path | None = None, people: bool = False
) -> DerenderSettings:
    """Make the settings of de-rendering.

    Args:
        fit: Fit vehicles to their outlines.
        meshes: Folder of additional meshes.
        segmenter: ONNX file of a segmentation network.
        people: Make objects of people and cyclists too.

    Returns:
        The settings.

    Raises:
        FormatError: A file that cannot be read.
    """
    from scene_ir.derender.derender import DerenderSettings
    from scene_ir.derender.silhouette import UserMesh

    settings = replace(DerenderSettings() if fit else DerenderSettings.fast(), people=people)
    if segmenter is not None:
        from drivesem.scenes.segmenter import OnnxSegmenter

        settings = replace(settings, segmenter=OnnxSegmenter(Path(segmenter)))
    if meshes is not None:
        from drivesem.synth.assets import meshes_in
        from scene_ir.meshes.lod import simplify

        user_meshes = (UserMesh(simplify(v.mesh, _MAX_FACES), v.kind, v.size_lhw) for v in meshes_in(str(meshes)))
        settings = replace(settings, meshes=tuple(user_meshes))
    return settings


def _make_settings(config: SceneOptions) -> DerenderSettings:
    if isinstance(config, DerenderConfig):
        return derender_settings(config.fit, config.meshes, config.segmenter, config.people)
    return derender_settings(config.fit, people=config.moves_people)


def _open_cache(config: SceneOptions) -> SceneCache | None:
    if config.cache is None:
        return None
    from drivesem.scenes.scene_cache import SceneCache

    cache = SceneCache(Path(config.cache), config.cache_gb)
    cache.evict()  # the limit may be lower than the last command's
    return cache


def open_source(config: SceneOptions) -> SceneSource:
    """Open the configured source. Raises SceneError for an unknown or unreadable data set."""
    if isinstance(config, DerenderConfig) and config.photo is not None:
        return PhotographSource(Path(config.photo), config)
    if config.dataset == DEMO:
        return DemoSource(config.seed, config.limit or DEMO_SCENES)
    if config.dataset == PHOTOGRAPHS:
        return PhotographSource(local_copy(config.root or ""), config)
    if config.dataset == SCENES:
        return SceneFolderSource(local_copy(config.root or ""))
    return DatasetSource(config)


def compile_source_kernels(config: SceneOptions) -> None:
    """Compile or load all kernels of a source's frames at once, before the first frame."""
    from scene_ir.render import fast

    if config.dataset != DEMO:
        fast.compile_kernels(())
        return
    from drivesem.synth import kernels, mesh_kernels

    fast.compile_kernels((kernels, mesh_kernels))
