"""The ground truth of a perturbed scene: moving a car moves its label.

Two modes. `paper`: the benign labels, whatever moved. `moved`: the benign box plus the change of the projected,
deformed mesh, and likewise for truncation and occlusion, so that at theta = 0 it *is* the benign label (KITTI's
hand-drawn boxes meet projected ones at a mean IoU of 0.975 only).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from detectors.types import CLASSES, Targets
from scene_ir import ffd
from scene_ir.errors import RangeError, ShapeError
from scene_ir.geometry import clip_boxes, place, to_clip, yaw_matrix
from scene_ir.types import Category, Labels, Mesh, Render, SceneIR

LabelMode = Literal["paper", "moved"]
LABEL_MODES: tuple[LabelMode, ...] = ("paper", "moved")

_NEAR_M = 0.1
"""Meshes are cut at this distance from the camera plane before they are projected."""
_OCCLUSION_BOUNDS = (0.0, 0.1, 0.5, 1.0)
"""Hidden share of a car at which KITTI's levels 0 (fully visible), 1 (partly), 2 (largely) begin; KITTI names no
numbers, these are ours. Level 3 (unknown) never changes."""
_OPAQUE = 0.5
"""Opacity from which a pixel belongs to an object, as in `Render.object_id`."""


@dataclass(frozen=True, slots=True)
class Difficulty:
    """Which objects are judged; the others are ignored, neither missed nor hit. Defaults: KITTI's "moderate"."""

    min_height_px: float = 25.0
    max_occlusion: int = 1
    max_truncation: float = 0.3


@dataclass(frozen=True, slots=True)
class MovedLabels:
    """Labels of one scene in one mode, object by object (the i-th row is object i).

    boxes_xyxy (N, 4) px; category (N,) int64; truncation (N,) in [0, 1]; occlusion (N,) int64, 0 to 3;
    ignore (N,) bool: too hard in the benign scene, or now. became_ignored (N,) bool: only now.
    became_counted (N,) bool: too hard in the benign scene, no longer now (still ignored, so that benign and
    attacked figures are over the same objects). regions_xyxy (K, 4) px: no detection is judged there.
    """

    mode: LabelMode
    boxes_xyxy: Tensor
    category: Tensor
    truncation: Tensor
    occlusion: Tensor
    ignore: Tensor
    became_ignored: Tensor
    became_counted: Tensor
    regions_xyxy: Tensor

    @property
    def targets(self) -> Targets:
        """For detectors and evaluation: the objects in order, then every region once for each class, ignored."""
        classes, regions = len(CLASSES), len(self.regions_xyxy)
        boxes = torch.cat(
            [self.boxes_xyxy, self.regions_xyxy.repeat_interleave(classes, dim=0).to(self.boxes_xyxy)]
        )
        labels = torch.cat([self.category, torch.arange(classes).repeat(regions).to(self.category)])
        ignore = torch.cat([self.ignore, self.ignore.new_ones(classes * regions)])
        return Targets(boxes_xyxy=boxes, labels=labels, ignore=ignore)


