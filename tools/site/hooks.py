"""Pages of the documentation's site whose text stands elsewhere: the README, model cards, what the parser knows.

    mkdocs build --strict -f tools/site/mkdocs.yml

Links between files of the repository become links between pages; what is no page is named without a link.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from drivesem.config.commands import COMMANDS
from drivesem.config.help import TOPICS, command_help

ROOT = Path(__file__).resolve().parents[2]
WRITTEN = {
    "index.md": "README.md",
    "conventions.md": "scene_ir/conventions.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
}
"""Pages whose text is a file beside docs/."""
CARDS = ("detectors/weights", "scene_ir/derender/weights")
API = {
    "drivesem": ("drivesem.scenes.scene", "drivesem.run.counterexample", "drivesem.run.finished"),
    "detectors": ("detectors.base", "detectors.registry", "detectors.planted"),
    "scene_ir": ("scene_ir.types", "scene_ir.geometry", "scene_ir.files"),
}
"""Modules of the reference, by package: what others build on."""
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]*)(#[^)]*)?\)")


def sources() -> dict[str, str]:
    """Where each page's text stands, by its place in the site; both relative, to docs/ and to the repository."""
    cards = (card for folder in CARDS for card in sorted((ROOT / folder).glob("*.md")))
    return WRITTEN | {f"cards/{card.stem}.md": card.relative_to(ROOT).as_posix() for card in cards}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that docs/ does not hold."""
    for place, source in sources().items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, place, content=relinked(text, source, place)))
    for place, text in (
        ("cards.md", "".join(cards_page())),
        ("reference/commands.md", "".join(commands_page())),
        ("reference/python.md", "".join(api_page())),
    ):
        files.append(File.generated(config, place, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links of docs/ that lead out of it."""
    place = page.file.src_uri
    return markdown if page.file.generated_by else relinked(markdown, f"docs/{place}", place)


def relinked(markdown: str, source: str, place: str) -> str:
    """Links of a file of the repository as links from a page. source: the file, place: the page."""
    pages = {file: page for page, file in sources().items()} | {"detectors/weights": "cards.md"}

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


def cards_page() -> Iterator[str]:
    """What ships with weights, a line each."""
    yield "# Model cards\n\nEach network that ships: where its weights come from, and what was measured.\n\n"
    for place, source in sources().items():
        if place.startswith("cards/"):
            title = (ROOT / source).read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
            yield f"- [{title}]({place})\n"


def commands_page() -> Iterator[str]:
    """What `drivesem COMMAND --help` says of every command, by topic."""
    yield "# Every option\n\nWhat `drivesem COMMAND --help` says.\n"
    for topic, names in TOPICS.items():
        yield f"\n## {topic}\n"
        for name in names:
            if name in COMMANDS:
                yield f"\n### {name}\n\n```text\n{command_help(name)}```\n"


def api_page() -> Iterator[str]:
    """The public names of what others build on, by their docstrings."""
    yield "# The Python API\n\nShapes, units and errors as the docstrings tell them.\n\n"
    for modules in API.values():
        for module in modules:
            yield f"::: {module}\n\n"
