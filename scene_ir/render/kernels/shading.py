# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: UP018, RUF046, SIM102, RUF059 - the line above; Warp needs int(0) to declare a variable that a loop changes;
# `wp.grad` returns gradients to all arguments.
"""Pixels of photographed vehicles as Warp kernels: one pass per stage, forward and backward; float32.

Each stage is defined by the plain torch of `reference` and `texture`; constants are in `model`, channels in
`channels`. Gradients of the per-pixel functions come from `wp.grad`; those that gather at vertices are written by
hand. `photographed_pixels` runs the stages. Shapes: N objects, V vertices, T packed pixels.

Arguments of kernels: `start` is the first index; `pixels`, `vertices`, `photograph`, `lookups`, `layers` and
`grads` are the structs below; `partial` and `need` list the pixels to process; `final` means that no painter runs
before mesh and halo are merged; `to_layers` holds gradients to `layers`.
"""

from __future__ import annotations

import warp as wp

from scene_ir.raster.kernels import (
    ONE,
    ZERO,
    BicubicTaps,
    TriangleHit,
    add_corner_gradients,
    bicubic_taps,
    triangle_hit,
)
from scene_ir.raster.launch import (
    Floats,
    Ints,
    Longs,
    Longs2D,
    Mat33fs,
    Vec2ds,
    Vec2fs,
    Vec3ds,
    Vec3fs,
    Vec3is,
    Vec4ds,
    Vec4fs,
    Vec4is,
    start_warp,
)
from scene_ir.raster.verbs import NEAR_M
from scene_ir.render import channels as ch
from scene_ir.render import model

start_warp()
wp.set_module_options({"fuse_fp": True, "fast_math": False, "max_unroll": ch.OWN})

DARKNESS = 4
"""Numbers per texel of a shadow: three, and one that completes what a CPU processes at once."""
texel_t = wp.types.vector(length=ch.TEXEL, dtype=wp.float32)
texel_samples = wp.types.matrix(shape=(3, ch.TEXEL), dtype=wp.float32)
darkness_samples = wp.types.matrix(shape=(3, DARKNESS), dtype=wp.float32)
lookup_t = wp.types.vector(length=ch.LOOKUP, dtype=wp.float32)
attributes_t = wp.types.vector(length=ch.OWN, dtype=wp.float32)
vec5 = wp.types.vector(length=5, dtype=wp.float32)
SUBPIXEL_COUNT = len(model.SUBPIXELS)
SUBPIXELS = wp.constant(
    wp.types.matrix(shape=(SUBPIXEL_COUNT, 2), dtype=wp.float64)(
        *(part / 16.0 for _pixel_xy in model.SUBPIXELS for part in _pixel_xy)
    )
)

DEPTH, STRETCH, OPEN_TURN, OPEN_ALPHA, RIM, OUTLINE_TURN, BORDER, EXTENDED = (
    wp.constant(wp.vec2f(*edges))
    for edges in (
        *(model.DEPTH_TOLERANCE_M, model.STRETCH, model.OPEN_TURN, model.OPEN_ALPHA, model.RIM),
        *([turn * turn for turn in model.OUTLINE_TURN], model.BORDER_PX, model.EXTENDED_PX),
    )
)
(
    OUTLINE_PX,
    RIM_INSET,
    MIRRORED_RIM,
    MIRRORED_COS,
    SOLID,
    SUPPORTED,
    COVERED,
    UNIT,
    OCCLUDED,
    ZENITH_UP,
    HORIZON_UP,
) = (
    wp.constant(wp.vec2f(*edges))
    for edges in (
        *(
            model.OUTLINE_PX,
            model.OUTER_OUTLINE_PX,
            model.MIRRORED_RIM,
            model.MIRRORED_COS,
            model.SOLID_ALPHA,
            model.SUPPORTED,
            model.COVERED,
            (0.0, 1.0),
        ),
        *(model.OCCLUDED[1:], model.ZENITH_UP, model.HORIZON_UP),
    )
)
GRAZING, PAINT_GRAZING = model.GRAZING
OPAQUE, EVEN_SLOPE = 1.0 - 1e-6, 1e-6
AMBIENT, SKYLIGHT = model.AMBIENT
FOOT_LIGHT, HEIGHT_LIGHT = model.OCCLUDED[0], 1.0 - model.OCCLUDED[0]
FRESNEL_REST = 1.0 - model.FRESNEL
GLASS_LEAST, GLASS_MORE = model.GLASS_MIRRORS
GLINT_PAINT, GLINT_GLASS = model.GLINT
GROUND_RGB, HORIZON_RGB, ZENITH_RGB = (
    wp.constant(wp.vec3f(*rgb)) for rgb in (model.GROUND_RGB, model.HORIZON_RGB, model.ZENITH_RGB)
)
UNSEEN = 4
"""Index in `_mesh_colour` of the share to complete; premultiplied RGB and opacity come first."""


@wp.struct
class PackedPixels:
    """The packed pixels of all objects' crops.

    Attributes:
        table: (T,) draw, x, y px, and the width of the draw's rectangle.
        rects: (N, 4) px.
        face: (T,) face that is hit, or -1.
        coverage: (T,).
        nearest: (T,) see `surfaces.nearest_hits`.
    """

    table: Vec4is
    rects: Longs2D
    face: Ints
    coverage: Floats
    nearest: Longs


@wp.struct
class Vertices:
    """Faces of the meshes and their neighbours, and the vertices: fields of `prepare.PlacedGeometry` and
    `fixed_geometry.FixedGeometry`.
    """

    faces: Vec3is
    neighbours: Vec3is
    clip: Vec3fs
    facing: Floats
    brighter: Floats
    base_clip: Vec3fs
    base: Vec3fs
    own: wp.array(dtype=attributes_t)


@wp.struct
class PhotographData:
    """The photograph of each object.

    Attributes:
        texels, rects, offsets: Packed crops.
        frame_wh: (N,) px.
        turn: (N,) cosine and sine of yaw.
        sun: (N,) direction and strength.
        unproject: (N,) from a pixel to its ray.
    """

    texels: wp.array(dtype=texel_t)
    rects: Longs2D
    offsets: Longs
    frame_wh: Vec2fs
    turn: Vec2fs
    sun: Vec4fs
    unproject: Mat33fs


@wp.struct
class PixelHit:
    """A position, px, and what is hit there."""

    hit: TriangleHit
    x: wp.float64
    y: wp.float64


@wp.struct
class Lookups:
    """Values of packed pixels, stage by stage.

    Attributes:
        found: Lookups of partly covered pixels before `extend_kernel`.
        lookup: Lookups, extended over the outline.
        mesh, halo: Premultiplied RGB and opacity.
        unseen: Share of the mesh to complete.
    """

    found: wp.array(dtype=lookup_t)
    lookup: wp.array(dtype=lookup_t)
    mesh: Vec4fs
    halo: Vec4fs
    unseen: Floats


@wp.struct
class MergedLayers:
    """Mesh and halo merged: premultiplied RGB and opacity / depth, opacity, depth in m; or gradients to these."""

    colour: Vec4fs
    opacity: Floats
    depth: Floats