class Labeller:
    """Labels scenes that differ from `base` by theta only. Carries no gradient: what a loss aims at is constant.

    base_render: the benign re-render; without it occlusion is taken as unchanged.
    """

    def __init__(
        self, base: SceneIR, base_render: Render | None = None, difficulty: Difficulty | None = None
    ) -> None:
        self.base = base
        self.difficulty = difficulty or Difficulty()
        self._weights = {
            index: ffd.lattice_weights(base.meshes[index].vertices.detach().double())
            for index in sorted(set(base.objects.mesh_index.tolist()))
        }
        self._boxes = self._project(base)
        self._hidden = None if base_render is None else hidden_share(base_render)

    def paper(self) -> MovedLabels:
        """The benign labels."""
        objects = self.base.objects
        ignore = self._too_hard(objects.box2d, objects.truncation, objects.occlusion)
        never = torch.zeros_like(ignore)
        return MovedLabels(
            mode="paper",
            boxes_xyxy=objects.box2d.detach(),
            category=objects.category,
            truncation=objects.truncation.detach(),
            occlusion=objects.occlusion,
            ignore=ignore,
            became_ignored=never,
            became_counted=never,
            regions_xyxy=self.base.ignore.detach(),
        )

    def moved(self, perturbed: SceneIR, render: Render | None = None) -> MovedLabels:
        """Labels that went along with the cars. Raises ShapeError where `perturbed` has other objects."""
        benign = self.paper()
        if len(perturbed.objects) != len(self.base.objects):
            raise ShapeError("perturbed.objects", f"{len(self.base.objects)} objects", len(perturbed.objects))
        camera = self.base.camera
        whole0, whole = self._boxes, self._project(perturbed)
        inside0, inside = (clip_boxes(b, camera.height, camera.width) for b in (whole0, whole))
        boxes = self._moved_boxes(benign.boxes_xyxy, inside - inside0)
        change = (_outside(whole, inside) - _outside(whole0, inside0)).to(benign.truncation)
        truncation = torch.where(change == 0, benign.truncation, (benign.truncation + change).clamp(0, 1))
        occlusion, gone = benign.occlusion, torch.zeros_like(benign.ignore)
        if self._hidden is not None and render is not None:
            hidden = hidden_share(render)
            occlusion = _new_occlusion(benign.occlusion, self._hidden, hidden)
            gone = (hidden >= 1) & (self._hidden < 1)
        hard = self._too_hard(boxes, truncation, occlusion) | gone
        return MovedLabels(
            mode="moved",
            boxes_xyxy=boxes,
            category=benign.category,
            truncation=truncation,
            occlusion=occlusion,
            ignore=benign.ignore | hard,
            became_ignored=hard & ~benign.ignore,
            became_counted=benign.ignore & ~hard,
            regions_xyxy=benign.regions_xyxy,
        )

    def labels(self, mode: LabelMode, perturbed: SceneIR, render: Render | None = None) -> MovedLabels:
        """`paper` or `moved` labels. Raises RangeError on another mode."""
        if mode not in LABEL_MODES:
            raise RangeError("label mode", f"one of {', '.join(LABEL_MODES)}", repr(mode))
        return self.paper() if mode == "paper" else self.moved(perturbed, render)

    def _moved_boxes(self, benign_xyxy: Tensor, change: Tensor) -> Tensor:
        """benign + change, kept in the image (or where the benign box lies, if that is outside of it)."""
        moved = benign_xyxy + change.to(benign_xyxy)
        camera = self.base.camera
        limit = moved.new_tensor([camera.width - 1, camera.height - 1] * 2)
        return torch.clamp(moved, min=benign_xyxy.clamp(max=0), max=torch.maximum(limit, benign_xyxy))

    def _too_hard(self, boxes_xyxy: Tensor, truncation: Tensor, occlusion: Tensor) -> Tensor:
        """(N,) bool: what the difficulty leaves out, and boxes without an area."""
        size = boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]
        return (
            (size[:, 1] < self.difficulty.min_height_px)
            | (size <= 0).any(dim=1)
            | (occlusion > self.difficulty.max_occlusion)
            | (truncation > self.difficulty.max_truncation)
        )

    @torch.no_grad()
    def _project(self, scene: SceneIR) -> Tensor:
        """Tight boxes (N, 4) float64 px of the deformed meshes, cut at the near plane, not at the image border."""
        objects, matrix = scene.objects, scene.camera.matrix.double()
        boxes = matrix.new_zeros(len(objects), 4)
        for i, index in enumerate(objects.mesh_index.tolist()):
            mesh = scene.meshes[index]
            unit = ffd.deform(mesh.vertices.double(), self._weights[index], objects.ffd[i].double())
            size, yaw, translation = (t[i].double() for t in (objects.size_lhw, objects.yaw, objects.translation))
            boxes[i] = _image_box(to_clip(place(unit, size, yaw, translation), matrix), mesh)
        return boxes


def targets(
    base_scene: SceneIR,
    perturbed_scene: SceneIR,
    mode: LabelMode = "moved",
    base_render: Render | None = None,
    render: Render | None = None,
    difficulty: Difficulty | None = None,
) -> MovedLabels:
    """Labels of a perturbed scene, for a single call; keep a `Labeller` where one scene is labelled more often.

    Not differentiable. Without the two renders occlusion is taken as unchanged.
    """
    return Labeller(base_scene, base_render, difficulty).labels(mode, perturbed_scene, render)


def hidden_share(render: Render) -> Tensor:
    """Share (N,) float64 of each object's own pixels that are not its own in the image; 1 where it has none."""
    count = len(render.opacity)
    seen = torch.bincount(render.object_id.reshape(-1), minlength=count + 1)[1:].double()
    own = torch.stack(
        [(crop.values.detach() >= _OPAQUE).sum() for crop in render.opacity]
        or [torch.zeros((), dtype=torch.int64, device=seen.device)]
    )[:count].double()
    return torch.where(own > 0, 1 - seen / own.clamp(min=1), torch.ones_like(own)).clamp(0, 1)


