"""What all tests share: property tests draw the same examples every time, and are not timed one by one. And data
that takes seconds to make, made once.
"""

import shutil
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("drivesem", deadline=None, derandomize=True, database=None)
settings.load_profile("drivesem")


@pytest.fixture(scope="session")
def small_kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A KITTI folder of one generated frame, 000008."""
    from drivesem.cli import main

    root = tmp_path_factory.mktemp("kitti")
    words = ["--frames", "1", "--seed", "7", "--workers", "1", "--out", str(root)]
    assert main(["synth", "--layout", "kitti", *words]) == 0
    for path in sorted((root / "training").glob("*/000000.*")):
        shutil.move(path, path.with_stem("000008"))
    return root


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps on one embedded frame."""
    from drivesem.cli import main

    out = tmp_path_factory.mktemp("runs") / "a"
    words = ["--limit", "1", "--workers", "1", "--params", "translate,rotate", "--steps", "2", "--out", str(out)]
    assert main(["attack", *words]) == 0
    return out
