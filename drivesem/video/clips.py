"""De-renders a clip frame by frame, with one mesh and one size per vehicle in all of its frames."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from operator import itemgetter
from pathlib import Path

from drivesem.config.commands import DerenderConfig
from drivesem.config.devices import memory_gb
from drivesem.config.errors import UsageError
from drivesem.config.options import DEMO, WorkerOptions
from drivesem.data.subsets import Clip, find_clips, select_clip
from drivesem.reporting.tables import format_count
from drivesem.run.derender import RECORD
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.scenes.sources import compile_source_kernels, derender_settings
from scene_ir.derender.derender import VEHICLE_CATEGORIES, DerenderSettings, derender, place_vehicles
from scene_ir.derender.silhouette import Placement, place_mesh, rank_template_kinds
from scene_ir.errors import FormatError, SceneError
from scene_ir.io import load_scene, save_scene
from scene_ir.types import Camera, Labels, SceneIR

DEMO_FRAMES = 30
"""Frames of the embedded clip: three seconds."""
_TRACKS = "tracks"
"""Provenance key of a scene: the tracks of its labels."""
_BYTES_A_PIXEL = 180
"""Memory of an attack per pixel of each frame: its maps, and the detector's layers for the photograph."""


@dataclass(frozen=True, slots=True)
class ClipSource:
    """The clip to de-render."""

    folder: str | None
    """Folder of clips; None for the embedded one."""
    name: str | None
    """Name of the clip; None for the first."""
    limit: int | None
    """Number of frames from the first one."""
    seed: int
    """Seed of the embedded clip."""
    fit: bool
    """Whether to fit shapes."""
    keep_going: bool
    """Whether to skip frames that cannot be used."""
    people: bool = False
    """Whether people and cyclists become objects."""


@dataclass(frozen=True, slots=True)
class DerenderedClip:
    """The scenes of a clip, in order."""

    name: str
    """Name of the clip."""
    names: tuple[str, ...]
    """Names of the frames."""
    scenes: tuple[SceneIR, ...]
    """Scene of each frame."""
    tracks: tuple[tuple[int, ...], ...]
    """Track of each object in each frame."""
    background_people: tuple[frozenset[int], ...] = ()
    """Tracks of the people in each frame that stay in its background; empty if there are none."""
    failed: dict[str, str] = field(default_factory=dict)
    """Why other frames could not be used."""


class _DemoFrames:
    """Frames of the embedded clip."""

    def __init__(self, source: ClipSource) -> None:
        from drivesem.synth.demo import make_drive

        self._drive = make_drive(source.seed, source.limit or DEMO_FRAMES)
        self.name = DEMO
        self.names = tuple(f"drive-{number:03d}" for number in range(self._drive.frames))

    def scene(self, name: str) -> SceneIR:
        return self._drive.scene(self.names.index(name))

    def camera(self) -> Camera:
        """Camera of the first frame."""
        return self._drive.plan(0).setting.view.camera


class _LabelledFrames:
    """Frames of a labelled clip.

    A vehicle takes its shape and size from the frame that shows it best, and its pose from each frame's label: poses
    fitted frame by frame differ, and vehicles would jitter. A person moves arms and legs, and is cut out of each frame.
    """

    def __init__(self, source: ClipSource) -> None:
        self._clip = select_clip(find_clips(source.folder or ""), source.name)
        self.name = self._clip.name
        self.names = self._clip.frames[: source.limit]
        self._fit, self._people = source.fit, source.people
        self._passed_over = (SceneError,) if source.keep_going else ()
        self._shapes: dict[int, Placement] | None = None

    def scene(self, name: str) -> SceneIR:
        labels, tracks = _load_labels(self._clip, name), self._clip.tracks(name)
        known = [self._place_vehicle(labels, row, track) for row, track in enumerate(tracks)]
        frame = self._clip.dataset.frame(name)
        settings = replace(DerenderSettings.fast(), known_placements=tuple(known), people=self._people)
        scene = derender(frame, settings)
        return replace(scene, provenance=dict(scene.provenance) | {_TRACKS: ",".join(map(str, tracks))})

    def camera(self) -> Camera | None:
        """Camera of the first readable frame; None without one."""
        for name in self.names:
            with suppress(*self._passed_over):
                return self._clip.dataset.frame(name).camera
        return None

    def _place_vehicle(self, labels: Labels, row: int, track: int) -> Placement | None:
        """Place a label's vehicle at the label; None where it is no vehicle."""
        kind, size = labels.kind[row], labels.size_lhw[row]
        if kind not in VEHICLE_CATEGORIES or not bool((size > 0).all()):
            return None
        at = labels.translation[row], labels.yaw[row]
        shape = self._load_shapes().get(track)
        if shape is None:  # no frame determines its shape
            return place_mesh(rank_template_kinds(kind, size.tolist())[0], *at, size)
        return replace(shape, translation=at[0], yaw=at[1])

    def _load_shapes(self) -> dict[int, Placement]:
        """The shape of each track, from the best of its usable frames; computed once per process."""
        if self._shapes is None:
            load = cache(self._shapes_in)
            best = {
                track: next((shapes for name in names if (shapes := load(name)) is not None), {})
                for track, names in self._rank_frames().items()
            }
            # assigned at once: a partial result would leave vehicles of other frames without a shape
            self._shapes = {track: shapes[track] for track, shapes in best.items() if track in shapes}
        return self._shapes

    def _shapes_in(self, name: str) -> dict[int, Placement] | None:
        """The shapes in a frame by track; None where the frame is skipped."""
        with suppress(*self._passed_over):
            found = place_vehicles(self._clip.dataset.frame(name), derender_settings(self._fit))
            tracks = self._clip.tracks(name)
            return {tracks[row]: placement for row, placement in found.items()}
        return None

    def _rank_frames(self) -> dict[int, list[str]]:
        """The frames of each vehicle's track, the best first: little occluded and truncated, then largest."""
        ranked_frames: dict[int, list[tuple[tuple[bool, bool, float], str]]] = {}
        for name in self.names:
            with suppress(*self._passed_over):
                labels = _load_labels(self._clip, name)
                heights = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
                for row, track in enumerate(self._clip.tracks(name)):
                    if labels.kind[row] in VEHICLE_CATEGORIES:
                        plain = int(labels.occlusion[row]) <= 1, float(labels.truncation[row]) < 0.1
                        ranked_frames.setdefault(track, []).append(((*plain, float(heights[row])), name))
        return {
            track: [name for _, name in sorted(ranked, key=itemgetter(0), reverse=True)]
            for track, ranked in ranked_frames.items()
        }


