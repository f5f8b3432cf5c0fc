"""Cache of de-rendered scenes: each photograph is de-rendered once for the same labels, settings and code."""

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
_MAX_WRITING_S = 3600.0
"""Age from which an unfinished scene belongs to a killed process."""


@dataclass(frozen=True, slots=True)
class SceneCache:
    """A folder of scenes by the digest of their inputs."""

    folder: Path
    """The folder."""
    limit_gb: float
    """Size limit; the least recently used scenes are removed."""

    def get_or_make(self, inputs: object, make: Callable[[], SceneIR]) -> SceneIR:
        """Return the cached scene of these inputs, or make it. A damaged scene is made again.

        `inputs` are dataclasses, tuples, mappings, tensors and plain values; TypeError for anything else.
        """
        path = self.folder / content_digest((_code_digest(), inputs))
        with contextlib.suppress(SceneError):
            scene = load_scene(path)
            with contextlib.suppress(OSError):
                os.utime(path)
            return scene
        scene = make()
        with files.atomic_folder(path) as part:
            save_scene(scene, part)
        self.evict(path)
        return scene

    def evict(self, newest: Path | None = None) -> None:
        """Remove scenes beyond the limit, except the `newest` and unfinished ones. Safe with several processes."""
        sizes: list[tuple[float, float, Path]] = []
        for path in self.folder.iterdir() if self.folder.is_dir() else ():
            with contextlib.suppress(OSError):
                changed = path.stat().st_mtime
                if path.match(".*.tmp") and time.time() - changed < _MAX_WRITING_S:
                    continue
                size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
                sizes.append((changed, size, path))
        total = sum(size for _, size, _ in sizes)
        for _, size, path in sorted(sizes):
            if total <= self.limit_gb * _GB or path == newest:
                break
            shutil.rmtree(path, ignore_errors=True)
            total -= size


def content_digest(value: object) -> str:
    """Return the hexadecimal SHA-256 of a value's content. Raises TypeError for other objects."""
    digest = hashlib.sha256()
    for part in _content_parts(value):
        digest.update(len(part).to_bytes(8, "big"))
        digest.update(part)
    return digest.hexdigest()


def _content_parts(value: object) -> Iterator[bytes]:
    yield type(value).__name__.encode()
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        yield f"{value.dtype} {value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield field.name.encode()
            yield from _content_parts(getattr(value, field.name))
    elif isinstance(value, dict):
        for key in sorted(value, key=repr):
            yield from _content_parts(key)
            yield from _content_parts(value[key])
    elif isinstance(value, list | tuple):
        yield str(len(value)).encode()
        for item in value:
            yield from _content_parts(item)
    elif value is None or isinstance(value, str | int | float | bool | bytes):
        yield repr(value).encode()
    else:
        raise TypeError(f"content of {type(value).__name__}: expected plain values, found an object")


@cache
def _code_digest() -> str:
    """Return the digest of the de-rendering code and its networks."""
    root = Path(scene_ir.__file__).parent
    return content_digest(
        [files.sha256_digest(path) for path in sorted(root.rglob("*")) if path.suffix in (".py", ".safetensors")]
    )
