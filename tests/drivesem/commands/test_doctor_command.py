"""`drivesem doctor`: features that work, are missing, or abort their process."""

from __future__ import annotations

import ast
import pkgutil
import subprocess
import sys

import pytest

from drivesem.commands import doctor
from drivesem.commands.doctor import FEATURES, OptionalFeature, check_features
from tests.drivesem.invoke import invoke, run_json


def feature(code: str, name: str = "extra", needed: bool = False) -> OptionalFeature:
    return OptionalFeature(name, "something", "pip install extra", code, needed)


@pytest.mark.parametrize(
    ("code", "status", "detail"),
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
def test_each_part_is_tried_afeature(code: str, status: str, detail: str) -> None:
    (result,) = check_features([feature(code)])
    assert result.status == status
    assert detail in result.detail
    assert "\n" not in result.detail


def test_a_feature_that_hangs_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "TIMEOUT_S", 0.5)
    (result,) = check_features([feature("import time; time.sleep(60)")])
    assert (result.status, result.detail) == ("broken", "no answer within 0 s")


def test_results_keep_the_order() -> None:
    done: list[int] = []
    results = check_features([feature("pass", str(i)) for i in range(6)], lambda: done.append(1))
    assert [result.feature.name for result in results] == [str(i) for i in range(6)]
    assert len(done) == 6


def test_command(monkeypatch: pytest.MonkeyPatch) -> None:
    features = (
        feature("print('7')", "core", needed=True),
        feature("import no_such_thing", "extra"),
        feature("1 / 0", "sick"),
    )
    monkeypatch.setattr(doctor, "FEATURES", features)
    text = invoke("doctor").out
    assert "extra: pip install extra" in text
    assert "ZeroDivisionError: division by zero" in text
    assert "everything that is required works" in text
    data = run_json("doctor")
    assert (data["fit"], data["python"]) == (True, sys.version.split()[0])
    assert [(row["name"], row["status"]) for row in data["parts"]] == [
        ("core", "works"), ("extra", "missing"), ("sick", "broken"),
    ]  # fmt: skip
    monkeypatch.setattr(doctor, "FEATURES", (feature("import no_such_thing", "core", needed=True),))
    assert "drivesem cannot work here" in invoke("doctor", code=1).out


def test_probes_are_python() -> None:
    for one in FEATURES:
        compile(one.code, one.name, "exec")
        assert one.gives
        assert one.bring
    assert [one.name for one in FEATURES if one.needed] == ["torch", "warp", "weights"]


def test_probes_use_names_of_ours_that_exist() -> None:
    """A probe of a name that is gone would report a feature that works as broken."""
    found = 0
    for one in FEATURES:
        for node in ast.walk(ast.parse(one.code)):
            package = (node.module or "").partition(".")[0] if isinstance(node, ast.ImportFrom) else ""
            if isinstance(node, ast.ImportFrom) and package in ("drivesem", "detectors", "scene_ir"):
                for alias in node.names:
                    pkgutil.resolve_name(f"{node.module}.{alias.name}")
                    found += 1
    assert found >= 4


def test_the_command_imports_no_feature() -> None:
    heavy = "('torch', 'warp', 'open3d', 'ray')"
    code = f"import sys, drivesem.commands.doctor; print([m for m in {heavy} if m in sys.modules])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"


@pytest.mark.slow
def test_this_machine_is_fit() -> None:
    assert run_json("doctor")["fit"]


@pytest.mark.parametrize(
    ("version", "command"),
    [
        ("2.9.1", "pip install torchvision torch==2.9.1"),
        (
            "2.9.1+cu128",
            "pip install torchvision torch==2.9.1+cu128 --index-url https://download.pytorch.org/whl/cu128",
        ),
    ],
)
def test_torchvision_is_the_one_of_the_installed_torch(
    version: str, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor.importlib.metadata, "version", lambda _: version)
    assert doctor._torchvision_command() == command