def _load_labels(clip: Clip, name: str) -> Labels:
    labels = clip.dataset.labels(name)
    if labels is None or len(labels.kind) != len(clip.tracks(name)):
        found = "none" if labels is None else f"{len(labels.kind)}"
        raise FormatError(
            f"frame {name}: labels", f"one for each of {format_count(len(clip.tracks(name)), 'track')}", found
        )
    return labels


class ClipDerenderer:
    """Per-process state, built once and reused for all frames."""

    def __init__(self, source: ClipSource, out: Path) -> None:
        self.frames = _DemoFrames(source) if source.folder is None else _LabelledFrames(source)
        self.source, self.out = source, out

    def __call__(self, name: str) -> None:
        """De-render one frame into its folder. Raises SceneError where it cannot be used."""
        save_scene(self.frames.scene(name), self.out / name)


def derender_clip(work: ClipDerenderer, workers: WorkerOptions) -> DerenderedClip:
    """De-render the frames of a clip that are not in the output folder yet, and load all.

    Raises UsageError or SceneError for a clip that cannot be read or has no vehicle.
    """
    source, out = work.source, work.out
    names = work.frames.names
    _check_memory(work.frames)
    todo = [name for name in names if not (out / name / RECORD).is_file()]
    if todo:
        compile_source_kernels(
            DerenderConfig(dataset=DEMO if source.folder is None else "kitti", root=source.folder)
        )
    failed = run_frame_jobs(
        todo,
        work,
        partial(ClipDerenderer, source, out),
        workers,
        ProgressSettings("de-rendering frames", show_remaining=True),
    ).failed
    usable = tuple(name for name in names if name not in failed)
    scenes = tuple(load_scene(out / name) for name in usable)
    if not any(len(scene.objects) for scene in scenes):
        found = next(iter(failed.values()), f"none in {format_count(len(usable), 'frame')}")
        kinds = "cars, vans, trucks or people" if source.people else "cars, vans or trucks"
        raise UsageError("CLIP", f"frames with {kinds} that can be de-rendered", found)
    return DerenderedClip(
        work.frames.name,
        usable,
        scenes,
        tuple(map(object_tracks, scenes)),
        tuple(map(background_people, scenes)),
        failed,
    )


def _check_memory(frames: _DemoFrames | _LabelledFrames) -> None:
    """Raise UsageError where the clip's frames do not fit into memory together."""
    camera = frames.camera()
    if camera is None:
        return
    there, needed = memory_gb(), _BYTES_A_PIXEL * camera.width * camera.height / 2**30
    if there is not None and len(frames.names) * needed > there:
        expected = f"at most {format_count(int(there / needed), 'frame')}, which fit into {there:g} GB of memory"
        raise UsageError("CLIP: frames", f"{expected} (--limit takes the first)", f"{len(frames.names)}")


def object_tracks(scene: SceneIR) -> tuple[int, ...]:
    """Read the tracks of a scene's objects from its provenance."""
    tracks = scene.provenance[_TRACKS].split(",")
    return tuple(int(tracks[int(scene.provenance[f"objects[{i}].label"])]) for i in range(len(scene.objects)))


def background_people(scene: SceneIR) -> frozenset[int]:
    """Read the tracks of the people who stay in a scene's background from its provenance."""
    tracks = scene.provenance[_TRACKS].split(",")
    return frozenset(
        int(track) for row, track in enumerate(tracks) if f"labels[{row}].background" in scene.provenance
    )
