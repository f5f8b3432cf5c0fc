"""Off-screen rendering of textured triangles by pyrender, through EGL or, where that is missing, OSMesa."""

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
"""OpenGL's camera looks along -z, with y upwards."""
SUPERSAMPLING = 2
"""Subpixels per pixel, each way; pyrender takes four samples in each."""
NEAR_M, FAR_M = 0.1, 1000.0
_PLATFORM_VARIABLE = "PYOPENGL_PLATFORM"
_LIBRARIES = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}
_EXPECTED = "EGL or OSMesa, for photographs' second renderer (install Debian's libegl1 or libosmesa6)"


@dataclass(frozen=True, slots=True)
class TexturedSurface:
    """Texture of one object's F triangles."""

    uv: Array
    """(3F, 2) in [0, 1], corner by corner, v upwards."""
    texture: NDArray[np.uint8]
    """(h, w, 3); w is a multiple of 4, as OpenGL reads rows."""


@dataclass(frozen=True, slots=True)
class PaintLayer:
    """F triangles of one glossy material."""

    points: Array
    """(3F, 3) m, corner by corner."""
    normals: Array
    """(3F, 3), corner by corner."""
    colours: Array
    """(3F, 3), factor on each corner's light; linear under a lamp."""
    roughness: float
    """In [0, 1], as in glTF."""
    metallic: float
    """In [0, 1], as in glTF."""


