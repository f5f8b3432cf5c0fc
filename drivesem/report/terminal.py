"""What commands say on a terminal."""

from __future__ import annotations

from typing import Any

import rich.console
from rich.text import Text

from scene_ir.errors import shown

_LONGEST = 100_000


class Console(rich.console.Console):
    """Rich's, for text that may come from any file: names in brackets are no markup, and what would steer the
    terminal is written out.
    """

    def __init__(self, **looks: Any) -> None:
        super().__init__(markup=False, **looks)

    def render_str(self, text: str, **looks: Any) -> Text:
        """Rich's, of what a terminal prints."""
        return super().render_str(shown(text, _LONGEST), **looks)
