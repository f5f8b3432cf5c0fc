"""Ground truth of a perturbed scene, in two label modes.

`paper`: the benign labels, wherever objects move. `moved`: the benign box plus the change of the projected, deformed
mesh, and likewise for truncation and occlusion, so that at theta = 0 it equals the benign label (KITTI's hand-drawn
boxes match projected ones only at a mean IoU of 0.975).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.types import CLASSES, Targets
from drivesem.attacks.visibility import MIN_CONTRAST, compute_contrasts
from scene_ir import ffd
from scene_ir.errors import RangeError, ShapeError
from scene_ir.geometry import yaw_matrix
from scene_ir.types import LATTICE, Category, Labels, Mesh, Render, SceneIR, to_host

Array = NDArray[np.float64]
Levels = NDArray[np.int64]
Values = NDArray[np.floating[Any]]
"""Arrays in the labels' dtype, float32 or float64."""
LabelMode = Literal["paper", "moved"]
LABEL_MODES: tuple[LabelMode, ...] = ("paper", "moved")

_NEAR_M = 0.1
"""Meshes are cut at this distance from the camera plane before they are projected."""
_OCCLUSION_BOUNDS = np.array([0.0, 0.1, 0.5, 1.0])
"""Hidden shares at which KITTI's levels 0 (fully visible), 1 (partly), 2 (largely) begin. The numbers are a choice:
KITTI gives none. Level 3 (unknown) never changes."""
_VISIBLE_BEFORE, _VISIBLE_NOW = 0.25, 0.1
"""An object with at least the first visible share in the benign scene must keep the second. A lower first share would
let a few pixels of a nearly hidden car block all others."""
_OPAQUE = 0.5
"""Opacity from which a pixel belongs to an object, as in `Render.object_id`."""


@dataclass(frozen=True, slots=True)
class Difficulty:
    """Which objects are evaluated; the others are ignored, neither missed nor hit. Defaults: KITTI's "moderate", and
    what a person can see.
    """

    min_height_px: float = 25.0
    """Minimum height of a box."""
    max_occlusion: int = 1
    """Maximum occlusion level of KITTI, 0 to 3."""
    max_truncation: float = 0.3
    """Maximum share outside of the picture."""
    min_contrast: float = MIN_CONTRAST
    """Minimum contrast in renders (`compute_contrasts`); 0: no condition."""


@dataclass(frozen=True, slots=True)
class SceneLabels:
    """Labels of one scene in one mode; row i belongs to object i."""

    mode: LabelMode
    """The mode."""
    boxes_xyxy: Tensor
    """(N, 4) px."""
    category: Tensor
    """(N,) int64."""
    truncation: Tensor
    """(N,), share outside of the picture, in [0, 1]."""
    occlusion: Tensor
    """(N,) int64, KITTI's level, 0 to 3."""
    ignore: Tensor
    """(N,) bool, too hard in the benign scene or now."""
    became_ignored: Tensor
    """(N,) bool, too hard only now."""
    became_counted: Tensor
    """(N,) bool, too hard only in the benign scene; still ignored, so that both scenes have the same objects."""
    out_of_sight: Tensor
    """(N,) bool, visible in the benign scene, behind others now."""
    regions_xyxy: Tensor
    """(K, 4) px, regions in which no detection is evaluated."""
    in_view: Tensor
    """(N,) bool, in front of the camera; objects that are not in the scene are behind it."""

    @property
    def targets(self) -> Targets:
        """Targets of detectors and evaluation: the objects, then each region once for each class, ignored."""
        classes, regions = len(CLASSES), len(self.regions_xyxy)
        boxes = torch.cat(
            [self.boxes_xyxy, self.regions_xyxy.repeat_interleave(classes, dim=0).to(self.boxes_xyxy)]
        )
        labels = torch.cat([self.category, torch.arange(classes).repeat(regions).to(self.category)])
        ignore = torch.cat([self.ignore, self.ignore.new_ones(classes * regions)])
        return Targets(boxes_xyxy=boxes, labels=labels, ignore=ignore)


