"""`drivesem presets`: the presets that `--config NAME` takes."""

from __future__ import annotations

from rich.table import Table

from drivesem.config.commands import PresetsConfig
from drivesem.config.parsing import commands_of
from drivesem.config.presets import presets, remark
from drivesem.report.tables import print_json
from drivesem.report.terminal import Console


def run(config: PresetsConfig) -> int:
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
