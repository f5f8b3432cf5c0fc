"""Fidelity of edited objects: how far the picture of each can be trusted, from what is known without ground truth.

The score is exp(-error / ERROR_SCALE). The error, half of 1 - SSIM in the object's region, is a sum of evidence with
weights of at least 0. They were fitted to generated streets, which show the true picture of every edit:

    python -m tools.experiments fidelity --out FOLDER
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from scene_ir.render.compositor import Compositor
    from scene_ir.render.prepare import PreparedScene, VisibleSurfaces
    from scene_ir.types import Objects, SceneIR

BASE_ERROR = 0.003
"""Error of every edit."""
ERROR_WEIGHTS: Mapping[str, float] = {
    "completed": 0.064,
    "distorted": 0.029,
    "displaced": 0.7856,
    "repainted": 0.0271,
    "mismatched": 0.1265,
    "unsupported": 0.0862,
    "disturbed": 0.2036,
}
"""Error per unit of each piece of evidence."""
ERROR_SCALE = 0.1
"""Error at which the score is 1 / e."""
MIN_FIDELITY = 0.4
"""Score from which a picture is trusted: on the fitted half, 80 % of the pictures below it have an error above 0.1."""
MIN_OVERLAP = 0.1
"""Share of a failure's box from which an edited object is a part of its picture."""
_OPAQUE = 0.5
"""Opacity from which a pixel belongs to an object."""
_NOTHING, _OCCLUDER = -1, -2
"""Owners of a pixel that belongs to no object."""
_SAME_DEPTH_M, _NEAREST_M = 1e-3, 0.1
"""Difference in depth within one surface, and least depth of a projected point."""
_AROUND = 0.06
"""Surroundings of an object, as a share of its height."""
_LOWER_PART = 0.25
"""Lower part of an object, as a share of its height, that stands on the ground."""
_REASONS: Mapping[str, str] = {
    "completed": "{:.0%} of it is not in the photograph",
    "distorted": "it is turned, bent or scaled too far",
    "displaced": "it is moved too far for a position so uncertain",
    "repainted": "it is repainted too much",
    "mismatched": "its mesh and its outline differ by {:.0%}",
    "unsupported": "{:.0%} of its lower part is cut off in the photograph",
    "disturbed": "the picture around it changes too much",
}


@dataclass(frozen=True, slots=True)
class ObjectFidelity:
    """How far the picture of one edited object can be trusted, and the evidence; 0 of each is best."""

    index: int
    """Number of the object."""
    score: float
    """Fidelity, in [0, 1]."""
    completed: float
    """Share of its visible pixels with colours that are not from the photograph."""
    distorted: float
    """Turn, rad, plus the absolute logarithm of its growth in the picture, plus the largest lattice offset."""
    displaced: float
    """Movement in the picture, in its own heights, times the relative uncertainty of its depth."""
    repainted: float
    """Largest paint code, in [0, 1]."""
    mismatched: float
    """1 - IoU of its mesh and its opaque pixels in the photograph, where nothing hides it."""
    unsupported: float
    """Share of its mesh's lower part that the photograph does not show: cut off by the own car, or afloat."""
    disturbed: float
    """Mean change of the colours around it, in [0, 1]: the estimated background where it stood, and its border."""

    @classmethod
    def from_evidence(cls, index: int, **evidence: float) -> ObjectFidelity:
        """Compute the score from the evidence."""
        error = BASE_ERROR + sum(weight * evidence[name] for name, weight in ERROR_WEIGHTS.items())
        rounded = {name: round(value, 4) for name, value in evidence.items()}
        return cls(index, round(math.exp(-error / ERROR_SCALE), 4), **rounded)

    @property
    def is_trusted(self) -> bool:
        """Whether the picture is trusted."""
        return self.score >= MIN_FIDELITY

    @property
    def reason(self) -> str:
        """The strongest evidence against the picture: `62% of it is not in the photograph`."""
        name = max(ERROR_WEIGHTS, key=lambda name: ERROR_WEIGHTS[name] * getattr(self, name))
        return _REASONS[name].format(getattr(self, name))

    def describe(self) -> str:
        """Describe the fidelity: `picture not trusted: fidelity of object 3 is 0.21, it is bent too far`."""
        if self.is_trusted:
            return f"picture trusted: fidelity {self.score:.2f}"
        return f"picture not trusted: fidelity {self.score:.2f} of object {self.index}; {self.reason}"


