"""theta of a clip: one change a car, a smooth path, and the way back to what is feasible in all frames."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.space import Budget, Parameter, ParameterSpace
from drivesem.video.clips import DerenderedClip
from drivesem.video.objective import ClipSpace, project_clip
from drivesem.video.report import MissedInterval, TrackResult
from scene_ir.types import Category, SceneIR
from tests.drivesem.video.clips import clip_of

PARAMS = ("color", "weather", "translate", "rotate", "mesh")


@pytest.fixture(scope="module")
def streets(street: Callable[..., SceneIR]) -> DerenderedClip:
    return clip_of(street, 4, without=2)


@pytest.fixture(scope="module")
def space(streets: DerenderedClip) -> ClipSpace:
    return ClipSpace([ParameterSpace(scene, PARAMS) for scene in streets.scenes], streets.tracks)


def random_theta(space: ClipSpace, share: float = 1.0, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    place = torch.rand(space.dim, generator=generator)
    return share * (space.lower + place * (space.upper - space.lower))


def test_what_is_a_cars_is_the_same_in_all_frames(space: ClipSpace, streets: DerenderedClip) -> None:
    theta = random_theta(space)
    for parameter in (Parameter.COLOR, Parameter.ROTATE, Parameter.MESH):
        seen: dict[int, torch.Tensor] = {}
        for frame, tracks in enumerate(streets.tracks):
            block = space.spaces[frame].block(space.frame_theta(theta, frame), parameter)
            assert block is not None
            for row, track in enumerate(tracks):
                assert torch.equal(seen.setdefault(track, block[row]), block[row])
    for frame, one in enumerate(space.spaces):
        weather = one.block(space.frame_theta(theta, frame), Parameter.WEATHER)
        assert weather is not None
        assert torch.equal(weather, theta[space.blocks[Parameter.WEATHER]])


def test_frames_with_and_without_people_share_a_colour(streets: DerenderedClip) -> None:
    """A frame without objects, read from a file, has five codes."""
    scenes = list(streets.scenes)
    for frame in (1, 2, 3):
        count = len(scenes[frame].objects)
        kinds = torch.tensor([int(Category.PEDESTRIAN), *[int(Category.CAR)] * (count - 1)])
        scenes[frame] = scenes[frame].with_objects(texture_code=torch.zeros(count, 8), category=kinds)
    space = ClipSpace([ParameterSpace(scene, ("color", "weather")) for scene in scenes], streets.tracks)
    theta = random_theta(space)
    block = space.block(theta, Parameter.COLOR)
    assert block is not None
    assert block.shape[1] == 8
    for frame, width in enumerate((5, 8, 8, 8)):
        colour = space.spaces[frame].block(space.frame_theta(theta, frame), Parameter.COLOR)
        assert colour is not None
        assert torch.equal(colour, block[space.rows[frame], :width])
    projected = project_clip(space, [FeasibleSet(one) for one in space.spaces], theta)
    assert projected.active, "weather that every frame limits"
    assert torch.equal(projected.theta[space.blocks[Parameter.COLOR]], block.flatten())


def test_theta_0_is_the_clip_as_it_was(space: ClipSpace, streets: DerenderedClip) -> None:
    for frame, scene in enumerate(streets.scenes):
        here = space.frame_theta(space.theta0, frame)
        assert not here.any()
        assert torch.equal(space.spaces[frame].apply(scene, here).objects.translation, scene.objects.translation)


def test_a_path_is_a_cubic_within_its_bounds(streets: DerenderedClip) -> None:
    spaces = [ParameterSpace(streets.scenes[0], ("translate",))] * 9
    space = ClipSpace(spaces, [streets.tracks[0]] * 9)
    theta = random_theta(space)
    path = torch.stack([space.frame_theta(theta, frame) for frame in range(9)]).double()
    assert (path.abs() <= 0.25).all()
    fourth = torch.diff(path, n=4, dim=0)
    assert fourth.abs().max() < 1e-5
    assert torch.diff(path, n=3, dim=0).abs().max() > 1e-3
    length_m = streets.scenes[0].objects.size_lhw[:, :1]
    assert torch.equal(space.path_offsets(theta, 3), space.frame_theta(theta, 3).reshape(-1, 2) * length_m)
    still = ClipSpace(spaces, [streets.tracks[0]] * 9, bend=0)
    theta = random_theta(still)
    assert all(torch.equal(still.frame_theta(theta, f), still.frame_theta(theta, 0)) for f in range(9))


@pytest.mark.parametrize("bend", [0, 3])
def test_a_persons_path_ends_at_the_labelled_place_before_frames_without_the_person(
    streets: DerenderedClip, bend: int
) -> None:
    """In frames 12 and 13 the person of track 7 is background: its offset shrinks in the second before."""
    spaces = [ParameterSpace(streets.scenes[0], ("translate",))] * 12
    tracks = [streets.tracks[0]] * 12
    background = [frozenset[int]()] * 12 + [frozenset({7})] * 2
    free, space = ClipSpace(spaces, tracks, bend), ClipSpace(spaces, tracks, bend, background)
    theta = random_theta(space)
    for frame in range(12):
        offset, whole = (one.path_offsets(theta, frame) for one in (space, free))
        assert torch.equal(offset[[0, 2]], whole[[0, 2]])
        assert torch.allclose(offset[1], min((12 - frame) / 10, 1.0) * whole[1])


def test_bounds_are_the_tightest_of_a_cars_frames(streets: DerenderedClip) -> None:
    budget = Budget(translate_m=4.0, translate=1.5, distance_share=0.05)
    spaces = [ParameterSpace(scene, ("translate",), budget) for scene in streets.scenes]
    space = ClipSpace(spaces, streets.tracks)
    upper = space.upper.reshape(space.count, -1)
    for row, track in enumerate(space.tracks):
        own = [
            float(one.upper.reshape(-1, 2)[tracks.index(track), 0])
            for one, tracks in zip(spaces, streets.tracks, strict=True)
            if track in tracks
        ]
        assert float(upper[row, 0]) == pytest.approx(min(own), rel=1e-4)


def test_gradients_go_back_to_the_clip(space: ClipSpace) -> None:
    theta = random_theta(space).double().requires_grad_(True)
    weights = torch.rand(space.spaces[1].dim, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    (gradient,) = torch.autograd.grad((space.frame_theta(theta, 1) * weights).sum(), theta)
    step = torch.zeros_like(gradient)
    step[space.blocks[Parameter.TRANSLATE].start + 2] = 1e-3
    moved = space.frame_theta(theta.detach() + step, 1) - space.frame_theta(theta.detach(), 1)
    change = (moved * weights).sum() / 1e-3
    assert float((gradient * step).sum() / 1e-3) == pytest.approx(float(change), rel=1e-5, abs=1e-9)


def test_names_units_and_values_are_a_cars(space: ClipSpace) -> None:
    message = space.theta_by_name(random_theta(space))
    first = "tracks[4].translate.along[0]"
    assert first in message
    assert str(message[first]["display"]).endswith(" m")
    assert message["tracks[9].yaw"]["unit"] == "rad"
    assert str(message["tracks[9].yaw"]["display"]).endswith(" deg")
    assert "weather.fog" in message
    assert not any(" " in str(entry["display"]) for name, entry in message.items() if "paint" in name)


def test_colours_alone_have_values(streets: DerenderedClip) -> None:
    space = ClipSpace([ParameterSpace(scene, ("color",)) for scene in streets.scenes], streets.tracks)
    assert len(space.theta_by_name(random_theta(space))) == space.dim


def test_projection_is_feasible_in_every_frame_and_keeps_what_is(
    space: ClipSpace, streets: DerenderedClip
) -> None:
    sets = [FeasibleSet(one) for one in space.spaces]
    found = project_clip(space, sets, random_theta(space, 0.9))
    assert found.active
    for frame, feasible in enumerate(sets):
        here = space.frame_theta(found.theta, frame)
        assert torch.allclose(feasible.project(here).theta, here, atol=1e-5)
    again = project_clip(space, sets, found.theta)
    assert torch.allclose(again.theta, found.theta, atol=1e-5)
    assert torch.equal(project_clip(space, sets, space.theta0).theta, space.theta0)
    assert bool(found.theta.any())


def test_cars_that_cannot_move_stay(space: ClipSpace) -> None:
    """Where a frame grants nothing, the clip has nothing, and the search for it ends."""

    class Nothing:
        def project(self, theta: torch.Tensor) -> object:
            return type("Found", (), {"theta": torch.zeros_like(theta), "active": ("objects[0]: road",)})()

    sets = [FeasibleSet(one) for one in space.spaces]
    found = project_clip(space, [Nothing(), *sets[1:]], random_theta(space, 0.5))  # pyright: ignore[reportArgumentType]
    assert not space.frame_theta(found.theta, 0).any()
    assert f"tracks[{space.tracks[int(space.rows[0][0])]}]: road" in found.active


def test_misses_are_counted_by_stretch_and_metre() -> None:
    away = (30.0, 28.0, 25.0, 24.0, 25.0, None, 20.0, 19.0)
    missed = MissedInterval.from_states("flll- lf", away)
    assert missed == MissedInterval(frames=6, lost=4, longest=3, metres=7.0, metres_lost=6.0)
    nothing = MissedInterval.from_states("--  ", (9.0, 8.0, None, None))
    assert nothing == MissedInterval(0, 0, 0, 0.0, 0.0)
    car = TrackResult.from_states(
        4, "Car", {"before": "ff", "after": "fl", "control": "ll"}, (9.0, 7.5), (None, None), [True]
    )
    assert (car.frames, car.lost_before, car.lost_after, car.lost_control, car.new_misses) == (2, 0, 1, 2, 1)
    assert (car.metres, car.metres_lost_after, car.graded, car.certain) == (1.5, 1.5, 1, 1)
