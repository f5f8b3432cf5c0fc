"""Parts and combinations of data sets: splits, several folders as one data set, and clips of consecutive frames."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from drivesem.config.constraints import is_url, parse_attributes, parse_class_map
from drivesem.config.options import FrameFilterOptions
from drivesem.data import kitti_tracking
from drivesem.data.account import DataAccount, sum_accounts
from drivesem.data.classes import check_class_map, rename_to_types, rider_rows
from drivesem.data.kitti import KittiDataset
from drivesem.data.label_table import select_by_attributes
from drivesem.data.layouts import detect_layout
from drivesem.data.registry import DATASETS, Dataset, open_dataset
from drivesem.data.vkitti import VirtualKittiDataset
from drivesem.store import local_copy
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.types import Frame, Labels

PUBLISHED_SPLITS = ("3d-sdn", "3d-sdn-train")
"""Published splits by name: the frames to test on, and those to train on."""
_TEST_FRAMES = {1: range(356, 447), 2: range(185, 233), 6: range(69), 18: range(270, 339), 20: range(167)}
"""Frames of each world that 3D-SDN tests on, in all ten variations; it trains on all others (Yao et al. 2018,
`get_lists` of their code): 4,440 and 16,820 of 21,260 images."""
_RANDOM_SPLIT = re.compile(r"random:(0?\.\d+)(:rest)?")
_SPLIT_SEED = 20261125
"""Seed of the random order, the same for both parts."""
_MANIFEST = "manifest.json"
_CLIP_FOLDERS = (
    "Virtual KITTI, a KITTI tracking folder, or the output of drivesem synth --sequence (layout kitti or vkitti2)"
)


@dataclass(frozen=True, slots=True)
class FrameFilter:
    """Which frames of a data set are used, and under which class names."""

    split: str | None = None
    """Split; see `select_split`."""
    where: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Allowed values by attribute; a frame must have one of them for each attribute."""
    mapping: Mapping[str, str | None] = field(default_factory=dict)
    """New class names; None makes a class background."""

    @classmethod
    def from_options(cls, options: FrameFilterOptions) -> FrameFilter:
        """Return the filter that options configure."""
        where = parse_attributes("--where", options.where)
        return cls(options.split, where, parse_class_map("--map", options.map))

    def describe(self) -> str:
        """Return the selection as text, empty if all frames are used."""
        parts = [f"split {self.split}"] if self.split is not None else []
        parts += [f"{name} {' or '.join(values)}" for name, values in self.where.items()]
        return ", ".join(parts)


class DatasetSelection:
    """Some frames of a data set, in its order, with the object types of its classes as names."""

    def __init__(self, dataset: Dataset, identifiers: Sequence[str], choice: FrameFilter) -> None:
        self._dataset, self._identifiers, self._choice = dataset, tuple(identifiers), choice

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the selected frames."""
        return self._identifiers

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Identifiers by split, where the data set has splits."""
        return self._dataset.splits()

    def account(self) -> DataAccount:
        """Account for the whole data set, and name the selection."""
        selected = self._choice.describe()
        text = f"used: {len(self._identifiers):,} images ({selected})" if selected else ""
        return replace(self._dataset.account(), selection=text, mapping=self._choice.mapping)

    def attributes(self, identifier: str) -> Mapping[str, str]:
        """Attributes that the data set states of a frame."""
        return self._dataset.attributes(identifier)

    def labels(self, identifier: str) -> Labels | None:
        """Read the labels of one frame; None where the data set has none."""
        labels = self._dataset.labels(identifier)
        return None if labels is None else rename_to_types(labels, self._choice.mapping)

    def frame(self, identifier: str) -> Frame:
        """Read one frame. Raises FormatError naming a damaged file."""
        frame = self._dataset.frame(identifier)
        attributes, mapping = self._dataset.attributes(identifier), self._choice.mapping
        if frame.labels is None:
            return replace(frame, attributes=attributes)
        riders = {f"labels[{row}].name": "rider" for row in rider_rows(frame.labels, mapping)}
        labels = rename_to_types(frame.labels, mapping)
        return replace(frame, labels=labels, attributes=attributes, provenance={**frame.provenance, **riders})


