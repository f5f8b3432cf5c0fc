"""Errors raised at the borders of the scene representation.

All are `ValueError`s whose message is one line: what was looked at, what was expected, what was found.
"""

from __future__ import annotations


class SceneError(ValueError):
    """Base of the errors below; catch this one to catch every rejected input."""

    def __init__(self, field: str, expected: str, actual: object) -> None:
        self.field = field
        self.expected = expected
        self.actual = actual
        super().__init__(f"{field}: expected {expected}, found {actual}")

    def __reduce__(self) -> tuple[type[SceneError], tuple[str, str, str]]:
        """As processes hand errors to one another: `actual` as text, which always can be."""
        return type(self), (self.field, self.expected, str(self.actual))


class ShapeError(SceneError):
    """A tensor or array has the wrong shape or dtype."""


class RangeError(SceneError):
    """A value lies outside what it may be, or is not finite."""


class FormatError(SceneError):
    """A file does not follow its format. `field` names the file, and the line or key where there is one."""
