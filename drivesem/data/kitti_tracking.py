"""KITTI's tracking folders: `training/image_02/0000/000000.png`, `label_02/0000.txt`, `calib/0000.txt`.

A line of labels is the object benchmark's (`drivesem.data.kitti`) after two more fields, the frame and the track.
By the development kit (Geiger et al. 2012) truncation is a level, 0 to 2, for which shares in the middle of what
they mean are taken here. "Person" is "Person_sitting". Errors name the file, the line and the field.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from drivesem.data import kitti
from drivesem.data.frames import Frames, as_photograph, check_size, images_of
from drivesem.data.kitti_labels import Lines, finite_number
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.types import Camera, Frame, Labels

IMAGES, LABELS = "image_02", "label_02"
_TRUNCATION = {"0": "0", "1": "0.2", "2": "0.6"}
"""Shares for the levels "not", "partly", "largely" cut by the picture's border."""
_KINDS = {"Person": "Person_sitting"}
_MOST_LINES = 200_000
"""Of one sequence: KITTI's longest have some ten thousand."""


@dataclass(frozen=True, slots=True)
class _Rows:
    """The lines of one frame. text: of the whole file, other frames' lines left empty, so that numbers of lines
    stay; tracks: of what is no region, in the lines' order.
    """

    text: str
    tracks: tuple[int, ...]


def folder_of(root: Path) -> Path | None:
    """The folder with image_02: the root or its `training`; None where there is none."""
    return next((f for f in (root / "training", root) if (f / IMAGES).is_dir()), None)


def sequences_of(root: Path) -> tuple[str, ...]:
    """Names of the sequences. FormatError where there is none."""
    folder = folder_of(root)
    found = () if folder is None else tuple(sorted(p.name for p in (folder / IMAGES).iterdir() if p.is_dir()))
    if not found:
        raise FormatError(str(root), f"a KITTI tracking folder, with {IMAGES}/0000 and its kin", "no sequence")
    return found


class KittiTracking(Frames[Path]):
    """The frames of one sequence, by the names of their images.

    root: the folder that holds `training`, or that itself. FormatError naming the folder or file where something
    is missing, RangeError for a sequence that is not there.
    """

    def __init__(self, root: Path, sequence: str) -> None:
        known = sequences_of(root)
        if sequence not in known:
            raise RangeError(f"sequence of {root}", f"one of {', '.join(known)}", sequence)
        folder = folder_of(root)
        assert folder is not None
        self._labels = folder / LABELS / f"{sequence}.txt"
        self._calib = folder / "calib" / f"{sequence}.txt"
        self._sequence = sequence
        images = images_of(folder / IMAGES / sequence)
        for image in images:
            if not image.stem.isdecimal():
                raise FormatError(str(image), "the frame's number as its name", image.stem)
        if not images:
            raise FormatError(str(folder / IMAGES / sequence), "at least one .png or .jpg", "none")
        super().__init__(folder / IMAGES / sequence, {image.stem: image for image in images})

    def labels(self, identifier: str) -> Labels:
        """The labels of one frame. FormatError naming file, line and field."""
        rows = self._rows(identifier)
        lines = Lines([str(self._labels)], [rows.text], scored=False)
        kitti.check_scene(lines)
        return lines.table([identifier], scored=False).labels()

    def tracks(self, identifier: str) -> tuple[int, ...]:
        """The track of each label of `labels`, in its order."""
        return self._rows(identifier).tracks

    def frame(self, identifier: str) -> Frame:
        """One frame: photograph (3, H, W) float32, camera, labels. FormatError naming the file and the fault."""
        path = self._entry(identifier)
        labels, projection = self.labels(identifier), kitti.read_calib(self._calib).projection
        image = files.read_image(path)
        height, width = image.shape[:2]
        camera = Camera(projection[:, :3].clone(), height, width, projection)
        check_size(path, camera, labels)
        told = {"dataset": "kitti-tracking", "sequence": self._sequence, "image": path.name}
        return Frame(identifier, as_photograph(image), camera, labels, provenance=told)

    def _rows(self, identifier: str) -> _Rows:
        return self._by_frame.get(int(self._entry(identifier).stem), _Rows("", ()))

    @cached_property
    def _by_frame(self) -> dict[int, _Rows]:
        lines = files.read_text(self._labels).splitlines()
        if len(lines) > _MOST_LINES:
            raise FormatError(str(self._labels), f"at most {_MOST_LINES:,} lines", f"{len(lines):,}")
        found: dict[int, tuple[list[tuple[int, str]], list[int]]] = {}
        for number, line in enumerate(lines):
            parts = line.split()
            if not parts:
                continue
            where = f"{self._labels}:{number + 1}"
            if len(parts) not in (17, 18):
                raise FormatError(where, "17 fields, or 18 with a score", len(parts))
            frame, track = _whole(f"{where}: frame", parts[0]), _whole(f"{where}: track", parts[1])
            kind, truncated, *rest = parts[2:]
            region = kind == "DontCare"
            if not region and truncated not in _TRUNCATION:
                raise FormatError(f"{where}: truncated", "0, 1 or 2", truncated)
            rows, tracks = found.setdefault(frame, ([], []))
            if not region:
                if track in tracks:
                    raise FormatError(f"{where}: track", f"each once in frame {frame}", track)
                tracks.append(track)
            rows.append((number, " ".join([_KINDS.get(kind, kind), _TRUNCATION.get(truncated, "-1"), *rest])))
        return {frame: _Rows(_spread(rows), tuple(tracks)) for frame, (rows, tracks) in found.items()}


def _spread(rows: list[tuple[int, str]]) -> str:
    """Lines at their numbers, from 0, and empty ones before and between them."""
    lines = [""] * (rows[-1][0] + 1)
    for number, line in rows:
        lines[number] = line
    return "\n".join(lines)


def _whole(where: str, text: str) -> int:
    value = finite_number(where, text)
    if value != int(value):
        raise FormatError(where, "a whole number", text)
    return int(value)