@dataclass(frozen=True, slots=True)
class EditedRegion:
    """An edited object's fidelity, and its place in the picture."""

    fidelity: ObjectFidelity
    """The fidelity."""
    boxes_xyxy: tuple[tuple[float, float, float, float], ...]
    """Boxes around the object before and after the edit, px."""

    def overlap(self, box_xyxy: Sequence[float]) -> float:
        """Largest share of a box that the object's own boxes cover."""
        x0, y0, x1, y1 = box_xyxy
        area = max((x1 - x0) * (y1 - y0), 1e-6)
        return max(
            max(min(x1, right) - max(x0, left), 0.0) * max(min(y1, bottom) - max(y0, top), 0.0) / area
            for left, top, right, bottom in self.boxes_xyxy
        )


def lowest_fidelity(regions: Sequence[EditedRegion], box_xyxy: Sequence[float]) -> ObjectFidelity | None:
    """The lowest fidelity of the edited objects in a failure's box; None where no edited object is there."""
    inside = [region.fidelity for region in regions if region.overlap(box_xyxy) >= MIN_OVERLAP]
    return min(inside, key=lambda fidelity: fidelity.score, default=None)


def find_edited(objects: Objects) -> list[int]:
    """Rows of the vehicles with another position, shape or paint than in their photograph."""
    from scene_ir.render.prepare import at_photographed_pose

    if not objects.source:
        return []
    base = at_photographed_pose(objects)
    edited = objects.texture_code.abs().amax(dim=1) > 0
    for name in ("translation", "yaw", "size_lhw", "ffd"):
        change = (getattr(objects, name) - getattr(base, name)).abs().reshape(len(objects), -1)
        edited = edited | (change.amax(dim=1) > 1e-5)
    return edited.nonzero()[:, 0].tolist()


def measure_fidelity(prepared: Compositor, changed: SceneIR) -> tuple[EditedRegion, ...]:
    """Measure the fidelity of each edited object of a scene.

    Args:
        prepared: The photographed scene.
        changed: The scene after the edit.
    """
    import torch

    from scene_ir.render.prepare import at_photographed_pose

    objects = prepared.perturbed_objects(changed)
    rows = find_edited(objects)
    if not rows:
        return ()
    with torch.no_grad():
        photographed = at_photographed_pose(objects)
        rest, now = prepared.find_visible(photographed), prepared.find_visible(objects)
        pixels = _count_photographed_pixels(prepared, rest) | {"completed": _measure_completed(prepared, now)}
        disturbed = _measure_disturbance(prepared, changed, rest, now, rows)
        before, after = (_bounds_xyxy(prepared, found, rows) for found in (rest, now))
    regions = []
    for row, old, new in zip(rows, before, after, strict=True):
        height_px, new_height_px = max(old[3] - old[1], 1.0), max(new[3] - new[1], 1.0)
        shift_px = math.hypot(*((new[k] + new[k + 2] - old[k] - old[k + 2]) / 2 for k in (0, 1)))
        turn_rad = abs(float(objects.yaw[row] - photographed.yaw[row]))
        bend = float((objects.ffd[row] - photographed.ffd[row]).abs().max())
        fidelity = ObjectFidelity.from_evidence(
            row,
            **{name: float(share[row]) for name, share in pixels.items()},
            distorted=turn_rad + abs(math.log(new_height_px / height_px)) + bend,
            displaced=shift_px / height_px * _depth_uncertainty(prepared.scene, row),
            disturbed=disturbed[row],
            repainted=float(objects.texture_code[row].abs().max()),
        )
        regions.append(EditedRegion(fidelity, (old, new)))
    return tuple(regions)


