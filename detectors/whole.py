"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from detectors.base import DetectorError


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that a reader sees the old or the new one, never a part. Makes the folder. DetectorError
    where it cannot be written: a full disk, a folder that may only be read.
    """
    temporary = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_bytes(data)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise DetectorError(f"{path}: expected a place that can be written, found {reason}") from error
