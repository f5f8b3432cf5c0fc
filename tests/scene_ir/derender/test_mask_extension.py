"""Masks of large vehicles grow to what counts like the vehicle neighbour them, and no farther."""

import numpy as np
import pytest

from scene_ir.derender import cutout
from scene_ir.derender import matte as widen
from scene_ir.derender.cutout import Cutout
from scene_ir.derender.derender import DerenderSettings, place_vehicles

SHAPE = (200, 320)
PAINT, WALL, DARK = (190, 40, 35), (90, 100, 80), (12, 12, 14)


def picture(car: np.ndarray, paint: tuple[int, int, int] = PAINT) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 6, (*SHAPE, 3))
    return np.clip(np.where(car[..., None], paint, WALL) + noise, 0, 255).astype(np.uint8)


def block(x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
    out = np.zeros(SHAPE, bool)
    out[y0:y1, x0:x1] = True
    return out


def make_cutout(visible: np.ndarray, front: np.ndarray | None = None, shadow: np.ndarray | None = None) -> Cutout:
    nothing = np.zeros(SHAPE, bool)
    maps = (m if m is not None else nothing for m in (front, shadow))
    return Cutout(0, 0, visible.astype(np.float32), *(m.astype(np.float32) for m in maps))


def found(image: np.ndarray, seen: Cutout, other: Cutout | None = None, allowed: np.ndarray | None = None):
    other = other or seen
    drawn = ((seen.visible >= 0.5).astype(np.float32) + (other.visible >= 0.5)) / 2
    allowed = np.ones(SHAPE, bool) if allowed is None else allowed
    return widen.extend_mask(image, seen, other, drawn, allowed).visible >= 0.5


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


MASK = block(80, 60, 240, 170)
ROOF = MASK | block(90, 52, 230, 60)
MIRROR = MASK | block(72, 90, 80, 100)


@pytest.mark.parametrize("car", [ROOF, MIRROR], ids=["roof", "mirror"])
def test_a_missed_part_of_the_same_paint_is_added(car):
    seen = make_cutout(MASK)
    wide = found(picture(car), seen)
    assert np.count_nonzero(wide & car & ~MASK) > 0.9 * np.count_nonzero(car & ~MASK)
    assert iou(wide, car) > 0.99


def test_a_mask_that_is_right_stays():
    assert iou(found(picture(MASK), make_cutout(MASK)), MASK) > 0.99


def test_colours_decide_what_one_cut_out_missed():
    car = MASK | block(30, 70, 80, 160)
    # Beyond the band: without the second cut_out nothing tells of it.
    assert iou(found(picture(car), make_cutout(MASK)), car) < 0.9
    assert iou(found(picture(car), make_cutout(MASK), make_cutout(car)), car) > 0.97
    assert iou(found(picture(MASK), make_cutout(MASK), make_cutout(car)), MASK) > 0.97


def test_shadows_and_nearer_objects_of_the_same_colour_stay_out():
    low, neighbour = block(80, 170, 240, 178), block(240, 60, 248, 170)
    car = MASK | low | neighbour
    image = picture(car, DARK)
    wide = found(image, make_cutout(MASK, shadow=low), allowed=~neighbour)
    assert not (wide & neighbour).any()
    assert np.count_nonzero(wide & low) < 0.2 * np.count_nonzero(low)
    pole = block(150, 40, 158, 60)
    assert not (found(picture(ROOF), make_cutout(MASK, front=pole)) & pole).any()


def test_shares_add_up_to_at_most_one():
    low = block(80, 166, 240, 178).astype(np.float32) * 0.4
    seen = make_cutout(MASK * 0.6, shadow=low)
    wide = widen.extend_mask(picture(ROOF), seen, seen, MASK.astype(np.float32), np.ones(SHAPE, bool))
    assert (wide.visible + wide.front + wide.shadow <= 1 + 1e-6).all()
    assert (wide.visible >= seen.visible).all()


def test_small_vehicles_stay_as_they_are():
    seen = make_cutout(block(80, 60, 240, 120))
    assert widen.extend_mask(picture(ROOF), seen, seen, seen.visible, np.ones(SHAPE, bool)) is seen


def test_the_same_input_gives_the_same_bytes():
    one, two = (found(picture(MIRROR), make_cutout(MASK)) for _ in range(2))
    assert np.array_equal(one, two)


def test_paint_counts_wherever_on_the_vehicle_it_is():
    # Bright windows below the missed roof, dark bars behind: near by only the bars cut_out like it.
    paint = (60, 62, 66)
    image = picture(ROOF | (~MASK & (np.arange(SHAPE[1]) // 8 % 4 == 0)), paint)
    image[60:100, 84:236] = (200, 205, 210)
    seen = make_cutout(MASK)
    wide = widen.extend_mask(image, seen, seen, ROOF.astype(np.float32), np.ones(SHAPE, bool)).visible >= 0.5
    assert np.count_nonzero(wide & ROOF & ~MASK) > 0.9 * np.count_nonzero(ROOF & ~MASK)


@pytest.mark.parametrize("fit", [True, False])
def test_without_a_fit_each_vehicle_is_cut_out_once(street, monkeypatch, fit):
    counts = []
    cut_out = cutout.cut_out

    def counted(image, places, *rest, **options):
        counts.append(len(places))
        return cut_out(image, places, *rest, **options)

    monkeypatch.setattr(cutout, "cut_out", counted)
    assert len(place_vehicles(street.frame, DerenderSettings(fit=fit))) == 1
    assert sum(counts) == (2 if fit else 1)
