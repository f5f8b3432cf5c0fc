"""The objective of a clip: from its theta to the mean loss of its frames, each with its own frame objective."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors.base import Predictor
from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.methods.base import ParameterGroup, Problem, Score
from drivesem.attack.objective import Objective, RenderEvaluation
from drivesem.attack.space import Budget, Parameter, ParameterSpace
from drivesem.config.commands import AttackConfig, DriveConfig
from drivesem.evaluation.failures import match_detections
from drivesem.video.clips import DerenderedClip
from drivesem.video.space import ClipSpace, project_clip
from scene_ir import ffd
from scene_ir.render.compositor import Compositor


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
    evaluated frame. Raises as `Objective` does.
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
            objective_labels=config.objective_labels, objective=config.objective, t_star=config.t_star, whole=True
        )
        self.frames = [
            Objective(Compositor(scene), ParameterSpace(scene, params, budget), detector, settings)
            for scene in clip.scenes
        ]
        self.space = ClipSpace([objective.space for objective in self.frames], clip.tracks, config.bend)
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
        targets = objective.classes.map_targets(rendered.moved.targets)
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
            violations=tuple(f"cars[{track}]: visibility" for track in tracks),
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
