"""What a page may do: its content security policy names the one script that runs, by its hash."""

from __future__ import annotations

import base64
import hashlib


def script_hash(script: str) -> str:
    """A script's source expression for `script-src`, of the text between the tags."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode('ascii')}"
