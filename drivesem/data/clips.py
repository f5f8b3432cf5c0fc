"""Clips: frames of one drive in their order, and which of their labels are the same object."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from drivesem.data import kitti_tracking
from drivesem.data.kitti import KittiDataset
from drivesem.data.layouts import layout_of
from drivesem.data.registry import DATASETS, Dataset
from drivesem.data.virtual import VirtualDataset
from drivesem.store import place
from scene_ir import files
from scene_ir.errors import FormatError

_MANIFEST = "manifest.json"
_HOLDS = (
    "Virtual KITTI, a KITTI tracking folder, or what drivesem synth --sequence wrote (layout kitti or vkitti2)"
)


@dataclass(frozen=True, slots=True)
class Clip:
    """One drive. frames: identifiers in the data set, in order; tracks: of a frame's labels, in their order."""

    name: str
    dataset: Dataset
    frames: tuple[str, ...]
    tracks: Callable[[str], tuple[int, ...]]


def clips_in(root: Path | str) -> dict[str, Clip]:
    """The clips of a folder, or of its URL, by name and in order. FormatError for a folder of other things."""
    folder = place(root)
    if not folder.is_dir():
        raise FormatError(str(root), f"a folder of clips: {_HOLDS}", "no such folder")
    if kitti_tracking.folder_of(folder) is not None:
        names = kitti_tracking.sequences_of(folder)
        sequences = {name: kitti_tracking.KittiTracking(folder, name) for name in names}
        return {name: Clip(name, one, one.identifiers, one.tracks) for name, one in sequences.items()}
    layout = layout_of(folder)
    if layout in ("vkitti1", "vkitti2"):
        dataset = DATASETS[layout](folder)
        assert isinstance(dataset, VirtualDataset)
        return {name: Clip(name, dataset, frames, dataset.tracks) for name, frames in dataset.clips().items()}
    if layout == "kitti" and (folder / _MANIFEST).is_file():
        return _generated(folder)
    raise FormatError(str(root), _HOLDS, f"{layout or 'none of them'}, without tracks")


def _generated(folder: Path) -> dict[str, Clip]:
    """What the generator wrote in KITTI's layout, whose manifest knows the tracks."""
    path = folder / _MANIFEST
    manifest = files.read_json(path)
    try:
        length, entries = int(manifest["sequence"]), list(manifest["frames"])
        tracks = {
            f"{int(entry['number']):06d}": tuple(int(o["track"]) for o in entry["objects"] if o["labelled"])
            for entry in entries
        }
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(str(path), "what drivesem synth writes", f"{type(error).__name__} {error}") from error
    if length < 2:
        raise FormatError(f"{path}: sequence", "at least 2 frames of one drive (synth --sequence)", length)
    dataset, names = KittiDataset(folder), list(tracks)
    drives = {f"{i // length:02d}": tuple(names[i : i + length]) for i in range(0, len(names), length)}
    return {name: Clip(name, dataset, frames, tracks.__getitem__) for name, frames in drives.items()}


def clip_of(clips: Mapping[str, Clip], name: str | None) -> Clip:
    """The clip of that name, by default the first. FormatError for one that is not there."""
    if name is None:
        return next(iter(clips.values()))
    if name not in clips:
        raise FormatError("--sequence", f"one of {', '.join(clips)}", name)
    return clips[name]
