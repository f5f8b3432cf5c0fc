"""The interface of second renderers: they render states of one scene and label them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from detectors.types import Targets
from scene_ir.errors import SceneError
from scene_ir.types import SceneIR

MANIFEST = "manifest.json"
"""File of a generated data set with its settings, by which the generator can draw its frames again."""


@dataclass(frozen=True, slots=True)
class SecondRender:
    """One image of a second renderer, with its labels."""

    image: Tensor
    """(3, H, W) RGB in [0, 1], on the 8-bit grid."""
    targets: Targets
    """Labels among `CLASSES`: the scene's N objects in order, ignored where they have no counterpart, then regions
    in which no detection counts."""
    visible_xyxy: Tensor
    """(N, 4) px, box of the visible part of each object; zeros where nothing is visible."""


class SecondRenderer(Protocol):
    """A renderer of one frame's scene, before and after any change."""

    @property
    def name(self) -> str:
        """Name of the renderer, for people."""
        ...

    def render(self, changed: SceneIR) -> SecondRender:
        """Render a state of the scene. Raises SceneError where the change cannot be rendered."""
        ...

    def unsupported_changes(self, changed: SceneIR) -> tuple[str, ...]:
        """List the changes that `render` leaves out, as text; empty where it renders all."""
        ...


class NoSecondRendererError(SceneError):
    """No second renderer works on this machine; the message names what to install."""

    @classmethod
    def from_exception(cls, renderer: str, expected: str, error: BaseException) -> NoSecondRendererError:
        """Format a library's exception on one line.

        Args:
            renderer: Name of the renderer.
            expected: What it needs.
            error: What the library raised.
        """
        return cls(renderer, expected, " ".join(f"{type(error).__name__} {error}".split()))
