"""Edits of a scene: vehicles moved, turned, bent, painted or removed; weather and foliage changed.

`drivesem.synth.edits` applies the same edits (`drivesem.config.edits`) to generated streets. Objects are numbered by
their row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from drivesem.attacks.budgets import PRESETS, STREET, change_limits
from drivesem.attacks.feasibility_check import check_places
from drivesem.attacks.space import Budget, ground_axes
from drivesem.config.edits import ALL, FrameEdit, ObjectEdit
from scene_ir import ffd
from scene_ir.errors import RangeError
from scene_ir.removal import remove_objects
from scene_ir.render.night import measure_daylight
from scene_ir.types import CLOTHES_DIM, TEXTURE_DIM, Objects, SceneIR, Weather

REMOVED = "removed"
"""Provenance key of a scene from which vehicles were removed."""
_DARK = 0.5
"""Daylight of a photograph below which it counts as taken by night."""


@dataclass(frozen=True, slots=True)
class EditedScene:
    """A scene after an edit."""

    scene: SceneIR
    """The scene without the removed vehicles."""
    removed: tuple[int, ...]
    """Rows of the removed vehicles in the scene before."""
    notes: tuple[str, ...]
    """Violations that `check_places` found, with the limits of the widest budget; night on a photograph by night."""


def apply_edit(scene: SceneIR, edit: FrameEdit, bent: SceneIR | None = None) -> EditedScene:
    """Edit a scene, remove vehicles, and check the positions of the others.

    Args:
        scene: the scene.
        edit: the edit.
        bent: see `apply_changes`.

    Raises:
        RangeError: see `apply_changes`.
    """
    removed = [row for row, changes in enumerate(_by_row(scene, edit)) if any(c.remove for c in changes)]
    changed = apply_changes(scene, edit, bent)
    rows = (row for row in range(len(scene.objects)) if row not in removed)
    photographed = scene.unperturbed() if scene.objects.source else scene  # moves of several edits add up
    notes = check_places(photographed, changed, rows, change_limits(PRESETS[STREET]))
    if edit.weather[Weather.NIGHT] > 0 and measure_daylight(scene) < _DARK:
        notes.append("weather.night: the photograph is taken by night, so the code changes little")
    remaining = remove_objects(changed, removed)
    if removed:
        remaining = replace(remaining, provenance={**remaining.provenance, REMOVED: "vehicles, by an edit"})
    return EditedScene(remaining, tuple(removed), tuple(notes))


def apply_changes(scene: SceneIR, edit: FrameEdit, bent: SceneIR | None = None) -> SceneIR:
    """Edit a scene, but leave removed vehicles in place (`scene_ir.removal` removes them).

    Edits of all objects and of one add up, and add to the scene's own state. Moves are on the ground plane, along and
    across the vehicle's heading in `scene`; codes are limited to the bounds of theta.

    Args:
        scene: the scene.
        edit: the edit.
        bent: a state of the scene with changed shapes, for edits that set shares of them.

    Raises:
        RangeError: the edit names a row that the scene lacks, clothes that a row lacks, or a share of a shape without
            `bent`.
    """
    changes = _by_row(scene, edit)
    objects, environment = scene.objects, scene.environment
    like = objects.translation

    def summed(values: list[list[tuple[float, ...]]]) -> Tensor:
        return like.new_tensor([[sum(parts) for parts in zip(*row, strict=True)] for row in values])

    limits = Budget()
    changed_fields: dict[str, Tensor] = {}
    if any(changes):
        length_m = objects.size_lhw[:, 0]
        lengths = summed([[(0.0, 0.0), *(c.translate for c in row)] for row in changes])
        metres = summed([[(0.0, 0.0), *(c.translate_m for c in row)] for row in changes])
        axes = ground_axes(objects.yaw, length_m, scene.environment.ground)
        shift = (lengths + metres / length_m[:, None])[:, :, None] * axes
        turn = summed([[(0.0,), *((c.rotate,) for c in row)] for row in changes])[:, 0]
        none = (0.0,) * ffd.SYMMETRIC_DIM
        bend = summed([[none, *(c.mesh or none for c in row)] for row in changes])
        grown = summed([[(1.0,), *((c.size,) for c in row)] for row in changes])
        none_painted = (0.0,) * objects.texture_code.shape[1]
        paint = summed(
            [[none_painted, *(_texture_code(objects, i, c) for c in row)] for i, row in enumerate(changes)]
        )
        lamps = summed([[(0.0,), *((c.lamps,) for c in row)] for row in changes])[:, 0]
        changed_fields = {
            "translation": objects.translation + shift.sum(dim=1),
            "yaw": objects.yaw + turn,
            "ffd": objects.ffd + ffd.from_symmetric(bend) + _shape_shares(scene, changes, bent),
            "size_lhw": objects.size_lhw * grown,
            "lamps": (objects.lamps + lamps).clamp(-1.0, 1.0),
            "texture_code": (objects.texture_code + paint).clamp(-limits.color, limits.color),
        }
    weather = environment.weather + environment.weather.new_tensor(edit.weather)
    foliage = environment.foliage + environment.foliage.new_tensor(edit.foliage)
    return scene.with_objects(**changed_fields).with_environment(
        weather=weather.clamp(0.0, limits.weather),
        foliage=foliage.clamp(-limits.foliage, limits.foliage),
        light=(environment.light + environment.light.new_tensor(edit.sun)).clamp(-1.0, 1.0),
        drops=(environment.drops + edit.drops).clamp(0.0, 1.0),
    )


def _texture_code(objects: Objects, row: int, change: ObjectEdit) -> tuple[float, ...]:
    """The texture code of a row; five codes change all clothes of a pedestrian alike."""
    parted = bool(objects.parted[row])
    lower = change.color[TEXTURE_DIM:] or change.color[:3] * parted
    if any(lower) and not parted:
        expected = f"{TEXTURE_DIM} codes; {CLOTHES_DIM} are for pedestrians, in scenes de-rendered with --people"
        raise RangeError(f"objects[{row}].color", expected, f"{len(change.color)} codes")
    return (*change.color[:TEXTURE_DIM], *lower, 0.0, 0.0, 0.0)[: objects.texture_code.shape[1]]


def _shape_shares(scene: SceneIR, changes: list[list[ObjectEdit]], bent: SceneIR | None) -> Tensor:
    """Lattice offsets (N, P, 3) by shares of the shapes of `bent`."""
    ffds = scene.objects.ffd
    share = ffds.new_tensor([sum((c.mesh_fraction for c in row), 0.0) for row in changes])
    if bent is None:
        for row, value in enumerate(share.tolist()):
            if value:
                expected = "lattice offsets; shares need a scene with changed shapes, and --photographed"
                raise RangeError(f"objects[{row}].mesh", expected, f"{value:.0%}")
        return ffds.new_zeros(())
    return share[:, None, None] * (bent.objects.ffd - ffds)


def _by_row(scene: SceneIR, edit: FrameEdit) -> list[list[ObjectEdit]]:
    """The edits of each object: those of all objects, then its own."""
    count = len(scene.objects)
    for key in edit.objects:
        if isinstance(key, int) and key >= count:
            known = f"a row from 0 to {count - 1}" if count else "no row: the scene has no objects"
            raise RangeError(f"objects[{key}]", known, key)
    return [[edit.objects[key] for key in (ALL, row) if key in edit.objects] for row in range(count)]