class Labeller:
    """Labels scenes that differ from `base` by theta only; without gradient.

    Without `base_render`, the benign re-render, occlusion counts as unchanged and all objects as visible.
    """

    def __init__(
        self, base: SceneIR, base_render: Render | None = None, difficulty: Difficulty | None = None
    ) -> None:
        self.base = base
        self.difficulty = difficulty or Difficulty()
        self._projected_meshes: dict[int, tuple[Mesh, _ProjectedMesh]] = {}
        objects, camera = base.objects, base.camera
        self._matrix, self._mesh_index = camera.matrix.cpu().double().numpy(), objects.mesh_index.tolist()
        self._limit = np.array([camera.width - 1.0, camera.height - 1.0] * 2)
        self._boxes = self._project(base)
        self._absent = ~_any_area(self._boxes)
        """(N,) bool, objects that a change adds, which are not in the benign picture."""
        self._inside = self._clipped(self._boxes)
        self._outside = _outside(self._boxes, self._inside)
        self._hidden = None if base_render is None else hidden_shares(base_render)
        self._box2d = objects.box2d.detach().cpu().numpy()
        self._truncation = objects.truncation.detach().cpu().numpy()
        self._occlusion = objects.occlusion.cpu().numpy()
        self._ignore = self._too_hard(self._box2d, self._truncation, self._occlusion) | self._faint(base_render)
        # Moved boxes stay in the image, or where the benign box lies if that is outside of it.
        self._lowest = np.minimum(self._box2d, 0)
        self._highest = np.maximum(self._limit.astype(self._box2d.dtype), self._box2d)
        ignore = torch.from_numpy(self._ignore)
        self._paper = SceneLabels(
            mode="paper",
            boxes_xyxy=torch.from_numpy(self._box2d),
            category=objects.category.cpu(),
            truncation=torch.from_numpy(self._truncation),
            occlusion=torch.from_numpy(self._occlusion),
            ignore=ignore,
            became_ignored=torch.zeros_like(ignore),
            became_counted=torch.zeros_like(ignore),
            out_of_sight=torch.zeros_like(ignore),
            regions_xyxy=base.ignore.detach().cpu(),
            in_view=torch.from_numpy(_any_area(self._boxes)),
        )

    def paper(self) -> SceneLabels:
        """The benign labels."""
        return self._paper

    def moved(self, perturbed: SceneIR, render: Render | None = None) -> SceneLabels:
        """Labels that follow the objects. Raises ShapeError where `perturbed` has other objects."""
        if len(perturbed.objects) != len(self.base.objects):
            raise ShapeError("perturbed.objects", f"{len(self.base.objects)} objects", len(perturbed.objects))
        category = perturbed.objects.category
        render = None if render is None else _render_on_host(render)
        whole = self._project(perturbed)
        in_view = _any_area(whole)
        inside = self._clipped(whole)
        boxes = self._box2d + (inside - self._inside).astype(self._box2d.dtype)
        boxes = np.minimum(np.maximum(boxes, self._lowest), self._highest)
        change = (_outside(whole, inside) - np.where(self._absent, 0.0, self._outside)).astype(
            self._truncation.dtype
        )
        truncation = np.minimum(np.maximum(self._truncation + change, 0), 1)
        truncation = np.where(change == 0, self._truncation, truncation)
        occlusion, gone = self._occlusion, np.zeros_like(self._ignore)
        out_of_sight = gone
        if self._hidden is not None and render is not None:
            hidden = hidden_shares(render)
            occlusion = _new_occlusion(self._occlusion, np.where(self._absent, 0.0, self._hidden), hidden)
            gone = (hidden >= 1) & (self._hidden < 1)
            out_of_sight = (self._hidden <= 1 - _VISIBLE_BEFORE) & (hidden > 1 - _VISIBLE_NOW) & in_view
        hard = self._too_hard(boxes, truncation, occlusion) | gone | self._faint(render) | ~in_view
        return SceneLabels(
            mode="moved",
            boxes_xyxy=torch.from_numpy(boxes),
            category=self._paper.category if category is self.base.objects.category else category.cpu(),
            truncation=torch.from_numpy(truncation),
            occlusion=torch.from_numpy(occlusion),
            ignore=torch.from_numpy(self._ignore | hard),
            became_ignored=torch.from_numpy(hard & ~self._ignore),
            became_counted=torch.from_numpy(self._ignore & ~hard),
            out_of_sight=torch.from_numpy(out_of_sight),
            regions_xyxy=self._paper.regions_xyxy,
            in_view=torch.from_numpy(in_view),
        )

    def labels(self, mode: LabelMode, perturbed: SceneIR, render: Render | None = None) -> SceneLabels:
        """Labels of a perturbed scene.

        Args:
            mode: `paper` or `moved`.
            perturbed: the scene.
            render: its render; see `Labeller`.

        Raises:
            RangeError: another mode.
        """
        if mode not in LABEL_MODES:
            raise RangeError("label mode", f"one of {', '.join(LABEL_MODES)}", repr(mode))
        return self.paper() if mode == "paper" else self.moved(perturbed, render)

    def _clipped(self, boxes_xyxy: Array) -> Array:
        # Like `geometry.clip_boxes`, in numpy: `np.clip` takes ten times as long on so few numbers.
        return np.minimum(np.maximum(boxes_xyxy, 0), self._limit)

    def _too_hard(self, boxes_xyxy: Values, truncation: Values, occlusion: Levels) -> NDArray[np.bool_]:
        """(N,) bool: objects outside of the difficulty, and boxes without an area."""
        size = boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]
        return (
            (size[:, 1] < self.difficulty.min_height_px)
            | (size <= 0).any(axis=1)
            | (occlusion > self.difficulty.max_occlusion)
            | (truncation > self.difficulty.max_truncation)
        )

    def _faint(self, render: Render | None) -> NDArray[np.bool_]:
        """(N,) bool: objects that a person can hardly see in a render."""
        if self._hidden is None or render is None or self.difficulty.min_contrast == 0:
            return np.zeros(len(self._box2d), np.bool_)
        return compute_contrasts(render) < self.difficulty.min_contrast

    def _projected_mesh(self, mesh: Mesh) -> _ProjectedMesh:
        # The mesh is stored too: otherwise its id could be reused by another one.
        if id(mesh) not in self._projected_meshes:
            self._projected_meshes[id(mesh)] = (mesh, _ProjectedMesh.from_mesh(mesh))
        return self._projected_meshes[id(mesh)][1]

    def _project(self, scene: SceneIR) -> Array:
        """Tight boxes (N, 4) px of the deformed meshes, cut at the near plane, not at the image border."""
        objects = scene.objects
        poses = to_host(objects.ffd, objects.size_lhw, objects.yaw, objects.translation)
        offsets, size, yaw, translation = (values.numpy() for values in poses)
        # Placing and projecting are affine, so they are applied to the lattice instead of each vertex.
        x, y, z = ((_LATTICE_AT_REST + offsets) * size[:, None]).transpose(2, 0, 1)
        cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        placed = np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=1) + translation[:, :, None]
        nets = self._matrix[:, :3] @ placed + self._matrix[:, 3:]
        same = objects.mesh_index is self.base.objects.mesh_index
        index = np.array(self._mesh_index if same else objects.mesh_index.tolist(), dtype=np.int64)
        boxes = np.zeros((len(index), 4))
        for number in set(index.tolist()):
            rows = np.flatnonzero(index == number)
            boxes[rows] = self._projected_mesh(scene.meshes[number]).image_boxes(nets[rows])
        return boxes