def to_kitti_labels(
    labels: MovedLabels, base: SceneIR, perturbed: SceneIR, kinds: Sequence[str] | None = None
) -> Labels:
    """Labels of one mode as a KITTI file holds them: `paper` with the base's 3D boxes, `moved` with the new ones.

    A moved 3D box follows the pose and the change of the deformed mesh's extents; where nothing changed it is the
    base's to the bit. kinds: the types as labelled (a Van counts as a Car); else those of the categories.
    """
    names = tuple(kinds) if kinds is not None else tuple(_kind(c) for c in labels.category.tolist())
    translation, yaw, size_lhw = base.objects.translation, base.objects.yaw, base.objects.size_lhw
    if labels.mode == "moved":
        low0, high0 = _unit_extents(base)
        low, high = _unit_extents(perturbed)
        yaw = perturbed.objects.yaw
        # The lowest layer is fixed: only length and width can shift the middle of the bottom face.
        shift = (0.5 * ((low + high) - (low0 + high0)) * size_lhw) * size_lhw.new_tensor([1.0, 0.0, 1.0])
        translation = perturbed.objects.translation + (yaw_matrix(yaw) @ shift[:, :, None])[:, :, 0]
        size_lhw = size_lhw * ((high - low) / (high0 - low0))
        turns = torch.round(yaw / (2 * torch.pi))
        yaw = torch.where(yaw.abs() > torch.pi, yaw - turns * 2 * torch.pi, yaw)
    return Labels(
        kind=names,
        boxes_xyxy=labels.boxes_xyxy,
        truncation=labels.truncation,
        occlusion=labels.occlusion,
        translation=translation.detach(),
        yaw=yaw.detach(),
        size_lhw=size_lhw.detach(),
        ignore_xyxy=labels.regions_xyxy,
    )


def _kind(category: int) -> str:
    return Category(category).name.capitalize()


def _unit_extents(scene: SceneIR) -> tuple[Tensor, Tensor]:
    """Bounds (N, 3), (N, 3) of the deformed meshes, in unit boxes."""
    objects = scene.objects
    low, high = torch.empty_like(objects.size_lhw), torch.empty_like(objects.size_lhw)
    for i, index in enumerate(objects.mesh_index.tolist()):
        unit = scene.meshes[index].vertices.to(objects.ffd)
        deformed = ffd.deform(unit, ffd.lattice_weights(unit), objects.ffd[i]).detach()
        low[i], high[i] = deformed.amin(dim=0), deformed.amax(dim=0)
    return low, high


def _image_box(clip: Tensor, mesh: Mesh) -> Tensor:
    """Tight box (4,) px of clip-space vertices (V, 3); a mesh wholly behind the near plane gives zeros."""
    front = clip[:, 2] >= _NEAR_M
    points = clip[front]
    if not bool(front.all()):
        edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        edges = edges[front[edges[:, 0]] != front[edges[:, 1]]]
        start, end = clip[edges[:, 0]], clip[edges[:, 1]]
        share = (_NEAR_M - start[:, 2:]) / (end[:, 2:] - start[:, 2:])
        points = torch.cat([points, start + share * (end - start)])
    if not len(points):
        return clip.new_zeros(4)
    pixels = points[:, :2] / points[:, 2:]
    return torch.cat([pixels.amin(dim=0), pixels.amax(dim=0)])


def _outside(whole_xyxy: Tensor, inside_xyxy: Tensor) -> Tensor:
    """Share (N,) of each box that the image's border cuts off."""

    def area(boxes: Tensor) -> Tensor:
        return (boxes[:, 2:] - boxes[:, :2]).clamp(min=0).prod(dim=1)

    return 1 - area(inside_xyxy) / area(whole_xyxy).clamp(min=1e-9)


def _new_occlusion(level: Tensor, hidden0: Tensor, hidden: Tensor) -> Tensor:
    """KITTI levels (N,) after the hidden share went from hidden0 to hidden, both (N,).

    The labelled level counts what the render cannot know (trees, poles): the share starts inside the labelled
    level's range and moves by the difference. Unchanged shares keep their level.
    """
    bounds = hidden0.new_tensor(_OCCLUSION_BOUNDS)
    known = level.clamp(max=2)
    start = torch.minimum(torch.maximum(hidden0, bounds[known]), bounds[known + 1])
    after = start + (hidden - hidden0)
    new = (after[:, None] >= bounds[1:3]).sum(dim=1)
    return torch.where((hidden == hidden0) | (level > 2), level, new.to(level))
