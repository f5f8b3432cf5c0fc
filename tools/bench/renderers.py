"""Other renderers on the same meshes: whole frames from vertices that are new in every call, as in an attack.

They draw less than the project's renderer does, which textures by the photograph, completes it, adds shadows and
blends: each names what it `shows`. All are optional; a missing one gives the reason.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from drivesem.bench.scenes import PackedMeshes
from scene_ir.raster import verbs
from scene_ir.types import Camera

FAR_M = 300.0
_MITSUBA_SAMPLES = 4
"""Rays a pixel: with one, outlines are as jagged as a plain z-buffer's."""
_PLATFORM = "egl"
"""Off-screen OpenGL that works without a display, with Mesa's software renderer where there is no GPU."""


class UnavailableError(Exception):
    """A renderer that is not installed or cannot run here; the message gives the reason on one line."""


@dataclass(frozen=True, slots=True)
class RenderTask:
    """What to draw."""

    placed: PackedMeshes
    camera: Camera
    colours: Tensor
    """Random ones, one a vertex, (V, 3)."""
    weight: Tensor
    """The gradient that comes in, (H, W, 3)."""

    @property
    def relative(self) -> np.ndarray:
        """Vertices (V, 3) m float32 about the centre of projection, x right, y down, z forward."""
        matrix = self.camera.matrix.double().cpu().numpy()
        centre = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
        return np.ascontiguousarray(self.placed.points.double().cpu().numpy() - centre, dtype=np.float32)

    @property
    def faces(self) -> np.ndarray:
        """(F, 3) uint32."""
        return np.ascontiguousarray(self.placed.faces.cpu().numpy(), dtype=np.uint32)


@dataclass(frozen=True, slots=True)
class RivalRenderer:
    """forward: draws once; backward: takes what forward gave back to the vertices, None where it cannot. hits: how
    many of the frame's pixels show a car.
    """

    shows: str
    forward: Callable[[], Any]
    backward: Callable[[Any], object] | None
    hits: Callable[[Any], int]


def own_verbs(task: RenderTask, backend: verbs.Backend = "warp") -> RivalRenderer:
    """The project's four verbs at the job that the others have."""
    placed, camera = task.placed, task.camera
    leaf = placed.clip.detach().clone().requires_grad_(True)
    parts = task.weight.new_zeros(0, 3)

    def forward() -> tuple[Tensor, Tensor]:
        layout = placed.layout(camera)
        found = verbs.rasterize(leaf, placed.faces, placed.face_ranges, layout, backend)
        colour = verbs.interpolate(found, leaf, placed.faces, task.colours, backend)
        coverage = verbs.antialias(found, leaf, placed.faces, backend)
        return colour * coverage[:, None], found.face

    def backward(drawn: tuple[Tensor, Tensor]) -> object:
        nonlocal parts
        if parts.shape != drawn[0].shape:
            parts = torch.ones_like(drawn[0])
        return torch.autograd.grad(drawn[0], leaf, parts)

    shows = "vertex colours, antialiased outlines, car by car"
    return RivalRenderer(shows, forward, backward, lambda drawn: int((drawn[1] >= 0).sum()))


def pyrender(task: RenderTask) -> RivalRenderer:
    """OpenGL through pyrender."""
    os.environ.setdefault("PYOPENGL_PLATFORM", _PLATFORM)
    library = _load(lambda: importlib.import_module("pyrender"))
    k = task.camera.intrinsics.tolist()
    view = library.IntrinsicsCamera(k[0][0], k[1][1], k[0][2] + 0.5, k[1][2] + 0.5, znear=verbs.NEAR_M, zfar=FAR_M)
    points, faces = task.relative * np.array([1, -1, -1], np.float32), task.faces
    colours = task.colours.cpu().numpy()
    try:
        screen = library.OffscreenRenderer(task.camera.width, task.camera.height)
    except Exception as error:  # a driver's errors have no common kind
        raise UnavailableError(_line(error)) from error

    def forward() -> tuple[np.ndarray, np.ndarray]:
        part = library.Primitive(positions=points, indices=faces, color_0=colours, mode=4)
        scene = library.Scene(ambient_light=(1.0, 1.0, 1.0))
        scene.add(library.Mesh([part]))
        scene.add(view)
        return screen.render(scene, flags=library.RenderFlags.FLAT | library.RenderFlags.SKIP_CULL_FACES)

    return RivalRenderer("vertex colours", forward, None, lambda drawn: int((drawn[1] > 0).sum()))


