"""Proposals of changes: another vehicle in a car's place, one more or one fewer car, a load on a roof, a person who
stands half hidden behind a vehicle.

Each proposal is a scene that theta changes like the first one (`scene_ir.exchange`). A few are evaluated under
nuisances at the theta that a search found, and the one with the lowest margins is taken, or the unchanged scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.feasibility_check import check_exchange
from drivesem.attacks.labels import Labeller
from drivesem.attacks.methods.margin_search import MIN_PASSES
from drivesem.attacks.space import ground_axes
from scene_ir import exchange
from scene_ir.errors import FormatError
from scene_ir.exchange import Vehicle
from scene_ir.geometry import ground_footprint
from scene_ir.meshes.load import ImportedMesh
from scene_ir.meshes.templates import ROOF_LOADS, make_roof_load, template, typical_size_lhw
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.render.surfaces import camera_centre
from scene_ir.types import Category, Mesh, SceneIR

SAMPLES = 2
"""Nuisance samples in which each proposal is evaluated."""
_MAX_PASS_SHARE = 0.25
"""Maximum share of an attack's passes for proposals."""
_MAX_PROPOSALS = 6
"""Maximum number of proposals per frame."""
_ATTEMPTS = 6
"""Attempts per proposal; the first feasible one is taken."""
_KINDS = {
    Category.CAR: ("sedan", "hatchback", "estate", "suv", "van", "pickup"),
    Category.TRUCK: ("truck",),
}
_VARIANTS = 40
_SIZES_M = ((1.5, 20.0), (0.8, 4.5), (0.6, 3.5))
"""Ranges of vehicles' lengths, heights and widths."""
_PAINTS = (
    (0.78, 0.78, 0.77), (0.55, 0.56, 0.57), (0.30, 0.31, 0.33), (0.06, 0.06, 0.07), (0.10, 0.14, 0.30),
    (0.32, 0.06, 0.06), (0.45, 0.42, 0.36), (0.10, 0.22, 0.16),
)  # fmt: skip
"""Display RGB of common vehicles: mostly white, greys and black."""
_GAP_M = (0.6, 1.5)
"""Gap between parked cars."""
_OCCLUDER_DISTANCE = (0.55, 0.85)
"""Distance of a vehicle that hides a part of a car, as a share of the car's distance."""
_OCCLUDER_OFFSET = (0.4, 1.2)
"""Its lateral offset, in own widths."""
_BEHIND_M = (0.4, 1.5)
"""Distance of a person behind the end of the vehicle that hides a part of it."""
_COVERED = (0.3, 0.7)
"""Share of the person's width behind the vehicle's outline; more shows above a low vehicle."""
_MAX_ENLARGEMENT = 1.3
"""Maximum magnification of a person's photograph."""


class VehicleChange(StrEnum):
    """Kinds of vehicle changes."""

    LEAVE = "leave"
    """A car is gone."""
    PARK = "park"
    """One more car is parked."""
    SWAP = "swap"
    """Another vehicle stands in a car's place."""
    LOAD = "load"
    """A box, cases or a crate lie on a car's roof."""
    EMERGE = "emerge"
    """A person of the frame stands half hidden behind an end of a vehicle."""


@dataclass(frozen=True, slots=True)
class VehicleChangeSettings:
    """Which changes are proposed."""

    kinds: tuple[VehicleChange, ...]
    """Kinds of changes."""
    mesh: ImportedMesh | None = None
    """The vehicle that is parked or swapped in; None: templates."""


def parse_vehicle_changes(text: str) -> tuple[VehicleChange, ...]:
    """Kinds from "leave,park,swap,load,emerge". Raises FormatError naming the unknown one and the known ones."""
    names = [part.strip() for part in text.split(",")]
    for name in names:
        if name not in list(VehicleChange) or names.count(name) > 1:
            raise FormatError("--changes", f"each at most once of {', '.join(VehicleChange)}", repr(text))
    return tuple(change for change in VehicleChange if change in names)


