"""`python -m tools.bench rivals`: the same cars, drawn by others, and renderers that are not there."""

import pytest
import torch

from drivesem.bench.render import SceneSize
from drivesem.bench.scenes import PackedMeshes, build_bench_scene
from scene_ir.raster import verbs
from scene_ir.types import convert_scene
from tools.bench import renderers, rivals
from tools.bench.renderers import RenderTask


def test_the_own_verbs_stand_beside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renderers, "RENDERERS", {})
    (row,) = rivals.measure([SceneSize(1, 600)], 0.0, 0, "cpu")
    assert row.backend == "warp-verbs"
    assert row.forward_ms is not None
    assert row.forward_ms > 0
    assert row.backward_ms is not None
    assert row.forward_backward_ms is not None
    assert row.forward_backward_ms > row.backward_ms > 0


def _task(cars: int) -> RenderTask:
    scene = convert_scene(build_bench_scene(cars, 600).scene, torch.float32)
    placed = PackedMeshes.from_scene(scene)
    weight = torch.ones(scene.camera.height, scene.camera.width, 3)
    return RenderTask(placed, scene.camera, torch.rand(placed.points.shape), weight)


@pytest.mark.parametrize("name", ["pyrender", "open3d"])
@pytest.mark.filterwarnings("ignore")
def test_other_renderers_draw_the_same_cars(name: str) -> None:
    task = _task(4)
    try:
        renderer = renderers.RENDERERS[name](task)
    except renderers.UnavailableError as error:
        pytest.skip(f"{name}: {error}")
    placed, camera = task.placed, task.camera
    everything = torch.tensor([[0, placed.faces.shape[0]]])
    frame = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, camera.width, camera.height]]))
    own = int((verbs.rasterize(placed.clip, placed.faces, everything, frame).face >= 0).sum())
    assert renderer.hits(renderer.forward()) == pytest.approx(own, rel=0.02)


@pytest.mark.parametrize("name", ["pytorch3d", "nvdiffrast", "mitsuba"])
def test_a_renderer_that_is_not_there_says_why(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(module: str) -> None:
        raise ModuleNotFoundError(f"No module named {module!r}")

    monkeypatch.setattr(renderers.importlib, "import_module", missing)
    row = rivals._measure_rival(name, (SceneSize(1, 600), 5, _task(1)), 0.0, "cpu")
    assert row.forward_ms is None
    assert row.unavailable is not None
    assert "No module named" in row.unavailable
