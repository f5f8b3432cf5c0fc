"""Remote folders (s3://, gs://, memory://: any URL of fsspec) and their local copies.

A command works in the local copy. New files are uploaded in the order in which they were written, and a commit comes
last: an object that lists files with their sizes, times and hashes. Only files that a commit lists are read back, so
no store has to rename anything, and an interrupted upload is ignored. A file that changes is uploaded under another
name until its commit is written. A folder without commits, such as somebody's data set, is read as it is.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from drivesem.config.constraints import is_url
from drivesem.config.errors import UsageError
from drivesem.config.options import CommandConfig, OutputOptions
from scene_ir import files
from scene_ir.errors import FormatError

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

_COMMITS = ".store"
"""Folder of the commits, NUMBER-HASH.json, and of changed files, named by hash, before they replace the old ones."""
_COMMIT = re.compile(r"(\d{6})-([0-9a-f]{16})\.json")
_UPLOAD_FRACTION = 0.1
"""Fraction of a command's time for uploads while it works."""

C = TypeVar("C", bound=CommandConfig)


@dataclass(frozen=True, slots=True)
class FileVersion:
    """One version of a file."""

    size: int
    """Bytes."""
    time_ns: int
    """Time of the last change, ns."""
    digest: str
    """SHA-256, hexadecimal."""


