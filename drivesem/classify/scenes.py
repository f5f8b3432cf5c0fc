"""Scenes for classifiers: one object in one view, lit by a lamp near the camera, in front of a background."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from drivesem.classify.objects.types import ObjectModel
from drivesem.classify.space import LAMP_RGB, Lamp, ObjectChange, rotation_matrix
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.render.lit_mesh import Lights, LitMesh, Materials, composite_over
from scene_ir.types import Camera

DRAWN_PX, SEEN_PX = 512, 224
"""Side of a picture as rendered, and as the network sees it (the paper's)."""
VIEWS = {"forward": (0.0, 0.0), "top": (0.35, 0.0), "left": (0.0, 0.5), "right": (0.0, -0.5)}
"""Pitch and yaw of the object in each view, rad (the paper's four views)."""
DISTANCE = 2.2
"""Distance from the camera to the object's centre, in object sizes."""
_FOCAL = 1.85
"""Focal length, in picture widths: an object in any pose fits into the picture."""
_LAMP_POSITION = (0.5, -0.8, 0.2)
"""Position of the lamp in camera space: to the right of the camera and above it."""
_STRENGTH, _ENVIRONMENT = 0.85, 0.3
_FAR = 100.0
"""Distance of the coloured lamp before the object, in object sizes."""
_OBJECT_TO_CAMERA = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
"""From the object's axes (y up, front towards -z) to camera space, seen from the front."""

_BACKGROUND_GREYNESS = 0.5
"""Weight of grey in the colours of generated backgrounds."""
_Backgrounds = Callable[[str], Tensor]


@dataclass(frozen=True)
class ObjectScene:
    """An object in one view in front of a background."""

    identifier: str
    """Name of the picture."""
    model: ObjectModel
    """The object."""
    view: str
    """Key of `VIEWS`."""
    background: Tensor
    """RGB in [0, 1], (3, DRAWN_PX, DRAWN_PX)."""
    lamp: Lamp = "white"
    """The lamp; neither casts shadows."""

    @cached_property
    def mesh(self) -> LitMesh:
        """The object as the renderer takes it."""
        model = self.model
        materials = Materials(model.diffuse, model.specular, model.shininess)
        return LitMesh(model.mesh.vertices, model.mesh.faces, materials)

    @property
    def vertices(self) -> Tensor:
        """Unchanged vertices (V, 3), y up, front towards -z."""
        return self.model.mesh.vertices

    def camera_vertices(self, change: ObjectChange | None = None) -> Tensor:
        """Compute vertices (V, 3) in camera space after a change; differentiable."""
        change = change or ObjectChange()
        vertices = self.vertices if change.offsets is None else self.vertices + change.offsets
        angles = vertices.new_tensor([*VIEWS[self.view], 0.0])
        to_camera = vertices.new_tensor(_OBJECT_TO_CAMERA)
        if change.turns == "add":
            angles = angles if change.angles is None else angles + change.angles
            turned = vertices @ (rotation_matrix(angles) @ to_camera).T
        else:
            turned = self.vertices @ (rotation_matrix(angles) @ to_camera).T
            turned = turned if change.angles is None else _turn_about_mean(turned, change.angles)
            turned = turned if change.offsets is None else turned + change.offsets
            turned = turned if change.next_turn is None else _turn_about_mean(turned, change.next_turn)
        return turned + vertices.new_tensor([0.0, 0.0, DISTANCE])

    def lights(self, change: ObjectChange | None = None) -> Lights:
        """The lights after a change; the coloured lamp's strength is (3, 1), of R, G and B."""
        light = self.vertices.new_zeros(5) if change is None or change.light is None else change.light
        if self.lamp == "coloured":
            colour = light.new_tensor(LAMP_RGB) * 3 / sum(LAMP_RGB)
            strength = _STRENGTH * colour * (1 + light[:3])
            far = light.new_tensor([0.0, 0.0, DISTANCE - _FAR])
            return Lights(far, strength[:, None], light.new_tensor(_ENVIRONMENT), _FAR)
        lamp = light.new_tensor(_LAMP_POSITION) + light[2:]
        return Lights(lamp, _STRENGTH * (1 + light[0]), _ENVIRONMENT * (1 + light[1]), DISTANCE)

    def render(self, change: ObjectChange | None = None) -> Tensor:
        """Render the picture the network sees, RGB in [0, 1], (3, SEEN_PX, SEEN_PX); differentiable."""
        vertices, lights = self.camera_vertices(change), self.lights(change)
        return self.composite(*self.mesh.render_part(vertices, picture_camera(), lights))

    def composite(self, layer: Tensor, x: int = 0, y: int = 0) -> Tensor:
        """Put a rendered layer over the background and downscale; only the surroundings of the layer are computed.

        Args:
            layer: RGB and coverage (4, h, w), in [0, 1].
            x: Column of its left edge in the rendered picture.
            y: Row of its upper edge.

        Returns:
            RGB (3, SEEN_PX, SEEN_PX).
        """
        if not layer.numel():
            return self._small_background.to(layer)
        rows, columns = _ResampledSpan.around(y, layer.shape[1]), _ResampledSpan.around(x, layer.shape[2])
        padding = (*columns.padding(x, layer.shape[2]), *rows.padding(y, layer.shape[1]))
        background = self.background[:, rows.rendered, columns.rendered].to(layer)
        small = _downscale(composite_over(F.pad(layer, padding), background), (rows.size, columns.size))
        picture = self._small_background.to(layer, copy=True)
        picture[:, rows.target, columns.target] = small[:, rows.valid, columns.valid]
        return picture

    @cached_property
    def _small_background(self) -> Tensor:
        return _downscale(self.background, (SEEN_PX, SEEN_PX))


def _downscale(picture: Tensor, size: tuple[int, int]) -> Tensor:
    """Downscale (3, H, W) to (3, *size) with a filter of one output pixel to either side."""
    return F.interpolate(picture[None], size, mode="bilinear", antialias=True)[0]


@dataclass(frozen=True)
class _ResampledSpan:
    """Rows, or columns, of a picture that a layer affects, rendered and downscaled."""

    rendered: slice
    """Rendered pixels, between positions at which a rendered and a downscaled pixel begin together."""
    size: int
    """Number of downscaled pixels of this span."""
    valid: slice
    """Those of them that do not depend on pixels outside the span."""
    target: slice
    """Position of the valid ones in the downscaled picture."""

    @classmethod
    def around(cls, begin: int, count: int) -> _ResampledSpan:
        """The span that `count` rendered pixels from `begin` on affect."""
        steps = math.gcd(DRAWN_PX, SEEN_PX)
        drawn, seen = DRAWN_PX // steps, SEEN_PX // steps
        margin = -(-2 // seen)  # in steps: a downscaled pixel reaches its own width to either side of its centre
        first = max(begin // drawn - margin, 0)
        last = min(-(-(begin + count) // drawn) + margin, steps)
        low, high = int(first > 0), int(last < steps)
        size = (last - first) * seen
        target = slice(first * seen + low, last * seen - high)
        return cls(slice(first * drawn, last * drawn), size, slice(low, size - high), target)

    def padding(self, begin: int, count: int) -> tuple[int, int]:
        """Pixels of `rendered` before and after `count` pixels from `begin` on."""
        return begin - self.rendered.start, self.rendered.stop - begin - count


def picture_camera(size: int = DRAWN_PX) -> Camera:
    """Make the camera of all pictures, for a side of `size` pixels."""
    focal, middle = _FOCAL * size, (size - 1) / 2
    return Camera(torch.tensor([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]]), size, size)


def _turn_about_mean(vertices: Tensor, angles: Tensor) -> Tensor:
    """Turn vertices (V, 3) by pitch, yaw and roll (3,), rad, about their mean."""
    mean = vertices.mean(dim=0)
    return mean + (vertices - mean) @ rotation_matrix(angles).T


def open_backgrounds(folder: str | None) -> _Backgrounds:
    """Return a function from a picture's name to its background: a photograph of the folder, or a generated one.

    Raises:
        FormatError: A folder without photographs. The function raises it for a photograph that cannot be read.
    """
    if folder is None:
        return generate_background
    suffixes = {".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff"}
    root = Path(folder)
    paths = sorted(path for path in root.rglob("*") if path.suffix.lower() in suffixes) if root.is_dir() else []
    if not paths:
        raise FormatError(folder, "a folder with photographs (PNG, JPEG, ...)", "none")
    return lambda name: load_background(paths[_seed_from_name(name) % len(paths)])


def load_background(path: Path) -> Tensor:
    """Load the centre square of a photograph as a background. Raises FormatError."""
    image = files.read_image(path)
    side = min(image.shape[:2])
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    square = cv2.resize(
        image[top : top + side, left : left + side], (DRAWN_PX, DRAWN_PX), interpolation=cv2.INTER_AREA
    )
    return torch.from_numpy(np.ascontiguousarray(square.transpose(2, 0, 1))).float() / 255


def generate_background(name: str) -> Tensor:
    """Generate a background from a name: a sky over a ground, with blotches of all sizes."""
    rng = np.random.default_rng(_seed_from_name(name))
    rows = np.linspace(0, 1, DRAWN_PX, dtype=np.float32)[:, None, None]
    horizon, soft = rng.uniform(0.35, 0.75), rng.uniform(0.01, 0.15)
    sky, ground, glow = (
        rng.uniform(low, high, 3).astype(np.float32) for low, high in ((0.3, 0.95), (0.1, 0.7), (0.4, 1.0))
    )
    grey = _BACKGROUND_GREYNESS
    sky, ground, glow = (grey * colour.mean() + (1 - grey) * colour for colour in (sky, ground, glow))
    upper = sky + (glow - sky) * np.clip(rows / horizon, 0, 1)
    share = 1 / (1 + np.exp(np.clip((horizon - rows) / soft, -30, 30)))
    picture = upper * (1 - share) + ground * share
    for cells in (4, 12, 40, 120):
        noise = rng.normal(0, rng.uniform(0.005, 0.04), (cells, cells, 3)).astype(np.float32)
        noise = noise[..., :1] + 0.15 * noise
        picture = picture + cv2.resize(noise, (DRAWN_PX, DRAWN_PX), interpolation=cv2.INTER_CUBIC)
    return torch.from_numpy(np.clip(picture, 0, 1).astype(np.float32).transpose(2, 0, 1).copy())


def _seed_from_name(name: str) -> int:
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:6], "big")
