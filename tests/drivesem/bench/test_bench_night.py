"""The estimated time of an attack on many frames, from hand-made frames; the command on two real ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from drivesem.bench import night
from drivesem.bench.night import FrameTime
from drivesem.config.commands import BenchConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import to_yaml

FRAMES = [FrameTime(2.0, 4.0, 3.0, 1.0, 1.0), FrameTime(4.0, 8.0, 1.0, 1.0, 1.0)]


def test_where_the_time_goes() -> None:
    rows = {row["part"]: row for row in night.part_rows(FRAMES, 2)}
    assert [row["mean_s"] for row in rows.values()] == [3.0, 6.0, 2.0, 1.0]
    assert rows["search"]["share"] == pytest.approx(12 / 24)
    assert sum(row["share"] for row in rows.values()) == pytest.approx(1.0)
    hourly = {part: row["frames_an_hour_without"] for part, row in rows.items()}
    assert hourly == {"derender": 800, "search": 1200, "certify": 720, "write": 655}  # search pays most


def test_hours_of_many_frames_and_what_makes_them_fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(night.os, "cpu_count", lambda: 4)
    first, *others = night.night_rows(FRAMES, 600, 2, 0)
    assert (first["how"], first["processes"], first["frames"]) == ("as configured", 2, 600)
    assert first["hours"] == pytest.approx(12 * 600 / 2 / 3600)
    assert first["frames_an_hour"] == 600
    assert first["low"] <= first["hours"] <= first["high"]
    hours = {row["how"]: row["hours"] * 3600 * 2 / 600 for row in others}
    assert hours == pytest.approx(
        {
            "--no-fit": 10.0,
            "no grades, --no-grade": 10.0,
            "half the --steps": 9.0,
            "frames de-rendered before, in --cache": 9.0,
            "--workers": 6.0,
        }
    )
    assert [row["hours"] for row in others] == sorted((row["hours"] for row in others), reverse=True)


def test_frames_that_were_not_fitted_have_no_faster_way() -> None:
    rows = night.night_rows([FrameTime(1.0, 1.0, 1.0, 1.0, None)], 10, 99, 0)
    alternatives = ["half the --steps", "frames de-rendered before, in --cache", "no grades, --no-grade"]
    assert [row["how"] for row in rows] == ["as configured", *alternatives]


def test_frames_that_were_not_graded_save_nothing_by_that() -> None:
    rows = night.night_rows([FrameTime(1.0, 1.0, 0.0, 1.0, None)], 10, 99, 0)
    assert not [row for row in rows if row["how"].startswith("no grades")]


def test_processor_time_estimates_an_idle_machine() -> None:
    frames = [replace(frame, processor=2.5) for frame in FRAMES]
    rows = {row["how"]: row for row in night.night_rows(frames, 600, 2, 0)}
    alone = rows["no other work on the machine"]
    assert (alone["hours"], alone["by"]) == (pytest.approx(2.5 * 600 / 2 / 3600), "estimated")
    some = [frames[0], FRAMES[1]]
    assert "no other work on the machine" not in {row["how"] for row in night.night_rows(some, 600, 2, 0)}


def test_frames_lie_evenly() -> None:
    names = [f"{i:02d}" for i in range(11)]
    assert night.pick_evenly(names, 3) == ["01", "05", "09"]
    assert night.pick_evenly(names, 50) == names
    assert night.pick_evenly([], 3) == []


def test_picked_frames_have_as_many_vehicles_as_all() -> None:
    """Every third of these frames has one vehicle, the others up to twenty: places alone would see only the former."""
    vehicles = [1 if i % 3 == 1 else i // 3 for i in range(60)]
    names = [str(i) for i in range(60)]
    picked = [vehicles[int(name)] for name in night.pick_evenly(names, 20, vehicles)]
    assert sum(picked) / 20 == pytest.approx(sum(vehicles) / 60, rel=0.05)
    assert night.pick_evenly(names, 60, vehicles) == names


def test_vehicles_are_counted_in_labels(small_kitti: Path) -> None:
    root = small_kitti / "training"
    labels = (root / "label_2/000008.txt").read_text()
    settings = night.build_attack_config(BenchConfig(what="night", dataset="kitti", root=str(small_kitti)))
    count = sum(line.startswith(("Car ", "Van ", "Truck ")) for line in labels.splitlines())
    assert night.count_labelled_vehicles(settings, ["000008"]) == [count]
    assert count > 0
    assert night.count_labelled_vehicles(night.build_attack_config(BenchConfig(what="night")), ["a"]) is None


def test_no_frame_with_a_vehicle() -> None:
    with pytest.raises(UsageError, match="frames with vehicles"):
        night.require_frames([])


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0.4 s"), (58.32, "58 s"), (91, "1.5 min"), (3000, "50 min"), (5400, "1.5 h"), (234000, "2.7 days")],
)
def test_durations_have_the_unit_that_suits_them(seconds: float, text: str) -> None:
    assert night.format_duration(seconds) == text


@pytest.mark.parametrize("program", ["", "drivesem attack ", "attack "])
def test_the_attack_is_given_as_its_command(program: str, tmp_path: Path) -> None:
    words = "--method climb --params color,weather --no-confirm"
    settings = night.build_attack_config(BenchConfig(what="night", attack=program + words))
    assert (settings.method, settings.params, settings.confirm) == ("climb", "color,weather", False)
    command = night.format_attack(settings)
    assert command == "drivesem attack --no-confirm --params color,weather --method climb"
    assert night.build_attack_config(BenchConfig(what="night", attack=command)) == settings
    (tmp_path / "config.yaml").write_text(to_yaml(settings))
    assert (
        night.format_attack(night.build_attack_config(BenchConfig(what="night", attack=str(tmp_path)))) == command
    )


def test_the_attacks_own_frames_are_timed_unless_others_are_named(tmp_path: Path) -> None:
    attack = f"drivesem attack --dataset kitti --root {tmp_path} --limit 20"
    settings = night.build_attack_config(BenchConfig(what="night", attack=attack))
    assert (settings.dataset, settings.root, settings.limit) == ("kitti", str(tmp_path), None)
    settings = night.build_attack_config(BenchConfig(what="night", attack=attack, dataset="yolo"))
    assert settings.dataset == "yolo"


def test_the_attack_is_the_presets_on_this_commands_frames(tmp_path: Path) -> None:
    preset = tmp_path / "mine.yaml"
    preset.write_text("method: climb\nparams: weather\nseed: 4\n")
    settings = night.build_attack_config(BenchConfig(what="night", attack=str(preset), seed=9, workers=2))
    assert (settings.method, settings.params, settings.seed, settings.workers) == ("climb", "weather", 9, 2)
    assert night.build_attack_config(BenchConfig(what="night")).method == "si-fgsm"
