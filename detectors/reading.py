"""Files of detectors, which may come from anywhere: regular ones only, up to a size."""

from __future__ import annotations

import itertools
import stat
import zipfile
from pathlib import Path
from typing import Any

import torch

from detectors.base import DetectorError

_MOST_STATE = 1 << 32


def check_file(path: Path, what: str, most: int) -> None:
    """DetectorError for what is missing, no regular file (a device never ends), or larger than `most` bytes."""
    try:
        status = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise DetectorError(f"{path}: expected {what}, found {reason}") from None
    if not stat.S_ISREG(status.st_mode):
        raise DetectorError(f"{path}: expected {what}, found no regular file")
    if status.st_size > most:
        raise DetectorError(f"{path}: expected {what} of at most {most:,} bytes, found {status.st_size:,} bytes")


def read_file(path: Path, what: str, most: int) -> bytes:
    """The bytes of a file. DetectorError as `check_file`, and where it cannot be read."""
    check_file(path, what, most)
    try:
        return path.read_bytes()
    except OSError as error:
        raise DetectorError(f"{path}: expected {what}, found {error.strerror}") from None


def read_text(path: Path, what: str, most: int) -> str:
    """The text of a UTF-8 file. DetectorError as `read_file`, and where it is no text."""
    try:
        return read_file(path, what, most).decode("utf-8")
    except UnicodeDecodeError:
        raise DetectorError(f"{path}: expected {what}, found bytes that are no text") from None


def read_state(path: Path, what: str) -> Any:
    """What `torch.save` wrote, tensors and plain values alone (`weights_only`). DetectorError where it is none of
    these, or an archive whose parts are larger than the file: torch packs nothing, so that such a file claims
    memory that it does not fill.
    """
    check_file(path, what, _MOST_STATE)
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                claimed = sum(member.file_size for member in archive.infolist())
            if claimed > path.stat().st_size:
                raise ValueError(f"parts of {claimed:,} bytes in a file of {path.stat().st_size:,}")
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # pickle, zip and torch have errors of their own
        raise DetectorError(f"{path}: expected {what}, found {unreadable(error)}") from None


def unreadable(error: Exception) -> str:
    """Why torch could not read a file, without its advice to let code run."""
    _, found, reason = str(error).rpartition("WeightsUnpickler error:")
    lines = list(
        itertools.islice((line.strip() for line in reason.splitlines() if line.strip()), 1 if found else 2)
    )
    if found and lines:
        return f"more than tensors and plain values ({lines[0].partition('. Please')[0]})"
    return " ".join(lines[:2]) or type(error).__name__
