"""`python -m tools.bench viewer` as a maintainer types it."""

import json
from pathlib import Path
from typing import Any

import pytest

from tools.bench import viewer
from tools.bench.__main__ import main


@pytest.mark.parametrize("browser", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_viewer(
    browser: bool,
    small_run: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(viewer, "QUICK_STATES", 2)
    monkeypatch.setattr(viewer, "_LASTS", ("yaw",))
    if not browser:
        monkeypatch.setattr(viewer.shutil, "which", lambda _: None)
    elif viewer.shutil.which("chromium") is None:
        pytest.skip("Debian's chromium is not installed")
    scene = small_run / "frames" / "demo-000" / "scene"
    assert main(["viewer", "--quick", "--scenes", str(scene), "--json"]) == 0
    rows: list[dict[str, Any]] = json.loads(capsys.readouterr().out)["rows"]
    sliders = [row["slider"] for row in rows if row["where"] == "HTTP"]
    assert sliders[0].endswith(".yaw")
    assert sliders[1:] == ["weather.fog"]
    assert [row["where"] for row in rows] == ["HTTP", "HTTP", *(["browser"] * 2 if browser else [])]
    for row in rows:
        assert (row["size"], row["cars"], row["states"]) == ("1241 x 376", 6, 2)
        # Both are asked for at once: beside other work either may come first.
        assert min(row["picture_ms"], row["detections_ms"]) > 0
        assert (row["cpu_ms"] is None) == (row["where"] == "browser")
        assert row["cpu_ms"] is None or row["cpu_ms"] > 1


def test_values_are_new_ones_and_never_zero() -> None:
    class Of:
        high = 4.0

    values = viewer._values(Of(), 30)  # pyright: ignore[reportArgumentType]
    assert len(set(values)) == 31
    assert 0 < min(values) < max(values) < 4


def test_a_scene_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["viewer", "--scenes", str(tmp_path)]) == 2
    assert "expected a scene of drivesem derender" in capsys.readouterr().err
