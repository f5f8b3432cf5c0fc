"""Objects by where they come from."""

from __future__ import annotations

from drivesem.classify.objects.embedded import EmbeddedObjects
from drivesem.classify.objects.types import ObjectSet


def open_objects(source: str | None, *, seed: int = 0, most_triangles: int | None = 20_000) -> ObjectSet:
    """The embedded objects (None), or those of a folder: see `FolderObjects`, which seed and most_triangles are
    for. Raises FormatError for a folder without objects.
    """
    if source is None:
        return EmbeddedObjects()
    from drivesem.classify.objects.folders import FolderObjects

    return FolderObjects(source, seed=seed, most_triangles=most_triangles)
