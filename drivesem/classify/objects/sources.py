"""Objects by where they come from."""

from __future__ import annotations

from drivesem.classify.objects.embedded import EmbeddedObjects
from drivesem.classify.objects.types import ObjectSet


def open_objects(source: str | None) -> ObjectSet:
    """The embedded objects (None), or those of a folder."""
    return EmbeddedObjects()
