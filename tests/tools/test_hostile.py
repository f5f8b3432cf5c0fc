"""Hostile inputs: defects are reported, and some quick cases pass."""

import json
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tools.hostile import __main__ as command
from tools.hostile.cases import FAMILIES, cases
from tools.hostile.inputs import MARK, ValidInputs, nothing, text
from tools.hostile.trial import CaseResult, HostileCase, Signals, judge, run

LINE = "drivesem: a.json: score: expected a number, found 'high'"
REFUSED = HostileCase("a", "tracebacks", nothing, "drivesem report run", ("a.json: score",))
VERIFIED = HostileCase("b", "trust", nothing, "drivesem verify run", ("metrics.json: t_star",), code=1)
STOPPED = HostileCase("c", "signals", nothing, "x", ("interrupted",), 130, Signals("", (0.0,)), unlimited=True)
DONE = CaseResult(code=2, out="", err=f"{LINE}\n", seconds=2.0, mb=300.0)
DIFFERENCE = "(run): totals: metrics.json: t_star: expected 0.6, found 0.545"
AGAIN = CaseResult(
    code=1, out=f"{DIFFERENCE}\nthe run is not what it says it is\n", err="written to a\n", seconds=2, mb=300
)
ENDED = CaseResult(code=130, out="", err="drivesem: interrupted; the same\n", seconds=30, mb=300, ended_s=1.0)


def test_good_outcomes_pass() -> None:
    assert judge(REFUSED, DONE) == judge(VERIFIED, AGAIN) == judge(STOPPED, ENDED) == []
    before = "attacking ━━━━ 0/1\ndrivesem: --detector: runs the code in mine.py:Mine\nscenes are kept\n"
    assert judge(REFUSED, replace(DONE, err=before + DONE.err)) == []


@pytest.mark.parametrize(
    ("changed", "wrong"),
    [
        ({"code": 1}, "exit code 1, not 2"),
        ({"code": None}, "no end after 120 s"),
        ({"code": -9}, "exit code -9, not 2"),
        ({"err": ""}, "0 lines of error, not one"),
        ({"err": f"{LINE}\n{LINE}\n"}, "2 lines of error, not one"),
        ({"err": f"{LINE}\nlater\n"}, "the line is not the last"),
        ({"err": LINE.replace("score", "box")}, "the line does not name 'a.json: score'"),
        ({"err": "drivesem: a.json: score is odd"}, "the line does not state what was expected and found"),
        ({"err": f"Traceback (most recent call last):\n{LINE}"}, "prints 'Traceback (most recent call last)'"),
        ({"err": f"a.py:3: UserWarning: words\n{LINE}"}, "prints 'Warning:'"),
        ({"seconds": 5.1}, "5.1 s of the processor, more than 5"),
        ({"mb": 1100.0}, "1100 MB, more than 1024"),
        ({"mark": True}, "foreign code was run"),
        ({"left": 2}, "2 processes outlived it"),
    ],
)
def test_each_defect_is_listed(changed: dict[str, Any], wrong: str) -> None:
    assert judge(REFUSED, replace(DONE, **changed)) == [wrong]


def test_a_command_must_end_soon_after_a_signal() -> None:
    assert judge(STOPPED, replace(ENDED, ended_s=2.5)) == ["ended 2.5 s after the last signal, more than 2"]


EATING = "import time\nhoard = bytearray(300 << 20)\nwhile time.process_time() < 1:\n    pass\n"
LEAVING = """
import subprocess, sys
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
open("mark", "w")
"""
DEAF = """
import pathlib, signal, time
signal.signal(signal.SIGINT, lambda *_: print("again", flush=True))
pathlib.Path("ready").touch()
until = time.monotonic() + 1
while time.monotonic() < until:
    time.sleep(0.05)
raise SystemExit(130)
"""


def run_script(content: str, folder: Path, **fields: Any) -> CaseResult:
    case = replace(REFUSED, make=text("a.py", content), words="python a.py", **fields)
    return run(case, folder / "case", ValidInputs(folder))


def test_a_command_is_measured(tmp_path: Path) -> None:
    done = run_script(EATING, tmp_path)
    assert (done.code, done.mark, done.left) == (0, False, 0)
    assert 1 <= done.seconds < 3
    assert 300 <= done.mb < 400  # not this process's


def test_processes_left_behind_are_found_and_ended(tmp_path: Path) -> None:
    done = run_script(LEAVING, tmp_path)
    assert (done.left, done.mark) == (1, True)
    assert MARK == "mark"


def test_signals_are_sent_when_it_is_ready(tmp_path: Path) -> None:
    done = run_script(DEAF, tmp_path, signals=Signals("ready", (0.2, 0.4), signal.SIGINT))
    assert (done.code, done.out) == (130, "again\nagain\n")
    assert 0.4 < done.ended_s < 2


def test_case_names_are_unique() -> None:
    names = [case.name for case in cases()]
    assert len(names) == len(set(names))
    assert {case.family for case in cases()} == set(FAMILIES)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    raising = replace(REFUSED, make=text("a.py", "1 / 0"), words="python a.py")
    printing = replace(raising, name="b", make=text("a.py", f"raise SystemExit({LINE!r})"), code=1, named=())
    monkeypatch.setattr(command, "cases", lambda: [raising, replace(printing, family="trust")])
    assert command.main(["--only", "tracebacks"]) == 1
    output = capsys.readouterr().out
    assert (
        "tracebacks: a\n  $ python a.py\n  exit code 1, not 2\n  prints 'Traceback (most recent call last)'"
        in output
    )
    assert "  | ZeroDivisionError: division by zero" in output
    assert "0 of 1 clean" in output
    assert command.main(["--json"]) == 1
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows] == ["a", "b"]
    assert rows[1]["errors"] == [LINE]
    with pytest.raises(SystemExit):
        command.main(["--only", "nothing like it"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["COCO: images.id = [1]", "20,000 Darknet layers", "raises in decode: check", "verify: loss trace"]
)
def test_some_of_them(name: str) -> None:
    """`python -m tools.hostile` runs all cases."""
    assert command.main(["--only", name]) == 0
