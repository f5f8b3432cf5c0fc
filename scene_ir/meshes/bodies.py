"""Main bodies of vehicles: skins with wheel arches, bowed ends and named grid lines, and their wheels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scene_ir.meshes.solids import TemplateSolid, VehicleMaterial, coons, mirror_solid, revolve


@dataclass(frozen=True, slots=True)
class Body:
    """Shape of a body's skin. Levels run from the lower edge (0) to the shoulder (1)."""

    length: float
    """m."""
    half_width: float
    """m."""
    clearance: float
    """Height of the lower edge above the ground, m."""
    front_levels: np.ndarray
    """(K + 1,) heights at the front, fractions of the height between lower edge and top."""
    rear_levels: np.ndarray
    """The same at the rear."""
    front_recess: np.ndarray
    """(K + 1,) m, distance of each level behind the foremost point."""
    rear_recess: np.ndarray
    """The same at the rear."""
    side_inset: np.ndarray
    """(K + 1,) m, distance of each level inside the half width along the side."""
    top: Callable[[np.ndarray], np.ndarray]
    """Height of the shoulder line over x (m from the middle, front positive)."""
    crown: float
    """Rise of the lid in the middle over its sides, m."""
    nose_bow: float
    """Bow of the front in plan, m."""
    tail_bow: float
    """Bow of the rear in plan, m."""
    corner: float
    """Half width of front and rear at their corners, as a fraction of `half_width`."""
    front_columns: np.ndarray
    """(m + 1,) fractions of the corner's half width."""
    rear_columns: np.ndarray
    """The same at the rear."""
    axles: tuple[float, ...]
    """x of the axles, m."""
    arch_radius: float
    """Radius of the wheel arches, m."""
    hub: float
    """Height of the axles, m."""
    stations: np.ndarray
    """x of further stations along the side, m."""
    tyre_width: float
    """m."""
    ease: float = 0.9
    """Length over which the plan narrows towards both ends, m."""
    side_levels: np.ndarray | None = None
    """(K + 1,) fractions along the side; interpolated from front to rear by default."""
    arch_steps: int = 8
    """Segments of an arch."""
    arch_reach: float = 1.0
    """Levels at this fraction and above do not bend over the arches."""


def _side_stations(body: Body) -> np.ndarray:
    """x (n + 1,) of the stations along the side, front to rear, without the corners."""
    stations = [body.stations]
    for axle in body.axles:
        arc = axle + body.arch_radius * np.cos(np.linspace(0.0, np.pi, body.arch_steps + 1))
        stations += [arc, axle + np.array([-1.0, 1.0]) * (body.arch_radius + 0.004)]
        lo, hi = axle - body.arch_radius - 0.02, axle + body.arch_radius + 0.02
        stations[0] = stations[0][(stations[0] < lo) | (stations[0] > hi)]
    return np.sort(np.concatenate(stations))[::-1]


def _lower_edge(body: Body, x: np.ndarray) -> np.ndarray:
    """Height of the side's lower edge over x: the clearance, and the arches."""
    edge = np.full_like(x, body.clearance)
    for axle in body.axles:
        d = x - axle
        inside = np.abs(d) < body.arch_radius + 0.002
        rise = np.sqrt(np.clip(body.arch_radius**2 - d**2, 0.0, None))
        edge = np.where(inside, np.maximum(edge, body.hub + rise), edge)
    return edge


