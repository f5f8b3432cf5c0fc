"""What came of one frame before both renderers, and its file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivesem.analysis.confirm.judge import RendererFailure, Stand
from drivesem.run.records import dump_record, load_record
from drivesem.run.results import BoxRecord

SCHEMA = 2


@dataclass(frozen=True, slots=True)
class Confirmed:
    """What came of one frame. source: fingerprint of the run's result. renderer: the second one's name.
    compositor, second: failures in either picture; targets, detections: in the second renderer's; not_carried:
    what of the change it left out. `seconds` alone may differ between two calls.
    """

    identifier: str
    source: str
    renderer: str
    compositor: tuple[RendererFailure, ...]
    second: tuple[RendererFailure, ...]
    stands: tuple[Stand, ...]
    targets_benign: tuple[BoxRecord, ...]
    targets_changed: tuple[BoxRecord, ...]
    detections_benign: tuple[BoxRecord, ...]
    detections_changed: tuple[BoxRecord, ...]
    not_carried: tuple[str, ...]
    seconds: float


def dump(result: Confirmed) -> str:
    """JSON text of one frame's result."""
    return dump_record(result, SCHEMA)


def load(path: Path) -> Confirmed:
    """Read what `dump` wrote. Raises FormatError naming the file."""
    return load_record(path, Confirmed, SCHEMA)
