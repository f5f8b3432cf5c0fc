"""Errors for rejected input. Each message is one line: the field, what was expected, what was found.

All but `WriteError` are `ValueError`s.
"""

from __future__ import annotations

_MAX_CHARS = 500
"""Length limit of each part of a message."""


def make_printable(text: object, max_chars: int = _MAX_CHARS) -> str:
    """`text` for a message: control characters escaped, the middle of more than `max_chars` characters cut out."""
    message = str(text)
    if len(message) > max_chars:
        message = f"{message[: max_chars // 2]} ... {message[-(max_chars // 4) :]} ({len(message):,} characters)"
    if message.isprintable():
        return message
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in message)


class SceneError(ValueError):
    """Base class of the errors about rejected input."""

    def __init__(self, field: str, expected: str, actual: object) -> None:
        self.field = field
        self.expected = expected
        self.actual = actual
        super().__init__(
            f"{make_printable(field)}: expected {make_printable(expected)}, found {make_printable(actual)}"
        )

    def __reduce__(self) -> tuple[type[SceneError], tuple[str, str, str]]:
        """Pickle with `actual` as text, because the value itself may not be picklable."""
        return type(self), (self.field, self.expected, str(self.actual))


class WriteError(OSError):
    """A file cannot be written, for example because the disk is full. Not a SceneError: no input is to blame."""

    def __init__(self, path: str, reason: str) -> None:
        self.path = path
        self.reason = reason
        super().__init__(f"{path}: expected a place that can be written, found {reason}")

    def __reduce__(self) -> tuple[type[WriteError], tuple[str, str]]:
        """Pickle by the constructor's arguments."""
        return type(self), (self.path, self.reason)


class ShapeError(SceneError):
    """A tensor or array has the wrong shape or dtype."""


class RangeError(SceneError):
    """A value is out of range or not finite."""


class FormatError(SceneError):
    """A file does not follow its format. `field` names the file, and the line or key if there is one."""
