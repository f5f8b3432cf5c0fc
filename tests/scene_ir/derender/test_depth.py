"""Depth of a photograph's surroundings: the shipped network, and what ties it to what is known."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
import torch

from drivesem.synth.frames import SynthFrame, SynthSettings, generate_frame
from drivesem.synth.soup import Material
from scene_ir.derender import depth
from scene_ir.derender import depth as maps
from scene_ir.derender.depth import DepthConstraints
from scene_ir.errors import FormatError
from scene_ir.types import Camera
from tests.scene_ir.derender.conftest import HEIGHT, HORIZON, WIDTH, camera

LEVEL = torch.tensor([0.0, -1.0, 0.0, 1.65])
LEVEL_MATERIALS = (
    Material.ROAD, Material.PARKING, Material.PAVEMENT, Material.KERB, Material.GRAVEL, Material.GRASS,
)  # fmt: skip
WITHIN = 0.886
"""Share of that street's pixels whose depth is within a quarter of the truth."""


def nothing_known(shape: tuple[int, ...]) -> DepthConstraints:
    return DepthConstraints(*(np.zeros(shape, np.float32) for _ in range(4)))


def asphalt() -> np.ndarray:
    """(H, W, 3): a plain of grained asphalt under a blue sky, and nothing else."""
    rng = np.random.default_rng(3)
    grain = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32), (0, 0), 0.8)
    image = np.repeat((0.42 + 0.06 * grain)[..., None], 3, axis=2)
    image[: int(HORIZON)] = (0.55, 0.72, 0.93)
    return np.clip(image, 0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def street() -> SynthFrame:
    return generate_frame(52, 3, "heldout", SynthSettings(bent=True), with_background=True)


def picture(street: SynthFrame) -> np.ndarray:
    assert street.background is not None
    return street.background.astype(np.float32) / 255


def flat_of(street: SynthFrame) -> np.ndarray:
    return np.isin(street.ground_material, LEVEL_MATERIALS).astype(np.float32)


def ties_of(street: SynthFrame) -> DepthConstraints:
    known = nothing_known(street.image.shape[:2])
    return DepthConstraints(street.environment.sky.numpy(), flat_of(street), known.footprint, known.behind_m)


@pytest.fixture(scope="module")
def found(street: SynthFrame) -> np.ndarray:
    return depth.estimate_depth(picture(street), street.environment.ground, street.camera, ties_of(street))


def test_a_bare_plain_is_as_far_as_its_ground():
    known = nothing_known((HEIGHT, WIDTH))
    known.sky[: int(HORIZON)] = 1
    known.flat[int(HORIZON) :] = 1
    found = depth.estimate_depth(asphalt(), LEVEL, camera(), known)
    plane = maps.compute_plane_depth(LEVEL, camera())
    near = plane < 30
    assert np.median(found[near] / plane[near]) > 0.97
    assert np.percentile(found[near] / plane[near], 5) > 0.85
    assert np.isinf(found[: int(HORIZON) - 2]).all()


def test_a_street_that_no_training_frame_has(street, found):
    truth = street.background_depth_m
    assert truth is not None
    known = truth < 120
    ratio = np.maximum(found[known] / truth[known], truth[known] / found[known])
    assert (ratio < 1.25).mean() == pytest.approx(WITHIN, abs=0.02)


def test_nothing_is_farther_than_the_ground(street, found):
    plane = maps.compute_plane_depth(street.environment.ground, street.camera)
    assert (found <= plane * (1 + 1e-5)).all()
    assert found.dtype == np.float32
    assert found.min() > 0


def test_the_sky_is_endlessly_far(street, found):
    sky = street.environment.sky.numpy() == 1
    above = np.isinf(maps.compute_plane_depth(street.environment.ground, street.camera))
    assert np.isinf(found[sky & above]).all()


def tied_nothing(street: SynthFrame, ties: DepthConstraints) -> np.ndarray:
    """The depth where the vehicles are nearer than all else."""
    close = replace(ties, behind_m=np.full_like(ties.behind_m, 0.5))
    return depth.estimate_depth(picture(street), street.environment.ground, street.camera, close)


def test_what_stands_behind_vehicles_is_no_nearer_than_they_are(street, found):
    near = (found < 20) & np.isinf(maps.compute_plane_depth(street.environment.ground, street.camera))
    assert near.any()
    ties = ties_of(street)
    tied = replace(ties, behind_m=np.where(near, np.float32(25), 0).astype(np.float32))
    again = depth.estimate_depth(picture(street), street.environment.ground, street.camera, tied)
    assert again[near].min() >= 25 * (1 - 1e-5)
    # what is seen around them gives way too, and nothing comes nearer
    assert (again >= found * (1 - 1e-5)).all()
    assert np.array_equal(tied_nothing(street, ties), found)


def test_where_something_stands_there_is_ground(street):
    ground, view = street.environment.ground, street.camera
    plane = maps.compute_plane_depth(ground, view)
    ties = ties_of(street)
    footprint = np.zeros_like(ties.footprint)
    footprint[230:, 300:600] = 1
    tied = depth.estimate_depth(picture(street), ground, view, replace(ties, footprint=footprint))
    inside = tied[260:350, 340:560] / plane[260:350, 340:560]
    assert inside.min() > 0.999


def test_a_picture_twice_as_large_shows_the_same_street(street, found):
    view = street.camera
    matrix = view.matrix.clone()
    matrix[:2] *= 2
    matrix[:2, 2] += 0.5
    twice = Camera(matrix[:, :3], 2 * view.height, 2 * view.width)
    large = cv2.resize(picture(street), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC).clip(0, 1)
    ties = DepthConstraints(
        *(cv2.resize(getattr(ties_of(street), f.name), None, fx=2, fy=2) for f in fields(DepthConstraints))
    )
    again = depth.estimate_depth(large, street.environment.ground, twice, ties)[::2, ::2]
    both = (found < 80) & (again < 80)
    assert np.median(np.abs(np.log(again[both] / found[both]))) < 0.03


def test_same_picture_same_depth(street, found):
    again = depth.estimate_depth(picture(street), street.environment.ground, street.camera, ties_of(street))
    assert np.array_equal(again, found)


def test_the_shipped_weights_are_small_and_anothers_are_refused():
    assert depth.WEIGHTS.stat().st_size < 2_000_000
    with pytest.raises(FormatError, match="segment"):
        depth.load_network(depth.WEIGHTS.with_name("segment.safetensors"))