def visible_boxes(render: Render) -> Tensor:
    """Boxes (N, 4) px of the visible pixels of each object; zeros where there are none."""
    ids = render.object_id.cpu().numpy()
    boxes = np.zeros((len(render.opacity), 4), dtype=np.float32)
    for i, crop in enumerate(render.opacity):
        height, width = crop.values.shape[1:]
        seen = ids[crop.y0 : crop.y0 + height, crop.x0 : crop.x0 + width] == i + 1
        columns, rows = seen.any(axis=0).nonzero()[0], seen.any(axis=1).nonzero()[0]
        if len(rows):
            boxes[i] = (crop.x0 + columns[0], crop.y0 + rows[0], crop.x0 + columns[-1], crop.y0 + rows[-1])
    return torch.from_numpy(boxes)


def _render_on_host(render: Render) -> Render:
    """What labels need of a render, on the CPU: from a GPU in one transfer, as bytes."""
    if not render.image.is_cuda:
        return render
    ids, levels = render.object_id.to(torch.int16), (render.image.detach().clamp(0, 1) * 255).round()
    parts = [ids.view(torch.uint8), levels, *(crop.values >= _OPAQUE for crop in render.opacity)]
    values = torch.cat([part.to(torch.uint8).flatten() for part in parts]).cpu()
    numbers, picture, *opaque = values.split([part.numel() for part in parts])
    opacity = tuple(
        replace(crop, values=flags.view(crop.values.shape).float())
        for crop, flags in zip(render.opacity, opaque, strict=True)
    )
    numbers = numbers.view(torch.int16).view(ids.shape).long()
    return Render(picture.view(levels.shape).float() / 255, render.depth, numbers, opacity)


