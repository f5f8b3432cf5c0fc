"""A clip before and after its change, one above the other, as WebM (VP8), which browsers play."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from scene_ir import files
from scene_ir.errors import WriteError
from scene_ir.raster.launch import without_stderr

FRAMES_A_SECOND = 10
_GAP_PX = 4


def write_video(path: Path, folders: Sequence[Path]) -> None:
    """Write a video of folders with before.jpg and after.jpg, a frame each, atomically. WriteError where OpenCV
    was built without VP8.
    """
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / path.name
        writer: cv2.VideoWriter | None = None
        for one in folders:
            picture = _above_each_other(one)
            writer = writer or _writer(part, (picture.shape[1], picture.shape[0]))
            if not writer.isOpened():
                raise WriteError(str(path), "this OpenCV cannot write VP8")
            writer.write(picture[..., ::-1])
        if writer is not None:
            writer.release()
            files.write_bytes(path, files.read_bytes(part))


def _above_each_other(folder: Path) -> np.ndarray:
    """The frame before and after (h, w, 3), with even sides, as the codec needs: the last row and column twice."""
    before, after = (files.read_image(folder / f"{name}.jpg") for name in ("before", "after"))
    picture = np.concatenate([before, np.zeros((_GAP_PX, *before.shape[1:]), np.uint8), after])
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _writer(path: Path, size_wh: tuple[int, int]) -> cv2.VideoWriter:
    with without_stderr():  # where it says that WebM has no such tag, which it does not need
        code = cv2.VideoWriter.fourcc(*"VP80")
        return cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, FRAMES_A_SECOND, size_wh)