def body_grid(body: Body) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Wall, lid and floor of the body's skin, and the x of the side stations."""
    inner = _side_stations(body)
    levels, m, n = len(body.front_levels), len(body.front_columns) - 1, len(inner) + 1
    half_length = body.length / 2
    wall = np.empty((levels, 2 * m + n + 1, 3))
    reach = body.corner * body.half_width
    front_z, rear_z = body.front_columns * reach, body.rear_columns * reach
    for k in range(levels):
        shrink = 1 - body.side_inset[k] / body.half_width
        fx = half_length - body.front_recess[k] - body.nose_bow * body.front_columns**3
        rx = -half_length + body.rear_recess[k] + body.tail_bow * body.rear_columns**3
        x = np.concatenate([fx, np.clip(inner, rx[-1] + 0.004, fx[-1] - 0.004), rx[::-1]])
        # the plan narrows towards both ends: an ellipse's quarter at each corner
        from_front, from_rear = fx[-1] - inner, inner - rx[-1]
        ease = np.clip(np.minimum(from_front, from_rear) / body.ease, 0, 1)
        side_z = reach + (body.half_width - reach) * np.sqrt(1 - (1 - ease) ** 2)
        z = np.concatenate([front_z, side_z, rear_z[::-1]]) * shrink
        wall[k, :, 0], wall[k, :, 2] = x, z
    top_x = wall[-1, :, 0]
    edge = np.full(wall.shape[1], body.clearance)
    edge[m + 1 : m + n] = _lower_edge(body, inner)
    widest = wall[-1, :, 2].max()
    top = body.top(top_x) + body.crown * (1 - (wall[-1, :, 2] / widest) ** 2)
    along = np.clip((half_length - wall[0, :, 0]) / body.length, 0, 1)
    along[: m + 1], along[m + n :] = 0.0, 1.0
    for k in range(levels):
        fraction = body.front_levels[k] * (1 - along) + body.rear_levels[k] * along
        if body.side_levels is not None:
            fraction[m + 1 : m + n] = body.side_levels[k]
        bend = (edge - body.clearance) * np.clip(1 - fraction / body.arch_reach, 0, None)
        wall[k, :, 1] = body.clearance + fraction * (top - body.clearance) + bend
    # inside an arch the lower edge stands out instead of tucking under
    arch = edge > body.clearance + 1e-6
    wall[0, arch, 2] = np.maximum(wall[0, arch, 2], wall[1, arch, 2] + 0.004)
    lid, floor = coons(wall[-1], m, n), coons(wall[0], m, n)
    inside = (slice(0, m), slice(1, n))
    lid[inside][..., 1] = body.top(lid[inside][..., 0]) + body.crown * (1 - (lid[inside][..., 2] / widest) ** 2)
    floor[inside][..., 1] = body.clearance
    well = body.half_width - body.tyre_width - 0.12
    under = arch[m + 1 : m + n]
    floor[m - 1, 1:n, 2] = np.where(under, well, floor[m - 1, 1:n, 2])
    floor[m - 1, 1:n, 1] = np.where(under, edge[m + 1 : m + n], body.clearance)
    floor[m - 2, 1:n, 2] = np.where(under, well - 0.002, floor[m - 2, 1:n, 2])
    floor[1 : m - 2, 1:n, 2] = floor[1 : m - 2, 1:n, 2].clip(max=well - 0.1)
    return wall, lid, floor, inner


def wheels(x: float, z_outer: float, radius: float, tyre_width: float, spokes: int = 5) -> list[TemplateSolid]:
    """Make a wheel and its mirror image, standing on y = 0.

    Args:
        x: Position of the axle, m.
        z_outer: Position of the outer face, m.
        radius: m.
        tyre_width: m.
        spokes: Number of spokes.

    Returns:
        Both wheels.
    """
    r, w = radius, tyre_width
    profile = np.array(
        [
            [0.0, -w],
            [0.80 * r, -w],
            [r, -0.82 * w],
            [r, -0.12 * w],
            [0.93 * r, 0.0],
            [0.68 * r, -0.01],
            [0.64 * r, -0.035],
            [0.20 * r, -0.02],
            [0.0, -0.012],
        ]
    )
    sectors = 20 if spokes != 6 else 24
    strip = np.full((8, sectors), int(VehicleMaterial.TYRE))
    strip[0] = int(VehicleMaterial.UNDERBODY)
    strip[5], strip[7] = int(VehicleMaterial.RIM), int(VehicleMaterial.RIM)
    gap = np.arange(sectors) % (sectors // spokes) >= (sectors // spokes + 1) // 2
    strip[6] = np.where(gap, int(VehicleMaterial.RIM_GAP), int(VehicleMaterial.RIM))
    wheel = revolve(profile, strip, (x, r, z_outer))
    return [wheel, mirror_solid(wheel)]
