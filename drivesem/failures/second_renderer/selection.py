"""Which second renderer draws a frame again: the generator, where it made the frame; else pyrender."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from drivesem.config.errors import UsageError
from drivesem.config.options import DEMO
from drivesem.failures.second_renderer.base import SecondRender, SecondRenderer
from drivesem.failures.second_renderer.generator import DemoPlans, FolderPlans, GeneratorRenderer, PlanSource
from drivesem.failures.second_renderer.opengl import shared_context
from drivesem.failures.second_renderer.photograph import PhotographRenderer
from drivesem.store import place
from scene_ir.errors import FormatError
from scene_ir.types import SceneIR, convert_scene


class ExchangedSceneRenderer:
    """Of a scene whose vehicles were exchanged, added or taken away: the scenes before and after it, each drawn
    from its own textures. The generator's plan has no vehicle for a new one, so that pyrender draws it. scene:
    any state after it. Raises SceneError where a second renderer cannot be had.
    """

    def __init__(self, identifier: str, scene: SceneIR) -> None:
        self._before = PhotographRenderer(identifier, scene.origin)
        self._after = PhotographRenderer(identifier, scene, before=self._before)

    @property
    def name(self) -> str:
        return self._after.name

    def render(self, changed: SceneIR) -> SecondRender:
        """A state of the scene, before or after."""
        return (self._before if changed.before is None else self._after).render(changed)

    def unsupported_changes(self, changed: SceneIR) -> tuple[str, ...]:
        """See `PhotographRedraw`."""
        return self._after.unsupported_changes(changed)


class CpuSecondRenderer:
    """Of a scene on a GPU: second renderers draw on the processor; their pictures go where the scene lies."""

    def __init__(self, renderer: SecondRenderer) -> None:
        self._renderer = renderer

    @property
    def name(self) -> str:
        return self._renderer.name

    def render(self, changed: SceneIR) -> SecondRender:
        """A state of the scene."""
        drawn = self._renderer.render(convert_scene(changed, None, "cpu"))
        return replace(drawn, image=drawn.image.to(changed.photograph.device))

    def unsupported_changes(self, changed: SceneIR) -> tuple[str, ...]:
        """What of a change `render` leaves out."""
        return self._renderer.unsupported_changes(convert_scene(changed, None, "cpu"))


class SecondRenderers:
    """Second renderers of one data set's frames. dataset, root: as a run's settings name it.

    An embedded scene is known by its provenance, whatever the data set: in Python a scene may come from anywhere.
    """

    def __init__(self, dataset: str, root: str | None) -> None:
        self._dataset = dataset
        self._folder = _find_folder_plans(dataset, root)
        self._last: tuple[Tensor, Tensor, SecondRenderer] | None = None

    def renderer_for(self, identifier: str, scene: SceneIR) -> SecondRenderer:
        """What draws a frame again. scene: any state of it; attacks on the same scene, one after the other, share
        the renderer. Raises SceneError where nothing can.
        """
        same = (scene.photograph, scene.objects.mesh_index)  # the same state of affairs: no theta touches them
        if self._last is None or any(a is not b for a, b in zip(self._last, same, strict=False)):
            self._last = (*same, self._make_renderer(identifier, scene))
        return self._last[2]

    @property
    def generated(self) -> bool:
        """Whether the generator made the data set's frames, and draws them again."""
        return self._folder is not None or self._dataset == DEMO

    def check(self) -> None:
        """Raises NoSecondRendererError where no frame of the data set could be drawn a second time."""
        if not self.generated:
            shared_context()

    def _make_renderer(self, identifier: str, scene: SceneIR) -> SecondRenderer:
        if scene.photograph.is_cuda:
            return CpuSecondRenderer(self._make_renderer(identifier, convert_scene(scene, None, "cpu")))
        if scene.before is not None:
            return ExchangedSceneRenderer(identifier, scene)
        plans = DemoPlans() if scene.provenance.get("dataset") == DEMO else self._folder
        if plans is not None:
            return GeneratorRenderer(identifier, scene, plans)
        return PhotographRenderer(identifier, scene)


def _find_folder_plans(dataset: str, root: str | None) -> PlanSource | None:
    """Of a folder that the generator wrote; None where it did not, or where it is not known how."""
    if dataset != "kitti":
        return None
    try:
        return FolderPlans(place(root or ""))
    except (UsageError, FormatError):
        return None
