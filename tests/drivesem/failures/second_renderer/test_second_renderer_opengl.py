"""OpenGL without a window: what is drawn where, and what is said where there is none."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drivesem.failures.second_renderer.base import NoSecondRendererError
from drivesem.failures.second_renderer.opengl import (
    SUPERSAMPLING,
    ImageWindow,
    OpenGLContext,
    TexturedSurface,
    shared_context,
)
from drivesem.failures.second_renderer.photograph import PhotographRenderer
from drivesem.synth.demo import demo_scene

INTRINSICS = np.array([[100, 0, 50], [0, 100, 40], [0, 0, 1]], np.float32)


def square(x0: float, y0: float, x1: float, y1: float, z: float) -> np.ndarray:
    """Two triangles (6, 3) m whose projection is these pixels' edges."""
    corners = np.array([[x0, y0], [x1, y1], [x1, y0], [x0, y0], [x0, y1], [x1, y1]], np.float32)
    return np.concatenate([(corners - [50, 40]) / 100 * z, np.full((6, 1), z)], axis=1).astype(np.float32)


def plain(*rgb: int) -> TexturedSurface:
    return TexturedSurface(np.full((6, 2), 0.5, np.float32), np.full((4, 4, 3), rgb, np.uint8))


def test_pixels_depths_and_owners(screen: OpenGLContext) -> None:
    window = ImageWindow(10, 20, 40, 30)
    points = [square(19.5, 29.5, 29.5, 39.5, 10.0), square(24.5, 29.5, 39.5, 39.5, 5.0)]
    drawn = screen.render(points, [plain(255, 0, 0), plain(0, 0, 255)], INTRINSICS, window)
    rows, columns = window.slices
    assert (rows.start, columns.start) == (20, 10)
    # Column 20 of the picture is the tenth of the window.
    np.testing.assert_allclose(drawn.colour[10:20, 10:15], np.broadcast_to([1, 0, 0, 1], (10, 5, 4)), atol=0.01)
    np.testing.assert_allclose(drawn.colour[10:20, 15:30], np.broadcast_to([0, 0, 1, 1], (10, 15, 4)), atol=0.01)
    assert not drawn.colour[:, :10].any()
    np.testing.assert_allclose(drawn.depth_m[12, [12, 20]], [10, 5], rtol=1e-3)
    assert np.isinf(drawn.depth_m[0, 0])
    assert drawn.owner[12 * SUPERSAMPLING, [0, 12 * SUPERSAMPLING, 20 * SUPERSAMPLING]].tolist() == [0, 1, 2]


def test_edges_are_averages(screen: OpenGLContext) -> None:
    drawn = screen.render(
        [square(20.0, 30.0, 30.0, 40.0, 8.0)], [plain(255, 255, 255)], INTRINSICS, ImageWindow(0, 0, 60, 60)
    )
    assert drawn.colour[35, 20, 3] == pytest.approx(0.5, abs=0.15)
    assert drawn.colour[35, 25, 3] == pytest.approx(1)
    np.testing.assert_allclose(drawn.colour[35, 20, 0], drawn.colour[35, 20, 3], atol=0.01)


def test_another_renderer_of_the_process_may_come_and_go(screen: OpenGLContext) -> None:
    import pyrender

    def seen() -> np.ndarray:
        window = ImageWindow(0, 0, 60, 60)
        return screen.render([square(20, 30, 30, 40, 8)], [plain(255, 0, 0)], INTRINSICS, window).colour

    before = seen()
    pyrender.OffscreenRenderer(8, 8).delete()
    np.testing.assert_array_equal(seen(), before)

    # Another that lives on may have been given the handle of the one that is gone: both have to draw.
    pyrender.OffscreenRenderer(8, 8).delete()
    other = pyrender.OffscreenRenderer(8, 8)
    np.testing.assert_array_equal(seen(), before)
    empty = pyrender.Scene(bg_color=(0.0, 0.0, 1.0, 1.0))
    empty.add(pyrender.PerspectiveCamera(yfov=1.0))
    assert other.render(empty)[0][4, 4].tolist() == [0, 0, 255]
    np.testing.assert_array_equal(seen(), before)


def test_without_egl_and_osmesa_one_line_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str, *_: object) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    shared_context.cache_clear()
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setattr(ctypes, "CDLL", missing)
    with pytest.raises(NoSecondRendererError, match="libegl1 or libosmesa6") as message:
        PhotographRenderer("demo-000", demo_scene(0, 0))
    assert "\n" not in str(message.value)
    assert "PYOPENGL_PLATFORM" not in os.environ
    shared_context.cache_clear()


@pytest.mark.usefixtures("screen")
def test_torchs_compiler_is_loaded_before_the_driver(tmp_path: Path) -> None:
    """A process that draws and then trains: with both LLVMs the other order is a segmentation fault."""
    (tmp_path / "triton.py").write_text("import sys\nprint('OpenGL' in sys.modules)\n")
    program = (
        "import torch, drivesem.failures.second_renderer.opengl as s; s.shared_context(); "
        "print('triton' in sys.modules)"
    )
    both = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[4])])
    ended = subprocess.run(
        [sys.executable, "-c", f"import sys; {program}"],
        env={**os.environ, "PYTHONPATH": both},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stdout) == (0, "False\nTrue\n"), ended.stderr


@pytest.mark.usefixtures("screen")
def test_a_process_that_draws_can_train() -> None:
    program = (
        "import torch, drivesem.failures.second_renderer.opengl as s; s.shared_context(); import torch._dynamo"
    )
    ended = subprocess.run([sys.executable, "-c", program], cwd=Path(__file__).parents[4], check=False)
    assert ended.returncode == 0
