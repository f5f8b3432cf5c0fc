"""The fuzzer: are faults of every kind told, and is what is damaged the same each time?"""

import json
import os
import time
import warnings
from pathlib import Path

import pytest

from scene_ir.errors import FormatError
from tools.fuzz import trial
from tools.fuzz.__main__ import main
from tools.fuzz.formats import FORMATS, Format
from tools.fuzz.trial import FuzzSubject, fuzz


def make(root: Path) -> None:
    root.mkdir(parents=True)
    (root / "a.txt").write_text("one two three\n" * 21)


def taken(root: Path) -> None:
    (root / "a.txt").read_bytes()


def refused(root: Path) -> None:
    if (root / "a.txt").read_text(errors="replace") != "one two three\n" * 21:
        raise FormatError("a.txt", "words", "others")


def faulty(root: Path, fault: str) -> None:
    """As `refused`, but for every third input, which shows a fault."""
    data = (root / "a.txt").read_bytes()
    if len(data) % 3 == 1:
        match fault:
            case "raises":
                raise KeyError("words")
            case "warns":
                warnings.warn("words", UserWarning, stacklevel=1)
            case "dies":
                os.abort()
            case "hoards":
                bytearray(2 << 30)
            case "idles":
                while True:
                    try:
                        sum(range(1000))
                    except Exception:
                        time.sleep(0)
    refused(root)


def test_files_that_are_taken_or_refused_are_no_faults() -> None:
    outcome = fuzz(Format("words", make, taken), 1, 30)
    assert (outcome.tried, outcome.accepted, outcome.refused, outcome.wrong) == (30, 30, 0, {})
    outcome = fuzz(Format("words", make, refused), 1, 30)
    assert (outcome.tried, outcome.wrong) == (30, {})
    assert outcome.refused > 20


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("raises", "KeyError: 'words'"),
        ("warns", "UserWarning: words"),
        ("dies", "killed by SIGABRT"),
        ("hoards", "MemoryError"),
        ("idles", "more than 0.2 s"),
    ],
)
def test_each_fault_is_told(fault: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "SECONDS", 0.2)
    outcome = fuzz(Format("words", make, lambda root: faulty(root, fault)), 1, 20, keep=tmp_path)
    assert outcome.tried == 20
    ((told, numbers),) = outcome.wrong.items()
    assert told.startswith(said)
    assert 1 < len(numbers) < 20
    assert outcome.accepted + outcome.refused == 20 - len(numbers)
    if fault != "dies":
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted(f"words-1-{n}" for n in numbers)


def test_an_input_is_the_same_each_time(tmp_path: Path) -> None:
    found = []
    for name in ("a", "b"):
        subject = FuzzSubject(Format("words", make, taken), tmp_path / name)
        for number in range(20):
            with subject.damaged(3, number) as root:
                found.append((root / "a.txt").read_bytes())
        assert (subject.root / "a.txt").read_text() == "one two three\n" * 21
    assert found[:20] == found[20:]
    assert len(set(found)) > 10


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FORMATS, "words", Format("words", make, lambda root: faulty(root, "raises")))
    words = ["--formats", "words, survey", "--count", "40", "--seed", "1"]
    assert main([*words, "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert "words: KeyError" not in said.partition("seed 1")[0].splitlines()[0][:5]
    assert "x KeyError: 'words'" in said
    first, second = json.loads((tmp_path / "fuzz.json").read_text())["formats"]
    assert (first["name"], first["tried"], second["name"], second["tried"]) == ("words", 20, "survey", 20)
    number = first["wrong"][next(iter(first["wrong"]))][0]
    with pytest.raises(KeyError):
        main(["--formats", "words", "--seed", "1", "--show", str(number)])
    monkeypatch.setitem(FORMATS, "words", Format("words", make, refused))
    assert main(["--formats", "words", "--count", "5"]) == 0
