"""Shared by all tests: reproducible property tests, slow data made once, and the list of quick tests."""

import functools
import os
import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

if "PYTEST_XDIST_WORKER" in os.environ:
    # Processes that share the tests take a thread each: two threads in each of two are slower than one.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

from drivesem.config import options
from drivesem.synth import demo  # torch reads OMP_NUM_THREADS when it is imported

# Most tests of commands begin with the same embedded street, which takes seconds to generate.
demo.demo_scene = functools.lru_cache(maxsize=4)(demo.demo_scene)
# A process takes seconds to start: commands start one only where a test has --workers.
options._MAX_PROCESSES = 1

QUICK = [
    "architecture",
    "scene_ir/test_geometry.py",
    "scene_ir/test_types.py",
    "scene_ir/test_files.py",
    "scene_ir/raster/test_raster_layout.py",
    "scene_ir/raster/test_interpolate.py",
    "scene_ir/meshes/test_templates.py",
    "scene_ir/render/test_environment.py",
    "scene_ir/derender/test_matte.py",
    "detectors/test_boxes.py",
    "detectors/test_quality.py",
    "detectors/adapters/test_formats.py",
    "detectors/yolov3/test_yolov3_cfg.py",
    "drivesem/config/test_edits.py",
    "drivesem/data/test_subsets.py",
    "drivesem/data/test_label_table.py",
    "drivesem/evaluation/test_voc_matching.py",
    "drivesem/evaluation/test_resampling.py",
    "drivesem/run/report/test_report_charts.py",
    "drivesem/synth/test_synth_variations.py",
    "drivesem/attacks/test_budgets.py",
    "drivesem/attacks/test_space.py",
    "drivesem/attacks/test_targets.py",
    "drivesem/scenes/test_segmenter.py",
    "drivesem/run/test_results.py",
    "drivesem/training/test_samples.py",
    "drivesem/analysis/explain/test_shapley_values.py",
    "tools/experiments/survey/test_results.py",
    "drivesem/bench/test_timing.py",
    "drivesem/commands/test_convert_command.py",
    "tools/test_fit_kitti_statistics.py",
]
"""Tests of `pytest -m quick`: some of every package, in under a minute."""

settings.register_profile("drivesem", max_examples=25, deadline=None, derandomize=True, database=None)
settings.load_profile("drivesem")


@pytest.fixture
def full_disk() -> Callable[[int], AbstractContextManager[None]]:
    """A context in which the system lets no file grow beyond a number of bytes.

    Hold it only around the tested call: pytest's own output may go to a file too.
    """

    @contextmanager
    def limit_files(max_bytes: int) -> Iterator[None]:
        previous = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, previous[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, previous)

    return limit_files


@pytest.fixture(scope="session")
def screen() -> Any:
    """OpenGL without a window. Skips if neither EGL nor OSMesa is installed."""
    from drivesem.failures.second_renderer.base import NoSecondRendererError
    from drivesem.failures.second_renderer.opengl import shared_context

    try:
        return shared_context()
    except NoSecondRendererError as error:
        pytest.skip(str(error))


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


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of QUICK; `-m quick` fails if one of them does not exist."""
    chosen = [Path(__file__).parent / name for name in QUICK]
    missing = [str(path) for path in chosen if not path.exists()]
    assert not (missing and config.option.markexpr == "quick"), f"no such tests: {', '.join(missing)}"
    quick = {path for path in {item.path for item in items} if {path, *path.parents}.intersection(chosen)}
    for item in items:
        if item.path in quick and "slow" not in item.keywords:
            item.add_marker(pytest.mark.quick)
