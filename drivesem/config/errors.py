"""What is wrong with a setting, in one line."""

from __future__ import annotations

import re

from scene_ir.errors import make_printable

_TOLD = re.compile(r"(?:(.+?): )?expected (.+?), found (.+)", re.DOTALL)
"""How errors of `detectors` tell what is wrong: where, expected, found."""
_ITSELF = (None, "detector")
"""Where such an error is about what was named, not a file or a part of it."""


class UsageError(ValueError):
    """A setting that cannot be. The message is one line: setting, expected, found."""

    def __init__(self, field: str, expected: str, actual: object) -> None:
        self.field = field
        self.expected = expected
        self.actual = str(actual)
        super().__init__(
            f"{make_printable(field)}: expected {make_printable(expected)}, found {make_printable(actual)}"
        )

    @classmethod
    def of(cls, field: str, expected: str, error: Exception) -> UsageError:
        """A setting that names a detector that cannot be had, with one expected and one found: those of `error`,
        which says why. expected: what the setting takes.
        """
        told = _TOLD.fullmatch(str(error))
        if told is None:
            return cls(field, expected, error)
        where, wanted, found = told.groups()
        if where in _ITSELF:
            return cls(field, f"{expected} ({wanted})", found)
        return cls(f"{field}: {where}", wanted, found)

    def __reduce__(self) -> tuple[type[UsageError], tuple[str, str, str]]:
        """As processes hand errors to one another."""
        return type(self), (self.field, self.expected, self.actual)


def refuse(wrong: bool, setting: str, expected: str, found: object) -> None:
    """Raise UsageError where something is wrong."""
    if wrong:
        raise UsageError(setting, expected, found)
