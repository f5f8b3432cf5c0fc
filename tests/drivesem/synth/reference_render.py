"""A photograph in plain numpy with the project's rasteriser: it defines what the generator's kernels compute."""

from __future__ import annotations

import numpy as np

from drivesem.synth.light import LEAF_DEPTH_M, SHADOW_OFFSET_M, SHADOW_OFFSET_TEXELS, develop
from drivesem.synth.render import (
    SHADOW_TEXELS,
    grain_number,
    rasterise,
    sun_rows,
    through_lens,
    with_flakes,
    with_glare,
)
from drivesem.synth.soup import GROUND, Material, Semantic, Soup
from drivesem.synth.view import (
    SHADOW_VIEWS_M,
    SUPERSAMPLING,
    Setting,
    Shadow,
    Sight,
    SunMaps,
    View,
    blocks,
    fine_matrix,
)
from tests.drivesem.synth.reference_light import sky_radiance, white_noise
from tests.drivesem.synth.reference_shading import Samples, shade, unit

_SHADOW_DISTANCE_M = 3000.0
"""The sun stands this far away in the shadow maps: it bends walls of 20 m by 3 cm."""


def render(sight: Sight, soup: Soup, shadows: list[Shadow], setting: Setting) -> np.ndarray:
    """The picture (H, W, 3) uint8 of a world. sight: of the soup; shadows: of the actors in it."""
    camera = setting.view.camera
    pixels = camera.height * camera.width
    image = np.empty((pixels, 3), np.float32)
    shining = np.zeros_like(image)
    develop_pixels(sight, setting, sun_maps(soup, setting), shadows, (image, np.ones(pixels, bool), shining))
    shape = (camera.height, camera.width, 3)
    glared = with_glare(image.reshape(shape), shining.reshape(shape), setting)
    return take(with_flakes(glared, sight.depth_m, setting), setting)


def see(soup: Soup, view: View) -> Sight:
    """Which triangle each sample shows. soup: camera axes about the centre of projection."""
    size = (SUPERSAMPLING * view.camera.height, SUPERSAMPLING * view.camera.width)
    seen = soup.take(_in_front(soup.corners, view))
    rect = np.array([[0, 0, size[1], size[0]]])
    face, depth = rasterise(seen.corners, fine_matrix(view), rect, np.array([[0, len(seen)]]))
    hit, safe = face >= 0, np.maximum(face, 0)
    material = np.where(hit, seen.material[safe], np.uint8(Material.SKY))
    owner = np.where(hit, seen.owner[safe], np.int32(-1))
    semantic = np.where(hit, seen.semantic[safe], np.uint8(Semantic.SKY))
    return Sight(seen, *(a.reshape(size) for a in (face, depth, material, owner, semantic)))


def _in_front(points: np.ndarray, view: View) -> np.ndarray:
    """Faces (F,) that may be seen: not wholly beyond one border of the image."""
    k = view.camera.intrinsics.numpy()
    z = [points[:, i, 2] for i in range(3)]
    near = np.minimum(np.minimum(z[0], z[1]), z[2]) > 0
    out = np.maximum(np.maximum(z[0], z[1]), z[2]) < 0.05
    for axis, size in ((0, view.camera.width), (1, view.camera.height)):
        low, high = -k[axis, 2] / k[axis, axis], (size - k[axis, 2]) / k[axis, axis]
        value = [points[:, i, axis] for i in range(3)]
        out |= near & _all3([v < np.float32(low) * d for v, d in zip(value, z, strict=True)])
        out |= near & _all3([v > np.float32(high) * d for v, d in zip(value, z, strict=True)])
    return ~out


def _all3(masks: list[np.ndarray]) -> np.ndarray:
    return masks[0] & masks[1] & masks[2]


