"""Settings that hold several values in one word: numbers, sizes, class maps."""

from __future__ import annotations

import math
import re

from drivesem.config.errors import UsageError


def size_hw(setting: str, text: str) -> tuple[int, int]:
    """Height and width of "WIDTHxHEIGHT". Raises UsageError naming the setting."""
    width, cross, height = text.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise UsageError(setting, "WIDTHxHEIGHT, px", repr(text))
    return int(height), int(width)


def interval(setting: str, text: str) -> tuple[float, float]:
    """The positive numbers of "LOW,HIGH". Raises UsageError naming the setting."""
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low, high = math.nan, math.nan
    if not (0 < low <= high < math.inf):
        raise UsageError(setting, "LOW,HIGH, both above 0", repr(text))
    return low, high


def class_map(setting: str, text: str | None) -> dict[str, str | None]:
    """The names of "car=Car,bus=-", None where a class is left out. Raises UsageError naming the setting."""
    pairs: dict[str, str | None] = {}
    for part in text.split(",") if text else ():
        name, sign, to = (word.strip() for word in part.partition("="))
        if not (name and sign and to):
            raise UsageError(setting, "NAME=CLASS with commas", repr(part))
        pairs[name] = None if to == "-" else to
    return pairs


def numbers(setting: str, text: str, least: int = 1) -> list[int]:
    """The whole numbers of "1,4,8", each once, in order. Raises UsageError naming the setting."""
    try:
        found = sorted({int(part) for part in text.split(",")})
    except ValueError:
        found = []
    if not found or found[0] < least:
        raise UsageError(setting, f"numbers of at least {least}, with commas", repr(text))
    return found


def part_of(setting: str, text: str) -> tuple[int, int]:
    """K and N of "K/N", the K-th of N parts. Raises UsageError naming the setting."""
    number, slash, count = text.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise UsageError(setting, "K/N, the K-th of N parts, such as 2/4", repr(text))
    return int(number), int(count)


def is_url(text: str) -> bool:
    """Whether a text names something by a URL, such as s3://BUCKET/FOLDER, and not a path of this machine."""
    return re.match(r"[a-z][a-z0-9+.-]*(://|::)", text) is not None
