"""Curves as SVG: places on the axes, dashes, texts that cannot break the markup."""

from __future__ import annotations

import re
from xml.etree import ElementTree as ET

import pytest

from drivesem.run.report.page import (
    SERIES,
    ChartLine,
    MetricDrop,
    ReportChart,
    curve_chart,
    drop_chart,
    legend_key,
    loss_trace_chart,
)


def chart(lines: list[ChartLine], **of: object) -> ET.Element:
    return ET.fromstring(curve_chart(ReportChart("A < B", "recall, %", "precision, %", lines, "", **of)))  # pyright: ignore


def numbers(path: str) -> list[float]:
    return [float(word) for word in re.findall(r"-?\d+\.?\d*", path)]


def test_places() -> None:
    svg = chart([ChartLine("one", ((0.0, 100.0), (50.0, 50.0), (100.0, 0.0)), mark=(50.0, 50.0))])
    (line,) = (e for e in svg.iter("path") if e.get("class") == "line s0")
    x0, y0, x1, y1, x2, y2 = numbers(line.get("d", ""))
    assert x1 == pytest.approx((x0 + x2) / 2, abs=0.06)
    assert y1 == pytest.approx((y0 + y2) / 2, abs=0.06)
    assert x0 < x2
    assert y0 < y2
    (mark,) = svg.iter("circle")
    assert (float(mark.get("cx", "")), float(mark.get("cy", ""))) == (x1, y1)
    words = [e.text for e in svg.iter("text")]
    assert "recall, %" in words
    assert "precision, %" in words
    assert "A < B" in svg.get("aria-label", "")


def test_steps_on_a_logarithmic_axis() -> None:
    line = ChartLine(
        "one", ((1.0, 10.0), (2.0, 40.0), (4.0, 40.0)), steps=True, band=((1.0, 5.0, 20.0), (4.0, 30.0, 50.0))
    )
    svg = chart([line], x_range=(1.0, 4.0), log2_x=True)
    (path,) = (e for e in svg.iter("path") if e.get("class") == "line s0")
    places = numbers(path.get("d", ""))
    xs, ys = places[0::2], places[1::2]
    assert xs[1] == xs[2]  # goes up where the second query is, not before
    assert ys[0] == ys[1]
    assert xs[2] - xs[0] == pytest.approx(xs[4] - xs[2], abs=0.11)
    assert [e.text for e in svg.iter("text")][6:9] == ["1", "2", "4"]
    assert [e.get("class") for e in svg.iter("path")].count("band s0") == 1


def test_lines_differ_in_colour_or_dash() -> None:
    signs = [str(legend_key(place)).split("<path")[1] for place in range(2 * SERIES)]
    assert len(set(signs)) == 2 * SERIES


def test_drops() -> None:
    svg = ET.fromstring(
        drop_chart(
            [MetricDrop("ours & <co>", 95.7, 89.9), MetricDrop("theirs", 99.4, 65.9, from_paper=True)], "AP50"
        )
    )
    words = [e.text for e in svg.iter("text")]
    assert {"ours & <co>", "95.7", "89.9", "99.4", "65.9", "AP50, %"} <= set(words)
    before, after = (float(e.get("cx", "")) for e in list(svg.iter("circle"))[:2])
    assert before > after
    assert "ours & <co>: 95.7 to 89.9" in svg.get("aria-label", "")


@pytest.mark.parametrize(
    "fall", [MetricDrop("all", 100.0, 0.0), MetricDrop("up", 0.0, 100.0), MetricDrop("none", 50.0, 50.0)]
)
def test_every_fall_lies_in_the_picture(fall: MetricDrop) -> None:
    svg = ET.fromstring(drop_chart([fall], "AP50"))
    width = float(svg.get("viewBox", "").split()[2])
    assert all(0 <= float(e.get("cx", "")) <= width for e in svg.iter("circle"))
    values = [e.text for e in svg.iter("text") if "value" in e.get("class", "")]
    assert {f"{fall.before:.1f}", f"{fall.after:.1f}"} == set(values)


def test_trace() -> None:
    svg = ET.fromstring(loss_trace_chart([1.0, 3.0, 2.0]))
    (line,) = svg.iter("polyline")
    ys = numbers(line.get("points", ""))[1::2]
    assert ys[1] < ys[2] < ys[0]
    assert svg.get("aria-label") == "Loss by query: from 1 to 2, at most 3"
    ET.fromstring(loss_trace_chart([1.0, 1.0]))
