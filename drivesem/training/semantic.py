"""Frames whose vehicles were moved, turned, bent and painted at random, feasibly, by the project's renderer."""

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
"""Different perturbations of a frame: a frame's scene costs more than a few renders of it."""
PARAMETERS = PAPER_PARAMETERS
_BENT_BY = 0.3
"""Share of the budget that lattice offsets are drawn from: further out nearly all are scaled back to the same
bound on strain."""


class PerturbedFrames(Sequence[Sample]):
    """The frames of a store, a share of which is shown perturbed, each time by chance.

    A frame is taken apart when it is first drawn, and its variants stay in `folder`: they depend on the frame, its
    place and the seed alone. Frames without vehicles, or that cannot be taken apart, are shown as they are.
    """

    def __init__(self, store: FrameStore, folder: Path, share: float, seed: int) -> None:
        self._store, self._folder, self._share, self._seed = store, folder, share, seed

    def __len__(self) -> int:
        return len(self._store)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._store[index]

    def draw(self, index: int, step: int, generator: np.random.Generator) -> Sample:
        """Frame `index`, or one of its variants."""
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
        """All variants of a frame, whole or not at all; an empty folder where there can be none."""
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
    """VARIANTS feasible perturbations of a labelled frame: pixels (H, W, 3) uint8 RGB, and labels that moved too.

    None for a frame without vehicles. Raises SceneError where the frame cannot be taken apart.
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
        # Cubed: most codes stay near the photograph, as most days are no storm.
        drawn = torch.from_numpy(generator.uniform(-1, 1, space.dim).astype(np.float32)) ** 3 * reach
        theta = torch.where(drawn < 0, -drawn * space.lower, drawn * space.upper)
        image, labels, _ = render_state(feasible.project(theta).theta, space, compositor, labeller, scene)
        found.append((image, labels))
    return found


@torch.no_grad()
def render_state(
    theta: Tensor, space: ParameterSpace, compositor: Compositor, labeller: Labeller, base: SceneIR
) -> tuple[np.ndarray, Labels, Targets]:
    """The scene at theta (D,): pixels (H, W, 3) uint8 RGB, its labels, those of people and whatever else stays
    among them, and targets as they are judged, whose first rows are all of the scene's objects. base: the scene of
    the labels that move along.
    """
    moved = space.apply(space.scene, theta)
    render = compositor.render(moved)
    labels = labeller.moved(moved, render)
    every = append_other_labels(to_kitti_labels(labels, base, moved), base.other_labels)
    return to_uint8(render.image), every, labels.targets
