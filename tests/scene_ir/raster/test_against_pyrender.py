"""Depth and silhouettes against OpenGL, through pyrender."""

import os
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scene_ir.raster import verbs

HEIGHT, WIDTH, FAR_M = 90, 200, 60.0
PLATFORM = "PYOPENGL_PLATFORM"


@pytest.fixture(scope="module")
def screen() -> Iterator[tuple[Any, Any]]:
    """pyrender and an off-screen image; skipped without a suitable OpenGL."""
    before = os.environ.get(PLATFORM)
    os.environ.setdefault(PLATFORM, "egl")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of pyrender's own dependencies, while they are imported
            pyrender = pytest.importorskip("pyrender", reason="pyrender is not installed", exc_type=ImportError)
            try:
                image = pyrender.OffscreenRenderer(WIDTH, HEIGHT)
            except Exception as error:  # a driver's errors have no common kind
                pytest.skip(f"OpenGL cannot draw without a window here: {error}")
        yield pyrender, image
        image.delete()
    finally:
        if before is None:
            os.environ.pop(PLATFORM, None)


def render_with_pyrender(screen: tuple[Any, Any], crowd: Any) -> NDArray[np.float32]:
    """Depth (H, W) m, inf where nothing is hit."""
    pyrender, image = screen
    back = np.array([1.0, -1.0, -1.0], np.float32)  # OpenGL looks along -z with y up
    scene = pyrender.Scene()
    for points, faces in zip(crowd.points, crowd.faces, strict=True):
        part = pyrender.Primitive(positions=points.numpy() * back, indices=faces.numpy(), mode=4)
        scene.add(pyrender.Mesh([part]))
    k = crowd.intrinsics.tolist()
    # OpenGL's pixel centres lie at halves.
    view = pyrender.IntrinsicsCamera(
        k[0][0], k[1][1], k[0][2] + 0.5, k[1][2] + 0.5, znear=verbs.NEAR_M, zfar=FAR_M
    )
    scene.add(view)
    flags = pyrender.RenderFlags.DEPTH_ONLY | pyrender.RenderFlags.SKIP_CULL_FACES
    depth = np.asarray(image.render(scene, flags=flags))
    return np.where(depth > 0, depth, np.inf).astype(np.float32)


@pytest.mark.parametrize("seed", range(8))
def test_depth_and_silhouettes_agree_up_to_one_pixel_at_outlines(
    screen: tuple[Any, Any],
    crowd: Callable[[int], Any],
    outlines: Callable[[NDArray[np.float32]], NDArray[np.bool_]],
    inner_pixels: Callable[..., NDArray[np.bool_]],
    seed: int,
) -> None:
    scene = crowd(seed)
    ours, theirs = scene.render_depth(cull=False), render_with_pyrender(screen, scene)
    band = outlines(ours)
    inner = inner_pixels(ours, theirs, band)
    # pyrender reads one of four samples of a pixel, not its centre: the depth is that of somewhere within it.
    square = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(ours, square)[inner], cv2.dilate(ours, square)[inner]
    # Parts narrower than a pixel may lie there and at no centre. Depth has 24 bits from 5 cm on: 2 mm at 40 m.
    slack = 1e-4 * ours[inner] + 2.0**-23 / verbs.NEAR_M * np.square(ours[inner])
    assert ((low - slack < theirs[inner]) & (theirs[inner] < high + slack)).mean() > 0.98
    wrong = np.abs(ours[inner] / theirs[inner] - 1.0)
    assert np.median(wrong) < 1e-3
    assert wrong.max() < 0.05
