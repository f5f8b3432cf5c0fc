"""Ctrl-C and SIGTERM end a command once, and leave it alone while it cleans up."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator

import pytest

from drivesem import cli, program


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def send(number: signal.Signals) -> None:
    os.kill(os.getpid(), number)
    time.sleep(0.01)  # in which Python calls the handler


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("again", [signal.SIGINT, signal.SIGTERM])
def test_further_signals_during_cleanup_are_ignored(
    number: signal.Signals, code: int, again: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    cleaned = []

    def work(config: object) -> int:
        try:
            send(number)
        finally:
            send(again)
            cleaned.append(True)
        return 0

    monkeypatch.setattr(program.Program, "_load", lambda self, name: work)
    monkeypatch.setattr(sys, "argv", ["drivesem", "doctor"])
    assert cli.main() == code
    send(again)  # as Python ends
    assert cleaned == [True]


def test_a_signal_counts_again_after_some_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "_CLEANUP_SECONDS", 0.05)

    def work(config: object) -> int:
        try:
            send(signal.SIGINT)
        except KeyboardInterrupt:
            time.sleep(0.1)
            send(signal.SIGINT)
        return 0

    monkeypatch.setattr(program.Program, "_load", lambda self, name: work)
    assert cli.main(["doctor"]) == 130
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler, "Python goes on"


def test_handlers_are_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(program.Program, "_load", lambda self, name: lambda config: 0)
    assert cli.main(["doctor"]) == 0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) == before
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell has it for what it starts in the background
    assert cli.main(["doctor"]) == 0
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
