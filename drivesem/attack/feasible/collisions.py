"""Collisions: how far the footprints of cars lie apart, and how much ground they share."""

from __future__ import annotations

import numpy as np

from drivesem.attack.feasible.cars import Array, Cars, Indices, Turns, centres


def gap_between(cars: Cars, rows: Indices) -> Array:
    """Signed gap (M, N) m between the footprints of the cars `rows` and all, by separating axes; negative: depth
    of overlap.
    """
    centre, turn = centres(cars), cars.turn
    half = 0.5 * (cars.high - cars.low)[:, ::2]
    apart = centre[rows, None] - centre
    # Along and across, (M, N, 2): the way between them in the frames of both, one's axes in the other's frame.
    way = _parts(turn[rows, None] * apart)
    way_there = _parts(turn * apart)
    mixed = _parts(turn[rows, None] * turn.conj())
    mixed_back = mixed[..., ::-1]
    here = way - half[rows, None] - mixed * half[:, :1] - mixed_back * half[:, 1:]
    there = way_there - half - mixed * half[rows, None, :1] - mixed_back * half[rows, None, 1:]
    return np.maximum(here, there).max(axis=2)


def _parts(numbers: Turns) -> Array:
    """Absolute real and imaginary parts (..., 2)."""
    return np.abs(numbers.view(np.float64).reshape(*numbers.shape, 2))


def shared_ground(cars: Cars, i: Indices, j: Indices) -> Array:
    """Area (K,) m2 that the footprints of the cars i and j (K,) share."""
    half, centre = 0.5 * (cars.high - cars.low), centres(cars)
    corners = half[:, :1] * [1, 1, -1, -1] + 1j * half[:, 2:] * [1, -1, -1, 1]
    corners = centre[:, None] + cars.turn.conj()[:, None] * corners
    footprint = corners.view(np.float64).reshape(*corners.shape, 2)
    return _shared_area(footprint[i], footprint[j])


def _shared_area(a: Array, b: Array) -> Array:
    """Area (P,) shared by convex polygons (P, 4, 2), both around in the same sense, by Green's theorem."""
    return 0.5 * np.abs(_inside_integral(a, b) + _inside_integral(b, a))


def _inside_integral(a: Array, b: Array) -> Array:
    """Integral (P,) of x dz - z dx along the parts of a's edges that lie inside b (Cyrus and Beck's clipping)."""
    start, along = a, np.roll(a, -1, axis=1) - a
    corner, edge = b, np.roll(b, -1, axis=1) - b
    outline = edge[..., 0] * np.roll(edge, -1, axis=1)[..., 1] - edge[..., 1] * np.roll(edge, -1, axis=1)[..., 0]
    sense = np.sign(outline[:, :1, None])
    relative = start[:, :, None] - corner[:, None]
    distance = sense * (edge[:, None, :, 0] * relative[..., 1] - edge[:, None, :, 1] * relative[..., 0])
    slope = sense * (edge[:, None, :, 0] * along[:, :, None, 1] - edge[:, None, :, 1] * along[:, :, None, 0])
    flat = np.abs(slope) < 1e-12
    cut = -distance / np.where(flat, 1.0, slope)
    enter = np.where(~flat & (slope > 0), cut, 0.0).clip(min=0).max(axis=2)
    leave = np.where(~flat & (slope < 0), cut, 1.0).clip(max=1).min(axis=2)
    inside = (leave > enter) & ~(flat & (distance < 0)).any(axis=2)
    cross = start[..., 0] * along[..., 1] - start[..., 1] * along[..., 0]
    return (np.where(inside, leave - enter, 0.0) * cross).sum(axis=1)
