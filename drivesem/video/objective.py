"""The objective of a clip: from its theta, one change per track, to the mean loss of its frames.

The paint, shape, heading and size of an object change equally in all of its frames, as do weather, foliage and sun. Its
place follows a smooth path: Bernstein polynomials over the time in which it is visible, with control points as
coordinates of theta. Their weights sum to at most one, so a path stays within the bounds of its control points. A
person's path begins and ends at the labelled place next to frames in which the person stays in the background.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb

import torch
from torch import Tensor

from detectors.base import Predictor
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.methods.base import ParameterGroup, Problem, Score
from drivesem.attacks.objective import Objective, RenderEvaluation
from drivesem.attacks.space import SPECS, Budget, Parameter, ParameterSpace
from drivesem.attacks.theta import ParameterSpec, ProjectedTheta, ThetaSpace
from drivesem.config.commands import AttackConfig, DriveConfig
from drivesem.config.errors import UsageError
from drivesem.evaluation.failures import match_detections
from drivesem.reporting.tables import format_count
from drivesem.video.clips import DerenderedClip
from scene_ir import ffd
from scene_ir.errors import RangeError
from scene_ir.render.compositor import Compositor

_INSIDE = 1 - 1e-5
"""Factor on a path's bounds, as the sum of its weights is rounded."""
_SAME = 1e-6
"""Tolerance within which a frame's projection did not change theta."""
_FADE_FRAMES = 10
"""Frames in which a person's path returns to the labelled place: a second."""
_ROUNDS = 8
"""Rounds in which the limits of frames are applied to the clip, in the second half to whole paths; afterwards,
objects that still violate a constraint lose their changes of shape and place."""


class ClipSpace(ThetaSpace[Parameter]):
    """Parameters of a clip; bounds are the tightest of an object's frames."""

    def __init__(
        self,
        spaces: Sequence[ParameterSpace],
        tracks: Sequence[Sequence[int]],
        bend: int = 3,
        background_people: Sequence[Collection[int]] = (),
    ) -> None:
        """Combine the spaces of frames.

        Args:
            spaces: Space of each frame's scene, with equal parameters and budgets.
            tracks: Track of each object in each frame.
            bend: Degree of a path's polynomial; 0 for a constant offset.
            background_people: Tracks of the people that stay in the background of each frame; empty if there are none.
        """
        if bend < 0 or not spaces:
            raise RangeError("clip", "frames, and a bend of at least 0", f"{len(spaces)} frames, {bend}")
        self.spaces = tuple(spaces)
        self.tracks = tuple(sorted({track for of_frame in tracks for track in of_frame}))
        self.points = bend + 1
        like = spaces[0].scene.objects.translation
        widest = max(spaces, key=lambda space: space.specs[Parameter.COLOR].size)  # a frame without objects has 5
        super().__init__(spaces[0].params, _specs(widest.specs, self.points), len(self.tracks), like)
        places = ([self.tracks.index(track) for track in of_frame] for of_frame in tracks)
        self.rows = [torch.tensor(of_frame, dtype=torch.int64, device=like.device) for of_frame in places]
        self._weights = _path_weights(self.tracks, tracks, self.points, like, background_people)
        self.lower.fill_(-torch.inf)
        self.upper.fill_(torch.inf)
        for space, rows in zip(self.spaces, self.rows, strict=True):
            for parameter in self.params:
                self._tighten(parameter, space, rows)
        for bound in (self.lower, self.upper):
            bound[~bound.isfinite()] = 0  # objects without any frame do not occur

    def name(self, i: int) -> str:
        """The name of coordinate `i`, by the object's track: `tracks[12].translate.along[0]`."""
        parameter, owner, k = self._locate(i)
        spec = self.specs[parameter]
        return f"tracks[{self.tracks[owner]}].{spec.names[k]}" if spec.per_object else spec.names[k]

    def frame_theta(self, theta: Tensor, frame: int) -> Tensor:
        """Convert theta (D,) to a frame's own space (D',); differentiable."""
        parts = []
        for parameter in self.params:
            block = self.block(theta, parameter)
            assert block is not None
            if SPECS[parameter].per_object:
                block = block[self.rows[frame]]
            if parameter is Parameter.COLOR:
                block = block[:, : self.spaces[frame].specs[parameter].size]
            if parameter is Parameter.TRANSLATE:
                weights = self._weights[frame]
                block = (weights[:, :, None] * block.reshape(len(block), self.points, 2)).sum(1)
            parts.append(block.reshape(-1))
        return torch.cat(parts)

    def restrict(self, theta: Tensor, frame: int, proposed: Tensor, projected: Tensor, whole: bool) -> Tensor:
        """Apply a frame's projection to theta.

        Args:
            theta: (D,) of the clip.
            frame: Number of the frame.
            proposed: (D',) of the frame before its projection.
            projected: (D',) of the frame after it.
            whole: Whether to scale a whole path, instead of the control points that matter in the frame.

        Returns:
            (D,) of the clip.
        """
        theta, space = theta.clone(), self.spaces[frame]
        for parameter in self.params:
            block, there = self.block(theta, parameter), space.block(projected, parameter)
            before = space.block(proposed, parameter)
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
                block[self.rows[frame], : there.shape[1]] = there
            else:
                block.copy_(there)
        return theta

    def reset_geometry(self, theta: Tensor, chosen: Tensor) -> Tensor:
        """theta (D,) without changes of shape and place of the chosen objects (N,) bool."""
        theta = theta.clone()
        for parameter in self.params:
            block = self.block(theta, parameter)
            if block is not None and SPECS[parameter].per_object and parameter is not Parameter.COLOR:
                block[chosen] = 0
        return theta

    def path_offsets(self, theta: Tensor, frame: int) -> Tensor:
        """Offset (n, 2) m of each object of a frame from its place, along and across its heading."""
        space = self.spaces[frame]
        offset = space.block(self.frame_theta(theta, frame), Parameter.TRANSLATE)
        length_m = space.scene.objects.size_lhw[:, :1]
        return length_m.new_zeros(len(length_m), 2) if offset is None else offset * length_m

    def physical(self, i: int, value: float) -> tuple[float, str] | None:
        """Value in metres, degrees or percent, measured in the first frame with the object."""
        parameter, owner, k = self._locate(i)
        if not SPECS[parameter].per_object:
            return None
        frame = next(f for f, rows in enumerate(self.rows) if bool((rows == owner).any()))
        place = int((self.rows[frame] == owner).nonzero()[0])
        space = self.spaces[frame]
        size = space.specs[parameter].size
        return space.physical(space.blocks[parameter].start + place * size + k % size, value)

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
                block[rows, : there.shape[1]] = tighter(block[rows, : there.shape[1]], there)
            else:
                block.copy_(tighter(block, there))
        where, there = self.blocks.get(parameter), space.blocks.get(parameter)
        if where is not None and there is not None and len(space.step[there]):
            self.step[where] = space.step[there].max()