def open_selection(
    name: str,
    roots: str | Path,
    choice: FrameFilter | None = None,
    with_points: bool = False,
    focal_px: float | None = None,
) -> DatasetSelection:
    """Open the frames of a data set that a filter selects.

    Args:
        name: Layout, a key of DATASETS.
        roots: Folder or URL; or several, separated by commas, as one data set.
        choice: Frames and class names; by default all frames.
        with_points: Read laser points, which only KITTI has.
        focal_px: Focal length of photographs without a camera.

    Returns:
        The selected frames.

    Raises:
        FormatError: As `open_dataset`; a split or an attribute that the data set does not have; no frame.
        RangeError: As `open_dataset`; a class name that means no object type.
    """
    choice = choice or FrameFilter()
    check_class_map(choice.mapping)
    folders = [part for part in str(roots).split(",") if part] if not is_url(str(roots)) else [str(roots)]
    opened = [open_dataset(name, folder, with_points, focal_px) for folder in folders]
    dataset = opened[0] if len(opened) == 1 else JoinedDataset(opened)
    selected = dataset.identifiers if choice.split is None else select_split(dataset, choice.split)
    if choice.where:
        selected = select_by_attributes({name: dataset.attributes(name) for name in selected}, choice.where)
    return DatasetSelection(dataset, selected, choice)


def select_split(dataset: Dataset, split: str) -> list[str]:
    """Return the identifiers of a split, in the data set's order.

    `split` is one of the data set's own (such as train, val), one of PUBLISHED_SPLITS (Virtual KITTI only),
    `random:0.75` (a fixed random share), `random:0.75:rest` (all others), or a text file with one name a line, with or
    without a suffix such as .png. Raises FormatError for a data set without that split, a name without a frame, and
    an empty selection.
    """
    identifiers, share, own = dataset.identifiers, _RANDOM_SPLIT.fullmatch(split), dataset.splits()
    if split in own:
        selected = set(own[split])
    elif split in PUBLISHED_SPLITS:
        selected = {name for name in identifiers if _is_test_frame(name) == (split == PUBLISHED_SPLITS[0])}
    elif share is not None:
        order = np.random.default_rng(_SPLIT_SEED).permutation(len(identifiers))
        count = round(float(share[1]) * len(identifiers))
        selected = {identifiers[i] for i in (order[count:] if share[2] else order[:count])}
    elif not Path(split).is_file() and split.isidentifier():
        expected = f"one of {', '.join(own)}, " if own else ""
        raise FormatError("--split", f"{expected}random:FRACTION, or a file of names", repr(split))
    else:
        selected = _read_names(Path(split), identifiers)
    if not selected:
        raise FormatError(f"--split {split}", "at least one frame of the data set", f"none of {len(identifiers)}")
    return [name for name in identifiers if name in selected]


def _is_test_frame(name: str) -> bool:
    """Whether 3D-SDN tests on a frame, `0001/clone/00003` or `Scene01/clone/Camera_0/00003`."""
    world, number = name.split("/")[0].removeprefix("Scene"), name.split("/")[-1]
    if "/" not in name or not (world.isdecimal() and number.isdecimal()) or int(world) not in _TEST_FRAMES:
        worlds = ", ".join(map(str, _TEST_FRAMES))
        raise FormatError("--split", f"frames of Virtual KITTI's worlds {worlds} (vkitti1, vkitti2)", repr(name))
    return int(number) in _TEST_FRAMES[int(world)]


def _read_names(path: Path, identifiers: Sequence[str]) -> set[str]:
    known = set(identifiers)
    names: set[str] = set()
    for number, line in enumerate(files.read_text(path).splitlines(), start=1):
        name = line.strip()
        if name and name not in known:
            name = str(Path(name).with_suffix("")) if Path(name).name else name  # "." and "/" have none
            if name not in known:
                expected = f"a frame such as {identifiers[0]}" if identifiers else "nothing"
                raise FormatError(f"{path}:{number}", expected, repr(line))
        names |= {name} - {""}
    return names


