"""Hashes of the tested releases: `constraints.lock`, of the reports that pip makes.

    python -m pip install --dry-run --ignore-installed --no-deps --report report.json -r constraints.txt
    python -m tools.lock report.json                       # writes constraints.lock
    python -m tools.lock report.json --check               # exit code 1 where it is another

`constraints.txt` holds no hashes itself: pip then refuses packages without one, an editable project among it. Each
hash is of the file that pip chose for the interpreter and the machine that it ran on.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from scene_ir import files
from scene_ir.errors import FormatError

ROOT = Path(__file__).parents[1]
CONSTRAINTS, LOCK = ROOT / "constraints.txt", ROOT / "constraints.lock"
_HEAD = (
    "# constraints.txt with hashes (python -m tools.lock), CPython 3.11, Linux: docs/reference/reliability.md\n"
)


def read_pins(path: Path) -> dict[str, str]:
    """Lines NAME==VERSION of a constraints file, by the names that registries have. FormatError for others."""
    found = {}
    for number, line in enumerate(files.read_text(path).splitlines(), start=1):
        match = re.fullmatch(r"([A-Za-z0-9._-]+)==(\S+)", line.strip())
        if match is None:
            raise FormatError(f"{path}:{number}", "NAME==VERSION", repr(line))
        found[normalise_name(match[1])] = match[0]
    return found


def normalise_name(name: str) -> str:
    """A package's name as registries have it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def hashes(reports: Sequence[Path]) -> dict[str, str]:
    """SHA-256 by NAME==VERSION (plain names) of pip's reports; a later one wins. FormatError."""
    found = {}
    for path in reports:
        try:
            for one in files.read_json(path)["install"]:
                metadata = one["metadata"]
                release = f"{normalise_name(metadata['name'])}=={metadata['version']}"
                found[release] = one["download_info"]["archive_info"]["hashes"]["sha256"]
        except (KeyError, TypeError) as error:
            raise FormatError(str(path), "a report of pip install --report", repr(error)) from error
    return found


def lock(constraints: Mapping[str, str], known: Mapping[str, str]) -> str:
    """The lock file's text. FormatError for a release without a hash."""
    lines = []
    for name, requirement in constraints.items():
        release = f"{name}=={requirement.partition('==')[2]}"
        if release not in known:
            raise FormatError(f"report: {requirement}", "a hash", "none")
        lines.append(f"{requirement} --hash=sha256:{known[release]}\n")
    return _HEAD + "".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reports", nargs="+", type=Path, help="of pip install --report")
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    given = parser.parse_args(argv)
    text = lock(read_pins(CONSTRAINTS), hashes(given.reports))
    if not given.check:
        files.write_text(LOCK, text)
    elif files.read_text(LOCK) != text:
        print(f"{LOCK.name} is another")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
