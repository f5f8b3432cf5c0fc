"""Which values an option may take, declared in its type, as in `Annotated[int, at_least(1)]`.

Each constraint raises UsageError for other values; `options.Options.check` applies all of them. The parsers read
options that hold several values in one text: sizes, intervals, class maps.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivesem.config.errors import UsageError, refuse


@dataclass(frozen=True)
class NumberRange:
    """A number between two ends."""

    low: float
    """Lower end."""
    high: float = math.inf
    """Upper end."""
    ends: str = "[]"
    """"[" and "]" for an end that is included, "(" and ")" for one that is not."""
    expected: str = ""
    """The range in the words of an error; empty for the interval itself."""

    def check(self, option: str, value: Any) -> None:
        """Raise UsageError for a number outside the range."""
        above = value >= self.low if self.ends[0] == "[" else value > self.low
        below = value <= self.high if self.ends[1] == "]" else value < self.high
        interval = f"a number in {self.ends[0]}{self.low}, {self.high}{self.ends[1]}"
        refuse(not (above and below), option, self.expected or interval, value)


def at_least(low: int, reason: str = "") -> NumberRange:
    """A number that is not below `low`; `reason` is added to the error."""
    return NumberRange(low, expected=f"at least {low}{reason and f', {reason}'}")


POSITIVE = NumberRange(0, ends="(]", expected="a number above 0")


@dataclass(frozen=True)
class OneOf:
    """One of some names."""

    names: tuple[str, ...]
    """The names."""

    def check(self, option: str, value: Any) -> None:
        """Raise UsageError for another name."""
        refuse(value not in self.names, option, f"one of {', '.join(self.names)}", repr(value))


@dataclass(frozen=True)
class ExistingFolder:
    """A folder that exists."""

    expected: str = "a folder"
    """What the folder holds, in the words of an error."""

    def check(self, option: str, value: Any) -> None:
        """Raise UsageError for a path that is no folder."""
        refuse(not Path(value).is_dir(), option, self.expected, value)


@dataclass(frozen=True)
class ParsedBy:
    """A text in a format of its own."""

    parse: Callable[[str, str], object]
    """Reads the text: takes the option's name and the text, raises UsageError."""

    def check(self, option: str, value: Any) -> None:
        """Raise UsageError for a text that the parser does not understand."""
        self.parse(option, value)


@dataclass(frozen=True)
class Required:
    """A value that has to be given."""

    expected: str
    """What to give, in the words of an error."""
    name: str | None = None
    """The name in an error, for a positional argument."""

    def check(self, option: str, value: Any) -> None:
        """Raise UsageError for an empty value."""
        refuse(not value, self.name or option, self.expected, "nothing")


@dataclass(frozen=True)
class OnlyWith:
    """An option that applies only to some values of another field; with others it keeps its default."""

    field: str
    """The other field: an option such as `method`, or the positional argument `what`."""
    values: tuple[str, ...]
    """The values with which the option applies."""

    def check(self, option: str, value: Any) -> None:
        """Raise UsageError for another value of the other field."""
        prefix = "" if self.field == "what" else f"--{self.field} "
        refuse(value not in self.values, option, f"only with {prefix}{', '.join(self.values)}", f"{prefix}{value}")


@dataclass(frozen=True)
class AllowsUrl:
    """A path that may be a URL; all others are paths on this machine."""

    def check(self, option: str, value: Any) -> None:
        """Accept any value."""


Constraint = NumberRange | OneOf | ExistingFolder | ParsedBy | Required | OnlyWith | AllowsUrl


def parse_size_hw(option: str, text: str) -> tuple[int, int]:
    """Height and width of "WIDTHxHEIGHT". UsageError naming the option."""
    width, cross, height = text.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise UsageError(option, "WIDTHxHEIGHT, px", repr(text))
    return int(height), int(width)


def parse_interval(option: str, text: str) -> tuple[float, float]:
    """The positive numbers of "LOW,HIGH". UsageError naming the option."""
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low, high = math.nan, math.nan
    if not (0 < low <= high < math.inf):
        raise UsageError(option, "LOW,HIGH, both above 0", repr(text))
    return low, high


def parse_class_map(option: str, text: str | None) -> dict[str, str | None]:
    """The map of "car=Car,bus=-"; None for a class that is left out. UsageError naming the option."""
    pairs: dict[str, str | None] = {}
    for part in text.split(",") if text else ():
        name, sign, target = (word.strip() for word in part.partition("="))
        if not (name and sign and target):
            raise UsageError(option, "NAME=CLASS with commas", repr(part))
        pairs[name] = None if target == "-" else target
    return pairs


def parse_attributes(option: str, text: str | None) -> dict[str, tuple[str, ...]]:
    """The allowed values by attribute of "weather=rainy|foggy,timeofday=night". UsageError naming the option."""
    pairs: dict[str, tuple[str, ...]] = {}
    for part in text.split(",") if text else ():
        name, sign, values = (word.strip() for word in part.partition("="))
        if not (name and sign and values) or name in pairs:
            raise UsageError(option, "NAME=VALUE with commas, each name once", repr(part))
        pairs[name] = tuple(value.strip() for value in values.split("|"))
    return pairs


def parse_integers(option: str, text: str, minimum: int = 1) -> list[int]:
    """The whole numbers of "1,4,8", each once, in order.

    Args:
        option: The option, for errors.
        text: Its value.
        minimum: The smallest allowed number.

    Raises:
        UsageError: For any other text.
    """
    try:
        numbers = sorted({int(part) for part in text.split(",")})
    except ValueError:
        numbers = []
    if not numbers or numbers[0] < minimum:
        raise UsageError(option, f"numbers of at least {minimum}, with commas", repr(text))
    return numbers


def parse_part(option: str, text: str) -> tuple[int, int]:
    """K and N of "K/N", the K-th of N parts. UsageError naming the option."""
    number, slash, count = text.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise UsageError(option, "K/N, the K-th of N parts, such as 2/4", repr(text))
    return int(number), int(count)


def is_url(text: str) -> bool:
    """Whether a text is a URL, such as s3://BUCKET/FOLDER, and not a path on this machine."""
    return re.match(r"[a-z][a-z0-9+.-]*(://|::)", text) is not None
