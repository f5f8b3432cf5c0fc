# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportReturnType=false
"""Warp functions for kernels that the CPU runs on 8 or 16 pixels at once; float32, also for CUDA.

The CPU's compiler vectorises a kernel that is a straight line of arithmetic. Such kernels use `load` and `store`
(Warp's indices may be negative, which costs a branch), `exp_` and `log_` instead of the C library's, `wp.where`
for a choice, loops that unroll, no sums over pixels, and few output arrays: one with planes instead of several.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from scene_ir.raster.launch import Floats, start_warp

start_warp()

# With many arrays, LLVM's default limits end its runtime checks for overlaps and overflows before it can vectorise;
# a hundred comparisons per launch cost nothing.
_CHECK_LIMITS = (
    "vectorize-memory-check-threshold",
    "memory-check-merge-threshold",
    "vectorize-scev-check-threshold",
)
SIMD_OPTIONS: dict[str, Any] = {
    "fuse_fp": True,
    "fast_math": False,
    "enable_backward": False,
    "cpu_compiler_flags": " ".join(
        [wp.config.cpu_compiler_flags or "-march=native", *(f"-mllvm=-{name}=1000" for name in _CHECK_LIMITS)]
    ),
}
"""Module options of kernels that use these functions."""
wp.set_module_options(SIMD_OPTIONS)


@wp.func_native("return ((const float*)values.data)[i];")
def load(values: Floats, i: int) -> wp.float32: ...


@wp.func_native("((float*)values.data)[i] = value;")
def store(values: Floats, i: int, value: wp.float32):
    """Write a number without a check of the index.

    Args:
        values: Flat array.
        i: Index.
        value: The number.
    """


@wp.func
def load3(values: Floats, i: int, step: int):
    """Three numbers `step` apart, such as the colour of a pixel in a picture (3, H, W) with step H * W.

    Args:
        values: Flat array.
        i: Index of the first number.
        step: Distance between the numbers.
    """
    return wp.vec3f(load(values, i), load(values, i + step), load(values, i + 2 * step))


@wp.func
def store3(values: Floats, i: int, step: int, value: wp.vec3f):
    """Write three numbers `step` apart.

    Args:
        values: Flat array.
        i: Index of the first number.
        step: Distance between the numbers.
        value: The numbers.
    """
    store(values, i, value[0])
    store(values, i + step, value[1])
    store(values, i + 2 * step, value[2])


@wp.func
def exp_(x: wp.float32):
    """Exponential with relative error 2e-7; exactly 1 at 0; x is clamped to [-87, 88]. Source: Moshier's Cephes,
    `expf`.
    """
    y = wp.min(wp.max(x, -87.0), 88.0)
    n = wp.floor(y * 1.44269504088896341 + 0.5)
    r = (y - n * 0.693359375) + n * 2.12194440e-4
    p = 1.9875691500e-4
    p = p * r + 1.3981999507e-3
    p = p * r + 8.3334519073e-3
    p = p * r + 4.1665795894e-2
    p = p * r + 1.6666665459e-1
    p = p * r + 5.0000001201e-1
    return ((p * r) * r + r + 1.0) * wp.cast((int(n) + 127) << 23, wp.float32)


@wp.func
def log_(x: wp.float32):
    """Natural logarithm of a normal x > 0 with relative error 2e-7; exactly 0 at 1. Source: Moshier's Cephes,
    `logf`.
    """
    bits = wp.cast(x, wp.int32)
    n = (bits - 0x3F3504F3) >> 23  # x = 2^n m with m in [sqrt(1/2), sqrt(2))
    r = wp.cast(bits - (n << 23), wp.float32) - 1.0
    z = r * r
    p = 7.0376836292e-2
    p = p * r - 1.1514610310e-1
    p = p * r + 1.1676998740e-1
    p = p * r - 1.2420140846e-1
    p = p * r + 1.4249322787e-1
    p = p * r - 1.6668057665e-1
    p = p * r + 2.0000714765e-1
    p = p * r - 2.4999993993e-1
    p = p * r + 3.3333331174e-1
    e = float(n)
    return (r + (p * r * z + e * -2.12194440e-4 - 0.5 * z)) + e * 0.693359375


@wp.func
def sum3(x: wp.vec3f):
    """Sum of three components."""
    return x[0] + x[1] + x[2]