def open3d(task: RenderTask) -> RivalRenderer:
    """Ray casting by Open3D (Embree)."""
    library = _load(lambda: importlib.import_module("open3d"))
    points, faces = task.relative, task.faces
    k = task.camera.intrinsics.double().cpu().numpy() + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    eye = np.eye(4)

    def forward() -> np.ndarray:
        scene = library.t.geometry.RaycastingScene()
        scene.add_triangles(points, faces)
        rays = scene.create_rays_pinhole(k, eye, task.camera.width, task.camera.height)
        return scene.cast_rays(rays)["t_hit"].numpy()

    return RivalRenderer("depth", forward, None, lambda depth: int(np.isfinite(depth).sum()))


def pytorch3d(task: RenderTask) -> RivalRenderer:
    """PyTorch3D's rasteriser, one face a pixel, without blur."""
    structures = _load(lambda: importlib.import_module("pytorch3d.structures"))
    cameras = _load(lambda: importlib.import_module("pytorch3d.renderer.cameras"))
    rasterizer = _load(lambda: importlib.import_module("pytorch3d.renderer.mesh.rasterizer"))
    ops = _load(lambda: importlib.import_module("pytorch3d.ops.interp_face_attrs"))
    device, size = task.placed.points.device, (task.camera.height, task.camera.width)
    # PyTorch3D looks along +z with x to the left and y up.
    flip = torch.tensor([-1.0, -1.0, 1.0], device=device)
    leaf = (torch.from_numpy(task.relative).to(device) * flip).requires_grad_(True)
    k = task.camera.intrinsics
    view = cameras.PerspectiveCameras(
        focal_length=torch.stack([k[0, 0], k[1, 1]])[None], principal_point=k[:2, 2][None] + 0.5,
        in_ndc=False, image_size=torch.tensor([size]), device=device,
    )  # fmt: skip
    settings = rasterizer.RasterizationSettings(image_size=size, blur_radius=0.0, faces_per_pixel=1)
    draw = rasterizer.MeshRasterizer(cameras=view, raster_settings=settings)
    corners = task.colours[task.placed.faces]

    def forward() -> tuple[Tensor, Tensor]:
        found = draw(structures.Meshes([leaf], [task.placed.faces]))
        image = ops.interpolate_face_attributes(found.pix_to_face, found.bary_coords, corners)
        return image[0, :, :, 0], found.pix_to_face

    return RivalRenderer(
        "vertex colours, hard outlines",
        forward,
        lambda drawn: torch.autograd.grad(drawn[0], leaf, task.weight),
        lambda drawn: int((drawn[1] >= 0).sum()),
    )


def nvdiffrast(task: RenderTask) -> RivalRenderer:
    """nvdiffrast's rasterise, interpolate and antialias; needs CUDA."""
    library = _load(lambda: importlib.import_module("nvdiffrast.torch"))
    if task.placed.points.device.type != "cuda":
        raise UnavailableError("runs on CUDA only")
    context = library.RasterizeCudaContext()
    height, width = task.camera.height, task.camera.width
    leaf = task.placed.clip.detach().clone().requires_grad_(True)
    faces = task.placed.faces.to(torch.int32)

    def forward() -> tuple[Tensor, Tensor]:
        u, v, w = leaf.unbind(1)
        depth = (FAR_M + verbs.NEAR_M) / (FAR_M - verbs.NEAR_M) * w - 2 * FAR_M * verbs.NEAR_M / (
            FAR_M - verbs.NEAR_M
        )
        clip = torch.stack([2 * (u + 0.5 * w) / width - w, 2 * (v + 0.5 * w) / height - w, depth, w], dim=1)[None]
        found, _ = library.rasterize(context, clip, faces, resolution=[height, width])
        image, _ = library.interpolate(task.colours[None], found, faces)
        return library.antialias(image, found, clip, faces)[0], found[..., 3]

    return RivalRenderer(
        "vertex colours, antialiased outlines",
        forward,
        lambda drawn: torch.autograd.grad(drawn[0], leaf, task.weight),
        lambda drawn: int((drawn[1] > 0).sum()),
    )