def project_clip(space: ClipSpace, sets: Sequence[FeasibleSet], theta: Tensor) -> ProjectedTheta:
    """Project theta to what is feasible in every frame. The limits of each frame apply to the whole clip, repeatedly
    until no frame changes theta; theta = 0 is feasible.

    Args:
        space: Parameters of the clip.
        sets: Feasible set of each frame.
        theta: (D,) of the clip.
    """
    theta = torch.minimum(torch.maximum(theta.detach(), space.lower), space.upper)
    active: list[str] = []
    for attempt in range(_ROUNDS + space.count + 1):
        offenders = torch.zeros(space.count, dtype=torch.bool, device=theta.device)
        held = False
        for frame, feasible in enumerate(sets):
            proposed = space.frame_theta(theta, frame)
            found = feasible.project(proposed)
            if torch.allclose(found.theta, proposed, rtol=0, atol=_SAME):
                continue
            held = True
            active += [_renamed(name, space, frame) for name in found.active]
            theta = space.restrict(theta, frame, proposed, found.theta, whole=attempt >= _ROUNDS // 2)
            offenders[space.rows[frame][_differing(space.spaces[frame], proposed, found.theta)]] = True
        if not held:
            return ProjectedTheta(theta, tuple(dict.fromkeys(active)))
        if attempt >= _ROUNDS:
            theta = space.reset_geometry(theta, offenders)
    return ProjectedTheta(torch.zeros_like(theta), tuple(dict.fromkeys(active)))


def _differing(space: ParameterSpace, one: Tensor, other: Tensor) -> Tensor:
    """(n,) bool: objects of a frame for which two thetas (D',) differ."""
    found = torch.zeros(space.count, dtype=torch.bool, device=one.device)
    for parameter in space.params:
        if SPECS[parameter].per_object:
            a, b = space.block(one, parameter), space.block(other, parameter)
            assert a is not None
            assert b is not None
            found |= ((a - b).abs() > _SAME).any(1)
    return found


def _renamed(name: str, space: ClipSpace, frame: int) -> str:
    """Convert `objects[3]: collision` of a frame to the name of the track."""
    if not name.startswith("objects["):
        return name
    index, _, rest = name.removeprefix("objects[").partition("]")
    return f"tracks[{space.tracks[int(space.rows[frame][int(index)])]}]{rest}"


def _specs(specs: Mapping[Parameter, ParameterSpec], points: int) -> dict[Parameter, ParameterSpec]:
    """The specifications of the parameters, for tracks instead of objects."""
    names = tuple(f"{name}[{k}]" for k in range(points) for name in SPECS[Parameter.TRANSLATE].names)
    path = ParameterSpec(2 * points, True, SPECS[Parameter.TRANSLATE].unit, names, "tracks")
    return {p: replace(spec, owner="tracks") for p, spec in specs.items()} | {Parameter.TRANSLATE: path}


def _path_weights(
    names: Sequence[int],
    tracks: Sequence[Sequence[int]],
    points: int,
    like: Tensor,
    background_people: Sequence[Collection[int]],
) -> list[Tensor]:
    """For each frame the weights (n, K) of its objects' control points, by the time since each was first seen, and by
    the time to the nearest frame in which a person stays in the background.
    """
    seen, left_out = (
        {track: [f for f, of_frame in enumerate(frames) if track in of_frame] for track in names}
        for frames in (tracks, background_people)
    )
    found = []
    for frame, of_frame in enumerate(tracks):
        weights = like.new_zeros(len(of_frame), points)
        for row, track in enumerate(of_frame):
            first, last = seen[track][0], seen[track][-1]
            u = (frame - first) / max(last - first, 1)
            n = points - 1
            fade = min([abs(frame - other) / _FADE_FRAMES for other in left_out[track]], default=1.0)
            bernstein = [comb(n, k) * u**k * (1 - u) ** (n - k) for k in range(points)]
            weights[row] = min(fade, 1.0) * like.new_tensor(bernstein)
        found.append(weights)
    return found


@dataclass(frozen=True, slots=True)
class FrameDetection:
    """Detections in one frame of a clip."""

    rendered: RenderEvaluation
    """The rendered frame, its labels and detections."""
    found: tuple[bool, ...]
    """Whether each object is detected."""
    counted: tuple[bool, ...]
    """Whether each object counts."""
    lost: tuple[int, ...]
    """Objects that are missed but were detected in the photograph."""
    phantoms: int
    """Number of phantoms."""


class ClipObjective:
    """The objective that an attack on a clip maximises.

    Each gradient step uses `config.keys` evenly spaced frames, other ones in turn. `on_frame` is called for each
    evaluated frame. Raises as `Objective` does, and UsageError for a clip in which no targeted object counts.
    """

    def __init__(
        self,
        clip: DerenderedClip,
        detector: Predictor,
        params: Sequence[Parameter],
        budget: Budget,
        config: DriveConfig,
    ) -> None:
        settings = AttackConfig(
            objective_labels=config.objective_labels,
            objective=config.objective,
            t_star=config.t_star,
            target_classes=config.target_classes,
            whole=True,
        )
        self.frames = [
            Objective(Compositor(scene), ParameterSpace(scene, params, budget), detector, settings)
            for scene in clip.scenes
        ]
        if not any(objective.judged for objective in self.frames):
            kinds = f"objects of {config.target_classes}" if config.target_classes else "objects"
            found = f"none in {format_count(len(self.frames), 'frame')}"
            raise UsageError("CLIP", f"{kinds} that are large and visible enough to count", found)
        spaces = [objective.space for objective in self.frames]
        self.space = ClipSpace(spaces, clip.tracks, config.bend, clip.background_people)
        self.sets: list[FeasibleSet] = [
            objective.feasible_set(only_bounds=config.project == "bounds") for objective in self.frames
        ]
        self._keys = max(min(config.keys, len(self.frames)), 1)
        self.on_frame: Callable[[], object] = lambda: None
        self._steps = 0
        self._scores: dict[bytes, Score] = {}
        self._previews: dict[bytes, Score] = {}

    @property
    def passes(self) -> int:
        """Detector passes so far; a gradient counts as 3."""
        return sum(objective.passes for objective in self.frames)

    def problem(self, keep_last: bool = False) -> Problem:
        """The problem that attacks solve."""
        space = self.space
        return Problem(
            loss_and_grad=self.loss_and_grad,
            project=lambda theta: project_clip(space, self.sets, theta),
            score=self.score,
            step=space.step,
            lower=space.lower,
            upper=space.upper,
            groups=tuple(self._group(parameter, where) for parameter, where in space.blocks.items()),
            preview=lambda theta: self._previews.get(_key(theta)),
            keep_last=keep_last,
        )

    def loss_and_grad(self, theta: Tensor) -> tuple[float, Tensor]:
        """Mean loss and gradient (D,) at theta (D,) over the frames of this step."""
        count = len(self.frames)
        chosen = {(self._steps + round(k * count / self._keys)) % count for k in range(self._keys)}
        self._steps += 1
        leaf = theta.detach().clone().requires_grad_(True)
        total, gradient = 0.0, torch.zeros_like(theta)
        seen: list[Score] = []
        for frame in sorted(chosen):
            objective, here = self.frames[frame], self.space.frame_theta(leaf, frame)
            loss, along = objective.loss_and_grad(here.detach())
            total += loss
            gradient += torch.autograd.grad(here, leaf, along)[0]
            preview = objective.preview(here.detach())
            seen += [] if preview is None else [preview]
            self.on_frame()
        self._previews[_key(theta)] = _combine_scores(seen)
        return total / len(chosen), gradient / len(chosen)

    def score(self, theta: Tensor) -> Score:
        """Evaluate the whole clip at theta (D,)."""
        key = _key(theta)
        if key not in self._scores:
            self._scores[key] = _combine_scores(
                [self._score_frame(frame, detection) for frame, detection in self.detect_clip(theta)]
            )
        return self._scores[key]

    def detect_clip(self, theta: Tensor) -> Iterator[tuple[int, FrameDetection]]:
        """Yield the number and detections of every frame at theta (D,), one at a time."""
        for frame in range(len(self.frames)):
            yield frame, self.detect_frame(theta, frame)

    @torch.no_grad()
    def detect_frame(self, theta: Tensor, frame: int) -> FrameDetection:
        """Render one frame at theta (D,) and detect."""
        objective, here = self.frames[frame], self.space.frame_theta(theta, frame)
        scene = objective.space.apply(objective.space.scene, here)
        objective.passes += 1
        self.on_frame()
        return self.match_frame(frame, objective.evaluate_render(scene, objective.compositor.render(scene)))

    def match_frame(self, frame: int, rendered: RenderEvaluation) -> FrameDetection:
        """Match the detections of a rendered frame."""
        objective = self.frames[frame]
        count = len(objective.space.scene.objects)
        targets = objective.classes.map_targets(objective.aim.targets(rendered.moved.targets))
        found = match_detections(targets, rendered.detections, objective.t_star).detected[:count]
        failed = objective.failures(rendered, "moved")
        return FrameDetection(
            rendered,
            tuple(found.tolist()),
            tuple((~targets.ignore[:count]).tolist()),
            failed.lost,
            len(failed.phantoms),
        )

    def _score_frame(self, frame: int, detection: FrameDetection) -> Score:
        hidden = detection.rendered.moved.out_of_sight.nonzero()[:, 0].tolist()
        tracks = [self.space.tracks[int(self.space.rows[frame][i])] for i in hidden]
        paper = self.frames[frame].failures(detection.rendered, "paper")
        return Score(
            loss=detection.rendered.loss,
            lost=len(detection.lost),
            phantoms=detection.phantoms,
            success=bool(detection.lost or detection.phantoms),
            success_paper=paper.success,
            violations=tuple(f"tracks[{track}]: visibility" for track in tracks),
        )

    def _group(self, parameter: Parameter, where: slice) -> ParameterGroup:
        owners = self.space.owner_count(parameter)
        return ParameterGroup(
            parameter.value, where, owners, ffd.low_order_modes() if parameter is Parameter.MESH else None
        )


def _combine_scores(scores: Sequence[Score]) -> Score:
    """Combine the scores of frames: the mean loss, and the sum of the failures."""
    violations = tuple(dict.fromkeys(name for score in scores for name in score.violations))
    return Score(
        loss=sum(score.loss for score in scores) / max(len(scores), 1),
        lost=sum(score.lost for score in scores),
        phantoms=sum(score.phantoms for score in scores),
        success=any(score.success for score in scores) and not violations,
        success_paper=any(score.success_paper for score in scores) and not violations,
        violations=violations,
    )


def _key(theta: Tensor) -> bytes:
    return theta.detach().cpu().numpy().tobytes()
