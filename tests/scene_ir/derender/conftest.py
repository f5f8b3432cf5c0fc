"""A street made by code, of which everything is known: its photograph, its background, its car and the car's
mask."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch

from scene_ir.meshes.templates import template
from scene_ir.render.compositor import Compositor
from scene_ir.types import LATTICE_POINTS, Camera, Environment, Frame, Labels, Objects, SceneIR

HEIGHT, WIDTH, FOCAL = 200, 480, 380.0
HORIZON = 88.0


@dataclass(frozen=True)
class Street:
    frame: Frame
    background: np.ndarray
    mask: np.ndarray
    sun: torch.Tensor


def camera() -> Camera:
    return Camera(torch.tensor([[FOCAL, 0, 239.5], [0, FOCAL, HORIZON], [0, 0, 1.0]]), HEIGHT, WIDTH)


def labels_of(kind: str, translation: list[float], yaw: float, size_lhw: list[float], box: list[float]) -> Labels:
    return Labels(
        (kind,),
        torch.tensor([box]),
        torch.zeros(1),
        torch.zeros(1, dtype=torch.int64),
        torch.tensor([translation]),
        torch.tensor([yaw]),
        torch.tensor([size_lhw]),
        torch.zeros(0, 4),
    )


def empty_street() -> np.ndarray:
    """(H, W, 3): sky, a hedge, a road with grain."""
    rng = np.random.default_rng(5)
    image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    image[:45] = (0.72, 0.84, 0.98)
    hedge = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32), (0, 0), 1.2)
    image[45:96] = np.array([0.18, 0.33, 0.12]) + 0.12 * hedge[45:96, :, None]
    grain = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32), (0, 0), 0.8)
    image[96:] = 0.52 + 0.05 * grain[96:, :, None]
    return np.clip(np.rint(image * 255) / 255, 0, 1).astype(np.float32)


def _scene(background: np.ndarray, objects: Objects, sun: torch.Tensor) -> SceneIR:
    blank = torch.zeros(HEIGHT, WIDTH)
    picture = torch.from_numpy(np.ascontiguousarray(background.transpose(2, 0, 1)))
    environment = Environment(
        torch.zeros(4), torch.zeros(3), sun, torch.tensor([0.0, -1.0, 0.0, 1.65]), blank, blank, blank
    )
    depth = torch.full((HEIGHT, WIDTH), 60.0)
    return SceneIR(
        camera(), (template("hatchback"),), objects, environment, picture, picture, depth, torch.zeros(0, 4)
    )


@pytest.fixture(scope="session")
def street() -> Street:
    """A red hatchback, its label 0.1 m and a degree off, as labels are."""
    background = empty_street()
    sun = torch.nn.functional.normalize(torch.tensor([-0.5, -1.0, -0.3]), dim=0)
    size, place, yaw = [4.0, 1.5, 1.7], [0.6, 1.65, 11.0], 0.6
    code = torch.tensor([[0.0, 0.8, 0.5, 0.0, 0.0]])
    objects = Objects(
        torch.zeros(1, dtype=torch.int64),
        torch.tensor([place]),
        torch.tensor([yaw]),
        torch.tensor([size]),
        torch.zeros(1, LATTICE_POINTS, 3),
        code,
        torch.zeros(1, dtype=torch.int64),
        torch.zeros(1, 4),
        torch.zeros(1),
        torch.zeros(1, dtype=torch.int64),
    )
    scene = _scene(background, objects, sun)
    render = Compositor(scene).render(scene)
    photograph = (render.image * 255).round() / 255
    mask = render.object_id.numpy() > 0
    rows, columns = np.nonzero(mask)
    box = [float(columns.min()), float(rows.min()), float(columns.max()), float(rows.max())]
    labels = labels_of("Car", [place[0] + 0.08, 1.66, place[2] - 0.1], yaw + 0.02, [4.05, 1.48, 1.72], box)
    return Street(Frame("synthetic", photograph, camera(), labels), background, mask, sun)