class JoinedDataset:
    """The frames of several data sets, one after the other. Identifiers: "NUMBER/IDENTIFIER", numbers from 0."""

    def __init__(self, datasets: Sequence[Dataset]) -> None:
        self._datasets = tuple(datasets)

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, in the order of the data sets, each sorted."""
        return tuple(f"{i}/{name}" for i, dataset in enumerate(self._datasets) for name in dataset.identifiers)

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Identifiers by split, where the data sets have splits."""
        joined: dict[str, tuple[str, ...]] = {}
        for i, dataset in enumerate(self._datasets):
            for split, names in dataset.splits().items():
                joined[split] = (*joined.get(split, ()), *(f"{i}/{name}" for name in names))
        return joined

    def account(self) -> DataAccount:
        """Account for all data sets together."""
        return sum_accounts([dataset.account() for dataset in self._datasets])

    def attributes(self, identifier: str) -> Mapping[str, str]:
        """Attributes that a frame's data set states of it."""
        dataset, name = self._locate(identifier)
        return dataset.attributes(name)

    def labels(self, identifier: str) -> Labels | None:
        """Read the labels of one frame; None where its data set has none."""
        dataset, name = self._locate(identifier)
        return dataset.labels(name)

    def frame(self, identifier: str) -> Frame:
        """Read one frame. Raises FormatError naming a damaged file."""
        dataset, name = self._locate(identifier)
        return dataset.frame(name)

    def _locate(self, identifier: str) -> tuple[Dataset, str]:
        number, _, name = identifier.partition("/")
        return self._datasets[int(number)], name


@dataclass(frozen=True, slots=True)
class Clip:
    """Consecutive frames of one drive."""

    name: str
    """Name, unique in its folder."""
    dataset: Dataset
    """Data set that reads the frames."""
    frames: tuple[str, ...]
    """Identifiers in the data set, in temporal order."""
    tracks: Callable[[str], tuple[int, ...]]
    """Maps a frame's identifier to the track of each of its labels, in their order."""


def find_clips(root: Path | str) -> dict[str, Clip]:
    """Find the clips of a folder or URL, by name, in order. Raises FormatError for a folder without clips."""
    folder = local_copy(root)
    if not folder.is_dir():
        raise FormatError(str(root), f"a folder of clips: {_CLIP_FOLDERS}", "no such folder")
    if kitti_tracking.find_tracking_folder(folder) is not None:
        names = kitti_tracking.list_sequences(folder)
        sequences = {name: kitti_tracking.KittiTrackingDataset(folder, name) for name in names}
        return {name: Clip(name, reader, reader.identifiers, reader.tracks) for name, reader in sequences.items()}
    layout = detect_layout(folder)
    if layout in ("vkitti1", "vkitti2"):
        dataset = DATASETS[layout](folder)
        assert isinstance(dataset, VirtualKittiDataset)
        return {name: Clip(name, dataset, frames, dataset.tracks) for name, frames in dataset.clips().items()}
    if layout == "kitti" and (folder / _MANIFEST).is_file():
        return _find_generated_clips(folder)
    raise FormatError(str(root), _CLIP_FOLDERS, f"{layout or 'none of them'}, without tracks")


def _find_generated_clips(folder: Path) -> dict[str, Clip]:
    """Find the clips that the generator wrote in KITTI's layout; its manifest has the tracks."""
    path = folder / _MANIFEST
    manifest = files.read_json(path)
    try:
        length, entries = int(manifest["sequence"]), list(manifest["frames"])
        tracks = {
            f"{int(entry['number']):06d}": tuple(int(o["track"]) for o in entry["objects"] if o["labelled"])
            for entry in entries
        }
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(str(path), "a manifest of drivesem synth", f"{type(error).__name__} {error}") from error
    if length < 2:
        raise FormatError(f"{path}: sequence", "at least 2 frames of one drive (synth --sequence)", length)
    dataset, names = KittiDataset(folder), list(tracks)
    drives = {f"{i // length:02d}": tuple(names[i : i + length]) for i in range(0, len(names), length)}
    return {name: Clip(name, dataset, frames, tracks.__getitem__) for name, frames in drives.items()}


def select_clip(clips: Mapping[str, Clip], name: str | None) -> Clip:
    """Return the clip of a name, by default the first. Raises FormatError for an unknown name."""
    if name is None:
        return next(iter(clips.values()))
    if name not in clips:
        raise FormatError("--sequence", f"one of {', '.join(clips)}", name)
    return clips[name]
