"""Renders objects with Mitsuba or pyrender instead of the project's renderer, with the same lights and materials."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from drivesem.classify.results import RendererAgreement
from drivesem.classify.scenes import SEEN_PX, ObjectScene, picture_camera
from drivesem.classify.space import ObjectChange
from drivesem.failures.second_renderer.base import NoSecondRendererError
from drivesem.failures.second_renderer.opengl import ImageWindow, PaintLayer, shared_context
from scene_ir.render.lit_mesh import GAMMA, MIRRORED_SHARE, UPWARD_SHARE, Lights
from scene_ir.types import Camera

Array = NDArray[np.float32]

_RAYS = 16
"""Mitsuba's rays per pixel; pictures are reduced to less than half the size, which leaves 80 per pixel."""
_VARIANT = "scalar_rgb"
"""Mitsuba's back end without LLVM: with an LLVM that is too old, the other one ends the process."""
_GLOSSY = 0.1
"""Weight of the glossy layer in Mitsuba's blend; both layers are scaled up to compensate for it."""
_SKY = (16, 32)
_EXPECTED = "Mitsuba 3 (pip install 'drivesem[mitsuba]')"
_MATT = 0.96**2
"""Fraction of a colour that remains, in pyrender's glTF shading, on a surface that is neither metal nor glossy."""


@dataclass(frozen=True, slots=True)
class PosedObject:
    """An object in front of the camera, in camera space (x right, y down, z forward)."""

    points: Array
    """Corners of the faces (3F, 3), each face wound towards its visible side."""
    normals: Array
    """Normals at the corners (3F, 3), towards the visible side."""
    diffuse: Array
    """Colour of each face (F, 3), linear, in [0, 1]."""
    specular: Array
    """Specular reflectance of each face (F,), in [0, 1]."""
    shininess: Array
    """Phong exponent of each face (F,)."""
    lights: Lights
    """The lights."""
    camera: Camera
    """The camera."""

    @classmethod
    @torch.no_grad()
    def from_scene(cls, scene: ObjectScene, change: ObjectChange | None = None) -> PosedObject:
        """Take the object of a scene, optionally changed."""
        model = scene.model
        corners, normals, away = scene.mesh.corners(scene.camera_vertices(change))

        def wind(values: Tensor) -> Array:
            return torch.where(away[:, None, None], values[:, [0, 2, 1]], values).reshape(-1, 3).numpy()

        return cls(
            points=wind(corners),
            normals=wind(normals.reshape(-1, 3, 3)),
            diffuse=model.diffuse.numpy(),
            specular=model.specular.numpy(),
            shininess=model.shininess.numpy(),
            lights=scene.lights(change),
            camera=picture_camera(),
        )


class SecondObjectRenderer(Protocol):
    """A renderer of objects."""

    name: str
    """Its name for users."""

    def render(self, posed: PosedObject) -> Tensor:
        """Render as `LitMesh.render`: RGB after gamma in [0, 1] and coverage (4, H, W)."""
        ...


def _lamp_rgb(lights: Lights) -> Array:
    """Strength of the lamp in R, G and B (3,)."""
    return lights.strength.detach().reshape(-1).expand(3).numpy()


def open_second_renderer(name: str) -> SecondObjectRenderer:
    """Open mitsuba, pyrender, or auto: Mitsuba if it is installed. Raises NoSecondRendererError."""
    if name != "pyrender":
        try:
            return MitsubaRenderer()
        except NoSecondRendererError:
            if name == "mitsuba":
                raise
    return PyrenderRenderer()


def measure_agreement(scene: ObjectScene, first: Tensor, second: Tensor) -> RendererAgreement:
    """Compare what two renderers drew of a scene.

    Args:
        scene: The scene.
        first: RGB and coverage of one renderer (4, H, W).
        second: The same of the other.
    """
    covered, other = first[3] >= 0.5, second[3] >= 0.5
    union = int((covered | other).sum())
    inside = F.interpolate((covered & other).float()[None, None], (SEEN_PX, SEEN_PX), mode="area")[0, 0] > 0.999
    lab = [_to_lab(scene.composite(layer))[inside.numpy()] for layer in (first, second)]
    distance = np.linalg.norm(lab[0] - lab[1], axis=1)
    return RendererAgreement(
        iou=round(int((covered & other).sum()) / union, 4) if union else 1.0,
        colour=round(float(distance.mean()), 2) if len(distance) else 0.0,
    )


