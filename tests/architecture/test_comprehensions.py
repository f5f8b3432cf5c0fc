"""Comprehensions that Python 3.12.1 and 3.13.0 compile wrongly, with an UnboundLocalError.

They inline comprehensions into the function around them, and fail for a name that is the variable of one comprehension
and that another one takes from outside the function.
"""

import symtable
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_INLINED = ("listcomp", "setcomp", "dictcomp")


def iterate_mistakes(table: symtable.SymbolTable) -> Iterator[str]:
    """Yield each such name, with its line."""
    inner = [child for child in table.get_children() if child.get_name() in _INLINED]
    own = {symbol.get_name() for child in inner for symbol in child.get_symbols() if symbol.is_local()}
    if table.get_type() == "function":
        free = {symbol.get_name() for symbol in table.get_symbols() if symbol.is_free()}
        yield from (f"{table.get_lineno()}: {name}" for name in sorted(own & free - {".0"}))
    for child in table.get_children():
        yield from iterate_mistakes(child)


def find_mistakes(text: str, path: Path) -> list[str]:
    return [f"{path.name}:{place}" for place in iterate_mistakes(symtable.symtable(text, str(path), "exec"))]


def test_names_of_comprehensions() -> None:
    bad = "def f(size):\n    return lambda: [[size for size in 'ab'], [(size, n) for n in 'cd']]\n"
    assert find_mistakes(bad, Path("bad.py")) == ["bad.py:2: size"]
    assert find_mistakes(bad.replace("size for size", "n for n"), Path("good.py")) == []
    paths = [
        path
        for package in ("scene_ir", "detectors", "drivesem")
        for path in sorted((ROOT / package).rglob("*.py"))
    ]
    assert len(paths) > 100
    assert [line for path in paths for line in find_mistakes(path.read_text(encoding="utf-8"), path)] == []