def hidden_shares(render: Render) -> Array:
    """Share (N,) of each object's pixels that others hide; 1 for objects without pixels."""
    ids = render.object_id.cpu().numpy()
    shares: list[float] = []
    for i, crop in enumerate(render.opacity):
        opacity = crop.values[0].detach().cpu().numpy()
        own = int(np.count_nonzero(opacity >= _OPAQUE))
        # All pixels of the object lie in its crop.
        window = ids[crop.y0 : crop.y0 + opacity.shape[0], crop.x0 : crop.x0 + opacity.shape[1]]
        seen = int(np.count_nonzero(window == i + 1))
        shares.append(min(max(1 - seen / own, 0.0), 1.0) if own else 1.0)
    return np.array(shares, dtype=np.float64)


def to_kitti_labels(
    labels: SceneLabels, base: SceneIR, perturbed: SceneIR, kinds: Sequence[str] | None = None
) -> Labels:
    """Labels in the form of a KITTI file, of objects in view.

    A moved 3D box follows the pose and the change of the deformed mesh's extents; without a change it equals the
    base's to the bit.

    Args:
        labels: labels of one mode: `paper` takes the base's 3D boxes, `moved` the perturbed ones.
        base: the benign scene.
        perturbed: the labelled scene.
        kinds: types as labelled (a Van counts as a Car); None: those of the categories.
    """
    names = tuple(kinds) if kinds is not None else tuple(_kind(c) for c in labels.category.tolist())
    rows = labels.in_view
    names = tuple(name for name, seen in zip(names, rows.tolist(), strict=True) if seen)
    translation, yaw, size_lhw = base.objects.translation, base.objects.yaw, base.objects.size_lhw
    if labels.mode == "moved":
        low0, high0 = _unit_extents(base)
        low, high = _unit_extents(perturbed)
        yaw, grown_lhw = perturbed.objects.yaw, perturbed.objects.size_lhw
        # The lowest layer is fixed: only length and width can shift the middle of the bottom face.
        shift = 0.5 * ((low + high) * grown_lhw - (low0 + high0) * size_lhw) * size_lhw.new_tensor([1.0, 0.0, 1.0])
        translation = perturbed.objects.translation + (yaw_matrix(yaw) @ shift[:, :, None])[:, :, 0]
        size_lhw = grown_lhw * ((high - low) / (high0 - low0))
        turns = torch.round(yaw / (2 * torch.pi))
        yaw = torch.where(yaw.abs() > torch.pi, yaw - turns * 2 * torch.pi, yaw)
    return Labels(
        kind=names,
        boxes_xyxy=labels.boxes_xyxy[rows],
        truncation=labels.truncation[rows],
        occlusion=labels.occlusion[rows],
        translation=translation.detach()[rows],
        yaw=yaw.detach()[rows],
        size_lhw=size_lhw.detach()[rows],
        ignore_xyxy=labels.regions_xyxy,
    )


def append_other_labels(labels: Labels, others: Labels | None) -> Labels:
    """Labels with other objects of the scene (`SceneIR.others`: people, trams) appended as objects.

    `to_kitti_labels` and a run's files list these as regions, after those of the labels. The labels stay unchanged
    for None. It is unknown whether a moved vehicle hides a person.
    """
    if others is None:
        return labels
    names = ("boxes_xyxy", "truncation", "occlusion", "translation", "yaw", "size_lhw")
    columns = {name: torch.cat([getattr(labels, name), getattr(others, name)]) for name in names}
    return replace(others, kind=(*labels.kind, *others.kind), **columns)


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


