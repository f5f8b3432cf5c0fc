"""theta -> what a classifier makes of the object's picture: the one place where space, scene and network meet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from drivesem.attack.methods.base import GRADIENT_PASSES, ParameterGroup, Problem, Score
from drivesem.classify.networks.base import Scorer
from drivesem.classify.scenes import ObjectScene
from drivesem.classify.space import ObjectSpace
from scene_ir.errors import RangeError
from scene_ir.io import round_to_8bit

Aimed = Literal["logit", "hinge", "softmax"]
"""What an attack raises. logit: the true class's score falls, as in the paper; hinge: so does what it is ahead of
the best other class, down to 0, which is Carlini and Wagner's f; softmax: the best wrong class's probability
rises, by which the paper chooses among samples."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What a classifier says of one picture. scores (C,): before softmax."""

    scores: Tensor
    label: int

    @property
    def predicted(self) -> int:
        """The class of the highest score; of equal ones the first."""
        return int(self.scores.argmax())

    @property
    def right(self) -> bool:
        return self.predicted == self.label

    @property
    def confidence(self) -> float:
        """Softmax of the predicted class."""
        return float(self.scores.softmax(0).amax())

    @property
    def margin(self) -> float:
        """How far the true class is ahead of the best other one, in logits; below 0 it is misclassified."""
        return float(ahead(self.scores, self.label))


def ahead(scores: Tensor, label: int) -> Tensor:
    """How far () the true class's score is ahead of the best other one's; scores (C,)."""
    others = torch.cat([scores[:label], scores[label + 1 :]])
    return scores[label] - others.amax()


def aim(scores: Tensor, label: int, aimed: Aimed) -> Tensor:
    """What is to be raised, (), of scores (C,); differentiable."""
    if aimed == "logit":
        return -scores[label]
    if aimed == "hinge":
        return -ahead(scores, label).clamp_min(0)
    chances = scores.softmax(0)
    return torch.cat([chances[:label], chances[label + 1 :]]).amax()


class ClassifierObjective:
    """What an attack on a classifier raises, as a function of theta (D,). passes: of the network so far, a
    gradient counted as GRADIENT_PASSES. Raises RangeError where a loss or gradient is not finite.
    """

    def __init__(self, scene: ObjectScene, space: ObjectSpace, network: Scorer, aimed: Aimed) -> None:
        self.scene = scene
        self.space = space
        self.network = network
        self.aimed: Aimed = aimed
        self.passes = 0
        self._seen: dict[bytes, Seen] = {}
        self.benign = self.see(space.theta0)

    def loss_and_grad(self, theta: Tensor) -> tuple[float, Tensor]:
        """Loss and its gradient (D,)."""
        leaf = theta.detach().clone().requires_grad_(True)
        image = self.scene.picture(self.space.change(leaf))
        loss = aim(self.network(image[None])[0], self.scene.model.label, self.aimed)
        if not bool(loss.isfinite()):
            raise RangeError(f"objective: {self.aimed}", "a finite loss", float(loss.detach()))
        (gradient,) = torch.autograd.grad(loss, leaf)
        self.space.check_gradient(gradient)
        self.passes += GRADIENT_PASSES
        return float(loss.detach()), gradient

    @torch.no_grad()
    def picture(self, theta: Tensor) -> Tensor:
        """(3, H, W) on the 8-bit grid: what is judged is what is written."""
        return round_to_8bit(self.scene.picture(self.space.change(theta)))

    @torch.no_grad()
    def look(self, image: Tensor) -> Seen:
        """What the network says of a picture (3, H, W)."""
        self.passes += 1
        return Seen(self.network(image[None])[0], self.scene.model.label)

    def see(self, theta: Tensor) -> Seen:
        """The same of theta (D,), each once."""
        key = theta.detach().cpu().numpy().tobytes()
        if key not in self._seen:
            self._seen[key] = self.look(self.picture(theta))
        return self._seen[key]

    def score(self, theta: Tensor) -> Score:
        """What the network makes of theta (D,): a failure where it was right before, and is not now."""
        seen = self.see(theta)
        failed = self.benign.right and not seen.right
        loss = float(aim(seen.scores, seen.label, self.aimed))
        return Score(loss, lost=int(failed), phantoms=0, success=failed, success_paper=failed)

    def problem(self) -> Problem:
        """This objective as attacks see it."""
        return Problem(
            loss_and_grad=self.loss_and_grad,
            project=self.space.project,
            score=self.score,
            step=self.space.step,
            lower=self.space.lower,
            upper=self.space.upper,
            groups=tuple(
                ParameterGroup(str(p), where, self.space.owner_count(p)) for p, where in self.space.blocks.items()
            ),
        )