def _extent(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest (F,) of three corners' values (F, 3)."""
    a, b, c = values[:, 0], values[:, 1], values[:, 2]
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def sun_maps(soup: Soup, setting: Setting) -> SunMaps | None:
    """Shadow maps over the ground, or None without sun. soup: camera axes about the centre of projection."""
    placing = sun_rows(setting)
    if placing is None:
        return None
    ground = np.isin(soup.material, GROUND)
    corners = soup.corners[~ground]
    actor = soup.owner[~ground] > 0
    placed = corners @ placing[:, :3].T + placing[:, 3]
    depth = np.full((len(SHADOW_VIEWS_M), 2, SHADOW_TEXELS, SHADOW_TEXELS), np.inf, np.float32)
    size = SHADOW_TEXELS
    ends = [_extent(placed[..., 0]), _extent(placed[..., 1])]
    for i, (x0, x1, z0, z1) in enumerate(SHADOW_VIEWS_M):
        inside = (ends[0][1] > x0) & (ends[0][0] < x1) & (ends[1][1] > z0) & (ends[1][0] < z1)
        for j, chosen in enumerate((inside & ~actor, inside & actor)):
            points = placed[chosen]
            if not len(points):
                continue
            w = points[..., 2:] + np.float32(_SHADOW_DISTANCE_M)
            texels = np.array([size / (x1 - x0), size / (z1 - z0)], np.float32)
            pixels = (points[..., :2] - np.array([x0, z0], np.float32)) * texels - 0.5
            clip = np.concatenate([pixels * w, w], axis=-1)
            _, found = rasterise(clip, np.eye(3), np.array([[0, 0, size, size]]), np.array([[0, len(points)]]))
            depth[i, j] = found.reshape(size, size) - np.float32(_SHADOW_DISTANCE_M)
    return SunMaps(placing, depth)


def develop_pixels(
    sight: Sight,
    setting: Setting,
    maps: SunMaps | None,
    shadows: list[Shadow],
    target: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> np.ndarray:
    """Fill in display values. target: the image (H * W, 3) to fill, the pixels (H * W,) to do, and the light beyond
    white (H * W, 3) to fill where lamps are on. Returns the pixels (H * W,) that actors touch.
    """
    image, wanted, shining = target
    n, width = SUPERSAMPLING, setting.view.camera.width
    once, apart = _shading_sites(sight)
    whole, parts = np.flatnonzero(once & wanted), np.flatnonzero(apart & wanted)

    def first_sample(pixels: np.ndarray) -> np.ndarray:
        rows, columns = np.divmod(pixels, width)
        return rows * (n * n * width) + columns * n

    corner = first_sample(parts)
    spread = np.stack([corner + dy * n * width + dx for dy in range(n) for dx in range(n)], axis=1).reshape(-1)
    sites = np.concatenate([first_sample(whole), spread])
    radiance, changed = _shade_sites(sight, sites, setting, maps, shadows)
    visible = develop(radiance, setting.response)
    image[whole] = visible[: len(whole)]
    fine_visible = visible[len(whole) :].reshape(-1, n * n, 3)
    image[parts] = sum(fine_visible[:, i] for i in range(n * n)) / np.float32(n * n)
    if len(setting.lamps):
        beyond = np.maximum(radiance * setting.response.exposure * setting.response.white_balance - 1, 0)
        shining[whole] = beyond[: len(whole)]
        shining[parts] = beyond[len(whole) :].reshape(-1, n * n, 3).mean(axis=1)
    touched = np.zeros(len(image), bool)
    touched[whole] = changed[: len(whole)]
    touched[parts] = changed[len(whole) :].reshape(-1, n * n).any(axis=1)
    for owner in blocks(sight.owner):
        touched |= owner.reshape(-1) > 0
    return touched


def _shading_sites(sight: Sight) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (H * W,) bool shaded once, and those where every sample is shaded: outlines, thin things."""
    faces, depths = blocks(sight.face), blocks(sight.depth)
    keys = blocks(sight.material.astype(np.int32) * 4096 + sight.owner)
    same_face, alike = faces[1] == faces[0], keys[1] == keys[0]
    near, far = depths[0], depths[0]
    for i in range(1, len(faces)):
        same_face = same_face & (faces[i] == faces[0])
        alike = alike & (keys[i] == keys[0])
        near, far = np.minimum(near, depths[i]), np.maximum(far, depths[i])
    leaf = blocks(sight.material)[0] == Material.LEAF
    # Deep foliage is all outline: one sample of its four is enough, as lens blur and grain hide the rest.
    once = (same_face | alike & ((far < near * np.float32(1.03)) | leaf)).reshape(-1)
    return once, ~once


def _shade_sites(
    sight: Sight, index: np.ndarray, setting: Setting, maps: SunMaps | None, shadows: list[Shadow]
) -> tuple[np.ndarray, np.ndarray]:
    """Linear radiance (n, 3) at samples of the fine image, given by flat index (n,), and whether shadows of actors
    change it (n,)."""
    seen, view = sight.faces, setting.view
    face, w = sight.face.reshape(-1)[index], sight.depth.reshape(-1)[index]
    row, column = np.divmod(index, SUPERSAMPLING * view.camera.width)
    inverse = np.linalg.inv(fine_matrix(view)).astype(np.float32)
    ray = np.empty((len(index), 3), np.float32)
    for axis in range(3):
        ray[:, axis] = column * inverse[axis, 0] + row * inverse[axis, 1] + inverse[axis, 2]
    out = np.empty((len(face), 3), np.float32)
    sky = np.flatnonzero(face < 0)
    if len(sky):
        direction = unit(ray[sky])
        out[sky] = sky_radiance(setting.light, direction, setting.noise)
        if setting.light.weather == "fog":
            out[sky] = setting.light.horizon.astype(np.float32) * 0.8
    land = np.flatnonzero(face >= 0)
    changed = np.zeros(len(face), bool)
    if not len(land):
        return out, changed
    face = face[land]
    marked = np.zeros(len(seen), bool)
    marked[face] = True
    used = np.flatnonzero(marked)
    rank = np.cumsum(marked, dtype=np.int32) - 1
    local = rank[face]
    attributes = _attribute_maps(seen, used)
    point = ray[land] * w[land, None]
    values = np.matmul(attributes[local], point[:, :, None])[:, :, 0]
    normal = unit(values[:, :3])
    away = np.einsum("ni,ni->n", normal, point) > 0
    normal[away] *= -1
    world = view.to_world(point + view.centre.astype(np.float32))
    material, owner = seen.material[face], seen.owner[face]
    lit, shaded = _lit(maps, point, normal, (material, owner, setting.light.sun))
    open_sky, hemmed = _open_sky(world, material, owner, shadows)
    changed[land] = shaded | hemmed
    samples = Samples(
        point=point,
        world=world,
        normal=normal,
        uv=values[:, 3:5],
        material=material,
        albedo=seen.albedo[face],
        pattern=seen.pattern[face],
        owner=owner,
        lit=lit,
        open_sky=open_sky,
        pixel_m=point[:, 2] / np.float32(view.camera.intrinsics[0, 0]),
    )
    out[land] = shade(samples, setting)
    return out, changed


def _attribute_maps(seen: Soup, used: np.ndarray) -> np.ndarray:
    """(m, 5, 3) linear maps from a point on each used face (centre-relative) to its normal and surface
    coordinates.

    Barycentric coordinates are linear in the point, as the point is the same combination of the three corners.
    """
    corners = seen.corners[used].astype(np.float64)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    rows = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = (a * rows[:, 0]).sum(axis=1)
    rows /= np.where(np.abs(volume) < 1e-12, 1e-12, volume)[:, None, None]
    values = np.concatenate([seen.normals[used], seen.uv[used]], axis=2)
    return np.einsum("mik,mij->mkj", values, rows).astype(np.float32)


def _lit(
    maps: SunMaps | None, point: np.ndarray, normal: np.ndarray, samples: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Share (n,) of the sun that arrives, and where (n,) actors take some. samples: (material, owner, sun)."""
    n = len(point)
    shaded = np.zeros(n, bool)
    if maps is None:
        return np.zeros(n, np.float32), shaded
    material, owner, sun = samples
    lit = np.zeros(n, np.float32)
    facing = normal @ sun.astype(np.float32)
    leaf = material == Material.LEAF
    towards = np.flatnonzero((facing > 0) | leaf)
    slope = np.sqrt(np.maximum(1 - facing[towards] ** 2, 0))
    away = np.where(leaf[towards, None], sun.astype(np.float32), normal[towards])
    by_actor = ((np.isin(material, GROUND)) | (owner > 0))[towards]
    share = np.ones(len(towards), np.float32)
    pending = np.ones(len(towards), bool)
    size = SHADOW_TEXELS
    for i, (x0, x1, z0, z1) in enumerate(SHADOW_VIEWS_M):
        texel = (x1 - x0) / size
        steep = SHADOW_OFFSET_M + SHADOW_OFFSET_TEXELS * texel * slope
        offset = np.where(leaf[towards], LEAF_DEPTH_M, steep).astype(np.float32)
        place = (point[towards] + offset[:, None] * away) @ maps.rows[:, :3].T + maps.rows[:, 3]
        u = (place[:, 0] - np.float32(x0)) * np.float32(1 / texel) - 0.5
        v = (place[:, 1] - np.float32(z0)) * np.float32(size / (z1 - z0)) - 0.5
        here = pending & (u > 2) & (v > 2) & (u < size - 4) & (v < size - 4)
        pending &= ~here
        for j, chosen in ((0, np.flatnonzero(here)), (1, np.flatnonzero(here & by_actor))):
            table = maps.depth[i, j]
            if not len(chosen):
                continue
            open_share = _soft_compare(table, u[chosen], v[chosen], place[chosen, 2] - np.float32(0.02))
            share[chosen] *= open_share
            if j == 1:
                shaded[towards[chosen]] = open_share < 1
    lit[towards] = share
    return lit, shaded


def _soft_compare(table: np.ndarray, u: np.ndarray, v: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Share (n,) of a map's texels around (u, v) that lie behind `depth`: a tent three texels wide."""
    u0, v0 = np.floor(u), np.floor(v)
    fu, fv = u - u0, v - v0
    base = (v0.astype(np.int32) - 1) * np.int32(table.shape[1]) + u0.astype(np.int32) - 1
    flat = table.reshape(-1)
    total = np.zeros(len(u), np.float32)
    for i, across in enumerate((1 - fv, None, None, fv)):
        row = base + np.int32(i * table.shape[1])
        part = (flat[row] >= depth) * (1 - fu)
        part += flat[row + 1] >= depth
        part += flat[row + 2] >= depth
        part += (flat[row + 3] >= depth) * fu
        total += part if across is None else part * across
    total *= np.float32(1 / 9)
    return total


def _open_sky(
    world: np.ndarray, material: np.ndarray, owner: np.ndarray, shadows: list[Shadow]
) -> tuple[np.ndarray, np.ndarray]:
    """Share (n,) of the sky that lights a sample: less near the ground on upright things, and beside vehicles; and
    where (n,) vehicles hide some of it.
    """
    hemmed = np.zeros(len(world), bool)
    height = -world[:, 1]
    upright = ~np.isin(material, GROUND)
    open_sky = np.ones(len(height), np.float32)
    low = 0.5 + 0.5 * np.clip(height / 1.2, 0, 1)
    open_sky = np.where(upright, low, open_sky)
    actor = owner > 0
    open_sky = np.where(actor, 0.3 + 0.7 * np.clip((height - 0.12) / 0.6, 0, 1), open_sky).astype(np.float32)
    ground = np.flatnonzero(~upright)
    spot = world[ground][:, [0, 2]]
    for shadow in shadows:
        reach = 0.75 * shadow.size_lhw[1]
        radius = 0.5 * float(np.hypot(shadow.size_lhw[0], shadow.size_lhw[2])) + reach
        local = spot - np.asarray(shadow.position_xz, np.float32)
        near = np.flatnonzero((np.abs(local[:, 0]) < radius) & (np.abs(local[:, 1]) < radius))
        if not len(near):
            continue
        local = local[near]
        cos, sin = np.float32(np.cos(shadow.yaw)), np.float32(np.sin(shadow.yaw))
        along = np.abs(local[:, 0] * cos - local[:, 1] * sin) - np.float32(shadow.size_lhw[0] / 2)
        across = np.abs(local[:, 0] * sin + local[:, 1] * cos) - np.float32(shadow.size_lhw[2] / 2)
        outside = np.hypot(np.maximum(along, 0), np.maximum(across, 0))
        inside = np.minimum(np.maximum(along, across), 0)
        dark = 0.62 * np.exp(-outside / (0.32 * reach)) + 0.36 * np.clip(-inside / 0.25, 0, 1)
        dark[dark < 0.004] = 0
        open_sky[ground[near]] *= (1 - np.minimum(dark, 0.97)).astype(np.float32)
        hemmed[ground[near]] |= dark > 0
    return open_sky, hemmed


def take(image: np.ndarray, setting: Setting) -> np.ndarray:
    """Lens and sensor: (H, W, 3) display values to uint8, with chromatic error, blur, rain, vignette and noise."""
    response, seed = setting.response, grain_number(setting)
    out = through_lens(image, setting)
    height, width = out.shape[:2]
    x = np.linspace(-1, 1, width, dtype=np.float32)[None]
    y = np.linspace(-1, 1, height, dtype=np.float32)[:, None] * np.float32(height / width)
    out *= (1 - np.float32(response.vignette) * (x * x + y * y))[..., None]
    grain = white_noise(seed, out.size).reshape(out.shape)
    out += grain * (np.float32(response.noise) * (np.float32(0.4) + np.sqrt(np.maximum(out, 0))))
    return np.clip(np.rint(out * 255), 0, 255).astype(np.uint8)
