"""`python -m tools.bench parts`: the parts of a frame's time are those of its functions, and sum to all of it."""

import json

import pytest

from tools.bench import parts
from tools.bench.__main__ import main
from tools.bench.parts import PARTS, REST, WHOLE, DerenderedStreet


def test_command(capsys: pytest.CaptureFixture[str]) -> None:
    before = [getattr(owner, name) for functions in PARTS.values() for owner, name in functions]
    assert main(["parts", "--frames", "1", "--json"]) == 0
    assert [getattr(owner, name) for functions in PARTS.values() for owner, name in functions] == before
    found = json.loads(capsys.readouterr().out)
    (row,) = found["rows"]
    for seconds in (row["fit"], row["fast"]):
        assert list(seconds) == [*PARTS, REST, WHOLE]
        assert sum(value for part, value in seconds.items() if part != WHOLE) == pytest.approx(seconds[WHOLE])
        assert all(seconds[part] > 0 for part in ("template and heading", "maps", "fill behind", "sources"))
    assert row["fit"]["fit"] > 0
    assert row["fast"]["fit"] == 0
    assert [line["part"] for line in found["summary"]] == [*PARTS, REST, WHOLE]


def test_means_and_medians() -> None:
    rows = [
        DerenderedStreet(*(dict.fromkeys((*PARTS, REST, WHOLE), seconds * way) for way in (1.0, 0.5)))
        for seconds in (1.0, 2.0, 6.0)
    ]
    line = parts.summary(rows)[-1]
    assert line == {"part": WHOLE, "fit_s": 3.0, "fit_median": 2.0, "fast_s": 1.5, "fast_median": 1.0}
