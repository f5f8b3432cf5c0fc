"""`python -m drivesem`: the command, where its script is not on the path."""

from __future__ import annotations

import sys

from drivesem.cli import main

if __name__ == "__main__":  # workers load this file too, by another name
    sys.exit(main())