def find_untrusted(prepared: PreparedScene) -> list[int]:
    """Find the vehicles of a photographed scene that no edit would leave with a trusted picture."""
    import torch

    from scene_ir.render.prepare import at_photographed_pose

    objects = prepared.scene.objects
    if not objects.source:
        return []
    with torch.no_grad():
        pixels = _count_photographed_pixels(prepared, prepared.find_visible(at_photographed_pose(objects)))
    evidence = dict.fromkeys(ERROR_WEIGHTS, 0.0)
    found = []
    for row in range(len(objects)):
        at_rest = {name: float(share[row]) for name, share in pixels.items()}
        if not ObjectFidelity.from_evidence(row, **evidence | at_rest).is_trusted:
            found.append(row)
    return found


def _depth_uncertainty(scene: SceneIR, row: int) -> float:
    """Standard deviation of the logarithm of an object's depth; 0 for labelled positions."""
    label = scene.provenance.get(f"objects[{row}].label", "")
    return float(scene.provenance.get(f"labels[{label}].depth_sigma", 0))


@dataclass(frozen=True, slots=True)
class _MeshPixels:
    """Packed pixels of a scene's meshes."""

    hit: Tensor
    """(T,) bool, whether the mesh is there."""
    owner: Tensor
    """(T,) int64, its object."""
    pixel: Tensor
    """(T,) int64, pixel of the frame."""
    y: Tensor
    """(T,) int64, its row."""

    @classmethod
    def from_surfaces(cls, surfaces: VisibleSurfaces, width: int) -> _MeshPixels:
        """Locate the packed pixels of surfaces in a frame of `width` px."""
        x, y = surfaces.mesh.layout.pixel_xy().unbind(1)
        return cls(surfaces.mesh.face >= 0, surfaces.mesh.layout.draw_index(), y * width + x, y)


def _count_photographed_pixels(prepared: PreparedScene, rest: VisibleSurfaces) -> dict[str, Tensor]:
    """Evidence (N,) that does not depend on the edit, by its name. rest: surfaces as photographed."""
    count, (height, width) = len(prepared.scene.objects), prepared.frame_hw
    owner_map = _map_owners(prepared.scene).flatten().to(rest.coverage.device)
    mesh = _MeshPixels.from_surfaces(rest, width)
    is_own = owner_map[mesh.pixel] == mesh.owner
    is_free = mesh.hit & (is_own | (owner_map[mesh.pixel] == _NOTHING))
    opaque = _sum_by_owner(owner_map[owner_map >= 0], None, count)
    both = _sum_by_owner(mesh.owner, mesh.hit & is_own, count)
    union = _sum_by_owner(mesh.owner, is_free, count) + opaque - both
    top = mesh.y.new_full((count,), height).scatter_reduce(0, mesh.owner[mesh.hit], mesh.y[mesh.hit], "amin")
    bottom = mesh.y.new_zeros(count).scatter_reduce(0, mesh.owner[mesh.hit], mesh.y[mesh.hit], "amax")
    lower = is_free & (mesh.y >= (bottom - _LOWER_PART * (bottom - top + 1))[mesh.owner])
    lower_px = _sum_by_owner(mesh.owner, lower, count).clamp(min=1.0)
    # The surface of a person is wider than the outline by design.
    fitted = (~prepared.scene.objects.upright).to(both)
    return {
        "mismatched": fitted * (1.0 - both / union.clamp(min=1.0)),
        "unsupported": fitted * _sum_by_owner(mesh.owner, lower & ~is_own, count) / lower_px,
    }


