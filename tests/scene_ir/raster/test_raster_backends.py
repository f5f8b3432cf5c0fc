"""The fast implementation against the reference, on random triangle soups, and how it loads."""

import os
import subprocess
import sys

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_ir.raster import verbs

LAYOUT = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 40, 26], [10, 5, 10, 9], [3, 4, 33, 24]]))


def soup(seed, count, behind, on_pixels):
    """Random triangles, some partly behind the camera, some with corners on pixel centres; some share corners."""
    generator = torch.Generator().manual_seed(seed)
    uv = torch.rand(count * 3, 2, generator=generator) * torch.tensor([50.0, 36.0]) - 5
    w = torch.rand(count * 3, 1, generator=generator) * 20 + (-4 if behind else 0.5)
    if on_pixels:
        uv, w = uv.round(), w.round() + 0.5
    faces = torch.randint(0, count * 3, (count, 3), generator=generator)
    return torch.cat([uv * w, w], dim=1), faces


@given(st.integers(0, 2**31 - 1), st.integers(1, 30), st.booleans(), st.booleans())
@settings(max_examples=40, deadline=None)
def test_fast_is_reference(seed, count, behind, on_pixels):
    clip, faces = soup(seed, count, behind, on_pixels)
    ranges = torch.tensor([[0, count], [0, 1], [count // 3, max(count // 3, count - 2)]])
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(clip.shape[0], 5, generator=generator)
    weights = torch.randn(LAYOUT.size, 6, generator=generator)
    results = []
    for backend in ("reference", "warp"):
        corners, attributes = clip.clone().requires_grad_(), values.clone().requires_grad_()
        found = verbs.rasterize(corners, faces, ranges, LAYOUT, backend)
        out = verbs.interpolate(found, corners, faces, attributes, backend)
        coverage = verbs.antialias(found, corners, faces, backend)
        grad_clip, grad_values = torch.autograd.grad((out * weights[:, :5]).sum(), (corners, attributes))
        grad_outline = torch.autograd.grad((coverage * weights[:, 5]).sum(), corners)[0]
        results.append((found, out.detach(), coverage.detach(), grad_clip, grad_values, grad_outline))
    (slow, *slow_values), (fast, *fast_values) = results
    # Both decide in float64 with the same operations in the same order: no band of allowed flips is needed.
    assert torch.equal(fast.face, slow.face)
    assert torch.equal(fast.depth, slow.depth)
    for name, a, b in zip(
        ("values", "coverage", "clip", "attributes", "outline"), fast_values, slow_values, strict=True
    ):
        scale = 1 + float(b.abs().max())
        torch.testing.assert_close(a / scale, b / scale, rtol=1e-4, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}")
    coverage = fast_values[1]
    assert 0 <= float(coverage.min()) <= float(coverage.max()) <= 1


def test_fast_is_the_same_to_the_bit_when_repeated():
    clip, faces = soup(5, 60, behind=True, on_pixels=False)
    ranges = torch.tensor([[0, 60], [0, 60], [0, 60]])
    runs = []
    for _ in range(2):
        corners = clip.clone().requires_grad_()
        found = verbs.rasterize(corners, faces, ranges, LAYOUT)
        out = verbs.interpolate(found, corners, faces, corners)
        coverage = verbs.antialias(found, corners, faces)
        grad = torch.autograd.grad(out.sin().sum() + coverage.sin().sum(), corners)[0]
        runs.append((found.face, found.depth, out, coverage, grad))
    for first, second in zip(*runs, strict=True):
        assert torch.equal(first, second)


def test_warp_is_loaded_on_first_use_only_and_says_nothing(tmp_path):
    script = """
import sys, torch
from scene_ir.raster import verbs
assert "warp" not in sys.modules
layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 4, 4]]))
clip = torch.tensor([[0.0, 0, 1], [9, 0, 1], [0, 9, 1]])
found = verbs.rasterize(clip, torch.tensor([[0, 1, 2]]), torch.tensor([[0, 1]]), layout)
assert int((found.face >= 0).sum()) == 16 - (4 if found.face[0] < 0 else 0)
assert "warp" in sys.modules
"""
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=environment, timeout=200, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
