"""`drivesem doctor`: what is installed and works, what each missing part would give, and how to get it."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from drivesem.config.commands import DoctorConfig
from drivesem.doctor import PARTS, about, examine
from drivesem.report.tables import print_json
from drivesem.report.terminal import Console, progress_bar

_LOOKS = {"works": "green", "missing": "yellow", "broken": "red"}


def doctor_command(config: DoctorConfig) -> int:
    """Try all parts; exit code 0, or 1 where one does not work without which nothing does."""
    errors = Console(stderr=True)
    with progress_bar(errors, keep=False, show_elapsed=False, hidden=not errors.is_terminal) as bar:
        task = bar.add_task("trying parts", total=len(PARTS))
        found = examine(PARTS, lambda: bar.advance(task))
    fit = all(one.status == "works" for one in found if one.part.needed)
    if config.json:
        print_json({**about(), "fit": fit, "parts": [one.to_json() for one in found]})
        return 0 if fit else 1
    console = Console()
    for name, text in about().items():
        console.print(f"{name}: {text}", soft_wrap=True, highlight=False)
    table = Table(title="parts", title_justify="left")
    for column in ("part", "state", "version", "gives"):
        table.add_column(column)
    for one in found:
        version = one.told if one.status == "works" else ""
        table.add_row(one.part.name, Text(one.status, style=_LOOKS[one.status]), version, one.part.gives)
    console.print(table)
    for one in found:
        if one.status != "works":
            console.print(f"{one.part.name}: {one.part.bring}", soft_wrap=True, highlight=False)
            if one.status == "broken":
                console.print(f"    {one.told}", soft_wrap=True, highlight=False)
    console.print("all that is needed works" if fit else "drivesem cannot work here", soft_wrap=True)
    return 0 if fit else 1