def _measure_completed(prepared: PreparedScene, now: VisibleSurfaces) -> Tensor:
    """(N,) share of objects' visible pixels that is completed. now: surfaces after the edit."""
    import torch

    from scene_ir.render.reference import measure_completion

    count, (height, width) = len(prepared.scene.objects), prepared.frame_hw
    drawn, completed = measure_completion(prepared, now)
    mesh = _MeshPixels.from_surfaces(now, width)
    depth = now.mesh.depth.masked_fill(~mesh.hit, torch.inf)
    nearest = depth.new_full((height * width,), torch.inf).scatter_reduce(0, mesh.pixel, depth, "amin")
    visible = mesh.hit & (depth <= nearest[mesh.pixel] + _SAME_DEPTH_M)
    drawn_px = _sum_by_owner(mesh.owner, drawn * visible, count).clamp(min=1.0)
    return _sum_by_owner(mesh.owner, completed * visible, count) / drawn_px


def _measure_disturbance(
    compositor: Compositor, changed: SceneIR, rest: VisibleSurfaces, now: VisibleSurfaces, rows: Sequence[int]
) -> dict[int, float]:
    """Mean change of the colours around edited objects, in the photographed weather, by object.

    Args:
        compositor: The photographed scene.
        changed: The scene after the edit.
        rest: Its surfaces before it.
        now: Its surfaces after it.
        rows: The edited objects.
    """
    import cv2
    import numpy as np

    scene, (height, width) = compositor.scene, compositor.frame_hw
    environment = scene.environment
    codes = {name: getattr(environment, name) for name in ("weather", "foliage", "light")}
    picture = compositor.render(changed.with_environment(**codes)).image
    change = (picture - scene.photograph).abs().mean(dim=0).cpu().numpy()
    before, after = (_MeshPixels.from_surfaces(surfaces, width) for surfaces in (rest, now))
    found = {}
    for row in rows:
        own = np.zeros(height * width, np.uint8)
        own[after.pixel[after.hit & (after.owner == row)].cpu().numpy()] = 1
        both = own.copy()
        both[before.pixel[before.hit & (before.owner == row)].cpu().numpy()] = 1
        y, x = np.divmod(np.flatnonzero(both), width)
        if not len(y):
            found[row] = 0.0
            continue
        reach = max(2, round(_AROUND * int(y.max() - y.min() + 1)))
        window = tuple(slice(max(int(v.min()) - reach, 0), int(v.max()) + reach + 1) for v in (y, x))
        near = cv2.dilate(both.reshape(height, width)[window], np.ones((2 * reach + 1,) * 2, np.uint8))
        around = (near > 0) & (own.reshape(height, width)[window] == 0)
        found[row] = float(change[window][around].mean()) if around.any() else 0.0
    return found


def _sum_by_owner(owner: Tensor, values: Tensor | None, count: int) -> Tensor:
    """Sums (count,) of values (K,), by default 1, over the pixels of each owner (K,)."""
    import torch

    return torch.bincount(owner, None if values is None else values.double(), minlength=count).double()


def _map_owners(scene: SceneIR) -> Tensor:
    """(H, W) int64, the object that is opaque at each pixel of the photograph, or `_OCCLUDER` or `_NOTHING`."""
    import torch

    owner_map = torch.full((scene.camera.height, scene.camera.width), _NOTHING, dtype=torch.int64)
    crops = [(row, source.foreground) for row, source in enumerate(scene.objects.source)]
    crops += [(_OCCLUDER, occluder.foreground) for occluder in scene.occluders]
    for owner, crop in crops:
        h, w = crop.values.shape[1:]
        window = owner_map[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w]
        window[crop.values[3].cpu() > _OPAQUE] = owner
    return owner_map


def _bounds_xyxy(
    prepared: PreparedScene, surfaces: VisibleSurfaces, rows: Sequence[int]
) -> list[tuple[float, float, float, float]]:
    """Boxes around the meshes of objects, px; they may leave the picture."""
    found = []
    for row in rows:
        clip = surfaces.geometry.clip[prepared.surfaces.owner == row]
        xy = clip[:, :2] / clip[:, 2:].clamp(min=_NEAREST_M)
        (x0, y0), (x1, y1) = xy.amin(dim=0).tolist(), xy.amax(dim=0).tolist()
        found.append((x0, y0, x1, y1))
    return found
