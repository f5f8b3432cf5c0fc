"""What stands beside the road: on the ground, of sound triangles, of the right class."""

from collections.abc import Callable

import numpy as np
import pytest

from drivesem.synth import buildings, furniture
from drivesem.synth.soup import Semantic, Soup


def _check(soup: Soup) -> None:
    assert np.isfinite(soup.corners).all()
    assert np.abs(np.linalg.norm(soup.normals, axis=-1) - 1).max() < 1e-4
    assert soup.albedo.min() >= 0
    assert soup.albedo.max() <= 1
    # nothing floats, nothing is buried
    assert soup.corners[..., 1].max() == pytest.approx(0.0, abs=0.06)


def _small(rng: np.random.Generator) -> Soup:
    return furniture.clutter(rng, small=True)


def _large(rng: np.random.Generator) -> Soup:
    return furniture.clutter(rng, small=False)


@pytest.mark.parametrize("make", [furniture.sign, furniture.bus_stop, _small, _large])
def test_furniture_stands_on_the_ground(make: Callable[[np.random.Generator], Soup]) -> None:
    for seed in range(30):
        soup = make(np.random.default_rng(seed))
        _check(soup)
        assert len(soup) < 6000


def test_what_stands_on_pavements_is_slim() -> None:
    for seed in range(30):
        points = _small(np.random.default_rng(seed)).corners.reshape(-1, 3)
        assert np.ptp(points[:, 2]) < 2.0


def test_signs_and_lights_are_their_own_classes() -> None:
    for seed in range(12):
        sign = furniture.sign(np.random.default_rng(seed))
        assert set(sign.semantic) == {Semantic.TRAFFIC_SIGN, Semantic.POLE}
        # the painted side faces the traffic, the other is plain
        plate = sign.semantic == Semantic.TRAFFIC_SIGN
        assert len(np.unique(sign.albedo[plate & (sign.normals[:, 0, 0] < 0)], axis=0)) > 1
        assert len(np.unique(sign.albedo[plate & (sign.normals[:, 0, 0] > 0)], axis=0)) == 1
    light = furniture.traffic_light(np.random.default_rng(0), 3.0)
    _check(light)
    assert set(light.semantic) == {Semantic.TRAFFIC_LIGHT, Semantic.POLE}
    assert np.ptp(light.corners[..., 2]) > 3.0


def test_lamps_and_poles_stand() -> None:
    for soup in (furniture.lamp(7.0, -1), furniture.wire_pole(8.0), furniture.bale()):
        _check(soup)


@pytest.mark.parametrize("front", [0.0, 1.0, -1.0])
def test_buildings_stand_on_the_ground_and_their_windows_are_whole(front: float) -> None:
    for identifier in range(12):
        soup = buildings.building(identifier, 13.7, 9.0, 3, True, front, city=True)
        _check(soup)
        walls = soup.pattern[:, 0] > 0
        reach = np.ptp(soup.uv[walls][..., 0], axis=1)
        windows = reach / soup.pattern[walls, 0]
        assert np.abs(windows - np.round(windows)).max() < 1e-3
        assert set(soup.semantic) <= {Semantic.BUILDING, Semantic.MISC, Semantic.POLE, Semantic.CAR}


def test_fittings_are_on_the_side_of_the_street() -> None:
    bare, near, far = (buildings.building(4, 12.0, 9.0, 3, True, front, city=True) for front in (0.0, 1.0, -1.0))
    assert len(near) > len(bare) + 100
    assert len(near) == len(far)
    assert near.corners[..., 2].max() > bare.corners[..., 2].max() - 1e-3
    assert near.corners[..., 2].mean() > 0 > far.corners[..., 2].mean()
