"""A clip taken apart, frame by frame, so that a car has one mesh and one size in all of its frames."""

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
from drivesem.data.clips import Clip, clip_of, clips_in
from drivesem.report.tables import format_count
from drivesem.run.derender import RECORD
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.scenes.sources import derender_settings, make_ready
from scene_ir.derender.derender import VEHICLE_CATEGORIES, DerenderSettings, derender, place_vehicles
from scene_ir.derender.silhouette import Placement, place_mesh, rank_template_kinds
from scene_ir.errors import FormatError, SceneError
from scene_ir.io import load_scene, save_scene
from scene_ir.types import Camera, Labels, SceneIR

DEMO_FRAMES = 30
"""Of the embedded drive: three seconds."""
_TRACKS = "tracks"
"""Key of a scene's provenance: the tracks of its labels."""
_BYTES_A_PIXEL = 180
"""What an attack on a clip keeps of each frame: its maps, and what the detector made of the photograph."""


@dataclass(frozen=True, slots=True)
class ClipSource:
    """What is taken apart. folder: of clips, None for the embedded drive; name: of the clip, None for the first;
    limit: frames, from the first on; fit: whether shapes are fitted; keep_going: past frames that cannot be used.
    """

    folder: str | None
    name: str | None
    limit: int | None
    seed: int
    fit: bool
    keep_going: bool


@dataclass(frozen=True, slots=True)
class DerenderedClip:
    """scenes, in order; tracks: of each scene's objects; failed: why others could not be used, by frame."""

    name: str
    names: tuple[str, ...]
    scenes: tuple[SceneIR, ...]
    tracks: tuple[tuple[int, ...], ...]
    failed: dict[str, str] = field(default_factory=dict)


class _DemoFrames:
    """The embedded drive's frames."""

    def __init__(self, taking: ClipSource) -> None:
        from drivesem.synth.drives import drive_of

        self._drive = drive_of(taking.seed, taking.limit or DEMO_FRAMES)
        self.name = DEMO
        self.names = tuple(f"drive-{number:03d}" for number in range(self._drive.frames))

    def scene(self, name: str) -> SceneIR:
        return self._drive.scene(self.names.index(name))

    def camera(self) -> Camera:
        """Of the first frame."""
        return self._drive.plan(0).setting.view.camera


class _LabelledFrames:
    """The frames of a labelled clip. A car's shape and size are those of the frame in which it is seen best; it
    stands where each frame's label says, whatever the photograph shows: what is found frame by frame differs from
    frame to frame, and cars would tremble.
    """

    def __init__(self, taking: ClipSource) -> None:
        self._clip = clip_of(clips_in(taking.folder or ""), taking.name)
        self.name = self._clip.name
        self.names = self._clip.frames[: taking.limit]
        self._fit = taking.fit
        self._passed_over = (SceneError,) if taking.keep_going else ()
        self._shapes: dict[int, Placement] | None = None

    def scene(self, name: str) -> SceneIR:
        labels, tracks = _labels_of(self._clip, name), self._clip.tracks(name)
        known = [self._standing(labels, row, track) for row, track in enumerate(tracks)]
        frame = self._clip.dataset.frame(name)
        scene = derender(frame, replace(DerenderSettings.fast(), known=tuple(known)))
        return replace(scene, provenance=dict(scene.provenance) | {_TRACKS: ",".join(map(str, tracks))})

    def camera(self) -> Camera | None:
        """Of the first frame that can be read; None where none can."""
        for name in self.names:
            with suppress(*self._passed_over):
                return self._clip.dataset.frame(name).camera
        return None

    def _standing(self, labels: Labels, row: int, track: int) -> Placement | None:
        """A label's vehicle where the label says; None where it is none."""
        kind, size = labels.kind[row], labels.size_lhw[row]
        if kind not in VEHICLE_CATEGORIES or not bool((size > 0).all()):
            return None
        at = labels.translation[row], labels.yaw[row]
        shape = self._known().get(track)
        if shape is None:  # in no frame could it be told what it is
            return place_mesh(rank_template_kinds(kind, size.tolist())[0], *at, size)
        return replace(shape, translation=at[0], yaw=at[1])

    def _known(self) -> dict[int, Placement]:
        """The shape of each track, looked at once by each process: in the best of its frames that can be used."""
        if self._shapes is None:
            look = cache(self._shapes_in)
            best = {
                track: next((shapes for name in names if (shapes := look(name)) is not None), {})
                for track, names in self._views().items()
            }
            # not before all are known: with some, other frames' cars would be of no shape
            self._shapes = {track: shapes[track] for track, shapes in best.items() if track in shapes}
        return self._shapes

    def _shapes_in(self, name: str) -> dict[int, Placement] | None:
        """The shapes that a frame shows, by track; None where it is passed over."""
        with suppress(*self._passed_over):
            found = place_vehicles(self._clip.dataset.frame(name), derender_settings(self._fit))
            tracks = self._clip.tracks(name)
            return {tracks[row]: placement for row, placement in found.items()}
        return None

    def _views(self) -> dict[int, list[str]]:
        """For each vehicle's track its frames, the best first: those that show it largest, of those in which it is
        hidden and cut least.
        """
        views: dict[int, list[tuple[tuple[bool, bool, float], str]]] = {}
        for name in self.names:
            with suppress(*self._passed_over):
                labels = _labels_of(self._clip, name)
                heights = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
                for row, track in enumerate(self._clip.tracks(name)):
                    if labels.kind[row] in VEHICLE_CATEGORIES:
                        plain = int(labels.occlusion[row]) <= 1, float(labels.truncation[row]) < 0.1
                        views.setdefault(track, []).append(((*plain, float(heights[row])), name))
        return {
            track: [name for _, name in sorted(ranked, key=itemgetter(0), reverse=True)]
            for track, ranked in views.items()
        }