@dataclass(frozen=True, slots=True)
class ImageWindow:
    """The part of an image that is rendered."""

    x0: int
    """Left pixel."""
    y0: int
    """Top pixel."""
    width: int
    """Width, px."""
    height: int
    """Height, px."""

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the image."""
        return slice(self.y0, self.y0 + self.height), slice(self.x0, self.x0 + self.width)


@dataclass(frozen=True, slots=True)
class WindowImage:
    """Rendered objects in a window; s is the supersampling."""

    colour: Array
    """(h, w, 4) in [0, 1], premultiplied by coverage."""
    depth_m: Array
    """(h, w), inf where nothing is."""
    owner: NDArray[np.uint8]
    """(h s, w s), object + 1 by subpixel; 0 where there is none."""


@dataclass(frozen=True, slots=True)
class ObjectDepth:
    """Depth of one object alone."""

    window: ImageWindow
    """The rendered window."""
    depth_m: Array
    """(h s, w s), inf outside of the object."""


class OpenGLContext:
    """An OpenGL context of this process. Raises NoSecondRendererError where there is none."""

    def __init__(self) -> None:
        self._library = _import_pyrender()
        self._open()

    def render(
        self, points: Sequence[Array], surfaces: Sequence[TexturedSurface], intrinsics: Array, window: ImageWindow
    ) -> WindowImage:
        """Render textured objects with a common depth test.

        Args:
            points: (3F, 3) m for each object, corner by corner, in the camera's own axes, wound as `Mesh.faces`.
            surfaces: Their textures.
            intrinsics: (3, 3) px.
            window: Part of the image to render.
        """
        self._reopen()
        flags = self._library.RenderFlags
        scene, nodes = self._make_scene(points, surfaces, intrinsics, window)
        colour, _ = self._render_scene(scene, flags.FLAT | flags.RGBA, None, window)
        colour = cv2.resize(colour.astype(np.float32), (window.width, window.height), interpolation=cv2.INTER_AREA)
        owner, depth = self._render_owners(scene, nodes, window)
        return WindowImage(colour / np.float32(255), _nearest_sample(depth), owner)

    def render_depth(self, points: Array, intrinsics: Array, window: ImageWindow) -> ObjectDepth:
        """Render the depth of one object; see `render` for the arguments.

        Args:
            points: (3F, 3) m, corner by corner.
            intrinsics: (3, 3) px.
            window: Part of the image to render.
        """
        self._reopen()
        nothing = TexturedSurface(np.zeros((len(points), 2), np.float32), np.zeros((1, 1, 3), np.uint8))
        scene, nodes = self._make_scene([points], [nothing], intrinsics, window)
        return ObjectDepth(window, self._render_owners(scene, nodes, window)[1])

    def shade(
        self,
        layers: Sequence[PaintLayer],
        lamp: tuple[Array, float] | None,
        intrinsics: Array,
        window: ImageWindow,
    ) -> Array:
        """Render glossy materials under a point lamp.

        Args:
            layers: Triangles by material.
            lamp: Position (3,) and intensity; without a lamp, colours appear as they are.
            intrinsics: (3, 3) px.
            window: Part of the image to render.

        Returns:
            (h s, w s, 4) in [0, 1]: colour, raised to 1/2.2 under a lamp, and coverage, averaged over the samples.
        """
        self._reopen()
        library = self._library
        scene = library.Scene(bg_color=(0.0, 0.0, 0.0, 0.0), ambient_light=(0.0, 0.0, 0.0))
        for layer in layers:
            material = library.MetallicRoughnessMaterial(
                roughnessFactor=layer.roughness, metallicFactor=layer.metallic
            )
            opaque = np.ones((len(layer.colours), 1), np.float32)
            part = library.Primitive(
                positions=layer.points * _TO_OPENGL,
                normals=layer.normals * _TO_OPENGL,
                color_0=np.concatenate([layer.colours, opaque], axis=1),
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
        self, points: Sequence[Array], surfaces: Sequence[TexturedSurface], intrinsics: Array, window: ImageWindow
    ) -> tuple[Any, list[Any]]:
        library = self._library
        scene = library.Scene(bg_color=(0.0, 0.0, 0.0, 0.0), ambient_light=(1.0, 1.0, 1.0))
        linear = 9729  # GL_LINEAR: an atlas has no mipmaps
        sampler = library.Sampler(magFilter=linear, minFilter=linear)
        nodes = []
        for placed, surface in zip(points, surfaces, strict=True):
            texture = library.Texture(sampler=sampler, source=surface.texture, source_channels="RGB")
            material = library.MetallicRoughnessMaterial(baseColorTexture=texture)
            part = library.Primitive(
                positions=placed * _TO_OPENGL, texcoord_0=surface.uv, material=material, mode=4
            )
            nodes.append(scene.add(library.Mesh([part])))
        self._add_camera(scene, intrinsics, window)
        return scene, nodes

    def _add_camera(self, scene: Any, intrinsics: Array, window: ImageWindow) -> None:
        """Add the camera."""
        library, s, k = self._library, SUPERSAMPLING, intrinsics.astype(np.float64)
        # Pixel centres are integers in the conventions, and half-integers in OpenGL.
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
        """Create a renderer, and write a mark into its context by which `_reopen` recognises it."""
        try:
            self._renderer = self._library.OffscreenRenderer(64, 64)
            from OpenGL import GL

            self._mark = os.urandom(16)
            self._buffer = GL.glGenBuffers(1)
            GL.glBindBuffer(GL.GL_ARRAY_BUFFER, self._buffer)
            GL.glBufferData(GL.GL_ARRAY_BUFFER, len(self._mark), self._mark, GL.GL_STATIC_DRAW)
        except Exception as error:  # drivers' errors have no common base class
            raise NoSecondRendererError.from_exception("pyrender", _EXPECTED, error) from error

    def _reopen(self) -> None:
        """Open another context if this one is gone.

        All pyrender renderers of a process share one display. The first one that is deleted, perhaps a user's,
        closes it with all its contexts. Their handles may then be reused for other contexts, so rendering would
        give a wrong image instead of an error.
        """
        from OpenGL import GL

        try:
            self._renderer._platform.make_current()
            GL.glBindBuffer(GL.GL_ARRAY_BUFFER, self._buffer)
            if bytes(GL.glGetBufferSubData(GL.GL_ARRAY_BUFFER, 0, len(self._mark))) == self._mark:
                return
        except Exception:  # drivers' errors have no common base class; the mark cannot be read
            pass
        # Without its platform, the old renderer cannot delete what another one owns by now.
        self._renderer._platform = None
        self._open()


@cache
def shared_context() -> OpenGLContext:
    """The only context of this process."""
    return OpenGLContext()


def _nearest_sample(depth: Array) -> Array:
    """The smallest depth of each pixel's subpixels."""
    s = SUPERSAMPLING
    height, width = depth.shape
    return depth.reshape(height // s, s, width // s, s).min(axis=(1, 3))


def _import_pyrender() -> Any:
    """Import pyrender for an available platform. Raises NoSecondRendererError where there is none."""
    platform = os.environ.get(_PLATFORM_VARIABLE) or next(filter(_has_library, _LIBRARIES), None)
    if platform is None:
        raise NoSecondRendererError("pyrender", _EXPECTED, "neither")
    os.environ[_PLATFORM_VARIABLE] = platform
    # torch's optimisers load triton where it is installed. Its LLVM must load before that of Mesa, which renders
    # without a GPU; in the other order, the process crashes.
    with contextlib.suppress(Exception):
        importlib.import_module("triton")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # from pyrender's dependencies
            import pyrender
    except Exception as error:  # OpenGL's bindings raise various errors where a driver is missing
        raise NoSecondRendererError.from_exception("pyrender", _EXPECTED, error) from error
    return pyrender


def _has_library(platform: str) -> bool:
    try:
        ctypes.CDLL(_LIBRARIES[platform])
    except OSError:
        return False
    return True
