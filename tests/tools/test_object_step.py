"""What the renderer takes of a step: a line an object."""

import re
import sys

from tools import object_step


def test_a_line_tells_the_share_and_the_seconds_of_five_steps(monkeypatch, capsys):
    monkeypatch.setattr(
        sys, "argv", ["object_step", "bus/0080:top", "--network", "squeezenet", "--rounds", "1", "--threads", "1"]
    )
    object_step.main()
    (line,) = capsys.readouterr().out.splitlines()
    told = re.fullmatch(
        r"bus/0080:top, \d+ triangles, squeezenet: renderer (?P<share>[\d.]+) % \[.*\] of a step; processor ms: "
        r"step (?P<step>\d+) .*, renderer (?P<renderer>\d+) .*, network (?P<network>\d+) .*; "
        r"5 steps (?P<clock>[\d.]+) s, (?P<processor>[\d.]+) s of the processor",
        line,
    )
    assert told is not None, line
    share, step, renderer, network, _, five = (float(number) for number in told.groups())
    assert abs(share - 100 * renderer / (renderer + network)) < 5
    assert step < 3 * (renderer + network)
    assert 1e3 * five > step
