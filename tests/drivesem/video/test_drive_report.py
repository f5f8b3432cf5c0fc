"""What is said of a clip on a terminal."""

import io
from pathlib import Path

from drivesem.reporting.tables import Console
from drivesem.video.report import STATES, CarResult, DriveResult, build_report, format_summary


def _result(out: Path, frames: int, *cars: tuple[int, str]) -> DriveResult:
    """Cars, by track and kind, that come nearer by a metre a frame and are missed from the second one on."""
    states: dict[str, str] = dict.fromkeys(map(str, STATES), "f" + "l" * (frames - 1))
    distance_m = tuple(float(frames - i) for i in range(frames))
    message = (
        CarResult.from_states(track, kind, states, distance_m, (None,) * frames, (True, False))
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
        cars=tuple(message),
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
    assert ["car", *metrics] in lines
    for name in ("3 Car", "1012 Truck"):
        assert [*name.split(), "139", "139", "139", "140", "139", *["139.0"] * 4, "1/2"] in lines


def test_counts_of_one_are_singular(tmp_path: Path) -> None:
    output = format_summary(_result(tmp_path, 1, (3, "Car")))
    for part in ("of 1 sighting of 1 car missed", ", 1 phantom (", "in 1 of 1 frame; 1 query, 1 pass, "):
        assert part in output
