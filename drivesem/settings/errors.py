"""What is wrong with a setting, in one line."""

from __future__ import annotations

from scene_ir.errors import shown


class UsageError(ValueError):
    """A setting that cannot be. The message is one line: setting, expected, found."""

    def __init__(self, field: str, expected: str, actual: object) -> None:
        self.field = field
        self.expected = expected
        self.actual = str(actual)
        super().__init__(f"{shown(field)}: expected {shown(expected)}, found {shown(actual)}")

    def __reduce__(self) -> tuple[type[UsageError], tuple[str, str, str]]:
        """As processes hand errors to one another."""
        return type(self), (self.field, self.expected, self.actual)


def refuse(wrong: bool, setting: str, expected: str, found: object) -> None:
    """Raise UsageError where something is wrong."""
    if wrong:
        raise UsageError(setting, expected, found)
