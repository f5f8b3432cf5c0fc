"""Selects a frame's second renderer: the generator where it made the frame, else pyrender."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor

from drivesem.config.errors import UsageError
from drivesem.config.options import DEMO
from drivesem.failures.second_renderer.base import MANIFEST, SecondRender, SecondRenderer
from drivesem.failures.second_renderer.opengl import shared_context
from drivesem.failures.second_renderer.photograph import PhotographRenderer
from drivesem.store import local_copy
from scene_ir.errors import FormatError
from scene_ir.types import SceneIR, convert_scene

if TYPE_CHECKING:
    from drivesem.failures.second_renderer.generator import PlanSource


class ExchangedSceneRenderer:
    """Renders a scene with exchanged, added or removed vehicles: the scenes before and after, each from its
    own textures, by pyrender, as the generator's plan lacks the new vehicles. `scene` is any state after the
    exchange.
    """

    def __init__(self, identifier: str, scene: SceneIR) -> None:
        self._before = _make_photograph_renderer(identifier, scene.origin)
        self._after = _make_photograph_renderer(identifier, scene, self._before)

    @property
    def name(self) -> str:
        return self._after.name

    def render(self, changed: SceneIR) -> SecondRender:
        """Render a state of the scene, before or after the exchange."""
        return (self._before if changed.before is None else self._after).render(changed)

    def unsupported_changes(self, changed: SceneIR) -> tuple[str, ...]:
        """List the changes that `PhotographRenderer` leaves out."""
        return self._after.unsupported_changes(changed)


class CpuSecondRenderer:
    """Renders a scene that is on a GPU: the wrapped renderer runs on the CPU, its images go to the scene's device."""

    def __init__(self, renderer: SecondRenderer) -> None:
        self._renderer = renderer

    @property
    def name(self) -> str:
        return self._renderer.name

    def render(self, changed: SceneIR) -> SecondRender:
        """Render a state of the scene."""
        render = self._renderer.render(convert_scene(changed, None, "cpu"))
        return replace(render, image=render.image.to(changed.photograph.device))

    def unsupported_changes(self, changed: SceneIR) -> tuple[str, ...]:
        """List the changes that the wrapped renderer leaves out."""
        return self._renderer.unsupported_changes(convert_scene(changed, None, "cpu"))


class SecondRenderers:
    """Second renderers of one data set's frames.

    An embedded scene is recognised by its provenance in any data set, as in Python it may come from anywhere.
    """

    def __init__(self, dataset: str, root: str | None) -> None:
        """Take the data set's name and root as in a run's settings."""
        self._dataset = dataset
        self._folder = _find_folder_plans(dataset, root)
        self._last: tuple[Tensor, Tensor, SecondRenderer] | None = None

    def renderer_for(self, identifier: str, scene: SceneIR) -> SecondRenderer:
        """Make the renderer of a frame from any state of its scene; consecutive calls for a scene share it.

        Raises SceneError where no renderer works.
        """
        same = (scene.photograph, scene.objects.mesh_index)  # no theta changes them
        if self._last is None or any(a is not b for a, b in zip(self._last, same, strict=False)):
            self._last = (*same, self._make_renderer(identifier, scene))
        return self._last[2]

    @property
    def generated(self) -> bool:
        """Whether the generator made the data set's frames, and so can render them again."""
        return self._folder is not None or self._dataset == DEMO

    def check(self) -> None:
        """Raise NoSecondRendererError where no frame of the data set can be rendered a second time."""
        if not self.generated:
            shared_context()

    def _make_renderer(self, identifier: str, scene: SceneIR) -> SecondRenderer:
        if scene.photograph.is_cuda:
            return CpuSecondRenderer(self._make_renderer(identifier, convert_scene(scene, None, "cpu")))
        if scene.before is not None:
            return ExchangedSceneRenderer(identifier, scene)
        is_demo = scene.provenance.get("dataset") == DEMO
        photographed = self._folder is None and not is_demo
        if photographed or bool(scene.objects.upright.any()):  # plans hold no surfaces of people
            return _make_photograph_renderer(identifier, scene)
        from drivesem.failures.second_renderer.generator import DemoPlans, GeneratorRenderer

        plans = DemoPlans() if is_demo or self._folder is None else self._folder
        return GeneratorRenderer(identifier, scene, plans)


def _make_photograph_renderer(
    identifier: str, scene: SceneIR, before: PhotographRenderer | None = None
) -> PhotographRenderer:
    """Renderer of a photograph's scene. It has no mattes, so the surfaces of people get the outlines of theirs."""
    if bool(scene.objects.upright.any()):
        from scene_ir.derender.upright import trim_to_mattes

        scene = trim_to_mattes(scene)
    return PhotographRenderer(identifier, scene, before=before)


def _find_folder_plans(dataset: str, root: str | None) -> PlanSource | None:
    """Plans of a folder that the generator wrote; None for other folders, and for those without their settings."""
    if dataset != "kitti":
        return None
    folder = local_copy(root or "")
    if not any((one / MANIFEST).is_file() for one in (folder, folder.parent)):
        return None
    # Photographs need no generator, which takes a second to load.
    from drivesem.failures.second_renderer.generator import FolderPlans

    try:
        return FolderPlans(folder)
    except (UsageError, FormatError):
        return None
