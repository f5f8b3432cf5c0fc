"""Soft maps of sky, foliage, road: by the shipped network, a user's segmenter, a data set's classes."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from drivesem.synth.exposure import expose
from drivesem.synth.frames import SynthFrame, SynthSettings, generate_frame
from scene_ir.derender import segmentation as segment
from scene_ir.derender import unet
from scene_ir.derender.segmentation import Segmentation, StreetClass
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.types import Camera, Frame

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
LEVEL = torch.tensor([0.0, -1.0, 0.0, 1.65])


@pytest.fixture(scope="module")
def street() -> SynthFrame:
    """A street of the held-out pools, with trees, cars and sky."""
    return generate_frame(42, 3, "heldout", SynthSettings(bent=True))


@pytest.fixture(scope="module")
def image(street: SynthFrame) -> np.ndarray:
    return street.image.astype(np.float32) / 255


@pytest.fixture(scope="module")
def seen(street: SynthFrame, image: np.ndarray) -> Segmentation:
    return segment.segment_photograph(image, street.environment.ground, street.camera)


def iou(found: np.ndarray, truth: np.ndarray) -> float:
    return float((found & truth).sum() / (found | truth).sum())


def test_streets_that_no_training_frame_has(street, seen):
    other = generate_frame(42, 6, "heldout", SynthSettings(bent=True))
    picture = other.image.astype(np.float32) / 255
    both = ((street, seen), (other, segment.segment_photograph(picture, other.environment.ground, other.camera)))
    for name, truth, least in (("sky", "sky", 0.93), ("foliage", "foliage_map", 0.6), ("road", "road", 0.75)):
        found = np.concatenate([getattr(maps, name).ravel() for _, maps in both]) > 0.5
        share = np.concatenate([getattr(frame.environment, truth).numpy().ravel() for frame, _ in both]) > 0.5
        assert iou(found, share) > least, name


def test_vehicles_are_found_and_are_nothing_else(street, seen):
    vehicle = np.isin(street.semantic, (12, 13, 14))
    assert iou(seen.vehicle > 0.5, vehicle) > 0.6
    inside = (seen.vehicle > 0.9) & vehicle
    assert inside.any()
    assert max(float(getattr(seen, name)[inside].mean()) for name in ("sky", "foliage", "road")) < 0.05


def test_maps_are_soft_shares_within_one(street, seen):
    for field in fields(Segmentation):
        values = getattr(seen, field.name)
        assert values.shape == street.image.shape[:2]
        assert values.dtype == np.float32
        assert values.min() >= 0
        assert values.max() <= 1
    assert (seen.sky + seen.foliage).max() <= 1 + 1e-6
    assert ((seen.foliage > 0.2) & (seen.foliage < 0.8)).any()


def test_no_sky_below_the_horizon_and_no_ground_above(street, image):
    def all_of(name: str) -> segment.Segmenter:
        shares = np.zeros((3, 10, 20), np.float32)
        shares[("sky", "road", "tree").index(name)] = 1
        return lambda _: (shares, ("sky", "road", "tree"))

    ground, camera = street.environment.ground, street.camera
    height = unet.compute_elevation(ground, camera, image.shape[:2])
    sky = segment.segment_photograph(image, ground, camera, all_of("sky")).sky
    road = segment.segment_photograph(image, ground, camera, all_of("road")).road
    assert sky[height < -0.02].max() == 0
    assert sky[height > 0].min() > 0.99
    assert road[height > 0.03].max() == 0
    assert road[height < 0].min() > 0.99


def test_pictures_of_other_sizes_and_focal_lengths_come_out_at_their_own(image):
    for shape, focal in (((61, 90), 70.0), ((1100, 900), 500.0)):
        part = np.ascontiguousarray(np.resize(image, (*shape, 3)))
        matrix = torch.tensor([[focal, 0, shape[1] / 2], [0, focal, shape[0] / 2], [0, 0, 1.0]])
        shares = segment.predict_shares(part, LEVEL, Camera(matrix, *shape))
        assert shares.shape[0] == len(StreetClass)
        assert shares.sum(0) == pytest.approx(1, abs=1e-5)
        assert segment.segment_photograph(part, LEVEL, Camera(matrix, *shape)).sky.shape == shape


def test_same_picture_same_maps(street, image, seen):
    again = segment.segment_photograph(image, street.environment.ground, street.camera)
    assert all(np.array_equal(getattr(again, f.name), getattr(seen, f.name)) for f in fields(Segmentation))


def test_a_users_segmenter_replaces_the_network(image):
    names = ("Road", "sidewalk", "building", "vegetation", "sky", "car", "rider")
    shares = np.zeros((7, 4, 8), np.float32)
    shares[4, :2], shares[3, 2, :4], shares[5, 2, 4:], shares[0, 3, :6], shares[1, 3, 6:] = 1, 1, 1, 1, 1
    camera = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
    blank = np.full((200, 480, 3), 0.5, np.float32)
    inputs = []
    found = segment.segment_photograph(
        blank, LEVEL, camera, lambda picture: (inputs.append(picture), (shares, names))[1]
    )
    assert inputs[0] is blank
    assert found.sky[20].min() > 0.95
    assert found.foliage[125, :180].min() > 0.9
    assert found.vehicle[125, 300:].min() > 0.9
    assert found.road[190, :300].min() > 0.95
    assert found.ground[190].min() > 0.95
    assert found.road[190, 420:].max() < 0.05


@pytest.mark.parametrize(
    ("names", "count", "error", "message"),
    [
        (("sky", "tree", "car"), 3, RangeError, "segmenter: expected a class for road, found sky, tree, car"),
        (("sky", "tree", "road"), 4, ShapeError, r"segmenter: expected shares \(3, h, w\), found \(4, 5, 6\)"),
    ],
)
def test_a_segmenter_that_cannot_be_used_is_an_error(names, count, error, message):
    blank = np.zeros((200, 480, 3), np.float32)
    with pytest.raises(error, match=message):
        segment.segment_photograph(blank, LEVEL, CAMERA, lambda _: (np.zeros((count, 5, 6), np.float32), names))


def framed(street: SynthFrame) -> Frame:
    """The street as a reader of Virtual KITTI gives it."""
    shot = expose(street)
    photograph = torch.from_numpy(street.image.astype(np.float32).transpose(2, 0, 1) / 255)
    classes = torch.from_numpy(shot.classes.astype(np.int64))
    return Frame("000000", photograph, street.camera, classes=classes, class_names=shot.class_names)


def test_a_data_sets_classes_are_the_maps(street, seen):
    frame = framed(street)
    given = segment.apply_frame_classes(frame, seen)
    names = np.array(frame.class_names)[frame.classes.numpy()]
    terrain = names == "Terrain"
    assert np.array_equal(given.sky, names == "Sky")
    assert np.array_equal(given.road, names == "Road")
    assert np.array_equal(given.foliage[~terrain], np.isin(names, ("Tree", "Vegetation"))[~terrain])
    assert np.array_equal(given.foliage[terrain], seen.foliage[terrain])
    assert np.array_equal(given.ground, np.isin(names, ("Road", "Terrain")))
    assert np.array_equal(given.vehicle, np.isin(names, ("Car", "Van", "Truck")))
    assert segment.apply_frame_classes(replace(frame, classes=None, class_names=()), seen) is seen


def test_maps_of_one_within_a_mask_of_another(seen):
    other = Segmentation(*(1 - getattr(seen, f.name) for f in fields(Segmentation)))
    mask = np.zeros(seen.sky.shape, bool)
    mask[:40] = True
    mixed = seen.merge_inside(mask, other)
    assert np.array_equal(mixed.sky[:40], other.sky[:40])
    assert np.array_equal(mixed.sky[40:], seen.sky[40:])


def test_the_shipped_weights_are_small_and_anothers_are_refused():
    assert segment.WEIGHTS.stat().st_size < 2_000_000
    assert sum(p.numel() for p in segment.load_network().parameters()) < 500_000
    with pytest.raises(FormatError, match="pose"):
        segment.load_network(segment.WEIGHTS.with_name("pose.safetensors"))


def test_the_sky_has_grey_clouds_and_gaps_between_branches_but_no_poles():
    image = np.full((120, 200, 3), (0.3, 0.5, 0.9), np.float32)
    sky = np.ones((120, 200), np.float32)
    cloud, pole, gap, branch = np.s_[10:40, 60:100], np.s_[0:80, 78:82], np.s_[50:60, 20:30], np.s_[48:62, 30:34]
    image[cloud], sky[cloud] = (0.5, 0.5, 0.55), 0.3
    image[pole], sky[pole] = (0.12, 0.12, 0.12), 0.3
    sky[gap] = 0.0
    image[branch], sky[branch] = (0.2, 0.15, 0.1), 0.0
    blue_wall = np.s_[90:120, 0:40]
    sky[80:] = 0.0
    image[80:] = 0.4
    image[blue_wall] = (0.05, 0.1, 0.5)
    found = segment._complete_sky(sky, image, image.shape[0] // 4)
    assert found[15:35, 64:72].min() > 0.9
    assert found[12:70, 79:81].max() < 0.4
    assert found[53:58, 22:27].min() > 0.9
    assert found[50:60, 31:33].max() == 0.0
    assert found[blue_wall].max() == 0.0
