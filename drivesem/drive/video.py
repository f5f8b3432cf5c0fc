"""A clip before and after its change, one above the other, as WebM (VP8), which browsers play."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from scene_ir import files
from scene_ir.errors import WriteError

FRAMES_A_SECOND = 10
_GAP_PX = 4


def write_video(path: Path, folders: Sequence[Path]) -> None:
    """Write a video of folders with before.jpg and after.jpg, a frame each, atomically. WriteError where OpenCV
    was built without VP8.
    """
    writer: cv2.VideoWriter | None = None
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / path.name
        for one in folders:
            before, after = (files.read_image(one / f"{name}.jpg") for name in ("before", "after"))
            gap = np.zeros((_GAP_PX, *before.shape[1:]), np.uint8)
            picture = _even(np.concatenate([before, gap, after]))
            if writer is None:
                code = cv2.VideoWriter.fourcc(*"VP80")
                size = picture.shape[1], picture.shape[0]
                writer = cv2.VideoWriter(str(part), cv2.CAP_FFMPEG, code, FRAMES_A_SECOND, size)
            writer.write(picture[..., ::-1])
        if writer is None or not writer.isOpened():
            raise WriteError(str(path), "this OpenCV cannot write VP8")
        writer.release()
        files.write_bytes(path, files.read_bytes(part))


def _even(picture: np.ndarray) -> np.ndarray:
    """With an even number of rows and columns, as the codec needs: the last are said twice."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
