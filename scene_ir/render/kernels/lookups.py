# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportReturnType=false
"""Sums over the 4 x 4 texels of a lookup, all channels of a texel at once; float32, for CUDA as well.

Written in C: of Warp's own vectors a CPU makes one number after the other, and lookups are most of what a picture
costs. The pragma keeps the loop over channels a loop until the compiler widens it; elsewhere it says nothing.
"""

from __future__ import annotations

import warp as wp

from scene_ir.raster.launch import start_warp
from scene_ir.render import channels as ch

start_warp()

DARK = 4
"""Numbers of a shadow's texel: three, and one that fills it up to what a CPU takes at once."""
texel_type = wp.types.vector(length=ch.TEXEL, dtype=wp.float32)
texel_sums = wp.types.matrix(shape=(3, ch.TEXEL), dtype=wp.float32)
dark_sums = wp.types.matrix(shape=(3, DARK), dtype=wp.float32)

_SUMS = """
    const float* data = (const float*)texels.data;
    wp::mat_t<3, WIDTH, wp::float32> out;
    float value[WIDTH] = {}, to_u[WIDTH] = {}, to_v[WIDTH] = {};
    for (int k = 0; k < 4; ++k) {
        const float* a = data + WIDTH * (rows[k] + columns[0]);
        const float* b = data + WIDTH * (rows[k] + columns[1]);
        const float* c = data + WIDTH * (rows[k] + columns[2]);
        const float* d = data + WIDTH * (rows[k] + columns[3]);
        #pragma clang loop unroll(disable) vectorize_width(WIDTH)
        for (int i = 0; i < WIDTH; ++i) {
            const float along = (a[i] * wx[0] + b[i] * wx[1]) + (c[i] * wx[2] + d[i] * wx[3]);
            value[i] += along * wy[k];
            to_v[i] += along * sy[k];
            to_u[i] += ((a[i] * sx[0] + b[i] * sx[1]) + (c[i] * sx[2] + d[i] * sx[3])) * wy[k];
        }
    }
    for (int i = 0; i < WIDTH; ++i) {
        out.data[0][i] = value[i];
        out.data[1][i] = to_u[i];
        out.data[2][i] = to_v[i];
    }
    return out;
"""


@wp.func_native(_SUMS.replace("WIDTH", str(ch.TEXEL)))
def sums_of_texels(
    texels: wp.array(dtype=texel_type),
    rows: wp.vec4i,
    columns: wp.vec4i,
    wx: wp.vec4f,
    wy: wp.vec4f,
    sx: wp.vec4f,
    sy: wp.vec4f,
) -> texel_sums:
    """A texel between texels, how it changes along u, and along v: by the fields of `Taps`."""


@wp.func_native(_SUMS.replace("WIDTH", str(DARK)))
def sums_of_dark(
    texels: wp.array(dtype=wp.vec4f),
    rows: wp.vec4i,
    columns: wp.vec4i,
    wx: wp.vec4f,
    wy: wp.vec4f,
    sx: wp.vec4f,
    sy: wp.vec4f,
) -> dark_sums:
    """The same of what a shadow takes away."""
