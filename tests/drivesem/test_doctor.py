"""`drivesem doctor`: parts that work, are missing, or would take the whole process with them."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from drivesem import doctor
from drivesem.cli import main
from drivesem.commands import doctor as command
from drivesem.doctor import PARTS, Part, examine


def part(code: str, name: str = "thing", needed: bool = False) -> Part:
    return Part(name, "something", "pip install thing", code, needed)


@pytest.mark.parametrize(
    ("code", "status", "told"),
    [
        ("print('1.2')", "works", "1.2"),
        ("pass", "works", "installed"),
        ("import no_such_thing", "missing", "No module named 'no_such_thing'"),
        ("assert False, 'it sees no GPU'", "missing", "it sees no GPU"),
        ("raise ImportError('libusb-1.0.so.0: not there')", "broken", "ImportError: libusb-1.0.so.0: not there"),
        ("import os; os.abort()", "broken", "the process was ended by signal 6"),
        ("import os; os._exit(3)", "broken", "the process ended with 3"),
        ("import sys; sys.stderr.buffer.write(bytes([255])); sys.exit(1)", "broken", "\ufffd"),
    ],
)
def test_each_part_is_tried_apart(code: str, status: str, told: str) -> None:
    (found,) = examine([part(code)])
    assert found.status == status
    assert told in found.told
    assert "\n" not in found.told


def test_a_part_that_hangs_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "PATIENCE_S", 0.5)
    (found,) = examine([part("import time; time.sleep(60)")])
    assert (found.status, found.told) == ("broken", "no answer within 0 s")


def test_the_order_stays_and_each_is_told() -> None:
    done: list[int] = []
    found = examine([part("pass", str(i)) for i in range(6)], lambda: done.append(1))
    assert [one.part.name for one in found] == [str(i) for i in range(6)]
    assert len(done) == 6


def test_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    parts = (part("print('7')", "core", needed=True), part("import no_such_thing", "extra"), part("1 / 0", "sick"))
    monkeypatch.setattr(command, "PARTS", parts)
    monkeypatch.setattr(command, "examine", lambda parts, done: examine(parts, done))
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "extra: pip install thing" in text
    assert "ZeroDivisionError: division by zero" in text
    assert "all that is needed works" in text
    assert main(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["fit"], told["python"]) == (True, sys.version.split()[0])
    assert [(row["name"], row["status"]) for row in told["parts"]] == [
        ("core", "works"), ("extra", "missing"), ("sick", "broken"),
    ]  # fmt: skip
    monkeypatch.setattr(command, "PARTS", (part("import no_such_thing", "core", needed=True),))
    assert main(["doctor"]) == 1
    assert "drivesem cannot work here" in capsys.readouterr().out


def test_probes_are_python() -> None:
    for one in PARTS:
        compile(one.code, one.name, "exec")
        assert one.gives
        assert one.bring
    assert [one.name for one in PARTS if one.needed] == ["torch", "warp", "weights"]


def test_the_command_loads_none_of_the_parts() -> None:
    heavy = "('torch', 'warp', 'open3d', 'ray')"
    code = f"import sys, drivesem.commands.doctor; print([m for m in {heavy} if m in sys.modules])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"


@pytest.mark.slow
def test_this_machine_is_fit(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["fit"]
