"""Densities on a grid: planted modes come out with weights, order, and rotations between grid points."""

from __future__ import annotations

import math

import pytest
import torch
from conftest import assert_close
from scipy.spatial.transform import Rotation
from torch import Tensor

from sphereorient import so3
from sphereorient.learn.network import find_modes, first_right, smoothed_target

GRID = so3.lattman_grid(math.radians(15.0)).float()
SPREAD = math.radians(8.0)


def turned(axis: tuple[float, float, float], degrees: float) -> Tensor:
    vector = math.radians(degrees) * torch.tensor(axis, dtype=torch.float64)
    return torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_matrix())


def off_deg(a: Tensor, b: Tensor) -> float:
    return float(torch.rad2deg(so3.geodesic_distance(a.double(), b.double())).max())


def planted(*tops: tuple[Tensor, float]) -> Tensor:
    """Logits of a mixture of modes (R, weight), with an arbitrary constant."""
    density = sum(weight * smoothed_target(R.float()[None], GRID, SPREAD) for R, weight in tops)
    assert isinstance(density, Tensor)
    return density.clamp_min(1e-30).log() + 5.0


def test_two_planted_tops_come_in_the_order_of_their_weights(rng):
    for R in so3.random_rotations(10, generator=rng):
        small, large = R, turned((0.6, 0.0, 0.8), 130.0) @ R
        tops = find_modes(planted((small, 0.3), (large, 0.7)), GRID, 8)
        assert off_deg(tops.R_view_body[0, 0], large) < 3
        assert off_deg(tops.R_view_body[0, 1], small) < 3
        # A Gaussian of 8 degrees has 0.8 .. 0.95 of itself within 22 degrees of a place at most 10 degrees beside it.
        both = tops.probability[0, :2]
        assert 0.75 < both.sum() < 1
        assert_close(both / both.sum(), torch.tensor([0.7, 0.3]), atol=0.06)


def test_a_top_between_places_of_the_grid_is_found_between_them(rng):
    """The nearest place is up to 10 degrees away, half of them more than 5."""
    R = so3.random_rotations(200, generator=rng)
    logits = torch.cat([planted((one, 1.0)) for one in R])
    found = find_modes(logits, GRID, 1).R_view_body[:, 0]
    off = torch.rad2deg(so3.geodesic_distance(found.double(), R))
    nearest = torch.rad2deg(so3.geodesic_distance(GRID[logits.argmax(1)].double(), R))
    assert off.median() < 0.4 * nearest.median()
    assert off.max() < 6
    assert_close(found.mT @ found, torch.eye(3).expand_as(found), atol=1e-5)


def test_a_temperature_sharpens_probabilities_and_leaves_places_alone(rng):
    R = so3.random_rotations(20, generator=rng)
    logits = torch.cat([planted((one, 0.6), (turned((0, 0, 1), 100.0) @ one, 0.4)) for one in R])
    plain, sharp = find_modes(logits, GRID, 2), find_modes(logits, GRID, 2, temperature=0.4)
    assert (sharp.probability[:, 0] > plain.probability[:, 0]).all()
    assert sharp.probability[:, 0].mean() > plain.probability[:, 0].mean() + 0.1
    either = [torch.rad2deg(so3.geodesic_distance(plain.R_view_body, sharp.R_view_body[:, [k]])) for k in range(2)]
    assert all((one.amin(1) < 0.1).all() for one in either)


def test_tops_are_apart_and_probabilities_fall_and_are_no_more_than_all(rng):
    tops = find_modes(3 * torch.randn(16, len(GRID), generator=rng), GRID, 6)
    assert (tops.probability.diff(dim=1) <= 0).all()
    assert (tops.probability.sum(1) <= 1 + 1e-5).all()
    assert (tops.probability >= 0).all()


def test_where_there_is_one_top_alone_the_others_have_no_probability():
    logits = torch.full((1, len(GRID)), -60.0)
    logits[0, 1234] = 0.0
    tops = find_modes(logits, GRID, 4)
    assert_close(tops.probability[0, 0], torch.tensor(1.0), atol=1e-5)
    assert off_deg(tops.R_view_body[0, 0], GRID[1234]) < 0.1
    assert tops.probability[0, 1:].max() < 1e-10


def test_a_batch_is_the_stack_of_its_singles(rng):
    logits = torch.randn(5, len(GRID), generator=rng) * 2
    together = find_modes(logits, GRID, 4)
    for k in range(5):
        alone = find_modes(logits[k : k + 1], GRID, 4)
        assert_close(alone.R_view_body[0], together.R_view_body[k], atol=1e-5)
        assert_close(alone.probability[0], together.probability[k], atol=1e-6)


def test_a_spread_answer_is_a_gaussian_of_the_angle(rng):
    R = so3.random_rotations(4, generator=rng)
    answer = smoothed_target(R, GRID.double(), SPREAD)
    assert_close(answer.sum(1), torch.ones(4, dtype=torch.float64), atol=1e-9)
    angle = torch.from_numpy(
        (Rotation.from_matrix(R[2].numpy()).inv() * Rotation.from_matrix(GRID.double().numpy())).magnitude()
    )
    expected = torch.exp(-angle.square() / (2 * SPREAD**2))
    near = angle < math.radians(20)
    ratio = (answer[2] / answer[2].max())[near] / (expected / expected.max())[near]
    # 3 - trace is 2 (1 - cos), below the square of the angle by a hundredth at 20 degrees: 4 % of exp(-3.1).
    assert_close(ratio, torch.ones_like(ratio), atol=0.05)
    assert answer[2].argmax() == angle.argmin()


@pytest.mark.parametrize(("degrees", "place"), [(9.0, 1), (11.0, 5)])
def test_the_first_right_one_is_within_the_angle(degrees, place, rng):
    R = so3.random_rotations(1, generator=rng)
    logits = planted((R[0], 0.3), (turned((1, 0, 0), 120.0) @ R[0], 0.7))
    tops = find_modes(logits, GRID, 5)
    truth = turned((0, 1, 0), degrees) @ tops.R_view_body[:, 1].double()
    assert int(first_right(tops, truth.float(), 10.0)) == place


def test_a_place_without_probability_is_never_right():
    logits = torch.full((1, len(GRID)), -200.0)
    logits[0, 7] = 0.0
    tops = find_modes(logits, GRID, 3)
    assert tops.probability[0, 2] == 0
    assert int(first_right(tops, tops.R_view_body[:, 2], 10.0)) == 3


@pytest.mark.slow
def test_a_place_between_two_tops_counts_for_the_nearer_one_alone():
    """The oracle: a loop over the grid, for two bumps 25 .. 35 degrees apart on a broad hill."""
    apart = torch.rad2deg(so3.geodesic_distance(GRID[2000].double(), GRID.double()))
    near = int(torch.nonzero((apart > 26) & (apart < 34))[0])
    hill = smoothed_target(GRID[[2000]], GRID, math.radians(18)).log()
    hill[0, [2000, near]] = hill.max() + torch.tensor([0.3, 0.2])
    tops = find_modes(hill, GRID, 2)
    expected = [0.0, 0.0]
    for place, probability in zip(GRID, hill.softmax(1)[0].tolist(), strict=True):
        degrees = [off_deg(place, GRID[2000]), off_deg(place, GRID[near])]
        if min(degrees) < 22:
            expected[degrees.index(min(degrees))] += probability
    assert_close(tops.probability[0], torch.tensor(expected), atol=0.01)
