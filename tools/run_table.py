"""Tables that tools print about runs."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Sequence

from drivesem.config.errors import UsageError
from drivesem.reporting.tables import ReportTable
from scene_ir.errors import FormatError


def print_table(
    parser: ArgumentParser, title: str, columns: tuple[str, ...], build: Callable[[], Sequence[tuple[str, ...]]]
) -> None:
    """Print a Markdown table, or what is wrong with the runs that it is built from, with exit code 2.

    Args:
        parser: Of the tool.
        title: Heading.
        columns: Names of the columns, of which the first is text.
        build: Makes the rows. Raises UsageError or FormatError.
    """
    try:
        rows = build()
    except (UsageError, FormatError) as error:
        parser.exit(2, f"{error}\n")
    print("\n".join(ReportTable(title, columns, tuple(rows)).to_markdown(columns[:1])))
