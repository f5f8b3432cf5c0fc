"""What is said of a clip on a terminal."""

import io
from pathlib import Path

from drivesem.reporting.tables import Console
from drivesem.video.report import (
    STATES,
    DriveResult,
    TrackResult,
    build_report,
    format_summary,
    list_classes,
    write_page,
)


def _result(out: Path, frames: int, *cars: tuple[int, str]) -> DriveResult:
    """Cars, by track and kind, that come nearer by a metre a frame and are missed from the second one on."""
    states: dict[str, str] = dict.fromkeys(map(str, STATES), "f" + "l" * (frames - 1))
    distance_m = tuple(float(frames - i) for i in range(frames))
    message = (
        TrackResult.from_states(track, kind, states, distance_m, (None,) * frames, (True, False))
        for track, kind in cars
    )
    return DriveResult(
        out=str(out),
        clip="Scene01/clone",
        detector="squeezedet",
        t_star=0.5,
        params=("color", "mesh"),
        method="si-fgsm",
        frames=frames,
        names=tuple(map(str, range(frames))),
        tracks=tuple(message),
        phantoms=dict.fromkeys(map(str, STATES), 1),
        feasible=frames,
        violations={},
        held_back=(),
        failed={},
        theta={},
        loss_trace=(),
        queries=1,
        passes=1,
        seconds=1.0,
    )


def test_the_table_fits_a_terminal_of_80_columns(tmp_path: Path) -> None:
    visible = io.StringIO()
    answer = build_report(_result(tmp_path, 140, (3, "Car"), (1012, "Truck")))
    answer.print(Console(file=visible, width=80))
    lines = [line.split() for line in visible.getvalue().splitlines()[:6]]
    metrics = ["before", "after", "random", "of", "longest", "before", "after", "random", "of", "m", "certain"]
    assert ["object", *metrics] in lines
    for name in ("3 Car", "1012 Truck"):
        assert [*name.split(), "139", "139", "139", "140", "139", *["139.0"] * 4, "1/2"] in lines


def test_people_are_named_and_counted_by_class(tmp_path: Path) -> None:
    result = _result(tmp_path, 20, (12, "Pedestrian"), (3, "Car"), (4, "Car"))
    assert "of 60 sightings of 3 objects missed" in format_summary(result)
    assert list_classes(result) == [
        f"{kind}: {19 * count} of {20 * count} sightings of {objects} missed "
        f"({19 * count} before, {19 * count} by a random change)"
        for kind, count, objects in (("Pedestrian", 1, "1 object"), ("Car", 2, "2 objects"))
    ]
    assert list_classes(_result(tmp_path, 20, (3, "Car"), (4, "Truck"))) == []
    write_page(tmp_path / "page.html", result)
    page = (tmp_path / "page.html").read_text()
    assert "missed objects, over all frames" in page
    assert "<h3>Pedestrian 12</h3>" in page
    visible = io.StringIO()
    build_report(result).print(Console(file=visible, width=80))
    assert any(line.split()[:2] == ["12", "Pedestrian"] for line in visible.getvalue().splitlines())


def test_counts_of_one_are_singular(tmp_path: Path) -> None:
    output = format_summary(_result(tmp_path, 1, (3, "Car")))
    for part in ("of 1 sighting of 1 vehicle missed", ", 1 phantom (", "in 1 of 1 frame; 1 query, 1 pass, "):
        assert part in output