def _labels_of(clip: Clip, name: str) -> Labels:
    labels = clip.dataset.labels(name)
    if labels is None or len(labels.kind) != len(clip.tracks(name)):
        found = "none" if labels is None else f"{len(labels.kind)}"
        raise FormatError(
            f"frame {name}: labels", f"one for each of {format_count(len(clip.tracks(name)), 'track')}", found
        )
    return labels


class ClipDerenderer:
    """What one process needs: built once, used for many frames."""

    def __init__(self, taking: ClipSource, out: Path) -> None:
        self.source = _DemoFrames(taking) if taking.folder is None else _LabelledFrames(taking)
        self.taking, self.out = taking, out

    def __call__(self, name: str) -> None:
        """One frame to its folder. SceneError for one that cannot be used."""
        save_scene(self.source.scene(name), self.out / name)


def derender_clip(work: ClipDerenderer, sharing: WorkerOptions) -> DerenderedClip:
    """The clip's frames, taken apart into the taker's folder as far as they are not there yet. Raises UsageError
    or SceneError for a clip that cannot be read, or has no vehicle.
    """
    taking, out = work.taking, work.out
    names = work.source.names
    _check_memory(work.source)
    todo = [name for name in names if not (out / name / RECORD).is_file()]
    if todo:
        make_ready(DerenderConfig(dataset=DEMO if taking.folder is None else "kitti", root=taking.folder))
    failed = run_frame_jobs(
        todo,
        work,
        partial(ClipDerenderer, taking, out),
        sharing,
        ProgressSettings("taking frames apart", show_remaining=True),
    ).failed
    kept = tuple(name for name in names if name not in failed)
    scenes = tuple(load_scene(out / name) for name in kept)
    if not any(len(scene.objects) for scene in scenes):
        found = next(iter(failed.values()), f"none in {format_count(len(kept), 'frame')}")
        raise UsageError("CLIP", "frames with cars, vans or trucks that can be taken apart", found)
    return DerenderedClip(work.source.name, kept, scenes, tuple(object_tracks(scene) for scene in scenes), failed)


def _check_memory(source: _DemoFrames | _LabelledFrames) -> None:
    """UsageError where the clip's frames would not fit into memory together."""
    camera = source.camera()
    if camera is None:
        return
    there, needed = memory_gb(), _BYTES_A_PIXEL * camera.width * camera.height / 2**30
    if there is not None and len(source.names) * needed > there:
        expected = f"at most {format_count(int(there / needed), 'frame')}, as memory of {there:g} GB holds"
        raise UsageError("CLIP: frames", f"{expected} (--limit takes the first)", f"{len(source.names)}")


def object_tracks(scene: SceneIR) -> tuple[int, ...]:
    """The tracks of a scene's objects."""
    told = scene.provenance[_TRACKS].split(",")
    return tuple(int(told[int(scene.provenance[f"objects[{i}].label"])]) for i in range(len(scene.objects)))
