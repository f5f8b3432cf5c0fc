"""One command at a time writes into a folder. Light: needs no torch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from drivesem.config.errors import UsageError

if TYPE_CHECKING:
    from filelock import BaseFileLock

LOCK = ".lock"
"""Empty file in the folder. It stays: the system forgets who held it when a process ends, however it ends."""
_held: dict[Path, BaseFileLock] = {}
"""Of this process, by file."""


def acquire_folder_lock(folder: Path) -> None:
    """Make `folder`, and keep other processes that ask from writing into it, until `let_go` or this process' end.

    This process may ask again. Raises UsageError where another one holds the folder,
    WriteError where it cannot be made.
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
    """Whether another process writes into the folder now."""
    from filelock import FileLock, Timeout

    path = folder.resolve() / LOCK
    if path in _held or not path.is_file():
        return False
    try:
        with FileLock(path, blocking=False):
            return False
    except Timeout:
        return True
    except OSError:  # a folder that may only be read tells nothing
        return False


@contextmanager
def release_folder_locks() -> Iterator[None]:
    """What is held inside is free at the end."""
    before = set(_held)
    try:
        yield
    finally:
        for path in set(_held) - before:
            _held.pop(path).release()
