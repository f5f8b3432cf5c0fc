"""Scenes that are kept from one command to the next: a photograph is taken apart once, for the same labels,
settings and code.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path

import numpy as np
from torch import Tensor

import scene_ir
from scene_ir import files
from scene_ir.errors import SceneError
from scene_ir.io import load_scene, save_scene
from scene_ir.types import SceneIR

_GB = 1e9
_WRITING_S = 3600.0
"""A scene is written within it: what is older and not whole was left by a process that was killed."""


@dataclass(frozen=True, slots=True)
class KeptScenes:
    """A folder of scenes by what they were made of. limit_gb: beyond it those that nobody asked for longest go."""

    folder: Path
    limit_gb: float

    def scene(self, made_of: object, make: Callable[[], SceneIR]) -> SceneIR:
        """What `make` gives, or gave for the same before. A kept scene that cannot be read is made again.

        made_of: dataclasses, tuples, mappings, tensors and plain values; TypeError for anything else.
        """
        path = self.folder / digest_of((_code(), made_of))
        with contextlib.suppress(SceneError):
            scene = load_scene(path)
            with contextlib.suppress(OSError):
                os.utime(path)
            return scene
        scene = make()
        with files.whole_folder(path) as part:
            save_scene(scene, part)
        self.make_room(path)
        return scene

    def make_room(self, newest: Path | None = None) -> None:
        """Remove what is beyond the limit, but for the `newest` scene and what another process is writing. Several
        processes may do so at once: what is gone already is no error.
        """
        sizes: list[tuple[float, float, Path]] = []
        for path in self.folder.iterdir() if self.folder.is_dir() else ():
            with contextlib.suppress(OSError):
                changed = path.stat().st_mtime
                if path.match(".*.tmp") and time.time() - changed < _WRITING_S:
                    continue
                size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
                sizes.append((changed, size, path))
        total = sum(size for _, size, _ in sizes)
        for _, size, path in sorted(sizes):
            if total <= self.limit_gb * _GB or path == newest:
                break
            shutil.rmtree(path, ignore_errors=True)
            total -= size


def digest_of(value: object) -> str:
    """SHA-256 of a value's content, hexadecimal; equal content, equal digest. TypeError for what has none."""
    known = hashlib.sha256()
    for part in _parts(value):
        known.update(len(part).to_bytes(8, "big"))
        known.update(part)
    return known.hexdigest()


def _parts(value: object) -> Iterator[bytes]:
    yield type(value).__name__.encode()
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        yield f"{value.dtype} {value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield field.name.encode()
            yield from _parts(getattr(value, field.name))
    elif isinstance(value, dict):
        for key in sorted(value, key=repr):
            yield from _parts(key)
            yield from _parts(value[key])
    elif isinstance(value, list | tuple):
        yield str(len(value)).encode()
        for item in value:
            yield from _parts(item)
    elif value is None or isinstance(value, str | int | float | bool | bytes):
        yield repr(value).encode()
    else:
        raise TypeError(f"content of {type(value).__name__}: expected plain values, found an object")


@cache
def _code() -> str:
    """Of what takes photographs apart, with its networks: other code makes other scenes."""
    root = Path(scene_ir.__file__).parent
    return digest_of(
        [files.digest(path) for path in sorted(root.rglob("*")) if path.suffix in (".py", ".safetensors")]
    )
