"""A counterexample's change as an edit of the generator's plan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.config.edits import FrameEdit, ObjectEdit
from drivesem.failures.second_renderer.plans import Planned
from drivesem.synth.frames import yaw_in_camera
from drivesem.synth.layout import Actor
from drivesem.synth.view import View
from scene_ir import ffd
from scene_ir.types import LATTICE, SceneIR


@dataclass(frozen=True, slots=True)
class Carried:
    """edit: by track. missing: what the plan has no counterpart for, by name; such changes are not in the edit."""

    edit: FrameEdit
    missing: tuple[str, ...]


def carried(still: SceneIR, changed: SceneIR, planned: Planned) -> Carried:
    """What leads from `still` to `changed`, two states of one scene, as an edit of the plan it was taken from.

    Moves go by metres in the camera's axes, turns by angle, so that a car whose pose was fitted a little off makes
    the same way as its counterpart. Lattice offsets are fractions of either's own unit box. Heights are left out:
    the generator's vehicles stand on its ground.
    """
    before, after = still.objects, changed.objects
    actors = {actor.track: actor for actor in planned.plan.actors}
    view = planned.plan.setting.view
    edits: dict[int | str, ObjectEdit] = {}
    missing: list[str] = []
    for i, track in enumerate(planned.tracks):
        move = (after.translation[i] - before.translation[i]).detach().double()
        turn = float(after.yaw[i] - before.yaw[i])
        bend = (after.ffd[i] - before.ffd[i]).detach().double()
        grown = float((after.size_lhw[i] / before.size_lhw[i]).mean()) - 1
        paint = (after.texture_code[i] - before.texture_code[i]).detach()
        if track is None:
            if turn or grown or bool(move.any()) or bool(bend.any()) or bool(paint.any()):
                missing.append(f"objects[{i}]: the generator's plan has no such vehicle")
            continue
        actor = actors[track]
        if math.cos(float(before.yaw[i]) - yaw_in_camera(actor, view)) < 0:
            bend = _from_behind(bend)
        edits[track] = ObjectEdit(
            translate_m=_along_and_across(move, actor, view),
            rotate=turn,
            color=tuple(paint.clamp(-1, 1).tolist()),
            mesh=tuple(ffd.to_symmetric(bend).tolist()) if bool(bend.any()) else (),
            size=grown,
        )
    environment, then = changed.environment, still.environment
    edit = FrameEdit(
        objects=edits,
        weather=tuple((environment.weather - then.weather).detach().clamp(0, 1).tolist()),
        foliage=tuple((environment.foliage - then.foliage).detach().clamp(-1, 1).tolist()),
        sun=tuple((environment.light - then.light).detach().clamp(-1, 1).tolist()),
    )
    return Carried(edit, tuple(missing))


def _along_and_across(move: Tensor, actor: Actor, view: View) -> tuple[float, float]:
    """A way (3,) m in camera axes, along the actor's heading and to its left, on the ground."""
    x, _, z = (view.rotation.T @ move.numpy()).tolist()
    cos, sin = math.cos(actor.yaw), math.sin(actor.yaw)
    return x * cos - z * sin, x * sin + z * cos


def _from_behind(offsets: Tensor) -> Tensor:
    """Lattice offsets (64, 3) of a vehicle as one that faces the other way in the same place has them."""
    grid = offsets.reshape(*LATTICE, 3).flip(0, 2)
    return (grid * torch.tensor([-1.0, 1.0, -1.0]).to(grid)).reshape(-1, 3)
