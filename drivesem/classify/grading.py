"""How sure is it that a changed picture is misclassified? Draws of what a camera does, as for detectors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.classify.objective import Seen
from drivesem.failures.certificate import CertificateRule, SampleVerdict, count_samples
from drivesem.failures.grades import AGREEMENT_RULE, Certificate, SecondOpinion
from drivesem.failures.nuisances import Nuisances


@dataclass(frozen=True, slots=True)
class PictureGrader:
    """nuisances: what a draw changes; rule: in how many draws a failure must hold; seed: of the draws."""

    nuisances: Nuisances
    rule: CertificateRule
    seed: int

    @torch.no_grad()
    def count(self, identifier: str, look: Callable[[Tensor], Seen], before: Tensor, after: Tensor) -> Certificate:
        """Draws of the picture before the change that are right, and of the one after it (3, H, W) that are wrong,
        until no more can change whether the failure is certain: first after the change, then before it.
        """
        stream, hw = f"certificate:{identifier}:{self.seed}", (int(before.shape[1]), int(before.shape[2]))

        def seen(changed: bool, number: int, asked: Sequence[int]) -> list[SampleVerdict]:
            draw = self.nuisances.sample_for_image(stream, number, hw)
            told = look(draw.degrade_image(after if changed else before))
            return [(told.right != changed, told.margin)]

        return count_samples(1, seen, self.rule)[0]

    @torch.no_grad()
    def agreement(
        self, identifier: str, look: Callable[[Tensor], Seen], by: str, before: Tensor, after: Tensor
    ) -> SecondOpinion:
        """What draws of a second renderer's pictures (3, H, W), before the change and after it, say."""
        stream, hw = f"confirm:{identifier}:{self.seed}", (int(before.shape[1]), int(before.shape[2]))
        draws = [self.nuisances.sample_for_image(stream, number, hw) for number in range(AGREEMENT_RULE[1])]
        right, wrong = ([look(draw.degrade_image(p)).right for draw in draws] for p in (before, after))
        return SecondOpinion(by, sum(right), wrong.count(False), len(draws))