@wp.struct
class PixelGradients:
    """Gradients to the other structs; moved_lookup: see `move_gradients_kernel`."""

    lookup: wp.array(dtype=lookup_t)
    moved_lookup: wp.array(dtype=lookup_t)
    mesh: Vec4fs
    halo: Vec4fs
    unseen: Floats
    coverage: Floats
    clip: Vec3ds
    facing: Floats
    brighter: Floats
    turn: Vec2ds
    sun: Vec4ds


@wp.func
def _smoothstep(x: float, edges: wp.vec2f):
    """`texture.smoothstep`."""
    t = wp.clamp((x - edges[0]) * (1.0 / (edges[1] - edges[0])), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def _smoothstep_slope(x: float, edges: wp.vec2f):
    """Derivative of `_smoothstep`."""
    t = wp.clamp((x - edges[0]) * (1.0 / (edges[1] - edges[0])), 0.0, 1.0)
    return 6.0 * (t - t * t) * (1.0 / (edges[1] - edges[0]))


# ---------------------------------------------------------------------------------------------- pixels of a layout


@wp.kernel(enable_backward=False)
def table_kernel(start: int, rects: Longs2D, offsets: Longs, table: Vec4is):
    """Fill the table of the packed pixels of draws.

    Args:
        start: First draw.
        rects, offsets: Layout of the draws.
        table: See `PackedPixels`.
    """
    draw = start + wp.tid()
    x0 = wp.int32(rects[draw, 0])
    y0 = wp.int32(rects[draw, 1])
    width = wp.int32(rects[draw, 2]) - x0
    at = wp.int32(offsets[draw])
    if width > 0:
        for y in range(wp.int32(rects[draw, 3]) - y0):
            for x in range(width):
                table[at] = wp.vec4i(draw, x0 + x, y0 + y, width)
                at += 1


# ------------------------------------------------------------------------------------------- what a mesh pixel shows


@wp.func
def _corner_values(vertices: Vertices, i: int):
    """A lookup before its division: clip then minus now (3) and w then instead of displacement and depths."""
    then = vertices.base_clip[i]
    delta = then - vertices.clip[i]
    fixed = vertices.base[i]
    turned = vertices.facing[i] - fixed[0]
    bright = vertices.brighter[i]
    return lookup_t(delta[0], delta[1], delta[2], then[2], turned, fixed[0], fixed[1], fixed[2], bright)


@wp.func
def _scaled_pixel(hit: TriangleHit, x: wp.float64, y: wp.float64):
    """A pixel (x, y, 1) over the sum of the edge functions there: factor of their gradients."""
    return wp.vec3d(x, y, wp.float64(1.0)) * hit.scale


@wp.func
def _lookup_dot(a: lookup_t, b: lookup_t):
    """In double precision: differences between corners matter, which are small compared to the values."""
    total = wp.float64(a[0]) * wp.float64(b[0])
    for k in range(1, ch.LOOKUP):
        total += wp.float64(a[k]) * wp.float64(b[k])
    return total


@wp.func
def _attributes_dot(a: attributes_t, b: attributes_t):
    """See `_lookup_dot`."""
    total = wp.float64(a[0]) * wp.float64(b[0])
    for k in range(1, ch.OWN):
        total += wp.float64(a[k]) * wp.float64(b[k])
    return total


@wp.func
def is_partly_covered(pixels: PackedPixels, i: int):
    """Whether a pixel belongs to the mesh and is not fully covered."""
    return pixels.coverage[i] < 1.0 and (pixels.face[i] >= 0 or pixels.coverage[i] > 0.0)


@wp.func
def _saved_lookup(pixels: PackedPixels, lookups: Lookups, i: int):
    """Lookup of a pixel before its extension over the outline."""
    found = lookups.lookup[i]
    if is_partly_covered(pixels, i):
        found = lookups.found[i]
    return found


@wp.kernel(enable_backward=False)
def lookup_kernel(start: int, pixels: PackedPixels, vertices: Vertices, lookups: Lookups):
    """Find where pixels look up the photograph.

    Args:
        start, pixels, vertices, lookups: See the module.
    """
    i = start + wp.tid()
    value = lookup_t()
    if pixels.face[i] >= 0:
        at = pixels.table[i]
        hit = triangle_hit(pixels.face[i], wp.float64(at[1]), wp.float64(at[2]), vertices.clip, vertices.faces)
        a = _corner_values(vertices, hit.i0) * wp.float32(hit.b[0])
        a += _corner_values(vertices, hit.i1) * wp.float32(hit.b[1])
        a += _corner_values(vertices, hit.i2) * wp.float32(hit.b[2])
        value = a
        then = a[ch.CORNER_THEN]
        change = a[ch.CORNER_W]
        value[ch.DISPLACEMENT] = model.FAR_AWAY_PX
        value[ch.DISPLACEMENT + 1] = model.FAR_AWAY_PX
        value[ch.W_THEN] = then
        value[ch.W_NOW] = then - change
        if then > NEAR_M:
            value[ch.DISPLACEMENT] = (a[0] - wp.float32(at[1]) * change) / then
            value[ch.DISPLACEMENT + 1] = (a[1] - wp.float32(at[2]) * change) / then
    lookups.lookup[i] = value


@wp.kernel(enable_backward=False)
def lookup_backward_kernel(
    start: int, pixels: PackedPixels, vertices: Vertices, lookups: Lookups, grads: PixelGradients
):
    """Gradient of `lookup_kernel`.

    Args:
        start, pixels, vertices, lookups, grads: See the module.
    """
    i = start + wp.tid()
    if pixels.face[i] >= 0:
        at = pixels.table[i]
        x = wp.float32(at[1])
        y = wp.float32(at[2])
        hit = triangle_hit(pixels.face[i], wp.float64(at[1]), wp.float64(at[2]), vertices.clip, vertices.faces)
        v = _saved_lookup(pixels, lookups, i)
        go = grads.lookup[i]
        # Back through the division, to the interpolated values.
        g = go
        g[0] = float(0.0)
        g[1] = float(0.0)
        g[ch.CORNER_W] = -go[ch.W_NOW]
        g[ch.CORNER_THEN] = go[ch.W_THEN] + go[ch.W_NOW]
        if v[ch.W_THEN] > NEAR_M:
            g[0] = go[ch.DISPLACEMENT] / v[ch.W_THEN]
            g[1] = go[ch.DISPLACEMENT + 1] / v[ch.W_THEN]
            g[ch.CORNER_W] -= g[0] * x + g[1] * y
            g[ch.CORNER_THEN] -= g[0] * v[ch.DISPLACEMENT] + g[1] * v[ch.DISPLACEMENT + 1]
        s0 = _lookup_dot(g, _corner_values(vertices, hit.i0))
        s1 = _lookup_dot(g, _corner_values(vertices, hit.i1))
        s2 = _lookup_dot(g, _corner_values(vertices, hit.i2))
        mean = hit.b[0] * s0 + hit.b[1] * s1 + hit.b[2] * s2
        q = _scaled_pixel(hit, wp.float64(at[1]), wp.float64(at[2]))
        add_corner_gradients(hit, q * (s0 - mean), q * (s1 - mean), q * (s2 - mean), grads.clip)
        d = wp.vec3d(wp.float64(g[0]), wp.float64(g[1]), wp.float64(g[ch.CORNER_W]))
        wp.atomic_add(grads.clip, hit.i0, d * -hit.b[0])
        wp.atomic_add(grads.clip, hit.i1, d * -hit.b[1])
        wp.atomic_add(grads.clip, hit.i2, d * -hit.b[2])
        wp.atomic_add(grads.facing, hit.i0, g[ch.TURNED] * wp.float32(hit.b[0]))
        wp.atomic_add(grads.facing, hit.i1, g[ch.TURNED] * wp.float32(hit.b[1]))
        wp.atomic_add(grads.facing, hit.i2, g[ch.TURNED] * wp.float32(hit.b[2]))
        if g[ch.BRIGHTER] != 0.0:
            wp.atomic_add(grads.brighter, hit.i0, g[ch.BRIGHTER] * wp.float32(hit.b[0]))
            wp.atomic_add(grads.brighter, hit.i1, g[ch.BRIGHTER] * wp.float32(hit.b[1]))
            wp.atomic_add(grads.brighter, hit.i2, g[ch.BRIGHTER] * wp.float32(hit.b[2]))


# ------------------------------------------------------------------------------------------------------ the outline


@wp.struct
class OutlineBlend:
    """Blend of a pixel at a mesh's outline with its neighbours: a row of `reference._OutlineRows`."""

    known: wp.vec4f
    weight: wp.vec4f
    total: float
    own: float
    hit: float
    pixel: wp.vec4i


@wp.func
def _outline_blend(pixels: PackedPixels, i: int):
    out = OutlineBlend()
    at = pixels.table[i]
    draw = at[0]
    out.pixel = wp.vec4i(i, i, i, i)
    if at[1] > wp.int32(pixels.rects[draw, 0]):
        out.pixel[0] = i - 1
    if at[1] + 1 < wp.int32(pixels.rects[draw, 2]):
        out.pixel[1] = i + 1
    if at[2] > wp.int32(pixels.rects[draw, 1]):
        out.pixel[2] = i - at[3]
    if at[2] + 1 < wp.int32(pixels.rects[draw, 3]):
        out.pixel[3] = i + at[3]
    total = float(0.0)
    for k in range(4):
        j = out.pixel[k]
        if j != i:
            if pixels.face[j] >= 0:
                raw = wp.max(2.0 * pixels.coverage[j] - 1.0, 0.0) + model.LEAST_NEIGHBOUR
                out.known[k] = 1.0
                out.weight[k] = raw
                total += raw
    out.total = wp.max(total, model.LEAST_NEIGHBOUR)
    out.weight = out.weight / out.total
    if pixels.face[i] >= 0:
        out.hit = 1.0
    out.own = 1.0
    if total > 0.0:
        out.own = _smoothstep(pixels.coverage[i], COVERED) * out.hit
    return out


@wp.kernel(enable_backward=False)
def save_kernel(start: int, partial: Longs, lookups: Lookups):
    """Save the lookups of partly covered pixels before `extend_kernel`.

    Args:
        start, partial, lookups: See the module.
    """
    i = wp.int32(partial[start + wp.tid()])
    if i < 0:
        return
    lookups.found[i] = lookups.lookup[i]


@wp.kernel(enable_backward=False)
def extend_kernel(start: int, partial: Longs, pixels: PackedPixels, lookups: Lookups):
    """Extend the lookups over the outline.

    Args:
        start, partial, pixels, lookups: See the module.
    """
    i = wp.int32(partial[start + wp.tid()])
    if i < 0:
        return
    f = _outline_blend(pixels, i)
    mean = (
        _saved_lookup(pixels, lookups, f.pixel[0]) * f.weight[0]
        + _saved_lookup(pixels, lookups, f.pixel[1]) * f.weight[1]
    )
    mean += (
        _saved_lookup(pixels, lookups, f.pixel[2]) * f.weight[2]
        + _saved_lookup(pixels, lookups, f.pixel[3]) * f.weight[3]
    )
    lookups.lookup[i] = lookups.found[i] * (f.own * f.hit) + mean * (1.0 - f.own)


@wp.kernel(enable_backward=False)
def move_gradients_kernel(start: int, partial: Longs, grads: PixelGradients):
    """Move the gradients of partly covered pixels aside, for `extend_backward_kernel` to distribute.

    Args:
        start, partial, grads: See the module.
    """
    i = wp.int32(partial[start + wp.tid()])
    if i < 0:
        return
    grads.moved_lookup[i] = grads.lookup[i]
    grads.lookup[i] = lookup_t()


@wp.func
def _outline_to_coverage(
    pixels: PackedPixels, i: int, f: OutlineBlend, to_own: float, to_weight: wp.vec4f, grads: PixelGradients
):
    """Add gradients to a pixel's own weight and its neighbours' weights to their coverages."""
    shared = wp.dot(to_weight, f.weight)
    for n in range(4):
        if f.known[n] > 0.0:
            if pixels.coverage[f.pixel[n]] >= 0.5:
                wp.atomic_add(grads.coverage, f.pixel[n], 2.0 * (to_weight[n] - shared) / f.total)
    if f.known[0] + f.known[1] + f.known[2] + f.known[3] > 0.0:
        wp.atomic_add(grads.coverage, i, to_own * f.hit * _smoothstep_slope(pixels.coverage[i], COVERED))


@wp.kernel(enable_backward=False)
def extend_backward_kernel(
    start: int, partial: Longs, pixels: PackedPixels, lookups: Lookups, grads: PixelGradients
):
    """Gradient of `extend_kernel`.

    Args:
        start, partial, pixels, lookups, grads: See the module.
    """
    i = wp.int32(partial[start + wp.tid()])
    if i < 0:
        return
    f = _outline_blend(pixels, i)
    g = grads.moved_lookup[i]
    rest = 1.0 - f.own
    wp.atomic_add(grads.lookup, i, g * (f.own * f.hit))
    to_own = f.hit * wp.dot(g, lookups.found[i])
    to_weight = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    for n in range(4):
        if f.known[n] > 0.0:
            wp.atomic_add(grads.lookup, f.pixel[n], g * (rest * f.weight[n]))
            along = wp.dot(g, _saved_lookup(pixels, lookups, f.pixel[n]))
            to_own -= f.weight[n] * along
            to_weight[n] = rest * along
    _outline_to_coverage(pixels, i, f, to_own, to_weight, grads)


# --------------------------------------------------------------------------------------- looking up the photograph


_SAMPLE = """
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


@wp.func_native(_SAMPLE.replace("WIDTH", str(ch.TEXEL)))
def sample_texels(
    texels: wp.array(dtype=texel_t),
    rows: wp.vec4i,
    columns: wp.vec4i,
    wx: wp.vec4f,
    wy: wp.vec4f,
    sx: wp.vec4f,
    sy: wp.vec4f,
) -> texel_samples:
    """A texel between texels and its changes along u and v; the other arguments are fields of `BicubicTaps`.

    Args:
        texels: Packed texels.
        others: Fields of `BicubicTaps`.
    """


@wp.func_native(_SAMPLE.replace("WIDTH", str(DARKNESS)))
def sample_darkness(
    texels: Vec4fs, rows: wp.vec4i, columns: wp.vec4i, wx: wp.vec4f, wy: wp.vec4f, sx: wp.vec4f, sy: wp.vec4f
) -> darkness_samples:
    """`sample_texels` for shadows.

    Args:
        texels: Packed texels.
        others: Fields of `BicubicTaps`.
    """


@wp.struct
class TexelSample:
    """A texel between texels, and its changes along u and v."""

    value: texel_t
    to_u: texel_t
    to_v: texel_t


@wp.func
def _sample(texels: wp.array(dtype=texel_t), t: BicubicTaps):
    return sample_texels(texels, t.rows, t.columns, t.wx, t.wy, t.sx, t.sy)[0]


@wp.func
def _sample_with_slopes(texels: wp.array(dtype=texel_t), t: BicubicTaps):
    sums = sample_texels(texels, t.rows, t.columns, t.wx, t.wy, t.sx, t.sy)
    out = TexelSample()
    out.value = sums[0]
    out.to_u = sums[1]
    out.to_v = sums[2]
    return out


@wp.func
def read_rect(rects: Longs2D, i: int):
    return wp.vec4i(wp.int32(rects[i, 0]), wp.int32(rects[i, 1]), wp.int32(rects[i, 2]), wp.int32(rects[i, 3]))


@wp.func
def crop_taps(uv: wp.vec2f, rect: wp.vec4i, start: wp.int64, clamp: bool):
    """Taps of a position in a crop.

    Args:
        uv: Position in the frame, px.
        rect: The crop.
        start: Its first texel.
        clamp: Whether edge texels repeat.
    """
    return bicubic_taps(uv, rect[0], rect[1], rect[2] - rect[0], rect[3] - rect[1], wp.int32(start), 1, clamp)


@wp.func
def _texel_at(photograph: PhotographData, draw: int, uv: wp.vec2f):
    """The texel at a position of the frame; 0 in an empty crop."""
    out = texel_t()
    rect = read_rect(photograph.rects, draw)
    if rect[2] > rect[0]:
        out = _sample(photograph.texels, crop_taps(uv, rect, photograph.offsets[draw], True))
    return out


@wp.func
def _texel_with_slopes(photograph: PhotographData, draw: int, uv: wp.vec2f):
    """`_texel_at`, and its changes."""
    out = TexelSample()
    rect = read_rect(photograph.rects, draw)
    if rect[2] > rect[0]:
        out = _sample_with_slopes(photograph.texels, crop_taps(uv, rect, photograph.offsets[draw], True))
    return out


# ------------------------------------------------------------------------------------ a pixel of mesh, of its halo


@wp.func
def inside_weight(u: float, v: float, wh: wp.vec2f, edges: wp.vec2f):
    """`texture.inside_weight`.

    Args:
        u, v: Position, px.
        wh: Width and height, px.
        edges: Distances beyond the border.
    """
    beyond_u = wp.max(-u, u - (wh[0] - 1.0))
    beyond_v = wp.max(-v, v - (wh[1] - 1.0))
    return (1.0 - _smoothstep(beyond_u, edges)) * (1.0 - _smoothstep(beyond_v, edges))


@wp.func
def _facing_weight(turned: float, cos_then: float, paint: float):
    """`texture.facing_weight`."""
    positive = 0.5 * (cos_then + wp.sqrt(cos_then * cos_then + model.SQUARED_COS))
    slack = GRAZING + (PAINT_GRAZING - GRAZING) * paint
    return 1.0 - _smoothstep(turned / (positive + slack), STRETCH)


@wp.func
def _pixel_xy(pixels: PackedPixels, i: int):
    """Position of a packed pixel, px."""
    at = pixels.table[i]
    return wp.vec2f(wp.float32(at[1]), wp.float32(at[2]))


@wp.func
def _photograph_xy(lookup: lookup_t, xy: wp.vec2f):
    """Photograph position of a pixel, px."""
    return wp.vec2f(xy[0] + lookup[ch.DISPLACEMENT], xy[1] + lookup[ch.DISPLACEMENT + 1])


@wp.func
def _visible_weight(lookup: lookup_t, texel: texel_t, xy: wp.vec2f, wh: wp.vec2f):
    """Share of the pixel that the photograph knows; and share that it sees there at all."""
    u = xy[0] + lookup[ch.DISPLACEMENT]
    v = xy[1] + lookup[ch.DISPLACEMENT + 1]
    clear = 1.0 - _smoothstep(texel[ch.HIDDEN], UNIT)
    inside = inside_weight(u, v, wh, BORDER)
    facing = _facing_weight(lookup[ch.TURNED], lookup[ch.COS_THEN], lookup[ch.PAINT])
    weight = facing * inside * clear
    if inside < 1.0:
        near = inside_weight(u, v, wh, EXTENDED) * _smoothstep(texel[ch.ALPHA], SOLID)
        weight = weight + facing * (1.0 - inside) * near * clear
    weight = weight * (1.0 - _smoothstep(lookup[ch.W_THEN] - texel[ch.DEPTH], DEPTH))
    return wp.vec2f(weight, inside * clear)


@wp.func
def _relight(c: float, brighter: float):
    """`texture.relight`, one channel."""
    return c * (1.0 + brighter * (1.0 - c * c))


@wp.func
def _relight_slope(c: float, brighter: float):
    """Its derivative to the colour."""
    return 1.0 + brighter * (1.0 - 3.0 * c * c)


@wp.func
def _mesh_colour(lookup: lookup_t, texel: texel_t, xy: wp.vec2f, wh: wp.vec2f):
    """Premultiplied RGB, opacity, and the share to complete."""
    seen = _visible_weight(lookup, texel, xy, wh)
    weight = seen[0]
    alpha = texel[ch.ALPHA]
    rim = 1.0 - _smoothstep(lookup[ch.COS_THEN], RIM)
    opened = _smoothstep(lookup[ch.TURNED], OPEN_TURN) * rim * wp.max(1.0 - alpha, 0.0)
    empty = seen[1] * (1.0 - _smoothstep(texel[ch.SUPPORT], SUPPORTED))
    closed = weight * opened * (1.0 - empty) * _smoothstep(alpha, OPEN_ALPHA)
    texel_weight = weight + closed / wp.max(alpha, OPEN_ALPHA[0])
    out = vec5()
    out[0] = texel_weight * _relight(texel[0], lookup[ch.BRIGHTER])
    out[1] = texel_weight * _relight(texel[1], lookup[ch.BRIGHTER])
    out[2] = texel_weight * _relight(texel[2], lookup[ch.BRIGHTER])
    out[ch.ALPHA] = texel_weight * alpha
    out[UNSEEN] = (1.0 - weight) * (1.0 - empty)
    return out


@wp.func
def _is_plainly_visible(lookup: lookup_t, texel: texel_t, u: float, v: float, wh: wp.vec2f):
    """Whether all weights of `_mesh_colour` are constant at full: then it is the relit texel, and so is its
    gradient.
    """
    seen = (
        texel[ch.HIDDEN] <= 0.0
        and texel[ch.SUPPORT] >= SUPPORTED[1]
        and lookup[ch.W_THEN] - texel[ch.DEPTH] <= DEPTH[0]
    )
    if seen:
        seen = (
            u >= -BORDER[0] and u <= wh[0] - 1.0 + BORDER[0] and v >= -BORDER[0] and v <= wh[1] - 1.0 + BORDER[0]
        )
    if seen:  # no exposed outline: it did not turn, lies inside, or is opaque
        seen = lookup[ch.TURNED] <= OPEN_TURN[0] or lookup[ch.COS_THEN] >= RIM[1] or texel[ch.ALPHA] >= OPAQUE
    if seen:
        seen = lookup[ch.TURNED] <= STRETCH[0] * (PAINT_GRAZING + wp.max(lookup[ch.COS_THEN], 0.0))
    return seen


@wp.func
def _mesh_loss(lookup: lookup_t, texel: texel_t, xy: wp.vec2f, wh: wp.vec2f, g: wp.vec4f, to_unseen: float):
    p = _mesh_colour(lookup, texel, xy, wh)
    return p[0] * g[0] + p[1] * g[1] + p[2] * g[2] + p[3] * g[3] + p[UNSEEN] * to_unseen


@wp.func
def _outline_share(texel: texel_t):
    """`texture.outline_share`."""
    return 1.0 - _smoothstep(texel[ch.INSET], OUTLINE_PX)


@wp.func
def _halo_colour(lookup: lookup_t, texel: texel_t, inset: float, xy: wp.vec2f, wh: wp.vec2f):
    """Premultiplied RGB and opacity. inset: of the mesh pixel with which this one moves."""
    seen = _visible_weight(lookup, texel, xy, wh)
    on_outline = 1.0 - _smoothstep(lookup[ch.TURNED] * lookup[ch.TURNED], OUTLINE_TURN)
    texel_weight = (
        seen[0] * _smoothstep(_outline_share(texel), UNIT) * on_outline * (1.0 - _smoothstep(inset, RIM_INSET))
    )
    return wp.vec4f(
        texel_weight * _relight(texel[0], lookup[ch.BRIGHTER]),
        texel_weight * _relight(texel[1], lookup[ch.BRIGHTER]),
        texel_weight * _relight(texel[2], lookup[ch.BRIGHTER]),
        texel_weight * texel[ch.ALPHA],
    )


@wp.func
def _halo_loss(lookup: lookup_t, texel: texel_t, inset: float, xy: wp.vec2f, wh: wp.vec2f, g: wp.vec4f):
    return wp.dot(_halo_colour(lookup, texel, inset, xy, wh), g)


@wp.func
def _in_mesh(pixels: PackedPixels, i: int):
    return pixels.face[i] >= 0 or pixels.coverage[i] > 0.0


@wp.func
def _in_halo(pixels: PackedPixels, i: int):
    return pixels.nearest[i] >= wp.int64(0) and pixels.coverage[i] < 1.0


# --------------------------------------------------------------------------------------------- mesh and halo as one


@wp.func
def _write_layer(pixels: PackedPixels, lookups: Lookups, layers: MergedLayers, i: int, m: wp.vec4f, h: wp.vec4f):
    """Merge a pixel's mesh m and halo h."""
    c = wp.vec3f(0.0, 0.0, 0.0)
    inverse = float(0.0)
    solid = float(0.0)
    z = float(wp.inf)
    if _in_mesh(pixels, i):
        share = pixels.coverage[i]
        near = lookups.lookup[i][ch.W_NOW]
        a = m[3] * share
        c = wp.vec3f(m[0], m[1], m[2]) * share
        solid = a
        inverse = a / wp.max(near, NEAR_M)
        z = near
    if _in_halo(pixels, i):
        share = 1.0 - pixels.coverage[i]
        near = lookups.lookup[wp.int32(pixels.nearest[i])][ch.W_NOW]
        a = h[3] * share
        c += wp.vec3f(h[0], h[1], h[2]) * share
        solid += a
        inverse += a / wp.max(near, NEAR_M)
        z = wp.min(z, near)
    layers.colour[i] = wp.vec4f(c[0], c[1], c[2], inverse)
    layers.opacity[i] = solid
    layers.depth[i] = z


@wp.func
def _layer_gradient(lookups: Lookups, to_layers: MergedLayers, i: int, j: int):
    """Gradient to the mesh or halo of pixel i, by the lookup of pixel j, before its share."""
    g = to_layers.colour[i]
    return wp.vec4f(g[0], g[1], g[2], to_layers.opacity[i] + g[3] / wp.max(lookups.lookup[j][ch.W_NOW], NEAR_M))


@wp.func
def _add_depth_gradient(
    lookups: Lookups, to_layers: MergedLayers, i: int, j: int, solid: float, grads: PixelGradients
):
    """Add the gradient to opacity / depth to that of the depth there. solid: opacity of the part."""
    inverse = to_layers.colour[i][3]
    z = lookups.lookup[j][ch.W_NOW]
    if inverse != 0.0 and z > NEAR_M:
        to_z = lookup_t()
        to_z[ch.W_NOW] = -inverse * solid / (z * z)
        wp.atomic_add(grads.lookup, j, to_z)


@wp.kernel(enable_backward=False)
def combine_kernel(start: int, pixels: PackedPixels, lookups: Lookups, layers: MergedLayers):
    """Merge mesh and halo.

    Args:
        start, pixels, lookups, layers: See the module.
    """
    i = start + wp.tid()
    _write_layer(pixels, lookups, layers, i, lookups.mesh[i], lookups.halo[i])


@wp.kernel(enable_backward=False)
def combine_backward_kernel(
    start: int, pixels: PackedPixels, lookups: Lookups, to_layers: MergedLayers, grads: PixelGradients
):
    """Gradient of `combine_kernel` to mesh and halo.

    Args:
        start, pixels, lookups, to_layers, grads: See the module.
    """
    i = start + wp.tid()
    to_mesh = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    to_halo = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    if _in_mesh(pixels, i):
        to_mesh = _layer_gradient(lookups, to_layers, i, i) * pixels.coverage[i]
    if _in_halo(pixels, i):
        j = wp.int32(pixels.nearest[i])
        to_halo = _layer_gradient(lookups, to_layers, i, j) * (1.0 - pixels.coverage[i])
    grads.mesh[i] = to_mesh
    grads.halo[i] = to_halo


@wp.kernel(enable_backward=False)
def shade_kernel(
    start: int,
    pixels: PackedPixels,
    photograph: PhotographData,
    lookups: Lookups,
    final: bool,
    layers: MergedLayers,
):
    """Colour mesh and halo by the photograph.

    Args:
        start, pixels, photograph, lookups, final, layers: See the module.
    """
    i = start + wp.tid()
    at = pixels.table[i]
    to_mesh = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    to_halo = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    unseen = float(0.0)
    xy = _pixel_xy(pixels, i)
    wh = photograph.frame_wh[at[0]]
    if _in_mesh(pixels, i):
        a = lookups.lookup[i]
        uv = _photograph_xy(a, xy)
        texel = _texel_at(photograph, at[0], uv)
        bright = a[ch.BRIGHTER]
        alpha = texel[ch.ALPHA]
        to_mesh = wp.vec4f(
            _relight(texel[0], bright), _relight(texel[1], bright), _relight(texel[2], bright), alpha
        )
        if not _is_plainly_visible(a, texel, uv[0], uv[1], wh):
            p = _mesh_colour(a, texel, xy, wh)
            to_mesh = wp.vec4f(p[0], p[1], p[2], p[3])
            unseen = p[UNSEEN]
    if _in_halo(pixels, i):
        j = wp.int32(pixels.nearest[i])
        a = lookups.lookup[j]
        texel = _texel_at(photograph, at[0], _photograph_xy(a, xy))
        if texel[ch.ALPHA] != 0.0:  # else it is empty
            inset = _texel_at(photograph, at[0], _photograph_xy(a, _pixel_xy(pixels, j)))[ch.INSET]
            to_halo = _halo_colour(a, texel, inset, xy, wh)
    lookups.mesh[i] = to_mesh
    lookups.halo[i] = to_halo
    lookups.unseen[i] = unseen
    if final:
        _write_layer(pixels, lookups, layers, i, to_mesh, to_halo)


@wp.kernel(enable_backward=False)
def shade_backward_kernel(
    start: int,
    pixels: PackedPixels,
    photograph: PhotographData,
    lookups: Lookups,
    final: bool,
    to_layers: MergedLayers,
    grads: PixelGradients,
):
    """Gradient of `shade_kernel`.

    Args:
        start, pixels, photograph, lookups, final, to_layers, grads: See the module.
    """
    i = start + wp.tid()
    to_share = float(0.0)
    at = pixels.table[i]
    xy = _pixel_xy(pixels, i)
    wh = photograph.frame_wh[at[0]]
    if _in_mesh(pixels, i):
        a = lookups.lookup[i]
        uv = _photograph_xy(a, xy)
        g = _layer_gradient(lookups, to_layers, i, i)
        m = lookups.mesh[i]
        to_share = wp.dot(g, m)
        _add_depth_gradient(lookups, to_layers, i, i, m[3] * pixels.coverage[i], grads)
        g = g * pixels.coverage[i]
        if not final:
            g = grads.mesh[i]
        # Else nothing depends on it, such as behind another vehicle.
        if grads.unseen[i] != 0.0 or g[0] != 0.0 or g[1] != 0.0 or g[2] != 0.0 or g[3] != 0.0:
            texel = _texel_with_slopes(photograph, at[0], uv)
            c = texel.value
            to_lookup = lookup_t()
            to_texel = texel_t()
            to_texel[ch.ALPHA] = g[3]
            for k in range(3):
                to_texel[k] = g[k] * _relight_slope(c[k], a[ch.BRIGHTER])
                to_lookup[ch.BRIGHTER] += g[k] * c[k] * (1.0 - c[k] * c[k])
            # Where opacity changes along a surface that turned, so does the share of exposed outline.
            even = (
                a[ch.TURNED] <= OPEN_TURN[0]
                or wp.max(wp.abs(texel.to_u[ch.ALPHA]), wp.abs(texel.to_v[ch.ALPHA])) <= EVEN_SLOPE
            )
            if not (even and _is_plainly_visible(a, texel.value, uv[0], uv[1], wh)):
                to_lookup, to_texel, to_xy, to_wh, to_g, to_f = wp.grad(_mesh_loss)(
                    a, texel.value, xy, wh, g, grads.unseen[i]
                )
            to_lookup[ch.DISPLACEMENT] += wp.dot(to_texel, texel.to_u)
            to_lookup[ch.DISPLACEMENT + 1] += wp.dot(to_texel, texel.to_v)
            wp.atomic_add(grads.lookup, i, to_lookup)
    if _in_halo(pixels, i):
        j = wp.int32(pixels.nearest[i])
        b = lookups.lookup[j]
        halo_g = _layer_gradient(lookups, to_layers, i, j)
        h = lookups.halo[i]
        to_share -= wp.dot(halo_g, h)
        _add_depth_gradient(lookups, to_layers, i, j, h[3] * (1.0 - pixels.coverage[i]), grads)
        halo_g = halo_g * (1.0 - pixels.coverage[i])
        if not final:
            halo_g = grads.halo[i]
        outer = _texel_with_slopes(photograph, at[0], _photograph_xy(b, xy))
        if (
            outer.value[ch.ALPHA] != 0.0 or outer.to_u[ch.ALPHA] != 0.0 or outer.to_v[ch.ALPHA] != 0.0
        ):  # else its surroundings are empty
            anchor = _texel_with_slopes(photograph, at[0], _photograph_xy(b, _pixel_xy(pixels, j)))
            to_anchor, to_outer, to_inset, _to_halo_xy, _to_halo_wh, _to_halo_g = wp.grad(_halo_loss)(
                b, outer.value, anchor.value[ch.INSET], xy, wh, halo_g
            )
            to_anchor[ch.DISPLACEMENT] += wp.dot(to_outer, outer.to_u) + to_inset * anchor.to_u[ch.INSET]
            to_anchor[ch.DISPLACEMENT + 1] += wp.dot(to_outer, outer.to_v) + to_inset * anchor.to_v[ch.INSET]
            wp.atomic_add(grads.lookup, j, to_anchor)
    wp.atomic_add(grads.coverage, i, to_share)


# ------------------------------------------------------------------- completion of what the photograph did not see


@wp.func
def _centre_hit(pixels: PackedPixels, vertices: Vertices, i: int):
    """What a pixel's centre hits."""
    at = pixels.table[i]
    spot = PixelHit()
    spot.x = wp.float64(at[1])
    spot.y = wp.float64(at[2])
    spot.hit = triangle_hit(pixels.face[i], spot.x, spot.y, vertices.clip, vertices.faces)
    return spot


@wp.func
def _subpixel_hit(centre: PixelHit, face: int, k: int, vertices: Vertices):
    """`reference._walk_mesh` to the k-th position within a pixel, if its centre hits a face."""
    spot = PixelHit()
    spot.x = centre.x + SUBPIXELS[k, 0]
    spot.y = centre.y + SUBPIXELS[k, 1]
    front = wp.dot(centre.hit.c0, wp.cross(centre.hit.c1, centre.hit.c2))
    found = bool(False)
    passed = int(0)
    here = face
    while passed < model.WALK and here >= 0 and not found:
        spot.hit = triangle_hit(here, spot.x, spot.y, vertices.clip, vertices.faces)
        det = wp.dot(spot.hit.c0, wp.cross(spot.hit.c1, spot.hit.c2))
        side = spot.hit.e * wp.sign(det)
        nearest = int(0)
        if side[1] < side[0]:
            nearest = 1
        if side[2] < side[nearest]:
            nearest = 2
        if det * front <= ZERO:
            here = -1
        elif side[nearest] >= ZERO:
            found = True
        else:
            here = vertices.neighbours[here][nearest]
        passed += 1
    if not found:
        spot = centre
    return spot


@wp.func
def _average_attributes(pixels: PackedPixels, vertices: Vertices, i: int):
    """Mesh attributes averaged over a pixel that it hits, else 0."""
    value = attributes_t()
    if pixels.face[i] >= 0:
        centre = _centre_hit(pixels, vertices, i)
        k = int(0)
        while k < SUBPIXEL_COUNT:
            hit = _subpixel_hit(centre, pixels.face[i], k, vertices).hit
            value += vertices.own[hit.i0] * wp.float32(hit.b[0])
            value += vertices.own[hit.i1] * wp.float32(hit.b[1])
            value += vertices.own[hit.i2] * wp.float32(hit.b[2])
            k += 1
    return value * (1.0 / float(SUBPIXEL_COUNT))


@wp.func
def _blended_attributes(pixels: PackedPixels, vertices: Vertices, i: int):
    """`_average_attributes`, extended over the outline."""
    value = _average_attributes(pixels, vertices, i)
    if is_partly_covered(pixels, i):
        f = _outline_blend(pixels, i)
        value = value * (f.own * f.hit)
        for n in range(4):
            if f.known[n] > 0.0:
                value += _average_attributes(pixels, vertices, f.pixel[n]) * ((1.0 - f.own) * f.weight[n])
    return value


@wp.func
def _attributes_to_clip(
    pixels: PackedPixels, vertices: Vertices, i: int, g: attributes_t, share: float, grads: PixelGradients
):
    """Add `share` of a gradient to `_average_attributes` to the corners; returns g . attributes."""
    centre = _centre_hit(pixels, vertices, i)
    each = ONE / wp.float64(SUBPIXEL_COUNT)
    total = ZERO
    last = centre.hit
    s = _corner_products(vertices, last, g)
    q0 = wp.vec3d(ZERO, ZERO, ZERO)
    q1 = wp.vec3d(ZERO, ZERO, ZERO)
    q2 = wp.vec3d(ZERO, ZERO, ZERO)
    k = int(0)
    while k < SUBPIXEL_COUNT:
        spot = _subpixel_hit(centre, pixels.face[i], k, vertices)
        hit = spot.hit
        if hit.i0 != last.i0 or hit.i1 != last.i1 or hit.i2 != last.i2:
            add_corner_gradients(last, q0, q1, q2, grads.clip)
            q0 = wp.vec3d(ZERO, ZERO, ZERO)
            q1 = wp.vec3d(ZERO, ZERO, ZERO)
            q2 = wp.vec3d(ZERO, ZERO, ZERO)
            last = hit
            s = _corner_products(vertices, last, g)
        mean = wp.dot(hit.b, s)
        total += mean * each
        q = _scaled_pixel(hit, spot.x, spot.y) * (wp.float64(share) * each)
        q0 += q * (s[0] - mean)
        q1 += q * (s[1] - mean)
        q2 += q * (s[2] - mean)
        k += 1
    add_corner_gradients(last, q0, q1, q2, grads.clip)
    return wp.float32(total)


@wp.func
def _corner_products(vertices: Vertices, hit: TriangleHit, g: attributes_t):
    """Dot products of a gradient with the attributes of a face's corners."""
    return wp.vec3d(
        _attributes_dot(g, vertices.own[hit.i0]),
        _attributes_dot(g, vertices.own[hit.i1]),
        _attributes_dot(g, vertices.own[hit.i2]),
    )


@wp.func
def _attributes_backward(pixels: PackedPixels, vertices: Vertices, i: int, g: attributes_t, grads: PixelGradients):
    """Add a gradient to `_blended_attributes` to corners and coverages."""
    if is_partly_covered(pixels, i):
        f = _outline_blend(pixels, i)
        rest = 1.0 - f.own
        to_own = float(0.0)
        if pixels.face[i] >= 0:
            to_own = _attributes_to_clip(pixels, vertices, i, g, f.own, grads)
        to_weight = wp.vec4f(0.0, 0.0, 0.0, 0.0)
        for n in range(4):
            if f.known[n] > 0.0:
                along = _attributes_to_clip(pixels, vertices, f.pixel[n], g, rest * f.weight[n], grads)
                to_own -= f.weight[n] * along
                to_weight[n] = rest * along
        _outline_to_coverage(pixels, i, f, to_own, to_weight, grads)
    elif pixels.face[i] >= 0:
        _attributes_to_clip(pixels, vertices, i, g, 1.0, grads)


@wp.func
def _unit(v: wp.vec3f):
    return v / wp.max(wp.length(v), 1e-6)


@wp.func
def _clamp01(v: wp.vec3f):
    return wp.vec3f(wp.clamp(v[0], 0.0, 1.0), wp.clamp(v[1], 0.0, 1.0), wp.clamp(v[2], 0.0, 1.0))


@wp.func
def _shade(
    normal: wp.vec3f,
    to_eye: wp.vec3f,
    albedo: wp.vec3f,
    paint: float,
    glass: float,
    height: float,
    sunlit: wp.vec4f,
):
    """`texture.shade_template`, one row. sunlit: direction and strength of the sun."""
    sun = wp.vec3f(sunlit[0], sunlit[1], sunlit[2])
    dome = 0.5 - 0.5 * normal[1]
    soft = wp.dot(normal, sun)
    direct = 0.5 * (soft + wp.sqrt(soft * soft + model.TERMINATOR))
    occluded = FOOT_LIGHT + HEIGHT_LIGHT * _smoothstep(height, OCCLUDED)
    diffuse = ((AMBIENT + SKYLIGHT * dome) + sunlit[3] * direct) * occluded
    cosine = wp.clamp(wp.dot(normal, to_eye), 0.0, 1.0)
    mirror = normal * (2.0 * cosine) - to_eye
    above = HORIZON_RGB + (ZENITH_RGB - HORIZON_RGB) * _smoothstep(-mirror[1], ZENITH_UP)
    surround = GROUND_RGB + (above - GROUND_RGB) * _smoothstep(-mirror[1], HORIZON_UP)
    rest = 1.0 - cosine
    fresnel = model.FRESNEL + FRESNEL_REST * (rest * rest) * (rest * rest) * rest
    mirrored = model.PAINT_MIRRORS * paint * fresnel + glass * (GLASS_LEAST + GLASS_MORE * fresnel)
    strength = mirrored * (0.5 + 0.5 * occluded)
    g = wp.clamp(wp.dot(mirror, sun), 0.0, 1.0)
    halo_g = g * g
    g4 = halo_g * halo_g
    g8 = g4 * g4
    g32 = (g8 * g8) * (g8 * g8)
    glint = (g32 * g8) * (GLINT_PAINT * paint + GLINT_GLASS * glass)
    lit = albedo * diffuse
    return lit + (surround - lit) * strength + (wp.vec3f(1.0, 1.0, 1.0) - lit) * glint


@wp.func
def _mirrored_xy(own: attributes_t):
    """Photograph position of the car's other side, px."""
    safe = wp.max(own[ch.MIRROR + 2], model.NEAREST_MIRRORED_M)
    return wp.vec2f(own[ch.MIRROR] / safe, own[ch.MIRROR + 1] / safe)


@wp.func
def _complete(
    own: attributes_t, facing: float, texel: texel_t, turn: wp.vec2f, to_eye: wp.vec3f, sun: wp.vec4f, wh: wp.vec2f
):
    """`reference._complete_unseen`, one row. own: attributes with local normals; facing: cosine towards the camera
    now.
    """
    # Each use reads `own` again, which fixes the order in which gradients are summed.
    normal = _unit(
        wp.vec3f(
            turn[0] * own[ch.NORMAL] + turn[1] * own[ch.NORMAL + 2],
            own[ch.NORMAL + 1],
            turn[0] * own[ch.NORMAL + 2] - turn[1] * own[ch.NORMAL],
        )
    )
    albedo = wp.vec3f(own[0], own[1], own[2])
    light = _shade(normal, to_eye, albedo, own[ch.OWN_PAINT], own[ch.OWN_GLASS], own[ch.OWN_HEIGHT], sun)
    dark = wp.vec3f(
        wp.exp(-light[0] * own[ch.GAIN]),
        wp.exp(-light[1] * own[ch.GAIN + 1]),
        wp.exp(-light[2] * own[ch.GAIN + 2]),
    )
    colour = wp.vec3f(1.0, 1.0, 1.0) - dark * (1.0 - own[ch.LIFT])  # `texture.apply_finish`
    uv = _mirrored_xy(own)
    weight = inside_weight(uv[0], uv[1], wh, BORDER)
    weight = weight * (1.0 - _smoothstep(texel[ch.HIDDEN], UNIT)) * _smoothstep(texel[ch.ALPHA], SOLID)
    weight = weight * (1.0 - _smoothstep(own[ch.MIRROR + 2] - texel[ch.DEPTH], DEPTH))
    facing_now = _facing_weight(facing - own[ch.MIRROR_COS], own[ch.MIRROR_COS], own[ch.OWN_PAINT])
    weight = weight * facing_now * _smoothstep(own[ch.MIRROR_COS], MIRRORED_COS)
    weight = weight * (1.0 - _smoothstep(_outline_share(texel), MIRRORED_RIM))
    straight = _clamp01(
        wp.vec3f(texel[0], texel[1], texel[2]) / wp.max(texel[ch.ALPHA], model.LEAST_MIRRORED_ALPHA)
    )
    return colour + (straight - colour) * weight


@wp.func
def _completion_loss(
    own: attributes_t,
    facing: float,
    texel: texel_t,
    turn: wp.vec2f,
    to_eye: wp.vec3f,
    sun: wp.vec4f,
    wh: wp.vec2f,
    g: wp.vec3f,
):
    return wp.dot(_complete(own, facing, texel, turn, to_eye, sun, wh), g)


@wp.func
def _mirror_loss(own: attributes_t, g: wp.vec2f):
    return wp.dot(_mirrored_xy(own), g)


@wp.func
def _to_eye(photograph: PhotographData, at: wp.vec4i):
    """Unit vector towards the camera at a pixel."""
    ray = photograph.unproject[at[0]] @ wp.vec3f(wp.float32(at[1]), wp.float32(at[2]), 1.0)
    return _unit(ray) * -1.0


@wp.kernel(enable_backward=False)
def complete_kernel(
    start: int,
    need: Longs,
    pixels: PackedPixels,
    vertices: Vertices,
    photograph: PhotographData,
    lookups: Lookups,
    final: bool,
    layers: MergedLayers,
):
    """Complete what the photograph did not see.

    Args:
        start, need, pixels, vertices, photograph, lookups, final, layers: See the module.
    """
    i = wp.int32(need[start + wp.tid()])
    if i < 0:
        return
    at = pixels.table[i]
    o = at[0]
    v = _blended_attributes(pixels, vertices, i)
    texel = _texel_at(photograph, o, _mirrored_xy(v))
    a = lookups.lookup[i]
    facing = a[ch.TURNED] + a[ch.COS_THEN]
    eye = _to_eye(photograph, at)
    c = _complete(v, facing, texel, photograph.turn[o], eye, photograph.sun[o], photograph.frame_wh[o])
    f = lookups.unseen[i]
    m = lookups.mesh[i] + wp.vec4f(c[0] * f, c[1] * f, c[2] * f, f)
    lookups.mesh[i] = m
    if final:
        _write_layer(pixels, lookups, layers, i, m, lookups.halo[i])


@wp.kernel(enable_backward=False)
def complete_backward_kernel(
    start: int,
    need: Longs,
    pixels: PackedPixels,
    vertices: Vertices,
    photograph: PhotographData,
    lookups: Lookups,
    final: bool,
    to_layers: MergedLayers,
    grads: PixelGradients,
):
    """Gradient of `complete_kernel`.

    Args:
        start, need, pixels, vertices, photograph, lookups, final, to_layers, grads: See the module.
    """
    i = wp.int32(need[start + wp.tid()])
    if i < 0:
        return
    g = _layer_gradient(lookups, to_layers, i, i) * pixels.coverage[i]
    if not final:
        g = grads.mesh[i]
    if g[0] == 0.0 and g[1] == 0.0 and g[2] == 0.0 and g[3] == 0.0:  # such as behind another vehicle
        return
    at = pixels.table[i]
    o = at[0]
    v = _blended_attributes(pixels, vertices, i)
    a = lookups.lookup[i]
    texel = _texel_with_slopes(photograph, o, _mirrored_xy(v))
    eye = _to_eye(photograph, at)
    facing = a[ch.TURNED] + a[ch.COS_THEN]
    c = _complete(v, facing, texel.value, photograph.turn[o], eye, photograph.sun[o], photograph.frame_wh[o])
    f = lookups.unseen[i]
    to_colour = wp.vec3f(g[0] * f, g[1] * f, g[2] * f)
    grads.unseen[i] = grads.unseen[i] + g[0] * c[0] + g[1] * c[1] + g[2] * c[2] + g[3]
    to_own, to_facing, to_texel, to_turn, to_eye, to_sun, to_wh, to_g = wp.grad(_completion_loss)(
        v, facing, texel.value, photograph.turn[o], eye, photograph.sun[o], photograph.frame_wh[o], to_colour
    )
    move = wp.vec2f(wp.dot(to_texel, texel.to_u), wp.dot(to_texel, texel.to_v))
    more, to_move = wp.grad(_mirror_loss)(v, move)
    _attributes_backward(pixels, vertices, i, to_own + more, grads)
    to_lookup = lookup_t()
    to_lookup[ch.TURNED] = to_facing
    to_lookup[ch.COS_THEN] = to_facing
    wp.atomic_add(grads.lookup, i, to_lookup)
    wp.atomic_add(grads.turn, o, wp.vec2d(wp.float64(to_turn[0]), wp.float64(to_turn[1])))
    light = wp.vec4d(wp.float64(to_sun[0]), wp.float64(to_sun[1]), wp.float64(to_sun[2]), wp.float64(to_sun[3]))
    wp.atomic_add(grads.sun, o, light)


@wp.kernel(enable_backward=True)
def _adjoints_kernel(out: Floats):
    """Never run. Warp generates adjoints of what a differentiable kernel calls; with `wp.grad` alone, some
    functions further down may be missed (Warp 1.19), and their gradients are silently 0.
    """
    a = texel_t()
    xy = wp.vec2f(0.0, 0.0)
    c = wp.vec3f(0.0, 0.0, 0.0)
    g = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    b = lookup_t()
    out[0] = _mesh_loss(b, a, xy, xy, g, 0.0) + _halo_loss(b, a, 0.0, xy, xy, g)
    out[1] = _completion_loss(attributes_t(), 0.0, a, xy, c, g, xy, c) + _mirror_loss(attributes_t(), xy)
