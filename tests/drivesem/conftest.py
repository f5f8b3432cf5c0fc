"""A street of a few cars, without any photograph behind it: what space, feasibility and labels need of a scene.
And the command line given bad input."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from drivesem.cli import main
from scene_ir.geometry import clip_boxes, project_boxes
from scene_ir.meshes.templates import template
from scene_ir.types import Camera, Environment, Objects, SceneIR

HEIGHT, WIDTH = 188, 621
GROUND_Y_M = 1.65


def _street(
    positions_xz: Sequence[tuple[float, float]] = ((-2.5, 9.0), (2.5, 12.0), (-2.5, 18.0), (2.5, 24.0)),
    yaw: float = -1.5,
    dtype: torch.dtype = torch.float32,
    road_edge_x_m: float = 100.0,
    tilt: float = 0.0,
) -> SceneIR:
    """Cars at (x, z) m on the plane y = 1.65 + tilt * z; the road reaches from -road_edge to road_edge in x."""
    n = len(positions_xz)
    intrinsics = torch.tensor([[360.0, 0, 310], [0, 360, 94], [0, 0, 1]], dtype=dtype)
    camera = Camera(intrinsics, HEIGHT, WIDTH)
    xz = torch.tensor(positions_xz, dtype=dtype).reshape(n, 2)
    translation = torch.stack([xz[:, 0], GROUND_Y_M + tilt * xz[:, 1], xz[:, 1]], dim=-1)
    yaws = torch.full((n,), yaw, dtype=dtype)
    size_lhw = torch.tensor([4.2, 1.5, 1.75], dtype=dtype).repeat(n, 1)
    boxes = clip_boxes(project_boxes(size_lhw, yaws, translation, camera.matrix), HEIGHT, WIDTH)
    objects = Objects(
        mesh_index=torch.zeros(n, dtype=torch.int64),
        translation=translation,
        yaw=yaws,
        size_lhw=size_lhw,
        ffd=torch.zeros(n, 64, 3, dtype=dtype),
        texture_code=torch.zeros(n, 5, dtype=dtype),
        category=torch.zeros(n, dtype=torch.int64),
        box2d=boxes + 0.25,
        truncation=torch.zeros(n, dtype=dtype),
        occlusion=torch.zeros(n, dtype=torch.int64),
    )
    v, u = torch.meshgrid(torch.arange(HEIGHT, dtype=dtype), torch.arange(WIDTH, dtype=dtype), indexing="ij")
    # y = GROUND_Y + tilt * z along the ray ((u - 310) / 360, (v - 94) / 360, 1) * z
    z = GROUND_Y_M / ((v - 94) / 360 - tilt).clamp(min=1e-6)
    road = ((v > 96) & ((u - 310) / 360 * z).abs().lt(road_edge_x_m)).to(dtype)
    normal = torch.tensor([0.0, -1.0, tilt], dtype=dtype)
    empty = torch.zeros(HEIGHT, WIDTH, dtype=dtype)
    environment = Environment(
        weather=torch.zeros(4, dtype=dtype),
        foliage=torch.zeros(3, dtype=dtype),
        sun=torch.tensor([0.0, -1.0, 0.0], dtype=dtype),
        ground=torch.cat([normal, torch.tensor([GROUND_Y_M], dtype=dtype)]) / normal.norm(),
        sky=empty,
        foliage_map=empty,
        road=road,
    )
    grey = torch.full((3, HEIGHT, WIDTH), 0.5, dtype=dtype)
    return SceneIR(
        camera=camera,
        meshes=(template("sedan"),),
        objects=objects,
        environment=environment,
        photograph=grey,
        background=grey,
        depth=torch.full((HEIGHT, WIDTH), 80.0, dtype=dtype),
        ignore=torch.zeros(0, 4, dtype=dtype),
    )


@pytest.fixture(scope="session")
def street() -> Callable[..., SceneIR]:
    """The factory of streets."""
    return _street


@pytest.fixture
def command_line() -> Callable[[list[str]], int]:
    """The program that `refused` calls; folders of other programs override it."""
    return main


@pytest.fixture
def refused(
    command_line: Callable[[list[str]], int],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., str]:
    """The one line with which a command refuses bad input; it leaves no file behind."""

    def call(*words: str) -> str:
        folder = tmp_path / "empty"
        folder.mkdir()
        monkeypatch.chdir(folder)
        capsys.readouterr()
        assert command_line(list(words)) == 2
        printed = capsys.readouterr()
        (line,) = printed.err.splitlines()
        assert printed.out == ""
        assert not list(folder.iterdir())
        return line

    return call


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Debian's browser, headless. Playwright comes with the tests; its own browser cannot be had everywhere."""
    from playwright.sync_api import sync_playwright

    path = shutil.which("chromium")
    if path is None:
        pytest.skip("Debian's chromium is not installed")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()
