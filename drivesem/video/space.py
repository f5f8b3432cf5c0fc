"""theta of a clip: what changes is a car's, not a frame's.

A car's paint, shape, heading and size change by the same in all of its frames, and so do weather, foliage and sun.
Its place changes along a smooth path: Bernstein's polynomials over the time in which it is seen, whose control
points are theta's coordinates. They are weights that add up to one, so a path keeps to its control points' bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import comb

import torch
from torch import Tensor

from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.space import SPECS, Parameter, ParameterSpace
from drivesem.attack.theta import ParameterSpec, ProjectedTheta, ThetaSpace
from scene_ir.errors import RangeError

_INSIDE = 1 - 1e-5
"""Of a path's bounds: sums of its weights are rounded."""
_SAME = 1e-6
"""Within which a frame's projection left theta as it was."""
_ROUNDS = 8
"""In which what a frame holds back is held back in the clip, in the second half along whole paths; after that,
cars that still violate something stay at rest."""


class ClipSpace(ThetaSpace[Parameter]):
    """spaces: of each frame's scene, all of the same parameters and budget; tracks: of each frame's objects, in
    their order; bend: degree of a path's polynomial, 0 for an offset that stays. Bounds are the tightest of a
    car's frames.
    """

    def __init__(self, spaces: Sequence[ParameterSpace], tracks: Sequence[Sequence[int]], bend: int = 3) -> None:
        if bend < 0 or not spaces:
            raise RangeError("clip", "frames, and a bend of at least 0", f"{len(spaces)} frames, {bend}")
        self.spaces = tuple(spaces)
        self.tracks = tuple(sorted({track for of_frame in tracks for track in of_frame}))
        self.points = bend + 1
        like = spaces[0].scene.objects.translation
        super().__init__(spaces[0].params, _specs(self.points), len(self.tracks), like)
        places = ([self.tracks.index(track) for track in of_frame] for of_frame in tracks)
        self.rows = [torch.tensor(of_frame, dtype=torch.int64, device=like.device) for of_frame in places]
        self._weights = _path_weights(self.tracks, tracks, self.points, like)
        self.lower.fill_(-torch.inf)
        self.upper.fill_(torch.inf)
        for space, rows in zip(self.spaces, self.rows, strict=True):
            for parameter in self.params:
                self._tighten(parameter, space, rows)
        for bound in (self.lower, self.upper):
            bound[~bound.isfinite()] = 0  # of cars that no frame has, which there are none of

    def name(self, i: int) -> str:
        """The name of coordinate `i`, by the car's track: `cars[12].translate.along[0]`."""
        parameter, owner, k = self._locate(i)
        spec = self.specs[parameter]
        return f"cars[{self.tracks[owner]}].{spec.names[k]}" if spec.per_object else spec.names[k]

    def frame_theta(self, theta: Tensor, frame: int) -> Tensor:
        """theta (D,) as that of a frame's own space (D',); differentiable."""
        parts = []
        for parameter in self.params:
            block = self.block(theta, parameter)
            assert block is not None
            if SPECS[parameter].per_object:
                block = block[self.rows[frame]]
            if parameter is Parameter.TRANSLATE:
                weights = self._weights[frame]
                block = (weights[:, :, None] * block.reshape(len(block), self.points, 2)).sum(1)
            parts.append(block.reshape(-1))
        return torch.cat(parts)

    def restrict(self, theta: Tensor, frame: int, asked: Tensor, granted: Tensor, whole: bool) -> Tensor:
        """theta (D,) with what a frame granted (D',) of what was asked of it (D',). Of a path, those control
        points that matter there give way, or, where `whole`, all of it by as large a part.
        """
        theta, space = theta.clone(), self.spaces[frame]
        for parameter in self.params:
            block, there = self.block(theta, parameter), space.block(granted, parameter)
            before = space.block(asked, parameter)
            assert block is not None
            assert there is not None
            assert before is not None
            if parameter is Parameter.TRANSLATE:
                share = torch.where(before.abs() > _SAME, there / before, 1.0).clamp(0, 1)
                weights = self._weights[frame]
                matter = torch.ones_like(weights) if whole else weights / weights.amax(1, keepdim=True)
                path = block.reshape(len(block), self.points, 2)
                path[self.rows[frame]] *= 1 - matter[:, :, None] * (1 - share[:, None])
            elif SPECS[parameter].per_object:
                block[self.rows[frame]] = there
            else:
                block.copy_(there)
        return theta

    def reset_geometry(self, theta: Tensor, cars: Tensor) -> Tensor:
        """theta (D,) without the changes of shape and place of `cars` (N,) bool."""
        theta = theta.clone()
        for parameter in self.params:
            block = self.block(theta, parameter)
            if block is not None and SPECS[parameter].per_object and parameter is not Parameter.COLOR:
                block[cars] = 0
        return theta

    def path_offsets(self, theta: Tensor, frame: int) -> Tensor:
        """How far each object of a frame stands from its place (n, 2) m, along its heading and across."""
        space = self.spaces[frame]
        offset = space.block(self.frame_theta(theta, frame), Parameter.TRANSLATE)
        length_m = space.scene.objects.size_lhw[:, :1]
        return length_m.new_zeros(len(length_m), 2) if offset is None else offset * length_m

    def physical(self, i: int, value: float) -> tuple[float, str] | None:
        """In metres, degrees or percent, as of a frame in which the car is."""
        parameter, owner, k = self._locate(i)
        spec = SPECS[parameter]
        if not spec.per_object:
            return None
        frame = next(f for f, rows in enumerate(self.rows) if bool((rows == owner).any()))
        place = int((self.rows[frame] == owner).nonzero()[0])
        space = self.spaces[frame]
        return space.physical(space.blocks[parameter].start + place * spec.size + k % spec.size, value)

    def _tighten(self, parameter: Parameter, space: ParameterSpace, rows: Tensor) -> None:
        for own, theirs, tighter in (
            (self.lower, space.lower, torch.maximum),
            (self.upper, space.upper, torch.minimum),
        ):
            block, there = self.block(own, parameter), space.block(theirs, parameter)
            assert block is not None
            assert there is not None
            if parameter is Parameter.TRANSLATE:
                block[rows] = tighter(block[rows], _INSIDE * there.repeat(1, self.points))
            elif SPECS[parameter].per_object:
                block[rows] = tighter(block[rows], there)
            else:
                block.copy_(tighter(block, there))
        where, there = self.blocks.get(parameter), space.blocks.get(parameter)
        if where is not None and there is not None and len(space.step[there]):
            self.step[where] = space.step[there].max()


