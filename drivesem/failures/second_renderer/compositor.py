"""The first renderer, in the terms of the second ones: pictures of the compositor, labels that moved along."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from drivesem.attack.labels import Labeller, shown_boxes
from drivesem.failures.second_renderer.base import Redrawn
from scene_ir.io import as_written
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR


@dataclass(frozen=True, slots=True)
class CompositorDraw:
    """Of one scene, whose compositor and labeller are kept."""

    compositor: Compositor
    labeller: Labeller

    @property
    def name(self) -> str:
        return "compositor"

    def not_carried(self, changed: SceneIR) -> tuple[str, ...]:
        """Nothing is left out."""
        del changed
        return ()

    @torch.no_grad()
    def redraw(self, changed: SceneIR) -> Redrawn:
        """A state of the scene, as a file would hold it."""
        render = self.compositor.render(changed)
        return Redrawn(as_written(render.image), self.labeller.moved(changed, render).targets, shown_boxes(render))
