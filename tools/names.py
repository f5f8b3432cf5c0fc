"""Lint names and prose: unique class names, no retired words.

    python -m tools.names [PATH ...]

Checks Python files (identifiers, docstrings, comments, strings), Markdown and HTML pages. Without paths, checks the
whole repository. Prints one line per finding and exits with 1 if there is one. `docs/glossary.md` has the project's
terms.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CODE = ("scene_ir", "detectors", "drivesem", "tools", "tests")
PROSE = ("docs", "README.md", "CONTRIBUTING.md", "scene_ir", "detectors", "drivesem")
RETIRED_IN_NAMES = frozenset(
    (
        "ask",
        "asked",
        "asking",
        "asks",
        "beside",
        "figures",
        "kept",
        "look",
        "looked",
        "looking",
        "looks",
        "said",
        "say",
        "saying",
        "says",
        "shown",
        "tell",
        "telling",
        "tells",
        "thing",
        "things",
        "told",
        "ways",
        "whatever",
        "whose",
    )
)
"""Parts of identifiers, lower case, between underscores or capitals."""
LIBRARY_NAMES = frozenset({("gradient_free.py", "ask"), ("gradient_free.py", "tell")})
"""Names of libraries, by file: pycma's."""
RETIRED_IN_TEXT = re.compile(
    r"\b(told|(?<!too few to )tells?|telling|says?|said|kept|beside|asked|asks?|whose|whatever|things?|taken apart"
    r"|looked at|looks? at|is all well|by law|at hand)\b",
    re.IGNORECASE,
)
"""Words and phrases of docstrings, comments, messages and pages; "too few to tell" is a verdict."""
PATHS = re.compile(r"`[^`\n]*`|```.*?```|https?://\S+|\]\([^)]*\)|<[^>\n]*>", re.DOTALL)
"""Parts of a page that are not prose: code, links and tags."""
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


@dataclass(frozen=True)
class Finding:
    """One retired word or repeated class name."""

    path: Path
    """File, relative to the repository's root."""
    line: int
    """Line number, from 1."""
    text: str
    """What is wrong."""

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.text}"


def iterate_files(paths: Iterable[str], suffixes: tuple[str, ...]) -> Iterator[Path]:
    """Tracked and new files below `paths` (relative to the root) with one of `suffixes`, except ignored ones."""
    command = ["git", "ls-files", "-co", "--exclude-standard", "--", *paths]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    yield from (ROOT / name for name in sorted(set(listed)) if name.endswith(suffixes) and (ROOT / name).is_file())


def find_in_code(path: Path) -> Iterator[Finding]:
    """Retired words in one Python file; prose in tests is not checked, since they quote what users type."""
    relative = path.relative_to(ROOT)
    check_prose = relative.parts[0] != "tests" and relative.name != "names.py"
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type == tokenize.NAME:
            retired = RETIRED_IN_NAMES.intersection(word.lower() for word in WORD.findall(token.string))
            if retired and (relative.name, token.string) not in LIBRARY_NAMES:
                yield Finding(
                    relative, token.start[0], f"name {token.string}: retired {', '.join(sorted(retired))}"
                )
        elif check_prose and token.type in (tokenize.STRING, tokenize.COMMENT):
            for match in RETIRED_IN_TEXT.finditer(token.string):
                line = token.start[0] + token.string.count("\n", 0, match.start())
                yield Finding(relative, line, f"text: retired {match[0]!r}")


def find_in_page(path: Path) -> Iterator[Finding]:
    """Retired words in one page, outside code and links."""
    text = PATHS.sub(lambda match: "\n" * match[0].count("\n"), path.read_text(encoding="utf-8"))
    for number, line in enumerate(text.splitlines(), 1):
        for match in RETIRED_IN_TEXT.finditer(line):
            yield Finding(path.relative_to(ROOT), number, f"text: retired {match[0]!r}")


def find_repeated_classes(paths: Iterable[Path]) -> Iterator[Finding]:
    """Classes of the product and tools with the name of another one."""
    places: dict[str, list[tuple[Path, int]]] = defaultdict(list)
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                places[node.name].append((path.relative_to(ROOT), node.lineno))
    for name, found in sorted(places.items()):
        for path, line in found[1:]:
            yield Finding(path, line, f"class {name}: also in {found[0][0]}:{found[0][1]}")


def find_all(paths: Sequence[str] = ()) -> list[Finding]:
    """Every finding below `paths`, or in the repository; class names are always compared across the repository."""
    findings = [found for path in iterate_files(paths or CODE, (".py",)) for found in find_in_code(path)]
    pages = iterate_files(paths or PROSE, (".md", ".html"))
    findings += [found for path in pages for found in find_in_page(path)]
    chosen = {path.relative_to(ROOT) for path in iterate_files(paths or CODE, (".py",))}
    repeated = find_repeated_classes(path for path in iterate_files(CODE, (".py",)) if "tests" not in path.parts)
    return findings + [found for found in repeated if found.path in chosen]


def main() -> int:
    """Print the findings. -> exit code 1 if there are any."""
    findings = find_all(sys.argv[1:])
    print("\n".join(map(str, findings)))
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
