"""What cars carry on their roofs: boxes on bars, in the unit box of the car, and above it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from scene_ir.meshes.solids import Material, Solid, assemble, box
from scene_ir.types import Mesh

LOADS = ("roof box", "cases", "crate")
"""Kinds of load."""
_BARS_M = 0.05
"""Height of the bars over the roof."""
_SUNK_M = 0.09
"""How far their feet reach into it, since roofs are arched."""
_HIGH = 0.9
"""Height above which a car's mesh is roof, as a share of its own."""


def load(kind: str, car: Mesh, size_lhw: Sequence[float] | Tensor) -> Mesh:
    """A load of one of the LOADS for a car of that size (m)."""
    length, height, width = (float(side) for side in size_lhw)
    roof = car.vertices[car.vertices[:, 1] < -_HIGH]
    ends = roof[:, 0].aminmax()
    middle, half = 0.5 * float(ends.min + ends.max) * length, 0.5 * float(ends.max - ends.min) * length
    reach = 0.36 * width
    solids: list[Solid] = []
    for x in (-0.6 * half, 0.6 * half):
        solids.append(box((x - 0.03, 0.5 * _BARS_M, -reach), (x + 0.03, _BARS_M, reach), Material.CHROME))
        for z in (-reach, reach - 0.08):
            solids.append(box((x - 0.04, -_SUNK_M, z), (x + 0.04, _BARS_M, z + 0.08), Material.TRIM))
    solids += _boxes(kind, half, width)
    low = torch.tensor([min(solid.vertices[:, axis].min() for solid in solids) for axis in range(3)])
    high = torch.tensor([max(solid.vertices[:, axis].max() for solid in solids) for axis in range(3)])
    made = assemble(solids, kind)
    # Out of the load's own unit box, y down, to the car's: its roof is at y = -1.
    size, top = (high - low).to(made.vertices), made.vertices.new_tensor([length, height, width])
    centre = torch.tensor([middle + 0.5 * float(low[0] + high[0]), -float(low[1]) - height, 0.0])
    return replace(made, vertices=(made.vertices * size + centre.to(size)) / top)


def _boxes(kind: str, half: float, width: float) -> list[Solid]:
    """Metres over the roof, y up, about the roof's middle; half: of its length."""
    if kind == "roof box":
        return [box((-0.95, _BARS_M, -0.36), (0.95, _BARS_M + 0.36, 0.36), Material.TRIM, bevel=0.1)]
    if kind == "cases":
        rows = [
            (-0.95, -0.35, 0.42, Material.CARGO),
            (-0.32, 0.2, 0.3, Material.TRIM),
            (0.23, 0.8, 0.36, Material.RIM),
        ]
        reach = 0.3 * width
        return [
            box((a * half, _BARS_M, -reach), (b * half, _BARS_M + up, reach), m, bevel=0.03)
            for a, b, up, m in rows
        ]
    return [
        box(
            (-0.8 * half, _BARS_M, -0.38 * width),
            (0.9 * half, _BARS_M + 0.4, 0.38 * width),
            Material.CARGO,
            bevel=0.02,
        )
    ]
