"""Generate the pages of the documentation site that are not in docs/: README, model cards, commands, API.

    mkdocs build --strict -f tools/site/mkdocs.yml

Links between files of the repository become links between pages. A link to a file that has no page becomes its name.
"""

from __future__ import annotations

import contextlib
import io
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from drivesem.cli import TOPICS
from drivesem.config.commands import COMMANDS
from drivesem.config.parsing import print_help

ROOT = Path(__file__).resolve().parents[2]
PAGES_OUTSIDE_DOCS = {
    "index.md": "README.md",
    "conventions.md": "scene_ir/conventions.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
}
"""Pages with the text of a file outside docs/."""
CARDS = ("detectors/weights", "scene_ir/derender/weights")
API = {
    "drivesem": ("drivesem.scenes.scene", "drivesem.run.counterexample", "drivesem.run.finished"),
    "detectors": ("detectors.base", "detectors.registry", "detectors.planted"),
    "scene_ir": ("scene_ir.types", "scene_ir.geometry", "scene_ir.files"),
}
"""Modules of the API reference, by package."""
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]*)(#[^)]*)?\)")


def page_sources() -> dict[str, str]:
    """Source file of each page outside docs/, by the page's path in the site."""
    cards = (card for folder in CARDS for card in sorted((ROOT / folder).glob("*.md")))
    return PAGES_OUTSIDE_DOCS | {f"cards/{card.stem}.md": card.relative_to(ROOT).as_posix() for card in cards}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are not in docs/."""
    for place, source in page_sources().items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, place, content=relink(text, source, place)))
    for place, text in (
        ("cards.md", "".join(iterate_cards())),
        ("reference/commands.md", "".join(iterate_commands())),
        ("reference/api.md", "".join(iterate_api())),
    ):
        files.append(File.generated(config, place, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite links of pages in docs/ to files outside it."""
    place = page.file.src_uri
    return markdown if page.file.generated_by else relink(markdown, f"docs/{place}", place)


def relink(markdown: str, source: str, place: str) -> str:
    """Rewrite links of a repository file for the site.

    Args:
        markdown: Text of the file.
        source: Its path in the repository.
        place: Path of its page in the site.
    """
    pages = {file: page for page, file in page_sources().items()} | {"detectors/weights": "cards.md"}

    def link(match: re.Match[str]) -> str:
        picture, text, target, anchor = match[1], match[2], match[3], match[4] or ""
        if not target or "://" in target:
            return match[0]
        file = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        page = file.removeprefix("docs/") if file.startswith("docs/") else pages.get(file)
        if page is None:
            return f"{text} (`{file}`)"
        return f"{picture}[{text}]({posixpath.relpath(page, posixpath.dirname(place) or '.')}{anchor})"

    return _LINK.sub(link, markdown)


def iterate_cards() -> Iterator[str]:
    """Yield an index of the model cards."""
    yield "# Model cards\n\nEach bundled network: origin of its weights, and measurements.\n\n"
    for place, source in page_sources().items():
        if place.startswith("cards/"):
            title = (ROOT / source).read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
            yield f"- [{title}]({place})\n"


def iterate_commands() -> Iterator[str]:
    """Yield the options of every command, by topic."""
    yield "# Commands\n\nAll options, as `drivesem COMMAND --help-all` prints them.\n"
    for topic, names in TOPICS.items():
        yield f"\n## {topic}\n"
        for name in names:
            yield f"\n### {name}\n\n```text\n{format_options(name)}\n```\n"


def format_options(command: str) -> str:
    """Every option of a command, as its help prints them to a file: without a box."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        print_help(f"drivesem {command}", COMMANDS[command], every_option=True)
    return printed.getvalue().strip()


def iterate_api() -> Iterator[str]:
    """Yield the public API from its docstrings."""
    yield "# Signatures\n\nThe public API, generated from docstrings.\n\n"
    for modules in API.values():
        for module in modules:
            yield f"::: {module}\n\n"
