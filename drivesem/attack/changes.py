"""Changes that people see in streets from one day to the next, as an attack's scouts propose them: another
vehicle in a car's place, a parked car more or less, a load on a roof.

Each is a scene of its own, which theta changes as it does the first (`scene_ir.exchange`). A few are seen in
draws at the theta that a search found, and the one with the lowest margins is kept, or the scene as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch
from torch import Tensor

from drivesem.attack.feasibility_check import check_exchange
from drivesem.attack.labels import Labeller
from drivesem.attack.methods.margin_search import LEAST_PASSES
from drivesem.attack.space import ground_axes
from scene_ir import exchange
from scene_ir.errors import FormatError
from scene_ir.exchange import Vehicle
from scene_ir.meshes.load import Imported, import_mesh
from scene_ir.meshes.loads import LOADS, load
from scene_ir.meshes.templates import template, typical_size_lhw
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Category, Mesh, SceneIR

DRAWS = 2
"""In which each proposal is seen."""
_SHARE = 0.25
"""Of an attack's passes, at most, for proposals."""
_MOST = 6
"""Proposals a frame."""
_ATTEMPTS = 6
"""At one proposal, of which the first is taken that can be."""
_KINDS = {
    Category.CAR: ("sedan", "hatchback", "estate", "suv", "van", "pickup"),
    Category.TRUCK: ("truck",),
}
_VARIANTS = 40
_SIZES_M = ((1.5, 20.0), (0.8, 4.5), (0.6, 3.5))
"""Lengths, heights, widths of vehicles."""
_PAINTS = (
    (0.78, 0.78, 0.77), (0.55, 0.56, 0.57), (0.30, 0.31, 0.33), (0.06, 0.06, 0.07), (0.10, 0.14, 0.30),
    (0.32, 0.06, 0.06), (0.45, 0.42, 0.36), (0.10, 0.22, 0.16),
)  # fmt: skip
"""Display RGB of what is on the roads: mostly white, greys and black."""
_GAP_M = (0.6, 1.5)
"""Between parked cars."""
_NEARER = (0.55, 0.85)
"""Shares of the way to a car, on which another may hide a part of it; and own widths to its side."""
_BESIDE = (0.4, 1.2)


class Change(StrEnum):
    """What may be proposed. leave: a car is gone; park: one more stands there; swap: another vehicle in its place;
    load: a box, cases or a crate on its roof.
    """

    LEAVE = "leave"
    PARK = "park"
    SWAP = "swap"
    LOAD = "load"


@dataclass(frozen=True, slots=True)
class Changes:
    """kinds: what may be proposed; mesh: the vehicle that parks or comes in a car's place, by default
    templates.
    """

    kinds: tuple[Change, ...]
    mesh: Imported | None = None


def parse_changes(text: str) -> tuple[Change, ...]:
    """Changes from "leave,park,swap,load". Raises FormatError naming the unknown one and the known ones."""
    names = [part.strip() for part in text.split(",")]
    for name in names:
        if name not in list(Change) or names.count(name) > 1:
            raise FormatError("--changes", f"each at most once of {', '.join(Change)}", repr(text))
    return tuple(change for change in Change if change in names)


def vehicle_mesh(path: str) -> Imported:
    """A user's mesh in metres. Raises FormatError naming the file where it is none, or not as large as vehicles
    are.
    """
    found = import_mesh(path)
    for name, size_m, (low, high) in zip(("length", "height", "width"), found.size_lhw, _SIZES_M, strict=True):
        if not low <= size_m <= high:
            raise FormatError(f"{path}: {name}", f"a vehicle's in metres, {low:g} to {high:g}", f"{size_m:.3g}")
    return found


