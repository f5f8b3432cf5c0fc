"""Pictures of cars whose parts have plain colours."""

import cv2
import numpy as np
import torch

from scene_ir.derender.silhouette import Placement
from scene_ir.geometry import to_clip
from scene_ir.raster import verbs
from scene_ir.types import Camera, Part

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
NOTHING = np.zeros((200, 480), bool)
COLOURS = {
    Part.PAINT: (190, 40, 40),
    Part.GLASS: (30, 35, 40),
    Part.TYRE: (20, 20, 20),
    Part.LIGHT: (240, 235, 200),
}


def drawn(placement: Placement) -> tuple[verbs.Fragments, torch.Tensor]:
    """What of the mesh each pixel of `CAMERA` shows, and the vertices' clip coordinates."""
    clip = to_clip(placement.vertices(), CAMERA.matrix)
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 480, 200]]))
    faces = placement.mesh.faces
    return verbs.rasterize(clip, faces, torch.tensor([[0, len(faces)]]), layout), clip


def painted(placement: Placement) -> np.ndarray:
    """A picture (200, 480, 3) uint8 of the car whose parts have plain colours, on grey with grain."""
    face = drawn(placement)[0].face.reshape(200, 480).long()
    part = np.where(face.numpy() >= 0, placement.mesh.part[face.clamp(min=0)].numpy(), -1)
    image = np.full((200, 480, 3), 120.0)
    for kind, colour in COLOURS.items():
        image[part == int(kind)] = colour
    image[part == int(Part.OTHER)] = (70, 70, 70)
    image = cv2.GaussianBlur(image, (0, 0), 0.7) + np.random.default_rng(0).normal(0, 3, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)
