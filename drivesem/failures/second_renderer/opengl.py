"""A window that nobody sees, in which pyrender draws textured triangles: EGL, or OSMesa where that is missing."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivesem.failures.second_renderer.base import NoSecondRendererError

Array = NDArray[np.float32]

_TO_OPENGL = np.array([1, -1, -1], np.float32)
"""OpenGL looks along -z, with y upwards."""
SUPERSAMPLING = 2
"""Drawn pixels a pixel, each way; pyrender takes four samples in each of them."""
NEAR_M, FAR_M = 0.1, 1000.0
_PLATFORM_VARIABLE = "PYOPENGL_PLATFORM"
_LIBRARIES = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}
_EXPECTED = "EGL or OSMesa, for photographs' second renderer (install Debian's libegl1 or libosmesa6)"


@dataclass(frozen=True, slots=True)
class TexturedSurface:
    """One object's triangles. uv: (3F, 2) in [0, 1], corner by corner, v upwards; texture: (h, w, 3) uint8, w a
    multiple of 4 as OpenGL reads rows."""

    uv: Array
    texture: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class PaintLayer:
    """Triangles of one gloss under a lamp. points, normals: (3F, 3), corner by corner; colours: (3F, 3), what each
    corner's light is multiplied by, linear under a lamp; roughness, metallic: in [0, 1], see glTF."""

    points: Array
    normals: Array
    colours: Array
    roughness: float
    metallic: float