def project_clip(space: ClipSpace, sets: Sequence[FeasibleSet], theta: Tensor) -> ProjectedTheta:
    """theta (D,) brought back to what is feasible in every frame (sets, one a frame): what one frame holds back is
    held back in the whole clip, in turn until no frame asks for more. theta = 0 is feasible.
    """
    theta = torch.minimum(torch.maximum(theta.detach(), space.lower), space.upper)
    active: list[str] = []
    for attempt in range(_ROUNDS + space.count + 1):
        offenders = torch.zeros(space.count, dtype=torch.bool, device=theta.device)
        held = False
        for frame, feasible in enumerate(sets):
            asked = space.frame_theta(theta, frame)
            found = feasible.project(asked)
            if torch.allclose(found.theta, asked, rtol=0, atol=_SAME):
                continue
            held = True
            active += [_renamed(name, space, frame) for name in found.active]
            theta = space.restrict(theta, frame, asked, found.theta, whole=attempt >= _ROUNDS // 2)
            offenders[space.rows[frame][_differing(space.spaces[frame], asked, found.theta)]] = True
        if not held:
            return ProjectedTheta(theta, tuple(dict.fromkeys(active)))
        if attempt >= _ROUNDS:
            theta = space.reset_geometry(theta, offenders)
    return ProjectedTheta(torch.zeros_like(theta), tuple(dict.fromkeys(active)))


def _differing(space: ParameterSpace, one: Tensor, other: Tensor) -> Tensor:
    """(n,) bool: objects of a frame of which two thetas (D',) differ."""
    found = torch.zeros(space.count, dtype=torch.bool, device=one.device)
    for parameter in space.params:
        if SPECS[parameter].per_object:
            a, b = space.block(one, parameter), space.block(other, parameter)
            assert a is not None
            assert b is not None
            found |= ((a - b).abs() > _SAME).any(1)
    return found


def _renamed(name: str, space: ClipSpace, frame: int) -> str:
    """`objects[3]: collision` of a frame as the car's."""
    if not name.startswith("objects["):
        return name
    index, _, rest = name.removeprefix("objects[").partition("]")
    return f"cars[{space.tracks[int(space.rows[frame][int(index)])]}]{rest}"


def _specs(points: int) -> dict[Parameter, ParameterSpec]:
    """The parameters' facts, of cars instead of objects."""
    names = tuple(f"{name}[{k}]" for k in range(points) for name in SPECS[Parameter.TRANSLATE].names)
    path = ParameterSpec(2 * points, True, SPECS[Parameter.TRANSLATE].unit, names, "cars")
    return {p: replace(spec, owner="cars") for p, spec in SPECS.items()} | {Parameter.TRANSLATE: path}


def _path_weights(cars: Sequence[int], tracks: Sequence[Sequence[int]], points: int, like: Tensor) -> list[Tensor]:
    """For each frame the weights (n, K) of its objects' control points, by the time since each was first seen."""
    seen = {car: [f for f, of_frame in enumerate(tracks) if car in of_frame] for car in cars}
    found = []
    for frame, of_frame in enumerate(tracks):
        weights = like.new_zeros(len(of_frame), points)
        for row, car in enumerate(of_frame):
            first, last = seen[car][0], seen[car][-1]
            u = (frame - first) / max(last - first, 1)
            n = points - 1
            weights[row] = like.new_tensor([comb(n, k) * u**k * (1 - u) ** (n - k) for k in range(points)])
        found.append(weights)
    return found
