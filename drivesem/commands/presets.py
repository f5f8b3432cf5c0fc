"""`drivesem presets`: the presets that `--config NAME` takes."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from drivesem.report.answer import print_json
from drivesem.settings.commands import Presets
from drivesem.settings.parsing import commands_of
from drivesem.settings.presets import presets, remark


def run(config: Presets) -> int:
    """List; exit code 0. Raises UsageError for a preset that cannot be read."""
    rows = [(name, commands_of(str(path)), remark(path), str(path)) for name, path in presets().items()]
    if config.json:
        names = ("name", "commands", "about", "file")
        print_json({"presets": [dict(zip(names, row, strict=True)) for row in rows]})
        return 0
    table = Table(title="presets: drivesem COMMAND --config NAME", title_justify="left")
    for column in ("name", "for", "about"):
        table.add_column(column)
    for name, commands, about, _ in rows:
        table.add_row(name, ", ".join(commands), about)
    Console().print(table)
    return 0
