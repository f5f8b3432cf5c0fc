"""Runs the notebooks of the documentation, and keeps in them what they showed.

    python -m tools.site.notebooks            # writes docs/notebooks anew
    python -m tools.site.notebooks --check    # only runs them; exit code 1 where one fails

Each runs in an empty folder. Pictures are stored as JPEG: a photograph as PNG weighs ten times as much.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from PIL import Image

from drivesem.reporting.tables import format_count
from scene_ir import files

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = ROOT / "docs" / "notebooks"
_PNG, _JPEG, _QUALITY = "image/png", "image/jpeg", 85


def executed(path: Path) -> Any:
    """The notebook after a run in an empty folder. CellExecutionError where a cell fails."""
    notebook = nbformat.read(path, as_version=4)
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"PYTHONPATH": paths}
        NotebookClient(notebook, timeout=600, resources={"metadata": {"path": folder}}).execute(env=environment)
    for cell in notebook.cells:
        cell.metadata.clear()  # when it ran
        for output in cell.get("outputs", []):
            _lighter(output)
    return notebook


def _lighter(output: Any) -> None:
    data = output.get("data", {})
    if _PNG in data:
        picture = Image.open(io.BytesIO(base64.b64decode(data.pop(_PNG)))).convert("RGB")
        written = io.BytesIO()
        picture.save(written, "JPEG", quality=_QUALITY)
        data[_JPEG] = base64.b64encode(written.getvalue()).decode()


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns the exit code: 0, or 1 where a notebook fails."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--check", action="store_true", help="only run them")
    words = parser.parse_args(argv)
    failed = 0
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        try:
            notebook = executed(path)
        except CellExecutionError as error:
            print(f"{path.name}: {str(error).strip().splitlines()[-1]}", file=sys.stderr)
            failed = 1
            continue
        if not words.check:
            files.write_text(path, nbformat.writes(notebook) + "\n")
        print(f"{path.name}: {format_count(len(notebook.cells), 'cell')}", file=sys.stderr)
    return failed


if __name__ == "__main__":
    sys.exit(main())