def affordable(passes: int) -> int:
    """How many proposals an attack of so many passes sees, beside the scene as it is."""
    spare = min(int(_SHARE * passes), passes - LEAST_PASSES)
    return min(max((spare - DRAWS - 1) // (DRAWS + 1), 0), _MOST)


def passes_of(count: int) -> int:
    """What so many proposals take: each a pass for the picture before it, and its draws; with those of the scene
    as it is, and the judging of the one that is kept.
    """
    return count * (DRAWS + 1) + DRAWS + 1 if count else 0


@torch.no_grad()
def proposals(
    scene: SceneIR, changes: Changes, count: int, seed: int, settings: RenderSettings | None = None
) -> list[SceneIR]:
    """Up to `count` changed scenes that can be: on the road, in nobody's way, with labels that followed. The kinds
    take turns.
    """
    rng = np.random.default_rng(seed)
    render = Compositor(scene, settings).render(scene)
    labels = Labeller(scene, render)
    rows = (~labels.paper().ignore).nonzero()[:, 0].tolist()
    if not rows:
        return []
    found = []
    for turn in range(count):
        kind = changes.kinds[turn % len(changes.kinds)]
        for made in _attempts(scene, kind, changes.mesh, rows, rng):
            if not check_exchange(made):
                found.append(_labelled(made, settings))
                break
    return found


def _attempts(
    scene: SceneIR, change: Change, own: Imported | None, rows: Sequence[int], rng: np.random.Generator
) -> Iterator[SceneIR]:
    """Scenes in which something of a kind was changed, possible or not, with labels still to be made."""
    for _ in range(_ATTEMPTS):
        row = int(rng.choice(rows))
        if change is Change.LEAVE:
            yield exchange.without(scene, row)
            continue
        if change is Change.LOAD:
            car = scene.meshes[int(scene.objects.mesh_index[row])]
            if int(scene.objects.category[row]) == Category.CAR:
                yield exchange.with_load(
                    scene, row, load(str(rng.choice(LOADS)), car, scene.objects.size_lhw[row])
                )
            continue
        category = Category(int(scene.objects.category[row]))
        if category not in _KINDS:
            return
        swap = change is Change.SWAP
        mesh, size, paint = _model(own, category if swap else Category.CAR, rng)
        place = scene.objects.translation[row]
        if not swap:
            place = _parked(scene, row, size, rng)
            category = Category.CAR
        vehicle = Vehicle(mesh, category, place, scene.objects.yaw[row], torch.tensor(size), paint)
        yield exchange.with_other(scene, row, vehicle) if swap else exchange.with_vehicle(scene, vehicle)


def _model(
    own: Imported | None, category: Category, rng: np.random.Generator
) -> tuple[Mesh, tuple[float, float, float], tuple[float, float, float] | None]:
    """Mesh, size (m) and paint of a vehicle: the user's as it is, or a template in a street's paint."""
    if own is not None:
        return own.mesh, own.size_lhw, None
    kind, variant = str(rng.choice(_KINDS[category])), int(rng.integers(_VARIANTS))
    return template(kind, variant), typical_size_lhw(kind, variant), _PAINTS[rng.integers(len(_PAINTS))]


def _parked(scene: SceneIR, row: int, size_lhw: tuple[float, float, float], rng: np.random.Generator) -> Tensor:
    """Where (3,) m another car may stand: before or behind the car in `row`, as parked cars do, or nearer to the
    camera and to its side, where it hides a part.
    """
    objects = scene.objects
    place, yaw = objects.translation[row], objects.yaw[row : row + 1]
    along, across = ground_axes(yaw, torch.ones_like(yaw), scene.environment.ground)[0]
    side = float(rng.choice((-1.0, 1.0)))
    if rng.random() < 0.5:
        way = 0.5 * (float(objects.size_lhw[row, 0]) + size_lhw[0]) + rng.uniform(*_GAP_M)
        return place + side * way * along
    # Towards the camera along the ground: its slope, and how high the car stands above it, are kept.
    way = rng.uniform(*_NEARER) - 1.0
    ground = scene.environment.ground.to(place)
    nearer = torch.stack([way * place[0], place.new_zeros(()), way * place[2]])
    nearer[1] = -(ground[0] * nearer[0] + ground[2] * nearer[2]) / ground[1]
    return place + nearer + side * rng.uniform(*_BESIDE) * size_lhw[2] * across


def _labelled(made: SceneIR, settings: RenderSettings | None) -> SceneIR:
    """A changed scene with the labels of its own objects: the benign ones, moved."""
    compositor = Compositor(made, settings)
    labeller = Labeller(made.origin, compositor.render(made.origin))
    labels = labeller.moved(made, compositor.render(made))
    return made.with_objects(box2d=labels.boxes_xyxy, truncation=labels.truncation, occlusion=labels.occlusion)
