"""The least change on games made by hand: what is shortened, what is dropped, what is not monotone."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from drivesem.analysis.explain.attribution import MinimalChangeSearch, ThetaBlock, find_minimal_change
from scene_ir.errors import RangeError

RESOLUTION = 1 / (16 * 32)


def blocks(*groups):
    found = []
    for name, indices in groups:
        mask = torch.zeros(4, dtype=torch.bool)
        mask[list(indices)] = True
        found.append(ThetaBlock(name, mask))
    return found


PAIRS = blocks(("a", (0, 1)), ("b", (2, 3)))


def search(fails, project=lambda theta: theta, points=16):
    return MinimalChangeSearch(project, fails, fails, lambda theta: float(theta.norm()), points)


def test_what_is_not_needed_goes_and_the_rest_is_shortened():
    theta = torch.ones(4)
    found = find_minimal_change(theta, PAIRS, search(lambda t: bool(t[2] > 0.3)))
    assert found.dropped == ("a",)
    assert found.sign_changes == 1
    assert found.scan[:5] == (False,) * 5
    assert 0.3 < found.scale < 0.3 + RESOLUTION
    assert 0.3 < found.shortened_scale < 0.3 + RESOLUTION
    torch.testing.assert_close(found.shortened, found.shortened_scale * theta)
    assert found.theta[:2].tolist() == [0, 0]
    torch.testing.assert_close(found.theta[2:], torch.full((2,), found.scale))


def test_single_coordinates_go_where_they_are_offered():
    every = PAIRS + blocks(*((str(i), (i,)) for i in range(4)))
    found = find_minimal_change(torch.ones(4), every, search(lambda t: bool(t[1] > 0.25) and bool(t[2] > 0.1)))
    assert found.dropped == ("0", "3")
    assert found.theta.nonzero()[:, 0].tolist() == [1, 2]
    assert 0.25 < found.scale < 0.25 + RESOLUTION


def test_the_order_of_blocks_decides_between_two_that_would_each_do():
    fails = search(lambda t: bool(t[0] > 0.5) or bool(t[2] > 0.5))
    assert find_minimal_change(torch.ones(4), PAIRS, fails).dropped == ("a",)
    assert find_minimal_change(torch.ones(4), PAIRS[::-1], fails).dropped == ("b",)


def test_nothing_goes_where_all_is_needed_or_the_rest_would_be_larger():
    both = find_minimal_change(torch.ones(4), PAIRS, search(lambda t: bool(t.min() > 0.5)))
    assert both.dropped == ()
    assert torch.equal(both.theta, both.shortened)
    # alone, b would have to go to 0.9: longer than both of them at 0.5
    fails = search(lambda t: (bool(t[0] > 0.5) and bool(t[2] > 0.5)) or bool(t[2] > 0.9))
    assert find_minimal_change(torch.ones(4), PAIRS, fails).dropped == ()
    # at 0.6 it is shorter, and a goes though the rest grows
    fails = search(lambda t: (bool(t[0] > 0.5) and bool(t[2] > 0.5)) or bool(t[2] > 0.6))
    longer = find_minimal_change(torch.ones(4), PAIRS, fails)
    assert longer.dropped == ("a",)
    assert 0.6 < longer.scale < 0.6 + RESOLUTION


def test_the_first_of_several_intervals_is_taken_and_they_are_counted():
    found = find_minimal_change(
        torch.tensor([1.0, 0, 0, 0]), PAIRS, search(lambda t: 0.2 < float(t[0]) < 0.3 or float(t[0]) > 0.8)
    )
    assert found.sign_changes == 3
    assert 0.2 < found.scale < 0.2 + RESOLUTION


def test_what_falls_between_two_points_of_the_grid_is_not_seen():
    narrow = search(lambda t: 0.26 < float(t[0]) < 0.29 or float(t[0]) > 0.8, points=4)
    assert find_minimal_change(torch.tensor([1.0, 0, 0, 0]), PAIRS, narrow).scale > 0.8


def test_every_point_is_projected():
    seen = []

    def project(theta):
        return theta.clamp(max=0.375)

    def fails(theta):
        seen.append(theta)
        return bool(theta[0] >= 0.375)

    found = find_minimal_change(torch.ones(4), PAIRS, search(fails, project))
    assert max(float(t.max()) for t in seen) <= 0.375
    assert found.dropped == ("b",)
    assert 0.375 <= found.scale < 0.375 + RESOLUTION


def test_a_projection_that_lengthens_does_not_pass_for_smaller():
    """Without block a, projection sends b far out, where it fails: no smaller than what there was."""

    def project(theta):
        return theta if bool(theta[0] != 0) or not bool(theta.any()) else torch.tensor([0.0, 0, 9, 9])

    found = find_minimal_change(torch.ones(4), PAIRS, search(lambda t: bool(t[2] > 0.5), project))
    assert found.dropped == ()


@given(st.lists(st.floats(0, 1), min_size=17, max_size=17), st.integers(0, 3))
def test_the_result_fails_and_is_no_larger_than_the_start(heights, seed):
    theta = torch.randn(4, generator=torch.Generator().manual_seed(seed))

    def fails(point):
        """Some jagged function of where the point is; the whole change fails, none of it does not."""
        share = float((point * theta).sum() / (theta @ theta))
        return share > 0.999 or (share > 0 and heights[min(int(16 * share), 16)] > 0.7)

    found = find_minimal_change(theta, PAIRS, search(fails))
    assert fails(found.theta)
    assert float(found.theta.norm()) <= float(found.shortened.norm()) * (1 + 1e-4)
    assert float(found.shortened.norm()) <= float(theta.norm()) * (1 + 1e-6)


def test_what_does_not_fail_is_refused():
    with pytest.raises(RangeError, match="expected a change that fails, found one that does not"):
        find_minimal_change(torch.ones(4), PAIRS, search(lambda _: False))
    with pytest.raises(RangeError, match="found a failure without any change"):
        find_minimal_change(torch.ones(4), PAIRS, search(lambda _: True))


def test_what_only_occurs_in_the_picture_is_not_enough():
    """The scan follows the picture; the scale is the first from which the failure holds."""
    occurs, holds = (lambda theta: bool(theta[0] > 0.2)), (lambda theta: bool(theta[0] > 0.6))
    found = find_minimal_change(
        torch.tensor([1.0, 0, 0, 0]),
        [],
        MinimalChangeSearch(lambda t: t, occurs, holds, lambda t: float(t.norm()), 16),
    )
    assert found.scan.index(True) == 4
    assert 0.6 < found.scale < 0.6 + RESOLUTION
