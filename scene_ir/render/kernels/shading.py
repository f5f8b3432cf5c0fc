# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: E501, UP018, RUF046, SIM102, RUF059 - the line above; Warp needs int(0) to declare what a loop changes; `wp.grad`
# returns the gradients of all arguments.
"""The pixels of photographed vehicles as Warp kernels: one pass a stage, forward and backward, float32.

What each stage computes is defined by the plain torch of `reference` and `texture`; constants are `model`'s, channels
`channels`'. Gradients of the per-pixel functions come from `wp.grad`, those that gather at vertices are written by
hand. `photographed` runs the stages. Shapes: N objects, V vertices, T packed pixels.
"""

from __future__ import annotations

import warp as wp

from scene_ir.raster.kernels import ONE, ZERO, Hit, Taps, add_to_corners, find_hit, find_taps
from scene_ir.raster.launch import start_warp
from scene_ir.raster.verbs import NEAR_M
from scene_ir.render import channels as ch
from scene_ir.render import model
from scene_ir.render.kernels.lookups import sums_of_texels, texel_type

start_warp()
wp.set_module_options({"fuse_fp": True, "fast_math": False, "max_unroll": ch.OWN})

look_type = wp.types.vector(length=ch.LOOK, dtype=wp.float32)
own_type = wp.types.vector(length=ch.OWN, dtype=wp.float32)
vec5 = wp.types.vector(length=5, dtype=wp.float32)
PLACES = len(model.SUBPIXELS)
SUBPIXELS = wp.constant(
    wp.types.matrix(shape=(PLACES, 2), dtype=wp.float64)(
        *(part / 16.0 for place in model.SUBPIXELS for part in place)
    )
)

