"""What every second renderer is: it draws states of one scene, and labels what it drew."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from detectors.types import Targets
from scene_ir.errors import SceneError
from scene_ir.types import SceneIR


@dataclass(frozen=True, slots=True)
class SecondRender:
    """One picture of a second renderer.

    image: (3, H, W) RGB in [0, 1], on the 8-bit grid. targets: labels among `CLASSES`; the first N rows are the
    scene's objects in order, ignored where the renderer has no counterpart; then regions in which no detection
    counts. shown_xyxy: (N, 4) px, the box of what shows of each object, zeros where nothing does.
    """

    image: Tensor
    targets: Targets
    visible_xyxy: Tensor


class SecondRenderer(Protocol):
    """A renderer of one frame's scene, before and after any change. name: of what draws, for people."""

    @property
    def name(self) -> str: ...

    def render(self, changed: SceneIR) -> SecondRender:
        """A state of the scene. Raises SceneError where the change cannot be drawn."""
        ...

    def unsupported_changes(self, changed: SceneIR) -> tuple[str, ...]:
        """What of a change `render` leaves out, in words; nothing where it draws it whole."""
        ...


class NoSecondRendererError(SceneError):
    """Nothing on this machine can draw the scene a second time; the message says what to install."""

    @classmethod
    def from_exception(cls, renderer: str, expected: str, error: BaseException) -> NoSecondRendererError:
        """What a library raised, on one line."""
        return cls(renderer, expected, " ".join(f"{type(error).__name__} {error}".split()))
