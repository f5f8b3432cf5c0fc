"""Every kernel module compiles for CUDA; Warp needs no GPU and no driver for that."""

import importlib
from pathlib import Path

import pytest
import warp as wp

from scene_ir.raster.launch import start_warp

ROOT = Path(__file__).parents[3]
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for package in ("scene_ir", "drivesem", "detectors")
    for path in sorted((ROOT / package).rglob("*.py"))
    if "@wp.kernel" in path.read_text(encoding="utf-8")
]
ARCHITECTURES = [75, pytest.param(80, marks=pytest.mark.slow), pytest.param(90, marks=pytest.mark.slow)]
"""Compute capabilities times ten: Turing, Ampere, Hopper."""


def test_kernel_modules_are_found() -> None:
    assert {"drivesem.synth.kernels", "scene_ir.raster.kernels", "scene_ir.render.kernels.shading"} < set(MODULES)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("name", MODULES)
def test_a_module_compiles_for_cuda(name: str, architecture: int, tmp_path: Path) -> None:
    start_warp()
    importlib.import_module(name)
    if not wp._src.context.runtime.is_cuda_enabled:  # pyright: ignore
        pytest.skip("this build of Warp has no CUDA")
    wp.compile_aot_module(wp.get_module(name), arch=architecture, module_dir=tmp_path, use_ptx=True)
    assert [path.suffixes[-2] for path in tmp_path.glob("*.ptx")] == [f".sm{architecture}"]