@dataclass(frozen=True, slots=True)
class ImageWindow:
    """The part of a picture that is drawn: its upper left pixel, its size in pixels."""

    x0: int
    y0: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the picture."""
        return slice(self.y0, self.y0 + self.height), slice(self.x0, self.x0 + self.width)


@dataclass(frozen=True, slots=True)
class WindowImage:
    """What a window shows. colour: (h, w, 4) in [0, 1], premultiplied by coverage; depth_m: (h, w), inf where
    nothing is; owner: (h s, w s) object + 1 by drawn pixel, 0 where none is."""

    colour: Array
    depth_m: Array
    owner: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class ObjectDepth:
    """One object without the others. depth_m: (h s, w s), inf beside it."""

    window: ImageWindow
    depth_m: Array


class OpenGLContext:
    """An OpenGL context of this process. Raises NoSecondRendererError where there is none."""

    def __init__(self) -> None:
        self._library = _import_pyrender()
        self._open()

    def render(
        self, points: Sequence[Array], skins: Sequence[TexturedSurface], intrinsics: Array, window: ImageWindow
    ) -> WindowImage:
        """Objects, tested by depth among each other. points: (3F, 3) m of each, corner by corner, in the axes of
        the picture's own camera, their fronts winding as `Mesh.faces` do; intrinsics: (3, 3) px."""
        self._reopen()
        flags = self._library.RenderFlags
        scene, nodes = self._make_scene(points, skins, intrinsics, window)
        colour, _ = self._render_scene(scene, flags.FLAT | flags.RGBA, None, window)
        colour = cv2.resize(colour.astype(np.float32), (window.width, window.height), interpolation=cv2.INTER_AREA)
        owner, depth = self._render_owners(scene, nodes, window)
        return WindowImage(colour / np.float32(255), _nearest_sample(depth), owner)

    def render_depth(self, points: Array, intrinsics: Array, window: ImageWindow) -> ObjectDepth:
        """One object, see `draw`."""
        self._reopen()
        nothing = TexturedSurface(np.zeros((len(points), 2), np.float32), np.zeros((1, 1, 3), np.uint8))
        scene, nodes = self._make_scene([points], [nothing], intrinsics, window)
        return ObjectDepth(window, self._render_owners(scene, nodes, window)[1])

    def shade(
        self, coats: Sequence[PaintLayer], lamp: tuple[Array, float] | None, intrinsics: Array, window: ImageWindow
    ) -> Array:
        """(h s, w s, 4) in [0, 1] by drawn pixel: colour, raised to 1/2.2 under a lamp, and coverage; both are
        averages over a pixel's samples. lamp: where (3,), and its intensity; without one colours show as they are.
        """
        self._reopen()
        library = self._library
        scene = library.Scene(bg_color=(0.0, 0.0, 0.0, 0.0), ambient_light=(0.0, 0.0, 0.0))
        for coat in coats:
            material = library.MetallicRoughnessMaterial(
                roughnessFactor=coat.roughness, metallicFactor=coat.metallic
            )
            opaque = np.ones((len(coat.colours), 1), np.float32)
            part = library.Primitive(
                positions=coat.points * _TO_OPENGL,
                normals=coat.normals * _TO_OPENGL,
                color_0=np.concatenate([coat.colours, opaque], axis=1),
                material=material,
                mode=4,
            )
            scene.add(library.Mesh([part]))
        flags = library.RenderFlags.RGBA | library.RenderFlags.SKIP_CULL_FACES
        if lamp is None:
            flags |= library.RenderFlags.FLAT
        else:
            pose = np.eye(4)
            pose[:3, 3] = lamp[0] * _TO_OPENGL
            scene.add(library.PointLight(color=(1.0, 1.0, 1.0), intensity=lamp[1]), pose=pose)
        self._add_camera(scene, intrinsics, window)
        return self._render_scene(scene, flags, None, window)[0].astype(np.float32) / np.float32(255)

    def _make_scene(
        self, points: Sequence[Array], skins: Sequence[TexturedSurface], intrinsics: Array, window: ImageWindow
    ) -> tuple[Any, list[Any]]:
        library = self._library
        scene = library.Scene(bg_color=(0.0, 0.0, 0.0, 0.0), ambient_light=(1.0, 1.0, 1.0))
        linear = 9729  # GL_LINEAR: an atlas has no smaller levels
        sampler = library.Sampler(magFilter=linear, minFilter=linear)
        nodes = []
        for placed, skin in zip(points, skins, strict=True):
            texture = library.Texture(sampler=sampler, source=skin.texture, source_channels="RGB")
            material = library.MetallicRoughnessMaterial(baseColorTexture=texture)
            part = library.Primitive(positions=placed * _TO_OPENGL, texcoord_0=skin.uv, material=material, mode=4)
            nodes.append(scene.add(library.Mesh([part])))
        self._add_camera(scene, intrinsics, window)
        return scene, nodes

    def _add_camera(self, scene: Any, intrinsics: Array, window: ImageWindow) -> None:
        """Add the camera."""
        library, s, k = self._library, SUPERSAMPLING, intrinsics.astype(np.float64)
        # Pixel centres are integers here, and halves there.
        centre = (k[0, 2] + 0.5 - window.x0) * s, (k[1, 2] + 0.5 - window.y0) * s
        camera = library.IntrinsicsCamera(k[0, 0] * s, k[1, 1] * s, *centre, znear=NEAR_M, zfar=FAR_M)
        scene.add(camera)

    def _render_owners(
        self, scene: Any, nodes: Sequence[Any], window: ImageWindow
    ) -> tuple[NDArray[np.uint8], Array]:
        flags = self._library.RenderFlags
        names = {node: (i + 1, 0, 0) for i, node in enumerate(nodes)}
        found, depth = self._render_scene(scene, flags.SEG, names, window)
        return np.ascontiguousarray(found[..., 0]), np.where(depth > 0, depth, np.float32(np.inf))

    def _render_scene(
        self, scene: Any, flags: int, names: dict[Any, Any] | None, window: ImageWindow
    ) -> tuple[Any, Array]:
        self._renderer.viewport_width = window.width * SUPERSAMPLING
        self._renderer.viewport_height = window.height * SUPERSAMPLING
        return self._renderer.render(scene, flags=flags, seg_node_map=names)

    def _open(self) -> None:
        """Make a renderer, and leave a mark in its context by which `_reopen` knows it."""
        try:
            self._renderer = self._library.OffscreenRenderer(64, 64)
            from OpenGL import GL

            self._mark = os.urandom(16)
            self._buffer = GL.glGenBuffers(1)
            GL.glBindBuffer(GL.GL_ARRAY_BUFFER, self._buffer)
            GL.glBufferData(GL.GL_ARRAY_BUFFER, len(self._mark), self._mark, GL.GL_STATIC_DRAW)
        except Exception as error:  # a driver's errors have no common kind
            raise NoSecondRendererError.from_exception("pyrender", _EXPECTED, error) from error

    def _reopen(self) -> None:
        """Before a scene is made: open another context if this one is gone. All pyrender renderers of a process
        share one display, and the first that is deleted, maybe a user's, ends it with all of its contexts. Their
        handles may then be given to others' contexts, so that drawing on would show no error, but another picture.
        """
        from OpenGL import GL

        try:
            self._renderer._platform.make_current()
            GL.glBindBuffer(GL.GL_ARRAY_BUFFER, self._buffer)
            if bytes(GL.glGetBufferSubData(GL.GL_ARRAY_BUFFER, 0, len(self._mark))) == self._mark:
                return
        except Exception:  # a driver's errors have no common kind; whichever it is, the mark cannot be read
            pass
        # Without its platform the old renderer cannot delete what by now belongs to another.
        self._renderer._platform = None
        self._open()


@cache
def shared_context() -> OpenGLContext:
    """The one window of this process."""
    return OpenGLContext()


def _nearest_sample(depth: Array) -> Array:
    """Of the drawn pixels of each pixel the nearest."""
    s = SUPERSAMPLING
    height, width = depth.shape
    return depth.reshape(height // s, s, width // s, s).min(axis=(1, 3))


def _import_pyrender() -> Any:
    """The library, told which platform to draw on. Raises NoSecondRendererError where there is none."""
    platform = os.environ.get(_PLATFORM_VARIABLE) or next(filter(_has_library, _LIBRARIES), None)
    if platform is None:
        raise NoSecondRendererError("pyrender", _EXPECTED, "neither")
    os.environ[_PLATFORM_VARIABLE] = platform
    # torch's optimisers load its compiler, where that is installed. Its LLVM and that of Mesa, which draws without
    # a GPU, go together in this order alone: the other way round the process ends.
    with contextlib.suppress(Exception):
        importlib.import_module("triton")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of pyrender's own dependencies, while they are imported
            import pyrender
    except Exception as error:  # OpenGL's bindings raise what they like where a driver is missing
        raise NoSecondRendererError.from_exception("pyrender", _EXPECTED, error) from error
    return pyrender


def _has_library(platform: str) -> bool:
    try:
        ctypes.CDLL(_LIBRARIES[platform])
    except OSError:
        return False
    return True