def _to_lab(picture: Tensor) -> Array:
    """Convert a picture (3, H, W) to CIE L*a*b* (H, W, 3), in which 1 is hardly visible; black to white is 100."""
    rgb = np.ascontiguousarray(picture.clamp(0, 1).permute(1, 2, 0).numpy())
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB), np.float32)


class MitsubaRenderer:
    """`SecondObjectRenderer` with Mitsuba 3 (Jakob et al. 2022): ray tracing with shadows, without gradients.

    The project's shading is translated: the lamp to a point light of equal irradiance, the ambient light to a sky
    with the same irradiance for every normal, Phong's lobe to a rough conductor of equal width and height.
    The difference is physical: parts of an object shade each other.

    Raises:
        NoSecondRendererError: Mitsuba is not installed or does not run.
    """

    name = "mitsuba"

    def __init__(self) -> None:
        self._library = _load_mitsuba()

    def render(self, posed: PosedObject) -> Tensor:
        """See `SecondObjectRenderer`."""
        library, lights = self._library, posed.lights
        size = posed.camera.width
        focal = float(posed.camera.matrix[0, 0])
        scene = library.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "direct", "hide_emitters": True},
                "lamp": {
                    "type": "point",
                    "position": lights.point.tolist(),
                    "intensity": {
                        "type": "rgb",
                        "value": (math.pi * lights.reach**2 * _lamp_rgb(lights)).tolist(),
                    },
                },
                "sky": self._sky(float(lights.environment)),
                "object": self._mesh(posed),
                "sensor": {
                    "type": "perspective",
                    # Mitsuba looks along +z with x to the left and y up; the scene has x to the right and y down.
                    "to_world": library.ScalarTransform4f(np.diag([-1.0, -1.0, 1.0, 1.0])),
                    "fov_axis": "x",
                    "fov": math.degrees(2 * math.atan(size / 2 / focal)),
                    "near_clip": 0.01,
                    "far_clip": 100.0,
                    "sampler": {"type": "multijitter", "sample_count": _RAYS},
                    "film": {
                        "type": "hdrfilm",
                        "width": size,
                        "height": posed.camera.height,
                        "pixel_format": "rgba",
                        "component_format": "float32",
                        "rfilter": {"type": "box"},
                    },
                },
            }
        )
        image = torch.from_numpy(np.array(library.render(scene, spp=_RAYS), dtype=np.float32)).permute(2, 0, 1)
        coverage = image[3].clamp(0, 1)
        linear = image[:3] / coverage.clamp_min(1e-6)
        return torch.cat([linear.clamp(0, 1) ** GAMMA, coverage[None]])

    def _sky(self, strength: float) -> dict[str, Any]:
        """Sky with a cosine-weighted mean radiance over the half-space of a normal of 1 + UPWARD_SHARE up . normal."""
        height, width = _SKY
        polar = (np.arange(height) + 0.5) / height * math.pi  # 0 is up
        rows = strength * (1 + 1.5 * UPWARD_SHARE * np.cos(polar))
        pixels = np.broadcast_to(rows[:, None, None], (height, width, 3)).astype(np.float32)
        # The scene's y axis points down, so the sky is turned upside down.
        turn = self._library.ScalarTransform4f(np.diag([1.0, -1.0, -1.0, 1.0]))
        bitmap = self._library.Bitmap(np.ascontiguousarray(pixels))
        return {"type": "envmap", "bitmap": bitmap, "to_world": turn}

    def _mesh(self, posed: PosedObject) -> Any:
        library = self._library
        # Beckmann's distribution with this width and factor has the width and height of Phong's lobe.
        width = np.sqrt(2 / (posed.shininess + 2))
        height = posed.specular * 8 / (posed.shininess + 2)
        surface = {
            "type": "blendbsdf",
            "weight": _GLOSSY,
            "diffuse": {"type": "diffuse", "reflectance": _attribute("diffuse")},
            "glossy": {
                "type": "roughconductor",
                "material": "none",
                "distribution": "beckmann",
                "alpha": _attribute("width"),
                "specular_reflectance": _attribute("height"),
            },
        }
        properties = library.Properties()
        properties["surface"] = library.load_dict({"type": "twosided", "surface": surface})
        count = len(posed.points)
        mesh = library.Mesh("object", count, count // 3, properties, has_vertex_normals=True)
        parameters = library.traverse(mesh)
        parameters["vertex_positions"] = _flatten(posed.points)
        parameters["vertex_normals"] = _flatten(posed.normals)
        parameters["faces"] = np.arange(count, dtype=np.uint32)
        parameters.update()
        mesh.add_attribute("face_diffuse", 3, _flatten(posed.diffuse / (1 - _GLOSSY)))
        mesh.add_attribute("face_width", 1, _flatten(width))
        mesh.add_attribute("face_height", 1, _flatten(height / _GLOSSY))
        return mesh


def _attribute(name: str) -> dict[str, Any]:
    return {"type": "mesh_attribute", "name": f"face_{name}"}


def _flatten(values: Array) -> Array:
    return np.ascontiguousarray(values, np.float32).ravel()


@cache
def _load_mitsuba() -> Any:
    """Import Mitsuba, with as many threads as torch has now."""
    try:
        library = importlib.import_module("mitsuba")
        library.set_variant(_VARIANT)
        importlib.import_module("drjit").set_thread_count(torch.get_num_threads())
    except Exception as error:  # a library that lacks its own libraries raises anything
        raise NoSecondRendererError.from_exception(MitsubaRenderer.name, _EXPECTED, error) from error
    return library


class PyrenderRenderer:
    """`SecondObjectRenderer` with pyrender: OpenGL's z-buffer and glTF's shading, off screen.

    pyrender has no sky light, and its materials have no specular strength. So a picture is the sum of three: the
    lamp on matt surfaces; the lamp on mirrors with the width and height of Phong's lobe; and the ambient light,
    computed per corner.

    Raises:
        NoSecondRendererError: There is neither EGL nor OSMesa.
    """

    name = "pyrender"

    def __init__(self) -> None:
        self._context = shared_context()

    def render(self, posed: PosedObject) -> Tensor:
        """See `SecondObjectRenderer`."""
        lights, size = posed.lights, (posed.camera.height, posed.camera.width)
        window = ImageWindow(0, 0, size[1], size[0])
        intrinsics = posed.camera.matrix.numpy()[:3, :3]
        colour = _lamp_rgb(lights)
        intensity = math.pi * float(colour.max()) * lights.reach**2
        tint = colour / colour.max()  # of the surfaces, as pyrender's lamps are white
        diffuse, specular, shininess = (
            np.repeat(values, 3, axis=0) for values in (posed.diffuse, posed.specular, posed.shininess)
        )
        around = float(lights.environment) * (1 - UPWARD_SHARE * posed.normals[:, 1:2])
        sky = np.clip((diffuse + MIRRORED_SHARE * specular[:, None]) * around, 0, 1)
        matt = [PaintLayer(posed.points, posed.normals, tint * diffuse / np.float32(_MATT), 1.0, 0.0)]
        ambient = [PaintLayer(posed.points, posed.normals, (sky**GAMMA).astype(np.float32), 1.0, 0.0)]
        glossy = []
        for exponent in np.unique(shininess):
            same = shininess == exponent
            height = tint * specular[same, None] * 8 / (exponent + 2)
            rough = float((2 / (exponent + 2)) ** 0.25)
            layer = posed.points[same], posed.normals[same], height.astype(np.float32)
            glossy.append(PaintLayer(*layer, rough, 1.0))
        lamp = lights.point.numpy(), intensity
        images = [
            self._context.shade(layers, light, intrinsics, window)
            for layers, light in ((matt, lamp), (glossy, lamp), (ambient, None))
        ]
        coverage = images[0][..., 3:]
        # pyrender averages a pixel's samples after gamma, background included.
        linear = sum((image[..., :3] / np.maximum(coverage, 1e-6)) ** (1 / GAMMA) for image in images)
        colour = np.minimum(linear, 1) ** GAMMA
        both = np.concatenate([colour * coverage, coverage], axis=2).astype(np.float32)
        resized: Array = np.asarray(cv2.resize(both, (size[1], size[0]), interpolation=cv2.INTER_AREA), np.float32)
        resized[..., :3] /= np.maximum(resized[..., 3:], 1e-6)
        return torch.from_numpy(resized).permute(2, 0, 1).contiguous()