DEPTH, STRETCH, OPEN_TURN, OPEN_ALPHA, RIM, OUTLINE_TURN, BORDER, EXTENDED = (
    wp.constant(wp.vec2f(*edges))
    for edges in (
        *(model.DEPTH_TOLERANCE_M, model.STRETCH, model.OPEN_TURN, model.OPEN_ALPHA, model.RIM),
        *([turn * turn for turn in model.OUTLINE_TURN], model.BORDER_PX, model.EXTENDED_PX),
    )
)
OUTLINE_PX, BESIDE, MIRRORED_RIM, MIRRORED_COS, SOLID, SUPPORTED, COVERED, ANY, OCCLUDED, ZENITH_UP, HORIZON_UP = (
    wp.constant(wp.vec2f(*edges))
    for edges in (
        *(
            model.OUTLINE_PX,
            model.BESIDE_OUTLINE_PX,
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
GRAZING, GRAZING_PAINT = model.GRAZING
OPAQUE, EVEN = 1.0 - 1e-6, 1e-6
AROUND, ABOVE = model.AMBIENT
FOOT, FOOT_REST = model.OCCLUDED[0], 1.0 - model.OCCLUDED[0]
SCHLICK = 1.0 - model.FRESNEL
GLASS_LEAST, GLASS_MORE = model.GLASS_MIRRORS
GLINT_PAINT, GLINT_GLASS = model.GLINT
GROUND_RGB, HORIZON_RGB, ZENITH_RGB = (
    wp.constant(wp.vec3f(*rgb)) for rgb in (model.GROUND_RGB, model.HORIZON_RGB, model.ZENITH_RGB)
)
LEFT = 4
"""Of `mesh_pixel`: how much is left to be completed; premultiplied RGB and opacity come before it."""


@wp.struct
class Pixels:
    """The packed pixels of all objects' crops. table: draw, x, y px, and the width of its rectangle; rects (N, 4);
    face: the triangle that is hit, or -1; coverage; nearest: see `surfaces.nearest_hits`."""

    table: wp.array(dtype=wp.vec4i)
    rects: wp.array2d(dtype=wp.int64)
    face: wp.array(dtype=wp.int32)
    coverage: wp.array(dtype=wp.float32)
    nearest: wp.array(dtype=wp.int64)


@wp.struct
class Vertices:
    """The meshes' faces and what is beside them, and their vertices: `prepare.Geometry`'s clip, cosine and brightness,
    and `fast.Fixed`'s."""

    faces: wp.array(dtype=wp.vec3i)
    beside: wp.array(dtype=wp.vec3i)
    clip: wp.array(dtype=wp.vec3f)
    facing: wp.array(dtype=wp.float32)
    brighter: wp.array(dtype=wp.float32)
    base_clip: wp.array(dtype=wp.vec3f)
    base: wp.array(dtype=wp.vec3f)
    own: wp.array(dtype=own_type)


@wp.struct
class Photograph:
    """What is known of each object: its texels, rects (N, 4) and offsets (N + 1,) of their crops; the frame's width
    and height; cosine and sine of its yaw; direction and strength of the sun; from a pixel to its ray."""

    texels: wp.array(dtype=texel_type)
    rects: wp.array2d(dtype=wp.int64)
    offsets: wp.array(dtype=wp.int64)
    frame_wh: wp.array(dtype=wp.vec2f)
    turn: wp.array(dtype=wp.vec2f)
    sun: wp.array(dtype=wp.vec4f)
    unproject: wp.array(dtype=wp.mat33f)


@wp.struct
class Spot:
    """A place, px, and what is hit there."""

    hit: Hit
    x: wp.float64
    y: wp.float64


@wp.struct
class Looks:
    """What packed pixels show, stage by stage: where they look, continued over the outline, and of leaning pixels also
    as found there; premultiplied RGB and opacity of mesh and halo; how much of the mesh is left to be completed."""

    found: wp.array(dtype=look_type)
    look: wp.array(dtype=look_type)
    mesh: wp.array(dtype=wp.vec4f)
    halo: wp.array(dtype=wp.vec4f)
    fill: wp.array(dtype=wp.float32)


@wp.struct
class Layers:
    """Mesh and halo as one: premultiplied RGB and opacity / depth, opacity, depth, m; or gradients to these."""

    colour: wp.array(dtype=wp.vec4f)
    opacity: wp.array(dtype=wp.float32)
    depth: wp.array(dtype=wp.float32)


@wp.struct
class Gradients:
    """To what `Looks`, `Pixels`, `Vertices` and `Photograph` hold. kept: see `keep_kernel`."""

    look: wp.array(dtype=look_type)
    kept: wp.array(dtype=look_type)
    mesh: wp.array(dtype=wp.vec4f)
    halo: wp.array(dtype=wp.vec4f)
    fill: wp.array(dtype=wp.float32)
    coverage: wp.array(dtype=wp.float32)
    clip: wp.array(dtype=wp.vec3d)
    facing: wp.array(dtype=wp.float32)
    brighter: wp.array(dtype=wp.float32)
    turn: wp.array(dtype=wp.vec2d)
    sun: wp.array(dtype=wp.vec4d)


@wp.func
def step(x: float, edges: wp.vec2f):
    """`texture.smoothstep`."""
    t = wp.clamp((x - edges[0]) * (1.0 / (edges[1] - edges[0])), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def step_slope(x: float, edges: wp.vec2f):
    """The derivative of `step`."""
    t = wp.clamp((x - edges[0]) * (1.0 / (edges[1] - edges[0])), 0.0, 1.0)
    return 6.0 * (t - t * t) * (1.0 / (edges[1] - edges[0]))


# ---------------------------------------------------------------------------------------------- pixels of a layout


@wp.kernel(enable_backward=False)
def table_kernel(
    start: int,
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    table: wp.array(dtype=wp.vec4i),
):
    """For each packed pixel of a draw: the draw, x, y px, and the width of its rectangle."""
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
def corner_values(vertices: Vertices, i: int):
    """A look before its division: clip then minus now (3) and w then stand in place of the lookup and the w's."""
    then = vertices.base_clip[i]
    delta = then - vertices.clip[i]
    fixed = vertices.base[i]
    turned = vertices.facing[i] - fixed[0]
    bright = vertices.brighter[i]
    return look_type(delta[0], delta[1], delta[2], then[2], turned, fixed[0], fixed[1], fixed[2], bright)


@wp.func
def scaled_pixel(hit: Hit, x: wp.float64, y: wp.float64):
    """A pixel (x, y, 1) over the sum of the edge functions there: what their gradients are times."""
    return wp.vec3d(x, y, wp.float64(1.0)) * hit.scale


@wp.func
def look_dot(a: look_type, b: look_type):
    """In double precision: differences between corners matter, which are small beside the values."""
    total = wp.float64(a[0]) * wp.float64(b[0])
    for k in range(1, ch.LOOK):
        total += wp.float64(a[k]) * wp.float64(b[k])
    return total


@wp.func
def own_dot(a: own_type, b: own_type):
    """See `look_dot`."""
    total = wp.float64(a[0]) * wp.float64(b[0])
    for k in range(1, ch.OWN):
        total += wp.float64(a[k]) * wp.float64(b[k])
    return total


@wp.func
def leans(pixels: Pixels, i: int):
    """Whether a pixel belongs to the mesh and is not wholly covered by it."""
    return pixels.coverage[i] < 1.0 and (pixels.face[i] >= 0 or pixels.coverage[i] > 0.0)


@wp.func
def found_at(pixels: Pixels, looks: Looks, i: int):
    """Where a pixel looks, as found, not continued over the outline."""
    found = looks.look[i]
    if leans(pixels, i):
        found = looks.found[i]
    return found


@wp.kernel(enable_backward=False)
def look_kernel(start: int, pixels: Pixels, vertices: Vertices, looks: Looks):
    i = start + wp.tid()
    value = look_type()
    if pixels.face[i] >= 0:
        at = pixels.table[i]
        hit = find_hit(pixels.face[i], wp.float64(at[1]), wp.float64(at[2]), vertices.clip, vertices.faces)
        a = corner_values(vertices, hit.i0) * wp.float32(hit.b[0])
        a += corner_values(vertices, hit.i1) * wp.float32(hit.b[1])
        a += corner_values(vertices, hit.i2) * wp.float32(hit.b[2])
        value = a
        then = a[ch.CORNER_THEN]
        change = a[ch.CORNER_W]
        value[ch.MOVE] = model.FAR_AWAY_PX
        value[ch.MOVE + 1] = model.FAR_AWAY_PX
        value[ch.W_THEN] = then
        value[ch.W_NOW] = then - change
        if then > NEAR_M:
            value[ch.MOVE] = (a[0] - wp.float32(at[1]) * change) / then
            value[ch.MOVE + 1] = (a[1] - wp.float32(at[2]) * change) / then
    looks.look[i] = value


@wp.kernel(enable_backward=False)
def look_backward_kernel(start: int, pixels: Pixels, vertices: Vertices, looks: Looks, grads: Gradients):
    i = start + wp.tid()
    if pixels.face[i] >= 0:
        at = pixels.table[i]
        x = wp.float32(at[1])
        y = wp.float32(at[2])
        hit = find_hit(pixels.face[i], wp.float64(at[1]), wp.float64(at[2]), vertices.clip, vertices.faces)
        v = found_at(pixels, looks, i)
        go = grads.look[i]
        # Back through the division, to the interpolated values.
        g = go
        g[0] = float(0.0)
        g[1] = float(0.0)
        g[ch.CORNER_W] = -go[ch.W_NOW]
        g[ch.CORNER_THEN] = go[ch.W_THEN] + go[ch.W_NOW]
        if v[ch.W_THEN] > NEAR_M:
            g[0] = go[ch.MOVE] / v[ch.W_THEN]
            g[1] = go[ch.MOVE + 1] / v[ch.W_THEN]
            g[ch.CORNER_W] -= g[0] * x + g[1] * y
            g[ch.CORNER_THEN] -= g[0] * v[ch.MOVE] + g[1] * v[ch.MOVE + 1]
        s0 = look_dot(g, corner_values(vertices, hit.i0))
        s1 = look_dot(g, corner_values(vertices, hit.i1))
        s2 = look_dot(g, corner_values(vertices, hit.i2))
        mean = hit.b[0] * s0 + hit.b[1] * s1 + hit.b[2] * s2
        q = scaled_pixel(hit, wp.float64(at[1]), wp.float64(at[2]))
        add_to_corners(hit, q * (s0 - mean), q * (s1 - mean), q * (s2 - mean), grads.clip)
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
class Fringe:
    """How a pixel at a mesh's outline leans on its neighbours: `reference._Fringe`, one row of it."""

    known: wp.vec4f
    weight: wp.vec4f
    total: float
    own: float
    hit: float
    pixel: wp.vec4i


@wp.func
def fringe_of(pixels: Pixels, i: int):
    out = Fringe()
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
        out.own = step(pixels.coverage[i], COVERED) * out.hit
    return out


@wp.kernel(enable_backward=False)
def find_kernel(start: int, leaning: wp.array(dtype=wp.int64), looks: Looks):
    """Keeps what leaning pixels found, before `fill_kernel` continues what is beside them."""
    i = wp.int32(leaning[start + wp.tid()])
    looks.found[i] = looks.look[i]


@wp.kernel(enable_backward=False)
def fill_kernel(start: int, leaning: wp.array(dtype=wp.int64), pixels: Pixels, looks: Looks):
    i = wp.int32(leaning[start + wp.tid()])
    f = fringe_of(pixels, i)
    mean = found_at(pixels, looks, f.pixel[0]) * f.weight[0] + found_at(pixels, looks, f.pixel[1]) * f.weight[1]
    mean += found_at(pixels, looks, f.pixel[2]) * f.weight[2] + found_at(pixels, looks, f.pixel[3]) * f.weight[3]
    looks.look[i] = looks.found[i] * (f.own * f.hit) + mean * (1.0 - f.own)


@wp.kernel(enable_backward=False)
def keep_kernel(start: int, leaning: wp.array(dtype=wp.int64), grads: Gradients):
    """Moves gradients of leaning pixels from `grad` to `kept`, so that `fill_backward_kernel` can spread them."""
    i = wp.int32(leaning[start + wp.tid()])
    grads.kept[i] = grads.look[i]
    grads.look[i] = look_type()


@wp.func
def fringe_to_coverage(pixels: Pixels, i: int, f: Fringe, to_own: float, to_weight: wp.vec4f, grads: Gradients):
    """Add what gradients to a pixel's own share and to its neighbours' weights mean for their coverages."""
    shared = wp.dot(to_weight, f.weight)
    for n in range(4):
        if f.known[n] > 0.0:
            if pixels.coverage[f.pixel[n]] >= 0.5:
                wp.atomic_add(grads.coverage, f.pixel[n], 2.0 * (to_weight[n] - shared) / f.total)
    if f.known[0] + f.known[1] + f.known[2] + f.known[3] > 0.0:
        wp.atomic_add(grads.coverage, i, to_own * f.hit * step_slope(pixels.coverage[i], COVERED))


@wp.kernel(enable_backward=False)
def fill_backward_kernel(
    start: int, leaning: wp.array(dtype=wp.int64), pixels: Pixels, looks: Looks, grads: Gradients
):
    i = wp.int32(leaning[start + wp.tid()])
    f = fringe_of(pixels, i)
    g = grads.kept[i]
    rest = 1.0 - f.own
    wp.atomic_add(grads.look, i, g * (f.own * f.hit))
    to_own = f.hit * wp.dot(g, looks.found[i])
    to_weight = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    for n in range(4):
        if f.known[n] > 0.0:
            wp.atomic_add(grads.look, f.pixel[n], g * (rest * f.weight[n]))
            along = wp.dot(g, found_at(pixels, looks, f.pixel[n]))
            to_own -= f.weight[n] * along
            to_weight[n] = rest * along
    fringe_to_coverage(pixels, i, f, to_own, to_weight, grads)


# --------------------------------------------------------------------------------------- looking up the photograph


@wp.struct
class Sampled:
    """A texel between texels, and how it changes along u and v."""

    value: texel_type
    to_u: texel_type
    to_v: texel_type


@wp.func
def sample(texels: wp.array(dtype=texel_type), t: Taps):
    return sums_of_texels(texels, t.rows, t.columns, t.wx, t.wy, t.sx, t.sy)[0]


@wp.func
def sample_both(texels: wp.array(dtype=texel_type), t: Taps):
    sums = sums_of_texels(texels, t.rows, t.columns, t.wx, t.wy, t.sx, t.sy)
    out = Sampled()
    out.value = sums[0]
    out.to_u = sums[1]
    out.to_v = sums[2]
    return out


@wp.func
def rect_of(rects: wp.array2d(dtype=wp.int64), i: int):
    return wp.vec4i(wp.int32(rects[i, 0]), wp.int32(rects[i, 1]), wp.int32(rects[i, 2]), wp.int32(rects[i, 3]))


@wp.func
def taps_at(uv: wp.vec2f, rect: wp.vec4i, start: wp.int64, clamp: bool):
    return find_taps(uv, rect[0], rect[1], rect[2] - rect[0], rect[3] - rect[1], wp.int32(start), 1, clamp)


@wp.func
def texel_at(photograph: Photograph, draw: int, uv: wp.vec2f):
    """The texel at a place of the frame; 0 in an empty crop."""
    out = texel_type()
    rect = rect_of(photograph.rects, draw)
    if rect[2] > rect[0]:
        out = sample(photograph.texels, taps_at(uv, rect, photograph.offsets[draw], True))
    return out


@wp.func
def texel_around(photograph: Photograph, draw: int, uv: wp.vec2f):
    """`texel_at`, and how it changes."""
    out = Sampled()
    rect = rect_of(photograph.rects, draw)
    if rect[2] > rect[0]:
        out = sample_both(photograph.texels, taps_at(uv, rect, photograph.offsets[draw], True))
    return out


# ------------------------------------------------------------------------------------ a pixel of mesh, of its halo


@wp.func
def inside_weight(u: float, v: float, wh: wp.vec2f, edges: wp.vec2f):
    """`texture.inside_weight`."""
    beyond_u = wp.max(-u, u - (wh[0] - 1.0))
    beyond_v = wp.max(-v, v - (wh[1] - 1.0))
    return (1.0 - step(beyond_u, edges)) * (1.0 - step(beyond_v, edges))


@wp.func
def facing_weight(turned: float, cos_then: float, paint: float):
    """`texture.facing_weight`."""
    positive = 0.5 * (cos_then + wp.sqrt(cos_then * cos_then + model.SQUARED_COS))
    slack = GRAZING + (GRAZING_PAINT - GRAZING) * paint
    return 1.0 - step(turned / (positive + slack), STRETCH)


@wp.func
def place(pixels: Pixels, i: int):
    """Of a packed pixel, px."""
    at = pixels.table[i]
    return wp.vec2f(wp.float32(at[1]), wp.float32(at[2]))


@wp.func
def lookup(look: look_type, xy: wp.vec2f):
    """Where a pixel looks at the photograph, px."""
    return wp.vec2f(xy[0] + look[ch.MOVE], xy[1] + look[ch.MOVE + 1])


@wp.func
def seen_weight(look: look_type, texel: texel_type, xy: wp.vec2f, wh: wp.vec2f):
    """How much of what is shown the photograph knows; and how much of it it sees there at all."""
    u = xy[0] + look[ch.MOVE]
    v = xy[1] + look[ch.MOVE + 1]
    clear = 1.0 - step(texel[ch.HIDDEN], ANY)
    inside = inside_weight(u, v, wh, BORDER)
    facing = facing_weight(look[ch.TURNED], look[ch.COS_THEN], look[ch.PAINT])
    weight = facing * inside * clear
    if inside < 1.0:
        near = inside_weight(u, v, wh, EXTENDED) * step(texel[ch.ALPHA], SOLID)
        weight = weight + facing * (1.0 - inside) * near * clear
    weight = weight * (1.0 - step(look[ch.W_THEN] - texel[ch.DEPTH], DEPTH))
    return wp.vec2f(weight, inside * clear)


@wp.func
def relit(c: float, brighter: float):
    """`texture.relit`, one channel of it."""
    return c * (1.0 + brighter * (1.0 - c * c))


@wp.func
def relit_slope(c: float, brighter: float):
    """Its derivative to the colour."""
    return 1.0 + brighter * (1.0 - 3.0 * c * c)


@wp.func
def mesh_pixel(look: look_type, texel: texel_type, xy: wp.vec2f, wh: wp.vec2f):
    """Premultiplied RGB, opacity, and how much is left to be completed."""
    seen = seen_weight(look, texel, xy, wh)
    weight = seen[0]
    alpha = texel[ch.ALPHA]
    rim = 1.0 - step(look[ch.COS_THEN], RIM)
    opened = step(look[ch.TURNED], OPEN_TURN) * rim * wp.max(1.0 - alpha, 0.0)
    empty = seen[1] * (1.0 - step(texel[ch.SUPPORT], SUPPORTED))
    closed = weight * opened * (1.0 - empty) * step(alpha, OPEN_ALPHA)
    shown = weight + closed / wp.max(alpha, OPEN_ALPHA[0])
    out = vec5()
    out[0] = shown * relit(texel[0], look[ch.BRIGHTER])
    out[1] = shown * relit(texel[1], look[ch.BRIGHTER])
    out[2] = shown * relit(texel[2], look[ch.BRIGHTER])
    out[ch.ALPHA] = shown * alpha
    out[LEFT] = (1.0 - weight) * (1.0 - empty)
    return out


@wp.func
def plainly_seen(look: look_type, texel: texel_type, u: float, v: float, wh: wp.vec2f):
    """Whether every weight of `mesh_pixel` is flat at full: then it is the texel, relit, and so is its gradient."""
    seen = (
        texel[ch.HIDDEN] <= 0.0
        and texel[ch.SUPPORT] >= SUPPORTED[1]
        and look[ch.W_THEN] - texel[ch.DEPTH] <= DEPTH[0]
    )
    if seen:
        seen = (
            u >= -BORDER[0] and u <= wh[0] - 1.0 + BORDER[0] and v >= -BORDER[0] and v <= wh[1] - 1.0 + BORDER[0]
        )
    if seen:  # nothing opens up: it did not turn, lies inside, or is opaque
        seen = look[ch.TURNED] <= OPEN_TURN[0] or look[ch.COS_THEN] >= RIM[1] or texel[ch.ALPHA] >= OPAQUE
    if seen:
        seen = look[ch.TURNED] <= STRETCH[0] * (GRAZING_PAINT + wp.max(look[ch.COS_THEN], 0.0))
    return seen


@wp.func
def mesh_loss(look: look_type, texel: texel_type, xy: wp.vec2f, wh: wp.vec2f, g: wp.vec4f, to_fill: float):
    p = mesh_pixel(look, texel, xy, wh)
    return p[0] * g[0] + p[1] * g[1] + p[2] * g[2] + p[3] * g[3] + p[LEFT] * to_fill


@wp.func
def outline_share(texel: texel_type):
    """`texture.outline_share`."""
    return 1.0 - step(texel[ch.INSET], OUTLINE_PX)


@wp.func
def halo_pixel(look: look_type, texel: texel_type, inset: float, xy: wp.vec2f, wh: wp.vec2f):
    """Premultiplied RGB and opacity. inset: of the mesh pixel that this one moves with."""
    seen = seen_weight(look, texel, xy, wh)
    on_outline = 1.0 - step(look[ch.TURNED] * look[ch.TURNED], OUTLINE_TURN)
    shown = seen[0] * step(outline_share(texel), ANY) * on_outline * (1.0 - step(inset, BESIDE))
    return wp.vec4f(
        shown * relit(texel[0], look[ch.BRIGHTER]),
        shown * relit(texel[1], look[ch.BRIGHTER]),
        shown * relit(texel[2], look[ch.BRIGHTER]),
        shown * texel[ch.ALPHA],
    )


@wp.func
def halo_loss(look: look_type, texel: texel_type, inset: float, xy: wp.vec2f, wh: wp.vec2f, g: wp.vec4f):
    return wp.dot(halo_pixel(look, texel, inset, xy, wh), g)


@wp.func
def in_mesh(pixels: Pixels, i: int):
    return pixels.face[i] >= 0 or pixels.coverage[i] > 0.0


@wp.func
def in_halo(pixels: Pixels, i: int):
    return pixels.nearest[i] >= wp.int64(0) and pixels.coverage[i] < 1.0


# --------------------------------------------------------------------------------------------- mesh and halo as one


@wp.func
def lay(pixels: Pixels, looks: Looks, layers: Layers, i: int, m: wp.vec4f, h: wp.vec4f):
    """A pixel's mesh m and halo h as one."""
    c = wp.vec3f(0.0, 0.0, 0.0)
    inverse = float(0.0)
    solid = float(0.0)
    z = float(wp.inf)
    if in_mesh(pixels, i):
        share = pixels.coverage[i]
        near = looks.look[i][ch.W_NOW]
        a = m[3] * share
        c = wp.vec3f(m[0], m[1], m[2]) * share
        solid = a
        inverse = a / wp.max(near, NEAR_M)
        z = near
    if in_halo(pixels, i):
        share = 1.0 - pixels.coverage[i]
        near = looks.look[wp.int32(pixels.nearest[i])][ch.W_NOW]
        a = h[3] * share
        c += wp.vec3f(h[0], h[1], h[2]) * share
        solid += a
        inverse += a / wp.max(near, NEAR_M)
        z = wp.min(z, near)
    layers.colour[i] = wp.vec4f(c[0], c[1], c[2], inverse)
    layers.opacity[i] = solid
    layers.depth[i] = z


@wp.func
def to_part(looks: Looks, to_layers: Layers, i: int, j: int):
    """The gradient to what pixel i shows of mesh or halo, by the look of pixel j, before its share."""
    g = to_layers.colour[i]
    return wp.vec4f(g[0], g[1], g[2], to_layers.opacity[i] + g[3] / wp.max(looks.look[j][ch.W_NOW], NEAR_M))


@wp.func
def to_nearness(looks: Looks, to_layers: Layers, i: int, j: int, solid: float, grads: Gradients):
    """Adds what the gradient to opacity / depth means for the depth there. solid: the part's opacity."""
    inverse = to_layers.colour[i][3]
    z = looks.look[j][ch.W_NOW]
    if inverse != 0.0 and z > NEAR_M:
        to_z = look_type()
        to_z[ch.W_NOW] = -inverse * solid / (z * z)
        wp.atomic_add(grads.look, j, to_z)


@wp.kernel(enable_backward=False)
def combine_kernel(start: int, pixels: Pixels, looks: Looks, layers: Layers):
    i = start + wp.tid()
    lay(pixels, looks, layers, i, looks.mesh[i], looks.halo[i])


@wp.kernel(enable_backward=False)
def combine_backward_kernel(start: int, pixels: Pixels, looks: Looks, to_layers: Layers, grads: Gradients):
    i = start + wp.tid()
    to_mesh = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    to_halo = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    if in_mesh(pixels, i):
        to_mesh = to_part(looks, to_layers, i, i) * pixels.coverage[i]
    if in_halo(pixels, i):
        j = wp.int32(pixels.nearest[i])
        to_halo = to_part(looks, to_layers, i, j) * (1.0 - pixels.coverage[i])
    grads.mesh[i] = to_mesh
    grads.halo[i] = to_halo


@wp.kernel(enable_backward=False)
def shade_kernel(start: int, pixels: Pixels, photograph: Photograph, looks: Looks, final: bool, layers: Layers):
    """final: whether no painter comes before mesh and halo become one."""
    i = start + wp.tid()
    at = pixels.table[i]
    to_mesh = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    to_halo = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    left = float(0.0)
    xy = place(pixels, i)
    wh = photograph.frame_wh[at[0]]
    if in_mesh(pixels, i):
        a = looks.look[i]
        uv = lookup(a, xy)
        texel = texel_at(photograph, at[0], uv)
        bright = a[ch.BRIGHTER]
        alpha = texel[ch.ALPHA]
        to_mesh = wp.vec4f(relit(texel[0], bright), relit(texel[1], bright), relit(texel[2], bright), alpha)
        if not plainly_seen(a, texel, uv[0], uv[1], wh):
            p = mesh_pixel(a, texel, xy, wh)
            to_mesh = wp.vec4f(p[0], p[1], p[2], p[3])
            left = p[LEFT]
    if in_halo(pixels, i):
        j = wp.int32(pixels.nearest[i])
        a = looks.look[j]
        texel = texel_at(photograph, at[0], lookup(a, xy))
        if texel[ch.ALPHA] != 0.0:  # else there is nothing to show
            inset = texel_at(photograph, at[0], lookup(a, place(pixels, j)))[ch.INSET]
            to_halo = halo_pixel(a, texel, inset, xy, wh)
    looks.mesh[i] = to_mesh
    looks.halo[i] = to_halo
    looks.fill[i] = left
    if final:
        lay(pixels, looks, layers, i, to_mesh, to_halo)


@wp.kernel(enable_backward=False)
def shade_backward_kernel(
    start: int,
    pixels: Pixels,
    photograph: Photograph,
    looks: Looks,
    final: bool,
    to_layers: Layers,
    grads: Gradients,
):
    i = start + wp.tid()
    to_share = float(0.0)
    at = pixels.table[i]
    xy = place(pixels, i)
    wh = photograph.frame_wh[at[0]]
    if in_mesh(pixels, i):
        a = looks.look[i]
        uv = lookup(a, xy)
        g = to_part(looks, to_layers, i, i)
        m = looks.mesh[i]
        to_share = wp.dot(g, m)
        to_nearness(looks, to_layers, i, i, m[3] * pixels.coverage[i], grads)
        g = g * pixels.coverage[i]
        if not final:
            g = grads.mesh[i]
        texel = texel_around(photograph, at[0], uv)
        c = texel.value
        to_look = look_type()
        to_texel = texel_type()
        to_texel[ch.ALPHA] = g[3]
        for k in range(3):
            to_texel[k] = g[k] * relit_slope(c[k], a[ch.BRIGHTER])
            to_look[ch.BRIGHTER] += g[k] * c[k] * (1.0 - c[k] * c[k])
        # Where opacity changes along a surface that turned, so does how much of it opens up.
        even = (
            a[ch.TURNED] <= OPEN_TURN[0]
            or wp.max(wp.abs(texel.to_u[ch.ALPHA]), wp.abs(texel.to_v[ch.ALPHA])) <= EVEN
        )
        if not (even and plainly_seen(a, texel.value, uv[0], uv[1], wh)):
            to_look, to_texel, to_xy, to_wh, to_g, to_f = wp.grad(mesh_loss)(
                a, texel.value, xy, wh, g, grads.fill[i]
            )
        to_look[ch.MOVE] += wp.dot(to_texel, texel.to_u)
        to_look[ch.MOVE + 1] += wp.dot(to_texel, texel.to_v)
        wp.atomic_add(grads.look, i, to_look)
    if in_halo(pixels, i):
        j = wp.int32(pixels.nearest[i])
        b = looks.look[j]
        g2 = to_part(looks, to_layers, i, j)
        h = looks.halo[i]
        to_share -= wp.dot(g2, h)
        to_nearness(looks, to_layers, i, j, h[3] * (1.0 - pixels.coverage[i]), grads)
        g2 = g2 * (1.0 - pixels.coverage[i])
        if not final:
            g2 = grads.halo[i]
        texel2 = texel_around(photograph, at[0], lookup(b, xy))
        if (
            texel2.value[ch.ALPHA] != 0.0 or texel2.to_u[ch.ALPHA] != 0.0 or texel2.to_v[ch.ALPHA] != 0.0
        ):  # else there is nothing near
            anchor = texel_around(photograph, at[0], lookup(b, place(pixels, j)))
            to_look2, to_texel2, to_inset, to_xy2, to_wh2, to_g2 = wp.grad(halo_loss)(
                b, texel2.value, anchor.value[ch.INSET], xy, wh, g2
            )
            to_look2[ch.MOVE] += wp.dot(to_texel2, texel2.to_u) + to_inset * anchor.to_u[ch.INSET]
            to_look2[ch.MOVE + 1] += wp.dot(to_texel2, texel2.to_v) + to_inset * anchor.to_v[ch.INSET]
            wp.atomic_add(grads.look, j, to_look2)
    wp.atomic_add(grads.coverage, i, to_share)


# ------------------------------------------------------------------- completion of what the photograph did not see


@wp.func
def centre_of(pixels: Pixels, vertices: Vertices, i: int):
    """What a pixel's centre hits."""
    at = pixels.table[i]
    spot = Spot()
    spot.x = wp.float64(at[1])
    spot.y = wp.float64(at[2])
    spot.hit = find_hit(pixels.face[i], spot.x, spot.y, vertices.clip, vertices.faces)
    return spot


@wp.func
def spot_of(centre: Spot, face: int, k: int, vertices: Vertices):
    """`reference._walked`, to the k-th place within a pixel whose centre hits a face."""
    spot = Spot()
    spot.x = centre.x + SUBPIXELS[k, 0]
    spot.y = centre.y + SUBPIXELS[k, 1]
    front = wp.dot(centre.hit.c0, wp.cross(centre.hit.c1, centre.hit.c2))
    found = bool(False)
    passed = int(0)
    here = face
    while passed < model.WALK and here >= 0 and not found:
        spot.hit = find_hit(here, spot.x, spot.y, vertices.clip, vertices.faces)
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
            here = vertices.beside[here][nearest]
        passed += 1
    if not found:
        spot = centre
    return spot


@wp.func
def own_at(pixels: Pixels, vertices: Vertices, i: int):
    """The mesh's own attributes over a pixel that it hits, else 0."""
    value = own_type()
    if pixels.face[i] >= 0:
        centre = centre_of(pixels, vertices, i)
        k = int(0)
        while k < PLACES:
            hit = spot_of(centre, pixels.face[i], k, vertices).hit
            value += vertices.own[hit.i0] * wp.float32(hit.b[0])
            value += vertices.own[hit.i1] * wp.float32(hit.b[1])
            value += vertices.own[hit.i2] * wp.float32(hit.b[2])
            k += 1
    return value * (1.0 / float(PLACES))


@wp.func
def own_filled(pixels: Pixels, vertices: Vertices, i: int):
    """`own_at`, continued over the outline."""
    value = own_at(pixels, vertices, i)
    if leans(pixels, i):
        f = fringe_of(pixels, i)
        value = value * (f.own * f.hit)
        for n in range(4):
            if f.known[n] > 0.0:
                value += own_at(pixels, vertices, f.pixel[n]) * ((1.0 - f.own) * f.weight[n])
    return value


@wp.func
def own_to_clip(pixels: Pixels, vertices: Vertices, i: int, g: own_type, share: float, grads: Gradients):
    """Add what `share` of a gradient to `own_at` means for the corners; returns g . own_at."""
    centre = centre_of(pixels, vertices, i)
    each = ONE / wp.float64(PLACES)
    total = ZERO
    k = int(0)
    while k < PLACES:
        spot = spot_of(centre, pixels.face[i], k, vertices)
        hit = spot.hit
        s0 = own_dot(g, vertices.own[hit.i0])
        s1 = own_dot(g, vertices.own[hit.i1])
        s2 = own_dot(g, vertices.own[hit.i2])
        mean = hit.b[0] * s0 + hit.b[1] * s1 + hit.b[2] * s2
        total += mean * each
        if share != 0.0:
            q = scaled_pixel(hit, spot.x, spot.y) * (wp.float64(share) * each)
            add_to_corners(hit, q * (s0 - mean), q * (s1 - mean), q * (s2 - mean), grads.clip)
        k += 1
    return wp.float32(total)


@wp.func
def own_backward(pixels: Pixels, vertices: Vertices, i: int, g: own_type, grads: Gradients):
    """Add what a gradient to `own_filled` means for corners and coverages."""
    if leans(pixels, i):
        f = fringe_of(pixels, i)
        rest = 1.0 - f.own
        to_own = float(0.0)
        if pixels.face[i] >= 0:
            to_own = own_to_clip(pixels, vertices, i, g, f.own, grads)
        to_weight = wp.vec4f(0.0, 0.0, 0.0, 0.0)
        for n in range(4):
            if f.known[n] > 0.0:
                along = own_to_clip(pixels, vertices, f.pixel[n], g, rest * f.weight[n], grads)
                to_own -= f.weight[n] * along
                to_weight[n] = rest * along
        fringe_to_coverage(pixels, i, f, to_own, to_weight, grads)
    elif pixels.face[i] >= 0:
        own_to_clip(pixels, vertices, i, g, 1.0, grads)


@wp.func
def unit(v: wp.vec3f):
    return v / wp.max(wp.length(v), 1e-6)


@wp.func
def clamped(v: wp.vec3f):
    return wp.vec3f(wp.clamp(v[0], 0.0, 1.0), wp.clamp(v[1], 0.0, 1.0), wp.clamp(v[2], 0.0, 1.0))


@wp.func
def shade(
    normal: wp.vec3f,
    to_eye: wp.vec3f,
    albedo: wp.vec3f,
    paint: float,
    glass: float,
    height: float,
    sunlit: wp.vec4f,
):
    """`texture.shade`, one row of it. sunlit: direction and strength of the sun."""
    sun = wp.vec3f(sunlit[0], sunlit[1], sunlit[2])
    dome = 0.5 - 0.5 * normal[1]
    soft = wp.dot(normal, sun)
    direct = 0.5 * (soft + wp.sqrt(soft * soft + model.TERMINATOR))
    occluded = FOOT + FOOT_REST * step(height, OCCLUDED)
    diffuse = ((AROUND + ABOVE * dome) + sunlit[3] * direct) * occluded
    cosine = wp.clamp(wp.dot(normal, to_eye), 0.0, 1.0)
    mirror = normal * (2.0 * cosine) - to_eye
    above = HORIZON_RGB + (ZENITH_RGB - HORIZON_RGB) * step(-mirror[1], ZENITH_UP)
    surround = GROUND_RGB + (above - GROUND_RGB) * step(-mirror[1], HORIZON_UP)
    rest = 1.0 - cosine
    fresnel = model.FRESNEL + SCHLICK * (rest * rest) * (rest * rest) * rest
    mirrored = model.PAINT_MIRRORS * paint * fresnel + glass * (GLASS_LEAST + GLASS_MORE * fresnel)
    strength = mirrored * (0.5 + 0.5 * occluded)
    g = wp.clamp(wp.dot(mirror, sun), 0.0, 1.0)
    g2 = g * g
    g4 = g2 * g2
    g8 = g4 * g4
    g32 = (g8 * g8) * (g8 * g8)
    glint = (g32 * g8) * (GLINT_PAINT * paint + GLINT_GLASS * glass)
    lit = albedo * diffuse
    return lit + (surround - lit) * strength + (wp.vec3f(1.0, 1.0, 1.0) - lit) * glint


@wp.func
def mirror_place(own: own_type):
    """Where the photograph shows the other side of the car, px."""
    safe = wp.max(own[ch.MIRROR + 2], model.NEAREST_MIRRORED_M)
    return wp.vec2f(own[ch.MIRROR] / safe, own[ch.MIRROR + 1] / safe)


@wp.func
def completed(
    own: own_type,
    facing: float,
    texel: texel_type,
    turn: wp.vec2f,
    to_eye: wp.vec3f,
    sun: wp.vec4f,
    wh: wp.vec2f,
):
    """`reference._completion`, one row of it. own: with local normals; facing: cosine towards the camera now."""
    # Each use reads `own` anew: gradients are added up use by use, and rounded as they always were.
    normal = unit(
        wp.vec3f(
            turn[0] * own[ch.NORMAL] + turn[1] * own[ch.NORMAL + 2],
            own[ch.NORMAL + 1],
            turn[0] * own[ch.NORMAL + 2] - turn[1] * own[ch.NORMAL],
        )
    )
    albedo = wp.vec3f(own[0], own[1], own[2])
    light = shade(normal, to_eye, albedo, own[ch.OWN_PAINT], own[ch.OWN_GLASS], own[ch.OWN_HEIGHT], sun)
    left = wp.vec3f(
        wp.exp(-light[0] * own[ch.GAIN]),
        wp.exp(-light[1] * own[ch.GAIN + 1]),
        wp.exp(-light[2] * own[ch.GAIN + 2]),
    )
    colour = wp.vec3f(1.0, 1.0, 1.0) - left * (1.0 - own[ch.LIFT])  # `texture.finished`
    uv = mirror_place(own)
    weight = inside_weight(uv[0], uv[1], wh, BORDER)
    weight = weight * (1.0 - step(texel[ch.HIDDEN], ANY)) * step(texel[ch.ALPHA], SOLID)
    weight = weight * (1.0 - step(own[ch.MIRROR + 2] - texel[ch.DEPTH], DEPTH))
    facing_now = facing_weight(facing - own[ch.MIRROR_COS], own[ch.MIRROR_COS], own[ch.OWN_PAINT])
    weight = weight * facing_now * step(own[ch.MIRROR_COS], MIRRORED_COS)
    weight = weight * (1.0 - step(outline_share(texel), MIRRORED_RIM))
    straight = clamped(
        wp.vec3f(texel[0], texel[1], texel[2]) / wp.max(texel[ch.ALPHA], model.LEAST_MIRRORED_ALPHA)
    )
    return colour + (straight - colour) * weight


@wp.func
def completed_loss(
    own: own_type,
    facing: float,
    texel: texel_type,
    turn: wp.vec2f,
    to_eye: wp.vec3f,
    sun: wp.vec4f,
    wh: wp.vec2f,
    g: wp.vec3f,
):
    return wp.dot(completed(own, facing, texel, turn, to_eye, sun, wh), g)


@wp.func
def mirror_loss(own: own_type, g: wp.vec2f):
    return wp.dot(mirror_place(own), g)


@wp.func
def eye_of(photograph: Photograph, at: wp.vec4i):
    """Unit vector towards the camera at a pixel."""
    ray = photograph.unproject[at[0]] @ wp.vec3f(wp.float32(at[1]), wp.float32(at[2]), 1.0)
    return unit(ray) * -1.0


@wp.kernel(enable_backward=False)
def complete_kernel(
    start: int,
    need: wp.array(dtype=wp.int64),
    pixels: Pixels,
    vertices: Vertices,
    photograph: Photograph,
    looks: Looks,
    final: bool,
    layers: Layers,
):
    i = wp.int32(need[start + wp.tid()])
    at = pixels.table[i]
    o = at[0]
    v = own_filled(pixels, vertices, i)
    texel = texel_at(photograph, o, mirror_place(v))
    a = looks.look[i]
    facing = a[ch.TURNED] + a[ch.COS_THEN]
    eye = eye_of(photograph, at)
    c = completed(v, facing, texel, photograph.turn[o], eye, photograph.sun[o], photograph.frame_wh[o])
    f = looks.fill[i]
    m = looks.mesh[i] + wp.vec4f(c[0] * f, c[1] * f, c[2] * f, f)
    looks.mesh[i] = m
    if final:
        lay(pixels, looks, layers, i, m, looks.halo[i])


@wp.kernel(enable_backward=False)
def complete_backward_kernel(
    start: int,
    need: wp.array(dtype=wp.int64),
    pixels: Pixels,
    vertices: Vertices,
    photograph: Photograph,
    looks: Looks,
    final: bool,
    to_layers: Layers,
    grads: Gradients,
):
    i = wp.int32(need[start + wp.tid()])
    at = pixels.table[i]
    o = at[0]
    v = own_filled(pixels, vertices, i)
    a = looks.look[i]
    texel = texel_around(photograph, o, mirror_place(v))
    eye = eye_of(photograph, at)
    facing = a[ch.TURNED] + a[ch.COS_THEN]
    c = completed(v, facing, texel.value, photograph.turn[o], eye, photograph.sun[o], photograph.frame_wh[o])
    g = to_part(looks, to_layers, i, i) * pixels.coverage[i]
    if not final:
        g = grads.mesh[i]
    f = looks.fill[i]
    to_colour = wp.vec3f(g[0] * f, g[1] * f, g[2] * f)
    grads.fill[i] = grads.fill[i] + g[0] * c[0] + g[1] * c[1] + g[2] * c[2] + g[3]
    to_own, to_facing, to_texel, to_turn, to_eye, to_sun, to_wh, to_g = wp.grad(completed_loss)(
        v, facing, texel.value, photograph.turn[o], eye, photograph.sun[o], photograph.frame_wh[o], to_colour
    )
    move = wp.vec2f(wp.dot(to_texel, texel.to_u), wp.dot(to_texel, texel.to_v))
    more, to_move = wp.grad(mirror_loss)(v, move)
    own_backward(pixels, vertices, i, to_own + more, grads)
    to_look = look_type()
    to_look[ch.TURNED] = to_facing
    to_look[ch.COS_THEN] = to_facing
    wp.atomic_add(grads.look, i, to_look)
    wp.atomic_add(grads.turn, o, wp.vec2d(wp.float64(to_turn[0]), wp.float64(to_turn[1])))
    light = wp.vec4d(wp.float64(to_sun[0]), wp.float64(to_sun[1]), wp.float64(to_sun[2]), wp.float64(to_sun[3]))
    wp.atomic_add(grads.sun, o, light)


@wp.kernel(enable_backward=True)
def adjoints_kernel(out: wp.array(dtype=wp.float32)):
    """Never run. Warp writes adjoints of what a differentiable kernel calls; those that `wp.grad` alone asks for may
    miss some of the functions below them (Warp 1.19), and then their gradients are silently 0."""
    a = texel_type()
    xy = wp.vec2f(0.0, 0.0)
    c = wp.vec3f(0.0, 0.0, 0.0)
    g = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    b = look_type()
    out[0] = mesh_loss(b, a, xy, xy, g, 0.0) + halo_loss(b, a, 0.0, xy, xy, g)
    out[1] = completed_loss(own_type(), 0.0, a, xy, c, g, xy, c) + mirror_loss(own_type(), xy)
