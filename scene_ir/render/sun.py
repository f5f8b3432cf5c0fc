"""The sun of a perturbed scene: where it stands and how strong it is, beside the one in the photograph."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.render import model
from scene_ir.types import Environment


@dataclass(frozen=True, slots=True)
class Sun:
    """direction (3,): unit, towards it, in camera axes; strength (): of its light, as a factor on the
    photograph's; shade (): of the shadows that it casts, likewise. Differentiable to `Environment.light`.
    """

    direction: Tensor
    strength: Tensor
    shade: Tensor

    @classmethod
    def of(cls, environment: Environment, like: Tensor, sunlight: Tensor) -> Sun:
        """Under `environment.light`, in the dtype of `like`; sunlight (): how strong the photograph's is, as
        `Source.sunlight`. At code 0 the photograph's to the last bit, with both factors 1.
        """
        sun, up = environment.sun.to(like), environment.ground[:3].to(like)
        code = environment.light.to(like)
        still = torch.zeros_like(code)
        # What the code adds, so that nothing is rounded where it is 0.
        direction = sun + (moved_sun(sun, up, code) - moved_sun(sun, up, still))
        strength = 1.0 + model.SUN_STRENGTH * code[2]
        shade = _taken(direction, up, sunlight * strength) / _taken(sun, up, sunlight).clamp(min=1e-6)
        return cls(direction, strength, torch.where(sunlight > 0, shade, torch.ones_like(shade)))


def moved_sun(sun: Tensor, up: Tensor, code: Tensor) -> Tensor:
    """The direction (3,) towards a sun (3,) under a light code (3,): turned about `up` (3,), to the right for who
    looks at it, and risen."""
    sine = (sun * up).sum()
    flat = torch.nn.functional.normalize(sun - sine * up, dim=0)
    azimuth, height = model.SUN_TURN_RAD * code[0], torch.asin(sine) + model.SUN_RISE_RAD * code[1]
    along = torch.cos(azimuth) * flat + torch.sin(azimuth) * torch.linalg.cross(flat, up)
    return torch.cos(height) * along + torch.sin(height) * up


def _taken(sun: Tensor, up: Tensor, sunlight: Tensor) -> Tensor:
    """The share of the light on the ground that a shadow takes away."""
    direct = sunlight * (sun * up).sum().clamp(min=0.0)
    return direct / (sum(model.AMBIENT) + direct)
