"""Reads detector files, which may come from anywhere, and writes files atomically."""

from __future__ import annotations

import itertools
import os
import stat
import zipfile
from pathlib import Path
from typing import Any

import torch

from detectors.base import DetectorError

_MAX_STATE_BYTES = 1 << 32


def check_file(path: Path, what: str, max_bytes: int) -> None:
    """Check that a path is a regular file of limited size.

    Args:
        path: The file.
        what: What the file should be, for the error.
        max_bytes: Largest size accepted.

    Raises:
        DetectorError: The file is missing, not regular (a device never ends), or too large.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise DetectorError(f"{path}: expected {what}, found {reason}") from None
    if not stat.S_ISREG(status.st_mode):
        raise DetectorError(f"{path}: expected {what}, found no regular file")
    if status.st_size > max_bytes:
        raise DetectorError(
            f"{path}: expected {what} of at most {max_bytes:,} bytes, found {status.st_size:,} bytes"
        )


def read_file(path: Path, what: str, max_bytes: int) -> bytes:
    """The bytes of a file.

    Args:
        path: The file.
        what: What the file should be, for the error.
        max_bytes: Largest size accepted.

    Raises:
        DetectorError: As `check_file`, or the file cannot be read.
    """
    check_file(path, what, max_bytes)
    try:
        return path.read_bytes()
    except OSError as error:
        raise DetectorError(f"{path}: expected {what}, found {error.strerror}") from None


def read_text(path: Path, what: str, max_bytes: int) -> str:
    """The text of a UTF-8 file.

    Args:
        path: The file.
        what: What the file should be, for the error.
        max_bytes: Largest size accepted.

    Raises:
        DetectorError: As `read_file`, or the bytes are not UTF-8.
    """
    try:
        return read_file(path, what, max_bytes).decode("utf-8")
    except UnicodeDecodeError:
        raise DetectorError(f"{path}: expected {what}, found bytes that are no text") from None


def read_state(path: Path, what: str) -> Any:
    """The content of a `torch.save` file, restricted to tensors and plain values (`weights_only`).

    Raises:
        DetectorError: The file holds anything else, or is an archive that claims more bytes than it has: torch
            does not compress, so such a file would allocate memory that it does not fill.
    """
    check_file(path, what, _MAX_STATE_BYTES)
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                claimed = sum(member.file_size for member in archive.infolist())
            if claimed > path.stat().st_size:
                raise ValueError(f"parts of {claimed:,} bytes in a file of {path.stat().st_size:,}")
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # pickle, zip and torch raise their own errors
        raise DetectorError(f"{path}: expected {what}, found {describe_torch_error(error)}") from None


def describe_torch_error(error: Exception) -> str:
    """Why torch could not read a file, without its advice to allow code."""
    _, found, reason = str(error).rpartition("WeightsUnpickler error:")
    lines = list(
        itertools.islice((line.strip() for line in reason.splitlines() if line.strip()), 1 if found else 2)
    )
    if found and lines:
        return f"more than tensors and plain values ({lines[0].partition('. Please')[0]})"
    return " ".join(lines[:2]) or type(error).__name__


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that readers see either the old or the new one; make its folder.

    Raises:
        DetectorError: The file cannot be written, as on a full disk or in a read-only folder.
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
