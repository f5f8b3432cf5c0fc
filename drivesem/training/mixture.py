"""A training set of benign frames and counterexamples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from detectors.training import Drawn, Sample

Mix = Literal["replace", "add"]


@dataclass(frozen=True, slots=True)
class Shares:
    """fraction: share of the set that are counterexamples, in (0, 1); mix: in the place of benign frames drawn at
    random, or beside all of them; ramp_steps: over so many steps a counterexample shows with a chance that rises
    from 0 to 1, a benign frame otherwise; seed: of the draw.
    """

    fraction: float
    mix: Mix
    ramp_steps: int
    seed: int


class Mixture(Sequence[Sample]):
    """Benign frames and counterexamples; each counterexample is shown as often as the others, or once more.

    Raises ValueError where there is none of either.
    """

    def __init__(self, benign: Sequence[Sample], counterexamples: Sequence[Sample], shares: Shares) -> None:
        for name, frames in (("benign", benign), ("counterexamples", counterexamples)):
            if not len(frames):
                raise ValueError(f"{name}: expected at least one frame, found 0")
        self._benign, self._counterexamples, self._shares = benign, counterexamples, shares
        generator = np.random.default_rng([shares.seed, 5])
        count = len(benign)
        if shares.mix == "replace":
            wanted = min(max(round(shares.fraction * count), 1), count - 1) if count > 1 else 1
            self.places = generator.permutation(count)[wanted:]
        else:
            wanted = max(round(count * shares.fraction / (1 - shares.fraction)), 1)
            self.places = np.arange(count)
        rounds = -(-wanted // len(counterexamples))
        order = [generator.permutation(len(counterexamples)) for _ in range(rounds)]
        self.shown = np.concatenate(order)[:wanted]

    def __len__(self) -> int:
        return len(self.places) + len(self.shown)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        if index < len(self.places):
            return self._benign[int(self.places[index])]
        return self._counterexamples[int(self.shown[index - len(self.places)])]

    def draw(self, index: int, step: int, generator: np.random.Generator) -> Sample:
        """Entry `index`; while counterexamples come in, now and then any benign frame in its place.
        Counterexamples that are drawn look otherwise each time.
        """
        if index >= len(self.places) and generator.random() * self._shares.ramp_steps > step:
            return self._benign[int(generator.integers(len(self._benign)))]
        if index >= len(self.places) and isinstance(self._counterexamples, Drawn):
            return self._counterexamples.draw(int(self.shown[index - len(self.places)]), step, generator)
        return self[index]
