"""Frames with vehicles moved, turned, deformed and painted at random, within the feasible set, by the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from detectors.training import Sample
from detectors.types import Targets
from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.labels import Labeller, append_other_labels, to_kitti_labels
from drivesem.attack.space import PAPER_PARAMETERS, Parameter, ParameterSpace
from drivesem.data import kitti
from drivesem.training.frames import TRAINING_LIMITS, FrameStore, training_targets
from scene_ir import files
from scene_ir.derender.derender import DerenderSettings, derender
from scene_ir.errors import SceneError
from scene_ir.io import to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.types import Frame, Labels, SceneIR

VARIANTS = 4
"""Perturbations per frame: de-rendering costs more than a few renders."""
PARAMETERS = PAPER_PARAMETERS
_BENT_BY = 0.3
"""Share of the budget from which lattice offsets are drawn: the bound on strain scales nearly all larger ones back."""


class PerturbedFrames(Sequence[Sample]):
    """The frames of a store; each view is perturbed with probability `share`.

    A frame is de-rendered when first drawn. Its variants are cached in `folder` and depend only on the frame, its
    index and the seed. Frames without vehicles, or that cannot be de-rendered, stay as they are.
    """

    def __init__(self, store: FrameStore, folder: Path, share: float, seed: int) -> None:
        self._store, self._folder, self._share, self._seed = store, folder, share, seed

    def __len__(self) -> int:
        return len(self._store)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._store[index]

    def draw(self, index: int, step: int, generator: np.random.Generator) -> Sample:
        """Draw a frame or one of its variants.

        Args:
            index: The frame.
            step: Not used.
            generator: Source of random numbers.
        """
        if generator.random() >= self._share:
            return self._store[index]
        variant = int(generator.integers(VARIANTS))
        name = self._store.names[index].replace("/", "_")
        folder = self._folder / name
        if not folder.is_dir():
            self._make(index, folder)
        if not (folder / f"{variant}.png").is_file():
            return self._store[index]
        labels = kitti.read_labels(folder / f"{variant}.txt")
        return files.read_image(folder / f"{variant}.png"), training_targets(
            labels, TRAINING_LIMITS, self._store.classes
        )

    def _make(self, index: int, folder: Path) -> None:
        """Write all variants of a frame at once; an empty folder where there are none."""
        with files.atomic_folder(folder) as part:
            frame = self._store.dataset.frame(self._store.names[index])
            try:
                variants = perturb_frame(frame, [self._seed, index])
            except SceneError:
                return
            for i, (image, labels) in enumerate(variants):
                files.write_png(part / f"{i}.png", image)
                kitti.write_labels(part / f"{i}.txt", labels)


@torch.no_grad()
def perturb_frame(frame: Frame, seed: Sequence[int]) -> list[tuple[np.ndarray, Labels]]:
    """Perturb a labelled frame `VARIANTS` times: pixels (H, W, 3) uint8 RGB, and moved labels.

    Empty for a frame without vehicles. Raises SceneError where the frame cannot be de-rendered.
    """
    scene = derender(frame, DerenderSettings(fit=False))
    if not len(scene.objects) or frame.labels is None:
        return []
    space = ParameterSpace(scene, PARAMETERS)
    feasible, compositor = FeasibleSet(space), Compositor(scene)
    labeller = Labeller(scene, compositor.render(scene))
    generator = np.random.default_rng([*seed, 4])
    reach = torch.ones(space.dim)
    reach[space.blocks.get(Parameter.MESH)] = _BENT_BY
    found = []
    for _ in range(VARIANTS):
        # Cubed: most codes stay near the photograph.
        drawn = torch.from_numpy(generator.uniform(-1, 1, space.dim).astype(np.float32)) ** 3 * reach
        theta = torch.where(drawn < 0, -drawn * space.lower, drawn * space.upper)
        image, labels, _ = render_state(feasible.project(theta).theta, space, compositor, labeller, scene)
        found.append((image, labels))
    return found


@torch.no_grad()
def render_state(
    theta: Tensor, space: ParameterSpace, compositor: Compositor, labeller: Labeller, base: SceneIR
) -> tuple[np.ndarray, Labels, Targets]:
    """Render and label a state.

    Args:
        theta: (D,) the state.
        space: Its parameters.
        compositor: Renderer of the scene.
        labeller: Its labeller.
        base: Scene of the labels that move.

    Returns:
        Pixels (H, W, 3) uint8 RGB; labels, including people and other objects outside of the scene; evaluation
        targets, of which the first rows are the scene's objects.
    """
    moved = space.apply(space.scene, theta)
    render = compositor.render(moved)
    labels = labeller.moved(moved, render)
    every = append_other_labels(to_kitti_labels(labels, base, moved), base.other_labels)
    return to_uint8(render.image), every, labels.targets