_SLICE = LATTICE[1] * LATTICE[2]
_LATTICE_AT_REST = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in LATTICE), indexing="ij"), axis=-1).reshape(
    -1, 3
) - np.array([0.5, 1.0, 0.5])
"""Lattice points (64, 3) in the unit box. Bernstein polynomials reproduce linear functions, so the weighted sum of
these positions is the vertex itself."""


@dataclass(frozen=True, slots=True)
class _ProjectedMesh:
    """A mesh's K distinct vertices (parts of a mesh repeat shared ones) as lattice weights, for its image box.

    The products of `along` and `across` are those of `ffd.lattice_weights`, in a third of the memory, which takes
    most of the time.
    """

    along: Array
    """(4, K), weights of the lattice's slices along the length."""
    across: Array
    """(16, K), weights of the points in a slice."""
    faces: NDArray[np.int64]
    """(F, 3), indices of the distinct vertices."""

    @classmethod
    def from_mesh(cls, mesh: Mesh) -> _ProjectedMesh:
        vertices, inverse = np.unique(mesh.vertices.detach().cpu().double().numpy(), axis=0, return_inverse=True)
        weights = ffd.lattice_weights(torch.from_numpy(vertices)).numpy().reshape(-1, LATTICE[0], _SLICE)
        # Each factor of the weights sums to 1.
        along, across = weights.sum(axis=2), weights.sum(axis=1)
        faces = inverse.reshape(-1)[mesh.faces.cpu().numpy()]
        return cls(np.ascontiguousarray(along.T), np.ascontiguousarray(across.T), faces)

    def image_boxes(self, nets: Array) -> Array:
        """Tight boxes xyxy (M, 4) px under lattices (M, 3, 64) in clip space; zeros where all is behind the near
        plane.
        """
        slices = (nets.reshape(-1, _SLICE) @ self.across).reshape(-1, 3, LATTICE[0], self.along.shape[1])
        clip = np.einsum("mcik,ik->mck", slices, self.along)
        if not clip.shape[2]:
            return np.zeros((len(nets), 4))
        pixels = clip[:, :2] / np.maximum(clip[:, 2:], _NEAR_M)
        boxes = np.concatenate([pixels.min(axis=2), pixels.max(axis=2)], axis=1)
        for row in np.flatnonzero(clip[:, 2].min(axis=1) < _NEAR_M):
            front = self._in_front(clip[row])
            pixels = front[:2] / front[2]
            boxes[row] = [*pixels.min(axis=1), *pixels.max(axis=1)] if front.shape[1] else 0.0
        return boxes

    def _in_front(self, clip: Array) -> Array:
        """Vertices (3, K') in front of the near plane, and intersections of the edges with it."""
        front = clip[2] >= _NEAR_M
        edges = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        edges = edges[front[edges[:, 0]] != front[edges[:, 1]]]
        start, end = clip[:, edges[:, 0]], clip[:, edges[:, 1]]
        share = (_NEAR_M - start[2]) / (end[2] - start[2])
        return np.concatenate([clip[:, front], start + share * (end - start)], axis=1)


def _outside(whole_xyxy: Array, inside_xyxy: Array) -> Array:
    """Share (N,) of each box outside of the picture."""
    return 1 - _area(inside_xyxy) / np.maximum(_area(whole_xyxy), 1e-9)


def _any_area(boxes_xyxy: Array) -> NDArray[np.bool_]:
    return _area(boxes_xyxy) > 0


def _area(boxes_xyxy: Array) -> Array:
    width, height = np.maximum(boxes_xyxy[:, 2:] - boxes_xyxy[:, :2], 0).T
    return width * height


def _new_occlusion(level: Levels, hidden0: Array, hidden: Array) -> Levels:
    """KITTI levels (N,) after the hidden share changed from hidden0 to hidden, both (N,).

    The labelled level includes occluders that the render lacks (trees, poles): the share starts inside the labelled
    level's range and changes by the difference. Unchanged shares keep their level.
    """
    known = np.minimum(level, 2)
    start = np.clip(hidden0, _OCCLUSION_BOUNDS[known], _OCCLUSION_BOUNDS[known + 1])
    after = start + (hidden - hidden0)
    new = (after[:, None] >= _OCCLUSION_BOUNDS[1:3]).sum(axis=1)
    return np.where((hidden == hidden0) | (level > 2), level, new).astype(level.dtype)