class RemoteFolder:
    """A remote folder and its local copy, which has the same name in every process and on every machine."""

    def __init__(self, url: str, setting: str, home: Path | None = None) -> None:
        """Name the folder; nothing is read yet.

        Args:
            url: URL of the folder.
            setting: The option that gave it, for errors.
            home: Folder of the local copy (default: in the user's cache).
        """
        self.url, self._setting = url.rstrip("/"), setting
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        name = hashlib.sha256(self.url.encode()).hexdigest()[:16]
        self._home = home or cache / "drivesem" / "stores" / name
        # A run has the name of its folder.
        self.folder = (
            self._home / "copy" / (re.sub(r"[^\w.-]", "_", self.url.rsplit("/", 1)[-1]).strip(".") or "_")
        )
        self._versions: dict[str, FileVersion | None] = {}
        self._read: set[str] = set()
        self._not_before = 0.0

    def __reduce__(self) -> tuple[type[RemoteFolder], tuple[str, str, Path]]:
        return type(self), (self.url, self._setting, self._home)

    def fetch(self) -> None:
        """Download what the local copy lacks. Raises UsageError for a store that cannot be read."""
        with self._locked():
            commits = self._list_marks(_COMMITS)
            if commits:
                self._fetch_commits([name for name in commits if _COMMIT.fullmatch(name)])
            else:
                self._mirror()

    def upload(self, now: bool = False) -> None:
        """Upload what is new, if `now` or if uploads have taken less than a tenth of the time.

        Raises UsageError for a store that cannot be written.
        """
        begun = time.monotonic()
        if not now and begun < self._not_before:
            return
        with self._locked():
            self._push()
        self._not_before = time.monotonic() + (time.monotonic() - begun) / _UPLOAD_FRACTION

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the copy: one process of this machine at a time reads or writes commits."""
        from filelock import FileLock

        (self._home / "commits").mkdir(parents=True, exist_ok=True)
        with FileLock(self._home / "lock"):
            self._read_commits()
            yield

    @functools.cached_property
    def _opened(self) -> tuple[AbstractFileSystem, str]:
        try:
            from fsspec.core import url_to_fs

            return url_to_fs(self.url)
        except (ImportError, ValueError) as error:
            expected = "a folder, or a URL with a library that is installed (pip install 'drivesem[remote]')"
            raise UsageError(self._setting, expected, f"{self.url}: {error}") from error

    @contextmanager
    def _store_errors(self, expected: str) -> Iterator[tuple[AbstractFileSystem, str]]:
        """The store and the path in it; any error of its library becomes a UsageError."""
        opened = self._opened
        try:
            yield opened
        except Exception as error:
            found = f"{self.url}: {type(error).__name__}: {error} (the results are in {self.folder})"
            raise UsageError(self._setting, expected, found) from error

    def _get(self, name: str) -> bytes | None:
        """The content of an object; None if it does not exist."""
        with self._store_errors("a store that can be read") as (store, root):
            try:
                data: Any = store.cat_file(f"{root}/{name}")
            except FileNotFoundError:
                return None
        return data

    def _put(self, name: str, data: bytes) -> None:
        with self._store_errors("a store that can be written") as (store, root):
            path = f"{root}/{name}"
            try:
                store.pipe_file(path, data)
            except FileNotFoundError:  # a store with folders
                store.makedirs(path.rsplit("/", 1)[0], exist_ok=True)
                store.pipe_file(path, data)

    def _remove(self, name: str) -> None:
        with self._store_errors("a store that can be written") as (store, root):
            try:
                store.rm_file(f"{root}/{name}")
            except FileNotFoundError:
                return

    def _list_marks(self, folder: str = "") -> dict[str, str]:
        """Every object in a subfolder, at any depth: a mark of its state, by name."""
        with self._store_errors("a store that can be read") as (store, root):
            store.invalidate_cache()
            path = f"{root}/{folder}".rstrip("/")
            try:
                found: Any = store.find(path, detail=True)
            except FileNotFoundError:
                return {}
        marks = ((name[len(path) + 1 :], str(info).encode()) for name, info in found.items())
        return {name: hashlib.sha256(info).hexdigest() for name, info in marks}

    # --- folders with commits

    def _read_commits(self) -> None:
        for path in sorted((self._home / "commits").glob("*.json")):
            if path.name not in self._read:
                self._versions |= _read_versions(path)
                self._read.add(path.name)

    def _fetch_commits(self, names: Iterable[str]) -> None:
        fresh: dict[str, dict[str, FileVersion | None]] = {}
        for name in sorted(set(names) - self._read):
            data, path = self._get(f"{_COMMITS}/{name}") or b"", self._home / "commit"
            if hashlib.sha256(data).hexdigest()[:16] == name[7:23]:  # else it is half written
                files.write_bytes(path, data)
                fresh[name] = _read_versions(path)
        wanted = dict(self._versions)
        for versions in fresh.values():
            wanted |= versions
        # Includes files that have vanished from the copy: no command removed them.
        lost = {name for name in _track_progress(wanted) if not self._fetch_file(name, wanted[name])}
        for name, versions in fresh.items():
            self._record(name, {file: None if file in lost else v for file, v in versions.items()})
        self._versions |= dict.fromkeys(lost)

    def _fetch_file(self, name: str, version: FileVersion | None) -> bool:
        """Make a local file as a commit lists it. False if the store has other content in its place."""
        path = files.resolve_inside(self.folder, name)
        if version is None:
            path.unlink(missing_ok=True)
            return True
        if _state(path) == (version.size, version.time_ns):
            return True
        # Under its hash while it changes, or in its place if the change ended in between.
        for place in (name, f"{_COMMITS}/{version.digest}", name):
            data = self._get(place)
            if data is not None and hashlib.sha256(data).hexdigest() == version.digest:
                files.write_bytes(path, data)
                os.utime(path, ns=(version.time_ns, version.time_ns))
                return True
        path.unlink(missing_ok=True)
        return False

    def _push(self) -> None:
        local = {path.relative_to(self.folder).as_posix(): state for path, state in _files(self.folder)}
        known = self._versions
        changed = [
            name for name, state in local.items() if (v := known.get(name)) is None or state != (v.size, v.time_ns)
        ]
        removed = [name for name, version in known.items() if version is not None and name not in local]
        if not changed and not removed:
            return
        if not self._read:
            self._commit({})  # from now on, only listed files count
        written: dict[str, FileVersion | None] = dict.fromkeys(removed)
        temporary: dict[str, str] = {}
        for name in sorted(changed, key=lambda name: local[name][1]):
            data = _read(self.folder / name)
            if data is None:
                continue
            digest = hashlib.sha256(data).hexdigest()
            if known.get(name) is not None:
                temporary[name] = f"{_COMMITS}/{digest}"
            self._put(temporary.get(name, name), data)
            written[name] = FileVersion(len(data), local[name][1], digest)
        self._commit(written)
        for name, place in temporary.items():
            data = _read(self.folder / name)
            if data is not None and place.endswith(
                hashlib.sha256(data).hexdigest()
            ):  # otherwise it has changed again
                self._put(name, data)
                self._remove(place)
        for name in removed:
            self._remove(name)

    def _commit(self, versions: Mapping[str, FileVersion | None]) -> None:
        listed = {name: v and [v.size, v.time_ns, v.digest] for name, v in versions.items()}
        data = json.dumps(listed, ensure_ascii=False).encode()
        number = max((int(name[:6]) for name in self._read), default=-1) + 1
        name = f"{number:06d}-{hashlib.sha256(data).hexdigest()[:16]}.json"
        self._put(f"{_COMMITS}/{name}", data)
        self._record(name, versions)

    def _record(self, name: str, versions: Mapping[str, FileVersion | None]) -> None:
        listed = {file: v and [v.size, v.time_ns, v.digest] for file, v in versions.items()}
        files.write_json(self._home / "commits" / name, listed)
        self._versions |= versions
        self._read.add(name)

    # --- folders without commits

    def _mirror(self) -> None:
        record = self._home / "mirror.txt"
        lines = files.read_text(record).splitlines() if record.is_file() else []
        before = {name: mark for mark, _, name in (line.partition(" ") for line in lines)}
        marks = self._list_marks()
        with record.open("a", encoding="utf-8") as record_file:
            for name in _track_progress(name for name, mark in marks.items() if before.get(name) != mark):
                path, data = files.resolve_inside(self.folder, name), self._get(name)
                if data is not None:
                    files.write_bytes(path, data)
                    record_file.write(f"{marks[name]} {name}\n")
                    record_file.flush()
        for name in before.keys() - marks:
            files.resolve_inside(self.folder, name).unlink(missing_ok=True)
        files.write_text(record, "".join(f"{mark} {name}\n" for name, mark in marks.items()))


def _track_progress(names: Iterable[str]) -> Iterator[str]:
    from drivesem.reporting.tables import Console, progress_bar

    names = list(names)
    with progress_bar(Console(stderr=True), keep=False, hidden=not names) as progress:
        yield from progress.track(names, description="copying from the store")


def _read_versions(path: Path) -> dict[str, FileVersion | None]:
    """The files of a commit; None for a removed one. Raises FormatError."""
    listed = files.read_json(path)
    try:
        return {name: v and FileVersion(int(v[0]), int(v[1]), str(v[2])) for name, v in listed.items()}
    except (AttributeError, TypeError, ValueError, LookupError) as error:
        raise FormatError(str(path), "size, time and hash of each file, or null", error) from error


def _files(folder: Path) -> Iterator[tuple[Path, tuple[int, int]]]:
    """Complete files with their states, while other processes may write.

    Hidden files at the top, such as a lock, belong to this machine and are left out.
    """
    for root, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not files.is_leftover(name)]
        for path in (Path(root, name) for name in names):
            local = files.is_leftover(path.name) or (path.parent == folder and path.name.startswith("."))
            state = None if local else _state(path)
            if state is not None:
                yield path, state


def _read(path: Path) -> bytes | None:
    """The content; None if the file is gone since it was listed, which the next upload notices."""
    try:
        return files.read_bytes(path)
    except FormatError:
        if path.exists():
            raise
        return None


def _state(path: Path) -> tuple[int, int] | None:
    """Size and time of the last change, ns; None for no file."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_size, status.st_mtime_ns


