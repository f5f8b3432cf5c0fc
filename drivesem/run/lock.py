"""Locks output folders, so that one command at a time writes into them. Imports no torch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from drivesem.config.errors import UsageError

if TYPE_CHECKING:
    from filelock import BaseFileLock

LOCK = ".lock"
"""Empty file in the folder, which stays. The system releases the lock when the process ends in any way."""
_held: dict[Path, BaseFileLock] = {}
"""Locks of this process, by file."""


def acquire_folder_lock(folder: Path) -> None:
    """Create and lock `folder` until `release_folder_locks` or the end of this process, which may lock it again.

    Raises UsageError if another process holds the lock, WriteError if the folder cannot be created.
    """
    from filelock import FileLock, Timeout  # when needed: `drivesem --help` starts without

    from scene_ir.files import name_write_errors

    path = folder.resolve() / LOCK
    if path in _held:
        return
    lock = FileLock(path)
    with name_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(blocking=False)
        except Timeout:
            raise UsageError("--out", "a folder that no other command writes into now", folder) from None
    _held[path] = lock


def is_locked_elsewhere(folder: Path) -> bool:
    """Whether another process holds the lock of the folder."""
    from filelock import FileLock, Timeout

    path = folder.resolve() / LOCK
    if path in _held or not path.is_file():
        return False
    try:
        with FileLock(path, blocking=False):
            return False
    except Timeout:
        return True
    except OSError:  # a read-only folder
        return False


@contextmanager
def release_folder_locks() -> Iterator[None]:
    """Release the locks that are acquired inside the block."""
    before = set(_held)
    try:
        yield
    finally:
        for path in set(_held) - before:
            _held.pop(path).release()
