"""What a classifier is shown: an object, from a view, under a lamp near the camera, before a background."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from drivesem.classify.objects.types import ObjectModel
from drivesem.classify.space import Change
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.render.lit_mesh import Lights, LitMesh, Materials, composite_over
from scene_ir.types import Camera

DRAWN_PX, SEEN_PX = 512, 224
"""Pictures are drawn so large, and shown so large to a network (the paper)."""
VIEWS = {"forward": (0.0, 0.0), "top": (0.35, 0.0), "left": (0.0, 0.5), "right": (0.0, -0.5)}
"""Pitch and yaw, rad, of the object before the camera (the paper's four views)."""
DISTANCE = 2.2
"""From the camera to the object's middle, in object sizes."""
_FOCAL = 1.85
"""Of the camera, in widths of the picture: an object turned any way stays in it."""
_LAMP = (0.5, -0.8, 0.2)
"""Where the lamp is, in camera space: to the right of the camera and above it."""
_STRENGTH, _ENVIRONMENT = 0.85, 0.3
_TURN = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
"""From y up, front towards -z, to camera space, seen from the front."""

_PALE = 0.5
"""How grey the colours of backgrounds are that are made."""

_Backgrounds = Callable[[str], Tensor]


@dataclass(frozen=True)
class ObjectScene:
    """An object from a view before a background (3, DRAWN_PX, DRAWN_PX) RGB in [0, 1]."""

    identifier: str
    model: ObjectModel
    view: str
    background: Tensor

    @cached_property
    def mesh(self) -> LitMesh:
        """What draws it."""
        model = self.model
        materials = Materials(model.diffuse, model.specular, model.shininess)
        return LitMesh(model.mesh.vertices, model.mesh.faces, materials)

    @property
    def vertices(self) -> Tensor:
        """(V, 3) at rest, y up, the front towards -z."""
        return self.model.mesh.vertices

    def placed(self, change: Change | None = None) -> Tensor:
        """Vertices (V, 3) in camera space, with a change; differentiable."""
        change = change or Change()
        vertices = self.vertices if change.offsets is None else self.vertices + change.offsets
        angles = vertices.new_tensor([*VIEWS[self.view], 0.0])
        angles = angles if change.angles is None else angles + change.angles
        turned = vertices @ (rotation(angles) @ vertices.new_tensor(_TURN)).T
        return turned + vertices.new_tensor([0.0, 0.0, DISTANCE])

    def lights(self, change: Change | None = None) -> Lights:
        """The lights, with a change."""
        light = self.vertices.new_zeros(5) if change is None or change.light is None else change.light
        lamp = light.new_tensor(_LAMP) + light[2:]
        return Lights(lamp, _STRENGTH * (1 + light[0]), _ENVIRONMENT * (1 + light[1]), DISTANCE)

    def picture(self, change: Change | None = None) -> Tensor:
        """(3, SEEN_PX, SEEN_PX) RGB in [0, 1]; differentiable to the change."""
        placed, lights = self.placed(change), self.lights(change)
        return self.shown(*self.mesh.render_part(placed, camera(), lights))

    def shown(self, drawn: Tensor, x: int = 0, y: int = 0) -> Tensor:
        """What a renderer drew (4, h, w) from column x and row y on, before the background, as a network sees it.
        Only what is around it is put together and made smaller.
        """
        if not drawn.numel():
            return self._behind.to(drawn)
        rows, columns = _Cut.around(y, drawn.shape[1]), _Cut.around(x, drawn.shape[2])
        around = (*columns.beside(x, drawn.shape[2]), *rows.beside(y, drawn.shape[1]))
        whole = composite_over(F.pad(drawn, around), self.background[:, rows.drawn, columns.drawn].to(drawn))
        size = (rows.small, columns.small)
        small = _smaller(whole, size)
        picture = self._behind.to(drawn, copy=True)
        picture[:, rows.seen, columns.seen] = small[:, rows.kept, columns.kept]
        return picture

    @cached_property
    def _behind(self) -> Tensor:
        """The background as a network sees it."""
        return _smaller(self.background, (SEEN_PX, SEEN_PX))


def _smaller(picture: Tensor, size: tuple[int, int]) -> Tensor:
    """(3, *size) of (3, H, W): each pixel is a mean of what lies within a pixel's width around its middle."""
    return F.interpolate(picture[None], size, mode="bilinear", antialias=True)[0]


@dataclass(frozen=True)
class _Cut:
    """The rows, or columns, of a picture that change where something is drawn. drawn: as they are drawn, from a
    line to a line at which a drawn and a seen pixel begin together; small: how many seen ones these are; kept:
    those of them that see nothing beyond, and seen: where they belong.
    """

    drawn: slice
    small: int
    kept: slice
    seen: slice

    @classmethod
    def around(cls, begin: int, count: int) -> _Cut:
        """Of `count` drawn pixels from `begin` on, and so far beyond as a seen pixel reaches that sees any."""
        steps = math.gcd(DRAWN_PX, SEEN_PX)
        drawn, seen = DRAWN_PX // steps, SEEN_PX // steps
        margin = -(-2 // seen)  # of steps: a seen pixel reaches its own width either way from its middle
        first = max(begin // drawn - margin, 0)
        last = min(-(-(begin + count) // drawn) + margin, steps)
        low, high = int(first > 0), int(last < steps)
        small = (last - first) * seen
        kept = slice(low, small - high)
        return cls(slice(first * drawn, last * drawn), small, kept, slice(first * seen + low, last * seen - high))

    def beside(self, begin: int, count: int) -> tuple[int, int]:
        """How much of `drawn` lies before those pixels, and after them."""
        return begin - self.drawn.start, self.drawn.stop - begin - count


def camera(size: int = DRAWN_PX) -> Camera:
    """The camera of all pictures."""
    focal, middle = _FOCAL * size, (size - 1) / 2
    return Camera(torch.tensor([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]]), size, size)


def rotation(angles: Tensor) -> Tensor:
    """(3, 3): by angles (3,) rad, yaw first, then pitch, then roll, about the camera's axes; at a positive pitch
    the object shows its top.
    """
    (cp, cy, cr), (sp, sy, sr) = angles.cos(), angles.sin()
    zero, one = torch.zeros_like(cp), torch.ones_like(cp)
    pitch = torch.stack([one, zero, zero, zero, cp, -sp, zero, sp, cp]).reshape(3, 3)
    yaw = torch.stack([cy, zero, sy, zero, one, zero, -sy, zero, cy]).reshape(3, 3)
    roll = torch.stack([cr, -sr, zero, sr, cr, zero, zero, zero, one]).reshape(3, 3)
    return roll @ pitch @ yaw


def open_backgrounds(folder: str | None) -> _Backgrounds:
    """Backgrounds by a scene's name: of the photographs of a folder one, or one that is made. Raises FormatError
    for a folder without pictures, and, when it is asked for, for a picture that cannot be read.
    """
    if folder is None:
        return generated_background
    kinds = {".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff"}
    root = Path(folder)
    paths = sorted(path for path in root.rglob("*") if path.suffix.lower() in kinds) if root.is_dir() else []
    if not paths:
        raise FormatError(folder, "a folder with photographs (PNG, JPEG, ...)", "none")
    return lambda name: photograph(paths[_seed(name) % len(paths)])


def photograph(path: Path) -> Tensor:
    """The middle of a photograph as a background. Raises FormatError."""
    image = files.read_image(path)
    side = min(image.shape[:2])
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    square = cv2.resize(
        image[top : top + side, left : left + side], (DRAWN_PX, DRAWN_PX), interpolation=cv2.INTER_AREA
    )
    return torch.from_numpy(np.ascontiguousarray(square.transpose(2, 0, 1))).float() / 255


def generated_background(name: str) -> Tensor:
    """A background that nobody photographed: a sky over a ground, with blotches of all sizes."""
    rng = np.random.default_rng(_seed(name))
    rows = np.linspace(0, 1, DRAWN_PX, dtype=np.float32)[:, None, None]
    horizon, soft = rng.uniform(0.35, 0.75), rng.uniform(0.01, 0.15)
    sky, ground, glow = (
        rng.uniform(low, high, 3).astype(np.float32) for low, high in ((0.3, 0.95), (0.1, 0.7), (0.4, 1.0))
    )
    sky, ground, glow = (_PALE * colour.mean() + (1 - _PALE) * colour for colour in (sky, ground, glow))
    upper = sky + (glow - sky) * np.clip(rows / horizon, 0, 1)
    share = 1 / (1 + np.exp(np.clip((horizon - rows) / soft, -30, 30)))
    picture = upper * (1 - share) + ground * share
    for cells in (4, 12, 40, 120):
        noise = rng.normal(0, rng.uniform(0.005, 0.04), (cells, cells, 3)).astype(np.float32)
        noise = noise[..., :1] + 0.15 * noise
        picture = picture + cv2.resize(noise, (DRAWN_PX, DRAWN_PX), interpolation=cv2.INTER_CUBIC)
    return torch.from_numpy(np.clip(picture, 0, 1).astype(np.float32).transpose(2, 0, 1).copy())


def in_turn(names: Sequence[str]) -> list[str]:
    """Names "class/object" so that of classes each has its turn: the first of each, then the second."""
    seen: Counter[str] = Counter()
    turns: list[tuple[int, str]] = []
    for name in names:
        kind = name.rpartition("/")[0]
        turns.append((seen[kind], name))
        seen[kind] += 1
    return [name for _, name in sorted(turns, key=lambda turn: turn[0])]


def _seed(name: str) -> int:
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:6], "big")
