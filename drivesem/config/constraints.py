"""What a setting may be, said beside its type, as in `Annotated[int, at_least(1)]`.

Each marker raises UsageError for a value that is not so. `blocks.Options.check` asks all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivesem.config.errors import refuse


@dataclass(frozen=True)
class NumberRange:
    """A number from `low` to `high`. ends: "[" and "]" where an end belongs to it, "(" and ")" where it does not;
    expected: what an error says, where the interval itself is not plain enough.
    """

    low: float
    high: float = math.inf
    ends: str = "[]"
    expected: str = ""

    def check(self, setting: str, value: Any) -> None:
        above = value >= self.low if self.ends[0] == "[" else value > self.low
        below = value <= self.high if self.ends[1] == "]" else value < self.high
        interval = f"a number in {self.ends[0]}{self.low}, {self.high}{self.ends[1]}"
        refuse(not (above and below), setting, self.expected or interval, value)


def at_least(low: int, why: str = "") -> NumberRange:
    """A number that is not below `low`. why: what an error adds."""
    return NumberRange(low, expected=f"at least {low}{why and f', {why}'}")


POSITIVE = NumberRange(0, ends="(]", expected="a number above 0")


@dataclass(frozen=True)
class OneOf:
    """One of some names."""

    names: tuple[str, ...]

    def check(self, setting: str, value: Any) -> None:
        refuse(value not in self.names, setting, f"one of {', '.join(self.names)}", repr(value))


@dataclass(frozen=True)
class ExistingFolder:
    """A folder that is there. expected: what an error says."""

    expected: str = "a folder"

    def check(self, setting: str, value: Any) -> None:
        refuse(not Path(value).is_dir(), setting, self.expected, value)


@dataclass(frozen=True)
class Parsed:
    """A text that `parse`, one of `settings.values`, understands. parse: takes the setting's name and the text."""

    parse: Callable[[str, str], object]

    def check(self, setting: str, value: Any) -> None:
        self.parse(setting, value)


@dataclass(frozen=True)
class Required:
    """A setting that has no default. setting: what an error calls it, where it is a word without an option."""

    expected: str
    setting: str | None = None

    def check(self, setting: str, value: Any) -> None:
        refuse(not value, self.setting or setting, self.expected, "nothing")


@dataclass(frozen=True)
class ForMethods:
    """A setting that only some values of --method have: with others it keeps its default."""

    methods: tuple[str, ...]

    def check(self, setting: str, method: str) -> None:
        refuse(method not in self.methods, setting, f"--method {', '.join(self.methods)} beside it", method)


@dataclass(frozen=True)
class AllowsUrl:
    """A text that may be a URL; others name what is on this machine."""

    def check(self, setting: str, value: Any) -> None:
        """Any will do."""


Constraint = NumberRange | OneOf | ExistingFolder | Parsed | Required | ForMethods | AllowsUrl
