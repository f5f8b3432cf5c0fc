"""Margins of a scene's objects as a function of theta, in draws of the nuisances: what a search for failures that
hold asks for. Certificates use draws of another name, which no search sees.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from detectors.base import Candidates, Detector, predict
from detectors.incremental.reference import Reference
from drivesem.attack import goals
from drivesem.attack.labels import shown_boxes
from drivesem.attack.methods.base import GRADIENT_PASSES
from drivesem.attack.objective import Objective
from drivesem.failures import margin
from drivesem.failures.certificate import with_regions
from drivesem.failures.kinds import View, judge
from drivesem.failures.nuisances import Draw, Nuisances
from scene_ir.types import Render, SceneIR

SHARPNESS = 4.0
"""Of the soft maximum over candidates in gradients, 1 / logits."""


@dataclass(frozen=True)
class DrawnViews:
    """`attack.methods.base.Views` of an objective. stream: name of the draws, which are kept with their noise:
    5.6 MB each at 1242 x 375 px, and a search goes round in twelve. Where neither weather nor foliage changes, the
    detector's layers of a draw's first picture are kept too, and further ones are seen where they differ from it.
    """

    objective: Objective
    nuisances: Nuisances
    stream: str
    judged: Tensor
    _draws: dict[int, Draw] = field(default_factory=dict[int, Draw])
    _first: dict[int, Reference] = field(default_factory=dict[int, Reference])

    @classmethod
    def of(cls, objective: Objective, nuisances: Nuisances, stream: str) -> DrawnViews:
        """Objects that are found in the benign re-render, and that the aim does not leave out."""
        benign, judged = objective.benign, objective.judged
        targets = judged.targets(objective.aim.targets(benign.paper.targets))
        shown = with_regions(shown_boxes(benign.render), targets)
        found = judge(View(targets, shown, benign.detections), objective.t_star).found
        count = len(objective.space.scene.objects)
        return cls(objective, nuisances, stream, (found & ~targets.ignore.to(found.device))[:count])

    @property
    def differentiable(self) -> bool:
        """See `Views`. A detector that does not tell its candidates has no gradient of margins."""
        detector = self.objective.detector
        return isinstance(detector, Detector) and type(detector).candidates is not Detector.candidates

    @property
    def passes(self) -> int:
        """Of the detector, since the objective was made."""
        return self.objective.passes

    @torch.no_grad()
    def margins(self, theta: Tensor, number: int) -> Tensor:
        """See `Views`."""
        draw, scene, render = self._drawn(theta, number)
        self.objective.passes += 1
        return self._margins(
            self._candidates(draw.picture(render.image), number, render), draw, scene, render, None
        )

    def margins_and_grad(self, theta: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        """See `Views`; the gradient is that of soft margins. RangeError for a detector without a gradient."""
        leaf = theta.detach().clone().requires_grad_(True)
        soft = self.soft(leaf, number)
        self.objective.passes += GRADIENT_PASSES
        counts = torch.isfinite(soft)
        total = (weights.to(soft)[counts] * soft[counts]).sum()
        if not total.requires_grad:  # nothing counts there
            return soft.detach(), torch.zeros_like(theta)
        (gradient,) = torch.autograd.grad(total, leaf)
        return soft.detach(), gradient

    def soft(self, theta: Tensor, number: int) -> Tensor:
        """Margins (N,) by a soft maximum over candidates, of a picture that is not rounded to 8 bits where theta
        (D,) carries a gradient; differentiable.
        """
        draw, scene, render = self._drawn(theta, number)
        return self._margins(
            self._candidates(draw.picture(render.image), number, render), draw, scene, render, SHARPNESS
        )

    def forget(self) -> None:
        """Let go of what is kept of draws, which is made anew when it is asked for."""
        self._draws.clear()
        self._first.clear()

    @property
    def kept_mb(self) -> float:
        """Of layers."""
        return sum(reference.bytes for reference in self._first.values()) / 1e6

    def draw(self, number: int) -> Draw:
        """The number-th draw."""
        if number not in self._draws:
            self._draws[number] = self.nuisances.draw(self.stream, number, self.objective.space.scene)
        return self._draws[number]

    def _drawn(self, theta: Tensor, number: int) -> tuple[Draw, SceneIR, Render]:
        space, draw = self.objective.space, self.draw(number)
        scene = draw.scene(space.apply(space.scene, theta))
        return draw, scene, self.objective.compositor.render(scene)

    def _candidates(self, image: Tensor, number: int, render: Render) -> Candidates:
        detector, judged = self.objective.detector, self.objective.judged
        if self.differentiable:
            known, first = self.objective.differentiable, None
            if image.requires_grad:
                return known.candidates(known(image[None]))
            if render.drawn is not None and not self.objective.whole:
                first = self._kept(known, image, number)
            return known.candidates(known.glance(image[None]) if first is None else first(image[None], []))
        return goals.of_detections(judged.detections(predict(detector, image[None])[0]), len(judged.names))

    def _kept(self, detector: Detector, image: Tensor, number: int) -> Reference | None:
        """A draw's first picture; None where its layers are not known, or there is no room for them."""
        limit = self.objective.picture_mb
        if number not in self._first and self.objective.kept_mb + self.kept_mb + limit <= self.objective.keep_mb:
            first = Reference.of(detector, image[None], limit)
            if first is not None:
                self._first[number] = first
        return self._first.get(number)

    def _margins(
        self, candidates: Candidates, draw: Draw, scene: SceneIR, render: Render, sharpness: float | None
    ) -> Tensor:
        """(N,); infinite for objects that are not judged, here or as photographed."""
        objective, count = self.objective, len(self.judged)
        with torch.no_grad():
            still = replace(render, image=render.image.detach())
            moved = objective.labeller.moved(scene, still).targets
            targets = objective.judged.targets(moved)
            if self.differentiable:
                targets = objective.judged.own_targets(targets)
            rows = (self.judged & ~targets.ignore[:count].to(self.judged.device)).nonzero()[:, 0]
            placed, shown = draw.boxes(targets.boxes_xyxy[rows]), shown_boxes(still)[rows]
            seen = torch.where((shown[:, 2:] > shown[:, :2]).all(1, keepdim=True), draw.boxes(shown), shown)
        own = margin.of_objects(candidates, placed, targets.labels[rows], seen, objective.t_star, sharpness)
        return own.new_full((count,), torch.inf).index_put((rows.to(own.device),), own)