def local_copy(path: str | Path, setting: str = "--root") -> Path:
    """The folder of a path, or the local copy of a URL, which is updated once per process.

    Raises UsageError for a URL without files.
    """
    return _copy_of(path, setting) if isinstance(path, str) and is_url(path) else Path(path)


@functools.cache
def _copy_of(url: str, setting: str) -> Path:
    store = RemoteFolder(url, setting)
    store.fetch()
    if not store.folder.is_dir():
        raise UsageError(setting, "a folder with files", f"{url}, which is empty")
    return store.folder


_open: RemoteFolder | None = None
"""The remote folder that this process writes to, if any."""


@contextmanager
def remote_output(config: C) -> Iterator[C]:
    """The settings with a local folder in place of a URL in --out.

    The folder is downloaded first; what the command writes is uploaded as it goes (`upload`) and at the end.
    """
    _copy_of.cache_clear()
    if not isinstance(config, OutputOptions) or config.out is None or not is_url(config.out):
        yield config
        return
    store = RemoteFolder(config.out, "--out")
    set_output_store(store)
    try:
        store.fetch()
        yield replace(config, out=str(store.folder))
        store.upload(now=True)
    finally:
        set_output_store(None)


def set_output_store(store: RemoteFolder | None) -> None:
    """Set the remote folder that this process writes to."""
    global _open
    _open = store


def output_store() -> RemoteFolder | None:
    """The remote folder that this process writes to, if any."""
    return _open
