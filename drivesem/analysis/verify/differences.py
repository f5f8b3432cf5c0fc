"""What was compared, and what differed: the terms in which a run is checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

CHECKS: Mapping[str, str] = {
    "files": "all files of the frames, and metrics.json, have the hashes of manifest.json",
    "settings": "config.yaml has the settings of manifest.json",
    "pictures": "the saved scene, rendered again, gives the three pictures",
    "detections": "the detector finds in the three pictures what is recorded",
    "labels": "the saved scene gives both label files and the recorded targets",
    "success": "lost, phantoms, and success under both label modes, from label files and detections",
    "grades": "the draws of each certificate, taken again, say the same; grades follow from what they rest on",
    "feasibility": "the second check says the same of the saved scene, and all lies within the budget",
    "theta": "theta.json, result.json and the saved scene say the same change",
    "totals": "metrics.json is what the frames add up to, and names what config.yaml names",
}
"""Names of the checks, in the order in which they are told, and what holds where nothing differs."""


@dataclass(frozen=True, slots=True)
class Disagreement:
    """One thing that is not as the run says. field: such as `success_moved` or `objects[3].yaw`; expected: what
    the run's result says; found: what its files give.
    """

    check: str
    field: str
    expected: str
    found: str


@dataclass(slots=True)
class CheckLog:
    """Counts comparisons by check, and keeps what differs."""

    compared: dict[str, int] = field(default_factory=dict)
    differences: list[Disagreement] = field(default_factory=list)

    def same(self, check: str, name: str, expected: object, found: object) -> None:
        """Compare exactly."""
        self.told(check, name, expected, found, agrees=expected == found)

    def each(self, check: str, file: str, expected: Mapping[str, str], found: Mapping[str, str]) -> None:
        """Compare what is expected of the values of a file, by name."""
        for name, value in expected.items():
            self.same(check, f"{file}: {name}", value, found.get(name))

    def told(self, check: str, name: str, expected: object, found: object, agrees: bool) -> None:
        """Count a comparison whose outcome is known."""
        self.compared[check] = self.compared.get(check, 0) + 1
        if not agrees:
            self.differences.append(Disagreement(check, name, _text(expected), _text(found)))


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "; ".join(_text(part) for part in value) or "none"
    return str(value)
