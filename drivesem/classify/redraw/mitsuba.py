"""Mitsuba 3 (Jakob et al. 2022): light that is traced, with shadows and without gradients.

What the project's own renderer adds up is translated: the lamp to a point light of equal irradiance, the light
from all around to a sky whose irradiance is the same for every normal, Phong's lobe to a rough conductor of equal
width and equal height. What differs is what physics adds: parts of an object shade each other.
"""

from __future__ import annotations

import importlib
import math
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from drivesem.classify.redraw.base import Solid
from drivesem.failures.second_renderer.base import NoSecondRendererError
from scene_ir.render.lit_mesh import GAMMA, UPWARD_SHARE

NAME = "mitsuba"
_RAYS = 16
"""A pixel; pictures are shown at less than half the size, so that 80 make a pixel that is seen."""
_VARIANT = "scalar_rgb"
"""Needs no LLVM; where LLVM is too old for Mitsuba, that back end ends the process without an error to catch."""
_GLOSSY = 0.1
"""Share of the surface that a blend gives to its glossy layer; both are scaled up by what they lose by it."""
_SKY = (16, 32)
_EXPECTED = "Mitsuba 3 (pip install 'drivesem[mitsuba]')"


class MitsubaRenderer:
    """`Redraw` by Mitsuba. Raises NoSecondRendererError where it is not installed or does not run."""

    name = NAME

    def __init__(self) -> None:
        self._library = _mitsuba()

    def draw(self, solid: Solid) -> torch.Tensor:
        """See `Redraw`."""
        library, lights = self._library, solid.lights
        size = solid.camera.width
        focal = float(solid.camera.matrix[0, 0])
        scene = library.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "direct", "hide_emitters": True},
                "lamp": {
                    "type": "point",
                    "position": lights.point.tolist(),
                    "intensity": {"type": "rgb", "value": math.pi * float(lights.strength) * lights.reach**2},
                },
                "sky": self._sky(float(lights.environment)),
                "object": self._mesh(solid),
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
                        "height": solid.camera.height,
                        "pixel_format": "rgba",
                        "component_format": "float32",
                        "rfilter": {"type": "box"},
                    },
                },
            }
        )
        drawn = torch.from_numpy(np.array(library.render(scene, spp=_RAYS), dtype=np.float32)).permute(2, 0, 1)
        coverage = drawn[3].clamp(0, 1)
        linear = drawn[:3] / coverage.clamp_min(1e-6)
        return torch.cat([linear.clamp(0, 1) ** GAMMA, coverage[None]])

    def _sky(self, strength: float) -> dict[str, Any]:
        """Radiance whose cosine-weighed mean over the half-space of a normal is 1 + UPWARD_SHARE up . normal."""
        height, width = _SKY
        polar = (np.arange(height) + 0.5) / height * math.pi  # 0 is up
        rows = strength * (1 + 1.5 * UPWARD_SHARE * np.cos(polar))
        pixels = np.broadcast_to(rows[:, None, None], (height, width, 3)).astype(np.float32)
        # The scene's y points down: the sky is turned upside down.
        turn = self._library.ScalarTransform4f(np.diag([1.0, -1.0, -1.0, 1.0]))
        bitmap = self._library.Bitmap(np.ascontiguousarray(pixels))
        return {"type": "envmap", "bitmap": bitmap, "to_world": turn}

    def _mesh(self, solid: Solid) -> Any:
        library = self._library
        # Of Beckmann's distribution this width has Phong's lobe, and this factor its height.
        width = np.sqrt(2 / (solid.shininess + 2))
        height = solid.specular * 8 / (solid.shininess + 2)
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
        count = len(solid.points)
        mesh = library.Mesh("object", count, count // 3, properties, has_vertex_normals=True)
        filled = library.traverse(mesh)
        filled["vertex_positions"] = _flat(solid.points)
        filled["vertex_normals"] = _flat(solid.normals)
        filled["faces"] = np.arange(count, dtype=np.uint32)
        filled.update()
        mesh.add_attribute("face_diffuse", 3, _flat(solid.diffuse / (1 - _GLOSSY)))
        mesh.add_attribute("face_width", 1, _flat(width))
        mesh.add_attribute("face_height", 1, _flat(height / _GLOSSY))
        return mesh


def _attribute(name: str) -> dict[str, Any]:
    return {"type": "mesh_attribute", "name": f"face_{name}"}


def _flat(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, np.float32).ravel()


@cache
def _mitsuba() -> Any:
    """The library, with as many threads as torch has now."""
    try:
        library = importlib.import_module("mitsuba")
        library.set_variant(_VARIANT)
        importlib.import_module("drjit").set_thread_count(torch.get_num_threads())
    except Exception as error:  # also what a library raises whose own libraries are missing
        raise NoSecondRendererError.from_exception(NAME, _EXPECTED, error) from error
    return library