def load_vehicle_mesh(path: str) -> ImportedMesh:
    """A user's mesh in metres. Raises FormatError for a file that is no mesh, or not of a vehicle's size."""
    from drivesem.synth.assets import read_vehicle

    vehicle = read_vehicle(path)
    for name, size_m, (low, high) in zip(("length", "height", "width"), vehicle.stated_lhw, _SIZES_M, strict=True):
        if not low <= size_m <= high:
            raise FormatError(f"{path}: {name}", f"a vehicle's in metres, {low:g} to {high:g}", f"{size_m:.3g}")
    return ImportedMesh(vehicle.mesh, vehicle.stated_lhw, vehicle.up, vehicle.notes)


def count_affordable_proposals(passes: int) -> int:
    """Number of proposals that an attack with so many passes can evaluate."""
    spare = min(int(_MAX_PASS_SHARE * passes), passes - MIN_PASSES)
    return min(max((spare - SAMPLES - 1) // (SAMPLES + 1), 0), _MAX_PROPOSALS)


def proposal_passes(count: int) -> int:
    """Passes of so many proposals: each takes one for its benign picture and one per sample, as does the unchanged
    scene; one more evaluates the result.
    """
    return count * (SAMPLES + 1) + SAMPLES + 1 if count else 0


@torch.no_grad()
def propose_scenes(
    scene: SceneIR, changes: VehicleChangeSettings, count: int, seed: int, settings: RenderSettings | None = None
) -> list[SceneIR]:
    """Up to `count` feasible changed scenes: on the road, without collisions, with moved labels. Kinds take turns.

    Args:
        scene: the scene to change.
        changes: which changes are proposed.
        count: number of proposals.
        seed: seed of the random choices.
        settings: of the renderer.
    """
    rng = np.random.default_rng(seed)
    render = Compositor(scene, settings).render(scene)
    labels = Labeller(scene, render)
    rows = (~labels.paper().ignore).nonzero()[:, 0].tolist()
    if not rows:
        return []
    proposals = []
    for turn in range(count):
        kind = changes.kinds[turn % len(changes.kinds)]
        for attempt in _generate_attempts(scene, kind, changes.mesh, rows, rng):
            if check_exchange(attempt):
                continue
            labelled = _with_moved_labels(attempt, settings)
            if kind is not VehicleChange.EMERGE or _is_half_hidden(scene, labelled):
                proposals.append(labelled)
                break
    return proposals


def _generate_attempts(
    scene: SceneIR,
    change: VehicleChange,
    own_mesh: ImportedMesh | None,
    rows: Sequence[int],
    rng: np.random.Generator,
) -> Iterator[SceneIR]:
    """Scenes with a change of one kind, feasible or not, without moved labels."""
    upright = scene.objects.upright.tolist()
    if change is not VehicleChange.LEAVE:
        rows = [row for row in rows if upright[row] == (change is VehicleChange.EMERGE)]
    for _ in range(_ATTEMPTS if rows else 0):
        row = int(rng.choice(rows))
        if change is VehicleChange.EMERGE:
            vehicles = [i for i, person in enumerate(upright) if not person]
            if not vehicles:
                return
            vehicle = int(rng.choice(vehicles))
            place = _choose_place_behind(scene, row, vehicle, rng)
            if place is not None:
                yield exchange.relocate_person(scene, row, place, vehicle)
            continue
        if change is VehicleChange.LEAVE:
            yield exchange.remove_vehicle(scene, row)
            continue
        if change is VehicleChange.LOAD:
            car = scene.meshes[int(scene.objects.mesh_index[row])]
            if int(scene.objects.category[row]) == Category.CAR:
                yield exchange.add_roof_load(
                    scene, row, make_roof_load(str(rng.choice(ROOF_LOADS)), car, scene.objects.size_lhw[row])
                )
            continue
        category = Category(int(scene.objects.category[row]))
        if category not in _KINDS:
            return
        swap = change is VehicleChange.SWAP
        mesh, size, paint = _choose_vehicle(own_mesh, category if swap else Category.CAR, rng)
        place = scene.objects.translation[row]
        if not swap:
            place = _choose_parking_place(scene, row, size, rng)
            category = Category.CAR
        vehicle = Vehicle(mesh, category, place, scene.objects.yaw[row], torch.tensor(size), paint)
        yield exchange.replace_vehicle(scene, row, vehicle) if swap else exchange.add_vehicle(scene, vehicle)


def _choose_vehicle(
    own_mesh: ImportedMesh | None, category: Category, rng: np.random.Generator
) -> tuple[Mesh, tuple[float, float, float], tuple[float, float, float] | None]:
    """Mesh, size (m) and paint of a vehicle: the user's mesh, or a template in a common paint."""
    if own_mesh is not None:
        return own_mesh.mesh, own_mesh.size_lhw, None
    kind, variant = str(rng.choice(_KINDS[category])), int(rng.integers(_VARIANTS))
    return template(kind, variant), typical_size_lhw(kind, variant), _PAINTS[rng.integers(len(_PAINTS))]


def _choose_parking_place(
    scene: SceneIR, row: int, size_lhw: tuple[float, float, float], rng: np.random.Generator
) -> Tensor:
    """Position (3,) m of one more car: in front of or behind the car in `row`, or nearer to the camera and to its
    side, where it hides a part of it.
    """
    objects = scene.objects
    place, yaw = objects.translation[row], objects.yaw[row : row + 1]
    along, across = ground_axes(yaw, torch.ones_like(yaw), scene.environment.ground)[0]
    side = float(rng.choice((-1.0, 1.0)))
    if rng.random() < 0.5:
        distance = 0.5 * (float(objects.size_lhw[row, 0]) + size_lhw[0]) + rng.uniform(*_GAP_M)
        return place + side * distance * along
    # Towards the camera along the ground plane, at the same height above it.
    share = rng.uniform(*_OCCLUDER_DISTANCE) - 1.0
    ground = scene.environment.ground.to(place)
    nearer = torch.stack([share * place[0], place.new_zeros(()), share * place[2]])
    nearer[1] = -(ground[0] * nearer[0] + ground[2] * nearer[2]) / ground[1]
    return place + nearer + side * rng.uniform(*_OCCLUDER_OFFSET) * size_lhw[2] * across


def _choose_place_behind(scene: SceneIR, row: int, vehicle: int, rng: np.random.Generator) -> Tensor | None:
    """Position (3,) m of a person behind the left or right end of a vehicle, as the camera sees it, where a part of
    the person's width shows; None where the photograph would be enlarged too much.
    """
    objects, ground = scene.objects, scene.environment.ground.double()
    here = objects.translation[row].double()
    centre = camera_centre(scene.camera.matrix.double())
    corners = ground_footprint(
        *(part[vehicle : vehicle + 1].double() for part in (objects.size_lhw, objects.yaw, objects.translation))
    )[0]
    across, ahead = (corners - centre[[0, 2]]).unbind(1)
    bearing = torch.atan2(across, ahead)
    side = float(rng.choice((-1.0, 1.0)))
    end = int((side * bearing).argmax())
    distance = float(torch.hypot(across[end], ahead[end])) + rng.uniform(*_BEHIND_M)
    if float((here - centre)[[0, 2]].norm()) > _MAX_ENLARGEMENT * distance or float(ahead.min()) < 1.0:
        return None
    shift = side * (0.5 - rng.uniform(*_COVERED)) * float(objects.size_lhw[row, 2]) / distance
    angle = bearing[end] + shift
    place = torch.stack([centre[0] + distance * angle.sin(), here[1], centre[2] + distance * angle.cos()])
    place[1] += -(ground[:3] @ (place - here)) / ground[1]
    return place.to(objects.translation)


def _is_half_hidden(scene: SceneIR, changed: SceneIR) -> bool:
    """Whether the person that `changed` moved is partly hidden there, and wholly inside of the picture."""
    (row,) = (changed.objects.translation != scene.objects.translation).any(dim=1).nonzero()[:, 0].tolist()
    return int(changed.objects.occlusion[row]) == 1 and float(changed.objects.truncation[row]) == 0


def _with_moved_labels(changed: SceneIR, settings: RenderSettings | None) -> SceneIR:
    """A changed scene with moved labels as its own."""
    compositor = Compositor(changed, settings)
    labeller = Labeller(changed.origin, compositor.render(changed.origin))
    labels = labeller.moved(changed, compositor.render(changed))
    return changed.with_objects(box2d=labels.boxes_xyxy, truncation=labels.truncation, occlusion=labels.occlusion)
