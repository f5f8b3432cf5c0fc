"""What the kernels need of a scene, and no parameter changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.render.prepare import PreparedScene, at_photographed_pose
from scene_ir.render.surfaces import offset_indices


@dataclass(frozen=True, slots=True)
class FixedGeometry:
    """Input of the kernels that no parameter affects."""

    faces: Tensor
    """(F, 3) int32."""
    neighbours: Tensor
    """(F, 3) int32, see `surfaces.TemplateSurface`."""
    base_clip: Tensor
    """(V, 3) photographed clip coordinates."""
    base_attributes: Tensor
    """(V, 3) photographed cosine towards the camera, paint share, height."""
    template: Tensor
    """(V, channels.OWN) template attributes with local normals and depth 0."""
    texels: tuple[Tensor, Tensor, Tensor]
    """Values (S, channels.TEXEL), rects (N, 4), offsets (N + 1,)."""
    base_patches: Tensor
    """(N, 3, 3) float64, from (s, t, 1) on a shadow's patch, each in [0, 1], to photographed clip coordinates."""
    darkness: tuple[Tensor, Tensor, Tensor]
    """Values (S, 4) of the shadows, the fourth 0, rects (N, 4), offsets (N + 1,)."""
    frame_wh: Tensor
    """(N, 2) px."""
    unproject: Tensor
    """(N, 3, 3), from a pixel (x, y, 1) to its ray."""

    @classmethod
    def from_scene(cls, prepared: PreparedScene) -> FixedGeometry:
        """The input for one scene."""
        meshes, base, count = (prepared.surfaces, prepared.base_geometry, len(prepared.scene.objects))
        assert prepared.texels is not None
        assert prepared.shadows is not None
        height, width = prepared.frame_hw
        return cls(
            faces=meshes.faces.to(torch.int32).contiguous(),
            neighbours=meshes.neighbours.to(torch.int32).contiguous(),
            base_clip=base.clip,
            base_attributes=torch.stack([base.facing_cos, meshes.paint, prepared.vertex_height], dim=1),
            template=prepared.completion_attributes(
                prepared.sharp_normals, torch.zeros_like(prepared.vertex_height)
            ),
            texels=(
                prepared.texels.values[: int(prepared.texels.offsets[count])],
                prepared.texels.rects[:count],
                prepared.texels.offsets[: count + 1],
            ),
            base_patches=prepared.batch.patch_matrices([at_photographed_pose(prepared.scene.objects)]),
            darkness=(
                torch.nn.functional.pad(prepared.shadows.values, (0, 1)),
                prepared.shadows.rects,
                prepared.shadows.offsets,
            ),
            frame_wh=prepared.like.new_tensor([width, height]).expand(count, 2).contiguous(),
            unproject=prepared.unproject.expand(count, 3, 3).contiguous(),
        )

    @classmethod
    def concat(cls, parts: Sequence[FixedGeometry]) -> FixedGeometry:
        """Several scenes' objects, concatenated."""
        if len(parts) == 1:
            return parts[0]
        plain = ("base_clip", "base_attributes", "template", "base_patches", "frame_wh", "unproject")
        return cls(
            faces=torch.cat(offset_indices([p.faces for p in parts], [p.base_clip.shape[0] for p in parts])),
            neighbours=torch.cat(offset_indices([p.neighbours for p in parts], [p.faces.shape[0] for p in parts])),
            texels=_concat_crops([p.texels for p in parts]),
            darkness=_concat_crops([p.darkness for p in parts]),
            **{name: torch.cat([getattr(p, name) for p in parts]) for name in plain},
        )


def _concat_crops(crops: Sequence[tuple[Tensor, Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """Values, rects and offsets of several sets of crops, concatenated."""
    starts = [sum(c[0].shape[0] for c in crops[:i]) for i in range(len(crops))]
    ends = [c[2][1:] + start for c, start in zip(crops, starts, strict=True)]
    offsets = torch.cat([crops[0][2][:1], *ends])
    return torch.cat([c[0] for c in crops]), torch.cat([c[1] for c in crops]), offsets
