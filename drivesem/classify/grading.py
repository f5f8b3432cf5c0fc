"""How sure is it that a changed picture is misclassified? Draws of what a camera does, as for detectors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.classify.objective import Seen
from drivesem.failures.certificate import Drawn, Rule, count_draws
from drivesem.failures.grades import SECOND, Agreement, Count
from drivesem.failures.nuisances import Nuisances


@dataclass(frozen=True, slots=True)
class PictureGrader:
    """nuisances: what a draw changes; rule: in how many draws a failure must hold; seed: of the draws."""

    nuisances: Nuisances
    rule: Rule
    seed: int

    @torch.no_grad()
    def count(self, identifier: str, look: Callable[[Tensor], Seen], before: Tensor, after: Tensor) -> Count:
        """Draws of the picture before the change that are right, and of the one after it (3, H, W) that are wrong,
        until no more can change whether the failure is certain: first after the change, then before it.
        """
        stream, hw = f"certificate:{identifier}:{self.seed}", (int(before.shape[1]), int(before.shape[2]))

        def seen(changed: bool, number: int, asked: Sequence[int]) -> list[Drawn]:
            draw = self.nuisances.of_picture(stream, number, hw)
            told = look(draw.picture(after if changed else before))
            return [(told.right != changed, told.margin)]

        return count_draws(1, seen, self.rule)[0]

    @torch.no_grad()
    def agreement(
        self, identifier: str, look: Callable[[Tensor], Seen], by: str, before: Tensor, after: Tensor
    ) -> Agreement:
        """What draws of a second renderer's pictures (3, H, W), before the change and after it, say."""
        stream, hw = f"confirm:{identifier}:{self.seed}", (int(before.shape[1]), int(before.shape[2]))
        draws = [self.nuisances.of_picture(stream, number, hw) for number in range(SECOND[1])]
        right, wrong = ([look(draw.picture(p)).right for draw in draws] for p in (before, after))
        return Agreement(by, sum(right), wrong.count(False), len(draws))
