"""KITTI's tracking folders: `training/image_02/0000/000000.png`, `label_02/0000.txt`, `calib/0000.txt`.

A line of labels is the object benchmark's (`drivesem.data.kitti`) after two more fields, the frame and the track.
Truncation is a level from 0 to 2 (development kit, Geiger et al. 2012), read as the mean share of the level. "Person"
is "Person_sitting". Errors name the file, the line and the field.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from drivesem.data import kitti
from drivesem.data.account import DataAccount, account_for_files
from drivesem.data.kitti_labels import KittiLabelLines, finite_number
from drivesem.data.photographs import FrameIndex, check_image_size, list_images, read_upright
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.io import to_tensor
from scene_ir.types import Camera, Frame, Labels

IMAGES, LABELS = "image_02", "label_02"
_TRUNCATION = {"0": "0", "1": "0.2", "2": "0.6"}
"""Shares of the levels "not", "partly" and "largely" truncated."""
_KINDS = {"Person": "Person_sitting"}
_MAX_LINES = 200_000
"""Limit of one sequence; KITTI's longest have about ten thousand."""


@dataclass(frozen=True, slots=True)
class _FrameLines:
    """Label lines of one frame."""

    text: str
    """Text of the file with other frames' lines left empty, so that line numbers stay."""
    tracks: tuple[int, ...]
    """Tracks of the objects, in the order of the lines, without regions."""


def find_tracking_folder(root: Path) -> Path | None:
    """Find the folder with image_02: the root or its `training`; None if there is none."""
    return next((f for f in (root / "training", root) if (f / IMAGES).is_dir()), None)


def list_sequences(root: Path) -> tuple[str, ...]:
    """List the names of the sequences. Raises FormatError if there is none."""
    folder = find_tracking_folder(root)
    names = () if folder is None else tuple(sorted(p.name for p in (folder / IMAGES).iterdir() if p.is_dir()))
    if not names:
        raise FormatError(str(root), f"a KITTI tracking folder with {IMAGES}/0000", "no sequence")
    return names


class KittiTrackingDataset(FrameIndex[Path]):
    """The frames of one sequence, by the names of their images.

    `root` contains `training`, or is that folder. Raises FormatError naming a missing folder or file, RangeError for
    an unknown sequence.
    """

    def __init__(self, root: Path, sequence: str) -> None:
        known = list_sequences(root)
        if sequence not in known:
            raise RangeError(f"sequence of {root}", f"one of {', '.join(known)}", sequence)
        folder = find_tracking_folder(root)
        assert folder is not None
        self._labels = folder / LABELS / f"{sequence}.txt"
        self._calib = folder / "calib" / f"{sequence}.txt"
        self._sequence = sequence
        images = list_images(folder / IMAGES / sequence)
        for image in images:
            if not image.stem.isdecimal():
                raise FormatError(str(image), "the frame's number as its name", image.stem)
        if not images:
            raise FormatError(str(folder / IMAGES / sequence), "at least one .png or .jpg", "none")
        super().__init__(folder / IMAGES / sequence, {image.stem: image for image in images})

    def account(self) -> DataAccount:
        """Account for the sequence's files and label rows."""
        images = [f"{self._entry(name)}" for name in self.identifiers]
        lines = KittiLabelLines([""], ["\n".join(rows.text for rows in self._by_frame.values())], scored=False)
        classes, regions = lines.count_rows()
        count, skipped = account_for_files(self._entry(self.identifiers[0]).parent, images)
        count += sum(path.is_file() for path in (self._labels, self._calib))
        return DataAccount("kitti-tracking", len(images), count, skipped, classes, regions)

    def labels(self, identifier: str) -> Labels:
        """Read the labels of one frame. Raises FormatError naming file, line and field."""
        rows = self._frame_lines(identifier)
        lines = KittiLabelLines([str(self._labels)], [rows.text], scored=False)
        kitti.check_scene(lines)
        return lines.to_table([identifier], scored=False).to_labels()

    def tracks(self, identifier: str) -> tuple[int, ...]:
        """Return the track of each label, in the order of `labels`."""
        return self._frame_lines(identifier).tracks

    def frame(self, identifier: str) -> Frame:
        """Read one frame: photograph, camera, labels. Raises FormatError naming the file and the fault."""
        path = self._entry(identifier)
        labels, projection = self.labels(identifier), kitti.read_calibration(self._calib).projection
        image = read_upright(path)
        height, width = image.shape[:2]
        camera = Camera(projection[:, :3].clone(), height, width, projection)
        check_image_size(path, camera, labels)
        provenance = {"dataset": "kitti-tracking", "sequence": self._sequence, "image": path.name}
        return Frame(identifier, to_tensor(image), camera, labels, provenance=provenance)

    def _frame_lines(self, identifier: str) -> _FrameLines:
        return self._by_frame.get(int(self._entry(identifier).stem), _FrameLines("", ()))

    @cached_property
    def _by_frame(self) -> dict[int, _FrameLines]:
        lines = files.read_text(self._labels).splitlines()
        if len(lines) > _MAX_LINES:
            raise FormatError(str(self._labels), f"at most {_MAX_LINES:,} lines", f"{len(lines):,}")
        by_frame: dict[int, tuple[list[tuple[int, str]], list[int]]] = {}
        for number, line in enumerate(lines):
            parts = line.split()
            if not parts:
                continue
            where = f"{self._labels}:{number + 1}"
            if len(parts) not in (17, 18):
                raise FormatError(where, "17 fields, or 18 with a score", len(parts))
            frame, track = _parse_integer(f"{where}: frame", parts[0]), _parse_integer(f"{where}: track", parts[1])
            kind, truncated, *rest = parts[2:]
            region = kind == "DontCare"
            if not region and truncated not in _TRUNCATION:
                raise FormatError(f"{where}: truncated", "0, 1 or 2", truncated)
            rows, tracks = by_frame.setdefault(frame, ([], []))
            if not region:
                if track in tracks:
                    raise FormatError(f"{where}: track", f"each once in frame {frame}", track)
                tracks.append(track)
            rows.append((number, " ".join([_KINDS.get(kind, kind), _TRUNCATION.get(truncated, "-1"), *rest])))
        return {frame: _FrameLines(_pad_lines(rows), tuple(tracks)) for frame, (rows, tracks) in by_frame.items()}


def _pad_lines(rows: list[tuple[int, str]]) -> str:
    """Join lines at their numbers, from 0, with empty lines in the gaps."""
    lines = [""] * (rows[-1][0] + 1)
    for number, line in rows:
        lines[number] = line
    return "\n".join(lines)


def _parse_integer(where: str, text: str) -> int:
    value = finite_number(where, text)
    if value != int(value):
        raise FormatError(where, "a whole number", text)
    return int(value)
