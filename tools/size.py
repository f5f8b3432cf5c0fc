"""Measure how large the project is: lines of code, classes, files, words of documentation, commands and options.

    python -m tools.size [REVISION]

Counts the working tree, or a git revision (except commands and options, which need the code that runs). A line of
code is one that holds a token other than a comment or a docstring.
"""

from __future__ import annotations

import ast
import io
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PARTS = {"product": ("scene_ir", "detectors", "drivesem"), "tests": ("tests",), "tools": ("tools",)}
SKIPPED = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)


def read_files(revision: str | None) -> Iterator[tuple[str, str]]:
    """Path and text of every tracked Python and Markdown file, of a revision or of the working tree."""
    command = ["git", "ls-tree", "-r", "--name-only", revision] if revision else ["git", "ls-files"]
    for name in subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines():
        if not name.endswith((".py", ".md")):
            continue
        if revision:
            content = subprocess.run(
                ["git", "show", f"{revision}:{name}"], cwd=ROOT, capture_output=True, check=True
            )
            yield name, content.stdout.decode()
        elif (ROOT / name).is_file():
            yield name, (ROOT / name).read_text(encoding="utf-8")


def count_code_lines(source: str) -> int:
    """Lines of a Python source that hold code."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant(value=str()), lineno=first, end_lineno=int(last)):
                docstrings.update(range(first, last + 1))
            case _:
                pass
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in SKIPPED:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - docstrings)


def main() -> int:
    """Print the counts. -> exit code 0."""
    revision = sys.argv[1] if len(sys.argv) > 1 else None
    lines, files, words, classes = Counter[str](), Counter[str](), 0, list[str]()
    for name, text in read_files(revision):
        if name.endswith(".md"):
            words += len(text.split()) if name.startswith("docs/") else 0
            continue
        part = next((part for part, folders in PARTS.items() if name.split("/")[0] in folders), None)
        if part is None:
            continue
        lines[part] += count_code_lines(text)
        files[part] += 1
        if part == "product":
            classes += [node.name for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ClassDef)]
    for part in PARTS:
        print(f"{part}: {lines[part]:,} lines of code in {files[part]} files")
    print(f"classes of the product: {len(classes)}, {len(classes) - len(set(classes))} names repeated")
    print(f"words of docs: {words:,}")
    if revision is None:
        from drivesem.config.commands import COMMANDS

        options = len(COMMANDS["attack"].basic) + 1  # --config
        print(f"commands: {len(COMMANDS)}; options in attack --help: {options}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
