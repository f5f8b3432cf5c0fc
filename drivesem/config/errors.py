"""Errors about what the user typed, each in one line."""

from __future__ import annotations

import re

from scene_ir.errors import make_printable

_DETECTOR_ERROR = re.compile(r"(?:(.+?): )?expected (.+?), found (.+)", re.DOTALL)
"""The form of errors of `detectors`: field, expected, found."""
_OPTION = re.compile(r"--([a-z][a-z-]*)")
_WHOLE_DETECTOR = (None, "detector")
"""Fields of such errors about the detector itself, not a file or a part of it."""


class CommandLineError(ValueError):
    """A command line that the parser does not understand, in its words."""


class UsageError(ValueError):
    """A bad value of an option, in one line: option, expected, found."""

    def __init__(self, field: str, expected: str, actual: object) -> None:
        self.field = field
        self.expected = expected
        self.actual = str(actual)
        super().__init__(
            f"{make_printable(field)}: expected {make_printable(expected)}, found {make_printable(actual)}"
        )

    @classmethod
    def from_detector_error(cls, field: str, expected: str, error: Exception) -> UsageError:
        """An option that names a detector which cannot be loaded.

        Args:
            field: The option.
            expected: What the option takes.
            error: The reason, with its own `expected` and `found`.
        """
        match = _DETECTOR_ERROR.fullmatch(str(error))
        if match is None:
            return cls(field, expected, error)
        where, wanted, actual = match.groups()
        if where in _WHOLE_DETECTOR:
            return cls(field, f"{expected} ({wanted})", actual)
        return cls(f"{field}: {where}", wanted, actual)

    def with_arguments(self) -> UsageError:
        """The same error with options as Python's arguments: `--t-star` becomes t_star."""
        field, expected = (
            _OPTION.sub(lambda flag: flag[1].replace("-", "_"), t) for t in (self.field, self.expected)
        )
        return UsageError(field, expected, self.actual)

    def __reduce__(self) -> tuple[type[UsageError], tuple[str, str, str]]:
        """Pickle the parts, for errors that cross processes."""
        return type(self), (self.field, self.expected, self.actual)


def refuse(wrong: bool, option: str, expected: str, actual: object) -> None:
    """Raise UsageError if `wrong`.

    Args:
        wrong: Whether the value is wrong.
        option: The option, as it is typed.
        expected: What it takes.
        actual: What was given.
    """
    if wrong:
        raise UsageError(option, expected, actual)
