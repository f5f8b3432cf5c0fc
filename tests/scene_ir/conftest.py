"""A small street with three box-like cars, drawn by the project itself and then taken apart again."""

import math
from collections.abc import Callable

import pytest
import torch
import trimesh

from scene_ir.render.sources import photograph_scene
from scene_ir.types import Camera, Environment, Mesh, Objects, Part, SceneIR

HEIGHT, WIDTH, FOCAL, EYE_M = 80, 144, 110.0, 1.65


def _car(colour: tuple[float, float, float], dtype: torch.dtype) -> Mesh:
    """A subdivided box, its upper half drawn in to a cabin of glass."""
    box = trimesh.creation.box().subdivide().subdivide()
    vertices = torch.tensor(box.vertices[:, [0, 2, 1]].copy(), dtype=dtype)
    faces = torch.tensor(box.faces[:, [0, 2, 1]].copy(), dtype=torch.int64)
    vertices[:, 1] -= 0.5
    high = vertices[:, 1] < -0.6
    vertices[high, 0] *= 0.55
    vertices[high, 2] *= 0.8
    glass = (vertices[faces][:, :, 1].mean(dim=1) < -0.6) & (vertices[faces][:, :, 1].amin(dim=1) > -0.99)
    part = torch.where(glass, int(Part.GLASS), int(Part.PAINT))
    colours = torch.tensor(colour, dtype=dtype).expand(len(vertices), 3).clone()
    split = vertices[faces].reshape(-1, 3)
    colours = colours[faces].reshape(-1, 3)
    colours[glass.repeat_interleave(3)] = 0.15
    return Mesh(split, torch.arange(len(split)).reshape(-1, 3), part, "box", colours)


def _noise(count: int, scale: float, seed: int, dtype: torch.dtype) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(
        1, count, int(HEIGHT / scale) + 2, int(WIDTH / scale) + 2, generator=generator, dtype=dtype
    )
    return torch.nn.functional.interpolate(coarse, (HEIGHT, WIDTH), mode="bicubic", align_corners=True)[0]


def bare_scene(dtype: torch.dtype = torch.float64) -> SceneIR:
    """The street without photograph: its background stands for it; objects without sources."""
    intrinsics = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT * 0.4], [0, 0, 1]], dtype=dtype)
    projection = torch.cat([intrinsics, torch.tensor([[4.0], [0.1], [0.003]], dtype=dtype)], dim=1)
    camera = Camera(intrinsics, HEIGHT, WIDTH, projection)
    rows = torch.arange(HEIGHT, dtype=dtype)[:, None].expand(HEIGHT, WIDTH)
    below = rows - HEIGHT * 0.4
    depth = torch.where(below > 1.5, EYE_M * FOCAL / below.clamp(min=1.0), torch.inf)
    road = (below > 1.5).to(dtype)
    sky = (rows < 20).to(dtype)
    foliage = ((rows >= 20) & (below <= 1.5)).to(dtype) * _noise(1, 9, 1, dtype)[0].clamp(0, 1)
    base = torch.tensor([0.45, 0.44, 0.42], dtype=dtype)[:, None, None] * road + (1 - road) * 0.6
    green = torch.tensor([0.25, 0.38, 0.2], dtype=dtype)[:, None, None]
    picture = base * (1 - foliage) + green * foliage
    picture = picture + 0.25 * (_noise(3, 6, 2, dtype) - 0.5) + 0.1 * (_noise(3, 2.5, 3, dtype) - 0.5)
    picture = (picture.clamp(0.1, 0.85) * 255).round() / 255
    sun = torch.tensor([0.4, -0.75, -0.4], dtype=dtype)
    environment = Environment(
        torch.zeros(4, dtype=dtype), torch.zeros(3, dtype=dtype), sun / sun.norm(),
        torch.tensor([0.0, -1.0, 0.0, EYE_M], dtype=dtype), sky, foliage, road,
    )  # fmt: skip
    places = [[-2.3, EYE_M, 9.0], [1.6, EYE_M, 10.5], [0.4, EYE_M, 17.0]]
    colours = ((0.75, 0.2, 0.15), (0.2, 0.3, 0.6), (0.7, 0.65, 0.3))
    objects = Objects(
        torch.arange(3), torch.tensor(places, dtype=dtype),
        torch.tensor([math.pi / 2 + 0.5, -math.pi / 2 + 0.65, 0.4], dtype=dtype),
        torch.tensor([[4.2, 1.5, 1.8], [4.5, 1.7, 1.9], [4.0, 1.45, 1.7]], dtype=dtype),
        torch.zeros(3, 64, 3, dtype=dtype), torch.zeros(3, 5, dtype=dtype), torch.zeros(3, dtype=torch.int64),
        torch.zeros(3, 4, dtype=dtype), torch.zeros(3, dtype=dtype), torch.zeros(3, dtype=torch.int64),
    )  # fmt: skip
    meshes = tuple(_car(c, dtype) for c in colours)
    return SceneIR(camera, meshes, objects, environment, picture, picture, depth, torch.zeros(0, 4, dtype=dtype))


@pytest.fixture(scope="session")
def street() -> Callable[[torch.dtype], SceneIR]:
    """The small street, not photographed, in a dtype."""
    return bare_scene


@pytest.fixture(scope="session")
def photographed() -> SceneIR:
    """The small street photographed, float64, for the reference backend."""
    return photograph_scene(bare_scene(), "reference")