def mitsuba(task: RenderTask) -> RivalRenderer:
    """Mitsuba 3's projective integrator: direct light of a constant sky, gradients through silhouettes."""
    library = _load(lambda: importlib.import_module("mitsuba"))
    jit = _load(lambda: importlib.import_module("drjit"))
    variant = "cuda_ad_rgb" if task.placed.points.device.type == "cuda" else "llvm_ad_rgb"
    try:
        library.set_variant(variant)
        mesh = library.Mesh("cars", len(task.relative), len(task.faces), has_vertex_texcoords=False)
        filled = library.traverse(mesh)
        filled["vertex_positions"] = library.Float(task.relative.ravel())
        filled["faces"] = library.UInt32(task.faces.ravel())
        filled.update()
    except Exception as error:  # a missing LLVM or driver shows as several kinds of error
        raise UnavailableError(_line(error)) from error
    camera, k = task.camera, task.camera.intrinsics.tolist()
    scene = library.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct_projective", "sppi": 0, "guiding": "none"},
            "light": {"type": "constant"},
            "cars": mesh,
            "sensor": {
                "type": "perspective",
                # Mitsuba looks along +z with x to the left and y up.
                "to_world": library.ScalarTransform4f(np.diag([-1.0, -1.0, 1.0, 1.0])),
                "fov_axis": "x",
                "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / k[0][0]))),
                "principal_point_offset_x": (k[0][2] + 0.5) / camera.width - 0.5,
                "principal_point_offset_y": (k[1][2] + 0.5) / camera.height - 0.5,
                "near_clip": verbs.NEAR_M,
                "far_clip": FAR_M,
                "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "rgb",
                         "rfilter": {"type": "box"}, "sample_border": True},
            },
        }
    )  # fmt: skip
    params = library.traverse(scene)
    key = "cars.vertex_positions"
    start = library.Float(params[key])
    weight = library.TensorXf(task.weight.cpu().numpy())

    def forward() -> Any:
        params[key] = library.Float(start)
        jit.enable_grad(params[key])
        params.update()
        image = library.render(scene, params, spp=_MITSUBA_SAMPLES, spp_grad=_MITSUBA_SAMPLES)
        jit.eval(image)
        jit.sync_thread()
        return image

    def backward(image: Any) -> Any:
        jit.backward(jit.sum(image * weight, axis=None))
        gradient = jit.grad(params[key])
        jit.eval(gradient)
        jit.sync_thread()
        return gradient

    shows = f"grey meshes under a white sky, {_MITSUBA_SAMPLES} rays a pixel"
    # The sky is 1, and a mesh reflects half of what it receives.
    return RivalRenderer(shows, forward, backward, lambda image: int((np.array(image)[..., 0] < 0.75).sum()))


RENDERERS: dict[str, Callable[[RenderTask], RivalRenderer]] = {
    "pyrender": pyrender,
    "open3d": open3d,
    "pytorch3d": pytorch3d,
    "nvdiffrast": nvdiffrast,
    "mitsuba": mitsuba,
}
"""By name."""


def _load(load: Callable[[], Any]) -> Any:
    """What an import gives. UnavailableError where it fails."""
    try:
        return load()
    except Exception as error:  # also a library's error about its own missing libraries
        raise UnavailableError(_line(error)) from error


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:160]
